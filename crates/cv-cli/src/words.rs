//! What the program says about failures, and which of its options help: the one place where the reasons of the libraries are worded.

pub(crate) mod calibration;
pub(crate) mod many_views;

use crate::frame::Failure;
use cv_io::FormatError;
use cv_pipeline::panorama_types::{LayoutError, RegistrationError, RenderError};
use cv_pipeline::stereo::RectifyError;
use cv_pipeline::{
    Advice, DenseError, DepthError, LeftOut, MatchingError, NoPairCause, PanoramaError, ReconstructError,
};
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// What to look at where a calibration and photographs contradict each other.
pub(crate) const CHECK_CALIBRATION: &str =
    "check that the calibration is that of these photographs, and that they are in its order";

/// Advice in words, with the program's options and commands.
fn words(advice: Advice) -> String {
    let words = match advice {
        Advice::SharperPhotographs => "take sharper photographs with more texture",
        Advice::ShareMore => "take photographs that share more of the scene, from places nearer to each other",
        Advice::SameScene => "take two photographs of the same things, with texture on them",
        Advice::NearerAndStill => "take photographs nearer to each other, of things with texture that stand still",
        Advice::LargerPhotographs => "take larger photographs",
        Advice::StepAside => "step aside between the photographs; to join photographs from one place use `cv panorama`",
        Advice::StepAsideOrGiveFocal => {
            "step aside between the photographs and include things in front of the plane or behind it; --focal tells a plane from a turn; to join photographs from one place use `cv panorama`"
        }
        Advice::StepAsideNotAhead => "step aside between the photographs rather than ahead",
        Advice::LeaveThePlane => "include things in front of the plane or behind it",
        Advice::SameFeatures => {
            "take the features of both photographs from the same detector, or leave out --load-features"
        }
        Advice::FartherApart => "take the photographs farther apart",
        Advice::MoreDepthOrFeatures => {
            "take photographs that share more of the scene, with things near and far all over them, or find more features (--features)"
        }
        Advice::FocalBetter { px } => {
            return format!(
                "check the focal length, which is in pixels of the photograph: --focal {px:.0}, or leave it out (--ignore-exif where the photograph has a wrong one)"
            );
        }
        Advice::LeaveOutFocal => {
            "give the focal length in pixels of the photograph (millimeters × its width in pixels / the sensor's width in millimeters), or leave it out (--ignore-exif where the photograph has a wrong one)"
        }
        Advice::CheckCamera => "check the camera file",
        Advice::CheckMatches => "check the matches with `cv match`",
        Advice::Rectify => "rectify the pair (--rig, or `cv rectify`)",
        Advice::Exchange { min_disparity } => {
            return format!("exchange the two photographs; if they are in order, give --min-disparity {min_disparity}");
        }
        Advice::TryDisparities { min, count } => {
            return format!("--disparities auto, or --min-disparity {min} --disparities {count}");
        }
        Advice::KeepDepths { near, far } => {
            return format!("choose --near and --far so that they include depths from {near:.3} to {far:.3}");
        }
        Advice::CheckOffset => "check --offset, the difference of the principal points, or the calibration",
        Advice::GiveDisparities => "rectify the pair (--rig, or `cv rectify`), or give the number of disparities",
        Advice::LargerWindow => "a larger window (--census 9), or more light",
        Advice::MoreMemory { needed } => {
            return format!("allow more memory (--max-memory {}), or fewer disparities", needed.div_ceil(1 << 20));
        }
        Advice::ReduceLess => "reduce the photographs less (--dense-size)",
        Advice::CheckOptions => "see the help (--help) for the range of each option",
        Advice::RunAgain => "run it again",
    };
    words.to_owned()
}

/// What to do about a file that cannot be read or written.
pub(crate) fn unreadable(reason: &FormatError) -> Option<String> {
    match reason {
        FormatError::TooMuchMemory { needed, size, .. } => {
            let what = if size.is_some() { ", or a smaller picture" } else { "" };
            Some(format!("--max-memory {}{what}", needed.div_ceil(1 << 20)))
        }
        other => other.hint().map(str::to_owned),
    }
}

/// Why two photographs have no matches.
pub(crate) fn no_matches(error: MatchingError, photos: [&Path; 2]) -> Failure {
    Failure::new(format!("{} and {}: {error}", photos[0].display(), photos[1].display())).advice(words(error.advice()))
}

/// Why there is no reconstruction of two photographs.
pub(crate) fn no_reconstruction(error: &ReconstructError, photos: [&Path; 2]) -> Failure {
    Failure::new(format!("{} and {}: {error}", photos[0].display(), photos[1].display())).advice(words(error.advice()))
}

/// Why there is no dense cloud of two photographs whose sparse one there is.
pub(crate) fn no_dense_cloud(error: &DenseError, photos: [&Path; 2]) -> Failure {
    let what = format!("no dense cloud of {} and {}: {error}", photos[0].display(), photos[1].display());
    let advice = match error.advice() {
        Advice::MoreMemory { needed } => format!(
            "allow more memory (--max-memory {}) or reduce the photographs further (--dense-size)",
            needed.div_ceil(1 << 20)
        ),
        advice @ (Advice::StepAsideNotAhead | Advice::ShareMore | Advice::NearerAndStill) => {
            format!("{}; the sparse cloud alone needs no --dense", words(advice))
        }
        advice => words(advice),
    };
    Failure::new(what).advice(advice)
}

