//! Least-squares solution for displacement fields from tie points, smoothness and damping.

use crate::surface::DisplacementField;
use cv_core::{Cancelled, Point2, Stage, Vector2};
use std::ops::Range;

/// A correspondence of two placements: the difference of their displacements at two canvas positions.
#[derive(Clone, Copy)]
pub(super) struct TiePoint {
    pub(super) p: usize,
    pub(super) q: usize,
    pub(super) a: Point2<f64>,
    pub(super) b: Point2<f64>,
    /// Displacement of `p` at `a` minus that of `q` at `b`.
    pub(super) difference: Vector2<f64>,
    /// Unit normal of the edge, where the position along it is unknown (aperture problem).
    pub(super) normal: Option<Vector2<f64>>,
}

impl TiePoint {
    /// A point of the scene that the placements show at these canvas positions before displacement.
    pub(super) fn point(p: usize, q: usize, a: Point2<f64>, b: Point2<f64>, normal: Option<Vector2<f64>>) -> Self {
        Self { p, q, a, b, difference: b - a, normal }
    }

    /// Returns the component of a displacement that the tie point measures.
    pub(super) fn measured(normal: Option<Vector2<f64>>, v: Vector2<f64>) -> Vector2<f64> {
        normal.map_or(v, |n| n * n.dot(&v))
    }
}

/// Weight of the smoothness term relative to a tie point.
const SMOOTHNESS: f64 = 0.15;
/// Weight of the continuity of a photograph across the border of a canvas that spans 360°, relative to a tie point: dominates the tie points of a cell.
const CONTINUITY: f64 = 30.0;
/// Rounds of iteratively reweighted least squares.
const ROUNDS: u32 = 5;
/// Tolerance of the conjugate gradients in the last round: a thousandth of a pixel.
const TOLERANCE: f64 = 1e-8;
/// Tolerance in the rounds before, whose weights are of a wider loss.
const ROUND_TOLERANCE: f64 = 1e-4;

/// Solves for the fields by iteratively reweighted least squares (Cauchy weights of `scale` pixels, infinite for least squares) and conjugate gradients; `continuity` are positions at which two fields are equal.
pub(super) fn solve(
    fields: &mut [DisplacementField],
    ties: &[TiePoint],
    continuity: &[TiePoint],
    damping: f64,
    scale: f64,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let mut offsets = vec![0];
    for f in fields.iter() {
        offsets.push(offsets[offsets.len() - 1] + f.displacement.len());
    }
    let n = offsets[fields.len()];
    /// A residual: eight vertices with signed weights, the displacement to be compensated, and the direction in which it is known.
    type Term = ([(usize, f64); 8], Vector2<f64>, Option<Vector2<f64>>);
    let vertices = |t: &TiePoint| {
        let (a, b) = (fields[t.p].around(t.a), fields[t.q].around(t.b));
        let term = |k: usize| {
            if k < 4 { (offsets[t.p] + a[k].0, a[k].1) } else { (offsets[t.q] + b[k - 4].0, -b[k - 4].1) }
        };
        std::array::from_fn(term)
    };
    let terms: Vec<Term> = ties.iter().chain(continuity).map(|t| (vertices(t), t.difference, t.normal)).collect();
    // The columns and the vertices of each field.
    let grids: Vec<(usize, Range<usize>)> =
        fields.iter().zip(offsets.windows(2)).map(|(f, ends)| (f.columns, ends[0]..ends[1])).collect();
    let own: Vec<f64> = fields.iter().flat_map(|f| smooth_diagonal(f.columns, f.rows, damping)).collect();
    let mut d: Vec<Vector2<f64>> = fields.iter().flat_map(|f| f.displacement.iter().copied()).collect();
    let left = |d: &[Vector2<f64>], t: &[(usize, f64); 8]| -> Vector2<f64> { t.iter().map(|&(i, w)| d[i] * w).sum() };
    // Without robust weights the rounds are the same.
    let rounds = if scale.is_finite() { ROUNDS } else { 1 };
    for round in 0..rounds {
        // The scale shrinks from round to round (graduated non-convexity).
        let scale = scale * f64::from(1 << (rounds - 1 - round));
        let weight = |(t, want, normal): &Term| {
            let residual = TiePoint::measured(*normal, left(&d, t) - want);
            1.0 / (1.0 + residual.norm_squared() / (scale * scale))
        };
        let weights = terms[..ties.len()].iter().map(weight);
        let weights: Vec<f64> = weights.chain(continuity.iter().map(|_| CONTINUITY)).collect();
        let apply = |x: &[Vector2<f64>], out: &mut [Vector2<f64>]| {
            for (columns, vertices) in &grids {
                smooth(&x[vertices.clone()], *columns, damping, &mut out[vertices.clone()]);
            }
            for ((t, _, normal), w) in terms.iter().zip(&weights) {
                let value = TiePoint::measured(*normal, left(x, t) * *w);
                for &(i, c) in t {
                    out[i] += value * c;
                }
            }
        };
        let mut right = vec![Vector2::zeros(); n];
        let mut diagonal: Vec<Vector2<f64>> = own.iter().map(|v| Vector2::repeat(*v)).collect();
        for ((t, want, normal), w) in terms.iter().zip(&weights) {
            let want = TiePoint::measured(*normal, *want);
            let axes = normal.map_or_else(|| Vector2::repeat(1.0), |n| n.component_mul(&n));
            for &(i, c) in t {
                right[i] += want * (c * w);
                diagonal[i] += axes * (c * c * w);
            }
        }
        let tolerance = if round + 1 < rounds { ROUND_TOLERANCE } else { TOLERANCE };
        conjugate_gradients(apply, &right, &diagonal, &mut d, tolerance, stage)?;
    }
    for (f, offset) in fields.iter_mut().zip(&offsets) {
        let len = f.displacement.len();
        f.displacement.copy_from_slice(&d[*offset..offset + len]);
    }
    Ok(())
}

