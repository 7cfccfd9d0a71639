//! Color segmentation of an object: training on images with masks, segmentation of others, and scores.

use cv_core::Camera;
use cv_pipeline::segmentation::{ConfusionMatrix, Labeled, TrainOptions};
use cv_pipeline::{Silent, segment, train_segment};
use cv_synth::{RenderOptions, ball_photos};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // An orange ball at several distances.
    let photos = ball_photos(3, 6, &Camera::from_focal(240, 180, 220.0), &RenderOptions::default())?;
    let labeled: Vec<Labeled<'_>> = photos.iter().map(|p| (p.view.image.view(), p.mask.view())).collect();
    let (known, new) = labeled.split_at(4);

    let model = train_segment(known, &TrainOptions::default(), &Silent)?.trained.model;
    for (photo, truth) in new {
        let found = segment(*photo, &model, &Silent)?;
        let scores = ConfusionMatrix::new(found.mask.view(), *truth)?;
        println!("{:.1} % of the pixels, F1 {:.3}", 100.0 * found.fraction, scores.f1());
    }
    Ok(())
}
