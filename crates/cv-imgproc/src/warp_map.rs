//! Precomputed warps for many images of one size, such as the frames of a calibrated camera.
//!
//! The map is stored in fixed point, in blocks of eight result pixels: an origin in the source, an offset (step) from it for each pixel, and
//! fractions of 1/256 pixel. 8-bit samples are interpolated in integers: a window of 16 bytes of each source row of the block is shuffled to
//! the left and right neighbors of its pixels, for any map within the window. Blocks that span more than a window are processed pixel by pixel,
//! with identical results. Memory bandwidth limits the speed, so the map is compact: the part of the fractions below 1/256 px, which only
//! sample types other than 8-bit need, is stored separately.

use crate::byte_windows::{BLOCKS, ShufflePattern, SourceRows, WINDOW_BYTES, interpolate_four_blocks};
use crate::rows::for_rows;
use crate::sample::{bilinear_at, split_coordinate};
use crate::{Pixel, WarpError, simd};
use cv_core::{Image, ImageView, Mask, Point2};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};

/// Result pixels per block.
pub(crate) const LANES: usize = 8;
/// Channels of RGB, and parts of eight samples of an RGB block. Windows are used for RGB and gray images.
const RGB_CHANNELS: usize = 3;
/// Maximum row step of blocks that use windows: a rotation by 90° steps by one row per pixel.
const MAX_ROW_STEP: u8 = 8;
/// Maximum step: four bits for the column, four for the row.
const MAX_STEP: usize = 15;

/// Bytes per cache line.
const CACHE_LINE_BYTES: usize = 64;

/// The source positions of eight consecutive result pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Block {
    /// Minimum column and row of the base pixels (those left of and above the positions); of a scattered block `x` is its index among those.
    pub(crate) x: u32,
    pub(crate) y: u32,
    /// Eight steps from there to each base pixel, 16 · rows + columns; then eight fractions in x and eight in y, in 1/256. An unmapped pixel has
    /// the step of another.
    pub(crate) steps_and_fractions: [u8; 3 * LANES],
    /// Bit i: pixel i maps inside the source.
    inside: u8,
    /// Maximum row step.
    pub(crate) rows: u8,
    /// For RGB: minimum column step of the pixels of each part.
    min_column_step: [u8; RGB_CHANNELS],
    /// Bits [`GRAY_IN_WINDOWS`], [`RGB_IN_WINDOWS`], [`SCATTERED`].
    flags: u8,
}

/// Flags: the samples of a gray block fit into windows, those of an RGB block do, steps cannot reach all base pixels.
const GRAY_IN_WINDOWS: u8 = 1;
const RGB_IN_WINDOWS: u8 = 2;
const SCATTERED: u8 = 4;

/// Remainders of the fractions in x and y, in 1/65536.
type FineFractions = [[i8; LANES]; 2];

/// Base pixels of a scattered block, whose offsets exceed [`MAX_STEP`].
type Scattered = [[u32; 2]; LANES];

/// A precomputed inverse map: the source position of every result pixel, for source images of one size.
///
/// Bilinear interpolation; black where there is no source position or it is outside the source. Positions of 8-bit samples are rounded to
/// 1/256 px, so that results are within one gray level of `f32` interpolation ([`warp_with`](crate::warp_with)); other samples are interpolated
/// in `f32` at positions rounded to 1/65536 px. Memory: 7 bytes per result pixel.
///
/// ```
/// use cv_core::{GrayU8, Point2};
/// use cv_imgproc::WarpMap;
///
/// // Half a pixel to the left, for every frame.
/// let map = WarpMap::new((64, 48), (64, 48), |x, y| Some(Point2::new(x as f64 + 0.5, y as f64)))?;
/// let mut shifted = GrayU8::new(64, 48, [0]);
/// for time in 0..3 {
///     let frame = GrayU8::from_fn(64, 48, |x, _| [2 * x as u8 + time]);
///     map.compute_into(frame.view(), &mut shifted)?;
///     assert_eq!(shifted.at(10, 5), [21 + time]);
/// }
/// # Ok::<(), cv_imgproc::WarpError>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct WarpMap {
    source: (usize, usize),
    size: (usize, usize),
    /// Row-major; the last block of a row is padded.
    blocks: Vec<Block>,
    fine: Vec<FineFractions>,
    scattered: Vec<Scattered>,
}

