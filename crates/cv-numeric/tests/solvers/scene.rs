//! Bundle adjustment of generated scenes and chains of positions, and a reference implementation of their normal equations.

use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustIteration, Adjustment, Euclidean, GroupId, Manifold, Residual, RigidMotion};
use nalgebra::{DMatrix, DVector, Rotation3, SMatrix, Vector2, Vector3};
use std::ops::ControlFlow;

pub(crate) fn never_stop(_: &AdjustIteration) -> ControlFlow<()> {
    ControlFlow::Continue(())
}

/// Uniform random numbers from −1 to 1.
struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 = self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        // splitmix64's mixing.
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 52) as f64 - 1.0
    }

    fn gauss(&mut self) -> f64 {
        let u = (self.next() + 1.0) / 2.0;
        (-2.0 * u.max(1e-300).ln()).sqrt() * (std::f64::consts::PI * self.next()).cos()
    }

    fn vector(&mut self) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.next())
    }
}

/// Reprojection errors of cameras with a focal length and one radial distortion coefficient.
#[derive(Clone)]
struct Reprojection(Vec<Vector2<f64>>);

impl Residual<2, 3, 11> for Reprojection {
    const DIMS: [usize; 3] = [6, 2, 3];

    fn evaluate(
        &self,
        item: usize,
        [pose, lens, point]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, 11>>,
    ) -> Option<Vector2<f64>> {
        let (rotation, translation) = RigidMotion::load(pose);
        let turned = rotation * Vector3::from_column_slice(point);
        let p = turned + translation;
        if p.z <= 0.0 {
            return None;
        }
        let n = Vector2::new(p.x, p.y) / p.z;
        let r2 = n.norm_squared();
        let radial = 1.0 + lens[1] * r2;
        if let Some(j) = jacobian {
            let by_n = (SMatrix::<f64, 2, 2>::identity() * radial + n * n.transpose() * (2.0 * lens[1])) * lens[0];
            let by_p = by_n * SMatrix::<f64, 2, 3>::new(1.0, 0.0, -n.x, 0.0, 1.0, -n.y) / p.z;
            j.fixed_columns_mut::<3>(0).copy_from(&(-by_p * turned.cross_matrix()));
            j.fixed_columns_mut::<3>(3).copy_from(&by_p);
            j.set_column(6, &(n * radial));
            j.set_column(7, &(n * (lens[0] * r2)));
            j.fixed_columns_mut::<3>(8).copy_from(&(by_p * rotation.matrix()));
        }
        Some(n * (lens[0] * radial) - self.0[item])
    }
}

pub(crate) struct Scene {
    pub(crate) poses: Vec<f64>,
    pub(crate) lenses: Vec<f64>,
    pub(crate) points: Vec<f64>,
    pub(crate) pixels: Vec<Vector2<f64>>,
    pub(crate) blocks: Vec<[u32; 3]>,
}

impl Scene {
    /// Cameras on an arc around points in a cube, every point observed by `views` of them.
    pub(crate) fn new(seed: u64, cameras: usize, points: usize, views: usize, own_lenses: bool) -> Self {
        let mut random = Random(seed);
        let count = if own_lenses { cameras } else { 1 };
        let lenses = (0..count).flat_map(|_| [800.0 + 20.0 * random.next(), -0.05 + 0.01 * random.next()]).collect();
        let mut poses = Vec::new();
        for c in 0..cameras {
            let angle = 1.2 * (c as f64 / (cameras - 1) as f64 - 0.5);
            let turn = Rotation3::new(Vector3::new(0.0, angle, 0.0) + random.vector() * 0.1);
            poses.extend(RigidMotion::store(&turn, &(Vector3::new(0.0, 0.0, 5.0) + random.vector() * 0.3)));
        }
        let points: Vec<f64> = (0..points * 3).map(|_| random.next()).collect();
        let mut scene = Self { poses, lenses, points, pixels: Vec::new(), blocks: Vec::new() };
        for p in 0..scene.points.len() / 3 {
            for s in 0..views {
                let c = (p * 7 + s * (1 + p % 3)) % cameras;
                if scene.blocks.iter().rev().take(views).any(|b| b[2] == p as u32 && b[0] == c as u32) {
                    continue;
                }
                scene.blocks.push([c as u32, if own_lenses { c as u32 } else { 0 }, p as u32]);
            }
        }
        let zero = Reprojection(vec![Vector2::zeros(); scene.blocks.len()]);
        let truth = [&*scene.poses, &scene.lenses, &scene.points];
        let pixel = |i: usize| zero.evaluate(i, scene.at(i, truth), None).unwrap();
        scene.pixels = (0..scene.blocks.len()).map(pixel).collect();
        scene
    }

