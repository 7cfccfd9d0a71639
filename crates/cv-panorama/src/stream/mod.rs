//! Compositing of panoramas larger than memory.
//!
//! Photographs are loaded one after the other, twice: for the gray images of local alignment and the preview, and for warping. Warped photographs go to a
//! scratch file, labels are run-length encoded, seams are refined on the window of one photograph at a time, and the canvas is blended in strips of rows, and
//! these in tiles, that are handed on. The pixels are the same as those of [`render`](crate::render).

mod blend;
mod budget;
mod label_rows;
mod scratch;

pub(crate) use label_rows::LabelRows;
pub(crate) use scratch::WarpedStore;

use crate::align::Alignment;
use crate::bit_depth::PhotoSample;
use crate::blend::NO_PHOTO;
use crate::compensation::Compensation;
use crate::masks::{Filled, PhotoMask, PlacedMasks};
use crate::photometric::Gains;
use crate::regions::{Region, regions};
use crate::render::{CompositingOptions, Drawing, PREVIEW_PIXELS, Panorama, RenderError, check, closed_breaks, draw};
use crate::seams::{self, Seams};
use crate::surface::{
    Bounds, Layout, PhotoMap, Preview, PreviewScale, ROUND_UNITS, WarpedPhoto, displacements_with, downsample_box,
    largest_rectangle_of, layout,
};
use blend::Tiling;
use budget::{Budget, needs_whole};
use cv_core::{Image, ImageView, Mask, Progress, RgbU8, Stage, StageClock};
use cv_parallel::prelude::*;
use scratch::{GrayStore, Scratch};
use std::borrow::Cow;
use std::io::{Read, Seek, Write};

/// Photographs that are loaded when they are needed.
pub trait PhotoSource<T>: Sync
where
    T: PhotoSample,
{
    /// Returns width and height of a photograph; `(0, 0)` where there is none of this index.
    fn size(&self, index: usize) -> (usize, usize);

    /// Loads a photograph, of that size; `None` where it can no longer be read. Called several times, from several threads.
    fn load(&self, index: usize) -> Option<Cow<'_, Image<T, 3>>>;

    /// Returns the mask of a photograph. Default none.
    fn mask(&self, index: usize) -> Option<&PhotoMask> {
        let _ = index;
        None
    }
}

/// The rows of a panorama could not be written; the [`RowSink`] knows why.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct NotWritten;

/// The frame of a streamed panorama.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StreamedFrame {
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// Index of the reference photograph.
    pub reference: usize,
    /// Indices of the registered photographs.
    pub photos: Vec<usize>,
}

/// A warped and exposure-compensated photograph with its mask.
#[derive(Debug, Clone)]
pub struct Layer<T = u8> {
    /// Index of the photograph.
    pub photo: usize,
    /// Its part of the panorama: the bounding box of the whole photograph.
    pub bounds: Bounds,
    /// Red, green, blue, and the mask: white on the side of the seams where this photograph is taken. Outside the mask are the other colors of the photograph,
    /// black beyond its border and where the photographs' masks exclude it.
    pub pixels: Image<T, 4>,
}

/// Receives a panorama row by row.
pub trait RowSink<T>: Send {
    /// Receives the frame, first of all.
    ///
    /// # Errors
    /// [`NotWritten`] ends the work.
    fn begin(&mut self, frame: &StreamedFrame) -> Result<(), NotWritten>;

    /// Returns whether [`layer`](Self::layer) shall be called. Default false.
    fn wants_layers(&self) -> bool {
        false
    }

    /// Receives a photograph before the rows, also one of which no pixel is taken; twice one that lies at both ends of a full circle.
    ///
    /// # Errors
    /// [`NotWritten`] ends the work.
    fn layer(&mut self, layer: Layer<T>) -> Result<(), NotWritten> {
        let _ = layer;
        Ok(())
    }

    /// Receives the next rows: colors, and the index of the photograph of each pixel, [`NO_PHOTO`] where none covers it.
    ///
    /// # Errors
    /// [`NotWritten`] ends the work.
    fn rows(&mut self, colors: ImageView<'_, T, 3>, labels: ImageView<'_, u16, 1>) -> Result<(), NotWritten>;
}

