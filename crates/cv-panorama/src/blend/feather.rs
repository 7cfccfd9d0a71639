//! Feathering: a linear transition across the seams.

use crate::bit_depth::Channel;
use crate::blend::{Blender, Composition, NO_PHOTO};
use crate::rows::{for_each_row, is_check_due};
use cv_core::{Cancelled, Image, Progress, Stage};

/// Half width of the transition in pixels.
const RADIUS: usize = 8;
/// Rows on either side of a pixel that its weights depend on.
pub(crate) const MARGIN: usize = RADIUS + 1;

/// Weights each photograph by the box-filtered indicator of its label, kernel side `2 · RADIUS + 1`.
pub(crate) struct Feather;

impl<T: Channel> Blender<T> for Feather {
    fn blend(&self, composition: &Composition<'_, T>, progress: &dyn Progress) -> Result<Image<T, 3>, Cancelled> {
        let (photos, labels) = (composition.photos, composition.labels);
        let (w, h) = labels.size();
        let stage = Stage::new(progress, "blend", photos.len() + 1)?;
        let mut sums = vec![[0.0_f32; 4]; w * h];
        for (label, photo) in photos.iter().enumerate() {
            let Some(photo) = photo else { continue };
            let b = photo.bounds;
            let (pw, ph) = (b.width(), b.height());
            // Separable box filter of the label's indicator by running sums.
            let mut across = vec![0.0_f32; pw * ph];
            for_each_row(&mut across, pw, &stage, |y, row| {
                let names = &labels.row(b.top + y)[b.left..][..pw];
                let own = |x: usize| if usize::from(names[x]) == label { 1.0 } else { 0.0 };
                let mut sum: f32 = (0..RADIUS.min(pw)).map(own).sum();
                for (x, out) in row.iter_mut().enumerate() {
                    if x + RADIUS < pw {
                        sum += own(x + RADIUS);
                    }
                    if x > RADIUS {
                        sum -= own(x - RADIUS - 1);
                    }
                    *out = sum;
                }
            })?;
            let mut column: Vec<f32> = vec![0.0; pw];
            for y in 0..RADIUS.min(ph) {
                column.iter_mut().zip(&across[y * pw..(y + 1) * pw]).for_each(|(s, v)| *s += v);
            }
            for y in 0..ph {
                if is_check_due(y, pw) {
                    stage.check()?;
                }
                if y + RADIUS < ph {
                    column.iter_mut().zip(&across[(y + RADIUS) * pw..]).for_each(|(s, v)| *s += v);
                }
                if y > RADIUS {
                    column.iter_mut().zip(&across[(y - RADIUS - 1) * pw..]).for_each(|(s, v)| *s -= v);
                }
                let out = &mut sums[(b.top + y) * w + b.left..][..pw];
                for ((out, p), weight) in out.iter_mut().zip(photo.pixels.row(y).as_chunks::<4>().0).zip(&column) {
                    if p[3] != T::default() && *weight > 0.5 {
                        for c in 0..3 {
                            out[c] += weight * p[c].to_f32();
                        }
                        out[3] += weight;
                    }
                }
            }
            stage.add(1)?;
        }
        let mut image = Image::new(w, h, [T::default(); 3]);
        for_each_row(image.as_mut_slice(), 3 * w, &stage, |y, row| {
            let sums = &sums[y * w..(y + 1) * w];
            for ((out, s), l) in row.as_chunks_mut::<3>().0.iter_mut().zip(sums).zip(labels.row(y)) {
                if *l != NO_PHOTO {
                    *out = [0, 1, 2].map(|c| T::from_f32(s[c] / s[3].max(1e-6)));
                }
            }
        })?;
        stage.add(1)?;
        Ok(image)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{Bounds, WarpedPhoto};
    use crate::testing::drawn;
    use cv_core::Silent;

    /// The definition: at each pixel the mean of the photographs that reach it, weighted by how many labels around name them.
    fn plain(photos: &[Option<WarpedPhoto>], labels: &Image<u16, 1>, x: usize, y: usize) -> [f64; 3] {
        let (mut sum, mut total) = ([0.0; 3], 0.0);
        for (label, photo) in photos.iter().enumerate() {
            let Some(photo) = photo else { continue };
            let b = photo.bounds;
            if !photo.reaches(x, y) {
                continue;
            }
            // Within the photograph's own bounds, as only there its weights are known.
            let inside =
                |v: usize, low: usize, high: usize| v.saturating_sub(RADIUS).max(low)..(v + RADIUS + 1).min(high);
            let around = inside(y, b.top, b.bottom).flat_map(|y| inside(x, b.left, b.right).map(move |x| (x, y)));
            let weight = around.filter(|&(x, y)| usize::from(labels.at(x, y)[0]) == label).count() as f64;
            let [r, g, b, _] = photo.pixels.at(x - b.left, y - b.top).map(f64::from);
            for (s, v) in sum.iter_mut().zip([r, g, b]) {
                *s += weight * v;
            }
            total += weight;
        }
        sum.map(|s| s / total)
    }

    #[test]
    fn running_sums_are_the_plain_definition() {
        let (w, h) = (53, 37);
        let left = drawn(Bounds { left: 0, top: 0, right: 40, bottom: h }, |x, y| [x as u8 * 3, y as u8 * 5, 40]);
        let right = drawn(Bounds { left: 9, top: 3, right: w, bottom: h }, |x, y| [200 - x as u8, y as u8, 90]);
        let mut third = drawn(Bounds { left: 20, top: 20, right: 33, bottom: 31 }, |_, _| [255, 0, 10]);
        // A photograph that does not reach a corner of its bounds, though the labels beside it name it.
        third.pixels.row_mut(0)[3] = 0;
        let photos = [Some(left), None, Some(right), Some(third)];
        let labels = Image::from_fn(w, h, |x, y| {
            let blob = (22..30).contains(&x) && (22..29).contains(&y);
            // The second photograph begins at row 3.
            let beside = if y >= 3 {
                2
            } else if x < 40 {
                0
            } else {
                NO_PHOTO
            };
            [if blob {
                3
            } else if x < 20 + y / 4 {
                0
            } else {
                beside
            }]
        });
        let composition = Composition { photos: &photos, labels: &labels, typical_side: 30.0 };
        let image = Feather.blend(&composition, &Silent).unwrap();
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            if labels.at(x, y)[0] == NO_PHOTO {
                assert_eq!(image.at(x, y), [0; 3]);
                continue;
            }
            for (got, want) in image.at(x, y).into_iter().zip(plain(&photos, &labels, x, y)) {
                // Half a level of rounding; the sums are of whole numbers, exact in f32.
                assert!((f64::from(got) - want).abs() < 0.501, "{x} {y}: {got} {want}");
            }
        }
    }

    #[test]
    fn a_straight_seam_becomes_a_linear_slope_over_the_width() {
        let whole = Bounds { left: 0, top: 0, right: 60, bottom: 40 };
        let photos = [Some(drawn(whole, |_, _| [0; 3])), Some(drawn(whole, |_, _| [170; 3]))];
        let labels = Image::from_fn(60, 40, |x, _| [u16::from(x >= 30)]);
        let composition = Composition { photos: &photos, labels: &labels, typical_side: 40.0 };
        let image = Feather.blend(&composition, &Silent).unwrap();
        for x in 0..60_i32 {
            // 17 columns in the square, of which x − 21 are on the right: 10 levels each.
            let expected = 10 * (x - 21).clamp(0, 17);
            assert_eq!(i32::from(image.at(x as usize, 20)[0]), expected, "{x}");
        }
    }
}
