//! Degenerate generated pairs: each is an error with the cause, its numbers, and advice.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Pose, RgbU8, Rotation3, Vector3};
use cv_pipeline::{Advice, Intrinsics, ReconstructError, ReconstructOptions, Silent, TwoViewError, reconstruct};
use cv_synth::{RenderOptions, Scene, homography_pair, render, two_view};

const FOCAL: f64 = 560.0;

fn camera() -> Camera {
    Camera::from_focal(640, 480, FOCAL)
}

fn refusal(a: &RgbU8, b: &RgbU8, intrinsics: Intrinsics) -> TwoViewError {
    let result = reconstruct(a.view(), b.view(), &ReconstructOptions::new(intrinsics), &Silent);
    match result.map(|r| (r.scene.points.len(), r.scene.cameras[0].fx)).unwrap_err() {
        ReconstructError::TwoView(error) => error,
        other => panic!("{other}"),
    }
}

fn advice(error: TwoViewError) -> Advice {
    ReconstructError::from(error).advice()
}

fn known() -> Intrinsics {
    Intrinsics::Known([camera(); 2])
}

#[test]
fn a_plane_is_distinguished_from_a_rotation_if_the_focal_length_is_known() {
    for seed in [1, 2] {
        let pair = homography_pair(seed, &camera(), 0.3, &RenderOptions::draft()).unwrap();
        let (a, b) = (&pair.a.image, &pair.b.image);
        for intrinsics in [known(), Intrinsics::Focal([FOCAL; 2])] {
            match refusal(a, b, intrinsics) {
                // All matches on a wall lie on one plane.
                error @ TwoViewError::Planar { fraction } => {
                    assert!(fraction > 0.95 && advice(error) == Advice::LeaveThePlane, "{error}");
                }
                other => panic!("{seed}: {other}"),
            }
        }
        match refusal(a, b, Intrinsics::Unknown) {
            error @ TwoViewError::PlanarOrPureRotation { fraction } => {
                assert!(fraction > 0.95 && advice(error) == Advice::StepAsideOrGiveFocal, "{error}");
            }
            other => panic!("{seed}: {other}"),
        }
    }
}

#[test]
fn a_rotation_is_identified_or_ambiguous() {
    let turn = Pose::new(Rotation3::new(Vector3::new(0.02, 0.12, 0.01)), Vector3::zeros());
    for seed in [5, 6] {
        let scene = Scene::room(seed);
        let first = scene.viewpoint();
        let [a, b] = [first, turn.compose(&first)]
            .map(|pose| render(&scene, &camera(), &pose, &RenderOptions::draft()).unwrap().image);
        for intrinsics in [known(), Intrinsics::Focal([FOCAL; 2])] {
            match refusal(&a, &b, intrinsics) {
                error @ TwoViewError::PureRotation { fraction, degrees } => {
                    // The angle of (0.02, 0.12, 0.01) is 7.0 degrees.
                    assert!(fraction > 0.95 && (degrees - 7.0).abs() < 0.2, "{error}");
                    assert_eq!(advice(error), Advice::StepAside);
                }
                other => panic!("{seed}: {other}"),
            }
        }
        match refusal(&a, &b, Intrinsics::Unknown) {
            error @ TwoViewError::PlanarOrPureRotation { .. } => {
                assert_eq!(advice(error), Advice::StepAsideOrGiveFocal)
            }
            other => panic!("{seed}: {other}"),
        }
    }
}

#[test]
fn a_short_baseline_is_an_error() {
    // Two centimeters in front of a room of three to six meters: a parallax of two pixels and less.
    for seed in [3, 4] {
        let views = two_view(seed, &camera(), 0.02, &RenderOptions::draft()).unwrap();
        match refusal(&views.a.image, &views.b.image, known()) {
            error @ TwoViewError::PureRotation { fraction, .. } => {
                assert!(fraction > 0.95 && error.to_string().contains("hardly moved"), "{error}");
            }
            TwoViewError::LittleParallax { degrees, needed } => assert!(degrees < needed && needed > 0.4),
            other => panic!("{seed}: {other}"),
        }
    }
}

#[test]
fn an_implausible_focal_length_is_an_error_with_a_better_one() {
    for seed in [3, 8] {
        let views = two_view(seed, &camera(), 0.4, &RenderOptions::default()).unwrap();
        let (a, b) = (&views.a.image, &views.b.image);
        // In another unit, and of a thumbnail. (One that is too long may be accepted if it cannot be told from the
        // correct one.)
        for wrong in [35.0, 230.0] {
            match refusal(a, b, Intrinsics::Focal([wrong; 2])) {
                error @ TwoViewError::WrongFocal { given, better, deviations, .. } => {
                    assert!(given == wrong && deviations > 4.0, "{error}");
                    // The requirement for an unknown focal length is five per cent after bundle adjustment; this is
                    // before.
                    assert!(
                        (better / FOCAL).ln().abs() < 0.15 && advice(error) == (Advice::FocalBetter { px: better }),
                        "{error}"
                    );
                }
                other => panic!("{seed} {wrong}: {other}"),
            }
        }
        // An inaccurate one is accepted.
        for near in [500.0, 640.0] {
            let options = ReconstructOptions::new(Intrinsics::Focal([near; 2]));
            assert!(reconstruct(a.view(), b.view(), &options, &Silent).unwrap().scene.points.len() > 100);
        }
    }
}

#[test]
fn too_few_matches_are_counted() {
    let views = [3, 4].map(|seed| {
        let scene = Scene::room(seed);
        render(&scene, &camera(), &scene.viewpoint(), &RenderOptions::draft()).unwrap().image
    });
    // Two unrelated rooms.
    for intrinsics in [known(), Intrinsics::Unknown] {
        let error = refusal(&views[0], &views[1], intrinsics);
        match error {
            TwoViewError::TooFewMatches { got, needed } => assert!(got < needed),
            TwoViewError::TooFewInliers { inliers, needed, .. } => assert!(inliers < needed),
            other => panic!("{other}"),
        }
        assert_eq!(advice(error), Advice::ShareMore);
    }
}
