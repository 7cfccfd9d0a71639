//! Masks on the canvas: the opacity of a warped photograph is cleared where its mask removes it, and where another photograph is kept.

use super::{KEPT, PhotoMask, PhotoUse, REMOVED};
use crate::bit_depth::Channel;
use crate::regions::Region;
use crate::rows::for_each_row;
use crate::surface::{Bounds, DisplacementField, Layout, Map, Placement, Preview, PreviewScale, Surface, WarpedPhoto};
use cv_core::{Cancelled, Image, Point2, Progress, Scaling, Stage, Vector2};
use cv_parallel::prelude::*;

/// The masks of the placements of a layout.
pub(crate) struct PlacedMasks<'a> {
    layout: &'a Layout,
    fields: &'a [Option<DisplacementField>],
    /// `None` for placements without one; empty if there is no mask at all.
    masks: Vec<Option<&'a PhotoMask>>,
}

/// What the masks say about the pixels of a preview, of each piece with a mask: [`REMOVED`] where any pixel near is removed, [`KEPT`] where any is kept.
pub(crate) struct PreviewMasks(Vec<Option<Vec<u8>>>);

impl<'a> PlacedMasks<'a> {
    /// `masks` are those of the photographs, in their order; there may be fewer.
    pub(crate) fn new(
        masks: &[Option<&'a PhotoMask>],
        layout: &'a Layout,
        fields: &'a [Option<DisplacementField>],
    ) -> Self {
        let of = |p: &Placement| masks.get(p.photo).copied().flatten();
        let masks: Vec<_> = layout.placements.iter().map(of).collect();
        let masks = if masks.iter().any(Option::is_some) { masks } else { Vec::new() };
        Self { layout, fields, masks }
    }

    /// Returns what the masks say about a preview. Reports as the stage "preview", where there are masks.
    pub(crate) fn on_preview(
        &self,
        preview: &Preview,
        scale: PreviewScale,
        progress: &dyn Progress,
    ) -> Result<PreviewMasks, Cancelled> {
        if self.masks.is_empty() {
            return Ok(PreviewMasks(Vec::new()));
        }
        let stage = Stage::new(progress, "preview", 1)?;
        let s = 1.0 / scale.step as f64;
        let surface = Surface { scale: self.layout.surface.scale * s, ..self.layout.surface };
        let flags = |(k, mask): (usize, &Option<&PhotoMask>)| -> Result<Option<Vec<u8>>, Cancelled> {
            let Some(mask) = mask else { return Ok(None) };
            let bounds = preview.pieces[k].warped.bounds;
            let placement = &self.layout.placements[k];
            // As the preview is warped, but to pixels of the whole photograph.
            let small = Placement { origin: -Scaling::uniform(s).point(-placement.origin), ..*placement };
            let field = self.fields[k].as_ref().map(|field| field.scaled(s, 1.0));
            let positions = Positions::new(&small, &surface, field.as_ref(), bounds);
            let blocks = mask.blocks(scale.shrink);
            let mut flags = vec![0; bounds.width() * bounds.height()];
            for_each_row(&mut flags, bounds.width(), &stage, |y, row| {
                let places = positions.row(bounds.top + y, bounds.left, bounds.right);
                row.iter_mut().zip(places).for_each(|(flags, p)| *flags = blocks_around(&blocks, scale.shrink, p));
            })?;
            Ok(Some(flags))
        };
        Ok(PreviewMasks(self.masks.par_iter().enumerate().map(flags).try_collect()?))
    }

    /// Clears the opacity of placement `k`, warped to a part of the canvas in full resolution, where its mask removes it and where another that has a region is
    /// kept.
    pub(crate) fn clear<T: Channel>(
        &self,
        k: usize,
        warped: &mut WarpedPhoto<T>,
        regions: &[Option<Region>],
        stage: &Stage<'_>,
    ) -> Result<(), Cancelled> {
        let bounds = warped.bounds;
        let at = |j: usize, part: Bounds| -> Option<Kept<'_>> {
            let (mask, placement) = (self.masks[j]?, &self.layout.placements[j]);
            let positions = Positions::new(placement, &self.layout.surface, self.fields[j].as_ref(), part);
            Some(Kept { index: j, mask, placement, positions, region: regions[j].as_ref()? })
        };
        let keeps = |j: usize| j != k && self.masks[j].is_some_and(|mask| mask.has(PhotoUse::Keep));
        let others: Vec<Kept<'_>> = (0..self.masks.len())
            .filter(|j| keeps(*j))
            .filter_map(|j| at(j, regions[j].as_ref()?.bounds.intersection(&bounds)?))
            .collect();
        let own = self.masks.get(k).copied().flatten().and_then(|_| at(k, bounds));
        if others.is_empty() && own.as_ref().is_none_or(|own| !own.mask.has(PhotoUse::Remove)) {
            return Ok(());
        }
        for_each_row(warped.pixels.as_mut_slice(), 4 * bounds.width(), stage, |y, row| {
            let (pixels, y) = (row.as_chunks_mut::<4>().0, bounds.top + y);
            let own_row: Vec<(PhotoUse, f32)> = match &own {
                Some(own) => own.row(y, bounds.left, bounds.right).collect(),
                None => vec![(PhotoUse::Free, 0.0); bounds.width()],
            };
            for (pixel, _) in pixels.iter_mut().zip(&own_row).filter(|(_, own)| own.0 == PhotoUse::Remove) {
                pixel[3] = T::default();
            }
            for other in &others {
                let (part, span) = (other.positions.bounds, other.region.span(y));
                let (start, end) = (part.left.max(span.start), part.right.min(span.end));
                if y < part.top || y >= part.bottom || start >= end {
                    continue;
                }
                let first = start - bounds.left;
                let places = pixels[first..].iter_mut().zip(&own_row[first..]);
                for ((pixel, own), theirs) in places.zip(other.row(y, start, end)) {
                    let is_nearer = own.0 != PhotoUse::Keep || (theirs.1, other.index) < (own.1, k);
                    if theirs.0 == PhotoUse::Keep && is_nearer {
                        pixel[3] = T::default();
                    }
                }
            }
        })
    }
}

