//! The lens that the matches themselves tell: focal length and radial distortion.

use super::{PLAUSIBLE_FOCAL, TwoViewError, usual_focal};
use crate::{
    EstimateError, RobustOptions, Scorer, SharedFocalPose, TukeyBiweight, essential_from_pose, estimate_relative_pose,
    estimate_shared_focal_pose, normalize_matches, refine_relative_pose, refine_shared_focal_pose, sampson,
};
use cv_core::{Camera, Cancelled, Correspondence, Distortion, Matrix3, Pose, Progress, Stage};
use rayon::prelude::*;

/// Focal lengths in pixels, and by how much of their distance from the middle the corners are displaced.
#[derive(Clone, Copy)]
struct Lens {
    focal: [f64; 2],
    distortion: f64,
}

/// A lens, the pose that goes with it, and what each match loses by them.
#[derive(Clone)]
struct Trial {
    lens: Lens,
    pose: Pose,
    losses: Vec<f64>,
    sum: f64,
}

/// What [`find_lens`] found.
pub(super) struct Found {
    pub(super) cameras: [Camera; 2],
    /// Largest relative change of the focal length that the matches do not exclude; 0 where it was given.
    pub(super) focal_range: f64,
    /// Where the focal length was given and is far from one that explains the matches much better.
    pub(super) rival: Option<Rival>,
}

/// Another focal length than the one given.
pub(super) struct Rival {
    /// In pixels.
    pub(super) focal: f64,
    /// By how many standard deviations it fits better.
    pub(super) deviations: f64,
    /// Matches within the threshold.
    pub(super) inliers: usize,
}

/// Standard deviations that leave no doubt: one chance in thirty thousand.
const BEYOND_DOUBT: f64 = 4.0;
/// A given focal length this far from the best one, as a logarithm (half as long again), is no inaccuracy of EXIF but another lens, a cropped picture, or another unit.
const FAR: f64 = 0.405;

/// Displacements of the corners that are tried: from the barrel of a wide angle to the pincushion of a long lens. The steps between them are
/// narrowed down.
const DISTORTIONS: [f64; 5] = [-0.09, -0.06, -0.03, 0.0, 0.03];
/// Focal lengths as shares of the longer side that are tried where the matches lead to none that photographs have: a factor of a half apart.
pub(super) const USUAL_FOCALS: [f64; 5] = [0.5, 0.75, 1.1, 1.7, 2.5];
/// Displacements that a search may end at: a fisheye distorts more, and is no lens for this model. Without an end, forward motion, whose flow a
/// distorting lens can imitate, leads on and on.
const DISTORTION_RANGE: (f64, f64) = (-0.3, 0.15);
/// Most steps of a search; from the grid to the optimum it takes ten or so.
const MAX_STEPS: usize = 40;
/// Samples for each of them: enough to find a pose among half wrong matches, of five (the focal length given) or six; the right lens needs
/// the fewest.
const SAMPLES: [usize; 2] = [300, 800];

/// The lens whose best pose leaves the least robust Sampson error, with the focal lengths of `base` or, where that is `free`, of all. Distortion is left out
/// where it makes no significant difference; the cameras have a radial model all the same. `None` where no lens has a pose. O(matches) for each of some hundred trials and
/// some thousand samples.
pub(super) fn find_lens(
    pairs: &[Correspondence],
    base: [Camera; 2],
    free: bool,
    robust: &RobustOptions,
    progress: &dyn Progress,
) -> Result<Option<Found>, Cancelled> {
    let stage = Stage::new(progress, "lens", DISTORTIONS.len() + AFTERWARDS)?;
    let search = Search { pairs, base, robust, stage: &stage };
    let searched = |distortion: &f64| -> Result<Option<Trial>, Cancelled> {
        let given = Lens { focal: base.map(|camera| camera.fx), distortion: *distortion };
        let trial = if free { search.searched_free(*distortion) } else { search.searched(given) }?;
        stage.add(1)?;
        Ok(trial)
    };
    let trials: Vec<Option<Trial>> = DISTORTIONS.par_iter().map(searched).collect::<Result<_, _>>()?;
    let mut trials: Vec<Trial> = trials.into_iter().flatten().collect();
    let mut found = match least(&trials) {
        Some(first) => {
            // From the best one's pose too: a search now and then ends elsewhere.
            for trial in &mut trials {
                stage.check()?;
                let other = search.near(&first, trial.lens.distortion, free);
                if other.sum < trial.sum {
                    *trial = other;
                }
            }
            let pinhole = trials.iter().find(|t| t.lens.distortion == 0.0).cloned();
            let distorted = search.narrow(least(&trials).unwrap_or(first), free)?;
            Some(match pinhole {
                Some(pinhole) if !significantly_worse(&pinhole, &distorted) => pinhole,
                _ => distorted,
            })
        }
        None => None,
    };
    stage.add(1)?;
    if free {
        // A focal length that photographs hardly have must be needed.
        let plausible = |best: &Trial| is_plausible(best.lens.focal[0], &base[0]);
        if !found.as_ref().is_some_and(plausible) {
            let usual = search.of_usual_focal()?;
            let is_possible =
                |free: &Trial| TwoViewError::check_focal(free.lens.focal[0], longer_side(&base[0])).is_ok();
            found = match (found.filter(is_possible), usual) {
                (Some(free), Some(usual)) if worse_by(&usual, &free) > doubt(free.lens.focal[0], &base[0]) => {
                    Some(free)
                }
                (free, usual) => usual.or(free),
            };
        }
    }
    stage.add(1)?;
    let Some(best) = found else { return Ok(None) };
    let focal_range = if free { search.focal_range(&best)? } else { 0.0 };
    let rival = if free { None } else { search.rival(&best)? };
    stage.add(1)?;
    let with_radial = |camera: Camera| match camera.distortion.is_none() {
        true => Camera { distortion: Distortion::radial(0.0, 0.0), ..camera },
        false => camera,
    };
    Ok(Some(Found { cameras: search.cameras(&best.lens).map(with_radial), focal_range, rival }))
}

