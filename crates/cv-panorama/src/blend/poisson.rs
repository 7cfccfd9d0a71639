//! Gradient-domain blending (Pérez, Gangnet & Blake 2003), solved by multigrid.
//!
//! The guidance field is the gradient of the labeled photograph; across a seam, the mean gradient of the two photographs. The unknown is the correction to the
//! composite with hard seams, which compensates the step at the seams and is harmonic elsewhere, with Neumann conditions at the image border and zero mean.

use crate::bit_depth::Channel;
use crate::blend::hard_seams::copy;
use crate::blend::{Blender, Composition, NO_PHOTO};
use crate::rows::{for_each_row, is_check_due};
use cv_core::{Cancelled, Image, Progress, Stage};
use rayon::prelude::*;

type Pixel = [f32; 4];

/// Weight λ of the screening term, which pulls the correction toward zero: it decays over 1/√λ = 1000 pixels, which limits drift in long panoramas.
const SCREEN: f32 = 1e-6;
/// Damping of the Jacobi smoother, best for the five-point Laplacian (Trottenberg, Multigrid, §2.1).
const OMEGA: f32 = 0.8;
/// Smoothing sweeps before and after each coarse correction.
const SWEEPS: usize = 2;
/// V-cycles on the full grid after the full multigrid start. Each reduces the error by a factor of about seven.
const CYCLES: usize = 4;

/// Gradient-domain blending.
pub(crate) struct Poisson;

impl<T: Channel> Blender<T> for Poisson {
    fn blend(&self, composition: &Composition<'_, T>, progress: &dyn Progress) -> Result<Image<T, 3>, Cancelled> {
        // Cycles on the full grid are most of the work.
        let stage = Stage::new(progress, "blend", CYCLES + 2)?;
        let mut image = copy(composition, &stage)?;
        let mut grids = vec![Grid::from_seams(composition, &stage)?];
        stage.add(1)?;
        if grids[0].right_side.iter().all(|b| *b == [0.0; 4]) {
            stage.add(CYCLES + 1)?;
            return Ok(image);
        }
        // Coarsened to a few cells, which a few sweeps solve.
        while let Some(last) = grids.last()
            && last.width.max(last.height) > 2
        {
            let next = last.coarser(&stage)?;
            grids.push(next);
        }
        solve(&mut grids, &stage)?;
        let (w, correction, labels) = (composition.labels.width(), &grids[0].value, composition.labels);
        // Interpolation between levels does not preserve the mean, and the screening is too weak to restore it.
        let rows: Vec<[f64; 4]> = correction
            .par_chunks(w.max(1))
            .zip(labels.as_slice().par_chunks(w.max(1)))
            .map(|(row, labels)| {
                let mut sum = [0.0; 4];
                for (c, _) in row.iter().zip(labels).filter(|(_, l)| **l != NO_PHOTO) {
                    sum = [sum[0] + f64::from(c[0]), sum[1] + f64::from(c[1]), sum[2] + f64::from(c[2]), sum[3] + 1.0];
                }
                sum
            })
            .collect();
        let total = rows.iter().fold([0.0; 4], |t, r| std::array::from_fn(|i| t[i] + r[i]));
        let mean: [f32; 3] = std::array::from_fn(|i| (total[i] / total[3].max(1.0)) as f32);
        for_each_row(image.as_mut_slice(), 3 * w, &stage, |y, row| {
            let (labels, correction) = (labels.row(y), &correction[y * w..]);
            for ((out, l), c) in row.as_chunks_mut::<3>().0.iter_mut().zip(labels).zip(correction) {
                if *l != NO_PHOTO {
                    *out = std::array::from_fn(|i| T::from_f32(out[i].to_f32() + c[i] - mean[i]));
                }
            }
        })?;
        stage.add(1)?;
        Ok(image)
    }
}

/// Full multigrid on `grids`, finest first (Trottenberg, Multigrid, §2.6): restricted right-hand sides, then from coarse to fine one V-cycle on each level
/// from the interpolated coarser solution, several on the finest.
fn solve(grids: &mut [Grid], stage: &Stage<'_>) -> Result<(), Cancelled> {
    for level in 1..grids.len() {
        let (fine, coarse) = grids.split_at_mut(level);
        coarse[0].right_side = fine[level - 1].restrict(&fine[level - 1].right_side, stage)?;
    }
    for level in (0..grids.len()).rev() {
        let cycles = if level == 0 { CYCLES } else { 1 };
        for _ in 0..cycles {
            cycle(&mut grids[level..], stage)?;
            stage.add(usize::from(level == 0))?;
        }
        if level > 0 {
            let (fine, coarse) = grids.split_at_mut(level);
            fine[level - 1].add_interpolated(&coarse[0], stage)?;
        }
    }
    Ok(())
}