/// A file that is written and read at any place.
pub trait ScratchFile: Read + Write + Seek + Send {}

impl<F: Read + Write + Seek + Send> ScratchFile for F {}

/// Memory for [`render_streamed`].
pub struct MemoryLimit {
    /// Bytes of memory, at most.
    pub bytes: usize,
    /// An empty file for what does not fit: a byte per pixel of the photographs first, then about five bytes per pixel of the panorama (ten for 16 bits).
    pub scratch: Box<dyn ScratchFile>,
}

/// Why streamed compositing failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum StreamError {
    /// The panorama needs more memory, even in strips.
    #[error("a panorama of {width} x {height} pixels takes {} MiB of memory in strips, {} MiB are allowed", needed.div_ceil(1 << 20), allowed >> 20)]
    Memory {
        /// Width of the canvas in pixels.
        width: usize,
        /// Height of the canvas in pixels.
        height: usize,
        /// Bytes needed.
        needed: usize,
        /// Bytes allowed.
        allowed: usize,
    },
    /// The blend mode or output needs the whole canvas in memory.
    #[error("{what} needs the whole panorama of {width} x {height} pixels in memory: {} MiB, {} MiB are allowed", needed.div_ceil(1 << 20), allowed >> 20)]
    Whole {
        /// The blend mode, or "radiance".
        what: &'static str,
        /// Width of the canvas in pixels.
        width: usize,
        /// Height of the canvas in pixels.
        height: usize,
        /// Bytes needed.
        needed: usize,
        /// Bytes allowed.
        allowed: usize,
    },
    /// A photograph can no longer be read, or has another size.
    #[error("photograph {index} cannot be read again")]
    Photograph {
        /// Which.
        index: usize,
    },
    /// The scratch file cannot be written or read.
    #[error("the scratch file cannot be used: {}", os_reason(*os_error))]
    Scratch {
        /// The operating system's error code, where there is one.
        os_error: Option<i32>,
    },
    /// The [`RowSink`] failed.
    #[error("the panorama cannot be written")]
    NotWritten,
}

fn os_reason(code: Option<i32>) -> String {
    code.map_or_else(
        || "it is shorter than written".to_owned(),
        |code| std::io::Error::from_raw_os_error(code).to_string(),
    )
}

impl From<NotWritten> for RenderError {
    fn from(NotWritten: NotWritten) -> Self {
        StreamError::NotWritten.into()
    }
}

/// Composites a panorama within a limit of memory, and hands it on in rows.
///
/// As [`render`](crate::render), to the same pixels; `image`, `mask` and `labels` of the result are empty. Reports as the stages "elastic", "preview", "exposure", "seams",
/// "warp", "seams" again, and "blend", which includes layers and the writing of rows.
///
/// # Errors
/// [`RenderError`]; [`StreamError::Memory`] and [`StreamError::Whole`] before photographs are loaded.
pub fn render_streamed<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    alignment: &Alignment,
    options: &CompositingOptions,
    limit: MemoryLimit,
    output: &mut dyn RowSink<T>,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    T::draw_streamed(photos, alignment, options, limit, output, progress)
}

