//! Alignment of models to measurements, against the true frame.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Matrix3, Point3, Pose, Rotation3, Silent, Vector3};
use cv_geometry::Similarity;
use cv_sfm::{KnownPlaces, ModelAlignError, ModelAlignment, SfmModel, SfmPoint, align_model, align_to_poses};
use std::f64::consts::TAU;

/// Returns a pseudo-random number from −1 to 1.
fn noise(of: usize) -> f64 {
    let mut v = (of as u64 + 1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    v = (v ^ (v >> 31)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    ((v ^ (v >> 29)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
}

fn shake(i: usize, by: f64) -> Vector3<f64> {
    Vector3::from_fn(|k, _| by * noise(3 * i + k))
}

/// Upright cameras with centers `eyes` (Z up) that look horizontally along `ahead`, as a model in another frame; and
/// the true poses.
fn model(eyes: &[Point3<f64>], ahead: impl Fn(usize) -> Vector3<f64>) -> (SfmModel, Vec<Pose>) {
    let truth: Vec<Pose> =
        eyes.iter().enumerate().map(|(i, eye)| Pose::look_at(*eye, eye + ahead(i), -Vector3::z()).unwrap()).collect();
    let points: Vec<Point3<f64>> = eyes.iter().enumerate().map(|(i, eye)| eye + 7.0 * ahead(i)).collect();
    let seen = |position| SfmPoint { position, error: 0.0, observations: Vec::new() };
    let mut model = SfmModel {
        cameras: vec![Camera::from_focal(640, 480, 500.0)],
        poses: truth.iter().copied().map(Some).collect(),
        points: points.into_iter().map(seen).collect(),
    };
    let to_model = Similarity {
        scale: 0.13,
        rotation: Rotation3::from_euler_angles(0.4, -1.1, 2.0),
        translation: Vector3::new(1.0, -2.0, 0.3),
    };
    model.transform(&to_model);
    (model, truth)
}

/// Camera centers on a circle of 40 m diameter, at slightly varying heights.
fn circle(n: usize) -> Vec<Point3<f64>> {
    let angle = |i: usize| TAU * i as f64 / n as f64;
    (0..n).map(|i| Point3::new(20.0 * angle(i).cos() + 300.0, 20.0 * angle(i).sin(), 1.6 + 0.3 * noise(i))).collect()
}

fn inward(eyes: &[Point3<f64>]) -> impl Fn(usize) -> Vector3<f64> + '_ {
    |i| (Point3::new(300.0, 0.0, eyes[i].z) - eyes[i]).normalize()
}

fn align(model: &SfmModel, known: &KnownPlaces<'_>) -> Result<(ModelAlignment, SfmModel), ModelAlignError> {
    let found = align_model(model, known, 0, &Silent)?;
    let mut moved = model.clone();
    moved.transform(&found.similarity);
    Ok((found, moved))
}

/// Returns the largest error of a center, and the largest angle of a rotation error in degrees.
fn max_errors(model: &SfmModel, truth: &[Pose]) -> (f64, f64) {
    let pairs = || model.poses.iter().flatten().zip(truth);
    let off = pairs().map(|(p, t)| (p.center() - t.center()).norm()).fold(0.0, f64::max);
    let turn = |(p, t): (&Pose, &Pose)| Pose::new(p.rotation * t.rotation.inverse(), Vector3::zeros()).rotation_angle();
    (off, pairs().map(turn).fold(0.0, f64::max).to_degrees())
}

#[test]
fn noisy_centers_with_outliers() {
    let eyes = circle(24);
    let (model, truth) = model(&eyes, inward(&eyes));
    // Errors within 3 m in each coordinate; five centers are off by tens of meters, two are unknown.
    let mut known: Vec<Option<Point3<f64>>> =
        eyes.iter().enumerate().map(|(i, eye)| Some(eye + shake(i, 3.0))).collect();
    for i in [2, 3, 4, 11, 17] {
        *known[i].as_mut().unwrap() += Vector3::new(60.0, -35.0, 20.0);
    }
    (known[7], known[20]) = (None, None);
    let (found, moved) = align(&model, &KnownPlaces { centers: &known, distances: &[] }).unwrap();
    let fit = found.centers.unwrap();
    assert!(found.metric && fit.tilt && fit.outliers == [2, 3, 4, 11, 17], "{fit:?}");
    assert_eq!(fit.inliers.len(), 17);
    // Uniform within 3 m: a standard deviation of 1.73 m in each of three coordinates, 3.0 m in space, of which the fit
    // absorbs some.
    assert!((2.0..3.1).contains(&fit.rms) && (19.0..22.0).contains(&fit.spread), "{fit:?}");
    // The mean of 17 such errors is 0.7 m; over 20 m the scale is off by 2 % and the rotation by 1.2 degrees. The limit
    // is three standard deviations of all together.
    let (off, degrees) = max_errors(&moved, &truth);
    assert!(off < 4.0 && degrees < 4.0, "{off} {degrees}");
}

#[test]
fn exact_centers_restore_the_frame() {
    let eyes = circle(5);
    let (model, truth) = model(&eyes, inward(&eyes));
    for n in [3, 4, 5] {
        let known: Vec<_> = eyes.iter().take(n).copied().map(Some).collect();
        let (found, moved) = align(&model, &KnownPlaces { centers: &known, distances: &[] }).unwrap();
        assert_eq!(found.centers.unwrap().inliers.len(), n);
        // Rounding of coordinates of some hundreds.
        let (off, degrees) = max_errors(&moved, &truth);
        assert!(off < 1e-6 && degrees < 1e-6, "{n}: {off} {degrees}");
        // The first point is 7 m in front of the first camera.
        let ahead = truth[0].transform(&moved.points[0].position);
        assert!((ahead - Point3::new(0.0, 0.0, 7.0)).norm() < 1e-6, "{ahead}");
    }
}

#[test]
fn collinear_centers_take_the_vertical_from_the_images() {
    // Thirty views 3 m apart, with errors of up to 4 m.
    let eyes: Vec<_> = (0..30).map(|i| Point3::new(3.0 * i as f64, 0.1 * noise(i), 1.6)).collect();
    let ahead = |i: usize| Vector3::new(1.0, 0.5 * noise(i), 0.1 * noise(i + 50)).normalize();
    let (model, truth) = model(&eyes, ahead);
    let known: Vec<_> = eyes.iter().enumerate().map(|(i, eye)| Some(eye + shake(i, 4.0))).collect();
    let (found, moved) = align(&model, &KnownPlaces { centers: &known, distances: &[] }).unwrap();
    let fit = found.centers.unwrap();
    assert!(!fit.tilt && fit.inliers.len() >= 29, "{fit:?}");
    // Exactly collinear centers too.
    let line: Vec<_> = (0..30).map(|i| Some(Point3::new(3.0 * i as f64, 0.0, 1.6))).collect();
    let (exact, _) = align(&model, &KnownPlaces { centers: &line, distances: &[] }).unwrap();
    assert!(!exact.centers.unwrap().tilt && (exact.similarity.scale * 0.13 - 1.0).abs() < 1e-3);
    // Errors within 4 m have a standard deviation of 2.3 m in a coordinate, over a spread of 26 m and thirty views 1
    // degree. The pitch of the views is within 3 degrees; its mean is half a degree.
    let (off, degrees) = max_errors(&moved, &truth);
    assert!(off < 5.0 && degrees < 4.0, "{off} {degrees}");
}

#[test]
fn distances_set_the_scale_and_that_of_centers_is_reported() {
    let eyes = circle(12);
    let (model, truth) = model(&eyes, inward(&eyes));
    let distances = [(0, 6, (eyes[0] - eyes[6]).norm()), (2, 3, (eyes[2] - eyes[3]).norm())];
    let (found, moved) = align(&model, &KnownPlaces { centers: &[], distances: &distances }).unwrap();
    assert!(found.metric && found.centers.is_none() && found.distance_error.unwrap() < 1e-9);
    for (a, b, known) in distances {
        let [a, b] = [a, b].map(|v| moved.poses[v].unwrap().center());
        assert!(((a - b).norm() / known - 1.0).abs() < 1e-9);
    }
    // Upright, with the first view at the origin: the cameras were level, so that the vertical is exact.
    let first = moved.poses[0].unwrap();
    assert!(first.center().coords.norm() < 1e-9);
    for (pose, truth) in moved.poses.iter().flatten().zip(&truth) {
        let up = |p: &Pose| p.rotation * Vector3::z();
        assert!((up(pose) - up(truth)).norm() < 1e-6, "{pose:?}");
    }
    assert!((first.rotation * Vector3::y() - Vector3::z()).norm() < 1e-6, "{first:?}");
    // Known centers with a scale that is 5 % larger: the scale is that of the distances, and the ratio is reported.
    let larger: Vec<_> = eyes.iter().map(|p| Some(Point3::from(1.05 * p.coords))).collect();
    let (both, _) = align(&model, &KnownPlaces { centers: &larger, distances: &distances }).unwrap();
    assert!((both.similarity.scale / found.similarity.scale - 1.0).abs() < 1e-9);
    assert!((both.centers.unwrap().scale_ratio.unwrap() - 1.05).abs() < 1e-6);
    // Two contradictory distances.
    let wrong = [distances[0], (2, 3, 1.1 * distances[1].2)];
    let error = align(&model, &KnownPlaces { centers: &[], distances: &wrong }).unwrap().0.distance_error.unwrap();
    assert!((0.04..0.06).contains(&error), "{error}");
}

#[test]
fn inconsistent_measurements_are_errors() {
    let eyes = circle(12);
    let (model, _) = model(&eyes, inward(&eyes));
    let with = |centers: &[Option<Point3<f64>>]| align(&model, &KnownPlaces { centers, distances: &[] }).unwrap_err();
    // Random centers.
    let other: Vec<_> = (0..12).map(|i| Some(Point3::from(shake(i + 40, 30.0)))).collect();
    assert!(matches!(with(&other), ModelAlignError::Contradiction { of: 12, .. }), "{:?}", with(&other));
    // Coincident centers, as of a GPS receiver without a fix.
    assert_eq!(with(&[Some(eyes[0]); 12]), ModelAlignError::OnePlace);
    assert_eq!(with(&[Some(eyes[0]), None, Some(eyes[1])]), ModelAlignError::TooFew { got: 2, needed: 3 });
    assert_eq!(with(&[Some(Point3::new(f64::NAN, 0.0, 0.0)); 12]), ModelAlignError::NotFinite { index: 0 });
    let by = |distances: &[(usize, usize, f64)]| {
        align_model(&model, &KnownPlaces { centers: &[], distances }, 0, &Silent).unwrap_err()
    };
    assert_eq!(by(&[(0, 40, 1.0)]), ModelAlignError::NotInModel { view: 40 });
    assert_eq!(by(&[(3, 3, 1.0)]), ModelAlignError::NoDistance { a: 3, b: 3 });
    assert_eq!(by(&[(0, 1, 1.0), (0, 1, -1.0)]), ModelAlignError::NotFinite { index: 1 });
}

#[test]
fn a_similarity_changes_no_projection() {
    let eyes = circle(6);
    let (mut model, truth) = model(&eyes, inward(&eyes));
    let before: Vec<_> = model.poses.iter().flatten().map(|p| p.transform(&model.points[0].position)).collect();
    let to = Similarity {
        scale: 3.0,
        rotation: Rotation3::from_matrix_unchecked(Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)),
        translation: truth[0].translation,
    };
    model.transform(&to);
    for (pose, before) in model.poses.iter().flatten().zip(before) {
        let now = pose.transform(&model.points[0].position);
        assert!((now.coords - 3.0 * before.coords).norm() < 1e-9, "{now} {before}");
    }
}

#[test]
fn known_poses_restore_the_frame_of_collinear_centers_too() {
    let eyes: Vec<_> = (0..6).map(|i| Point3::new(2.0 * i as f64, 0.0, 1.6)).collect();
    let (mut model, truth) = model(&eyes, |i| Vector3::new(0.2 * noise(i), 1.0, 0.0));
    let known: Vec<Option<Pose>> = truth.iter().copied().map(Some).collect();
    for n in [2, 6] {
        let mut moved = model.clone();
        moved.transform(&align_to_poses(&model, &known[..n]).unwrap());
        // Rounding of coordinates of ten.
        let (off, degrees) = max_errors(&moved, &truth);
        assert!(off < 1e-9 && degrees < 1e-6, "{n}: {off} {degrees}");
    }
    assert_eq!(align_to_poses(&model, &known[..1]), None);
    model.poses.fill(None);
    assert_eq!(align_to_poses(&model, &known), None);
}