/// Steps of the progress after the distortions: narrowing down, usual focal lengths, what else fits.
const AFTERWARDS: usize = 3;

/// The one with the least loss.
fn least(trials: &[Trial]) -> Option<Trial> {
    trials.iter().min_by(|a, b| a.sum.total_cmp(&b.sum)).cloned()
}

/// Whether photographs have such focal lengths.
fn is_plausible(focal: f64, camera: &Camera) -> bool {
    let (low, high) = PLAUSIBLE_FOCAL;
    (low..=high).contains(&(focal / longer_side(camera) as f64))
}

fn longer_side(camera: &Camera) -> usize {
    camera.width.max(camera.height)
}

/// By how many standard deviations a focal length must fit better before it is believed: four, or by as many as it is from those that photographs have.
fn doubt(focal: f64, camera: &Camera) -> f64 {
    let (share, deviation) = usual_focal();
    let from_usual = (focal / longer_side(camera) as f64 / share).ln() / deviation;
    from_usual.abs().max(BEYOND_DOUBT)
}

/// Vuong's test at two standard deviations: see [`crate::poses_are_rivals`].
fn significantly_worse(a: &Trial, b: &Trial) -> bool {
    worse_by(a, b) > 2.0
}

/// By how many standard deviations of the difference `a` is worse; 0 where they are the same.
fn worse_by(a: &Trial, b: &Trial) -> f64 {
    let (sum, squares) =
        a.losses.iter().zip(&b.losses).fold((0.0, 0.0), |(s, q), (a, b)| (s + a - b, q + (a - b) * (a - b)));
    if squares > 0.0 { sum / f64::sqrt(squares) } else { 0.0 }
}

