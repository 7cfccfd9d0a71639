//! Two-view reconstruction from synthetic keypoints and matches.

use cv_core::{Camera, Cancelled, DMatch, Distortion, Keypoint, Point3, Pose, Progress, Rotation3, Silent, Vector3};
use cv_geometry::{
    Intrinsics, MatchedViews, TwoViewAdjustment, TwoViewError, TwoViewOptions, TwoViewReconstruction,
    estimate_two_view_geometry, pose_difference, reconstruct_two_views,
};

/// A deterministic random number generator (LCG).
struct Random(u64);

impl Random {
    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Approximately standard normal (Irwin–Hall, twelve uniform variates).
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform(-0.5, 0.5)).sum()
    }
}

/// Points and their keypoints in two views: keypoint `i` of the first view and `n − 1 − i` of the second are of point
/// `i`; further keypoints are outliers.
struct Scene {
    camera: Camera,
    pose: Pose,
    points: Vec<Point3<f64>>,
    keypoints: [Vec<Keypoint>; 2],
    matches: Vec<DMatch>,
}

fn matched(query: usize, train: usize) -> DMatch {
    DMatch { query: query as u32, train: train as u32, distance: 0.0, ratio: 0.5 }
}

impl Scene {
    /// `n` points with a noise of 0.3 px at depths from `near` to `far`, and `outliers` outlier matches.
    fn new(seed: u64, pose: Pose, depths: (f64, f64), n: usize, outliers: usize) -> Self {
        Self::with_lens(0.0, seed, pose, depths, n, outliers)
    }

    /// The same with radial distortion k1.
    fn with_lens(k1: f64, seed: u64, pose: Pose, (near, far): (f64, f64), n: usize, outliers: usize) -> Self {
        let mut camera = Camera::from_focal(640, 480, 560.0);
        camera.distortion = Distortion::radial(k1, 0.0);
        let mut random = Random(seed);
        let (mut points, mut keypoints) = (Vec::new(), [Vec::new(), Vec::new()]);
        while points.len() < n {
            let z = random.uniform(near, far);
            let point = Point3::new(z * random.uniform(-0.55, 0.55), z * random.uniform(-0.4, 0.4), z);
            let projections = [point, pose.transform(&point)].map(|p| camera.project(&p));
            let [Some(a), Some(b)] = projections else { continue };
            if ![a, b].iter().all(|p| p.x > 0.0 && p.y > 0.0 && p.x < 639.0 && p.y < 479.0) {
                continue;
            }
            for (view, p) in keypoints.iter_mut().zip([a, b]) {
                let (x, y) = (p.x + 0.3 * random.normal(), p.y + 0.3 * random.normal());
                view.push(Keypoint::new(x as f32, y as f32, 1.0));
            }
            points.push(point);
        }
        keypoints[1].reverse();
        let mut matches: Vec<DMatch> = (0..n).map(|i| matched(i, n - 1 - i)).collect();
        for i in 0..outliers {
            for view in &mut keypoints {
                view.push(Keypoint::new(random.uniform(0.0, 639.0) as f32, random.uniform(0.0, 479.0) as f32, 1.0));
            }
            // Interleaved with the inliers, so that the order carries no information.
            matches.insert((7 * i) % n, matched(n + i, n + i));
        }
        Self { camera, pose, points, keypoints, matches }
    }

    fn general(seed: u64) -> Self {
        let pose = Pose::new(Rotation3::new(Vector3::new(0.02, -0.12, 0.03)), Vector3::new(-0.9, 0.1, 0.15));
        Self::new(seed, pose, (4.0, 12.0), 200, 60)
    }

    fn views(&self) -> MatchedViews<'_> {
        let [a, b] = &self.keypoints;
        MatchedViews { sizes: [(640, 480); 2], keypoints: [a, b], matches: &self.matches }
    }

    fn known(&self) -> TwoViewOptions {
        TwoViewOptions { intrinsics: Intrinsics::Known([self.camera; 2]), ..TwoViewOptions::default() }
    }

    /// Returns the point of a match; `None` for outliers.
    fn point(&self, m: &DMatch) -> Option<Point3<f64>> {
        let i = m.query as usize;
        (i < self.points.len() && m.train as usize == self.points.len() - 1 - i).then(|| self.points[i])
    }

    /// Counts the points of inlier matches, and those of them whose 95 % ellipsoid contains the truth.
    fn count_correct(&self, found: &TwoViewReconstruction) -> (usize, usize) {
        let scale = self.pose.translation.norm();
        let (mut correct, mut within) = (0, 0);
        for p in &found.points {
            let m = found.matches[p.match_index];
            let Some(truth) = self.point(&m) else { continue };
            correct += 1;
            let error = p.position.coords - truth.coords / scale;
            // χ² of three degrees of freedom.
            within += usize::from(error.dot(&(p.covariance.try_inverse().unwrap() * error)) < 7.815);
        }
        (correct, within)
    }
}