    /// The blocks of an item among the values of poses, lenses and points.
    fn at<'a>(&self, item: usize, [poses, lenses, points]: [&'a [f64]; 3]) -> [&'a [f64]; 3] {
        let [c, l, p] = self.blocks[item].map(|i| i as usize);
        [&poses[12 * c..][..12], &lenses[2 * l..][..2], &points[3 * p..][..3]]
    }

    /// The present values of a [`Scene::problem`], with what it fixes.
    pub(crate) fn parameters<'a>(problem: &'a Adjustment<'_>, groups: [GroupId; 3]) -> [Parameters<'a>; 3] {
        let [poses, lenses, points] = groups.map(|g| problem.values(g));
        let fixed = (0..6).map(|k| (0, k)).chain([(1, 3)]).collect();
        [
            Parameters { manifold: &RigidMotion, values: poses, fixed },
            Parameters { manifold: &Euclidean(2), values: lenses, fixed: Vec::new() },
            Parameters { manifold: &Euclidean(3), values: points, fixed: Vec::new() },
        ]
    }

    /// Computes [`reference`] at the present values of a [`Scene::problem`].
    pub(crate) fn reference(
        &self,
        problem: &Adjustment<'_>,
        groups: [GroupId; 3],
        loss: RobustLoss,
    ) -> (DMatrix<f64>, DVector<f64>) {
        let groups = Self::parameters(problem, groups);
        let residual = Reprojection(self.pixels.clone());
        reference(&groups, |values| {
            let components = |i: usize| {
                let r = residual.evaluate(i, self.at(i, [&values[0], &values[1], &values[2]]), None).unwrap();
                [r.x, r.y].map(|component| (component, loss.weight(r.norm_squared())))
            };
            (0..self.blocks.len()).flat_map(components).collect()
        })
    }

    pub(crate) fn noisy(mut self, seed: u64, sigma: f64) -> Self {
        let mut random = Random(seed);
        self.pixels.iter_mut().for_each(|p| *p += Vector2::new(random.gauss(), random.gauss()) * sigma);
        self
    }

    /// The problem from a start perturbed by `off`; the first pose and the scale fixed.
    pub(crate) fn problem(&self, off: f64, eliminate: bool, loss: RobustLoss) -> (Adjustment<'static>, [GroupId; 3]) {
        let mut random = Random(99);
        let mut poses = self.poses.clone();
        for (c, pose) in poses.chunks_exact_mut(12).enumerate().skip(1) {
            let mut delta = [0.0; 6];
            delta.iter_mut().for_each(|d| *d = off * random.next());
            if c == 1 {
                delta[3] = 0.0;
            }
            let before = pose.to_vec();
            RigidMotion.step(&before, &delta, pose);
        }
        let points = self.points.iter().map(|x| x + off * random.next()).collect();
        let lenses =
            self.lenses.iter().enumerate().map(|(i, l)| if i % 2 == 0 { l * (1.0 + off) } else { 0.0 }).collect();
        let mut problem = Adjustment::default();
        let groups = [
            problem.add_group("poses", RigidMotion, poses).unwrap(),
            problem.add_group("lenses", Euclidean(2), lenses).unwrap(),
            problem.add_group("points", Euclidean(3), points).unwrap(),
        ];
        let residual = Reprojection(self.pixels.clone());
        problem.add_residuals("observations", residual, groups, self.blocks.clone(), loss).unwrap();
        if eliminate {
            problem.eliminate(groups[2]).unwrap();
        }
        problem.fix(groups[0], 0).unwrap();
        problem.fix_parameters(groups[0], 1, &[3]).unwrap();
        (problem, groups)
    }
}

/// The parameters of one group for [`reference`].
pub(crate) struct Parameters<'a> {
    pub(crate) manifold: &'a dyn Manifold,
    pub(crate) values: &'a [f64],
    /// Block and index of the fixed degrees of freedom.
    pub(crate) fixed: Vec<(usize, usize)>,
}

impl Parameters<'_> {
    /// Block and index of the free degrees of freedom.
    fn free(&self) -> impl Iterator<Item = (usize, usize)> {
        let size = self.manifold.tangent();
        let all = (0..self.values.len() / self.manifold.ambient()).flat_map(move |b| (0..size).map(move |k| (b, k)));
        all.filter(|f| !self.fixed.contains(f))
    }

    /// The values after a step of one block.
    fn moved(&self, block: usize, delta: &[f64]) -> Vec<f64> {
        let (mut values, at) = (self.values.to_vec(), block * self.manifold.ambient());
        let range = at..at + self.manifold.ambient();
        self.manifold.step(&self.values[range.clone()], delta, &mut values[range]);
        values
    }

    /// The values after a step of the free degrees of freedom, the next ones of `delta`.
    pub(crate) fn stepped(&self, delta: &mut impl Iterator<Item = f64>) -> Vec<f64> {
        let (n, size) = (self.manifold.ambient(), self.manifold.tangent());
        let mut step = vec![0.0; self.values.len() / n * size];
        self.free().for_each(|(b, k)| step[b * size + k] = delta.next().unwrap());
        let mut values = self.values.to_vec();
        for ((x, delta), to) in self.values.chunks(n).zip(step.chunks(size)).zip(values.chunks_mut(n)) {
            self.manifold.step(x, delta, to);
        }
        values
    }
}

