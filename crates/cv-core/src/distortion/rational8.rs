//! OpenCV's rational model: `x' = x (1 + k1 r² + k2 r⁴ + k3 r⁶) / (1 + k4 r² + k5 r⁴ + k6 r⁶)` and two tangential terms
//! (Claus & Fitzgibbon, "A rational function lens distortion model for general cameras", CVPR 2005, in OpenCV's form).

use nalgebra::Point2;

use super::lens::{ByParameters, ColmapModel, Distorted, Lens, LensInfo, LensProjection, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct Rational8;

impl Distortion {
    /// A rational radial factor and two tangential terms in OpenCV's order: `[k1, k2, p1, p2, k3, k4, k5, k6]`.
    pub const fn rational8(parameters: [f64; 8]) -> Self {
        Self::of(DistortionModel::Rational8, parameters)
    }
}

/// The rational factor and the tangential terms, the first eight parameters; shared with the thin prism.
#[inline(always)]
pub(super) fn rational_tangential(
    k: &Parameters,
    p: Point2<f64>,
    r2: f64,
    by_parameters: Option<&mut ByParameters>,
) -> Distorted {
    let rational = terms::rational([k[0], k[1], k[4]], [k[5], k[6], k[7]], r2);
    if let Some(out) = by_parameters {
        terms::by_radial(out, 0, 2, p, r2, rational.inverse);
        terms::by_tangential(out, 2, p, r2);
        terms::by_radial(out, 4, 1, p, r2, r2 * r2 * rational.inverse);
        terms::by_radial(out, 5, 3, p, r2, -rational.factor.0 * rational.inverse);
    }
    let mut distorted = terms::radial(p, rational.factor);
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

    type Slope = [f64; 10];

    #[inline(always)]
    fn slope(k: &Parameters) -> Self::Slope {
        terms::rational_slope([k[0], k[1], k[4]], [k[5], k[6], k[7]])
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, by_parameters: Option<&mut ByParameters>) -> Distorted {
        rational_tangential(k, p, terms::squared_radius(p), by_parameters)
    }
}
