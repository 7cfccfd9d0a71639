//! Dense point clouds of generated scenes, against the true depth.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Distortion, Point3, Pose, Vector3};
use cv_pipeline::stereo::RectifyError;
use cv_pipeline::{
    Advice, DenseError, DenseOptions, Intrinsics, ReconstructOptions, ReconstructResult, Silent, reconstruct,
    reconstruct_dense,
};
use cv_synth::{RenderOptions, Scene, TwoView, render, two_view};

fn sparse(views: &TwoView, camera: &Camera) -> ReconstructResult {
    let options = ReconstructOptions::new(Intrinsics::Known([*camera; 2]));
    reconstruct(views.a.image.view(), views.b.image.view(), &options, &Silent).unwrap()
}

/// Returns the sorted relative depth errors of points, each at the pixel that it projects to.
fn errors(views: &TwoView, points: impl Iterator<Item = Point3<f64>>, camera: &Camera) -> Vec<f64> {
    let baseline = views.relative.translation.norm();
    let mut errors: Vec<f64> = points
        .map(|p| {
            let pixel = camera.project(&p).unwrap();
            let (x, y) = (pixel.x.round() as usize, pixel.y.round() as usize);
            let truth = f64::from(views.a.depth.at(x.min(camera.width - 1), y.min(camera.height - 1))[0]);
            (p.z * baseline / truth - 1.0).abs()
        })
        .collect();
    errors.sort_by(f64::total_cmp);
    errors
}

#[test]
fn the_cloud_is_as_accurate_as_the_sparse_points() {
    let plain = Camera::from_focal(640, 480, 560.0);
    let mut bent = plain;
    bent.distortion = Distortion::radial(-0.12, 0.02);
    // The second camera is left or right of the first, and a little in front or behind, depending on the seed.
    for (seed, camera) in [(3, plain), (5, bent), (8, plain), (11, bent)] {
        let views = two_view(seed, &camera, 0.4, &RenderOptions::draft()).unwrap();
        let sparse = sparse(&views, &camera);
        let (a, b) = (views.a.image.view(), views.b.image.view());
        let dense = reconstruct_dense(a, b, &sparse, &DenseOptions::default(), &Silent).unwrap();
        let position = |p: &[f32; 3]| Point3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]));
        let of_dense = errors(&views, dense.cloud.positions.iter().map(position), &camera);
        let of_sparse = errors(&views, sparse.scene.points.iter().map(|p| p.position), &camera);
        let at = |e: &[f64], fraction: f64| e[((e.len() - 1) as f64 * fraction) as usize];
        println!(
            "{seed}: {} points, coverage {:.2}, disparities {:?}; median error {:.4} (sparse {:.4}), 90 % {:.4} ({:.4})",
            dense.cloud.len(),
            dense.coverage,
            dense.disparities,
            at(&of_dense, 0.5),
            at(&of_sparse, 0.5),
            at(&of_dense, 0.9),
            at(&of_sparse, 0.9)
        );
        // Both depend on the same pose, whose error is most of the median; a disparity of 20 px or more, accurate to a
        // third of a pixel, adds 1.5 %.
        assert!(at(&of_dense, 0.5) < at(&of_sparse, 0.5) + 0.015);
        assert!(at(&of_dense, 0.9) < at(&of_sparse, 0.9) + 0.03);
        // A room is textured all over; a camera half a meter aside sees most of it.
        assert!(dense.cloud.len() > 150_000 && dense.coverage > 0.5);
        // The depth map has the same points: the depth of each pixel is correct too.
        let baseline = views.relative.translation.norm();
        let mut off: Vec<f64> = (0..480 * 640)
            .map(|i| (dense.depth.at(i % 640, i / 640)[0], views.a.depth.at(i % 640, i / 640)[0]))
            .filter(|(z, _)| z.is_finite())
            .map(|(z, truth)| (f64::from(z) * baseline / f64::from(truth) - 1.0).abs())
            .collect();
        off.sort_by(f64::total_cmp);
        assert!(off.len() > 150_000 && at(&off, 0.5) < at(&of_sparse, 0.5) + 0.015);
    }
}

#[test]
fn reduced_images_and_little_memory_give_the_same_scene() {
    let camera = Camera::from_focal(640, 480, 560.0);
    let views = two_view(3, &camera, 0.4, &RenderOptions::draft()).unwrap();
    let sparse = sparse(&views, &camera);
    let run = |options: &DenseOptions| {
        reconstruct_dense(views.a.image.view(), views.b.image.view(), &sparse, options, &Silent)
    };
    let whole = run(&DenseOptions::default()).unwrap();
    let small = run(&DenseOptions { max_size: 320, ..DenseOptions::default() }).unwrap();
    assert_eq!(small.depth.size(), (320, 240));
    // A quarter of the pixels, up to those at depth discontinuities.
    let share = small.cloud.len() as f64 / whole.cloud.len() as f64;
    assert!((0.18..0.32).contains(&share), "{share}");
    let median = |cloud: &cv_core::PointCloud| {
        let mut z: Vec<f32> = cloud.positions.iter().map(|p| p[2]).collect();
        cv_core::median(&mut z).unwrap()
    };
    // A tenth: the median of a room with several depths depends on the pixels lost at depth discontinuities.
    assert!((median(&small.cloud) / median(&whole.cloud) - 1.0).abs() < 0.1);
    // In strips, at most one pixel in a thousand differs (see `StereoOptions::max_memory`); speckles are then separated
    // differently.
    let strips = run(&DenseOptions { max_memory: 96 << 20, ..DenseOptions::default() }).unwrap();
    assert!((strips.cloud.len() as f64 / whole.cloud.len() as f64 - 1.0).abs() < 0.01);
    assert!(matches!(
        run(&DenseOptions { max_memory: 1 << 20, ..DenseOptions::default() }),
        Err(DenseError::Stereo(_))
    ));
    let filled = run(&DenseOptions { fill: true, ..DenseOptions::default() }).unwrap();
    assert!(filled.cloud.len() > whole.cloud.len());
    assert!(matches!(run(&DenseOptions { max_size: 8, ..DenseOptions::default() }), Err(DenseError::Option(_))));
    let other = views.a.image.view();
    let cropped = other.crop(0, 0, 600, 400).unwrap();
    let wrong = reconstruct_dense(cropped, other, &sparse, &DenseOptions::default(), &Silent);
    assert!(matches!(wrong, Err(DenseError::Rectify(RectifyError::ImageSize { image: (600, 400), .. }))));
}

#[test]
fn a_forward_motion_is_an_error_with_its_angle() {
    let camera = Camera::from_focal(640, 480, 560.0);
    let scene = Scene::room(3);
    let first = scene.viewpoint();
    // 60 cm straight ahead: the epipole is at the center of both images.
    let second = Pose::new(first.rotation, first.translation - Vector3::new(0.03, 0.0, 0.6));
    let photos = [first, second].map(|pose| render(&scene, &camera, &pose, &RenderOptions::draft()).unwrap().image);
    let options = ReconstructOptions::new(Intrinsics::Known([camera; 2]));
    let (a, b) = (photos[0].view(), photos[1].view());
    let sparse = reconstruct(a, b, &options, &Silent).unwrap();
    match reconstruct_dense(a, b, &sparse, &DenseOptions::default(), &Silent) {
        Err(error @ DenseError::Rectify(RectifyError::TooFarTurned { degrees, .. })) => {
            assert!(degrees > 80.0 && error.advice() == Advice::StepAsideNotAhead, "{error}");
        }
        other => panic!("{:?}", other.map(|d| d.cloud.len())),
    }
}
