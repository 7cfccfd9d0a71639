//! Smoothing of noisy pairs before matching: the census transform compares single pixels, and noise reverses comparisons in weak texture.

use crate::census::{Gray, MARGIN};
use cv_parallel::prelude::*;

/// Side of the blocks in which noise is measured, in px.
const BLOCK: usize = 16;
/// Pixels across a block at half resolution, without its border.
const HALVED: usize = BLOCK / 2 - 2;
/// Maximum number of blocks across and down.
const MAX_BLOCKS: usize = 32;
/// Minimum number of blocks with unclipped pixels.
const MIN_BLOCKS: usize = 16;
/// Minimum fraction of unclipped pixels of a block.
const MIN_UNCLIPPED: f64 = 0.9;
/// Quantile of the blocks that is the noise of the image: the blocks with least texture.
const QUANTILE: f64 = 0.05;
/// Noise, as a ratio of the contrast of the image, from which on it is smoothed. Public pairs, without noise to speak of, have up to 0.02, one with fine
/// texture everywhere 0.043; with a noise of 4 levels of gray added, of 255, 0.05 to 0.11.
const MIN_NOISE: f64 = 0.05;
/// Noise of the median block up to which it is: an image of nothing but noise has 1, and smoothed, more chance matches.
const MAX_NOISE: f64 = 0.6;
/// Minimum ratio of the noise to that at half resolution.
const MIN_WHITENESS: f64 = 1.5;
/// Taps of the smoothing, in 256ths: a Gaussian of σ 0.75 px. A wider one leaves fewer errors under strong noise, but more chance matches where there is nothing
/// but noise.
const TAPS: [f32; 3] = [136.0, 56.0, 4.0];

/// Estimates the noise of an image (Immerkær, "Fast noise variance estimation", CVIU 1996: the mean absolute response of a difference of two Laplacians, to which
/// surfaces of constant curvature do not contribute), in the blocks with least texture. `None` for small images and if most pixels are clipped.
fn noise(gray: &Gray) -> Option<Noise> {
    let starts = |length: usize| {
        // A pixel of space on each side.
        let blocks = length.saturating_sub(2) / BLOCK;
        let count = blocks.min(MAX_BLOCKS);
        (0..count).map(move |i| 1 + i * blocks / count * BLOCK)
    };
    let columns: Vec<usize> = starts(gray.width).collect();
    let rows: Vec<usize> = starts(gray.height).collect();
    let blocks: Vec<Vec<Block>> = rows
        .par_iter()
        .map(|&y| columns.iter().map(|&x| Block::measure(gray, x, y)).filter(Block::is_unclipped).collect())
        .collect();
    let blocks = blocks.concat();
    if blocks.len() < MIN_BLOCKS {
        return None;
    }
    let quantile = |response: fn(&Block) -> u64, pixels: usize, fraction: f64| {
        let mut responses: Vec<u64> = blocks.iter().map(response).collect();
        responses.sort_unstable();
        // The mask has a norm of six, and the mean absolute value of a normal distribution is √(2/π) σ.
        let factor = (std::f64::consts::PI / 2.0).sqrt() / (6 * pixels) as f64;
        factor * responses[(fraction * responses.len() as f64) as usize] as f64
    };
    let count = (BLOCK * BLOCK * blocks.len()) as f64;
    let mean = blocks.iter().map(|block| block.sum).sum::<u64>() as f64 / count;
    let contrast = (blocks.iter().map(|block| block.squares).sum::<u64>() as f64 / count - mean * mean).sqrt();
    let noise = quantile(|block| block.responses, BLOCK * BLOCK, QUANTILE);
    (contrast > 0.0).then(|| Noise {
        relative: noise / contrast,
        median: quantile(|block| block.responses, BLOCK * BLOCK, 0.5) / contrast,
        // Of sums of four pixels.
        whiteness: noise / (quantile(|block| block.halved, HALVED * HALVED, QUANTILE) / 4.0),
    })
}

/// The noise of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Noise {
    /// Standard deviation as a ratio of that of the gray levels.
    relative: f64,
    /// That of the median block, with its texture.
    median: f64,
    /// As a ratio of that at half resolution: 2 for independent noise, about 1 for fine texture.
    whiteness: f64,
}

impl Noise {
    fn is_to_smooth(&self) -> bool {
        self.relative >= MIN_NOISE && self.median <= MAX_NOISE && self.whiteness >= MIN_WHITENESS
    }
}

/// Returns whether both images of a pair are so noisy, and yet not nothing but noise, that smoothing them improves their matches.
pub(crate) fn is_noisy(pair: &[Gray; 2]) -> bool {
    pair.iter().all(|gray| noise(gray).is_some_and(|noise| noise.is_to_smooth()))
}

