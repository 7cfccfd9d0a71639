//! Warps whose map is made once and used for many pictures: the frames of a calibrated camera.
//!
//! The map is kept in fixed point, eight result pixels to a block: the block's first source pixel, a step from there for each of the eight, and fractions of 1/256
//! pixel. Bytes are interpolated in integers: a window of 16 bytes from each source row that a block touches is shuffled to the left and right neighbors of its
//! pixels, whatever way the map takes within the window. A block that spans more than a window goes pixel by pixel; both ways give the same bytes. The map is read as
//! fast as the pictures are, so it is kept small: what is finer than 1/256 px, which only samples other than bytes need, lies apart.

use crate::rows::for_rows;
use crate::sample::{bilinear_at, split};
use crate::{Pixel, WarpError, simd};
use cv_core::{Image, ImageView, Mask, Point2};
use fearless_simd::{Level, dispatch, i16x16, prelude::*, u8x16, u8x32, u16x16, u32x8};
use rayon::prelude::*;

/// Result pixels of a block.
const LANES: usize = 8;
/// Bytes of a window.
const WINDOW: usize = 16;
/// Channels of RGB. Windows are used for them and for one channel; there are as many parts of eight samples in a block.
const RGB: usize = 3;
/// Rows beyond the first that windows are taken from: a map that turns by a quarter steps by one each pixel.
const MOST_ROWS: u8 = 8;
/// The most that a step can be: half a byte for the column, half for the row.
const MOST_STEP: usize = 15;

/// Bytes of a cache line.
const LINE: usize = 64;

/// Eight result pixels of a row and where they come from.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Block {
    /// The least column and row of the base pixels (those left of and above the positions); where the block is scattered, `x` is its number among those.
    x: u32,
    y: u32,
    /// Eight steps from there to each base pixel, 16 · rows + columns; then eight fractions in x and eight in y, of 256. A pixel that comes from nowhere has the
    /// step of another.
    numbers: [u8; 3 * LANES],
    /// Bit i: pixel i comes from inside the source.
    inside: u8,
    /// The largest step of a row.
    rows: u8,
    /// Of RGB: the least column step of the pixels of each part.
    least: [u8; RGB],
    /// Bits: windows of one channel hold it, windows of RGB do, it is scattered.
    flags: u8,
}

const GRAY_FITS: u8 = 1;
const RGB_FITS: u8 = 2;
const SCATTERED: u8 = 4;

/// What fractions in x and y are more, of 65536.
type Fine = [[i8; LANES]; 2];

/// Base pixels of a block that steps cannot reach.
type Scattered = [[u32; 2]; LANES];

/// Where every pixel of a result comes from, for pictures of one size.
///
/// Bilinear, and black where the map leads nowhere or outside the source. Bytes are within one level of the interpolation in `f32`
/// ([`warp_with`](crate::warp_with)): positions count to 1/256 px. Other samples are interpolated in `f32` at positions to 1/65536 px. Memory: 7 bytes for each
/// pixel of the result.
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
    /// Row by row, the last one of a row filled up.
    blocks: Vec<Block>,
    fine: Vec<Fine>,
    scattered: Vec<Scattered>,
}