/// One level: unknowns, right-hand side, and the weights of the edges to the right and below (zero where there is none).
struct Grid {
    width: usize,
    height: usize,
    value: Vec<Pixel>,
    right_side: Vec<Pixel>,
    right: Vec<f32>,
    down: Vec<f32>,
    screen: f32,
}

impl Grid {
    fn empty(width: usize, height: usize, screen: f32) -> Self {
        let n = width * height;
        let (value, right_side) = (vec![[0.0; 4]; n], vec![[0.0; 4]; n]);
        Self { width, height, value, right_side, right: vec![0.0; n], down: vec![0.0; n], screen }
    }

    fn from_seams<T: Channel>(composition: &Composition<'_, T>, stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let (w, h) = composition.labels.size();
        let labels = composition.labels.as_slice();
        let mut grid = Self::empty(w, h, SCREEN);
        let color = |label: u16, x: usize, y: usize| -> Option<[f32; 3]> {
            let p = composition.photos.get(usize::from(label))?.as_ref()?;
            p.color(x, y).map(|c| c.map(T::to_f32))
        };
        for y in 0..h {
            if is_check_due(y, w) {
                stage.check()?;
            }
            for x in 0..w {
                let own = labels[y * w + x];
                for (nx, ny) in [(x + 1, y), (x, y + 1)] {
                    if own == NO_PHOTO || nx >= w || ny >= h || labels[ny * w + nx] == NO_PHOTO {
                        continue;
                    }
                    let (i, j) = (y * w + x, ny * w + nx);
                    if ny == y {
                        grid.right[i] = 1.0
                    } else {
                        grid.down[i] = 1.0
                    }
                    let other = labels[j];
                    if own == other {
                        continue;
                    }
                    let (Some(p), Some(q)) = (color(own, x, y), color(other, nx, ny)) else { continue };
                    let (p2, q2) = (color(other, x, y), color(own, nx, ny));
                    for c in 0..3 {
                        // Mean gradient of the photographs that cover both pixels; zero where none does.
                        let steps = [q2.map(|q2| p[c] - q2[c]), p2.map(|p2| p2[c] - q[c])];
                        let known = steps.iter().flatten().count().max(1) as f32;
                        let step = steps.iter().flatten().sum::<f32>() / known;
                        let mismatch = step - (p[c] - q[c]);
                        grid.right_side[i][c] += mismatch;
                        grid.right_side[j][c] -= mismatch;
                    }
                }
            }
        }
        Ok(grid)
    }

    /// Coarsens to half resolution. The weight of an edge between two cells is half the sum of the fine edges between them (number over doubled distance).
    fn coarser(&self, stage: &Stage<'_>) -> Result<Self, Cancelled> {
        let (w, h) = (self.width.div_ceil(2), self.height.div_ceil(2));
        // A cell represents four pixels.
        let mut grid = Self::empty(w, h, 4.0 * self.screen);
        for y in 0..self.height {
            if is_check_due(y, self.width) {
                stage.check()?;
            }
            for x in 0..self.width {
                let (i, cell) = (y * self.width + x, y / 2 * w + x / 2);
                if x % 2 == 1 {
                    grid.right[cell] += 0.5 * self.right[i];
                }
                if y % 2 == 1 {
                    grid.down[cell] += 0.5 * self.down[i];
                }
            }
        }
        Ok(grid)
    }

    /// Restricts by sums of 2 × 2 blocks.
    fn restrict(&self, fine: &[Pixel], stage: &Stage<'_>) -> Result<Vec<Pixel>, Cancelled> {
        let (w, h) = (self.width.div_ceil(2), self.height.div_ceil(2));
        let mut coarse = vec![[0.0; 4]; w * h];
        for_each_row(&mut coarse, w, stage, |y, row| {
            for fine_y in 2 * y..(2 * y + 2).min(self.height) {
                for (x, v) in fine[fine_y * self.width..(fine_y + 1) * self.width].iter().enumerate() {
                    let sum: &mut Pixel = &mut row[x / 2];
                    for c in 0..3 {
                        sum[c] += v[c];
                    }
                }
            }
        })?;
        Ok(coarse)
    }

