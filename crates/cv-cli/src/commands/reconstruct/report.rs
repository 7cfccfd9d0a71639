//! The report of `cv reconstruct`.

use crate::frame::Failure;
use crate::pictures::{Width, cloud, map, picture};
use cv_core::{Correspondence, Keypoint, Point2, Point3, PointCloud, Pose, RgbU8};
use cv_pipeline::{DenseResult, ReconstructResult};
use cv_report::{
    MapStyle, MatchStyle, Plot, PointScene, Report, camera_color, draw_epipolar_lines, draw_keypoints, draw_matches,
};
use std::path::Path;

/// Builds the page: clouds, relative pose, matches and residuals.
pub(super) fn report(
    paths: [&Path; 2],
    photos: [&RgbU8; 2],
    result: &ReconstructResult,
    dense: Option<&DenseResult>,
    source: &str,
) -> Result<Report, Failure> {
    let found = &result.scene;
    let mut page = Report::new("Two-view reconstruction");
    page.subtitle(&format!("{} and {}", paths[0].display(), paths[1].display()))
        .headline("points", &found.points.len().to_string())
        .headline("inliers", &format!("{} of {}", found.inliers.len(), result.matching.matches.len()))
        .headline("reprojection RMS", &format!("{:.2} px", found.reprojection_rms))
        .headline("median triangulation angle", &format!("{:.2}°", found.median_angle.to_degrees()));
    if found.planar_ratio > 0.8 {
        page.warn("the scene is nearly planar: the pose is less certain than its standard deviations state");
    }
    page.section("The cloud").paragraph(
        "The points are triangulated from both images. The unit is the baseline; the cameras are drawn as pyramids.",
    );
    let names = paths.map(|path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy());
    cloud(&mut page, &sparse(result, names.each_ref().map(|n| &**n)), "The points and the two cameras.")?;
    if let Some(dense) = dense {
        dense_section(&mut page, dense, result, names.each_ref().map(|n| &**n))?;
    }
    motion(&mut page, result, source);
    matches(&mut page, photos, result)?;

    page.section("Quality");
    let plot = |title: &str, unit: &str, values: Vec<f64>| Plot::new(title, unit, "points").histogram("", &values, 30);
    let errors = plot("Reprojection error", "px", found.points.iter().map(|p| p.reprojection).collect());
    let angles = plot("Triangulation angle", "degrees", found.points.iter().map(|p| p.angle.to_degrees()).collect());
    page.plots(&[
        (&errors, "Distance of the projections of the points from the matched keypoints."),
        (&angles, "Small angles mean uncertain depths."),
    ]);
    let stages: Vec<_> =
        result.stages.iter().copied().chain(dense.iter().flat_map(|d| super::dense_stages(d))).collect();
    page.times(&stages);
    Ok(page)
}

/// Builds the scene of the sparse points, both cameras, and the keypoints of the points in both images.
pub(crate) fn sparse(result: &ReconstructResult, names: [&str; 2]) -> PointScene {
    let mut scene = scene(&result.cloud(), result);
    for (side, (name, camera)) in names.into_iter().zip(&result.scene.cameras).enumerate() {
        scene.add_observations(name, (camera.width, camera.height), |i| {
            let pair = result.pair(&result.scene.points[i]);
            Some(if side == 0 { pair.a } else { pair.b })
        });
    }
    scene
}

/// Builds a scene of a cloud with both cameras.
fn scene(cloud: &PointCloud, result: &ReconstructResult) -> PointScene {
    let mut scene = PointScene::new(cloud);
    for (i, (camera, pose)) in result.scene.cameras.iter().zip([Pose::identity(), result.scene.pose]).enumerate() {
        scene.add_camera(camera, &pose, camera_color(i));
    }
    scene
}

