//! Point clouds and cameras: for the viewer inside the report, and as still pictures.

use std::fmt::Write as _;

use cv_core::{Camera, Point2, Point3, PointCloud, Pose, RgbU8, median, quantile};

use crate::base64;
use crate::raster::{Color, Raster, colors};

/// Points and cameras in one world (X right, Y down, Z forward, as the first camera sees it).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PointScene {
    points: Vec<[f32; 3]>,
    colors: Vec<Color>,
    /// Which point of the cloud each is.
    indices: Vec<usize>,
    frusta: Vec<Frustum>,
    photos: Vec<Sightings>,
    left_out: usize,
}

/// Where a photograph shows the points.
#[derive(Debug, Clone, PartialEq)]
struct Sightings {
    photo: String,
    /// Of the photograph's longer side.
    side: usize,
    /// In the order of the points.
    pixels: Vec<Option<Point2<f64>>>,
}

/// A camera's outline: its center and the corners of its picture, in the world, at distance 1.
#[derive(Debug, Clone, PartialEq)]
struct Frustum {
    center: Point3<f64>,
    /// From the center to the corners, top left first, clockwise; `z` along the axis is 1.
    rays: [[f64; 3]; 4],
    /// The direction of the optical axis.
    axis: [f64; 3],
    color: Color,
}

impl PointScene {
    /// The most points kept: of a larger cloud they are taken evenly. Each takes 12 bytes in the file, and 5 for each photograph it was seen in.
    pub const MAX_POINTS: usize = 100_000;
    /// How far from the middle points are kept, in radii that hold 90 % of them: what lies farther, nobody would look at, and 16 bits
    /// would be too few for what does not.
    const REACH: f32 = 10.0;

    /// A scene of the points of a cloud (white where there are too few colors; without its edges). Points that are not finite or far from all
    /// others are left out.
    pub fn new(cloud: &PointCloud) -> Self {
        let (points, colors) = (&cloud.positions, &cloud.colors);
        let mut usable: Vec<usize> = (0..points.len()).filter(|&i| points[i].iter().all(|v| v.is_finite())).collect();
        let finite = usable.len();
        if let Some((center, radius)) = extent(usable.iter().map(|&i| points[i])) {
            usable.retain(|&i| distance(points[i], center) <= Self::REACH * radius);
        }
        let kept = usable.len().min(Self::MAX_POINTS);
        let indices: Vec<usize> =
            (0..kept).map(|i| usable[(i as u64 * usable.len() as u64 / kept as u64) as usize]).collect();
        let (points, colors) = indices.iter().map(|&i| (points[i], colors.get(i).copied().unwrap_or([255; 3]))).unzip();
        Self { points, colors, indices, frusta: Vec::new(), photos: Vec::new(), left_out: finite - kept }
    }

    /// Says where a photograph of `size` pixels shows the points: a click on a point tells. `pixel` is asked with the index of the point in the
    /// cloud that the scene was made of, and answers with a position in pixels.
    pub fn seen_in(
        &mut self,
        photo: &str,
        size: (usize, usize),
        pixel: impl Fn(usize) -> Option<Point2<f64>>,
    ) -> &mut Self {
        let pixels = self.indices.iter().map(|&i| pixel(i)).collect();
        self.photos.push(Sightings { photo: photo.to_owned(), side: size.0.max(size.1), pixels });
        self
    }

    /// Adds a camera.
    pub fn camera(&mut self, camera: &Camera, pose: &Pose, color: Color) -> &mut Self {
        let (w, h) = (camera.width as f64, camera.height as f64);
        let corners = [(-0.5, -0.5), (w - 0.5, -0.5), (w - 0.5, h - 0.5), (-0.5, h - 0.5)];
        let to_world = pose.rotation.inverse();
        let ray = |(x, y): (f64, f64)| {
            let n = camera.normalize(Point2::new(x, y));
            // A corner the lens model cannot place: as a pinhole would.
            let n = if n.coords.iter().all(|v| v.is_finite()) {
                n
            } else {
                Point2::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
            };
            (to_world * nalgebra_vector(n)).into()
        };
        let rays: [[f64; 3]; 4] = corners.map(ray);
        let axis: [f64; 3] = (to_world * cv_core::Vector3::z()).into();
        let center = pose.center();
        if rays.iter().flatten().chain(center.coords.iter()).all(|v| v.is_finite()) {
            self.frusta.push(Frustum { center, rays, axis, color });
        }
        self
    }

