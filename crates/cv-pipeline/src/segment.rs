//! Color segmentation of an object: training on images with masks, then segmentation of other images.

use crate::Progress;
use cv_core::{Cancelled, ImageView, Mask, StageClock};
use cv_segment::{ColorModel, DetectOptions, Detection, Labeled, SegmentError, TrainOptions, Trained, train};

/// Result of [`train_segment`].
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentTraining {
    /// The model and its scores on the training images.
    pub trained: Trained,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Result of [`segment`].
#[derive(Debug, Clone, PartialEq)]
pub struct SegmentResult {
    /// The object mask.
    pub mask: Mask,
    /// Fraction of marked pixels, 0 to 1; 0 for an empty image.
    pub fraction: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Result of [`detect`].
#[derive(Debug, Clone, PartialEq)]
pub struct DetectResult {
    /// Mask of the detected objects.
    pub mask: Mask,
    /// Fraction of marked pixels, 0 to 1; 0 for an empty image.
    pub fraction: f64,
    /// All regions of the object's color, detected or not, by descending score.
    pub objects: Vec<Detection>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Trains a color model of an object from images with masks.
///
/// # Errors
/// [`SegmentError`]: no training data, masks of other sizes or without objects, options out of range.
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

/// Segments an image.
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

/// Detects objects: measures the regions of [`segment`] and scores each by its agreement with the training objects in
/// color and shape. Regions with a low score are not marked.
///
/// # Errors
/// [`SegmentError`]: an option out of range, or the job was stopped.
pub fn detect(
    photo: ImageView<'_, u8, 3>,
    model: &ColorModel,
    options: &DetectOptions,
    progress: &dyn Progress,
) -> Result<DetectResult, SegmentError> {
    options.validate()?;
    let mut clock = StageClock::new();
    let score = model.score(photo, progress)?;
    let raw = model.binarize(score.view());
    clock.lap("classify");
    let cleaned = model.cleanup().apply(raw.view(), progress)?;
    clock.lap("clean up");
    let detections = model.detect(cleaned.view(), score.view(), options, progress)?;
    clock.lap("detect");
    let marked: usize = detections.objects.iter().filter(|o| o.found).map(|o| o.region.area).sum();
    let fraction = marked as f64 / detections.mask.as_slice().len().max(1) as f64;
    Ok(DetectResult { mask: detections.mask, fraction, objects: detections.objects, stages: clock.into_stages() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Silent;
    use cv_core::{Camera, RgbU8};
    use cv_segment::{ColorSpace, ConfusionMatrix};
    use cv_synth::{RenderOptions, ball_photos};

    #[test]
    fn a_ball_is_segmented_in_images_outside_the_training_set() {
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
                // The requirement for generated scenes.
                assert!(scores.f1() >= 0.97, "seed {seed}, {space:?}: {} {scores:?}", scores.f1());
            }
        }
    }

    #[test]
    fn an_object_of_the_same_color_and_another_shape_is_not_detected() {
        let camera = Camera::from_focal(240, 180, 220.0);
        let photos = ball_photos(5, 10, &camera, &RenderOptions::default()).unwrap();
        let labeled: Vec<Labeled<'_>> = photos.iter().map(|p| (p.view.image.view(), p.mask.view())).collect();
        let half = |odd: usize| -> Vec<Labeled<'_>> { labeled.iter().copied().skip(odd).step_by(2).collect() };
        let model = train_segment(&half(0), &TrainOptions::default(), &Silent).unwrap().trained.model;
        for (photo, mask) in half(1) {
            let ball = detect(photo, &model, &DetectOptions::default(), &Silent).unwrap();
            let best = ball.objects[0];
            println!("ball {:?} {:?}", best.score, best.region);
            assert!(best.found, "{best:?}");
            assert_eq!(ball.mask, segment(photo, &model, &Silent).unwrap().mask);
            // The centroid of the true mask.
            let (mut sum, mut count) = ([0.0; 2], 0.0);
            for y in 0..mask.height() {
                for x in (0..mask.width()).filter(|&x| mask.row(y)[x]) {
                    sum = [sum[0] + x as f64, sum[1] + y as f64];
                    count += 1.0;
                }
            }
            let center = best.region.center;
            // A missing border of one pixel on one side moves the centroid by less than a pixel.
            assert!((center.x - sum[0] / count).hypot(center.y - sum[1] / count) < 1.0, "{best:?}");
            assert!((best.region.area as f64 / count - 1.0).abs() < 0.15, "{best:?}");
            // A bar with the ball's pixels on gray: the same colors, another shape.
            let colors: Vec<[u8; 3]> = (0..mask.height())
                .flat_map(|y| (0..mask.width()).map(move |x| (x, y)))
                .filter(|&(x, y)| mask.row(y)[x])
                .map(|(x, y)| photo.row(y).as_chunks::<3>().0[x])
                .collect();
            let bar_height = ((colors.len() as f64 / 5.0).sqrt() as usize).max(6);
            let bar_width = 5 * bar_height;
            let bar = RgbU8::from_fn(bar_width + 40, bar_height + 40, |x, y| {
                let inside = (20..20 + bar_width).contains(&x) && (20..20 + bar_height).contains(&y);
                if inside { colors[((y - 20) * bar_width + x - 20) % colors.len()] } else { [120, 118, 116] }
            });
            assert!(segment(bar.view(), &model, &Silent).unwrap().fraction > 0.0);
            let result = detect(bar.view(), &model, &DetectOptions::default(), &Silent).unwrap();
            println!("bar {:?} {:?}", result.objects[0].score, result.objects[0].region);
            assert!(!result.objects.is_empty() && result.objects.iter().all(|o| !o.found), "{:?}", result.objects);
            assert!(result.fraction == 0.0 && result.mask.as_slice().iter().all(|&m| !m));
            // With a minimum score of zero, all regions are detected.
            let all = detect(bar.view(), &model, &DetectOptions { min_score: 0.0 }, &Silent).unwrap();
            assert_eq!(all.mask, segment(bar.view(), &model, &Silent).unwrap().mask);
        }
        let wrong = detect(labeled[0].0, &model, &DetectOptions { min_score: f64::NAN }, &Silent);
        assert!(matches!(wrong, Err(SegmentError::Option(e)) if e.name == "min_score"));
    }

    #[test]
    fn an_empty_image_has_an_empty_mask() {
        let photo = RgbU8::from_fn(8, 8, |x, _| if x < 4 { [200, 90, 20] } else { [40, 90, 200] });
        let mask = Mask::from_fn(8, 8, |x, _| [x < 4]);
        let model =
            train_segment(&[(photo.view(), mask.view())], &TrainOptions::default(), &Silent).unwrap().trained.model;
        let result = segment(RgbU8::new(0, 0, [0; 3]).view(), &model, &Silent).unwrap();
        assert!(result.mask.is_empty() && result.fraction == 0.0);
        let none = detect(RgbU8::new(0, 0, [0; 3]).view(), &model, &DetectOptions::default(), &Silent).unwrap();
        assert!(none.mask.is_empty() && none.fraction == 0.0 && none.objects.is_empty());
        let one = segment(RgbU8::new(1, 1, [200, 90, 20]).view(), &model, &Silent).unwrap();
        assert_eq!((one.mask.at(0, 0), one.fraction), ([true], 1.0));
    }
}