#[test]
fn points_are_reconstructed_with_their_keypoints_and_covariances() {
    for seed in 0..4 {
        let scene = Scene::general(seed);
        let found = reconstruct_two_views(&scene.views(), &scene.known(), &Silent).unwrap();
        let mut truth = scene.pose;
        truth.translation.normalize_mut();
        let [rotation, direction] = pose_difference(&found.pose, &truth).map(f64::to_degrees);
        // Two hundred points with 0.3 px at a focal length of 560 px: 0.03 degrees each, 0.002 for their mean. The
        // rotation that is correlated with the direction is about twenty times less certain, and the worst of four
        // scenes has up to four standard deviations.
        assert!(rotation < 0.2 && direction < 1.0, "{seed}: {rotation} {direction}");
        let (correct, within) = scene.count_correct(&found);
        // An outlier is within two pixels of its epipolar line with a probability of 1/100.
        assert!(correct >= 195 && found.points.len() - correct <= 3, "{seed}: {correct} of {}", found.points.len());
        // 95 % of 200, with a standard deviation of 1.5 %: four of them.
        assert!(within as f64 >= 0.89 * correct as f64, "{seed}: {within} of {correct}");
        for p in &found.points {
            let m = found.matches[p.match_index];
            let observed = m.correspondence(&scene.keypoints[0], &scene.keypoints[1]).unwrap();
            let first = scene.camera.project(&p.position).unwrap() - observed.a;
            let second = scene.camera.project(&found.pose.transform(&p.position)).unwrap() - observed.b;
            let rms = ((first.norm_squared() + second.norm_squared()) / 2.0).sqrt();
            assert!((rms - p.reprojection).abs() < 1e-9 && rms <= 2.0, "{rms} {}", p.reprojection);
        }
        assert!(found.inliers.iter().filter(|&&i| scene.point(&scene.matches[i]).is_none()).count() <= 3);
        assert!(found.matches.iter().all(|m| scene.matches.contains(m)) && found.guided == 0);
    }
}

#[test]
fn an_unknown_focal_length_is_estimated_and_a_wrong_one_is_rejected() {
    let scene = Scene::general(7);
    let unknown = TwoViewOptions::default();
    let found = reconstruct_two_views(&scene.views(), &unknown, &Silent).unwrap();
    let error = found.cameras[0].fx / scene.camera.fx - 1.0;
    // Within three standard deviations.
    assert!(
        found.focal_deviation > 0.0 && error.abs() < 3.0 * found.focal_deviation,
        "{error} {}",
        found.focal_deviation
    );
    let wrong = TwoViewOptions { intrinsics: Intrinsics::Focal([60.0; 2]), ..unknown };
    let error = reconstruct_two_views(&scene.views(), &wrong, &Silent).unwrap_err();
    assert!(matches!(error, TwoViewError::WrongFocal { given: 60.0, .. }), "{error}");
}

#[test]
fn guided_matches_become_points_with_their_keypoints() {
    let scene = Scene::general(3);
    // Every other match, then all matches.
    let few: Vec<DMatch> = scene.matches.iter().step_by(2).copied().collect();
    let views = MatchedViews { matches: &few, ..scene.views() };
    let geometry = estimate_two_view_geometry(&views, &scene.known(), &Silent).unwrap();
    let plain = TwoViewAdjustment::new(&views, geometry.clone(), &scene.known(), &Silent).unwrap();
    let mut guided = plain.clone();
    guided.add_matches(&scene.matches, &Silent).unwrap();
    let (before, after) = (plain.finish().unwrap(), guided.finish().unwrap());
    assert_eq!(before.inliers, after.inliers);
    // All inliers, and the outliers that are depth-consistent with their neighbors by chance.
    assert!((190..230).contains(&after.guided) && before.guided == 0, "{}", after.guided);
    let [(few, _), (all, within)] = [&before, &after].map(|found| scene.count_correct(found));
    // 102 inliers are in the first half.
    assert!(few <= 102 && all >= 190 && within as f64 >= 0.89 * all as f64, "{few} {all} {within}");
    // Fewer guided matches than inliers are ignored.
    let mut same = TwoViewAdjustment::new(&views, geometry, &scene.known(), &Silent).unwrap();
    same.add_matches(&scene.matches[..20], &Silent).unwrap();
    assert_eq!(same.finish().unwrap().points, before.points);
}