impl WarpMap {
    /// Precomputes the map for results of `size` (width, height) whose pixel `(x, y)` is a source of size `source` at `map(x, y)`.
    ///
    /// Inside is `[0, w − 1] × [0, h − 1]`, between the outermost pixel centers. The map is called once per pixel, in unspecified order, from
    /// several threads.
    ///
    /// # Errors
    /// [`WarpError::Size`] where the map is larger than memory can address.
    pub fn new(
        source: (usize, usize),
        size: (usize, usize),
        map: impl Fn(usize, usize) -> Option<Point2<f64>> + Sync,
    ) -> Result<Self, WarpError> {
        // Sizes that cannot be addressed are refused as for images.
        let max_side = u32::MAX as usize;
        if size.0.checked_mul(size.1).is_none_or(|n| n > isize::MAX as usize / 16) || source.0.max(source.1) > max_side
        {
            let (width, height) = if source.0.max(source.1) > max_side { source } else { size };
            return Err(WarpError::Size(cv_core::ImageError::TooLarge { width, height, channels: 1 }));
        }
        let per_row = size.0.div_ceil(LANES);
        let mut blocks = vec![Block::UNMAPPED; per_row * size.1];
        let mut fine = vec![FineFractions::default(); per_row * size.1];
        let mut scattered = Vec::new();
        if source.0 > 0 && source.1 > 0 && per_row > 0 {
            // Scattered blocks are indexed within their row first.
            let row = |(y, (blocks, fine)): (usize, (&mut [Block], &mut [FineFractions]))| {
                let mut row_scattered = Vec::new();
                for (i, (block, fine)) in blocks.iter_mut().zip(fine).enumerate() {
                    let at = |k: usize| {
                        let x = LANES * i + k;
                        let p = if x < size.0 { map(x, y)? } else { return None };
                        Some([
                            round_coordinate(split_coordinate(p.x, source.0)?),
                            round_coordinate(split_coordinate(p.y, source.1)?),
                        ])
                    };
                    (*block, *fine) = Block::new(std::array::from_fn(at), &mut row_scattered);
                }
                row_scattered
            };
            let rows = blocks.par_chunks_mut(per_row).zip(fine.par_chunks_mut(per_row));
            let row_scattered: Vec<Vec<Scattered>> = rows.enumerate().map(row).collect();
            for (y, row_scattered) in
                row_scattered.into_iter().enumerate().filter(|(_, row_scattered)| !row_scattered.is_empty())
            {
                for block in blocks[y * per_row..][..per_row].iter_mut().filter(|b| b.flags & SCATTERED != 0) {
                    block.x += scattered.len() as u32;
                }
                scattered.extend(row_scattered);
            }
        }
        Ok(Self { source, size, blocks, fine, scattered })
    }

    /// Returns width and height of the source images.
    pub fn source_size(&self) -> (usize, usize) {
        self.source
    }

    /// Returns width and height of the results.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Returns the mask of result pixels that map inside the source.
    pub fn inside(&self) -> Mask {
        let per_row = self.size.0.div_ceil(LANES);
        Mask::from_fn(self.size.0, self.size.1, |x, y| {
            [self.blocks[y * per_row + x / LANES].inside >> (x % LANES) & 1 == 1]
        })
    }

    /// Warps an image.
    ///
    /// # Errors
    /// [`WarpError::SourceSize`] where the image does not have the source size of the map.
    pub fn compute<T: Pixel, const C: usize>(&self, frame: ImageView<'_, T, C>) -> Result<Image<T, C>, WarpError> {
        let mut out = Image::try_new(self.size.0, self.size.1, [T::default(); C])?;
        self.compute_into(frame, &mut out)?;
        Ok(out)
    }

