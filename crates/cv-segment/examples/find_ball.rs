//! Trains a color model of a ball on four images with masks, and segments it in two others.
use cv_core::{Camera, Silent};
use cv_segment::{ConfusionMatrix, TrainOptions, train};
use cv_synth::{RenderOptions, ball_photos};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let views = ball_photos(3, 6, &Camera::from_focal(160, 120, 150.0), &RenderOptions::default())?;
    let labeled: Vec<_> = views.iter().map(|p| (p.view.image.view(), p.mask.view())).collect();
    let (training, test) = labeled.split_at(4);

    let model = train(training, &TrainOptions::default(), &Silent)?.model;
    for (image, truth) in test {
        let mask = model.predict(*image, &Silent)?;
        let scores = ConfusionMatrix::new(mask.view(), *truth)?;
        println!("precision {:.3}, recall {:.3}, F1 {:.3}", scores.precision(), scores.recall(), scores.f1());
    }
    Ok(())
}
