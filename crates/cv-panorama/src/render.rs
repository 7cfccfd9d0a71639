//! Compositing: from aligned photographs to the panorama.

use crate::align::Alignment;
use crate::bit_depth::{Channel, EightBits, PhotoSample};
use crate::blend::{BlendMode, Blender, Composition, NO_PHOTO, of_mode};
use crate::compensation::Compensation;
use crate::masks::{PhotoMask, PlacedMasks, filled};
use crate::photometric::{
    Adaptation, Exposure, ExposureCorrection, Gains, Tone, decode_radiance, fill_saturated, relative_gains,
};
use crate::regions::{Region, regions};
use crate::rows::for_each_row;
use crate::seams::{self, Seams};
use crate::stream::StreamError;
use crate::surface::{
    Bounds, Canvas, DisplacementField, Framing, Layout, LayoutError, PhotoMap, Placement, Preview, PreviewScale,
    Projection, WarpSettings, WarpedPhoto, close_breaks, displacements, downsampled_view, largest_rectangle, layout,
    max_displacement, warp,
};
use cv_core::{Cancelled, Image, ImageView, Mask, OptionError, Progress, RgbF32, Sample, Stage, StageClock};
use cv_imgproc::{Interpolation, resize_area};

/// Options of [`render`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CompositingOptions {
    /// Projection. Default [`Projection::Auto`].
    pub projection: Projection,
    /// Orientation and field of view. Default the extent of the photographs, at most [`Projection::widest_field`].
    pub framing: Framing,
    /// Resolution of the panorama relative to the photographs: at 1 the center of a photograph of median focal length keeps its scale. Above 0; default 1.
    pub resolution: f64,
    /// Local alignment by smooth displacement fields, which compensates small parallax, and larger parallax of objects that seams cut. Default true.
    pub elastic: bool,
    /// Exposure compensation. Default [`Exposure::Match`].
    pub exposure: Exposure,
    /// Seam finding. Default [`Seams::GraphCut`].
    pub seams: Seams,
    /// Where three or more photographs cover a pixel, prefer those near their median, so that objects that move from one to the next vanish; for
    /// [`Seams::GraphCut`]. Default false.
    pub removes_transients: bool,
    /// Blending. Default [`BlendMode::Multiband`].
    pub blend: BlendMode,
    /// Interpolation kernel. Default bicubic: a few milliseconds per megapixel more than bilinear, but sharper.
    pub interpolation: Interpolation,
    /// Also compute the linear radiance ([`Panorama::radiance`]), clipped pixels filled from photographs that are not clipped there. Default false.
    pub radiance: bool,
    /// Crop to the largest axis-aligned rectangle without empty pixels. Default false.
    pub crop: bool,
    /// Maximum number of canvas pixels. Default 400 million, for which blending needs some 12 GB.
    pub max_pixels: usize,
}

impl Default for CompositingOptions {
    fn default() -> Self {
        Self {
            projection: Projection::Auto,
            framing: Framing::default(),
            resolution: 1.0,
            elastic: true,
            exposure: Exposure::default(),
            seams: Seams::default(),
            removes_transients: false,
            blend: BlendMode::default(),
            interpolation: Interpolation::Bicubic,
            radiance: false,
            crop: false,
            max_pixels: 400_000_000,
        }
    }
}

/// Why compositing failed.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum RenderError {
    /// The canvas cannot be laid out.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// A photograph does not have the size that was aligned.
    #[error("photograph {index} is {width}x{height}; {expected_width}x{expected_height} was aligned")]
    WrongPhoto {
        /// Which.
        index: usize,
        /// Its width.
        width: usize,
        /// Its height.
        height: usize,
        /// The width that was aligned; 0 where no such photograph was.
        expected_width: usize,
        /// The height that was aligned.
        expected_height: usize,
    },
    /// A mask does not have the size of its photograph.
    #[error("the mask of photograph {index} is {width}x{height}, the photograph {expected_width}x{expected_height}")]
    WrongMask {
        /// Which.
        index: usize,
        /// Width of the mask.
        width: usize,
        /// Height of the mask.
        height: usize,
        /// Width of the photograph; 0 where there is none of this index.
        expected_width: usize,
        /// Height of the photograph.
        expected_height: usize,
    },
    /// The blender returned an image of another size than the canvas.
    #[error("the blender gave {width}x{height} pixels for a canvas of {expected_width}x{expected_height}")]
    WrongBlend {
        /// Width of the image.
        width: usize,
        /// Height of the image.
        height: usize,
        /// Width of the canvas.
        expected_width: usize,
        /// Height of the canvas.
        expected_height: usize,
    },
    /// Streamed compositing failed ([`render_streamed`](crate::render_streamed)).
    #[error(transparent)]
    Stream(#[from] StreamError),
    /// The work was stopped by its progress callback.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// An option is outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
}

