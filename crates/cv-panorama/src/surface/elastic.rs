//! Small smooth deformations that bring photographs together where turning the camera cannot: taken by hand, near things move against far ones
//! (after Shum & Szeliski 2000, "local alignment", and Li et al. 2018, elastic warping).
//!
//! Each photograph on the canvas gets a field of displacements on a coarse grid. Matched points are to be drawn at one place; the fields are to be smooth,
//! and zero where nothing asks for more. That is linear least squares, reweighted so that false matches count little.

use crate::align::Alignment;
use crate::surface::Surface;
use crate::surface::{Bounds, Layout, Placement};
use crate::surface::{PAD, PLACES, REACH, Template};
use cv_core::{GrayU8, ImageView, Point2, Vector2};
use rayon::prelude::*;

/// Displacements of one photograph on a grid over its part of the canvas.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Field {
    /// Canvas position of the first vertex.
    left: f64,
    top: f64,
    /// Canvas pixels between vertices.
    spacing: f64,
    columns: usize,
    rows: usize,
    /// Canvas pixels by which what the photograph shows is moved.
    moved: Vec<Vector2<f64>>,
    /// The same as a change of the photograph's pixel to look at.
    shift: Vec<[f32; 2]>,
}

impl Field {
    fn over(b: &Bounds, spacing: f64) -> Self {
        let columns = (b.width() as f64 / spacing).ceil() as usize + 2;
        let rows = (b.height() as f64 / spacing).ceil() as usize + 2;
        let (left, top) = (b.left as f64 - 0.5 * spacing, b.top as f64 - 0.5 * spacing);
        Self {
            left,
            top,
            spacing,
            columns,
            rows,
            moved: vec![Vector2::zeros(); columns * rows],
            shift: vec![[0.0; 2]; columns * rows],
        }
    }

    /// The four vertices around a canvas position and their weights; outside the grid those of the nearest position on it.
    fn around(&self, p: Point2<f64>) -> [(usize, f64); 4] {
        let place = |v: f64, n: usize| {
            let v = v.clamp(0.0, n as f64 - 1.0001);
            (v as usize, v - v.floor())
        };
        let (x, fx) = place((p.x - self.left) / self.spacing, self.columns);
        let (y, fy) = place((p.y - self.top) / self.spacing, self.rows);
        let i = y * self.columns + x;
        let j = i + self.columns;
        [(i, (1.0 - fx) * (1.0 - fy)), (i + 1, fx * (1.0 - fy)), (j, (1.0 - fx) * fy), (j + 1, fx * fy)]
    }

    /// How far what the photograph shows at a canvas position is moved.
    fn at(&self, p: Point2<f64>) -> Vector2<f64> {
        self.around(p).iter().map(|&(i, w)| self.moved[i] * w).sum()
    }

    /// The same field on a canvas and a photograph of other sizes.
    pub(crate) fn scaled(&self, canvas: f64, photo: f64) -> Self {
        let place = |v: f64| (v + 0.5) * canvas - 0.5;
        Self {
            left: place(self.left),
            top: place(self.top),
            spacing: self.spacing * canvas,
            shift: self.shift.iter().map(|s| s.map(|v| v * photo as f32)).collect(),
            moved: self.moved.iter().map(|m| m * canvas).collect(),
            ..*self
        }
    }

    /// Adds the change of the photograph's pixel to coordinates of one canvas row, from column `left` on.
    pub(crate) fn add_row(&self, y: f64, left: f64, us: &mut [f32], vs: &mut [f32]) {
        let v = ((y - self.top) / self.spacing).clamp(0.0, self.rows as f64 - 1.0001);
        let (row, fy) = (v as usize * self.columns, v.fract() as f32);
        let vertex = |x: usize| -> [f32; 2] {
            let (a, b) = (self.shift[row + x], self.shift[row + self.columns + x]);
            [a[0] + (b[0] - a[0]) * fy, a[1] + (b[1] - a[1]) * fy]
        };
        let (start, step) = (((left - self.left) / self.spacing) as f32, (1.0 / self.spacing) as f32);
        let last = self.columns as f32 - 1.0001;
        let mut cell = usize::MAX;
        let (mut a, mut b) = ([0.0; 2], [0.0; 2]);
        for (i, (u, v)) in us.iter_mut().zip(vs).enumerate() {
            let x = (start + i as f32 * step).clamp(0.0, last);
            if x as usize != cell {
                cell = x as usize;
                (a, b) = (vertex(cell), vertex(cell + 1));
            }
            let f = x - cell as f32;
            *u += a[0] + (b[0] - a[0]) * f;
            *v += a[1] + (b[1] - a[1]) * f;
        }
    }

