//! Relative pose and shared focal length of two views, where many matches may be wrong.

use crate::epipolar::{Epipolar, SampsonKernel, SampsonProblem, refine_sampson, sampson};
use crate::error::{Degeneracy, EstimateError};
use crate::essential::{decompose_essential, essential_from_pose, in_front};
use crate::match_blocks::{LANES, MatchBlock, NormalizedMatches, Normalizer, check, point_degeneracy};
use crate::ransac::{Estimator, RobustOptions, Scorer, TukeyBiweight, ransac};
use crate::robust::RobustModel;
use crate::rotation::orthonormalized;
use crate::six_point::fundamental_six_point;
use cv_core::{Correspondence, Matrix3, Point2, Pose, Progress, Vector3};
use cv_numeric::LeastSquares;
use nalgebra::{SMatrix, SVector};

/// A relative pose, and the focal length of both cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct SharedFocalPose {
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Focal length, in the unit of the matches.
    pub focal: f64,
}

impl SharedFocalPose {
    /// The fundamental matrix between coordinates relative to the principal points, times the squared focal length.
    pub fn fundamental(&self) -> Matrix3<f64> {
        let k = self.scaling();
        k * essential_from_pose(&self.pose) * k
    }

    /// K⁻¹ times the focal length.
    fn scaling(&self) -> Matrix3<f64> {
        Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, self.focal))
    }

    fn scaled(self, factor: f64) -> Self {
        Self { focal: self.focal * factor, ..self }
    }
}

/// The relative pose and the focal length of two cameras of one unknown focal length, from matches in pixels relative to the principal points,
/// of which many may be wrong.
///
/// RANSAC over six-point samples ([`fundamental_six_point`]) with local optimization of pose and focal length together on the Sampson error.
/// Inliers lie in front of both cameras.
///
/// # Errors
/// [`EstimateError`]: fewer than seven matches, a coordinate that is not finite, coincident or collinear points, or no model supported by more
/// matches than the number of false alarms allows.
pub fn estimate_shared_focal_pose(
    matches: &[Correspondence],
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<RobustModel<SharedFocalPose>, EstimateError> {
    options.check()?;
    check(matches, 7)?;
    let size = size(matches);
    if size <= 0.0 {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Coincident });
    }
    let normalizer = Normalizer { center: Point2::origin(), scale: 1.0 / size };
    let set = NormalizedMatches::with(matches, normalizer, normalizer);
    if let Some(kind) = point_degeneracy(set.pairs.iter(), 7, 0.0) {
        return Err(EstimateError::Degenerate { kind });
    }
    let found = ransac(&FocalEstimator { set, scale: 1.0 / size }, options, progress)?;
    let model = found.model.scaled(size);
    let f = model.fundamental();
    let residual = |m: &SharedFocalPose, pair: &Correspondence| {
        let ray = |p: &Point2<f64>| Vector3::new(p.x, p.y, m.focal);
        let front = in_front(m.pose.rotation.matrix(), &m.pose.translation, &ray(&pair.a), &ray(&pair.b));
        if front { sampson(&f, pair) } else { f64::INFINITY }
    };
    Ok(RobustModel::new(model, matches, options.threshold, &found, residual))
}

/// Refines a pose and a focal length on all `matches` (pixels relative to the principal points) that are within reach, to the least robust
/// Sampson error.
///
/// Returns them and their loss: each match adds 0 (exact) to 1 (beyond 2.5 thresholds, in pixels).
pub fn refine_shared_focal_pose(
    start: &SharedFocalPose,
    matches: &[Correspondence],
    threshold: f64,
) -> (SharedFocalPose, f64) {
    let size = size(matches).max(f64::MIN_POSITIVE);
    let unit = |m: &Correspondence| [m.a.x / size, m.a.y / size, m.b.x / size, m.b.y / size];
    let pairs: Vec<[f64; 4]> = matches.iter().map(unit).collect();
    let problem = SampsonProblem::new(&pairs, &TukeyBiweight, threshold / size);
    let start = start.scaled(1.0 / size);
    let refined = refine_sampson(&problem, start, 50).and_then(straightened).unwrap_or(start);
    (refined.scaled(size), problem.cost(&refined))
}

