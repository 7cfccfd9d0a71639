//! `cargo xtask fixtures`: renders the small inputs under `fixtures/` and writes what is true about them to
//! `fixtures/oracle`. Run it only to change them: tests and golden figures rest on these bytes.

use anyhow::Result;
use cv_core::{Camera, Matrix3, RgbU8};
use cv_synth::{
    PanoramaSetOptions, RenderOptions, Scene, ball_photos, homography_pair, panorama_views, stereo_pair, two_view,
};
use serde_json::{Value, json};
use std::{fs, path::Path};

/// One seed for all scenes; another one gives other rooms.
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

/// JPEG as cameras write it: small, and with the errors that real inputs have.
fn photo(path: impl AsRef<Path>, image: &RgbU8) -> Result<()> {
    Ok(cv_io::write_jpeg(path, image.view())?)
}

fn oracle(root: &Path, name: &str, truth: &Value) -> Result<()> {
    let text = serde_json::to_string_pretty(truth)? + "\n";
    Ok(cv_io::write_bytes(folder(root, "oracle")?.join(name), text.as_bytes())?)
}

fn rows(m: &Matrix3<f64>) -> Vec<Vec<f64>> {
    m.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// A rectified pair, its disparity and what both views see.
fn stereo(root: &Path) -> Result<()> {
    let scene = Scene::tabletop(SEED);
    // Disparities of tens of pixels, as in photographs: 5 % of the depth is then no fraction of what a pixel resolves.
    let camera = Camera::from_focal(400, 300, 380.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.12, &RenderOptions::default())?;
    let to = folder(root, "stereo")?;
    photo(to.join("left.jpg"), &pair.left.image)?;
    photo(to.join("right.jpg"), &pair.right.image)?;
    let truth = folder(root, "oracle")?;
    // 1/256 px steps, far below what any matcher resolves.
    cv_io::kitti::write(truth.join("stereo-disparity.png"), pair.disparity.view())?;
    cv_io::write_png(truth.join("stereo-visible.png"), pair.visible.view())?;
    oracle(root, "stereo.json", &json!({ "focal_px": camera.fx, "baseline_m": pair.baseline }))
}

/// Three overlapping photographs from one point and the homographies between neighbors.
fn panorama(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(320, 240, 330.0);
    let options = PanoramaSetOptions { views: 3, ..PanoramaSetOptions::default() };
    let set = panorama_views(SEED, &camera, &options, &RenderOptions::default())?;
    let to = folder(root, "panorama")?;
    for (i, view) in set.views.iter().enumerate() {
        photo(to.join(format!("view{i}.jpg")), &view.image)?;
    }
    let homographies: Vec<_> = (0..2).filter_map(|i| set.homography(i, i + 1)).map(|h| rows(&h)).collect();
    oracle(root, "panorama.json", &json!({ "focal_px": camera.fx, "homographies": homographies }))
}

/// Two views of a room and the motion between them.
fn pair(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(480, 360, 440.0);
    let views = two_view(SEED, &camera, 0.5, &RenderOptions::default())?;
    let to = folder(root, "two-view")?;
    photo(to.join("a.jpg"), &views.a.image)?;
    photo(to.join("b.jpg"), &views.b.image)?;
    let truth = json!({
        "focal_px": camera.fx,
        "rotation": rows(views.relative.rotation.matrix()),
        "translation_m": views.relative.translation.as_slice(),
    });
    oracle(root, "two-view.json", &truth)
}

/// Two views of a wall and the homography between them.
fn plane(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(320, 240, 300.0);
    let views = homography_pair(SEED, &camera, 0.3, &RenderOptions::default())?;
    let to = folder(root, "plane")?;
    photo(to.join("a.jpg"), &views.a.image)?;
    photo(to.join("b.jpg"), &views.b.image)?;
    oracle(root, "plane.json", &json!({ "homography": rows(&views.homography) }))
}

/// Photographs of an orange ball and where it is.
fn ball(root: &Path) -> Result<()> {
    let camera = Camera::from_focal(160, 120, 140.0);
    let photos = ball_photos(SEED, 8, &camera, &RenderOptions::default())?;
    let (images, masks) = (folder(root, "ball")?, folder(root, "oracle/ball-masks")?);
    for (i, ball) in photos.iter().enumerate() {
        photo(images.join(format!("ball{i}.jpg")), &ball.view.image)?;
        cv_io::write_png(masks.join(format!("ball{i}_mask.png")), ball.mask.view())?;
    }
    Ok(())
}
