//! Multi-band blending (Burt & Adelson 1983): low frequencies over a wide transition, high ones over a narrow one.
//!
//! Pixels are `[red, green, blue, weight]`, one vector register each. A photograph's weight is one where the labels name it and zero
//! elsewhere; its pyramid is blurred and halved along with the colors. Outside a photograph its edge pixels are repeated (see `warp`), so no
//! band knows of a border and nothing dark bleeds in.

use crate::blend::{Blender, Composition, NO_PHOTO};
use crate::rows::{for_each_row, for_each_row_with};
use crate::surface::WarpedPhoto;
use cv_core::{Cancelled, Image, Progress, RgbU8, Stage};

type Pixel = [f32; 4];

/// A dense rectangle of pixels whose top-left corner lies at `(left, top)` of its level of the canvas.
struct Level {
    left: usize,
    top: usize,
    width: usize,
    height: usize,
    data: Vec<Pixel>,
}

impl Level {
    fn new(left: usize, top: usize, width: usize, height: usize) -> Self {
        Self { left, top, width, height, data: vec![[0.0; 4]; width * height] }
    }

    fn row(&self, y: usize) -> &[Pixel] {
        &self.data[y * self.width..(y + 1) * self.width]
    }
}

/// Multi-band blending with transitions of a 25th of a photograph in either direction.
pub(crate) struct Multiband;

impl Blender for Multiband {
    fn pyramid_levels(&self, typical_side: f64) -> usize {
        ((0.04 * typical_side).max(1.0).log2().round() as usize).clamp(1, 8)
    }

    fn blend(&self, composition: &Composition<'_>, progress: &dyn Progress) -> Result<RgbU8, Cancelled> {
        let stage = Stage::new(progress, "blend", composition.photos.len() + 1)?;
        let (width, height) = composition.labels.size();
        let mut pyramid = Pyramid::new(width, height, self.pyramid_levels(composition.typical_side));
        for (label, photo) in composition.photos.iter().enumerate() {
            if let Some(photo) = photo {
                pyramid.add(photo, composition.labels, label as u16, &stage)?;
            }
            stage.add(1)?;
        }
        let image = pyramid.collapse(composition.labels, &stage)?;
        stage.add(1)?;
        Ok(image)
    }
}

/// The canvas as a Laplacian pyramid of weighted sums.
struct Pyramid {
    levels: Vec<Level>,
}

impl Pyramid {
    /// For a canvas of this size and `bands` bands above the residual.
    fn new(width: usize, height: usize, bands: usize) -> Self {
        let levels = (0..=bands).map(|l| Level::new(0, 0, width.div_ceil(1 << l), height.div_ceil(1 << l))).collect();
        Self { levels }
    }

    /// Adds a photograph where `labels` say `label`.
    fn add(
        &mut self,
        photo: &WarpedPhoto,
        labels: &Image<u16, 1>,
        label: u16,
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        let b = photo.bounds;
        let (w, h) = (b.width(), b.height());
        let mut level = Level::new(b.left, b.top, w, h);
        for_each_row(&mut level.data, w, stage, |y, row| {
            let (pixels, _) = photo.pixels.row(y).as_chunks::<4>();
            for ((out, p), l) in row.iter_mut().zip(pixels).zip(&labels.row(b.top + y)[b.left..]) {
                *out = [p[0].into(), p[1].into(), p[2].into(), if *l == label { 1.0 } else { 0.0 }];
            }
        })?;
        let last = self.levels.len() - 1;
        for l in 0..last {
            let smaller = halve(&level, stage)?;
            add_band(&mut self.levels[l], &level, Some(&smaller), stage)?;
            level = smaller;
        }
        add_band(&mut self.levels[last], &level, None, stage)
    }

    /// The blended canvas; black where no label names a photograph.
    fn collapse(mut self, labels: &Image<u16, 1>, stage: &Stage<'_>) -> Result<RgbU8, Cancelled> {
        for level in &mut self.levels {
            for_each_row(&mut level.data, level.width, stage, |_, row| {
                for p in row {
                    // A thousandth of a pixel's weight lies beyond every photograph's blending range.
                    let scale = if p[3] > 1e-3 { 1.0 / p[3] } else { 0.0 };
                    *p = [p[0] * scale, p[1] * scale, p[2] * scale, 0.0];
                }
            })?;
        }
        while self.levels.len() > 1 {
            let (Some(smaller), Some(larger)) = (self.levels.pop(), self.levels.last_mut()) else { break };
            for_each_row_with(&mut larger.data, larger.width, stage, Vec::new, |buffer, y, row| {
                enlarged_row(&smaller, 0, 0, y, row.len(), buffer, |x, up| {
                    for c in 0..3 {
                        row[x][c] += up[c];
                    }
                });
            })?;
        }
        let (width, height) = labels.size();
        let mut image: RgbU8 = Image::new(width, height, [0; 3]);
        let Some(base) = self.levels.first() else { return Ok(image) };
        for_each_row(image.as_mut_slice(), 3 * width, stage, |y, row| {
            for ((out, p), l) in row.as_chunks_mut::<3>().0.iter_mut().zip(base.row(y)).zip(labels.row(y)) {
                if *l != NO_PHOTO {
                    *out = [(p[0] + 0.5) as u8, (p[1] + 0.5) as u8, (p[2] + 0.5) as u8];
                }
            }
        })?;
        Ok(image)
    }
}