/// Largest coordinate.
fn size(matches: &[Correspondence]) -> f64 {
    let largest = |m: &Correspondence| m.a.coords.amax().max(m.b.coords.amax());
    matches.iter().map(largest).fold(0.0, f64::max)
}

/// With the rotation made one again after many small turns.
fn straightened(model: SharedFocalPose) -> Option<SharedFocalPose> {
    let rotation = orthonormalized(&model.pose.rotation)?;
    Some(SharedFocalPose { pose: Pose::new(rotation, model.pose.translation), ..model })
}

/// Five degrees of freedom of the pose, and the logarithm of the focal length.
impl Epipolar<6> for SharedFocalPose {
    fn matrix(&self) -> Matrix3<f64> {
        self.fundamental()
    }

    fn tangent(&self) -> SMatrix<f64, 9, 6> {
        let k = self.scaling();
        let of_pose = Epipolar::<5>::tangent(&self.pose);
        let f = self.fundamental();
        SMatrix::from_fn(|i, d| {
            let (row, column) = (i / 3, i % 3);
            if d < 5 {
                of_pose[(i, d)] * k[(row, row)] * k[(column, column)]
            } else {
                // Of degree one in the focal length for each third coordinate.
                f[(row, column)] * f64::from(u8::from(row == 2) + u8::from(column == 2))
            }
        })
    }

    fn step(&self, d: &SVector<f64, 6>) -> Self {
        let pose = Epipolar::<5>::step(&self.pose, &d.fixed_rows::<5>(0).into_owned());
        // A step of more than a factor of two is beyond what a linearization knows.
        Self { pose, focal: self.focal * d[5].clamp(-0.7, 0.7).exp() }
    }
}

struct FocalEstimator {
    set: NormalizedMatches,
    scale: f64,
}

impl Estimator for FocalEstimator {
    type Model = SharedFocalPose;
    type Data = NormalizedMatches;
    type Kernel = SampsonKernel;
    const SAMPLE: usize = 6;
    const RESIDUAL_DIMENSION: i32 = 1;
    // As for calibrated poses.
    const RESAMPLES: usize = 20;

    fn data(&self) -> &NormalizedMatches {
        &self.set
    }

    fn unit(&self) -> f64 {
        self.scale
    }

    fn solve(&self, sample: &[u32], models: &mut Vec<SharedFocalPose>) {
        let pair = |i: usize| &self.set.pairs[sample[i] as usize];
        let a: [Point2<f64>; 6] = std::array::from_fn(|i| Point2::new(pair(i)[0], pair(i)[1]));
        let b: [Point2<f64>; 6] = std::array::from_fn(|i| Point2::new(pair(i)[2], pair(i)[3]));
        fundamental_six_point(&a, &b, |f, focal| {
            let k = Matrix3::from_diagonal(&Vector3::new(focal, focal, 1.0));
            let ray = |p: &Point2<f64>| Vector3::new(p.x, p.y, focal);
            for pose in decompose_essential(&(k * f * k)).into_iter().flatten() {
                let (r, t) = (pose.rotation.matrix(), &pose.translation);
                // At most one of the four poses has all six in front, and for most wrong samples none.
                if (0..6).all(|i| in_front(r, t, &ray(&a[i]), &ray(&b[i]))) {
                    models.push(SharedFocalPose { pose, focal });
                    return;
                }
            }
        });
    }

    fn kernel(&self, model: &SharedFocalPose) -> SampsonKernel {
        SampsonKernel::new(&model.fundamental())
    }

    #[inline(always)]
    fn squared_residuals(kernel: &SampsonKernel, block: &MatchBlock) -> [f32; LANES] {
        kernel.squared_residuals(block)
    }

