//! Depths of what two photographs show whose geometry is known.

use crate::Progress;
use crate::depth::LEAST_MATCHED;
use crate::reconstruct::{DenseError, DenseOptions};
use cv_core::{Camera, Cancelled, GrayF32, ImageView, Point2, Point3, PointCloud, RgbU8, Stage, StageClock, StereoRig};
use cv_stereo::{PixelState, RectifiedView, SceneRectification, StereoMatcher, StereoOptions};
use rayon::prelude::*;

/// Half a window of the matcher and more.
const BORDER: i64 = 4;

/// Share of the rectified photograph up to which a patch of disparities by itself is a speckle: OpenCV's 100 pixels of VGA.
const SPECKLE: f64 = 100.0 / (640.0 * 480.0);

/// Depths of the first of two photographs, as its rectified view has them.
pub(crate) struct PairDepth {
    /// Along the axis of the rectified view, row by row; NaN where none is known.
    rows: Vec<Vec<f32>>,
    view: RectifiedView,
    /// The rectified photograph.
    image: RgbU8,
    /// Smallest disparity in pixels, and number of disparities tried.
    pub(crate) disparities: (i32, usize),
    /// Share of the pixels that both rectified photographs can show for which a depth was found and confirmed.
    pub(crate) coverage: f64,
    /// Stage names and their seconds.
    pub(crate) stages: Vec<(&'static str, f64)>,
}

/// Rectifies two photographs of a rig's cameras around `positions` that both show, in the first camera's frame ([`SceneRectification`]), and matches them ([`StereoMatcher`]); depths that the other
/// photograph confirms, or with [`DenseOptions::fill`] those of around them, are known.
///
/// # Errors
/// [`DenseError`].
pub(crate) fn pair_depth(
    photos: [ImageView<'_, u8, 3>; 2],
    rig: &StereoRig,
    positions: &[Point3<f64>],
    options: &DenseOptions,
    progress: &dyn Progress,
) -> Result<PairDepth, DenseError> {
    let mut clock = StageClock::new();
    progress.report("rectify", 0, 1)?;
    let scene = SceneRectification::new(rig, positions)?;
    let views = [scene.views.left, scene.views.right];
    let size = (views[0].camera.width, views[0].camera.height);
    let mut rectified = Vec::new();
    for (photo, view) in photos.iter().zip(&views) {
        rectified.push(view.apply(*photo, progress)?);
    }
    clock.lap("rectify");

    let stereo = StereoOptions {
        fill: options.fill,
        max_memory: Some(options.max_memory),
        speckle_size: ((size.0 * size.1) as f64 * SPECKLE) as usize,
        ..scene.stereo_options()
    };
    let mut matcher = StereoMatcher::new(stereo)?;
    let map = matcher.compute(rectified[0].0.view(), rectified[1].0.view(), progress)?;
    let sigma = matcher.uncertainty(&map);
    clock.lap("match");

    let stage = Stage::new(progress, "cloud", size.1)?;
    let geometry = &scene.views.geometry;
    let (width, height) = size;
    // Depth in the rectified frame; seen and confirmed; seen by both at this depth at all.
    // The border of a photograph looks like that of the other: what is compared must lie inside.
    let inside = |photo: usize, x: i64, y: i64| {
        let mask = &rectified[photo].1;
        [(-BORDER, -BORDER), (BORDER, -BORDER), (-BORDER, BORDER), (BORDER, BORDER)].iter().all(|(dx, dy)| {
            let (x, y) = (x + dx, y + dy);
            x >= 0 && y >= 0 && x < width as i64 && y < height as i64 && mask.at(x as usize, y as usize)[0]
        })
    };
    let examine = |x: usize, y: usize| -> (f32, bool, bool) {
        let none = (f32::NAN, false, false);
        let d = map.disparity.at(x, y)[0];
        let row = y as i64;
        if !inside(0, x as i64, row) {
            return none;
        }
        if !d.is_finite() {
            // Whether the other photograph shows it is unknown: it does where it shows what lies in the middle of the range.
            let middle = x as i64 - i64::from(scene.disparities.0) - scene.disparities.1 as i64 / 2;
            return (f32::NAN, false, inside(1, middle, row));
        }
        if !inside(1, (x as f32 - d).round() as i64, row) {
            return none;
        }
        let depth = geometry.depth(d);
        let matched = map.state.at(x, y)[0] == PixelState::Matched;
        // A winner at either end of the range is the nearest to what lies beyond it.
        let d = d - scene.disparities.0 as f32;
        let within = d >= 1.0 && d <= scene.disparities.1 as f32 - 2.0;
        // Filled pixels are selected by `fill`, not by their standard deviation.
        let deviation = geometry.depth_uncertainty(depth, sigma.at(x, y)[0]);
        let sharp = !matched || deviation <= options.max_deviation * depth;
        let known = depth.is_finite() && within && sharp && (matched || options.fill);
        (if known { depth } else { f32::NAN }, known && matched, true)
    };
    let rows: Vec<(Vec<f32>, usize, usize)> = (0..height)
        .into_par_iter()
        .map(|y| {
            stage.add(1)?;
            let row: Vec<_> = (0..width).map(|x| examine(x, y)).collect();
            let count = |f: &dyn Fn(&(f32, bool, bool)) -> bool| row.iter().filter(|p| f(p)).count();
            Ok((row.iter().map(|p| p.0).collect(), count(&|p| p.1), count(&|p| p.2)))
        })
        .collect::<Result<_, Cancelled>>()?;
    let (confirmed, common) = rows.iter().fold((0, 0), |(a, b), row| (a + row.1, b + row.2));
    let coverage = confirmed as f64 / common.max(1) as f64;
    if coverage < LEAST_MATCHED {
        return Err(DenseError::LittleConfirmed { coverage, needed: LEAST_MATCHED });
    }
    clock.lap("cloud");
    let image = rectified.swap_remove(0).0;
    let (disparities, stages) = (scene.disparities, clock.into_stages());
    let rows = rows.into_iter().map(|row| row.0).collect();
    Ok(PairDepth { rows, view: views[0], image, disparities, coverage, stages })
}

impl PairDepth {
    /// Width and height of the rectified photographs in pixels.
    pub(crate) fn size(&self) -> (usize, usize) {
        self.image.size()
    }

    /// The points, in the frame of the first camera.
    pub(crate) fn cloud(&self) -> PointCloud {
        let back = self.view.rotation.inverse();
        let (positions, colors) = self
            .rows
            .par_iter()
            .enumerate()
            .flat_map_iter(|(y, row)| {
                row.iter().enumerate().filter(|(_, z)| z.is_finite()).map(move |(x, z)| {
                    let n = self.view.camera.normalize(Point2::new(x as f64, y as f64));
                    let p = back * (Point3::new(n.x, n.y, 1.0) * f64::from(*z));
                    ([p.x as f32, p.y as f32, p.z as f32], self.image.at(x, y))
                })
            })
            .unzip();
        PointCloud::colored(positions, colors)
    }

    /// Depth along the axis of the first camera for each pixel of its photograph, NaN where none is known.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn depth_map(&self, camera: &Camera, progress: &dyn Progress) -> Result<GrayF32, Cancelled> {
        let stage = Stage::new(progress, "cloud", camera.height)?;
        let back = self.view.rotation.inverse();
        let (width, height) = self.size();
        let at = |p: Point2<f64>| -> Option<f32> {
            let q = self.view.rectified_pixel(p)?;
            let (x, y) = (q.x.round(), q.y.round());
            let inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
            let z = if inside { self.rows[y as usize][x as usize] } else { f32::NAN };
            let n = self.view.camera.normalize(q);
            // The point's own depth: its place on the ray, turned back.
            Some(((back * Point3::new(n.x, n.y, 1.0)).z * f64::from(z)) as f32)
        };
        let mut depth = GrayF32::new(camera.width, camera.height, [f32::NAN]);
        if !depth.is_empty() {
            depth.as_mut_slice().par_chunks_mut(camera.width).enumerate().try_for_each(|(y, row)| {
                stage.add(1)?;
                for (x, z) in row.iter_mut().enumerate() {
                    *z = at(Point2::new(x as f64, y as f64)).unwrap_or(f32::NAN);
                }
                Ok::<(), Cancelled>(())
            })?;
        }
        Ok(depth)
    }
}
