//! The focal length of a camera from the fundamental matrices of its view pairs.

use crate::{CameraKnowledge, SfmInput, ViewPairModel};
use cv_core::{Camera, Matrix3};
use cv_numeric::svd3;

/// Focal lengths tried in turn where it cannot be estimated, as ratios of the longer image side: fields of view of 45,
/// 71, 28 and 90 degrees.
const FALLBACK_FOCALS: [f64; 4] = [1.2, 0.7, 2.0, 0.5];

/// Search range of the focal length, as ratios of the longer image side.
const FOCAL_RANGE: (f64, f64) = (0.3, 5.0);
/// Number of samples of the search range, evenly on a logarithmic scale.
const FOCAL_SAMPLES: usize = 90;
/// Scale of the robust loss (Geman-McClure) on the difference of the two singular values, `(s₁ − s₂) / (s₁ + s₂)`.
const LOSS_SCALE: f64 = 0.05;

/// Estimates the focal length in pixels that brings the weighted fundamental matrices closest to essential matrices,
/// which have two equal singular values (Huang & Faugeras, "Some properties of the E matrix in two-view motion
/// estimation", PAMI 1989), with a bounded loss for each pair. The principal point is the image center.
///
/// Returns `None` for degenerate pairs (a plane, a rotation, a motion along the optical axis) or without consensus.
fn estimate_focal(camera: &Camera, pairs: &[(Matrix3<f64>, f64)]) -> Option<f64> {
    let longest = camera.width.max(camera.height) as f64;
    let cost = |focal: f64| -> f64 {
        let k = Camera::from_focal(camera.width, camera.height, focal).matrix();
        let residual_cost = |(f, weight): &(Matrix3<f64>, f64)| {
            let Ok(svd) = svd3(&(k.transpose() * f * k)) else { return *weight };
            let residual = (svd.s[0] - svd.s[1]) / (svd.s[0] + svd.s[1]).max(f64::MIN_POSITIVE) / LOSS_SCALE;
            weight * residual * residual / (1.0 + residual * residual)
        };
        pairs.iter().map(residual_cost).sum()
    };
    let total: f64 = pairs.iter().map(|p| p.1).sum();
    let step = (FOCAL_RANGE.1 / FOCAL_RANGE.0).ln() / (FOCAL_SAMPLES - 1) as f64;
    let focal_at = |i: f64| longest * FOCAL_RANGE.0 * (step * i).exp();
    let costs: Vec<f64> = (0..FOCAL_SAMPLES).map(|i| cost(focal_at(i as f64))).collect();
    let best = (0..FOCAL_SAMPLES).min_by(|a, b| costs[*a].total_cmp(&costs[*b]))?;
    // No minimum inside the range, or all pairs are outliers.
    if best == 0 || best + 1 == FOCAL_SAMPLES || costs[best] > 0.75 * total {
        return None;
    }
    // Golden-section search between the neighboring samples.
    let ratio = (5f64.sqrt() - 1.0) / 2.0;
    let (mut low, mut high) = (best as f64 - 1.0, best as f64 + 1.0);
    for _ in 0..30 {
        let (a, b) = (high - ratio * (high - low), low + ratio * (high - low));
        if cost(focal_at(a)) <= cost(focal_at(b)) { high = b } else { low = a }
    }
    Some(focal_at(0.5 * (low + high)))
}

/// Returns the initial cameras in the order of trial: unknown focal lengths from the view graph first, then the
/// fallback values.
pub(crate) fn initial_cameras(input: &SfmInput<'_>) -> Vec<Vec<Camera>> {
    let is_unknown = |c: usize| input.knowledge[c] == CameraKnowledge::Unknown;
    let is_used = (0..input.cameras.len()).any(|c| is_unknown(c) && input.views.iter().any(|v| v.camera == c));
    let with_fallback = |ratio: &f64| {
        let all = input.cameras.iter().enumerate();
        let focal = |camera: &Camera| ratio * camera.width.max(camera.height) as f64;
        all.map(|(c, camera)| if is_unknown(c) { with_focal(camera, focal(camera)) } else { *camera }).collect()
    };
    let guessed = FALLBACK_FOCALS.iter().filter(|_| is_used).map(with_fallback);
    std::iter::once(cameras_from_view_graph(input)).chain(guessed).collect()
}

/// Returns the camera with another focal length and square pixels.
fn with_focal(camera: &Camera, focal: f64) -> Camera {
    Camera { fx: focal, fy: focal, ..*camera }
}

/// Returns the cameras, with focal lengths from the view graph where they are unknown.
fn cameras_from_view_graph(input: &SfmInput<'_>) -> Vec<Camera> {
    let mut cameras = input.cameras.to_vec();
    for (c, camera) in cameras.iter_mut().enumerate() {
        if input.knowledge[c] != CameraKnowledge::Unknown {
            continue;
        }
        let has_camera = |i: &usize| {
            let pair = &input.pairs[*i];
            input.views[pair.a].camera == c && input.views[pair.b].camera == c
        };
        let weighted = |i: usize| match input.geometry[i] {
            ViewPairModel::Fundamental(f) => Some((f, input.pairs[i].matches.len() as f64)),
            _ => None,
        };
        let pairs: Vec<_> = (0..input.pairs.len()).filter(has_camera).filter_map(weighted).collect();
        if let Some(focal) = estimate_focal(camera, &pairs) {
            *camera = with_focal(camera, focal);
        }
    }
    cameras
}
