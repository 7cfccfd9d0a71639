//! A-contrario validation: random matches have no significant model, and few inliers among many outliers do.

use cv_core::{Camera, Correspondence, Point2, Point3, Pose, Rotation3, Silent, Vector3};
use cv_geometry::{
    EstimateError, RobustOptions, estimate_fundamental, estimate_homography, estimate_relative_pose, normalize_matches,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

const WIDTH: f64 = 1200.0;
const HEIGHT: f64 = 900.0;

#[derive(Debug, Clone, Copy, PartialEq)]
enum Model {
    Homography,
    Fundamental,
    Essential,
}

fn camera() -> Camera {
    Camera::from_focal(WIDTH as usize, HEIGHT as usize, 1000.0)
}

/// `outliers` random matches, then `inliers` of a camera with a baseline of a tenth of the depth and a rotation of a
/// few degrees, with uniform noise of ±0.5 px.
fn matches(model: Model, seed: u64, outliers: usize, inliers: usize) -> Vec<Correspondence> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut random = |low: f64, high: f64| low + (high - low) * f64::from(rng.next_u32()) / 4294967296.0;
    let rotation = Vector3::from_fn(|_, _| random(-0.1, 0.1));
    let pose = Pose::new(Rotation3::new(rotation), Vector3::from_fn(|_, _| random(-0.8, 0.8)));
    let mut matches = Vec::new();
    while matches.len() < outliers + inliers {
        let a = Point2::new(random(0.0, WIDTH), random(0.0, HEIGHT));
        if matches.len() < outliers {
            matches.push(Correspondence { a, b: Point2::new(random(0.0, WIDTH), random(0.0, HEIGHT)) });
            continue;
        }
        let ray = camera().normalize(a).to_homogeneous();
        let depth = if model == Model::Homography { 8.0 + 2.0 * ray.x } else { random(4.0, 12.0) };
        let projected = camera().project(&pose.transform(&Point3::from(ray * depth)));
        let inside = |b: &Point2<f64>| b.x > 0.0 && b.y > 0.0 && b.x < WIDTH && b.y < HEIGHT;
        if let Some(b) = projected.filter(inside) {
            matches.push(Correspondence::new(a.x, a.y, b.x + random(-0.5, 0.5), b.y + random(-0.5, 0.5)));
        }
    }
    matches
}

/// Returns the inliers and log₁₀ of the number of false alarms.
fn estimate(model: Model, m: &[Correspondence], seed: u64) -> Result<(Vec<usize>, f64), EstimateError> {
    let found = match model {
        Model::Homography => {
            let found = estimate_homography(m, &RobustOptions { seed, ..RobustOptions::homography() }, &Silent)?;
            (found.inliers, found.log_nfa)
        }
        Model::Fundamental => {
            let found = estimate_fundamental(m, &RobustOptions { seed, ..RobustOptions::fundamental() }, &Silent)?;
            (found.inliers, found.log_nfa)
        }
        Model::Essential => {
            let (m, unit) = normalize_matches(m, &camera(), &camera());
            let options = RobustOptions { threshold: unit, seed, ..RobustOptions::essential() };
            let found = estimate_relative_pose(&m, &options, &Silent)?;
            (found.inliers, found.log_nfa)
        }
    };
    Ok((found.0, found.1.unwrap()))
}

#[test]
fn random_matches_have_no_significant_model() {
    for model in [Model::Homography, Model::Fundamental, Model::Essential] {
        let (mut rejected, mut all) = (0, 0);
        for n in [15, 40, 120, 300] {
            for seed in 0..15 {
                all += 1;
                match estimate(model, &matches(model, seed, n, 0), seed) {
                    Err(EstimateError::NoConsensus { inliers, matches, needed, .. }) => {
                        assert!(inliers < needed && matches == n);
                        rejected += 1;
                    }
                    Err(error) => panic!("{model:?} {n}: {error}"),
                    // A fraction of at most ε of random sets has a model with an NFA below ε: none of 60 has one below
                    // 1e-6.
                    Ok((_, log_nfa)) => assert!(log_nfa > -6.0, "{model:?} {n}: {log_nfa}"),
                }
            }
        }
        // The bound of the NFA is 0.01.
        assert!(100 * rejected >= 99 * all, "{model:?}: {rejected} of {all}");
    }
}

#[test]
fn few_inliers_among_many_outliers_are_significant() {
    for (model, outliers, inliers) in [
        // An outlier ratio of 0.9 (homographies, poses), and of 0.8: at 0.9, only one seven-point sample in ten million
        // is outlier-free.
        (Model::Homography, 270, 30),
        (Model::Essential, 270, 30),
        (Model::Fundamental, 240, 60),
    ] {
        let (mut lost, mut found) = (0, 0);
        for seed in 0..10 {
            let m = matches(model, seed, outliers, inliers);
            match estimate(model, &m, seed) {
                Err(EstimateError::NoConsensus { .. }) => lost += 1,
                Err(error) => panic!("{model:?}: {error}"),
                Ok((indices, _)) => {
                    found += usize::from(2 * indices.iter().filter(|i| **i >= outliers).count() > inliers);
                }
            }
        }
        // At 0.9, ten thousand samples of four include an outlier-free one with a probability of 63 %, twenty thousand
        // of five with 18 % (and more with local optimization).
        assert!(found + lost == 10 && found >= 3, "{model:?}: {found} found, {lost} lost");
    }
}
