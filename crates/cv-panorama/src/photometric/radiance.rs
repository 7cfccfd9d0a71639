//! Scene radiance: linearized by the inverse response, exposures normalized by the gains, clipped pixels filled from other photographs.

use crate::bit_depth::{Channel, PhotoSample};
use crate::photometric::Gains;
use crate::rows::{for_each_row, is_check_due};
use crate::surface::{CLIPPED, WarpedPhoto};
use cv_core::{Cancelled, Image, ImageView, RgbF32, Stage};
use cv_parallel::prelude::*;

/// Minimum radiance of a replacement relative to the clipped value, which is a lower bound: darker samples show something else.
const MIN_REPLACEMENT_RATIO: f32 = 0.8;

/// Returns the gains relative to those of the reference photograph.
pub(crate) fn relative_gains(gains: &Gains, reference: usize) -> Gains {
    let of = gains.gains.get(reference).copied().unwrap_or([1.0; 3]);
    let gain = |gain: &[f32; 3]| std::array::from_fn(|c| gain[c] / of[c].max(f32::MIN_POSITIVE));
    Gains { gains: gains.gains.iter().map(gain).collect(), ..gains.clone() }
}

/// Linearizes a photograph: radiance in its own exposure, 1 for white.
pub(crate) fn decode_radiance<T: PhotoSample>(
    photo: ImageView<'_, T, 3>,
    gains: &Gains,
    stage: &Stage<'_>,
) -> Result<RgbF32, Cancelled> {
    let white = T::WHITE.index();
    let table: Vec<f32> = (0..=white).map(|v| gains.radiance(v as f64 / white as f64)).collect();
    let (width, height) = photo.size();
    let mut radiance = RgbF32::new(width, height, [0.0; 3]);
    for_each_row(radiance.as_mut_slice(), 3 * width, stage, |y, row| {
        row.iter_mut().zip(photo.row(y)).for_each(|(radiance, sample)| *radiance = table[sample.index()]);
    })?;
    Ok(radiance)
}

/// Replaces clipped pixels by the mean radiance of the photographs that are not clipped there and are consistent with the lower bound.
pub(crate) fn fill_saturated(photos: &mut [Option<WarpedPhoto<f32>>], stage: &Stage<'_>) -> Result<(), Cancelled> {
    let fill = |own: &WarpedPhoto<f32>| -> Result<Image<f32, 4>, Cancelled> {
        let b = own.bounds;
        let mut pixels = own.pixels.clone();
        for y in b.top..b.bottom {
            if is_check_due(y, 4 * b.width()) {
                stage.check()?;
            }
            let row = pixels.row_mut(y - b.top).as_chunks_mut::<4>().0;
            for (x, pixel) in (b.left..).zip(row).filter(|(_, pixel)| pixel[3] == CLIPPED) {
                let (mut sum, mut n) = ([0.0_f32; 3], 0.0);
                let bound = MIN_REPLACEMENT_RATIO * pixel[0].max(pixel[1]).max(pixel[2]);
                for other in photos.iter().flatten().filter(|other| other.bounds.contains(x, y)) {
                    let [r, g, b, a] = other.pixels.at(x - other.bounds.left, y - other.bounds.top);
                    if a == f32::OPAQUE && r.max(g).max(b) >= bound {
                        sum = [sum[0] + r, sum[1] + g, sum[2] + b];
                        n += 1.0;
                    }
                }
                if n > 0.0 {
                    (0..3).for_each(|c| pixel[c] = sum[c] / n);
                }
            }
        }
        Ok(pixels)
    };
    let filled: Vec<_> =
        photos.par_iter().map(|photo| photo.as_ref().map(fill).transpose()).try_collect::<_, Cancelled>()?;
    for (photo, filled) in photos.iter_mut().flatten().zip(filled.into_iter().flatten()) {
        photo.pixels = filled;
    }
    Ok(())
}