    /// As [`WarpMap::compute`] into an existing image of the result size; writes every pixel and allocates nothing.
    ///
    /// # Errors
    /// [`WarpError::SourceSize`], [`WarpError::ResultSize`].
    pub fn compute_into<T: Pixel, const C: usize>(
        &self,
        frame: ImageView<'_, T, C>,
        out: &mut Image<T, C>,
    ) -> Result<(), WarpError> {
        if frame.size() != self.source {
            return Err(WarpError::SourceSize { got: frame.size(), expected: self.source });
        }
        if out.size() != self.size {
            return Err(WarpError::ResultSize { got: out.size(), expected: self.size });
        }
        let level = simd::level();
        let per_row = self.size.0.div_ceil(LANES);
        for_rows(out, |y, row| {
            let blocks = &self.blocks[y * per_row..][..per_row];
            match (T::as_bytes(frame), T::as_bytes_mut(row)) {
                (Some(frame), Some(row)) => {
                    if let Some(gray) = frame.with_channels() {
                        self.remap_gray_row(level, gray, blocks, row);
                    } else if let Some(rgb) = frame.with_channels() {
                        self.remap_rgb_row(level, rgb, blocks, row);
                    } else {
                        self.interpolate_blocks(frame, blocks, row);
                    }
                }
                _ => self.remap_row(frame, blocks, &self.fine[y * per_row..][..per_row], row),
            }
        });
        Ok(())
    }

    /// Returns base pixel `k` of a block.
    #[inline(always)]
    fn base(&self, block: &Block, k: usize) -> (usize, usize) {
        if block.flags & SCATTERED != 0 {
            let [x, y] = self.scattered[block.x as usize][k];
            (x as usize, y as usize)
        } else {
            let step = usize::from(block.steps_and_fractions[k]);
            (block.x as usize + (step & MAX_STEP), block.y as usize + (step >> 4))
        }
    }

    /// Warps one row in `f32`.
    fn remap_row<T: Pixel, const C: usize>(
        &self,
        frame: ImageView<'_, T, C>,
        blocks: &[Block],
        fine: &[FineFractions],
        out: &mut [T],
    ) {
        for ((block, fine), out) in blocks.iter().zip(fine).zip(out.chunks_mut(LANES * C)) {
            for (k, out) in out.as_chunks_mut::<C>().0.iter_mut().enumerate() {
                *out = [T::default(); C];
                if block.inside >> k & 1 == 1 {
                    let (x, y) = self.base(block, k);
                    let [fx, fy] = block.fractions(k).map(f64::from);
                    let [x, y] = [
                        x as f64 + fx / 256.0 + f64::from(fine[0][k]) / 65536.0,
                        y as f64 + fy / 256.0 + f64::from(fine[1][k]) / 65536.0,
                    ];
                    // The position was inside, up to rounding.
                    if let (Some((x, fx)), Some((y, fy))) =
                        (split_coordinate(x, frame.width()), split_coordinate(y, frame.height()))
                    {
                        *out = bilinear_at(frame, x, y, fx, fy).map(T::from_f32);
                    }
                }
            }
        }
    }

    /// As [`WarpMap::remap_byte_row`] of one channel. Not generic, so that it is compiled with the optimizations of this crate, whatever those of
    /// the caller's crate are.
    #[inline(never)]
    fn remap_gray_row(&self, level: Level, frame: ImageView<'_, u8, 1>, blocks: &[Block], out: &mut [u8]) {
        self.remap_byte_row(level, frame, blocks, out);
    }

    /// As [`WarpMap::remap_gray_row`] of RGB.
    #[inline(never)]
    fn remap_rgb_row(&self, level: Level, frame: ImageView<'_, u8, RGB_CHANNELS>, blocks: &[Block], out: &mut [u8]) {
        self.remap_byte_row(level, frame, blocks, out);
    }

    /// Warps pixel by pixel.
    #[inline(always)]
    fn interpolate_blocks<const C: usize>(&self, frame: ImageView<'_, u8, C>, blocks: &[Block], out: &mut [u8]) {
        for (block, out) in blocks.iter().zip(out.chunks_mut(LANES * C)) {
            for (k, out) in out.as_chunks_mut::<C>().0.iter_mut().enumerate() {
                *out = [0; C];
                if block.inside >> k & 1 == 1 {
                    *out = interpolate_bytes(frame, self.base(block, k), block.fractions(k));
                }
            }
        }
    }

    /// Warps one row of 8-bit samples with SIMD, pixel by pixel where blocks do not fit into windows.
    #[inline(always)]
    fn remap_byte_row<const C: usize>(
        &self,
        level: Level,
        frame: ImageView<'_, u8, C>,
        blocks: &[Block],
        out: &mut [u8],
    ) {
        dispatch!(level, simd => self.remap_byte_row_simd(simd, frame, blocks, out));
    }