    /// Evaluates `f` at every pixel with its index, the sum of its edge weights and the weighted sum of its neighbors.
    fn stencil(
        &self,
        stage: &Stage<'_>,
        f: impl Fn(usize, f32, Pixel) -> Pixel + Sync,
    ) -> Result<Vec<Pixel>, Cancelled> {
        let (w, h) = (self.width, self.height);
        let mut out = vec![[0.0; 4]; self.value.len()];
        for_each_row(&mut out, w, stage, |y, row| {
            for (x, out) in row.iter_mut().enumerate() {
                let i = y * w + x;
                let (mut total, mut sum) = (self.screen, [0.0_f32; 4]);
                let mut add = |weight: f32, j: usize| {
                    if weight > 0.0 {
                        total += weight;
                        let v = self.value[j];
                        sum = std::array::from_fn(|c| sum[c] + weight * v[c]);
                    }
                };
                if x + 1 < w {
                    add(self.right[i], i + 1);
                }
                if x > 0 {
                    add(self.right[i - 1], i - 1);
                }
                if y + 1 < h {
                    add(self.down[i], i + w);
                }
                if y > 0 {
                    add(self.down[i - w], i - w);
                }
                *out = f(i, total, sum);
            }
        })?;
        Ok(out)
    }

    /// Performs one sweep of damped Jacobi.
    fn smooth(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        self.value = self.stencil(stage, |i, total, sum| {
            let (v, b) = (self.value[i], self.right_side[i]);
            // Isolated pixels are not corrected.
            if total <= self.screen {
                return [0.0; 4];
            }
            std::array::from_fn(|c| v[c] + OMEGA * ((b[c] + sum[c]) / total - v[c]))
        })?;
        Ok(())
    }

    fn residual(&self, stage: &Stage<'_>) -> Result<Vec<Pixel>, Cancelled> {
        self.stencil(stage, |i, total, sum| {
            let (v, b) = (self.value[i], self.right_side[i]);
            if total <= self.screen {
                return [0.0; 4];
            }
            std::array::from_fn(|c| b[c] + sum[c] - total * v[c])
        })
    }

    /// Adds the coarse correction, interpolated between the centers of its cells inside the image.
    fn add_interpolated(&mut self, coarse: &Self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        let w = self.width;
        let inside: Vec<f32> = (0..coarse.value.len()).map(|i| if coarse.has_edges(i) { 1.0 } else { 0.0 }).collect();
        for_each_row(&mut self.value, w, stage, |y, row| {
            let place = |v: usize, n: usize| {
                let near = v / 2;
                let far = if v.is_multiple_of(2) { near.saturating_sub(1) } else { (near + 1).min(n - 1) };
                (near, far)
            };
            let (y0, y1) = place(y, coarse.height);
            for (x, out) in row.iter_mut().enumerate() {
                let (x0, x1) = place(x, coarse.width);
                let (mut total, mut sum) = (0.0, [0.0_f32; 4]);
                for (i, weight) in [
                    (y0 * coarse.width + x0, 9.0),
                    (y0 * coarse.width + x1, 3.0),
                    (y1 * coarse.width + x0, 3.0),
                    (y1 * coarse.width + x1, 1.0),
                ] {
                    let weight = weight * inside[i];
                    total += weight;
                    let v = coarse.value[i];
                    sum = std::array::from_fn(|c| sum[c] + weight * v[c]);
                }
                if total > 0.0 {
                    for c in 0..3 {
                        out[c] += sum[c] / total;
                    }
                }
            }
        })
    }

    fn has_edges(&self, i: usize) -> bool {
        let (x, y) = (i % self.width, i / self.width);
        self.right[i] > 0.0
            || self.down[i] > 0.0
            || x > 0 && self.right[i - 1] > 0.0
            || y > 0 && self.down[i - self.width] > 0.0
    }
}

