//! Global refinement of all photographs over all overlaps at once (Brown & Lowe 2007, §4).
//!
//! One problem serves both kinds of set. Photograph `i` sees the world through a 3×3 matrix `M_i` (a rotation, or a homography
//! where the scene is flat) and a lens (focal length, one radial coefficient). A match `a ↔ b` of photographs `i` and `j` is
//! carried from `i` to `j` by `M_j M_i⁻¹` and compared in pixels, and the other way round. `M` moves by
//! `M ← (I + Σ δ_k G_k) M`: the `G_k` are the three generators of rotations, or eight of homographies.

use cv_numeric::{LeastSquares, LmOptions, NormalEquations, RobustLoss, levenberg_marquardt};
use nalgebra::{DVector, Dyn, Matrix2, Matrix3, Rotation3, Vector2, Vector3};
use rayon::prelude::*;

/// What a photograph's matrix may be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Motion {
    /// The camera turned about its center.
    Rotation,
    /// The scene is flat, the camera moved.
    Homography,
}

impl Motion {
    fn generators(self) -> Vec<Matrix3<f64>> {
        match self {
            Self::Rotation => (0..3).map(|k| Vector3::ith(k, 1.0).cross_matrix()).collect(),
            // All entries but the last: the scale of a homography means nothing.
            Self::Homography => (0..8)
                .map(|k| {
                    let mut g = Matrix3::zeros();
                    g[(k / 3, k % 3)] = 1.0;
                    g
                })
                .collect(),
        }
    }
}

/// Matches of two photographs, in pixels from their principal points.
#[derive(Debug, Clone)]
pub(crate) struct Overlap {
    pub(crate) i: usize,
    pub(crate) j: usize,
    pub(crate) points: Vec<(Vector2<f64>, Vector2<f64>)>,
}

/// One lens, shared by the photographs that name it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Lens {
    pub(crate) log_focal: f64,
    /// Coefficient of r² in normalized coordinates.
    pub(crate) k1: f64,
}

/// All unknowns.
#[derive(Debug, Clone)]
pub(crate) struct State {
    /// World to camera, per photograph.
    pub(crate) motion: Vec<Matrix3<f64>>,
    pub(crate) lenses: Vec<Lens>,
}

/// Which unknowns move, and what is known beforehand.
#[derive(Debug, Clone)]
pub(crate) struct Problem<'a> {
    pub(crate) kind: Motion,
    pub(crate) overlaps: &'a [Overlap],
    /// Lens of each photograph.
    pub(crate) lens_of: &'a [usize],
    /// The photograph that stays where it is.
    pub(crate) fixed: usize,
    pub(crate) free_focal: bool,
    pub(crate) free_k1: bool,
    /// Expected logarithm of each lens's focal length and its standard deviation.
    pub(crate) focal_prior: &'a [(f64, f64)],
    pub(crate) loss: RobustLoss,
}

/// Standard deviation of k1 beforehand: ordinary lenses reach ±0.2 in these units, phone cameras, which correct themselves, ±0.03.
const K1_SIGMA: f64 = 0.1;
/// Residual in pixels that stands for a point behind the camera or out of the lens's reach.
const LOST: f64 = 1e4;
/// The widest row: two motions of eight and two lenses of two.
const MAX_LOCAL: usize = 20;

/// A transferred point and its derivatives by: motion of the source, of the target, lens of the source, of the target.
struct Transfer {
    point: Vector2<f64>,
    by_source: [Vector2<f64>; 8],
    by_target: [Vector2<f64>; 8],
    by_source_lens: [Vector2<f64>; 2],
    by_target_lens: [Vector2<f64>; 2],
}

/// Inverse of `x (1 + k1 |x|²)`; `None` beyond its turning point.
fn undistort(q: Vector2<f64>, k1: f64) -> Option<Vector2<f64>> {
    if k1 == 0.0 {
        return Some(q);
    }
    let rd = q.norm();
    let mut r = rd;
    for _ in 0..20 {
        let slope = 1.0 + 3.0 * k1 * r * r;
        if slope <= 0.05 {
            return None;
        }
        let step = (r * (1.0 + k1 * r * r) - rd) / slope;
        r -= step;
        if step.abs() < 1e-14 * (1.0 + rd) {
            break;
        }
    }
    if rd > 0.0 { Some(q * (r / rd)) } else { Some(q) }
}

fn distortion_jacobian(p: Vector2<f64>, k1: f64) -> Matrix2<f64> {
    Matrix2::identity() * (1.0 + k1 * p.norm_squared()) + p * p.transpose() * (2.0 * k1)
}

