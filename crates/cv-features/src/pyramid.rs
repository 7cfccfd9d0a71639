//! A Gaussian pyramid with several scales per octave, for multi-scale corners and patches.

use cv_core::{Cancelled, GrayF32, ImageView, Progress, Stage};
use cv_imgproc::{bilinear_at, gaussian_blur};
use cv_parallel::prelude::*;
use std::iter::successors;

/// Assumed blur σ of the input image, in pixels (Lowe).
const INPUT_SIGMA: f32 = 0.5;
/// σ of the first scale of an octave, in octave pixels (Brown, Szeliski & Winder).
pub(crate) const FIRST_SIGMA: f32 = 1.0;
/// Minimum shorter side of an octave in pixels.
const MIN_SIDE: usize = 16;

/// A scale.
pub(crate) struct Level {
    pub(crate) image: GrayF32,
    /// Size of a level pixel in input pixels, a power of two. Level pixel (x, y) is at `pixel · (x, y)`.
    pub(crate) pixel: f32,
    /// σ in level pixels: from [`FIRST_SIGMA`] to less than twice that.
    pub(crate) sigma: f32,
}

/// The scale space of an image, with `per_octave` levels per octave.
pub(crate) struct Pyramid {
    pub(crate) levels: Vec<Level>,
    pub(crate) per_octave: usize,
}

impl Pyramid {
    pub(crate) fn new(
        view: ImageView<'_, f32, 1>,
        per_octave: usize,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let sides = successors(Some(view.width().min(view.height())), |side| Some(side.div_ceil(2)));
        let octaves = 1 + sides.skip(1).take_while(|side| *side >= MIN_SIDE).count();
        let stage = Stage::new(progress, "pyramid", octaves * per_octave)?;
        let mut levels = Vec::new();
        let mut base = gaussian_blur(view, (FIRST_SIGMA * FIRST_SIGMA - INPUT_SIGMA * INPUT_SIGMA).sqrt());
        let mut pixel = 1.0;
        loop {
            let sigma = |i: usize| FIRST_SIGMA * 2f32.powf(i as f32 / per_octave as f32);
            let from_base = |i: usize| -> Result<GrayF32, Cancelled> {
                stage.add(1)?;
                Ok(gaussian_blur(base.view(), (sigma(i) * sigma(i) - FIRST_SIGMA * FIRST_SIGMA).sqrt()))
            };
            let next = half_resolution(&from_base(per_octave)?);
            let further: Vec<GrayF32> = (1..per_octave).map(from_base).collect::<Result<_, _>>()?;
            let images = std::iter::once(base).chain(further);
            levels.extend(images.enumerate().map(|(i, image)| Level { image, pixel, sigma: sigma(i) }));
            if next.width().min(next.height()) < MIN_SIDE {
                return Ok(Self { levels, per_octave });
            }
            base = next;
            pixel *= 2.0;
        }
    }

    /// Returns the level whose σ is nearest to `sigma` input pixels.
    pub(crate) fn nearest(&self, sigma: f32) -> &Level {
        let index = (self.per_octave as f32 * (sigma / FIRST_SIGMA).log2()).round().max(0.0) as usize;
        &self.levels[index.min(self.levels.len() - 1)]
    }
}

impl Level {
    /// Interpolates the intensity at a position in input pixels, with replicated borders.
    pub(crate) fn at(&self, x: f32, y: f32) -> f32 {
        let (w, h) = self.image.size();
        let cell_and_fraction = |v: f32, n: usize| {
            let v = (v / self.pixel).clamp(0.0, n as f32 - 1.0);
            let cell = (v as usize).min(n - 2);
            (cell, v - cell as f32)
        };
        let ((column, fx), (row, fy)) = (cell_and_fraction(x, w), cell_and_fraction(y, h));
        bilinear_at(self.image.view(), column, row, fx, fy)[0]
    }

    /// Computes the scale-normalized Laplacian (σ²∇²) at a position in input pixels.
    pub(crate) fn laplacian(&self, x: f32, y: f32) -> f32 {
        let p = self.pixel;
        let neighbors = self.at(x - p, y) + self.at(x + p, y) + self.at(x, y - p) + self.at(x, y + p);
        self.sigma * self.sigma * (neighbors - 4.0 * self.at(x, y))
    }
}

/// Subsamples every second pixel of every second row.
fn half_resolution(image: &GrayF32) -> GrayF32 {
    let (w, h) = image.size();
    let mut out = GrayF32::new(w.div_ceil(2), h.div_ceil(2), [0.0]);
    out.as_mut_slice().par_chunks_mut(w.div_ceil(2)).enumerate().for_each(|(y, row)| {
        row.iter_mut().zip(image.row(2 * y).iter().step_by(2)).for_each(|(o, v)| *o = *v);
    });
    out
}
