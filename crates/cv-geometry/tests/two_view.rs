//! Two-view geometry from matches by index of keypoints: no pixels.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Cancelled, DMatch, Distortion, Keypoint, Point3, Pose, Progress, Rotation3, Silent, Vector3};
use cv_geometry::{
    Intrinsics, MatchedViews, TwoViewAdjustment, TwoViewError, TwoViewOptions, TwoViewReconstruction,
    estimate_two_view_geometry, pose_difference, reconstruct_two_views,
};

/// Numbers that are always the same for a seed.
struct Random(u64);

impl Random {
    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Normal, standard deviation one: the sum of twelve uniform numbers.
    fn normal(&mut self) -> f64 {
        (0..12).map(|_| self.uniform(-0.5, 0.5)).sum()
    }
}

/// Points, and keypoints of them that two cameras saw: keypoint `i` of the first view and `n − 1 − i` of the second are of point `i`; further keypoints are of nothing.
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
    /// `n` points seen with a noise of 0.3 px at depths from `near` to `far`, and `wrong` wrong matches among the right ones.
    fn new(seed: u64, pose: Pose, depths: (f64, f64), n: usize, wrong: usize) -> Self {
        Self::with_lens(0.0, seed, pose, depths, n, wrong)
    }

    /// The same through a lens with this k1.
    fn with_lens(k1: f64, seed: u64, pose: Pose, (near, far): (f64, f64), n: usize, wrong: usize) -> Self {
        let mut camera = Camera::from_focal(640, 480, 560.0);
        camera.distortion = Distortion::radial(k1, 0.0);
        let mut random = Random(seed);
        let (mut points, mut keypoints) = (Vec::new(), [Vec::new(), Vec::new()]);
        while points.len() < n {
            let z = random.uniform(near, far);
            let point = Point3::new(z * random.uniform(-0.55, 0.55), z * random.uniform(-0.4, 0.4), z);
            let seen = [point, pose.transform(&point)].map(|p| camera.project(&p));
            let [Some(a), Some(b)] = seen else { continue };
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
        for i in 0..wrong {
            for view in &mut keypoints {
                view.push(Keypoint::new(random.uniform(0.0, 639.0) as f32, random.uniform(0.0, 479.0) as f32, 1.0));
            }
            // Among the right ones, so that places in the list tell nothing.
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

    /// The point that a match is of.
    fn point(&self, m: &DMatch) -> Option<Point3<f64>> {
        let i = m.query as usize;
        (i < self.points.len() && m.train as usize == self.points.len() - 1 - i).then(|| self.points[i])
    }

    /// Points that are of a right match, and those of them within the ellipsoid of 95 % around the truth.
    fn right(&self, found: &TwoViewReconstruction) -> (usize, usize) {
        let scale = self.pose.translation.norm();
        let (mut right, mut within) = (0, 0);
        for p in &found.points {
            let m = found.matches[p.match_index];
            let Some(truth) = self.point(&m) else { continue };
            right += 1;
            let off = p.position.coords - truth.coords / scale;
            // χ² of three degrees of freedom.
            within += usize::from(off.dot(&(p.covariance.try_inverse().unwrap() * off)) < 7.815);
        }
        (right, within)
    }
}

#[test]
fn points_come_back_each_with_its_keypoints() {
    for seed in 0..4 {
        let scene = Scene::general(seed);
        let found = reconstruct_two_views(&scene.views(), &scene.known(), &Silent).unwrap();
        let mut truth = scene.pose;
        truth.translation.normalize_mut();
        let [turn, direction] = pose_difference(&found.pose, &truth).map(f64::to_degrees);
        // Two hundred points of 0.3 px at a focal length of 560 px: 0.03 degrees each, 0.002 for their mean; the rotation that a change of direction makes up for
        // is known some twenty times worse, and the worst of four scenes has up to four deviations.
        assert!(turn < 0.2 && direction < 1.0, "{seed}: {turn} {direction}");
        let (right, within) = scene.right(&found);
        // A wrong match lies within two pixels of its epipolar line in one of a hundred cases.
        assert!(right >= 195 && found.points.len() - right <= 3, "{seed}: {right} of {}", found.points.len());
        // Of 200, 95 % with a standard deviation of 1.5 %: four of them.
        assert!(within as f64 >= 0.89 * right as f64, "{seed}: {within} of {right}");
        for p in &found.points {
            let m = found.matches[p.match_index];
            let seen = m.correspondence(&scene.keypoints[0], &scene.keypoints[1]).unwrap();
            let first = scene.camera.project(&p.position).unwrap() - seen.a;
            let second = scene.camera.project(&found.pose.transform(&p.position)).unwrap() - seen.b;
            let rms = ((first.norm_squared() + second.norm_squared()) / 2.0).sqrt();
            assert!((rms - p.reprojection).abs() < 1e-9 && rms <= 2.0, "{rms} {}", p.reprojection);
        }
        assert!(found.inliers.iter().filter(|&&i| scene.point(&scene.matches[i]).is_none()).count() <= 3);
        assert!(found.matches.iter().all(|m| scene.matches.contains(m)) && found.guided == 0);
    }
}

#[test]
fn a_focal_length_is_found_or_asked_for() {
    let scene = Scene::general(7);
    let unknown = TwoViewOptions::default();
    let found = reconstruct_two_views(&scene.views(), &unknown, &Silent).unwrap();
    let off = found.cameras[0].fx / scene.camera.fx - 1.0;
    // As far off as it says: three standard deviations.
    assert!(found.focal_deviation > 0.0 && off.abs() < 3.0 * found.focal_deviation, "{off} {}", found.focal_deviation);
    let wrong = TwoViewOptions { intrinsics: Intrinsics::Focal([60.0; 2]), ..unknown };
    let error = reconstruct_two_views(&scene.views(), &wrong, &Silent).unwrap_err();
    assert!(matches!(error, TwoViewError::WrongFocal { given: 60.0, .. }), "{error}");
}

#[test]
fn matches_added_later_are_points_with_their_own_keypoints() {
    let scene = Scene::general(3);
    // Every other match, then all that there are.
    let few: Vec<DMatch> = scene.matches.iter().step_by(2).copied().collect();
    let views = MatchedViews { matches: &few, ..scene.views() };
    let geometry = estimate_two_view_geometry(&views, &scene.known(), &Silent).unwrap();
    let plain = TwoViewAdjustment::new(&views, geometry.clone(), &scene.known(), &Silent).unwrap();
    let mut guided = plain.clone();
    guided.add_matches(&scene.matches, &Silent).unwrap();
    let (before, after) = (plain.finish().unwrap(), guided.finish().unwrap());
    assert_eq!(before.inliers, after.inliers);
    // All right ones, and those of the wrong that lie at the depth of their neighbors by chance.
    assert!((190..230).contains(&after.guided) && before.guided == 0, "{}", after.guided);
    let [(few, _), (all, within)] = [&before, &after].map(|found| scene.right(found));
    // Of every other match, 102 are right.
    assert!(few <= 102 && all >= 190 && within as f64 >= 0.89 * all as f64, "{few} {all} {within}");
    // Fewer than there were are not what was looked for: nothing changes.
    let mut same = TwoViewAdjustment::new(&views, geometry, &scene.known(), &Silent).unwrap();
    same.add_matches(&scene.matches[..20], &Silent).unwrap();
    assert_eq!(same.finish().unwrap().points, before.points);
}

#[test]
fn what_is_simpler_than_a_moving_camera_is_named() {
    let turn = Pose::new(Rotation3::new(Vector3::new(0.02, 0.12, 0.01)), Vector3::zeros());
    let turned = Scene::new(1, turn, (4.0, 12.0), 150, 20);
    match reconstruct_two_views(&turned.views(), &turned.known(), &Silent) {
        // The angle of (0.02, 0.12, 0.01).
        Err(TwoViewError::PureRotation { share, degrees }) => assert!(share > 0.95 && (degrees - 7.0).abs() < 0.1),
        other => panic!("{other:?}"),
    }
    let plane = Scene::new(2, Scene::general(0).pose, (8.0, 8.0), 150, 20);
    let error = reconstruct_two_views(&plane.views(), &plane.known(), &Silent).unwrap_err();
    assert!(matches!(error, TwoViewError::Planar { share } if share > 0.95), "{error}");
    for scene in [&turned, &plane] {
        let error = reconstruct_two_views(&scene.views(), &TwoViewOptions::default(), &Silent).unwrap_err();
        assert!(matches!(error, TwoViewError::PlanarOrTurned { share } if share > 0.95), "{error}");
    }
}

#[test]
fn distortion_is_no_parallax() {
    // Ten degrees, and a poster seen from two places.
    let turn = Pose::new(Rotation3::new(Vector3::new(0.03, 0.17, 0.02)), Vector3::zeros());
    for (seed, k1) in [-0.3, -0.2, -0.1, 0.1].into_iter().enumerate() {
        let turned = Scene::with_lens(k1, seed as u64, turn, (4.0, 12.0), 300, 40);
        let poster = Scene::with_lens(k1, seed as u64, Scene::general(0).pose, (8.0, 8.0), 300, 40);
        let refused = |scene: &Scene, intrinsics: Intrinsics| {
            let options = TwoViewOptions { intrinsics, ..TwoViewOptions::default() };
            reconstruct_two_views(&scene.views(), &options, &Silent).map(|found| found.points.len()).unwrap_err()
        };
        let matrix = Camera::from_focal(640, 480, 560.0);
        for intrinsics in [Intrinsics::Focal([560.0; 2]), Intrinsics::Matrix([matrix; 2])] {
            match refused(&turned, intrinsics) {
                TwoViewError::PureRotation { share, degrees } => {
                    // The angle of (0.03, 0.17, 0.02), less what a lens known to a few per cent makes of it.
                    assert!(share > 0.95 && (degrees - 9.96).abs() < 0.5, "{k1}: {share} {degrees}");
                }
                other => panic!("{k1}: {other}"),
            }
            let error = refused(&poster, intrinsics);
            assert!(matches!(error, TwoViewError::Planar { share } if share > 0.95), "{k1}: {error}");
        }
        for scene in [&turned, &poster] {
            let error = refused(scene, Intrinsics::Unknown);
            assert!(matches!(error, TwoViewError::PlanarOrTurned { share } if share > 0.95), "{k1}: {error}");
        }
        // A scene with depth through the same lens is none of these.
        let general = Scene::with_lens(k1, seed as u64, Scene::general(0).pose, (4.0, 12.0), 300, 40);
        let options = TwoViewOptions { intrinsics: Intrinsics::Focal([560.0; 2]), ..TwoViewOptions::default() };
        let found = reconstruct_two_views(&general.views(), &options, &Silent).unwrap();
        let truth = Pose { translation: general.pose.translation.normalize(), ..general.pose };
        let [turn, way] = pose_difference(&found.pose, &truth);
        let [turn_said, way_said] = found.pose_deviation;
        assert!(turn < 3.0 * turn_said && way < 3.0 * way_said, "{k1}: {turn} {turn_said} {way} {way_said}");
    }
}

#[test]
fn errors_are_as_large_as_is_said_where_the_focal_length_is_off() {
    // EXIF's, a few per cent off: over many scenes, nine in ten errors lie within three standard deviations.
    let (mut within, mut count) = (0, 0);
    for (seed, wrong) in [0.95, 0.97, 1.0, 1.03, 1.05, 0.96, 1.04, 1.02].into_iter().enumerate() {
        let scene = Scene::with_lens(-0.1, seed as u64, Scene::general(0).pose, (4.0, 12.0), 300, 60);
        let intrinsics = Intrinsics::Focal([560.0 * wrong; 2]);
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
fn a_focal_length_that_is_advised_holds_when_it_is_given() {
    for seed in 0..4 {
        let scene = Scene::general(seed);
        let refused = |focal: f64| {
            let intrinsics = Intrinsics::Focal([focal; 2]);
            let options = TwoViewOptions { intrinsics, ..TwoViewOptions::default() };
            reconstruct_two_views(&scene.views(), &options, &Silent).map(|found| found.cameras[0].fx)
        };
        for wrong in [50.0, 200.0, 3000.0] {
            match refused(wrong) {
                Err(TwoViewError::WrongFocal { given, better, .. }) => {
                    assert_eq!(given, wrong);
                    let then = refused(better).unwrap();
                    assert!((then / better).ln().abs() < 0.2, "{seed}: {better} {then}");
                }
                // One that is too long may not be told from the right one; what is said to be known of it must then be so.
                Ok(_) => assert!(wrong > 560.0, "{seed}: {wrong}"),
                Err(other) => panic!("{seed} {wrong}: {other}"),
            }
        }
    }
}

#[test]
fn what_cannot_be_is_an_error_with_its_numbers() {
    let scene = Scene::general(5);
    let (views, known) = (scene.views(), scene.known());
    let refused = |views: &MatchedViews<'_>, options: &TwoViewOptions| {
        reconstruct_two_views(views, options, &Silent).map(|found| found.points.len()).unwrap_err()
    };
    let beyond = [matched(3, 4), matched(5, 260)];
    assert_eq!(
        refused(&MatchedViews { matches: &beyond, ..views }, &known),
        TwoViewError::MatchOutOfRange { index: 1, query: 5, train: 260, keypoints: (260, 260) }
    );
    assert_eq!(
        refused(&MatchedViews { matches: &scene.matches[..9], ..views }, &known),
        TwoViewError::TooFewMatches { got: 9, needed: 30 }
    );
    assert!(matches!(
        refused(&MatchedViews { sizes: [(640, 480), (480, 640)], ..views }, &known),
        TwoViewError::CameraSize { index: 2, camera: (640, 480), photo: (480, 640) }
    ));
    let negative = TwoViewOptions { intrinsics: Intrinsics::Focal([500.0, -1.0]), ..known };
    assert!(matches!(refused(&views, &negative), TwoViewError::Camera { index: 2, .. }));
    // Photographs of no size, keypoints that are no numbers, and nothing asked for at all.
    let nothing = TwoViewOptions { min_inliers: 0, ..TwoViewOptions::default() };
    refused(&MatchedViews { sizes: [(0, 0); 2], ..views }, &TwoViewOptions::default());
    let nan = vec![Keypoint::new(f32::NAN, 0.0, 1.0); 260];
    for options in [&known, &nothing] {
        refused(&MatchedViews { keypoints: [&nan, &nan], ..views }, options);
    }
    refused(&MatchedViews { matches: &[], ..views }, &nothing);
    let wrong: Vec<DMatch> = (0..200).map(|i| matched(i, (i + 40) % 200)).collect();
    assert!(matches!(refused(&MatchedViews { matches: &wrong, ..views }, &known), TwoViewError::TooFewInliers { .. }));

    struct Stop;
    impl Progress for Stop {
        fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
            Err(Cancelled)
        }
    }
    assert_eq!(reconstruct_two_views(&views, &known, &Stop), Err(TwoViewError::Cancelled(Cancelled)));
}
