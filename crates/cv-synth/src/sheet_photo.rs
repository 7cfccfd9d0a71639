//! Photographs of one flat sheet, quicker than a scene: a calibration board before a wall, with uneven light and glare.

use crate::error::SynthError;
use crate::poster::Poster;
use crate::render::check;
use crate::rng::Rng;
use crate::sensor::{self, RenderOptions};
use crate::texture::{Rgb, SurfacePoint, Texture, mix, scale};
use cv_core::{Camera, Distortion, DistortionModel, Point2, Pose, RgbF32, RgbU8};
use nalgebra::{Matrix2, Point3, Rotation3, Vector2, Vector3};
use rayon::prelude::*;
use std::sync::Arc;

/// A sheet of paper and how it is lit. The sheet lies in the plane z = 0 of its own frame, from the origin `size` to the right and down.
#[derive(Debug, Clone)]
pub struct Sheet {
    /// What is printed on it.
    pub texture: Texture,
    /// Width and height in meters.
    pub size: (f64, f64),
    /// How far its middle is bent away from the chord along the width, as a parabola, in meters; positive away from the camera.
    pub bend: f64,
    /// What is behind it, a meter of it as wide as a meter of the sheet.
    pub behind: Texture,
    /// Change of the light over the width and over the height, as shares.
    pub light: [f32; 2],
    /// A reflection of a lamp: middle in meters on the sheet, radius (one standard deviation) in meters, and what it adds, 1 being white.
    pub glare: Option<([f64; 2], f64, f32)>,
}

impl Sheet {
    /// The point of the sheet `(u, v)` meters from its corner, in its frame.
    pub fn point(&self, u: f64, v: f64) -> Point3<f64> {
        let t = 2.0 * u / self.size.0 - 1.0;
        Point3::new(u, v, self.bend * (1.0 - t * t))
    }

    /// The picture. `pose` maps the sheet's frame to that of the camera.
    ///
    /// A sheet that is bent must not hide itself. Of the options `blur` may be up to 20 here.
    ///
    /// # Errors
    /// [`SynthError`] where the camera, its size or the pose make no sense.
    pub fn photo(&self, camera: &Camera, pose: &Pose, options: &RenderOptions) -> Result<RgbU8, SynthError> {
        let (width, height) = check(camera, pose)?;
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

    fn pixel(&self, camera: &Camera, to_sheet: &Pose, center: Point2<f64>, n: usize) -> Rgb {
        let middle = camera.normalize(center);
        if !middle.x.is_finite() {
            return [0.0; 3];
        }
        // Within a pixel the lens is as good as linear.
        let (_, jacobian) = camera.distortion.distort_with_jacobian(middle);
        let inverse = jacobian.try_inverse().unwrap_or_else(Matrix2::identity);
        let origin = Point3::from(to_sheet.translation);
        // What is behind the sheet is smooth over a pixel by itself, and nobody looks at it that closely.
        let n = if self.is_beside(&origin, &(to_sheet.rotation * Vector3::new(middle.x, middle.y, 1.0)), camera.fx) {
            1
        } else {
            n
        };
        let mut sum = [0.0; 3];
        for j in 0..n {
            for i in 0..n {
                let offset = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
                let p = middle + inverse * Vector2::new(offset(i) / camera.fx, offset(j) / camera.fy);
                let ray = to_sheet.rotation * Vector3::new(p.x, p.y, 1.0);
                let color = self.seen(&origin, &ray, 1.0 / (n as f64 * camera.fx));
                (0..3).for_each(|c| sum[c] += color[c]);
            }
        }
        sum.map(|c| c / (n * n) as f32)
    }

    /// Whether the sheet is further than some two pixels from a ray.
    fn is_beside(&self, origin: &Point3<f64>, ray: &Vector3<f64>, focal: f64) -> bool {
        let t = -origin.z / ray.z;
        let (u, v) = (origin.x + t * ray.x, origin.y + t * ray.y);
        let slant = (ray.z / ray.norm()).abs().max(0.04);
        let far = 2.0 * self.bend.abs() / slant + 3.0 * t.abs() / (focal * slant);
        let inside = |v: f64, size: f64| v > -far && v < size + far;
        !(inside(u, self.size.0) && inside(v, self.size.1))
    }

    /// The light along a ray; `width` is that of a sample at distance 1.
    fn seen(&self, origin: &Point3<f64>, ray: &Vector3<f64>, width: f64) -> Rgb {
        // z of the sheet changes slowly over it: a few rounds find where the ray meets it.
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
        let at = |u: f64, v: f64, size: (f64, f64)| SurfacePoint {
            u: u as f32,
            v: v as f32,
            local: [0.0; 3],
            size: (size.0 as f32, size.1 as f32),
            width: (t * width * ray.norm() / slant.sqrt()) as f32,
        };
        if !(0.0..=w).contains(&u) || !(0.0..=h).contains(&v) {
            return self.behind.color(&at(u + 1.0, v + 1.0, (3.0, 3.0)));
        }
        let light = 1.0 + self.light[0] * (u / w - 0.5) as f32 + self.light[1] * (v / h - 0.5) as f32;
        let color = scale(self.texture.color(&at(u, v, self.size)), light);
        match self.glare {
            Some(([gu, gv], radius, strength)) => {
                let r2 = ((u - gu).powi(2) + (v - gv).powi(2)) / (radius * radius);
                color.map(|c| c + strength * (-0.5 * r2).exp() as f32)
            }
            None => color,
        }
    }
}

/// A photograph of a chessboard with what is true about it.
#[derive(Debug, Clone)]
pub struct ChessboardPhoto {
    /// The picture.
    pub image: RgbU8,
    /// Its camera.
    pub camera: Camera,
    /// Board to camera; the board's origin is its first inner corner, x along the columns.
    pub pose: Pose,
    /// Inner corners along a row, and rows.
    pub size: (usize, usize),
    /// Side of a square in meters.
    pub square: f64,
    /// Where the inner corners are in the picture, row-major from the one beside a black corner square; `None` outside.
    pub corners: Vec<Option<Point2<f64>>>,
}

/// What is difficult about a photograph of a chessboard.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ChessboardTrial {
    /// Nothing: sharp, well lit, at most 30° of tilt.
    Clean,
    /// Blurred by 1 to 2 pixels.
    Blur,
    /// Little light: noise of some ten levels of 255.
    Noise,
    /// 45° to 60° of tilt.
    Tilt,
    /// Light that falls by half over the board, and the reflection of a lamp on it.
    Glare,
    /// A wide lens: strong barrel distortion.
    Wide,
    /// A part of the board is outside the picture.
    Cut,
}

