//! Synthetic views of a board.

use cv_calib::{TargetCorner, TargetObservations, TargetPoints};
use cv_core::{Camera, Distortion, Pose, Rotation3, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Returns a uniform random number in [0, 1).
pub(crate) fn uniform(rng: &mut ChaCha8Rng) -> f64 {
    f64::from(rng.next_u32()) / 4294967296.0
}

/// Returns a standard normal random number (Box-Muller).
pub(crate) fn gauss(rng: &mut ChaCha8Rng) -> f64 {
    let (u, v) = (1.0 - uniform(rng), uniform(rng));
    (-2.0 * u.ln()).sqrt() * (std::f64::consts::TAU * v).cos()
}

/// A board of 11 × 8 corners on 300 × 210 mm, deflected by 1 mm, and the cameras that observe it.
pub(crate) struct Studio {
    pub(crate) target: TargetPoints,
    pub(crate) shape: [f64; 2],
    pub(crate) cameras: Vec<Camera>,
    pub(crate) rig_poses: Vec<Pose>,
    pub(crate) rng: ChaCha8Rng,
}

impl Studio {
    pub(crate) fn new(seed: u64, distortion: Distortion) -> Self {
        Self {
            target: TargetPoints::grid(11, 8, 30.0).unwrap(),
            shape: [1.0, 0.0],
            cameras: vec![Camera { distortion, ..Camera::pinhole(1280, 960, 900.0, 902.0, 650.0, 470.0) }],
            rig_poses: vec![Pose::identity()],
            rng: ChaCha8Rng::seed_from_u64(seed),
        }
    }

    /// Adds a second camera, 120 mm to the right, with another image size and lens.
    pub(crate) fn rig(seed: u64) -> Self {
        let mut studio = Self::new(seed, Distortion::radial_tangential5([-0.3, 0.1, 1e-3, -5e-4, -0.01]));
        let distortion = Distortion::radial_tangential4([-0.1, 0.02, 0.0, 1e-3]);
        studio.cameras.push(Camera { distortion, ..Camera::pinhole(800, 600, 560.0, 561.0, 395.0, 303.0) });
        let turn = Rotation3::new(Vector3::new(0.01, 0.08, -0.005));
        studio.rig_poses.push(Pose::new(turn, Vector3::new(-120.0, 2.0, 5.0)));
        studio
    }

    /// Returns a random pose: the board's center on a random ray of the first camera, at 300 to 550 mm, tilted by up to
    /// 57°.
    pub(crate) fn pose(&mut self) -> Pose {
        let mut u = || uniform(&mut self.rng);
        let (x, y) = (0.1 + 0.8 * u(), 0.1 + 0.8 * u());
        let (tilt, about, roll) = (1.0 * u().sqrt(), std::f64::consts::TAU * u(), 0.6 * (u() - 0.5));
        let distance = 300.0 + 250.0 * u();
        let camera = &self.cameras[0];
        let pixel = cv_core::Point2::new(x * camera.width as f64, y * camera.height as f64);
        let middle = camera.normalize(pixel).to_homogeneous() * distance;
        let turn = Rotation3::new(Vector3::new(tilt * about.cos(), tilt * about.sin(), 0.0))
            * Rotation3::new(Vector3::new(0.0, 0.0, roll));
        Pose::new(turn, middle - turn * Vector3::new(150.0, 105.0, 0.0))
    }

    /// Projects the board to the cameras: corners within the images, or none where these are fewer than a third.
    pub(crate) fn view(&mut self, pose: &Pose, noise: f64) -> Vec<Vec<TargetCorner>> {
        let mut cameras = Vec::new();
        for (camera, rig_pose) in self.cameras.iter().zip(&self.rig_poses) {
            let pose = rig_pose.compose(pose);
            let mut corners = Vec::new();
            for point in 0..self.target.points().len() {
                let p = pose.transform(&self.target.bent(point, self.shape));
                let ray = cv_core::Point2::new(p.x / p.z, p.y / p.z);
                let Some(mut pixel) = camera.denormalize_in_range(ray).filter(|_| p.z > 0.0) else { continue };
                let within = |x: f64, n: usize| (-0.5..n as f64 - 0.5).contains(&x);
                if within(pixel.x, camera.width) && within(pixel.y, camera.height) {
                    pixel.x += noise * gauss(&mut self.rng);
                    pixel.y += noise * gauss(&mut self.rng);
                    corners.push(TargetCorner { point, pixel });
                }
            }
            cameras.push(if 3 * corners.len() < self.target.points().len() { Vec::new() } else { corners });
        }
        cameras
    }

    /// Returns random views that the first camera observes.
    pub(crate) fn observations(&mut self, views: usize, noise: f64) -> TargetObservations {
        let mut all = Vec::new();
        while all.len() < views {
            let pose = self.pose();
            let view = self.view(&pose, noise);
            if !view[0].is_empty() {
                all.push(view);
            }
        }
        let sizes = self.cameras.iter().map(|c| (c.width, c.height)).collect();
        TargetObservations { target: self.target.clone(), sizes, views: all }
    }
}