/// Performs one V-cycle on the first of `grids`.
fn cycle(grids: &mut [Grid], stage: &Stage<'_>) -> Result<(), Cancelled> {
    let Some((fine, coarser)) = grids.split_first_mut() else { return Ok(()) };
    for _ in 0..SWEEPS {
        fine.smooth(stage)?;
    }
    if let Some(coarse) = coarser.first_mut() {
        // The right-hand side of the full multigrid start is no longer needed.
        coarse.right_side = fine.restrict(&fine.residual(stage)?, stage)?;
        coarse.value.fill([0.0; 4]);
        cycle(coarser, stage)?;
        fine.add_interpolated(&coarser[0], stage)?;
    } else {
        for _ in 0..8 {
            fine.smooth(stage)?;
        }
    }
    for _ in 0..SWEEPS {
        fine.smooth(stage)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{Bounds, WarpedPhoto};
    use crate::testing::{drawn, stage};
    use cv_core::Silent;

    fn gray(w: usize, h: usize, f: impl Fn(usize, usize) -> u8) -> Option<WarpedPhoto> {
        Some(drawn(Bounds { left: 0, top: 0, right: w, bottom: h }, |x, y| [f(x, y); 3]))
    }

    /// A picture whose parts differ by constants is put together without any step, whatever the shape of the seam and of the picture.
    #[test]
    fn constant_differences_vanish_and_the_mean_stays() {
        let (w, h) = (150, 90);
        let texture = |x: usize, y: usize| 90.0 + 25.0 * ((x as f64 * 0.3).sin() + (y as f64 * 0.23).cos());
        let photos = [gray(w, h, |x, y| texture(x, y) as u8), gray(w, h, |x, y| texture(x, y) as u8 + 40)];
        // A wavy seam, a hole, and a corner that is not there.
        let labels = Image::from_fn(w, h, |x, y| {
            let hole = (x as i32 - 40).pow(2) + (y as i32 - 30).pow(2) < 150;
            [if hole || x + y < 25 { NO_PHOTO } else { u16::from(x as f64 > 75.0 + 20.0 * (y as f64 * 0.1).sin()) }]
        });
        let composition = Composition { photos: &photos, labels: &labels, typical_side: 100.0 };
        let result = Poisson.blend(&composition, &Silent).unwrap();
        let mut offsets = Vec::new();
        for y in 0..h {
            for x in 0..w {
                if labels.at(x, y)[0] != NO_PHOTO {
                    offsets.push(f64::from(result.at(x, y)[0]) - texture(x, y).floor());
                } else {
                    assert_eq!(result.at(x, y), [0; 3]);
                }
            }
        }
        let mean = offsets.iter().sum::<f64>() / offsets.len() as f64;
        let share = labels.as_slice().iter().filter(|l| **l == 1).count() as f64 / offsets.len() as f64;
        // The hard-seamed picture is 40 brighter on the second label's share.
        assert!((mean - 40.0 * share).abs() < 1.0, "{mean} {share}");
        // Rounding to bytes, half a level, and what four cycles leave of 40 levels: 40 / 7⁴ = 0.02; the screening adds a slope of a
        // fraction of a level over 150 px.
        let worst = offsets.iter().map(|o| (o - mean).abs()).fold(0.0, f64::max);
        assert!(worst <= 1.6, "{worst}");
    }

    /// Against the plain definition: Gauss-Seidel on the pixels until nothing moves.
    #[test]
    fn the_multigrid_finds_what_plain_relaxation_finds() {
        let (w, h) = (24, 17);
        let photos =
            [gray(w, h, |x, y| (40 + x * 3 + y) as u8), gray(w, h, |x, y| (70 + x * 2 + 3 * y + (x * y) % 7) as u8)];
        let labels = Image::from_fn(w, h, |x, y| [if x < 3 && y > 10 { NO_PHOTO } else { u16::from(x + y / 2 > 14) }]);
        let composition = Composition { photos: &photos, labels: &labels, typical_side: 20.0 };
        let grid = Grid::from_seams(&composition, &stage()).unwrap();
        let mut plain = vec![0.0_f64; w * h];
        for _ in 0..20_000 {
            for i in 0..w * h {
                let (x, y) = (i % w, i / w);
                let (mut total, mut sum) = (f64::from(SCREEN), f64::from(grid.right_side[i][0]));
                let mut add = |weight: f32, j: usize| {
                    total += f64::from(weight);
                    sum += f64::from(weight) * plain[j];
                };
                if x + 1 < w {
                    add(grid.right[i], i + 1);
                }
                if x > 0 {
                    add(grid.right[i - 1], i - 1);
                }
                if y + 1 < h {
                    add(grid.down[i], i + w);
                }
                if y > 0 {
                    add(grid.down[i - w], i - w);
                }
                plain[i] = sum / total;
            }
        }
        // Relaxation alone lets the mean drift too.
        let covered: Vec<usize> = (0..w * h).filter(|i| labels.as_slice()[*i] != NO_PHOTO).collect();
        let mean = covered.iter().map(|i| plain[*i]).sum::<f64>() / covered.len() as f64;
        let hard = copy(&composition, &stage()).unwrap();
        let result = Poisson.blend(&composition, &Silent).unwrap();
        for i in covered {
            let want = f64::from(hard.at(i % w, i / w)[0]) + plain[i] - mean;
            // Half a level of rounding and a quarter for unfinished cycles.
            assert!(
                (f64::from(result.at(i % w, i / w)[0]) - want).abs() < 0.75,
                "{i}: {:?} {want}",
                result.at(i % w, i / w)
            );
        }
    }

    #[test]
    fn without_seams_nothing_changes() {
        let photos = [gray(30, 20, |x, y| (x * y % 200) as u8)];
        let labels = Image::new(30, 20, [0]);
        let composition = Composition { photos: &photos, labels: &labels, typical_side: 20.0 };
        let result = Poisson.blend(&composition, &Silent).unwrap();
        assert_eq!(result, copy(&composition, &stage()).unwrap());
    }
}
