//! Color segmentation of an orange ball, trained on half of the images.

use super::{Check, Demo, Part};
use crate::frame::Failure;
use cv_pipeline::{segment, train_segment};
use cv_report::overlay_comparison;
use cv_synth::{MaskScore, RenderOptions, ball_photos};

/// Number of images; every other one is a training image.
const PHOTOS: usize = 8;

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    let photos = ball_photos(demo.seed, PHOTOS, &demo.camera(), &RenderOptions::default())?;
    let labeled: Vec<_> = photos.iter().step_by(2).map(|p| (p.view.image.view(), p.mask.view())).collect();
    let model = match train_segment(&labeled, &Default::default(), demo.context) {
        Ok(training) => training.trained.model,
        Err(error) => return Ok(Part::failed("segment", &error)),
    };
    let mut score = MaskScore::default();
    let mut figures = Vec::new();
    for (i, photo) in photos.iter().enumerate() {
        cv_io::write_png(demo.out.join(format!("segment-{}.png", i + 1)), photo.view.image.view())?;
        cv_io::write_png(demo.out.join(format!("segment-{}_mask.png", i + 1)), photo.mask.view())?;
        if i % 2 == 0 {
            continue;
        }
        let found = segment(photo.view.image.view(), &model, demo.context)?.mask;
        let one = MaskScore::new(&found, &photo.mask).unwrap_or_default();
        score = score.plus(one);
        let caption = format!("The ball {:.2} m away: F1 {:.3}.", photo.distance, one.f1());
        let overlay = overlay_comparison(photo.view.image.view(), found.view(), photo.mask.view());
        figures.push(demo.figure(&format!("segment-{}-result.png", i + 1), &overlay, &caption)?);
    }
    let pixels = |n: usize| format!("{n} px of ball");
    let check = Check::at_least("segment", "F1 over all test pixels", score.f1(), 0.97, "")
        .of(pixels(score.true_positives + score.false_negatives), pixels(score.true_positives + score.false_positives));
    Ok(Part::new(vec![check], move |page| {
        page.section("Segmentation")
            .paragraph("A color model is trained on four images with masks and segments four others. Green: true positive, red: false positive, blue: false negative.")
            .figures(figures);
    }))
}
