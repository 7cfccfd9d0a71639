//! Writes a report with a plot and a point cloud as one self-contained HTML file.
use cv_core::{GrayF32, PointCloud};
use cv_report::{MapStyle, Note, Plot, PointScene, Report, Viewpoint, draw_map, render_points};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let height = |x: f32, y: f32| (0.1 * x).sin() * (0.13 * y).cos();
    let map = GrayF32::from_fn(80, 60, |x, y| [height(x as f32, y as f32)]);
    let points = (0..80 * 60).map(|i| [(i % 80) as f32, (i / 80) as f32, 60.0 + 5.0 * map.as_slice()[i]]).collect();
    let scene = PointScene::new(&PointCloud::from_positions(points));

    let mut page = Report::new("A surface");
    page.headline("points", "4800").note(Note::Good, "Every pixel has a height.");
    let heights: Vec<f64> = map.as_slice().iter().map(|v| f64::from(*v)).collect();
    page.section("Heights")
        .plot(&Plot::new("Heights", "height", "pixels").histogram("", &heights, 20), "Distribution of heights.");
    page.section("In space").points(&scene, None, "Drag to rotate.");
    std::fs::write(std::env::temp_dir().join("cv-report-example.html"), page.to_html())?;

    let (colors, still) = (draw_map(map.view(), &MapStyle::default()), render_points(&scene, Viewpoint::Top, 320, 240));
    println!("a map of {:?} pixels, a view from above of {:?}", colors.size(), still.size());
    Ok(())
}
