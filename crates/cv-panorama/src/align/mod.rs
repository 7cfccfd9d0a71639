//! Alignment: from verified pairs to the pose and intrinsics of every photograph.

mod bundle;
mod focal;
mod group;
mod metric;
mod refine;
mod straighten;
mod view;

pub use refine::refine_alignment;
pub(crate) use straighten::turn;
pub use view::View;

use cv_core::{Camera, Cancelled, Correspondence, Point2, Progress, Scaling, Stage, named};
use cv_geometry::VerifiedPair;
use group::Group;

/// A photograph's size and what is known of its intrinsics beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photo {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Prior focal length in pixels, from EXIF; refined by the adjustment.
    pub focal: Option<f64>,
    /// The calibrated camera; kept constant. Its size must be that of the photograph.
    pub camera: Option<Camera>,
}

impl Photo {
    /// A photograph of which only the size is known.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, focal: None, camera: None }
    }

    /// Returns whether two photographs share their intrinsics: equal size (in either orientation) and equal prior.
    pub(crate) fn shares_lens(&self, other: &Self) -> bool {
        let size = |p: &Self| (p.width.min(p.height), p.width.max(p.height));
        let same_hint = match (self.focal, other.focal) {
            (Some(a), Some(b)) => (a / b).ln().abs() < 0.01,
            (None, None) => true,
            _ => false,
        };
        size(self) == size(other) && same_hint && self.camera == other.camera
    }

    pub(crate) fn long_side(&self) -> f64 {
        self.width.max(self.height) as f64
    }

    /// Returns the focal length of the camera, that of EXIF, or the longer side: a field of view of 53°, a common wide-angle lens.
    pub(crate) fn expected_focal(&self) -> f64 {
        let known = self.camera.map(|c| c.fx).or(self.focal.filter(|f| f.is_finite() && *f > 0.0));
        known.unwrap_or_else(|| self.long_side())
    }
}

/// Motion model of the camera between photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CameraMotion {
    /// [`Rotation`](Self::Rotation), unless [`Homography`](Self::Homography) has far smaller residuals.
    #[default]
    Auto,
    /// Rotation about the camera center.
    Rotation,
    /// Planar scene (a wall, a page, the ground from above) and arbitrary camera motion. The result is metrically rectified as far as the focal length is
    /// known; without, a field of view of 53 degrees is assumed, and a tilt common to all photographs remains.
    Homography,
}

named!(CameraMotion { Auto = "auto", Rotation = "rotation", Homography = "plane" | "homography" });

/// Options of [`align`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// Motion model. Default [`CameraMotion::Auto`].
    pub motion: CameraMotion,
    /// Scale of the Cauchy loss on transfer errors, in pixels, above 0. Default 2, the σ of Brown & Lowe's robust loss.
    pub outlier_px: f64,
    /// Estimate one radial distortion coefficient where no camera is given and it reduces the cost significantly. Default true.
    pub refine_distortion: bool,
    /// Level the result (wave correction). Default true; false keeps the frame of the reference photograph.
    pub straighten: bool,
}

impl Default for AlignOptions {
    fn default() -> Self {
        Self { motion: CameraMotion::Auto, outlier_px: 2.0, refine_distortion: true, straighten: true }
    }
}

/// Why photographs could not be aligned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum AlignError {
    /// Fewer than two photographs.
    #[error("a panorama needs at least 2 photographs, got {got}")]
    TooFewPhotos {
        /// Photographs given.
        got: usize,
    },
    /// There is no verified pair.
    #[error("no two of the {photos} photographs overlap")]
    NoOverlap {
        /// Photographs given.
        photos: usize,
    },
    /// A pair has an index out of range, or twice the same.
    #[error("a pair names photographs {a} and {b} of {photos}")]
    BadPair {
        /// First of the pair.
        a: usize,
        /// Second of the pair.
        b: usize,
        /// Photographs given.
        photos: usize,
    },
    /// A photograph is empty, or its camera is invalid or of another size.
    #[error("photograph {index} is empty or its camera does not fit it")]
    BadPhoto {
        /// Which.
        index: usize,
    },
    /// The work was stopped by its progress callback.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// No alignment is consistent with the matches.
    #[error("the overlaps of the {photos} photographs contradict each other")]
    Inconsistent {
        /// Photographs in the group.
        photos: usize,
    },
}

/// Why a photograph is not registered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unplaced {
    /// It has no verified pair.
    NoOverlap,
    /// It belongs to another, smaller component of the match graph.
    OtherComponent {
        /// Photographs in that component.
        size: usize,
    },
    /// Its pairs are inconsistent with the others.
    Inconsistent,
}

/// A pair that is consistent with the alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Indices of the inliers among the tentative matches, as in [`VerifiedPair::inliers`].
    pub inliers: Vec<usize>,
    /// The matches, in pixels.
    pub matches: Vec<Correspondence>,
    /// Root mean square transfer error, in pixels.
    pub rms_px: f64,
}

/// Poses and intrinsics of all photographs.
#[derive(Debug, Clone)]
pub struct Alignment {
    /// The view of each photograph, or why it is not registered; one entry per input.
    pub views: Vec<Result<View, Unplaced>>,
    /// The photograph in the center of the match graph.
    pub reference: usize,
    /// [`CameraMotion::Rotation`] or [`CameraMotion::Homography`].
    pub motion: CameraMotion,
    /// The consistent pairs.
    pub pairs: Vec<AlignedPair>,
    /// Root mean square transfer error of all matches, in pixels, averaged over both directions.
    pub rms_px: f64,
    /// Median transfer error of all matches, in pixels.
    pub median_px: f64,
}