/// Sums over the pixels of a block.
#[derive(Debug, Clone, Default)]
struct Block {
    /// Absolute responses of the mask.
    responses: u64,
    /// Those at half resolution, of sums of four pixels.
    halved: u64,
    sum: u64,
    squares: u64,
    unclipped: usize,
}

impl Block {
    fn measure(gray: &Gray, x: usize, y: usize) -> Self {
        let row = |y: usize| &gray.values[y * gray.stride() + MARGIN + x - 1..][..BLOCK + 2];
        let mut block = Self::default();
        for y in y..y + BLOCK {
            let [above, here, below] = [row(y - 1), row(y), row(y + 1)];
            for i in 1..=BLOCK {
                let across = |row: &[u16]| i64::from(row[i - 1]) - 2 * i64::from(row[i]) + i64::from(row[i + 1]);
                block.responses += (across(above) - 2 * across(here) + across(below)).unsigned_abs();
                let value = u64::from(here[i]);
                block.sum += value;
                block.squares += value * value;
                // The first and last level of eight bits.
                block.unclipped += usize::from((1 << 8..0xff << 8).contains(&here[i]));
            }
        }
        let sums: [[i64; HALVED + 2]; HALVED + 2] = std::array::from_fn(|j| {
            let [upper, lower] = [row(y + 2 * j), row(y + 2 * j + 1)];
            std::array::from_fn(|i| {
                [upper, lower].iter().map(|row| i64::from(row[2 * i + 1]) + i64::from(row[2 * i + 2])).sum()
            })
        });
        for j in 1..=HALVED {
            for i in 1..=HALVED {
                let across = |row: &[i64; HALVED + 2]| row[i - 1] - 2 * row[i] + row[i + 1];
                let [above, here, below] = [j - 1, j, j + 1].map(|j| across(&sums[j]));
                block.halved += (above - 2 * here + below).unsigned_abs();
            }
        }
        block
    }

    fn is_unclipped(&self) -> bool {
        self.unclipped as f64 >= MIN_UNCLIPPED * (BLOCK * BLOCK) as f64
    }
}

