//! Reconstruction of synthetic views, against the true cameras and points.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, DMatch, Keypoint, Point3, Pose, Silent};
use cv_geometry::align_points;
use cv_sfm::{
    CameraKnowledge, FeatureDistance, Observation, PairMatches, SfmError, SfmInput, SfmOptions, SfmOutcome, SfmView,
    Solver, ViewOutcome, ViewPairModel, ViewPairOptions, focal_deviations, reconstruct_views, verify_view_pair,
};
use cv_synth::{FeatureViews, FeatureViewsOptions};

/// Views, verified pairs and everything else of an input.
struct Dataset {
    cameras: Vec<Camera>,
    knowledge: Vec<CameraKnowledge>,
    keypoints: Vec<Vec<Keypoint>>,
    pairs: Vec<PairMatches>,
    geometry: Vec<ViewPairModel>,
}

impl Dataset {
    /// Verifies all pairs of synthetic views with at least `min_shared` common points.
    fn new(views: &FeatureViews, knowledge: CameraKnowledge, camera: Camera, min_shared: usize) -> Self {
        let keypoint = |p: &cv_core::Point2<f64>| Keypoint::new(p.x as f32, p.y as f32, 1.0);
        let keypoints = views.keypoints.iter().map(|view| view.iter().map(keypoint).collect()).collect();
        let mut dataset = Self {
            cameras: vec![camera],
            knowledge: vec![knowledge],
            keypoints,
            pairs: Vec::new(),
            geometry: Vec::new(),
        };
        for (a, b, _) in views.pairs(min_shared) {
            dataset.verify(a, b, &views.matches(a, b));
        }
        dataset
    }

    /// Projects points into each view and verifies all pairs. Keypoints have 0.3 px of noise; `start` is what the
    /// reconstruction knows of the camera.
    fn of_points(points: &[Point3<f64>], poses: &[Pose], camera: &Camera, start: (CameraKnowledge, Camera)) -> Self {
        let mut keypoints = vec![Vec::new(); poses.len()];
        let mut of_point = vec![Vec::new(); poses.len()];
        let size = (camera.width as f64, camera.height as f64);
        for (n, point) in points.iter().enumerate() {
            for (i, view) in keypoints.iter_mut().enumerate() {
                let pixel = camera.project(&poses[i].transform(point));
                let inside = pixel.filter(|q| (0.0..size.0).contains(&q.x) && (0.0..size.1).contains(&q.y));
                of_point[i].push(inside.map(|q| {
                    // An arbitrary direction for each observation.
                    let (sin, cos) = ((n * poses.len() + i) as f64 * 2.4).sin_cos();
                    view.push(Keypoint::new((q.x + 0.42 * cos) as f32, (q.y + 0.42 * sin) as f32, 1.0));
                    view.len() as u32 - 1
                }));
            }
        }
        let mut dataset = Self {
            cameras: vec![start.1],
            knowledge: vec![start.0],
            keypoints,
            pairs: Vec::new(),
            geometry: Vec::new(),
        };
        for (a, b) in (0..poses.len()).flat_map(|a| (a + 1..poses.len()).map(move |b| (a, b))) {
            let both = of_point[a].iter().zip(&of_point[b]).filter_map(|(x, y)| Some(((*x)?, (*y)?)));
            let matches: Vec<DMatch> =
                both.map(|(query, train)| DMatch { query, train, distance: 0.1, ratio: 0.5 }).collect();
            dataset.verify(a, b, &matches);
        }
        dataset
    }

    fn verify(&mut self, a: usize, b: usize, matches: &[DMatch]) {
        let camera = (&self.cameras[0], &self.knowledge[0]);
        let keypoints = [&self.keypoints[a][..], &self.keypoints[b]];
        let options = ViewPairOptions::default();
        if let Ok(found) = verify_view_pair([camera; 2], keypoints, matches, &options, &Silent) {
            let matches = found.inliers.iter().map(|i| matches[*i]).collect();
            self.pairs.push(PairMatches::new(a, b, matches));
            self.geometry.push(found.model);
        }
    }

