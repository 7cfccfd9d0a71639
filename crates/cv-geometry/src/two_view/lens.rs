//! Self-calibration from the matches of two views: focal length and radial distortion.

use super::{PLAUSIBLE_FOCAL, TwoViewError, log_normal_focal_prior};
use crate::{
    EstimateError, RobustOptions, Scorer, SharedFocalPose, TukeyBiweight, essential_from_pose, estimate_relative_pose,
    estimate_shared_focal_pose, normalize_matches, refine_relative_pose, refine_shared_focal_pose, sampson,
};
use cv_core::{Camera, Cancelled, Correspondence, Distortion, Matrix3, Pose, Progress, Stage};
use cv_parallel::prelude::*;

/// Focal lengths in pixels, and the radial distortion as the relative displacement of the image corners.
#[derive(Clone, Copy)]
struct Lens {
    focal: [f64; 2],
    distortion: f64,
}

/// A lens, its refined pose, and the loss of each match.
#[derive(Clone)]
struct LensHypothesis {
    lens: Lens,
    pose: Pose,
    losses: Vec<f64>,
    total_loss: f64,
}

/// Result of [`find_lens`].
pub(super) struct LensEstimate {
    pub(super) cameras: [Camera; 2],
    /// Maximum relative change of the focal length that the matches do not exclude; 0 if it was given.
    pub(super) focal_range: f64,
    /// A focal length far from the given one that fits the matches significantly better.
    pub(super) alternative: Option<AlternativeFocal>,
}

/// A focal length that fits better than the given one.
pub(super) struct AlternativeFocal {
    /// In pixels.
    pub(super) focal: f64,
    /// Difference of the losses in standard deviations of it.
    pub(super) deviations: f64,
    /// Number of matches within the threshold.
    pub(super) inliers: usize,
}

/// Significance level of a contradiction, in standard deviations: a probability of 1 in 30 000.
const SIGNIFICANCE: f64 = 4.0;
/// Minimum absolute log ratio (a factor of 1.5) of an alternative to the given focal length: more than the inaccuracy
/// of EXIF, so another lens, a cropped image, or another unit.
const MIN_LOG_FOCAL_RATIO: f64 = 0.405;

/// Grid of relative corner displacements: from the barrel distortion of wide-angle lenses to the pincushion distortion
/// of telephoto lenses. The best one is refined.
const DISTORTION_GRID: [f64; 5] = [-0.09, -0.06, -0.03, 0.0, 0.03];
/// Grid of focal lengths relative to the longer image side, with a ratio of 1.5, for matches whose best focal length is
/// implausible.
pub(super) const FOCAL_GRID: [f64; 5] = [0.5, 0.75, 1.1, 1.7, 2.5];
/// Bounds of the relative corner displacement: fisheye lenses, with more distortion, do not fit this model. Without
/// bounds, the search diverges for forward motion, whose flow radial distortion can imitate.
const DISTORTION_RANGE: (f64, f64) = (-0.3, 0.15);
/// Maximum number of steps of a line search; about ten are typical.
const MAX_STEPS: usize = 40;
/// Maximum number of RANSAC samples for each lens, for five-point (known focal length) and six-point samples: enough
/// for an outlier ratio of 0.5.
const MAX_SAMPLES: [usize; 2] = [300, 800];