impl ChessboardTrial {
    /// All of them.
    pub const ALL: [Self; 7] = [Self::Clean, Self::Blur, Self::Noise, Self::Tilt, Self::Glare, Self::Wide, Self::Cut];
}

/// A surface to photograph a board before.
fn behind(rng: &mut Rng) -> Texture {
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

/// A random photograph, 640×480, of a board of `size` inner corners that lies in the picture as a whole (but for [`ChessboardTrial::Cut`]).
///
/// # Errors
/// As [`Sheet::photo`]; with the cameras chosen here there are none.
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
    // Until it is all in the picture (or, to be cut, partly).
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
        let middle = Vector3::new(sheet_size.0 / 2.0, sheet_size.1 / 2.0, 0.0);
        let pose = Pose::new(rotation, Vector3::new(aim.x, aim.y, 1.0) * z - rotation * middle);
        let inside = |u: f64, v: f64| {
            let p = pose.transform(&Point3::new(u, v, 0.0));
            let seen = (p.z > 0.05).then(|| camera.project(&p)).flatten();
            seen.filter(|p| p.x > 1.0 && p.y > 1.0 && p.x < 638.0 && p.y < 478.0)
        };
        // The squares at the rim are in the picture as wholes; the paper around need not be.
        let (u0, v0) = (margin, margin);
        let rim = |k: usize| {
            let t = k as f64 / 8.0;
            let (u1, v1) = (u0 + columns * square, v0 + rows * square);
            let (u, v) = (u0 + t * (u1 - u0), v0 + t * (v1 - v0));
            [(u, v0), (u, v1), (u0, v), (u1, v)]
        };
        let seen = (0..=8).flat_map(rim).filter(|&(u, v)| inside(u, v).is_some()).count();
        // Squares of at least nine pixels, in any direction.
        let step = |c: f64, r: f64| {
            let at = |dc: f64, dr: f64| inside(first.x + (c + dc) * square, first.y + (r + dr) * square);
            let (Some(p), Some(q), Some(s)) = (at(0.0, 0.0), at(1.0, 0.0), at(0.0, 1.0)) else { return 0.0 };
            let (a, b) = (q - p, s - p);
            (a.perp(&b).abs() / a.norm().max(b.norm())).min(a.norm()).min(b.norm())
        };
        let (c1, r1) = (columns - 3.0, rows - 3.0);
        let least = [(0.0, 0.0), (c1, 0.0), (0.0, r1), (c1, r1)].iter().fold(f64::MAX, |m, &(c, r)| m.min(step(c, r)));
        let good = if trial == T::Cut { (8..30).contains(&seen) } else { seen == 36 && least > 9.0 };
        if good {
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
    let uneven = if trial == T::Glare { 1.0 } else { 0.2 };
    let sheet = Sheet {
        texture: Texture::Board { squares: (columns as u32, rows as u32), square: square as f32 },
        size: sheet_size,
        bend: 0.0,
        behind: behind(&mut rng),
        light: [rng.range32(-uneven, uneven) * 0.7, rng.range32(-uneven, uneven) * 0.7],
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
    // The texture's first square, at the sheet's corner, is black; where the far end's is too, either begins.
    let pose = pose.compose(&Pose::new(Rotation3::identity(), first.coords));
    let corners = (0..size.0 * size.1)
        .map(|i| {
            let p = Point3::new((i % size.0) as f64 * square, (i / size.0) as f64 * square, 0.0);
            let seen = camera.project(&pose.transform(&p))?;
            let inside = seen.x > -0.5 && seen.y > -0.5 && seen.x < 639.5 && seen.y < 479.5;
            inside.then_some(seen)
        })
        .collect();
    Ok(ChessboardPhoto { image, camera, pose, size, square, corners })
}

/// A random photograph, 640×480, in which no board is: a wall, a poster, a rug, brickwork, books.
///
/// # Errors
/// As [`Sheet::photo`]; there are none.
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
        behind(&mut rng)
    };
    let z = rng.range(0.4, 1.6);
    let middle = rotation * Vector3::new(size.0 / 2.0, size.1 / 2.0, 0.0);
    let sheet = Sheet { texture, size, bend: 0.0, behind: behind(&mut rng), light: [0.2, 0.1], glare: None };
    let pose = Pose::new(rotation, Vector3::z() * z - middle);
    let options = RenderOptions {
        blur: rng.range32(0.3, 1.0),
        full_well: rng.pick([600.0, 12_000.0]),
        samples: 1,
        seed: rng.next(),
        ..RenderOptions::default()
    };
    sheet.photo(&camera, &pose, &options)
}