impl Alignment {
    /// Returns the alignment of the photographs resized: each scaled by its factor and then of the given size.
    ///
    /// Errors are scaled by the median factor of the registered photographs.
    pub fn resized(&self, sizes: &[(f64, (usize, usize))]) -> Self {
        let mut out = self.clone();
        for (view, (factor, size)) in out.views.iter_mut().zip(sizes) {
            if let Ok(view) = view {
                view.camera = view.camera.scaled(*factor);
                (view.camera.width, view.camera.height) = *size;
            }
        }
        let factor = |i: usize| sizes.get(i).map_or(1.0, |s| s.0);
        let place = |p, f| Scaling::uniform(f).point(p);
        for pair in &mut out.pairs {
            let (fa, fb) = (factor(pair.a), factor(pair.b));
            pair.rms_px *= 0.5 * (fa + fb);
            for m in &mut pair.matches {
                (m.a, m.b) = (place(m.a, fa), place(m.b, fb));
            }
        }
        let mut factors: Vec<f64> = self.used().map(|(i, _)| factor(i)).collect();
        factors.sort_by(f64::total_cmp);
        let typical = factors.get(factors.len() / 2).copied().unwrap_or(1.0);
        out.rms_px *= typical;
        out.median_px *= typical;
        out
    }

    /// Recomputes the errors of all matches.
    fn measure(&mut self) {
        let rms = |squares: &[f64]| (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
        let mut all = Vec::new();
        for pair in &mut self.pairs {
            let (Some(Ok(a)), Some(Ok(b))) = (self.views.get(pair.a), self.views.get(pair.b)) else { continue };
            let square =
                |from: &View, to: &View, p, q: Point2<f64>| Some((to.project(&from.ray(p)?)? - q).norm_squared());
            let both = |m: &Correspondence| Some(0.5 * (square(a, b, m.a, m.b)? + square(b, a, m.b, m.a)?));
            let squares: Vec<f64> = pair.matches.iter().filter_map(both).collect();
            pair.rms_px = rms(&squares);
            all.extend(squares);
        }
        self.rms_px = rms(&all);
        self.median_px = cv_core::median(&mut all).unwrap_or(0.0).sqrt();
    }

    /// Iterates over the registered photographs.
    pub fn used(&self) -> impl Iterator<Item = (usize, &View)> {
        self.views.iter().enumerate().filter_map(|(i, v)| v.as_ref().ok().map(|v| (i, v)))
    }
}

/// Median transfer error relative to the scale of the loss up to which an alignment is good: other models and sets of pairs are not tried.
const GOOD_FIT: f64 = 0.75;

/// Aligns photographs by their verified pairs: initialization along the spanning tree from the center of the match graph, bundle adjustment over all
/// overlaps with a robust loss, then leveling.
///
/// Registers the largest connected component. Focal lengths come from the cameras, the priors, or the homographies. Complexity
/// O(matches · iterations + photographs³). Reports as the stage "align", of unknown length.
///
/// # Errors
/// [`AlignError`].
pub fn align(
    photos: &[Photo],
    pairs: &[VerifiedPair],
    options: &AlignOptions,
    progress: &dyn Progress,
) -> Result<Alignment, AlignError> {
    let stage = Stage::new(progress, "align", 0)?;
    let n = photos.len();
    if n < 2 {
        return Err(AlignError::TooFewPhotos { got: n });
    }
    for (index, p) in photos.iter().enumerate() {
        let fits = p.camera.is_none_or(|c| c.validate().is_ok() && (c.width, c.height) == (p.width, p.height));
        if p.width == 0 || p.height == 0 || !fits {
            return Err(AlignError::BadPhoto { index });
        }
    }
    if let Some(bad) = pairs.iter().find(|p| p.a >= n || p.b >= n || p.a == p.b) {
        return Err(AlignError::BadPair { a: bad.a, b: bad.b, photos: n });
    }
    // Sorted: the result must not depend on the order of the input pairs.
    let mut pairs: Vec<&VerifiedPair> = pairs.iter().filter(|p| !p.matches.is_empty()).collect();
    pairs.sort_by_key(|p| (p.a.min(p.b), p.a.max(p.b)));
    let mut inconsistent = vec![false; n];
    loop {
        let mut group = Group::largest(photos, &pairs)?;
        let (mut solution, mut motion) = group.solve(options, &stage)?;
        let typical = group.median_error(motion, &solution);
        if typical > GOOD_FIT * options.outlier_px {
            // A false pair at the ends of a chain closes a circle that is none, and its residuals spread over all others.
            let kept = group.without_weak_closures();
            if kept.len() < group.pairs.len() {
                let open = Group::largest(photos, &kept)?;
                let (better, kind) = open.solve(options, &stage)?;
                if open.median_error(kind, &better) < 0.5 * typical {
                    (pairs, group, solution, motion) = (kept, open, better, kind);
                }
            }
        }
        let bad = group.worst_inconsistency(&solution, motion, options);
        if let Some(bad) = bad {
            // One at a time: a false pair raises the residuals of the pairs around it.
            let pair = group.pairs[bad];
            pairs.retain(|p| !std::ptr::eq(*p, pair));
            for i in [pair.a, pair.b] {
                inconsistent[i] = true;
            }
            continue;
        }
        let solution = if motion == CameraMotion::Homography { group.as_plan(solution) } else { solution };
        return group.finish(photos, &solution, motion, &inconsistent, options);
    }
}
