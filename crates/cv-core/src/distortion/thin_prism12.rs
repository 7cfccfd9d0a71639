//! OpenCV's thin prism model: the rational model, and terms for a tilted lens or sensor: `(s1 r² + s2 r⁴, s3 r² + s4 r⁴)`
//! (Weng, Cohen & Herniou, "Camera calibration with distortion models and accuracy evaluation", PAMI 1992).

use nalgebra::Point2;

use super::lens::{Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::rational8::rational_tangential;
use super::{Distortion, DistortionModel, terms};

pub(super) struct ThinPrism12;

impl Distortion {
    /// The rational model and four prism terms in OpenCV's order: `[k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4]`.
    pub const fn thin_prism12(parameters: [f64; 12]) -> Self {
        Self::from_array(DistortionModel::ThinPrism12, parameters)
    }
}

impl Lens for ThinPrism12 {
    const INFO: LensInfo = LensInfo {
        name: "thin_prism12",
        former_names: &[],
        parameters: &["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"],
        projection: LensProjection::Perspective,
        opencv: true,
        ros: None,
        kalibr: None,
        colmap: &[],
    };

    type MonotonicityPolynomial = [f64; 10];

    #[inline(always)]
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial {
        terms::rational_monotonicity_polynomial([k[0], k[1], k[4]], [k[5], k[6], k[7]])
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, mut parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted {
        let r2 = terms::squared_radius(p);
        let mut distorted = rational_tangential(k, p, r2, parameter_jacobian.as_deref_mut());
        terms::add_prism(&mut distorted, p, r2, [k[8], k[9], k[10], k[11]]);
        if let Some(out) = parameter_jacobian {
            terms::set_prism_columns(out, 8, r2);
        }
        distorted
    }
}