/// Finds the lens whose best pose has the minimum robust Sampson error, with the focal lengths of `base`, or any focal
/// length if `is_focal_free`. Distortion is zero unless it makes a significant difference; the cameras have a radial
/// model in any case. `None` if no lens has a pose. O(matches) for each of about a hundred hypotheses and a thousand
/// samples.
pub(super) fn find_lens(
    pairs: &[Correspondence],
    base: [Camera; 2],
    is_focal_free: bool,
    robust: &RobustOptions,
    progress: &dyn Progress,
) -> Result<Option<LensEstimate>, Cancelled> {
    let stage = Stage::new(progress, "lens", DISTORTION_GRID.len() + REFINEMENT_STAGES)?;
    let search = Search { pairs, base, robust, stage: &stage };
    let search_distortion = |distortion: &f64| -> Result<Option<LensHypothesis>, Cancelled> {
        let given = Lens { focal: base.map(|camera| camera.fx), distortion: *distortion };
        let hypothesis =
            if is_focal_free { search.search_pose_and_focal(*distortion) } else { search.search_pose(given) }?;
        stage.add(1)?;
        Ok(hypothesis)
    };
    let hypotheses: Vec<Option<LensHypothesis>> = DISTORTION_GRID.par_iter().map(search_distortion).try_collect()?;
    let mut hypotheses: Vec<LensHypothesis> = hypotheses.into_iter().flatten().collect();
    let mut best = match min_loss(&hypotheses) {
        Some(first) => {
            // Refined from the best pose too: some searches end in other minima.
            for hypothesis in &mut hypotheses {
                stage.check()?;
                let other = search.refine_with_distortion(&first, hypothesis.lens.distortion, is_focal_free);
                if other.total_loss < hypothesis.total_loss {
                    *hypothesis = other;
                }
            }
            let pinhole = hypotheses.iter().find(|t| t.lens.distortion == 0.0).cloned();
            let distorted = search.refine_distortion(min_loss(&hypotheses).unwrap_or(first), is_focal_free)?;
            Some(match pinhole {
                Some(pinhole) if !is_significantly_worse(&pinhole, &distorted) => pinhole,
                _ => distorted,
            })
        }
        None => None,
    };
    stage.add(1)?;
    if is_focal_free {
        // An implausible focal length is accepted only if it fits significantly better than the plausible ones.
        let has_plausible_focal = |best: &LensHypothesis| is_plausible(best.lens.focal[0], &base[0]);
        if !best.as_ref().is_some_and(has_plausible_focal) {
            let plausible = search.search_focal_grid()?;
            let is_possible =
                |h: &LensHypothesis| TwoViewError::check_focal(h.lens.focal[0], longer_side(&base[0])).is_ok();
            best = match (best.filter(is_possible), plausible) {
                (Some(any), Some(plausible))
                    if loss_difference_sigmas(&plausible, &any) > required_sigmas(any.lens.focal[0], &base[0]) =>
                {
                    Some(any)
                }
                (any, plausible) => plausible.or(any),
            };
        }
    }
    stage.add(1)?;
    let Some(best) = best else { return Ok(None) };
    let focal_range = if is_focal_free { search.focal_range(&best)? } else { 0.0 };
    let alternative = if is_focal_free { None } else { search.alternative_focal(&best)? };
    stage.add(1)?;
    let with_radial = |camera: Camera| match camera.distortion.is_none() {
        true => Camera { distortion: Distortion::radial(0.0, 0.0), ..camera },
        false => camera,
    };
    Ok(Some(LensEstimate { cameras: search.cameras(&best.lens).map(with_radial), focal_range, alternative }))
}

/// Progress steps after the grid: refinement, plausible focal lengths, uncertainty.
const REFINEMENT_STAGES: usize = 3;

/// Returns the hypothesis with the minimum loss.
fn min_loss(hypotheses: &[LensHypothesis]) -> Option<LensHypothesis> {
    hypotheses.iter().min_by(|a, b| a.total_loss.total_cmp(&b.total_loss)).cloned()
}

/// Returns whether a focal length is in [`PLAUSIBLE_FOCAL`].
fn is_plausible(focal: f64, camera: &Camera) -> bool {
    let (low, high) = PLAUSIBLE_FOCAL;
    (low..=high).contains(&(focal / longer_side(camera) as f64))
}

fn longer_side(camera: &Camera) -> usize {
    camera.width.max(camera.height)
}

/// Returns by how many standard deviations a focal length must fit better to be accepted: four, or its distance from
/// the mean of the prior.
fn required_sigmas(focal: f64, camera: &Camera) -> f64 {
    let (median, deviation) = log_normal_focal_prior();
    let prior_sigmas = (focal / longer_side(camera) as f64 / median).ln() / deviation;
    prior_sigmas.abs().max(SIGNIFICANCE)
}

/// Applies Vuong's test at two standard deviations: see [`crate::poses_are_indistinguishable`].
fn is_significantly_worse(a: &LensHypothesis, b: &LensHypothesis) -> bool {
    loss_difference_sigmas(a, b) > 2.0
}

/// Computes how much larger the loss of `a` is, in standard deviations of the difference; 0 if all losses are equal.
fn loss_difference_sigmas(a: &LensHypothesis, b: &LensHypothesis) -> f64 {
    let (sum, squares) =
        a.losses.iter().zip(&b.losses).fold((0.0, 0.0), |(s, q), (a, b)| (s + a - b, q + (a - b) * (a - b)));
    if squares > 0.0 { sum / f64::sqrt(squares) } else { 0.0 }
}

