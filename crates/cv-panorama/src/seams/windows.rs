//! Refinement of seams in full resolution with labels and photographs in a scratch file: each photograph's expansion runs on the window of its bounds.

use super::alpha_expansion::{Labeling, independent_groups};
use super::cost::difference;
use super::{BLOCK, refined_block_radius, seam_band, subsampled};
use crate::bit_depth::Internals;
use crate::blend::NO_PHOTO;
use crate::render::RenderError;
use crate::stream::{LabelRows, WarpedStore};
use crate::surface::{Bounds, WarpedPhoto};
use cv_core::{Image, Progress, Stage};
use cv_parallel::prelude::*;
use std::collections::BTreeSet;

/// Canvas pixels that an expansion reads around the bounds of a photograph: the next pixel, and that before it for gradients.
const READ_AROUND: usize = 3;

/// Bytes of memory per canvas pixel of a window, without the samples: labels twice, the band, and the nodes of the graph, which are a small part.
const WINDOW_BYTES: usize = 8;

/// Estimates the memory in bytes of the refinement of one photograph of this area, where photographs overlap by up to a half: itself and its neighbors,
/// with their copies of 8 bits.
pub(crate) fn window_memory<T>(area: usize) -> usize {
    let samples = 4 * size_of::<T>() + if size_of::<T>() > 1 { 4 } else { 0 };
    area * (3 * samples + WINDOW_BYTES)
}

/// As [`refine`](super::refine), to the same labels. `memory` is the number of bytes for windows; they are worked on in parallel as far as it allows.
pub(crate) fn refine_in_windows<T: Internals>(
    labels: &mut LabelRows,
    photos: &WarpedStore<'_, T>,
    step: usize,
    memory: usize,
    progress: &dyn Progress,
) -> Result<(), RenderError> {
    let bounds = photos.bounds();
    let stage = Stage::new(progress, "seams", 2 * bounds.len() + 2)?;
    let largest = bounds.iter().flatten().map(|b| b.width() * b.height()).max().unwrap_or(0);
    let at_once = (memory / window_memory::<T>(largest).max(1)).clamp(1, rayon::current_num_threads());
    let mut reach = 2 * step;
    if let Some(radius) = refined_block_radius(step) {
        refine_blocks(labels, photos, radius, at_once, &stage)?;
        reach = BLOCK + BLOCK / 2;
    }
    stage.add(1)?;
    let before = labels.clone();
    let (width, height) = labels.size();
    for group in independent_groups(&bounds, None) {
        for batch in group.chunks(at_once) {
            let expand = |&alpha: &usize| -> Result<Vec<(usize, usize)>, RenderError> {
                let Some(own) = bounds[alpha] else { return Ok(Vec::new()) };
                let window = own.grown(READ_AROUND, width, height);
                let free = band_in(&before, window, reach, &stage)?;
                let names = labels.window(window);
                let photos = crops(photos, alpha, &names, window, &stage)?;
                let pieces: Vec<Option<&WarpedPhoto>> = photos.iter().map(Option::as_ref).collect();
                let labeling = Labeling {
                    photos: &pieces,
                    unary: |_, _, _| 0,
                    difference: |a: usize, c: usize, x: usize, y: usize| difference(pieces[a], pieces[c], x, y),
                    free: |y: usize| &free[y * names.width()..(y + 1) * names.width()],
                    beyond: None,
                };
                let changed = labeling.expand_one(&names, alpha, &stage)?;
                stage.add(1)?;
                Ok(changed
                    .into_iter()
                    .map(|i| (window.left + i % names.width(), window.top + i / names.width()))
                    .collect())
            };
            let changes: Vec<Vec<(usize, usize)>> = batch.par_iter().map(expand).try_collect()?;
            for (&alpha, changed) in batch.iter().zip(changes) {
                relabel(labels, alpha as u16, &changed);
            }
        }
    }
    stage.add(1)?;
    Ok(())
}

/// Sets the labels of pixels in row-major order.
fn relabel(labels: &mut LabelRows, label: u16, pixels: &[(usize, usize)]) {
    let mut row = Vec::new();
    for run in pixels.chunk_by(|a, b| a.1 == b.1) {
        let (left, y) = run[0];
        let right = run[run.len() - 1].0 + 1;
        row.clear();
        row.resize(right - left, NO_PHOTO);
        labels.read_row(y, left, &mut row);
        run.iter().for_each(|&(x, _)| row[x - left] = label);
        labels.write_row(y, left, &row);
    }
}

/// Returns the part of [`seam_band`] inside a window.
fn band_in(labels: &LabelRows, window: Bounds, reach: usize, stage: &Stage<'_>) -> Result<Vec<bool>, RenderError> {
    let (width, height) = labels.size();
    let around = window.grown(reach + 1, width, height);
    let band = seam_band(&labels.window(around), reach, stage)?;
    let mut inside = Vec::with_capacity(window.width() * window.height());
    for y in window.top - around.top..window.bottom - around.top {
        inside.extend_from_slice(&band[y * around.width() + window.left - around.left..][..window.width()]);
    }
    Ok(inside)
}