fn motion(page: &mut Report, result: &ReconstructResult, source: &str) {
    let found = &result.scene;
    let degrees = |v: f64| format!("{:.3}°", v.to_degrees());
    let vector = |v: &cv_core::Vector3<f64>| format!("({:.4}, {:.4}, {:.4})", v.x, v.y, v.z);
    let deviation = match found.focal_deviation {
        0.0 => String::new(),
        relative => format!(" ± {:.1} %", 100.0 * relative),
    };
    page.section("Relative pose").facts(
        "From the first camera to the second, in the frame of the first: x right, y down, z forward.",
        &[
            ("rotation angle", degrees(found.pose.rotation_angle())),
            ("rotation axis", found.pose.rotation.axis().map_or_else(|| "none".to_owned(), |axis| vector(&axis))),
            ("translation direction", vector(&found.pose.translation)),
            ("standard deviation of the rotation", degrees(found.pose_deviation[0])),
            ("standard deviation of the translation direction", degrees(found.pose_deviation[1])),
            ("matches added by guided matching", found.guided.to_string()),
            (
                "focal lengths",
                format!("{:.1} and {:.1} px{deviation} ({source})", found.cameras[0].fx, found.cameras[1].fx),
            ),
            ("explained by one plane", format!("{:.0} % of the inliers", 100.0 * found.planar_ratio)),
        ],
    );
}

fn matches(page: &mut Report, [a, b]: [&RgbU8; 2], result: &ReconstructResult) -> Result<(), Failure> {
    let [fa, fb] = result.matching.features.each_ref().map(|f| &f.keypoints);
    let shown = |k: &[Keypoint]| k.iter().step_by((k.len() / 2000).max(1)).copied().collect::<Vec<_>>();
    let marked = |photo: &RgbU8, k: &[Keypoint]| draw_keypoints(photo.view(), &shown(k), [0, 158, 115]);
    let first = format!("{} features of the first image (at most 2000 drawn).", fa.len());
    page.section("Features and matches").figures(vec![
        picture(&marked(a, fa), Width::Half, &first)?,
        picture(&marked(b, fb), Width::Half, &format!("{} features of the second image.", fb.len()))?,
    ]);
    let pairs = &result.matching.pairs();
    let mut mask = vec![false; pairs.len()];
    result.scene.inliers.iter().for_each(|&i| mask[i] = true);
    let style = MatchStyle::default();
    let before = draw_matches(a.view(), b.view(), pairs, None, &style);
    let after = draw_matches(a.view(), b.view(), pairs, Some(&mask), &style);
    let chosen: Vec<Correspondence> = result.scene.inliers.iter().map(|&i| pairs[i]).collect();
    let lines = draw_epipolar_lines(a.view(), b.view(), &result.scene.fundamental(), &chosen, 24);
    for (image, caption) in [
        (before, "Tentative matches, each in its own color."),
        (after, "After robust estimation of the pose: inliers green, outliers red."),
        (
            lines,
            "Points and their epipolar lines in the other image (lens distortion, which bends them, is not drawn).",
        ),
    ] {
        page.figure(picture(&image, Width::Full, caption)?);
    }
    Ok(())
}

/// Adds the depth map and the cloud of the dense matching.
fn dense_section(
    page: &mut Report,
    dense: &DenseResult,
    result: &ReconstructResult,
    names: [&str; 2],
) -> Result<(), Failure> {
    let (width, height) = dense.size;
    page.section("The dense cloud").paragraph(&format!(
        "The images were rectified to {width}×{height} px and matched at {} disparities. {} points, {:.0} % of the overlap, passed the left-right \
         check.",
        dense.disparities.1,
        dense.cloud.len(),
        100.0 * dense.coverage,
    ));
    let style = MapStyle::depth("baselines");
    let caption = "Depth of the first image: near blue, far red, invalid gray.";
    page.figure(map(dense.depth.view(), &style, Width::Full, caption)?);
    let mut scene = scene(&dense.cloud, result);
    for ((name, camera), pose) in
        names.into_iter().zip(&result.scene.cameras).zip([Pose::identity(), result.scene.pose])
    {
        scene.add_observations(name, (camera.width, camera.height), |i| {
            let point = Point3::from(dense.cloud.positions[i].map(f64::from));
            camera.project(&pose.transform(&point)).filter(|p: &Point2<f64>| p.coords.iter().all(|v| v.is_finite()))
        });
    }
    cloud(page, &scene, "The dense cloud.")
}
