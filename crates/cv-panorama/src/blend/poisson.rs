//! Gradient-domain blending (Pérez, Gangnet & Blake 2003), solved by multigrid near the seams.
//!
//! The guidance field is the gradient of the labeled photograph; across a seam, the mean gradient of the two photographs. The unknown is the correction to the
//! composite with hard seams, which compensates the step at the seams and is harmonic elsewhere, with Neumann conditions at the image border and zero mean.

use crate::bit_depth::Channel;
use crate::blend::composite_grid::{CYCLES, CompositeGrid, Pixel, Sources};
use crate::blend::grid_edges::GridEdges;
use crate::blend::hard_seams::copy;
use crate::blend::{Blender, Composition, NO_PHOTO};
use crate::rows::{for_each_row_with, is_check_due};
use cv_core::{Cancelled, Image, Progress, Stage};
use cv_parallel::prelude::*;

/// Weight λ of the screening term, which pulls the correction toward zero: it decays over 1/√λ = 1000 pixels, which limits drift in long panoramas.
const SCREEN: f32 = 1e-6;

/// Gradient-domain blending.
pub(crate) struct Poisson;

impl<T: Channel> Blender<T> for Poisson {
    fn blend(&self, composition: &Composition<'_, T>, progress: &dyn Progress) -> Result<Image<T, 3>, Cancelled> {
        let stage = Stage::new(progress, "blend", CYCLES + 2)?;
        let mut image = copy(composition, &stage)?;
        let (edges, sources) = equation(composition, &stage)?;
        stage.add(1)?;
        if sources.iter().all(Vec::is_empty) {
            stage.add(CYCLES + 1)?;
            return Ok(image);
        }
        let mut grid = CompositeGrid::new(edges, &sources, SCREEN, &stage)?;
        grid.solve(&stage)?;
        let (w, labels) = (composition.labels.width(), composition.labels);
        // Interpolation between levels does not preserve the mean, and the screening is too weak to restore it.
        let mean = mean_correction(labels, &grid, &stage)?;
        for_each_row_with(image.as_mut_slice(), 3 * w, &stage, Buffer::default, |buffer, y, row| {
            let corrections = buffer.row(&grid, y, w);
            let pixels = row.as_chunks_mut::<3>().0.iter_mut().zip(labels.row(y));
            for ((out, label), correction) in pixels.zip(corrections) {
                if *label != NO_PHOTO {
                    *out = std::array::from_fn(|c| T::from_f32(out[c].to_f32() + correction[c] - mean[c]));
                }
            }
        })?;
        stage.add(1)?;
        Ok(image)
    }
}

/// Buffers for a row of corrections.
#[derive(Default)]
struct Buffer {
    columns: Vec<Pixel>,
    row: Vec<Pixel>,
}

impl Buffer {
    fn row(&mut self, grid: &CompositeGrid, y: usize, width: usize) -> &[Pixel] {
        self.row.resize(width, [0.0; 4]);
        grid.row(y, &mut self.columns, &mut self.row);
        &self.row
    }
}

/// Returns the mean of the correction over the pixels with a label.
fn mean_correction(labels: &Image<u16, 1>, grid: &CompositeGrid, stage: &Stage<'_>) -> Result<[f32; 3], Cancelled> {
    let mut rows = vec![[0.0_f64; 4]; labels.height()];
    let width = labels.width();
    for_each_row_with(&mut rows, 1, stage, Buffer::default, |buffer, y, sum| {
        let mut total = [0.0_f32; 4];
        for (correction, label) in buffer.row(grid, y, width).iter().zip(labels.row(y)) {
            let weight = f32::from(*label != NO_PHOTO);
            let [r, g, b, _] = *correction;
            let terms = [r, g, b, 1.0];
            total = std::array::from_fn(|c| total[c] + weight * terms[c]);
        }
        sum[0] = total.map(f64::from);
    })?;
    let total = rows.iter().fold([0.0; 4], |t, r| std::array::from_fn(|i| t[i] + r[i]));
    Ok(std::array::from_fn(|c| (total[c] / total[3].max(1.0)) as f32))
}