impl PreviewMasks {
    /// Clears the opacity of removed pixels.
    pub(crate) fn remove(&self, preview: &mut Preview) {
        for (piece, flags) in preview.pieces.iter_mut().zip(&self.0) {
            let Some(flags) = flags else { continue };
            let pixels = piece.warped.pixels.as_mut_slice().as_chunks_mut::<4>().0;
            pixels.iter_mut().zip(flags).filter(|(_, flags)| **flags & REMOVED != 0).for_each(|(p, _)| p[3] = 0);
        }
    }

    /// Clears the opacity where another photograph is kept.
    pub(crate) fn keep(&self, preview: &mut Preview) {
        // Eccentricity of a piece where it covers a pixel and is kept there.
        let kept = |k: usize, x: usize, y: usize| -> Option<f32> {
            let (flags, piece) = (self.0.get(k)?.as_ref()?, &preview.pieces[k]);
            let is_kept = || flags[piece.warped.bounds.index(x, y)] & KEPT != 0 && piece.warped.reaches(x, y);
            (piece.warped.bounds.contains(x, y) && is_kept())
                .then(|| piece.eccentricity[piece.warped.bounds.index(x, y)])
        };
        let keeps = |flags: &Option<Vec<u8>>| flags.as_ref().is_some_and(|flags| flags.iter().any(|f| f & KEPT != 0));
        let keepers: Vec<usize> = (0..self.0.len()).filter(|k| keeps(&self.0[*k])).collect();
        let cleared: Vec<Vec<usize>> = (0..preview.pieces.len())
            .into_par_iter()
            .map(|k| {
                let b = preview.pieces[k].warped.bounds;
                let is_cleared = |i: &usize| {
                    let (x, y) = (b.left + i % b.width(), b.top + i / b.width());
                    let own = kept(k, x, y).map_or((f32::INFINITY, k), |own| (own, k));
                    let mut others = keepers.iter().filter(|j| **j != k);
                    others.any(|&j| kept(j, x, y).is_some_and(|theirs| (theirs, j) < own))
                };
                if keepers.is_empty() { Vec::new() } else { (0..b.width() * b.height()).filter(is_cleared).collect() }
            })
            .collect();
        for (piece, cleared) in preview.pieces.iter_mut().zip(&cleared) {
            let pixels = piece.warped.pixels.as_mut_slice().as_chunks_mut::<4>().0;
            cleared.iter().for_each(|&i| pixels[i][3] = 0);
        }
    }
}

