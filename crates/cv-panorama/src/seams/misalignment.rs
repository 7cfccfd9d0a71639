//! Residual misalignment (parallax) of two photographs on the preview, by normalized cross-correlation of patches. A seam there cuts objects in two
//! however similar the colors are.

use crate::surface::{PAD, Piece, Preview, SEARCH_RADIUS, SEARCH_SIDE, Template};
use cv_core::{Cancelled, GrayF32, Stage, luma_f32};
use cv_parallel::prelude::*;

/// Patch radius in preview pixels.
pub(super) const PATCH_RADIUS: usize = 4;
/// Side of a patch.
pub(super) const PATCH_SIDE: usize = 2 * PATCH_RADIUS + 1;
/// Grid spacing of the patches in preview pixels.
pub(super) const SPACING: usize = 3;
/// Minimum root mean square contrast of a patch, in gray levels: low-texture patches are skipped.
const MIN_CONTRAST: f32 = 4.0;
/// Minimum correlation of corresponding patches.
const MIN_CORRELATION: f32 = 0.85;
/// Correlations within this of the maximum are equivalent (aperture problem along edges): the smallest displacement counts.
const CORRELATION_TOLERANCE: f32 = 0.03;

/// Misalignment maps of all pairs of pieces, in preview pixels.
pub(crate) struct Misalignments {
    pieces: usize,
    pairs: Vec<Option<Pair>>,
}

struct Pair {
    left: usize,
    top: usize,
    columns: usize,
    rows: usize,
    pixels: Vec<f32>,
}

impl Misalignments {
    /// Compares all overlapping pieces. O(overlap · search² · patch) where they are misaligned, O(overlap · patch) elsewhere.
    pub(crate) fn find(preview: &Preview, photo_of: &[usize], stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let lumas: Vec<GrayF32> = preview.pieces.par_iter().map(luma).collect();
        let n = preview.pieces.len();
        let pairs = (0..n * n)
            .into_par_iter()
            .map(|k| {
                let (a, b) = (k / n, k % n);
                if a < b && photo_of[a] != photo_of[b] { compare(preview, &lumas, a, b, stage) } else { Ok(None) }
            })
            .try_collect()?;
        Ok(Self { pieces: n, pairs })
    }

    /// Returns the misalignment of two pieces at a preview pixel, in preview pixels; 0 where unknown.
    #[inline]
    pub(crate) fn at(&self, a: usize, b: usize, x: usize, y: usize) -> f32 {
        let (a, b) = (a.min(b), a.max(b));
        let Some(Some(p)) = self.pairs.get(a * self.pieces + b) else { return 0.0 };
        let (Some(x), Some(y)) = (x.checked_sub(p.left), y.checked_sub(p.top)) else { return 0.0 };
        let (column, row) = (x / SPACING, y / SPACING);
        if column < p.columns && row < p.rows { p.pixels[row * p.columns + column] } else { 0.0 }
    }
}

/// Converts a piece to luma; NaN where the photograph does not cover the pixel.
pub(super) fn luma(piece: &Piece) -> GrayF32 {
    let (w, h) = piece.warped.pixels.size();
    GrayF32::from_fn(w, h, |x, y| {
        let [r, g, b, a] = piece.warped.pixels.at(x, y).map(f32::from);
        [if a > 0.0 { luma_f32([r, g, b]) } else { f32::NAN }]
    })
}

fn compare(
    preview: &Preview,
    lumas: &[GrayF32],
    a: usize,
    b: usize,
    stage: &Stage<'_>,
) -> Result<Option<Pair>, Cancelled> {
    let (first, second) = (preview.pieces[a].warped.bounds, preview.pieces[b].warped.bounds);
    let Some(common) = first.intersection(&second) else { return Ok(None) };
    let (columns, rows) = (common.width() / SPACING, common.height() / SPACING);
    let mut pixels = vec![0.0; columns * rows];
    pixels.par_chunks_mut(columns.max(1)).enumerate().try_for_each(|(row, out)| {
        // A row takes milliseconds.
        stage.check()?;
        for (column, out) in out.iter_mut().enumerate() {
            let (x, y) = (common.left + column * SPACING + SPACING / 2, common.top + row * SPACING + SPACING / 2);
            let p = ((x - first.left) as isize, (y - first.top) as isize);
            let q = ((x - second.left) as isize, (y - second.top) as isize);
            *out = displacement(&lumas[a], p, &lumas[b], q);
        }
        Ok(())
    })?;
    extend_to_borders(&mut pixels, columns);
    Ok(Some(Pair { left: common.left, top: common.top, columns, rows, pixels }))
}

/// Extrapolates to patches too close to a border (NaN): each takes the maximum of its neighbors.
fn extend_to_borders(pixels: &mut [f32], columns: usize) {
    // Number of grid cells from the border to the first complete patch.
    for _ in 0..PATCH_RADIUS.div_ceil(SPACING) + 1 {
        let before = pixels.to_vec();
        for (i, pixel) in pixels.iter_mut().enumerate().filter(|(_, p)| p.is_nan()) {
            let (x, y) = (i % columns, i / columns);
            let rows = y.saturating_sub(1)..(y + 2).min(before.len() / columns);
            let around = rows.flat_map(|r| &before[r * columns..][x.saturating_sub(1)..(x + 2).min(columns)]);
            // `max` passes over NaN.
            *pixel = around.fold(f32::NAN, |m, v| m.max(*v));
        }
    }
    pixels.iter_mut().filter(|p| p.is_nan()).for_each(|p| *p = 0.0);
}

