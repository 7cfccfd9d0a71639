//! Synthetic two-view scenes with known pose, and known homographies, for tests. Also part of `tests/estimators`.

use cv_core::{Camera, Correspondence, Matrix3, Point2, Point3, Pose, Rotation3, Vector3};
use proptest::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::cell::RefCell;

/// Draws a uniform number from 0 to 1.
pub(crate) fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    f64::from(rng.next_u32()) / 4294967296.0
}

/// Draws an approximately standard normal number (Irwin–Hall, twelve uniform variates).
pub(crate) fn gauss(rng: &mut ChaCha8Rng) -> f64 {
    (0..12).map(|_| uniform(rng)).sum::<f64>() - 6.0
}

/// Computes |cos| of the angle between two matrices as vectors.
pub(crate) fn cosine(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    (a.dot(b) / (a.norm() * b.norm())).abs()
}

/// Two cameras of 640 × 480 px, with points at depths from 4 to 12 units.
pub(crate) struct TwoViews {
    pub(crate) camera: Camera,
    /// First camera frame to second.
    pub(crate) pose: Pose,
    rng: RefCell<ChaCha8Rng>,
}

impl TwoViews {
    /// Creates a pair with a baseline of one unit in a random direction and a rotation of up to 20 degrees.
    pub(crate) fn random(seed: u64) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut vector = || Vector3::from_fn(|_, _| gauss(&mut rng)).normalize();
        let (axis, direction) = (vector(), vector());
        let angle = 0.35 * uniform(&mut rng);
        let pose = Pose::new(Rotation3::new(axis * angle), direction);
        Self { camera: Camera::from_focal(640, 480, 500.0), pose, rng: RefCell::new(rng) }
    }

    pub(crate) fn essential(&self) -> Matrix3<f64> {
        self.pose.translation.cross_matrix() * self.pose.rotation.matrix()
    }

    pub(crate) fn fundamental(&self) -> Matrix3<f64> {
        let k = self.camera.inverse_matrix();
        k.transpose() * self.essential() * k
    }

    /// Draws a point visible in both cameras, on the plane `n·x = 1` if one is given, and its exact projections.
    pub(crate) fn point(&self, plane: Option<Vector3<f64>>) -> (Point3<f64>, Correspondence) {
        let rng = &mut *self.rng.borrow_mut();
        loop {
            let pixel = Point2::new(640.0 * uniform(rng) - 0.5, 480.0 * uniform(rng) - 0.5);
            let ray = self.camera.normalize(pixel).to_homogeneous();
            let depth = match plane {
                Some(n) => 1.0 / n.dot(&ray),
                None => 4.0 + 8.0 * uniform(rng),
            };
            let point = Point3::from(ray * depth);
            let Some(b) = self.camera.project(&self.pose.transform(&point)) else { continue };
            if depth > 0.0 && (-0.5..639.5).contains(&b.x) && (-0.5..479.5).contains(&b.y) {
                return (point, Correspondence { a: pixel, b });
            }
        }
    }

    /// Adds noise to all four coordinates.
    pub(crate) fn noisy(&self, m: Correspondence, noise: f64) -> Correspondence {
        let rng = &mut *self.rng.borrow_mut();
        let mut n = || noise * gauss(rng);
        Correspondence::new(m.a.x + n(), m.a.y + n(), m.b.x + n(), m.b.y + n())
    }

    /// Draws inlier matches in pixels.
    pub(crate) fn matches(&self, n: usize, noise: f64) -> Vec<Correspondence> {
        (0..n).map(|_| self.noisy(self.point(None).1, noise)).collect()
    }

    /// Draws outlier matches, uniformly in both images.
    pub(crate) fn outliers(&self, n: usize) -> Vec<Correspondence> {
        let rng = &mut *self.rng.borrow_mut();
        let mut u = |size: f64| size * uniform(rng);
        (0..n).map(|_| Correspondence::new(u(640.0), u(480.0), u(640.0), u(480.0))).collect()
    }

    /// Draws inlier matches in normalized coordinates; the noise is also in normalized units.
    pub(crate) fn normalized_matches(&self, n: usize, noise: f64) -> Vec<Correspondence> {
        self.matches(n, noise * 500.0).iter().map(|m| self.normalize(m)).collect()
    }

    pub(crate) fn normalize(&self, m: &Correspondence) -> Correspondence {
        Correspondence { a: self.camera.normalize(m.a), b: self.camera.normalize(m.b) }
    }
}

/// Maps a point by a homography.
pub(crate) fn map(h: &Matrix3<f64>, x: f64, y: f64) -> (f64, f64) {
    let q = h * Point2::new(x, y).to_homogeneous();
    (q.x / q.z, q.y / q.z)
}

/// Homographies of images of 640 × 480: rotation, scale, shear, shift and perspective. H[2][2] = 1.
pub(crate) fn a_homography() -> impl Strategy<Value = Matrix3<f64>> {
    (-3.0..3.0f64, 0.4..2.5f64, -0.3..0.3f64, -200.0..200.0f64, -200.0..200.0f64, -4e-4..4e-4f64, -4e-4..4e-4f64)
        .prop_map(|(turn, scale, shear, tx, ty, px, py)| {
            let (s, c) = turn.sin_cos();
            Matrix3::new(scale * c, scale * (shear * c - s), tx, scale * s, scale * (shear * s + c), ty, px, py, 1.0)
        })
}

/// Draws points of 640 × 480 px and maps them, with noise in both images.
pub(crate) fn homography_matches(h: &Matrix3<f64>, n: usize, noise: f64, rng: &mut ChaCha8Rng) -> Vec<Correspondence> {
    (0..n)
        .map(|_| {
            let (x, y) = (640.0 * uniform(rng), 480.0 * uniform(rng));
            let (u, v) = map(h, x, y);
            Correspondence::new(
                x + noise * gauss(rng),
                y + noise * gauss(rng),
                u + noise * gauss(rng),
                v + noise * gauss(rng),
            )
        })
        .collect()
}
