//! Messages about structure from motion: why there is no model, and why photographs are not registered.

use super::{Failure, advice_text, unreadable};
use cv_core::GeodeticPoint;
use cv_io::IoError;
use cv_pipeline::many_views::{CenterFit, ModelAlignError, PairRefusal, RefusedPair, SfmError, ViewOutcome};
use cv_pipeline::{Advice, SfmDenseError, SfmJobError};
use std::path::{Path, PathBuf};

/// Words why a photograph is not registered; `None` if it is.
pub(crate) fn left_out(outcome: &ViewOutcome) -> Option<String> {
    match *outcome {
        ViewOutcome::Registered { .. } => None,
        ViewOutcome::NoPairs => {
            Some("it has too little overlap with every other photograph; try photographs in between".to_owned())
        }
        ViewOutcome::TooFewPoints { seen, needed } => Some(format!(
            "it has {seen} correspondences to points of the model, {needed} are needed; try photographs in between"
        )),
        ViewOutcome::NoPose { seen, agree, needed } => Some(format!(
            "{agree} of its {seen} correspondences to points of the model are inliers of a pose, {needed} are needed: repeated structure or moving objects"
        )),
        ViewOutcome::Contradicted { agree, of } => Some(format!(
            "it shows only {agree} of {of} points that should be in it: another place that looks alike; try photographs in between"
        )),
    }
}

/// Words that the photographs do not determine a focal length, if its relative standard deviation is above
/// [`MAX_FOCAL_DEVIATION`].
pub(crate) fn focal_uncertain(focal: f64, deviation: f64) -> Option<String> {
    (deviation > MAX_FOCAL_DEVIATION * focal).then(|| {
        format!(
            "the photographs do not determine the focal length, {focal:.0} px in the model: the camera hardly turned between them, and depths may be stretched; try: --camera FILE or --focal PIXELS, or photographs of the same place in other directions"
        )
    })
}

/// Largest relative standard deviation of a focal length without a warning. Where views determine it, it is 0.3 % or less,
/// and 4 % around an object from a constant height (where it is exchanged for the principal point); with cameras that only
/// translate, 15 % and more.
const MAX_FOCAL_DEVIATION: f64 = 0.1;

/// Numbers of refused pairs of photographs, by reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct RefusedPairs {
    /// Refused by the cycle consistency of rotations in triplets.
    pub(crate) triplets: usize,
    /// Refused as repeated structure: different objects of the same appearance.
    pub(crate) repeated: usize,
}

impl RefusedPairs {
    pub(crate) fn of(all: &[RefusedPair]) -> Self {
        let triplets = all.iter().filter(|r| matches!(r.reason, PairRefusal::Triplets { .. })).count();
        Self { triplets, repeated: all.len() - triplets }
    }

    /// Words the refused pairs among `pairs`, if there are any.
    pub(crate) fn text(self, pairs: usize) -> Option<String> {
        let Self { triplets, repeated } = self;
        let mut reasons = Vec::new();
        if triplets > 0 {
            reasons.push(format!("{triplets} by triplets (inconsistent relative rotations)"));
        }
        if repeated > 0 {
            reasons.push(format!("{repeated} as repeated structure (different objects of the same appearance)"));
        }
        (!reasons.is_empty())
            .then(|| format!("{} of {pairs} pairs refused: {}", triplets + repeated, reasons.join(", ")))
    }
}

/// Words why a photograph cannot be read.
pub(crate) fn not_read(error: &IoError) -> String {
    let hint = unreadable(&error.reason).map_or_else(String::new, |hint| format!("; try: {hint}"));
    format!("it cannot be read: {}{hint}", error.reason)
}