    /// Works out `shift` from `moved`.
    fn settle(&mut self, placement: &Placement, surface: &Surface) {
        for y in 0..self.rows {
            for x in 0..self.columns {
                let i = y * self.columns + x;
                let p = Point2::new(self.left + x as f64 * self.spacing, self.top + y as f64 * self.spacing);
                let look = |p: Point2<f64>| placement.view.project(&surface.inverse(p + placement.origin.coords));
                self.shift[i] = match (look(p), look(p - self.moved[i])) {
                    (Some(a), Some(b)) => [(b.x - a.x) as f32, (b.y - a.y) as f32],
                    _ => [0.0; 2],
                };
            }
        }
    }
}

/// Where in its photograph each pixel of a panorama comes from, deformations included.
#[derive(Debug, Clone)]
pub struct PhotoMap {
    surface: Surface,
    /// Pixel (0, 0) of the panorama on the canvas it was drawn on.
    corner: Vector2<f64>,
    pieces: Vec<(Placement, Option<Field>)>,
}

impl PhotoMap {
    pub(crate) fn new(layout: &Layout, fields: Vec<Option<Field>>) -> Self {
        let pieces = layout.placements.iter().copied().zip(fields).collect();
        Self { surface: layout.surface, corner: Vector2::zeros(), pieces }
    }

    pub(crate) fn crop(&mut self, left: usize, top: usize) {
        self.corner += Vector2::new(left as f64, top as f64);
    }

    /// The pixel of `photo` that is shown at a pixel of the panorama, were the panorama taken from that photograph there; `None` where it does not reach.
    pub fn source(&self, photo: usize, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let p = pixel + self.corner;
        self.pieces.iter().filter(|(placement, _)| placement.photo == photo).find_map(|(placement, field)| {
            let moved = field.as_ref().map_or_else(Vector2::zeros, |f| f.at(p));
            let ray = self.surface.inverse(p - moved + placement.origin.coords);
            placement.view.project(&ray).filter(|q| placement.view.contains(*q))
        })
    }
}

/// Two placements' positions of one thing on the canvas, before anything is moved.
struct Tie {
    p: usize,
    q: usize,
    a: Point2<f64>,
    b: Point2<f64>,
}

/// Grid cells along the side of a photograph.
const CELLS: f64 = 24.0;
/// Weight of a difference between neighboring vertices against a match.
const SMOOTH: f64 = 0.15;
/// Weight of a displacement itself: what one place asks for fades out over √(SMOOTH / STAY) = 5 cells, a fifth of a photograph.
const STAY: f64 = 0.006;
/// Matches farther apart than this share of a photograph's side are no parallax.
const FARTHEST: f64 = 0.04;

