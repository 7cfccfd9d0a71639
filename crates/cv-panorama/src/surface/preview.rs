//! The canvas at reduced resolution, on which exposure compensation and seam finding run.

use crate::align::View;
use crate::photometric::{Adaptation, ExposureCorrection, Gains, SATURATED_LEVEL};
use crate::rows::is_check_due;
use crate::surface::{Bounds, DisplacementField, Layout, Map, Placement, Surface, WarpSettings, WarpedPhoto, warp};
use cv_core::{Cancelled, Image, ImageView, Progress, RgbU8, Scaling, Stage, luma_f32};
use cv_imgproc::{Interpolation, Pixel};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch};

/// All placements warped at `1 / step` of the canvas resolution.
pub(crate) struct Preview {
    /// Canvas pixels per preview pixel.
    pub(crate) step: usize,
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Whether it spans 360°: the right edge continues at the left one.
    pub(crate) full_circle: bool,
    /// In the order of the layout's placements.
    pub(crate) pieces: Vec<Piece>,
}

/// A placement warped to the preview.
pub(crate) struct Piece {
    pub(crate) warped: WarpedPhoto,
    /// Squared Chebyshev distance of each pixel from the photograph's center, normalized to 1 along the border.
    pub(crate) eccentricity: Vec<f32>,
    /// Squared Euclidean distance of each pixel from the photograph's center, normalized to 1 at the corners.
    pub(crate) radius: Vec<f32>,
    /// Whether the photograph is clipped in a channel.
    pub(crate) clipped: Vec<bool>,
    /// Levels of the panorama that a clipped sample reaches at least, in the center of the photograph.
    pub(crate) clipped_level: [u8; 3],
    /// Mean level of the photograph's samples.
    pub(crate) mean_level: f64,
    /// Data term of the seams at each pixel, for photographs of exposure brackets; empty for none.
    pub(crate) cost: Vec<f32>,
}

/// Pixels that are corrected at once.
const BLOCK: usize = 64;

/// Level of a photograph whose correction bounds that of its clipped samples from below. It is lower than [`SATURATED_LEVEL`] by a third of a stop, since previews are averages.
const CLIPPED_LEVEL: u8 = 224;

impl Piece {
    /// Returns a piece without exposure correction, clipped where a channel of its pixels is.
    pub(crate) fn new(warped: WarpedPhoto, eccentricity: Vec<f32>, radius: Vec<f32>, mean_level: f64) -> Self {
        let pixels = warped.pixels.as_slice().as_chunks::<4>().0.iter();
        let clipped = pixels.map(|p| p[..3].iter().any(|v| *v >= SATURATED_LEVEL)).collect();
        let clipped_level = [CLIPPED_LEVEL; 3];
        Self { warped, eccentricity, radius, clipped, clipped_level, mean_level, cost: Vec::new() }
    }

    /// Returns which channels of `color` a clipped sample at a pixel bounds from below: none where the photograph, which must cover the pixel, is not clipped.
    pub(crate) fn bounded_channels(&self, color: [u8; 3], x: usize, y: usize) -> [bool; 3] {
        let clipped = self.clipped[self.warped.bounds.index(x, y)];
        std::array::from_fn(|c| clipped && color[c] >= self.clipped_level[c])
    }