/// Sets `out` to the product of the matrix of damping and smoothness with the displacements `x` of a grid, row-major.
fn smooth(x: &[Vector2<f64>], columns: usize, damping: f64, out: &mut [Vector2<f64>]) {
    let rows = x.len() / columns;
    for (i, (row, out)) in x.chunks_exact(columns).zip(out.chunks_exact_mut(columns)).enumerate() {
        for (out, v) in out.iter_mut().zip(row) {
            *out = v * damping;
        }
        for k in 1..columns {
            out[k] += (row[k] - row[k - 1]) * SMOOTHNESS;
        }
        for k in 1..columns {
            out[k - 1] += (row[k - 1] - row[k]) * SMOOTHNESS;
        }
        let others = [i.checked_sub(1), (i + 1 < rows).then_some(i + 1)];
        for other in others.into_iter().flatten().map(|other| &x[other * columns..]) {
            for ((out, v), w) in out.iter_mut().zip(row).zip(other) {
                *out += (v - w) * SMOOTHNESS;
            }
        }
    }
}

/// Returns the diagonal of that matrix.
fn smooth_diagonal(columns: usize, rows: usize, damping: f64) -> impl Iterator<Item = f64> {
    let neighbors = |i: usize, n: usize| usize::from(i > 0) + usize::from(i + 1 < n);
    let vertices = (0..rows).flat_map(move |y| (0..columns).map(move |x| (x, y)));
    vertices.map(move |(x, y)| damping + SMOOTHNESS * (neighbors(x, columns) + neighbors(y, rows)) as f64)
}

