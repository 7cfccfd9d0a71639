//! What the program says of models of many photographs: why there is none, and why photographs are left out.

use super::{Failure, unreadable, words};
use cv_io::IoError;
use cv_pipeline::many_views::{SfmError, ViewOutcome};
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
    fn what_there_is_to_try_stands_behind_the_reason() {
        let text = no_model(SfmJobError::Solve(SfmError::NoInitialPair { pairs: 7 })).text();
        assert!(text.contains("none of 7 pairs") && text.contains("; try: walk along") && text.contains("cv panorama"));
        assert!(no_model(SfmJobError::NoPairs { photos: 3 }).text().contains("of 3 photographs"));
    }
}
