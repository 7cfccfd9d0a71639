//! Fusion of the depth maps of many views to a point cloud that at least two pairs confirm.

use super::dense::DensePhoto;
use cv_core::{Camera, Cancelled, GrayF32, Point2, Point3, PointCloud, Pose, Progress, Stage, Vector3};
use cv_parallel::prelude::*;

/// Depth at a pixel.
#[derive(Clone, Copy)]
struct PixelDepth {
    /// Depth along the camera's axis; NaN where unknown.
    depth: f32,
    /// Number of pairs that agree.
    pairs: u8,
    /// The other view of one of these pairs.
    partner: u32,
}

/// Merged depth map of a view.
pub(super) struct ViewDepth<'p> {
    photo: &'p DensePhoto,
    pose: Pose,
    pixels: Vec<PixelDepth>,
}

/// Merges the depth maps of a view's pairs: at each pixel the mean of the largest set of agreeing depths, the first one
/// of equals.
pub(super) fn merge_depth_maps<'p>(
    photo: &'p DensePhoto,
    pose: Pose,
    maps: &[(usize, GrayF32)],
    tolerance: f32,
) -> ViewDepth<'p> {
    let (width, height) = (photo.camera.width, photo.camera.height);
    let pixel = |i: usize| {
        let mut best = PixelDepth { depth: f32::NAN, pairs: 0, partner: 0 };
        for (partner, map) in maps {
            let depth = map.as_slice()[i];
            let agreeing =
                maps.iter().map(|(_, other)| other.as_slice()[i]).filter(|d| (d - depth).abs() <= tolerance * depth);
            let (count, sum) = agreeing.fold((0u8, 0.0), |(n, sum), d| (n + 1, sum + d));
            if count > best.pairs {
                best = PixelDepth { depth: sum / f32::from(count), pairs: count, partner: *partner as u32 };
            }
        }
        best
    };
    ViewDepth { photo, pose, pixels: (0..width * height).into_par_iter().map(pixel).collect() }
}

impl ViewDepth<'_> {
    fn camera(&self) -> &Camera {
        &self.photo.camera
    }

    /// Returns the world position of a pixel at a depth.
    fn unproject(&self, x: usize, y: usize, depth: f32) -> Option<Point3<f64>> {
        let n = self.camera().normalize(Point2::new(x as f64, y as f64));
        let depth = f64::from(depth);
        let is_valid = depth.is_finite() && n.x.is_finite() && n.y.is_finite();
        is_valid.then(|| self.pose.inverse().transform(&Point3::new(n.x * depth, n.y * depth, depth)))
    }

    /// Returns the pixel that a world position projects to, and its depth there.
    fn project(&self, position: &Point3<f64>) -> Option<(usize, f32)> {
        let local = self.pose.transform(position);
        let pixel = self.camera().project(&local).filter(|_| local.z > 0.0)?;
        let (x, y) = (pixel.x.round(), pixel.y.round());
        let is_inside = x >= 0.0 && y >= 0.0 && x < self.camera().width as f64 && y < self.camera().height as f64;
        is_inside.then(|| (y as usize * self.camera().width + x as usize, local.z as f32))
    }

    /// Returns the normal at a pixel, towards the camera: from the depths of its neighbors on the same surface, or the
    /// viewing direction without such neighbors.
    fn normal(&self, x: usize, y: usize, center: &Point3<f64>, tolerance: f32) -> Vector3<f64> {
        let (width, height) = (self.camera().width, self.camera().height);
        let depth_here = self.pixels[y * width + x].depth;
        let neighbor = |x: usize, y: usize| {
            let is_inside = x < width && y < height;
            let depth = if is_inside { self.pixels[y * width + x].depth } else { f32::NAN };
            // Twice the tolerance of two depths of one point: a slanted surface, no depth discontinuity.
            let is_continuous = (depth - depth_here).abs() <= 2.0 * tolerance * depth_here;
            if is_continuous { self.unproject(x, y, depth) } else { None }
        };
        let difference = |before: Option<Point3<f64>>, after: Option<Point3<f64>>| match (before, after) {
            (Some(a), Some(b)) => Some(b - a),
            (Some(a), None) => Some(center - a),
            (None, Some(b)) => Some(b - center),
            (None, None) => None,
        };
        let across = difference(if x > 0 { neighbor(x - 1, y) } else { None }, neighbor(x + 1, y));
        let down = difference(if y > 0 { neighbor(x, y - 1) } else { None }, neighbor(x, y + 1));
        let ray = (self.pose.center() - center).normalize();
        let normal = across.zip(down).and_then(|(across, down)| down.cross(&across).try_normalize(0.0)).unwrap_or(ray);
        if normal.dot(&ray) < 0.0 { -normal } else { normal }
    }
}

