//! Blending in strips of rows, and these in tiles.

use super::{LabelRows, RowSink, WarpedStore};
use crate::bit_depth::PhotoSample;
use crate::blend::{BlendMode, CoarseCanvas, CoarseLevels, Composition, FEATHER_MARGIN, NO_PHOTO, coarse_margin};
use crate::render::RenderError;
use crate::surface::Bounds;
use cv_core::{Image, Progress, Stage};

/// Smallest side of a tile, without its margins.
const MIN_SIDE: usize = 64;
/// Largest width of a tile with its margins: wider ones overlap hardly less.
const MAX_COLUMNS: usize = 8192;

/// Size of the tiles in which a canvas is blended. Their sides lie on multiples of `unit`, the coarsest pixel of the fine bands, or on those of the canvas.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tiling {
    /// By how many pixels a tile is larger than its valid ones on each side.
    margin: usize,
    unit: usize,
    /// Valid rows and columns.
    rows: usize,
    columns: usize,
}

impl Tiling {
    /// Returns the fewest bytes in which a canvas of this width is blended.
    pub(super) fn fewest_bytes<T>(mode: BlendMode, levels: usize, width: usize) -> usize {
        let Self { margin, rows, columns, .. } = Self::smallest(mode, levels);
        finished_bytes::<T>(width) * rows + tile_bytes::<T>() * (rows + 2 * margin) * (columns + 2 * margin).min(width)
    }

    /// Returns the largest tiles that take at most `bytes`, and not less than [`Self::fewest_bytes`].
    pub(super) fn within<T>(bytes: usize, mode: BlendMode, levels: usize, width: usize) -> Self {
        let smallest = Self::smallest(mode, levels);
        let Self { margin, unit, rows, columns } = smallest;
        let (finished, pixel) = (finished_bytes::<T>(width), tile_bytes::<T>());
        let widest = bytes.saturating_sub(finished * rows) / (pixel * (rows + 2 * margin));
        let with_margins =
            widest.clamp((columns + 2 * margin).min(width), MAX_COLUMNS.max(columns + 2 * margin)).min(width);
        let most = bytes.saturating_sub(pixel * 2 * margin * with_margins) / (finished + pixel * with_margins).max(1);
        // A tile as wide as the canvas has no margins left and right.
        let columns = if with_margins == width { width } else { (with_margins - 2 * margin) / unit * unit };
        Self { rows: (most / unit * unit).max(rows), columns, ..smallest }
    }

    fn smallest(mode: BlendMode, levels: usize) -> Self {
        let unit = 1 << levels.min(8);
        let side = MIN_SIDE.next_multiple_of(unit);
        Self { margin: margin(mode, levels).next_multiple_of(unit), unit, rows: side, columns: side }
    }

    /// Returns the tile of valid pixels `inner` with its margins.
    fn with_margins(&self, inner: Bounds, (width, height): (usize, usize)) -> Bounds {
        Bounds {
            left: inner.left.saturating_sub(self.margin),
            top: inner.top.saturating_sub(self.margin),
            right: (inner.right + self.margin).min(width),
            bottom: (inner.bottom + self.margin).min(height),
        }
    }
}

/// Returns the memory in bytes per pixel of a tile: warped photographs that overlap by up to a half, their half resolution, the fine levels, colors and
/// labels.
pub(super) fn tile_bytes<T>() -> usize {
    2 * 4 * size_of::<T>() + 2 * 3 * size_of::<T>() + 2 * 4 + 8 + 8
}

/// Returns the memory in bytes per row of finished strips: colors and labels of the one that is blended and of the one that is being written.
fn finished_bytes<T>(width: usize) -> usize {
    2 * width * (3 * size_of::<T>() + size_of::<u16>())
}

/// Returns by how many pixels a tile must be larger than its valid ones on each side.
fn margin(mode: BlendMode, levels: usize) -> usize {
    match mode {
        BlendMode::Multiband => coarse_margin(levels),
        BlendMode::Feather => FEATHER_MARGIN,
        BlendMode::None | BlendMode::Poisson => 0,
    }
}

/// A canvas that is blended in strips.
pub(super) struct Strips<'a, T> {
    pub(super) photos: &'a WarpedStore<'a, T>,
    pub(super) labels: &'a LabelRows,
    pub(super) typical_side: f64,
    pub(super) levels: usize,
    pub(super) mode: BlendMode,
    pub(super) tiling: Tiling,
}