/// Returns the equation of the correction: the edges between pixels, and the right-hand side at the seams.
fn equation<T: Channel>(
    composition: &Composition<'_, T>,
    stage: &Stage<'_>,
) -> Result<(GridEdges, Sources), Cancelled> {
    let labels = composition.labels;
    let (w, h) = labels.size();
    let mut edges = GridEdges::new(w, h);
    let mut sources = vec![Vec::new(); h];
    let rows = (sources.par_iter_mut().enumerate())
        .zip(edges.right.par_chunks_mut(w.max(1)))
        .zip(edges.down.par_chunks_mut(w.max(1)));
    rows.try_for_each(|(((y, sources), right), down)| {
        if is_check_due(y, w) {
            stage.check()?;
        }
        let row = labels.row(y);
        let (above, below) = (labels.row(y.saturating_sub(1)), labels.row((y + 1).min(h - 1)));
        let weight = |a: &u16, b: &u16| f32::from(*a != NO_PHOTO && *b != NO_PHOTO);
        right.iter_mut().zip(row.iter().zip(&row[1..])).for_each(|(out, (a, b))| *out = weight(a, b));
        if y + 1 < h {
            down.iter_mut().zip(row.iter().zip(below)).for_each(|(out, (a, b))| *out = weight(a, b));
        }
        for x in 0..w {
            let (left, right) = (x.saturating_sub(1), (x + 1).min(w - 1));
            let (own, neighbors) = (row[x], [row[right], row[left], below[x], above[x]]);
            if own == NO_PHOTO || neighbors == [own; 4] {
                continue;
            }
            let places = [(right, y), (left, y), (x, (y + 1).min(h - 1)), (x, y.saturating_sub(1))];
            let mut sum = [0.0; 4];
            for (other, place) in neighbors.into_iter().zip(places) {
                if other != own && other != NO_PHOTO {
                    let mismatch = mismatch(composition, (own, (x, y)), (other, place));
                    (0..3).for_each(|c| sum[c] += mismatch[c]);
                }
            }
            if sum != [0.0; 4] {
                sources.push((x, sum));
            }
        }
        Ok(())
    })?;
    Ok((edges, sources))
}

/// Returns what the step from a pixel to a neighbor of another label should be, less what it is in the composite: the mean step of the photographs that
/// cover both pixels; zero where none does.
fn mismatch<T: Channel>(
    composition: &Composition<'_, T>,
    (own, at): (u16, (usize, usize)),
    (other, next): (u16, (usize, usize)),
) -> [f32; 3] {
    let color = |label: u16, (x, y): (usize, usize)| -> Option<[f32; 3]> {
        let p = composition.photos.get(usize::from(label))?.as_ref()?;
        p.color(x, y).map(|c| c.map(T::to_f32))
    };
    let (Some(p), Some(q)) = (color(own, at), color(other, next)) else { return [0.0; 3] };
    let (p2, q2) = (color(other, at), color(own, next));
    std::array::from_fn(|c| {
        let steps = [q2.map(|q2| p[c] - q2[c]), p2.map(|p2| p2[c] - q[c])];
        let known = steps.iter().flatten().count().max(1) as f32;
        steps.iter().flatten().sum::<f32>() / known - (p[c] - q[c])
    })
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

    /// Against the plain definition: successive over-relaxation on the pixels until nothing moves; in the larger image only the cells near the seam are fine.
    #[test]
    fn the_multigrid_finds_what_plain_relaxation_finds() {
        for (w, h) in [(24, 17), (211, 140)] {
            let photos = [
                gray(w, h, |x, y| (40 + 72 * x / w + 17 * y / h) as u8),
                gray(w, h, |x, y| (70 + 48 * x / w + 51 * y / h + (x * y) % 7) as u8),
            ];
            let labels = Image::from_fn(w, h, |x, y| {
                [if 8 * x < w && 5 * y > 3 * h { NO_PHOTO } else { u16::from(5 * x + y > 3 * w) }]
            });
            let composition = Composition { photos: &photos, labels: &labels, typical_side: 20.0 };
            let (grid, sources) = equation(&composition, &stage()).unwrap();
            let mut right_side = vec![0.0; w * h];
            for (y, row) in sources.iter().enumerate() {
                row.iter().for_each(|(x, b)| right_side[y * w + x] = b[0]);
            }
            let mut plain = vec![0.0_f64; w * h];
            let over = 2.0 / (1.0 + std::f64::consts::PI / w as f64);
            for _ in 0..12 * w {
                for i in 0..w * h {
                    let (x, y) = (i % w, i / w);
                    let (mut total, mut sum) = (f64::from(SCREEN), f64::from(right_side[i]));
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
                    plain[i] += over * (sum / total - plain[i]);
                }
            }
            // Relaxation alone lets the mean drift too.
            let covered: Vec<usize> = (0..w * h).filter(|i| labels.as_slice()[*i] != NO_PHOTO).collect();
            let mean = covered.iter().map(|i| plain[*i]).sum::<f64>() / covered.len() as f64;
            let hard = copy(&composition, &stage()).unwrap();
            let result = Poisson.blend(&composition, &Silent).unwrap();
            for i in covered {
                let want = f64::from(hard.at(i % w, i / w)[0]) + plain[i] - mean;
                let is = result.at(i % w, i / w)[0];
                // Half a level of rounding, and a hundredth of the steps of up to 50 levels.
                assert!((f64::from(is) - want).abs() < 1.0, "{w} × {h}, {i}: {is} {want}");
            }
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
