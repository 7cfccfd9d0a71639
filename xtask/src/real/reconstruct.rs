//! Two photographs of the castle of Sceaux, against the poses that COLMAP found from all eleven.

use super::Check;
use anyhow::{Context, Result, bail};
use cv_core::Pose;
use cv_core::nalgebra::{Quaternion, UnitQuaternion, Vector3};
use cv_pipeline::{Intrinsics, ReconstructOptions, Silent, reconstruct};
use std::path::Path;

/// The pair that the bars are for.
const PAIR: [&str; 2] = ["100_7103.JPG", "100_7104.JPG"];

pub(crate) fn run(data: &Path) -> Result<Vec<Check>> {
    let folder = data.join("sfm");
    let reference = folder.join("sceaux-reference/poses.txt");
    let text = std::fs::read_to_string(&reference).with_context(|| reference.display().to_string())?;
    let photos = PAIR.map(|name| cv_io::read_rgb(folder.join("sceaux").join(name)));
    let [a, b] = photos;
    let (a, b) = (a?, b?);
    // The header holds COLMAP's camera, whose pixel centres the reader brings to ours.
    let camera = cv_io::read_camera(&reference, Some(a.size()))?;
    let options = ReconstructOptions { intrinsics: Intrinsics::Known([camera; 2]), ..ReconstructOptions::default() };
    let result = reconstruct(a.view(), b.view(), &options, &Silent)?;
    let truth = Pose::relative(&pose(&text, PAIR[0])?, &pose(&text, PAIR[1])?);
    let turn = cv_synth::rotation_error(&result.pose.rotation, &truth.rotation).to_degrees();
    let direction = cv_synth::direction_error(&result.pose.translation, &truth.translation).to_degrees();
    println!(
        "{} matches, {} agree, {} along lines; {:?}",
        result.matching.pairs.len(),
        result.inliers.len(),
        result.guided,
        result.stages
    );
    Ok(vec![
        Check::at_least("points", result.points.len() as f64, 1200.0),
        Check::at_most("reprojection RMS, px", result.reprojection_rms, 1.2),
        Check::at_most("rotation, degrees", turn, 1.0),
        Check::at_most("direction, degrees", direction, 5.0),
    ])
}

/// A row of the reference: `name qw qx qy qz tx ty tz`, world to camera.
fn pose(text: &str, name: &str) -> Result<Pose> {
    let row = text.lines().find(|l| l.split_whitespace().next() == Some(name));
    let row = row.with_context(|| format!("no pose of {name}"))?;
    let numbers: Vec<f64> = row.split_whitespace().skip(1).map(str::parse).collect::<Result<_, _>>()?;
    let [w, x, y, z, tx, ty, tz] = numbers[..] else { bail!("{name}: {} numbers instead of 7", numbers.len()) };
    let rotation = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z)).to_rotation_matrix();
    Ok(Pose::new(rotation, Vector3::new(tx, ty, tz)))
}
