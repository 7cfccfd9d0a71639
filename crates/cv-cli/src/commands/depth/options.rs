//! Conversion of the arguments of `cv depth` to library options.

use super::Args;
use crate::frame::Context;
use cv_pipeline::stereo::{Smoothing, StereoOptions};
use cv_pipeline::{DepthOptions, DisparityRange, FewMatches};

/// The value of `--disparities`.
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
    pub(super) fn options(&self, context: &Context) -> DepthOptions {
        let default = StereoOptions::default();
        DepthOptions {
            stereo: StereoOptions {
                min_disparity: self.min_disparity.unwrap_or(default.min_disparity),
                disparities: match self.disparities {
                    Range::Number(n) => n,
                    Range::Auto => default.disparities,
                },
                census: self.census,
                pyramid_levels: self.pyramid_levels,
                search: self.search,
                paths: self.paths,
                uniqueness: self.uniqueness,
                speckle_size: self.speckle_size,
                fill: !self.no_fill,
                quality: self.quality,
                sequence: self.sequence,
                intensity_cost: self.blend,
                smoothing: match self.smoothing {
                    Smoothing::None => Smoothing::None,
                    Smoothing::Bilateral { sigma } => Smoothing::Bilateral { sigma: self.sigma.unwrap_or(sigma) },
                    Smoothing::LeastSquares { lambda, sigma } => Smoothing::LeastSquares {
                        lambda: self.lambda.unwrap_or(lambda),
                        sigma: self.sigma.unwrap_or(sigma),
                    },
                },
                confidence: self.confidence.is_some(),
                max_memory: context.max_memory,
                ..default
            }
            .with_penalties(self.p1, self.p2),
            disparities: match self.disparities {
                Range::Number(_) => DisparityRange::Given,
                Range::Auto => DisparityRange::Auto { min: self.min_disparity },
            },
            range: (self.near, self.far.unwrap_or(f32::INFINITY)),
            few_matches: if self.force { FewMatches::Keep } else { FewMatches::Check },
            align: !self.no_align,
        }
    }
}
