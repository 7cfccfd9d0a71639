//! Views of generated scenes, against the cameras and points they were made of.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, DMatch, Keypoint, Point3, Pose, Silent};
use cv_geometry::align_points;
use cv_sfm::{
    CameraKnowledge, FeatureDistance, Observation, PairMatches, SfmError, SfmInput, SfmOptions, SfmOutcome, SfmView,
    Solver, ViewOutcome, ViewPairModel, ViewPairOptions, reconstruct_views, verify_view_pair,
};
use cv_synth::{FeatureViews, FeatureViewsOptions};

/// Views, verified pairs and all that an input refers to.
struct Given {
    cameras: Vec<Camera>,
    knowledge: Vec<CameraKnowledge>,
    keypoints: Vec<Vec<Keypoint>>,
    pairs: Vec<PairMatches>,
    geometry: Vec<ViewPairModel>,
}

impl Given {
    /// All pairs of generated views that share `least` points, verified from their matches.
    fn new(views: &FeatureViews, knowledge: CameraKnowledge, camera: Camera, least: usize) -> Self {
        let keypoint = |p: &cv_core::Point2<f64>| Keypoint::new(p.x as f32, p.y as f32, 1.0);
        let keypoints = views.keypoints.iter().map(|view| view.iter().map(keypoint).collect()).collect();
        let mut given = Self {
            cameras: vec![camera],
            knowledge: vec![knowledge],
            keypoints,
            pairs: Vec::new(),
            geometry: Vec::new(),
        };
        for (a, b, _) in views.pairs(least) {
            given.verify(a, b, &views.matches(a, b));
        }
        given
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

    fn solve_with(&self, alike: Option<&dyn FeatureDistance>) -> Result<SfmOutcome, SfmError> {
        self.solve_by(Solver::Auto, alike)
    }

    fn solve_by(&self, solver: Solver, alike: Option<&dyn FeatureDistance>) -> Result<SfmOutcome, SfmError> {
        let views: Vec<SfmView<'_>> = self.keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
        let input = SfmInput {
            views: &views,
            cameras: &self.cameras,
            knowledge: &self.knowledge,
            pairs: &self.pairs,
            geometry: &self.geometry,
            alike,
        };
        reconstruct_views(&input, &SfmOptions { solver, ..SfmOptions::default() }, &Silent)
    }
}

/// Largest distance of a center from the truth, as a share of the extent of the true centers, and largest angle of a rotation, in degrees, after a similarity.
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

/// Largest error of a center as a share of the extent: what is asked of many views.
const CENTER: f64 = 1e-3;
/// Largest error of a rotation in degrees: keypoints have a noise of 0.3 px, which leaves 0.015 degrees (adjusting on until nothing moves any more gives the same), and the largest of many is three
/// or four times that.
const DEGREES: f64 = 0.06;

fn walk(views: usize) -> FeatureViews {
    FeatureViews::new(&FeatureViewsOptions { views, points: 200 * views, ..FeatureViewsOptions::default() })
}

#[test]
fn a_walk_around_a_street_closes() {
    for (views, solver) in [(30, Solver::Global), (30, Solver::Incremental), (60, Solver::Auto)] {
        let truth = walk(views);
        let given = Given::new(&truth, CameraKnowledge::Known, truth.camera, 30);
        let found = given.solve_by(solver, None).unwrap();
        // Known cameras are placed at once.
        assert_eq!(found.solvers, [if solver == Solver::Incremental { solver } else { Solver::Global }]);
        assert!(found.refused.is_empty(), "{:?}", found.refused);
        assert!(found.models.len() == 1 && found.models[0].registered() == views, "{:?}", found.views);
        let (center, degrees) = errors(&found.models[0].poses, &truth.poses);
        assert!(center < CENTER && degrees < DEGREES, "{views}: {center} {degrees}");
        // The noise is 0.3 px in each coordinate, the mean length of which is 0.376; the fit takes some of it up.
        let error = found.models[0].mean_reprojection_error();
        assert!((0.2..0.4).contains(&error), "{error}");
    }
}

#[test]
fn focal_length_and_distortion_are_found() {
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
        let given = Given::new(&truth, knowledge, start(focal), 30);
        for solver in [Solver::Incremental, Solver::Global] {
            let found = given.solve_by(solver, None).unwrap();
            assert_eq!(found.models[0].registered(), 40, "{:?}", found.views);
            let camera = &found.models[0].cameras[0];
            // The walk turns by 360 degrees, which fixes the focal length far better than a thousandth.
            assert!((camera.fx / truth.camera.fx - 1.0).abs() < 1e-3, "{} of {}", camera.fx, truth.camera.fx);
            assert!(camera.distortion.parameters().iter().all(|k| k.abs() < 0.01), "{:?}", camera.distortion);
        }
    }
}

