//! What the levels of a camera mean in light: sRGB, and what the camera puts on top of it (after Grossberg & Nayar 2004, "Modeling the space of camera response
//! functions").
//!
//! `log₂ light = log₂ sRGB⁻¹(v) + (1 − v)(p₀ + p₁ v + p₂ v²)` for a level `v` of 0 to 1. In logarithms the model is linear in its coefficients, as it is in exposures
//! and vignetting. White is light 1 whatever the coefficients. S-shaped curves of moderate contrast are met to half a gray level.

/// Coefficients of a response.
pub(crate) const COEFFICIENTS: usize = 3;

/// The response curve of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Response {
    pub(crate) coefficients: [f64; COEFFICIENTS],
}

/// Level below which light is taken to fall in proportion: black has no logarithm.
const DARKEST: f64 = 0.25 / 255.0;

impl Response {
    /// The terms that the coefficients multiply, at a level of 0 to 1.
    pub(crate) fn basis(v: f64) -> [f64; COEFFICIENTS] {
        let rest = 1.0 - v;
        [rest, rest * v, rest * v * v]
    }

    /// log₂ of the light that plain sRGB takes a level for.
    pub(crate) fn srgb(v: f64) -> f64 {
        let v = v.max(DARKEST);
        if v <= 0.04045 { (v / 12.92).log2() } else { 2.4 * ((v + 0.055) / 1.055).log2() }
    }

    /// log₂ of the light of a level of 0 to 1; 0 for white.
    pub(crate) fn log_light(&self, v: f64) -> f64 {
        let terms = Self::basis(v);
        Self::srgb(v) + terms.iter().zip(&self.coefficients).map(|(t, p)| t * p).sum::<f64>()
    }

    /// Stops of light for the whole range of levels, at a level of 0 to 1: the derivative of [`log_light`](Self::log_light).
    pub(crate) fn slope(&self, v: f64) -> f64 {
        let h = 0.5 / 255.0;
        let (low, high) = ((v - h).max(DARKEST), (v + h).min(1.0));
        (self.log_light(high) - self.log_light(low)) / (high - low)
    }

    /// Whether brighter levels are more light everywhere, by a third to three times of what they are in sRGB.
    pub(crate) fn is_plausible(&self) -> bool {
        (4..=255).all(|level| {
            let v = f64::from(level) / 255.0;
            let ratio = self.slope(v) / Self::default().slope(v);
            (0.3..3.0).contains(&ratio)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn plain_srgb_is_the_standard() {
        // IEC 61966-2-1: level 188 is half the light to a third of a level, level 10 lies on the straight part (10.3 is where it ends).
        let plain = Response::default();
        assert!((plain.log_light(188.0 / 255.0).exp2() - 0.5).abs() < 0.005);
        assert!((plain.log_light(10.0 / 255.0).exp2() - 10.0 / 255.0 / 12.92).abs() < 1e-9);
        assert!(plain.log_light(1.0).abs() < 1e-12 && plain.is_plausible());
    }

    #[test]
    fn white_is_white_and_the_slope_is_the_derivative() {
        let curve = Response { coefficients: [0.8, -1.0, -1.2] };
        assert!(curve.log_light(1.0).abs() < 1e-12 && curve.is_plausible());
        for level in [20, 80, 150, 230] {
            let v = f64::from(level) / 255.0;
            let wide = (curve.log_light(v + 0.01) - curve.log_light(v - 0.01)) / 0.02;
            // Differences over two widths of a curve whose third derivative is some v⁻³: 1e-4 · 2.4 / (3 v³).
            assert!((curve.slope(v) - wide).abs() < 2e-4 / v.powi(3), "{level}: {} {wide}", curve.slope(v));
        }
        // Light that falls with rising levels is no camera's.
        assert!(!Response { coefficients: [0.0, 20.0, 0.0] }.is_plausible());
    }
}
