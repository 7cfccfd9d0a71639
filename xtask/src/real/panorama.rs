//! Panoramas of real photographs: number of photographs used, displacement at seams, roll, and coverage of the canvas.

use super::Check;
use anyhow::{Context, Result};
use cv_core::{ImageView, Point2, RgbU8, luma_f32};
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, PanoramaResult, Silent, panorama};
use std::path::Path;

/// Name and number of photographs of each set.
const SETS: [(&str, usize); 3] = [("weir", 3), ("umd-set1", 3), ("umd-set3", 8)];

/// Radius in pixels of the patches compared across a seam.
const PATCH_RADIUS: i32 = 12;
/// Largest displacement searched, in pixels.
const SEARCH_RADIUS: i32 = 24;

pub(super) fn run(data: &Path) -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    for (set, count) in SETS {
        let folder = data.join("panorama").join(set);
        let mut paths: Vec<_> = std::fs::read_dir(&folder)
            .with_context(|| format!("{}", folder.display()))?
            .map(|entry| Ok(entry?.path()))
            .collect::<Result<_>>()?;
        paths.sort();
        let mut figures: Vec<Figures> = Vec::new();
        // The result must not depend on the order of the files.
        for shift in [0, count / 2] {
            let mut order = paths.clone();
            order.rotate_left(shift);
            figures.push(stitch(set, &order)?);
        }
        let worst = |figure: fn(&Figures) -> f64, worse: fn(f64, f64) -> f64| {
            figures.iter().map(figure).reduce(worse).unwrap_or(f64::NAN)
        };
        checks.push(Check::at_least(format!("{set}: photographs used"), worst(|f| f.used, f64::min), count as f64));
        checks.push(Check::at_least(
            format!("{set}: textured positions on seams"),
            worst(|f| f.positions, f64::min),
            20.0,
        ));
        checks.push(Check::at_most(
            format!("{set}: displacement at seams, 95th percentile, px"),
            worst(|f| f.displacement, f64::max),
            2.0,
        ));
        checks.push(Check::at_most(
            format!("{set}: largest roll of a photograph, degrees"),
            worst(|f| f.roll, f64::max),
            10.0,
        ));
        checks.push(Check::at_least(
            format!("{set}: covered fraction of the canvas"),
            worst(|f| f.covered, f64::min),
            0.6,
        ));
    }
    Ok(checks)
}

/// Figures of one panorama.
struct Figures {
    used: f64,
    positions: f64,
    displacement: f64,
    roll: f64,
    covered: f64,
}

fn stitch(set: &str, paths: &[std::path::PathBuf]) -> Result<Figures> {
    let photos: Vec<(RgbU8, Option<f64>)> = paths
        .iter()
        .map(|p| {
            let file = cv_io::read_image(p)?;
            let focal = file.exif.focal.as_ref().map(|f| f.pixels);
            Ok((file.into_rgb8(), focal))
        })
        .collect::<Result<_>>()?;
    let inputs: Vec<PanoramaPhoto<'_>> = photos
        .iter()
        .map(|(image, focal)| PanoramaPhoto { focal: *focal, ..PanoramaPhoto::new(image.view()) })
        .collect();
    let result = panorama(&inputs, &PanoramaOptions::default(), &Silent)?;
    let seams = seam_displacements(&photos.iter().map(|(i, _)| i.view()).collect::<Vec<_>>(), &result);
    let quantile = |q: f64| {
        let i = ((seams.len() as f64 * q) as usize).min(seams.len().saturating_sub(1));
        seams.get(i).copied().unwrap_or(f64::NAN)
    };
    let (w, h) = result.image.size();
    let times: Vec<String> = result.stages.iter().map(|(s, t)| format!("{s} {:.0} ms", 1000.0 * t)).collect();
    println!(
        "{set}: {w}x{h} {}, {} positions on seams, displacement median {:.2} px, 95th percentile {:.2} px; {}",
        result.canvas.projection,
        seams.len(),
        quantile(0.5),
        quantile(0.95),
        times.join(", ")
    );
    Ok(Figures {
        used: result.images.iter().filter(|i| i.used).count() as f64,
        positions: seams.len() as f64,
        displacement: quantile(0.95),
        roll: largest_roll(&result),
        covered: covered_fraction(&result),
    })
}

/// Returns the largest angle in degrees between the vertical of the canvas and that of a photograph at its center.
fn largest_roll(result: &PanoramaResult) -> f64 {
    let angles = result.alignment.used().filter_map(|(_, view)| {
        let (w, h) = (view.camera.width as f64, view.camera.height as f64);
        let at = |y: f64| result.canvas.pixel(&view.ray(Point2::new(0.5 * w, y))?);
        let down = at(0.6 * h)? - at(0.4 * h)?;
        Some(down.x.atan2(down.y).abs().to_degrees())
    });
    angles.fold(0.0, f64::max)
}

/// Returns the covered fraction of the canvas, which is small for a panorama with a bow-tie shape.
fn covered_fraction(result: &PanoramaResult) -> f64 {
    result.mask.as_slice().iter().filter(|m| **m).count() as f64 / result.mask.as_slice().len() as f64
}

