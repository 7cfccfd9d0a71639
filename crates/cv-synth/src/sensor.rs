//! The sensor: from linear intensity to 8-bit values.

use crate::rng::normal_pair;
use cv_core::{Image, RgbF32, RgbU8};
use cv_parallel::prelude::*;

/// Imaging parameters. The default is a good compact camera in a well-lit room.
#[derive(Debug, Clone, PartialEq)]
pub struct RenderOptions {
    /// Exposure in stops relative to a well-exposed image; −3 to 3. Default 0.
    pub exposure: f32,
    /// White balance factors of red, green and blue; 0.5 to 2. Default 1.
    pub white_balance: [f32; 3],
    /// Vignetting: relative loss at the image corners, quadratic in the distance from the center; 0 to 0.8. Default
    /// 0.15, a zoom lens two stops below wide open.
    pub vignetting: f32,
    /// Full-well capacity: electrons of a pixel at white, which determines the photon (shot) noise; infinity for none.
    /// Default 12,000, a small sensor at base sensitivity.
    pub full_well: f32,
    /// Standard deviation of the read noise in electrons. Default 6.
    pub read_noise: f32,
    /// Standard deviation of the Gaussian lens blur in pixels; 0 to 5. Default 0.45.
    pub blur: f32,
    /// Samples along each side of a pixel, 1 to 8; twice as many at object boundaries. Default 2.
    pub samples: usize,
    /// Seed of the noise. Default 0.
    pub seed: u64,
}

impl Default for RenderOptions {
    fn default() -> Self {
        Self {
            exposure: 0.0,
            white_balance: [1.0; 3],
            vignetting: 0.15,
            full_well: 12_000.0,
            read_noise: 6.0,
            blur: 0.45,
            samples: 2,
            seed: 0,
        }
    }
}

impl RenderOptions {
    /// Returns the options of an ideal camera: no noise, no vignetting, no blur beyond the pixel's area.
    pub fn ideal() -> Self {
        Self { vignetting: 0.0, full_well: f32::INFINITY, read_noise: 0.0, blur: 0.0, ..Self::default() }
    }

    /// Returns the options with one sample for each pixel instead of four, for results that do not depend on how fine
    /// texture is averaged over a pixel.
    pub fn draft() -> Self {
        Self { samples: 1, ..Self::default() }
    }

    /// Returns the options with another seed of the noise.
    pub fn with_seed(self, seed: u64) -> Self {
        Self { seed, ..self }
    }
}

/// Applies a separable Gaussian blur with replicated borders.
pub(crate) fn blur(image: &RgbF32, sigma: f32) -> RgbF32 {
    if sigma.is_nan() || sigma <= 0.05 || image.is_empty() {
        return image.clone();
    }
    let sigma = sigma.min(20.0);
    let radius = (3.5 * sigma).ceil() as usize;
    let mut kernel: Vec<f32> =
        (0..=2 * radius).map(|i| (-0.5 * ((i as f32 - radius as f32) / sigma).powi(2)).exp()).collect();
    let sum: f32 = kernel.iter().sum();
    kernel.iter_mut().for_each(|k| *k /= sum);
    let (width, height) = image.size();
    let mut across = Image::new(width, height, [0.0; 3]);
    across.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, out)| {
        let row = image.row(y);
        for x in 0..width {
            for (i, k) in kernel.iter().enumerate() {
                let from = 3 * (x + i).saturating_sub(radius).min(width - 1);
                for c in 0..3 {
                    out[3 * x + c] += k * row[from + c];
                }
            }
        }
    });
    let mut down = Image::new(width, height, [0.0; 3]);
    down.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, out)| {
        for (i, k) in kernel.iter().enumerate() {
            let row = across.row((y + i).saturating_sub(radius).min(height - 1));
            out.iter_mut().zip(row).for_each(|(o, v)| *o += k * v);
        }
    });
    down
}

/// Applies exposure, white balance and vignetting in place.
pub(crate) fn expose(image: &mut RgbF32, options: &RenderOptions) {
    let (width, height) = image.size();
    if image.is_empty() {
        return;
    }
    let (cx, cy) = ((width as f32 - 1.0) / 2.0, (height as f32 - 1.0) / 2.0);
    let corner = (cx * cx + cy * cy).max(1.0);
    let gain = options.white_balance.map(|w| w * options.exposure.exp2());
    image.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let (dx, dy) = (x as f32 - cx, y as f32 - cy);
            let falloff = 1.0 - options.vignetting * (dx * dx + dy * dy) / corner;
            pixel.iter_mut().zip(gain).for_each(|(p, g)| *p *= g * falloff);
        }
    });
}

