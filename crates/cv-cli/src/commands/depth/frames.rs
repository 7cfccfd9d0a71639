//! `cv depth` on frames: one pair after the other with the same buffers.

use super::{Args, Range, say_memory};
use crate::frame::{Context, Explain, Failure, Outcome, expand_images};
use crate::words;
use cv_core::Stage;
use cv_pipeline::FrameDepth;
use std::path::{Path, PathBuf};

/// True for a folder or a pattern.
pub(super) fn is_sequence(path: &Path) -> bool {
    path.is_dir() || (!path.exists() && path.to_string_lossy().contains('*'))
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

/// Whether a name fits a pattern in which `*` stands for anything.
fn matches(pattern: &str, name: &str) -> bool {
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
        if lefts.len() != rights.len() {
            return Err(Failure::new(format!("{} left frames and {} right ones", lefts.len(), rights.len()))
                .advice("give as many of each"));
        }
        if self.output.exists() && !self.output.is_dir() {
            return Err(Failure::new(format!("{} is not a folder", self.output.display()))
                .advice("give a folder for the disparities of the frames"));
        }
        let options = self.options().stereo;
        let mut film = FrameDepth::new(options.clone())?;
        let (mut size, mut seconds, mut valid) = ((0, 0), 0.0, 0.0);
        let stage = Stage::new(context, "frames", lefts.len())?;
        for (i, (left, right)) in lefts.iter().zip(&rights).enumerate() {
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
            valid += map.valid_fraction() / lefts.len() as f64;
            if i == 0 {
                // Not before there is something to put there.
                std::fs::create_dir_all(&self.output).during(self.output.display())?;
            }
            let name = Path::new(left.file_stem().unwrap_or_default()).with_extension("pfm");
            cv_io::pfm::write(self.output.join(name), map.disparity.view())?;
            stage.add(1)?;
        }
        let rate = lefts.len() as f64 / seconds;
        let (width, height) = size;
        Ok(Outcome::new(vec![("match", seconds)])
            .with("frames", lefts.len())
            .with("frames_per_second", rate)
            .with("width", width)
            .with("height", height)
            .with("valid_fraction", valid)
            .summary(format!("{} frames of {width}×{height} px, {rate:.1} frames per second of matching", lefts.len())))
    }
}
