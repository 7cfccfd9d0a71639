//! Conversion of images to the 16-bit gray levels that the matcher takes.

use crate::census::{Gray, MARGIN};
use cv_core::{ImageView, Sample, luma_u16};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;

/// A channel type that the matcher accepts.
pub trait Intensity: Sample {
    /// Converts to the scale 0 to 65535.
    fn to_u16(self) -> u16;
    /// Returns false for NaN and infinities.
    fn is_number(self) -> bool {
        true
    }
    /// Converts a row of pixels of `channels` interleaved samples to gray levels of 0 to 65535, one per pixel, with Rec. 601 weights for three
    /// or more channels; of two, the first is used. Returns the number of samples that are NaN or infinite.
    ///
    /// Not generic, so that it is compiled with the optimizations of this crate, whatever those of its caller: at `opt-level = "z"` it takes
    /// twelve times as long.
    fn gray_row(samples: &[Self], channels: usize, gray: &mut [u16]) -> usize;
}

impl Intensity for u8 {
    #[inline]
    fn to_u16(self) -> u16 {
        u16::from(self) * 257
    }
    fn gray_row(samples: &[Self], channels: usize, gray: &mut [u16]) -> usize {
        gray_row(samples, channels, gray)
    }
}

impl Intensity for u16 {
    #[inline]
    fn to_u16(self) -> u16 {
        self
    }
    fn gray_row(samples: &[Self], channels: usize, gray: &mut [u16]) -> usize {
        gray_row(samples, channels, gray)
    }
}

/// From 0 to 1; values outside are clamped.
impl Intensity for f32 {
    #[inline]
    fn to_u16(self) -> u16 {
        (self.clamp(0.0, 1.0) * 65535.0 + 0.5) as u16
    }
    #[inline]
    fn is_number(self) -> bool {
        self.is_finite()
    }
    fn gray_row(samples: &[Self], channels: usize, gray: &mut [u16]) -> usize {
        gray_row(samples, channels, gray)
    }
}

fn gray_row<T: Intensity>(samples: &[T], channels: usize, gray: &mut [u16]) -> usize {
    dispatch!(Level::new(), simd => match channels {
        0 => {}
        1 => convert::<_, T, 1>(simd, samples, gray),
        2 => convert::<_, T, 2>(simd, samples, gray),
        3 => convert::<_, T, 3>(simd, samples, gray),
        4 => convert::<_, T, 4>(simd, samples, gray),
        _ => {
            for (pixel, gray) in samples.chunks_exact(channels).zip(gray) {
                *gray = luma_u16([pixel[0], pixel[1], pixel[2]].map(T::to_u16));
            }
        }
    });
    samples.iter().map(|v| usize::from(!v.is_number())).sum()
}

/// Converts a row; in integers, so that every instruction set gives the same bytes.
#[simd]
fn convert<S: Simd, T: Intensity, const C: usize>(_: S, samples: &[T], out: &mut [u16]) {
    for (pixel, gray) in samples.as_chunks::<C>().0.iter().zip(out) {
        *gray = if C >= 3 {
            luma_u16([pixel[0].to_u16(), pixel[1].to_u16(), pixel[2].to_u16()])
        } else {
            pixel[0].to_u16()
        };
    }
}

/// Converts `view` to gray into `out` (resized). Returns the number of samples that are NaN or infinite.
pub(crate) fn to_gray<T: Intensity, const C: usize>(view: ImageView<'_, T, C>, out: &mut Gray) -> usize {
    let (width, height) = view.size();
    (out.width, out.height) = (width, height);
    let stride = out.stride();
    out.values.resize(stride * height, 0);
    if view.is_empty() || C == 0 {
        return 0;
    }
    let rows = out.values.par_chunks_mut(stride).enumerate();
    let counts = rows.map(|(y, row)| {
        let count = T::gray_row(view.row(y), C, &mut row[MARGIN..MARGIN + width]);
        let (first, last) = (row[MARGIN], row[MARGIN + width - 1]);
        row[..MARGIN].fill(first);
        row[MARGIN + width..].fill(last);
        count
    });
    counts.collect().iter().sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Image;

    #[test]
    fn gray_in_color_is_the_same_gray() {
        let gray = Image::<u8, 1>::from_fn(256, 1, |x, _| [x as u8]);
        let rgb = gray.map(|[v]| [v; 3]);
        let (mut a, mut b) = (Gray::default(), Gray::default());
        to_gray(gray.view(), &mut a);
        to_gray(rgb.view(), &mut b);
        assert_eq!(a.values, b.values);
        assert_eq!((a.values[MARGIN], a.values[MARGIN + 255]), (0, 65535));
    }

    #[test]
    fn nan_and_infinite_samples_are_counted() {
        let image = Image::<f32, 1>::from_vec(2, 2, vec![0.5, f32::NAN, f32::INFINITY, 2.0]).unwrap();
        let mut out = Gray::default();
        assert_eq!(to_gray(image.view(), &mut out), 2);
        assert_eq!((out.values[MARGIN], out.values[out.stride() + MARGIN + 1]), (32768, 65535));
    }

    #[test]
    fn of_many_channels_the_first_three_are_the_color_and_none_are_no_pixels() {
        let samples: Vec<u8> = (0..30).map(|i| i * 8).collect();
        let rgb: Vec<u8> = samples.chunks_exact(5).flat_map(|pixel| pixel[..3].to_vec()).collect();
        let (mut of_five, mut of_three) = ([0; 6], [0; 6]);
        u8::gray_row(&samples, 5, &mut of_five);
        u8::gray_row(&rgb, 3, &mut of_three);
        assert_eq!(of_five, of_three);
        let mut unchanged = [7; 2];
        assert_eq!(u8::gray_row(&samples, 0, &mut unchanged), 0);
        assert_eq!(unchanged, [7; 2]);
    }
}
