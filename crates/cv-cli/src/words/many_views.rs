//! What the program says of models of many photographs: why there is none, and why photographs are left out.

use super::{Failure, unreadable, words};
use cv_core::GeodeticPoint;
use cv_io::IoError;
use cv_pipeline::many_views::{CenterFit, ModelAlignError, PairRefusal, RefusedPair, SfmError, ViewOutcome};
use cv_pipeline::{Advice, SfmDenseError, SfmJobError};
use std::path::{Path, PathBuf};

/// Why a photograph is in no model; `None` where it is in one.
pub(crate) fn left_out(outcome: &ViewOutcome) -> Option<String> {
    match *outcome {
        ViewOutcome::Registered { .. } => None,
        ViewOutcome::NoPairs => {
            Some("no other photograph shows enough of the same; try photographs in between".to_owned())
        }
        ViewOutcome::TooFewPoints { seen, needed } => {
            Some(format!("it sees {seen} points of the model where {needed} are needed; try photographs in between"))
        }
        ViewOutcome::NoPose { seen, agree, needed } => Some(format!(
            "of the {seen} points of the model that it seems to see {agree} agree with a pose where {needed} are needed: things that look alike, or that moved"
        )),
    }
}

/// How many pairs of photographs were not used, by the reason.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct RefusedPairs {
    /// Their rotations contradict those of other pairs.
    pub(crate) triplets: usize,
    /// They show different things that look alike.
    pub(crate) repeated: usize,
}

impl RefusedPairs {
    pub(crate) fn of(all: &[RefusedPair]) -> Self {
        let triplets = all.iter().filter(|r| matches!(r.reason, PairRefusal::Triplets { .. })).count();
        Self { triplets, repeated: all.len() - triplets }
    }

    /// What is said of them, if there are any, among so many pairs.
    pub(crate) fn text(self, pairs: usize) -> Option<String> {
        let Self { triplets, repeated } = self;
        let mut reasons = Vec::new();
        if triplets > 0 {
            reasons.push(format!("{triplets} by triplets (their rotations contradict those of other pairs)"));
        }
        if repeated > 0 {
            reasons.push(format!("{repeated} as repeated structure (different things that look alike)"));
        }
        (!reasons.is_empty())
            .then(|| format!("{} of {pairs} pairs refused: {}", triplets + repeated, reasons.join(", ")))
    }
}

/// Why a photograph is not looked at.
pub(crate) fn not_read(error: &IoError) -> String {
    let hint = unreadable(&error.reason).map_or_else(String::new, |hint| format!("; try: {hint}"));
    format!("it cannot be read: {}{hint}", error.reason)
}

/// Why there is no work to be done: so many of the photographs that were named can be looked at, and what is said of the others.
pub(crate) fn too_few(usable: usize, refused: &[(&Path, &str)]) -> Failure {
    let named = usable + refused.len();
    let mut what = format!("{usable} of {named} photographs can be used, and two at least are needed");
    for (i, (path, reason)) in refused.iter().take(SHOWN).enumerate() {
        what += &format!("{}{}: {reason}", if i == 0 { " (" } else { "; " }, path.display());
    }
    if !refused.is_empty() {
        what += if refused.len() > SHOWN { "; …)" } else { ")" };
    }
    Failure::new(what).advice("ten or more different photographs of one place")
}

/// Reasons that stand in one line, at most.
const SHOWN: usize = 3;

/// Why there is no model.
pub(crate) fn no_model(error: SfmJobError) -> Failure {
    let advice = match &error {
        SfmJobError::Cancelled(_) => return error.into(),
        SfmJobError::NoPairs { .. } => {
            "sharp photographs of one place, with texture, each of which shows more than half of what its neighbor shows".to_owned()
        }
        SfmJobError::Solve(SfmError::NoInitialPair { .. }) => {
            "walk along between the photographs: turning on the spot tells no depth (to join photographs from one place use `cv panorama`); a focal length, where EXIF has none or a wrong one (--focal, --ignore-exif)".to_owned()
        }
        SfmJobError::Solve(SfmError::Inconsistent { .. }) => {
            "about the right focal length (--focal), or --ignore-exif where EXIF's is wrong; leave out photographs of other places that look alike".to_owned()
        }
        SfmJobError::Option(_) | SfmJobError::Solve(SfmError::Option(_)) => words(Advice::CheckOptions),
        _ => return error.into(),
    };
    Failure::from(error).advice(advice)
}

