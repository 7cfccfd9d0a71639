//! Depth map of a pair of images with known relative pose.

use crate::Progress;
use crate::depth::MIN_MATCHED_FRACTION;
use crate::reconstruct::{DenseError, DenseOptions};
use cv_core::{Camera, Cancelled, GrayF32, ImageView, Point2, Point3, PointCloud, RgbU8, Stage, StageClock, StereoRig};
use cv_parallel::prelude::*;
use cv_stereo::{PixelState, RectifiedView, SceneRectification, StereoMatcher, StereoOptions};

/// Width of the invalid border in pixels: more than the radius of the matching window.
const BORDER_PX: i64 = 4;

/// Largest speckle as a fraction of the image: OpenCV's 100 pixels of VGA.
const SPECKLE_FRACTION: f64 = 100.0 / (640.0 * 480.0);

/// Depth map of the first image, in its rectified view.
pub(crate) struct PairDepth {
    /// Depth along the axis of the rectified view, row by row; NaN where unknown.
    rows: Vec<Vec<f32>>,
    view: RectifiedView,
    /// The rectified first image.
    image: RgbU8,
    /// Smallest disparity in pixels, and number of disparities.
    pub(crate) disparities: (i32, usize),
    /// Fraction of the commonly visible pixels with a confirmed depth.
    pub(crate) coverage: f64,
    /// Stage names and their seconds.
    pub(crate) stages: Vec<(&'static str, f64)>,
}

/// Rectifies two images around 3-D `positions` that both observe, in the first camera's frame ([`SceneRectification`]),
/// and matches them ([`StereoMatcher`]). Depths are kept where the left-right check confirms them, or with
/// [`DenseOptions::fill`] where they are filled.
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
        speckle_size: ((size.0 * size.1) as f64 * SPECKLE_FRACTION) as usize,
        ..scene.stereo_options()
    };
    let mut matcher = StereoMatcher::new(stereo)?;
    matcher.set_masks(Some([&rectified[0].1, &rectified[1].1]));
    let map = matcher.compute(rectified[0].0.view(), rectified[1].0.view(), progress)?;
    let sigma = matcher.uncertainty(&map);
    clock.lap("match");

    let stage = Stage::new(progress, "cloud", size.1)?;
    let geometry = &scene.views.geometry;
    let (width, height) = size;
    // Image borders match each other: the windows must be inside both images.
    let is_inside = |photo: usize, x: i64, y: i64| {
        let mask = &rectified[photo].1;
        [(-BORDER_PX, -BORDER_PX), (BORDER_PX, -BORDER_PX), (-BORDER_PX, BORDER_PX), (BORDER_PX, BORDER_PX)].iter().all(
            |(dx, dy)| {
                let (x, y) = (x + dx, y + dy);
                x >= 0 && y >= 0 && x < width as i64 && y < height as i64 && mask.at(x as usize, y as usize)[0]
            },
        )
    };
    // Depth in the rectified frame, whether it is confirmed, and whether both images can show it.
    let pixel_depth = |x: usize, y: usize| -> (f32, bool, bool) {
        let none = (f32::NAN, false, false);
        let d = map.disparity.at(x, y)[0];
        let row = y as i64;
        if !is_inside(0, x as i64, row) {
            return none;
        }
        if !d.is_finite() {
            // Visibility in the other image is unknown; it is decided at the middle of the range.
            let center = x as i64 - i64::from(scene.disparities.0) - scene.disparities.1 as i64 / 2;
            return (f32::NAN, false, is_inside(1, center, row));
        }
        if !is_inside(1, (x as f32 - d).round() as i64, row) {
            return none;
        }
        let depth = geometry.depth(d);
        let matched = map.state.at(x, y)[0] == PixelState::Matched;
        // A winner at an end of the range is nearest to a disparity beyond it.
        let d = d - scene.disparities.0 as f32;
        let is_within = d >= 1.0 && d <= scene.disparities.1 as f32 - 2.0;
        // Filled pixels are selected by `fill`, not by their standard deviation.
        let sigma = geometry.depth_uncertainty(depth, sigma.at(x, y)[0]);
        let is_certain = !matched || sigma <= options.max_deviation * depth;
        let is_valid = depth.is_finite() && is_within && is_certain && (matched || options.fill);
        (if is_valid { depth } else { f32::NAN }, is_valid && matched, true)
    };
    let rows: Vec<(Vec<f32>, usize, usize)> = (0..height)
        .into_par_iter()
        .map(|y| {
            stage.add(1)?;
            let row: Vec<_> = (0..width).map(|x| pixel_depth(x, y)).collect();
            let count = |f: &dyn Fn(&(f32, bool, bool)) -> bool| row.iter().filter(|p| f(p)).count();
            Ok((row.iter().map(|p| p.0).collect(), count(&|p| p.1), count(&|p| p.2)))
        })
        .try_collect::<_, Cancelled>()?;
    let (confirmed, common) = rows.iter().fold((0, 0), |(a, b), row| (a + row.1, b + row.2));
    let coverage = confirmed as f64 / common.max(1) as f64;
    if coverage < MIN_MATCHED_FRACTION {
        return Err(DenseError::LittleConfirmed { coverage, needed: MIN_MATCHED_FRACTION });
    }
    clock.lap("cloud");
    let image = rectified.swap_remove(0).0;
    let (disparities, stages) = (scene.disparities, clock.into_stages());
    let rows = rows.into_iter().map(|row| row.0).collect();
    Ok(PairDepth { rows, view: views[0], image, disparities, coverage, stages })
}

