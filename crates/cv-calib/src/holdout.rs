//! The error on views that a calibration was not fitted to.

use crate::adjustment::{Estimate, Failure, Free, Used, adjust};
use crate::fit::{Fit, Limits, fit};
use crate::target::Sightings;
use cv_core::Progress;
use cv_numeric::RobustLoss;

/// Squared errors on views that had no part in the fit.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct HoldOut {
    /// By view and camera: sum of squared distances in square pixels, and corners.
    pub(crate) pictures: Vec<Vec<(f64, usize)>>,
    /// The same of all corners of these views, those that the fit left out as well, by poses that are fitted to all of them.
    pub(crate) all: Vec<Vec<(f64, usize)>>,
}

impl HoldOut {
    /// Root mean square distance over the corners of one camera, or of all.
    pub(crate) fn rms(&self, camera: Option<usize>) -> f64 {
        Self::rms_of(&self.pictures, camera)
    }

    /// As [`HoldOut::rms`], over all corners.
    pub(crate) fn rms_of_all(&self, camera: Option<usize>) -> f64 {
        Self::rms_of(&self.all, camera)
    }

    fn rms_of(pictures: &[Vec<(f64, usize)>], camera: Option<usize>) -> f64 {
        let of = |v: &Vec<(f64, usize)>| match camera {
            Some(c) => v.get(c).copied().unwrap_or_default(),
            None => v.iter().fold((0.0, 0), |s, p| (s.0 + p.0, s.1 + p.1)),
        };
        let (squares, count) = pictures.iter().map(of).fold((0.0, 0), |s, p| (s.0 + p.0, s.1 + p.1));
        (squares / count.max(1) as f64).sqrt()
    }
}

/// The views in turns: view `i` of those with corners is left out of the fit by fold `i mod folds`, and then only its pose is adjusted.
///
/// `usable`: corners that a fit may use. `judged`: corners that errors are taken of, beside those of all usable ones. Costs `folds` fits, from where the fit of all is.
pub(crate) fn hold_out(
    data: &Sightings,
    found: &Fit,
    (usable, judged): (&Used, &Used),
    limits: Limits,
    folds: usize,
    progress: &dyn Progress,
) -> Result<HoldOut, Failure> {
    let views: Vec<usize> = (0..data.views.len())
        .filter(|v| found.estimate.poses[*v].is_some() && judged[*v].iter().flatten().any(|u| *u))
        .collect();
    let pick = |used: &Used, views: &[usize]| -> Used { views.iter().map(|v| used[*v].clone()).collect() };
    let none = || vec![vec![(0.0, 0); data.sizes.len()]; data.views.len()];
    let mut out = HoldOut { pictures: none(), all: none() };
    for fold in 0..folds {
        let (mut train, mut test) = (Vec::new(), Vec::new());
        for (i, v) in views.iter().enumerate() {
            if i % folds == fold { test.push(*v) } else { train.push(*v) }
        }
        let fitted =
            fit(&data.subset(&train), &found.estimate.subset(&train), &pick(usable, &train), limits, progress)?;
        let mut left = Estimate { poses: found.estimate.subset(&test).poses, ..fitted.estimate };
        let others = data.subset(&test);
        for (corners, sums) in [(judged, &mut out.pictures), (usable, &mut out.all)] {
            let corners = pick(corners, &test);
            adjust(&others, &mut left, &corners, (Free::POSES, RobustLoss::Trivial), (100, 1e-8), progress)?;
            for (i, &v) in test.iter().enumerate() {
                for c in 0..data.sizes.len() {
                    let residuals = left.residuals(&others, i, c);
                    for r in residuals.iter().zip(&corners[i][c]).filter(|(_, judged)| **judged).filter_map(|(r, _)| *r)
                    {
                        sums[v][c].0 += r.norm_squared();
                        sums[v][c].1 += 1;
                    }
                }
            }
        }
    }
    Ok(out)
}