/// Reads the photographs of the labels in a window, as 8 bits in its coordinates.
fn crops<T: Internals>(
    photos: &WarpedStore<'_, T>,
    alpha: usize,
    labels: &Image<u16, 1>,
    window: Bounds,
    stage: &Stage<'_>,
) -> Result<Vec<Option<WarpedPhoto>>, RenderError> {
    let runs = (0..labels.height()).flat_map(|y| labels.row(y).chunk_by(|a, b| a == b).map(|run| usize::from(run[0])));
    let mut present: BTreeSet<usize> = runs.collect();
    present.insert(alpha);
    let read = |index: usize| -> Result<Option<WarpedPhoto>, RenderError> {
        if !present.contains(&index) {
            return Ok(None);
        }
        let Some(crop) = photos.crop(index, window)? else { return Ok(None) };
        stage.check()?;
        Ok(T::warped_in_8_bits(crop, stage)?)
    };
    (0..photos.bounds().len()).map(read).collect()
}

/// As [`refine_blocks`](super::refine_blocks), to the same labels.
fn refine_blocks<T: Internals>(
    labels: &mut LabelRows,
    photos: &WarpedStore<'_, T>,
    reach: usize,
    at_once: usize,
    stage: &Stage<'_>,
) -> Result<(), RenderError> {
    const MIDDLE: usize = BLOCK / 2;
    let (w, h) = labels.size();
    let (across, down) = ((w + BLOCK - 1 - MIDDLE) / BLOCK, (h + BLOCK - 1 - MIDDLE) / BLOCK);
    let mut before = Image::new(across, down, [NO_PHOTO]);
    let mut row = vec![NO_PHOTO; w];
    for y in 0..down {
        labels.read_row(BLOCK * y + MIDDLE, 0, &mut row);
        before
            .row_mut(y)
            .iter_mut()
            .zip(row.iter().skip(MIDDLE).step_by(BLOCK))
            .for_each(|(block, label)| *block = *label);
    }
    let near = seam_band(&before, reach, stage)?;
    let bounds = photos.bounds();
    let mut after = before.clone();
    // Groups are those of the blocks, as they may differ from those of the pixels.
    let of_blocks: Vec<Option<Bounds>> = bounds.iter().map(|b| b.map(super::block_bounds)).collect();
    for group in independent_groups(&of_blocks, None) {
        for batch in group.chunks(at_once) {
            let current = &after;
            let expand = |&alpha: &usize| -> Result<Vec<usize>, RenderError> {
                stage.add(1)?;
                let Some(blocks) = of_blocks[alpha] else { return Ok(Vec::new()) };
                // A window that begins with a block, in blocks and in pixels.
                let blocks = blocks.grown(2, across, down);
                let window = Bounds {
                    left: BLOCK * blocks.left,
                    top: BLOCK * blocks.top,
                    right: (BLOCK * blocks.right).min(w),
                    bottom: (BLOCK * blocks.bottom).min(h),
                };
                let names =
                    Image::from_fn(blocks.width(), blocks.height(), |x, y| current.at(blocks.left + x, blocks.top + y));
                let photos = crops(photos, alpha, &names, window, stage)?;
                let pieces: Vec<Option<&WarpedPhoto>> = photos.iter().map(Option::as_ref).collect();
                let own = pieces[alpha].map(subsampled);
                let reached: Vec<Option<&WarpedPhoto>> =
                    (0..pieces.len()).map(|k| own.as_ref().filter(|_| k == alpha)).collect();
                let labeling = Labeling {
                    photos: &reached,
                    unary: |_, _, _| 0,
                    difference: |a: usize, c: usize, x: usize, y: usize| super::block_difference(&pieces, a, c, x, y),
                    free: |y: usize| &near[(blocks.top + y) * across..(blocks.top + y + 1) * across][blocks.left..],
                    beyond: None,
                };
                let changed = labeling.expand_one(&names, alpha, stage)?;
                let global = |i: usize| (blocks.top + i / blocks.width()) * across + blocks.left + i % blocks.width();
                Ok(changed.into_iter().map(global).collect())
            };
            let changes: Vec<Vec<usize>> = batch.par_iter().map(expand).try_collect()?;
            for (&alpha, changed) in batch.iter().zip(&changes) {
                changed.iter().for_each(|&i| after.as_mut_slice()[i] = alpha as u16);
            }
        }
    }
    // The blocks that changed, by photograph: only its own pixels are read.
    for (alpha, b) in bounds.iter().enumerate() {
        let Some(b) = b else { continue };
        let Some(part) = super::block_bounds(*b).grown(1, across, down).intersection(&of_whole(across, down)) else {
            continue;
        };
        for y in part.top..part.bottom {
            let is_new = |x: usize| {
                let [label] = after.at(x, y);
                usize::from(label) == alpha && before.at(x, y) != [label]
            };
            let (Some(first), Some(last)) =
                ((part.left..part.right).find(|x| is_new(*x)), (part.left..part.right).rev().find(|x| is_new(*x)))
            else {
                continue;
            };
            let strip = Bounds {
                left: BLOCK * first,
                top: BLOCK * y,
                right: (BLOCK * (last + 1)).min(w),
                bottom: (BLOCK * (y + 1)).min(h),
            };
            let Some(photo) = photos.crop(alpha, strip)? else { continue };
            let mut names = labels.window(strip);
            for (row, line) in names.as_mut_slice().chunks_exact_mut(strip.width()).enumerate() {
                for (x, label) in line.iter_mut().enumerate() {
                    if is_new(first + x / BLOCK) && photo.reaches(x, row) {
                        *label = alpha as u16;
                    }
                }
                labels.write_row(strip.top + row, strip.left, line);
            }
        }
        stage.check()?;
    }
    Ok(())
}

fn of_whole(width: usize, height: usize) -> Bounds {
    Bounds { left: 0, top: 0, right: width, bottom: height }
}