    fn views(&self) -> Vec<SfmView<'_>> {
        self.keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect()
    }

    fn solve(&self) -> Result<SfmOutcome, SfmError> {
        self.solve_with(None)
    }

    fn solve_with(&self, feature_distance: Option<&dyn FeatureDistance>) -> Result<SfmOutcome, SfmError> {
        self.solve_with_solver(Solver::Auto, feature_distance)
    }

    fn solve_with_solver(
        &self,
        solver: Solver,
        feature_distance: Option<&dyn FeatureDistance>,
    ) -> Result<SfmOutcome, SfmError> {
        let views = self.views();
        let input = SfmInput {
            views: &views,
            cameras: &self.cameras,
            knowledge: &self.knowledge,
            pairs: &self.pairs,
            geometry: &self.geometry,
            feature_distance,
        };
        reconstruct_views(&input, &SfmOptions { solver, ..SfmOptions::default() }, &Silent)
    }
}

/// Returns the largest error of a center, as a ratio of the extent of the true centers, and the largest angle of a
/// rotation error in degrees, after a similarity alignment.
fn errors(found: &[Option<Pose>], truth: &[Pose]) -> (f64, f64) {
    let pairs: Vec<(Pose, Pose)> = found.iter().zip(truth).filter_map(|(f, t)| Some(((*f)?, *t))).collect();
    let centers =
        |of: fn(&(Pose, Pose)) -> Pose| -> Vec<Point3<f64>> { pairs.iter().map(|p| of(p).center()).collect() };
    let (from, to) = (centers(|p| p.0), centers(|p| p.1));
    let similarity = align_points(&from, &to, true).unwrap();
    let extent = to.iter().flat_map(|a| to.iter().map(move |b| (a - b).norm())).fold(0.0, f64::max);
    let off = from.iter().zip(&to).map(|(a, b)| (similarity.transform(a) - b).norm()).fold(0.0, f64::max);
    // R_found ≈ R_true · R_similarity.
    let turn = |(f, t): &(Pose, Pose)| {
        let rotation = t.rotation.inverse() * f.rotation * similarity.rotation.inverse();
        Pose::new(rotation, cv_core::Vector3::zeros()).rotation_angle().to_degrees()
    };
    (off / extent, pairs.iter().map(turn).fold(0.0, f64::max))
}

/// Largest error of a center as a ratio of the extent.
const MAX_CENTER_ERROR: f64 = 1e-3;
/// Largest error of a rotation in degrees: the keypoint noise of 0.3 px leaves 0.015 degrees (a fully converged
/// adjustment gives the same), and the maximum over many views is three or four times that.
const MAX_ROTATION_ERROR: f64 = 0.06;

fn walk(views: usize) -> FeatureViews {
    FeatureViews::new(&FeatureViewsOptions { views, points: 200 * views, ..FeatureViewsOptions::default() })
}

/// Returns a camera of the same size with a focal length and a distortion to be estimated.
fn initial_camera(truth: &Camera, focal: f64) -> Camera {
    let distortion = cv_core::Distortion::radial(0.0, 0.0);
    Camera { distortion, ..Camera::from_focal(truth.width, truth.height, focal) }
}

#[test]
fn a_closed_walk_is_reconstructed_accurately() {
    for (views, solver) in [(30, Solver::Global), (30, Solver::Incremental), (60, Solver::Auto)] {
        let truth = walk(views);
        let dataset = Dataset::new(&truth, CameraKnowledge::Known, truth.camera, 30);
        let found = dataset.solve_with_solver(solver, None).unwrap();
        // Calibrated cameras use the global solver.
        assert_eq!(found.solvers, [if solver == Solver::Incremental { solver } else { Solver::Global }]);
        assert!(found.refused.is_empty(), "{:?}", found.refused);
        assert!(found.models.len() == 1 && found.models[0].registered() == views, "{:?}", found.views);
        let (center, degrees) = errors(&found.models[0].poses, &truth.poses);
        assert!(center < MAX_CENTER_ERROR && degrees < MAX_ROTATION_ERROR, "{views}: {center} {degrees}");
        // The noise is 0.3 px in each coordinate, with a mean length of 0.376; the fit absorbs some of it.
        let error = found.models[0].mean_reprojection_error();
        assert!((0.2..0.4).contains(&error), "{error}");
    }
}

