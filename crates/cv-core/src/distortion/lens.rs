//! What a lens model is: the interface that each file of this folder fills in.

use nalgebra::{Matrix2, Point2, SMatrix};

/// The most parameters a lens model has.
pub const MAX_PARAMETERS: usize = 12;

/// A lens's parameters in its own order; those it does not have are zero.
pub(super) type Parameters = [f64; MAX_PARAMETERS];

/// Derivatives of a distorted point by the lens's parameters, a column each.
pub type ByParameters = SMatrix<f64, 2, MAX_PARAMETERS>;

/// A distorted point, and its derivative by the ideal one.
pub(super) type Distorted = (Point2<f64>, Matrix2<f64>);

/// What a lens's parameters bend. Lenses of one projection whose parameters have the same names are special cases of each other.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LensProjection {
    /// The picture of a plane: distances from the axis go as tan θ, and the parameters bend those.
    Perspective,
    /// Distances from the axis go as the angle θ itself (equidistant), and the parameters bend that.
    Fisheye,
}

/// A model of COLMAP: its focal lengths, the principal point, and then the first so many of our parameters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ColmapModel {
    /// Its name in `cameras.txt`.
    pub name: &'static str,
    /// Its number in `cameras.bin`.
    pub id: i32,
    /// Focal lengths: 1 or 2.
    pub focal_lengths: usize,
    /// How many parameters follow the principal point; the lens's others are zero.
    pub parameters: usize,
}

/// A lens model's names and counts.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct LensInfo {
    /// Its name in our own files.
    pub name: &'static str,
    /// Names it had in our own files before; still read.
    pub former_names: &'static [&'static str],
    /// The names of its parameters, in their order.
    pub parameters: &'static [&'static str],
    /// What the parameters bend.
    pub projection: LensProjection,
    /// Whether OpenCV knows it: its vector of distortion coefficients then has these parameters in this order.
    pub opencv: bool,
    /// ROS's `distortion_model` in `camera_info`.
    pub ros: Option<&'static str>,
    /// Kalibr's `distortion_model`.
    pub kalibr: Option<&'static str>,
    /// COLMAP's models that are this lens or a special case of it, fewest numbers first.
    pub colmap: &'static [ColmapModel],
}

/// A lens model.
pub(super) trait Lens {
    const INFO: LensInfo;

    /// Coefficients of a polynomial, constant term (1) first.
    type Slope: AsRef<[f64]>;

    /// A polynomial in r² (perspective) or θ² (fisheye) whose first positive root is where the lens stops to be monotonic: where the
    /// distorted distance from the axis turns back, or has a pole. Terms without rotational symmetry are left out.
    fn slope(k: &Parameters) -> Self::Slope;

    /// Ideal to distorted normalized coordinates, the derivative by the ideal ones, and, where asked for, those by the parameters (all
    /// columns of the lens's own parameters are set; the others are zero when it is called).
    fn evaluate(k: &Parameters, p: Point2<f64>, by_parameters: Option<&mut ByParameters>) -> Distorted;
}
