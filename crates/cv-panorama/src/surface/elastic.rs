//! Small smooth deformations that bring photographs together where turning the camera cannot: taken by hand, near things move against far ones
//! (after Shum & Szeliski 2000, "local alignment", and Li et al. 2018, elastic warping).
//!
//! Each photograph on the canvas gets a field of displacements on a coarse grid. Tie points are to be drawn at one place; the fields are to be smooth,
//! and zero where nothing asks for more. That is linear least squares, reweighted so that false matches count little.

use crate::align::Alignment;
use crate::surface::{DisplacementField, Layout, PAD, PLACES, Placement, REACH, Surface, Template};
use cv_core::{Cancelled, GrayU8, ImageView, Point2, Progress, Stage, Vector2};
use cv_imgproc::bilinear_at;
use fearless_simd::{Level, dispatch};
use rayon::prelude::*;

/// Two placements' positions of one thing on the canvas, before anything is displaced.
#[derive(Clone, Copy)]
struct TiePoint {
    p: usize,
    q: usize,
    a: Point2<f64>,
    b: Point2<f64>,
}

/// Grid cells along the side of a photograph.
const CELLS: f64 = 24.0;
/// Weight of a difference between neighboring vertices against a tie point.
const SMOOTHNESS: f64 = 0.15;
/// Weight of a displacement itself: what one place asks for fades out over √(SMOOTHNESS / DAMPING) = 5 cells, a fifth of a photograph.
const DAMPING: f64 = 0.006;
/// Matches farther apart than this share of a photograph's side are no parallax.
const FARTHEST: f64 = 0.04;

/// Displacements for every placement.
pub(crate) fn displacements(
    photos: &[ImageView<'_, u8, 3>],
    layout: &Layout,
    alignment: &Alignment,
    progress: &dyn Progress,
) -> Result<Vec<Option<DisplacementField>>, Cancelled> {
    // A unit per photograph, and one for every solution and every registration of patches.
    let stage = Stage::new(progress, "elastic", photos.len() + 5)?;
    let side = layout.typical_side();
    let spacing = (side / CELLS).max(8.0);
    let mut fields: Vec<_> = layout.placements.iter().map(|p| DisplacementField::over(&p.bounds, spacing)).collect();
    let mut ties = feature_ties(layout, alignment, FARTHEST * side, &stage)?;
    // Feature positions are good to a pixel or so of the photographs they were found on, patches to a fraction.
    solve(&mut fields, &ties, 3.0, &stage)?;
    stage.add(1)?;
    let gray = |p: &ImageView<'_, u8, 3>| {
        let gray = cv_imgproc::rgb_to_gray(*p);
        stage.add(1).map(|()| gray)
    };
    let grays: Vec<GrayU8> = photos.par_iter().map(gray).collect::<Result<_, _>>()?;
    let mut places = patch_places(layout, spacing);
    let features = ties.len();
    // Twice: what the first round brings within reach, the second registers.
    for _ in 0..2 {
        look(&mut places, &grays, layout, &fields, &stage)?;
        ties.truncate(features);
        ties.extend(places.iter().filter_map(|place| place.tie));
        stage.add(1)?;
        solve(&mut fields, &ties, 3.0, &stage)?;
        stage.add(1)?;
    }
    for (field, placement) in fields.iter_mut().zip(&layout.placements) {
        field.update_source_shift(placement, &layout.surface);
    }
    Ok(fields.into_iter().map(Some).collect())
}

/// Where a placement draws a pixel of its photograph, before anything is displaced.
fn drawn(placement: &Placement, surface: &Surface, pixel: Point2<f64>) -> Option<Point2<f64>> {
    let mut p = surface.forward(&placement.view.ray(pixel)?)? - placement.origin.coords;
    if let Some(period) = surface.period() {
        let middle = 0.5 * (placement.bounds.left + placement.bounds.right) as f64;
        p.x -= ((p.x - middle) / period).round() * period;
    }
    Some(p)
}