    /// How many points of the cloud are not in the scene, though they are finite.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// The extent of the points; without any, of the cameras.
    fn extent(&self) -> ([f32; 3], f32) {
        let centers = self.frusta.iter().map(|f| [f.center.x as f32, f.center.y as f32, f.center.z as f32]);
        extent(self.points.iter().copied()).or_else(|| extent(centers)).unwrap_or(([0.0; 3], 1.0))
    }

    /// How far from its center a camera's picture is drawn: a small part of the scene, and where there are many cameras not far beyond the next one.
    fn frustum_depth(&self) -> f32 {
        let (center, radius) = self.extent();
        let near = self
            .frusta
            .iter()
            .map(|f| distance([f.center.x as f32, f.center.y as f32, f.center.z as f32], center))
            .fold(f32::INFINITY, f32::min);
        let depth = 0.05 * radius.max(near.min(4.0 * radius));
        let mut steps: Vec<f32> =
            self.frusta.windows(2).map(|pair| (pair[1].center - pair[0].center).norm() as f32).collect();
        match median(&mut steps) {
            Some(step) if steps.len() > 1 => depth.min((1.5 * step).max(0.2 * depth)),
            _ => depth,
        }
    }

    /// The corners and the tip of every frustum as line segments with a color.
    fn segments(&self) -> Vec<([f32; 3], [f32; 3], Color)> {
        let depth = f64::from(self.frustum_depth());
        let mut out = Vec::new();
        for f in &self.frusta {
            let at = |ray: &[f64; 3]| {
                [f.center.x + depth * ray[0], f.center.y + depth * ray[1], f.center.z + depth * ray[2]]
                    .map(|v| v as f32)
            };
            let tip = [f.center.x as f32, f.center.y as f32, f.center.z as f32];
            for i in 0..4 {
                out.push((tip, at(&f.rays[i]), f.color));
                out.push((at(&f.rays[i]), at(&f.rays[(i + 1) % 4]), f.color));
            }
        }
        out
    }

    /// The nearest eye looking along `forward` that has every camera and all but the outermost points in its picture of this aspect ratio, as the viewer's
    /// script finds it: first its distance from what it looks at, then the target that leaves as much room on the left as on the right, and above as below. A point at
    /// (u, v, w) from `center` along the eye's axes is in a picture of half width k where |u − shift| ≤ k (w + distance).
    fn frame(
        &self,
        center: &Point3<f64>,
        forward: &cv_core::Vector3<f64>,
        up: &cv_core::Vector3<f64>,
        aspect: f64,
    ) -> Option<(Point3<f64>, f64)> {
        const FOCAL: f64 = 2.2;
        const SHOWN: f64 = 0.98;
        let right = forward.cross(up).try_normalize(1e-9)?;
        let axes = [right, forward.cross(&right), *forward];
        let along = |p: &[f32; 3]| {
            let d = Point3::from(p.map(f64::from)) - center;
            axes.map(|axis| axis.dot(&d))
        };
        let step = (self.points.len() / 2000).max(1);
        let dots: Vec<[f64; 3]> = self.points.iter().step_by(step).map(along).collect();
        let corners: Vec<[f64; 3]> = self.segments().iter().flat_map(|(a, b, _)| [along(a), along(b)]).collect();
        let most = |reach: &dyn Fn(&[f64; 3]) -> f64| {
            let mut values: Vec<f64> = dots.iter().map(reach).collect();
            let inner = quantile(&mut values, SHOWN).unwrap_or(f64::NEG_INFINITY);
            corners.iter().map(reach).fold(inner, f64::max)
        };
        let needed = [aspect, 1.0].into_iter().enumerate().map(|(i, side)| {
            let k = 0.92 * side / FOCAL;
            (most(&|p| p[i] - k * p[2]) + most(&|p| -p[i] - k * p[2])) / (2.0 * k)
        });
        let distance = Some(needed.fold(0.0, f64::max)).filter(|d| *d > 0.0 && d.is_finite())?;
        let mut target = *center;
        for i in [0, 1] {
            let (mut low, mut high) = (-2.0 * distance, 2.0 * distance);
            for _ in 0..24 {
                let shift = (low + high) / 2.0;
                let reach = |sign: f64| most(&|p| sign * (p[i] - shift) / (p[2] + distance).max(1e-9));
                if reach(1.0) > reach(-1.0) { low = shift } else { high = shift }
            }
            target += axes[i] * ((low + high) / 2.0);
        }
        Some((target, distance))
    }