/// A panorama.
#[derive(Debug, Clone)]
pub struct Panorama<T = u8> {
    /// Width and height in pixels.
    pub size: (usize, usize),
    /// The image, of the bit depth of the photographs; black where no photograph covers it. As `mask` and `labels`, empty where the panorama was
    /// [streamed](crate::render_streamed).
    pub image: Image<T, 3>,
    /// Linear scene radiance, if requested by [`CompositingOptions::radiance`]: not tone-mapped, in the primaries of the photographs; 1 is white at the center of the reference photograph.
    /// Pixels clipped in every photograph are lower bounds. With [`Exposure::None`] each photograph keeps its exposure. 0 where no photograph covers it.
    pub radiance: Option<RgbF32>,
    /// True where a photograph covers the pixel.
    pub mask: Mask,
    /// Index of the photograph of each pixel; [`NO_PHOTO`] where none covers it.
    pub labels: Image<u16, 1>,
    /// Projection geometry.
    pub canvas: Canvas,
    /// Map from its pixels to photograph pixels.
    pub map: PhotoMap,
    /// Whether it spans 360°: the right edge continues at the left one.
    pub full_circle: bool,
    /// Whether photographs extend beyond the maximum field of view of the projection and none was requested.
    pub reaches_beyond: bool,
    /// Photometric parameters.
    pub gains: Gains,
    /// Exposure brackets: photographs of the same view with different exposures, by ascending indices; at least two each. Their seams prefer the best exposed of them where it is not clipped.
    pub stacks: Vec<Vec<usize>>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Number of pixels of the preview on which seams are found.
pub(crate) const PREVIEW_PIXELS: usize = 300_000;

/// Composites the panorama.
///
/// `photos` are the aligned photographs, in the same order, at full size; the panorama has their sample type, `u8` or `u16`. Seams and exposure are estimated on 8 bits. The
/// alignment may be that of resized photographs ([`Alignment::resized`]). O(canvas + pixels of the photographs); seams are found on a preview of bounded size first.
/// Reports as the stages "elastic", "preview", "exposure", "seams", "warp", "seams" again, "blend" and "crop".
///
/// # Errors
/// [`RenderError`].
pub fn render<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    alignment: &Alignment,
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    render_with(photos, alignment, options, options.blend.blender(), progress)
}

/// As [`render`], with the caller's blender instead of `options.blend`.
///
/// # Errors
/// [`RenderError`].
pub fn render_with<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    alignment: &Alignment,
    options: &CompositingOptions,
    blender: &dyn Blender<T>,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    T::draw(photos, &[], alignment, options, blender, progress)
}

/// As [`render`], with the masks of the photographs; fewer than photographs where the last have none.
///
/// # Errors
/// [`RenderError`].
pub fn render_masked<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    masks: &[Option<&PhotoMask>],
    alignment: &Alignment,
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    T::draw(photos, masks, alignment, options, options.blend.blender(), progress)
}

