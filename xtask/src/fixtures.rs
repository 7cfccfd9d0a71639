//! `cargo xtask fixtures`: renders the small inputs under `fixtures/` and writes their ground truth to
//! `fixtures/oracle`. Run it only to change them: tests and golden figures depend on these bytes.

use anyhow::Result;
use cv_core::{Camera, Matrix3, RgbU8};
use cv_synth::{
    PanoramaSetOptions, RenderOptions, Scene, ball_photos, homography_pair, panorama_views, stereo_pair, two_view,
};
use serde_json::{Value, json};
use std::{fs, path::Path};

/// Seed of all scenes.
const SEED: u64 = 20;

/// Renders all fixtures.
pub(crate) fn run() -> Result<bool> {
    let root = crate::root().join("fixtures");
    stereo(&root)?;
    panorama(&root)?;
    pair(&root)?;
    plane(&root)?;
    ball(&root)?;
    Ok(true)
}

fn folder(root: &Path, name: &str) -> Result<std::path::PathBuf> {
    let folder = root.join(name);
    fs::create_dir_all(&folder)?;
    Ok(folder)
}

/// Writes a JPEG file: small, and with the compression artifacts of real inputs.
fn write_photo(path: impl AsRef<Path>, image: &RgbU8) -> Result<()> {
    Ok(cv_io::write_jpeg(path, image.view())?)
}

/// Writes ground truth as JSON.
fn write_oracle(root: &Path, name: &str, truth: &Value) -> Result<()> {
    let text = serde_json::to_string_pretty(truth)? + "\n";
    Ok(cv_io::write_bytes(folder(root, "oracle")?.join(name), text.as_bytes())?)
}

fn rows(m: &Matrix3<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// Renders a rectified pair, its disparity map and the mask of pixels visible in both views.
fn stereo(root: &Path) -> Result<()> {
    let scene = Scene::tabletop(SEED);
    // Disparities of tens of pixels, as in photographs, so that 5 % of the depth is more than a pixel.
    let camera = Camera::from_focal(400, 300, 380.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.12, &RenderOptions::default())?;
    let to = folder(root, "stereo")?;
    write_photo(to.join("left.jpg"), &pair.left.image)?;
    write_photo(to.join("right.jpg"), &pair.right.image)?;
    let truth = folder(root, "oracle")?;
    // Steps of 1/256 px, far below the resolution of any matcher.
    cv_io::kitti::write(truth.join("stereo-disparity.png"), pair.disparity.view())?;
    cv_io::write_png(truth.join("stereo-visible.png"), pair.visible.view())?;
    write_oracle(root, "stereo.json", &json!({ "focal_px": camera.fx, "baseline_m": pair.baseline }))
}

/// Renders three overlapping photographs from one viewpoint and the homographies between neighbors.
fn panorama(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(320, 240, 330.0);
    let options = PanoramaSetOptions { views: 3, ..PanoramaSetOptions::default() };
    let set = panorama_views(SEED, &camera, &options, &RenderOptions::default())?;
    let to = folder(root, "panorama")?;
    for (i, view) in set.views.iter().enumerate() {
        write_photo(to.join(format!("view{i}.jpg")), &view.image)?;
    }
    let homographies: Vec<_> = (0..2).filter_map(|i| set.homography(i, i + 1)).map(|h| rows(&h)).collect();
    write_oracle(root, "panorama.json", &json!({ "focal_px": camera.fx, "homographies": homographies }))
}

/// Renders two views of a room and their relative pose.
fn pair(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(480, 360, 440.0);
    let views = two_view(SEED, &camera, 0.5, &RenderOptions::default())?;
    let to = folder(root, "two-view")?;
    write_photo(to.join("a.jpg"), &views.a.image)?;
    write_photo(to.join("b.jpg"), &views.b.image)?;
    let truth = json!({
        "focal_px": camera.fx,
        "rotation": rows(views.relative.rotation.matrix()),
        "translation_m": views.relative.translation.as_slice(),
    });
    write_oracle(root, "two-view.json", &truth)
}

/// Renders two views of a wall and the homography between them.
fn plane(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(320, 240, 300.0);
    let views = homography_pair(SEED, &camera, 0.3, &RenderOptions::default())?;
    let to = folder(root, "plane")?;
    write_photo(to.join("a.jpg"), &views.a.image)?;
    write_photo(to.join("b.jpg"), &views.b.image)?;
    write_oracle(root, "plane.json", &json!({ "homography": rows(&views.homography) }))
}

/// Renders photographs of an orange ball and its masks.
fn ball(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(160, 120, 140.0);
    let photos = ball_photos(SEED, 8, &camera, &RenderOptions::default())?;
    let (images, masks) = (folder(root, "ball")?, folder(root, "oracle/ball-masks")?);
    for (i, ball) in photos.iter().enumerate() {
        write_photo(images.join(format!("ball{i}.jpg")), &ball.view.image)?;
        cv_io::write_png(masks.join(format!("ball{i}_mask.png")), ball.mask.view())?;
    }
    Ok(())
}