/// Displacements for every placement; none where the photographs agree as they are.
pub(crate) fn fields(photos: &[ImageView<'_, u8, 3>], layout: &Layout, alignment: &Alignment) -> Vec<Option<Field>> {
    let n = layout.placements.len();
    let mut sides: Vec<f64> =
        layout.placements.iter().map(|p| ((p.bounds.width() * p.bounds.height()) as f64).sqrt()).collect();
    sides.sort_by(f64::total_cmp);
    let Some(&side) = sides.get(n / 2) else { return vec![None; n] };
    let spacing = (side / CELLS).max(8.0);
    let mut fields: Vec<Field> = layout.placements.iter().map(|p| Field::over(&p.bounds, spacing)).collect();
    let mut ties = feature_ties(layout, alignment, FARTHEST * side);
    // Feature positions are good to a pixel or so of the photographs they were found on, patches to a fraction.
    solve(&mut fields, &ties, 3.0);
    let features = ties.len();
    let grays: Vec<GrayU8> = photos.par_iter().map(|p| cv_imgproc::rgb_to_gray(*p)).collect();
    // Twice: what the first round brings within reach, the second registers.
    for _ in 0..2 {
        ties.truncate(features);
        ties.extend(patch_ties(&grays, layout, &fields, spacing));
        solve(&mut fields, &ties, 3.0);
    }
    for (field, placement) in fields.iter_mut().zip(&layout.placements) {
        field.settle(placement, &layout.surface);
    }
    fields.into_iter().map(Some).collect()
}

/// Where a placement draws a pixel of its photograph, before anything is moved.
fn drawn(placement: &Placement, surface: &Surface, pixel: Point2<f64>) -> Option<Point2<f64>> {
    let mut p = surface.forward(&placement.view.ray(pixel)?)? - placement.origin.coords;
    if let Some(period) = surface.period() {
        let middle = 0.5 * (placement.bounds.left + placement.bounds.right) as f64;
        p.x -= ((p.x - middle) / period).round() * period;
    }
    Some(p)
}

fn feature_ties(layout: &Layout, alignment: &Alignment, farthest: f64) -> Vec<Tie> {
    let mut ties = Vec::new();
    for pair in &alignment.pairs {
        for (p, first) in layout.placements.iter().enumerate().filter(|(_, p)| p.photo == pair.a) {
            for (q, second) in layout.placements.iter().enumerate().filter(|(_, q)| q.photo == pair.b) {
                for m in &pair.matches {
                    let (Some(a), Some(b)) = (drawn(first, &layout.surface, m.a), drawn(second, &layout.surface, m.b))
                    else {
                        continue;
                    };
                    if (a - b).norm() < farthest {
                        ties.push(Tie { p, q, a, b });
                    }
                }
            }
        }
    }
    ties
}

/// Least squares by conjugate gradients, reweighted: a tie off by `scale` pixels counts half.
fn solve(fields: &mut [Field], ties: &[Tie], scale: f64) {
    let mut offsets = vec![0];
    for f in fields.iter() {
        offsets.push(offsets[offsets.len() - 1] + f.moved.len());
    }
    let n = offsets[fields.len()];
    /// Of a tie: eight vertices and their signed weights, and what is to be closed.
    type Term = ([(usize, f64); 8], Vector2<f64>);
    let terms: Vec<Term> = ties
        .iter()
        .map(|t| {
            let (a, b) = (fields[t.p].around(t.a), fields[t.q].around(t.b));
            let term = |k: usize| {
                if k < 4 { (offsets[t.p] + a[k].0, a[k].1) } else { (offsets[t.q] + b[k - 4].0, -b[k - 4].1) }
            };
            (std::array::from_fn(term), t.b - t.a)
        })
        .collect();
    let mut edges = Vec::new();
    for (f, offset) in fields.iter().zip(&offsets) {
        for y in 0..f.rows {
            for x in 0..f.columns {
                let i = offset + y * f.columns + x;
                if x + 1 < f.columns {
                    edges.push((i, i + 1));
                }
                if y + 1 < f.rows {
                    edges.push((i, i + f.columns));
                }
            }
        }
    }
    let mut d: Vec<Vector2<f64>> = fields.iter().flat_map(|f| f.moved.iter().copied()).collect();
    let left = |d: &[Vector2<f64>], t: &[(usize, f64); 8]| -> Vector2<f64> { t.iter().map(|&(i, w)| d[i] * w).sum() };
    for round in 0..5 {
        // From wide to narrow, so that no false match decides what counts as one.
        let scale = scale * f64::from(1 << (4 - round.min(4)));
        let weights: Vec<f64> =
            terms.iter().map(|(t, want)| 1.0 / (1.0 + (left(&d, t) - want).norm_squared() / (scale * scale))).collect();
        let apply = |x: &[Vector2<f64>]| {
            let mut out: Vec<Vector2<f64>> = x.iter().map(|v| v * STAY).collect();
            for &(i, j) in &edges {
                let pull = (x[i] - x[j]) * SMOOTH;
                out[i] += pull;
                out[j] -= pull;
            }
            for ((t, _), w) in terms.iter().zip(&weights) {
                let value = left(x, t) * *w;
                for &(i, c) in t {
                    out[i] += value * c;
                }
            }
            out
        };
        let mut right = vec![Vector2::zeros(); n];
        let mut diagonal = vec![STAY; n];
        for &(i, j) in &edges {
            diagonal[i] += SMOOTH;
            diagonal[j] += SMOOTH;
        }
        for ((t, want), w) in terms.iter().zip(&weights) {
            for &(i, c) in t {
                right[i] += want * (c * w);
                diagonal[i] += c * c * w;
            }
        }
        conjugate_gradients(apply, &right, &diagonal, &mut d);
    }
    for (f, offset) in fields.iter_mut().zip(&offsets) {
        let len = f.moved.len();
        f.moved.copy_from_slice(&d[*offset..offset + len]);
    }
}

fn conjugate_gradients(
    apply: impl Fn(&[Vector2<f64>]) -> Vec<Vector2<f64>>,
    right: &[Vector2<f64>],
    diagonal: &[f64],
    x: &mut [Vector2<f64>],
) {
    // The two axes are two problems with one matrix: products are taken per axis.
    let dot = |a: &[Vector2<f64>], b: &[Vector2<f64>]| -> Vector2<f64> {
        a.iter().zip(b).map(|(a, b)| a.component_mul(b)).sum()
    };
    let scaled = |r: &[Vector2<f64>]| -> Vec<Vector2<f64>> { r.iter().zip(diagonal).map(|(r, d)| r / *d).collect() };
    let product = apply(x);
    let mut r: Vec<Vector2<f64>> = right.iter().zip(&product).map(|(b, a)| b - a).collect();
    let mut z = scaled(&r);
    let mut direction = z.clone();
    let mut rz = dot(&r, &z);
    // Against the right side, not against the first residual: what a former solution leaves may be small already.
    let whole = dot(right, &scaled(right));
    for _ in 0..200 {
        // A thousandth of the error a pixel leaves is enough.
        if rz.x <= 1e-8 * whole.x.max(1e-6) && rz.y <= 1e-8 * whole.y.max(1e-6) {
            break;
        }
        let product = apply(&direction);
        let curvature = dot(&direction, &product);
        let step = Vector2::new(rz.x / curvature.x.max(1e-300), rz.y / curvature.y.max(1e-300));
        for i in 0..x.len() {
            x[i] += direction[i].component_mul(&step);
            r[i] -= product[i].component_mul(&step);
        }
        z = scaled(&r);
        let next = dot(&r, &z);
        let keep = Vector2::new(next.x / rz.x.max(1e-300), next.y / rz.y.max(1e-300));
        for (p, z) in direction.iter_mut().zip(&z) {
            *p = z + p.component_mul(&keep);
        }
        rz = next;
    }
}

/// Half the side of the patches that are compared.
const HALF: usize = 8;
/// Patches tried in each overlap at most.
const PER_OVERLAP: usize = 800;

/// Ties between patches of the photographs as drawn with the fields so far.
fn patch_ties(photos: &[GrayU8], layout: &Layout, fields: &[Field], spacing: f64) -> Vec<Tie> {
    let mut tries = Vec::new();
    for (p, first) in layout.placements.iter().enumerate() {
        for (q, second) in layout.placements.iter().enumerate().skip(p + 1) {
            let Some(common) = first.bounds.intersection(&second.bounds) else { continue };
            if first.photo == second.photo {
                continue;
            }
            let step =
                ((common.width() * common.height()) as f64 / PER_OVERLAP as f64).sqrt().max(0.5 * spacing).max(1.0);
            let (across, down) = ((common.width() as f64 / step) as usize, (common.height() as f64 / step) as usize);
            for y in 0..down {
                for x in 0..across {
                    let at = |first: usize, i: usize| first as f64 + (i as f64 + 0.5) * step;
                    tries.push((p, q, Point2::new(at(common.left, x).round(), at(common.top, y).round())));
                }
            }
        }
    }
    let found: Vec<Option<Tie>> = tries
        .par_iter()
        .map(|&(p, q, c)| {
            let first = patch(photos, layout, &fields[p], p, c, HALF)?;
            let least = corner_strength(&first);
            // Texture in both directions of two and a half gray levels a pixel: below that noise decides where the best place is.
            if least < 6.0 {
                return None;
            }
            let second = patch(photos, layout, &fields[q], q, c, HALF + REACH)?;
            let offset = register(&first, second)?;
            let other = c + offset;
            Some(Tie { p, q, a: c - fields[p].at(c), b: other - fields[q].at(other) })
        })
        .collect();
    found.into_iter().flatten().collect()
}

/// A placement as drawn around a canvas pixel, `2 half + 1` on a side; `None` where it is not wholly inside the photograph.
fn patch(photos: &[GrayU8], layout: &Layout, field: &Field, p: usize, c: Point2<f64>, half: usize) -> Option<Vec<f32>> {
    let placement = &layout.placements[p];
    let photo = photos.get(placement.photo)?;
    let look =
        |c: Point2<f64>| placement.view.project(&layout.surface.inverse(c - field.at(c) + placement.origin.coords));
    // Over a patch the map is as good as affine.
    let h = half as f64;
    let middle = look(c)?;
    let (right, down) = (look(c + Vector2::new(h, 0.0))?, look(c + Vector2::new(0.0, h))?);
    let (ux, uy) = ((right - middle) / h, (down - middle) / h);
    for (i, j) in [(-h, -h), (h, -h), (-h, h), (h, h)] {
        let corner = middle + ux * i + uy * j;
        let inside = corner.x >= 0.0
            && corner.y >= 0.0
            && corner.x < photo.width() as f64 - 1.0
            && corner.y < photo.height() as f64 - 1.0;
        if !inside {
            return None;
        }
    }
    let side = 2 * half + 1;
    let (width, pixels) = (photo.width(), photo.as_slice());
    let (ux, uy) = (ux.cast::<f32>(), uy.cast::<f32>());
    let mut values = Vec::with_capacity(side * side);
    for j in 0..side {
        let start = middle.cast::<f32>() + uy * (j as f32 - half as f32);
        for i in 0..side {
            let at = start + ux * (i as f32 - half as f32);
            // Rounding to single precision may reach the last column or row.
            let (x, y) = ((at.x as usize).min(width - 2), (at.y as usize).min(photo.height() - 2));
            let (fx, fy) = (at.x - x as f32, at.y - y as f32);
            let four = &pixels[y * width + x..][..width + 2];
            let [a, b, c, d] = [four[0], four[1], four[width], four[width + 1]].map(f32::from);
            let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
            values.push(top + (bottom - top) * fy);
        }
    }
    Some(values)
}

/// The lesser eigenvalue of the mean structure tensor of a patch.
fn corner_strength(patch: &[f32]) -> f32 {
    let side = 2 * HALF + 1;
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for r in 1..side - 1 {
        for c in 1..side - 1 {
            let i = r * side + c;
            let (gx, gy) = (0.5 * (patch[i + 1] - patch[i - 1]), 0.5 * (patch[i + side] - patch[i - side]));
            xx += gx * gx;
            xy += gx * gy;
            yy += gy * gy;
        }
    }
    let n = ((side - 2) * (side - 2)) as f32;
    (0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()) / n
}

/// How far the content of `first` lies from the middle of the larger `second`, by normalized correlation with a parabola at its peak; `None` where nothing is
/// alike, or two places are.
fn register(first: &[f32], mut second: Vec<f32>) -> Option<Vector2<f64>> {
    second.resize(second.len() + PAD, 0.0);
    let scores = Template::new(2 * HALF + 1, first).scores(&second);
    let (best, &score) = scores.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
    let (y, x) = (best / PLACES, best % PLACES);
    if score < 0.85 || x == 0 || y == 0 || x == PLACES - 1 || y == PLACES - 1 {
        return None;
    }
    // Repeated structure: another place that is nearly as good, not beside the best.
    let rival = scores.iter().enumerate().any(|(i, s)| {
        let far = (i / PLACES).abs_diff(y).max((i % PLACES).abs_diff(x)) > 2;
        far && *s > score - 0.05
    });
    if rival {
        return None;
    }
    let parabola = |a: f32, b: f32, c: f32| {
        let curvature = a - 2.0 * b + c;
        if curvature < 0.0 { f64::from(0.5 * (a - c) / curvature).clamp(-0.5, 0.5) } else { 0.0 }
    };
    let fx = parabola(scores[best - 1], score, scores[best + 1]);
    let fy = parabola(scores[best - PLACES], score, scores[best + PLACES]);
    Some(Vector2::new(x as f64 + fx - REACH as f64, y as f64 + fy - REACH as f64))
}
