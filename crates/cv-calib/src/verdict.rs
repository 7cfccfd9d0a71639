//! What can be said of a calibration, and what to photograph next.

use cv_core::named;

/// A side of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum PictureSide {
    /// The left quarter.
    Left,
    /// The right quarter.
    Right,
    /// The upper quarter.
    Top,
    /// The lower quarter.
    Bottom,
}

named!(PictureSide { Left = "left", Right = "right", Top = "top", Bottom = "bottom" });

/// Something of the views that a calibration suffers from, or that whoever uses it should know.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case", tag = "kind"))]
#[non_exhaustive]
pub enum CaptureNote {
    /// There are few views.
    FewViews {
        /// Which camera.
        camera: usize,
        /// Views used.
        got: usize,
        /// Views that are usually enough.
        wanted: usize,
    },
    /// A quarter of the picture has hardly a corner.
    EmptySide {
        /// Which camera.
        camera: usize,
        /// Which quarter.
        side: PictureSide,
        /// Share of its cells that has a corner.
        covered: f64,
    },
    /// The target is about parallel to itself in all views.
    ParallelTargets {
        /// Which camera.
        camera: usize,
        /// Largest angle between two of its positions, in degrees.
        spread_degrees: f64,
    },
    /// Somewhere in the picture the projection is not known well.
    Uncertain {
        /// Which camera.
        camera: usize,
        /// Standard deviation there, in pixels.
        pixels: f64,
        /// Where, in pixels.
        x: f64,
        /// Where, in pixels.
        y: f64,
        /// Median over the picture, in pixels.
        median_px: f64,
    },
    /// Views that had no part in the fit are much worse: the lens model or the target does not hold everywhere.
    HoldOut {
        /// Which camera.
        camera: usize,
        /// Root mean square distance of the corners that the fit is of, in pixels.
        rms_px: f64,
        /// The same on views it is not of.
        holdout_rms_px: f64,
    },
    /// Many pictures were left out.
    LeftOut {
        /// Which camera.
        camera: usize,
        /// Pictures left out.
        pictures: usize,
        /// Pictures with corners.
        of: usize,
    },
    /// Two cameras are joined by few views.
    FewShared {
        /// The camera that is not the first.
        camera: usize,
        /// Views that it shares with others.
        got: usize,
        /// Views that are usually enough.
        wanted: usize,
    },
    /// The target is bent.
    BentTarget {
        /// The larger deflection, as a share of the target's longer side.
        share: f64,
    },
}

/// How far a calibration can be trusted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Trust {
    /// Better photographs are needed.
    Poor,
    /// It will do, and better photographs would do better.
    Usable,
    /// Known to a fraction of a pixel all over the picture.
    Good,
}

named!(Trust { Poor = "poor", Usable = "usable", Good = "good" });

/// How far a calibration can be trusted, and why.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Verdict {
    /// The least that one of the notes says.
    pub trust: Trust,
    /// What to know, the worst first.
    pub notes: Vec<CaptureNote>,
}

/// Views that are usually enough.
pub(crate) const ENOUGH_VIEWS: usize = 10;
/// Below this share of cells with corners, a quarter of the picture is as good as empty.
pub(crate) const EMPTY: f64 = 0.25;
/// Degrees between the extreme positions of the target below which a focal length is badly known.
pub(crate) const PARALLEL_DEGREES: f64 = 20.0;
/// Standard deviations of the projection, in pixels: that of the worst place that is worth a note, and the median that makes a calibration poor.
pub(crate) const UNCERTAIN_PX: [f64; 2] = [0.5, 1.0];
/// Ratios of hold-out error to that of the fit that are worth a note, and that make a calibration poor.
pub(crate) const HOLDOUT_RATIO: [f64; 2] = [1.5, 4.0];
/// Deflection as a share of the target's side that is worth a note.
pub(crate) const BENT: f64 = 0.002;

impl Verdict {
    pub(crate) fn new(mut notes: Vec<CaptureNote>) -> Self {
        notes.sort_by_key(Self::trust_by);
        let trust = notes.iter().map(Self::trust_by).min().unwrap_or(Trust::Good);
        Self { trust, notes }
    }

    fn trust_by(note: &CaptureNote) -> Trust {
        let poor = match *note {
            CaptureNote::FewViews { got, .. } => got < 5,
            CaptureNote::ParallelTargets { spread_degrees, .. } => spread_degrees < PARALLEL_DEGREES / 2.0,
            CaptureNote::Uncertain { median_px, .. } => median_px.is_nan() || median_px > UNCERTAIN_PX[1],
            CaptureNote::HoldOut { rms_px, holdout_rms_px, .. } => holdout_rms_px > HOLDOUT_RATIO[1] * rms_px,
            CaptureNote::LeftOut { pictures, of, .. } => 2 * pictures > of,
            CaptureNote::FewShared { got, .. } => got < 3,
            CaptureNote::EmptySide { .. } => false,
            CaptureNote::BentTarget { .. } => return Trust::Good,
        };
        if poor { Trust::Poor } else { Trust::Usable }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_worst_note_decides_and_comes_first() {
        assert_eq!(Verdict::new(Vec::new()).trust, Trust::Good);
        let bent = CaptureNote::BentTarget { share: 0.01 };
        let side = CaptureNote::EmptySide { camera: 0, side: PictureSide::Left, covered: 0.1 };
        let few = CaptureNote::FewViews { camera: 0, got: 3, wanted: 10 };
        assert_eq!(Verdict::new(vec![bent]).trust, Trust::Good);
        assert_eq!(Verdict::new(vec![bent, side, few]), Verdict { trust: Trust::Poor, notes: vec![few, side, bent] });
    }
}
