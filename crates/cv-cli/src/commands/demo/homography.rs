//! The homography between two views of a wall.

use super::{Check, Demo, Part};
use crate::frame::Failure;
use cv_core::{ImageView, Matrix3, RgbU8, Vector3};
use cv_pipeline::{MatchingOptions, ModelKind, estimate, match_photos};
use cv_report::{MatchStyle, colors, draw_keypoints, draw_matches};
use cv_synth::{RenderOptions, homography_corner_error, homography_pair};

pub(super) fn run(demo: &Demo<'_>) -> Result<Part, Failure> {
    let camera = demo.camera();
    let pair = homography_pair(demo.seed, &camera, 0.3, &RenderOptions::default())?;
    let (a, b) = (&pair.a.image, &pair.b.image);
    let found = match match_photos(a.view(), b.view(), &MatchingOptions::default(), demo.context) {
        Ok(found) => found,
        Err(error) => return Ok(Part::failed("homography", &error)),
    };
    let mut options = ModelKind::Homography.options();
    if let Some(seed) = demo.context.seed {
        options.seed = seed;
    }
    let pairs = found.pairs();
    let model = match estimate(&pairs, ModelKind::Homography, &options, demo.context) {
        Ok(result) => result.robust,
        Err(error) => return Ok(Part::failed("homography", &error)),
    };
    let (width, height) = a.size();
    let error = homography_corner_error(&model.model, &pair.homography, width, height);
    let check = Check::at_most("homography", "mean error of the corners", error, 0.3, "px")
        .of(corner(&pair.homography, width, height), corner(&model.model, width, height));

    let mut inliers = vec![false; pairs.len()];
    model.inliers.iter().for_each(|&i| inliers[i] = true);
    let keypoints = &found.features[0].keypoints;
    let strongest = &keypoints[..keypoints.len().min(600)];
    let photos = vec![
        demo.figure("homography-a.png", a, "First photograph.")?,
        demo.figure("homography-b.png", b, "Second photograph.")?,
        demo.figure(
            "homography-features.png",
            &draw_keypoints(a.view(), strongest, colors::YELLOW),
            &format!("Features of the first: {} of {}.", strongest.len(), keypoints.len()),
        )?,
        demo.figure(
            "homography-warped.png",
            &checkerboard(a.view(), b.view(), &model.model),
            "Checkerboard of the first image and the warped second one: edges are continuous where the homography is correct.",
        )?,
    ];
    let matches =
        draw_matches(a.view(), b.view(), &pairs, Some(&inliers), &MatchStyle { limit: 160, ..MatchStyle::default() });
    let matches = demo.figure(
        "homography-matches.png",
        &matches,
        &format!(
            "{} of {} matches are inliers of the homography (green); outliers are red.",
            model.inliers.len(),
            inliers.len()
        ),
    )?;
    Ok(Part::new(vec![check], move |page| {
        page.section("Homography")
            .paragraph("Two photographs of one wall. Features are detected in both and matched by their descriptors; a robust estimator finds the homography and rejects outliers.")
            .figures(photos)
            .figure(matches);
    }))
}

/// Formats the mapped lower right corner, the one farthest from the origin.
fn corner(h: &Matrix3<f64>, width: usize, height: usize) -> String {
    let q = h * Vector3::new(width as f64 - 1.0, height as f64 - 1.0, 1.0);
    format!("corner at ({:.2}, {:.2})", q.x / q.z, q.y / q.z)
}

/// Interleaves the first image with the second one, warped by the homography, in a checkerboard of squares.
fn checkerboard(a: ImageView<'_, u8, 3>, b: ImageView<'_, u8, 3>, h: &Matrix3<f64>) -> RgbU8 {
    RgbU8::from_fn(a.width(), a.height(), |x, y| {
        if (x / 80 + y / 80) % 2 == 0 {
            return a.at(x, y);
        }
        let q = h * Vector3::new(x as f64, y as f64, 1.0);
        bilinear(b, q.x / q.z, q.y / q.z).unwrap_or([0; 3])
    })
}

fn bilinear(view: ImageView<'_, u8, 3>, x: f64, y: f64) -> Option<[u8; 3]> {
    if !(x >= 0.0 && y >= 0.0) {
        return None;
    }
    let (i, j) = (x as usize, y as usize);
    let (fx, fy) = (x.fract(), y.fract());
    let corner = |dx, dy| Some(view.get(i + dx, j + dy)?.map(f64::from));
    let (p, q, r, s) = (corner(0, 0)?, corner(1, 0)?, corner(0, 1)?, corner(1, 1)?);
    let mix = |c: usize| (1.0 - fy) * ((1.0 - fx) * p[c] + fx * q[c]) + fy * ((1.0 - fx) * r[c] + fx * s[c]);
    Some([0, 1, 2].map(|c| (mix(c) + 0.5) as u8))
}
