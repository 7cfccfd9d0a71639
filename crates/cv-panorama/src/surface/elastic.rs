//! Local alignment: smooth displacement fields that compensate small parallax (after Shum & Szeliski 2000, "local alignment", and Li et al. 2018,
//! elastic warping).
//!
//! Each photograph on the canvas has a displacement field on a coarse grid. The energy has a data term (tie points coincide), a smoothness term and a
//! damping term (zero displacement without data); it is minimized by iteratively reweighted least squares. After the seams are found, the breaks of objects at
//! them are closed on a finer grid (see `seams::breaks`).

use crate::align::Alignment;
use crate::masks::{PhotoMask, is_removed, is_removed_near};
use crate::surface::correlation::AMBIGUITY;
use crate::surface::structure_tensor::StructureTensor;
use crate::surface::tie_points::{TiePoint, solve};
use crate::surface::{
    DisplacementField, Layout, PAD, Placement, SEARCH_RADIUS, SEARCH_SIDE, Surface, Template, parabola_peak,
    score_maximum,
};
use cv_core::{Cancelled, GrayU8, ImageView, Point2, Progress, Scaling, Stage, Vector2};
use cv_imgproc::{SAMPLE_LANES, bilinear_lanes};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch};
use std::ops::Deref;

/// Grid cells along the side of a photograph.
const CELLS: f64 = 24.0;
/// Weight of the damping term: a displacement decays over the root of the ratio to the weight of smoothness, 5 cells, a fifth of a photograph.
const DAMPING: f64 = 0.006;
/// Scale of the robust loss in canvas pixels: feature positions have errors of up to a pixel, registered patches of a fraction.
const LOSS_SCALE: f64 = 3.0;
/// How much finer the grid is on which the breaks at seams are closed.
const REFINEMENT: f64 = 2.0;
/// Displacement in canvas pixels up to which a photograph counts as not displaced: invisible.
const NO_DISPLACEMENT_PX: f64 = 0.05;
/// Maximum displacement of a tie point relative to the side of a photograph; larger ones are outliers.
const MAX_DISPLACEMENT_RATIO: f64 = 0.04;

/// Estimates the displacement field of every placement.
pub(crate) fn displacements(
    photos: &[ImageView<'_, u8, 3>],
    masks: &[Option<&PhotoMask>],
    layout: &Layout,
    alignment: &Alignment,
    progress: &dyn Progress,
) -> Result<Vec<Option<DisplacementField>>, Cancelled> {
    let stage = Stage::new(progress, "elastic", photos.len() + ROUND_UNITS)?;
    let gray = |p: &ImageView<'_, u8, 3>| {
        let gray = cv_imgproc::rgb_to_gray(*p);
        stage.add(1).map(|()| gray)
    };
    let grays: Vec<GrayU8> = photos.par_iter().map(gray).try_collect()?;
    displacements_with(&|photo| Ok::<_, Cancelled>(&grays[photo]), masks, layout, alignment, &stage)
}

/// Units of progress of [`displacements_with`]: one for every solution and every round of patch registration.
pub(crate) const ROUND_UNITS: usize = 5;

/// As [`displacements`], with the gray image of a photograph loaded by `gray` for each overlap, twice.
///
/// # Errors
/// [`Cancelled`], and errors of `gray`.
pub(crate) fn displacements_with<G, E>(
    gray: &(impl Fn(usize) -> Result<G, E> + Sync),
    masks: &[Option<&PhotoMask>],
    layout: &Layout,
    alignment: &Alignment,
    stage: &Stage<'_>,
) -> Result<Vec<Option<DisplacementField>>, E>
where
    G: Deref<Target = GrayU8> + Sync,
    E: From<Cancelled> + Send,
{
    let spacing = grid_spacing(layout);
    let mut fields: Vec<_> = layout.placements.iter().map(|p| DisplacementField::over(&p.bounds, spacing)).collect();
    let mut ties = feature_ties(layout, alignment, max_displacement(layout), stage)?;
    ties.retain(|t| !is_removed(masks, layout, t.p, t.a) && !is_removed(masks, layout, t.q, t.b));
    let continuity = border_ties(layout, spacing);
    solve(&mut fields, &ties, &continuity, DAMPING, LOSS_SCALE, stage)?;
    stage.add(1)?;
    let mut sites = patch_sites(layout, spacing);
    sites.retain(|site| ![site.p, site.q].iter().any(|&k| is_removed_near(masks, layout, k, site.at, WINDOW_RADIUS)));
    let features = ties.len();
    // The first round brings more patches within the search range of the second.
    for _ in 0..2 {
        register_patches(&mut sites, gray, layout, &fields, stage)?;
        ties.truncate(features);
        ties.extend(sites.iter().filter_map(|site| site.tie));
        stage.add(1)?;
        solve(&mut fields, &ties, &continuity, DAMPING, LOSS_SCALE, stage)?;
        stage.add(1)?;
    }
    for (field, placement) in fields.iter_mut().zip(&layout.placements) {
        field.update_source_shift(placement, &layout.surface);
    }
    Ok(fields.into_iter().map(Some).collect())
}