/// Applies noise, clipping and the sRGB transfer function.
pub(crate) fn develop(linear: &RgbF32, options: &RenderOptions) -> RgbU8 {
    let (width, height) = linear.size();
    let mut image = Image::new(width, height, [0; 3]);
    if image.is_empty() {
        return image;
    }
    let shot = if options.full_well > 0.0 { 1.0 / options.full_well } else { 0.0 };
    let read = if options.full_well > 0.0 { options.read_noise / options.full_well } else { 0.0 };
    let has_noise = shot > 0.0 || read > 0.0;
    let table = TransferTable::new();
    image.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, out)| {
        for (x, (out, linear)) in out.chunks_exact_mut(3).zip(linear.row(y).chunks_exact(3)).enumerate() {
            let mut noise = [0.0; 3];
            if has_noise {
                let counter = 2 * (y * width + x) as u64;
                let (a, b) = normal_pair(options.seed, counter);
                noise = [a, b, normal_pair(options.seed, counter + 1).0];
            }
            for c in 0..3 {
                let sigma = (linear[c].max(0.0) * shot + read * read).sqrt();
                out[c] = table.encode(linear[c] + sigma * noise[c]);
            }
        }
    });
    image
}

/// The sRGB transfer function as a table, which rounds like the formula for all but one in 4096 values.
struct TransferTable(Vec<f32>);

impl TransferTable {
    const STEPS: usize = 4096;

    fn new() -> Self {
        Self((0..=Self::STEPS + 1).map(|i| 255.0 * encode_srgb(i as f32 / Self::STEPS as f32)).collect())
    }

    fn encode(&self, v: f32) -> u8 {
        let x = v.clamp(0.0, 1.0) * Self::STEPS as f32;
        let i = x as usize;
        let low = self.0[i.min(Self::STEPS)];
        let high = self.0[(i + 1).min(Self::STEPS + 1)];
        (low + (x - i as f32) * (high - low) + 0.5) as u8
    }
}

/// Returns the sRGB encoding (IEC 61966-2-1) of a linear intensity from 0 to 1.
pub fn encode_srgb(v: f32) -> f32 {
    let v = v.max(0.0);
    if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_rounds_like_the_formula() {
        let table = TransferTable::new();
        for i in 0..=20_000 {
            let v = i as f32 / 20_000.0;
            let exact = 255.0 * encode_srgb(v);
            // Half for rounding; the rest is the table's chord, largest where the curve bends most.
            assert!((f32::from(table.encode(v)) - exact).abs() < 0.52, "{v}");
        }
        assert_eq!((table.encode(-1.0), table.encode(7.0), table.encode(f32::NAN)), (0, 255, 0));
    }

    #[test]
    fn noise_has_the_standard_deviation_of_the_options() {
        let options = RenderOptions { full_well: 1000.0, read_noise: 10.0, ..RenderOptions::default() };
        let image = develop(&Image::new(200, 200, [0.25; 3]), &options);
        // The slope of the transfer function at 0.25, in levels per unit.
        let slope = 255.0 * (encode_srgb(0.26) - encode_srgb(0.24)) / 0.02;
        let sigma = slope * (0.25f32 / 1000.0 + 0.0001).sqrt();
        let values: Vec<f32> = image.as_slice().iter().map(|&v| f32::from(v)).collect();
        let mean = values.iter().sum::<f32>() / values.len() as f32;
        let standard_deviation = (values.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / values.len() as f32).sqrt();
        // 120,000 samples determine the standard deviation to 0.2 %; the curvature of the transfer function changes it
        // by about one per cent.
        assert!((standard_deviation / sigma - 1.0).abs() < 0.03, "{standard_deviation} {sigma}");
        assert!((mean - 255.0 * encode_srgb(0.25)).abs() < 0.3);
    }

    #[test]
    fn blur_preserves_the_sum_and_has_the_variance_of_a_gaussian() {
        let mut image = Image::new(21, 21, [0.0; 3]);
        image.set(10, 10, [1.0; 3]);
        let out = blur(&image, 1.5);
        let sum: f32 = out.pixels().map(|p| p[0]).sum();
        let variance: f32 = (0..21)
            .flat_map(|y| (0..21).map(move |x| (x, y)))
            .map(|(x, y)| out.at(x, y)[0] * (x as f32 - 10.0).powi(2))
            .sum();
        assert!((sum - 1.0).abs() < 1e-5);
        // Sampled and truncated at 3.5 sigma.
        assert!((variance - 2.25).abs() < 0.03, "{variance}");
    }
}
