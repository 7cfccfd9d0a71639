//! The hold-out error: reprojection errors on views that a calibration was not fitted to.

use crate::adjustment::{Estimate, Failure, FreeParameters, InlierMask, adjust};
use crate::fit::{Fit, Limits, fit};
use crate::target::TargetObservations;
use cv_core::Progress;
use cv_numeric::RobustLoss;

/// Sums of squared errors on held-out views.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct HoldOut {
    /// Sum of squared errors over the inliers in square pixels, and number of corners, by view and camera.
    pub(crate) inliers: Vec<Vec<(f64, usize)>>,
    /// The same over all usable corners of these views, outliers included, with poses fitted to all of them.
    pub(crate) all: Vec<Vec<(f64, usize)>>,
}

impl HoldOut {
    /// Returns the root mean square error over the corners of one camera, or of all cameras.
    pub(crate) fn rms(&self, camera: Option<usize>) -> f64 {
        Self::rms_of(&self.inliers, camera)
    }

    /// As [`HoldOut::rms`], over all corners, outliers included.
    pub(crate) fn rms_of_all(&self, camera: Option<usize>) -> f64 {
        Self::rms_of(&self.all, camera)
    }

    fn rms_of(images: &[Vec<(f64, usize)>], camera: Option<usize>) -> f64 {
        let of = |v: &Vec<(f64, usize)>| match camera {
            Some(c) => v.get(c).copied().unwrap_or_default(),
            None => v.iter().fold((0.0, 0), |s, p| (s.0 + p.0, s.1 + p.1)),
        };
        let (squares, count) = images.iter().map(of).fold((0.0, 0), |s, p| (s.0 + p.0, s.1 + p.1));
        (squares / count.max(1) as f64).sqrt()
    }
}

/// Cross-validates a fit: fold `i mod folds` holds out view `i` (of those with corners), fits the other views and
/// adjusts only the pose of the held-out one.
///
/// `usable`: corners that a fit may use. `scored`: corners whose errors are summed, besides those of all usable ones.
/// Costs `folds` fits, each from the fit of all views.
pub(crate) fn hold_out(
    data: &TargetObservations,
    fit_of_all: &Fit,
    (usable, scored): (&InlierMask, &InlierMask),
    limits: Limits,
    folds: usize,
    progress: &dyn Progress,
) -> Result<HoldOut, Failure> {
    let views: Vec<usize> = (0..data.views.len())
        .filter(|v| fit_of_all.estimate.poses[*v].is_some() && scored[*v].iter().flatten().any(|u| *u))
        .collect();
    let select =
        |used: &InlierMask, views: &[usize]| -> InlierMask { views.iter().map(|v| used[*v].clone()).collect() };
    let zeros = || vec![vec![(0.0, 0); data.sizes.len()]; data.views.len()];
    let mut out = HoldOut { inliers: zeros(), all: zeros() };
    for fold in 0..folds {
        let (mut train, mut test) = (Vec::new(), Vec::new());
        for (i, v) in views.iter().enumerate() {
            if i % folds == fold { test.push(*v) } else { train.push(*v) }
        }
        let fitted =
            fit(&data.subset(&train), &fit_of_all.estimate.subset(&train), &select(usable, &train), limits, progress)?;
        let mut held_out = Estimate { poses: fit_of_all.estimate.subset(&test).poses, ..fitted.estimate };
        let test_data = data.subset(&test);
        for (corners, sums) in [(scored, &mut out.inliers), (usable, &mut out.all)] {
            let corners = select(corners, &test);
            adjust(
                &test_data,
                &mut held_out,
                &corners,
                (FreeParameters::POSES, RobustLoss::Trivial),
                (100, 1e-8),
                progress,
            )?;
            for (i, &v) in test.iter().enumerate() {
                for c in 0..data.sizes.len() {
                    let residuals = held_out.residuals(&test_data, i, c);
                    for r in residuals.iter().zip(&corners[i][c]).filter(|(_, scored)| **scored).filter_map(|(r, _)| *r)
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