/// Burt's kernel 1 4 6 4 1.
fn kernel(a: Pixel, b: Pixel, c: Pixel, d: Pixel, e: Pixel) -> Pixel {
    std::array::from_fn(|i| (a[i] + e[i]) * 0.0625 + (b[i] + d[i]) * 0.25 + c[i] * 0.375)
}

/// The next level: blurred, every second pixel of every second row. Edges are repeated.
fn halve(level: &Level, stage: &Stage<'_>) -> Result<Level, Cancelled> {
    let (w, h) = (level.width, level.height);
    let mut half = Level::new(level.left / 2, level.top / 2, w.div_ceil(2), h.div_ceil(2));
    let width = half.width;
    for_each_row_with(
        &mut half.data,
        width,
        stage,
        || vec![[0.0; 4]; w],
        |column, y, row| {
            let at = |dy: isize| level.row((2 * y as isize + dy).clamp(0, h as isize - 1) as usize);
            let (a, b, c, d, e) = (at(-2), at(-1), at(0), at(1), at(2));
            for x in 0..w {
                column[x] = kernel(a[x], b[x], c[x], d[x], e[x]);
            }
            let at = |x: isize| column[x.clamp(0, w as isize - 1) as usize];
            for (x, out) in row.iter_mut().enumerate() {
                let x = 2 * x;
                *out = if x >= 2 && x + 2 < w {
                    kernel(column[x - 2], column[x - 1], column[x], column[x + 1], column[x + 2])
                } else {
                    let x = x as isize;
                    kernel(at(x - 2), at(x - 1), at(x), at(x + 1), at(x + 2))
                };
            }
        },
    )?;
    Ok(half)
}

/// Hands every pixel of one row of the level twice as large to `put`: `x` from 0 to `width`, for the rectangle whose corner lies at `(left, top)` of that
/// level.
fn enlarged_row(
    small: &Level,
    left: usize,
    top: usize,
    y: usize,
    width: usize,
    buffer: &mut Vec<Pixel>,
    mut put: impl FnMut(usize, Pixel),
) {
    let (w, h) = (small.width, small.height);
    let y = top + y - 2 * small.top;
    let at = |y: isize| small.row(y.clamp(0, h as isize - 1) as usize);
    let middle = (y / 2) as isize;
    buffer.clear();
    if y.is_multiple_of(2) {
        let (a, b, c) = (at(middle - 1), at(middle), at(middle + 1));
        buffer
            .extend((0..w).map(|x| -> Pixel { std::array::from_fn(|i| (a[x][i] + c[x][i]) * 0.125 + b[x][i] * 0.75) }));
    } else {
        let (a, b) = (at(middle), at(middle + 1));
        buffer.extend((0..w).map(|x| -> Pixel { std::array::from_fn(|i| (a[x][i] + b[x][i]) * 0.5) }));
    }
    // A copy at each end stands for the repeated edge.
    let column = |x: isize| buffer[x.clamp(0, w as isize - 1) as usize];
    let offset = left - 2 * small.left;
    for x in 0..width {
        let at = x + offset;
        let middle = (at / 2) as isize;
        let up = if at.is_multiple_of(2) {
            let (a, b, c) = (column(middle - 1), column(middle), column(middle + 1));
            std::array::from_fn(|i| (a[i] + c[i]) * 0.125 + b[i] * 0.75)
        } else {
            let (a, b) = (column(middle), column(middle + 1));
            std::array::from_fn(|i| (a[i] + b[i]) * 0.5)
        };
        put(x, up);
    }
}

