//! The report of `cv panorama`.

use crate::frame::Failure;
use crate::pictures::{Width, picture};
use crate::words;
use cv_core::{Correspondence, ImageView, Point2, RgbU8, Scaling};
use cv_pipeline::PanoramaResult;
use cv_report::{MatchStyle, Report, draw_matches, shrink_to_fit};
use std::path::PathBuf;

/// Maximum number of pairs whose matches are drawn.
const MAX_DRAWN_PAIRS: usize = 12;

/// Builds the page: the panorama, its seams, the outcome of each photograph and the matches of each overlap. `pictures` are the photographs and, last, the panorama, of any resolution, and `labels`
/// those of that panorama.
pub(super) fn report<T>(
    paths: &[PathBuf],
    pictures: &[ImageView<'_, u8, 3>],
    labels: ImageView<'_, u16, 1>,
    result: &PanoramaResult<T>,
) -> Result<Report, Failure> {
    let image = pictures[paths.len()];
    let name = |i: usize| paths[i].file_name().unwrap_or_default().to_string_lossy().into_owned();
    let used = result.images.iter().filter(|image| image.used).count();
    let (width, height) = result.size;
    let mut page = Report::new("Panorama");
    page.headline("photographs used", &format!("{used} of {}", paths.len()))
        .headline("size", &format!("{width}×{height}"))
        .headline("residual of matches (RMS)", &format!("{:.2} px", result.reprojection_rms_px));
    let caption = format!("{} projection; black where no photograph reaches.", result.canvas.projection);
    page.section("Panorama").figure(picture(&image.to_image(), Width::Full, &caption)?);
    let sources = RgbU8::from_fn(image.width(), image.height(), |x, y| {
        let label = labels.at(x, y)[0];
        if label == u16::MAX { [0; 3] } else { tint(image.at(x, y), label) }
    });
    let caption = "Source photograph of each pixel; seams are where the color changes.";
    page.figure(picture(&sources, Width::Full, caption)?);

    page.section("Photographs");
    let rows: Vec<Vec<String>> = result
        .images
        .iter()
        .enumerate()
        .map(|(i, image)| {
            let focal = image.focal.map_or_else(|| "–".to_owned(), |f| format!("{f:.0} px"));
            let outcome = image.reason.as_ref().map_or_else(|| "used".to_owned(), |r| words::left_out(r, paths));
            vec![name(i), outcome, image.features.to_string(), focal]
        })
        .collect();
    page.table("Outcome of each photograph.", &["file", "outcome", "features", "focal length"], &rows);

    page.section("Overlaps");
    let accepted = result.pairs.iter().filter(|pair| pair.rejected.is_none());
    for pair in accepted.take(MAX_DRAWN_PAIRS) {
        let (photo_a, photo_b) = (pictures[pair.a], pictures[pair.b]);
        let (a, b) = (shrink_to_fit(photo_a, 700), shrink_to_fit(photo_b, 700));
        let at = |p: Point2<f64>, photo: usize, small: &RgbU8| {
            Scaling::between(result.images[photo].size, small.size()).point(p)
        };
        let matches: Vec<Correspondence> = result
            .correspondences(pair)
            .iter()
            .map(|m| Correspondence { a: at(m.a, pair.a, &a), b: at(m.b, pair.b, &b) })
            .collect();
        let mut agree = vec![false; matches.len()];
        pair.inliers.iter().for_each(|&i| agree[i] = true);
        let drawn = draw_matches(a.view(), b.view(), &matches, Some(&agree), &MatchStyle::default());
        let good = pair.inliers.len();
        let caption =
            format!("{} and {}: {good} of {} matches are inliers (green).", name(pair.a), name(pair.b), matches.len());
        page.figure(picture(&drawn, Width::Full, &caption)?);
    }
    page.section("Time").times(&result.stages);
    Ok(page)
}

/// Tints a pixel with the hue of its photograph; consecutive labels have distant hues (golden ratio).
fn tint(pixel: [u8; 3], label: u16) -> [u8; 3] {
    const GOLDEN: f32 = 0.618_034;
    let hue = f32::from(label) * GOLDEN * std::f32::consts::TAU;
    std::array::from_fn(|c| {
        let wave = 0.5 + 0.5 * (hue - c as f32 * std::f32::consts::TAU / 3.0).cos();
        (0.5 * f32::from(pixel[c]) + 127.0 * wave) as u8
    })
}
