//! Messages for the errors of the libraries, with the program's options as remedies.

pub(crate) mod calibration;
pub(crate) mod many_views;

use crate::frame::Failure;
use cv_io::FormatError;
use cv_pipeline::panorama_types::{LayoutError, RegistrationError, RenderError, StreamError};
use cv_pipeline::stereo::RectifyError;
use cv_pipeline::{
    Advice, DenseError, DepthError, LeftOut, MatchingError, NoPairCause, PanoramaError, ReconstructError,
};
use std::fmt::Display;
use std::path::{Path, PathBuf};

/// Remedy if a calibration contradicts the photographs.
pub(crate) const CHECK_CALIBRATION: &str =
    "check that the calibration belongs to these photographs, and that they are in its order";

/// Formats advice, with the program's options and commands.
fn advice_text(advice: Advice) -> String {
    let text = match advice {
        Advice::SharperPhotographs => "take sharper photographs with more texture",
        Advice::ShareMore => "take photographs with more overlap, from nearer viewpoints",
        Advice::SameScene => "take two photographs of the same textured scene",
        Advice::NearerAndStill => "take photographs with a smaller baseline, of a static scene with texture",
        Advice::LargerPhotographs => "take larger photographs",
        Advice::StepAside => {
            "move the camera sideways between the photographs; to stitch photographs from one place use `cv panorama`"
        }
        Advice::StepAsideOrGiveFocal => {
            "move the camera sideways between the photographs and include objects in front of or behind the plane; --focal distinguishes a plane from a rotation; to stitch photographs from one place use `cv panorama`"
        }
        Advice::StepAsideNotAhead => "move the camera sideways between the photographs, not forward",
        Advice::LeaveThePlane => "include objects in front of or behind the plane",
        Advice::SameFeatures => "use features of the same method for both photographs, or leave out --load-features",
        Advice::FartherApart => "take the photographs with a larger baseline",
        Advice::MoreDepthOrFeatures => {
            "take photographs with more overlap and with near and far objects all over the image, or detect more features (--features)"
        }
        Advice::FocalBetter { px } => {
            return format!(
                "check the focal length, which is in pixels: --focal {px:.0}, or leave it out (--ignore-exif if the EXIF of the photograph is wrong)"
            );
        }
        Advice::LeaveOutFocal => {
            "give the focal length in pixels (millimeters × image width in pixels / sensor width in millimeters), or leave it out (--ignore-exif if the EXIF of the photograph is wrong)"
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
            return format!("choose --near and --far to include depths from {near:.3} to {far:.3}");
        }
        Advice::CheckOffset => "check --offset, the difference of the principal points, or the calibration",
        Advice::GiveDisparities => "rectify the pair (--rig, or `cv rectify`), or give the number of disparities",
        Advice::LargerWindow => "a larger census window (--census 9), or better illumination",
        Advice::MoreMemory { needed } => {
            return format!("allow more memory (--max-memory {}), or fewer disparities", needed.div_ceil(1 << 20));
        }
        Advice::ReduceLess => "downscale the photographs less (--dense-size)",
        Advice::CheckOptions => "see the help (--help) for the range of each option",
        Advice::RunAgain => "run it again",
    };
    text.to_owned()
}

/// Returns a remedy for a file that cannot be read or written.
pub(crate) fn unreadable(reason: &FormatError) -> Option<String> {
    match reason {
        FormatError::TooMuchMemory { needed, size, .. } => {
            let what = if size.is_some() { ", or a smaller image" } else { "" };
            Some(format!("--max-memory {}{what}", needed.div_ceil(1 << 20)))
        }
        other => other.hint().map(str::to_owned),
    }
}

/// Words a failed matching of two photographs.
pub(crate) fn no_matches(error: MatchingError, photos: [&Path; 2]) -> Failure {
    Failure::new(format!("{} and {}: {error}", photos[0].display(), photos[1].display()))
        .advice(advice_text(error.advice()))
}

/// Words a failed reconstruction of two photographs.
pub(crate) fn no_reconstruction(error: &ReconstructError, photos: [&Path; 2]) -> Failure {
    Failure::new(format!("{} and {}: {error}", photos[0].display(), photos[1].display()))
        .advice(advice_text(error.advice()))
}

/// Words a failed dense reconstruction after a successful sparse one.
pub(crate) fn no_dense_cloud(error: &DenseError, photos: [&Path; 2]) -> Failure {
    let what = format!("no dense cloud of {} and {}: {error}", photos[0].display(), photos[1].display());
    let advice = match error.advice() {
        Advice::MoreMemory { needed } => format!(
            "allow more memory (--max-memory {}) or downscale the photographs further (--dense-size)",
            needed.div_ceil(1 << 20)
        ),
        advice @ (Advice::StepAsideNotAhead | Advice::ShareMore | Advice::NearerAndStill) => {
            format!("{}; or leave out --dense for the sparse cloud alone", advice_text(advice))
        }
        advice => advice_text(advice),
    };
    Failure::new(what).advice(advice)
}

/// Words a failed depth computation; `by_rig`: the pair was rectified by a calibration, which is then suspected.
pub(crate) fn no_depth(error: DepthError, by_rig: bool) -> Failure {
    let advice = match (&error, by_rig) {
        (
            DepthError::NoPair { cause: NoPairCause::VerticalDisparity { .. } | NoPairCause::Exchanged { .. }, .. },
            true,
        )
        | (DepthError::NoRange(_), true) => CHECK_CALIBRATION.to_owned(),
        _ => advice_text(error.advice()),
    };
    Failure::from(error).advice(advice)
}