/// Implements [`render_streamed`].
pub(crate) fn draw_streamed<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    alignment: &Alignment,
    options: &CompositingOptions,
    limit: MemoryLimit,
    output: &mut dyn RowSink<T>,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    let mut clock = StageClock::new();
    let masks: Vec<Option<&PhotoMask>> = (0..alignment.views.len()).map(|index| photos.mask(index)).collect();
    check(|index| photos.size(index), &masks, alignment, options)?;
    let layout = layout(alignment, options.projection, &options.framing, options.resolution, options.max_pixels)?;
    let photo_of: Vec<usize> = layout.placements.iter().map(|p| p.photo).collect();
    let typical_side = layout.typical_side();
    let levels = options.blend.blender::<T>().pyramid_levels(typical_side).min(16);
    let canvas = (layout.width, layout.height);
    let largest: Vec<Bounds> = layout.placements.iter().map(|p| p.bounds).collect();
    let budget = Budget::new::<T>(&layout, &largest, options, levels, limit.bytes)?;
    if needs_whole(options).is_some() {
        return draw_whole(photos, &masks, alignment, options, output, progress);
    }
    let photos: &dyn PhotoSource<T> = &Filled(photos);
    let scratch = Scratch::new(limit.scratch);

    let scale = PreviewScale::new(&layout, options.resolution, PREVIEW_PIXELS);
    let (fields, small) = {
        let stage = Stage::new(progress, "elastic", alignment.views.len() + ROUND_UNITS)?;
        let (grays, small) = loaded(photos, &layout, options.elastic, scale.shrink, &scratch, budget.loads, &stage)?;
        let fields = if options.elastic {
            let each = grays.iter().flatten().map(|((w, h), _)| w * h).max().unwrap_or(1).max(1);
            let store = GrayStore::new(&scratch, grays, budget.work / 2 / each);
            displacements_with(
                &|index| store.get(index).map_err(RenderError::from),
                &masks,
                &layout,
                alignment,
                &stage,
            )?
        } else {
            vec![None; layout.placements.len()]
        };
        (fields, small)
    };
    scratch.clear();
    clock.lap("elastic");
    let mut preview = {
        let stage = Stage::new(progress, "preview", layout.placements.len())?;
        Preview::draw_small(&small, &layout, &fields, scale, &stage)?
    };
    drop(small);
    let placed = PlacedMasks::new(&masks, &layout, &fields);
    let masked = placed.on_preview(&preview, scale, progress)?;
    masked.remove(&mut preview);
    clock.lap("preview");
    let Compensation { gains, adaptation, stacks } = Compensation::apply(
        &mut preview,
        &masked,
        (alignment.views.len(), alignment),
        &layout,
        options.exposure,
        progress,
    )?;
    drop(masked);
    clock.lap("exposure");
    let coarse =
        seams::on_preview(&preview, &photo_of, options.seams, options.radiance, options.removes_transients, progress)?;
    let fields = closed_breaks(&preview, &coarse, &layout, &fields, options, progress)?.unwrap_or(fields);
    let placed = PlacedMasks::new(&masks, &layout, &fields);
    let step = preview.step;
    let regions = regions(&coarse, &preview, &layout, levels);
    drop(preview);
    clock.lap("seams");

    let drawing = Drawing {
        layout: &layout,
        regions: &regions,
        fields: &fields,
        options,
        adaptation: adaptation.as_ref(),
        masks: &placed,
    };
    let mut warped = WarpedStore::new(&scratch);
    {
        let stage = Stage::new(progress, "warp", layout.placements.len())?;
        each_warped(photos, &drawing, &gains, &stage, |_, photo| Ok(warped.push(photo.as_ref())?))?;
    }
    clock.lap("warp");
    let mut labels = LabelRows::new(canvas.0);
    {
        let stage = Stage::new(progress, "seams", 1)?;
        let rows = (budget.work / (blend::tile_bytes::<T>() * canvas.0).max(1)).clamp(1, canvas.1);
        for top in (0..canvas.1).step_by(rows) {
            let strip = Bounds { left: 0, top, right: canvas.0, bottom: (top + rows).min(canvas.1) };
            let crops = warped.crops(strip)?;
            labels.append(&seams::upsample_rows(&coarse, step, top, (canvas.0, strip.height()), &crops, &stage)?);
        }
    }
    if options.seams == Seams::GraphCut && step > 1 {
        seams::refine_in_windows(&mut labels, &warped, step, budget.work, progress)?;
    }
    clock.lap("seams");

    let shown = if options.crop {
        let stage = Stage::new(progress, "crop", 1)?;
        let mut row = vec![NO_PHOTO; canvas.0];
        let inside = |y: usize, mask: &mut [bool]| {
            labels.read_row(y, 0, &mut row);
            mask.iter_mut().zip(&row).for_each(|(inside, label)| *inside = *label != NO_PHOTO);
        };
        largest_rectangle_of(canvas, inside, &stage)?
    } else {
        None
    };
    let shown = shown.unwrap_or(Bounds { left: 0, top: 0, right: canvas.0, bottom: canvas.1 });
    output.begin(&frame((shown.width(), shown.height()), alignment))?;
    if output.wants_layers() {
        layers(photos, &drawing, &gains, (&labels, shown), output, progress)?;
    }
    let tiling = Tiling::within::<T>(budget.work, options.blend, levels, canvas.0);
    let strips = blend::Strips { photos: &warped, labels: &labels, typical_side, levels, mode: options.blend, tiling };
    strips.blend(shown, &photo_of, output, progress)?;
    clock.lap("blend");

    let mut panorama = Panorama {
        size: (shown.width(), shown.height()),
        image: Image::new(0, 0, [T::default(); 3]),
        radiance: None,
        mask: Mask::new(0, 0, [false]),
        labels: Image::new(0, 0, [NO_PHOTO]),
        canvas: layout.canvas,
        map: PhotoMap::new(&layout, fields),
        full_circle: layout.full_circle && shown.width() == canvas.0,
        reaches_beyond: layout.reaches_beyond,
        gains,
        stacks,
        stages: clock.into_stages(),
    };
    panorama.map.crop(shown.left, shown.top);
    panorama.canvas.origin += nalgebra::Vector2::new(shown.left as f64, shown.top as f64);
    Ok(panorama)
}

