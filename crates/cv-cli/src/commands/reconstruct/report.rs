//! The report of `cv reconstruct`.

use crate::frame::Failure;
use crate::pictures::{Width, cloud, map, picture};
use cv_core::{Correspondence, Keypoint, Point2, Point3, PointCloud, Pose, RgbU8};
use cv_pipeline::{DenseResult, ReconstructResult};
use cv_report::{
    MapStyle, MatchStyle, Plot, PointScene, Report, camera_color, draw_epipolar_lines, draw_keypoints, draw_matches,
};
use std::path::Path;

/// The page: the cloud, the motion, what was matched, and how well it fits.
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
        .headline("matches that agree", &format!("{} of {}", found.inliers.len(), result.matching.matches.len()))
        .headline("reprojection", &format!("{:.2} px", found.reprojection_rms))
        .headline("median angle", &format!("{:.2}°", found.median_angle.to_degrees()));
    if found.planar_share > 0.8 {
        page.warn("most of the scene is nearly one plane: the motion is less certain than the deviations say");
    }
    page.section("The cloud").paragraph(
        "Each point was seen in both photographs. The unit is the distance between the two cameras, which are drawn as pyramids.",
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
    let angles = plot("Angle between the rays", "degrees", found.points.iter().map(|p| p.angle.to_degrees()).collect());
    page.plots(&[
        (&errors, "How far the points are from where they were seen."),
        (&angles, "Small angles make uncertain depths."),
    ]);
    let stages: Vec<_> =
        result.stages.iter().copied().chain(dense.iter().flat_map(|d| super::dense_stages(d))).collect();
    page.times(&stages);
    Ok(page)
}

/// The points that were matched, both cameras, and where each photograph shows the points.
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

/// A cloud with both cameras.
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
        share => format!(" ± {:.1} %", 100.0 * share),
    };
    page.section("The motion").facts(
        "From the first camera to the second, in the frame of the first: x to the right, y down, z ahead.",
        &[
            ("angle of the rotation", degrees(found.pose.rotation_angle())),
            (
                "axis of the rotation",
                found.pose.rotation.axis().map_or_else(|| "none".to_owned(), |axis| vector(&axis)),
            ),
            ("direction of the translation", vector(&found.pose.translation)),
            ("standard deviation of the rotation", degrees(found.pose_deviation[0])),
            ("standard deviation of the direction", degrees(found.pose_deviation[1])),
            ("matches along epipolar lines", found.guided.to_string()),
            (
                "focal lengths",
                format!("{:.1} and {:.1} px{deviation} ({source})", found.cameras[0].fx, found.cameras[1].fx),
            ),
            ("explained by one plane", format!("{:.0} % of the matches that agree", 100.0 * found.planar_share)),
        ],
    );
}

fn matches(page: &mut Report, [a, b]: [&RgbU8; 2], result: &ReconstructResult) -> Result<(), Failure> {
    let [fa, fb] = result.matching.features.each_ref().map(|f| &f.keypoints);
    let shown = |k: &[Keypoint]| k.iter().step_by((k.len() / 2000).max(1)).copied().collect::<Vec<_>>();
    let marked = |photo: &RgbU8, k: &[Keypoint]| draw_keypoints(photo.view(), &shown(k), [0, 158, 115]);
    let first = format!("{} features of the first photograph (at most 2000 drawn).", fa.len());
    page.section("Features and matches").figures(vec![
        picture(&marked(a, fa), Width::Half, &first)?,
        picture(&marked(b, fb), Width::Half, &format!("{} of the second.", fb.len()))?,
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
        (before, "Tentative matches, each in a color of its own."),
        (after, "The same after the search for a motion: matches that agree green, others red."),
        (
            lines,
            "Points and their epipolar lines: each point of one photograph lies on its line in the other (up to the lens distortion, which bends lines).",
        ),
    ] {
        page.figure(picture(&image, Width::Full, caption)?);
    }
    Ok(())
}

/// Depth and cloud of the dense matching.
fn dense_section(
    page: &mut Report,
    dense: &DenseResult,
    result: &ReconstructResult,
    names: [&str; 2],
) -> Result<(), Failure> {
    let (width, height) = dense.size;
    page.section("The dense cloud").paragraph(&format!(
        "The photographs were rectified to {width}×{height} px and matched at {} disparities. {} points, {:.0} % of what both show, were confirmed \
         from both.",
        dense.disparities.1,
        dense.cloud.len(),
        100.0 * dense.coverage,
    ));
    let style = MapStyle::depth("distances between the cameras");
    let caption = "Depth of the first photograph: near blue, far red, unknown gray.";
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
