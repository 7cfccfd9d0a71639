//! Two-view reconstruction of the ten pairs of neighboring photographs of Sceaux castle, against COLMAP's poses from all eleven.

use super::Check;
use anyhow::{Context, Result, bail};
use cv_core::Pose;
use cv_core::nalgebra::{Quaternion, UnitQuaternion, Vector3};
use cv_pipeline::{Intrinsics, ReconstructOptions, Silent, reconstruct};
use std::path::{Path, PathBuf};

/// Number of pairs; the photographs are `100_7100.JPG` to `100_7110.JPG`, in the order of the viewpoints.
const PAIRS: usize = 10;

pub(crate) fn run(data: &Path) -> Result<Vec<Check>> {
    let folder = data.join("sfm");
    let reference = folder.join("sceaux-reference/poses.txt");
    let text = std::fs::read_to_string(&reference).with_context(|| reference.display().to_string())?;
    let (mut max_rotation, mut max_direction, mut max_rms, mut min_points) = (0.0f64, 0.0f64, 0.0f64, usize::MAX);
    let read = |i: usize| cv_io::read_image(sceaux(&folder, i));
    let (mut focal_within, mut focal_squares) = (0.0, 0.0);
    let mut first = read(0)?.into_rgb8();
    for i in 0..PAIRS {
        let second = read(i + 1)?.into_rgb8();
        // The header has COLMAP's camera; the reader converts its pixel coordinates to our convention.
        let camera = cv_io::read_camera(&reference, Some(first.size()))?;
        let options = ReconstructOptions::new(Intrinsics::Known([camera; 2]));
        let result = reconstruct(first.view(), second.view(), &options, &Silent)
            .with_context(|| format!("{} and {}", name(i), name(i + 1)))?;
        let truth = Pose::relative(&pose(&text, &name(i))?, &pose(&text, &name(i + 1))?);
        let rotation = cv_synth::rotation_error(&result.scene.pose.rotation, &truth.rotation).to_degrees();
        let direction = cv_synth::direction_error(&result.scene.pose.translation, &truth.translation).to_degrees();
        let sigma = result.scene.pose_deviation.map(f64::to_degrees);
        println!(
            "{} to {}: {} matches, {} inliers, {} points, {:.3} px; rotation error {rotation:.3}° (σ {:.3}°), \
             direction error {direction:.3}° (σ {:.3}°)",
            name(i),
            name(i + 1),
            result.matching.matches.len(),
            result.scene.inliers.len(),
            result.scene.points.len(),
            result.scene.reprojection_rms,
            sigma[0],
            sigma[1],
        );
        (max_rotation, max_direction) = (max_rotation.max(rotation), max_direction.max(direction));
        (max_rms, min_points) = (max_rms.max(result.scene.reprojection_rms), min_points.min(result.scene.points.len()));
        // With an unknown focal length; the job `focal` tests an approximate one.
        let options = ReconstructOptions::new(Intrinsics::Unknown);
        let result = reconstruct(first.view(), second.view(), &options, &Silent)
            .with_context(|| format!("{} and {} without a focal length", name(i), name(i + 1)))?;
        let error = result.scene.cameras[0].fx / camera.fx - 1.0;
        println!(
            "  unknown focal length: {:.0} px, error {:+.1} % (σ {:.1} %)",
            result.scene.cameras[0].fx,
            100.0 * error,
            100.0 * result.scene.focal_deviation
        );
        focal_within += f64::from(u8::from(error.abs() <= 0.05));
        focal_squares += (error / result.scene.focal_deviation).powi(2);
        first = second;
    }
    Ok(vec![
        Check::at_least("fewest points of a pair", min_points as f64, 1500.0),
        Check::at_most("largest reprojection RMS, px", max_rms, 0.7),
        Check::at_most("largest rotation error, degrees", max_rotation, 0.5),
        Check::at_most("largest direction error, degrees", max_direction, 3.0),
        Check::at_least("unknown focal length: pairs with an error within 5 %", focal_within, 9.0),
        // The 99th percentile of the RMS of ten standard normal errors.
        Check::at_most(
            "unknown focal length: RMS of its errors, in estimated standard deviations",
            (focal_squares / PAIRS as f64).sqrt(),
            1.52,
        ),
    ])
}

/// Returns the file name of a photograph.
pub(super) fn name(i: usize) -> String {
    format!("100_71{i:02}.JPG")
}

/// Returns the path of a photograph.
pub(super) fn sceaux(folder: &Path, i: usize) -> PathBuf {
    folder.join("sceaux").join(name(i))
}

/// Parses the pose of a photograph from a row of the reference, `name qw qx qy qz tx ty tz`, world to camera.
pub(super) fn pose(text: &str, name: &str) -> Result<Pose> {
    let row = text.lines().find(|l| l.split_whitespace().next() == Some(name));
    let row = row.with_context(|| format!("no pose of {name}"))?;
    let numbers: Vec<f64> = row.split_whitespace().skip(1).map(str::parse).collect::<Result<_, _>>()?;
    let [w, x, y, z, tx, ty, tz] = numbers[..] else { bail!("{name}: {} numbers instead of 7", numbers.len()) };
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
    Ok(Pose::new(rotation, Vector3::new(tx, ty, tz)))
}
