//! What the program says of models of many photographs: why there is none, and why photographs are left out.

use super::{Failure, unreadable, words};
use cv_io::IoError;
use cv_pipeline::many_views::{PairRefusal, RefusedPair, SfmError, ViewOutcome};
use cv_pipeline::{Advice, SfmJobError};
use std::path::Path;

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