/// Implements [`render_with`] and [`render_masked`].
pub(crate) fn draw<T: PhotoSample>(
    photos: &[ImageView<'_, T, 3>],
    masks: &[Option<&PhotoMask>],
    alignment: &Alignment,
    options: &CompositingOptions,
    blender: &dyn Blender<T>,
    progress: &dyn Progress,
) -> Result<Panorama<T>, RenderError> {
    let mut clock = StageClock::new();
    check(|index| photos.get(index).map_or((0, 0), ImageView::size), masks, alignment, options)?;
    let filled = filled(photos, masks, progress)?;
    let photos: Vec<ImageView<'_, T, 3>> = photos
        .iter()
        .enumerate()
        .map(|(i, photo)| filled.get(i).and_then(Option::as_ref).map_or(*photo, Image::view))
        .collect();
    let photos = &photos[..];
    let layout = layout(alignment, options.projection, &options.framing, options.resolution, options.max_pixels)?;
    let photo_of: Vec<usize> = layout.placements.iter().map(|p| p.photo).collect();
    let eight = EightBits::new(photos, "elastic", progress)?;
    let bytes = eight.views();
    let fields = if options.elastic {
        displacements(&bytes, masks, &layout, alignment, progress)?
    } else {
        vec![None; layout.placements.len()]
    };
    clock.lap("elastic");
    let mut preview = Preview::draw(&bytes, &layout, &fields, options.resolution, PREVIEW_PIXELS, progress)?;
    drop(eight);
    let placed = PlacedMasks::new(masks, &layout, &fields);
    let scale = PreviewScale::new(&layout, options.resolution, PREVIEW_PIXELS);
    let masked = placed.on_preview(&preview, scale, progress)?;
    masked.remove(&mut preview);
    clock.lap("preview");
    let Compensation { gains, adaptation, stacks } =
        Compensation::apply(&mut preview, &masked, (photos.len(), alignment), &layout, options.exposure, progress)?;
    drop(masked);
    clock.lap("exposure");
    let coarse =
        seams::on_preview(&preview, &photo_of, options.seams, options.radiance, options.removes_transients, progress)?;
    let fields = closed_breaks(&preview, &coarse, &layout, &fields, options, progress)?.unwrap_or(fields);
    let placed = PlacedMasks::new(masks, &layout, &fields);
    clock.lap("seams");

    let typical_side = layout.typical_side();
    // No canvas has more levels.
    let levels = blender.pyramid_levels(typical_side).min(16);
    let regions = regions(&coarse, &preview, &layout, levels);
    let drawing = Drawing {
        layout: &layout,
        regions: &regions,
        fields: &fields,
        options,
        adaptation: adaptation.as_ref(),
        masks: &placed,
    };
    let warped = drawing.warped(photos, &gains, progress)?;
    clock.lap("warp");
    let mut labels = {
        let stage = Stage::new(progress, "seams", 1)?;
        seams::upsample(&coarse, preview.step, (layout.width, layout.height), &warped, &stage)?
    };
    if options.seams == Seams::GraphCut && preview.step > 1 {
        let stage = Stage::new(progress, "seams", 1)?;
        let bytes = T::drawn_in_8_bits(&warped, &stage)?;
        seams::refine(&mut labels, &bytes, preview.step, progress)?;
    }
    clock.lap("seams");
    let image = blender.blend(&Composition { photos: &warped, labels: &labels, typical_side }, progress)?;
    if image.size() != labels.size() {
        let ((width, height), (expected_width, expected_height)) = (image.size(), labels.size());
        return Err(RenderError::WrongBlend { width, height, expected_width, expected_height });
    }
    clock.lap("blend");
    let radiance = if options.radiance {
        drop(warped);
        let relative = relative_gains(&gains, alignment.reference);
        let radiance = drawing.radiance(photos, &relative, progress)?;
        let composition = Composition { photos: &radiance, labels: &labels, typical_side };
        let mut radiance = of_mode::<f32>(options.blend).blend(&composition, progress)?;
        // Blending may overshoot below zero.
        radiance.as_mut_slice().iter_mut().for_each(|v| *v = v.max(0.0));
        clock.lap("radiance");
        Some(radiance)
    } else {
        None
    };
    let stage = Stage::new(progress, "crop", 2)?;
    let mut mask = Mask::new(layout.width, layout.height, [false]);
    for_each_row(mask.as_mut_slice(), layout.width, &stage, |y, row| {
        row.iter_mut().zip(labels.row(y)).for_each(|(inside, label)| *inside = *label != NO_PHOTO);
    })?;
    for_each_row(labels.as_mut_slice(), layout.width, &stage, |_, row| {
        row.iter_mut().for_each(|l| *l = photo_of.get(usize::from(*l)).map_or(NO_PHOTO, |&p| p as u16));
    })?;
    stage.add(1)?;
    let mut panorama = Panorama {
        size: image.size(),
        image,
        radiance,
        mask,
        labels,
        canvas: layout.canvas,
        map: PhotoMap::new(&layout, fields),
        full_circle: layout.full_circle,
        reaches_beyond: layout.reaches_beyond,
        gains,
        stacks,
        stages: Vec::new(),
    };
    if options.crop {
        crop(&mut panorama, &stage)?;
        clock.lap("crop");
    }
    stage.add(1)?;
    panorama.stages = clock.into_stages();
    Ok(panorama)
}

/// Returns the displacement fields that close the breaks of objects at the seams of the preview; `None` without local alignment and without breaks.
pub(crate) fn closed_breaks(
    preview: &Preview,
    coarse: &Image<u16, 1>,
    layout: &Layout,
    fields: &[Option<DisplacementField>],
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<Option<Vec<Option<DisplacementField>>>, Cancelled> {
    if !options.elastic {
        return Ok(None);
    }
    let stage = Stage::new(progress, "seams", 1)?;
    let photo_of: Vec<usize> = layout.placements.iter().map(|p| p.photo).collect();
    let max_displacement = (max_displacement(layout) / preview.step as f64).ceil() as usize;
    let ties = seams::find_breaks(preview, coarse, &photo_of, max_displacement, &stage)?;
    let closed = if ties.is_empty() { None } else { Some(close_breaks(fields, &ties, preview.step, layout, &stage)?) };
    stage.add(1)?;
    Ok(closed)
}

/// Checks the sizes of the photographs and their masks, and the options.
pub(crate) fn check(
    size_of_photo: impl Fn(usize) -> (usize, usize),
    masks: &[Option<&PhotoMask>],
    alignment: &Alignment,
    options: &CompositingOptions,
) -> Result<(), RenderError> {
    OptionError::check("resolution", options.resolution, "a positive number", |v| v > 0.0 && v.is_finite())?;
    options.framing.check()?;
    for (index, view) in alignment.used() {
        let (expected_width, expected_height) = (view.camera.width, view.camera.height);
        let (width, height) = size_of_photo(index);
        if (width, height) != (expected_width, expected_height) {
            return Err(RenderError::WrongPhoto { index, width, height, expected_width, expected_height });
        }
    }
    check_masks(size_of_photo, masks)
}

/// Checks the sizes of masks.
///
/// # Errors
/// [`RenderError::WrongMask`].
pub fn check_masks(
    size_of_photo: impl Fn(usize) -> (usize, usize),
    masks: &[Option<&PhotoMask>],
) -> Result<(), RenderError> {
    for (index, mask) in masks.iter().enumerate().filter_map(|(index, mask)| Some((index, (*mask)?))) {
        let ((width, height), (expected_width, expected_height)) = (mask.size(), size_of_photo(index));
        if (width, height) != (expected_width, expected_height) {
            return Err(RenderError::WrongMask { index, width, height, expected_width, expected_height });
        }
    }
    Ok(())
}

/// Inputs of warping.
pub(crate) struct Drawing<'a> {
    pub(crate) layout: &'a Layout,
    pub(crate) regions: &'a [Option<Region>],
    pub(crate) fields: &'a [Option<DisplacementField>],
    pub(crate) options: &'a CompositingOptions,
    pub(crate) adaptation: Option<&'a Adaptation>,
    pub(crate) masks: &'a PlacedMasks<'a>,
}

impl Drawing<'_> {
    /// Returns the factor of the box filter that is applied before warping against aliasing.
    fn shrink(&self) -> usize {
        ((1.0 / self.options.resolution).floor() as usize).max(1)
    }

    /// Warps every placement to its region.
    fn warped<T: PhotoSample>(
        &self,
        photos: &[ImageView<'_, T, 3>],
        gains: &Gains,
        progress: &dyn Progress,
    ) -> Result<Vec<Option<WarpedPhoto<T>>>, Cancelled> {
        let stage = Stage::new(progress, "warp", self.layout.placements.len())?;
        let tone = gains.adapted_tone(self.adaptation, T::PARTS);
        let draw = |k: usize, region: &Region| {
            self.warped_one(photos[self.layout.placements[k].photo], k, region, gains, &tone, &stage)
        };
        self.each(draw, &stage)
    }

    /// Warps a photograph to the region of placement `k`.
    pub(crate) fn warped_one<T: PhotoSample>(
        &self,
        photo: ImageView<'_, T, 3>,
        k: usize,
        region: &Region,
        gains: &Gains,
        tone: &Tone,
        stage: &Stage<'_>,
    ) -> Result<WarpedPhoto<T>, Cancelled> {
        let is_corrected = self.options.exposure != Exposure::None;
        let photo_index = self.layout.placements[k].photo;
        let correction =
            is_corrected.then(|| ExposureCorrection::new(tone, gains, photo_index).adapted(self.adaptation));
        let shrink = self.shrink();
        if shrink == 1 {
            return self.warp(photo, k, region.bounds, Some(region), correction, stage);
        }
        let small = T::shrunk(photo, shrink, stage)?;
        self.warp(small.view(), k, region.bounds, Some(region), correction, stage)
    }

    /// Warps the linear radiance of every placement to its region; clipped pixels are filled from the others.
    fn radiance<T: PhotoSample>(
        &self,
        photos: &[ImageView<'_, T, 3>],
        gains: &Gains,
        progress: &dyn Progress,
    ) -> Result<Vec<Option<WarpedPhoto<f32>>>, Cancelled> {
        let stage = Stage::new(progress, "radiance", self.layout.placements.len() + 1)?;
        let (shrink, tone) = (self.shrink(), gains.tone(1));
        // The whole bounds: a clipped pixel is filled from photographs whose label may be far.
        let draw = |k: usize, region: &Region| {
            let index = self.layout.placements[k].photo;
            let photo = decode_radiance(photos[index], gains, &stage)?;
            let correction = Some(ExposureCorrection::new(&tone, gains, index));
            let size = ((photo.width() / shrink).max(1), (photo.height() / shrink).max(1));
            // Incomplete blocks are dropped.
            let whole =
                photo.view().crop(0, 0, (size.0 * shrink).min(photo.width()), (size.1 * shrink).min(photo.height()));
            match whole.filter(|_| shrink > 1).and_then(|whole| resize_area(whole, size.0, size.1).ok()) {
                Some(small) => self.warp(small.view(), k, region.bounds, None, correction, &stage),
                None => self.warp(photo.view(), k, region.bounds, None, correction, &stage),
            }
        };
        let mut drawn = self.each(draw, &stage)?;
        fill_saturated(&mut drawn, &stage)?;
        stage.add(1)?;
        Ok(drawn)
    }

    /// Calls `draw` with the index and the region of every placement that has one, one after the other.
    fn each<D>(
        &self,
        draw: impl Fn(usize, &Region) -> Result<D, Cancelled>,
        stage: &Stage<'_>,
    ) -> Result<Vec<Option<D>>, Cancelled> {
        let mut drawn = Vec::with_capacity(self.regions.len());
        for (k, region) in self.regions.iter().enumerate() {
            drawn.push(region.as_ref().map(|region| draw(k, region)).transpose()?);
            stage.add(1)?;
        }
        Ok(drawn)
    }

    /// Warps the photograph of a placement, possibly downsampled, to `bounds`, where `region` is given to its spans only.
    fn warp<D: Channel>(
        &self,
        photo: ImageView<'_, D, 3>,
        k: usize,
        bounds: Bounds,
        region: Option<&Region>,
        correction: Option<ExposureCorrection<'_>>,
        stage: &Stage<'_>,
    ) -> Result<WarpedPhoto<D>, Cancelled> {
        let (placement, field) = (&self.layout.placements[k], self.fields[k].as_ref());
        let (shrink, interpolation) = (self.shrink(), self.options.interpolation);
        if shrink == 1 {
            let settings = WarpSettings { displacement: field, interpolation, correction, region };
            let mut warped = warp(photo, placement, &self.layout.surface, bounds, settings, stage)?;
            self.masks.clear(k, &mut warped, self.regions, stage)?;
            return Ok(warped);
        }
        let placement = Placement { view: downsampled_view(placement, shrink, photo.size()), ..*placement };
        let field = field.map(|f| f.scaled(1.0, 1.0 / shrink as f64));
        let settings = WarpSettings { displacement: field.as_ref(), interpolation, correction, region };
        let mut warped = warp(photo, &placement, &self.layout.surface, bounds, settings, stage)?;
        self.masks.clear(k, &mut warped, self.regions, stage)?;
        Ok(warped)
    }
}

/// Crops a panorama to the largest rectangle without empty pixels.
fn crop<T: Sample>(p: &mut Panorama<T>, stage: &Stage<'_>) -> Result<(), Cancelled> {
    let Some(b) = largest_rectangle(p.mask.view(), stage)? else { return Ok(()) };
    let (w, h) = (b.width(), b.height());
    p.full_circle &= w == p.image.width();
    p.size = (w, h);
    if let Some(view) = p.image.view().crop(b.left, b.top, w, h) {
        p.image = view.to_image();
    }
    if let Some(view) = p.radiance.as_ref().and_then(|radiance| radiance.view().crop(b.left, b.top, w, h)) {
        p.radiance = Some(view.to_image());
    }
    if let Some(view) = p.labels.view().crop(b.left, b.top, w, h) {
        p.labels = view.to_image();
    }
    if let Some(view) = p.mask.view().crop(b.left, b.top, w, h) {
        p.mask = view.to_image();
    }
    p.map.crop(b.left, b.top);
    p.canvas.origin += nalgebra::Vector2::new(b.left as f64, b.top as f64);
    Ok(())
}
