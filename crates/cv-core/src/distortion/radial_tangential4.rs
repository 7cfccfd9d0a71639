//! Brown–Conrady with two radial and two tangential terms: OpenCV's four coefficients, Kalibr's `radtan`, COLMAP's OPENCV.

use nalgebra::Point2;

use super::lens::{ColmapModel, Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct RadialTangential4;

impl Distortion {
    /// Two radial and two tangential terms: `[k1, k2, p1, p2]`.
    pub const fn radial_tangential4(parameters: [f64; 4]) -> Self {
        Self::from_array(DistortionModel::RadialTangential4, parameters)
    }
}

impl Lens for RadialTangential4 {
    const INFO: LensInfo = LensInfo {
        name: "radial_tangential4",
        former_names: &[],
        parameters: &["k1", "k2", "p1", "p2"],
        projection: LensProjection::Perspective,
        opencv: true,
        ros: None,
        kalibr: Some("radtan"),
        colmap: &[ColmapModel { name: "OPENCV", id: 4, focal_lengths: 2, parameters: 4 }],
    };

    type MonotonicityPolynomial = [f64; 3];

    #[inline(always)]
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial {
        [1.0, 3.0 * k[0], 5.0 * k[1]]
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted {
        let r2 = terms::squared_radius(p);
        if let Some(out) = parameter_jacobian {
            terms::set_radial_columns(out, 0, 2, p, r2, 1.0);
            terms::set_tangential_columns(out, 2, p, r2);
        }
        let mut distorted = terms::apply_radial_factor(p, terms::radial_polynomial([k[0], k[1]], r2));
        terms::add_tangential(&mut distorted, p, r2, [k[2], k[3]]);
        distorted
    }
}