impl<T: PhotoSample> Strips<'_, T> {
    /// Blends the canvas and hands on its part `shown`.
    pub(super) fn blend(
        &self,
        shown: Bounds,
        photo_of: &[usize],
        output: &mut dyn RowSink<T>,
        progress: &dyn Progress,
    ) -> Result<(), RenderError> {
        let (width, height) = self.labels.size();
        let Tiling { unit, rows, .. } = self.tiling;
        let first = shown.top / unit * unit;
        let bounds = self.photos.bounds();
        let coarse_units = if self.mode == BlendMode::Multiband { bounds.len() } else { 0 };
        let stage = Stage::new(progress, "blend", coarse_units + (shown.bottom - first).div_ceil(rows))?;
        let coarse = if self.mode == BlendMode::Multiband {
            let mut coarse = CoarseLevels::new(width, height, self.levels);
            for (label, bounds) in bounds.iter().enumerate() {
                if let Some(bounds) = *bounds
                    && let Some(photo) = self.photos.crop(label, bounds)?
                {
                    coarse.add((bounds.left, bounds.top), photo, &self.labels.window(bounds), label as u16, &stage)?;
                }
                stage.add(1)?;
            }
            Some(coarse.blended(&stage)?)
        } else {
            None
        };
        // The rows of a strip are handed on while the next one is blended.
        let mut ready: Option<Rows<T>> = None;
        for top in (first..shown.bottom).step_by(rows) {
            let (blended, handed) = rayon::join(
                || self.strip(top, shown, coarse.as_ref(), photo_of, &stage),
                || ready.take().map_or(Ok(()), |rows| output.rows(rows.colors.view(), rows.labels.view())),
            );
            handed?;
            ready = Some(blended?);
            stage.add(1)?;
        }
        if let Some(rows) = ready {
            output.rows(rows.colors.view(), rows.labels.view())?;
        }
        Ok(())
    }

    /// Blends the rows of `shown` of the strip from `top`.
    fn strip(
        &self,
        top: usize,
        shown: Bounds,
        coarse: Option<&CoarseCanvas>,
        photo_of: &[usize],
        stage: &Stage<'_>,
    ) -> Result<Rows<T>, RenderError> {
        let size = self.labels.size();
        let Tiling { unit, rows, columns, .. } = self.tiling;
        let bottom = (top + rows).min(size.1);
        let (from, to) = (top.max(shown.top), bottom.min(shown.bottom));
        let mut strip = Rows {
            colors: Image::new(shown.width(), to - from, [T::default(); 3]),
            labels: Image::new(shown.width(), to - from, [NO_PHOTO]),
        };
        for left in (shown.left / unit * unit..shown.right).step_by(columns) {
            stage.check()?;
            let inner = Bounds { left, top, right: (left + columns).min(size.0), bottom };
            let tile = self.tiling.with_margins(inner, size);
            let photos = self.photos.crops(tile)?;
            let labels = self.labels.window(tile);
            let image = match coarse {
                Some(coarse) => coarse.tile((tile.left, tile.top), &photos, &labels, stage)?,
                None => {
                    let composition = Composition { photos: &photos, labels: &labels, typical_side: self.typical_side };
                    self.mode.blender::<T>().blend(&composition, stage)?
                }
            };
            let (first, end) = (left.max(shown.left), inner.right.min(shown.right));
            for y in from..to {
                let (own, x) = (y - tile.top, first - tile.left);
                let colors = &image.row(own)[3 * x..3 * (end - tile.left)];
                strip.colors.row_mut(y - from)[3 * (first - shown.left)..][..colors.len()].copy_from_slice(colors);
                let names = &labels.row(own)[x..end - tile.left];
                let out = &mut strip.labels.row_mut(y - from)[first - shown.left..][..names.len()];
                for (out, name) in out.iter_mut().zip(names) {
                    *out = photo_of.get(usize::from(*name)).map_or(NO_PHOTO, |&photo| photo as u16);
                }
            }
        }
        Ok(strip)
    }
}

/// Rows of the panorama, and the index of the photograph of each pixel.
struct Rows<T> {
    colors: Image<T, 3>,
    labels: Image<u16, 1>,
}
