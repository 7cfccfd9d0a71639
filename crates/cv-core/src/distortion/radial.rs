//! Two radial terms: `x' = x (1 + k1 r² + k2 r⁴)`.

use nalgebra::Point2;

use super::lens::{ColmapModel, Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct Radial;

impl Distortion {
    /// Two radial terms: `x' = x (1 + k1 r² + k2 r⁴)`.
    pub const fn radial(k1: f64, k2: f64) -> Self {
        Self::from_array(DistortionModel::Radial, [k1, k2])
    }
}

impl Lens for Radial {
    const INFO: LensInfo = LensInfo {
        name: "radial",
        former_names: &[],
        parameters: &["k1", "k2"],
        projection: LensProjection::Perspective,
        opencv: false,
        ros: None,
        kalibr: None,
        colmap: &[ColmapModel { name: "RADIAL", id: 3, focal_lengths: 1, parameters: 2 }],
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
        }
        terms::apply_radial_factor(p, terms::radial_polynomial([k[0], k[1]], r2))
    }
}