    #[inline(always)]
    fn remap_byte_row_simd<S: Simd, const C: usize>(
        &self,
        simd: S,
        frame: ImageView<'_, u8, C>,
        blocks: &[Block],
        out: &mut [u8],
    ) {
        let windows = frame.width() * C >= WINDOW_BYTES;
        let patterns: [ShufflePattern<S>; RGB_CHANNELS] =
            std::array::from_fn(|part| ShufflePattern::new(simd, part, C));
        let is_simple = |block: &Block| windows && block.fits_windows(C);
        if windows && frame.height() > 0 {
            prefetch(frame, blocks);
        }
        // Four blocks at a time; the end of a row by itself.
        for (four, out) in blocks.chunks(BLOCKS).zip(out.chunks_mut(BLOCKS * LANES * C)) {
            match <&[Block; BLOCKS]>::try_from(four) {
                Ok(four) if out.len() == BLOCKS * LANES * C && four.iter().all(is_simple) => {
                    let rows = four.each_ref().map(|block| SourceRows::new(frame, block));
                    for (part, pattern) in patterns.iter().enumerate().take(C) {
                        let bytes = interpolate_four_blocks(simd, frame, (four, &rows), (part, pattern));
                        for (k, out) in out.chunks_exact_mut(LANES * C).enumerate() {
                            out[part * LANES..(part + 1) * LANES].copy_from_slice(&bytes[k * LANES..(k + 1) * LANES]);
                        }
                    }
                    for (block, out) in four.iter().zip(out.chunks_exact_mut(LANES * C)) {
                        clear_outside::<C>(block, out);
                    }
                }
                _ => self.interpolate_blocks(frame, four, out),
            }
        }
    }
}

/// Prefetches the lowest source row that the blocks are likely to need, by reading a byte of each cache line: the loads overlap, where the
/// windows would wait for one after the other. Rows are too short for the hardware prefetcher.
#[inline(always)]
fn prefetch<const C: usize>(frame: ImageView<'_, u8, C>, blocks: &[Block]) {
    let last = frame.height() - 1;
    let first_byte = |block: &Block| frame.row((block.y as usize + 2).min(last))[C * block.x as usize];
    let near =
        blocks.iter().step_by((CACHE_LINE_BYTES / (LANES * C)).max(1)).filter(|block| block.flags & SCATTERED == 0);
    std::hint::black_box(near.fold(0, |all, block| all ^ first_byte(block)));
}

/// Sets the pixels of a block that do not map inside the source to black.
#[inline(always)]
fn clear_outside<const C: usize>(block: &Block, out: &mut [u8]) {
    if block.inside != u8::MAX {
        for (k, out) in out.as_chunks_mut::<C>().0.iter_mut().enumerate() {
            *out = if block.inside >> k & 1 == 1 { *out } else { [0; C] };
        }
    }
}

/// A fixed-point coordinate: base index, fraction in 1/256, and its remainder in 1/65536.
#[derive(Debug, Clone, Copy)]
struct FixedCoordinate {
    base: usize,
    fraction: u8,
    fine: i8,
}

/// Rounds a base index and a fraction from 0 to 1 to the nearest 1/65536.
fn round_coordinate((base, fraction): (usize, f32)) -> FixedCoordinate {
    let all = (fraction * 65536.0).round() as i32;
    // Nearest 1/256, which may carry into the next pixel.
    let coarse = (all + 128) >> 8;
    let fine = (all - (coarse << 8)) as i8;
    FixedCoordinate { base: base + (coarse >> 8) as usize, fraction: (coarse & 255) as u8, fine }
}

impl Block {
    /// A block without source positions.
    const UNMAPPED: Self = Self {
        x: 0,
        y: 0,
        steps_and_fractions: [0; 3 * LANES],
        inside: 0,
        rows: 0,
        min_column_step: [0; RGB_CHANNELS],
        flags: 0,
    };