struct Search<'a> {
    pairs: &'a [Correspondence],
    /// The cameras without distortion; their focal lengths are scaled to those of a trial.
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

    /// The best pose of a search with a lens.
    fn searched(&self, lens: Lens) -> Result<Option<Trial>, Cancelled> {
        let [a, b] = self.cameras(&lens);
        let (normalized, unit) = normalize_matches(self.pairs, &a, &b);
        let usable: Vec<_> = normalized.into_iter().filter(Correspondence::is_finite).collect();
        let options = RobustOptions {
            threshold: self.robust.threshold * unit,
            max_iterations: SAMPLES[0].min(self.robust.max_iterations),
            ..*self.robust
        };
        let found = unless_stopped(estimate_relative_pose(&usable, &options, self.stage))?;
        Ok(found.map(|found| self.refined(lens, &found.model)))
    }

    /// The best pose and focal length of a search with a distortion.
    fn searched_free(&self, distortion: f64) -> Result<Option<Trial>, Cancelled> {
        let usable: Vec<_> = self.undistorted(distortion).into_iter().filter(Correspondence::is_finite).collect();
        let options = RobustOptions { max_iterations: SAMPLES[1].min(self.robust.max_iterations), ..*self.robust };
        let found = unless_stopped(estimate_shared_focal_pose(&usable, &options, self.stage))?;
        Ok(found.map(|found| self.refined_free(distortion, &found.model)))
    }

    /// The best of some focal lengths that photographs have.
    fn of_usual_focal(&self) -> Result<Option<Trial>, Cancelled> {
        let side = longer_side(&self.base[0]) as f64;
        let searched = |share: &f64| self.searched(Lens { focal: [share * side; 2], distortion: 0.0 });
        let trials: Vec<Option<Trial>> = USUAL_FOCALS.par_iter().map(searched).collect::<Result<_, _>>()?;
        let trials: Vec<Trial> = trials.into_iter().flatten().collect();
        least(&trials).map(|best| self.narrow(best, false)).transpose()
    }

    /// Largest relative change of the focal length, up to a half, that the matches do not exclude.
    fn focal_range(&self, best: &Trial) -> Result<f64, Cancelled> {
        let mut range = 0.0f64;
        for direction in [1.0, -1.0] {
            // From the last pose on, so that each starts in the right place.
            let mut at = best.clone();
            for k in 1..=8 {
                self.stage.check()?;
                let factor = 1.05f64.powf(direction * f64::from(k));
                let lens = Lens { focal: best.lens.focal.map(|f| f * factor), distortion: at.lens.distortion };
                at = self.refined(lens, &at.pose);
                if best.lens.distortion != 0.0 {
                    at = self.narrow(at, false)?;
                }
                if significantly_worse(&at, best) {
                    break;
                }
                range = range.max((factor - 1.0).abs());
            }
        }
        Ok(range)
    }

    /// A focal length far from the given one that is better beyond doubt.
    fn rival(&self, given: &Trial) -> Result<Option<Rival>, Cancelled> {
        let Some(other) = self.searched_free(given.lens.distortion)? else { return Ok(None) };
        let other = self.narrow(other, true)?;
        let usual = (given.lens.focal[0] * given.lens.focal[1]).sqrt();
        let focal = other.lens.focal[0];
        let deviations = worse_by(given, &other);
        let reach = f64::from(TukeyBiweight.loss(1.0));
        let inliers = other.losses.iter().filter(|loss| **loss < reach).count();
        let far = (focal / usual).ln().abs() > FAR && is_plausible(focal, &self.base[0]);
        Ok((far && deviations > BEYOND_DOUBT).then_some(Rival { focal, deviations, inliers }))
    }

    /// The best one near another with another distortion, the focal length too where it is free.
    fn near(&self, other: &Trial, distortion: f64, free: bool) -> Trial {
        if free {
            self.refined_free(distortion, &SharedFocalPose { pose: other.pose, focal: other.lens.focal[0] })
        } else {
            self.refined(Lens { distortion, ..other.lens }, &other.pose)
        }
    }

    /// The best pose near another.
    fn refined(&self, lens: Lens, pose: &Pose) -> Trial {
        let [a, b] = self.cameras(&lens);
        let (normalized, unit) = normalize_matches(self.pairs, &a, &b);
        let threshold = self.robust.threshold * unit;
        let usable: Vec<_> = normalized.iter().copied().filter(Correspondence::is_finite).collect();
        let (pose, _) = refine_relative_pose(pose, &usable, threshold);
        trial(lens, pose, &essential_from_pose(&pose), &normalized, threshold)
    }

    /// The best pose and focal length near others.
    fn refined_free(&self, distortion: f64, start: &SharedFocalPose) -> Trial {
        let matches = self.undistorted(distortion);
        let usable: Vec<_> = matches.iter().copied().filter(Correspondence::is_finite).collect();
        let (found, _) = refine_shared_focal_pose(start, &usable, self.robust.threshold);
        let lens = Lens { focal: [found.focal; 2], distortion };
        trial(lens, found.pose, &found.fundamental(), &matches, self.robust.threshold)
    }

    /// Matches in pixels from the principal points with the distortion taken out: it is a share of the picture, whatever the focal length.
    fn undistorted(&self, distortion: f64) -> Vec<Correspondence> {
        let any = longer_side(&self.base[0]) as f64;
        let [a, b] = self.cameras(&Lens { focal: [any; 2], distortion });
        let (normalized, _) = normalize_matches(self.pairs, &a, &b);
        normalized.into_iter().map(|m| Correspondence { a: m.a * any, b: m.b * any }).collect()
    }

    /// Steps of the distortion, halved where none helps, down to a thousandth.
    fn narrow(&self, mut best: Trial, free: bool) -> Result<Trial, Cancelled> {
        let mut step = 1.0;
        for _ in 0..MAX_STEPS {
            if step <= 0.05 {
                break;
            }
            self.stage.check()?;
            let distortions = [-1.0, 1.0]
                .map(|sign| (best.lens.distortion + 0.015 * sign * step).clamp(DISTORTION_RANGE.0, DISTORTION_RANGE.1));
            let trials: Vec<Trial> =
                distortions.par_iter().map(|distortion| self.near(&best, *distortion, free)).collect();
            match trials.into_iter().min_by(|a, b| a.sum.total_cmp(&b.sum)) {
                Some(trial) if trial.sum < best.sum => best = trial,
                _ => step *= 0.5,
            }
        }
        Ok(best)
    }
}

/// What was found, if anything, unless the search was stopped.
fn unless_stopped<T>(found: Result<T, EstimateError>) -> Result<Option<T>, Cancelled> {
    match found {
        Err(EstimateError::Cancelled(stop)) => Err(stop),
        found => Ok(found.ok()),
    }
}

/// What each match loses by a geometry.
fn trial(lens: Lens, pose: Pose, f: &Matrix3<f64>, matches: &[Correspondence], threshold: f64) -> Trial {
    let loss = |m: &Correspondence| {
        let r = sampson(f, m) / threshold;
        f64::from(TukeyBiweight.loss((r * r) as f32))
    };
    let losses: Vec<f64> = matches.iter().map(loss).collect();
    let sum = losses.iter().sum();
    Trial { lens, pose, losses, sum }
}
