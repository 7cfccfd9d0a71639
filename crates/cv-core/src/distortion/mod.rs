//! Lens distortion: a model out of a table, and its parameters.
//!
//! A lens model maps ideal normalized coordinates, `(x, y) = (X/Z, Y/Z)` of a point in the camera's frame, to distorted ones, which the
//! focal lengths and the principal point take to pixels. [`Distortion`] holds which model it is and a vector of its parameters, in the
//! names and the order of OpenCV's `calib3d`.
//!
//! # Adding a lens
//!
//! Write its file in this folder, an implementation of [`lens::Lens`] with the formula, its derivatives, its range and the names by
//! which files know it (start from `radial.rs`), and add its `mod` and its line in the table below. Everything else goes by the table:
//! distorting and undistorting, derivatives for adjustment, warps, and the files of `cv-io`. Nothing outside this folder may `match` on
//! the models. The tests below go through the table too; give them parameters of such a lens in `tests::examples`.
//!
//! # Range
//!
//! A polynomial means something only up to its first turning point; beyond it rays from far outside fold back into the picture.
//! [`Distortion::max_radius`] is where that is, [`Distortion::distort_in_range`] and [`Distortion::undistort`] refuse what lies beyond.
//! Normalized coordinates express rays less than 90° from the axis and no others: a fisheye's pixels beyond that have no ray here.

mod fisheye4;
mod inverse;
mod lens;
mod none;
mod radial;
mod radial_tangential4;
mod radial_tangential5;
mod range;
mod rational8;
mod simple_radial;
#[cfg(feature = "serde")]
mod stored;
mod terms;
mod thin_prism12;

use nalgebra::{Matrix2, Point2};