/// `H = Σ w JᵀJ` and `g = Σ w Jᵀr` with numeric derivatives by every free parameter, group after group. `rows` computes the
/// components of all residuals, each with its weight, from the values of all groups.
pub(crate) fn reference(
    groups: &[Parameters<'_>],
    rows: impl Fn(&[Vec<f64>]) -> Vec<(f64, f64)>,
) -> (DMatrix<f64>, DVector<f64>) {
    let free = groups.iter().enumerate().flat_map(|(g, group)| group.free().map(move |(b, k)| (g, b, k)));
    let free: Vec<_> = free.collect();
    let start: Vec<Vec<f64>> = groups.iter().map(|g| g.values.to_vec()).collect();
    let (r, weights): (Vec<f64>, Vec<f64>) = rows(&start).into_iter().unzip();
    let residuals = |values: &[Vec<f64>]| DVector::from_iterator(r.len(), rows(values).into_iter().map(|r| r.0));
    let at = DVector::from_column_slice(&r);
    let mut j = DMatrix::zeros(r.len(), free.len());
    for (column, &(g, b, k)) in free.iter().enumerate() {
        let moved = |h: f64| {
            let mut values = start.clone();
            let mut delta = vec![0.0; groups[g].manifold.tangent()];
            delta[k] = h;
            values[g] = groups[g].moved(b, &delta);
            residuals(&values)
        };
        // Richardson's extrapolation of central differences: h⁴ of truncation, 1e-13/h of rounding.
        let (one, two) = ((moved(1e-4) - moved(-1e-4)) / 2e-4, (moved(2e-4) - moved(-2e-4)) / 4e-4);
        j.set_column(column, &((one * 4.0 - two) / 3.0));
    }
    let weighted = DMatrix::from_fn(j.nrows(), j.ncols(), |i, c| j[(i, c)] * weights[i]);
    (j.transpose() * &weighted, weighted.transpose() * at)
}

/// The difference of two plane positions.
pub(crate) struct Between(pub(crate) Vec<Vector2<f64>>);

impl Residual<2, 2, 4> for Between {
    const DIMS: [usize; 2] = [2, 2];

    fn evaluate(
        &self,
        item: usize,
        [a, b]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 2, 4>>,
    ) -> Option<Vector2<f64>> {
        if let Some(j) = jacobian {
            *j = SMatrix::from_row_slice(&[-1.0, 0.0, 1.0, 0.0, 0.0, -1.0, 0.0, 1.0]);
        }
        Some(Vector2::new(b[0] - a[0], b[1] - a[1]) - self.0[item])
    }
}

/// A closed chain of positions with shortcuts: large and sparse. Also [`reference`] of it.
pub(crate) fn chain(n: u32) -> (Adjustment<'static>, GroupId, (DMatrix<f64>, DVector<f64>)) {
    let mut random = Random(7);
    let mut problem = Adjustment::default();
    let positions = problem.add_group("positions", Euclidean(2), vec![0.0; 2 * n as usize]).unwrap();
    let mut blocks: Vec<[u32; 2]> = (0..n).map(|i| [i, (i + 1) % n]).collect();
    blocks.extend((0..n).step_by(9).map(|i| [i, (i + 20) % n]));
    let steps: Vec<_> = blocks.iter().map(|_| Vector2::new(random.next(), random.next())).collect();
    let values = problem.values(positions);
    let group = Parameters { manifold: &Euclidean(2), values, fixed: vec![(0, 0), (0, 1)] };
    let residual = Between(steps);
    let expected = reference(&[group], |values| {
        let components = |(i, ab): (usize, &[u32; 2])| {
            let r = residual.evaluate(i, ab.map(|b| &values[0][2 * b as usize..][..2]), None).unwrap();
            [(r.x, 1.0), (r.y, 1.0)]
        };
        blocks.iter().enumerate().flat_map(components).collect()
    });
    problem.add_residuals("steps", residual, [positions; 2], blocks, RobustLoss::Trivial).unwrap();
    problem.fix(positions, 0).unwrap();
    (problem, positions, expected)
}
