//! Finding an object by its color: train on photographs with masks, then mark it in others.

use crate::Progress;
use cv_core::{Cancelled, ImageView, Mask, StageClock};
use cv_segment::{ColorModel, Labeled, SegmentError, TrainOptions, Trained, train};

/// What [`train_segment`] learned.
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentTraining {
    /// The model and its scores on the training photographs.
    pub trained: Trained,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// What [`segment`] found in a photograph.
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentResult {
    /// Where the object is.
    pub mask: Mask,
    /// The share of the photograph's pixels that are marked, 0 to 1; 0 for an empty photograph.
    pub fraction: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Learns an object's colors from photographs and masks.
///
/// # Errors
/// [`SegmentError`]: nothing to train on, masks that do not fit or show nothing, options out of range.
pub fn train_segment(
    photos: &[Labeled<'_>],
    options: &TrainOptions,
    progress: &dyn Progress,
) -> Result<SegmentTraining, SegmentError> {
    let mut clock = StageClock::new();
    let trained = train(photos, options, progress)?;
    clock.lap("train");
    Ok(SegmentTraining { trained, stages: clock.into_stages() })
}

/// Marks the object in a photograph.
///
/// # Errors
/// [`Cancelled`].
pub fn segment(
    photo: ImageView<'_, u8, 3>,
    model: &ColorModel,
    progress: &dyn Progress,
) -> Result<SegmentResult, Cancelled> {
    let mut clock = StageClock::new();
    let raw = model.classify(photo, progress)?;
    clock.lap("classify");
    let mask = model.cleanup().apply(raw.view(), progress)?;
    clock.lap("clean up");
    let marked = mask.as_slice().iter().filter(|&&m| m).count();
    let fraction = marked as f64 / mask.as_slice().len().max(1) as f64;
    Ok(SegmentResult { mask, fraction, stages: clock.into_stages() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::{Camera, RgbU8};
    use cv_segment::{ColorSpace, ConfusionMatrix};
    use cv_synth::{RenderOptions, ball_photos};

    #[test]
    fn a_ball_is_found_in_photographs_it_was_not_trained_on() {
        let camera = Camera::from_focal(240, 180, 220.0);
        for seed in [3, 4] {
            let photos = ball_photos(seed, 8, &camera, &RenderOptions::default()).unwrap();
            let labeled: Vec<Labeled<'_>> = photos.iter().map(|p| (p.view.image.view(), p.mask.view())).collect();
            let half = |odd: usize| -> Vec<Labeled<'_>> { labeled.iter().copied().skip(odd).step_by(2).collect() };
            for space in [ColorSpace::Hsv, ColorSpace::Rgb, ColorSpace::Lab] {
                let options = TrainOptions { space, ..TrainOptions::default() };
                let model = train_segment(&half(0), &options, &Silent).unwrap().trained.model;
                let scores: ConfusionMatrix = half(1)
                    .iter()
                    .map(|(photo, mask)| {
                        ConfusionMatrix::new(segment(*photo, &model, &Silent).unwrap().mask.view(), *mask).unwrap()
                    })
                    .sum();
                // The bar for generated scenes.
                assert!(scores.f1() >= 0.97, "seed {seed}, {space:?}: {} {scores:?}", scores.f1());
            }
        }
    }

    #[test]
    fn an_empty_photograph_has_an_empty_mask() {
        let photo = RgbU8::from_fn(8, 8, |x, _| if x < 4 { [200, 90, 20] } else { [40, 90, 200] });
        let mask = Mask::from_fn(8, 8, |x, _| [x < 4]);
        let model =
            train_segment(&[(photo.view(), mask.view())], &TrainOptions::default(), &Silent).unwrap().trained.model;
        let result = segment(RgbU8::new(0, 0, [0; 3]).view(), &model, &Silent).unwrap();
        assert!(result.mask.is_empty() && result.fraction == 0.0);
        let one = segment(RgbU8::new(1, 1, [200, 90, 20]).view(), &model, &Silent).unwrap();
        assert_eq!((one.mask.at(0, 0), one.fraction), ([true], 1.0));
    }
}