/// Measures the displacement between the two photographs of each seam at textured positions, in pixels, ascending.
fn seam_displacements(photos: &[ImageView<'_, u8, 3>], result: &PanoramaResult) -> Vec<f64> {
    let labels = &result.labels;
    let (w, h) = labels.size();
    let mut displacements = Vec::new();
    // Positions on seams in every 12th row and column.
    for y in (0..h).step_by(12) {
        for x in 1..w {
            let (a, b) = (labels.at(x - 1, y)[0], labels.at(x, y)[0]);
            if a != b && a != u16::MAX && b != u16::MAX {
                displacements.extend(displacement(photos, result, (a, b), (x as i32, y as i32)));
            }
        }
    }
    for x in (0..w).step_by(12) {
        for y in 1..h {
            let (a, b) = (labels.at(x, y - 1)[0], labels.at(x, y)[0]);
            if a != b && a != u16::MAX && b != u16::MAX {
                displacements.extend(displacement(photos, result, (a, b), (x as i32, y as i32)));
            }
        }
    }
    displacements.sort_by(f64::total_cmp);
    displacements
}

/// Measures the displacement between photographs `a` and `b` around a canvas pixel by normalized cross-correlation; `None` for low texture or
/// different content.
fn displacement(
    photos: &[ImageView<'_, u8, 3>],
    result: &PanoramaResult,
    (a, b): (u16, u16),
    (x, y): (i32, i32),
) -> Option<f64> {
    let patch = |photo: u16, half: i32| -> Option<Vec<f64>> {
        let image = photos[usize::from(photo)];
        let mut values = Vec::with_capacity((2 * half as usize + 1).pow(2));
        for dy in -half..=half {
            for dx in -half..=half {
                let p = result.map.source(usize::from(photo), Point2::new(f64::from(x + dx), f64::from(y + dy)))?;
                values.push(luma(image, p));
            }
        }
        Some(values)
    };
    let (first, second) = (patch(a, PATCH_RADIUS)?, patch(b, PATCH_RADIUS + SEARCH_RADIUS)?);
    let (side, wide) = ((2 * PATCH_RADIUS + 1) as usize, (2 * (PATCH_RADIUS + SEARCH_RADIUS) + 1) as usize);
    // Corner strength: the smaller eigenvalue of the structure tensor, in squared gray levels per pixel.
    let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
    for r in 1..side - 1 {
        for c in 1..side - 1 {
            let i = r * side + c;
            let (gx, gy) = (0.5 * (first[i + 1] - first[i - 1]), 0.5 * (first[i + side] - first[i - side]));
            xx += gx * gx;
            xy += gx * gy;
            yy += gy * gy;
        }
    }
    let n = ((side - 2) * (side - 2)) as f64;
    let smaller_eigenvalue = (0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()) / n;
    if smaller_eigenvalue < 16.0 {
        return None;
    }
    let radius = SEARCH_RADIUS as usize;
    let mut scores = vec![f64::NEG_INFINITY; (2 * radius + 1).pow(2)];
    for (k, score) in scores.iter_mut().enumerate() {
        let (dy, dx) = (k / (2 * radius + 1), k % (2 * radius + 1));
        let at = |r: usize, c: usize| second[(r + dy) * wide + c + dx];
        *score = correlation(&first, side, at);
    }
    let (best, score) = scores.iter().copied().enumerate().max_by(|p, q| p.1.total_cmp(&q.1))?;
    let displacement_at =
        |k: usize| ((k % (2 * radius + 1)) as f64 - radius as f64, (k / (2 * radius + 1)) as f64 - radius as f64);
    // A low score means different content (water, leaves, people). A maximum at the border of the search window is no peak.
    let (dx, dy) = displacement_at(best);
    if score < 0.85 || dx.abs().max(dy.abs()) >= f64::from(SEARCH_RADIUS) {
        return None;
    }
    // Aperture problem: along an edge many displacements score alike; the shortest of them is a lower bound.
    let lengths =
        (0..scores.len()).filter(|&k| scores[k] >= score - 0.02).map(displacement_at).map(|(dx, dy)| dx.hypot(dy));
    lengths.min_by(f64::total_cmp)
}

fn correlation(first: &[f64], side: usize, second: impl Fn(usize, usize) -> f64) -> f64 {
    let n = (side * side) as f64;
    let (mut a, mut b, mut aa, mut bb, mut ab) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for r in 0..side {
        for c in 0..side {
            let (p, q) = (first[r * side + c], second(r, c));
            a += p;
            b += q;
            aa += p * p;
            bb += q * q;
            ab += p * q;
        }
    }
    (ab - a * b / n) / ((aa - a * a / n) * (bb - b * b / n)).max(1e-9).sqrt()
}

fn luma(image: ImageView<'_, u8, 3>, p: Point2<f64>) -> f64 {
    let (x, y) = (p.x as usize, p.y as usize);
    let (fx, fy) = (p.x - x as f64, p.y - y as f64);
    let at = |x: usize, y: usize| {
        f64::from(luma_f32(image.at(x.min(image.width() - 1), y.min(image.height() - 1)).map(f32::from)))
    };
    (at(x, y) * (1.0 - fx) + at(x + 1, y) * fx) * (1.0 - fy) + (at(x, y + 1) * (1.0 - fx) + at(x + 1, y + 1) * fx) * fy
}
