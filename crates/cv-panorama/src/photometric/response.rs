//! Camera response: sRGB times a parametric correction (after Grossberg & Nayar 2004, "Modeling the space of camera response functions").
//!
//! `log₂ E = log₂ sRGB⁻¹(v) + (1 − v)(p₀ + p₁ v + p₂ v²)` maps a level `v` of 0 to 1 to radiance `E`. The model is linear in its coefficients, as it is in
//! log exposure and log vignetting. White has radiance 1 for all coefficients. S-shaped curves of moderate contrast are approximated to half a gray level.

/// Number of coefficients of a response.
pub(crate) const COEFFICIENT_COUNT: usize = 3;

/// The response curve of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(crate) struct Response {
    pub(crate) coefficients: [f64; COEFFICIENT_COUNT],
}

/// Level, 0 to 1, below which the response is extrapolated linearly: black has no logarithm.
const MIN_LEVEL: f64 = 0.25 / 255.0;

impl Response {
    /// Returns the basis functions at a level of 0 to 1.
    pub(crate) fn basis(v: f64) -> [f64; COEFFICIENT_COUNT] {
        let rest = 1.0 - v;
        [rest, rest * v, rest * v * v]
    }

    /// Returns the derivatives, by coefficient, of the exponent of the power of the sRGB transfer function that fits a response best: least squares over levels in log radiance.
    pub(crate) fn exponent() -> [f64; COEFFICIENT_COUNT] {
        let (mut sums, mut squares) = ([0.0; COEFFICIENT_COUNT], 0.0);
        for v in (8..=248).map(|level| f64::from(level) / 255.0) {
            let log = Self::srgb(v);
            sums.iter_mut().zip(Self::basis(v)).for_each(|(sum, term)| *sum += term * log);
            squares += log * log;
        }
        sums.map(|sum| sum / squares)
    }

    /// Returns log₂ of the radiance of a level of 0 to 1 under the sRGB transfer function.
    pub(crate) fn srgb(v: f64) -> f64 {
        let v = v.max(MIN_LEVEL);
        if v <= 0.04045 { (v / 12.92).log2() } else { 2.4 * ((v + 0.055) / 1.055).log2() }
    }

    /// Returns log₂ of the radiance of a level of 0 to 1; 0 for white.
    pub(crate) fn log_radiance(&self, v: f64) -> f64 {
        let terms = Self::basis(v);
        Self::srgb(v) + terms.iter().zip(&self.coefficients).map(|(t, p)| t * p).sum::<f64>()
    }

    /// Returns the derivative of [`log_radiance`](Self::log_radiance) in stops per unit of level, by central differences.
    pub(crate) fn slope(&self, v: f64) -> f64 {
        let h = 0.5 / 255.0;
        let (low, high) = ((v - h).max(MIN_LEVEL), (v + h).min(1.0));
        (self.log_radiance(high) - self.log_radiance(low)) / (high - low)
    }

    /// Returns whether the response is monotonic, with a slope of a third to three times that of sRGB.
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
        assert!((plain.log_radiance(188.0 / 255.0).exp2() - 0.5).abs() < 0.005);
        assert!((plain.log_radiance(10.0 / 255.0).exp2() - 10.0 / 255.0 / 12.92).abs() < 1e-9);
        assert!(plain.log_radiance(1.0).abs() < 1e-12 && plain.is_plausible());
    }

    #[test]
    fn white_is_white_and_the_slope_is_the_derivative() {
        let curve = Response { coefficients: [0.8, -1.0, -1.2] };
        assert!(curve.log_radiance(1.0).abs() < 1e-12 && curve.is_plausible());
        for level in [20, 80, 150, 230] {
            let v = f64::from(level) / 255.0;
            let wide = (curve.log_radiance(v + 0.01) - curve.log_radiance(v - 0.01)) / 0.02;
            // Differences over two widths of a curve whose third derivative is some v⁻³: 1e-4 · 2.4 / (3 v³).
            assert!((curve.slope(v) - wide).abs() < 2e-4 / v.powi(3), "{level}: {} {wide}", curve.slope(v));
        }
        // Not monotonic.
        assert!(!Response { coefficients: [0.0, 20.0, 0.0] }.is_plausible());
    }
}
