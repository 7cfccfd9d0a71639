//! Point clouds and cameras, for the interactive viewer of the report and as still images.

use std::fmt::Write as _;

use cv_core::{Camera, Point2, Point3, PointCloud, Pose, RgbU8, median, quantile};

use crate::base64;
use crate::raster::{Color, Raster, colors};

/// Points and cameras in a common world frame (X right, Y down, Z forward).
#[derive(Debug, Clone, PartialEq, Default)]
pub struct PointScene {
    points: Vec<[f32; 3]>,
    colors: Vec<Color>,
    /// Index of each point in the cloud.
    indices: Vec<usize>,
    frusta: Vec<Frustum>,
    photos: Vec<Observations>,
    left_out: usize,
}

/// Observations of the points in one image.
#[derive(Debug, Clone, PartialEq)]
struct Observations {
    photo: String,
    /// Longer side of the image in pixels.
    longer_side: usize,
    /// In the order of the points.
    pixels: Vec<Option<Point2<f64>>>,
}

/// A camera frustum: camera center and rays through the image corners, in the world frame.
#[derive(Debug, Clone, PartialEq)]
struct Frustum {
    center: Point3<f64>,
    /// Rays from the center to the corners, top left first, clockwise, with depth 1 along the optical axis.
    rays: [[f64; 3]; 4],
    /// The direction of the optical axis.
    axis: [f64; 3],
    color: Color,
}

impl PointScene {
    /// Maximum number of points; larger clouds are subsampled evenly. Each takes 12 bytes in the file, and 5 per image with observations.
    pub const MAX_POINTS: usize = 100_000;
    /// Maximum distance from the center, in radii that contain 90 % of the points: farther outliers would degrade the 16-bit quantization of
    /// the others.
    const MAX_DISTANCE_RADII: f32 = 10.0;

    /// Makes a scene of the points of a cloud (white where there are too few colors; without its edges). Points that are not finite or far from
    /// all others are left out.
    pub fn new(cloud: &PointCloud) -> Self {
        let (points, colors) = (&cloud.positions, &cloud.colors);
        let mut usable: Vec<usize> = (0..points.len()).filter(|&i| points[i].iter().all(|v| v.is_finite())).collect();
        let finite = usable.len();
        if let Some((center, radius)) = extent(usable.iter().map(|&i| points[i])) {
            usable.retain(|&i| distance(points[i], center) <= Self::MAX_DISTANCE_RADII * radius);
        }
        let kept = usable.len().min(Self::MAX_POINTS);
        let indices: Vec<usize> =
            (0..kept).map(|i| usable[(i as u64 * usable.len() as u64 / kept as u64) as usize]).collect();
        let (points, colors) = indices.iter().map(|&i| (points[i], colors.get(i).copied().unwrap_or([255; 3]))).unzip();
        Self { points, colors, indices, frusta: Vec::new(), photos: Vec::new(), left_out: finite - kept }
    }

    /// Adds the observations of the points in an image of `size` pixels, which the viewer shows on a click. `pixel` maps the index of a point in
    /// the original cloud to its position in pixels, `None` where it is not observed.
    pub fn add_observations(
        &mut self,
        photo: &str,
        size: (usize, usize),
        pixel: impl Fn(usize) -> Option<Point2<f64>>,
    ) -> &mut Self {
        let pixels = self.indices.iter().map(|&i| pixel(i)).collect();
        self.photos.push(Observations { photo: photo.to_owned(), longer_side: size.0.max(size.1), pixels });
        self
    }