impl Problem<'_> {
    fn motion_dof(&self) -> usize {
        match self.kind {
            Motion::Rotation => 3,
            Motion::Homography => 8,
        }
    }

    fn lens_dof(&self) -> usize {
        usize::from(self.free_focal) + usize::from(self.free_k1)
    }

    /// First column of a photograph's motion, `None` for the fixed one.
    fn motion_column(&self, i: usize) -> Option<usize> {
        (i != self.fixed).then(|| self.motion_dof() * (i - usize::from(i > self.fixed)))
    }

    fn lens_column(&self, lens: usize) -> usize {
        self.motion_dof() * (self.lens_of.len() - 1) + self.lens_dof() * lens
    }

    fn columns(&self) -> usize {
        self.lens_column(self.focal_prior.len())
    }

    /// Pixels of photograph `i` (from its principal point) to those of `j`.
    pub(crate) fn transfer(&self, s: &State, i: usize, j: usize, a: Vector2<f64>) -> Option<Vector2<f64>> {
        let (from, to) = (s.lenses[self.lens_of[i]], s.lenses[self.lens_of[j]]);
        let p = undistort(a / from.log_focal.exp(), from.k1)?;
        let y = s.motion[j] * inverse(self.kind, &s.motion[i]) * Vector3::new(p.x, p.y, 1.0);
        finish(&y, to).map(|(n, f)| n * (f * (1.0 + to.k1 * n.norm_squared())))
    }

    fn transfer_with_jacobian(
        &self,
        generators: &[Matrix3<f64>],
        s: &State,
        i: usize,
        j: usize,
        a: Vector2<f64>,
    ) -> Option<Transfer> {
        let (from, to) = (s.lenses[self.lens_of[i]], s.lenses[self.lens_of[j]]);
        let q = a / from.log_focal.exp();
        let p = undistort(q, from.k1)?;
        let relative = s.motion[j] * inverse(self.kind, &s.motion[i]);
        let x = Vector3::new(p.x, p.y, 1.0);
        let y = relative * x;
        let (n, f) = finish(&y, to)?;
        let r2 = n.norm_squared();
        // Derivative of the pixel by n, then by y.
        let by_n = distortion_jacobian(n, to.k1) * f;
        let by_y = |dy: Vector3<f64>| by_n * Vector2::new(dy.x - n.x * dy.z, dy.y - n.y * dy.z) / y.z;
        let zero = Vector2::zeros();
        let (mut by_source, mut by_target) = ([zero; 8], [zero; 8]);
        for (k, g) in generators.iter().enumerate() {
            by_target[k] = by_y(g * y);
            by_source[k] = by_y(-(relative * (g * x)));
        }
        let inverse_lens = distortion_jacobian(p, from.k1).try_inverse()?;
        let by_p = |dp: Vector2<f64>| by_y(relative * Vector3::new(dp.x, dp.y, 0.0));
        let point = n * (f * (1.0 + to.k1 * r2));
        Some(Transfer {
            point,
            by_source,
            by_target,
            by_source_lens: [by_p(-(inverse_lens * q)), by_p(-(inverse_lens * (p * p.norm_squared())))],
            by_target_lens: [point, n * (f * r2)],
        })
    }

    fn overlap_cost(&self, s: &State, o: &Overlap) -> f64 {
        let one = |i, j, a, b: Vector2<f64>| {
            let squared = self.transfer(s, i, j, a).map_or(LOST * LOST, |p| (p - b).norm_squared());
            self.loss.value(squared)
        };
        o.points.iter().map(|&(a, b)| one(o.i, o.j, a, b) + one(o.j, o.i, b, a)).sum()
    }

    /// Global columns of the local ones: motion of i, motion of j, lens of i, lens of j.
    fn local_columns(&self, i: usize, j: usize) -> Vec<Option<usize>> {
        let (m, l) = (self.motion_dof(), self.lens_dof());
        let mut columns = Vec::with_capacity(MAX_LOCAL);
        for photo in [i, j] {
            let first = self.motion_column(photo);
            columns.extend((0..m).map(|k| first.map(|c| c + k)));
        }
        for photo in [i, j] {
            let first = self.lens_column(self.lens_of[photo]);
            columns.extend((0..l).map(|k| Some(first + k)));
        }
        columns
    }

    fn linearize_overlap(&self, generators: &[Matrix3<f64>], s: &State, o: &Overlap) -> NormalEquations<Dyn> {
        let (m, l) = (self.motion_dof(), self.lens_dof());
        let n = 2 * (m + l);
        let mut normal = NormalEquations::zeros(Dyn(n));
        let mut rows = [DVector::zeros(n), DVector::zeros(n)];
        // Which of the two lens derivatives are in use.
        let lens: Vec<usize> =
            [(0, self.free_focal), (1, self.free_k1)].iter().filter(|(_, f)| *f).map(|(k, _)| *k).collect();
        for &(a, b) in &o.points {
            for forward in [true, false] {
                let (i, j, from, to) = if forward { (o.i, o.j, a, b) } else { (o.j, o.i, b, a) };
                let Some(t) = self.transfer_with_jacobian(generators, s, i, j, from) else {
                    normal.cost += self.loss.value(LOST * LOST);
                    continue;
                };
                let r = t.point - to;
                let squared = r.norm_squared();
                normal.cost += self.loss.value(squared);
                let weight = self.loss.weight(squared);
                let (source, target) = if forward { (0, 1) } else { (1, 0) };
                for (axis, row) in rows.iter_mut().enumerate() {
                    for k in 0..m {
                        row[source * m + k] = t.by_source[k][axis];
                        row[target * m + k] = t.by_target[k][axis];
                    }
                    for (k, &which) in lens.iter().enumerate() {
                        row[2 * m + source * l + k] = t.by_source_lens[which][axis];
                        row[2 * m + target * l + k] = t.by_target_lens[which][axis];
                    }
                    normal.add(r[axis], row, weight);
                }
            }
        }
        normal
    }

    fn prior_cost(&self, s: &State) -> f64 {
        s.lenses
            .iter()
            .zip(self.focal_prior)
            .map(|(lens, &(mean, sigma))| {
                let f = if self.free_focal { ((lens.log_focal - mean) / sigma).powi(2) } else { 0.0 };
                let k = if self.free_k1 { (lens.k1 / K1_SIGMA).powi(2) } else { 0.0 };
                f + k
            })
            .sum()
    }

    /// Minimizes the reprojection error from `start`.
    pub(crate) fn solve(&self, start: State, max_iterations: usize) -> (State, f64) {
        let options = LmOptions { max_iterations, cost_tolerance: 1e-7, ..LmOptions::default() };
        let report = levenberg_marquardt(self, start, &options);
        (report.params, report.cost)
    }

    /// Squared error in pixels of every match of an overlap, the mean of the two directions.
    pub(crate) fn squared_errors(&self, s: &State, o: &Overlap) -> Vec<f64> {
        let one = |i, j, a, b: Vector2<f64>| self.transfer(s, i, j, a).map_or(LOST * LOST, |p| (p - b).norm_squared());
        o.points.iter().map(|&(a, b)| 0.5 * (one(o.i, o.j, a, b) + one(o.j, o.i, b, a))).collect()
    }
}

