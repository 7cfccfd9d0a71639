//! Blending in strips of rows.

use super::{LabelRows, RowSink, WarpedStore};
use crate::bit_depth::PhotoSample;
use crate::blend::{BlendMode, CoarseCanvas, CoarseLevels, Composition, FEATHER_MARGIN, NO_PHOTO, coarse_margin};
use crate::render::RenderError;
use crate::rows::for_each_row;
use crate::surface::Bounds;
use cv_core::{Image, Progress, Stage};

/// Rows of a strip, without its margins, at least.
const MIN_ROWS: usize = 64;

/// Returns the fewest rows of a strip with its margins.
pub(super) fn fewest_rows(mode: BlendMode, levels: usize) -> usize {
    MIN_ROWS + 2 * margin(mode, levels)
}

/// Returns by how many rows a strip is larger than its valid rows on either side.
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
    /// Rows of a strip with its margins.
    pub(super) rows: usize,
}

impl<T: PhotoSample> Strips<'_, T> {
    /// Blends the canvas and hands on its part `shown`. Strips are multiples of the coarsest pixel of the fine bands.
    pub(super) fn blend(
        &self,
        shown: Bounds,
        photo_of: &[usize],
        output: &mut dyn RowSink<T>,
        progress: &dyn Progress,
    ) -> Result<(), RenderError> {
        let (width, height) = self.labels.size();
        let margin = margin(self.mode, self.levels);
        let unit = 1 << self.levels.min(8);
        let rows = (self.rows.saturating_sub(2 * margin).max(MIN_ROWS) / unit).max(1) * unit;
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
                || self.strip(top, rows, margin, unit, shown, coarse.as_ref(), photo_of, &stage),
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

    /// Blends the rows of `shown` from `top`, `rows` at most.
    #[allow(clippy::too_many_arguments)]
    fn strip(
        &self,
        top: usize,
        rows: usize,
        margin: usize,
        unit: usize,
        shown: Bounds,
        coarse: Option<&CoarseCanvas>,
        photo_of: &[usize],
        stage: &Stage<'_>,
    ) -> Result<Rows<T>, RenderError> {
        let (width, height) = self.labels.size();
        let bottom = (top + rows).min(height);
        let strip = Bounds {
            left: 0,
            top: top.saturating_sub(margin) / unit * unit,
            right: width,
            bottom: (bottom + margin).next_multiple_of(unit).min(height),
        };
        let photos = self.photos.crops(strip)?;
        let labels = self.labels.window(strip);
        let image = match coarse {
            Some(coarse) => coarse.strip(strip.top, &photos, &labels, stage)?,
            None => {
                let composition = Composition { photos: &photos, labels: &labels, typical_side: self.typical_side };
                self.mode.blender::<T>().blend(&composition, stage)?
            }
        };
        drop(photos);
        let (from, to) = (top.max(shown.top), bottom.min(shown.bottom));
        let part = Bounds { top: from - strip.top, bottom: to - strip.top, ..shown };
        let (x, y, w, h) = (part.left, part.top, part.width(), part.height());
        let (Some(colors), Some(names)) = (image.view().crop(x, y, w, h), labels.view().crop(x, y, w, h)) else {
            return Ok(Rows { colors: image, labels });
        };
        let mut rows = Rows { colors: colors.to_image(), labels: names.to_image() };
        for_each_row(rows.labels.as_mut_slice(), w, stage, |_, row| {
            row.iter_mut().for_each(|l| *l = photo_of.get(usize::from(*l)).map_or(NO_PHOTO, |&p| p as u16));
        })?;
        Ok(rows)
    }
}

/// Rows of the panorama, and the index of the photograph of each pixel.
struct Rows<T> {
    colors: Image<T, 3>,
    labels: Image<u16, 1>,
}