impl WarpMap {
    /// The map of results of `size` (width, height) whose pixel `(x, y)` is that of a source of size `source` at `map(x, y)`.
    ///
    /// Inside is `[0, w − 1] × [0, h − 1]`, between the outermost pixel centers. The map is called once for each pixel, in no particular order, from several
    /// threads.
    ///
    /// # Errors
    /// [`WarpError::Size`] where the map is larger than memory can address.
    pub fn new(
        source: (usize, usize),
        size: (usize, usize),
        map: impl Fn(usize, usize) -> Option<Point2<f64>> + Sync,
    ) -> Result<Self, WarpError> {
        // What cannot be addressed as a picture is refused as one.
        let most = u32::MAX as usize;
        if size.0.checked_mul(size.1).is_none_or(|n| n > isize::MAX as usize / 16) || source.0.max(source.1) > most {
            let (width, height) = if source.0.max(source.1) > most { source } else { size };
            return Err(WarpError::Size(cv_core::ImageError::TooLarge { width, height, channels: 1 }));
        }
        let per_row = size.0.div_ceil(LANES);
        let mut blocks = vec![Block::NOWHERE; per_row * size.1];
        let mut fine = vec![Fine::default(); per_row * size.1];
        let mut scattered = Vec::new();
        if source.0 > 0 && source.1 > 0 && per_row > 0 {
            // Scattered blocks are numbered within their row first.
            let row = |(y, (blocks, fine)): (usize, (&mut [Block], &mut [Fine]))| {
                let mut far = Vec::new();
                for (i, (block, fine)) in blocks.iter_mut().zip(fine).enumerate() {
                    let at = |k: usize| {
                        let x = LANES * i + k;
                        let p = if x < size.0 { map(x, y)? } else { return None };
                        Some([rounded(split(p.x, source.0)?), rounded(split(p.y, source.1)?)])
                    };
                    (*block, *fine) = Block::new(std::array::from_fn(at), &mut far);
                }
                far
            };
            let rows = blocks.par_chunks_mut(per_row).zip(fine.par_chunks_mut(per_row));
            let far: Vec<Vec<Scattered>> = rows.enumerate().map(row).collect();
            for (y, far) in far.into_iter().enumerate().filter(|(_, far)| !far.is_empty()) {
                for block in blocks[y * per_row..][..per_row].iter_mut().filter(|b| b.flags & SCATTERED != 0) {
                    block.x += scattered.len() as u32;
                }
                scattered.extend(far);
            }
        }
        Ok(Self { source, size, blocks, fine, scattered })
    }

    /// Width and height of the pictures it is for.
    pub fn source_size(&self) -> (usize, usize) {
        self.source
    }

    /// Width and height of the results.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Which pixels of the results come from inside the source.
    pub fn inside(&self) -> Mask {
        let per_row = self.size.0.div_ceil(LANES);
        Mask::from_fn(self.size.0, self.size.1, |x, y| {
            [self.blocks[y * per_row + x / LANES].inside >> (x % LANES) & 1 == 1]
        })
    }

    /// The result for a picture.
    ///
    /// # Errors
    /// [`WarpError::SourceSize`] where the picture is not of the size that the map is for.
    pub fn compute<T: Pixel, const C: usize>(&self, frame: ImageView<'_, T, C>) -> Result<Image<T, C>, WarpError> {
        let mut out = Image::try_new(self.size.0, self.size.1, [T::default(); C])?;
        self.compute_into(frame, &mut out)?;
        Ok(out)
    }

