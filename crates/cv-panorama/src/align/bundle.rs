//! Bundle adjustment of all photographs over all overlaps (Brown & Lowe 2007, §4).
//!
//! Photograph `i` has a 3×3 matrix `M_i` (world to camera: a rotation, or a homography of a planar scene) and intrinsics (focal length, one
//! radial distortion coefficient). A match `a ↔ b` of photographs `i` and `j` is transferred from `i` to `j` by `M_j M_i⁻¹` and back; the
//! residuals are the symmetric transfer errors in pixels. Updates are `M ← (I + Σ δ_k G_k) M` with the three generators `G_k` of rotations,
//! or eight of homographies.

use cv_core::Distortion;
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustOptions, AdjustReport, Adjustment, GroupId, Manifold, Prior, Residual, RotationManifold,
};
use nalgebra::{Matrix3, SMatrix, Vector2, Vector3};
use std::ops::ControlFlow;

/// The motion model of a photograph.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Motion {
    /// Rotation about the camera center.
    Rotation,
    /// Planar scene, arbitrary camera motion.
    Homography,
}

/// Homographies up to scale: nine entries in column-major order, eight degrees of freedom (all entries of the update but the last).
struct HomographyManifold;

impl Manifold for HomographyManifold {
    fn ambient(&self) -> usize {
        9
    }

    fn tangent(&self) -> usize {
        8
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        let change = Matrix3::from_fn(|i, j| delta.get(3 * i + j).copied().unwrap_or(0.0));
        let to = (Matrix3::identity() + change) * Matrix3::from_column_slice(x);
        moved.copy_from_slice((to / to.norm()).as_slice());
    }
}

/// Intrinsics as log focal length, k₁ and focal length: the exponential is computed once per step instead of in every residual.
struct LensManifold;

impl LensManifold {
    fn numbers(lens: &Lens) -> [f64; 3] {
        [lens.log_focal, lens.k1, lens.log_focal.exp()]
    }
}

impl Manifold for LensManifold {
    fn ambient(&self) -> usize {
        3
    }

    fn tangent(&self) -> usize {
        2
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        moved.copy_from_slice(&Self::numbers(&Lens { log_focal: x[0] + delta[0], k1: x[1] + delta[1] }));
    }
}

/// Matches of two photographs, in pixels relative to their principal points.
#[derive(Debug, Clone)]
pub(crate) struct Overlap {
    pub(crate) i: usize,
    pub(crate) j: usize,
    pub(crate) points: Vec<(Vector2<f64>, Vector2<f64>)>,
}

/// Intrinsics shared by a group of photographs.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    pub(crate) log_focal: f64,
    /// Coefficient of r² in normalized coordinates.
    pub(crate) k1: f64,
}

impl Lens {
    fn distortion(&self) -> Distortion {
        Distortion::simple_radial(self.k1)
    }

    /// Undistorts a pixel, divided by the focal length, to normalized coordinates; `None` outside the range of the distortion model.
    #[inline]
    fn normalize(&self, q: Vector2<f64>) -> Option<Vector2<f64>> {
        let p = if self.k1 == 0.0 { q } else { self.undistort(q) };
        p.x.is_finite().then_some(p)
    }

    /// Returns the factor `1 + k₁ r²` of normalized coordinates, which distorts them, and the slope `1 + 3 k₁ r²` of the distorted radius.
    #[inline]
    fn radial(&self, r2: f64) -> (f64, f64) {
        (1.0 + self.k1 * r2, 1.0 + 3.0 * self.k1 * r2)
    }

    /// Solves for the radius by Newton's method; as [`Distortion::undistort`], in a fraction of the time.
    #[inline]
    fn undistort(&self, q: Vector2<f64>) -> Vector2<f64> {
        let distorted = q.norm();
        let mut radius = distorted;
        for _ in 0..MAX_NEWTON_STEPS {
            let (factor, slope) = self.radial(radius * radius);
            let error = radius * factor - distorted;
            if slope <= 0.0 {
                break;
            }
            if error.abs() < NEWTON_TOLERANCE * (1.0 + distorted) {
                return if distorted > 0.0 { q * (radius / distorted) } else { q };
            }
            radius -= error / slope;
        }
        // Near the limit of its range, or beyond.
        self.distortion().undistort(q.into()).coords
    }
}

/// All parameters of the adjustment.
#[derive(Debug, Clone)]
pub(crate) struct State {
    /// World to camera, per photograph.
    pub(crate) motion: Vec<Matrix3<f64>>,
    pub(crate) lenses: Vec<Lens>,
}