pub use lens::{ByParameters, ColmapModel, LensInfo, LensProjection, MAX_PARAMETERS};
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
            /// All models: the table.
            pub const ALL: &'static [Self] = &[$(Self::$model),*];

            /// Its names and counts.
            pub const fn info(self) -> &'static LensInfo {
                match self {
                    $(Self::$model => &<$lens as Lens>::INFO,)*
                }
            }
        }

        // Each of these chooses the model once, around code that is compiled for each of them.
        impl Distortion {
            #[inline(always)]
            fn evaluate(&self, p: Point2<f64>, by_parameters: Option<&mut ByParameters>) -> (Point2<f64>, Matrix2<f64>) {
                match self.model {
                    $(DistortionModel::$model => <$lens as Lens>::evaluate(&self.parameters, p, by_parameters),)*
                }
            }

            #[inline]
            fn checked(&self, p: Point2<f64>) -> Option<Point2<f64>> {
                match self.model {
                    $(DistortionModel::$model => {
                        let (q, j) = <$lens as Lens>::evaluate(&self.parameters, p, None);
                        range::contains::<$lens>(&self.parameters, p, j.determinant()).then_some(q)
                    })*
                }
            }

            fn inverse(&self, q: Point2<f64>) -> Point2<f64> {
                match self.model {
                    $(DistortionModel::$model => inverse::undistort::<$lens>(&self.parameters, q),)*
                }
            }

            fn end(&self) -> f64 {
                match self.model {
                    $(DistortionModel::$model => range::end::<$lens>(&self.parameters),)*
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
    /// The model of this name in our own files, today's or a former one.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.iter().copied().find(|m| m.info().name == name || m.info().former_names.contains(&name))
    }

    /// How many parameters it has.
    pub const fn parameter_count(self) -> usize {
        self.info().parameters.len()
    }
}

/// A model does not have so many parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the lens model {} has {needed} parameters, not {got}", model.info().name)]
pub struct ParameterCountError {
    /// The model.
    pub model: DistortionModel,
    /// How many were given.
    pub got: usize,
    /// How many it has.
    pub needed: usize,
}

/// Lens distortion, applied to normalized image coordinates `(x, y) = (X/Z, Y/Z)`: a model and its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(into = "stored::Stored", try_from = "stored::Stored"))]
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
    /// A pinhole.
    pub const NONE: Self = Self { model: DistortionModel::None, parameters: [0.0; MAX_PARAMETERS] };

    /// For the lenses' own constructors.
    const fn of<const N: usize>(model: DistortionModel, given: [f64; N]) -> Self {
        let mut parameters = [0.0; MAX_PARAMETERS];
        let mut i = 0;
        while i < N {
            parameters[i] = given[i];
            i += 1;
        }
        Self { model, parameters }
    }

    /// The lens of a model with these parameters.
    ///
    /// # Errors
    /// [`ParameterCountError`] where the model has more or fewer.
    pub fn new(model: DistortionModel, given: &[f64]) -> Result<Self, ParameterCountError> {
        let needed = model.parameter_count();
        if given.len() != needed {
            return Err(ParameterCountError { model, got: given.len(), needed });
        }
        let mut parameters = [0.0; MAX_PARAMETERS];
        parameters[..needed].copy_from_slice(given);
        Ok(Self { model, parameters })
    }

    /// Which model it is.
    #[inline]
    pub const fn model(&self) -> DistortionModel {
        self.model
    }

    /// Whether it is the pinhole's.
    #[inline]
    pub fn is_none(&self) -> bool {
        self.model == DistortionModel::None
    }

    /// The parameters, in the order of the model's names.
    #[inline]
    pub fn parameters(&self) -> &[f64] {
        &self.parameters[..self.model.parameter_count()]
    }

    /// The parameters, to be changed.
    #[inline]
    pub fn parameters_mut(&mut self) -> &mut [f64] {
        &mut self.parameters[..self.model.parameter_count()]
    }

    /// Ideal to distorted normalized coordinates, whether or not the ideal point lies within the lens's range.
    #[inline]
    pub fn distort(&self, p: Point2<f64>) -> Point2<f64> {
        self.evaluate(p, None).0
    }

    /// Ideal to distorted normalized coordinates, with the 2×2 derivative by the ideal ones.
    #[inline]
    pub fn distort_with_jacobian(&self, p: Point2<f64>) -> (Point2<f64>, Matrix2<f64>) {
        self.evaluate(p, None)
    }

    /// As [`Self::distort_with_jacobian`], with the derivatives by the parameters too: as many columns as the model has parameters, the
    /// others zero.
    #[inline]
    pub fn distort_with_jacobians(&self, p: Point2<f64>) -> (Point2<f64>, Matrix2<f64>, ByParameters) {
        let mut by_parameters = ByParameters::zeros();
        let (q, j) = self.evaluate(p, Some(&mut by_parameters));
        (q, j, by_parameters)
    }

    /// Ideal to distorted normalized coordinates; `None` beyond the range in which the lens is monotonic.
    ///
    /// The range is that of the radial part ([`Self::max_radius`]). Tangential and prism terms shift the fold a little: a point whose
    /// Jacobian's determinant is not positive is refused too.
    #[inline]
    pub fn distort_in_range(&self, p: Point2<f64>) -> Option<Point2<f64>> {
        self.checked(p)
    }

    /// Distorted to ideal normalized coordinates. Bounded: at most 40 steps of Newton's method and 100 halvings, four to six steps for
    /// lenses as they are sold.
    ///
    /// NaN where no ideal point within the lens's range maps there: beyond the picture's rim of a lens that folds back, and beyond 90°
    /// of a fisheye.
    #[inline]
    pub fn undistort(&self, q: Point2<f64>) -> Point2<f64> {
        if self.is_none() { q } else { self.inverse(q) }
    }

    /// The radius in ideal normalized coordinates up to which the lens is monotonic: where the distorted radius first turns back, or has a
    /// pole (rational models), exact up to rounding. Infinity where it nowhere does, or (fisheye) not before 90°. Terms that are not radial
    /// (tangential, prism) are left out of it. Less than a microsecond; for many points see [`Self::distort_in_range`].
    pub fn max_radius(&self) -> f64 {
        let end = self.end();
        match self.model.info().projection {
            LensProjection::Perspective => end,
            LensProjection::Fisheye if end < std::f64::consts::FRAC_PI_2 => end.tan(),
            LensProjection::Fisheye => f64::INFINITY,
        }
    }

    /// The same lens by another model; `None` where that cannot express it, by the names of the parameters that are not zero.
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

    /// The same lens by the model with the fewest parameters that can express it.
    pub fn simplified(&self) -> Self {
        let models = DistortionModel::ALL.iter().filter_map(|m| self.converted(*m));
        models.min_by_key(|d| d.model.parameter_count()).unwrap_or(*self)
    }

    /// True where every parameter is finite.
    pub fn is_finite(&self) -> bool {
        self.parameters.iter().all(|v| v.is_finite())
    }
}

#[cfg(test)]
mod tests;
#[cfg(test)]
pub(crate) use tests::examples;
