//! Images of one planar sheet, faster than a scene: a calibration board in front of a wall, with uneven illumination
//! and glare.

use crate::error::SynthError;
use crate::poster::Poster;
use crate::render::validate;
use crate::rng::Rng;
use crate::sensor::{self, RenderOptions};
use crate::texture::{Rgb, SurfacePoint, Texture, mix, scale};
use cv_core::{Camera, Distortion, DistortionModel, Point2, Pose, RgbF32, RgbU8};
use cv_parallel::prelude::*;
use nalgebra::{Matrix2, Point3, Rotation3, Vector2, Vector3};
use std::sync::Arc;

/// A sheet of paper and its illumination. It is in the plane z = 0 of its own frame, from the origin `size` to the
/// right and down.
#[derive(Debug, Clone)]
pub struct Sheet {
    /// Print of the sheet.
    pub texture: Texture,
    /// Width and height in meters.
    pub size: (f64, f64),
    /// Deflection of its center from the chord along the width, a parabola, in meters; positive away from the camera.
    pub bend: f64,
    /// Texture of the background, at the scale of the sheet.
    pub behind: Texture,
    /// Relative change of the illumination over the width and over the height.
    pub light: [f32; 2],
    /// Specular reflection of a lamp: center in meters on the sheet, radius (one standard deviation) in meters, and
    /// added intensity, 1 being white.
    pub glare: Option<([f64; 2], f64, f32)>,
}

impl Sheet {
    /// Returns the point of the sheet at `(u, v)` meters from its corner, in its frame.
    pub fn point(&self, u: f64, v: f64) -> Point3<f64> {
        let t = 2.0 * u / self.size.0 - 1.0;
        Point3::new(u, v, self.bend * (1.0 - t * t))
    }

    /// Renders an image. `pose` maps the sheet's frame to the camera's.
    ///
    /// A deflected sheet must not occlude itself. The option `blur` may be up to 20 here.
    ///
    /// # Errors
    /// [`SynthError`] if the camera, its size or the pose is not valid.
    pub fn photo(&self, camera: &Camera, pose: &Pose, options: &RenderOptions) -> Result<RgbU8, SynthError> {
        let (width, height) = validate(camera, pose)?;
        let mut linear = RgbF32::new(width, height, [0.0; 3]);
        let to_sheet = pose.inverse();
        let n = options.samples.clamp(1, 8);
        linear.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
            for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
                pixel.copy_from_slice(&self.pixel(camera, &to_sheet, Point2::new(x as f64, y as f64), n));
            }
        });
        let mut linear = sensor::blur(&linear, options.blur);
        sensor::expose(&mut linear, options);
        Ok(sensor::develop(&linear, options))
    }

    /// Returns the mean radiance over a pixel's area, by an `n` × `n` grid of samples.
    fn pixel(&self, camera: &Camera, to_sheet: &Pose, center: Point2<f64>, n: usize) -> Rgb {
        let center_ray = camera.normalize(center);
        if !center_ray.x.is_finite() {
            return [0.0; 3];
        }
        // Within a pixel the distortion is linear.
        let (_, jacobian) = camera.distortion.distort_with_jacobian(center_ray);
        let inverse = jacobian.try_inverse().unwrap_or_else(Matrix2::identity);
        let origin = Point3::from(to_sheet.translation);
        // The background is smooth over a pixel: one sample is enough.
        let n = if self.is_background(
            &origin,
            &(to_sheet.rotation * Vector3::new(center_ray.x, center_ray.y, 1.0)),
            camera.fx,
        ) {
            1
        } else {
            n
        };
        let mut sum = [0.0; 3];
        for j in 0..n {
            for i in 0..n {
                let offset = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
                let p = center_ray + inverse * Vector2::new(offset(i) / camera.fx, offset(j) / camera.fy);
                let ray = to_sheet.rotation * Vector3::new(p.x, p.y, 1.0);
                let color = self.radiance(&origin, &ray, 1.0 / (n as f64 * camera.fx));
                (0..3).for_each(|c| sum[c] += color[c]);
            }
        }
        sum.map(|c| c / (n * n) as f32)
    }

    /// Returns whether a ray passes the sheet at more than about two pixels.
    fn is_background(&self, origin: &Point3<f64>, ray: &Vector3<f64>, focal: f64) -> bool {
        let t = -origin.z / ray.z;
        let (u, v) = (origin.x + t * ray.x, origin.y + t * ray.y);
        let slant = (ray.z / ray.norm()).abs().max(0.04);
        let margin = 2.0 * self.bend.abs() / slant + 3.0 * t.abs() / (focal * slant);
        let is_inside = |v: f64, size: f64| v > -margin && v < size + margin;
        !(is_inside(u, self.size.0) && is_inside(v, self.size.1))
    }

    /// Returns the radiance along a ray; `width` is that of a sample at distance 1.
    fn radiance(&self, origin: &Point3<f64>, ray: &Vector3<f64>, width: f64) -> Rgb {
        // Fixed-point iterations for the deflected sheet, whose z changes slowly.
        let mut t = -origin.z / ray.z;
        for _ in 0..if self.bend == 0.0 { 0 } else { 8 } {
            let u = origin.x + t * ray.x;
            t = (self.point(u.clamp(0.0, self.size.0), 0.0).z - origin.z) / ray.z;
        }
        if t <= 0.0 || !t.is_finite() {
            return [0.2; 3];
        }
        let (u, v) = (origin.x + t * ray.x, origin.y + t * ray.y);
        let (w, h) = self.size;
        let slant = (ray.z / ray.norm()).abs().max(0.04);
        let surface_point = |u: f64, v: f64, size: (f64, f64)| SurfacePoint {
            u: u as f32,
            v: v as f32,
            local: [0.0; 3],
            size: (size.0 as f32, size.1 as f32),
            width: (t * width * ray.norm() / slant.sqrt()) as f32,
        };
        if !(0.0..=w).contains(&u) || !(0.0..=h).contains(&v) {
            return self.behind.color(&surface_point(u + 1.0, v + 1.0, (3.0, 3.0)));
        }
        let illumination = 1.0 + self.light[0] * (u / w - 0.5) as f32 + self.light[1] * (v / h - 0.5) as f32;
        let color = scale(self.texture.color(&surface_point(u, v, self.size)), illumination);
        match self.glare {
            Some(([gu, gv], radius, strength)) => {
                let r2 = ((u - gu).powi(2) + (v - gv).powi(2)) / (radius * radius);
                color.map(|c| c + strength * (-0.5 * r2).exp() as f32)
            }
            None => color,
        }
    }
}

