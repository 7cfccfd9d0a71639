//! A dense cloud from two photographs whose geometry is known.

use super::ReconstructResult;
use crate::Progress;
use crate::depth::LEAST_MATCHED;
use cv_core::{Cancelled, GrayF32, ImageView, OptionError, Point2, Point3, PointCloud, Stage, StageClock, StereoRig};
use cv_imgproc::resize_area;
use cv_stereo::{PixelState, RectifyError, SceneRectification, StereoError, StereoMatcher, StereoOptions};
use rayon::prelude::*;

/// Settings of [`reconstruct_dense`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct DenseOptions {
    /// Photographs whose longer side is above this are reduced to it first, in pixels. 32 or more; default 1600: a million points or so, and
    /// half a gigabyte of costs. (COLMAP matches at 2000.)
    pub max_size: usize,
    /// Most bytes the matcher may hold; above, it works in strips. Default 1 GiB.
    pub max_memory: usize,
    /// Largest standard deviation of the depth of a point that is kept, as a share of the depth. Above 0; default 0.05.
    pub max_deviation: f32,
    /// Whether pixels that the other photograph does not confirm get a depth from around them. Default false: only what was
    /// seen twice is a point.
    pub fill: bool,
}

impl Default for DenseOptions {
    fn default() -> Self {
        Self { max_size: 1600, max_memory: 1 << 30, max_deviation: 0.05, fill: false }
    }
}