/// Which parameters are free, and their priors.
#[derive(Debug, Clone)]
pub(crate) struct Problem<'a> {
    pub(crate) kind: Motion,
    pub(crate) overlaps: &'a [Overlap],
    /// Index of the intrinsics of each photograph.
    pub(crate) lens_of: &'a [usize],
    /// The photograph whose rotation is fixed (gauge).
    pub(crate) fixed: usize,
    pub(crate) free_focal: bool,
    pub(crate) free_k1: bool,
    /// Prior of each log focal length: mean and standard deviation.
    pub(crate) focal_prior: &'a [(f64, f64)],
    pub(crate) loss: RobustLoss,
}

/// When an adjustment ends: a wrong model converges slowly, along a valley of focal length and distortion.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    max_iterations: usize,
    /// Relative decrease of the cost.
    cost_tolerance: f64,
}

impl Limits {
    /// For a start, of which only the basin of attraction matters.
    pub(crate) const START: Self = Self { max_iterations: 30, cost_tolerance: 1e-3 };
    /// For model selection, where a model must reduce the cost by percents.
    pub(crate) const SELECTION: Self = Self { max_iterations: 50, cost_tolerance: 1e-4 };
    /// For the result.
    pub(crate) const RESULT: Self = Self { max_iterations: 50, cost_tolerance: 1e-7 };
}

/// Maximum number of Newton steps; ordinary lenses take three to five.
const MAX_NEWTON_STEPS: usize = 10;
/// Residual at which Newton's method stops, relative to the focal length.
const NEWTON_TOLERANCE: f64 = 1e-13;
/// Prior standard deviation of k1: ordinary lenses reach ±0.2, phone cameras with built-in correction ±0.03.
const K1_SIGMA: f64 = 0.1;
/// Residual, in pixels, of a point behind the camera or outside the range of the distortion model.
const INVALID_RESIDUAL_PX: f64 = 1e4;

/// Transfer errors of matches: parameters are the motions of source and target (`M` degrees of freedom each) and their intrinsics.
struct Transfers<const M: usize, const C: usize> {
    kind: Motion,
    matches: Vec<(Vector2<f64>, Vector2<f64>)>,
}

impl<const M: usize, const C: usize> Residual<2, 4, C> for Transfers<M, C> {
    const DIMS: [usize; 4] = [M, M, 2, 2];

    /// The distortion is radial, so that all derivatives are in closed form: that of the distorted point `n (1 + k₁ r²)` is `(1 + k₁ r²) I + 2 k₁ n nᵀ`, and its inverse applied to `n` itself divides it
    /// by the slope `1 + 3 k₁ r²`.
    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [source, target, from, to]: [&[f64]; 4],
        jacobian: Option<&mut SMatrix<f64, 2, C>>,
    ) -> Option<Vector2<f64>> {
        let (a, b) = self.matches[item];
        let (from_focal, f) = (from[2], to[2]);
        let [from, to] = [from, to].map(|l| Lens { log_focal: l[0], k1: l[1] });
        let relative = Matrix3::from_column_slice(target) * inverse(self.kind, &Matrix3::from_column_slice(source));
        let invalid = Some(Vector2::new(INVALID_RESIDUAL_PX, 0.0));
        let Some(p) = from.normalize(a / from_focal) else { return invalid };
        let x = p.push(1.0);
        let y = relative * x;
        let Some((n, factor)) = project(&y, to) else { return invalid };
        let projected = n * (factor * f);
        let Some(j) = jacobian else { return Some(projected - b) };
        let (scale, bend) = (f / y.z, 2.0 * to.k1);
        let by_y = |dy: Vector3<f64>| {
            let d = Vector2::new(dy.x - n.x * dy.z, dy.y - n.y * dy.z);
            (d * factor + n * (bend * n.dot(&d))) * scale
        };
        for k in 0..M {
            let (by_source, by_target) = match self.kind {
                Motion::Rotation => (y.cross(&relative.column(k)), cross(k, &y)),
                Motion::Homography => {
                    let mut moved = Vector3::zeros();
                    moved[k / 3] = y[k % 3];
                    (relative.column(k / 3) * -x[k % 3], moved)
                }
            };
            j.set_column(k, &by_y(by_source));
            j.set_column(M + k, &by_y(by_target));
        }
        let r2 = p.norm_squared();
        let (stretch, slope) = from.radial(r2);
        if slope <= 0.0 {
            return invalid;
        }
        // Of the ray by its own scale.
        let by_ray = by_y(relative * p.push(0.0)) / -slope;
        j.set_column(2 * M, &(by_ray * stretch));
        j.set_column(2 * M + 1, &(by_ray * r2));
        j.set_column(2 * M + 2, &projected);
        j.set_column(2 * M + 3, &(n * (n.norm_squared() * f)));
        Some(projected - b)
    }
}