/// The camera-plane point and the focal length; `None` behind the camera.
fn finish(y: &Vector3<f64>, lens: Lens) -> Option<(Vector2<f64>, f64)> {
    if y.z <= 1e-6 * y.norm() {
        return None;
    }
    let n = Vector2::new(y.x / y.z, y.y / y.z);
    // Beyond the turning point of the lens polynomial a pixel means nothing.
    (1.0 + 3.0 * lens.k1 * n.norm_squared() > 0.05).then(|| (n, lens.log_focal.exp()))
}

fn inverse(kind: Motion, m: &Matrix3<f64>) -> Matrix3<f64> {
    match kind {
        Motion::Rotation => m.transpose(),
        Motion::Homography => m.try_inverse().unwrap_or_else(|| Matrix3::from_element(f64::NAN)),
    }
}

impl LeastSquares for Problem<'_> {
    type Dim = Dyn;
    type Params = State;

    fn dim(&self) -> Dyn {
        Dyn(self.columns())
    }

    fn cost(&self, s: &State) -> f64 {
        // Collected before summing: the order of a parallel sum would change the last bits.
        let costs: Vec<f64> = self.overlaps.par_iter().map(|o| self.overlap_cost(s, o)).collect();
        costs.iter().sum::<f64>() + self.prior_cost(s)
    }

    fn linearize(&self, s: &State) -> NormalEquations<Dyn> {
        let generators = self.kind.generators();
        let locals: Vec<NormalEquations<Dyn>> =
            self.overlaps.par_iter().map(|o| self.linearize_overlap(&generators, s, o)).collect();
        let mut normal = NormalEquations::zeros(self.dim());
        for (o, local) in self.overlaps.iter().zip(&locals) {
            let columns = self.local_columns(o.i, o.j);
            normal.cost += local.cost;
            for (q, column) in columns.iter().enumerate() {
                let Some(column) = *column else { continue };
                normal.gradient[column] += local.gradient[q];
                for (p, row) in columns.iter().enumerate() {
                    let Some(row) = *row else { continue };
                    if row >= column {
                        normal.hessian[(row, column)] += local.hessian[(p.max(q), p.min(q))];
                    }
                }
            }
        }
        for (lens, (value, &(mean, sigma))) in s.lenses.iter().zip(self.focal_prior).enumerate() {
            let mut column = self.lens_column(lens);
            let mut add = |on: bool, error: f64, sigma: f64| {
                if on {
                    normal.hessian[(column, column)] += 1.0 / (sigma * sigma);
                    normal.gradient[column] += error / (sigma * sigma);
                    column += 1;
                }
            };
            add(self.free_focal, value.log_focal - mean, sigma);
            add(self.free_k1, value.k1, K1_SIGMA);
        }
        normal.cost += self.prior_cost(s);
        normal
    }

    fn step(&self, s: &State, delta: &DVector<f64>) -> State {
        let generators = self.kind.generators();
        let mut next = s.clone();
        for (i, motion) in next.motion.iter_mut().enumerate() {
            let Some(column) = self.motion_column(i) else { continue };
            *motion = match self.kind {
                Motion::Rotation => {
                    let moved = Rotation3::new(Vector3::new(delta[column], delta[column + 1], delta[column + 2]))
                        .into_inner()
                        * *motion;
                    // Products of rotations drift off the group by rounding.
                    Rotation3::from_matrix_eps(&moved, 1e-15, 10, Rotation3::from_matrix_unchecked(moved)).into_inner()
                }
                Motion::Homography => {
                    let change: Matrix3<f64> = generators.iter().enumerate().map(|(k, g)| g * delta[column + k]).sum();
                    let moved = (Matrix3::identity() + change) * *motion;
                    moved / moved.norm()
                }
            };
        }
        for lens in 0..next.lenses.len() {
            let mut column = self.lens_column(lens);
            if self.free_focal {
                next.lenses[lens].log_focal += delta[column];
                column += 1;
            }
            if self.free_k1 {
                next.lenses[lens].k1 += delta[column];
            }
        }
        next
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Points that two cameras turned by `angles` see, the lens `focal`, `k1`.
    fn overlaps(rotations: &[Rotation3<f64>], focal: f64, k1: f64) -> Vec<Overlap> {
        let see = |r: &Rotation3<f64>, ray: Vector3<f64>| -> Option<Vector2<f64>> {
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
                        if let (Some(a), Some(b)) = (see(&rotations[i], ray), see(&rotations[j], ray)) {
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

    #[test]
    fn jacobians_are_the_derivatives() {
        let rotations = turns();
        let overlaps = overlaps(&rotations, 700.0, 0.0);
        for kind in [Motion::Rotation, Motion::Homography] {
            let free = kind == Motion::Rotation;
            let problem = Problem {
                kind,
                overlaps: &overlaps,
                lens_of: &[0, 1, 0, 1],
                fixed: 1,
                free_focal: free,
                free_k1: free,
                focal_prior: &[(6.5, 0.3), (6.5, 0.3)],
                loss: RobustLoss::Trivial,
            };
            let state = State {
                motion: rotations
                    .iter()
                    .map(|r| (Rotation3::new(Vector3::new(0.01, -0.02, 0.01)) * r).into_inner())
                    .collect(),
                lenses: vec![Lens { log_focal: 6.5, k1: -0.04 }, Lens { log_focal: 6.6, k1: 0.03 }],
            };
            let normal = problem.linearize(&state);
            let h = 1e-6;
            for column in 0..problem.columns() {
                let mut d = DVector::zeros(problem.columns());
                d[column] = h;
                let forward = problem.cost(&problem.step(&state, &d));
                d[column] = -h;
                let numeric = (forward - problem.cost(&problem.step(&state, &d))) / (4.0 * h);
                // Central differences of a cost of 1e7: h² truncation and 1e-16·1e7/h rounding, against gradients of 1e6.
                let analytic = normal.gradient[column];
                assert!(
                    (numeric - analytic).abs() < 1e-4 * (1e3 + analytic.abs()),
                    "{kind:?} {column}: {numeric} {analytic}"
                );
            }
        }
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
        let (state, _) = problem.solve(State { motion, lenses: vec![Lens { log_focal: start, k1: 0.0 }] }, 100);
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
            problem.solve(State { motion, lenses: vec![Lens { log_focal: 690.0_f64.ln(), k1: 0.0 }] }, 100);
        // A match off by 25 px pulls with weight 1/625: a tenth of them, all the same way, by 0.1 · 25/625 = 0.004 px of 700 px.
        assert!((state.lenses[0].log_focal.exp() - 700.0).abs() < 1.0);
        let relative = state.motion[3] * state.motion[0].transpose();
        let truth = rotations[3] * rotations[0].inverse();
        assert!((relative - truth.matrix()).norm() < 1e-3);
    }
}