/// Returns whether placement `k` is removed at a canvas position, before displacement.
pub(crate) fn is_removed(masks: &[Option<&PhotoMask>], layout: &Layout, k: usize, at: Point2<f64>) -> bool {
    let placement = &layout.placements[k];
    let Some(mask) = masks.get(placement.photo).copied().flatten() else { return false };
    let pixel = placement.view.project(&layout.surface.inverse(at + placement.origin.coords));
    pixel.is_some_and(|p| mask.around(p.x as f32, p.y as f32) == PhotoUse::Remove)
}

/// Returns whether placement `k` is removed anywhere in a square around a canvas position, of which every fourth pixel is tried.
pub(crate) fn is_removed_near(
    masks: &[Option<&PhotoMask>],
    layout: &Layout,
    k: usize,
    at: Point2<f64>,
    radius: usize,
) -> bool {
    if masks.get(layout.placements[k].photo).copied().flatten().is_none() {
        return false;
    }
    let steps = || (0..=2 * radius).step_by(4).map(|i| i as f64 - radius as f64);
    steps().any(|dy| steps().any(|dx| is_removed(masks, layout, k, at + Vector2::new(dx, dy))))
}

/// Positions in a photograph of canvas pixels, as [`warp`](crate::surface::warp) finds them.
struct Positions<'a> {
    map: Map,
    field: Option<&'a DisplacementField>,
    bounds: Bounds,
}

impl<'a> Positions<'a> {
    fn new(placement: &Placement, surface: &Surface, field: Option<&'a DisplacementField>, bounds: Bounds) -> Self {
        Self { map: Map::new(placement, surface, bounds), field, bounds }
    }

    /// Returns the positions of the columns `start..end` of a row, which lie within the bounds.
    fn row(&self, y: usize, start: usize, end: usize) -> impl Iterator<Item = Point2<f32>> {
        let (mut us, mut vs) = (vec![0.0; end - start], vec![0.0; end - start]);
        self.map.row(y - self.bounds.top, start - self.bounds.left, &mut us, &mut vs);
        if let Some(field) = self.field {
            field.add_row(y as f64, start as f64, &mut us, &mut vs);
        }
        us.into_iter().zip(vs).map(|(u, v)| Point2::new(u, v))
    }
}

/// A placement with a mask on a part of the canvas.
struct Kept<'a> {
    index: usize,
    mask: &'a PhotoMask,
    placement: &'a Placement,
    positions: Positions<'a>,
    region: &'a Region,
}

impl Kept<'_> {
    /// Returns what the mask says about the columns `start..end` of a row, and the eccentricity there as of [`Piece`](crate::surface::Piece).
    fn row(&self, y: usize, start: usize, end: usize) -> impl Iterator<Item = (PhotoUse, f32)> {
        let camera = &self.placement.view.camera;
        let (cx, cy) = (0.5 * (camera.width as f32 - 1.0), 0.5 * (camera.height as f32 - 1.0));
        self.positions.row(y, start, end).map(move |p| {
            let eccentricity = ((p.x - cx).abs() / (cx + 0.5)).max((p.y - cy).abs() / (cy + 0.5));
            (self.mask.around(p.x, p.y), eccentricity)
        })
    }
}

/// Returns the flags of the blocks of `step` pixels that bilinear interpolation at a position takes in.
fn blocks_around(blocks: &Image<u8, 1>, step: usize, p: Point2<f32>) -> u8 {
    let (w, h) = blocks.size();
    let place = |v: f32, n: usize| {
        let v = ((v + 0.5) / step as f32 - 0.5).clamp(0.0, n as f32 - 1.0);
        (v as usize, (v.ceil() as usize).min(n - 1))
    };
    let ((x0, x1), (y0, y1)) = (place(p.x, w), place(p.y, h));
    [(x0, y0), (x1, y0), (x0, y1), (x1, y1)].into_iter().fold(0, |flags, (x, y)| flags | blocks.at(x, y)[0])
}