/// Returns the distance between vertices of the grid, in canvas pixels.
fn grid_spacing(layout: &Layout) -> f64 {
    (layout.typical_side() / CELLS).max(8.0)
}

/// Returns the maximum displacement between two photographs, in canvas pixels.
pub(crate) fn max_displacement(layout: &Layout) -> f64 {
    MAX_DISPLACEMENT_RATIO * layout.typical_side()
}

/// A correspondence across a seam, in preview pixels: at `at`, the content of placement `q` is this far off that of `p`.
pub(crate) struct SeamTie {
    pub(crate) p: usize,
    pub(crate) q: usize,
    pub(crate) at: Point2<f64>,
    pub(crate) displacement: Vector2<f64>,
}

/// Returns the displacement fields that also close the breaks of objects at the seams: nearer objects are displaced towards each other on both sides of a seam, which fades away from it. `step` is that of
/// the preview.
pub(crate) fn close_breaks(
    fields: &[Option<DisplacementField>],
    ties: &[SeamTie],
    step: usize,
    layout: &Layout,
    stage: &Stage<'_>,
) -> Result<Vec<Option<DisplacementField>>, Cancelled> {
    // A finer grid: objects are narrower than the overlap.
    let spacing = grid_spacing(layout) / REFINEMENT;
    let mut closing: Vec<_> = layout.placements.iter().map(|p| DisplacementField::over(&p.bounds, spacing)).collect();
    let scale = step as f64;
    let tie = |tie: &SeamTie| {
        let at = Scaling::uniform(scale).point(tie.at);
        TiePoint { p: tie.p, q: tie.q, a: at, b: at, difference: tie.displacement * scale, normal: None }
    };
    let ties: Vec<TiePoint> = ties.iter().map(tie).collect();
    // The same decay as that of the coarser grid.
    let damping = DAMPING / (REFINEMENT * REFINEMENT);
    solve(&mut closing, &ties, &border_ties(layout, spacing), damping, f64::INFINITY, stage)?;
    let both = |((closing, before), placement): ((DisplacementField, &Option<DisplacementField>), &Placement)| {
        if closing.displacement.iter().all(|d| d.amax() < NO_DISPLACEMENT_PX) {
            return before.clone();
        }
        let mut field = closing.after(before.as_ref());
        field.update_source_shift(placement, &layout.surface);
        Some(field)
    };
    Ok(closing.into_iter().zip(fields).zip(&layout.placements).map(both).collect())
}

/// Maps a pixel of a photograph to the canvas, before displacement.
fn to_canvas(placement: &Placement, surface: &Surface, pixel: Point2<f64>) -> Option<Point2<f64>> {
    let mut p = surface.forward(&placement.view.ray(pixel)?)? - placement.origin.coords;
    if let Some(period) = surface.period() {
        let middle = 0.5 * (placement.bounds.left + placement.bounds.right) as f64;
        p.x -= ((p.x - middle) / period).round() * period;
    }
    Some(p)
}

