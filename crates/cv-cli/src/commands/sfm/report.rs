//! The report of `cv sfm`.

use super::outcome::{Registration, reprojection_rms, reprojections};
use super::photographs::Photograph;
use super::places::Frame;
use crate::frame::Failure;
use crate::pictures::{Width, cloud, picture};
use cv_core::SparseModel;
use cv_report::{Plot, PointScene, Report, draw_view_graph};

/// Rows of the table of weakest connections.
const WEAK_CONNECTIONS: usize = 8;
/// Side of the image of the view graph in pixels.
const GRAPH_SIZE: usize = 1000;

/// Builds the page: each model, the outcome of each photograph, the view graph and the residuals.
pub(super) fn report(
    all: &[Photograph],
    registered: &[Registration],
    models: &[SparseModel],
    frames: &[Frame],
    stages: &[(&'static str, f64)],
) -> Result<Report, Failure> {
    let used = registered.iter().filter(|outcome| outcome.is_ok()).count();
    let mut page = Report::new("Structure from motion");
    page.subtitle(&format!("{} photographs", all.len()))
        .headline("registered photographs", &format!("{used} of {}", all.len()));
    if models.len() > 1 {
        page.headline("models", &models.len().to_string());
    }
    if let Some(main) = models.first() {
        let observations: usize = main.points.values().map(|p| p.track.len()).sum();
        page.headline("points", &main.points.len().to_string())
            .headline("mean track length", &format!("{:.1}", observations as f64 / main.points.len() as f64))
            .headline("reprojection error", &format!("{:.2} px RMS", reprojection_rms(main)));
    }
    let left_out: Vec<[&str; 2]> = all
        .iter()
        .zip(registered)
        .filter_map(|(one, outcome)| Some([one.name.as_str(), outcome.as_ref().err()?.as_str()]))
        .collect();
    if !left_out.is_empty() {
        page.section("Left out").table("Unregistered photographs.", &["photograph", "reason"], &left_out);
    }
    for (m, model) in models.iter().enumerate() {
        let names: Vec<&str> = all
            .iter()
            .zip(registered)
            .filter(|(_, outcome)| **outcome == Ok(m))
            .map(|(one, _)| one.name.as_str())
            .collect();
        let title = if m == 0 { "The model".to_owned() } else { format!("Model {m}") };
        page.section(&title).paragraph(&format!(
            "{} photographs and {} points, {}. The cameras are drawn as pyramids, from the first (blue) to the last (red).",
            names.len(),
            model.points.len(),
            frames.get(m).map_or("", |frame| &frame.text),
        ));
        cloud(&mut page, &PointScene::of_model(model), "The points and the cameras.")?;
        cameras(&mut page, model);
        page.registered_photographs(model, &names);
        let graph = draw_view_graph(model, GRAPH_SIZE);
        let caption =
            "Number of common points of each pair of photographs. Dark squares off the diagonal are loop closures.";
        let width = if names.len() > 20 { Width::Full } else { Width::Half };
        page.figure(picture(&graph, width, caption)?).weakest_connections(model, WEAK_CONNECTIONS);
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
            let coefficients: Vec<String> = lens.parameters().iter().map(|v| format!("{v:.4}")).collect();
            let lens = if lens.is_none() {
                "none".to_owned()
            } else {
                format!("{} ({})", lens.model().info().name, coefficients.join(", "))
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
        "The refined intrinsics.",
        &["size (px)", "photographs", "focal length (px)", "principal point (px)", "distortion"],
        &rows,
    );
}

fn quality(page: &mut Report, model: &SparseModel) {
    let errors: Vec<f64> = reprojections(model).collect();
    let lengths: Vec<f64> = model.points.values().map(|p| p.track.len() as f64).collect();
    let errors = Plot::new("Reprojection error", "px", "observations").histogram("", &errors, 30);
    let longest = lengths.iter().fold(2.0, |a: f64, b| a.max(*b));
    let lengths = Plot::new("Track length", "photographs", "points").histogram_within(
        "",
        &lengths,
        (longest as usize - 1).min(30),
        (1.5, longest + 0.5),
    );
    page.plots(&[
        (&errors, "Distance of each observation from the projection of its point."),
        (&lengths, "Long tracks constrain the model best."),
    ]);
}
