//! A panorama of a room in which someone walks about.

use super::{Check, Demo, Part};
use crate::frame::Failure;
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, panorama};
use cv_report::side_by_side;
use cv_synth::{RenderOptions, alignment_error, panorama_views};

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    let camera = demo.camera();
    let walk = cv_synth::PanoramaSetOptions { walker: true, ..cv_synth::PanoramaSetOptions::default() };
    let set = panorama_views(demo.seed, &camera, &walk, &RenderOptions::default())?;
    let photos: Vec<PanoramaPhoto<'_>> = set.views.iter().map(|v| PanoramaPhoto::new(v.image.view())).collect();
    let result = match panorama(&photos, &PanoramaOptions::default(), demo.context) {
        Ok(result) => result,
        Err(error) => return Ok(Part::failed("panorama", &error)),
    };
    let n = set.views.len();
    let used = result.images.iter().filter(|i| i.used).count();
    // Over all overlapping pairs: the error of mapping pixels of one image to the other.
    let (mut sum, mut pairs) = (0.0, 0.0);
    for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))).filter(|(i, j)| i != j) {
        let map = |p| {
            let (from, to) = (result.alignment.views[i].as_ref().ok()?, result.alignment.views[j].as_ref().ok()?);
            to.project(&from.ray(p)?)
        };
        if let Some(error) = alignment_error(map, |p| set.transfer(i, j, p), camera.width, camera.height) {
            sum += error * error;
            pairs += 1.0;
        }
    }
    let focal = result.images.iter().find_map(|i| i.focal).unwrap_or(f64::NAN);
    let checks = vec![
        Check::at_least("panorama", "photographs used", used as f64 / n as f64, 1.0, "%")
            .of(format!("{n} photographs"), format!("{used} photographs")),
        Check::at_most("panorama", "RMS error of alignment", (sum / pairs).sqrt(), 0.5, "px")
            .of(format!("focal length {:.1} px", camera.fx), format!("{focal:.1} px")),
    ];

    let mut row = Vec::new();
    for (i, view) in set.views.iter().enumerate() {
        cv_io::write_png(demo.out.join(format!("panorama-{}.png", i + 1)), view.image.view())?;
        row.push(view.image.view());
    }
    let inputs = demo.figure(
        "panorama-photographs.png",
        &side_by_side(&row, 8),
        "The photographs, each with its own exposure.",
    )?;
    let joined = demo.figure(
        "panorama-result.png",
        &result.image,
        "The panorama. Seams run where the images agree, so that the moving person is shown completely or not at all.",
    )?;
    Ok(Part::new(checks, move |page| {
        page.section("Panorama")
            .paragraph("Handheld photographs from one place, rotating from left to right while somebody walks through. Their order, the focal length and the rotations are estimated from the images alone.")
            .figure(inputs)
            .figure(joined);
    }))
}