/// Returns tie points from the matches of the alignment, without outliers.
fn feature_ties(
    layout: &Layout,
    alignment: &Alignment,
    max_displacement: f64,
    stage: &Stage<'_>,
) -> Result<Vec<TiePoint>, Cancelled> {
    let mut ties = Vec::new();
    for pair in &alignment.pairs {
        stage.check()?;
        for (p, first) in layout.placements.iter().enumerate().filter(|(_, p)| p.photo == pair.a) {
            for (q, second) in layout.placements.iter().enumerate().filter(|(_, q)| q.photo == pair.b) {
                for m in &pair.matches {
                    let (Some(a), Some(b)) =
                        (to_canvas(first, &layout.surface, m.a), to_canvas(second, &layout.surface, m.b))
                    else {
                        continue;
                    };
                    if (a - b).norm() < max_displacement {
                        ties.push(TiePoint::point(p, q, a, b, None));
                    }
                }
            }
        }
    }
    Ok(ties)
}

/// Returns positions along the border of a canvas that spans 360°, on both sides of it, of the photographs across it. Both sides have the same displacement there, in two placements of the photograph or, if it shows a pole, in one.
fn border_ties(layout: &Layout, spacing: f64) -> Vec<TiePoint> {
    let Some(period) = layout.surface.period().filter(|_| layout.full_circle) else { return Vec::new() };
    let mut ties = Vec::new();
    for (p, left) in layout.placements.iter().enumerate().filter(|(_, p)| p.bounds.left == 0) {
        let beyond = |q: &Placement| q.photo == left.photo && q.bounds.right == layout.width;
        for (q, right) in layout.placements.iter().enumerate().filter(|(_, q)| beyond(q)) {
            let rows = left.bounds.top.max(right.bounds.top)..left.bounds.bottom.min(right.bounds.bottom);
            for y in rows.step_by(spacing as usize) {
                // The border is half a pixel left of the center of the first column.
                let a = Point2::new(-0.5, y as f64);
                let b = a + Vector2::new(period, 0.0);
                ties.push(TiePoint { p, q, a, b, difference: Vector2::zeros(), normal: None });
            }
        }
    }
    ties
}

/// Patch radius in canvas pixels.
const PATCH_RADIUS: usize = 8;
/// Radius in canvas pixels of what is compared with a patch.
const WINDOW_RADIUS: usize = PATCH_RADIUS + SEARCH_RADIUS;
/// Maximum number of patches per overlap.
const MAX_PATCHES: usize = 800;

/// A canvas position where the patches of two placements are registered.
struct PatchSite {
    p: usize,
    q: usize,
    at: Point2<f64>,
    /// The correspondence, where registration succeeded.
    tie: Option<TiePoint>,
    /// Relative displacement of the two fields at the last registration; `None` before the first.
    registered_at: Option<Vector2<f64>>,
    /// Whether the texture is too low for registration.
    is_low_texture: bool,
}

/// Minimum smaller eigenvalue of the structure tensor of a corner: gradients of 2.5 gray levels per pixel in both directions; noise dominates below.
const MIN_CORNER_STRENGTH: f32 = 6.0;

/// Relative displacement of the fields, in canvas pixels, after which a failed registration is repeated.
const MIN_FIELD_CHANGE_PX: f64 = 1.0;
/// Residual of a tie point, in canvas pixels, below which its registration is not repeated.
const CONVERGED_PX: f64 = 0.5;

/// Returns a grid of patch positions over every overlap.
fn patch_sites(layout: &Layout, spacing: f64) -> Vec<PatchSite> {
    let mut sites = Vec::new();
    for (p, first) in layout.placements.iter().enumerate() {
        for (q, second) in layout.placements.iter().enumerate().skip(p + 1) {
            let Some(common) = first.bounds.intersection(&second.bounds) else { continue };
            if first.photo == second.photo {
                continue;
            }
            let step =
                ((common.width() * common.height()) as f64 / MAX_PATCHES as f64).sqrt().max(0.5 * spacing).max(1.0);
            let (across, down) = ((common.width() as f64 / step) as usize, (common.height() as f64 / step) as usize);
            for y in 0..down {
                for x in 0..across {
                    let at = |first: usize, i: usize| (first as f64 + (i as f64 + 0.5) * step).round();
                    let at = Point2::new(at(common.left, x), at(common.top, y));
                    sites.push(PatchSite { p, q, at, tie: None, registered_at: None, is_low_texture: false });
                }
            }
        }
    }
    sites
}