impl PairDepth {
    /// Returns width and height of the rectified images in pixels.
    pub(crate) fn size(&self) -> (usize, usize) {
        self.image.size()
    }

    /// Returns the points in the frame of the first camera.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn cloud(&self, progress: &dyn Progress) -> Result<PointCloud, Cancelled> {
        let stage = Stage::new(progress, "cloud", self.rows.len())?;
        let to_camera = self.view.rotation.inverse();
        let points_of_row = |(y, row): (usize, &Vec<f32>)| {
            stage.add(1)?;
            let points = row.iter().enumerate().filter(|(_, z)| z.is_finite()).map(|(x, z)| {
                let n = self.view.camera.normalize(Point2::new(x as f64, y as f64));
                let p = to_camera * (Point3::new(n.x, n.y, 1.0) * f64::from(*z));
                ([p.x as f32, p.y as f32, p.z as f32], self.image.at(x, y))
            });
            Ok(points.collect())
        };
        let rows: Vec<Vec<([f32; 3], [u8; 3])>> =
            self.rows.par_iter().enumerate().map(points_of_row).try_collect::<_, Cancelled>()?;
        let (positions, colors) = rows.into_iter().flatten().unzip();
        Ok(PointCloud::colored(positions, colors))
    }

    /// Returns the depth along the axis of the first camera for each pixel of its image, NaN where unknown.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn depth_map(&self, camera: &Camera, progress: &dyn Progress) -> Result<GrayF32, Cancelled> {
        let stage = Stage::new(progress, "cloud", camera.height)?;
        let to_camera = self.view.rotation.inverse();
        let (width, height) = self.size();
        let depth_at = |p: Point2<f64>| -> Option<f32> {
            let q = self.view.rectified_pixel(p)?;
            let (x, y) = (q.x.round(), q.y.round());
            let is_inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
            let z = if is_inside { self.rows[y as usize][x as usize] } else { f32::NAN };
            let n = self.view.camera.normalize(q);
            // The depth of the point in the unrectified camera frame.
            Some(((to_camera * Point3::new(n.x, n.y, 1.0)).z * f64::from(z)) as f32)
        };
        let mut depth = GrayF32::new(camera.width, camera.height, [f32::NAN]);
        if !depth.is_empty() {
            depth.as_mut_slice().par_chunks_mut(camera.width).enumerate().try_for_each(|(y, row)| {
                stage.add(1)?;
                for (x, z) in row.iter_mut().enumerate() {
                    *z = depth_at(Point2::new(x as f64, y as f64)).unwrap_or(f32::NAN);
                }
                Ok::<(), Cancelled>(())
            })?;
        }
        Ok(depth)
    }
}