/// Words that fewer than two photographs are usable, with the reasons for the others.
pub(crate) fn too_few(usable: usize, refused: &[(&Path, &str)]) -> Failure {
    let named = usable + refused.len();
    let mut what = format!("{usable} of {named} photographs can be used, at least two are needed");
    for (i, (path, reason)) in refused.iter().take(MAX_SHOWN).enumerate() {
        what += &format!("{}{}: {reason}", if i == 0 { " (" } else { "; " }, path.display());
    }
    if !refused.is_empty() {
        what += if refused.len() > MAX_SHOWN { "; …)" } else { ")" };
    }
    Failure::new(what).advice("ten or more different photographs of one scene")
}

/// Maximum number of reasons in a message.
const MAX_SHOWN: usize = 3;

/// Words a failed reconstruction.
pub(crate) fn no_model(error: SfmJobError) -> Failure {
    let advice = match &error {
        SfmJobError::Cancelled(_) => return error.into(),
        SfmJobError::NoPairs { .. } => {
            "sharp photographs of one textured scene, each overlapping its neighbor by more than half".to_owned()
        }
        SfmJobError::Solve(SfmError::NoInitialPair { .. }) => {
            "move the camera between the photographs: a pure rotation gives no depth (to stitch photographs from one place use `cv panorama`); a focal length, if EXIF has none or a wrong one (--focal, --ignore-exif)".to_owned()
        }
        SfmJobError::Solve(SfmError::Inconsistent { .. }) => {
            "an approximately correct focal length (--focal), or --ignore-exif if that of EXIF is wrong; leave out photographs of similar but different places".to_owned()
        }
        SfmJobError::Option(_) | SfmJobError::Solve(SfmError::Option(_)) => advice_text(Advice::CheckOptions),
        _ => return error.into(),
    };
    Failure::from(error).advice(advice)
}

/// Words a failed dense reconstruction; the model itself is written.
pub(crate) fn no_dense_cloud(error: SfmDenseError) -> Failure {
    let advice = match &error {
        SfmDenseError::NoPairs { .. } => {
            "more photographs, at baselines of a tenth of the distance and with large overlap"
        }
        SfmDenseError::NoDepths { .. } | SfmDenseError::NoAgreement { .. } => {
            "three or more photographs of each surface, at smaller baselines, of a static scene with texture; a larger --dense-size"
        }
        _ => return error.into(),
    };
    Failure::from(error).advice(advice)
}

/// The source of known camera positions.
#[derive(Clone)]
pub(crate) enum PlaceSource {
    /// GPS positions in EXIF: the geodetic origin, and whether altitudes are known.
    Gps { origin: GeodeticPoint, heights: bool },
    /// The file of `--known`.
    File(PathBuf),
}

impl PlaceSource {
    /// Returns its name for messages.
    pub(crate) fn name(&self) -> String {
        match self {
            Self::Gps { .. } => "the GPS positions".to_owned(),
            Self::File(path) => format!("the positions of {}", path.display()),
        }
    }

    /// Returns its key in JSON.
    pub(crate) fn key(&self) -> &'static str {
        match self {
            Self::Gps { .. } => "gps",
            Self::File(_) => "known",
        }
    }

    /// Words why a model is not aligned to the positions; `None` if too few photographs have GPS positions.
    pub(crate) fn refusal(&self, error: &ModelAlignError) -> Option<String> {
        match error {
            ModelAlignError::TooFew { got, needed } => match self {
                Self::Gps { .. } => None,
                Self::File(_) => Some(format!("{got} of them belong to photographs of the model, {needed} are needed")),
            },
            ModelAlignError::OnePlace => Some("they are all at one position".to_owned()),
            ModelAlignError::Contradiction { agree, of, rms, spread } => Some(format!(
                "they contradict it: {agree} of {of} are inliers, with {rms:.2} m RMS at a spread of {spread:.2} m around their mean"
            )),
            other => Some(other.to_string()),
        }
    }
}