/// A point, and the pixels of other views that observe it.
struct Point {
    position: [f32; 3],
    color: [u8; 3],
    normal: [f32; 3],
    observations: Vec<(u32, u32)>,
}

/// Depth difference, in tolerances, of a free-space violation: another view observes a more distant surface through the
/// point.
const FREE_SPACE_TOLERANCES: f32 = 3.0;

/// Fuses the depth maps of all views to one cloud. `near` are the views that each view is checked against.
pub(super) fn fuse(
    views: &[Option<ViewDepth<'_>>],
    neighbors: &[Vec<usize>],
    tolerance: f32,
    progress: &dyn Progress,
) -> Result<PointCloud, Cancelled> {
    let stage = Stage::new(progress, "join", views.len())?;
    // Pixels whose surface is in the cloud already.
    let mut is_fused: Vec<Vec<bool>> =
        views.iter().map(|view| vec![false; view.as_ref().map_or(0, |view| view.pixels.len())]).collect();
    let mut cloud = PointCloud::default();
    for (v, view) in views.iter().enumerate() {
        stage.add(1)?;
        let Some(view) = view else { continue };
        let (width, height) = (view.camera().width, view.camera().height);
        let point = |i: usize| {
            if is_fused[v][i] { None } else { fuse_pixel(views, &neighbors[v], v, view, i, tolerance) }
        };
        let rows: Vec<Vec<Point>> = (0..height)
            .into_par_iter()
            .map(|y| {
                stage.check()?;
                Ok((y * width..(y + 1) * width).filter_map(point).collect())
            })
            .try_collect::<_, Cancelled>()?;
        for point in rows.into_iter().flatten() {
            cloud.positions.push(point.position);
            cloud.colors.push(point.color);
            cloud.normals.push(point.normal);
            point.observations.iter().for_each(|(other, pixel)| is_fused[*other as usize][*pixel as usize] = true);
        }
    }
    Ok(cloud)
}

/// Returns the point at a pixel of view `v`, if another pair confirms it and free-space violations are no majority.
fn fuse_pixel(
    views: &[Option<ViewDepth<'_>>],
    neighbors: &[usize],
    v: usize,
    view: &ViewDepth<'_>,
    i: usize,
    tolerance: f32,
) -> Option<Point> {
    let here = view.pixels[i];
    let (x, y) = (i % view.camera().width, i / view.camera().width);
    let position = view.unproject(x, y, here.depth)?;
    let (mut agreeing, mut violations, mut ratio, mut observations) = (0, 0, 1.0, Vec::new());
    let mut is_confirmed = here.pairs > 1;
    for &w in neighbors {
        let Some((other, (pixel, depth))) = views[w].as_ref().and_then(|o| Some((o, o.project(&position)?))) else {
            continue;
        };
        let there = other.pixels[pixel];
        if (there.depth - depth).abs() <= tolerance * depth {
            agreeing += 1;
            ratio += there.depth / depth;
            observations.push((w as u32, pixel as u32));
            // A pair does not confirm itself when it is matched in both directions.
            let is_same_pair = here.partner as usize == w && there.partner as usize == v && there.pairs < 2;
            is_confirmed |= !is_same_pair;
        } else if there.depth > depth * (1.0 + FREE_SPACE_TOLERANCES * tolerance) {
            violations += 1;
        }
    }
    if !is_confirmed || violations > agreeing {
        return None;
    }
    // The mean of all agreeing depths, on the ray of this pixel.
    let position = view.unproject(x, y, here.depth * ratio / (1 + agreeing) as f32)?;
    let normal = view.normal(x, y, &position, tolerance).cast::<f32>();
    let position = position.cast::<f32>();
    Some(Point { position: position.into(), color: view.photo.image.at(x, y), normal: normal.into(), observations })
}
