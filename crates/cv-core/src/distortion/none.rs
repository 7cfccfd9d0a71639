//! The pinhole: no distortion.

use nalgebra::{Matrix2, Point2};

use super::lens::{ColmapModel, Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};

pub(super) struct Pinhole;

impl Lens for Pinhole {
    const INFO: LensInfo = LensInfo {
        name: "none",
        former_names: &[],
        parameters: &[],
        projection: LensProjection::Perspective,
        opencv: false,
        ros: None,
        kalibr: Some("none"),
        colmap: &[
            ColmapModel { name: "SIMPLE_PINHOLE", id: 0, focal_lengths: 1, parameters: 0 },
            ColmapModel { name: "PINHOLE", id: 1, focal_lengths: 2, parameters: 0 },
        ],
    };

    type MonotonicityPolynomial = [f64; 1];

    #[inline(always)]
    fn monotonicity_polynomial(_: &Parameters) -> Self::MonotonicityPolynomial {
        [1.0]
    }

    #[inline(always)]
    fn evaluate(_: &Parameters, p: Point2<f64>, _: Option<&mut ParameterJacobian>) -> Distorted {
        (p, Matrix2::identity())
    }
}
