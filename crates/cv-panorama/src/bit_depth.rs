//! Sample types of photographs: 8 and 16 bits.
//!
//! The panorama has the bit depth of the photographs; alignment, exposure and seams are estimated on 8 bits. The methods dispatch generic code so that it is
//! compiled, and optimized, in this crate instead of the caller's, once per depth.

use crate::align::Alignment;
use crate::blend::{BlendMode, Blender, of_mode};
use crate::masks::PhotoMask;
use crate::render::{CompositingOptions, Panorama, RenderError, draw};
use crate::rows::for_each_row;
use crate::stream::{MemoryLimit, PhotoSource, RowSink, draw_streamed};
use crate::surface::{WarpedPhoto, downsample_box};
use cv_core::{Cancelled, Image, ImageView, Progress, RgbU8, Stage};
use cv_imgproc::{Pixel, SAMPLE_LANES, bicubic_rgb_lanes, resize_area};
use cv_parallel::prelude::*;
use fearless_simd::Simd;
use std::borrow::Cow;
use std::ops::{Add, Mul};

/// Sample type of photographs and panoramas: `u8`, or `u16` with 65535 for white; sRGB-encoded, not linear.
pub trait PhotoSample: Internals {
    /// Maximum value: white, or fully opaque.
    const WHITE: Self;
}

impl PhotoSample for u8 {
    const WHITE: Self = 255;
}

impl PhotoSample for u16 {
    const WHITE: Self = 65535;
}

/// One coordinate, in pixels, of the positions that are interpolated at once.
pub(crate) type Positions<'a> = &'a [f32; SAMPLE_LANES];

/// The three channels at these positions.
pub(crate) type Colors = [[f32; SAMPLE_LANES]; 3];

/// Sample type of warped photographs: a [`PhotoSample`], or linear radiance in `f32`.
pub trait Channel: Pixel {
    /// Opacity where a photograph covers a pixel.
    const OPAQUE: Self;
    /// Sample units per gray level of 8 bits.
    const PER_LEVEL: f32;
    /// Quantization steps per gray level of the tone tables.
    const PARTS: usize;
    /// Whether samples are linear radiance.
    const LINEAR: bool = false;
    /// Integer type of sums of up to 256 samples.
    type Sum: Sum;

    fn widened(self) -> Self::Sum;

    /// As [`bicubic_rgb_lanes`] for bytes; `None` for other types, whose positions are interpolated one by one.
    #[inline(always)]
    fn bicubic_lanes<S: Simd>(_: S, _: ImageView<'_, Self, 3>, _: Positions<'_>, _: Positions<'_>) -> Option<Colors> {
        None
    }
}

/// Internal operations of a [`PhotoSample`].
pub trait Internals: Channel {
    /// Converts the sample to an index.
    fn index(self) -> usize;

    /// Averages blocks of `step × step` pixels, 2 or more.
    fn shrunk(photo: ImageView<'_, Self, 3>, step: usize, stage: &Stage<'_>) -> Result<Image<Self, 3>, Cancelled>;

    /// Converts to 8 bits; `None` where it has 8 bits already.
    fn in_8_bits(photo: ImageView<'_, Self, 3>, stage: &Stage<'_>) -> Result<Option<RgbU8>, Cancelled>;

    /// Converts warped photographs to 8 bits.
    fn drawn_in_8_bits<'a>(
        photos: &'a [Option<WarpedPhoto<Self>>],
        stage: &Stage<'_>,
    ) -> Result<Cow<'a, [Option<WarpedPhoto>]>, Cancelled>;

    /// As [`Internals::drawn_in_8_bits`], of one photograph.
    fn warped_in_8_bits(photo: WarpedPhoto<Self>, stage: &Stage<'_>) -> Result<Option<WarpedPhoto>, Cancelled> {
        let mut copies = Self::drawn_in_8_bits(&[Some(photo)], stage)?.into_owned();
        Ok(copies.pop().flatten())
    }

    fn blender(mode: BlendMode) -> &'static dyn Blender<Self>
    where
        Self: PhotoSample;

    /// Returns the samples as bytes, for [`Internals::fill_from_bytes`] of the same process.
    fn bytes_of(samples: &[Self]) -> Cow<'_, [u8]>;

    /// Fills samples from the bytes that `read` writes.
    fn fill_from_bytes<E>(samples: &mut [Self], read: impl FnOnce(&mut [u8]) -> Result<(), E>) -> Result<(), E>;

    fn draw_streamed(
        photos: &dyn PhotoSource<Self>,
        alignment: &Alignment,
        options: &CompositingOptions,
        limit: MemoryLimit,
        output: &mut dyn RowSink<Self>,
        progress: &dyn Progress,
    ) -> Result<Panorama<Self>, RenderError>
    where
        Self: PhotoSample;

    fn draw(
        photos: &[ImageView<'_, Self, 3>],
        masks: &[Option<&PhotoMask>],
        alignment: &Alignment,
        options: &CompositingOptions,
        blender: &dyn Blender<Self>,
        progress: &dyn Progress,
    ) -> Result<Panorama<Self>, RenderError>
    where
        Self: PhotoSample;
}