/// Hands on the layers of the part `shown` of the canvas. Warps the photographs again: for the panorama each is warped only around its label.
fn layers<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    drawing: &Drawing<'_>,
    gains: &Gains,
    (labels, shown): (&LabelRows, Bounds),
    output: &mut dyn RowSink<T>,
    progress: &dyn Progress,
) -> Result<(), RenderError> {
    let placements = &drawing.layout.placements;
    let visible = placements.iter().map(|placement| placement.bounds.intersection(&shown));
    let regions: Vec<Option<Region>> = visible.map(|bounds| bounds.map(Region::whole)).collect();
    let stage = Stage::new(progress, "blend", placements.len())?;
    each_warped(photos, &Drawing { regions: &regions, ..*drawing }, gains, &stage, |k, photo| {
        let Some(WarpedPhoto { bounds, mut pixels }) = photo else { return Ok(()) };
        let mut row = vec![NO_PHOTO; bounds.width()];
        for y in 0..bounds.height() {
            labels.read_row(bounds.top + y, bounds.left, &mut row);
            for (pixel, label) in pixels.row_mut(y).as_chunks_mut::<4>().0.iter_mut().zip(&row) {
                if pixel[3] == T::default() {
                    *pixel = [T::default(); 4];
                }
                pixel[3] = if usize::from(*label) == k { T::WHITE } else { T::default() };
            }
        }
        Ok(output.layer(Layer { photo: placements[k].photo, bounds: bounds.relative_to(&shown), pixels })?)
    })
}

fn frame(size: (usize, usize), alignment: &Alignment) -> StreamedFrame {
    StreamedFrame { size, reference: alignment.reference, photos: alignment.used().map(|(index, _)| index).collect() }
}

/// Composites in memory what cannot be blended in strips, where it fits.
fn draw_whole<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    masks: &[Option<&PhotoMask>],
    alignment: &Alignment,
    options: &CompositingOptions,
    output: &mut dyn RowSink<T>,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    let no_image = || Cow::Owned(Image::new(0, 0, [T::default(); 3]));
    let load = |(index, view): (usize, &Result<_, _>)| match view {
        Ok(_) => load(photos, index),
        Err(_) => Ok(no_image()),
    };
    let images: Vec<Cow<'_, Image<T, 3>>> =
        alignment.views.iter().enumerate().map(load).collect::<Result<_, StreamError>>()?;
    let views: Vec<ImageView<'_, T, 3>> = images.iter().map(|image| image.view()).collect();
    let mut panorama = draw(&views, masks, alignment, options, options.blend.blender(), progress)?;
    output.begin(&frame(panorama.size, alignment))?;
    output.rows(panorama.image.view(), panorama.labels.view())?;
    panorama.image = no_image().into_owned();
    (panorama.mask, panorama.labels) = (Mask::new(0, 0, [false]), Image::new(0, 0, [NO_PHOTO]));
    Ok(panorama)
}

