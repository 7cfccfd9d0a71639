//! Wrong matches that happen to fit a model are told from right ones, of which there may be few.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

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

/// `wrong` random matches, then `right` ones of a camera that moves by a tenth of the distance and turns by a few degrees, 0.5 px off either way.
fn matches(model: Model, seed: u64, wrong: usize, right: usize) -> Vec<Correspondence> {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    let mut random = |low: f64, high: f64| low + (high - low) * f64::from(rng.next_u32()) / 4294967296.0;
    let turn = Vector3::from_fn(|_, _| random(-0.1, 0.1));
    let pose = Pose::new(Rotation3::new(turn), Vector3::from_fn(|_, _| random(-0.8, 0.8)));
    let mut matches = Vec::new();
    while matches.len() < wrong + right {
        let a = Point2::new(random(0.0, WIDTH), random(0.0, HEIGHT));
        if matches.len() < wrong {
            matches.push(Correspondence { a, b: Point2::new(random(0.0, WIDTH), random(0.0, HEIGHT)) });
            continue;
        }
        let ray = camera().normalize(a).to_homogeneous();
        let depth = if model == Model::Homography { 8.0 + 2.0 * ray.x } else { random(4.0, 12.0) };
        let seen = camera().project(&pose.transform(&Point3::from(ray * depth)));
        let inside = |b: &Point2<f64>| b.x > 0.0 && b.y > 0.0 && b.x < WIDTH && b.y < HEIGHT;
        if let Some(b) = seen.filter(inside) {
            matches.push(Correspondence::new(a.x, a.y, b.x + random(-0.5, 0.5), b.y + random(-0.5, 0.5)));
        }
    }
    matches
}

/// Inliers and log₁₀ of the number of false alarms.
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
fn wrong_matches_alone_have_no_model() {
    for model in [Model::Homography, Model::Fundamental, Model::Essential] {
        let (mut refused, mut all) = (0, 0);
        for n in [15, 40, 120, 300] {
            for seed in 0..15 {
                all += 1;
                match estimate(model, &matches(model, seed, n, 0), seed) {
                    Err(EstimateError::NoConsensus { inliers, matches, needed, .. }) => {
                        assert!(inliers < needed && matches == n);
                        refused += 1;
                    }
                    Err(error) => panic!("{model:?} {n}: {error}"),
                    // Of sets of wrong matches, a share of ε has a model with fewer than ε false alarms: none of 60 has one of a millionth.
                    Ok((_, log_nfa)) => assert!(log_nfa > -6.0, "{model:?} {n}: {log_nfa}"),
                }
            }
        }
        // The number of false alarms is to be below one; that of the sets that have any is below a tenth of it or so, for few models of many have an alarm to
        // themselves. A hundredth is the bar.
        assert!(100 * refused >= 99 * all, "{model:?}: {refused} of {all}");
    }
}

#[test]
fn few_right_matches_among_many_wrong_ones_are_no_chance() {
    for (model, wrong, right) in [
        // A share of nine tenths (homographies, poses), and of eight: seven right ones of ten wrong in a row are one sample in ten million.
        (Model::Homography, 270, 30),
        (Model::Essential, 270, 30),
        (Model::Fundamental, 240, 60),
    ] {
        let (mut lost, mut found) = (0, 0);
        for seed in 0..10 {
            let m = matches(model, seed, wrong, right);
            match estimate(model, &m, seed) {
                Err(EstimateError::NoConsensus { .. }) => lost += 1,
                Err(error) => panic!("{model:?}: {error}"),
                Ok((inliers, _)) => {
                    found += usize::from(2 * inliers.iter().filter(|i| **i >= wrong).count() > right);
                }
            }
        }
        // At nine tenths, ten thousand samples of four hold one that is right with 63 %, twenty thousand of five with 18 % (and more through the search near the
        // best ones); what is found is told from chance.
        assert!(found + lost == 10 && found >= 3, "{model:?}: {found} found, {lost} lost");
    }
}
