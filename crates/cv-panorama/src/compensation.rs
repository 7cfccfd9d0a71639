//! Exposure compensation of the preview, with masks and exposure brackets: between its warping and the seams.

use crate::align::Alignment;
use crate::brackets;
use crate::masks::PreviewMasks;
use crate::photometric::{Adaptation, Exposure, Gains, estimate_gains};
use crate::surface::{Layout, Preview};
use cv_core::{Cancelled, Progress, Stage};

/// Exposures as estimated on a preview.
pub(crate) struct Compensation {
    pub(crate) gains: Gains,
    /// Local adaptation, if requested and needed.
    pub(crate) adaptation: Option<Adaptation>,
    /// Exposure brackets: indices of photographs.
    pub(crate) stacks: Vec<Vec<usize>>,
}

impl Compensation {
    /// Estimates the exposures of `photos` photographs, corrects the preview, then restricts it to kept parts and sets the data terms of exposure brackets. Reports as the stage "exposure".
    pub(crate) fn apply(
        preview: &mut Preview,
        masks: &PreviewMasks,
        (photos, alignment): (usize, &Alignment),
        layout: &Layout,
        exposure: Exposure,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let photo_of: Vec<usize> = layout.placements.iter().map(|p| p.photo).collect();
        let gains = estimate_gains(preview, &photo_of, photos, exposure, progress)?;
        let adaptation = Adaptation::new(preview, &gains, &photo_of, exposure, layout, progress)?;
        let stacks = brackets::stacks(alignment, &gains);
        let lumas = brackets::lumas(preview, &stacks, &photo_of);
        if exposure != Exposure::None {
            preview.correct(&gains, adaptation.as_ref(), &photo_of);
        }
        masks.keep(preview);
        brackets::set_costs(preview, &stacks, &photo_of, &lumas, &Stage::new(progress, "exposure", 1)?)?;
        Ok(Self { gains, adaptation, stacks })
    }
}