    fn new(at: [Option<[FixedCoordinate; 2]>; LANES], row_scattered: &mut Vec<Scattered>) -> (Self, FineFractions) {
        let (mut block, mut fine) = (Self::UNMAPPED, FineFractions::default());
        let Some(mut last) = at.iter().flatten().next().copied() else { return (block, fine) };
        // An unmapped pixel takes the position of the one before it, or of the first.
        let all = at.map(|p| {
            last = p.unwrap_or(last);
            last
        });
        for (k, p) in at.iter().enumerate() {
            block.inside |= u8::from(p.is_some()) << k;
            for (axis, p) in p.iter().flatten().enumerate() {
                block.steps_and_fractions[LANES * (axis + 1) + k] = p.fraction;
                fine[axis][k] = p.fine;
            }
        }
        let [x, y] = [0, 1].map(|axis: usize| all.iter().map(|p| p[axis].base).min().unwrap_or(0));
        if all.iter().any(|p| p[0].base - x > MAX_STEP || p[1].base - y > MAX_STEP) {
            block.flags = SCATTERED;
            block.x = row_scattered.len() as u32;
            row_scattered.push(all.map(|p| p.map(|p| p.base as u32)));
            return (block, fine);
        }
        (block.x, block.y) = (x as u32, y as u32);
        for (k, p) in all.iter().enumerate() {
            let row = (p[1].base - y) as u8;
            block.steps_and_fractions[k] = (p[0].base - x) as u8 | row << 4;
            block.rows = block.rows.max(row);
        }
        for (part, min_column_step) in block.min_column_step.iter_mut().enumerate() {
            let pixels = LANES * part / RGB_CHANNELS..(LANES * (part + 1)).div_ceil(RGB_CHANNELS);
            *min_column_step = block.steps_and_fractions[pixels].iter().map(|step| step & 15).min().unwrap_or(0);
        }
        for (channels, flag) in [(1, GRAY_IN_WINDOWS), (RGB_CHANNELS, RGB_IN_WINDOWS)] {
            // Each sample, and its right neighbor where its weight is not zero, must be in the window of its part.
            let fits = |sample: usize| {
                let (pixel, channel) = (sample / channels, sample % channels);
                let step = usize::from(block.steps_and_fractions[pixel]) & MAX_STEP;
                let right = usize::from(block.fractions(pixel)[0] > 0);
                channels * (step - block.window_step(sample / LANES, channels) + right) + channel < WINDOW_BYTES
            };
            if block.rows <= MAX_ROW_STEP && (0..LANES * channels).all(fits) {
                block.flags |= flag;
            }
        }
        (block, fine)
    }

    /// Returns the fractions in x and y of pixel `k`, in 1/256.
    #[inline(always)]
    fn fractions(&self, k: usize) -> [u8; 2] {
        [self.steps_and_fractions[LANES + k], self.steps_and_fractions[2 * LANES + k]]
    }

    /// Returns the column step at which the window of a part begins.
    #[inline(always)]
    pub(crate) fn window_step(&self, part: usize, channels: usize) -> usize {
        if channels == 1 { 0 } else { self.min_column_step[part].into() }
    }

    /// Whether the block fits into windows for the given number of channels.
    #[inline(always)]
    fn fits_windows(&self, channels: usize) -> bool {
        match channels {
            1 => self.flags & GRAY_IN_WINDOWS != 0,
            RGB_CHANNELS => self.flags & RGB_IN_WINDOWS != 0,
            _ => false,
        }
    }
}