/// Sums of samples, exact where they are integers.
pub trait Sum: Copy + Default + Send + Sync + From<u8> + Add<Output = Self> + Mul<Output = Self> {
    fn to_f32(self) -> f32;
}

impl Sum for u16 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        f32::from(self)
    }
}

impl Sum for f32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        self
    }
}

impl Sum for u32 {
    #[inline(always)]
    fn to_f32(self) -> f32 {
        // 256 · 65535 is less than 2²⁴.
        self as f32
    }
}

impl Channel for u8 {
    const OPAQUE: Self = 255;
    const PER_LEVEL: f32 = 1.0;
    const PARTS: usize = 1;
    type Sum = u16;

    #[inline(always)]
    fn widened(self) -> u16 {
        u16::from(self)
    }

    #[inline(always)]
    fn bicubic_lanes<S: Simd>(
        simd: S,
        view: ImageView<'_, u8, 3>,
        us: Positions<'_>,
        vs: Positions<'_>,
    ) -> Option<Colors> {
        bicubic_rgb_lanes(simd, view, us, vs)
    }
}

/// The methods that compile whole stages for a bit depth. In each implementation rather than in the trait: a provided method would be generic, and
/// compiled again in every crate that calls it, with the optimizations of that crate.
macro_rules! compiled_here {
    () => {
        #[inline(never)]
        fn blender(mode: BlendMode) -> &'static dyn Blender<Self> {
            of_mode(mode)
        }

        #[inline(never)]
        fn draw(
            photos: &[ImageView<'_, Self, 3>],
            masks: &[Option<&PhotoMask>],
            alignment: &Alignment,
            options: &CompositingOptions,
            blender: &dyn Blender<Self>,
            progress: &dyn Progress,
        ) -> Result<Panorama<Self>, RenderError> {
            draw(photos, masks, alignment, options, blender, progress)
        }

        #[inline(never)]
        fn draw_streamed(
            photos: &dyn PhotoSource<Self>,
            alignment: &Alignment,
            options: &CompositingOptions,
            limit: MemoryLimit,
            output: &mut dyn RowSink<Self>,
            progress: &dyn Progress,
        ) -> Result<Panorama<Self>, RenderError> {
            draw_streamed(photos, alignment, options, limit, output, progress)
        }
    };
}

impl Internals for u8 {
    fn index(self) -> usize {
        usize::from(self)
    }

    fn shrunk(photo: ImageView<'_, Self, 3>, step: usize, stage: &Stage<'_>) -> Result<Image<Self, 3>, Cancelled> {
        downsample_box(photo, step, stage)
    }

    fn in_8_bits(_: ImageView<'_, Self, 3>, _: &Stage<'_>) -> Result<Option<RgbU8>, Cancelled> {
        Ok(None)
    }

    fn drawn_in_8_bits<'a>(
        photos: &'a [Option<WarpedPhoto>],
        _: &Stage<'_>,
    ) -> Result<Cow<'a, [Option<WarpedPhoto>]>, Cancelled> {
        Ok(Cow::Borrowed(photos))
    }

    fn warped_in_8_bits(photo: WarpedPhoto, _: &Stage<'_>) -> Result<Option<WarpedPhoto>, Cancelled> {
        Ok(Some(photo))
    }

    fn bytes_of(samples: &[Self]) -> Cow<'_, [u8]> {
        Cow::Borrowed(samples)
    }

    fn fill_from_bytes<E>(samples: &mut [Self], read: impl FnOnce(&mut [u8]) -> Result<(), E>) -> Result<(), E> {
        read(samples)
    }

    compiled_here!();
}

impl Channel for u16 {
    const OPAQUE: Self = 65535;
    const PER_LEVEL: f32 = 257.0;
    const PARTS: usize = 8;
    type Sum = u32;

    #[inline(always)]
    fn widened(self) -> u32 {
        u32::from(self)
    }
}

