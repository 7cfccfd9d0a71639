//! The light of the scene: levels undone by the response, exposures by the gains, and what one photograph clipped taken from others.

use crate::depth::{Channel, PhotoSample};
use crate::light::Gains;
use crate::rows::{asks, for_each_row};
use crate::surface::{CLIPPED, WarpedPhoto};
use cv_core::{Cancelled, Image, ImageView, RgbF32, Stage};
use rayon::prelude::*;

/// What a clipped sample has at the least, as a share of what it shows: others that show less saw something else there.
const BOUND: f32 = 0.8;

/// Gains by which the light of one photograph, at its middle, stays what it is.
pub(crate) fn relative_to(gains: &Gains, reference: usize) -> Gains {
    let of = gains.gains.get(reference).copied().unwrap_or([1.0; 3]);
    let gain = |gain: &[f32; 3]| std::array::from_fn(|c| gain[c] / of[c].max(f32::MIN_POSITIVE));
    Gains { gains: gains.gains.iter().map(gain).collect(), ..gains.clone() }
}

/// The light of a photograph in its own exposure: 1 is what it records as white.
pub(crate) fn light_of<T: PhotoSample>(
    photo: ImageView<'_, T, 3>,
    gains: &Gains,
    stage: &Stage<'_>,
) -> Result<RgbF32, Cancelled> {
    let white = T::WHITE.index();
    let table: Vec<f32> = (0..=white).map(|v| gains.light(v as f64 / white as f64)).collect();
    let (width, height) = photo.size();
    let mut light = RgbF32::new(width, height, [0.0; 3]);
    for_each_row(light.as_mut_slice(), 3 * width, stage, |y, row| {
        row.iter_mut().zip(photo.row(y)).for_each(|(light, sample)| *light = table[sample.index()]);
    })?;
    Ok(light)
}

/// Gives pixels that a photograph clipped the mean light of the photographs that did not, where they saw as much there.
pub(crate) fn fill_clipped(photos: &mut [Option<WarpedPhoto<f32>>], stage: &Stage<'_>) -> Result<(), Cancelled> {
    let fill = |own: &WarpedPhoto<f32>| -> Result<Image<f32, 4>, Cancelled> {
        let b = own.bounds;
        let mut pixels = own.pixels.clone();
        for y in b.top..b.bottom {
            if asks(y, 4 * b.width()) {
                stage.check()?;
            }
            let row = pixels.row_mut(y - b.top).as_chunks_mut::<4>().0;
            for (x, pixel) in (b.left..).zip(row).filter(|(_, pixel)| pixel[3] == CLIPPED) {
                let (mut sum, mut n) = ([0.0_f32; 3], 0.0);
                let bound = BOUND * pixel[0].max(pixel[1]).max(pixel[2]);
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
        photos.par_iter().map(|photo| photo.as_ref().map(fill).transpose()).collect::<Result<_, Cancelled>>()?;
    for (photo, filled) in photos.iter_mut().flatten().zip(filled.into_iter().flatten()) {
        photo.pixels = filled;
    }
    Ok(())
}