/// Registers the patches at all sites, warped with the current fields, where the result may differ from the last one.
fn register_patches<G, E>(
    sites: &mut [PatchSite],
    gray: &(impl Fn(usize) -> Result<G, E> + Sync),
    layout: &Layout,
    fields: &[DisplacementField],
    stage: &Stage<'_>,
) -> Result<(), E>
where
    G: Deref<Target = GrayU8> + Sync,
    E: From<Cancelled> + Send,
{
    let overlaps: Vec<&mut [PatchSite]> = sites.chunk_by_mut(|a, b| (a.p, a.q) == (b.p, b.q)).collect();
    overlaps.into_par_iter().try_for_each(|overlap| {
        let Some(site) = overlap.first() else { return Ok(()) };
        let photo = |k: usize| gray(layout.placements[k].photo);
        let (first, second) = (photo(site.p)?, photo(site.q)?);
        register_overlap(overlap, [&*first, &*second], layout, fields, stage).map_err(E::from)
    })
}

/// Registers the patches of one overlap; `photos` are those of the two placements.
fn register_overlap(
    sites: &mut [PatchSite],
    photos: [&GrayU8; 2],
    layout: &Layout,
    fields: &[DisplacementField],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    sites.par_iter_mut().enumerate().try_for_each(|(i, site)| {
        if i % 64 == 0 {
            stage.check()?;
        }
        let (p, q, c) = (site.p, site.q, site.at);
        let apart = fields[p].at(c) - fields[q].at(c);
        let is_known = match (&site.tie, site.registered_at) {
            _ if site.is_low_texture => true,
            (Some(tie), _) => {
                let residual = tie.a + fields[p].at(tie.a) - tie.b - fields[q].at(tie.b);
                TiePoint::measured(tie.normal, residual).norm() < CONVERGED_PX
            }
            (None, Some(before)) => (apart - before).norm() < MIN_FIELD_CHANGE_PX,
            (None, None) => false,
        };
        if is_known {
            return Ok(());
        }
        (site.tie, site.registered_at) = (None, Some(apart));
        let sample = |side: usize, axis: Vector2<f64>, along: usize, across: usize| {
            let k = [p, q][side];
            patch(photos[side], layout, &fields[k], k, c, axis, (along, across))
        };
        let (wide, right) = (WINDOW_RADIUS, Vector2::x());
        let Some(first) = sample(0, right, PATCH_RADIUS, PATCH_RADIUS) else { return Ok(()) };
        let tensor = StructureTensor::of(&first);
        site.is_low_texture = tensor.strengths[1] < MIN_CORNER_STRENGTH && !tensor.is_edge();
        let tie = |offset: Vector2<f64>, normal: Option<Vector2<f64>>| {
            let other = c + offset;
            TiePoint::point(p, q, c - fields[p].at(c), other - fields[q].at(other), normal)
        };
        if tensor.strengths[1] >= MIN_CORNER_STRENGTH
            && let Some(second) = sample(1, right, wide, wide)
            && let Some(offset) = register(&first, second)
        {
            site.tie = Some(tie(offset, None));
        } else if tensor.is_edge()
            && let Some(first) = sample(0, tensor.normal, PATCH_RADIUS, PATCH_RADIUS)
            && let Some(second) = sample(1, tensor.normal, wide, PATCH_RADIUS)
            && let Some(offset) = register_edge(&first, &second)
        {
            site.tie = Some(tie(tensor.normal * offset, Some(tensor.normal)));
        }
        Ok(())
    })
}

/// Samples a placement around a canvas pixel in rows along a unit vector, of sides `2 along + 1` and `2 across + 1`; `None` where the patch is not completely inside the photograph.
fn patch(
    photo: &GrayU8,
    layout: &Layout,
    field: &DisplacementField,
    p: usize,
    c: Point2<f64>,
    axis: Vector2<f64>,
    (along, across): (usize, usize),
) -> Option<Vec<f32>> {
    let placement = &layout.placements[p];
    let to_pixel =
        |c: Point2<f64>| placement.view.project(&layout.surface.inverse(c - field.at(c) + placement.origin.coords));
    // The map is affine to first order over a patch.
    let (w, h) = (along as f64, across as f64);
    let middle = to_pixel(c)?;
    let (right, down) = (to_pixel(c + axis * w)?, to_pixel(c + Vector2::new(-axis.y, axis.x) * h)?);
    let (ux, uy) = ((right - middle) / w, (down - middle) / h);
    for (i, j) in [(-w, -h), (w, -h), (-w, h), (w, h)] {
        let corner = middle + ux * i + uy * j;
        let inside = corner.x >= 0.0
            && corner.y >= 0.0
            && corner.x < photo.width() as f64 - 1.0
            && corner.y < photo.height() as f64 - 1.0;
        if !inside {
            return None;
        }
    }
    let side = 2 * along + 1;
    let mut values = vec![0.0; side * (2 * across + 1)];
    let (middle, ux, uy) = (middle.coords.cast::<f32>(), ux.cast::<f32>(), uy.cast::<f32>());
    let corner = middle - ux * along as f32 - uy * across as f32;
    dispatch!(Level::new(), _simd => sample_patch(photo, corner, ux, uy, side, &mut values));
    Some(values)
}

