//! Panoramas of real photographs: how many are used, how well the matches agree, how far what two photographs show lies apart at their seams, and
//! which way is up.

use super::Check;
use anyhow::{Context, Result};
use cv_core::{ImageView, Point2, RgbU8, luma_f32};
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, PanoramaResult, Silent, panorama};
use std::path::Path;

/// Set, photographs.
const SETS: [(&str, usize); 3] = [("weir", 3), ("umd-set1", 3), ("umd-set3", 8)];

/// Half the side of the patches compared across a seam.
const HALF: i32 = 12;
/// Farthest displacement looked for.
const REACH: i32 = 24;

pub(super) fn run(data: &Path) -> Result<Vec<Check>> {
    let mut checks = Vec::new();
    for (set, count) in SETS {
        let folder = data.join("panorama").join(set);
        let mut paths: Vec<_> = std::fs::read_dir(&folder)
            .with_context(|| format!("{}", folder.display()))?
            .map(|entry| Ok(entry?.path()))
            .collect::<Result<_>>()?;
        paths.sort();
        let mut found: Vec<Figures> = Vec::new();
        // The order of the names must not matter.
        for turn in [0, count / 2] {
            let mut order = paths.clone();
            order.rotate_left(turn);
            found.push(join(set, &order)?);
        }
        let worst = |figure: fn(&Figures) -> f64, worse: fn(f64, f64) -> f64| {
            found.iter().map(figure).reduce(worse).unwrap_or(f64::NAN)
        };
        checks.push(Check::at_least(format!("{set}: photographs used"), worst(|f| f.used, f64::min), count as f64));
        checks.push(Check::at_least(
            format!("{set}: places on seams with texture to measure"),
            worst(|f| f.places, f64::min),
            20.0,
        ));
        checks.push(Check::at_most(
            format!("{set}: 95 % displacement at seams, px"),
            worst(|f| f.displacement, f64::max),
            2.0,
        ));
        checks.push(Check::at_most(
            format!("{set}: largest roll of a photograph, degrees"),
            worst(|f| f.roll, f64::max),
            10.0,
        ));
        checks.push(Check::at_least(
            format!("{set}: share of its bounding box covered"),
            worst(|f| f.covered, f64::min),
            0.6,
        ));
    }
    Ok(checks)
}

/// What is measured of one panorama.
struct Figures {
    used: f64,
    places: f64,
    displacement: f64,
    roll: f64,
    covered: f64,
}

fn join(set: &str, paths: &[std::path::PathBuf]) -> Result<Figures> {
    let photos: Vec<(RgbU8, Option<f64>)> = paths
        .iter()
        .map(|p| {
            let picture = cv_io::read_image(p)?;
            let focal = picture.exif.focal.as_ref().map(|f| f.pixels);
            Ok((picture.into_rgb8(), focal))
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
        "{set}: {w}x{h} {}, {} places on seams, displacement median {:.2} px, 95 % {:.2} px; {}",
        result.canvas.projection,
        seams.len(),
        quantile(0.5),
        quantile(0.95),
        times.join(", ")
    );
    Ok(Figures {
        used: result.images.iter().filter(|i| i.used).count() as f64,
        places: seams.len() as f64,
        displacement: quantile(0.95),
        roll: largest_roll(&result),
        covered: covered(&result),
    })
}

/// The angle between the canvas's down and each photograph's own, where its middle is drawn.
fn largest_roll(result: &PanoramaResult) -> f64 {
    let angles = result.alignment.used().filter_map(|(_, view)| {
        let (w, h) = (view.camera.width as f64, view.camera.height as f64);
        let at = |y: f64| result.canvas.pixel(&view.ray(Point2::new(0.5 * w, y))?);
        let down = at(0.6 * h)? - at(0.4 * h)?;
        Some(down.x.atan2(down.y).abs().to_degrees())
    });
    angles.fold(0.0, f64::max)
}

/// A bow-tied panorama leaves most of its canvas empty.
fn covered(result: &PanoramaResult) -> f64 {
    result.mask.as_slice().iter().filter(|m| **m).count() as f64 / result.mask.as_slice().len() as f64
}

/// How far apart the two photographs of a seam show the same thing, at places along all seams that have texture in both directions, ascending.
fn seam_displacements(photos: &[ImageView<'_, u8, 3>], result: &PanoramaResult) -> Vec<f64> {
    let labels = &result.labels;
    let (w, h) = labels.size();
    let mut displacements = Vec::new();
    // A place every 12 pixels in both directions, where one lies on a seam.
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

/// The displacement between photographs `a` and `b` around a canvas pixel, by normalized cross-correlation; `None` where there is too little texture, or they
/// show different things.
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
    let (first, second) = (patch(a, HALF)?, patch(b, HALF + REACH)?);
    let (side, wide) = ((2 * HALF + 1) as usize, (2 * (HALF + REACH) + 1) as usize);
    // Corner strength: the lesser eigenvalue of the structure tensor, as a gradient in gray levels per pixel.
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
    let least = (0.5 * (xx + yy) - (0.25 * (xx - yy).powi(2) + xy * xy).sqrt()) / n;
    if least < 16.0 {
        return None;
    }
    let reach = REACH as usize;
    let mut scores = vec![f64::NEG_INFINITY; (2 * reach + 1).pow(2)];
    for (k, score) in scores.iter_mut().enumerate() {
        let (dy, dx) = (k / (2 * reach + 1), k % (2 * reach + 1));
        let at = |r: usize, c: usize| second[(r + dy) * wide + c + dx];
        *score = correlation(&first, side, at);
    }
    let (best, score) = scores.iter().copied().enumerate().max_by(|p, q| p.1.total_cmp(&q.1))?;
    let place = |k: usize| ((k % (2 * reach + 1)) as f64 - reach as f64, (k / (2 * reach + 1)) as f64 - reach as f64);
    // Below this the two show different things: water, leaves, people. At the end of the reach there is no peak.
    let (dx, dy) = place(best);
    if score < 0.85 || dx.abs().max(dy.abs()) >= f64::from(REACH) {
        return None;
    }
    // Along an edge many places are as alike but for noise: the nearest of them is what is known of the displacement.
    let near = (0..scores.len()).filter(|&k| scores[k] >= score - 0.02).map(place).map(|(dx, dy)| dx.hypot(dy));
    near.min_by(f64::total_cmp)
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
