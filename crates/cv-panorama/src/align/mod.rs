//! From verified overlaps to the place of every photograph.

mod bundle;
mod focal;
mod graph;
mod group;
mod straighten;
mod verify;
mod view;

pub(crate) use straighten::turn;
pub use verify::{NotAPair, VerifiedPair, VerifyOptions, verify_pair};
pub use view::View;

use crate::align::group::Group;
use cv_core::{Camera, Correspondence, Point2};

/// What is known about a photograph before looking at its pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photo {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Focal length in pixels, from EXIF: a hint that the overlaps may correct.
    pub focal: Option<f64>,
    /// The calibrated camera, which is believed as it is. Its size must be the photograph's.
    pub camera: Option<Camera>,
}

impl Photo {
    /// A photograph of which only the size is known.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, focal: None, camera: None }
    }

    /// Photographs that are taken to share a lens: the same size (either way up) and the same hint.
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
}

/// What may have moved the camera between photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CameraMotion {
    /// [`Rotation`](Self::Rotation), unless [`Homography`](Self::Homography) explains the matches far better.
    #[default]
    Auto,
    /// The camera turned about its center: the panorama proper.
    Rotation,
    /// The scene is flat (a wall, a page, the ground from above) and the camera moved anyhow.
    Homography,
}

/// Options of [`align`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// What moved the camera. Default [`CameraMotion::Auto`].
    pub motion: CameraMotion,
    /// Error of a match, in pixels, at which it starts to count less (the scale of a Cauchy loss), above 0. Default 2, the σ that
    /// Brown & Lowe give their robust loss.
    pub outlier_px: f64,
    /// Estimate one coefficient of radial distortion where no camera is given and the matches ask for it. Default true.
    pub refine_distortion: bool,
    /// Turn the result level. Default true; false keeps the frame of the middle photograph.
    pub straighten: bool,
}

impl Default for AlignOptions {
    fn default() -> Self {
        Self { motion: CameraMotion::Auto, outlier_px: 2.0, refine_distortion: true, straighten: true }
    }
}

/// Why photographs could not be aligned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// A panorama needs two photographs.
    #[error("a panorama needs at least 2 photographs, got {got}")]
    TooFewPhotos {
        /// Photographs given.
        got: usize,
    },
    /// No two photographs overlap as far as the matches tell.
    #[error("no two of the {photos} photographs overlap")]
    NoOverlap {
        /// Photographs given.
        photos: usize,
    },
    /// A pair names a photograph that is not there, or itself.
    #[error("a pair names photographs {a} and {b} of {photos}")]
    BadPair {
        /// First of the pair.
        a: usize,
        /// Second of the pair.
        b: usize,
        /// Photographs given.
        photos: usize,
    },
    /// A photograph is empty, or its camera is no camera or of another size.
    #[error("photograph {index} is empty or its camera does not fit it")]
    BadPhoto {
        /// Which.
        index: usize,
    },
    /// No placement explains the matches.
    #[error("the overlaps of the {photos} photographs contradict each other")]
    Inconsistent {
        /// Photographs in the group.
        photos: usize,
    },
}

/// Why a photograph is not in the panorama.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unplaced {
    /// It overlaps no other photograph.
    Alone,
    /// It belongs to another, smaller group of photographs.
    OtherGroup {
        /// Photographs in that group.
        size: usize,
    },
    /// Its overlaps contradict those of the others.
    Contradicts,
}

/// An overlap that holds in the whole.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Matches, in pixels.
    pub matches: Vec<Correspondence>,
    /// Root mean square of their errors, in pixels.
    pub rms_px: f64,
}

/// The place of every photograph.
#[derive(Debug, Clone)]
pub struct Alignment {
    /// The view of each photograph, or why it has none; as many as photographs were given.
    pub views: Vec<Result<View, Unplaced>>,
    /// The photograph in the middle of the match graph.
    pub reference: usize,
    /// [`CameraMotion::Rotation`] or [`CameraMotion::Homography`].
    pub motion: CameraMotion,
    /// The overlaps that hold.
    pub pairs: Vec<AlignedPair>,
    /// Root mean square error of all their matches, in pixels, the mean of the two directions.
    pub rms_px: f64,
    /// Median error of all their matches, in pixels.
    pub median_px: f64,
}

impl Alignment {
    /// The same alignment of photographs of other sizes: each made `factor` times as large and then of `size`.
    ///
    /// Errors are scaled by the median factor of the photographs used.
    pub fn resized(&self, sizes: &[(f64, (usize, usize))]) -> Self {
        let mut out = self.clone();
        for (view, (factor, size)) in out.views.iter_mut().zip(sizes) {
            if let Ok(view) = view {
                view.camera = view.camera.scaled(*factor);
                (view.camera.width, view.camera.height) = *size;
            }
        }
        let factor = |i: usize| sizes.get(i).map_or(1.0, |s| s.0);
        let place = |p: Point2<f64>, f: f64| Point2::from((p.coords.add_scalar(0.5) * f).add_scalar(-0.5));
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

    /// The photographs in the panorama.
    pub fn used(&self) -> impl Iterator<Item = (usize, &View)> {
        self.views.iter().enumerate().filter_map(|(i, v)| v.as_ref().ok().map(|v| (i, v)))
    }
}

/// Places photographs by their verified overlaps: spanning tree from the middle of the match graph, then all cameras at once over all
/// overlaps under a robust loss, then the world turned level.
///
/// The largest group of connected photographs is placed. Focal lengths come from the cameras, the hints, or the homographies
/// themselves. Costs O(matches · iterations + photographs³).
///
/// # Errors
/// [`AlignError`].
pub fn align(photos: &[Photo], pairs: &[VerifiedPair], options: &AlignOptions) -> Result<Alignment, AlignError> {
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
    // In an order of their own, so that the order of the pairs changes nothing.
    let mut pairs: Vec<&VerifiedPair> = pairs.iter().filter(|p| !p.inliers.is_empty()).collect();
    pairs.sort_by_key(|p| (p.a.min(p.b), p.a.max(p.b)));
    let mut contradicting = vec![false; n];
    loop {
        let group = Group::largest(photos, &pairs)?;
        let (solution, motion) = group.solve(options);
        let bad = group.worst_contradiction(&solution, motion, options);
        if let Some(bad) = bad {
            // One at a time: a false overlap bends the true ones around it.
            let pair = group.pairs[bad];
            pairs.retain(|p| !std::ptr::eq(*p, pair));
            for i in [pair.a, pair.b] {
                contradicting[i] = true;
            }
            continue;
        }
        return group.finish(photos, &solution, motion, &contradicting, options);
    }
}
