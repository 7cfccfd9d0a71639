//! A pinhole: nothing is bent.

use nalgebra::{Matrix2, Point2};

use super::lens::{ByParameters, ColmapModel, Distorted, Lens, LensInfo, LensProjection, Parameters};

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

    type Slope = [f64; 1];

    #[inline(always)]
    fn slope(_: &Parameters) -> Self::Slope {
        [1.0]
    }

    #[inline(always)]
    fn evaluate(_: &Parameters, p: Point2<f64>, _: Option<&mut ByParameters>) -> Distorted {
        (p, Matrix2::identity())
    }
}