#[test]
fn pure_rotations_and_planar_scenes_are_rejected() {
    let rotation = Pose::new(Rotation3::new(Vector3::new(0.02, 0.12, 0.01)), Vector3::zeros());
    let rotated = Scene::new(1, rotation, (4.0, 12.0), 150, 20);
    match reconstruct_two_views(&rotated.views(), &rotated.known(), &Silent) {
        // The angle of (0.02, 0.12, 0.01).
        Err(TwoViewError::PureRotation { fraction, degrees }) => {
            assert!(fraction > 0.95 && (degrees - 7.0).abs() < 0.1)
        }
        other => panic!("{other:?}"),
    }
    let plane = Scene::new(2, Scene::general(0).pose, (8.0, 8.0), 150, 20);
    let error = reconstruct_two_views(&plane.views(), &plane.known(), &Silent).unwrap_err();
    assert!(matches!(error, TwoViewError::Planar { fraction } if fraction > 0.95), "{error}");
    for scene in [&rotated, &plane] {
        let error = reconstruct_two_views(&scene.views(), &TwoViewOptions::default(), &Silent).unwrap_err();
        assert!(matches!(error, TwoViewError::PlanarOrPureRotation { fraction } if fraction > 0.95), "{error}");
    }
}

#[test]
fn distortion_is_not_mistaken_for_parallax() {
    // A rotation by ten degrees, and a plane from two positions.
    let rotation = Pose::new(Rotation3::new(Vector3::new(0.03, 0.17, 0.02)), Vector3::zeros());
    for (seed, k1) in [-0.3, -0.2, -0.1, 0.1].into_iter().enumerate() {
        let rotated = Scene::with_lens(k1, seed as u64, rotation, (4.0, 12.0), 300, 40);
        let planar = Scene::with_lens(k1, seed as u64, Scene::general(0).pose, (8.0, 8.0), 300, 40);
        let reject = |scene: &Scene, intrinsics: Intrinsics| {
            let options = TwoViewOptions { intrinsics, ..TwoViewOptions::default() };
            reconstruct_two_views(&scene.views(), &options, &Silent).map(|found| found.points.len()).unwrap_err()
        };
        let matrix = Camera::from_focal(640, 480, 560.0);
        for intrinsics in [Intrinsics::Focal([560.0; 2]), Intrinsics::Matrix([matrix; 2])] {
            match reject(&rotated, intrinsics) {
                TwoViewError::PureRotation { fraction, degrees } => {
                    // The angle of (0.03, 0.17, 0.02), with a tolerance for a focal length uncertainty of a few per
                    // cent.
                    assert!(fraction > 0.95 && (degrees - 9.96).abs() < 0.5, "{k1}: {fraction} {degrees}");
                }
                other => panic!("{k1}: {other}"),
            }
            let error = reject(&planar, intrinsics);
            assert!(matches!(error, TwoViewError::Planar { fraction } if fraction > 0.95), "{k1}: {error}");
        }
        for scene in [&rotated, &planar] {
            let error = reject(scene, Intrinsics::Unknown);
            assert!(
                matches!(error, TwoViewError::PlanarOrPureRotation { fraction } if fraction > 0.95),
                "{k1}: {error}"
            );
        }
        // A general scene with the same lens is accepted.
        let general = Scene::with_lens(k1, seed as u64, Scene::general(0).pose, (4.0, 12.0), 300, 40);
        let options = TwoViewOptions { intrinsics: Intrinsics::Focal([560.0; 2]), ..TwoViewOptions::default() };
        let found = reconstruct_two_views(&general.views(), &options, &Silent).unwrap();
        let truth = Pose { translation: general.pose.translation.normalize(), ..general.pose };
        let [rotation, direction] = pose_difference(&found.pose, &truth);
        let [rotation_deviation, direction_deviation] = found.pose_deviation;
        assert!(
            rotation < 3.0 * rotation_deviation && direction < 3.0 * direction_deviation,
            "{k1}: {rotation} {rotation_deviation} {direction} {direction_deviation}"
        );
    }
}