/// Words a failed rectification; `exchanged`: --exchange was given.
pub(crate) fn no_rectification(error: RectifyError, rig: &Path, exchanged: bool) -> Failure {
    let advice = match error {
        RectifyError::Exchanged { .. } if exchanged => {
            "leave out --exchange, and give the photographs in the other order"
        }
        RectifyError::Exchanged { .. } => "give the photographs in the other order, and --exchange",
        RectifyError::TooLarge { .. } => "a smaller --size",
        _ => "check the calibration file",
    };
    Failure::new(format!("{}: {error}", rig.display())).advice(advice)
}

/// Words a contradiction between a rig and feature matches.
pub(crate) fn contradicting_rig(rig: &Path, cause: impl Display) -> Failure {
    Failure::new(format!("the photographs contradict the calibration {}: {cause}", rig.display()))
        .advice(CHECK_CALIBRATION)
}

/// Words why a photograph is not in the panorama.
pub(crate) fn left_out(reason: &LeftOut, paths: &[PathBuf]) -> String {
    match reason {
        LeftOut::Features(error) => error.to_string(),
        LeftOut::NoFeatures => "no features detected".to_owned(),
        LeftOut::NoOverlap { nearest: None } => "overlaps with no other photograph".to_owned(),
        LeftOut::NoOverlap { nearest: Some(pair) } => format!(
            "overlaps with no other photograph: the best candidate, {}, has {} matches consistent with one homography, and more than {:.0} are needed",
            paths[pair.other].display(),
            pair.agree,
            pair.needed
        ),
        LeftOut::OtherComponent { size } => format!("belongs to a smaller connected component of {size} photographs"),
        LeftOut::Inconsistent => "its registration is inconsistent with the other photographs".to_owned(),
    }
}

/// Words a failed panorama.
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
                .advice("photographs from one place that overlap their neighbors by a third")
        }
        PanoramaError::Registration(source) => {
            let photograph = match source {
                RegistrationError::Size { index, .. } => paths.get(index),
                _ => None,
            };
            let photograph = photograph.map(|path| format!("{}: ", path.display())).unwrap_or_default();
            Failure::new(format!("{photograph}{source}"))
                .advice("give photographs of the same cameras in the order of the registration")
        }
        PanoramaError::Render(RenderError::Stream(source)) => {
            let mib = |bytes: usize| bytes.div_ceil(1 << 20);
            let advice = match source {
                StreamError::Memory { needed, .. } => format!("--max-memory {}, or a smaller --scale", mib(needed)),
                StreamError::Whole { what: "radiance", needed, .. } => {
                    format!("--max-memory {}, a smaller --scale, or a panorama as .tif of 16 bits", mib(needed))
                }
                StreamError::Whole { needed, .. } => {
                    format!("--blend multiband, --max-memory {}, or a smaller --scale", mib(needed))
                }
                StreamError::Scratch { .. } | StreamError::NotWritten => {
                    "free some space on the disk of the panorama: five times its pixels in bytes, ten times for 16 bits"
                        .to_owned()
                }
                StreamError::Photograph { .. } => "do not change the photographs during the run".to_owned(),
            };
            Failure::new(source).advice(advice)
        }
        PanoramaError::Render(source) => {
            let advice = match source {
                RenderError::Layout(LayoutError::FieldTooWide { .. }) => "a smaller --fov, or --projection spherical",
                RenderError::Layout(LayoutError::NothingInView) => "another --center, or a wider --fov",
                RenderError::Layout(LayoutError::FlatScene) => {
                    "leave out --fov, --center and --roll, or use --mode rotation for a rotating camera"
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
    use cv_pipeline::{NearestPair, TwoViewError};

    #[test]
    fn advice_names_options_with_their_numbers() {
        assert!(
            advice_text(Advice::TryDisparities { min: -7, count: 64 }).contains("--min-disparity -7 --disparities 64")
        );
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
    fn the_memory_to_read_a_large_file_is_advised() {
        let reason = FormatError::TooMuchMemory { needed: (9 << 20) + 1, allowed: 1 << 20, size: Some((2000, 1000)) };
        assert_eq!(unreadable(&reason).unwrap(), "--max-memory 10, or a smaller image");
        assert!(unreadable(&FormatError::Empty).unwrap().contains("export"));
    }

    #[test]
    fn required_memory_is_in_the_unit_of_the_option() {
        // 5 MiB and a byte.
        assert!(advice_text(Advice::MoreMemory { needed: (5 << 20) + 1 }).contains("--max-memory 6)"));
    }

    #[test]
    fn a_photograph_without_overlap_is_compared_with_its_best_candidate() {
        let nearest = NearestPair { other: 1, agree: 5, in_overlap: 0, needed: 8.3 };
        let text = left_out(&LeftOut::NoOverlap { nearest: Some(nearest) }, &["a.jpg".into(), "b.jpg".into()]);
        assert!(text.contains("b.jpg, has 5 matches") && text.contains("more than 8 are"), "{text}");
    }

    #[test]
    fn with_a_rig_the_calibration_is_suspected() {
        let error =
            || DepthError::NoPair { matched: 0.1, needed: 0.18, cause: NoPairCause::VerticalDisparity { px: 9.0 } };
        assert!(no_depth(error(), true).text().contains("calibration"));
        assert!(no_depth(error(), false).text().contains("--rig, or `cv rectify`"));
    }
}