/// An image of a chessboard with its ground truth.
#[derive(Debug, Clone)]
pub struct ChessboardPhoto {
    /// The image.
    pub image: RgbU8,
    /// Its camera.
    pub camera: Camera,
    /// Pose of the board in the camera frame; its origin is the first inner corner, x along the columns.
    pub pose: Pose,
    /// Numbers of inner corners along a row and along a column.
    pub size: (usize, usize),
    /// Side of a square in meters.
    pub square: f64,
    /// Pixels of the inner corners, row-major from the one at a black corner square; `None` outside the image.
    pub corners: Vec<Option<Point2<f64>>>,
}

/// Kind of difficulty of a chessboard image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChessboardTrial {
    /// None: sharp, well lit, a tilt of at most 30°.
    Clean,
    /// Blur of 1 to 2 pixels.
    Blur,
    /// Underexposure: noise of some ten levels of 255.
    Noise,
    /// A tilt of 45° to 60°.
    Tilt,
    /// Illumination that falls by half over the board, and the specular reflection of a lamp.
    Glare,
    /// A wide-angle lens with strong barrel distortion.
    Wide,
    /// A part of the board is out of view.
    Cut,
}

impl ChessboardTrial {
    /// All kinds.
    pub const ALL: [Self; 7] = [Self::Clean, Self::Blur, Self::Noise, Self::Tilt, Self::Glare, Self::Wide, Self::Cut];
}

/// Returns a random background texture.
fn random_background(rng: &mut Rng) -> Texture {
    let seed = rng.seed32();
    let tone = |rng: &mut Rng| [rng.range32(0.05, 0.7), rng.range32(0.05, 0.7), rng.range32(0.05, 0.7)];
    let (a, b) = (tone(rng), tone(rng));
    match rng.index(9) {
        0 => Texture::Paint { color: a, seed },
        1 => Texture::Stone { colors: [a, b], seed },
        2 => Texture::Wallpaper { ground: a, inks: [b, mix(a, b, 0.5), scale(b, 0.5)], cell: 0.07, seed },
        3 => Texture::Bricks { colors: [a, b], mortar: [0.6; 3], seed },
        4 => Texture::Planks { colors: [a, b], plank: 0.09, seed },
        5 => Texture::Tiles { colors: [a, b], tile: 0.11, seed },
        6 => Texture::Fabric { colors: [a, b], seed },
        7 => Texture::Rug { colors: [a, b, mix(b, [0.9; 3], 0.5)], seed },
        _ => Texture::Poster(Arc::new(Poster::new(3.0, 3.0, rng.next()))),
    }
}