    /// What the viewer's script reads. Numbers in base64 are little-endian: positions as three `u16` over the box of the points, colors as red,
    /// green, blue, sightings as two `u16` for each photograph in steps of its own (0xffff: not seen), ends of lines as three `f32`.
    pub(crate) fn to_json(&self) -> String {
        let (center, radius) = self.extent();
        let bound =
            |axis: usize, pick: fn(f32, f32) -> f32| self.points.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0);
        let low = [0, 1, 2].map(|axis| bound(axis, f32::min));
        let size = [0, 1, 2].map(|axis| bound(axis, f32::max) - low[axis]);
        let short = |bytes: &mut Vec<u8>, share: f64| {
            bytes.extend_from_slice(&((share * 65_535.0).round() as u16).to_le_bytes());
        };
        let (mut positions, mut sightings) = (Vec::new(), Vec::new());
        for (i, p) in self.points.iter().enumerate() {
            for axis in 0..3 {
                short(&mut positions, f64::from(p[axis] - low[axis]) / f64::from(size[axis].max(f32::MIN_POSITIVE)));
            }
            for photo in &self.photos {
                // From half a pixel beyond the border on; the last number stands for none.
                let share = |v: f64| ((v + 0.5) / photo.side as f64).clamp(0.0, 1.0) * 65_534.0 / 65_535.0;
                let pixel = photo.pixels[i].map_or([1.0; 2], |p| [share(p.x), share(p.y)]);
                pixel.iter().for_each(|v| short(&mut sightings, *v));
            }
        }
        let (mut ends, mut line_colors) = (Vec::new(), Vec::new());
        for (a, b, color) in self.segments() {
            a.iter().chain(&b).for_each(|v| ends.extend_from_slice(&v.to_le_bytes()));
            line_colors.extend([color, color].concat());
        }
        let mut json = format!("{{\"center\":{center:?},\"radius\":{radius:?},\"low\":{low:?},\"size\":{size:?}");
        if let Some(f) = self.frusta.first() {
            let _ = write!(json, ",\"axis\":{:?}", f.axis);
        }
        let photos: Vec<String> = (self.photos.iter())
            .map(|photo| format!("{{\"name\":{},\"side\":{}}}", json_text(&photo.photo), photo.side))
            .collect();
        let _ = write!(
            json,
            ",\"count\":{},\"positions\":\"{}\",\"colors\":\"{}\",\"photos\":[{}],\"sightings\":\"{}\",\"ends\":\"{}\",\"lineColors\":\"{}\"}}",
            self.points.len(),
            base64::encode(&positions),
            base64::encode(self.colors.as_flattened()),
            photos.join(","),
            base64::encode(&sightings),
            base64::encode(&ends),
            base64::encode(&line_colors)
        );
        json
    }
}

