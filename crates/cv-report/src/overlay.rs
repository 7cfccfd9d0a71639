//! Overlays on images: keypoints, matches, epipolar lines, masks, patches, error maps.

use cv_core::{Correspondence, ImageView, Keypoint, Matrix3, RgbU8, luma_u8};

use crate::raster::{Color, Raster, colors};

/// Returns the scale of line widths and marker sizes for an image size: 1 for about 1000 pixels.
fn line_scale(width: usize, height: usize) -> f32 {
    (width.max(height) as f32 / 1000.0).clamp(0.8, 4.0)
}

/// Desaturates and darkens an image, so that overlays stand out.
fn desaturate(raster: &mut Raster) {
    raster.map(|[r, g, b]| {
        let luma = u32::from(luma_u8([r, g, b]));
        [r, g, b].map(|v| ((u32::from(v) + 3 * luma) * 45 / 256 + 20) as u8)
    });
}

/// Draws keypoints: a circle whose radius grows with the scale, with a spoke in the direction of the orientation.
pub fn draw_keypoints(view: ImageView<'_, u8, 3>, keypoints: &[Keypoint], color: Color) -> RgbU8 {
    let mut raster = Raster::from_rgb(view);
    let u = line_scale(view.width(), view.height());
    for point in keypoints {
        let center = [point.position.x, point.position.y];
        let radius = (3.6 * u).max(3.0 * point.scale.clamp(0.0, 100.0));
        raster.circle(center, radius, 2.9 * u, colors::BLACK);
        raster.circle(center, radius, 1.5 * u, color);
        if point.angle != 0.0 && point.angle.is_finite() {
            let end = [center[0] + radius * point.angle.cos(), center[1] + radius * point.angle.sin()];
            raster.line(center, end, 1.3 * u, color);
        }
    }
    raster.into_image()
}

