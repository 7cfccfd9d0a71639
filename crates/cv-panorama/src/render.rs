//! From aligned photographs to the picture.

use crate::align::Alignment;
use crate::blend::{self, Blender, Exposure, Gains};
use crate::seams::{self, Labels, NONE, Seams, Toned};
use crate::surface::{
    self, Bounds, Canvas, Layout, LayoutError, PhotoMap, Placement, Preview, Projection, Tone, Warped,
    largest_rectangle, shrunk, shrunk_view, warp,
};
use cv_core::{Image, ImageView, Mask, OptionError, RgbU8, StageClock};
use cv_imgproc::Interpolation;
use rayon::prelude::*;

/// How photographs are joined at the seams.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Blend {
    /// Each frequency band over a transition as wide as itself (Burt & Adelson 1983).
    #[default]
    Multiband,
    /// In the gradient domain (Pérez et al. 2003): differences at the seams are spread over the whole picture, which keeps its own border free.
    Poisson,
    /// A short linear transition.
    Feather,
    /// Hard seams.
    None,
}

/// Options of [`render`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CompositingOptions {
    /// The surface. Default [`Projection::Auto`].
    pub projection: Projection,
    /// Size of the panorama relative to the photographs: 1 draws the middle of a photograph of median focal length pixel for pixel. Above 0; default 1.
    pub resolution: f64,
    /// Deform photographs slightly and smoothly so that they meet where the camera did not turn about its center. Default true.
    pub elastic: bool,
    /// Exposure compensation. Default [`Exposure::Gain`].
    pub exposure: Exposure,
    /// Seam finding. Default [`Seams::GraphCut`].
    pub seams: Seams,
    /// Blending. Default [`Blend::Multiband`].
    pub blend: Blend,
    /// How values between pixels are found. Default bicubic: sharper than what other stitchers do, at a few milliseconds a megapixel.
    pub interpolation: Interpolation,
    /// Cut the result to the largest upright rectangle without empty pixels. Default false.
    pub crop: bool,
    /// Most pixels of the canvas. Default 400 million, for which blending needs some 12 GB.
    pub max_pixels: usize,
}

impl Default for CompositingOptions {
    fn default() -> Self {
        Self {
            projection: Projection::Auto,
            resolution: 1.0,
            elastic: true,
            exposure: Exposure::default(),
            seams: Seams::default(),
            blend: Blend::default(),
            interpolation: Interpolation::Bicubic,
            crop: false,
            max_pixels: 400_000_000,
        }
    }
}

/// Why a panorama could not be drawn.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
pub enum RenderError {
    /// There is no canvas.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// The photographs are not those that were aligned.
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
    /// An option is outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
}