/// Renders a random image, 640×480, of a board of `size` inner corners that is wholly in view (except for
/// [`ChessboardTrial::Cut`]).
///
/// # Errors
/// As [`Sheet::photo`]; never with the cameras chosen here.
pub fn chessboard_photo(
    size: (usize, usize),
    trial: ChessboardTrial,
    seed: u64,
) -> Result<ChessboardPhoto, SynthError> {
    use ChessboardTrial as T;
    let mut rng = Rng::new(seed, 0x6368_6573 + trial as u64);
    let square = 0.025;
    let (columns, rows) = ((size.0 + 1) as f64, (size.1 + 1) as f64);
    let margin = rng.range(0.3, 1.2) * square;
    let sheet_size = (columns * square + 2.0 * margin, rows * square + 2.0 * margin);
    let mut camera = Camera::from_focal(640, 480, rng.range(480.0, 800.0));
    let distortion = |model, values: &[f64]| Distortion::new(model, values).unwrap_or_default();
    camera.distortion = match trial {
        T::Wide if rng.chance(0.5) => {
            (camera.fx, camera.fy) = (300.0, 300.0);
            distortion(DistortionModel::Fisheye4, &[-0.02, 0.004, -0.002, 0.0])
        }
        T::Wide => distortion(DistortionModel::Radial, &[-0.35, 0.12]),
        _ => distortion(DistortionModel::Radial, &[rng.range(-0.15, 0.05), 0.0]),
    };
    let (low, high) = if trial == T::Tilt { (45.0, 60.0) } else { (0.0, 30.0) };
    let first = Point3::new(margin + square, margin + square, 0.0);
    // Until all of it is in view (or, for `Cut`, a part).
    let mut chosen = None;
    for _ in 0..400 {
        let axis = rng.range(0.0, std::f64::consts::TAU);
        let tilt = Rotation3::from_axis_angle(
            &nalgebra::Unit::new_normalize(Vector3::new(axis.cos(), axis.sin(), 0.0)),
            rng.range(low, high) * rng.pick([-1.0, 1.0]) * std::f64::consts::PI / 180.0,
        );
        let roll = Rotation3::from_axis_angle(&Vector3::z_axis(), rng.range(0.0, std::f64::consts::TAU));
        let rotation = tilt * roll;
        let length = columns.max(rows) * square;
        let z = camera.fx * length / rng.range(200.0, 560.0);
        let aim = camera.normalize(Point2::new(rng.range(80.0, 560.0), rng.range(60.0, 420.0)));
        if !aim.x.is_finite() {
            continue;
        }
        let center = Vector3::new(sheet_size.0 / 2.0, sheet_size.1 / 2.0, 0.0);
        let pose = Pose::new(rotation, Vector3::new(aim.x, aim.y, 1.0) * z - rotation * center);
        let visible_pixel = |u: f64, v: f64| {
            let p = pose.transform(&Point3::new(u, v, 0.0));
            let seen = (p.z > 0.05).then(|| camera.project(&p)).flatten();
            seen.filter(|p| p.x > 1.0 && p.y > 1.0 && p.x < 638.0 && p.y < 478.0)
        };
        // The outer squares must be wholly in view; the paper around them need not be.
        let (u0, v0) = (margin, margin);
        let border_points = |k: usize| {
            let t = k as f64 / 8.0;
            let (u1, v1) = (u0 + columns * square, v0 + rows * square);
            let (u, v) = (u0 + t * (u1 - u0), v0 + t * (v1 - v0));
            [(u, v0), (u, v1), (u0, v), (u1, v)]
        };
        let visible = (0..=8).flat_map(border_points).filter(|&(u, v)| visible_pixel(u, v).is_some()).count();
        // Squares of at least nine pixels in any direction.
        let step = |c: f64, r: f64| {
            let at = |dc: f64, dr: f64| visible_pixel(first.x + (c + dc) * square, first.y + (r + dr) * square);
            let (Some(p), Some(q), Some(s)) = (at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0)) else { return 0.0 };
            let (a, b) = (q - p, s - p);
            (a.perp(&b).abs() / a.norm().max(b.norm())).min(a.norm()).min(b.norm())
        };
        let (c1, r1) = (columns - 3.0, rows - 3.0);
        let min_square =
            [(0.0, 0.0), (c1, 0.0), (0.0, r1), (c1, r1)].iter().fold(f64::MAX, |m, &(c, r)| m.min(step(c, r)));
        let is_suitable = if trial == T::Cut { (8..30).contains(&visible) } else { visible == 36 && min_square > 9.0 };
        if is_suitable {
            chosen = Some(pose);
            break;
        }
    }
    let upright = Pose::new(Rotation3::identity(), Vector3::new(-sheet_size.0 / 2.0, -sheet_size.1 / 2.0, 0.0));
    let pose = chosen.unwrap_or_else(|| {
        let z = camera.fx * sheet_size.0.max(sheet_size.1) / 380.0;
        Pose::new(upright.rotation, upright.translation + Vector3::z() * z)
    });
    let glare = (trial == T::Glare).then(|| {
        let at = [rng.range(0.2, 0.8) * sheet_size.0, rng.range(0.2, 0.8) * sheet_size.1];
        (at, rng.range(0.5, 1.3) * square, rng.range32(0.2, 0.55))
    });
    let max_change = if trial == T::Glare { 1.0 } else { 0.2 };
    let sheet = Sheet {
        texture: Texture::Board { squares: (columns as u32, rows as u32), square: square as f32 },
        size: sheet_size,
        bend: 0.0,
        behind: random_background(&mut rng),
        light: [rng.range32(-max_change, max_change) * 0.7, rng.range32(-max_change, max_change) * 0.7],
        glare,
    };
    let options = RenderOptions {
        blur: if trial == T::Blur { rng.range32(1.0, 2.0) } else { 0.45 },
        full_well: if trial == T::Noise { 250.0 } else { 12_000.0 },
        exposure: rng.range32(-0.6, 0.0),
        samples: 3,
        ..RenderOptions::default()
    };
    let image = sheet.photo(&camera, &pose, &options.with_seed(rng.next()))?;
    // The texture's first square, at the sheet's corner, is black; if the opposite one is too, either may be the first.
    let pose = pose.compose(&Pose::new(Rotation3::identity(), first.coords));
    let corners = (0..size.0 * size.1)
        .map(|i| {
            let p = Point3::new((i % size.0) as f64 * square, (i / size.0) as f64 * square, 0.0);
            let pixel = camera.project(&pose.transform(&p))?;
            let is_inside = pixel.x > -0.5 && pixel.y > -0.5 && pixel.x < 639.5 && pixel.y < 479.5;
            is_inside.then_some(pixel)
        })
        .collect();
    Ok(ChessboardPhoto { image, camera, pose, size, square, corners })
}