/// Returns the cross product of the unit vector along axis `k` and `y`.
#[inline]
fn cross(k: usize, y: &Vector3<f64>) -> Vector3<f64> {
    match k {
        0 => Vector3::new(0.0, -y.z, y.y),
        1 => Vector3::new(y.z, 0.0, -y.x),
        _ => Vector3::new(-y.y, y.x, 0.0),
    }
}

/// Projects a ray to normalized coordinates and the factor that distorts them; `None` behind the camera and outside the monotonic range of the distortion.
#[inline]
fn project(y: &Vector3<f64>, lens: Lens) -> Option<(Vector2<f64>, f64)> {
    if y.z <= 1e-6 * y.norm() {
        return None;
    }
    let n = y.xy() / y.z;
    let (factor, slope) = lens.radial(n.norm_squared());
    (slope > 0.0).then_some((n, factor))
}

fn inverse(kind: Motion, m: &Matrix3<f64>) -> Matrix3<f64> {
    match kind {
        Motion::Rotation => m.transpose(),
        Motion::Homography => m.try_inverse().unwrap_or_else(|| Matrix3::from_element(f64::NAN)),
    }
}

impl Problem<'_> {
    /// Transfers a pixel of photograph `i` to photograph `j`, both relative to the principal points.
    pub(crate) fn transfer(&self, s: &State, i: usize, j: usize, a: Vector2<f64>) -> Option<Vector2<f64>> {
        let (from, to) = (s.lenses[self.lens_of[i]], s.lenses[self.lens_of[j]]);
        let ray = from.normalize(a / from.log_focal.exp())?.push(1.0);
        let (n, factor) = project(&(s.motion[j] * inverse(self.kind, &s.motion[i]) * ray), to)?;
        Some(n * (factor * to.log_focal.exp()))
    }

    /// Minimizes the transfer errors from `start`; returns the state and its cost. A start that is not finite is returned with infinite cost.
    pub(crate) fn solve(&self, start: State, limits: Limits) -> (State, f64) {
        let mut state = start.clone();
        match self.adjust(&mut state, limits) {
            Ok(report) => (state, report.cost),
            Err(_) => (start, f64::INFINITY),
        }
    }

    fn adjust(&self, state: &mut State, limits: Limits) -> Result<AdjustReport, AdjustError> {
        let mut problem = Adjustment::default();
        let numbers = state.motion.iter().flat_map(|m| m.iter().copied()).collect();
        let lenses = state.lenses.iter().flat_map(LensManifold::numbers).collect();
        let lenses = problem.add_group("lenses", LensManifold, lenses)?;
        let motions = match self.kind {
            Motion::Rotation => {
                let motions = problem.add_group("rotations", RotationManifold, numbers)?;
                self.add_matches::<3, 10>(&mut problem, motions, lenses)?;
                motions
            }
            Motion::Homography => {
                let motions = problem.add_group("homographies", HomographyManifold, numbers)?;
                self.add_matches::<8, 20>(&mut problem, motions, lenses)?;
                motions
            }
        };
        problem.fix(motions, self.fixed)?;
        for lens in 0..state.lenses.len() {
            let fixed: Vec<usize> = [(0, self.free_focal), (1, self.free_k1)]
                .into_iter()
                .filter(|(_, free)| !free)
                .map(|(k, _)| k)
                .collect();
            problem.fix_parameters(lenses, lens, &fixed)?;
        }
        let weight = |free: bool, sigma: f64| if free { 1.0 / sigma } else { 0.0 };
        let prior_item = |&(mean, sigma): &(f64, f64)| {
            ([mean, 0.0], [weight(self.free_focal, sigma), weight(self.free_k1, K1_SIGMA)])
        };
        let prior = Prior { items: self.focal_prior.iter().map(prior_item).collect() };
        let blocks = (0..self.focal_prior.len() as u32).map(|l| [l]).collect();
        problem.add_residuals("lens priors", prior, [lenses], blocks, RobustLoss::Trivial)?;
        let Limits { max_iterations, cost_tolerance } = limits;
        let options = AdjustOptions { max_iterations, cost_tolerance, ..AdjustOptions::default() };
        let report = problem.solve(&options, |_| ControlFlow::Continue(()))?;
        for (motion, x) in state.motion.iter_mut().zip(problem.values(motions).chunks_exact(9)) {
            motion.copy_from_slice(x);
        }
        for (lens, x) in state.lenses.iter_mut().zip(problem.values(lenses).chunks_exact(3)) {
            (lens.log_focal, lens.k1) = (x[0], x[1]);
        }
        Ok(report)
    }

    /// Adds the residuals of every match in both directions.
    fn add_matches<const M: usize, const C: usize>(
        &self,
        problem: &mut Adjustment<'_>,
        motions: GroupId,
        lenses: GroupId,
    ) -> Result<(), AdjustError> {
        let (mut matches, mut blocks) = (Vec::new(), Vec::new());
        for o in self.overlaps {
            let [i, j, from, to] = [o.i, o.j, self.lens_of[o.i], self.lens_of[o.j]].map(|n| n as u32);
            // One direction after the other: consecutive residuals of the same blocks are accumulated together.
            matches.extend(&o.points);
            matches.extend(o.points.iter().map(|&(a, b)| (b, a)));
            blocks.resize(blocks.len() + o.points.len(), [i, j, from, to]);
            blocks.resize(blocks.len() + o.points.len(), [j, i, to, from]);
        }
        let transfers = Transfers::<M, C> { kind: self.kind, matches };
        problem.add_residuals("matches", transfers, [motions, motions, lenses, lenses], blocks, self.loss)
    }

    /// Computes the squared transfer error of every match of an overlap in pixels², the mean of both directions.
    pub(crate) fn squared_errors(&self, s: &State, o: &Overlap) -> Vec<f64> {
        let one = |i, j, a, b: Vector2<f64>| {
            self.transfer(s, i, j, a).map_or(INVALID_RESIDUAL_PX * INVALID_RESIDUAL_PX, |p| (p - b).norm_squared())
        };
        o.points.iter().map(|&(a, b)| 0.5 * (one(o.i, o.j, a, b) + one(o.j, o.i, b, a))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    /// Matches of exact points between rotated cameras of focal length `focal` and distortion `k1`.
    fn overlaps(rotations: &[Rotation3<f64>], focal: f64, k1: f64) -> Vec<Overlap> {
        let project = |r: &Rotation3<f64>, ray: Vector3<f64>| -> Option<Vector2<f64>> {
            let c = r * ray;
            let n = Vector2::new(c.x / c.z, c.y / c.z);
            let p = n * (focal * (1.0 + k1 * n.norm_squared()));
            (c.z > 0.0 && n.norm() < 1.0 && p.x.abs() < 500.0 && p.y.abs() < 400.0).then_some(p)
        };
        let mut all = Vec::new();
        for i in 0..rotations.len() {
            for j in i + 1..rotations.len() {
                let mut points = Vec::new();
                for u in -30..=30 {
                    for v in -8..=8 {
                        let ray = Vector3::new(f64::from(u) * 0.06, f64::from(v) * 0.06, 1.0);
                        if let (Some(a), Some(b)) = (project(&rotations[i], ray), project(&rotations[j], ray)) {
                            points.push((a, b));
                        }
                    }
                }
                if points.len() > 10 {
                    all.push(Overlap { i, j, points });
                }
            }
        }
        all
    }

    fn turns() -> Vec<Rotation3<f64>> {
        [(-0.6, 0.02, 0.01), (-0.2, -0.03, 0.02), (0.2, 0.01, -0.03), (0.55, 0.05, 0.0)]
            .iter()
            .map(|&(yaw, pitch, roll)| Rotation3::from_euler_angles(pitch, yaw, roll))
            .collect()
    }

    /// Derivatives of all residuals against central differences.
    fn check<const M: usize, const C: usize>(
        transfers: &Transfers<M, C>,
        manifold: &impl Manifold,
        motions: [Matrix3<f64>; 2],
    ) {
        let lenses = [(6.5, -0.04), (6.6, 0.03)].map(|(log_focal, k1)| LensManifold::numbers(&Lens { log_focal, k1 }));
        let at = |item: usize, c: usize, h: f64| {
            let (mut motions, mut lenses) = (motions, lenses);
            if c < 2 * M {
                let mut delta = [0.0; 8];
                delta[c % M] = h;
                let before = motions[c / M];
                manifold.step(before.as_slice(), &delta[..M], motions[c / M].as_mut_slice());
            } else {
                let mut delta = [0.0; 2];
                delta[(c - 2 * M) % 2] = h;
                let before = lenses[(c - 2 * M) / 2];
                LensManifold.step(&before, &delta, &mut lenses[(c - 2 * M) / 2]);
            }
            let blocks = [motions[0].as_slice(), motions[1].as_slice(), &lenses[0], &lenses[1]];
            transfers.evaluate(item, blocks, None).unwrap()
        };
        for item in 0..transfers.matches.len() {
            let blocks = [motions[0].as_slice(), motions[1].as_slice(), &lenses[0], &lenses[1]];
            let mut jacobian = SMatrix::zeros();
            transfers.evaluate(item, blocks, Some(&mut jacobian)).unwrap();
            for c in 0..C {
                let numeric = (at(item, c, 1e-5) - at(item, c, -1e-5)) / 2e-5;
                let exact = jacobian.column(c);
                // Pixels of some hundreds: 1e-13 of rounding by 1e-5, and h² of truncation by derivatives of some thousands.
                assert!((numeric - exact).norm() < 1e-5 * (1.0 + exact.norm()), "{item} {c}: {numeric} {exact}");
            }
        }
    }

    #[test]
    fn jacobians_are_the_derivatives() {
        let rotations = turns();
        let overlap = overlaps(&rotations, 700.0, 0.0).swap_remove(0);
        let matches: Vec<_> = overlap.points.into_iter().step_by(9).collect();
        assert!(matches.len() > 20);
        let motions = [overlap.i, overlap.j]
            .map(|i| (Rotation3::new(Vector3::new(0.01, -0.02, 0.01)) * rotations[i]).into_inner());
        let transfers = Transfers::<3, 10> { kind: Motion::Rotation, matches: matches.clone() };
        check(&transfers, &RotationManifold, motions);
        let transfers = Transfers::<8, 20> { kind: Motion::Homography, matches };
        check(&transfers, &HomographyManifold, motions);
    }

    #[test]
    fn exact_matches_give_the_exact_rotations_focal_length_and_distortion() {
        let rotations = turns();
        let truth = 700.0_f64;
        let overlaps = overlaps(&rotations, truth, -0.05);
        let start = 620.0_f64.ln();
        let problem = Problem {
            kind: Motion::Rotation,
            overlaps: &overlaps,
            lens_of: &[0; 4],
            fixed: 1,
            free_focal: true,
            free_k1: true,
            focal_prior: &[(start, 0.3)],
            loss: RobustLoss::Cauchy { scale: 5.0 },
        };
        let wobble = Rotation3::new(Vector3::new(0.03, -0.05, 0.02));
        let motion =
            rotations.iter().enumerate().map(|(i, r)| if i == 1 { *r } else { wobble * r }.into_inner()).collect();
        let (state, _) =
            problem.solve(State { motion, lenses: vec![Lens { log_focal: start, k1: 0.0 }] }, Limits::RESULT);
        // The prior on the focal length (one pixel² per 0.3²) pulls against ten thousand matches: some 1e-6 of a radian.
        assert!((state.lenses[0].log_focal.exp() / truth - 1.0).abs() < 1e-5, "{:?}", state);
        assert!((state.lenses[0].k1 + 0.05).abs() < 1e-5);
        for (m, r) in state.motion.iter().zip(&rotations) {
            assert!((m - r.matrix()).norm() < 1e-5, "{m} {r}");
        }
    }

    #[test]
    fn a_tenth_of_false_matches_does_not_move_the_result() {
        let rotations = turns();
        let mut overlaps = overlaps(&rotations, 700.0, 0.0);
        for o in &mut overlaps {
            for (k, p) in o.points.iter_mut().enumerate().filter(|(k, _)| k % 10 == 3) {
                p.1 += Vector2::new(15.0 + (k % 7) as f64, -20.0);
            }
        }
        let problem = Problem {
            kind: Motion::Rotation,
            overlaps: &overlaps,
            lens_of: &[0; 4],
            fixed: 0,
            free_focal: true,
            free_k1: false,
            focal_prior: &[(700.0_f64.ln(), 0.3)],
            loss: RobustLoss::Cauchy { scale: 1.0 },
        };
        let motion = rotations.iter().map(|r| r.into_inner()).collect();
        let (state, _) =
            problem.solve(State { motion, lenses: vec![Lens { log_focal: 690.0_f64.ln(), k1: 0.0 }] }, Limits::RESULT);
        // A match off by 25 px pulls with weight 1/625: a tenth of them, all the same way, by 0.1 · 25/625 = 0.004 px of 700 px.
        assert!((state.lenses[0].log_focal.exp() - 700.0).abs() < 1.0);
        let relative = state.motion[3] * state.motion[0].transpose();
        let truth = rotations[3] * rotations[0].inverse();
        assert!((relative - truth.matrix()).norm() < 1e-3);
    }
}
