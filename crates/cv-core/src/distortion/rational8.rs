//! OpenCV's rational model: `x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)` and two tangential terms
//! (Claus & Fitzgibbon, "A rational function lens distortion model for general cameras", CVPR 2005, in OpenCV's form).

use nalgebra::Point2;

use super::lens::{ColmapModel, Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct Rational8;

impl Distortion {
    /// A rational radial factor and two tangential terms in OpenCV's order: `[k1, k2, p1, p2, k3, k4, k5, k6]`.
    pub const fn rational8(parameters: [f64; 8]) -> Self {
        Self::from_array(DistortionModel::Rational8, parameters)
    }
}

/// Evaluates the rational factor and the tangential terms, the first eight parameters; shared with the thin prism model.
#[inline(always)]
pub(super) fn rational_tangential(
    k: &Parameters,
    p: Point2<f64>,
    r2: f64,
    parameter_jacobian: Option<&mut ParameterJacobian>,
) -> Distorted {
    let rational = terms::rational_factor([k[0], k[1], k[4]], [k[5], k[6], k[7]], r2);
    if let Some(out) = parameter_jacobian {
        terms::set_radial_columns(out, 0, 2, p, r2, rational.inverse);
        terms::set_tangential_columns(out, 2, p, r2);
        terms::set_radial_columns(out, 4, 1, p, r2, r2 * r2 * rational.inverse);
        terms::set_radial_columns(out, 5, 3, p, r2, -rational.factor.0 * rational.inverse);
    }
    let mut distorted = terms::apply_radial_factor(p, rational.factor);
    terms::add_tangential(&mut distorted, p, r2, [k[2], k[3]]);
    distorted
}

impl Lens for Rational8 {
    const INFO: LensInfo = LensInfo {
        name: "rational8",
        former_names: &[],
        parameters: &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"],
        projection: LensProjection::Perspective,
        opencv: true,
        ros: Some("rational_polynomial"),
        kalibr: None,
        colmap: &[ColmapModel { name: "FULL_OPENCV", id: 6, focal_lengths: 2, parameters: 8 }],
    };

    type MonotonicityPolynomial = [f64; 10];

    #[inline(always)]
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial {
        terms::rational_monotonicity_polynomial([k[0], k[1], k[4]], [k[5], k[6], k[7]])
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted {
        rational_tangential(k, p, terms::squared_radius(p), parameter_jacobian)
    }
}
