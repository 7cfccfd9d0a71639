//! The lens that the matches themselves tell: focal length and radial distortion.

use cv_core::{Camera, Correspondence, Distortion, Pose};
use cv_geometry::{
    Marginal, RobustOptions, Scorer, essential_from_pose, estimate_relative_pose, normalize_matches,
    refine_relative_pose, sampson,
};
use rayon::prelude::*;

/// Focal lengths in pixels, and by how much of their distance from the middle the corners are displaced.
#[derive(Clone, Copy)]
struct Lens {
    focal: [f64; 2],
    bend: f64,
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
}

/// Displacements of the corners that are tried: from the barrel of a wide angle to the pincushion of a long lens. The steps between them are
/// narrowed down.
const BENDS: [f64; 5] = [-0.09, -0.06, -0.03, 0.0, 0.03];
/// Displacements that a search may end at: a fisheye bends more, and is no lens for this model. Without an end, forward motion, whose flow a
/// bent lens can imitate, leads on and on.
const BEND_RANGE: (f64, f64) = (-0.3, 0.15);
/// Most steps of a search; from the grid to the optimum it takes ten or so.
const MAX_STEPS: usize = 40;
/// Focal lengths that are tried, in longer sides: from 100 to 20 degrees of view.
const FOCALS: i32 = 10;
/// Samples for each: enough to find a pose among half wrong matches; the right lens needs the fewest.
const SAMPLES: usize = 300;

/// The lens whose best pose leaves the least robust Sampson error, among all focal lengths or with those given. Distortion is left out
/// where it makes no significant difference. `None` where no lens has a pose.
pub(super) fn find_lens(
    pairs: &[Correspondence],
    sizes: [(usize, usize); 2],
    given: Option<[f64; 2]>,
    robust: &RobustOptions,
) -> Option<Found> {
    let search = Search { pairs, sizes, robust };
    let longest = sizes[0].0.max(sizes[0].1) as f64;
    let focals: Vec<[f64; 2]> = match given {
        Some(focal) => vec![focal],
        None => (0..FOCALS).map(|k| [0.45 * longest * 1.2f64.powi(k); 2]).collect(),
    };
    let lenses: Vec<Lens> = focals.iter().flat_map(|&focal| BENDS.map(|bend| Lens { focal, bend })).collect();
    let trials: Vec<Trial> = lenses.par_iter().filter_map(|lens| search.searched(*lens)).collect();
    let least = |of: &mut dyn Iterator<Item = &Trial>| of.min_by(|a, b| a.sum.total_cmp(&b.sum)).cloned();
    let free = given.is_none();
    let straight = least(&mut trials.iter().filter(|t| t.lens.bend == 0.0)).map(|t| search.narrow(t, free, false));
    let bent = search.narrow(least(&mut trials.iter())?, free, true);
    let (best, bends) = match straight {
        Some(straight) if !significantly_worse(&straight, &bent) => (straight, false),
        _ => (bent, true),
    };
    let mut focal_range = 0.0f64;
    if free {
        for direction in [1.0, -1.0] {
            // Up to a half, and from the last pose on, so that each starts in the right place.
            let mut at = best.clone();
            for k in 1..=8 {
                let factor = 1.05f64.powf(direction * f64::from(k));
                let lens = Lens { focal: best.lens.focal.map(|f| f * factor), bend: at.lens.bend };
                at = search.narrow(search.refined(lens, &at.pose), false, bends);
                if significantly_worse(&at, &best) {
                    break;
                }
                focal_range = focal_range.max((factor - 1.0).abs());
            }
        }
    }
    Some(Found { cameras: search.cameras(&best.lens), focal_range })
}

/// Vuong's test at two standard deviations: see [`cv_geometry::poses_are_rivals`].
fn significantly_worse(a: &Trial, b: &Trial) -> bool {
    let (sum, squares) =
        a.losses.iter().zip(&b.losses).fold((0.0, 0.0), |(s, q), (a, b)| (s + a - b, q + (a - b) * (a - b)));
    sum > 2.0 * f64::sqrt(squares)
}

struct Search<'a> {
    pairs: &'a [Correspondence],
    sizes: [(usize, usize); 2],
    robust: &'a RobustOptions,
}

impl Search<'_> {
    fn cameras(&self, lens: &Lens) -> [Camera; 2] {
        [0, 1].map(|i: usize| {
            let (width, height) = self.sizes[i];
            let corner = 0.5 * (width as f64).hypot(height as f64) / lens.focal[i];
            let mut camera = Camera::from_focal(width, height, lens.focal[i]);
            if lens.bend != 0.0 {
                camera.distortion = Distortion::Radial { k1: lens.bend / (corner * corner), k2: 0.0 };
            }
            camera
        })
    }

    /// The best pose of a search.
    fn searched(&self, lens: Lens) -> Option<Trial> {
        let [a, b] = self.cameras(&lens);
        let (normalised, unit) = normalize_matches(self.pairs, &a, &b);
        let usable: Vec<_> = normalised.into_iter().filter(Correspondence::is_finite).collect();
        let options = RobustOptions {
            threshold: self.robust.threshold * unit,
            max_iterations: SAMPLES.min(self.robust.max_iterations),
            ..*self.robust
        };
        let found = estimate_relative_pose(&usable, &options).ok()?;
        Some(self.refined(lens, &found.model))
    }

    /// The best pose near another.
    fn refined(&self, lens: Lens, pose: &Pose) -> Trial {
        let [a, b] = self.cameras(&lens);
        let (normalised, unit) = normalize_matches(self.pairs, &a, &b);
        let threshold = self.robust.threshold * unit;
        let usable: Vec<_> = normalised.iter().copied().filter(Correspondence::is_finite).collect();
        let (pose, _) = refine_relative_pose(pose, &usable, threshold);
        let e = essential_from_pose(&pose);
        let loss = |m: &Correspondence| {
            let r = sampson(&e, m) / threshold;
            f64::from(Marginal.loss((r * r) as f32))
        };
        let losses: Vec<f64> = normalised.iter().map(loss).collect();
        let sum = losses.iter().sum();
        Trial { lens, pose, losses, sum }
    }

    /// Steps of focal length and distortion, halved where none helps, down to half a per cent and a thousandth.
    fn narrow(&self, mut best: Trial, focal: bool, bend: bool) -> Trial {
        let mut step = 1.0;
        for _ in 0..MAX_STEPS {
            if step <= 0.05 {
                break;
            }
            let mut lenses = Vec::new();
            for sign in [-1.0f64, 1.0] {
                if focal {
                    lenses.push(Lens { focal: best.lens.focal.map(|f| f * (0.09 * sign * step).exp()), ..best.lens });
                }
                if bend {
                    let bend = (best.lens.bend + 0.015 * sign * step).clamp(BEND_RANGE.0, BEND_RANGE.1);
                    lenses.push(Lens { bend, ..best.lens });
                }
            }
            let trials: Vec<Trial> = lenses.par_iter().map(|lens| self.refined(*lens, &best.pose)).collect();
            match trials.into_iter().min_by(|a, b| a.sum.total_cmp(&b.sum)) {
                Some(trial) if trial.sum < best.sum => best = trial,
                _ => step *= 0.5,
            }
        }
        best
    }
}