/// Adds `weight · (level − enlarged(smaller))` and the weight.
fn add_band(sum: &mut Level, level: &Level, smaller: Option<&Level>, stage: &Stage<'_>) -> Result<(), Cancelled> {
    let (left, width, row_width) = (level.left, level.width, sum.width);
    let rows = &mut sum.data[level.top * row_width..][..level.height * row_width];
    for_each_row_with(rows, row_width, stage, Vec::new, |buffer, y, row| {
        let source = level.row(y);
        let row = &mut row[left..left + width];
        match smaller {
            None => {
                for (out, p) in row.iter_mut().zip(source) {
                    for c in 0..3 {
                        out[c] += p[3] * p[c];
                    }
                    out[3] += p[3];
                }
            }
            Some(smaller) => enlarged_row(smaller, left, level.top, y, width, buffer, |x, up| {
                let p = source[x];
                let (w, out) = (p[3], &mut row[x]);
                *out =
                    [out[0] + w * (p[0] - up[0]), out[1] + w * (p[1] - up[1]), out[2] + w * (p[2] - up[2]), out[3] + w];
            }),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Bounds;
    use crate::testing::{drawn, stage};

    /// Photographs of the whole canvas joined with so many bands.
    fn joined(photos: &[WarpedPhoto], labels: &Image<u16, 1>, bands: usize) -> RgbU8 {
        let mut pyramid = Pyramid::new(labels.width(), labels.height(), bands);
        for (label, photo) in photos.iter().enumerate() {
            pyramid.add(photo, labels, label as u16, &stage()).unwrap();
        }
        pyramid.collapse(labels, &stage()).unwrap()
    }

    fn scene(x: usize, y: usize) -> [u8; 3] {
        [((x * 7 + y * 3) % 251) as u8, ((x * y) % 241) as u8, if (x / 5 + y / 7).is_multiple_of(2) { 30 } else { 220 }]
    }

    #[test]
    fn photographs_of_one_picture_give_that_picture_back_at_any_size_and_depth() {
        for (w, h) in [(97, 61), (64, 64), (33, 18), (5, 3), (1, 1)] {
            for bands in 0..5 {
                let labels = Image::from_fn(w, h, |x, _| [u16::from(x > w / 2)]);
                let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
                let result = joined(&[drawn(whole, scene), drawn(whole, scene)], &labels, bands);
                for y in 0..h {
                    for x in 0..w {
                        // Bands are taken off and put back in f32: exact but for rounding, far from half a level.
                        assert_eq!(result.at(x, y), scene(x, y), "{w}x{h} {bands}: {x} {y}");
                    }
                }
            }
        }
    }

    #[test]
    fn a_photograph_that_ends_at_its_margin_still_gives_the_picture_back() {
        let (w, h, bands) = (300, 40, 3);
        let labels = Image::from_fn(w, h, |x, _| [u16::from(x >= 150)]);
        let halves =
            [Bounds { left: 0, top: 0, right: 150, bottom: h }, Bounds { left: 150, top: 0, right: w, bottom: h }];
        let photos = halves.map(|b| {
            let region = b.for_pyramid(bands, w, h);
            assert!(region.width() < 200);
            drawn(region, scene)
        });
        let result = joined(&photos, &labels, bands);
        for y in 0..h {
            for x in 0..w {
                for (got, want) in result.at(x, y).into_iter().zip(scene(x, y)) {
                    // Beyond the margin a photograph repeats its edge; the weights there are the tail of the kernel.
                    assert!(got.abs_diff(want) <= 1, "{x} {y}: {got} {want}");
                }
            }
        }
    }

    #[test]
    fn a_step_in_brightness_becomes_a_slope_and_stays_between_its_sides() {
        let (w, h, bands) = (256, 32, 4);
        let labels = Image::from_fn(w, h, |x, _| [u16::from(x >= 128)]);
        let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
        let result = joined(&[drawn(whole, |_, _| [100; 3]), drawn(whole, |_, _| [140; 3])], &labels, bands);
        let row: Vec<u8> = (0..w).map(|x| result.at(x, 16)[0]).collect();
        assert_eq!((row[0], row[255]), (100, 140));
        assert!(row.windows(2).all(|p| p[1] >= p[0] && p[1] - p[0] <= 3), "{row:?}");
        assert!((118..=122).contains(&row[128]));
    }

    #[test]
    fn what_nobody_covers_is_black_and_darkens_nothing() {
        let (w, h, bands) = (120, 60, 4);
        let inside = |x: usize, y: usize| (21..100).contains(&x) && (10..50).contains(&y);
        let labels = Image::from_fn(w, h, |x, y| [if inside(x, y) { 0 } else { NO_PHOTO }]);
        let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
        let result = joined(&[drawn(whole, |_, _| [90, 180, 45])], &labels, bands);
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            assert_eq!(result.at(x, y), if inside(x, y) { [90, 180, 45] } else { [0; 3] });
        }
    }
}