/// Arranges images in a row on white, `gap` pixels apart, centered vertically.
pub fn side_by_side(views: &[ImageView<'_, u8, 3>], gap: usize) -> RgbU8 {
    let (raster, _) = arrange_in_row(views, gap);
    raster.into_image()
}

/// Returns the row and the top-left corner of each image in it.
fn arrange_in_row(views: &[ImageView<'_, u8, 3>], gap: usize) -> (Raster, Vec<[f32; 2]>) {
    let height = views.iter().map(ImageView::height).max().unwrap_or(0);
    let width = views.iter().map(ImageView::width).sum::<usize>() + gap * views.len().saturating_sub(1);
    let mut raster = Raster::new(width, height, colors::WHITE);
    let mut corners = Vec::with_capacity(views.len());
    let mut x = 0;
    for view in views {
        let y = (height - view.height()) / 2;
        raster.paste(*view, x as i64, y as i64);
        corners.push([x as f32, y as f32]);
        x += view.width() + gap;
    }
    (raster, corners)
}

/// Returns a color for an index, distinct from those of adjacent indices (categorical colors).
fn categorical_color(index: usize) -> Color {
    // Steps of the golden angle around the hue circle, at full saturation and two lightnesses.
    let hue = (index as f32 * 0.618_034).fract() * 6.0;
    let value = if index.is_multiple_of(2) { 255.0 } else { 210.0 };
    std::array::from_fn(|c| {
        let d = (hue - [0.0, 2.0, 4.0][c]).rem_euclid(6.0);
        let ramp = (d.min(6.0 - d) - 1.0).clamp(0.0, 1.0);
        (value * (1.0 - 0.85 * ramp)) as u8
    })
}

/// Selects at most `limit` of `0..n`, evenly spaced.
fn evenly_spaced(n: usize, limit: usize) -> impl Iterator<Item = usize> {
    let shown = n.min(limit);
    (0..shown).map(move |i| i * n / shown)
}

/// How matches are drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MatchStyle {
    /// Maximum number of lines per class (inliers, outliers), evenly spaced in the list. Default 400: more would hide the images.
    pub limit: usize,
    /// Whether outliers are drawn. Default true.
    pub outliers: bool,
}

impl Default for MatchStyle {
    fn default() -> Self {
        Self { limit: 400, outliers: true }
    }
}

/// Draws two images, desaturated and side by side, with a line per match: inliers green over outliers red, or each in a different color
/// where `inliers` is `None`. A pair beyond the end of `inliers` counts as an outlier.
pub fn draw_matches(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    pairs: &[Correspondence],
    inliers: Option<&[bool]>,
    style: &MatchStyle,
) -> RgbU8 {
    let (mut raster, corners) = arrange_in_row(&[a, b], 0);
    desaturate(&mut raster);
    let u = line_scale(raster.width() / 2, raster.height());
    let mut draw = |pair: &Correspondence, color: Color| {
        let from = [pair.a.x as f32 + corners[0][0], pair.a.y as f32 + corners[0][1]];
        let to = [pair.b.x as f32 + corners[1][0], pair.b.y as f32 + corners[1][1]];
        raster.line(from, to, 1.3 * u, color);
        for end in [from, to] {
            raster.disc(end, 3.4 * u, colors::BLACK);
            raster.disc(end, 2.4 * u, color);
        }
    };
    match inliers {
        None => evenly_spaced(pairs.len(), style.limit).for_each(|i| draw(&pairs[i], categorical_color(i))),
        Some(inliers) => {
            let is_inlier = |i: &usize| inliers.get(*i).copied().unwrap_or(false);
            let (inliers, outliers): (Vec<usize>, Vec<usize>) = (0..pairs.len()).partition(is_inlier);
            if style.outliers {
                evenly_spaced(outliers.len(), style.limit).for_each(|i| draw(&pairs[outliers[i]], colors::RED));
            }
            evenly_spaced(inliers.len(), style.limit).for_each(|i| draw(&pairs[inliers[i]], colors::GREEN));
        }
    }
    raster.into_image()
}

/// Draws two images, desaturated and side by side, with up to `count` pairs, each with its epipolar lines in one color: `F x_a` in the second
/// image and `Fᵀ x_b` in the first, where `x_bᵀ F x_a = 0`.
pub fn draw_epipolar_lines(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    fundamental: &Matrix3<f64>,
    pairs: &[Correspondence],
    count: usize,
) -> RgbU8 {
    let (mut left, mut right) = (Raster::from_rgb(a), Raster::from_rgb(b));
    desaturate(&mut left);
    desaturate(&mut right);
    let u = line_scale(a.width(), a.height());
    for (n, i) in evenly_spaced(pairs.len(), count).enumerate() {
        let pair = &pairs[i];
        let color = categorical_color(n);
        let (xa, xb) = (pair.a.to_homogeneous(), pair.b.to_homogeneous());
        for (raster, line, point) in
            [(&mut left, fundamental.transpose() * xb, pair.a), (&mut right, fundamental * xa, pair.b)]
        {
            if let Some((from, to)) =
                clip_line_to_image(line.x, line.y, line.z, raster.width() as f64, raster.height() as f64)
            {
                raster.line(from, to, 1.8 * u, color);
            }
            let center = [point.x as f32, point.y as f32];
            raster.disc(center, 4.6 * u, colors::BLACK);
            raster.disc(center, 3.6 * u, color);
        }
    }
    let gap = (6.0 * u) as usize;
    side_by_side(&[left.image().view(), right.image().view()], gap)
}

/// Computes the ends of the line `a x + b y + c = 0` at the borders of an image.
fn clip_line_to_image(a: f64, b: f64, c: f64, width: f64, height: f64) -> Option<([f32; 2], [f32; 2])> {
    let norm = a.hypot(b);
    if !(norm > 0.0 && norm.is_finite() && c.is_finite()) {
        return None;
    }
    let (from, to) = if a.abs() < b.abs() {
        ([0.0, -c / b], [width - 1.0, -(c + a * (width - 1.0)) / b])
    } else {
        ([-c / a, 0.0], [-(c + b * (height - 1.0)) / a, height - 1.0])
    };
    Some((from.map(|v| v as f32), to.map(|v| v as f32)))
}

/// Overlays a mask on an image: `color` blended by `alpha` (0 to 1) where true, with a solid boundary. Pixels beyond the mask's size are
/// unchanged.
pub fn overlay_mask(view: ImageView<'_, u8, 3>, mask: ImageView<'_, bool, 1>, color: Color, alpha: f32) -> RgbU8 {
    let mut raster = Raster::from_rgb(view);
    let outline_width = line_scale(view.width(), view.height()).round() as i64;
    let is_set = |x: i64, y: i64| {
        usize::try_from(x).ok().zip(usize::try_from(y).ok()).and_then(|(x, y)| mask.get(x, y)).is_some_and(|[m]| m)
    };
    for y in 0..view.height().min(mask.height()) as i64 {
        for x in 0..view.width().min(mask.width()) as i64 {
            if !is_set(x, y) {
                continue;
            }
            let is_boundary = (1..=outline_width)
                .any(|d| !is_set(x - d, y) || !is_set(x + d, y) || !is_set(x, y - d) || !is_set(x, y + d));
            raster.blend(x, y, color, if is_boundary { 1.0 } else { alpha });
        }
    }
    raster.into_image()
}

/// Overlays a mask compared with ground truth on the desaturated image: true positives green, false positives red, false negatives blue.
pub fn overlay_comparison(
    view: ImageView<'_, u8, 3>,
    mask: ImageView<'_, bool, 1>,
    truth: ImageView<'_, bool, 1>,
) -> RgbU8 {
    let mut raster = Raster::from_rgb(view);
    desaturate(&mut raster);
    for y in 0..view.height() {
        for x in 0..view.width() {
            let color = match (mask.get(x, y) == Some([true]), truth.get(x, y) == Some([true])) {
                (true, true) => colors::GREEN,
                (true, false) => colors::RED,
                (false, true) => colors::BLUE,
                (false, false) => continue,
            };
            raster.blend(x as i64, y as i64, color, 0.55);
        }
    }
    raster.into_image()
}

/// Draws square patches, such as descriptors, as enlarged tiles: `side × side` values each, row-major, the contrast of each tile
/// stretched to its range.
///
/// Values beyond whole patches are ignored. Returns an empty image where `side` is 0 or there is no patch.
pub fn tile_patches(values: &[f32], side: usize, columns: usize, zoom: usize) -> RgbU8 {
    let area = side * side;
    let (columns, zoom) = (columns.max(1), zoom.max(1));
    let count = values.len().checked_div(area).unwrap_or(0);
    if count == 0 {
        return RgbU8::new(0, 0, [0; 3]);
    }
    let gap = (zoom * side / 12).max(2);
    let cell = zoom * side + gap;
    let used = columns.min(count);
    let mut raster = Raster::new(used * cell + gap, count.div_ceil(columns) * cell + gap, [225, 227, 232]);
    for (i, patch) in values.chunks_exact(area).enumerate() {
        let finite = || patch.iter().copied().filter(|v| v.is_finite());
        let (low, high) = (finite().fold(f32::INFINITY, f32::min), finite().fold(f32::NEG_INFINITY, f32::max));
        let scale = if high > low { 1.0 / (high - low) } else { 0.0 };
        let (left, top) = ((i % columns * cell + gap) as i64, (i / columns * cell + gap) as i64);
        for (j, &v) in patch.iter().enumerate() {
            let color = if v.is_finite() { [(255.0 * (v - low) * scale) as u8; 3] } else { colors::UNKNOWN };
            let (x, y) = ((j % side * zoom) as i64, (j / side * zoom) as i64);
            raster.fill_rect(left + x, top + y, zoom, zoom, color);
        }
    }
    raster.into_image()
}

/// Draws the error map of a disparity or depth map against ground truth: gray ramp up to `limit`, then red to yellow; black where there is
/// no ground truth, blue where the estimate is missing.
///
/// The boundary between gray and color is the bad-pixel threshold (2 px for bad-2.0).
pub fn draw_error_map(estimate: ImageView<'_, f32, 1>, truth: ImageView<'_, f32, 1>, limit: f32) -> RgbU8 {
    let limit = if limit > 0.0 { limit } else { 1.0 };
    RgbU8::from_fn(estimate.width().min(truth.width()), estimate.height().min(truth.height()), |x, y| {
        let (e, [t]) = (estimate.at(x, y)[0], truth.at(x, y));
        if !t.is_finite() {
            return colors::BLACK;
        }
        if !e.is_finite() {
            return [40, 90, 200];
        }
        let error = (e - t).abs() / limit;
        if error <= 1.0 {
            [(245.0 - 95.0 * error) as u8; 3]
        } else {
            // Twice the limit is red, eight times and more yellow.
            let more = (error.log2() / 3.0).clamp(0.0, 1.0);
            [205 + (more * 50.0) as u8, 30 + (more * 190.0) as u8, 30]
        }
    })
}

/// Shrinks an image to at most `side` pixels on its longer side by area averaging; a smaller one is copied.
///
/// For reports: a panorama of 10,000 pixels would be tens of megabytes in the file.
pub fn shrink_to_fit(view: ImageView<'_, u8, 3>, side: usize) -> RgbU8 {
    let (w, h) = view.size();
    let (longest, side) = (w.max(h), side.max(1));
    if longest <= side {
        return view.to_image();
    }
    let scaled = |n: usize| (n * side / longest).max(1).min(n);
    let (width, height) = (scaled(w), scaled(h));
    let mut out = RgbU8::new(width, height, [0; 3]);
    let mut sums = vec![[0.0f32; 3]; width];
    let columns = area_weights(w, width);
    for (y, (top, rows)) in area_weights(h, height).into_iter().enumerate() {
        sums.fill([0.0; 3]);
        for (j, weight_y) in rows.into_iter().enumerate() {
            let row = view.row(top + j).as_chunks::<3>().0;
            for (sum, (left, weights)) in sums.iter_mut().zip(&columns) {
                for (pixel, weight_x) in row[*left..].iter().zip(weights) {
                    let weight = weight_x * weight_y;
                    for c in 0..3 {
                        sum[c] += weight * f32::from(pixel[c]);
                    }
                }
            }
        }
        for (pixel, sum) in out.row_mut(y).as_chunks_mut::<3>().0.iter_mut().zip(&sums) {
            *pixel = sum.map(|v| (v + 0.5) as u8);
        }
    }
    out
}

/// Computes the area weights for resampling a line of `from ≥ to` pixels to `to`: per result the first source pixel, and the weights of it
/// and its successors, which sum to one.
fn area_weights(from: usize, to: usize) -> Vec<(usize, Vec<f32>)> {
    let step = from as f64 / to as f64;
    let part = |i: usize| {
        let (start, end) = (i as f64 * step, ((i + 1) as f64 * step).min(from as f64));
        let (first, last) = (start as usize, (end.ceil() as usize).clamp(start as usize + 1, from));
        let weight = |cell: usize| ((end.min(cell as f64 + 1.0) - start.max(cell as f64)) / (end - start)) as f32;
        (first, (first..last).map(weight).collect())
    };
    (0..to).map(part).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Mask, Point2};
    use proptest::prelude::*;

    fn gray(w: usize, h: usize) -> RgbU8 {
        RgbU8::new(w, h, [60; 3])
    }

    #[test]
    fn inliers_are_green_and_outliers_red_at_their_positions() {
        let (a, b) = (gray(40, 30), gray(50, 20));
        let pairs = [Correspondence::new(10.0, 10.0, 20.0, 5.0), Correspondence::new(10.0, 25.0, 20.0, 15.0)];
        let drawn = draw_matches(a.view(), b.view(), &pairs, Some(&[true, false]), &MatchStyle::default());
        assert_eq!(drawn.size(), (90, 30));
        // The second image is centered: 5 pixels down, 40 to the right.
        for (x, y, color) in
            [(10, 10, colors::GREEN), (60, 10, colors::GREEN), (10, 25, colors::RED), (60, 20, colors::RED)]
        {
            let got = drawn.at(x, y);
            assert!((0..3).all(|c| got[c].abs_diff(color[c]) < 8), "{x} {y}: {got:?}");
        }
        let only = MatchStyle { outliers: false, ..MatchStyle::default() };
        let drawn = draw_matches(a.view(), b.view(), &pairs, Some(&[true, false]), &only);
        assert_eq!(drawn.at(10, 25), drawn.at(2, 2));
    }

    #[test]
    fn epipolar_lines_of_a_sideways_motion_are_rows() {
        // F of a translation along x: x_bᵀ [t]× x_a = 0 with t = (1, 0, 0), so y_a = y_b.
        let f = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        let a = gray(60, 40);
        let pairs = [Correspondence::new(20.0, 12.0, 30.0, 12.0)];
        let drawn = draw_epipolar_lines(a.view(), a.view(), &f, &pairs, 5);
        let marked = |x: usize, y: usize| drawn.at(x, y) != drawn.at(2, 38);
        assert!((0..60).all(|x| marked(x, 12)));
        let start = drawn.width() - 60;
        assert!((start..start + 60).all(|x| marked(x, 12)));
        assert!(!marked(50, 20) && !marked(start + 50, 3));
    }

    #[test]
    fn a_mask_overlay_has_blended_interior_and_solid_boundary() {
        let mask = Mask::from_fn(20, 20, |x, y| [(5..15).contains(&x) && (5..15).contains(&y)]);
        let drawn = overlay_mask(gray(20, 20).view(), mask.view(), [255, 0, 0], 0.5);
        assert_eq!(drawn.at(5, 8), [255, 0, 0]);
        assert_eq!(drawn.at(2, 2), [60; 3]);
        let [r, g, _] = drawn.at(10, 10);
        assert!(r.abs_diff(157) <= 2 && g.abs_diff(30) <= 2, "{r} {g}");
    }

    #[test]
    fn error_map_colors_by_error_class() {
        let estimate = cv_core::GrayF32::from_vec(4, 1, vec![1.0, 9.0, f32::NAN, 3.0]).unwrap();
        let truth = cv_core::GrayF32::from_vec(4, 1, vec![1.5, 1.0, 2.0, f32::NAN]).unwrap();
        let drawn = draw_error_map(estimate.view(), truth.view(), 2.0);
        let [r, g, b] = drawn.at(0, 0);
        assert!(r == g && g == b && r > 150);
        assert!(drawn.at(1, 0)[0] > 200 && drawn.at(1, 0)[2] < 50);
        assert!(drawn.at(2, 0)[2] > 150 && drawn.at(3, 0) == [0; 3]);
    }

    #[test]
    fn patches_are_tiled_at_their_positions() {
        let drawn = tile_patches(&[0.0, 1.0, 0.5, f32::NAN, 2.0, 2.0, 2.0, 2.0, 7.0], 2, 8, 4);
        let cell = 4 * 2 + 2;
        assert_eq!(drawn.size(), (2 * cell + 2, cell + 2));
        assert_eq!((drawn.at(2, 2), drawn.at(6, 2), drawn.at(6, 6)), ([0; 3], [255; 3], colors::UNKNOWN));
        assert!(tile_patches(&[], 8, 4, 2).is_empty() && tile_patches(&[1.0], 0, 4, 2).is_empty());
    }

    #[test]
    fn shrinking_is_area_averaging() {
        let image =
            RgbU8::from_vec(4, 2, [0, 100, 10, 30, 20, 200, 50, 70].iter().flat_map(|&v| [v, 255, 0]).collect());
        let small = shrink_to_fit(image.unwrap().view(), 2);
        assert_eq!(small.size(), (2, 1));
        assert_eq!((small.at(0, 0), small.at(1, 0)), ([80, 255, 0], [40, 255, 0]));
        // Three pixels in two: each part is one and a half of them.
        let image = RgbU8::from_vec(3, 1, [0, 90, 240].iter().flat_map(|&v| [v; 3]).collect()).unwrap();
        let small = shrink_to_fit(image.view(), 2);
        assert_eq!((small.at(0, 0)[0], small.at(1, 0)[0]), (30, 190));
    }

    proptest! {
        #[test]
        fn shrinking_preserves_the_mean_and_fits(w in 1usize..40, h in 1usize..40, side in 0usize..50, seed: u8) {
            let image = RgbU8::from_fn(w, h, |x, y| [(x * 37 + y * 91) as u8 ^ seed, 0, 255]);
            let small = shrink_to_fit(image.view(), side);
            prop_assert!(small.width().max(small.height()) <= side.max(1));
            prop_assert!(small.pixels().all(|p| p[1] == 0 && p[2] == 255));
            let mean = |i: &RgbU8| i.pixels().map(|p| f64::from(p[0])).sum::<f64>() / i.pixels().len() as f64;
            // Every pixel has equal weight in the whole; each result is rounded by at most a half.
            prop_assert!((mean(&image) - mean(&small)).abs() <= 0.51, "{} {}", mean(&image), mean(&small));
        }

        #[test]
        fn extreme_input_never_panics(values in prop::array::uniform9(prop::num::f64::ANY), w in 0usize..9, h in 0usize..9) {
            let a = gray(w, h);
            let pairs = [Correspondence::new(values[0], values[1], values[2], values[3])];
            draw_matches(a.view(), a.view(), &pairs, None, &MatchStyle::default());
            draw_epipolar_lines(a.view(), a.view(), &Matrix3::from_row_slice(&values), &pairs, 3);
            let mut point = Keypoint::new(values[0] as f32, values[1] as f32, 0.0);
            (point.scale, point.angle) = (values[2] as f32, values[3] as f32);
            draw_keypoints(a.view(), &[point], colors::RED);
            let p = Point2::new(1.0, 2.0);
            draw_epipolar_lines(a.view(), a.view(), &Matrix3::identity(), &[Correspondence { a: p, b: p }], 0);
        }
    }
}