    fn refine<C: Scorer>(
        &self,
        model: &SharedFocalPose,
        scorer: &C,
        threshold: f64,
        iterations: usize,
    ) -> Option<SharedFocalPose> {
        let problem = SampsonProblem::new(&self.set.pairs, scorer, threshold);
        refine_sampson(&problem, *model, iterations).and_then(straightened)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TwoViews;
    use cv_core::Silent;
    use proptest::prelude::*;

    /// Relative to the principal point.
    fn centered(views: &TwoViews, matches: Vec<Correspondence>) -> Vec<Correspondence> {
        let c = Point2::new(views.camera.cx, views.camera.cy).coords;
        matches.into_iter().map(|m| Correspondence { a: m.a - c, b: m.b - c }).collect()
    }

    proptest! {
        #[test]
        fn the_tangent_is_the_derivative(seed: u64, focal in 0.3..3.0f64) {
            let model = SharedFocalPose { pose: TwoViews::random(seed).pose, focal };
            let tangent = Epipolar::<6>::tangent(&model);
            for i in 0..6 {
                let mut d = SVector::<f64, 6>::zeros();
                d[i] = 1e-6;
                let numeric = (model.step(&d).fundamental() - model.step(&-d).fundamental()) / 2e-6;
                for k in 0..9 {
                    // Central differences of a smooth function of size up to ten: 1e-11 truncation, 1e-9 rounding.
                    prop_assert!((numeric[(k / 3, k % 3)] - tangent[(k, i)]).abs() < 1e-7);
                }
            }
        }
    }

    #[test]
    fn exact_matches_give_the_exact_focal_length_and_wrong_ones_matter_little() {
        let (mut exact, mut off) = (Vec::new(), Vec::new());
        for seed in 0..40 {
            let views = TwoViews::random(seed);
            let mut m = centered(&views, views.matches(60, 0.0));
            let options = RobustOptions { threshold: 1.0, seed, ..RobustOptions::default() };
            let error = |m: &[Correspondence]| {
                let found = estimate_shared_focal_pose(m, &options, &Silent).unwrap();
                assert!(found.inliers.len() >= 60);
                (refine_shared_focal_pose(&found.model, m, 1.0).0.focal / 500.0 - 1.0).abs()
            };
            exact.push(error(&m));
            m.extend(centered(&views, views.wrong(40)));
            off.push(error(&m));
        }
        exact.sort_by(f64::total_cmp);
        off.sort_by(f64::total_cmp);
        // Steps end when the cost falls by less than a millionth of what it is: of nothing, at 1e-3 px or less. The least favorable motion of
        // forty shows the focal length by a hundredth of a pixel for each per cent.
        assert!(exact[39] < 1e-3, "{exact:?}");
        // One or two wrong matches of forty lie near the right lines by chance, and pull as one or two of sixty do.
        assert!(off[20] < 5e-3 && off[39] < 0.1, "{off:?}");
    }

    #[test]
    fn bad_input_gets_a_typed_answer() {
        let views = TwoViews::random(1);
        let options = RobustOptions { threshold: 1.0, ..RobustOptions::default() };
        let good = centered(&views, views.matches(20, 0.0));
        let get = |m: &[Correspondence]| estimate_shared_focal_pose(m, &options, &Silent).unwrap_err();
        assert_eq!(get(&good[..6]), EstimateError::NotEnoughMatches { got: 6, needed: 7 });
        assert_eq!(
            get(&[Correspondence::new(0.0, 0.0, 0.0, 0.0); 9]),
            EstimateError::Degenerate { kind: Degeneracy::Coincident }
        );
        assert_eq!(get(&[good[0]; 9]), EstimateError::Degenerate { kind: Degeneracy::Coincident });
        let mut bad = good.clone();
        bad[2].b.x = f64::NAN;
        assert_eq!(get(&bad), EstimateError::NotFinite { index: 2 });
    }
}