#[test]
fn focal_length_and_distortion_are_estimated() {
    let truth = walk(40);
    let start = |focal: f64| initial_camera(&truth.camera, focal);
    let wrong = 1.05 * truth.camera.fx;
    for (knowledge, focal) in [
        (CameraKnowledge::Focal { focal: wrong, deviation: 0.03 }, wrong),
        (CameraKnowledge::Unknown, 1.2 * truth.camera.width as f64),
    ] {
        let dataset = Dataset::new(&truth, knowledge, start(focal), 30);
        for solver in [Solver::Incremental, Solver::Global] {
            let found = dataset.solve_with_solver(solver, None).unwrap();
            assert_eq!(found.models[0].registered(), 40, "{:?}", found.views);
            let camera = &found.models[0].cameras[0];
            // The walk turns by 360 degrees, which determines the focal length far better than to a thousandth.
            assert!((camera.fx / truth.camera.fx - 1.0).abs() < 1e-3, "{} of {}", camera.fx, truth.camera.fx);
            assert!(camera.distortion.parameters().iter().all(|k| k.abs() < 0.01), "{:?}", camera.distortion);
        }
    }
}

#[test]
fn the_result_does_not_depend_on_the_number_of_threads() {
    let truth = walk(30);
    let dataset = Dataset::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| dataset.solve().unwrap())
    };
    assert_eq!(run(1), run(3));
}

/// Descriptors match if they are of the same point.
struct TrueDistance<'v>(&'v FeatureViews);

impl FeatureDistance for TrueDistance<'_> {
    fn distance(&self, a: Observation, b: Observation) -> f32 {
        let [one, two] = [a, b].map(|o| self.0.point_indices[o.view as usize][o.keypoint as usize]);
        if one == two { 0.1 } else { 2.0 }
    }
}

#[test]
fn completion_adds_observations_that_matching_missed() {
    let truth = walk(30);
    let mut dataset = Dataset::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    // One match in four of each pair.
    dataset.pairs.iter_mut().for_each(|p| p.matches = p.matches.iter().step_by(4).copied().collect());
    let (plain, completed) = (dataset.solve().unwrap(), dataset.solve_with(Some(&TrueDistance(&truth))).unwrap());
    let (before, after) = (plain.models[0].mean_track_length(), completed.models[0].mean_track_length());
    assert!(after > 1.05 * before, "{before} {after}");
    let point = |o: &Observation| truth.point_indices[o.view as usize][o.keypoint as usize];
    let correct = completed.models[0]
        .points
        .iter()
        .filter(|p| p.observations.iter().all(|o| point(o) == point(&p.observations[0])));
    let fraction = correct.count() as f64 / completed.models[0].points.len() as f64;
    // A tenth of the matches was wrong; a few per cent of them are within the thresholds of the epipolar line and of a
    // point.
    assert!(fraction > 0.97, "{fraction}");
}

