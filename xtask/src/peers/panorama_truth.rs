//! Accuracy of a panorama of generated photographs against ground truth: drift, PSNR, steps at seams.

use anyhow::Result;
use cv_core::{Camera, Distortion, ImageView, Matrix3, Point2, RgbU8, Vector3};
use cv_pipeline::panorama_types::NO_PHOTO;
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, PanoramaResult, Silent, panorama};
use cv_synth::{Vista, VistaOptions, VistaPhoto, vista_photos, vista_response};

/// A generated set: the spread of its exposures in EV and the smallest PSNR in dB required of its panorama.
pub(super) struct Generated {
    spread: f32,
    min_psnr: f64,
}

/// The sets by name.
pub(super) const SETS: [(&str, Generated); 2] = [
    ("8 views, ±1 EV", Generated { spread: 1.0, min_psnr: 36.0 }),
    ("8 views, ±2 EV", Generated { spread: 2.0, min_psnr: 34.0 }),
];

/// Measured figures; the worst over the seeds.
#[derive(Debug, Clone, Copy)]
pub(super) struct Truth {
    pub(super) photographs: f64,
    pub(super) used: f64,
    /// Median and 95th percentile of the blocks' displacements, in pixels.
    pub(super) drift: (f64, f64),
    pub(super) psnr: f64,
    pub(super) min_psnr: f64,
    /// 95th percentile of the steps at seams, in gray levels.
    pub(super) step: f64,
    /// Share of the pixels unclipped in some photograph that are clipped or flat in the result.
    pub(super) lost: f64,
}

const SEEDS: [u64; 3] = [1, 2, 3];
const CONTRAST: f32 = 0.4;
/// Samples per pixel along each axis, in the photographs and in the truth: the pixels of a camera integrate over their area. At 2 instead of 4, aliasing at hard edges limits even an exact
/// result to 35 dB.
const SAMPLES: usize = 4;

pub(super) fn measure(set: &Generated) -> Result<Truth> {
    let mut worst: Option<Truth> = None;
    for seed in SEEDS {
        let camera = Camera { distortion: Distortion::simple_radial(-0.04), ..Camera::from_focal(960, 720, 900.0) };
        let vista = Vista::new(seed, 220.0);
        let options = VistaOptions {
            exposure: set.spread,
            white_balance: 0.04,
            contrast: CONTRAST,
            samples: SAMPLES,
            ..VistaOptions::default()
        };
        let photos = vista_photos(&vista, seed, &camera, &options)?;
        let inputs: Vec<PanoramaPhoto<'_>> = photos.iter().map(|p| PanoramaPhoto::new(p.image.view())).collect();
        let result = panorama(&inputs, &PanoramaOptions::default(), &Silent)?;
        let drift = drift(&photos, &result);
        let used = result.images.iter().filter(|image| image.used).count() as f64;
        let steps = seam_steps(&photos, &result);
        let step = steps.get(steps.len() * 95 / 100).copied().unwrap_or(f64::NAN);
        let psnr = psnr(&vista, &photos, &result);
        let images: Vec<ImageView<'_, u8, 3>> = photos.iter().map(|p| p.image.view()).collect();
        let lost = lost_share(&images, &result);
        println!(
            "  seed {seed}: used {used}, drift {:.2} {:.2}, PSNR {psnr:.1}, {} steps {step:.1}, lost {lost:.5}",
            drift.0,
            drift.1,
            steps.len()
        );
        let figures = Truth { photographs: photos.len() as f64, used, drift, psnr, min_psnr: set.min_psnr, step, lost };
        worst = Some(worst.map_or(figures, |w| Truth {
            used: w.used.min(used),
            drift: (w.drift.0.max(drift.0), w.drift.1.max(drift.1)),
            psnr: w.psnr.min(psnr),
            step: w.step.max(step),
            lost: w.lost.max(lost),
            ..figures
        }));
    }
    worst.ok_or_else(|| anyhow::anyhow!("no seeds"))
}

/// Returns the true world direction of a pixel of the panorama, from its source pixel in the photograph of its label.
pub(super) fn true_ray(photos: &[VistaPhoto], result: &PanoramaResult, x: f64, y: f64) -> Option<Vector3<f64>> {
    let label = usize::from(result.labels.at((x + 0.5) as usize, (y + 0.5) as usize)[0]);
    let source = result.map.source(label, Point2::new(x, y))?;
    let photo = photos.get(label)?;
    let n = photo.camera.normalize(source);
    Some((photo.from_world.inverse() * Vector3::new(n.x, n.y, 1.0)).normalize())
}