    #[inline(always)]
    fn correct(&mut self, correction: &ExposureCorrection<'_>, adaptation: Option<&Adaptation>) {
        self.clipped_level = correction.levels([f32::from(CLIPPED_LEVEL); 3], 0.0).map(u8::from_f32);
        let b = self.warped.bounds;
        let blocks = self.warped.pixels.as_mut_slice().as_chunks_mut::<4>().0.chunks_mut(BLOCK);
        let ([mut reds, mut greens, mut blues], mut lifts, mut clipped) =
            ([[0.0; BLOCK]; 3], [0.0; BLOCK], [0.0; BLOCK]);
        for ((start, pixels), radius) in (0..).step_by(BLOCK).zip(blocks).zip(self.radius.chunks(BLOCK)) {
            let n = pixels.len();
            for (k, (p, r2)) in pixels.iter().zip(radius).enumerate() {
                let levels = [p[0], p[1], p[2]].map(f32::from);
                let mut lift = correction.vignetting_stops(*r2);
                if let Some(adaptation) = adaptation {
                    let (x, y) = (b.left + (start + k) % b.width(), b.top + (start + k) / b.width());
                    lift += adaptation.at_preview(x, y, correction.log_luminance(luma_f32(levels)) + lift);
                }
                [reds[k], greens[k], blues[k]] = levels;
                lifts[k] = lift;
            }
            let colors = [&mut reds[..n], &mut greens[..n], &mut blues[..n]];
            correction.row_of_levels::<false>(colors, &lifts[..n], &mut clipped);
            for (k, p) in pixels.iter_mut().enumerate() {
                let [r, g, b] = [reds[k], greens[k], blues[k]].map(u8::from_f32);
                *p = [r, g, b, p[3]];
            }
        }
    }

    /// Averages blocks of 2 × 2 pixels that lie completely within the bounds; covered where all four are.
    fn halved(&self) -> Self {
        let (b, pixels) = (self.warped.bounds, &self.warped.pixels);
        let (left, top) = (b.left.div_ceil(2), b.top.div_ceil(2));
        let bounds = Bounds { left, top, right: (b.right / 2).max(left), bottom: (b.bottom / 2).max(top) };
        let (width, height) = (bounds.width(), bounds.height());
        let corner = |x: usize, y: usize| (2 * (left + x) - b.left, 2 * (top + y) - b.top);
        let pixels = Image::from_fn(width, height, |x, y| {
            let (x, y) = corner(x, y);
            let block = [pixels.at(x, y), pixels.at(x + 1, y), pixels.at(x, y + 1), pixels.at(x + 1, y + 1)];
            let mean = |c: usize| ((block.iter().map(|p| u16::from(p[c])).sum::<u16>() + 2) / 4) as u8;
            [mean(0), mean(1), mean(2), if block.iter().all(|p| p[3] > 0) { 255 } else { 0 }]
        });
        let at_corners = |values: &[f32]| {
            let places = (0..height).flat_map(|y| (0..width).map(move |x| corner(x, y)));
            places.map(|(x, y)| values[y * b.width() + x]).collect()
        };
        let greatest = |values: &[f32]| {
            let places = (0..height).flat_map(|y| (0..width).map(move |x| corner(x, y)));
            let greatest = |(x, y): (usize, usize)| {
                let four = [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)];
                four.iter().map(|(x, y)| values[y * b.width() + x]).fold(0.0, f32::max)
            };
            places.map(greatest).collect()
        };
        let clipped = (0..width * height).map(|i| {
            let (x, y) = corner(i % width, i / width);
            [(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)].iter().any(|(x, y)| self.clipped[y * b.width() + x])
        });
        Self {
            warped: WarpedPhoto { bounds, pixels },
            eccentricity: at_corners(&self.eccentricity),
            radius: at_corners(&self.radius),
            clipped: clipped.collect(),
            clipped_level: self.clipped_level,
            mean_level: self.mean_level,
            cost: if self.cost.is_empty() { Vec::new() } else { greatest(&self.cost) },
        }
    }
}

/// Scale of a preview.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct PreviewScale {
    /// Canvas pixels per preview pixel.
    pub(crate) step: usize,
    /// Factor by which photographs are downsampled first, against aliasing.
    pub(crate) shrink: usize,
}

impl PreviewScale {
    /// Returns the scale of a preview of about `max_pixels` pixels at most.
    pub(crate) fn new(layout: &Layout, resolution: f64, max_pixels: usize) -> Self {
        let ratio = (layout.width as f64 * layout.height as f64 / max_pixels.max(1) as f64).sqrt();
        let step = (ratio.ceil() as usize).max(1);
        Self { step, shrink: ((step as f64 / resolution.max(1e-9)).round() as usize).max(1) }
    }
}