#[test]
fn the_same_at_any_number_of_threads() {
    let truth = walk(30);
    let given = Given::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    let run = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| given.solve().unwrap())
    };
    assert_eq!(run(1), run(3));
}

/// Features are alike where they show one point.
struct Shown<'v>(&'v FeatureViews);

impl FeatureDistance for Shown<'_> {
    fn distance(&self, a: Observation, b: Observation) -> f32 {
        let [one, two] = [a, b].map(|o| self.0.point_indices[o.view as usize][o.keypoint as usize]);
        if one == two { 0.1 } else { 2.0 }
    }
}

#[test]
fn points_are_found_where_matching_missed_them() {
    let truth = walk(30);
    let mut given = Given::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    // Of every pair one match in four.
    given.pairs.iter_mut().for_each(|p| p.matches = p.matches.iter().step_by(4).copied().collect());
    let (plain, completed) = (given.solve().unwrap(), given.solve_with(Some(&Shown(&truth))).unwrap());
    let (before, after) = (plain.models[0].mean_track_length(), completed.models[0].mean_track_length());
    assert!(after > 1.05 * before, "{before} {after}");
    let point = |o: &Observation| truth.point_indices[o.view as usize][o.keypoint as usize];
    let right = completed.models[0]
        .points
        .iter()
        .filter(|p| p.observations.iter().all(|o| point(o) == point(&p.observations[0])));
    let share = right.count() as f64 / completed.models[0].points.len() as f64;
    // A tenth of the matches was wrong; those within the threshold of their epipolar lines and of a point are a few in a hundred of them.
    assert!(share > 0.97, "{share}");
}

#[test]
fn two_places_are_two_models() {
    let (one, two) = (walk(30), walk(30));
    let mut given = Given::new(&one, CameraKnowledge::Known, one.camera, 30);
    let other = Given::new(&two, CameraKnowledge::Known, two.camera, 30);
    given.keypoints.extend(other.keypoints);
    given.geometry.extend(other.geometry);
    given.pairs.extend(other.pairs.into_iter().map(|p| PairMatches { a: p.a + 30, b: p.b + 30, ..p }));
    let found = given.solve().unwrap();
    assert_eq!(found.models.iter().map(cv_sfm::SfmModel::registered).collect::<Vec<_>>(), [30, 30]);
    for (v, outcome) in found.views.iter().enumerate() {
        let model = if found.models[0].poses[v].is_some() { 0 } else { 1 };
        assert_eq!(*outcome, ViewOutcome::Registered { model });
    }
    assert!(found.models[0].poses[..30].iter().all(|p| p.is_some() == found.models[0].poses[0].is_some()));
}

#[test]
fn a_camera_that_only_turns_gives_no_model() {
    let truth = walk(12);
    let camera = truth.camera;
    // Points far around, seen from one place.
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
    let mut given = Given {
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
        given.verify(a, b, &matches);
    }
    assert!(matches!(given.solve(), Err(SfmError::NoInitialPair { .. })));
}

#[test]
fn what_is_not_there_is_refused() {
    let truth = walk(12);
    let given = Given::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    let views: Vec<SfmView<'_>> = given.keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
    let input = SfmInput {
        views: &views,
        cameras: &given.cameras,
        knowledge: &given.knowledge,
        pairs: &given.pairs,
        geometry: &given.geometry,
        alike: None,
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

/// The largest set that is asked for: two minutes and two gigabytes at most. By hand: `cargo test --release -p cv-sfm --test generated -- --ignored --nocapture`.
#[test]
#[ignore = "takes a minute"]
fn a_thousand_views() {
    let truth =
        FeatureViews::new(&FeatureViewsOptions { views: 1000, points: 200_000, ..FeatureViewsOptions::default() });
    let given = Given::new(&truth, CameraKnowledge::Known, truth.camera, 30);
    let start = std::time::Instant::now();
    let found = given.solve().unwrap();
    println!("{} observations in {:.1} s", found.models[0].observations(), start.elapsed().as_secs_f64());
    assert_eq!(found.models[0].registered(), 1000);
    let (center, degrees) = errors(&found.models[0].poses, &truth.poses);
    assert!(center < CENTER && degrees < DEGREES, "{center} {degrees}");
}