/// Samples the positions `corner + i ux + j uy` of a rectangle, `side` wide, inside the image.
#[inline(always)]
fn sample_patch(
    photo: &GrayU8,
    corner: Vector2<f32>,
    ux: Vector2<f32>,
    uy: Vector2<f32>,
    side: usize,
    values: &mut [f32],
) {
    let (mut us, mut vs) = ([0.0_f32; SAMPLE_LANES], [0.0_f32; SAMPLE_LANES]);
    for (j, row) in values.chunks_exact_mut(side).enumerate() {
        let (u0, v0) = (corner.x + uy.x * j as f32, corner.y + uy.y * j as f32);
        for (first, values) in (0..).step_by(SAMPLE_LANES).zip(row.chunks_mut(SAMPLE_LANES)) {
            for k in 0..SAMPLE_LANES {
                let i = (first + k as i32) as f32;
                (us[k], vs[k]) = (u0 + ux.x * i, v0 + ux.y * i);
            }
            values.copy_from_slice(&bilinear_lanes(photo, &us, &vs)[..values.len()]);
        }
    }
}

/// Minimum correlation of registered profiles: means along the edge, whose noise is a quarter of that of a pixel.
const MIN_PROFILE_CORRELATION: f32 = 0.9;

/// Estimates the displacement across an edge: `first` and the longer `second` have their rows across it, whose means are correlated. `None` for a low or ambiguous maximum.
fn register_edge(first: &[f32], second: &[f32]) -> Option<f64> {
    const SIDE: usize = 2 * PATCH_RADIUS + 1;
    const WIDE: usize = SIDE + 2 * SEARCH_RADIUS;
    let (mut ours, mut theirs) = ([0.0_f32; SIDE], [0.0_f32; WIDE]);
    for row in first.as_chunks::<SIDE>().0 {
        ours.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
    }
    for row in second.as_chunks::<WIDE>().0 {
        theirs.iter_mut().zip(row).for_each(|(sum, v)| *sum += v);
    }
    let centered = |values: &[f32]| -> ([f32; SIDE], f32) {
        let mean = values.iter().sum::<f32>() / SIDE as f32;
        let centered: [f32; SIDE] = std::array::from_fn(|i| values[i] - mean);
        (centered, centered.iter().map(|v| v * v).sum())
    };
    let (ours, energy) = centered(&ours);
    let scores: [f32; SEARCH_SIDE] = std::array::from_fn(|shift| {
        let (theirs, other) = centered(&theirs[shift..shift + SIDE]);
        ours.iter().zip(theirs).map(|(a, b)| a * b).sum::<f32>() / (energy * other).sqrt().max(1e-3)
    });
    let (best, &score) = scores.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1))?;
    if score.is_nan() || score < MIN_PROFILE_CORRELATION || best == 0 || best == SEARCH_SIDE - 1 {
        return None;
    }
    if scores.iter().enumerate().any(|(i, s)| i.abs_diff(best) > 2 && *s > score - AMBIGUITY) {
        return None;
    }
    Some(best as f64 + parabola_peak(scores[best - 1], score, scores[best + 1]) - SEARCH_RADIUS as f64)
}

/// Minimum correlation of registered patches.
const MIN_CORRELATION: f32 = 0.85;