/// Text as JSON writes it.
fn json_text(text: &str) -> String {
    let mut out = String::from("\"");
    for c in text.chars() {
        match c {
            '"' | '\\' => out.extend(['\\', c]),
            c if c.is_control() => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out.push('"');
    out
}

/// The middle of points (median by axis) and the distance from it that 90 % of them keep.
fn extent(points: impl Iterator<Item = [f32; 3]>) -> Option<([f32; 3], f32)> {
    let points: Vec<[f32; 3]> = points.collect();
    let mut values = Vec::with_capacity(points.len());
    let mut center = [0.0; 3];
    for axis in 0..3 {
        values.clear();
        values.extend(points.iter().map(|p| p[axis]));
        center[axis] = median(&mut values)?;
    }
    let mut distances: Vec<f32> = points.iter().map(|&p| distance(p, center)).collect();
    let radius = quantile(&mut distances, 0.9)?;
    Some((center, if radius > 0.0 && radius.is_finite() { radius } else { 1.0 }))
}

fn nalgebra_vector(n: Point2<f64>) -> cv_core::Vector3<f64> {
    cv_core::Vector3::new(n.x, n.y, 1.0)
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f32>().sqrt()
}

/// From where a still picture of a scene is taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Viewpoint {
    /// From behind the first camera, a little above: what it saw, with depth.
    Camera,
    /// From above, forward up: a map.
    Top,
    /// From the right side.
    Side,
}

/// A still picture of a scene on a dark ground, `width × height` pixels.
pub fn render_points(scene: &PointScene, viewpoint: Viewpoint, width: usize, height: usize) -> RgbU8 {
    const GROUND: Color = [20, 22, 28];
    let mut raster = Raster::new(width, height, GROUND);
    if width == 0 || height == 0 {
        return raster.into_image();
    }
    let (center, radius) = scene.extent();
    let center = Point3::new(f64::from(center[0]), f64::from(center[1]), f64::from(center[2]));
    let radius = f64::from(radius);
    let (forward, up) = match (viewpoint, scene.frusta.first()) {
        (Viewpoint::Top, _) => (cv_core::Vector3::y(), cv_core::Vector3::z()),
        (Viewpoint::Side, _) => (-cv_core::Vector3::x(), -cv_core::Vector3::y()),
        (Viewpoint::Camera, Some(f)) => {
            let axis = cv_core::Vector3::from(f.axis);
            (axis + cv_core::Vector3::y() * 0.35 + cv_core::Vector3::x() * 0.25, -cv_core::Vector3::y())
        }
        (Viewpoint::Camera, None) => (cv_core::Vector3::new(0.25, 0.35, 1.0), -cv_core::Vector3::y()),
    };
    let forward = forward.try_normalize(1e-9).unwrap_or_else(cv_core::Vector3::z);
    // A plan is drawn from far away, where lines that are parallel look it.
    let (target, distance) = match viewpoint {
        Viewpoint::Camera => {
            scene.frame(&center, &forward, &up, width as f64 / height as f64).unwrap_or((center, 3.0 * radius))
        }
        Viewpoint::Top | Viewpoint::Side => (center, 60.0 * radius),
    };
    let eye = target - forward * distance;
    let Some(pose) = Pose::look_at(eye, target, -up) else { return raster.into_image() };
    let project = |p: [f32; 3]| {
        let q = pose.transform(&Point3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2])));
        (q.z > 0.02 * distance).then(|| ([(q.x / q.z) as f32, (q.y / q.z) as f32], q.z as f32))
    };
    // Far points first, near ones over them.
    let mut order: Vec<(f32, [f32; 2], Color)> =
        scene.points.iter().zip(&scene.colors).filter_map(|(p, c)| project(*p).map(|(q, z)| (z, q, *c))).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0));
    let lines: Vec<_> =
        scene.segments().into_iter().filter_map(|(a, b, color)| Some((project(a)?.0, project(b)?.0, color))).collect();
    let Some((middle, scale)) = fit(&order, &lines, width as f32, height as f32) else { return raster.into_image() };
    let place = |q: [f32; 2]| {
        [(q[0] - middle[0]) * scale + width as f32 / 2.0, (q[1] - middle[1]) * scale + height as f32 / 2.0]
    };
    let size = (width.min(height) as f32 / 500.0).clamp(1.0, 3.0);
    let side = (1.5 * size).round() as usize;
    for (_, q, color) in order {
        let corner = place(q).map(|v| (v - side as f32 / 2.0 + 0.5).floor() as i64);
        raster.fill_rect(corner[0], corner[1], side, side, color);
    }
    for (a, b, color) in lines {
        raster.line(place(a), place(b), 1.4 * size, color);
    }
    let name = match viewpoint {
        Viewpoint::Camera => "",
        Viewpoint::Top => "from above",
        Viewpoint::Side => "from the side",
    };
    raster.text(10.0 * size, 10.0 * size, name, 9.0 * size, [170, 176, 190]);
    raster.into_image()
}