    /// As [`WarpMap::compute`] into an image of the result's size, every pixel of which is written. Allocates nothing.
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
                (Some(frame), Some(row)) => self.bytes(level, frame, blocks, row),
                _ => self.plain(frame, blocks, &self.fine[y * per_row..][..per_row], row),
            }
        });
        Ok(())
    }

    /// Base pixel `k` of a block.
    #[inline(always)]
    fn base(&self, block: &Block, k: usize) -> (usize, usize) {
        if block.flags & SCATTERED != 0 {
            let [x, y] = self.scattered[block.x as usize][k];
            (x as usize, y as usize)
        } else {
            let step = usize::from(block.numbers[k]);
            (block.x as usize + (step & MOST_STEP), block.y as usize + (step >> 4))
        }
    }

    /// A row in `f32`.
    fn plain<T: Pixel, const C: usize>(
        &self,
        frame: ImageView<'_, T, C>,
        blocks: &[Block],
        fine: &[Fine],
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
                    // Which is where it was inside, to a rounding.
                    if let (Some((x, fx)), Some((y, fy))) = (split(x, frame.width()), split(y, frame.height())) {
                        *out = bilinear_at(frame, x, y, fx, fy).map(T::from_f32);
                    }
                }
            }
        }
    }

    /// A row of bytes.
    fn bytes<const C: usize>(&self, level: Level, frame: ImageView<'_, u8, C>, blocks: &[Block], out: &mut [u8]) {
        dispatch!(level, simd => self.bytes_impl(simd, frame, blocks, out));
    }

    #[inline(always)]
    fn bytes_impl<S: Simd, const C: usize>(
        &self,
        simd: S,
        frame: ImageView<'_, u8, C>,
        blocks: &[Block],
        out: &mut [u8],
    ) {
        let windows = frame.width() * C >= WINDOW;
        let patterns: [Pattern<S>; RGB] = std::array::from_fn(|part| Pattern::new(simd, part, C));
        let is_simple = |block: &Block| windows && block.is_in_windows(C);
        if windows && frame.height() > 0 {
            fetch(frame, blocks);
        }
        // Two at a time; the end of a row by itself.
        for (pair, out) in blocks.chunks(2).zip(out.chunks_mut(2 * LANES * C)) {
            match pair {
                [one, two] if out.len() == 2 * LANES * C && is_simple(one) && is_simple(two) => {
                    let pair = [one, two].map(|block| (block, Rows::new(frame, block)));
                    let (first, second) = out.split_at_mut(LANES * C);
                    let parts = first.as_chunks_mut::<LANES>().0.iter_mut().zip(second.as_chunks_mut::<LANES>().0);
                    for ((part, (first, second)), pattern) in parts.enumerate().zip(&patterns) {
                        (*first, *second) = sixteen(simd, frame, &pair, (part, pattern));
                    }
                    black_outside::<C>(one, first);
                    black_outside::<C>(two, second);
                }
                _ => pair.iter().zip(out.chunks_mut(LANES * C)).for_each(|(block, out)| {
                    for (k, out) in out.as_chunks_mut::<C>().0.iter_mut().enumerate() {
                        *out = [0; C];
                        if block.inside >> k & 1 == 1 {
                            *out = byte_pixel(frame, self.base(block, k), block.fractions(k));
                        }
                    }
                }),
            }
        }
    }
}

/// Reads a byte of the lowest row that blocks are likely to need, of each cache line one. Those lines then come to the cache side by side, where the windows would wait for one after the
/// other: each row of the source is new once, and too short for the processor to see ahead.
#[inline(always)]
fn fetch<const C: usize>(frame: ImageView<'_, u8, C>, blocks: &[Block]) {
    let last = frame.height() - 1;
    let first_byte = |block: &Block| frame.row((block.y as usize + 2).min(last))[C * block.x as usize];
    let near = blocks.iter().step_by((LINE / (LANES * C)).max(1)).filter(|block| block.flags & SCATTERED == 0);
    std::hint::black_box(near.fold(0, |all, block| all ^ first_byte(block)));
}

/// Makes those pixels of a block black that come from nowhere.
#[inline(always)]
fn black_outside<const C: usize>(block: &Block, out: &mut [u8]) {
    if block.inside != u8::MAX {
        for (k, out) in out.as_chunks_mut::<C>().0.iter_mut().enumerate() {
            *out = if block.inside >> k & 1 == 1 { *out } else { [0; C] };
        }
    }
}

/// A coordinate: its base index, its fraction of 256, and what that is more, of 65536.
#[derive(Debug, Clone, Copy)]
struct Rounded {
    base: usize,
    fraction: u8,
    fine: i8,
}

/// A base index and a fraction from 0 to 1, to the nearest of 65536.
fn rounded((base, fraction): (usize, f32)) -> Rounded {
    let all = (fraction * 65536.0).round() as i32;
    // To the nearest 1/256, which may be the next pixel.
    let coarse = (all + 128) >> 8;
    let fine = (all - (coarse << 8)) as i8;
    Rounded { base: base + (coarse >> 8) as usize, fraction: (coarse & 255) as u8, fine }
}

impl Block {
    /// Comes from nowhere.
    const NOWHERE: Self = Self { x: 0, y: 0, numbers: [0; 3 * LANES], inside: 0, rows: 0, least: [0; RGB], flags: 0 };