#[test]
fn errors_are_consistent_with_the_deviations_for_inaccurate_focal_lengths() {
    // Errors of a few per cent, as of EXIF focal lengths: over many scenes, nine in ten errors lie within three
    // standard deviations.
    let (mut within, mut count) = (0, 0);
    for (seed, focal_scale) in [0.95, 0.97, 1.0, 1.03, 1.05, 0.96, 1.04, 1.02].into_iter().enumerate() {
        let scene = Scene::with_lens(-0.1, seed as u64, Scene::general(0).pose, (4.0, 12.0), 300, 60);
        let intrinsics = Intrinsics::Focal([560.0 * focal_scale; 2]);
        let options = TwoViewOptions { intrinsics, ..TwoViewOptions::default() };
        let found = reconstruct_two_views(&scene.views(), &options, &Silent).unwrap();
        let truth = Pose { translation: scene.pose.translation.normalize(), ..scene.pose };
        let errors = pose_difference(&found.pose, &truth);
        let focal = (found.cameras[0].fx / 560.0).ln().abs();
        for (error, said) in errors.into_iter().zip(found.pose_deviation).chain([(focal, found.focal_deviation)]) {
            within += usize::from(error <= 3.0 * said);
            count += 1;
        }
        assert!(found.pose_deviation[1] > found.pose_deviation_given_lens[1], "{seed}");
    }
    assert!(10 * within >= 9 * count, "{within} of {count}");
}

#[test]
fn a_suggested_focal_length_is_accepted() {
    for seed in 0..4 {
        let scene = Scene::general(seed);
        let reject = |focal: f64| {
            let intrinsics = Intrinsics::Focal([focal; 2]);
            let options = TwoViewOptions { intrinsics, ..TwoViewOptions::default() };
            reconstruct_two_views(&scene.views(), &options, &Silent).map(|found| found.cameras[0].fx)
        };
        for wrong in [50.0, 200.0, 3000.0] {
            match reject(wrong) {
                Err(TwoViewError::WrongFocal { given, better, .. }) => {
                    assert_eq!(given, wrong);
                    let then = reject(better).unwrap();
                    assert!((then / better).ln().abs() < 0.2, "{seed}: {better} {then}");
                }
                // A focal length that is too long may be indistinguishable from the true one.
                Ok(_) => assert!(wrong > 560.0, "{seed}: {wrong}"),
                Err(other) => panic!("{seed} {wrong}: {other}"),
            }
        }
    }
}

#[test]
fn invalid_input_is_a_typed_error() {
    let scene = Scene::general(5);
    let (views, known) = (scene.views(), scene.known());
    let reject = |views: &MatchedViews<'_>, options: &TwoViewOptions| {
        reconstruct_two_views(views, options, &Silent).map(|found| found.points.len()).unwrap_err()
    };
    let beyond = [matched(3, 4), matched(5, 260)];
    assert_eq!(
        reject(&MatchedViews { matches: &beyond, ..views }, &known),
        TwoViewError::MatchOutOfRange { index: 1, query: 5, train: 260, keypoints: (260, 260) }
    );
    assert_eq!(
        reject(&MatchedViews { matches: &scene.matches[..9], ..views }, &known),
        TwoViewError::TooFewMatches { got: 9, needed: 30 }
    );
    assert!(matches!(
        reject(&MatchedViews { sizes: [(640, 480), (480, 640)], ..views }, &known),
        TwoViewError::CameraSize { index: 2, camera: (640, 480), photo: (480, 640) }
    ));
    let negative = TwoViewOptions { intrinsics: Intrinsics::Focal([500.0, -1.0]), ..known };
    assert!(matches!(reject(&views, &negative), TwoViewError::Camera { index: 2, .. }));
    // Images of size zero, NaN keypoints, and a minimum of zero inliers.
    let nothing = TwoViewOptions { min_inliers: 0, ..TwoViewOptions::default() };
    reject(&MatchedViews { sizes: [(0, 0); 2], ..views }, &TwoViewOptions::default());
    let nan = vec![Keypoint::new(f32::NAN, 0.0, 1.0); 260];
    for options in [&known, &nothing] {
        reject(&MatchedViews { keypoints: [&nan, &nan], ..views }, options);
    }
    reject(&MatchedViews { matches: &[], ..views }, &nothing);
    let wrong: Vec<DMatch> = (0..200).map(|i| matched(i, (i + 40) % 200)).collect();
    assert!(matches!(reject(&MatchedViews { matches: &wrong, ..views }, &known), TwoViewError::TooFewInliers { .. }));

    struct Stop;
    impl Progress for Stop {
        fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
            Err(Cancelled)
        }
    }
    assert_eq!(reconstruct_two_views(&views, &known, &Stop), Err(TwoViewError::Cancelled(Cancelled)));
}