/// Estimates the displacement of `first` in the larger window `second` by normalized cross-correlation with parabolic sub-pixel interpolation; `None` for a low
/// or ambiguous maximum.
fn register(first: &[f32], mut second: Vec<f32>) -> Option<Vector2<f64>> {
    second.resize(second.len() + PAD, 0.0);
    let scores = Template::new(2 * PATCH_RADIUS + 1, first).scores(&second);
    score_maximum(&scores, SEARCH_SIDE, MIN_CORRELATION)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::{CameraMotion, View};
    use crate::surface::{Bounds, Framing, PhotoMap, Projection, layout};
    use crate::testing::{StopAt, photograph, sky, stage};
    use cv_core::{Camera, Correspondence, Silent, Vector3};
    use nalgebra::Rotation3;

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

    /// Known deformation of the second photograph: pixel `p` shows the ray of `p + bend(p)`.
    fn bend(p: Point2<f64>) -> Vector2<f64> {
        Vector2::new(2.5 * (p.y / 40.0).sin(), 2.0 * (p.x / 50.0).cos())
    }

    /// RMS error, over the overlap, of the map against the known deformation of the second photograph.
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
    fn a_deformed_photograph_is_aligned_with_the_other() {
        let views = [view(-0.2), view(0.2)];
        let first = photograph(&views[0], sky);
        let second = cv_core::RgbU8::from_fn(240, 180, |x, y| {
            let p = Point2::new(x as f64, y as f64);
            sky(&views[1].ray(p + bend(p)).unwrap()).map(|v| v.round() as u8)
        });
        let alignment = alignment(&views);
        let layout = layout(&alignment, Projection::Cylindrical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let photos = [first.view(), second.view()];
        let fields = displacements(&photos, &[], &layout, &alignment, &Silent).unwrap();
        let size = (layout.width, layout.height);
        let before = misfit(&PhotoMap::new(&layout, vec![None, None]), &views, size);
        let after = misfit(&PhotoMap::new(&layout, fields), &views, size);
        // The bend is 2.3 px (RMS); a grid of 10 px with smoothing over 5 cells follows waves of 250 px to a tenth of their height or so.
        assert!(before > 1.8 && after < 0.45, "{before} {after}");
        // Stopped at any report, in any of its parts, it is stopped.
        let watched = StopAt::never();
        displacements(&photos, &[], &layout, &alignment, &watched).unwrap();
        for at in (1..=watched.reports()).step_by(watched.reports().div_ceil(12)) {
            let stop = StopAt::report(at);
            assert!(displacements(&photos, &[], &layout, &alignment, &stop).is_err(), "{at}");
        }
    }

    #[test]
    fn aligned_photographs_are_not_displaced() {
        let views = [view(-0.2), view(0.2)];
        let photos = [photograph(&views[0], sky), photograph(&views[1], sky)];
        let alignment = alignment(&views);
        let layout = layout(&alignment, Projection::Cylindrical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let fields = displacements(&[photos[0].view(), photos[1].view()], &[], &layout, &alignment, &Silent).unwrap();
        for field in fields.iter().flatten() {
            // The accuracy of patch registration with gray levels rounded to integers.
            assert!(field.displacement.iter().all(|d| d.norm() < 0.1), "{:?}", field.displacement);
        }
    }

    #[test]
    fn a_break_is_closed_beside_the_seam_and_after_the_displacement_before() {
        let views = [view(-0.2), view(0.2)];
        let layout = layout(&alignment(&views), Projection::Cylindrical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let common = layout.placements[0].bounds.intersection(&layout.placements[1].bounds).unwrap();
        let middle = Point2::new(0.5 * (common.left + common.right) as f64, 0.5 * (common.top + common.bottom) as f64);
        // A seam along a row, on a preview of half the size: an object 40 px wide is displaced by 8 and −2 px, beyond 10 px beside it nothing.
        let off = Vector2::new(4.0, -1.0);
        let tie = |x: f64, displacement| {
            let at = Scaling::uniform(0.5).point(middle + Vector2::new(x, 0.0));
            SeamTie { p: 0, q: 1, at, displacement }
        };
        let object = (-10..=10).map(|i| tie(2.0 * f64::from(i), off));
        let beside = (15..25)
            .flat_map(|i| [tie(2.0 * f64::from(i), Vector2::zeros()), tie(-2.0 * f64::from(i), Vector2::zeros())]);
        let ties: Vec<SeamTie> = object.chain(beside).collect();
        let mut before: Vec<Option<DisplacementField>> =
            layout.placements.iter().map(|p| Some(DisplacementField::over(&p.bounds, 9.0))).collect();
        let constant = Vector2::new(1.5, 0.5);
        before[0].as_mut().unwrap().displacement.fill(constant);
        let fields = close_breaks(&before, &ties, 2, &layout, &stage()).unwrap();
        let difference =
            |at: Point2<f64>| fields[0].as_ref().unwrap().at(at) - constant - fields[1].as_ref().unwrap().at(at);
        // Smoothness takes a tenth of a step between objects a grid cell or two apart.
        assert!((difference(middle) - 2.0 * off).norm() < 0.8, "{}", difference(middle));
        for x in [-45.0, 45.0] {
            assert!(difference(middle + Vector2::new(x, 0.0)).norm() < 0.8, "{x}");
        }
        for y in [-75.0, 75.0] {
            // Two distances of decay away.
            assert!(difference(middle + Vector2::new(0.0, y)).norm() < off.norm(), "{y}");
        }
    }

    #[test]
    fn matches_become_tie_points_up_to_the_maximum_displacement() {
        let views = [view(-0.2), view(0.2)];
        let mut set = alignment(&views);
        let ray = Vector3::new(0.05, 0.1, 1.0);
        let [a, b] = [0, 1].map(|i| views[i].project(&ray).unwrap());
        let matches = vec![Correspondence { a, b }, Correspondence { a, b: b + Vector2::new(30.0, 0.0) }];
        set.pairs = vec![crate::AlignedPair { a: 0, b: 1, inliers: vec![0, 1], matches, rms_px: 0.0 }];
        let layout = layout(&set, Projection::Spherical, &Framing::default(), 1.0, 1_000_000).unwrap();
        let ties = feature_ties(&layout, &set, 10.0, &stage()).unwrap();
        assert_eq!(ties.len(), 1);
        // A direction maps to one canvas position.
        assert!((ties[0].a - ties[0].b).norm() < 1e-9 && (ties[0].p, ties[0].q) == (0, 1));
        assert_eq!(feature_ties(&layout, &set, 40.0, &stage()).unwrap().len(), 2);
    }

    #[test]
    fn a_patch_is_registered_to_a_fraction_of_a_pixel() {
        let value =
            |x: f64, y: f64| (128.0 + 50.0 * (x * 0.4 + y * 0.1).sin() + 40.0 * (y * 0.35 - x * 0.07).cos()) as f32;
        let patch = |radius: usize, at: Vector2<f64>| -> Vec<f32> {
            let h = radius as i32;
            let rows = (-h..=h).flat_map(|j| (-h..=h).map(move |i| (i, j)));
            rows.map(|(i, j)| value(f64::from(i) + at.x, f64::from(j) + at.y)).collect()
        };
        let first = patch(PATCH_RADIUS, Vector2::zeros());
        for offset in [Vector2::new(0.0, 0.0), Vector2::new(3.3, -2.6), Vector2::new(-4.5, 1.2)] {
            // The content of the first patch is at `offset` in the second.
            let found = register(&first, patch(PATCH_RADIUS + SEARCH_RADIUS, -offset)).unwrap();
            // A patch is about one wave long, so its mean and energy change with its position: that moves the peak by a tenth or two.
            assert!((found - offset).norm() < 0.2, "{found} {offset}");
        }
        // Unrelated patches.
        let side = 2 * (PATCH_RADIUS + SEARCH_RADIUS) + 1;
        assert_eq!(register(&first, vec![128.0; side * side]), None);
        assert!(StructureTensor::of(&first).strengths[1] > MIN_CORNER_STRENGTH);
        // One direction only: the smaller eigenvalue of the structure tensor is zero.
        let edge: Vec<f32> = (0..17 * 17).map(|i| if i % 17 < 8 { 10.0 } else { 200.0 }).collect();
        let tensor = StructureTensor::of(&edge);
        assert!(tensor.strengths[1].abs() < 1e-2 && tensor.is_edge() && (tensor.normal.x.abs() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_photograph_across_the_border_of_a_full_circle_continues_there() {
        let views: Vec<View> = (0..12).map(|k| view(f64::from(k) * std::f64::consts::PI / 6.0)).collect();
        let layout = layout(&alignment(&views), Projection::Cylindrical, &Framing::default(), 1.0, 1_000_000).unwrap();
        assert!(layout.full_circle);
        let continuity = border_ties(&layout, 10.0);
        // Rows 10 px apart of at least one photograph 180 px high.
        assert!(continuity.len() > 12, "{}", continuity.len());
        for tie in &continuity {
            assert_eq!(layout.placements[tie.p].photo, layout.placements[tie.q].photo);
        }
        // In the overlap with its neighbor the content of the photograph on the left is displaced.
        let left = continuity[0].p;
        let overlap = |k: usize| layout.placements[left].bounds.intersection(&layout.placements[k].bounds);
        let found = (0..layout.placements.len()).find_map(|k| Some((k, overlap(k).filter(|_| k != left)?)));
        let (other, common) = found.unwrap();
        let rows = (common.top + 10..common.bottom - 10).step_by(10);
        let ties: Vec<TiePoint> = rows
            .map(|y| Point2::new(common.left as f64 + 5.0, y as f64))
            .map(|a| TiePoint::point(left, other, a, a + Vector2::new(3.0, -2.0), None))
            .collect();
        let step = |continuity: &[TiePoint]| -> f64 {
            let mut fields: Vec<_> =
                layout.placements.iter().map(|p| DisplacementField::over(&p.bounds, 10.0)).collect();
            solve(&mut fields, &ties, continuity, DAMPING, LOSS_SCALE, &stage()).unwrap();
            let steps =
                super::border_ties(&layout, 10.0).into_iter().map(|t| fields[t.p].at(t.a) - fields[t.q].at(t.b));
            steps.map(|v| v.norm()).fold(0.0, f64::max)
        };
        // Half of the displacement is that of either photograph; a twentieth of a pixel is invisible.
        assert!(step(&[]) > 1.0 && step(&continuity) < 0.05, "{} {}", step(&[]), step(&continuity));
    }

    #[test]
    fn an_edge_in_noise_is_registered_across_and_ties_only_in_that_direction() {
        let mut state = 5_u32;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            60.0 * ((state >> 8) as f32 / (1 << 24) as f32 - 0.5)
        };
        // A painted line, three pixels wide, in grass that differs; rows across it.
        let mut profile = |radius: usize, at: f32| -> Vec<f32> {
            let line = |i: i32| 70.0 * (2.0 - (i as f32 - at).abs()).clamp(0.0, 1.0);
            let h = radius as i32;
            (0..2 * PATCH_RADIUS + 1).flat_map(|_| -h..=h).map(|i| 100.0 + line(i) + noise()).collect()
        };
        let first = profile(PATCH_RADIUS, 0.0);
        for offset in [0.0, 4.0, -3.4] {
            let found = register_edge(&first, &profile(PATCH_RADIUS + SEARCH_RADIUS, offset)).unwrap();
            // Means of 17 pixels with noise of 17 levels, on slopes of 70 levels a pixel, and a parabola through a corner.
            assert!((found - f64::from(offset)).abs() < 0.3, "{offset} {found}");
        }
        assert_eq!(register_edge(&first, &vec![100.0; 17 * 33]), None);
        // A tie point along x leaves y to the damping.
        let bounds = Bounds { left: 0, top: 0, right: 200, bottom: 100 };
        let mut fields = vec![DisplacementField::over(&bounds, 10.0), DisplacementField::over(&bounds, 10.0)];
        let at = |x: f64, y: f64| Point2::new(x, y);
        let ties: Vec<TiePoint> = (0..40)
            .map(|k| at(20.0 + 20.0 * f64::from(k % 8), 10.0 + 18.0 * f64::from(k / 8)))
            .map(|a| TiePoint::point(0, 1, a, a + Vector2::new(3.0, 7.0), Some(Vector2::x())))
            .collect();
        solve(&mut fields, &ties, &[], DAMPING, LOSS_SCALE, &stage()).unwrap();
        let apart = fields[0].at(at(100.0, 50.0)) - fields[1].at(at(100.0, 50.0));
        // The damping, 0.006 a vertex, takes a hundredth of it.
        assert!((apart.x - 3.0).abs() < 0.1 && apart.y.abs() < 1e-6, "{apart}");
    }
}
