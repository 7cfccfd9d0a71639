//! Bilinear interpolation of 8-bit blocks in vectors: the source pixels of eight samples are in a window of sixteen bytes of each row.

use crate::warp_map::{Block, LANES};
use cv_core::ImageView;
use fearless_simd::{i16x32, prelude::*, u8x16, u8x64, u16x32, u32x16};

/// Bytes per window.
pub(crate) const WINDOW_BYTES: usize = 16;
/// Blocks that are interpolated at once: their windows fill a vector.
pub(crate) const BLOCKS: usize = 4;

/// Shuffle indices that expand per-pixel values of four blocks to eight samples of each.
#[derive(Clone, Copy)]
pub(crate) struct ShufflePattern<S: Simd> {
    /// For each sample twice: its pixel.
    columns: u8x64<S>,
    /// Likewise, for fractions in the upper half.
    fractions: u8x64<S>,
    /// Its channel, and the same channel of the right neighbor.
    channel: u8x64<S>,
}

impl<S: Simd> ShufflePattern<S> {
    #[inline(always)]
    pub(crate) fn new(simd: S, part: usize, channels: usize) -> Self {
        // Parts beyond the samples of a block are unused.
        let part = part.min(channels.max(1) - 1);
        let sample = |i: usize| LANES * part + i / 2;
        let of = |f: &dyn Fn(usize) -> usize| {
            let bytes: [u8; BLOCKS * WINDOW_BYTES] = std::array::from_fn(|i| f(i % WINDOW_BYTES) as u8);
            u8x64::from_slice(simd, &bytes)
        };
        Self {
            columns: of(&|i| sample(i) / channels),
            fractions: of(&|i| LANES + sample(i) / channels),
            channel: of(&|i| sample(i) % channels + i % 2 * channels),
        }
    }
}

/// The first three source rows of a block.
pub(crate) struct SourceRows<'a>([&'a [u8]; 3]);

impl<'a> SourceRows<'a> {
    #[inline(always)]
    pub(crate) fn new<const C: usize>(frame: ImageView<'a, u8, C>, block: &Block) -> Self {
        let y = block.y as usize;
        Self([y, y + 1, y + 2].map(|y| frame.row(y.min(frame.height() - 1))))
    }
}

/// Loads a window of each of four byte strings.
#[inline(always)]
fn load_windows<S: Simd>(simd: S, bytes: [&[u8]; BLOCKS], starts: [usize; BLOCKS]) -> u8x64<S> {
    let a = u8x16::from_slice(simd, &bytes[0][starts[0]..starts[0] + WINDOW_BYTES]);
    let b = u8x16::from_slice(simd, &bytes[1][starts[1]..starts[1] + WINDOW_BYTES]);
    let c = u8x16::from_slice(simd, &bytes[2][starts[2]..starts[2] + WINDOW_BYTES]);
    let d = u8x16::from_slice(simd, &bytes[3][starts[3]..starts[3] + WINDOW_BYTES]);
    a.combine(b).combine(c.combine(d))
}

/// Interpolates along a row: pairs of bytes, left and right, by the fractions in 1/256. The result is at most 255 · 256 and fits
/// an i16 after subtracting 32768; sums and products wrap.
#[inline(always)]
fn along<S: Simd>(pairs: u8x64<S>, fx: u16x32<S>) -> u32x16<S> {
    let pairs: u16x32<S> = pairs.bitcast();
    let (left, right) = (pairs & 255, pairs >> 8);
    (((left << 8) + fx * (right - left)) ^ (1 << 15)).bitcast()
}

/// Interpolates between 16-bit samples of two rows, the even or the odd ones of `a` and `b`: each pair of values with its weights.
/// The weights sum to 256: adds back 256 · 32768, and rounds. The result is in the upper half.
#[inline(always)]
fn weighted_sum<S: Simd>(values: u32x16<S>, weights: u32x16<S>) -> u32x16<S> {
    let (values, weights): (i16x32<S>, i16x32<S>) = (values.bitcast(), weights.bitcast());
    (values.pairwise_dot_product(weights) + ((1 << 23) + (1 << 15))).bitcast()
}