/// Computes the smallest displacement at which the patch around `p` matches that around `q`: 0 for low texture, [`SEARCH_RADIUS`] without a match, NaN where one
/// of the patches is not complete.
fn displacement(first: &GrayF32, p: (isize, isize), second: &GrayF32, q: (isize, isize)) -> f32 {
    let (Some(template), Some(theirs)) = (patch_template(first, p), patch_rows(second, q)) else { return f32::NAN };
    if theirs.clone().flatten().any(|v| v.is_nan()) {
        return f32::NAN;
    }
    if template.energy().is_nan() {
        return f32::NAN;
    }
    if !has_contrast(&template) {
        return 0.0;
    }
    if template.score(theirs) > 1.0 - CORRELATION_TOLERANCE {
        return 0.0;
    }
    // NaN outside the photograph, as are the scores there.
    const WIDE: usize = PATCH_SIDE + 2 * SEARCH_RADIUS;
    let mut window = [f32::NAN; WIDE * WIDE + PAD];
    let reach = (PATCH_RADIUS + SEARCH_RADIUS) as isize;
    let (w, h) = (second.width() as isize, second.height() as isize);
    let (left, right) = ((q.0 - reach).max(0), (q.0 + reach + 1).min(w));
    for y in (q.1 - reach).max(0)..(q.1 + reach + 1).min(h) {
        let start = (y - q.1 + reach) as usize * WIDE + (left - q.0 + reach) as usize;
        let row = &second.row(y as usize)[left as usize..right as usize];
        window[start..start + row.len()].copy_from_slice(row);
    }
    let scores = template.scores(&window);
    // `max` passes over NaN.
    let best = scores.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    if best < MIN_CORRELATION {
        return SEARCH_RADIUS as f32;
    }
    let off = |i: usize| i.abs_diff(SEARCH_RADIUS) as f32;
    let distance = |i: usize| off(i % SEARCH_SIDE).hypot(off(i / SEARCH_SIDE));
    (0..scores.len()).filter(|&i| scores[i] >= best - CORRELATION_TOLERANCE).map(distance).fold(f32::INFINITY, f32::min)
}

/// Returns whether a patch has enough texture to be compared; false where it contains NaN.
pub(super) fn has_contrast(patch: &Template) -> bool {
    patch.energy() >= (PATCH_SIDE * PATCH_SIDE) as f32 * MIN_CONTRAST * MIN_CONTRAST
}

/// Returns the patch around a pixel as a template; `None` where it is not complete.
pub(super) fn patch_template(image: &GrayF32, at: (isize, isize)) -> Option<Template> {
    let mut patch = [0.0_f32; PATCH_SIDE * PATCH_SIDE];
    for (to, from) in patch.chunks_exact_mut(PATCH_SIDE).zip(patch_rows(image, at)?) {
        to.copy_from_slice(from);
    }
    Some(Template::new(PATCH_SIDE, &patch))
}

/// Returns the rows of the patch around a pixel; `None` where it is not complete.
pub(super) fn patch_rows(image: &GrayF32, (x, y): (isize, isize)) -> Option<impl Iterator<Item = &[f32]> + Clone> {
    let h = PATCH_RADIUS as isize;
    let inside = x >= h && y >= h && x + h < image.width() as isize && y + h < image.height() as isize;
    inside.then(|| (y - h..=y + h).map(move |y| &image.row(y as usize)[(x - h) as usize..=(x + h) as usize]))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Blotches that no shift by less than their size maps to themselves.
    fn blotches(x: f32, y: f32) -> f32 {
        120.0 + 60.0 * (0.31 * x + 0.2 * (0.17 * y).sin() * x).sin() + 50.0 * (0.43 * y + 0.011 * x * x).cos()
    }

    #[test]
    fn a_shift_is_found_and_the_plain_and_the_foreign_are_told_apart() {
        let first = GrayF32::from_fn(60, 60, |x, y| [blotches(x as f32, y as f32)]);
        for (dx, dy) in [(0, 0), (3, -2), (-5, 4), (7, 7)] {
            let moved =
                GrayF32::from_fn(60, 60, |x, y| [0.7 * blotches((x as i32 - dx) as f32, (y as i32 - dy) as f32) + 9.0]);
            let found = displacement(&first, (30, 30), &moved, (30, 30));
            let truth = (dx as f32).hypot(dy as f32);
            // The nearest of the places that look nearly as alike may be one pixel nearer in either direction.
            assert!(found <= truth + 1e-3 && found >= truth - 1.5, "{dx} {dy}: {found}");
        }
        let plain = GrayF32::from_fn(60, 60, |_, _| [100.0]);
        assert_eq!(displacement(&plain, (30, 30), &first, (30, 30)), 0.0);
        let foreign = GrayF32::from_fn(60, 60, |x, y| [255.0 * ((x * 7919 + y * 104_729) % 97) as f32 / 97.0]);
        assert_eq!(displacement(&first, (30, 30), &foreign, (30, 30)), SEARCH_RADIUS as f32);
        // Along an edge nothing is known: the nearest place counts.
        let edge = GrayF32::from_fn(60, 60, |x, _| [if x < 30 { 20.0 } else { 200.0 }]);
        assert_eq!(displacement(&edge, (30, 25), &edge, (30, 33)), 0.0);
        assert!(displacement(&first, (2, 30), &first, (2, 30)).is_nan());
    }

    #[test]
    fn places_at_the_border_take_the_worst_of_their_neighbors() {
        let nan = f32::NAN;
        let mut pixels = vec![nan, nan, nan, nan, nan, 2.0, 5.0, nan, nan, 1.0, 0.0, nan];
        extend_to_borders(&mut pixels, 4);
        assert_eq!(pixels, [2.0, 5.0, 5.0, 5.0, 2.0, 2.0, 5.0, 5.0, 2.0, 1.0, 0.0, 5.0]);
    }
}