    fn new(at: [Option<[Rounded; 2]>; LANES], far: &mut Vec<Scattered>) -> (Self, Fine) {
        let (mut block, mut fine) = (Self::NOWHERE, Fine::default());
        let Some(mut last) = at.iter().flatten().next().copied() else { return (block, fine) };
        // Of a pixel that comes from nowhere the one before it, or the first.
        let all = at.map(|p| {
            last = p.unwrap_or(last);
            last
        });
        for (k, p) in at.iter().enumerate() {
            block.inside |= u8::from(p.is_some()) << k;
            for (axis, p) in p.iter().flatten().enumerate() {
                block.numbers[LANES * (axis + 1) + k] = p.fraction;
                fine[axis][k] = p.fine;
            }
        }
        let [x, y] = [0, 1].map(|axis: usize| all.iter().map(|p| p[axis].base).min().unwrap_or(0));
        if all.iter().any(|p| p[0].base - x > MOST_STEP || p[1].base - y > MOST_STEP) {
            block.flags = SCATTERED;
            block.x = far.len() as u32;
            far.push(all.map(|p| p.map(|p| p.base as u32)));
            return (block, fine);
        }
        (block.x, block.y) = (x as u32, y as u32);
        for (k, p) in all.iter().enumerate() {
            let row = (p[1].base - y) as u8;
            block.numbers[k] = (p[0].base - x) as u8 | row << 4;
            block.rows = block.rows.max(row);
        }
        for (part, least) in block.least.iter_mut().enumerate() {
            let pixels = LANES * part / RGB..(LANES * (part + 1)).div_ceil(RGB);
            *least = block.numbers[pixels].iter().map(|step| step & 15).min().unwrap_or(0);
        }
        for (channels, flag) in [(1, GRAY_FITS), (RGB, RGB_FITS)] {
            // Each sample is within the window of its part, and its right neighbor where that counts.
            let holds = |sample: usize| {
                let (pixel, channel) = (sample / channels, sample % channels);
                let step = usize::from(block.numbers[pixel]) & MOST_STEP;
                let right = usize::from(block.fractions(pixel)[0] > 0);
                channels * (step - block.least_step(sample / LANES, channels) + right) + channel < WINDOW
            };
            if block.rows <= MOST_ROWS && (0..LANES * channels).all(holds) {
                block.flags |= flag;
            }
        }
        (block, fine)
    }

    /// Fractions in x and y of pixel `k`, of 256.
    #[inline(always)]
    fn fractions(&self, k: usize) -> [u8; 2] {
        [self.numbers[LANES + k], self.numbers[2 * LANES + k]]
    }

    /// The column step at which the window of a part begins.
    #[inline(always)]
    fn least_step(&self, part: usize, channels: usize) -> usize {
        if channels == 1 { 0 } else { self.least[part].into() }
    }

    /// Whether the windows of a picture of so many channels hold it.
    #[inline(always)]
    fn is_in_windows(&self, channels: usize) -> bool {
        match channels {
            1 => self.flags & GRAY_FITS != 0,
            RGB => self.flags & RGB_FITS != 0,
            _ => false,
        }
    }
}

/// A pixel of bytes in integers: along both rows, then between them, and rounded once at the end.
#[inline(always)]
fn byte_pixel<const C: usize>(frame: ImageView<'_, u8, C>, (x, y): (usize, usize), fractions: [u8; 2]) -> [u8; C] {
    let right = (x + 1).min(frame.width() - 1) * C;
    let (above, below) = (frame.row(y), frame.row((y + 1).min(frame.height() - 1)));
    let [fx, fy] = fractions.map(u32::from);
    let along = |row: &[u8], c: usize| u32::from(row[x * C + c]) * (256 - fx) + u32::from(row[right + c]) * fx;
    std::array::from_fn(|c| ((along(above, c) * (256 - fy) + along(below, c) * fy + (1 << 15)) >> 16) as u8)
}

