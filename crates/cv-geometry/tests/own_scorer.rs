//! A custom loss in every robust estimator.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Correspondence, Matrix3, Point2, Point3, Pose, Rotation3, Silent, Vector3};
use cv_geometry::{
    RobustModel, RobustOptions, Scorer, Scoring, WorldMatch, estimate_essential, estimate_fundamental,
    estimate_homography, estimate_pose, normalize_matches, pose_difference,
};

/// MLESAC (Torr & Zisserman 2000): the negative log-likelihood of a mixture of a normal distribution with a standard
/// deviation of half the threshold and a uniform one, scaled to 0 to 1.
#[derive(Debug)]
struct Mlesac;

const OUTLIER_DENSITY: f64 = 0.01;

impl Scorer for Mlesac {
    fn loss(&self, u: f32) -> f32 {
        if u.is_nan() || f64::from(u) >= self.cutoff() {
            return 1.0;
        }
        let at = |u: f64| -((-2.0 * u).exp() + OUTLIER_DENSITY).ln();
        ((at(u.into()) - at(0.0)) / (at(f64::INFINITY) - at(0.0))) as f32
    }

    fn weight(&self, u: f64) -> f64 {
        if u >= self.cutoff() {
            0.0
        } else {
            (-2.0 * u).exp() * (1.0 + OUTLIER_DENSITY) / ((-2.0 * u).exp() + OUTLIER_DENSITY)
        }
    }

    // Where the loss is 1 to six digits.
    fn cutoff(&self) -> f64 {
        9.0
    }
}

fn with_mlesac(options: RobustOptions) -> RobustOptions {
    RobustOptions { scoring: Scoring::Other(&Mlesac), ..options }
}

struct Random(u64);

impl Random {
    fn uniform(&mut self, low: f64, high: f64) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        low + (high - low) * (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Adds noise with a standard deviation of 0.3 px to each coordinate.
    fn noisy(&mut self, p: Point2<f64>) -> Point2<f64> {
        let mut normal = || 0.3 * (0..12).map(|_| self.uniform(-0.5, 0.5)).sum::<f64>();
        Point2::new(p.x + normal(), p.y + normal())
    }
}

/// 150 inliers, with every fourth match one of 50 outliers.
fn matches(seed: u64, truth: impl Fn(&mut Random) -> (Point2<f64>, Point2<f64>)) -> Vec<Correspondence> {
    let mut random = Random(seed);
    (0..200)
        .map(|i| {
            let (a, b) = truth(&mut random);
            let b = if i % 4 == 0 { Point2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0)) } else { b };
            Correspondence { a: random.noisy(a), b: random.noisy(b) }
        })
        .collect()
}

fn camera() -> Camera {
    Camera::from_focal(640, 480, 560.0)
}

fn pose() -> Pose {
    Pose::new(Rotation3::new(Vector3::new(0.02, -0.12, 0.03)), Vector3::new(-0.9, 0.1, 0.15))
}

fn random_point(random: &mut Random) -> Point3<f64> {
    let z = random.uniform(4.0, 12.0);
    Point3::new(z * random.uniform(-0.5, 0.5), z * random.uniform(-0.4, 0.4), z)
}

fn two_views(random: &mut Random) -> (Point2<f64>, Point2<f64>) {
    let p = random_point(random);
    (camera().project(&p).unwrap(), camera().project(&pose().transform(&p)).unwrap())
}

/// Counts the true and the false positives among the inliers.
fn counts<M>(found: &RobustModel<M>) -> (usize, usize) {
    let false_positives = found.inliers.iter().filter(|&&i| i % 4 == 0).count();
    (found.inliers.len() - false_positives, false_positives)
}

#[test]
fn the_loss_has_the_required_properties() {
    assert_eq!((Mlesac.loss(0.0), Mlesac.loss(9.0), Mlesac.loss(f32::NAN), Mlesac.weight(0.0)), (0.0, 1.0, 1.0, 1.0));
    assert!((1..90).all(|i| Mlesac.loss(0.1 * i as f32) > Mlesac.loss(0.1 * (i - 1) as f32)));
    assert_eq!(Scoring::Other(&Mlesac), Scoring::Other(&Mlesac));
    assert_ne!(Scoring::Other(&Mlesac), Scoring::Msac);
}

#[test]
fn every_estimator_accepts_a_custom_loss() {
    let h = Matrix3::new(0.9, -0.1, 40.0, 0.12, 1.05, -15.0, 1e-4, -5e-5, 1.0);
    let plane = |random: &mut Random| {
        let p = Point2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0));
        (p, Point2::from_homogeneous(h * p.to_homogeneous()).unwrap())
    };
    for seed in 0..4 {
        let on_plane = matches(seed, plane);
        let found = estimate_homography(&on_plane, &with_mlesac(RobustOptions::homography()), &Silent).unwrap();
        // The threshold of 3 px is seven standard deviations of the residual; an outlier is within it with a
        // probability of 28 / (640 · 480).
        let (true_positives, false_positives) = counts(&found);
        assert!(true_positives == 150 && false_positives <= 1, "{seed}: {true_positives} {false_positives}");
        let through = Point2::from_homogeneous(found.model * Point2::new(320.0, 240.0).to_homogeneous()).unwrap();
        let truth = Point2::from_homogeneous(h * Point2::new(320.0, 240.0).to_homogeneous()).unwrap();
        // 0.3 px / √150, times six: the center depends on two or three of eight parameters.
        assert!((through - truth).norm() < 0.15, "{seed}: {through}");

        let general = matches(seed, two_views);
        let found = estimate_fundamental(&general, &with_mlesac(RobustOptions::fundamental()), &Silent).unwrap();
        // The threshold of 1 px is three standard deviations: one in three hundred inliers is beyond it. A band of 2 px
        // along an epipolar line is about a hundredth of the image: one of fifty outliers in two runs, and more if the
        // geometry adapts.
        let (true_positives, false_positives) = counts(&found);
        assert!(true_positives >= 143 && false_positives <= 5, "{seed}: {true_positives} {false_positives}");

        let (normalized, unit) = normalize_matches(&general, &camera(), &camera());
        let options = RobustOptions { threshold: unit, ..with_mlesac(RobustOptions::essential()) };
        let found = estimate_essential(&normalized, &options, &Silent).unwrap();
        let (true_positives, false_positives) = counts(&found);
        assert!(true_positives >= 143 && false_positives <= 5, "{seed}: {true_positives} {false_positives}");

        let mut random = Random(seed);
        let observations: Vec<WorldMatch> = (0..200)
            .map(|i| {
                let world = random_point(&mut random);
                let image = camera().project(&pose().transform(&world)).unwrap();
                let image = if i % 4 == 0 {
                    Point2::new(random.uniform(0.0, 640.0), random.uniform(0.0, 480.0))
                } else {
                    image
                };
                WorldMatch { world, image: camera().normalize(random.noisy(image)) }
            })
            .collect();
        let options = RobustOptions { threshold: 2.0 / 560.0, ..with_mlesac(RobustOptions::essential()) };
        let found = estimate_pose(&observations, &options, &Silent).unwrap();
        let (true_positives, false_positives) = counts(&found);
        assert!(true_positives == 150 && false_positives <= 1, "{seed}: {true_positives} {false_positives}");
        let [rotation, _] = pose_difference(&found.model, &pose());
        // 0.3 px at a focal length of 560 px / √150 is 4e-5; the correlation of rotation and translation costs a factor
        // of ten: five standard deviations.
        assert!(rotation < 2e-3, "{seed}: {rotation}");
    }
}