    /// Adds a camera.
    pub fn add_camera(&mut self, camera: &Camera, pose: &Pose, color: Color) -> &mut Self {
        let (w, h) = (camera.width as f64, camera.height as f64);
        let corners = [(-0.5, -0.5), (w - 0.5, -0.5), (w - 0.5, h - 0.5), (-0.5, h - 0.5)];
        let to_world = pose.rotation.inverse();
        let ray = |(x, y): (f64, f64)| {
            let n = camera.normalize(Point2::new(x, y));
            // A corner beyond the range of the lens model: use the pinhole model.
            let n = if n.coords.iter().all(|v| v.is_finite()) {
                n
            } else {
                Point2::new((x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy)
            };
            (to_world * homogeneous(n)).into()
        };
        let rays: [[f64; 3]; 4] = corners.map(ray);
        let axis: [f64; 3] = (to_world * cv_core::Vector3::z()).into();
        let center = pose.center();
        if rays.iter().flatten().chain(center.coords.iter()).all(|v| v.is_finite()) {
            self.frusta.push(Frustum { center, rays, axis, color });
        }
        self
    }

    /// Returns the number of finite points of the cloud that were left out.
    pub fn left_out(&self) -> usize {
        self.left_out
    }

    /// Computes center and radius of the points, or of the cameras where there are no points.
    fn extent(&self) -> ([f32; 3], f32) {
        let centers = self.frusta.iter().map(|f| [f.center.x as f32, f.center.y as f32, f.center.z as f32]);
        extent(self.points.iter().copied()).or_else(|| extent(centers)).unwrap_or(([0.0; 3], 1.0))
    }

    /// Computes the depth of the frusta: a small fraction of the scene's radius, limited by the spacing of the cameras.
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

    /// Returns the edges of every frustum as line segments with a color.
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

    /// Computes the nearest view along `forward` that contains every camera and all but the outermost points at this aspect ratio, as the
    /// viewer's script does: first the distance from the target, then the target that equalizes the margins. A point at (u, v, w) from `center`
    /// along the view's axes is inside a view of half width k where |u − shift| ≤ k (w + distance). Returns target and distance.
    fn frame_scene(
        &self,
        center: &Point3<f64>,
        forward: &cv_core::Vector3<f64>,
        up: &cv_core::Vector3<f64>,
        aspect: f64,
    ) -> Option<(Point3<f64>, f64)> {
        const FOCAL: f64 = 2.2;
        const SHOWN_QUANTILE: f64 = 0.98;
        let right = forward.cross(up).try_normalize(1e-9)?;
        let axes = [right, forward.cross(&right), *forward];
        let along = |p: &[f32; 3]| {
            let d = Point3::from(p.map(f64::from)) - center;
            axes.map(|axis| axis.dot(&d))
        };
        let step = (self.points.len() / 2000).max(1);
        let dots: Vec<[f64; 3]> = self.points.iter().step_by(step).map(along).collect();
        let corners: Vec<[f64; 3]> = self.segments().iter().flat_map(|(a, b, _)| [along(a), along(b)]).collect();
        let max_over_scene = |reach: &dyn Fn(&[f64; 3]) -> f64| {
            let mut values: Vec<f64> = dots.iter().map(reach).collect();
            let inner = quantile(&mut values, SHOWN_QUANTILE).unwrap_or(f64::NEG_INFINITY);
            corners.iter().map(reach).fold(inner, f64::max)
        };
        let needed = [aspect, 1.0].into_iter().enumerate().map(|(i, side)| {
            let k = 0.92 * side / FOCAL;
            (max_over_scene(&|p| p[i] - k * p[2]) + max_over_scene(&|p| -p[i] - k * p[2])) / (2.0 * k)
        });
        let distance = Some(needed.fold(0.0, f64::max)).filter(|d| *d > 0.0 && d.is_finite())?;
        let mut target = *center;
        for i in [0, 1] {
            let (mut low, mut high) = (-2.0 * distance, 2.0 * distance);
            for _ in 0..24 {
                let shift = (low + high) / 2.0;
                let reach = |sign: f64| max_over_scene(&|p| sign * (p[i] - shift) / (p[2] + distance).max(1e-9));
                if reach(1.0) > reach(-1.0) { low = shift } else { high = shift }
            }
            target += axes[i] * ((low + high) / 2.0);
        }
        Some((target, distance))
    }

    /// Serializes the scene for the viewer's script. Binary data are base64, little-endian: positions as three `u16` over the bounding box, colors
    /// as RGB, observations as two `u16` per image relative to its longer side (0xffff: none), ends of lines as three `f32`.
    pub(crate) fn to_json(&self) -> String {
        let (center, radius) = self.extent();
        let bound =
            |axis: usize, pick: fn(f32, f32) -> f32| self.points.iter().map(|p| p[axis]).reduce(pick).unwrap_or(0.0);
        let low = [0, 1, 2].map(|axis| bound(axis, f32::min));
        let size = [0, 1, 2].map(|axis| bound(axis, f32::max) - low[axis]);
        let push_u16 = |bytes: &mut Vec<u8>, share: f64| {
            bytes.extend_from_slice(&((share * 65_535.0).round() as u16).to_le_bytes());
        };
        let (mut positions, mut observations) = (Vec::new(), Vec::new());
        for (i, p) in self.points.iter().enumerate() {
            for axis in 0..3 {
                push_u16(&mut positions, f64::from(p[axis] - low[axis]) / f64::from(size[axis].max(f32::MIN_POSITIVE)));
            }
            for photo in &self.photos {
                // Relative to the image corner; the largest value is reserved for none.
                let share = |v: f64| ((v + 0.5) / photo.longer_side as f64).clamp(0.0, 1.0) * 65_534.0 / 65_535.0;
                let pixel = photo.pixels[i].map_or([1.0; 2], |p| [share(p.x), share(p.y)]);
                pixel.iter().for_each(|v| push_u16(&mut observations, *v));
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
            .map(|photo| format!("{{\"name\":{},\"side\":{}}}", json_text(&photo.photo), photo.longer_side))
            .collect();
        let _ = write!(
            json,
            ",\"count\":{},\"positions\":\"{}\",\"colors\":\"{}\",\"photos\":[{}],\"sightings\":\"{}\",\"ends\":\"{}\",\"lineColors\":\"{}\"}}",
            self.points.len(),
            base64::encode(&positions),
            base64::encode(self.colors.as_flattened()),
            photos.join(","),
            base64::encode(&observations),
            base64::encode(&ends),
            base64::encode(&line_colors)
        );
        json
    }
}

/// Quotes text as a JSON string.
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

/// Computes a robust center of points (median per axis) and the radius that contains 90 % of them.
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

fn homogeneous(n: Point2<f64>) -> cv_core::Vector3<f64> {
    cv_core::Vector3::new(n.x, n.y, 1.0)
}

fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|i| (a[i] - b[i]) * (a[i] - b[i])).sum::<f32>().sqrt()
}

/// Viewpoint of a still image of a scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Viewpoint {
    /// From behind and a little above the first camera.
    Camera,
    /// From above, forward is up in the image.
    Top,
    /// From the right side.
    Side,
}

