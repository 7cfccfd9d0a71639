//! `cv depth` on frames: one pair after the other with the same buffers.

use super::pairing::pair;
use super::{Args, Range, say_memory};
use crate::frame::{Context, Explain, Failure, Outcome, Output, expand_images};
use crate::words;
use cv_core::Stage;
use cv_pipeline::FrameDepth;
use std::path::{Path, PathBuf};

/// True for a folder or a pattern.
pub(super) fn is_sequence(path: &Path) -> bool {
    let text = path.to_string_lossy();
    path.is_dir() || (!path.exists() && (text.contains('*') || numbering(&text).is_some()))
}

/// The frames of a folder or pattern, in the order of their numbers.
fn frames(path: &Path) -> Result<Vec<PathBuf>, Failure> {
    if path.is_dir() {
        return expand_images(&[path.to_owned()]);
    }
    let pattern = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder.to_owned(),
        _ => PathBuf::from("."),
    };
    let mut found = expand_images(&[folder])?;
    found.retain(|file| matches(&pattern, &file.file_name().unwrap_or_default().to_string_lossy()));
    if found.is_empty() {
        return Err(Failure::new(format!("there are no images like {}", path.display())).advice("check the pattern"));
    }
    Ok(found)
}

/// The first number in the manner of C (`%d`, `%04d`) in a pattern: what stands before it, its least number of digits, and
/// what follows.
fn numbering(pattern: &str) -> Option<(&str, usize, &str)> {
    pattern.match_indices('%').find_map(|(at, _)| {
        let rest = &pattern[at + 1..];
        let width = rest.find('d')?;
        let digits = &rest[..width];
        let width = if digits.is_empty() { 1 } else { digits.parse().ok().filter(|_| digits.starts_with('0'))? };
        Some((&pattern[..at], width, &rest[digits.len() + 1..]))
    })
}

/// Whether a name fits a pattern in which `*` stands for anything and `%04d` for a number of at least four digits.
fn matches(pattern: &str, name: &str) -> bool {
    if let Some((head, width, rest)) = numbering(pattern).filter(|(head, ..)| !head.contains('*')) {
        return name.strip_prefix(head).is_some_and(|name| {
            let digits = name.len() - name.trim_start_matches(|c: char| c.is_ascii_digit()).len();
            (width..=digits).any(|n| matches(rest, &name[n..]))
        });
    }
    match pattern.split_once('*') {
        None => pattern == name,
        Some((head, rest)) => name.strip_prefix(head).is_some_and(|name| {
            (0..=name.len()).filter(|&i| name.is_char_boundary(i)).any(|i| matches(rest, &name[i..]))
        }),
    }
}

impl Args {
    /// Frame after frame with the same buffers.
    pub(super) fn run_frames(&self, context: &Context) -> Result<Outcome, Failure> {
        for (path, other) in [(&self.left, &self.right), (&self.right, &self.left)] {
            if !is_sequence(path) {
                return Err(Failure::new(format!("{} is one image, {} is not", path.display(), other.display()))
                    .advice("give two images, or two folders or patterns of frames"));
            }
        }
        if self.disparities == Range::Auto
            || self.depth.is_some()
            || self.cloud.is_some()
            || self.rig.is_some()
            || self.confidence.is_some()
            || self.matched.is_some()
            || self.uncertainty.is_some()
            || context.wants_report()
        {
            return Err(Failure::usage("frames give disparities only")
                .advice("leave out --rig, --depth, --cloud, --confidence, --matched, --uncertainty and --report, and give the number of disparities"));
        }
        let (lefts, rights) = (frames(&self.left)?, frames(&self.right)?);
        let pairs = pair(&lefts, &rights, self.pair_by)?;
        let options = self.options(context).stereo;
        let mut film = FrameDepth::new(options.clone())?;
        let (mut size, mut seconds, mut valid, mut matched) = ((0, 0), 0.0, 0.0, 0.0);
        let stage = Stage::new(context, "frames", pairs.len())?;
        for (left, right) in &pairs {
            let (a, b) = (cv_io::read_rgb(left)?, cv_io::read_rgb(right)?);
            if a.size() != size {
                size = a.size();
                say_memory(&options, size, context)?;
            }
            let start = std::time::Instant::now();
            let map = film
                .next(a.view(), b.view(), &stage)
                .map_err(|error| words::no_depth(error, false))
                .during(left.display())?;
            seconds += start.elapsed().as_secs_f64();
            valid += map.valid_fraction() / pairs.len() as f64;
            matched += map.matched_fraction() / pairs.len() as f64;
            let name = Path::new(left.file_stem().unwrap_or_default()).with_extension("pfm");
            let disparity = |out: &Path| cv_io::pfm::write(out.join(name), map.disparity.view());
            context.write(Output::Folder(&self.output), disparity)?;
            stage.add(1)?;
        }
        let rate = pairs.len() as f64 / seconds;
        let (width, height) = size;
        Ok(Outcome::new(vec![("match", seconds)])
            .with("frames", pairs.len())
            .with("frames_per_second", rate)
            .with("width", width)
            .with("height", height)
            .with("valid_fraction", valid)
            .with("matched_fraction", matched)
            .summary(format!(
                "{} frames of {width}×{height} px, {:.1} % matched and confirmed, {rate:.1} frames per second of matching",
                pairs.len(),
                100.0 * matched
            )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn patterns_are_those_of_a_shell_and_of_c() {
        let fits = |pattern: &str, names: &[&str]| names.iter().map(|name| matches(pattern, name)).collect::<Vec<_>>();
        assert_eq!(fits("f*.png", &["f1.png", "f.png", "g1.png", "f1.jpg"]), [true, true, false, false]);
        let names = ["frame_0001.png", "frame_12345.png", "frame_001.png", "frame_00x1.png", "frame_0001.png.bak"];
        assert_eq!(fits("frame_%04d.png", &names), [true, true, false, false, false]);
        assert_eq!(fits("f%d*.png", &["f7.png", "f7_left.png", "f.png"]), [true, true, false]);
        assert_eq!(fits("*_%02d.png", &["a_07.png", "a_7.png"]), [true, false]);
        // Not a number: the name of a file.
        assert!(!is_sequence(Path::new("100%.png")) && !is_sequence(Path::new("50%4d.png")));
        assert!(is_sequence(Path::new("nowhere/frame_%04d.png")));
    }
}
