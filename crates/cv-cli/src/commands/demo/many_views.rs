//! Structure from motion on a walk through a room.

use super::{Check, Demo, Part};
use crate::frame::Failure;
use crate::pictures::still;
use cv_core::{Pose, RgbU8};
use cv_pipeline::many_views::{CameraKnowledge, align_to_poses};
use cv_pipeline::{SfmCamera, SfmJobOptions, sfm, sfm_photo};
use cv_report::PointScene;
use cv_synth::{RenderOptions, Scene, render, rotation_error};

/// Number of images.
const COUNT: usize = 7;
/// Number of images of the full circular walk of which the first [`COUNT`] are used.
const AROUND: usize = 24;

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    // Smaller than the images of the other jobs, since there are more of them.
    let camera = demo.camera().resized(400, 300);
    let scene = Scene::room(demo.seed);
    let mut options = SfmJobOptions::default();
    options.features = options.features.at_most(3000);
    let (mut photos, mut truth) = (Vec::new(), Vec::new());
    for (i, pose) in Scene::room_walk(AROUND).into_iter().take(COUNT).enumerate() {
        let image: RgbU8 =
            render(&scene, &camera, &pose, &RenderOptions { seed: demo.seed + i as u64, ..RenderOptions::default() })?
                .image;
        let name = format!("walk-{}.png", i + 1);
        cv_io::write_png(demo.out.join(&name), image.view())?;
        photos.push(sfm_photo(image.view(), name, 0, &options.features, demo.context)?);
        truth.push(Some(pose));
    }
    let cameras = [SfmCamera { camera, knowledge: CameraKnowledge::Known }];
    let mut result = match sfm(&photos, &cameras, &options, demo.context) {
        Ok(result) => result,
        Err(error) => return Ok(Part::failed("sfm", &error)),
    };
    // Align to the frame of the room: the reconstruction is up to a similarity.
    let model = &mut result.models[0];
    if let Some(similarity) = align_to_poses(model, &truth) {
        model.transform(&similarity);
    }
    let pairs: Vec<(Pose, Pose)> = model.poses.iter().zip(&truth).filter_map(|(a, b)| Some(((*a)?, (*b)?))).collect();
    let turn = pairs.iter().map(|(a, b)| rotation_error(&a.rotation, &b.rotation)).fold(0.0, f64::max).to_degrees();
    let off = pairs.iter().map(|(a, b)| (a.center() - b.center()).norm()).fold(0.0, f64::max);
    let length: f64 = truth.windows(2).filter_map(|w| Some((w[1]?.center() - w[0]?.center()).norm())).sum();
    let walk = format!("a walk of {length:.2} m");
    let checks = vec![
        Check::at_least("sfm", "photographs in the model", pairs.len() as f64 / COUNT as f64, 1.0, "%")
            .of(format!("{COUNT}"), format!("{}", pairs.len())),
        Check::at_most("sfm", "largest error of a camera center", 100.0 * off, 2.0, "cm")
            .of(walk, format!("{} points", model.points.len())),
        Check::at_most("sfm", "largest rotation error", turn, 0.3, "°"),
    ];
    let points = model.points.len();
    let cloud = PointScene::of_model(&result.sparse_model(0, &photos).unwrap_or_default());
    let still = still(&cloud)?;
    Ok(Part::new(checks, move |page| {
        page.section("Many views").paragraph(&format!(
            "{COUNT} photographs of a walk through the room. Their matches determine the camera poses and {points} points."
        ));
        page.points(
            &cloud,
            Some(still),
            "The points, and the cameras from the first (blue) to the last (red). Drag to rotate.",
        );
    }))
}
