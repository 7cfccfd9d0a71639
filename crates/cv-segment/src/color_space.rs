//! Color spaces in which colors are modeled.

use cv_imgproc::{rgb_pixel_to_hsv, rgb_pixel_to_lab};
use serde::{Deserialize, Serialize};
use std::f32::consts::{PI, TAU};

/// A color space.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ColorSpace {
    /// Hue, saturation, value. Hue is circular: it is measured relative to the object's circular mean hue, −π to π, so
    /// that the wrap-around lies opposite the object's hue and linear averages are valid (Mardia & Jupp, Directional
    /// Statistics). Modeling `(S cos H, S sin H, V)`, which has no wrap-around, scored lower: its components widen
    /// where saturation varies under highlights and shadow.
    #[default]
    Hsv,
    /// Gamma-encoded sRGB, 0 to 1.
    Rgb,
    /// CIE L*a*b*, D65.
    Lab,
}

cv_core::named!(ColorSpace { Hsv = "hsv", Rgb = "rgb", Lab = "lab" });

impl ColorSpace {
    /// Converts an 8-bit sRGB color to coordinates in this space. `hue` is the reference hue in radians; only HSV uses
    /// it.
    #[inline]
    pub fn coordinates(self, rgb: [u8; 3], hue: f32) -> [f32; 3] {
        match self {
            Self::Hsv => {
                let [h, s, v] = rgb_pixel_to_hsv(rgb);
                [wrap(h - hue), s, v]
            }
            Self::Rgb => rgb.map(|v| f32::from(v) / 255.0),
            Self::Lab => rgb_pixel_to_lab(rgb),
        }
    }

    /// Returns the standard deviation of each coordinate that corresponds to about one gray level of quantization. For
    /// hue, at half saturation and value.
    pub(crate) fn resolution(self) -> [f64; 3] {
        const STEP: f64 = 1.0 / 255.0;
        match self {
            Self::Hsv => [4.0 * STEP, STEP, STEP],
            Self::Rgb => [STEP; 3],
            Self::Lab => [0.4; 3],
        }
    }

    /// Returns the volume of the sRGB gamut in this space: the inverse of the density of uniformly distributed colors.
    pub(crate) fn volume(self) -> f64 {
        match self {
            Self::Hsv => f64::from(TAU),
            Self::Rgb => 1.0,
            Self::Lab => 8.3e5,
        }
    }
}

/// Wraps an angle between −2π and 2π to −π to π.
#[inline(always)]
pub(crate) fn wrap(angle: f32) -> f32 {
    let wrapped = if angle > PI { angle - TAU } else { angle };
    if wrapped < -PI { wrapped + TAU } else { wrapped }
}

/// Computes the circular mean hue in radians, 0 to 2π, each color weighted by its weight times its saturation (a gray
/// has no hue). Returns 0 where the mean is undefined.
pub(crate) fn mean_hue(samples: impl Iterator<Item = ([u8; 3], f64)>) -> f32 {
    let (mut x, mut y, mut total) = (0.0f64, 0.0f64, 0.0f64);
    for (rgb, weight) in samples {
        let [h, s, _] = rgb_pixel_to_hsv(rgb).map(f64::from);
        x += weight * s * h.cos();
        y += weight * s * h.sin();
        total += weight * s;
    }
    // Opposite hues cancel up to the rounding of f32 hues: the direction is undefined.
    if x.hypot(y) <= 1e-6 * total { 0.0 } else { y.atan2(x).rem_euclid(std::f64::consts::TAU) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_mean_of_hues_on_both_sides_of_zero_is_zero() {
        // Hues 350° and 10°.
        let pair = [([255, 0, 43], 1.0), ([255, 43, 0], 1.0)];
        let mean = mean_hue(pair.into_iter());
        // Both are a sixth of 60° from red: by symmetry the mean is 0, or 2π less a rounding.
        assert!(wrap(mean).abs() < 1e-6, "{mean}");
        for (rgb, _) in pair {
            assert!(ColorSpace::Hsv.coordinates(rgb, mean)[0].abs() < 0.2);
        }
        assert_eq!(mean_hue([([9, 9, 9], 5.0)].into_iter()), 0.0);
        assert_eq!(mean_hue([([255, 0, 0], 1.0), ([0, 255, 255], 1.0)].into_iter()), 0.0);
    }
}
