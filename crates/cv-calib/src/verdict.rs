//! Assessment of a calibration, and advice on the capture.

use cv_core::named;

/// A side of an image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum ImageSide {
    /// The left quarter.
    Left,
    /// The right quarter.
    Right,
    /// The upper quarter.
    Top,
    /// The lower quarter.
    Bottom,
}

named!(ImageSide { Left = "left", Right = "right", Top = "top", Bottom = "bottom" });

/// A remark on the views that affects the quality of a calibration.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case", tag = "kind"))]
#[non_exhaustive]
pub enum CaptureNote {
    /// Few views.
    FewViews {
        /// Index of the camera.
        camera: usize,
        /// Views used.
        got: usize,
        /// Recommended number.
        wanted: usize,
    },
    /// A quarter of the image has hardly any corners.
    EmptySide {
        /// Index of the camera.
        camera: usize,
        /// The quarter.
        side: ImageSide,
        /// Fraction of its cells that have a corner.
        covered: f64,
    },
    /// The target has nearly the same orientation in all views.
    ParallelTargets {
        /// Index of the camera.
        camera: usize,
        /// Largest angle between the target's normals in two views, in degrees.
        spread_degrees: f64,
    },
    /// The projection uncertainty is large somewhere in the image.
    Uncertain {
        /// Index of the camera.
        camera: usize,
        /// The largest standard deviation, in pixels.
        pixels: f64,
        /// Its x, in pixels.
        x: f64,
        /// Its y, in pixels.
        y: f64,
        /// Median over the image, in pixels.
        median_px: f64,
    },
    /// The hold-out error is much larger: the lens model or the target's model is not valid everywhere.
    HoldOut {
        /// Index of the camera.
        camera: usize,
        /// Root mean square error of the fit, in pixels.
        rms_px: f64,
        /// The hold-out error, in pixels.
        holdout_rms_px: f64,
    },
    /// Many images were rejected.
    LeftOut {
        /// Index of the camera.
        camera: usize,
        /// Images rejected.
        #[cfg_attr(feature = "serde", serde(rename = "pictures"))]
        images: usize,
        /// Images with corners.
        of: usize,
    },
    /// A camera shares few views with the others.
    FewShared {
        /// Index of the camera.
        camera: usize,
        /// Views that it shares.
        got: usize,
        /// Recommended number.
        wanted: usize,
    },
    /// The target is not planar.
    BentTarget {
        /// The larger deflection, as a ratio of the target's longer side.
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
    /// Usable, but better photographs would improve it.
    Usable,
    /// The projection is known to a fraction of a pixel all over the image.
    Good,
}

named!(Trust { Poor = "poor", Usable = "usable", Good = "good" });

/// The trust in a calibration, and the reasons.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Verdict {
    /// The lowest trust of the notes.
    pub trust: Trust,
    /// The remarks, the worst first.
    pub notes: Vec<CaptureNote>,
}

/// Recommended number of views.
pub(crate) const RECOMMENDED_VIEWS: usize = 10;
/// Minimum fraction of cells with corners in a quarter of the image.
pub(crate) const MIN_COVERED_FRACTION: f64 = 0.25;
/// Angle between the extreme orientations of the target, in degrees, below which the focal length is poorly determined.
pub(crate) const PARALLEL_DEGREES: f64 = 20.0;
/// Projection uncertainties in pixels: the largest one that is worth a note, and the median that makes a calibration
/// poor.
pub(crate) const UNCERTAIN_PX: [f64; 2] = [0.5, 1.0];
/// Ratios of the hold-out error to that of the fit: worth a note, and poor.
pub(crate) const HOLDOUT_RATIO: [f64; 2] = [1.5, 4.0];
/// Deflection that is worth a note, as a ratio of the target's longer side.
pub(crate) const MAX_DEFLECTION_RATIO: f64 = 0.002;

impl Verdict {
    pub(crate) fn new(mut notes: Vec<CaptureNote>) -> Self {
        notes.sort_by_key(Self::trust_of_note);
        let trust = notes.iter().map(Self::trust_of_note).min().unwrap_or(Trust::Good);
        Self { trust, notes }
    }

    fn trust_of_note(note: &CaptureNote) -> Trust {
        let poor = match *note {
            CaptureNote::FewViews { got, .. } => got < 5,
            CaptureNote::ParallelTargets { spread_degrees, .. } => spread_degrees < PARALLEL_DEGREES / 2.0,
            CaptureNote::Uncertain { median_px, .. } => median_px.is_nan() || median_px > UNCERTAIN_PX[1],
            CaptureNote::HoldOut { rms_px, holdout_rms_px, .. } => holdout_rms_px > HOLDOUT_RATIO[1] * rms_px,
            CaptureNote::LeftOut { images, of, .. } => 2 * images > of,
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
        let side = CaptureNote::EmptySide { camera: 0, side: ImageSide::Left, covered: 0.1 };
        let few = CaptureNote::FewViews { camera: 0, got: 3, wanted: 10 };
        assert_eq!(Verdict::new(vec![bent]).trust, Trust::Good);
        assert_eq!(Verdict::new(vec![bent, side, few]), Verdict { trust: Trust::Poor, notes: vec![few, side, bent] });
    }
}