/// Describes the frame of a georeferenced model.
pub(crate) fn aligned(source: &PlaceSource, fit: &CenterFit) -> String {
    let (count, rms) = (fit.inliers.len(), fit.rms);
    let tilt = if fit.tilt {
        ""
    } else {
        "; the positions are collinear, so that the up direction is estimated from the photographs"
    };
    match source {
        PlaceSource::Gps { origin, heights } => {
            let side = |v: f64, [plus, minus]: [&str; 2]| {
                format!("{:.6}° {}", v.to_degrees().abs(), if v < 0.0 { minus } else { plus })
            };
            let place = format!("{}, {}", side(origin.latitude, ["N", "S"]), side(origin.longitude, ["E", "W"]));
            let height = if *heights { "" } else { "; altitudes are unknown" };
            format!(
                "in meters by the GPS positions of {count} photographs ({rms:.2} m RMS): X east, Y north, Z up from {place}{height}{tilt}"
            )
        }
        PlaceSource::File(path) => {
            format!("in the frame of {}, in meters, by {count} photographs ({rms:.3} m RMS){tilt}", path.display())
        }
    }
}

/// Relative residual of a known distance above which a warning is given.
pub(crate) const MAX_DISTANCE_RESIDUAL: f64 = 0.02;
/// Relative difference of the scales by positions and by distances above which a warning is given.
pub(crate) const MAX_SCALE_DIFFERENCE: f64 = 0.1;

/// Words contradicting known distances.
pub(crate) fn distances_differ(error: f64) -> String {
    format!("the distances of --distance contradict each other: the largest residual is {:.1} %", 100.0 * error)
}

/// Words outliers among the known positions: `differ` has their photographs and residuals in meters.
pub(crate) fn places_differ(source: &PlaceSource, differ: &[(&Path, f64)], rms: f64) -> String {
    let shown: Vec<String> =
        differ.iter().take(MAX_SHOWN).map(|(path, off)| format!("{} by {off:.1} m", path.display())).collect();
    let more = if differ.len() > MAX_SHOWN { ", …" } else { "" };
    format!(
        "of {} {} are outliers with respect to the model ({rms:.2} m RMS of the others) and are ignored: {}{more}",
        source.name(),
        differ.len(),
        shown.join(", ")
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_long_list_of_reasons_is_cut() {
        let path = Path::new("a.jpg");
        let text = |n: usize| too_few(1, &vec![(path, "it is blue"); n]).text();
        assert!(text(0).contains("1 of 1 photographs") && !text(0).contains('('));
        assert!(
            text(2).contains("1 of 3") && text(2).contains("(a.jpg: it is blue; a.jpg: it is blue)"),
            "{}",
            text(2)
        );
        assert_eq!(text(9).matches("blue").count(), MAX_SHOWN);
        assert!(text(9).contains("…)"));
    }

    #[test]
    fn refused_pairs_are_counted_by_reason() {
        let of = |reason| RefusedPair { pair: 0, reason };
        let repeated = [
            of(PairRefusal::Repeated { found: 0.2, expected: 0.6 }),
            of(PairRefusal::RepeatedLoops { against: 3, of: 4 }),
        ];
        let triplets = [of(PairRefusal::Triplets { loops: 5 })];
        let text = |all: &[RefusedPair]| RefusedPairs::of(all).text(40);
        assert_eq!(text(&[]), None);
        assert!(
            text(&repeated)
                .is_some_and(|t| t.starts_with("2 of 40 pairs refused: 2 as repeated") && !t.contains("triplets"))
        );
        let both = text(&[&repeated[..], &triplets].concat());
        assert!(both.is_some_and(|t| t.starts_with("3 of 40 pairs refused: 1 by triplets") && t.contains(", 2 as repeated")));
    }

    #[test]
    fn remedies_follow_the_reason() {
        let text = no_model(SfmJobError::Solve(SfmError::NoInitialPair { pairs: 7 })).text();
        assert!(
            text.contains("none of 7 pairs") && text.contains("; try: move the camera") && text.contains("cv panorama")
        );
        assert!(no_model(SfmJobError::NoPairs { photos: 3 }).text().contains("of 3 photographs"));
    }
}