/// Why there is no dense cloud of a model, which is written all the same.
pub(crate) fn no_dense_cloud(error: SfmDenseError) -> Failure {
    let advice = match &error {
        SfmDenseError::NoPairs { .. } => {
            "more photographs, a step of a tenth of the distance apart, each of which shows most of what its neighbor shows"
        }
        SfmDenseError::NoDepths { .. } | SfmDenseError::NoAgreement { .. } => {
            "three photographs or more of each thing, from nearer to each other, of things with texture that stand still; a larger --dense-size"
        }
        _ => return error.into(),
    };
    Failure::from(error).advice(advice)
}

/// By what a place is known.
#[derive(Clone)]
pub(crate) enum PlaceSource {
    /// The photographs' EXIF: the place of the origin, and whether heights are told.
    Gps { origin: GeodeticPoint, heights: bool },
    /// A file that the person names.
    File(PathBuf),
}

impl PlaceSource {
    /// What it is called.
    pub(crate) fn name(&self) -> String {
        match self {
            Self::Gps { .. } => "the GPS positions".to_owned(),
            Self::File(path) => format!("the places of {}", path.display()),
        }
    }

    /// The same for programs.
    pub(crate) fn key(&self) -> &'static str {
        match self {
            Self::Gps { .. } => "gps",
            Self::File(_) => "known",
        }
    }

    /// Why a model is not brought to places; nothing is to be said of photographs of which too few tell their position.
    pub(crate) fn refusal(&self, error: &ModelAlignError) -> Option<String> {
        match error {
            ModelAlignError::TooFew { got, needed } => match self {
                Self::Gps { .. } => None,
                Self::File(_) => {
                    Some(format!("{got} of them are of photographs in the model, and {needed} are needed"))
                }
            },
            ModelAlignError::OnePlace => Some("they are all one place".to_owned()),
            ModelAlignError::Contradiction { agree, of, rms, spread } => Some(format!(
                "they contradict it: {agree} of {of} agree, to {rms:.2} m where they are {spread:.2} m around their mean"
            )),
            other => Some(other.to_string()),
        }
    }
}

/// What frame a model is in that was brought to known places.
pub(crate) fn aligned(source: &PlaceSource, fit: &CenterFit) -> String {
    let (count, rms) = (fit.inliers.len(), fit.rms);
    let tilt = if fit.tilt { "" } else { "; they lie on a line, so that up is that of the photographs" };
    match source {
        PlaceSource::Gps { origin, heights } => {
            let side = |v: f64, [plus, minus]: [&str; 2]| {
                format!("{:.6}° {}", v.to_degrees().abs(), if v < 0.0 { minus } else { plus })
            };
            let place = format!("{}, {}", side(origin.latitude, ["N", "S"]), side(origin.longitude, ["E", "W"]));
            let height = if *heights { "" } else { "; no heights are told" };
            format!(
                "in meters by the GPS positions of {count} photographs ({rms:.2} m RMS): X east, Y north, Z up from {place}{height}{tilt}"
            )
        }
        PlaceSource::File(path) => {
            format!("in the frame of {}, in meters, by {count} photographs ({rms:.3} m RMS){tilt}", path.display())
        }
    }
}

/// Relative differences of which the person is told: of known distances among each other, and of the scale by positions from that by distances.
pub(crate) const DISTANCES_DIFFER: f64 = 0.02;
pub(crate) const SCALES_DIFFER: f64 = 0.1;

/// Known distances that contradict each other.
pub(crate) fn distances_differ(error: f64) -> String {
    format!("the distances of --distance contradict each other: one differs from the model by {:.1} %", 100.0 * error)
}

/// Known places that do not agree with a model that others agree with: the photographs and by how many meters.
pub(crate) fn places_differ(source: &PlaceSource, differ: &[(&Path, f64)], rms: f64) -> String {
    let shown: Vec<String> =
        differ.iter().take(SHOWN).map(|(path, off)| format!("{} by {off:.1} m", path.display())).collect();
    let more = if differ.len() > SHOWN { ", …" } else { "" };
    format!(
        "of {} {} differ from the model by much more than the others ({rms:.2} m RMS) and are left aside: {}{more}",
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
        assert_eq!(text(9).matches("blue").count(), SHOWN);
        assert!(text(9).contains("…)"));
    }

    #[test]
    fn refused_pairs_are_told_by_their_reasons() {
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
    fn what_there_is_to_try_stands_behind_the_reason() {
        let text = no_model(SfmJobError::Solve(SfmError::NoInitialPair { pairs: 7 })).text();
        assert!(text.contains("none of 7 pairs") && text.contains("; try: walk along") && text.contains("cv panorama"));
        assert!(no_model(SfmJobError::NoPairs { photos: 3 }).text().contains("of 3 photographs"));
    }
}
