//! Equidistant fisheye: `θ' = θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸)` with θ the angle from the optical axis and θ' the
//! distorted radius (Kannala & Brandt, "A generic camera model and calibration method for conventional, wide-angle, and fish-eye lenses", PAMI 2006).
//! OpenCV's `fisheye`, Kalibr's and ROS's `equidistant`, COLMAP's OPENCV_FISHEYE.

use nalgebra::{Matrix2, Point2};

use super::lens::{ColmapModel, Distorted, Lens, LensInfo, LensProjection, ParameterJacobian, Parameters};
use super::{Distortion, DistortionModel, terms};

pub(super) struct Fisheye4;

impl Distortion {
    /// Equidistant fisheye: `[k1, k2, k3, k4]`.
    pub const fn fisheye4(parameters: [f64; 4]) -> Self {
        Self::from_array(DistortionModel::Fisheye4, parameters)
    }
}

impl Lens for Fisheye4 {
    const INFO: LensInfo = LensInfo {
        name: "fisheye4",
        former_names: &["fisheye"],
        parameters: &["k1", "k2", "k3", "k4"],
        projection: LensProjection::Fisheye,
        opencv: true,
        ros: Some("equidistant"),
        kalibr: Some("equidistant"),
        colmap: &[
            ColmapModel { name: "SIMPLE_RADIAL_FISHEYE", id: 8, focal_lengths: 1, parameters: 1 },
            ColmapModel { name: "RADIAL_FISHEYE", id: 9, focal_lengths: 1, parameters: 2 },
            ColmapModel { name: "OPENCV_FISHEYE", id: 5, focal_lengths: 2, parameters: 4 },
        ],
    };

    type MonotonicityPolynomial = [f64; 5];

    #[inline(always)]
    fn monotonicity_polynomial(k: &Parameters) -> Self::MonotonicityPolynomial {
        [1.0, 3.0 * k[0], 5.0 * k[1], 7.0 * k[2], 9.0 * k[3]]
    }

    #[inline(always)]
    fn evaluate(k: &Parameters, p: Point2<f64>, parameter_jacobian: Option<&mut ParameterJacobian>) -> Distorted {
        let r2 = terms::squared_radius(p);
        let r = r2.sqrt();
        if r < 1e-8 {
            return (p, Matrix2::identity());
        }
        let theta = r.atan();
        let t2 = theta * theta;
        if let Some(out) = parameter_jacobian {
            terms::set_radial_columns(out, 0, 4, p, t2, theta / r);
        }
        let d = theta * (1.0 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3]))));
        let dd = 1.0 + t2 * (3.0 * k[0] + t2 * (5.0 * k[1] + t2 * (7.0 * k[2] + t2 * 9.0 * k[3])));
        // g(r²) = d(θ)/r; by r²: (d'·θ'·r − d)/(2 r³) with θ' = 1/(1 + r²).
        terms::apply_radial_factor(p, (d / r, (dd * r / (1.0 + r2) - d) / (2.0 * r2 * r)))
    }
}