/// Tie points from the matches of the alignment, without those that lie too far apart to be parallax.
fn feature_ties(
    layout: &Layout,
    alignment: &Alignment,
    farthest: f64,
    stage: &Stage<'_>,
) -> Result<Vec<TiePoint>, Cancelled> {
    let mut ties = Vec::new();
    for pair in &alignment.pairs {
        stage.check()?;
        for (p, first) in layout.placements.iter().enumerate().filter(|(_, p)| p.photo == pair.a) {
            for (q, second) in layout.placements.iter().enumerate().filter(|(_, q)| q.photo == pair.b) {
                for m in &pair.matches {
                    let (Some(a), Some(b)) = (drawn(first, &layout.surface, m.a), drawn(second, &layout.surface, m.b))
                    else {
                        continue;
                    };
                    if (a - b).norm() < farthest {
                        ties.push(TiePoint { p, q, a, b });
                    }
                }
            }
        }
    }
    Ok(ties)
}

/// Iteratively reweighted least squares, by conjugate gradients: a tie point off by `scale` pixels counts half (Cauchy's weight).
fn solve(fields: &mut [DisplacementField], ties: &[TiePoint], scale: f64, stage: &Stage<'_>) -> Result<(), Cancelled> {
    let mut offsets = vec![0];
    for f in fields.iter() {
        offsets.push(offsets[offsets.len() - 1] + f.displacement.len());
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
    let mut d: Vec<Vector2<f64>> = fields.iter().flat_map(|f| f.displacement.iter().copied()).collect();
    let left = |d: &[Vector2<f64>], t: &[(usize, f64); 8]| -> Vector2<f64> { t.iter().map(|&(i, w)| d[i] * w).sum() };
    for round in 0..5 {
        // From wide to narrow, so that no false match decides what counts as one.
        let scale = scale * f64::from(1 << (4 - round.min(4)));
        let weights: Vec<f64> =
            terms.iter().map(|(t, want)| 1.0 / (1.0 + (left(&d, t) - want).norm_squared() / (scale * scale))).collect();
        let apply = |x: &[Vector2<f64>]| {
            let mut out: Vec<Vector2<f64>> = x.iter().map(|v| v * DAMPING).collect();
            for &(i, j) in &edges {
                let pull = (x[i] - x[j]) * SMOOTHNESS;
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
        let mut diagonal = vec![DAMPING; n];
        for &(i, j) in &edges {
            diagonal[i] += SMOOTHNESS;
            diagonal[j] += SMOOTHNESS;
        }
        for ((t, want), w) in terms.iter().zip(&weights) {
            for &(i, c) in t {
                right[i] += want * (c * w);
                diagonal[i] += c * c * w;
            }
        }
        conjugate_gradients(apply, &right, &diagonal, &mut d, stage)?;
    }
    for (f, offset) in fields.iter_mut().zip(&offsets) {
        let len = f.displacement.len();
        f.displacement.copy_from_slice(&d[*offset..offset + len]);
    }
    Ok(())
}

/// Conjugate gradients with the diagonal as preconditioner, from `x` on.
fn conjugate_gradients(
    apply: impl Fn(&[Vector2<f64>]) -> Vec<Vector2<f64>>,
    right: &[Vector2<f64>],
    diagonal: &[f64],
    x: &mut [Vector2<f64>],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
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
    for iteration in 0..200 {
        // An iteration on a hundred thousand matches is some milliseconds.
        if iteration % 8 == 0 {
            stage.check()?;
        }
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
    Ok(())
}

/// Half the side of the patches that are compared.
const HALF: usize = 8;
/// Patches tried in each overlap at most.
const PER_OVERLAP: usize = 800;

/// A place where two placements are compared.
struct Place {
    p: usize,
    q: usize,
    at: Point2<f64>,
    /// What was found.
    tie: Option<TiePoint>,
    /// How far the fields had moved one against the other when it was last looked at; `None` before that.
    looked: Option<Vector2<f64>>,
    /// Whether there is nothing to compare.
    is_plain: bool,
}

/// Canvas pixels by which the fields must have moved before what was not alike is compared again: a step of the search.
const MOVED: f64 = 1.0;
/// Canvas pixels within which the fields bring a tie point together: looked at again, it would be found at the same place.
const CLOSED: f64 = 0.5;

/// Places on a grid over every overlap.
fn patch_places(layout: &Layout, spacing: f64) -> Vec<Place> {
    let mut places = Vec::new();
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
                    let at = |first: usize, i: usize| (first as f64 + (i as f64 + 0.5) * step).round();
                    let at = Point2::new(at(common.left, x), at(common.top, y));
                    places.push(Place { p, q, at, tie: None, looked: None, is_plain: false });
                }
            }
        }
    }
    places
}