/// Solves by conjugate gradients with Jacobi preconditioner, starting from `x`; ends at a squared residual of `tolerance` relative to the right-hand side, since
/// the initial residual may be small. `apply` sets its second argument to the product of the matrix with the first.
fn conjugate_gradients(
    apply: impl Fn(&[Vector2<f64>], &mut [Vector2<f64>]),
    right: &[Vector2<f64>],
    diagonal: &[Vector2<f64>],
    x: &mut [Vector2<f64>],
    tolerance: f64,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    let dot = |a: &[Vector2<f64>], b: &[Vector2<f64>]| -> f64 { a.iter().zip(b).map(|(a, b)| a.dot(b)).sum() };
    let scale = |r: &[Vector2<f64>], z: &mut [Vector2<f64>]| {
        for ((z, r), d) in z.iter_mut().zip(r).zip(diagonal) {
            *z = r.component_div(d);
        }
    };
    let (mut z, mut product) = (vec![Vector2::zeros(); x.len()], vec![Vector2::zeros(); x.len()]);
    scale(right, &mut z);
    let whole = dot(right, &z);
    apply(x, &mut product);
    let mut r: Vec<Vector2<f64>> = right.iter().zip(&product).map(|(b, a)| b - a).collect();
    scale(&r, &mut z);
    let mut direction = z.clone();
    let mut rz = dot(&r, &z);
    for iteration in 0..200 {
        // An iteration on a hundred thousand matches is some milliseconds.
        if iteration % 8 == 0 {
            stage.check()?;
        }
        if rz <= tolerance * whole.max(1e-6) {
            break;
        }
        apply(&direction, &mut product);
        let step = rz / dot(&direction, &product).max(1e-300);
        for i in 0..x.len() {
            x[i] += direction[i] * step;
            r[i] -= product[i] * step;
        }
        scale(&r, &mut z);
        let next = dot(&r, &z);
        let keep = next / rz.max(1e-300);
        for (p, z) in direction.iter_mut().zip(&z) {
            *p = z + *p * keep;
        }
        rz = next;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::stage;
    use nalgebra::{DMatrix, DVector};

    #[test]
    fn the_matrix_of_a_grid_is_that_of_its_energy() {
        let (columns, rows, damping) = (4, 3, 0.7);
        let at = |i: usize| Vector2::new((i * i % 7) as f64, (i * 5 % 11) as f64);
        let x: Vec<Vector2<f64>> = (0..columns * rows).map(at).collect();
        let mut energy = damping * x.iter().map(Vector2::norm_squared).sum::<f64>();
        for i in 0..x.len() {
            if (i + 1) % columns > 0 {
                energy += SMOOTHNESS * (x[i] - x[i + 1]).norm_squared();
            }
            if i + columns < x.len() {
                energy += SMOOTHNESS * (x[i] - x[i + columns]).norm_squared();
            }
        }
        let mut product = vec![Vector2::zeros(); x.len()];
        smooth(&x, columns, damping, &mut product);
        let quadratic: f64 = x.iter().zip(&product).map(|(x, p)| x.dot(p)).sum();
        assert!((quadratic - energy).abs() < 1e-9 * energy, "{quadratic} {energy}");
        for (i, diagonal) in smooth_diagonal(columns, rows, damping).enumerate() {
            let mut unit = vec![Vector2::zeros(); x.len()];
            unit[i].x = 1.0;
            smooth(&unit, columns, damping, &mut product);
            assert!((product[i].x - diagonal).abs() < 1e-12, "{i}");
        }
    }

    #[test]
    fn conjugate_gradients_converge_to_the_direct_solution() {
        // A chain of springs of different strength, each vertex tied to zero.
        let n = 40;
        let mut matrix = DMatrix::<f64>::from_diagonal_element(n, n, 0.3);
        for i in 0..n - 1 {
            let k = 1.0 + (i % 7) as f64;
            for (r, c, v) in [(i, i, k), (i + 1, i + 1, k), (i, i + 1, -k), (i + 1, i, -k)] {
                matrix[(r, c)] += v;
            }
        }
        let right: Vec<Vector2<f64>> =
            (0..n).map(|i| Vector2::new((i as f64).sin(), (2.0 * i as f64).cos() * 10.0)).collect();
        let apply = |x: &[Vector2<f64>], out: &mut [Vector2<f64>]| {
            for (i, out) in out.iter_mut().enumerate() {
                *out = (0..n).map(|j| x[j] * matrix[(i, j)]).sum();
            }
        };
        let diagonal: Vec<Vector2<f64>> = (0..n).map(|i| Vector2::repeat(matrix[(i, i)])).collect();
        let mut x = vec![Vector2::new(0.5, -0.5); n];
        conjugate_gradients(apply, &right, &diagonal, &mut x, TOLERANCE, &stage()).unwrap();
        for axis in 0..2 {
            let b = DVector::from_iterator(n, right.iter().map(|r| r[axis]));
            let direct = matrix.clone().cholesky().unwrap().solve(&b);
            for i in 0..n {
                // Stops at 1e-4 of the right side in the norm of the matrix, whose least eigenvalue is 0.3.
                assert!((x[i][axis] - direct[i]).abs() < 1e-3 * direct.amax(), "{i}");
            }
        }
    }
}
