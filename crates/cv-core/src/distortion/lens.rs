//! The trait that every lens model of this folder implements, and its descriptive data.

use nalgebra::{Matrix2, Point2, SMatrix};

/// Maximum number of distortion parameters of a lens model.
pub const MAX_PARAMETERS: usize = 12;

/// Distortion parameters in the model's order; entries beyond the model's count are zero.
pub(super) type Parameters = [f64; MAX_PARAMETERS];

/// Derivatives of a distorted point by the distortion parameters, one column each.
pub type ParameterJacobian = SMatrix<f64, 2, MAX_PARAMETERS>;

/// A distorted point, and its derivative by the undistorted one.
pub(super) type Distorted = (Point2<f64>, Matrix2<f64>);

/// The ideal projection that the distortion parameters modify. Models of one projection whose parameters have the same names are special
/// cases of each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensProjection {
    /// Radius proportional to tan θ, θ the angle from the optical axis (rectilinear projection).
    Perspective,
    /// Radius proportional to θ (equidistant projection).
    Fisheye,
}

/// A camera model of COLMAP: focal lengths, principal point, then the first `parameters` distortion parameters of ours.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ColmapModel {
    /// Its name in `cameras.txt`.
    pub name: &'static str,
    /// Its model id in `cameras.bin`.
    pub id: i32,
    /// Number of focal lengths, 1 or 2.
    pub focal_lengths: usize,
    /// Number of distortion parameters after the principal point; the lens's others are zero.
    pub parameters: usize,
}

/// A lens model's names and parameters, here and in other tools' files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LensInfo {
    /// Its name in our own files.
    pub name: &'static str,
    /// Former names in our own files; still read.
    pub former_names: &'static [&'static str],
    /// The names of its parameters, in their order.
    pub parameters: &'static [&'static str],
    /// The ideal projection that the parameters modify.
    pub projection: LensProjection,
    /// Whether OpenCV has the model: its vector of distortion coefficients then has these parameters in this order.
    pub opencv: bool,
    /// ROS's `distortion_model` in `camera_info`.
    pub ros: Option<&'static str>,
    /// Kalibr's `distortion_model`.
    pub kalibr: Option<&'static str>,
    /// COLMAP's models that are this lens or a special case of it, fewest parameters first.
    pub colmap: &'static [ColmapModel],
}

/// A lens model.
pub(super) trait Lens {
    const INFO: LensInfo;

    /// Coefficients of a polynomial, constant term (1) first.
    type MonotonicityPolynomial: AsRef<[f64]>;

    /// Returns a polynomial in r² (perspective) or θ² (fisheye) whose first positive root is the limit of monotonicity: where the
    /// distorted radius has a turning point or a pole. Terms that are not radial are ignored.
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial;

    /// Distorts normalized coordinates and returns the Jacobian by them. Where `parameter_jacobian` is given (zero on entry), sets
    /// the columns of the lens's parameters in it.
    fn evaluate(k: &Parameters, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted;
}
