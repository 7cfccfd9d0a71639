//! `cv depth` on frames: one pair after the other with the same buffers.

use super::pairing::pair;
use super::{Args, Range, say_memory};
use crate::frame::{Context, Explain, Failure, Outcome, Output, expand_images, stands_for_many};
use crate::words;
use cv_core::Stage;
use cv_pipeline::FrameDepth;
use std::path::Path;

impl Args {
    /// Frame after frame with the same buffers.
    pub(super) fn run_frames(&self, context: &Context) -> Result<Outcome, Failure> {
        for (path, other) in [(&self.left, &self.right), (&self.right, &self.left)] {
            if !stands_for_many(path) {
                return Err(Failure::new(format!("{} is one image, {} is not", path.display(), other.display()))
                    .advice("give two images, or two folders or patterns of frames"));
            }
        }
        if self.disparities == Range::Auto
            || self.depth.is_some()
            || self.cloud.is_some()
            || !self.rig.is_empty()
            || self.confidence.is_some()
            || self.matched.is_some()
            || self.uncertainty.is_some()
            || context.wants_report()
        {
            return Err(Failure::usage("frames give disparities only")
                .advice("leave out --rig, --depth, --cloud, --confidence, --matched, --uncertainty and --report, and give the number of disparities"));
        }
        let [lefts, rights] = [&self.left, &self.right].map(|path| expand_images(std::slice::from_ref(path)));
        let (lefts, rights) = (lefts?, rights?);
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