/// Smooths an image. `scratch` is scratch, resized to its pixels.
pub(crate) fn smooth(gray: &mut Gray, scratch: &mut Vec<f32>) {
    let (width, height, stride) = (gray.width, gray.height, gray.stride());
    if width == 0 || height == 0 {
        return;
    }
    scratch.resize(width * height, 0.0);
    let filter = |values: [f32; 5]| {
        let [a, b, c, d, e] = values;
        (TAPS[0] * c + TAPS[1] * (b + d) + TAPS[2] * (a + e)) / 256.0
    };
    scratch.par_chunks_mut(width).zip(gray.values.par_chunks(stride)).for_each(|(out, row)| {
        // The margins are as wide as two taps.
        for (out, window) in out.iter_mut().zip(row[MARGIN - 2..].windows(5)) {
            *out = filter([0, 1, 2, 3, 4].map(|i| f32::from(window[i])));
        }
    });
    let across = &scratch[..];
    gray.values.par_chunks_mut(stride).enumerate().for_each(|(y, row)| {
        let of = |dy: isize| {
            let y = y.saturating_add_signed(dy).min(height - 1);
            &across[y * width..][..width]
        };
        let [a, b, c, d, e] = [-2, -1, 0, 1, 2].map(of);
        for (x, out) in row[MARGIN..MARGIN + width].iter_mut().enumerate() {
            *out = (filter([a[x], b[x], c[x], d[x], e[x]]) + 0.5) as u16;
        }
        let (first, last) = (row[MARGIN], row[MARGIN + width - 1]);
        row[..MARGIN].fill(first);
        row[MARGIN + width..].fill(last);
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::input::to_gray;
    use cv_core::{GrayF32, GrayU8};

    /// Normal to a few per cent: the sum of twelve uniform numbers.
    fn normal(state: &mut u64) -> f64 {
        (0..12)
            .map(|_| {
                *state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (*state >> 40) as f64 / f64::from(1 << 24)
            })
            .sum::<f64>()
            - 6.0
    }

    /// Waves of a contrast (standard deviation) of 40 levels, with noise.
    fn waves(sigma: f64) -> GrayU8 {
        let mut state = 5;
        GrayU8::from_fn(200, 150, |x, y| {
            let wave = 40.0 * ((x as f64 / 23.0).sin() + (y as f64 / 17.0).cos());
            [(128.0 + wave + sigma * normal(&mut state)).round() as u8]
        })
    }

    fn gray(image: &GrayU8) -> Gray {
        let mut gray = Gray::default();
        to_gray(image.view(), &mut gray);
        gray
    }

    #[test]
    fn noise_is_estimated_relative_to_the_contrast() {
        for sigma in [1.0, 3.0, 6.0] {
            let found = noise(&gray(&waves(sigma))).unwrap().relative;
            // A twentieth of the blocks, of 256 correlated pixels each: 8 % lower. Rounding adds 0.08.
            let expected = sigma / f64::hypot(40.0, sigma);
            assert!((0.8..1.1).contains(&(found / expected)), "{sigma}: {found} of {expected}");
        }
        // Of the same image at a quarter of its contrast.
        let dark = waves(6.0).map(|[v]| [40 + v / 4]);
        let ratio = noise(&gray(&dark)).unwrap().relative / noise(&gray(&waves(6.0))).unwrap().relative;
        // Rounding.
        assert!((ratio - 1.0).abs() < 0.1, "{ratio}");
        assert!(is_noisy(&[gray(&dark), gray(&waves(3.0))]) && !is_noisy(&[gray(&dark), gray(&waves(1.0))]));
        let mut state = 3;
        let nothing_else = GrayU8::from_fn(200, 150, |_, _| [(128.0 + 20.0 * normal(&mut state)).round() as u8]);
        assert!(!is_noisy(&[gray(&nothing_else), gray(&nothing_else)]));
    }

    #[test]
    fn fine_texture_is_not_noise() {
        let whiteness = |image: &GrayU8| noise(&gray(image)).unwrap().whiteness;
        // Quantiles of blocks with 256 and 36 pixels: those of the latter are lower.
        assert!((1.9..2.6).contains(&whiteness(&waves(6.0))), "{}", whiteness(&waves(6.0)));
        // Spots of three pixels, as strong as the noise.
        let coarse = waves(6.0);
        let spots = GrayU8::from_fn(200, 150, |x, y| coarse.at(x / 3, y / 3));
        assert!(whiteness(&spots) < 1.2 && !is_noisy(&[gray(&spots), gray(&spots)]), "{}", whiteness(&spots));
    }

    #[test]
    fn images_without_enough_unclipped_pixels_have_no_estimate() {
        let mut state = 1;
        for (image, why) in [
            (GrayU8::new(0, 0, [0]), "empty"),
            (GrayU8::new(1, 1, [9]), "one pixel"),
            (GrayU8::new(40, 300, [9]), "small"),
            (GrayU8::new(200, 150, [77]), "one color"),
            (GrayU8::from_fn(200, 150, |_, _| [(250.0 + 20.0 * normal(&mut state)) as u8]), "clipped"),
        ] {
            assert_eq!(noise(&gray(&image)), None, "{why}");
        }
        // Black borders do not count.
        let whole = waves(6.0);
        let framed = GrayU8::from_fn(400, 150, |x, y| if x < 200 { whole.at(x, y) } else { [0] });
        let [with, without] = [&framed, &whole].map(|image| noise(&gray(image)).unwrap().relative);
        assert!((with / without - 1.0).abs() < 0.2, "{with} {without}");
    }

    #[test]
    fn smoothing_is_a_gaussian_that_keeps_the_mean() {
        let mut scratch = Vec::new();
        for (width, height) in [(1, 1), (1, 7), (9, 1), (30, 20)] {
            let mut image = gray(&GrayU8::new(width, height, [101]));
            let before = image.values.clone();
            smooth(&mut image, &mut scratch);
            assert_eq!(image.values, before);
        }
        // An impulse becomes the filter.
        let impulse = GrayF32::from_fn(21, 21, |x, y| [if (x, y) == (10, 10) { 1.0 } else { 0.0 }]);
        let mut image = Gray::default();
        to_gray(impulse.view(), &mut image);
        smooth(&mut image, &mut scratch);
        let at = |x: usize, y: usize| f64::from(image.values[y * image.stride() + MARGIN + x]) / 65535.0;
        let sum: f64 = (0..21).flat_map(|y| (0..21).map(move |x| (x, y))).map(|(x, y)| at(x, y)).sum();
        let variance: f64 = (0..21).map(|x| (x as f64 - 10.0).powi(2) * at(x, 10)).sum::<f64>()
            / (0..21).map(|x| at(x, 10)).sum::<f64>();
        // Rounding of 25 pixels; two taps on each side of a σ of 0.75.
        assert!((sum - 1.0).abs() < 1e-3 && (variance.sqrt() - 0.75).abs() < 0.02, "{sum} {variance}");
    }
}