/// What [`reconstruct_dense`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct DenseResult {
    /// The points, in the frame and the unit of the sparse ones: the first camera's, and the distance between the cameras.
    pub cloud: PointCloud,
    /// Depth along the first camera's axis for each pixel of the (reduced) first photograph, NaN where there is no point.
    pub depth: GrayF32,
    /// Width and height of the rectified photographs in pixels.
    pub size: (usize, usize),
    /// Smallest disparity of the rectified photographs in pixels, and number of disparities tried.
    pub disparities: (i32, usize),
    /// Share of the pixels that both rectified photographs can show for which a depth was found and confirmed.
    pub coverage: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why there is no dense cloud.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DenseError {
    /// The photographs cannot be turned so that their rows coincide.
    #[error("the two photographs cannot be rectified: {0}")]
    Rectify(#[source] RectifyError),
    /// The rectified photographs cannot be matched.
    #[error(transparent)]
    Stereo(StereoError),
    /// The other photograph confirms hardly any depth.
    #[error("only {:.1} % of what both photographs show was matched and confirmed; {:.0} % are the least that means anything", 100.0 * .coverage, 100.0 * .needed)]
    LittleConfirmed {
        /// Share of the pixels that both show that were confirmed.
        coverage: f64,
        /// The least that counts.
        needed: f64,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

impl From<StereoError> for DenseError {
    fn from(error: StereoError) -> Self {
        match error {
            StereoError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Stereo(other),
        }
    }
}

impl From<RectifyError> for DenseError {
    fn from(error: RectifyError) -> Self {
        match error {
            RectifyError::Cancelled(stop) => Self::Cancelled(stop),
            other => Self::Rectify(other),
        }
    }
}

/// Half a window of the matcher and more.
const BORDER: i64 = 4;

/// Share of the rectified photograph up to which a patch of disparities by itself is a speckle: OpenCV's 100 pixels of VGA.
const SPECKLE: f64 = 100.0 / (640.0 * 480.0);

/// A dense cloud of what two reconstructed photographs show: they are rectified by the geometry that was found
/// ([`SceneRectification`]) and matched semi-globally ([`StereoMatcher`]) over the disparities that the sparse points show. Pixels whose
/// match is confirmed from the other photograph become points.
///
/// O(pixels × disparities); the memory is bounded by [`DenseOptions::max_memory`] and some hundred bytes per pixel.
///
/// # Errors
/// [`DenseError`]: one camera stands ahead of the other, too little memory, or hardly any confirmed depth.
pub fn reconstruct_dense(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    sparse: &ReconstructResult,
    options: &DenseOptions,
    progress: &dyn Progress,
) -> Result<DenseResult, DenseError> {
    OptionError::check("max_size", options.max_size as f64, "at least 32 px", |v| v >= 32.0)?;
    OptionError::check("max_deviation", options.max_deviation.into(), "above 0", |v| v > 0.0)?;
    let photos = [a, b];
    for (photo, camera) in photos.iter().zip(&sparse.scene.cameras) {
        let expected = (camera.width, camera.height);
        if photo.size() != expected {
            return Err(RectifyError::ImageSize { image: photo.size(), expected }.into());
        }
    }
    let mut clock = StageClock::new();
    let longest = sparse.scene.cameras.iter().map(|c| c.width.max(c.height)).max().unwrap_or(1);
    let factor = (options.max_size as f64 / longest as f64).min(1.0);
    let side = |n: usize| ((n as f64 * factor).round() as usize).max(1);
    let cameras = sparse.scene.cameras.map(|camera| camera.resized(side(camera.width), side(camera.height)));
    let rig = StereoRig { left: cameras[0], right: cameras[1], right_from_left: sparse.scene.pose };
    let positions: Vec<Point3<f64>> = sparse.scene.points.iter().map(|p| p.position).collect();
    progress.report("rectify", 0, 1)?;
    let scene = SceneRectification::new(&rig, &positions)?;
    let views = [scene.views.left, scene.views.right];
    let size = (views[0].camera.width, views[0].camera.height);
    let too_large = RectifyError::TooLarge { width: size.0, height: size.1 };
    let mut rectified = Vec::new();
    for ((photo, view), camera) in photos.iter().zip(&views).zip(&cameras) {
        rectified.push(if factor < 1.0 {
            progress.report("reduce", 0, 1)?;
            let small = resize_area(*photo, camera.width, camera.height).map_err(|_| too_large)?;
            view.apply(small.view(), progress)?
        } else {
            view.apply(*photo, progress)?
        });
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

    let stage = Stage::new(progress, "cloud", size.1 + cameras[0].height)?;
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
        // What was filled in has no deviation of its own.
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
    let back = views[0].rotation.inverse();
    let (positions, colors) = rows
        .par_iter()
        .enumerate()
        .flat_map_iter(|(y, row)| {
            let (view, image) = (&views[0], rectified[0].0.view());
            row.0.iter().enumerate().filter(|(_, z)| z.is_finite()).map(move |(x, z)| {
                let n = view.camera.normalize(Point2::new(x as f64, y as f64));
                let p = back * (Point3::new(n.x, n.y, 1.0) * f64::from(*z));
                ([p.x as f32, p.y as f32, p.z as f32], image.at(x, y))
            })
        })
        .unzip();
    let cloud = PointCloud::colored(positions, colors);
    let at = |p: Point2<f64>| -> Option<f32> {
        let q = views[0].rectified_pixel(p)?;
        let (x, y) = (q.x.round(), q.y.round());
        let inside = x >= 0.0 && y >= 0.0 && x < width as f64 && y < height as f64;
        let z = if inside { rows[y as usize].0[x as usize] } else { f32::NAN };
        let n = views[0].camera.normalize(q);
        // The point's own depth: its place on the ray, turned back.
        Some(((back * Point3::new(n.x, n.y, 1.0)).z * f64::from(z)) as f32)
    };
    let (small_width, small_height) = (cameras[0].width, cameras[0].height);
    let mut depth = GrayF32::new(small_width, small_height, [f32::NAN]);
    if !depth.is_empty() {
        depth.as_mut_slice().par_chunks_mut(small_width).enumerate().try_for_each(|(y, row)| {
            stage.add(1)?;
            for (x, z) in row.iter_mut().enumerate() {
                *z = at(Point2::new(x as f64, y as f64)).unwrap_or(f32::NAN);
            }
            Ok::<(), Cancelled>(())
        })?;
    }
    clock.lap("cloud");
    Ok(DenseResult { cloud, depth, size, disparities: scene.disparities, coverage, stages: clock.into_stages() })
}