/// How the pixels of two blocks become eight samples of each.
#[derive(Clone, Copy)]
struct Pattern<S: Simd> {
    /// Of each sample twice: the pixel it is of.
    columns: u8x32<S>,
    /// Likewise, where the fractions stand in the upper half.
    fractions: u8x32<S>,
    /// Its channel, and that plus the channels: the same channel of the right neighbor.
    channel: u8x32<S>,
}

impl<S: Simd> Pattern<S> {
    #[inline(always)]
    fn new(simd: S, part: usize, channels: usize) -> Self {
        // Of no use beyond the samples of a block.
        let part = part.min(channels.max(1) - 1);
        let sample = |i: usize| LANES * part + i / 2;
        let of = |f: &dyn Fn(usize) -> usize| {
            let bytes: [u8; 2 * WINDOW] = std::array::from_fn(|i| f(i % WINDOW) as u8);
            u8x32::from_slice(simd, &bytes)
        };
        Self {
            columns: of(&|i| sample(i) / channels),
            fractions: of(&|i| LANES + sample(i) / channels),
            channel: of(&|i| sample(i) % channels + i % 2 * channels),
        }
    }
}

/// The first three rows of the source that a block is made of.
struct Rows<'a>([&'a [u8]; 3]);

impl<'a> Rows<'a> {
    #[inline(always)]
    fn new<const C: usize>(frame: ImageView<'a, u8, C>, block: &Block) -> Self {
        let y = block.y as usize;
        Self([y, y + 1, y + 2].map(|y| frame.row(y.min(frame.height() - 1))))
    }
}

