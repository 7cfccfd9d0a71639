//! The report of `cv sfm`.

use super::outcome::{Fate, reprojection_rms, reprojections};
use super::photographs::Photograph;
use super::places::Frame;
use crate::frame::Failure;
use crate::pictures::{Width, cloud, picture};
use cv_core::SparseModel;
use cv_report::{Plot, PointScene, Report, draw_view_graph};

/// Rows of the table of thin places.
const THIN: usize = 8;
/// Side of the picture of the view graph in pixels.
const GRAPH: usize = 1000;

/// The page: each model, what became of each photograph, how the photographs hang together, and how well it fits.
pub(super) fn report(
    all: &[Photograph],
    fates: &[Fate],
    models: &[SparseModel],
    frames: &[Frame],
    stages: &[(&'static str, f64)],
) -> Result<Report, Failure> {
    let used = fates.iter().filter(|fate| fate.is_ok()).count();
    let mut page = Report::new("Structure from motion");
    page.subtitle(&format!("{} photographs", all.len()))
        .headline("photographs in a model", &format!("{used} of {}", all.len()));
    if models.len() > 1 {
        page.headline("models", &models.len().to_string());
    }
    if let Some(main) = models.first() {
        let observations: usize = main.points.values().map(|p| p.track.len()).sum();
        page.headline("points", &main.points.len().to_string())
            .headline("seen", &format!("{:.1} times", observations as f64 / main.points.len() as f64))
            .headline("reprojection", &format!("{:.2} px RMS", reprojection_rms(main)));
    }
    let left_out: Vec<[&str; 2]> = all
        .iter()
        .zip(fates)
        .filter_map(|(one, fate)| Some([one.name.as_str(), fate.as_ref().err()?.as_str()]))
        .collect();
    if !left_out.is_empty() {
        page.section("Left out").table("Photographs that are in no model.", &["photograph", "why"], &left_out);
    }
    for (m, model) in models.iter().enumerate() {
        let names: Vec<&str> =
            all.iter().zip(fates).filter(|(_, fate)| **fate == Ok(m)).map(|(one, _)| one.name.as_str()).collect();
        let title = if m == 0 { "The model".to_owned() } else { format!("Model {m}") };
        page.section(&title).paragraph(&format!(
            "{} photographs and {} points, {}. The cameras are drawn as pyramids, from the first, blue, to the last, red.",
            names.len(),
            model.points.len(),
            frames.get(m).map_or("", |frame| &frame.text),
        ));
        cloud(&mut page, &PointScene::of_model(model), "The points and the cameras.")?;
        cameras(&mut page, model);
        page.registered_photographs(model, &names);
        let graph = draw_view_graph(model, GRAPH);
        let caption = "Which photographs see the same points. Dark squares away from the diagonal are walks that come back to where they were.";
        let width = if names.len() > 20 { Width::Full } else { Width::Half };
        page.figure(picture(&graph, width, caption)?).weakest_connections(model, THIN);
        quality(&mut page, model);
    }
    page.section("Time").times(stages);
    Ok(page)
}

fn cameras(page: &mut Report, model: &SparseModel) {
    let rows: Vec<[String; 5]> = model
        .cameras
        .iter()
        .map(|(id, camera)| {
            let count = model.images.values().filter(|image| image.camera == *id).count();
            let lens = camera.distortion.simplified();
            let numbers: Vec<String> = lens.parameters().iter().map(|v| format!("{v:.4}")).collect();
            let lens = if lens.is_none() {
                "none".to_owned()
            } else {
                format!("{} ({})", lens.model().info().name, numbers.join(", "))
            };
            let focal = if camera.fx == camera.fy {
                format!("{:.1}", camera.fx)
            } else {
                format!("{:.1}, {:.1}", camera.fx, camera.fy)
            };
            [
                format!("{}×{}", camera.width, camera.height),
                count.to_string(),
                focal,
                format!("{:.1}, {:.1}", camera.cx, camera.cy),
                lens,
            ]
        })
        .collect();
    page.table(
        "The cameras, as refined.",
        &["size (px)", "photographs", "focal length (px)", "principal point (px)", "distortion"],
        &rows,
    );
}

fn quality(page: &mut Report, model: &SparseModel) {
    let errors: Vec<f64> = reprojections(model).collect();
    let lengths: Vec<f64> = model.points.values().map(|p| p.track.len() as f64).collect();
    let errors = Plot::new("Reprojection error", "px", "observations").histogram("", &errors, 30);
    let longest = lengths.iter().fold(2.0, |a: f64, b| a.max(*b));
    let lengths = Plot::new("Photographs that see a point", "photographs", "points").histogram_within(
        "",
        &lengths,
        (longest as usize - 1).min(30),
        (1.5, longest + 0.5),
    );
    page.plots(&[
        (&errors, "How far the points are from where they were seen."),
        (&lengths, "Points that many photographs see hold the model together."),
    ]);
}