/// Compares the patches of the photographs, as drawn with the fields so far, at the places where that may say something new.
fn look(
    places: &mut [Place],
    photos: &[GrayU8],
    layout: &Layout,
    fields: &[DisplacementField],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    places.par_iter_mut().enumerate().try_for_each(|(i, place)| {
        if i % 64 == 0 {
            stage.check()?;
        }
        let (p, q, c) = (place.p, place.q, place.at);
        let apart = fields[p].at(c) - fields[q].at(c);
        let is_known = match (&place.tie, place.looked) {
            _ if place.is_plain => true,
            (Some(tie), _) => (tie.a + fields[p].at(tie.a) - tie.b - fields[q].at(tie.b)).norm() < CLOSED,
            (None, Some(before)) => (apart - before).norm() < MOVED,
            (None, None) => false,
        };
        if is_known {
            return Ok(());
        }
        (place.tie, place.looked) = (None, Some(apart));
        let Some(first) = patch(photos, layout, &fields[p], p, c, HALF) else { return Ok(()) };
        // Texture in both directions of two and a half gray levels a pixel: below that noise decides where the best place is.
        place.is_plain = corner_strength(&first) < 6.0;
        if !place.is_plain
            && let Some(second) = patch(photos, layout, &fields[q], q, c, HALF + REACH)
            && let Some(offset) = register(&first, second)
        {
            let other = c + offset;
            place.tie = Some(TiePoint { p, q, a: c - fields[p].at(c), b: other - fields[q].at(other) });
        }
        Ok(())
    })
}

/// A placement as drawn around a canvas pixel, `2 half + 1` on a side; `None` where it is not wholly inside the photograph.
fn patch(
    photos: &[GrayU8],
    layout: &Layout,
    field: &DisplacementField,
    p: usize,
    c: Point2<f64>,
    half: usize,
) -> Option<Vec<f32>> {
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
    let mut values = vec![0.0; side * side];
    let (middle, ux, uy) = (middle.coords.cast::<f32>(), ux.cast::<f32>(), uy.cast::<f32>());
    let corner = middle - (ux + uy) * half as f32;
    dispatch!(Level::new(), _simd => sample_patch(photo, corner, ux, uy, &mut values));
    Some(values)
}

