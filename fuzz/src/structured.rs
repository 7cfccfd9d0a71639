//! Generates inputs of the pipelines from bytes: mostly realistic scenes with noise, and some extreme values.

use arbitrary::Unstructured;
use cv_core::{Camera, Correspondence, Distortion, DistortionModel, Point2, Pose, RgbU8, Rotation3, Vector3};

/// Returns any number, often an extreme one.
pub fn number(u: &mut Unstructured<'_>) -> f64 {
    let extremes = [f64::NAN, f64::INFINITY, f64::NEG_INFINITY, 0.0, -0.0, 1e300, -1e300, 1e-310, f64::EPSILON, 1e15];
    let pick = u.int_in_range(0..=7).unwrap_or(7);
    let bits: u64 = u.arbitrary().unwrap_or(0);
    match pick {
        0 => extremes[bits as usize % extremes.len()],
        1 => f64::from_bits(bits),
        2..=4 => (bits % 4096) as f64 / 8.0,
        _ => (bits as i16) as f64 / 64.0,
    }
}

/// Returns a number from `low` to `high`.
pub fn within(u: &mut Unstructured<'_>, low: f64, high: f64) -> f64 {
    low + (high - low) * f64::from(u.arbitrary::<u16>().unwrap_or(0)) / f64::from(u16::MAX)
}

/// Returns an integer from `low` to `high`; `low` at the end of the bytes.
pub fn whole(u: &mut Unstructured<'_>, low: usize, high: usize) -> usize {
    u.int_in_range(low..=high).unwrap_or(low)
}

pub fn flag(u: &mut Unstructured<'_>) -> bool {
    u.arbitrary().unwrap_or(false)
}

/// Returns a pseudorandom number for an index.
fn hash(seed: u32, i: usize) -> u32 {
    let mut v = (i as u32).wrapping_mul(0x9E37_79B9) ^ seed.wrapping_mul(0x85EB_CA6B);
    v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
    v ^ (v >> 12)
}

/// Returns an image of a texture shifted by (`dx`, `dy`), with some pixels from the bytes.
pub fn photo(u: &mut Unstructured<'_>, (w, h): (usize, usize), dx: usize, dy: usize, seed: u32) -> RgbU8 {
    let cell = whole(u, 1, 8);
    let is_constant = whole(u, 0, 7) == 0;
    let mut image = RgbU8::from_fn(w, h, |x, y| {
        let v = hash(seed, (x + dx) / cell + 977 * ((y + dy) / cell));
        if is_constant { [seed as u8; 3] } else { [v as u8, (v >> 8) as u8, (v >> 16) as u8] }
    });
    for _ in 0..whole(u, 0, 12) {
        let [x, y, r, g, b]: [u8; 5] = u.arbitrary().unwrap_or_default();
        if w > 0 && h > 0 {
            image.set(usize::from(x) % w, usize::from(y) % h, [r, g, b]);
        }
    }
    image
}

/// Returns a camera of any distortion model, with mostly small coefficients.
pub fn camera(u: &mut Unstructured<'_>, (width, height): (usize, usize)) -> Camera {
    let is_extreme = whole(u, 0, 15) == 0;
    let mut value = |low: f64, high: f64| if is_extreme { number(u) } else { within(u, low, high) };
    let (fx, fy) = (value(0.2, 3.0) * width as f64, value(0.2, 3.0) * width as f64);
    let (cx, cy) = (value(0.0, 1.0) * width as f64, value(0.0, 1.0) * height as f64);
    let mut camera = Camera::pinhole(width, height, fx, fy, cx, cy);
    let model = DistortionModel::ALL[whole(u, 0, DistortionModel::ALL.len() - 1)];
    let parameters: Vec<f64> =
        (0..model.parameter_count()).map(|_| if is_extreme { number(u) } else { within(u, -0.5, 0.5) }).collect();
    if let Ok(distortion) = Distortion::new(model, &parameters) {
        camera.distortion = distortion;
    }
    camera
}

/// Returns a pose, sometimes an invalid one.
pub fn pose(u: &mut Unstructured<'_>, baseline: f64) -> Pose {
    let is_extreme = whole(u, 0, 15) == 0;
    let mut value = |size: f64| if is_extreme { number(u) } else { within(u, -size, size) };
    let rotation_vector = Vector3::new(value(0.3), value(0.3), value(0.3));
    let translation = Vector3::new(value(baseline) - baseline, value(0.2 * baseline), value(0.2 * baseline));
    Pose::new(Rotation3::new(rotation_vector), translation)
}

/// Matches of two views.
pub struct Input {
    /// Width and height of both photographs.
    pub size: (usize, usize),
    /// True focal length, in pixels.
    pub focal: f64,
    /// The matches.
    pub pairs: Vec<Correspondence>,
}

impl Input {
    /// Generates two views of a plane, of a scene with depth or of a rotating camera, with outliers.
    pub fn of(u: &mut Unstructured<'_>) -> Self {
        let size = (whole(u, 1, 2000), whole(u, 1, 2000));
        let focal = within(u, 0.3, 3.0) * size.0.max(size.1) as f64;
        let [seed, count, outliers, noise, relief]: [u8; 5] = u.arbitrary().unwrap_or_default();
        let mut motion = pose(u, 1.0);
        if whole(u, 0, 3) == 0 {
            motion.translation = Vector3::zeros();
        }
        // Quantized coordinates: few rows and columns, or repeated points.
        let grid = [1, 2, 3, 64, 512, 4096][whole(u, 0, 5)];
        let camera = Camera::from_focal(size.0, size.1, focal);
        let pairs = (0..usize::from(count)).map(|i| {
            let random = |k: usize| f64::from(hash(seed.into(), 8 * i + k) % 4096) / 4096.0;
            let coarse = |v: f64| (v * f64::from(grid)).floor() / f64::from(grid);
            let ray =
                camera.normalize(Point2::new(coarse(random(0)) * size.0 as f64, coarse(random(1)) * size.1 as f64));
            let depth = 4.0 + f64::from(relief) / 32.0 * random(2);
            let point = motion.rotation * (Vector3::new(ray.x, ray.y, 1.0) * depth) + motion.translation;
            let jitter = |k: usize| f64::from(noise) / 64.0 * (random(k) - 0.5);
            let [a, b] = [Vector3::new(ray.x, ray.y, 1.0), point].map(|p| {
                (focal * p.x / p.z + (size.0 as f64 - 1.0) / 2.0, focal * p.y / p.z + (size.1 as f64 - 1.0) / 2.0)
            });
            if random(3) * 256.0 < f64::from(outliers) {
                Correspondence::new(a.0, a.1, random(4) * size.0 as f64, random(5) * size.1 as f64)
            } else {
                Correspondence::new(a.0 + jitter(4), a.1 + jitter(5), b.0 + jitter(6), b.1 + jitter(7))
            }
        });
        let mut pairs: Vec<Correspondence> = pairs.collect();
        for _ in 0..whole(u, 0, 6) {
            let [x, y, z, w] = [(); 4].map(|()| number(u));
            pairs.push(Correspondence::new(x, y, z, w));
        }
        Self { size, focal, pairs }
    }
}
