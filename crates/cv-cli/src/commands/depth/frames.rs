//! `cv depth` on sequences: one pair after the other, reusing buffers.

use super::pairing::pair;
use super::{Args, Sequence, report};
use crate::frame::{Context, Explain, Failure, Outcome, expand_images, stands_for_many};
use crate::photos::{Photos, at_own_depth};
use cv_core::Stage;
use cv_pipeline::stereo::DisparityMap;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::Instant;

impl Args {
    /// Processes a sequence of pairs. Only the first pair is kept, for the report.
    pub(super) fn run_frames(&self, context: &Context) -> Result<Outcome, Failure> {
        for (path, other) in [(&self.left, &self.right), (&self.right, &self.left)] {
            if !stands_for_many(path) {
                return Err(Failure::new(format!("{} is one image, {} is not", path.display(), other.display()))
                    .advice("give two images, or two folders or patterns of frames"));
            }
        }
        let [lefts, rights] = [&self.left, &self.right].map(|path| expand_images(std::slice::from_ref(path)));
        let pairs = pair(&lefts?, &rights?, self.pair_by)?;
        check_unique_names(&pairs)?;
        let needs_depth = context.wants_report()
            || self.cloud.is_some()
            || self.matched.is_some()
            || [&self.depth, &self.confidence, &self.uncertainty].iter().any(|map| map.is_some());
        let started = Instant::now();
        let (mut sequence, mut size): (Option<Sequence>, _) = (None, [(0, 0); 2]);
        let (mut seconds, mut frames, mut first) = (0.0, Vec::with_capacity(pairs.len()), None);
        let mut aligned = false;
        let stage = Stage::new(context, "frames", pairs.len())?;
        for (left, right) in &pairs {
            let photos = Photos::read(left, right)?;
            // A change of size starts a new sequence.
            if size != photos.sizes() {
                sequence = None;
                size = photos.sizes();
            }
            let sequence = match &mut sequence {
                Some(sequence) => sequence,
                None => sequence.insert(self.sequence(&photos, [left, right], context)?),
            };
            let one = self.of_frame(left);
            let start = Instant::now();
            let failure = |error| self.failure(error);
            let fractions = |map: &DisparityMap| (map.matched_fraction(), map.valid_fraction(), map.no_data_fraction());
            let (matched, valid, no_data) = if needs_depth {
                let job =
                    at_own_depth!(photos, |a, b| sequence.frames.next_depth(a, b, self.wants_points(context), &stage));
                let job = job.map_err(failure).during(left.display())?;
                seconds += start.elapsed().as_secs_f64();
                one.write(&job, sequence.meters_per_unit, context)?;
                let fractions = fractions(&job.maps.map);
                if context.wants_report() && first.is_none() {
                    first = Some(job);
                }
                fractions
            } else {
                let map = at_own_depth!(photos, |a, b| sequence.frames.next(a, b, &stage));
                let map = map.map_err(failure).during(left.display())?;
                seconds += start.elapsed().as_secs_f64();
                one.write_disparity(map, context)?;
                fractions(map)
            };
            if frames.is_empty() {
                super::report_border(no_data, context);
                self.report_range(sequence, context);
            }
            if !aligned && let Some(offset) = sequence.frames.vertical_offset() {
                super::report_alignment(&offset, context);
                aligned = true;
            }
            frames.push((left.clone(), matched, valid));
            stage.add(1)?;
        }
        let count = frames.len() as f64;
        let mean = |fraction: fn(&(PathBuf, f64, f64)) -> f64| frames.iter().map(fraction).sum::<f64>() / count;
        let (matched, valid) = (mean(|frame| frame.1), mean(|frame| frame.2));
        let (rate, total) = (count / seconds, count / started.elapsed().as_secs_f64());
        if let Some(job) = &first {
            super::warn_of_filling(&job.maps, context);
            context.report(|| report::report(job, &frames))?;
        }
        let (width, height) = sequence.as_ref().map_or((0, 0), |sequence| sequence.size);
        let disparities = sequence.as_ref().and_then(|sequence| sequence.frames.disparities());
        Ok(Outcome::new(vec![("match", seconds)])
            .with("frames", frames.len())
            .with("frames_per_second", rate)
            .with("frames_per_second_with_files", total)
            .with("width", width)
            .with("height", height)
            .with("valid_fraction", valid)
            .with("matched_fraction", matched)
            .with("disparities", disparities.map(|(_, count)| count))
            .with("min_disparity", disparities.map(|(first, _)| first))
            .summary(format!(
                "{} frames of {width}×{height} px, {:.1} % matched and confirmed, {rate:.1} frames per second of matching, {total:.1} with reading and writing",
                frames.len(),
                100.0 * matched
            )))
    }

    /// Returns the arguments for one frame: the outputs are files in the output folders.
    fn of_frame(&self, left: &Path) -> Self {
        let file = |folder: &PathBuf, ending: &str| {
            let mut name = left.file_stem().unwrap_or_default().to_owned();
            name.push(".");
            name.push(ending);
            folder.join(name)
        };
        let map = |folder: &Option<PathBuf>| folder.as_ref().map(|folder| file(folder, "pfm"));
        Self {
            output: file(&self.output, "pfm"),
            depth: map(&self.depth),
            cloud: self.cloud.as_ref().map(|folder| file(folder, "ply")),
            confidence: map(&self.confidence),
            matched: self.matched.as_ref().map(|folder| file(folder, "png")),
            uncertainty: map(&self.uncertainty),
            ..self.clone()
        }
    }
}

/// Refuses frames whose results would have the same name.
fn check_unique_names(pairs: &[(PathBuf, PathBuf)]) -> Result<(), Failure> {
    let mut known = BTreeMap::new();
    for (left, _) in pairs {
        if let Some(other) = known.insert(left.file_stem(), left) {
            return Err(Failure::new(format!(
                "{} and {} would be written to one file",
                other.display(),
                left.display()
            ))
            .advice("select frames of different names by a pattern"));
        }
    }
    Ok(())
}