impl Channel for f32 {
    const OPAQUE: Self = 1.0;
    const PER_LEVEL: f32 = 1.0;
    const PARTS: usize = 1;
    const LINEAR: bool = true;
    type Sum = f32;

    #[inline(always)]
    fn widened(self) -> f32 {
        self
    }
}

impl Internals for u16 {
    fn index(self) -> usize {
        usize::from(self)
    }

    fn shrunk(photo: ImageView<'_, Self, 3>, step: usize, stage: &Stage<'_>) -> Result<Image<Self, 3>, Cancelled> {
        stage.check()?;
        let (width, height) = ((photo.width() / step).max(1), (photo.height() / step).max(1));
        // Incomplete blocks are dropped, as for bytes.
        let whole = photo.crop(0, 0, (width * step).min(photo.width()), (height * step).min(photo.height()));
        let small = whole.and_then(|whole| resize_area(whole, width, height).ok());
        Ok(small.unwrap_or_else(|| photo.to_image()))
    }

    fn in_8_bits(photo: ImageView<'_, Self, 3>, stage: &Stage<'_>) -> Result<Option<RgbU8>, Cancelled> {
        let (width, height) = photo.size();
        let mut copy = RgbU8::new(width, height, [0; 3]);
        for_each_row(copy.as_mut_slice(), 3 * width, stage, |y, row| to_bytes(photo.row(y), row))?;
        Ok(Some(copy))
    }

    fn drawn_in_8_bits<'a>(
        photos: &'a [Option<WarpedPhoto<Self>>],
        stage: &Stage<'_>,
    ) -> Result<Cow<'a, [Option<WarpedPhoto>]>, Cancelled> {
        let copy = |photo: &WarpedPhoto<Self>| {
            let (width, height) = photo.pixels.size();
            let mut pixels = Image::new(width, height, [0; 4]);
            for_each_row(pixels.as_mut_slice(), 4 * width, stage, |y, row| to_bytes(photo.pixels.row(y), row))?;
            Ok(WarpedPhoto { bounds: photo.bounds, pixels })
        };
        photos.iter().map(|photo| photo.as_ref().map(copy).transpose()).collect::<Result<_, _>>().map(Cow::Owned)
    }

    fn bytes_of(samples: &[Self]) -> Cow<'_, [u8]> {
        Cow::Owned(samples.iter().flat_map(|v| v.to_ne_bytes()).collect())
    }

    fn fill_from_bytes<E>(samples: &mut [Self], read: impl FnOnce(&mut [u8]) -> Result<(), E>) -> Result<(), E> {
        let mut bytes = vec![0; 2 * samples.len()];
        read(&mut bytes)?;
        samples.iter_mut().zip(bytes.as_chunks::<2>().0).for_each(|(v, b)| *v = u16::from_ne_bytes(*b));
        Ok(())
    }

    compiled_here!();
}

/// Rounds to the nearest of 8 bits.
fn to_bytes(deep: &[u16], bytes: &mut [u8]) {
    for (byte, deep) in bytes.iter_mut().zip(deep) {
        *byte = ((u32::from(*deep) + 128) / 257) as u8;
    }
}

/// 8-bit views of photographs: borrowed, or of converted copies.
#[derive(Debug)]
pub struct EightBits<'a> {
    views: Vec<ImageView<'a, u8, 3>>,
    copies: Vec<RgbU8>,
}

impl<'a> EightBits<'a> {
    /// Converts photographs of any depth, rounding to the nearest level. O(samples) for 16 bits, reported as `stage`, a unit per photograph.
    ///
    /// # Errors
    /// [`Cancelled`] where `progress` says so.
    pub fn new<T: PhotoSample>(
        photos: &[ImageView<'a, T, 3>],
        stage: &'static str,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        if let Some(views) = photos.iter().map(|photo| T::as_bytes(*photo)).collect() {
            return Ok(Self { views, copies: Vec::new() });
        }
        let stage = Stage::new(progress, stage, photos.len())?;
        let copy = |photo: &ImageView<'a, T, 3>| {
            let copy = T::in_8_bits(*photo, &stage)?;
            stage.add(1)?;
            Ok(copy)
        };
        let copies: Vec<Option<RgbU8>> = photos.par_iter().map(copy).try_collect::<_, Cancelled>()?;
        Ok(Self { views: Vec::new(), copies: copies.into_iter().flatten().collect() })
    }

    /// Returns the views in the order of the photographs.
    pub fn views(&self) -> Vec<ImageView<'_, u8, 3>> {
        self.views.iter().copied().chain(self.copies.iter().map(RgbU8::view)).collect()
    }
}
