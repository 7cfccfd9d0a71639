//! Lens distortion: the table of models, and their parameters.
//!
//! A lens model maps undistorted normalized coordinates, `(x, y) = (X/Z, Y/Z)` of a point in the camera frame, to distorted ones; the
//! focal lengths and the principal point map those to pixels. [`Distortion`] is a model and the vector of its parameters, with the
//! names and in the order of OpenCV's `calib3d`.
//!
//! # Adding a lens
//!
//! Write a file in this folder that implements [`lens::Lens`]: the formula, its derivatives, its range, and its names in files
//! (start from `radial.rs`). Add its `mod` and its line in the table below. Everything else uses the table: distortion and
//! undistortion, derivatives for adjustment, warps, and the files of `cv-io`. Nothing outside this folder may `match` on
//! the models. The tests below iterate over the table too; add parameter ranges of the lens in `tests::examples`.
//!
//! # Range
//!
//! A distortion polynomial is valid only up to its first turning point; beyond it rays fold back into the image.
//! [`Distortion::max_radius`] is this limit; [`Distortion::distort_in_range`] and [`Distortion::undistort`] refuse points beyond it.
//! Normalized coordinates express only rays less than 90° from the axis: fisheye pixels beyond that have no ray here.

mod fisheye4;
mod inverse;
mod lens;
mod none;
mod radial;
mod radial_tangential4;
mod radial_tangential5;
mod range;
mod rational8;
#[cfg(feature = "serde")]
mod serde_form;
mod simple_radial;
mod terms;
mod thin_prism12;

use nalgebra::{Matrix2, Point2};

pub use lens::{ColmapModel, LensInfo, LensProjection, MAX_PARAMETERS, ParameterJacobian};
use lens::{Lens, Parameters};

macro_rules! table {
    ($($model:ident: $lens:ty, $about:literal;)*) => {
        /// A lens model.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[cfg_attr(feature = "serde", derive(serde::Serialize))]
        #[non_exhaustive]
        pub enum DistortionModel {
            $(#[doc = $about] $model,)*
        }

        impl DistortionModel {
            /// All models, in the order of the table.
            pub const ALL: &'static [Self] = &[$(Self::$model),*];

            /// Returns the model's names and parameters.
            pub const fn info(self) -> &'static LensInfo {
                match self {
                    $(Self::$model => &<$lens as Lens>::INFO,)*
                }
            }
        }

        // Static dispatch: each function matches on the model once, around code that is compiled for each model.
        impl Distortion {
            #[inline(always)]
            fn evaluate(&self, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> (Point2<f64>, Matrix2<f64>) {
                match self.model {
                    $(DistortionModel::$model => <$lens as Lens>::evaluate(&self.parameters, p, parameter_jacobian),)*
                }
            }

            #[inline]
            fn evaluate_in_range(&self, p: Point2<f64>) -> Option<Point2<f64>> {
                match self.model {
                    $(DistortionModel::$model => {
                        let (q, j) = <$lens as Lens>::evaluate(&self.parameters, p, None);
                        range::is_in_range::<$lens>(&self.parameters, p, j.determinant()).then_some(q)
                    })*
                }
            }

            fn invert(&self, q: Point2<f64>) -> Point2<f64> {
                match self.model {
                    $(DistortionModel::$model => inverse::undistort::<$lens>(&self.parameters, q),)*
                }
            }

            fn radial_limit(&self) -> f64 {
                match self.model {
                    $(DistortionModel::$model => range::radial_limit::<$lens>(&self.parameters),)*
                }
            }
        }
    };
}

table! {
    None: none::Pinhole, "A pinhole: no parameters.";
    SimpleRadial: simple_radial::SimpleRadial, "`x' = x (1 + k1 r²)`: k1.";
    Radial: radial::Radial, "`x' = x (1 + k1 r² + k2 r⁴)`: k1, k2.";
    RadialTangential4: radial_tangential4::RadialTangential4, "Brown–Conrady: k1, k2, p1, p2.";
    RadialTangential5: radial_tangential5::RadialTangential5, "Brown–Conrady, OpenCV's usual five: k1, k2, p1, p2, k3.";
    Rational8: rational8::Rational8, "OpenCV's rational model: k1, k2, p1, p2, k3, k4, k5, k6.";
    ThinPrism12: thin_prism12::ThinPrism12, "The rational model and thin prism terms: k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4.";
    Fisheye4: fisheye4::Fisheye4, "Equidistant fisheye (Kannala–Brandt): k1, k2, k3, k4.";
}

impl DistortionModel {
    /// Returns the model of this name in our own files, current or former.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|m| m.info().name == name || m.info().former_names.contains(&name))
    }

    /// Returns the number of distortion parameters.
    pub const fn parameter_count(self) -> usize {
        self.info().parameters.len()
    }
}

/// The number of parameters is not that of the model.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the lens model {} has {needed} parameters, not {got}", model.info().name)]
pub struct ParameterCountError {
    /// The model.
    pub model: DistortionModel,
    /// Number of parameters given.
    pub got: usize,
    /// Number of parameters of the model.
    pub needed: usize,
}

/// Lens distortion, applied to normalized image coordinates `(x, y) = (X/Z, Y/Z)`: a model and its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(
    feature = "serde",
    serde(into = "serde_form::SerializedDistortion", try_from = "serde_form::SerializedDistortion")
)]
pub struct Distortion {
    model: DistortionModel,
    /// Zero beyond the model's count.
    parameters: Parameters,
}

