//! The focal length of a camera from the fundamental matrices between its views.

use crate::{CameraKnowledge, SfmInput, ViewPairModel};
use cv_core::{Camera, Matrix3};
use cv_numeric::svd3;

/// Focal lengths that are tried in turn where nothing tells one, as shares of the longer side: fields of view of 45, 71, 28 and 90 degrees.
const USUAL_FOCALS: [f64; 4] = [1.2, 0.7, 2.0, 0.5];

/// Focal lengths that are tried, as shares of the longer side, and how many on a logarithmic scale.
const RANGE: (f64, f64) = (0.3, 5.0);
const TRIALS: usize = 90;
/// How far from an essential matrix a pair may be before it counts as a wrong one: of the two singular values, `(s₁ − s₂) / (s₁ + s₂)`.
const REACH: f64 = 0.05;

/// The focal length with which the fundamental matrices come nearest to essential ones, in pixels: those whose two singular values are equal (Huang & Faugeras, "Some
/// properties of the E matrix in two-view motion estimation", PAMI 1989), each pair's misfit counted up to a limit. Principal points are in the middle.
///
/// `None` where no pair tells: all are of a plane, of a camera that turned or went straight ahead, or none agrees with another.
fn focal_length(camera: &Camera, pairs: &[(Matrix3<f64>, f64)]) -> Option<f64> {
    let longest = camera.width.max(camera.height) as f64;
    let cost = |focal: f64| -> f64 {
        let k = Camera::from_focal(camera.width, camera.height, focal).matrix();
        let misfit = |(f, weight): &(Matrix3<f64>, f64)| {
            let Ok(svd) = svd3(&(k.transpose() * f * k)) else { return *weight };
            let off = (svd.s[0] - svd.s[1]) / (svd.s[0] + svd.s[1]).max(f64::MIN_POSITIVE) / REACH;
            weight * off * off / (1.0 + off * off)
        };
        pairs.iter().map(misfit).sum()
    };
    let total: f64 = pairs.iter().map(|p| p.1).sum();
    let step = (RANGE.1 / RANGE.0).ln() / (TRIALS - 1) as f64;
    let of = |i: f64| longest * RANGE.0 * (step * i).exp();
    let costs: Vec<f64> = (0..TRIALS).map(|i| cost(of(i as f64))).collect();
    let best = (0..TRIALS).min_by(|a, b| costs[*a].total_cmp(&costs[*b]))?;
    // At an end of the range nothing was found, and where all are misfits neither.
    if best == 0 || best + 1 == TRIALS || costs[best] > 0.75 * total {
        return None;
    }
    // Golden section within the neighbors.
    let ratio = (5f64.sqrt() - 1.0) / 2.0;
    let (mut low, mut high) = (best as f64 - 1.0, best as f64 + 1.0);
    for _ in 0..30 {
        let (a, b) = (high - ratio * (high - low), low + ratio * (high - low));
        if cost(of(a)) <= cost(of(b)) { high = b } else { low = a }
    }
    Some(of(0.5 * (low + high)))
}

/// The cameras to begin with, in the order in which they are tried: where nothing is known of a focal length, that of the view graph first.
pub(crate) fn start_cameras(input: &SfmInput<'_>) -> Vec<Vec<Camera>> {
    let unknown = |c: usize| input.knowledge[c] == CameraKnowledge::Unknown;
    let used = (0..input.cameras.len()).any(|c| unknown(c) && input.views.iter().any(|v| v.camera == c));
    let usual = |share: &f64| {
        let all = input.cameras.iter().enumerate();
        let focal = |camera: &Camera| share * camera.width.max(camera.height) as f64;
        all.map(|(c, camera)| if unknown(c) { with_focal(camera, focal(camera)) } else { *camera }).collect()
    };
    let guessed = USUAL_FOCALS.iter().filter(|_| used).map(usual);
    std::iter::once(graph_cameras(input)).chain(guessed).collect()
}

/// The same camera with square pixels of another focal length.
fn with_focal(camera: &Camera, focal: f64) -> Camera {
    Camera { fx: focal, fy: focal, ..*camera }
}

/// The cameras with a focal length of the view graph, where nothing is known of it.
fn graph_cameras(input: &SfmInput<'_>) -> Vec<Camera> {
    let mut cameras = input.cameras.to_vec();
    for (c, camera) in cameras.iter_mut().enumerate() {
        if input.knowledge[c] != CameraKnowledge::Unknown {
            continue;
        }
        let own = |i: &usize| {
            let pair = &input.pairs[*i];
            input.views[pair.a].camera == c && input.views[pair.b].camera == c
        };
        let of = |i: usize| match input.geometry[i] {
            ViewPairModel::Fundamental(f) => Some((f, input.pairs[i].matches.len() as f64)),
            _ => None,
        };
        let pairs: Vec<_> = (0..input.pairs.len()).filter(own).filter_map(of).collect();
        if let Some(focal) = focal_length(camera, &pairs) {
            *camera = with_focal(camera, focal);
        }
    }
    cameras
}