/// Interpolates an 8-bit pixel bilinearly in integers: along both rows, then between them, rounded once at the end.
#[inline(always)]
fn interpolate_bytes<const C: usize>(
    frame: ImageView<'_, u8, C>,
    (x, y): (usize, usize),
    fractions: [u8; 2],
) -> [u8; C] {
    let right = (x + 1).min(frame.width() - 1) * C;
    let (above, below) = (frame.row(y), frame.row((y + 1).min(frame.height() - 1)));
    let [fx, fy] = fractions.map(u32::from);
    let along = |row: &[u8], c: usize| u32::from(row[x * C + c]) * (256 - fx) + u32::from(row[right + c]) * fx;
    std::array::from_fn(|c| ((along(above, c) * (256 - fy) + along(below, c) * fy + (1 << 15)) >> 16) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RemapOptions, warp_with};
    use cv_core::{GrayF32, GrayU8, RgbU8};
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    /// Deterministic pseudo-random numbers from 0 to 1.
    fn random(seed: u32) -> impl FnMut() -> f64 {
        let mut state = seed | 1;
        move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24)
        }
    }

    fn noise<const C: usize>(w: usize, h: usize, seed: u32) -> Image<u8, C> {
        let mut random = random(seed);
        // Includes saturated black and white, the largest differences.
        Image::from_fn(w, h, |_, _| std::array::from_fn(|_| (random() * 400.0 - 72.0).clamp(0.0, 255.0) as u8))
    }

    /// A linear map about the center, partly outside the source, with 1 % unmapped and 1 % random positions.
    fn irregular_map(
        w: usize,
        h: usize,
        m: [f64; 4],
        seed: u32,
    ) -> impl Fn(usize, usize) -> Option<Point2<f64>> + Sync {
        move |x, y| {
            let mut random = random(seed ^ (x * 7919 + y * 104_729) as u32);
            random();
            if random() < 0.01 {
                return None;
            }
            if random() < 0.01 {
                return Some(Point2::new(random() * w as f64, random() * h as f64));
            }
            let (u, v) = (x as f64 - 20.0, y as f64 - 8.0);
            let middle = (w as f64 / 2.0, h as f64 / 2.0);
            Some(Point2::new(middle.0 + m[0] * u + m[1] * v, middle.1 + m[2] * u + m[3] * v))
        }
    }

    /// Compares all instruction sets with pixel-by-pixel interpolation.
    fn check_against_reference<const C: usize>(
        w: usize,
        h: usize,
        m: [f64; 4],
        seed: u32,
    ) -> Result<(), TestCaseError> {
        let frame = noise::<C>(w, h, seed);
        let map = WarpMap::new((w, h), (43, 17), irregular_map(w, h, m, seed)).unwrap();
        let mut reference = Image::<u8, C>::new(43, 17, [0; C]);
        for y in 0..17 {
            for x in 0..43 {
                let block = &map.blocks[y * 6 + x / 8];
                if block.inside >> (x % 8) & 1 == 1 {
                    reference.set(
                        x,
                        y,
                        interpolate_bytes(frame.view(), map.base(block, x % 8), block.fractions(x % 8)),
                    );
                }
            }
        }
        let mut out = Image::<u8, C>::new(43, 17, [77; C]);
        for level in instruction_sets() {
            for y in 0..17 {
                map.remap_byte_row(level, frame.view(), &map.blocks[y * 6..][..6], out.row_mut(y));
            }
            prop_assert_eq!(&out, &reference, "{:?}", level);
        }
        Ok(())
    }

    proptest! {
        #[test]
        fn every_instruction_set_equals_the_scalar_reference(
            w in 1usize..70, h in 1usize..40, scale in 0.2..1.6f64, angle in -3.2..3.2f64, seed in any::<u32>(),
        ) {
            let (sin, cos) = angle.sin_cos();
            let m = [scale * cos, -scale * sin, scale * sin, scale * cos];
            check_against_reference::<1>(w, h, m, seed)?;
            check_against_reference::<2>(w, h, m, seed)?;
            check_against_reference::<3>(w, h, m, seed)?;
            check_against_reference::<5>(w, h, m, seed)?;
        }

        #[test]
        fn fixed_point_is_within_one_level_of_float_interpolation(
            w in 2usize..60, h in 2usize..40, scale in 0.2..2.0f64, angle in -3.2..3.2f64, seed in any::<u32>(),
        ) {
            let (sin, cos) = angle.sin_cos();
            let source = irregular_map(w, h, [scale * cos, -scale * sin, scale * sin, scale * cos], seed);
            let frame = noise::<3>(w, h, seed);
            let (float, inside) = warp_with(frame.view(), (43, 17), &RemapOptions::default(), &source).unwrap();
            let map = WarpMap::new((w, h), (43, 17), &source).unwrap();
            prop_assert_eq!(map.inside(), inside);
            let fixed = map.compute(frame.view()).unwrap();
            for (a, b) in fixed.as_slice().iter().zip(float.as_slice()) {
                // Half a unit of either fraction is 255 / 512 levels, less than one in total: such values round to the same or adjacent levels.
                prop_assert!(a.abs_diff(*b) <= 1, "{} {}", a, b);
            }
        }

        #[test]
        fn float_and_16_bit_samples_equal_those_of_warp_with(scale in 0.2..2.0f64, seed in any::<u32>()) {
            let source = irregular_map(50, 30, [scale, 0.1, -0.1, scale], seed);
            let mut random = random(seed);
            let frame = GrayF32::from_fn(50, 30, |_, _| [random() as f32]);
            let deep = Image::<u16, 3>::from_fn(50, 30, |_, _| std::array::from_fn(|_| (random() * 65535.0) as u16));
            let map = WarpMap::new((50, 30), (43, 17), &source).unwrap();
            let options = RemapOptions::default();
            let float = warp_with(frame.view(), (43, 17), &options, &source).unwrap().0;
            for (a, b) in map.compute(frame.view()).unwrap().as_slice().iter().zip(float.as_slice()) {
                // Half a unit of the fraction, 1/131072 px, on a slope of at most 1 each way; and f32.
                prop_assert!((a - b).abs() < 2e-5, "{} {}", a, b);
            }
            let float = warp_with(deep.view(), (43, 17), &options, &source).unwrap().0;
            for (a, b) in map.compute(deep.view()).unwrap().as_slice().iter().zip(float.as_slice()) {
                // Half a level each way, and the rounding.
                prop_assert!(a.abs_diff(*b) <= 2, "{} {}", a, b);
            }
        }
    }

    #[test]
    fn the_map_of_a_rectification_fits_into_windows() {
        // The speed depends on it: a rotation of 3° with 10 % distortion, as in rectification. Unmapped blocks excluded.
        let source = |x: usize, y: usize| {
            let (u, v) = ((x as f64 - 320.0) / 500.0, (y as f64 - 240.0) / 500.0);
            let r = 1.0 - 0.1 * (u * u + v * v);
            Some(Point2::new(320.0 + 500.0 * r * (u - 0.05 * v), 240.0 + 500.0 * r * (v + 0.05 * u)))
        };
        let map = WarpMap::new((640, 480), (640, 480), source).unwrap();
        assert!(map.blocks.iter().all(|b| b.inside == 0 || b.flags == GRAY_IN_WINDOWS | RGB_IN_WINDOWS));
        // A rotation by 90° too.
        let map = WarpMap::new((640, 480), (480, 640), |x, y| Some(Point2::new(y as f64, 479.0 - x as f64))).unwrap();
        assert!(map.blocks.iter().all(|b| b.flags == GRAY_IN_WINDOWS | RGB_IN_WINDOWS));
        let frame = noise::<3>(640, 480, 3);
        let rotated = map.compute(frame.view()).unwrap();
        assert!((0..640).all(|y| (0..480).all(|x| rotated.at(x, y) == frame.at(y, 479 - x))));
    }

    #[test]
    fn wrong_sizes_are_errors_and_empty_sizes_give_empty_results() {
        let map = WarpMap::new((8, 8), (20, 4), |x, y| Some(Point2::new(x as f64, y as f64))).unwrap();
        assert_eq!((map.source_size(), map.size()), ((8, 8), (20, 4)));
        let error = map.compute(GrayU8::new(8, 7, [1]).view()).unwrap_err();
        assert_eq!(error, WarpError::SourceSize { got: (8, 7), expected: (8, 8) });
        let error = map.compute_into(GrayU8::new(8, 8, [1]).view(), &mut GrayU8::new(4, 20, [0])).unwrap_err();
        assert_eq!(error, WarpError::ResultSize { got: (4, 20), expected: (20, 4) });
        let huge = WarpMap::new((8, 8), (usize::MAX, 2), |_, _| None);
        assert!(matches!(huge, Err(WarpError::Size(_))));
        for (source, size) in [((0, 0), (3, 2)), ((8, 8), (0, 5)), ((8, 0), (5, 0))] {
            let map = WarpMap::new(source, size, |_, _| Some(Point2::origin())).unwrap();
            let out = map.compute(RgbU8::new(source.0, source.1, [9; 3]).view()).unwrap();
            assert!(out.as_slice().iter().all(|&v| v == 0) && out.size() == size);
        }
    }

    #[test]
    fn the_previous_content_of_the_output_image_is_overwritten() {
        let map = WarpMap::new((30, 30), (30, 3), |x, _| (x != 9).then(|| Point2::new(x as f64 - 4.0, 2.0))).unwrap();
        let mut out = GrayU8::new(30, 3, [200]);
        map.compute_into(GrayU8::new(30, 30, [50]).view(), &mut out).unwrap();
        assert!((0..30).all(|x| out.at(x, 1) == [if x < 4 || x == 9 { 0 } else { 50 }]));
        let mut out = GrayF32::new(30, 3, [0.7]);
        map.compute_into(GrayF32::new(30, 30, [0.5]).view(), &mut out).unwrap();
        assert!((0..30).all(|x| out.at(x, 1) == [if x < 4 || x == 9 { 0.0 } else { 0.5 }]));
    }
}