struct Search<'a> {
    pairs: &'a [Correspondence],
    /// The cameras without distortion; a hypothesis replaces their focal lengths.
    base: [Camera; 2],
    robust: &'a RobustOptions,
    stage: &'a Stage<'a>,
}

impl Search<'_> {
    fn cameras(&self, lens: &Lens) -> [Camera; 2] {
        [0, 1].map(|i: usize| {
            let mut camera = self.base[i];
            (camera.fx, camera.fy) = (lens.focal[i], lens.focal[i] * (camera.fy / camera.fx));
            let corner = 0.5 * (camera.width as f64).hypot(camera.height as f64) / lens.focal[i];
            if lens.distortion != 0.0 {
                camera.distortion = Distortion::radial(lens.distortion / (corner * corner), 0.0);
            }
            camera
        })
    }

    /// Searches the best pose for a lens.
    fn search_pose(&self, lens: Lens) -> Result<Option<LensHypothesis>, Cancelled> {
        let [a, b] = self.cameras(&lens);
        let (normalized, unit) = normalize_matches(self.pairs, &a, &b);
        let usable: Vec<_> = normalized.into_iter().filter(Correspondence::is_finite).collect();
        let options = RobustOptions {
            threshold: self.robust.threshold * unit,
            max_iterations: MAX_SAMPLES[0].min(self.robust.max_iterations),
            ..*self.robust
        };
        let estimate = unless_cancelled(estimate_relative_pose(&usable, &options, self.stage))?;
        Ok(estimate.map(|estimate| self.refine_pose(lens, &estimate.model)))
    }

    /// Searches the best pose and focal length for a distortion.
    fn search_pose_and_focal(&self, distortion: f64) -> Result<Option<LensHypothesis>, Cancelled> {
        let usable: Vec<_> = self.undistorted(distortion).into_iter().filter(Correspondence::is_finite).collect();
        let options = RobustOptions { max_iterations: MAX_SAMPLES[1].min(self.robust.max_iterations), ..*self.robust };
        let estimate = unless_cancelled(estimate_shared_focal_pose(&usable, &options, self.stage))?;
        Ok(estimate.map(|estimate| self.refine_pose_and_focal(distortion, &estimate.model)))
    }

    /// Searches the best of a grid of plausible focal lengths.
    fn search_focal_grid(&self) -> Result<Option<LensHypothesis>, Cancelled> {
        let side = longer_side(&self.base[0]) as f64;
        let search = |ratio: &f64| self.search_pose(Lens { focal: [ratio * side; 2], distortion: 0.0 });
        let hypotheses: Vec<Option<LensHypothesis>> = FOCAL_GRID.par_iter().map(search).try_collect()?;
        let hypotheses: Vec<LensHypothesis> = hypotheses.into_iter().flatten().collect();
        min_loss(&hypotheses).map(|best| self.refine_distortion(best, false)).transpose()
    }

    /// Computes the maximum relative change of the focal length, up to a half, that the matches do not exclude.
    fn focal_range(&self, best: &LensHypothesis) -> Result<f64, Cancelled> {
        let mut range = 0.0f64;
        for direction in [1.0, -1.0] {
            // Each starts from the previous pose (continuation).
            let mut current = best.clone();
            for k in 1..=8 {
                self.stage.check()?;
                let factor = 1.05f64.powf(direction * f64::from(k));
                let lens = Lens { focal: best.lens.focal.map(|f| f * factor), distortion: current.lens.distortion };
                current = self.refine_pose(lens, &current.pose);
                if best.lens.distortion != 0.0 {
                    current = self.refine_distortion(current, false)?;
                }
                if is_significantly_worse(&current, best) {
                    break;
                }
                range = range.max((factor - 1.0).abs());
            }
        }
        Ok(range)
    }

    /// Searches a focal length far from the given one that fits significantly better.
    fn alternative_focal(&self, given: &LensHypothesis) -> Result<Option<AlternativeFocal>, Cancelled> {
        let Some(other) = self.search_pose_and_focal(given.lens.distortion)? else { return Ok(None) };
        let other = self.refine_distortion(other, true)?;
        let given_focal = (given.lens.focal[0] * given.lens.focal[1]).sqrt();
        let focal = other.lens.focal[0];
        let deviations = loss_difference_sigmas(given, &other);
        let inlier_loss = f64::from(TukeyBiweight.loss(1.0));
        let inliers = other.losses.iter().filter(|loss| **loss < inlier_loss).count();
        let is_far = (focal / given_focal).ln().abs() > MIN_LOG_FOCAL_RATIO && is_plausible(focal, &self.base[0]);
        Ok((is_far && deviations > SIGNIFICANCE).then_some(AlternativeFocal { focal, deviations, inliers }))
    }

    /// Refines a pose (and the focal length, if free) with another distortion.
    fn refine_with_distortion(&self, other: &LensHypothesis, distortion: f64, is_focal_free: bool) -> LensHypothesis {
        if is_focal_free {
            self.refine_pose_and_focal(distortion, &SharedFocalPose { pose: other.pose, focal: other.lens.focal[0] })
        } else {
            self.refine_pose(Lens { distortion, ..other.lens }, &other.pose)
        }
    }

    /// Refines a pose with a lens.
    fn refine_pose(&self, lens: Lens, pose: &Pose) -> LensHypothesis {
        let [a, b] = self.cameras(&lens);
        let (normalized, unit) = normalize_matches(self.pairs, &a, &b);
        let threshold = self.robust.threshold * unit;
        let usable: Vec<_> = normalized.iter().copied().filter(Correspondence::is_finite).collect();
        let (pose, _) = refine_relative_pose(pose, &usable, threshold);
        evaluate(lens, pose, &essential_from_pose(&pose), &normalized, threshold)
    }

    /// Refines a pose and a focal length with a distortion.
    fn refine_pose_and_focal(&self, distortion: f64, start: &SharedFocalPose) -> LensHypothesis {
        let matches = self.undistorted(distortion);
        let usable: Vec<_> = matches.iter().copied().filter(Correspondence::is_finite).collect();
        let (found, _) = refine_shared_focal_pose(start, &usable, self.robust.threshold);
        let lens = Lens { focal: [found.focal; 2], distortion };
        evaluate(lens, found.pose, &found.fundamental(), &matches, self.robust.threshold)
    }

    /// Returns the undistorted matches in pixels relative to the principal points. The distortion is relative to the
    /// image size, so it does not depend on the focal length.
    fn undistorted(&self, distortion: f64) -> Vec<Correspondence> {
        let focal = longer_side(&self.base[0]) as f64;
        let [a, b] = self.cameras(&Lens { focal: [focal; 2], distortion });
        let (normalized, _) = normalize_matches(self.pairs, &a, &b);
        normalized.into_iter().map(|m| Correspondence { a: m.a * focal, b: m.b * focal }).collect()
    }

    /// Refines the distortion by a line search, whose step is halved when neither direction improves, down to about
    /// 0.001.
    fn refine_distortion(&self, mut best: LensHypothesis, is_focal_free: bool) -> Result<LensHypothesis, Cancelled> {
        let mut step = 1.0;
        for _ in 0..MAX_STEPS {
            if step <= 0.05 {
                break;
            }
            self.stage.check()?;
            let distortions = [-1.0, 1.0]
                .map(|sign| (best.lens.distortion + 0.015 * sign * step).clamp(DISTORTION_RANGE.0, DISTORTION_RANGE.1));
            let hypotheses: Vec<LensHypothesis> = distortions
                .par_iter()
                .map(|distortion| self.refine_with_distortion(&best, *distortion, is_focal_free))
                .collect();
            match hypotheses.into_iter().min_by(|a, b| a.total_loss.total_cmp(&b.total_loss)) {
                Some(hypothesis) if hypothesis.total_loss < best.total_loss => best = hypothesis,
                _ => step *= 0.5,
            }
        }
        Ok(best)
    }
}

/// Converts any error but a cancellation to `None`.
fn unless_cancelled<T>(found: Result<T, EstimateError>) -> Result<Option<T>, Cancelled> {
    match found {
        Err(EstimateError::Cancelled(stop)) => Err(stop),
        found => Ok(found.ok()),
    }
}

/// Evaluates the loss of each match for a fundamental matrix.
fn evaluate(lens: Lens, pose: Pose, f: &Matrix3<f64>, matches: &[Correspondence], threshold: f64) -> LensHypothesis {
    let loss = |m: &Correspondence| {
        let r = sampson(f, m) / threshold;
        f64::from(TukeyBiweight.loss((r * r) as f32))
    };
    let losses: Vec<f64> = matches.iter().map(loss).collect();
    let total_loss = losses.iter().sum();
    LensHypothesis { lens, pose, losses, total_loss }
}