/// Why there is no depth; with a rig, the pair is as its calibration says.
pub(crate) fn no_depth(error: DepthError, by_rig: bool) -> Failure {
    let advice = match (&error, by_rig) {
        (
            DepthError::NoPair { cause: NoPairCause::VerticalDisparity { .. } | NoPairCause::Exchanged { .. }, .. },
            true,
        )
        | (DepthError::NoRange(_), true) => CHECK_CALIBRATION.to_owned(),
        _ => words(error.advice()),
    };
    Failure::from(error).advice(advice)
}

/// Why the rig of a file cannot be rectified; `exchanged`: --exchange was given.
pub(crate) fn no_rectification(error: RectifyError, rig: &Path, exchanged: bool) -> Failure {
    let advice = match error {
        RectifyError::Exchanged { .. } if exchanged => {
            "leave out --exchange, and name the photographs in the other order"
        }
        RectifyError::Exchanged { .. } => "name the photographs in the other order, and give --exchange",
        RectifyError::TooLarge { .. } => "a smaller --size",
        _ => "check the calibration file",
    };
    Failure::new(format!("{}: {error}", rig.display())).advice(advice)
}

/// A rig that is not that of the photographs.
pub(crate) fn another_rig(rig: &Path, cause: impl Display) -> Failure {
    Failure::new(format!("the photographs do not fit {}: {cause}", rig.display())).advice(CHECK_CALIBRATION)
}

/// Why a photograph is not in the panorama.
pub(crate) fn left_out(reason: &LeftOut, paths: &[PathBuf]) -> String {
    match reason {
        LeftOut::Features(error) => error.to_string(),
        LeftOut::NoFeatures => "no features found on it".to_owned(),
        LeftOut::NoOverlap { nearest: None } => "overlaps with no other photograph".to_owned(),
        LeftOut::NoOverlap { nearest: Some(pair) } => format!(
            "overlaps with no other photograph: with the likeliest, {}, {} of {} matches in the overlap agree, more than {:.0} are needed",
            paths[pair.other].display(),
            pair.agree,
            pair.in_overlap,
            pair.needed
        ),
        LeftOut::OtherComponent { size } => format!("overlaps only with a smaller group of {size} photographs"),
        LeftOut::Inconsistent => "its overlaps contradict those of the other photographs".to_owned(),
    }
}

/// Why there is no panorama.
pub(crate) fn no_panorama(error: PanoramaError, paths: &[PathBuf]) -> Failure {
    match error {
        PanoramaError::Align { source, images } => {
            let reasons: Vec<String> = paths
                .iter()
                .zip(&images)
                .filter_map(|(path, image)| {
                    image.reason.as_ref().map(|r| format!("{}: {}", path.display(), left_out(r, paths)))
                })
                .collect();
            Failure::new(format!("{source} ({})", reasons.join("; ")))
                .advice("photographs that share a third of their view with their neighbors, taken from one place")
        }
        PanoramaError::Registration(source) => {
            let photograph = match source {
                RegistrationError::Size { index, .. } => paths.get(index),
                _ => None,
            };
            let photograph = photograph.map(|path| format!("{}: ", path.display())).unwrap_or_default();
            Failure::new(format!("{photograph}{source}"))
                .advice("give the photographs of the same cameras in the order in which they were registered")
        }
        PanoramaError::Render(source) => {
            let advice = match source {
                RenderError::Layout(LayoutError::FieldTooWide { .. }) => "a smaller --fov, or --projection spherical",
                RenderError::Layout(LayoutError::NothingInView) => "another --center, or a wider --fov",
                RenderError::Layout(LayoutError::FlatScene) => {
                    "leave out --fov, --center and --roll, or --mode rotation where the camera only turned"
                }
                _ => "--projection auto, or a smaller --scale",
            };
            Failure::new(source).advice(advice)
        }
        PanoramaError::Cancelled(stop) => stop.into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_pipeline::TwoViewError;

    #[test]
    fn advice_names_options_with_their_numbers() {
        assert!(words(Advice::TryDisparities { min: -7, count: 64 }).contains("--min-disparity -7 --disparities 64"));
        let error = ReconstructError::from(TwoViewError::WrongFocal {
            given: 35.0,
            better: 561.4,
            deviations: 9.0,
            inliers: 80,
        });
        let failure = no_reconstruction(&error, [Path::new("a.jpg"), Path::new("b.jpg")]);
        assert!(failure.text().starts_with("error: a.jpg and b.jpg: ") && failure.text().contains("--focal 561,"));
    }

    #[test]
    fn a_file_too_large_is_read_with_the_memory_named() {
        let reason = FormatError::TooMuchMemory { needed: (9 << 20) + 1, allowed: 1 << 20, size: Some((2000, 1000)) };
        assert_eq!(unreadable(&reason).unwrap(), "--max-memory 10, or a smaller picture");
        assert!(unreadable(&FormatError::Empty).unwrap().contains("export"));
    }

    #[test]
    fn memory_is_asked_for_in_the_unit_of_the_option() {
        // 5 MiB and a byte.
        assert!(words(Advice::MoreMemory { needed: (5 << 20) + 1 }).contains("--max-memory 6)"));
    }

    #[test]
    fn with_a_rig_it_is_the_calibration_that_is_doubted() {
        let error =
            || DepthError::NoPair { matched: 0.1, needed: 0.18, cause: NoPairCause::VerticalDisparity { px: 9.0 } };
        assert!(no_depth(error(), true).text().contains("calibration"));
        assert!(no_depth(error(), false).text().contains("--rig, or `cv rectify`"));
    }
}