/// The middle and the scale that put the cameras and all but the outermost 2 % of the points inside the picture, with a margin.
fn fit(
    points: &[(f32, [f32; 2], Color)],
    lines: &[([f32; 2], [f32; 2], Color)],
    width: f32,
    height: f32,
) -> Option<([f32; 2], f32)> {
    let mut low = [f32::INFINITY; 2];
    let mut high = [f32::NEG_INFINITY; 2];
    for axis in 0..2 {
        let mut values: Vec<f32> = points.iter().map(|p| p.1[axis]).collect();
        if !values.is_empty() {
            values.sort_by(f32::total_cmp);
            let skip = values.len() / 100;
            (low[axis], high[axis]) = (values[skip], values[values.len() - 1 - skip]);
        }
        for v in lines.iter().flat_map(|l| [l.0[axis], l.1[axis]]) {
            (low[axis], high[axis]) = (low[axis].min(v), high[axis].max(v));
        }
    }
    let span = [high[0] - low[0], high[1] - low[1]];
    if !(span[0] >= 0.0 && span[1] >= 0.0 && span.iter().all(|s| s.is_finite())) {
        return None;
    }
    let scale = (0.9 * width / span[0].max(1e-6)).min(0.9 * height / span[1].max(1e-6));
    Some(([(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0], scale))
}

/// Colors for cameras, in order.
pub fn camera_color(index: usize) -> Color {
    [colors::ORANGE, colors::CYAN, colors::MAGENTA, colors::GREEN, colors::YELLOW][index % 5]
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Rotation3, Vector3};

    #[test]
    fn a_point_ahead_is_drawn_in_its_color_and_wild_ones_are_left_out() {
        let points = [[0.0, 0.0, 5.0], [f32::NAN, 0.0, 1.0], [0.0, f32::INFINITY, 0.0]];
        let scene = PointScene::new(&PointCloud::colored(points.to_vec(), vec![[255, 0, 0]; 3]));
        assert_eq!(scene.points.len(), 1);
        for view in [Viewpoint::Camera, Viewpoint::Top, Viewpoint::Side] {
            let picture = render_points(&scene, view, 101, 81);
            assert!(picture.pixels().any(|p| p == [255, 0, 0]), "{view:?}");
        }
        assert!(render_points(&scene, Viewpoint::Top, 0, 0).is_empty());
        assert!(!render_points(&PointScene::default(), Viewpoint::Camera, 20, 20).is_empty());
    }

    #[test]
    fn above_is_up_and_right_is_right_in_the_map() {
        // Most points around the origin, a few ahead on the right: in a map with forward up, those are upper right.
        let mut points: Vec<_> =
            (0..40).map(|i| [(i % 7) as f32 * 0.1 - 0.3, 0.0, (i % 5) as f32 * 0.1 - 0.2]).collect();
        let mut ink = vec![[90, 90, 90]; 40];
        points.extend([[1.0, 0.0, 1.0]; 6]);
        ink.extend([[255, 0, 0]; 6]);
        let scene = PointScene::new(&PointCloud::colored(points, ink));
        let picture = render_points(&scene, Viewpoint::Top, 200, 200);
        let red: Vec<_> = (0..200)
            .flat_map(|y| (0..200).map(move |x| (x, y)))
            .filter(|&(x, y)| picture.at(x, y) == [255, 0, 0])
            .collect();
        assert!(!red.is_empty() && red.iter().all(|&(x, y)| x > 100 && y < 100), "{red:?}");
    }

    #[test]
    fn a_frustum_is_the_cameras_own() {
        let camera = Camera::pinhole(200, 100, 100.0, 100.0, 99.5, 49.5);
        let pose = Pose::new(Rotation3::identity(), Vector3::new(-1.0, 0.0, 0.0));
        let mut scene = PointScene::new(&PointCloud::from_positions(vec![[0.0, 0.0, 10.0]]));
        scene.camera(&camera, &pose, colors::ORANGE);
        let f = &scene.frusta[0];
        assert_eq!(f.center, Point3::new(1.0, 0.0, 0.0));
        assert_eq!(f.rays[0], [-1.0, -0.5, 1.0]);
        assert_eq!(f.rays[2], [1.0, 0.5, 1.0]);
        assert_eq!(scene.segments().len(), 8);
    }

    #[test]
    fn a_small_thing_far_from_its_cameras_is_still_seen() {
        // A facade of 2 × 2 units eight units ahead of two cameras one unit apart.
        let points: Vec<_> = (0..400)
            .map(|i| [(i % 20) as f32 * 0.1 - 1.0, (i / 20) as f32 * 0.1 - 1.0, 8.0 + (i % 3) as f32 * 0.1])
            .collect();
        let mut scene = PointScene::new(&PointCloud::colored(points, vec![[255, 0, 0]; 400]));
        let camera = Camera::from_focal(400, 300, 400.0);
        for (x, color) in [(0.0, colors::ORANGE), (1.0, colors::CYAN)] {
            let pose = Pose::new(Rotation3::identity(), Vector3::new(-x, 0.0, 0.0));
            scene.camera(&camera, &pose, color);
        }
        let picture = render_points(&scene, Viewpoint::Camera, 480, 300);
        let span = |of: Color| {
            let columns = (0..480).filter(|&x| (0..300).any(|y| picture.at(x, y) == of));
            columns.clone().max().unwrap_or(0) - columns.min().unwrap_or(480).min(480)
        };
        // From behind the cameras, about nine units from it, it is as wide as a quarter of what a lens of 2.2 half widths shows there; an outline, 0.4 units wide and nearly as far
        // away as one unit, no more than a half.
        let [red, one, other] = [[255, 0, 0], colors::ORANGE, colors::CYAN].map(span);
        assert!(red > 80 && (1..240).contains(&one) && (1..240).contains(&other), "{red} {one} {other}");
    }

    #[test]
    fn large_clouds_are_thinned_evenly() {
        let n = PointScene::MAX_POINTS + 1000;
        let points: Vec<_> = (0..n).map(|i| [i as f32, 0.0, 0.0]).collect();
        let scene = PointScene::new(&PointCloud::from_positions(points));
        assert_eq!((scene.points.len(), scene.left_out()), (PointScene::MAX_POINTS, 1000));
        assert!(scene.points.windows(2).all(|p| p[1][0] - p[0][0] <= 2.0));
    }

    #[test]
    fn one_wild_point_does_not_take_the_bits_of_the_others() {
        let mut points: Vec<_> = (0..50).map(|i| [i as f32 * 0.1, 0.0, 5.0]).collect();
        points.push([0.0, 0.0, 1e6]);
        let scene = PointScene::new(&PointCloud::from_positions(points));
        assert_eq!((scene.points.len(), scene.left_out()), (50, 1));
        assert!(scene.to_json().contains("\"low\":[0.0, 0.0, 5.0],\"size\":[4.9, 0.0, 0.0]"), "{}", scene.to_json());
    }

    #[test]
    fn sightings_keep_to_their_points_when_others_are_left_out() {
        let points = vec![[f32::NAN; 3], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]];
        let mut scene = PointScene::new(&PointCloud::from_positions(points));
        scene.seen_in("a \"b\".jpg", (100, 50), |i| (i == 2).then(|| Point2::new(49.5, 24.5)));
        let json = scene.to_json();
        // Not seen, then half and a quarter of 0xfffe in little-endian: ff ff ff ff ff 7f 00 40.
        assert!(json.contains("\"sightings\":\"//////9/AEA=\""), "{json}");
        assert!(json.contains(r#""photos":[{"name":"a \"b\".jpg","side":100}]"#), "{json}");
    }
}
