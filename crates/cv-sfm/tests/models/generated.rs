//! Reconstruction of synthetic views, against the true cameras and points.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, DMatch, Keypoint, Point3, Pose, Silent};
use cv_geometry::align_points;
use cv_sfm::{
    CameraKnowledge, FeatureDistance, Observation, PairMatches, SfmError, SfmInput, SfmOptions, SfmOutcome, SfmView,
    Solver, ViewOutcome, ViewPairModel, ViewPairOptions, reconstruct_views, verify_view_pair,
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
        let views: Vec<SfmView<'_>> = self.keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
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
    let start = |focal: f64| Camera {
        distortion: cv_core::Distortion::radial(0.0, 0.0),
        ..Camera::from_focal(truth.camera.width, truth.camera.height, focal)
    };
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
    let camera = truth.camera;
    // Distant points, viewed from one center.
    let pose = |i: usize| {
        Pose::new(cv_core::Rotation3::new(cv_core::Vector3::y() * 0.1 * i as f64), cv_core::Vector3::zeros())
    };
    let mut keypoints: Vec<Vec<Keypoint>> = vec![Vec::new(); 8];
    let mut of_point: Vec<Vec<Option<u32>>> = vec![Vec::new(); 8];
    for p in &truth.points {
        let direction = (p - truth.poses[0].center()).normalize();
        for (i, view) in keypoints.iter_mut().enumerate() {
            let pixel = camera.project(&pose(i).transform(&Point3::from(direction * 10.0)));
            let inside = pixel
                .filter(|q| (0.0..camera.width as f64).contains(&q.x) && (0.0..camera.height as f64).contains(&q.y));
            of_point[i].push(inside.map(|q| {
                view.push(Keypoint::new(q.x as f32, q.y as f32, 1.0));
                view.len() as u32 - 1
            }));
        }
    }
    let mut dataset = Dataset {
        cameras: vec![camera],
        knowledge: vec![CameraKnowledge::Known],
        keypoints,
        pairs: Vec::new(),
        geometry: Vec::new(),
    };
    for (a, b) in (0..8).flat_map(|a| (a + 1..8).map(move |b| (a, b))) {
        let both = of_point[a].iter().zip(&of_point[b]).filter_map(|(x, y)| Some(((*x)?, (*y)?)));
        let matches: Vec<DMatch> =
            both.map(|(query, train)| DMatch { query, train, distance: 0.1, ratio: 0.5 }).collect();
        dataset.verify(a, b, &matches);
    }
    assert!(matches!(dataset.solve(), Err(SfmError::NoInitialPair { .. })));
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
