//! What the arguments of `cv depth` mean to the matcher.

use super::Args;
use crate::frame::{Context, Explain, Failure};
use crate::rig;
use cv_core::RgbU8;
use cv_pipeline::stereo::{Smoothing, StereoOptions};
use cv_pipeline::{DepthOptions, disparity_range};

/// `--disparities`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Range {
    Auto,
    Number(usize),
}

pub(super) fn parse_range(text: &str) -> Result<Range, String> {
    if text == "auto" {
        return Ok(Range::Auto);
    }
    text.parse().map(Range::Number).map_err(|_| "give a number, or auto".to_owned())
}

impl Args {
    /// Under `--disparities auto`, the range that feature matches show.
    pub(super) fn set_range(
        &self,
        options: &mut DepthOptions,
        left: &RgbU8,
        right: &RgbU8,
        context: &Context,
    ) -> Result<(), Failure> {
        if self.disparities == Range::Auto {
            let (min, n) = disparity_range(left.view(), right.view(), context).during("--disparities auto").advice(
                match self.rig {
                    Some(_) => rig::ADVICE,
                    None => "rectify the pair (--rig, or `cv rectify`), or give the number of disparities",
                },
            )?;
            let end = min + n as i32;
            options.stereo.min_disparity = self.min_disparity.unwrap_or(min);
            options.stereo.disparities = (end - options.stereo.min_disparity).max(1) as usize;
            context.note(format!("disparities {} to {}", options.stereo.min_disparity, end - 1));
        }
        Ok(())
    }

    pub(super) fn options(&self) -> DepthOptions {
        let default = StereoOptions::default();
        DepthOptions {
            stereo: StereoOptions {
                min_disparity: self.min_disparity.unwrap_or(default.min_disparity),
                disparities: match self.disparities {
                    Range::Number(n) => n,
                    Range::Auto => default.disparities,
                },
                census: self.census,
                p1: self.p1.unwrap_or(default.p1),
                p2: self.p2.unwrap_or(default.p2),
                p2_min: default
                    .p2_min
                    .clamp(self.p1.unwrap_or(0), self.p2.unwrap_or(u8::MAX).max(self.p1.unwrap_or(0))),
                paths: self.paths,
                uniqueness: self.uniqueness.unwrap_or(default.uniqueness),
                speckle_size: self.speckle_size.unwrap_or(default.speckle_size),
                fill: !self.no_fill,
                blend: self.blend,
                smoothing: match self.smoothing {
                    Smoothing::None => Smoothing::None,
                    Smoothing::Bilateral { sigma } => Smoothing::Bilateral { sigma: self.sigma.unwrap_or(sigma) },
                    Smoothing::LeastSquares { lambda, sigma } => Smoothing::LeastSquares {
                        lambda: self.lambda.unwrap_or(lambda),
                        sigma: self.sigma.unwrap_or(sigma),
                    },
                },
                confidence: self.confidence.is_some(),
                max_memory: self.max_memory.map(|mib| mib.saturating_mul(1 << 20)),
                ..default
            },
            range: (self.near, self.far.unwrap_or(f32::INFINITY)),
        }
    }
}
