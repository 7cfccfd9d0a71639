//! The ten pairs of neighboring photographs of the castle of Sceaux, against the poses that COLMAP found from all eleven.

use super::Check;
use anyhow::{Context, Result, bail};
use cv_core::Pose;
use cv_core::nalgebra::{Quaternion, UnitQuaternion, Vector3};
use cv_pipeline::{Intrinsics, ReconstructOptions, Silent, reconstruct};
use std::path::{Path, PathBuf};

/// The photographs are `100_7100.JPG` to `100_7110.JPG`, in the order in which the photographer walked.
const PAIRS: usize = 10;

pub(crate) fn run(data: &Path) -> Result<Vec<Check>> {
    let folder = data.join("sfm");
    let reference = folder.join("sceaux-reference/poses.txt");
    let text = std::fs::read_to_string(&reference).with_context(|| reference.display().to_string())?;
    let (mut turn, mut direction, mut rms, mut points) = (0.0f64, 0.0f64, 0.0f64, usize::MAX);
    let read = |i: usize| cv_io::read_image(sceaux(&folder, i));
    let (mut free_close, mut free_squares) = (0.0, 0.0);
    let mut first = read(0)?.into_rgb8();
    for i in 0..PAIRS {
        let second = read(i + 1)?.into_rgb8();
        // The header holds COLMAP's camera, whose pixel centers the reader brings to ours.
        let camera = cv_io::read_camera(&reference, Some(first.size()))?;
        let options = ReconstructOptions::new(Intrinsics::Known([camera; 2]));
        let result = reconstruct(first.view(), second.view(), &options, &Silent)
            .with_context(|| format!("{} and {}", name(i), name(i + 1)))?;
        let truth = Pose::relative(&pose(&text, &name(i))?, &pose(&text, &name(i + 1))?);
        let turned = cv_synth::rotation_error(&result.scene.pose.rotation, &truth.rotation).to_degrees();
        let moved = cv_synth::direction_error(&result.scene.pose.translation, &truth.translation).to_degrees();
        let said = result.scene.pose_deviation.map(f64::to_degrees);
        println!(
            "{} to {}: {} matches, {} agree, {} points, {:.3} px; rotation {turned:.3}° ({:.3}° by our own account), \
             direction {moved:.3}° ({:.3}°)",
            name(i),
            name(i + 1),
            result.matching.matches.len(),
            result.scene.inliers.len(),
            result.scene.points.len(),
            result.scene.reprojection_rms,
            said[0],
            said[1],
        );
        (turn, direction) = (turn.max(turned), direction.max(moved));
        (rms, points) = (rms.max(result.scene.reprojection_rms), points.min(result.scene.points.len()));
        // Without the camera, from the matches alone; `focal` has what is between.
        let options = ReconstructOptions::new(Intrinsics::Unknown);
        let result = reconstruct(first.view(), second.view(), &options, &Silent)
            .with_context(|| format!("{} and {} by themselves", name(i), name(i + 1)))?;
        let off = result.scene.cameras[0].fx / camera.fx - 1.0;
        println!(
            "  by themselves: focal length {:.0} px, off {:+.1} % ({:.1} % by our own account)",
            result.scene.cameras[0].fx,
            100.0 * off,
            100.0 * result.scene.focal_deviation
        );
        free_close += f64::from(u8::from(off.abs() <= 0.05));
        free_squares += (off / result.scene.focal_deviation).powi(2);
        first = second;
    }
    Ok(vec![
        Check::at_least("points of the poorest pair", points as f64, 1500.0),
        Check::at_most("reprojection RMS of the worst, px", rms, 0.7),
        Check::at_most("rotation of the worst, degrees", turn, 0.5),
        Check::at_most("direction of the worst, degrees", direction, 3.0),
        Check::at_least("by themselves: pairs with a focal length within 5 %", free_close, 9.0),
        // Of ten normal errors, one set in a hundred has more.
        Check::at_most(
            "by themselves: errors of it, in deviations that are stated (RMS)",
            (free_squares / PAIRS as f64).sqrt(),
            1.52,
        ),
    ])
}

/// The name of a photograph.
pub(super) fn name(i: usize) -> String {
    format!("100_71{i:02}.JPG")
}

/// Its path.
pub(super) fn sceaux(folder: &Path, i: usize) -> PathBuf {
    folder.join("sceaux").join(name(i))
}

/// A row of the reference: `name qw qx qy qz tx ty tz`, world to camera.
pub(super) fn pose(text: &str, name: &str) -> Result<Pose> {
    let row = text.lines().find(|l| l.split_whitespace().next() == Some(name));
    let row = row.with_context(|| format!("no pose of {name}"))?;
    let numbers: Vec<f64> = row.split_whitespace().skip(1).map(str::parse).collect::<Result<_, _>>()?;
    let [w, x, y, z, tx, ty, tz] = numbers[..] else { bail!("{name}: {} numbers instead of 7", numbers.len()) };
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
    Ok(Pose::new(rotation, Vector3::new(tx, ty, tz)))
}