#[test]
fn disconnected_scenes_are_separate_models() {
    let (one, two) = (walk(30), walk(30));
    let mut dataset = Dataset::new(&one, CameraKnowledge::Known, one.camera, 30);
    let other = Dataset::new(&two, CameraKnowledge::Known, two.camera, 30);
    dataset.keypoints.extend(other.keypoints);
    dataset.geometry.extend(other.geometry);
    dataset.pairs.extend(other.pairs.into_iter().map(|p| PairMatches { a: p.a + 30, b: p.b + 30, ..p }));
    let found = dataset.solve().unwrap();
    assert_eq!(found.models.iter().map(cv_sfm::SfmModel::registered).collect::<Vec<_>>(), [30, 30]);
    for (v, outcome) in found.views.iter().enumerate() {
        let model = if found.models[0].poses[v].is_some() { 0 } else { 1 };
        assert_eq!(*outcome, ViewOutcome::Registered { model });
    }
    assert!(found.models[0].poses[..30].iter().all(|p| p.is_some() == found.models[0].poses[0].is_some()));
}

#[test]
fn a_rotating_camera_gives_no_model() {
    let truth = walk(12);
    let pose = |i: usize| {
        Pose::new(cv_core::Rotation3::new(cv_core::Vector3::y() * 0.1 * i as f64), cv_core::Vector3::zeros())
    };
    let poses: Vec<Pose> = (0..8).map(pose).collect();
    // Distant points, viewed from one center.
    let direction = |p: &Point3<f64>| Point3::from((p - truth.poses[0].center()).normalize() * 10.0);
    let points: Vec<Point3<f64>> = truth.points.iter().map(direction).collect();
    let camera = truth.camera;
    // With an unknown lens, distortion can imitate parallax.
    let focal = 1.04 * camera.fx;
    let start = |focal: f64| initial_camera(&camera, focal);
    for start in [
        (CameraKnowledge::Known, camera),
        (CameraKnowledge::Focal { focal, deviation: 0.05 }, start(focal)),
        (CameraKnowledge::Unknown, start(1.2 * camera.width as f64)),
    ] {
        let dataset = Dataset::of_points(&points, &poses, &camera, start);
        let found = dataset.solve();
        assert!(matches!(found, Err(SfmError::NoInitialPair { .. })), "{:?}: {found:?}", start.0);
    }
}

#[test]
fn an_unknown_focal_length_is_estimated_around_an_object() {
    // Twelve views of objects on a table, all from the same height at the same distance: two views whose optical axes
    // intersect do not determine the focal length (Sturm, "On focal length calibration from two views", CVPR 2001).
    let mut rng = 1u64;
    let mut uniform = || {
        rng = rng.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (rng >> 11) as f64 / (1u64 << 53) as f64
    };
    let points: Vec<Point3<f64>> = (0..1500)
        .map(|i| {
            let height = if i % 3 == 0 { 0.3 * uniform() } else { 0.0 };
            Point3::new(1.2 * uniform() - 0.6, -height, 1.2 * uniform() - 0.6)
        })
        .collect();
    let eye = |angle: f64| Point3::new(1.5 * angle.sin(), -0.7, -1.5 * angle.cos());
    let pose = |i: usize| {
        let angle = 0.2 * (i as f64 - 5.5);
        Pose::look_at(eye(angle), Point3::new(0.0, -0.12, 0.0), cv_core::Vector3::y()).unwrap()
    };
    let poses: Vec<Pose> = (0..12).map(pose).collect();
    let camera = Camera::from_focal(1000, 750, 780.0);
    let start = initial_camera(&camera, 1200.0);
    let dataset = Dataset::of_points(&points, &poses, &camera, (CameraKnowledge::Unknown, start));
    let found = dataset.solve().unwrap();
    assert_eq!(found.models[0].registered(), 12, "{:?}", found.views);
    let focal = found.models[0].cameras[0].fx;
    let deviation = focal_deviations(&dataset.views(), &dataset.knowledge, &found.models[0]).unwrap()[0].unwrap();
    // The keypoint noise leaves a thousandth of the focal length. (And some pixels of the principal point, or tenths of
    // a degree of a pitch common to all views, which the positions do not show.)
    assert!((focal - camera.fx).abs() < 4.0 * deviation, "{focal} ± {deviation}");
    assert!(deviation < 0.05 * camera.fx && (focal / camera.fx - 1.0).abs() < 5e-3, "{focal} ± {deviation}");
    let (center, _) = errors(&found.models[0].poses, &poses);
    assert!(center < MAX_CENTER_ERROR, "{center}");
}