/// Eight samples of each of two blocks that fit into windows, as [`byte_pixel`] computes them.
#[inline(always)]
fn sixteen<S: Simd, const C: usize>(
    simd: S,
    frame: ImageView<'_, u8, C>,
    pair: &[(&Block, Rows<'_>); 2],
    (part, pattern): (usize, &Pattern<S>),
) -> ([u8; LANES], [u8; LANES]) {
    let [one, two] = pair;
    let length = frame.width() * C;
    let first = |block: &Block| C * block.x as usize;
    // Not beyond the end of the row; so much further in the window lies all of it then.
    let start = |block: &Block| (first(block) + C * block.least_step(part, C)).min(length - WINDOW);
    let starts = [start(one.0), start(two.0)];
    let both = |a: &[u8], b: &[u8]| u8x16::from_slice(simd, a).combine(u8x16::from_slice(simd, b));
    // Steps and fractions in x; fractions in x and in y.
    let numbers = |i: usize| both(&one.0.numbers[i..i + WINDOW], &two.0.numbers[i..i + WINDOW]);
    let (front, back) = (numbers(0), numbers(LANES));
    let steps = front.swizzle_dyn_within_blocks(pattern.columns);
    let (columns, row_steps) = (steps & 15, steps >> 4);
    let mut index = pattern.channel;
    for _ in 0..C {
        index += columns;
    }
    // Differences of bytes, whole multiples of 256 aside.
    let moved = |k: usize, block: &Block| u8x16::splat(simd, starts[k].wrapping_sub(first(block)) as u8);
    index -= moved(0, one.0).combine(moved(1, two.0));
    let window = |a: &[u8], b: &[u8]| -> u8x32<S> {
        let windows = both(&a[starts[0]..starts[0] + WINDOW], &b[starts[1]..starts[1] + WINDOW]);
        windows.swizzle_dyn_within_blocks(index)
    };
    // Two rows at the least, most often three: with no branch between, which would be as often mistaken as not.
    let near = |i: usize| window(one.1.0[i], two.1.0[i]);
    let (upper, middle, mut below) = (near(0), near(1), near(2));
    let reached = row_steps.simd_ge(u8x32::splat(simd, 1));
    let (mut top, mut bottom) = (reached.select(middle, upper), reached.select(below, middle));
    for row in 2..=one.0.rows.max(two.0.rows) {
        let at = |block: &Block| frame.row((block.y as usize + 1 + usize::from(row)).min(frame.height() - 1));
        let above = below;
        below = window(at(one.0), at(two.0));
        let reached = row_steps.simd_ge(u8x32::splat(simd, row));
        top = reached.select(above, top);
        bottom = reached.select(below, bottom);
    }
    let fraction = |numbers: u8x32<S>| -> u16x16<S> {
        let twice: u16x16<S> = numbers.swizzle_dyn_within_blocks(pattern.fractions).bitcast();
        twice & 255
    };
    let (fx, fy) = (fraction(front), fraction(back));
    let along = |pairs: u8x32<S>| -> u32x8<S> {
        // Bytes of a lane: left, right. Sums and products wrap; what comes out is at most 255 · 256, and 32768 less fits an i16.
        let pairs: u16x16<S> = pairs.bitcast();
        let (left, right) = (pairs & 255, pairs >> 8);
        (((left << 8) + fx * (right - left)) ^ (1 << 15)).bitcast()
    };
    // Of two rows of 16 bits the even samples side by side, and the odd ones.
    let paired = |a: u32x8<S>, b: u32x8<S>| -> [i16x16<S>; 2] {
        [((a & 0xFFFF) | (b << 16)).bitcast(), ((a >> 16) | (b & 0xFFFF_0000)).bitcast()]
    };
    let values = paired(along(top), along(bottom));
    let weights = paired((u16x16::splat(simd, 256) - fy).bitcast(), fy.bitcast());
    // The weights are 256 in all: so many times 32768 were missing. The result is in the upper half.
    let sum =
        |i: usize| -> u32x8<S> { (values[i].pairwise_dot_product(weights[i]) + ((1 << 23) + (1 << 15))).bitcast() };
    let words: u16x16<S> = ((sum(0) >> 16) | (sum(1) & 0xFFFF_0000)).bitcast();
    let (low, high) = words.split();
    let bytes = low.narrow(high);
    (std::array::from_fn(|i| bytes[i]), std::array::from_fn(|i| bytes[LANES + i]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{RemapOptions, warp_with};
    use cv_core::{GrayF32, GrayU8, RgbU8};
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    /// Numbers from 0 to 1, always the same.
    fn random(seed: u32) -> impl FnMut() -> f64 {
        let mut state = seed | 1;
        move || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state >> 8) / f64::from(1 << 24)
        }
    }

    fn noise<const C: usize>(w: usize, h: usize, seed: u32) -> Image<u8, C> {
        let mut random = random(seed);
        // Black and white among the rest: the largest differences there are.
        Image::from_fn(w, h, |_, _| std::array::from_fn(|_| (random() * 400.0 - 72.0).clamp(0.0, 255.0) as u8))
    }

    /// A linear map about the middle, some of it outside, some of it nowhere; now and then a wild pixel.
    fn wild(w: usize, h: usize, m: [f64; 4], seed: u32) -> impl Fn(usize, usize) -> Option<Point2<f64>> + Sync {
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

    /// All instruction sets against one pixel after the other.
    fn held_to_the_plain<const C: usize>(w: usize, h: usize, m: [f64; 4], seed: u32) -> Result<(), TestCaseError> {
        let frame = noise::<C>(w, h, seed);
        let map = WarpMap::new((w, h), (43, 17), wild(w, h, m, seed)).unwrap();
        let mut plain = Image::<u8, C>::new(43, 17, [0; C]);
        for y in 0..17 {
            for x in 0..43 {
                let block = &map.blocks[y * 6 + x / 8];
                if block.inside >> (x % 8) & 1 == 1 {
                    plain.set(x, y, byte_pixel(frame.view(), map.base(block, x % 8), block.fractions(x % 8)));
                }
            }
        }
        let mut out = Image::<u8, C>::new(43, 17, [77; C]);
        for level in instruction_sets() {
            for y in 0..17 {
                map.bytes(level, frame.view(), &map.blocks[y * 6..][..6], out.row_mut(y));
            }
            prop_assert_eq!(&out, &plain, "{:?}", level);
        }
        Ok(())
    }

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_plain_bytes(
            w in 1usize..70, h in 1usize..40, scale in 0.2..1.6f64, angle in -3.2..3.2f64, seed in any::<u32>(),
        ) {
            let (sin, cos) = angle.sin_cos();
            let m = [scale * cos, -scale * sin, scale * sin, scale * cos];
            held_to_the_plain::<1>(w, h, m, seed)?;
            held_to_the_plain::<2>(w, h, m, seed)?;
            held_to_the_plain::<3>(w, h, m, seed)?;
            held_to_the_plain::<5>(w, h, m, seed)?;
        }

        #[test]
        fn bytes_are_within_one_level_of_the_float_ones(
            w in 2usize..60, h in 2usize..40, scale in 0.2..2.0f64, angle in -3.2..3.2f64, seed in any::<u32>(),
        ) {
            let (sin, cos) = angle.sin_cos();
            let source = wild(w, h, [scale * cos, -scale * sin, scale * sin, scale * cos], seed);
            let frame = noise::<3>(w, h, seed);
            let (float, inside) = warp_with(frame.view(), (43, 17), &RemapOptions::default(), &source).unwrap();
            let map = WarpMap::new((w, h), (43, 17), &source).unwrap();
            prop_assert_eq!(map.inside(), inside);
            let fixed = map.compute(frame.view()).unwrap();
            for (a, b) in fixed.as_slice().iter().zip(float.as_slice()) {
                // Half a unit of either fraction is 255 / 512 levels, less than one in all: two values that near round to the same or to neighbors.
                prop_assert!(a.abs_diff(*b) <= 1, "{} {}", a, b);
            }
        }

        #[test]
        fn other_samples_are_those_of_a_warp(scale in 0.2..2.0f64, seed in any::<u32>()) {
            let source = wild(50, 30, [scale, 0.1, -0.1, scale], seed);
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
    fn the_map_of_a_camera_fits_into_windows() {
        // What the speed rests on: a turn of 3° with a tenth of distortion, as rectification makes them. Pixels that come from nowhere aside.
        let source = |x: usize, y: usize| {
            let (u, v) = ((x as f64 - 320.0) / 500.0, (y as f64 - 240.0) / 500.0);
            let r = 1.0 - 0.1 * (u * u + v * v);
            Some(Point2::new(320.0 + 500.0 * r * (u - 0.05 * v), 240.0 + 500.0 * r * (v + 0.05 * u)))
        };
        let map = WarpMap::new((640, 480), (640, 480), source).unwrap();
        assert!(map.blocks.iter().all(|b| b.inside == 0 || b.flags == GRAY_FITS | RGB_FITS));
        // A quarter turn too.
        let map = WarpMap::new((640, 480), (480, 640), |x, y| Some(Point2::new(y as f64, 479.0 - x as f64))).unwrap();
        assert!(map.blocks.iter().all(|b| b.flags == GRAY_FITS | RGB_FITS));
        let frame = noise::<3>(640, 480, 3);
        let turned = map.compute(frame.view()).unwrap();
        assert!((0..640).all(|y| (0..480).all(|x| turned.at(x, y) == frame.at(y, 479 - x))));
    }

    #[test]
    fn wrong_sizes_are_errors_and_empty_ones_are_empty() {
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
    fn what_an_image_held_before_does_not_shine_through() {
        let map = WarpMap::new((30, 30), (30, 3), |x, _| (x != 9).then(|| Point2::new(x as f64 - 4.0, 2.0))).unwrap();
        let mut out = GrayU8::new(30, 3, [200]);
        map.compute_into(GrayU8::new(30, 30, [50]).view(), &mut out).unwrap();
        assert!((0..30).all(|x| out.at(x, 1) == [if x < 4 || x == 9 { 0 } else { 50 }]));
        let mut out = GrayF32::new(30, 3, [0.7]);
        map.compute_into(GrayF32::new(30, 30, [0.5]).view(), &mut out).unwrap();
        assert!((0..30).all(|x| out.at(x, 1) == [if x < 4 || x == 9 { 0.0 } else { 0.5 }]));
    }
}
