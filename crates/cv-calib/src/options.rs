//! Options of a calibration.

use crate::CalibrateError;
use cv_core::{DistortionModel, OptionError, named};

/// The lens model of a calibration.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum LensChoice {
    /// The model with the smallest hold-out error.
    #[default]
    Auto,
    /// Two radial and two tangential coefficients.
    RadialTangential4,
    /// Three radial and two tangential coefficients, OpenCV's default five.
    RadialTangential5,
    /// A rational radial factor and two tangential coefficients.
    Rational8,
    /// The rational model and four thin prism coefficients.
    ThinPrism12,
    /// Equidistant fisheye.
    Fisheye4,
}

named!(LensChoice {
    Auto = "auto": "the one with the least error on views it was not fitted to",
    RadialTangential4 = "radial-tangential4" | "radial_tangential4": "k1, k2, p1, p2",
    RadialTangential5 = "radial-tangential5" | "radial_tangential5": "k1, k2, p1, p2, k3",
    Rational8 = "rational8": "k1 to k6, p1, p2",
    ThinPrism12 = "thin-prism12" | "thin_prism12": "rational, and s1 to s4",
    Fisheye4 = "fisheye4" | "fisheye": "equidistant, k1 to k4",
});

impl LensChoice {
    /// Returns the candidate models.
    pub fn models(self) -> &'static [DistortionModel] {
        use DistortionModel as M;
        match self {
            Self::Auto => &[M::RadialTangential4, M::RadialTangential5, M::Fisheye4, M::Rational8, M::ThinPrism12],
            Self::RadialTangential4 => &[M::RadialTangential4],
            Self::RadialTangential5 => &[M::RadialTangential5],
            Self::Rational8 => &[M::Rational8],
            Self::ThinPrism12 => &[M::ThinPrism12],
            Self::Fisheye4 => &[M::Fisheye4],
        }
    }
}

/// Options of [`calibrate`](crate::calibrate).
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct CalibrateOptions {
    /// Lens model; chosen by cross-validation for each camera separately. Default [`LensChoice::Auto`].
    pub lens: LensChoice,
    /// Whether the target's shape, two deflections, is adjusted where the views determine it. Default true.
    pub board_shape: bool,
    /// Outlier threshold in robust standard deviations of a coordinate, 3 to 100. Default 4.5: it rejects one in 25,000
    /// normal errors.
    pub outlier_deviations: f64,
    /// Minimum number of corners of an image, 4 to 1000. Default 6: four determine a homography and leave no
    /// redundancy.
    pub min_corners: usize,
    /// Whether the hold-out error is computed even if it is not needed to choose the lens. Default true; it takes as
    /// long as two calibrations.
    pub holdout: bool,
    /// Columns and rows of the uncertainty map and of the coverage map, 2 to 200. Default 16 × 12.
    pub grid: (usize, usize),
}

impl Default for CalibrateOptions {
    fn default() -> Self {
        Self {
            lens: LensChoice::Auto,
            board_shape: true,
            outlier_deviations: 4.5,
            min_corners: 6,
            holdout: true,
            grid: (16, 12),
        }
    }
}

impl CalibrateOptions {
    pub(crate) fn validate(&self) -> Result<(), CalibrateError> {
        OptionError::check("outlier_deviations", self.outlier_deviations, "3 to 100", |v| (3.0..=100.0).contains(&v))?;
        OptionError::check("min_corners", self.min_corners as f64, "4 to 1000", |v| (4.0..=1000.0).contains(&v))?;
        for side in [self.grid.0, self.grid.1] {
            OptionError::check("grid", side as f64, "2 to 200", |v| (2.0..=200.0).contains(&v))?;
        }
        Ok(())
    }
}