/// Size and position in a scratch file of each gray image.
type GrayPlaces = Vec<Option<((usize, usize), u64)>>;

/// Loads a photograph and checks its size.
fn load<T: PhotoSample>(photos: &dyn PhotoSource<T>, index: usize) -> Result<Cow<'_, Image<T, 3>>, StreamError> {
    let photo = photos.load(index).filter(|photo| photo.size() == photos.size(index));
    photo.ok_or(StreamError::Photograph { index })
}

/// Loads every placed photograph, `loads` at a time, and writes its gray image to the scratch file if `grays`; returns their places and the photographs
/// downsampled by `shrink`.
fn loaded<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    layout: &Layout,
    grays: bool,
    shrink: usize,
    scratch: &Scratch,
    loads: usize,
    stage: &Stage<'_>,
) -> Result<(GrayPlaces, Vec<Option<RgbU8>>), RenderError> {
    let count = layout.placements.iter().map(|p| p.photo + 1).max().unwrap_or(0);
    let mut is_placed = vec![false; count];
    layout.placements.iter().for_each(|p| is_placed[p.photo] = true);
    type Entry = (Option<((usize, usize), u64)>, Option<RgbU8>);
    let one = |index: usize| -> Result<Entry, RenderError> {
        if !is_placed[index] {
            stage.add(1)?;
            return Ok((None, None));
        }
        let photo = load(photos, index)?;
        let copy = T::in_8_bits(photo.view(), stage)?;
        let bytes = copy.as_ref().map(RgbU8::view).or_else(|| T::as_bytes(photo.view()));
        let bytes = bytes.ok_or(StreamError::Photograph { index })?;
        let place = if grays {
            let gray = cv_imgproc::rgb_to_gray(bytes);
            Some((gray.size(), scratch.append(gray.as_slice())?))
        } else {
            None
        };
        let small = downsample_box(bytes, shrink, stage)?;
        stage.add(1)?;
        Ok((place, Some(small)))
    };
    let indices: Vec<usize> = (0..count).collect();
    let mut all = (Vec::with_capacity(count), Vec::with_capacity(count));
    for batch in indices.chunks(loads) {
        let entries: Vec<Entry> = batch.par_iter().map(|&index| one(index)).try_collect::<_, RenderError>()?;
        all.extend(entries);
    }
    Ok(all)
}

/// Warps every placement to its region of the canvas and hands it on, `None` without a region. The next photograph is loaded meanwhile.
fn each_warped<T: PhotoSample>(
    photos: &dyn PhotoSource<T>,
    drawing: &Drawing<'_>,
    gains: &Gains,
    stage: &Stage<'_>,
    mut hand_on: impl FnMut(usize, Option<WarpedPhoto<T>>) -> Result<(), RenderError>,
) -> Result<(), RenderError> {
    let placements = &drawing.layout.placements;
    let tone = gains.adapted_tone(drawing.adaptation, T::PARTS);
    let load = |k: usize| -> Result<Option<Cow<'_, Image<T, 3>>>, StreamError> {
        let needed = placements.get(k).filter(|_| drawing.regions[k].is_some());
        needed.map(|p| load(photos, p.photo)).transpose()
    };
    let mut current = load(0)?;
    for k in 0..placements.len() {
        let draw = || -> Result<Option<WarpedPhoto<T>>, RenderError> {
            let (Some(photo), Some(region)) = (&current, &drawing.regions[k]) else { return Ok(None) };
            Ok(Some(drawing.warped_one(photo.view(), k, region, gains, &tone, stage)?))
        };
        let (piece, next) = rayon::join(draw, || load(k + 1));
        hand_on(k, piece?)?;
        current = next?;
        stage.add(1)?;
    }
    Ok(())
}