/// Values at the places `corner + i ux + j uy` of a square, all of which lie inside.
#[inline(always)]
fn sample_patch(photo: &GrayU8, corner: Vector2<f32>, ux: Vector2<f32>, uy: Vector2<f32>, values: &mut [f32]) {
    let (width, height) = photo.size();
    let side = values.len().isqrt();
    let (right, bottom) = ((width - 2) as f32, (height - 2) as f32);
    let view = photo.view();
    for (j, row) in values.chunks_exact_mut(side).enumerate() {
        let (u0, v0) = (corner.x + uy.x * j as f32, corner.y + uy.y * j as f32);
        for (i, value) in row.iter_mut().enumerate() {
            let (u, v) = (u0 + ux.x * i as f32, v0 + ux.y * i as f32);
            // Rounding to single precision may reach the last column or row.
            let (x, y) = (u.min(right) as usize, v.min(bottom) as usize);
            [*value] = bilinear_at(view, x, y, u - x as f32, v - y as f32);
        }
    }
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::{CameraMotion, View};
    use crate::surface::{Framing, PhotoMap, Projection, layout};
    use crate::testing::{StopAt, photograph, sky, stage};
    use cv_core::{Camera, Correspondence, Silent, Vector3};
    use nalgebra::{DMatrix, DVector, Rotation3};

    fn view(yaw: f64) -> View {
        let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
        View { camera: Camera::from_focal(240, 180, 260.0), from_world: turn.into_inner() }
    }

    fn alignment(views: &[View]) -> Alignment {
        Alignment {
            views: views.iter().map(|v| Ok(*v)).collect(),
            reference: 0,
            motion: CameraMotion::Rotation,
            pairs: Vec::new(),
            rms_px: 0.0,
            median_px: 0.0,
        }
    }

    /// By how many pixels the second photograph is bent: what it shows at `p` belongs to `p + bend(p)`.
    fn bend(p: Point2<f64>) -> Vector2<f64> {
        Vector2::new(2.5 * (p.y / 40.0).sin(), 2.0 * (p.x / 50.0).cos())
    }

    /// Root mean square distance, over the overlap, between the places of one direction in the second photograph: as the map says and as the bend is.
    fn misfit(map: &PhotoMap, views: &[View], size: (usize, usize)) -> f64 {
        let (mut sum, mut n) = (0.0, 0.0);
        for (x, y) in (0..size.1).step_by(5).flat_map(|y| (0..size.0).step_by(5).map(move |x| (x, y))) {
            let c = Point2::new(x as f64, y as f64);
            let (Some(a), Some(b)) = (map.source(0, c), map.source(1, c)) else { continue };
            // Patches of a radius of 8 pixels end that far from the border.
            let inner = |p: Point2<f64>| p.x > 20.0 && p.y > 20.0 && p.x < 220.0 && p.y < 160.0;
            if inner(a) && inner(b) {
                let truth = views[1].project(&views[0].ray(a).unwrap()).unwrap();
                sum += (b + bend(b) - truth).norm_squared();
                n += 1.0;
            }
        }
        assert!(n > 200.0);
        (sum / n).sqrt()
    }

    #[test]
    fn a_bent_photograph_is_brought_to_where_the_other_shows_the_same() {
        let views = [view(-0.2), view(0.2)];
        let first = photograph(&views[0], sky);
        let second = cv_core::RgbU8::from_fn(240, 180, |x, y| {
            let p = Point2::new(x as f64, y as f64);
            sky(&views[1].ray(p + bend(p)).unwrap()).map(|v| v.round() as u8)
        });
        let alignment = alignment(&views);
        let layout = layout(&alignment, Projection::Cylindrical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let photos = [first.view(), second.view()];
        let fields = displacements(&photos, &layout, &alignment, &Silent).unwrap();
        let size = (layout.width, layout.height);
        let before = misfit(&PhotoMap::new(&layout, vec![None, None]), &views, size);
        let after = misfit(&PhotoMap::new(&layout, fields), &views, size);
        // The bend is 2.3 px (RMS); a grid of 10 px with smoothing over 5 cells follows waves of 250 px to a tenth of their height or so.
        assert!(before > 1.8 && after < 0.45, "{before} {after}");
        // Stopped at any report, in any of its parts, it is stopped.
        let watched = StopAt::never();
        displacements(&photos, &layout, &alignment, &watched).unwrap();
        for at in (1..=watched.reports()).step_by(watched.reports().div_ceil(12)) {
            let stop = StopAt::report(at);
            assert!(displacements(&photos, &layout, &alignment, &stop).is_err(), "{at}");
        }
    }

    #[test]
    fn photographs_that_fit_are_left_as_they_are() {
        let views = [view(-0.2), view(0.2)];
        let photos = [photograph(&views[0], sky), photograph(&views[1], sky)];
        let alignment = alignment(&views);
        let layout = layout(&alignment, Projection::Cylindrical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let fields = displacements(&[photos[0].view(), photos[1].view()], &layout, &alignment, &Silent).unwrap();
        for field in fields.iter().flatten() {
            // What registering patches of rounded gray levels is good to.
            assert!(field.displacement.iter().all(|d| d.norm() < 0.1), "{:?}", field.displacement);
        }
    }

    #[test]
    fn matches_become_tie_points_unless_they_lie_too_far_apart() {
        let views = [view(-0.2), view(0.2)];
        let mut set = alignment(&views);
        let ray = Vector3::new(0.05, 0.1, 1.0);
        let [a, b] = [0, 1].map(|i| views[i].project(&ray).unwrap());
        let matches = vec![Correspondence { a, b }, Correspondence { a, b: b + Vector2::new(30.0, 0.0) }];
        set.pairs = vec![crate::AlignedPair { a: 0, b: 1, inliers: vec![0, 1], matches, rms_px: 0.0 }];
        let layout = layout(&set, Projection::Spherical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let ties = feature_ties(&layout, &set, 10.0, &stage()).unwrap();
        assert_eq!(ties.len(), 1);
        // One direction is drawn at one place.
        assert!((ties[0].a - ties[0].b).norm() < 1e-9 && (ties[0].p, ties[0].q) == (0, 1));
        assert_eq!(feature_ties(&layout, &set, 40.0, &stage()).unwrap().len(), 2);
    }

    #[test]
    fn conjugate_gradients_find_the_direct_solution() {
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
        let apply = |x: &[Vector2<f64>]| -> Vec<Vector2<f64>> {
            (0..n).map(|i| (0..n).map(|j| x[j] * matrix[(i, j)]).sum()).collect()
        };
        let diagonal: Vec<f64> = (0..n).map(|i| matrix[(i, i)]).collect();
        let mut x = vec![Vector2::new(0.5, -0.5); n];
        conjugate_gradients(apply, &right, &diagonal, &mut x, &stage()).unwrap();
        for axis in 0..2 {
            let b = DVector::from_iterator(n, right.iter().map(|r| r[axis]));
            let direct = matrix.clone().cholesky().unwrap().solve(&b);
            for i in 0..n {
                // Stops at 1e-4 of the right side in the norm of the matrix, whose least eigenvalue is 0.3.
                assert!((x[i][axis] - direct[i]).abs() < 1e-3 * direct.amax(), "{i}");
            }
        }
    }

    #[test]
    fn a_patch_is_registered_to_a_fraction_of_a_pixel() {
        let value =
            |x: f64, y: f64| (128.0 + 50.0 * (x * 0.4 + y * 0.1).sin() + 40.0 * (y * 0.35 - x * 0.07).cos()) as f32;
        let patch = |half: usize, at: Vector2<f64>| -> Vec<f32> {
            let h = half as i32;
            let rows = (-h..=h).flat_map(|j| (-h..=h).map(move |i| (i, j)));
            rows.map(|(i, j)| value(f64::from(i) + at.x, f64::from(j) + at.y)).collect()
        };
        let first = patch(HALF, Vector2::zeros());
        for offset in [Vector2::new(0.0, 0.0), Vector2::new(3.3, -2.6), Vector2::new(-4.5, 1.2)] {
            // The content of the first lies at `offset` in the second.
            let found = register(&first, patch(HALF + REACH, -offset)).unwrap();
            // A patch is about one wave long, so its mean and energy change with its place: that moves the peak by a tenth or two.
            assert!((found - offset).norm() < 0.2, "{found} {offset}");
        }
        // Where nothing is alike.
        let side = 2 * (HALF + REACH) + 1;
        assert_eq!(register(&first, vec![128.0; side * side]), None);
        assert!(corner_strength(&first) > 6.0);
        // One direction only: the lesser eigenvalue of the structure tensor is zero.
        let edge: Vec<f32> = (0..17 * 17).map(|i| if i % 17 < 8 { 10.0 } else { 200.0 }).collect();
        assert!(corner_strength(&edge).abs() < 1e-2);
    }
}