/// Computes median and 95th percentile of the displacements of 48 px blocks, in pixels, after alignment by the best rotation.
fn drift(photos: &[VistaPhoto], result: &PanoramaResult) -> (f64, f64) {
    let (w, h) = result.image.size();
    let mut pairs = Vec::new();
    for y in (24..h).step_by(48) {
        for x in (24..w).step_by(48) {
            if let Some(truth) = true_ray(photos, result, x as f64, y as f64) {
                pairs.push((result.canvas.ray(Point2::new(x as f64, y as f64)).normalize(), truth));
            }
        }
    }
    let covariance = pairs.iter().fold(Matrix3::zeros(), |sum, (ray, truth)| sum + truth * ray.transpose());
    let Ok(svd) = cv_numeric::svd3(&covariance) else { return (f64::NAN, f64::NAN) };
    let rotation = svd.nearest_rotation().into_inner();
    let mut displacements: Vec<f64> =
        pairs.iter().map(|(ray, truth)| (rotation * ray - truth).norm() * result.canvas.scale).collect();
    displacements.sort_by(f64::total_cmp);
    let quantile = |q: f64| displacements.get((displacements.len() as f64 * q) as usize).copied().unwrap_or(f64::NAN);
    (quantile(0.5), quantile(0.95))
}

/// Gray level above which the result may compress highlights.
const HIGHLIGHT_LEVEL: u8 = 190;

/// Computes the PSNR in gray levels of the camera response, after one gain per channel on the radiance, over pixels that are clipped in no photograph and below
/// [`HIGHLIGHT_LEVEL`] in the result.
fn psnr(vista: &Vista, photos: &[VistaPhoto], result: &PanoramaResult) -> f64 {
    let (w, h) = result.image.size();
    let mut samples = Vec::new();
    for y in (2..h).step_by(3) {
        for x in (2..w).step_by(3) {
            let (Some(ray), level) = (true_ray(photos, result, x as f64, y as f64), result.image.at(x, y)) else {
                continue;
            };
            let clipped = photos.iter().any(|p| {
                let point = p.from_world * ray;
                let pixel = p.camera.project(&point.into()).filter(|_| point.z > 0.0);
                pixel.is_some_and(|q| {
                    let inside = q.x >= 0.0
                        && q.y >= 0.0
                        && q.x < p.camera.width as f64 - 0.5
                        && q.y < p.camera.height as f64 - 0.5;
                    inside && p.image.at((q.x + 0.5) as usize, (q.y + 0.5) as usize).iter().any(|v| *v >= 254)
                })
            });
            if !clipped && level.iter().all(|v| *v < HIGHLIGHT_LEVEL) {
                // The mean over the pixel's area.
                let offset = |i: usize| (i as f64 + 0.5) / SAMPLES as f64 - 0.5;
                let rays: Vec<_> = (0..SAMPLES * SAMPLES)
                    .map(|i| true_ray(photos, result, x as f64 + offset(i % SAMPLES), y as f64 + offset(i / SAMPLES)))
                    .collect();
                let mut radiance = [0.0; 3];
                for ray in &rays {
                    let l = vista.radiance(&ray.unwrap_or_else(Vector3::z));
                    (0..3).for_each(|c| radiance[c] += l[c] / rays.len() as f32);
                }
                if rays.iter().all(Option::is_some) {
                    samples.push((radiance, level));
                }
            }
        }
    }
    let mean_squared_error = |c: usize, gain: f64| {
        let squared_error = |(radiance, level): &([f32; 3], [u8; 3])| {
            let expected = 255.0 * vista_response(radiance[c] * gain as f32, CONTRAST);
            f64::from(expected - f32::from(level[c])).powi(2)
        };
        samples.iter().map(squared_error).sum::<f64>() / samples.len().max(1) as f64
    };
    let squares = (0..3).map(|c| {
        let (mut low, mut high) = (-3.0_f64, 3.0_f64);
        for _ in 0..30 {
            let (a, b) = (low + (high - low) / 3.0, high - (high - low) / 3.0);
            if mean_squared_error(c, a.exp2()) < mean_squared_error(c, b.exp2()) { high = b } else { low = a }
        }
        mean_squared_error(c, low.exp2())
    });
    10.0 * (255.0 * 255.0 / (squares.sum::<f64>() / 3.0)).log10()
}

/// Side in pixels of the blocks whose means are compared across a seam.
const BLOCK_SIDE: usize = 32;