/// Renders a random image, 640×480, without a board: a wall, a poster, a rug, brickwork, books.
///
/// # Errors
/// As [`Sheet::photo`]; never with the camera chosen here.
pub fn photo_without_board(seed: u64) -> Result<RgbU8, SynthError> {
    let mut rng = Rng::new(seed, 0x6E6F_6E65);
    let camera = Camera::from_focal(640, 480, 600.0);
    let axis = rng.range(0.0, std::f64::consts::TAU);
    let axis = nalgebra::Unit::new_normalize(Vector3::new(axis.cos(), axis.sin(), 0.0));
    let rotation = Rotation3::from_axis_angle(&axis, rng.range(0.0, 1.0))
        * Rotation3::from_axis_angle(&Vector3::z_axis(), rng.range(-0.5, 0.5));
    let size = (rng.range(0.3, 1.0), rng.range(0.3, 1.0));
    let texture = if rng.chance(0.6) {
        Texture::Poster(Arc::new(Poster::new(size.0 as f32, size.1 as f32, rng.next())))
    } else {
        random_background(&mut rng)
    };
    let z = rng.range(0.4, 1.6);
    let center = rotation * Vector3::new(size.0 / 2.0, size.1 / 2.0, 0.0);
    let sheet = Sheet { texture, size, bend: 0.0, behind: random_background(&mut rng), light: [0.2, 0.1], glare: None };
    let pose = Pose::new(rotation, Vector3::z() * z - center);
    let options = RenderOptions {
        blur: rng.range32(0.3, 1.0),
        full_well: rng.pick([600.0, 12_000.0]),
        samples: 1,
        seed: rng.next(),
        ..RenderOptions::default()
    };
    sheet.photo(&camera, &pose, &options)
}
