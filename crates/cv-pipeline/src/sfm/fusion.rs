//! Depth maps of many views joined to one cloud, of what at least two pairs of photographs agree on.

use super::dense::DensePhoto;
use cv_core::{Camera, Cancelled, GrayF32, Point2, Point3, PointCloud, Pose, Progress, Stage, Vector3};
use rayon::prelude::*;

/// What is known of the depth at a pixel.
#[derive(Clone, Copy)]
struct PixelDepth {
    /// Along the camera's axis; NaN where there is none.
    depth: f32,
    /// Pairs of photographs that say so.
    pairs: u8,
    /// The other view of one of them.
    partner: u32,
}

/// Depths of a photograph.
pub(super) struct ViewDepth<'p> {
    photo: &'p DensePhoto,
    pose: Pose,
    pixels: Vec<PixelDepth>,
}

/// Depths of one photograph by its pairs as one map: at each pixel that which most of them agree on, the first of equals.
pub(super) fn joined<'p>(
    photo: &'p DensePhoto,
    pose: Pose,
    maps: &[(usize, GrayF32)],
    tolerance: f32,
) -> ViewDepth<'p> {
    let (width, height) = (photo.camera.width, photo.camera.height);
    let pixel = |i: usize| {
        let mut best = PixelDepth { depth: f32::NAN, pairs: 0, partner: 0 };
        for (partner, map) in maps {
            let own = map.as_slice()[i];
            let agree =
                maps.iter().map(|(_, other)| other.as_slice()[i]).filter(|d| (d - own).abs() <= tolerance * own);
            let (count, sum) = agree.fold((0u8, 0.0), |(n, sum), d| (n + 1, sum + d));
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

    /// A pixel's place in the world at a depth.
    fn place(&self, x: usize, y: usize, depth: f32) -> Option<Point3<f64>> {
        let n = self.camera().normalize(Point2::new(x as f64, y as f64));
        let depth = f64::from(depth);
        let known = depth.is_finite() && n.x.is_finite() && n.y.is_finite();
        known.then(|| self.pose.inverse().transform(&Point3::new(n.x * depth, n.y * depth, depth)))
    }

    /// The pixel that shows a place, and its depth there.
    fn sees(&self, place: &Point3<f64>) -> Option<(usize, f32)> {
        let local = self.pose.transform(place);
        let pixel = self.camera().project(&local).filter(|_| local.z > 0.0)?;
        let (x, y) = (pixel.x.round(), pixel.y.round());
        let inside = x >= 0.0 && y >= 0.0 && x < self.camera().width as f64 && y < self.camera().height as f64;
        inside.then(|| (y as usize * self.camera().width + x as usize, local.z as f32))
    }

    /// The normal at a pixel, towards the camera: by the depths beside it that go on from its own, or where there are none by its ray.
    fn normal(&self, x: usize, y: usize, center: &Point3<f64>, tolerance: f32) -> Vector3<f64> {
        let (width, height) = (self.camera().width, self.camera().height);
        let own = self.pixels[y * width + x].depth;
        let at = |x: usize, y: usize| {
            let inside = x < width && y < height;
            let depth = if inside { self.pixels[y * width + x].depth } else { f32::NAN };
            // Twice what two depths of one place may differ by: a slope, and no edge.
            let goes_on = (depth - own).abs() <= 2.0 * tolerance * own;
            if goes_on { self.place(x, y, depth) } else { None }
        };
        let along = |before: Option<Point3<f64>>, after: Option<Point3<f64>>| match (before, after) {
            (Some(a), Some(b)) => Some(b - a),
            (Some(a), None) => Some(center - a),
            (None, Some(b)) => Some(b - center),
            (None, None) => None,
        };
        let across = along(if x > 0 { at(x - 1, y) } else { None }, at(x + 1, y));
        let down = along(if y > 0 { at(x, y - 1) } else { None }, at(x, y + 1));
        let ray = (self.pose.center() - center).normalize();
        let normal = across.zip(down).and_then(|(across, down)| down.cross(&across).try_normalize(0.0)).unwrap_or(ray);
        if normal.dot(&ray) < 0.0 { -normal } else { normal }
    }
}

/// A point, and where other views show it.
struct Point {
    position: [f32; 3],
    color: [u8; 3],
    normal: [f32; 3],
    shown: Vec<(u32, u32)>,
}

/// By how much deeper than a place, in tolerances, a photograph must see to see through it.
const THROUGH: f32 = 3.0;

/// One cloud of all views. `near` are the views that are asked about each one's depths.
pub(super) fn fuse(
    views: &[Option<ViewDepth<'_>>],
    near: &[Vec<usize>],
    tolerance: f32,
    progress: &dyn Progress,
) -> Result<PointCloud, Cancelled> {
    let stage = Stage::new(progress, "join", views.len())?;
    // Pixels whose place is a point already.
    let mut shown: Vec<Vec<bool>> =
        views.iter().map(|view| vec![false; view.as_ref().map_or(0, |view| view.pixels.len())]).collect();
    let mut cloud = PointCloud::default();
    for (v, view) in views.iter().enumerate() {
        stage.add(1)?;
        let Some(view) = view else { continue };
        let (width, height) = (view.camera().width, view.camera().height);
        let point = |i: usize| {
            if shown[v][i] { None } else { confirmed(views, &near[v], v, view, i, tolerance) }
        };
        let rows: Vec<Vec<Point>> = (0..height)
            .into_par_iter()
            .map(|y| {
                stage.check()?;
                Ok((y * width..(y + 1) * width).filter_map(point).collect())
            })
            .collect::<Result<_, Cancelled>>()?;
        for point in rows.into_iter().flatten() {
            cloud.positions.push(point.position);
            cloud.colors.push(point.color);
            cloud.normals.push(point.normal);
            point.shown.iter().for_each(|(other, pixel)| shown[*other as usize][*pixel as usize] = true);
        }
    }
    Ok(cloud)
}

/// The point at a pixel of view `v`, where another pair of photographs confirms it.
fn confirmed(
    views: &[Option<ViewDepth<'_>>],
    near: &[usize],
    v: usize,
    view: &ViewDepth<'_>,
    i: usize,
    tolerance: f32,
) -> Option<Point> {
    let own = view.pixels[i];
    let (x, y) = (i % view.camera().width, i / view.camera().width);
    let place = view.place(x, y, own.depth)?;
    let (mut agree, mut through, mut ratio, mut shown) = (0, 0, 1.0, Vec::new());
    let mut other_pair = own.pairs > 1;
    for &w in near {
        let Some((other, (pixel, depth))) = views[w].as_ref().and_then(|o| Some((o, o.sees(&place)?))) else {
            continue;
        };
        let there = other.pixels[pixel];
        if (there.depth - depth).abs() <= tolerance * depth {
            agree += 1;
            ratio += there.depth / depth;
            shown.push((w as u32, pixel as u32));
            // The same two photographs, matched from either side, confirm nothing.
            let same = own.partner as usize == w && there.partner as usize == v && there.pairs < 2;
            other_pair |= !same;
        } else if there.depth > depth * (1.0 + THROUGH * tolerance) {
            through += 1;
        }
    }
    if !other_pair || through > agree {
        return None;
    }
    // What all say, on the ray of this one.
    let place = view.place(x, y, own.depth * ratio / (1 + agree) as f32)?;
    let normal = view.normal(x, y, &place, tolerance).cast::<f32>();
    let position = place.cast::<f32>();
    Some(Point { position: position.into(), color: view.photo.image.at(x, y), normal: normal.into(), shown })
}
