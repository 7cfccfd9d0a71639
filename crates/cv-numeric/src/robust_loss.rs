//! Robust losses for least squares.

/// A loss ρ of the squared residual `s = r²`, with `ρ(s) ≈ s` near zero (Triggs et al., "Bundle Adjustment", 2000, §3.3).
///
/// `scale` is the residual, in its own unit, at which a loss departs from the quadratic.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum RobustLoss {
    /// `ρ(s) = s`: plain least squares.
    #[default]
    Trivial,
    /// `s` up to `scale²`, then `2·scale·r − scale²`.
    Huber {
        /// Residual at which the quadratic ends.
        scale: f64,
    },
    /// `scale² ln(1 + s/scale²)`.
    Cauchy {
        /// Half weight at this residual.
        scale: f64,
    },
    /// Tukey's biweight, `scale²/3 · (1 − (1 − s/scale²)³)`, constant from `scale` on.
    Tukey {
        /// Zero weight from this residual on.
        scale: f64,
    },
    /// `min(s, scale²)`: least squares on the inliers.
    Truncated {
        /// Zero weight from this residual on.
        scale: f64,
    },
    /// Geman and McClure's `scale² s / (scale² + s)`, which saturates at `scale²`.
    GemanMcClure {
        /// A quarter of the weight at this residual.
        scale: f64,
    },
}

impl RobustLoss {
    /// Computes ρ(s) of the squared residual `s ≥ 0`.
    #[inline]
    pub fn value(&self, s: f64) -> f64 {
        match *self {
            Self::Trivial => s,
            Self::Huber { scale } => {
                let k = scale * scale;
                if s <= k { s } else { 2.0 * scale * s.sqrt() - k }
            }
            Self::Cauchy { scale } => {
                let k = scale * scale;
                k * (s / k).ln_1p()
            }
            Self::Tukey { scale } => {
                let k = scale * scale;
                let u = (1.0 - s / k).max(0.0);
                k / 3.0 * (1.0 - u * u * u)
            }
            Self::Truncated { scale } => s.min(scale * scale),
            Self::GemanMcClure { scale } => {
                let k = scale * scale;
                k * s / (k + s)
            }
        }
    }

    /// Computes ρ'(s): the weight of a residual in iteratively reweighted least squares, 1 near zero.
    #[inline]
    pub fn weight(&self, s: f64) -> f64 {
        match *self {
            Self::Trivial => 1.0,
            Self::Huber { scale } => {
                if s <= scale * scale {
                    1.0
                } else {
                    scale / s.sqrt()
                }
            }
            Self::Cauchy { scale } => 1.0 / (1.0 + s / (scale * scale)),
            Self::Tukey { scale } => {
                let u = (1.0 - s / (scale * scale)).max(0.0);
                u * u
            }
            Self::Truncated { scale } => {
                if s < scale * scale {
                    1.0
                } else {
                    0.0
                }
            }
            Self::GemanMcClure { scale } => {
                let u = 1.0 / (1.0 + s / (scale * scale));
                u * u
            }
        }
    }

    /// Computes `1 + 2 s ρ''(s) / ρ'(s)`: the curvature of the loss along the residual relative to that across it, 1 near zero, negative
    /// where the loss is concave in the residual (Triggs et al., §4.3). 1 where the weight is zero.
    #[inline]
    pub fn curvature(&self, s: f64) -> f64 {
        match *self {
            Self::Trivial | Self::Truncated { .. } => 1.0,
            Self::Huber { scale } => {
                if s <= scale * scale {
                    1.0
                } else {
                    0.0
                }
            }
            Self::Cauchy { scale } => {
                let u = s / (scale * scale);
                (1.0 - u) / (1.0 + u)
            }
            Self::Tukey { scale } => {
                let u = s / (scale * scale);
                if u < 1.0 { (1.0 - 5.0 * u) / (1.0 - u) } else { 1.0 }
            }
            Self::GemanMcClure { scale } => {
                let u = s / (scale * scale);
                (1.0 - 3.0 * u) / (1.0 + u)
            }
        }
    }
}