/// Interpolates eight samples of each of four blocks that fit into windows, with the same results as the interpolation of single pixels.
#[inline(always)]
pub(crate) fn interpolate_four_blocks<S: Simd, const C: usize>(
    simd: S,
    frame: ImageView<'_, u8, C>,
    (blocks, rows): (&[Block; BLOCKS], &[SourceRows<'_>; BLOCKS]),
    (part, pattern): (usize, &ShufflePattern<S>),
) -> [u8; BLOCKS * LANES] {
    // The window must not exceed the row; samples are then at larger offsets in it.
    let last_start = frame.width() * C - WINDOW_BYTES;
    let (mut starts, mut shifts) = ([0; BLOCKS], [0; BLOCKS]);
    for (k, block) in blocks.iter().enumerate() {
        let first = C * block.x as usize;
        starts[k] = (first + C * block.window_step(part, C)).min(last_start);
        // Differences modulo 256.
        shifts[k] = starts[k].wrapping_sub(first) as u8;
    }
    let [a, b, c, d] = shifts;
    let shifts = u8x16::splat(simd, a).combine(u8x16::splat(simd, b));
    let shifts = shifts.combine(u8x16::splat(simd, c).combine(u8x16::splat(simd, d)));
    let numbers = [
        &blocks[0].steps_and_fractions[..],
        &blocks[1].steps_and_fractions[..],
        &blocks[2].steps_and_fractions[..],
        &blocks[3].steps_and_fractions[..],
    ];
    // Steps and fractions in x; fractions in x and in y.
    let front = load_windows(simd, numbers, [0; BLOCKS]);
    let back = load_windows(simd, numbers, [LANES; BLOCKS]);
    let steps = front.swizzle_dyn_within_blocks(pattern.columns);
    let (columns, row_steps) = (steps & 15, steps >> 4);
    let mut index = pattern.channel;
    for _ in 0..C {
        index += columns;
    }
    index -= shifts;
    // At least two rows, most often three: always three, without an unpredictable branch.
    let [a, b, c, d] = rows;
    let upper = load_windows(simd, [a.0[0], b.0[0], c.0[0], d.0[0]], starts).swizzle_dyn_within_blocks(index);
    let middle = load_windows(simd, [a.0[1], b.0[1], c.0[1], d.0[1]], starts).swizzle_dyn_within_blocks(index);
    let mut below = load_windows(simd, [a.0[2], b.0[2], c.0[2], d.0[2]], starts).swizzle_dyn_within_blocks(index);
    let reached = row_steps.simd_ge(u8x64::splat(simd, 1));
    let (mut top, mut bottom) = (reached.select(middle, upper), reached.select(below, middle));
    let last = blocks[0].rows.max(blocks[1].rows).max(blocks[2].rows.max(blocks[3].rows));
    for row in 2..=last {
        let mut windows: [&[u8]; BLOCKS] = [&[]; BLOCKS];
        for (window, block) in windows.iter_mut().zip(blocks) {
            *window = frame.row((block.y as usize + 1 + usize::from(row)).min(frame.height() - 1));
        }
        let above = below;
        below = load_windows(simd, windows, starts).swizzle_dyn_within_blocks(index);
        let reached = row_steps.simd_ge(u8x64::splat(simd, row));
        top = reached.select(above, top);
        bottom = reached.select(below, bottom);
    }
    let fx = front.swizzle_dyn_within_blocks(pattern.fractions).bitcast::<u16x32<S>>() & 255;
    let fy = back.swizzle_dyn_within_blocks(pattern.fractions).bitcast::<u16x32<S>>() & 255;
    let (top, bottom) = (along(top, fx), along(bottom, fx));
    let (above, below): (u32x16<S>, u32x16<S>) = ((u16x32::splat(simd, 256) - fy).bitcast(), fy.bitcast());
    // The two rows interleaved: pairs of even samples, and of odd ones.
    let even = weighted_sum((top & 0xFFFF) | (bottom << 16), (above & 0xFFFF) | (below << 16));
    let odd = weighted_sum((top >> 16) | (bottom & 0xFFFF_0000), (above >> 16) | (below & 0xFFFF_0000));
    let words: u16x32<S> = ((even >> 16) | (odd & 0xFFFF_0000)).bitcast();
    let (low, high) = words.split();
    let mut bytes = [0; BLOCKS * LANES];
    low.narrow(high).store_slice(&mut bytes);
    bytes
}