impl Default for Distortion {
    fn default() -> Self {
        Self::NONE
    }
}

impl Distortion {
    /// No distortion: a pinhole.
    pub const NONE: Self = Self { model: DistortionModel::None, parameters: [0.0; MAX_PARAMETERS] };

    /// Pads the parameters with zeros, for the constructors of the models.
    const fn from_array<const N: usize>(model: DistortionModel, values: [f64; N]) -> Self {
        let mut parameters = [0.0; MAX_PARAMETERS];
        let mut i = 0;
        while i < N {
            parameters[i] = values[i];
            i += 1;
        }
        Self { model, parameters }
    }

    /// Makes the distortion of a model with these parameters.
    ///
    /// # Errors
    /// [`ParameterCountError`] where the model has more or fewer.
    pub fn new(model: DistortionModel, values: &[f64]) -> Result<Self, ParameterCountError> {
        let needed = model.parameter_count();
        if values.len() != needed {
            return Err(ParameterCountError { model, got: values.len(), needed });
        }
        let mut parameters = [0.0; MAX_PARAMETERS];
        parameters[..needed].copy_from_slice(values);
        Ok(Self { model, parameters })
    }

    /// Returns the distortion model.
    #[inline]
    pub const fn model(&self) -> DistortionModel {
        self.model
    }

    /// Whether the model is the pinhole (no distortion).
    #[inline]
    pub fn is_none(&self) -> bool {
        self.model == DistortionModel::None
    }

    /// Returns the parameters, in the order of the model's names.
    #[inline]
    pub fn parameters(&self) -> &[f64] {
        &self.parameters[..self.model.parameter_count()]
    }

    /// Returns the parameters, mutable.
    #[inline]
    pub fn parameters_mut(&mut self) -> &mut [f64] {
        &mut self.parameters[..self.model.parameter_count()]
    }

    /// Distorts normalized coordinates, also outside the lens's valid range.
    #[inline]
    pub fn distort(&self, p: Point2<f64>) -> Point2<f64> {
        self.evaluate(p, None).0
    }

    /// Distorts normalized coordinates, with the 2×2 Jacobian by the undistorted point.
    #[inline]
    pub fn distort_with_jacobian(&self, p: Point2<f64>) -> (Point2<f64>, Matrix2<f64>) {
        self.evaluate(p, None)
    }

    /// As [`Self::distort_with_jacobian`], with the Jacobian by the parameters too; columns beyond the model's parameters are zero.
    #[inline]
    pub fn distort_with_jacobians(&self, p: Point2<f64>) -> (Point2<f64>, Matrix2<f64>, ParameterJacobian) {
        let mut parameter_jacobian = ParameterJacobian::zeros();
        let (q, j) = self.evaluate(p, Some(&mut parameter_jacobian));
        (q, j, parameter_jacobian)
    }

    /// Distorts normalized coordinates; `None` beyond the range in which the lens is monotonic.
    ///
    /// The range is that of the radial terms ([`Self::max_radius`]). Tangential and prism terms shift the fold a little, so a point
    /// whose Jacobian determinant is not positive is refused too.
    #[inline]
    pub fn distort_in_range(&self, p: Point2<f64>) -> Option<Point2<f64>> {
        self.evaluate_in_range(p)
    }

    /// Undistorts normalized coordinates by Newton's method: four to six steps for commercial lenses, at most 40 steps and 100
    /// bisections.
    ///
    /// NaN where no undistorted point within the lens's valid range maps to `q`: beyond the largest radius of a lens that folds back,
    /// and beyond 90° of a fisheye.
    #[inline]
    pub fn undistort(&self, q: Point2<f64>) -> Point2<f64> {
        if self.is_none() { q } else { self.invert(q) }
    }

    /// Computes the undistorted normalized radius up to which the lens is monotonic: the first turning point of the distorted radius, or
    /// its pole (rational models), exact up to rounding. Infinity where there is neither, or (fisheye) not before 90°. Tangential and
    /// prism terms are ignored. Takes less than a microsecond; for many points see [`Self::distort_in_range`].
    pub fn max_radius(&self) -> f64 {
        let limit = self.radial_limit();
        match self.model.info().projection {
            LensProjection::Perspective => limit,
            LensProjection::Fisheye if limit < std::f64::consts::FRAC_PI_2 => limit.tan(),
            LensProjection::Fisheye => f64::INFINITY,
        }
    }

    /// Converts the distortion to another model; `None` where that model lacks a non-zero parameter or has another projection.
    pub fn converted(&self, model: DistortionModel) -> Option<Self> {
        let (from, to) = (self.model.info(), model.info());
        let mut out = Self { model, parameters: [0.0; MAX_PARAMETERS] };
        for (name, &value) in from.parameters.iter().zip(self.parameters()) {
            match to.parameters.iter().position(|n| n == name) {
                Some(i) => out.parameters[i] = value,
                None if value == 0.0 => {}
                None => return None,
            }
        }
        (from.projection == to.projection).then_some(out)
    }

    /// Converts the distortion to the model with the fewest parameters that can express it.
    pub fn simplified(&self) -> Self {
        let models = DistortionModel::ALL.iter().filter_map(|m| self.converted(*m));
        models.min_by_key(|d| d.model.parameter_count()).unwrap_or(*self)
    }

    /// Whether every parameter is finite.
    pub fn is_finite(&self) -> bool {
        self.parameters.iter().all(|v| v.is_finite())
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(crate) use tests::examples;