impl Preview {
    /// Warps all placements to a preview of about `max_pixels` pixels at most.
    pub(crate) fn draw(
        photos: &[ImageView<'_, u8, 3>],
        layout: &Layout,
        fields: &[Option<DisplacementField>],
        resolution: f64,
        max_pixels: usize,
        progress: &dyn Progress,
    ) -> Result<Self, Cancelled> {
        let stage = Stage::new(progress, "preview", photos.len() + layout.placements.len())?;
        let scale = PreviewScale::new(layout, resolution, max_pixels);
        let small = |(i, photo): (usize, &ImageView<'_, u8, 3>)| {
            let is_placed = layout.placements.iter().any(|p| p.photo == i);
            let small = is_placed.then(|| downsample_box(*photo, scale.shrink, &stage)).transpose()?;
            stage.add(1)?;
            Ok(small)
        };
        let small: Vec<Option<RgbU8>> = photos.par_iter().enumerate().map(small).try_collect::<_, Cancelled>()?;
        Self::draw_small(&small, layout, fields, scale, &stage)
    }

    /// As [`Preview::draw`], of photographs downsampled by [`PreviewScale::shrink`]; `None` for those that are not placed.
    pub(crate) fn draw_small(
        small: &[Option<RgbU8>],
        layout: &Layout,
        fields: &[Option<DisplacementField>],
        PreviewScale { step, shrink }: PreviewScale,
        stage: &Stage<'_>,
    ) -> Result<Self, Cancelled> {
        let s = 1.0 / step as f64;
        let surface = Surface { scale: layout.surface.scale * s, ..layout.surface };
        let (width, height) = (layout.width.div_ceil(step), layout.height.div_ceil(step));
        let draw = |(k, p): (usize, &Placement)| {
            let Some(Some(photo)) = small.get(p.photo) else { return Ok(None) };
            // The surface origin is canvas position −origin.
            let origin = -Scaling::uniform(s).point(-p.origin);
            let bounds = Bounds {
                left: p.bounds.left / step,
                top: p.bounds.top / step,
                right: p.bounds.right.div_ceil(step).min(width),
                bottom: p.bounds.bottom.div_ceil(step).min(height),
            };
            let field = fields.get(k).and_then(Option::as_ref).map(|f| f.scaled(s, 1.0 / shrink as f64));
            let view = downsampled_view(p, shrink, photo.size());
            let small = Placement { view, bounds, origin, ..*p };
            let settings = WarpSettings {
                displacement: field.as_ref(),
                interpolation: Interpolation::Bilinear,
                correction: None,
                region: None,
            };
            let warped = warp(photo.view(), &small, &surface, bounds, settings, stage)?;
            let (eccentricity, radius) = distances(&small, &surface);
            stage.add(1)?;
            let samples = photo.as_slice();
            let mean_level = samples.iter().map(|v| u64::from(*v)).sum::<u64>() as f64 / samples.len().max(1) as f64;
            Ok(Some(Piece::new(warped, eccentricity, radius, mean_level)))
        };
        let pieces: Vec<Option<Piece>> =
            layout.placements.par_iter().enumerate().map(draw).try_collect::<_, Cancelled>()?;
        let full_circle = layout.full_circle;
        Ok(Self { step, width, height, full_circle, pieces: pieces.into_iter().flatten().collect() })
    }

    /// Applies the exposure correction to every piece.
    pub(crate) fn correct(&mut self, gains: &Gains, adaptation: Option<&Adaptation>, photo_of: &[usize]) {
        let tone = gains.adapted_tone(adaptation, 1);
        self.pieces.par_iter_mut().zip(photo_of).for_each(|(piece, &photo)| {
            let correction = ExposureCorrection::new(&tone, gains, photo);
            dispatch!(Level::new(), _simd => piece.correct(&correction, adaptation));
        });
    }

    /// Returns the preview at half resolution.
    pub(crate) fn halved(&self) -> Self {
        let pieces = self.pieces.par_iter().map(Piece::halved).collect();
        Self { step: 2 * self.step, width: self.width / 2, height: self.height / 2, pieces, ..*self }
    }
}

/// Returns the view of a photograph downsampled by [`downsample_box`] to this size.
pub(crate) fn downsampled_view(p: &Placement, shrink: usize, size: (usize, usize)) -> View {
    let mut view = p.view.scaled(1.0 / shrink as f64);
    // Incomplete blocks at the right and bottom are dropped.
    (view.camera.width, view.camera.height) = size;
    view
}

/// Averages blocks of `step × step` pixels; incomplete blocks at the right and bottom are dropped unless nothing would be left.
pub(crate) fn downsample_box(photo: ImageView<'_, u8, 3>, step: usize, stage: &Stage<'_>) -> Result<RgbU8, Cancelled> {
    if step == 1 {
        return Ok(photo.to_image());
    }
    let (width, height) = ((photo.width() / step).max(1), (photo.height() / step).max(1));
    let (bw, bh) = (step.min(photo.width()), step.min(photo.height()));
    let mut small = RgbU8::new(width, height, [0; 3]);
    let area = (bw * bh) as u32;
    let mut columns = vec![0_u32; 3 * bw * width];
    for y in 0..height {
        if is_check_due(y, 3 * photo.width() * bh) {
            stage.check()?;
        }
        // Down the columns first, which is vectorized.
        columns.fill(0);
        dispatch!(Level::new(), _simd => for row in y * bh..(y + 1) * bh {
            for (sum, v) in columns.iter_mut().zip(photo.row(row)) {
                *sum += u32::from(*v);
            }
        });
        let blocks = columns.chunks_exact(3 * bw);
        for (out, block) in small.row_mut(y).as_chunks_mut::<3>().0.iter_mut().zip(blocks) {
            let mut sum = [area / 2; 3];
            for p in block.as_chunks::<3>().0 {
                for c in 0..3 {
                    sum[c] += p[c];
                }
            }
            *out = sum.map(|sum| (sum / area) as u8);
        }
    }
    Ok(small)
}

/// Computes `eccentricity` and `radius` of a [`Piece`].
fn distances(p: &Placement, surface: &Surface) -> (Vec<f32>, Vec<f32>) {
    let map = Map::new(p, surface, p.bounds);
    let (w, h) = (p.bounds.width(), p.bounds.height());
    let (cx, cy) = (0.5 * (p.view.camera.width as f32 - 1.0), 0.5 * (p.view.camera.height as f32 - 1.0));
    let corner = (cx + 0.5).powi(2) + (cy + 0.5).powi(2);
    let (mut eccentricity, mut radius) = (Vec::with_capacity(w * h), Vec::with_capacity(w * h));
    let (mut us, mut vs) = (vec![0.0; w], vec![0.0; w]);
    for y in 0..h {
        map.row(y, 0, &mut us, &mut vs);
        for (u, v) in us.iter().zip(&vs) {
            let (x, y) = (u - cx, v - cy);
            eccentricity.push((x.abs() / (cx + 0.5)).max(y.abs() / (cy + 0.5)).powi(2).min(4.0));
            radius.push(((x * x + y * y) / corner).min(4.0));
        }
    }
    (eccentricity, radius)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::{Canvas, Projection};
    use crate::testing::stage;
    use cv_core::{Camera, Matrix3, Point2, Silent};

    #[test]
    fn the_preview_is_the_block_average_of_the_canvas() {
        // A plane and a camera perpendicular to it: the canvas equals the photograph.
        let photo = RgbU8::from_fn(64, 48, |x, y| [(x * 3) as u8, (y * 5) as u8, 100]);
        let surface = Surface { projection: Projection::Plane, scale: 80.0 };
        let bounds = Bounds { left: 0, top: 0, right: 64, bottom: 48 };
        let view = View { camera: Camera::from_focal(64, 48, 80.0), from_world: Matrix3::identity() };
        let placement = Placement { photo: 0, view, bounds, origin: Point2::new(-31.5, -23.5) };
        let layout = Layout {
            surface,
            width: 64,
            height: 48,
            full_circle: false,
            reaches_beyond: false,
            placements: vec![placement],
            canvas: Canvas {
                projection: Projection::Plane,
                scale: 80.0,
                origin: placement.origin,
                frame: Matrix3::identity(),
            },
        };
        let preview = Preview::draw(&[photo.view()], &layout, &[], 1.0, 64 * 48 / 16, &Silent).unwrap();
        assert_eq!((preview.step, preview.width, preview.height), (4, 16, 12));
        for y in 0..12 {
            for x in 0..16 {
                let [r, g, b] = preview.pieces[0].warped.color(x, y).unwrap();
                // The mean of a ramp over a block is its value at the block's center, rounded.
                assert!((f64::from(r) - 3.0 * (4.0 * x as f64 + 1.5)).abs() <= 1.0, "{x} {y} {r}");
                assert!((f64::from(g) - 5.0 * (4.0 * y as f64 + 1.5)).abs() <= 1.0);
                assert_eq!(b, 100);
            }
        }
        let e = &preview.pieces[0].eccentricity;
        assert!(e[0] > 0.8 && e[6 * 16 + 8] < 0.02);
    }

    #[test]
    fn half_resolution_contains_only_complete_and_covered_blocks() {
        let bounds = Bounds { left: 3, top: 2, right: 10, bottom: 7 };
        // Canvas pixel (7, 4) is not reached.
        let pixels =
            Image::from_fn(7, 5, |x, y| [(10 * x) as u8, (20 * y) as u8, 7, if (x, y) == (4, 2) { 0 } else { 255 }]);
        let numbered: Vec<f32> = (0..35).map(|i| i as f32).collect();
        let clipped = (0..35).map(|i| i == 8).collect();
        let piece = Piece { clipped, ..Piece::new(WarpedPhoto { bounds, pixels }, numbered.clone(), numbered, 0.0) };
        let half = piece.halved();
        assert_eq!(half.warped.bounds, Bounds { left: 2, top: 1, right: 5, bottom: 3 });
        // Canvas pixels 4 and 5 of rows 2 and 3: the piece's columns 1 and 2, rows 0 and 1.
        assert_eq!(half.warped.color(2, 1), Some([15, 10, 7]));
        assert_eq!(half.warped.color(3, 2), None);
        assert_eq!(half.warped.color(4, 2), Some([55, 50, 7]));
        assert_eq!(half.eccentricity, [1.0, 3.0, 5.0, 15.0, 17.0, 19.0]);
        // Number 8 is in the first block.
        assert_eq!(half.clipped, [true, false, false, false, false, false]);
    }

    #[test]
    fn half_resolution_of_one_pixel_is_empty() {
        let bounds = Bounds { left: 3, top: 2, right: 4, bottom: 3 };
        let pixels = Image::new(1, 1, [9, 9, 9, 255]);
        let half = Piece::new(WarpedPhoto { bounds, pixels }, vec![0.0], vec![0.0], 9.0).halved();
        assert!(half.warped.pixels.is_empty() && half.radius.is_empty());
    }

    #[test]
    fn downscaling_gives_block_means_and_at_least_one_pixel() {
        let photo = RgbU8::from_fn(5, 3, |x, _| [(10 * x) as u8, 0, 255]);
        assert_eq!(downsample_box(photo.view(), 2, &stage()).unwrap().as_slice(), [5, 0, 255, 25, 0, 255]);
        assert_eq!(downsample_box(photo.view(), 100, &stage()).unwrap().as_slice(), [20, 0, 255]);
    }
}
