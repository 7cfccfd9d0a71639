//! One radial term: `x' = x (1 + k1 r²)`.

use nalgebra::Point2;

use super::lens::{ColmapModel, Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct SimpleRadial;

impl Distortion {
    /// One radial term: `x' = x (1 + k1 r²)`.
    pub const fn simple_radial(k1: f64) -> Self {
        Self::from_array(DistortionModel::SimpleRadial, [k1])
    }
}

impl Lens for SimpleRadial {
    const INFO: LensInfo = LensInfo {
        name: "simple_radial",
        former_names: &[],
        parameters: &["k1"],
        projection: LensProjection::Perspective,
        opencv: false,
        ros: None,
        kalibr: None,
        colmap: &[ColmapModel { name: "SIMPLE_RADIAL", id: 2, focal_lengths: 1, parameters: 1 }],
    };

    type MonotonicityPolynomial = [f64; 2];

    #[inline(always)]
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial {
        [1.0, 3.0 * k[0]]
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted {
        let r2 = terms::squared_radius(p);
        if let Some(out) = parameter_jacobian {
            terms::set_radial_columns(out, 0, 1, p, r2, 1.0);
        }
        terms::apply_radial_factor(p, terms::radial_polynomial([k[0]], r2))
    }
}