#[test]
fn a_focal_length_that_translations_do_not_determine_has_a_large_deviation() {
    let truth = walk(12);
    let camera = truth.camera;
    let rotation = truth.poses[0].rotation;
    let pose = |i: usize| {
        let aside = cv_core::Vector3::new(0.4 * i as f64, 0.0, 0.0);
        Pose::new(rotation, truth.poses[0].translation - aside)
    };
    let poses: Vec<Pose> = (0..6).map(pose).collect();
    let wrong = 1.04 * camera.fx;
    let start = initial_camera(&camera, wrong);
    for knowledge in [CameraKnowledge::Unknown, CameraKnowledge::Focal { focal: wrong, deviation: 0.05 }] {
        let dataset = Dataset::of_points(&truth.points, &poses, &camera, (knowledge, start));
        let found = dataset.solve().unwrap();
        assert_eq!(found.models[0].registered(), 6, "{:?}", found.views);
        let deviation = focal_deviations(&dataset.views(), &dataset.knowledge, &found.models[0]).unwrap()[0].unwrap();
        assert!(deviation > 0.1 * found.models[0].cameras[0].fx, "{deviation}");
    }
    let dataset = Dataset::of_points(&truth.points, &poses, &camera, (CameraKnowledge::Known, camera));
    let found = dataset.solve().unwrap();
    assert_eq!(focal_deviations(&dataset.views(), &dataset.knowledge, &found.models[0]), Ok(vec![None]));
}

#[test]
fn missing_items_are_errors() {
    let truth = walk(12);
    let dataset = Dataset::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    let views: Vec<SfmView<'_>> = dataset.keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
    let input = SfmInput {
        views: &views,
        cameras: &dataset.cameras,
        knowledge: &dataset.knowledge,
        pairs: &dataset.pairs,
        geometry: &dataset.geometry,
        feature_distance: None,
    };
    let refuse = |input: &SfmInput<'_>, options: &SfmOptions| reconstruct_views(input, options, &Silent).unwrap_err();
    let usual = SfmOptions::default();
    assert_eq!(refuse(&SfmInput { views: &views[..1], pairs: &[], ..input }, &usual), SfmError::TooFewViews { got: 1 });
    assert!(matches!(refuse(&SfmInput { cameras: &[], ..input }, &usual), SfmError::Missing { of: "camera", .. }));
    assert!(matches!(refuse(&SfmInput { views: &views[..5], ..input }, &usual), SfmError::Missing { of: "view", .. }));
    assert!(matches!(refuse(&SfmInput { geometry: &[], ..input }, &usual), SfmError::Missing { of: "geometry", .. }));
    assert_eq!(refuse(&SfmInput { pairs: &[], ..input }, &usual), SfmError::NoInitialPair { pairs: 0 });
    let bad = SfmOptions { max_error: f64::NAN, ..usual };
    assert!(matches!(refuse(&input, &bad), SfmError::Option(_)));
}

/// A large dataset: two minutes and two gigabytes at most. By hand: `cargo test --release -p cv-sfm --test models --
/// --ignored --nocapture`.
#[test]
#[ignore = "takes a minute"]
fn a_thousand_views() {
    let truth =
        FeatureViews::new(&FeatureViewsOptions { views: 1000, points: 200_000, ..FeatureViewsOptions::default() });
    let dataset = Dataset::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    let start = std::time::Instant::now();
    let found = dataset.solve().unwrap();
    println!("{} observations in {:.1} s", found.models[0].observations(), start.elapsed().as_secs_f64());
    assert_eq!(found.models[0].registered(), 1000);
    let (center, degrees) = errors(&found.models[0].poses, &truth.poses);
    assert!(center < MAX_CENTER_ERROR && degrees < MAX_ROTATION_ERROR, "{center} {degrees}");
}
