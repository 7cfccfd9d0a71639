//! Brown–Conrady with three radial and two tangential terms: OpenCV's usual five coefficients, ROS's `plumb_bob`.

use nalgebra::Point2;

use super::lens::{Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct RadialTangential5;

impl Distortion {
    /// Three radial and two tangential terms in OpenCV's order: `[k1, k2, p1, p2, k3]`.
    pub const fn radial_tangential5(parameters: [f64; 5]) -> Self {
        Self::from_array(DistortionModel::RadialTangential5, parameters)
    }
}

impl Lens for RadialTangential5 {
    const INFO: LensInfo = LensInfo {
        name: "radial_tangential5",
        former_names: &["brown_conrady"],
        parameters: &["k1", "k2", "p1", "p2", "k3"],
        projection: LensProjection::Perspective,
        opencv: true,
        ros: Some("plumb_bob"),
        kalibr: None,
        colmap: &[],
    };

    type MonotonicityPolynomial = [f64; 4];

    #[inline(always)]
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial {
        [1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[4]]
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted {
        let r2 = terms::squared_radius(p);
        if let Some(out) = parameter_jacobian {
            terms::set_radial_columns(out, 0, 2, p, r2, 1.0);
            terms::set_tangential_columns(out, 2, p, r2);
            terms::set_radial_columns(out, 4, 1, p, r2, r2 * r2);
        }
        let mut distorted = terms::apply_radial_factor(p, terms::radial_polynomial([k[0], k[1], k[4]], r2));
        terms::add_tangential(&mut distorted, p, r2, [k[2], k[3]]);
        distorted
    }
}
