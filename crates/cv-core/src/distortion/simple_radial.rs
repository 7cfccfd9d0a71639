//! One radial term: `x' = x (1 + k1 r²)`.

use nalgebra::Point2;

use super::lens::{ByParameters, ColmapModel, Distorted, Lens, LensInfo, LensProjection, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct SimpleRadial;

impl Distortion {
    /// One radial term: `x' = x (1 + k1 r²)`.
    pub const fn simple_radial(k1: f64) -> Self {
        Self::of(DistortionModel::SimpleRadial, [k1])
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

    type Slope = [f64; 2];

    #[inline(always)]
    fn slope(k: &Parameters) -> Self::Slope {
        [1.0, 3.0 * k[0]]
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, by_parameters: Option<&mut ByParameters>) -> Distorted {
        let r2 = terms::squared_radius(p);
        if let Some(out) = by_parameters {
            terms::by_radial(out, 0, 1, p, r2, 1.0);
        }
        terms::radial(p, terms::polynomial([k[0]], r2))
    }
}