/// Renders a still image of a scene on a dark background, `width × height` pixels.
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
    // Views from above and from the side are nearly orthographic: from far away.
    let (target, distance) = match viewpoint {
        Viewpoint::Camera => {
            scene.frame_scene(&center, &forward, &up, width as f64 / height as f64).unwrap_or((center, 3.0 * radius))
        }
        Viewpoint::Top | Viewpoint::Side => (center, 60.0 * radius),
    };
    let eye = target - forward * distance;
    let Some(pose) = Pose::look_at(eye, target, -up) else { return raster.into_image() };
    let project = |p: [f32; 3]| {
        let q = pose.transform(&Point3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2])));
        (q.z > 0.02 * distance).then(|| ([(q.x / q.z) as f32, (q.y / q.z) as f32], q.z as f32))
    };
    // Painter's algorithm: far points first.
    let mut order: Vec<(f32, [f32; 2], Color)> =
        scene.points.iter().zip(&scene.colors).filter_map(|(p, c)| project(*p).map(|(q, z)| (z, q, *c))).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0));
    let lines: Vec<_> =
        scene.segments().into_iter().filter_map(|(a, b, color)| Some((project(a)?.0, project(b)?.0, color))).collect();
    let Some((center, scale)) = fit_to_image(&order, &lines, width as f32, height as f32) else {
        return raster.into_image();
    };
    let place = |q: [f32; 2]| {
        [(q[0] - center[0]) * scale + width as f32 / 2.0, (q[1] - center[1]) * scale + height as f32 / 2.0]
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

/// Computes the center and the scale that fit the cameras and all but the outermost 2 % of the points into the image, with a margin.
fn fit_to_image(
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

/// Returns the color of the camera with this index.
pub fn camera_color(index: usize) -> Color {
    [colors::ORANGE, colors::CYAN, colors::MAGENTA, colors::GREEN, colors::YELLOW][index % 5]
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Rotation3, Vector3};

    #[test]
    fn finite_points_are_drawn_in_their_color_and_others_left_out() {
        let points = [[0.0, 0.0, 5.0], [f32::NAN, 0.0, 1.0], [0.0, f32::INFINITY, 0.0]];
        let scene = PointScene::new(&PointCloud::colored(points.to_vec(), vec![[255, 0, 0]; 3]));
        assert_eq!(scene.points.len(), 1);
        for view in [Viewpoint::Camera, Viewpoint::Top, Viewpoint::Side] {
            let rendered = render_points(&scene, view, 101, 81);
            assert!(rendered.pixels().any(|p| p == [255, 0, 0]), "{view:?}");
        }
        assert!(render_points(&scene, Viewpoint::Top, 0, 0).is_empty());
        assert!(!render_points(&PointScene::default(), Viewpoint::Camera, 20, 20).is_empty());
    }

    #[test]
    fn in_the_view_from_above_forward_is_up() {
        // Most points around the origin, a few ahead on the right, which are drawn in the upper right.
        let mut points: Vec<_> =
            (0..40).map(|i| [(i % 7) as f32 * 0.1 - 0.3, 0.0, (i % 5) as f32 * 0.1 - 0.2]).collect();
        let mut ink = vec![[90, 90, 90]; 40];
        points.extend([[1.0, 0.0, 1.0]; 6]);
        ink.extend([[255, 0, 0]; 6]);
        let scene = PointScene::new(&PointCloud::colored(points, ink));
        let rendered = render_points(&scene, Viewpoint::Top, 200, 200);
        let red: Vec<_> = (0..200)
            .flat_map(|y| (0..200).map(move |x| (x, y)))
            .filter(|&(x, y)| rendered.at(x, y) == [255, 0, 0])
            .collect();
        assert!(!red.is_empty() && red.iter().all(|&(x, y)| x > 100 && y < 100), "{red:?}");
    }

    #[test]
    fn a_frustum_has_the_rays_of_the_image_corners() {
        let camera = Camera::pinhole(200, 100, 100.0, 100.0, 99.5, 49.5);
        let pose = Pose::new(Rotation3::identity(), Vector3::new(-1.0, 0.0, 0.0));
        let mut scene = PointScene::new(&PointCloud::from_positions(vec![[0.0, 0.0, 10.0]]));
        scene.add_camera(&camera, &pose, colors::ORANGE);
        let f = &scene.frusta[0];
        assert_eq!(f.center, Point3::new(1.0, 0.0, 0.0));
        assert_eq!(f.rays[0], [-1.0, -0.5, 1.0]);
        assert_eq!(f.rays[2], [1.0, 0.5, 1.0]);
        assert_eq!(scene.segments().len(), 8);
    }

    #[test]
    fn a_small_object_far_from_its_cameras_is_visible() {
        // A facade of 2 × 2 units eight units ahead of two cameras one unit apart.
        let points: Vec<_> = (0..400)
            .map(|i| [(i % 20) as f32 * 0.1 - 1.0, (i / 20) as f32 * 0.1 - 1.0, 8.0 + (i % 3) as f32 * 0.1])
            .collect();
        let mut scene = PointScene::new(&PointCloud::colored(points, vec![[255, 0, 0]; 400]));
        let camera = Camera::from_focal(400, 300, 400.0);
        for (x, color) in [(0.0, colors::ORANGE), (1.0, colors::CYAN)] {
            let pose = Pose::new(Rotation3::identity(), Vector3::new(-x, 0.0, 0.0));
            scene.add_camera(&camera, &pose, color);
        }
        let rendered = render_points(&scene, Viewpoint::Camera, 480, 300);
        let span = |of: Color| {
            let columns = (0..480).filter(|&x| (0..300).any(|y| rendered.at(x, y) == of));
            columns.clone().max().unwrap_or(0) - columns.min().unwrap_or(480).min(480)
        };
        // From behind the cameras, about nine units away, it takes a quarter of the width of a view with a focal length of 2.2 half widths; a
        // frustum, 0.4 units wide and about one unit away, at most half.
        let [red, one, other] = [[255, 0, 0], colors::ORANGE, colors::CYAN].map(span);
        assert!(red > 80 && (1..240).contains(&one) && (1..240).contains(&other), "{red} {one} {other}");
    }

    #[test]
    fn large_clouds_are_subsampled_evenly() {
        let n = PointScene::MAX_POINTS + 1000;
        let points: Vec<_> = (0..n).map(|i| [i as f32, 0.0, 0.0]).collect();
        let scene = PointScene::new(&PointCloud::from_positions(points));
        assert_eq!((scene.points.len(), scene.left_out()), (PointScene::MAX_POINTS, 1000));
        assert!(scene.points.windows(2).all(|p| p[1][0] - p[0][0] <= 2.0));
    }

    #[test]
    fn an_outlier_does_not_degrade_the_quantization() {
        let mut points: Vec<_> = (0..50).map(|i| [i as f32 * 0.1, 0.0, 5.0]).collect();
        points.push([0.0, 0.0, 1e6]);
        let scene = PointScene::new(&PointCloud::from_positions(points));
        assert_eq!((scene.points.len(), scene.left_out()), (50, 1));
        assert!(scene.to_json().contains("\"low\":[0.0, 0.0, 5.0],\"size\":[4.9, 0.0, 0.0]"), "{}", scene.to_json());
    }

    #[test]
    fn observations_match_their_points_when_others_are_left_out() {
        let points = vec![[f32::NAN; 3], [0.0, 0.0, 1.0], [1.0, 0.0, 1.0]];
        let mut scene = PointScene::new(&PointCloud::from_positions(points));
        scene.add_observations("a \"b\".jpg", (100, 50), |i| (i == 2).then(|| Point2::new(49.5, 24.5)));
        let json = scene.to_json();
        // Not observed, then half and a quarter of 0xfffe in little-endian: ff ff ff ff ff 7f 00 40.
        assert!(json.contains("\"sightings\":\"//////9/AEA=\""), "{json}");
        assert!(json.contains(r#""photos":[{"name":"a \"b\".jpg","side":100}]"#), "{json}");
    }
}