/// A panorama.
#[derive(Debug, Clone)]
pub struct Panorama {
    /// The picture; black where no photograph reaches.
    pub image: RgbU8,
    /// True where a photograph reaches.
    pub mask: Mask,
    /// Which photograph each pixel is from; [`u16::MAX`] where none reaches.
    pub labels: Image<u16, 1>,
    /// Where its pixels look.
    pub canvas: Canvas,
    /// Where in its photograph each pixel comes from.
    pub map: PhotoMap,
    /// True where the right edge continues at the left one.
    pub full_circle: bool,
    /// What each photograph was multiplied with.
    pub gains: Gains,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Pixels of the preview on which seams are found.
const PREVIEW_PIXELS: usize = 300_000;

/// Draws the panorama.
///
/// `photos` are those that were aligned, in the same order, in full size; `alignment` may have been made at another size and scaled.
/// Costs O(canvas + pixels of the photographs), with the seams found on a preview of bounded size.
///
/// # Errors
/// [`RenderError`].
pub fn render(
    photos: &[ImageView<'_, u8, 3>],
    alignment: &Alignment,
    options: &CompositingOptions,
) -> Result<Panorama, RenderError> {
    let mut clock = StageClock::new();
    OptionError::check("resolution", options.resolution, "a positive number", |v| v > 0.0 && v.is_finite())?;
    for (index, view) in alignment.used() {
        let (expected_width, expected_height) = (view.camera.width, view.camera.height);
        let (width, height) = photos.get(index).map_or((0, 0), ImageView::size);
        if (width, height) != (expected_width, expected_height) {
            return Err(RenderError::WrongPhoto { index, width, height, expected_width, expected_height });
        }
    }
    let layout = surface::layout(alignment, options.projection, options.resolution, options.max_pixels)?;
    let photo_of: Vec<usize> = layout.placements.iter().map(|p| p.photo).collect();
    let fields =
        if options.elastic { surface::fields(photos, &layout, alignment) } else { vec![None; layout.placements.len()] };
    clock.lap("elastic");
    let preview = Preview::draw(photos, &layout, &fields, options.resolution, PREVIEW_PIXELS);
    clock.lap("preview");
    let gains = blend::estimate(&preview, &photo_of, photos.len(), options.exposure);
    clock.lap("exposure");
    let per_piece: Vec<[f32; 3]> = photo_of.iter().map(|&p| gains.gains[p]).collect();
    let coarse = seams::on_preview(&preview, &per_piece, &photo_of, options.seams);
    clock.lap("seams");

    let bands = bands(&layout);
    let margin = match options.blend {
        Blend::Multiband => bands,
        Blend::Poisson | Blend::Feather | Blend::None => 4,
    };
    let regions = regions(&coarse, &preview, &layout, margin);
    // A photograph drawn smaller is averaged first, or fine texture would alias.
    let pieces: Vec<Option<Warped>> = layout
        .placements
        .iter()
        .zip(&regions)
        .zip(&fields)
        .map(|((placement, region), field)| {
            let region = (*region)?;
            let tone = Tone { gain: gains.gains[placement.photo], vignetting: gains.vignetting };
            let shrink = ((1.0 / options.resolution).floor() as usize).max(1);
            let photo = photos[placement.photo];
            if shrink == 1 {
                return Some(warp(
                    photo,
                    placement,
                    &layout.surface,
                    region,
                    field.as_ref(),
                    options.interpolation,
                    tone,
                ));
            }
            let small = shrunk(photo, shrink);
            let placement = Placement { view: shrunk_view(placement, shrink, &small), ..*placement };
            let field = field.as_ref().map(|f| f.scaled(1.0, 1.0 / shrink as f64));
            Some(warp(small.view(), &placement, &layout.surface, region, field.as_ref(), options.interpolation, tone))
        })
        .collect();
    clock.lap("warp");
    let mut labels = enlarge(&coarse, &preview, &layout, &pieces);
    if options.seams == Seams::GraphCut && preview.step > 1 {
        let toned: Vec<Option<Toned<'_>>> =
            pieces.iter().map(|p| p.as_ref().map(|p| Toned::new(p, [1.0; 3]))).collect();
        seams::refine(&mut labels, &toned, 2 * preview.step);
    }
    clock.lap("seams");
    let image = match options.blend {
        Blend::Multiband => {
            let mut blender = Blender::new(layout.width, layout.height, bands);
            for (label, piece) in pieces.iter().enumerate() {
                if let Some(piece) = piece {
                    blender.add(piece, &labels, label as u16);
                }
            }
            blender.finish(&labels)
        }
        Blend::Poisson => blend::poisson(&pieces, &labels),
        Blend::Feather => blend::feather(&pieces, &labels),
        Blend::None => blend::copy(&pieces, &labels),
    };
    clock.lap("blend");
    let mask = Mask::from_vec(layout.width, layout.height, labels.data.iter().map(|l| *l != NONE).collect())
        .unwrap_or_else(|_| Mask::new(0, 0, [false]));
    let names = labels.data.iter().map(|&l| photo_of.get(usize::from(l)).map_or(NONE, |&p| p as u16)).collect();
    let labels = Image::from_vec(layout.width, layout.height, names).unwrap_or_else(|_| Image::new(0, 0, [NONE]));
    let mut panorama = Panorama {
        image,
        mask,
        labels,
        canvas: layout.canvas,
        map: PhotoMap::new(&layout, fields),
        full_circle: layout.full_circle,
        gains,
        stages: Vec::new(),
    };
    if options.crop {
        crop(&mut panorama);
        clock.lap("crop");
    }
    panorama.stages = clock.into_stages();
    Ok(panorama)
}

/// Bands of the blend: transitions of a 25th of a photograph, in either direction.
fn bands(layout: &Layout) -> usize {
    let mut sides: Vec<f64> =
        layout.placements.iter().map(|p| ((p.bounds.width() * p.bounds.height()) as f64).sqrt()).collect();
    sides.sort_by(f64::total_cmp);
    let side = sides.get(sides.len() / 2).copied().unwrap_or(1.0);
    ((0.04 * side).max(1.0).log2().round() as usize).clamp(1, 8)
}

/// The part of the canvas that each placement is drawn on: where the preview's labels name it, and the surroundings that blending needs.
fn regions(coarse: &Labels, preview: &Preview, layout: &Layout, bands: usize) -> Vec<Option<Bounds>> {
    let (w, h) = (layout.width, layout.height);
    // A preview pixel for the label's own rounding, two for the refinement of the seam.
    let slack = 3 * preview.step;
    coarse
        .bounds(layout.placements.len())
        .into_iter()
        .map(|b| {
            let b = b?;
            let full = Bounds {
                left: (b.left * preview.step).min(w),
                top: (b.top * preview.step).min(h),
                right: (b.right * preview.step).min(w),
                bottom: (b.bottom * preview.step).min(h),
            };
            Some(Blender::region(&full.grown(slack, w, h), bands, w, h))
        })
        .collect()
}

/// Labels in full size: the preview's, interpolated so that their borders are smooth, where the piece reaches; else another that reaches.
fn enlarge(coarse: &Labels, preview: &Preview, layout: &Layout, pieces: &[Option<Warped>]) -> Labels {
    let (w, h, step) = (layout.width, layout.height, preview.step);
    let reaches = |label: u16, x: usize, y: usize| {
        pieces.get(usize::from(label)).and_then(Option::as_ref).is_some_and(|p| p.reaches(x, y))
    };
    let mut data = vec![NONE; w * h];
    let (cw, ch) = (coarse.width, coarse.height);
    // The preview pixel at or before a canvas pixel, and how far behind it that lies.
    let place = |v: usize, n: usize| {
        let t = ((v as f32 + 0.5) / step as f32 - 0.5).max(0.0);
        let i = (t as usize).min(n - 1);
        (i, (i + 1).min(n - 1), t - i as f32)
    };
    let columns: Vec<(usize, usize, f32)> = (0..w).map(|x| place(x, cw)).collect();
    data.par_chunks_mut(w.max(1)).enumerate().for_each(|(y, row)| {
        let (y0, y1, fy) = place(y, ch);
        for (x, out) in row.iter_mut().enumerate() {
            let (x0, x1, fx) = columns[x];
            let near = [coarse.at(x0, y0), coarse.at(x1, y0), coarse.at(x0, y1), coarse.at(x1, y1)];
            let first = near[0];
            if first != NONE && near.iter().all(|l| *l == first) && reaches(first, x, y) {
                *out = first;
                continue;
            }
            let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
            let mut best = (0.0, NONE);
            for label in near {
                let weight: f32 = near.iter().zip(weights).filter(|(l, _)| **l == label).map(|(_, w)| w).sum();
                if label != NONE && weight >= best.0 && weight > 0.0 && reaches(label, x, y) {
                    best = (weight + 1e-6, label);
                }
            }
            if best.1 == NONE {
                let any = (0..pieces.len() as u16).find(|&l| reaches(l, x, y));
                best.1 = any.unwrap_or(NONE);
            }
            *out = best.1;
        }
    });
    Labels { width: w, height: h, data }
}

/// Cuts a panorama to the largest rectangle without empty pixels.
fn crop(p: &mut Panorama) {
    let Some(b) = largest_rectangle(p.mask.view()) else { return };
    let (w, h) = (b.width(), b.height());
    p.full_circle &= w == p.image.width();
    if let Some(view) = p.image.view().crop(b.left, b.top, w, h) {
        p.image = view.to_image();
    }
    if let Some(view) = p.labels.view().crop(b.left, b.top, w, h) {
        p.labels = view.to_image();
    }
    if let Some(view) = p.mask.view().crop(b.left, b.top, w, h) {
        p.mask = view.to_image();
    }
    p.map.crop(b.left, b.top);
    p.canvas.origin += nalgebra::Vector2::new(b.left as f64, b.top as f64);
}