/// Computes the steps of the means of 32 px blocks across seams, in gray levels, after subtraction of the gradient on both sides; ascending. Only blocks of low variance
/// count, and none with clipped source pixels, whose radiance is unknown.
fn seam_steps(photos: &[VistaPhoto], result: &PanoramaResult) -> Vec<f64> {
    let (w, h) = result.labels.size();
    let block = |x: usize, y: usize, label: u16| -> Option<[f64; 3]> {
        let (mut sum, mut squares, mut n) = ([0.0; 3], [0.0; 3], 0.0);
        for (x, y) in (y..y + BLOCK_SIDE).step_by(2).flat_map(|y| (x..x + BLOCK_SIDE).step_by(2).map(move |x| (x, y))) {
            if result.labels.get(x, y)? != [label] {
                continue;
            }
            let source = result.map.source(usize::from(label), Point2::new(x as f64, y as f64))?;
            let source_level =
                photos.get(usize::from(label))?.image.get(source.x.round() as usize, source.y.round() as usize)?;
            if source_level.iter().any(|v| *v >= 250) {
                return None;
            }
            let p = result.image.at(x, y).map(f64::from);
            for c in 0..3 {
                sum[c] += p[c];
                squares[c] += p[c] * p[c];
            }
            n += 1.0;
        }
        let smooth = (0..3).all(|c| squares[c] / n - (sum[c] / n).powi(2) < 16.0);
        // More than half of the block must be on its side of the seam.
        (n > 0.5 * (BLOCK_SIDE * BLOCK_SIDE / 4) as f64 && smooth).then(|| sum.map(|s| s / n))
    };
    let mut steps = Vec::new();
    for y in (0..h.saturating_sub(BLOCK_SIDE)).step_by(BLOCK_SIDE / 2) {
        for x in 2 * BLOCK_SIDE..w.saturating_sub(2 * BLOCK_SIDE) {
            let (a, b) = (result.labels.at(x - 1, y + BLOCK_SIDE / 2)[0], result.labels.at(x, y + BLOCK_SIDE / 2)[0]);
            if a == b || a == u16::MAX || b == u16::MAX {
                continue;
            }
            let four = [(x - 2 * BLOCK_SIDE, a), (x - BLOCK_SIDE, a), (x, b), (x + BLOCK_SIDE, b)]
                .map(|(x, l)| block(x, y, l));
            if let [Some(m0), Some(m1), Some(m2), Some(m3)] = four {
                let step = |c: usize| ((m2[c] - m1[c]) - 0.5 * ((m1[c] - m0[c]) + (m3[c] - m2[c]))).abs();
                steps.push((step(0) + step(1) + step(2)) / 3.0);
            }
        }
    }
    steps.sort_by(f64::total_cmp);
    steps
}

/// Level from which a sample counts as clipped: in the photographs below white, since interpolation and noise lower it.
const CLIPPED: [u8; 2] = [250, 254];
/// Difference of levels in a neighborhood of a photograph that is more than noise.
const MIN_CONTRAST: u8 = 12;

/// Computes the share of the pixels unclipped in some photograph that are clipped in the result, or flat where that photograph is not; neighborhoods of 5 × 5 pixels.
pub(super) fn lost_share(photos: &[ImageView<'_, u8, 3>], result: &PanoramaResult) -> f64 {
    let (w, h) = result.image.size();
    let range = |image: ImageView<'_, u8, 3>, x: usize, y: usize| -> Option<([u8; 3], [u8; 3])> {
        let (width, height) = image.size();
        if x < 2 || y < 2 || x + 2 >= width || y + 2 >= height {
            return None;
        }
        let around = (y - 2..=y + 2).flat_map(|y| (x - 2..=x + 2).map(move |x| image.at(x, y)));
        Some(around.fold(([255; 3], [0; 3]), |(low, high), p| {
            (std::array::from_fn(|c| p[c].min(low[c])), std::array::from_fn(|c| p[c].max(high[c])))
        }))
    };
    let (mut seen, mut lost) = (0_usize, 0_usize);
    for (x, y) in (2..h - 2).step_by(2).flat_map(|y| (2..w - 2).step_by(2).map(move |x| (x, y))) {
        if result.labels.at(x, y) == [NO_PHOTO] {
            continue;
        }
        let ranges = photos.iter().enumerate().filter_map(|(i, photo)| {
            let source = result.map.source(i, Point2::new(x as f64, y as f64))?;
            let (low, high) = range(*photo, source.x.round() as usize, source.y.round() as usize)?;
            high.iter().all(|v| *v < CLIPPED[0]).then_some((low, high))
        });
        let contrasts: Vec<u8> =
            ranges.map(|(low, high)| (0..3).map(|c| high[c] - low[c]).max().unwrap_or(0)).collect();
        let Some((low, high)) = range(result.image.view(), x, y).filter(|_| !contrasts.is_empty()) else { continue };
        seen += 1;
        let is_clipped = result.image.at(x, y).iter().any(|v| *v >= CLIPPED[1]);
        lost += usize::from(is_clipped || low == high && contrasts.iter().all(|c| *c >= MIN_CONTRAST));
    }
    lost as f64 / seen.max(1) as f64
}

/// Renders our panorama of photographs and computes its [`lost_share`].
pub(super) fn panorama_with_lost_share(photos: &[RgbU8]) -> Result<(PanoramaResult, f64)> {
    let inputs: Vec<PanoramaPhoto<'_>> = photos.iter().map(|p| PanoramaPhoto::new(p.view())).collect();
    let result = panorama(&inputs, &PanoramaOptions::default(), &Silent)?;
    let lost = lost_share(&photos.iter().map(RgbU8::view).collect::<Vec<_>>(), &result);
    Ok((result, lost))
}
