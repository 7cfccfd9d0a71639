//! A wide landscape of known radiance in every direction, and images of it from one center by a camera with a response
//! curve, vignetting and noise. It tests the photometric part of panoramas, for which a room
//! ([`panorama_views`](crate::panorama_views)) has too little contrast.

use crate::error::SynthError;
use crate::noise::noise2;
use crate::rng::{Rng, normal_pair};
use crate::sensor::encode_srgb;
use crate::texture::Rgb;
use cv_core::{Camera, Mask, Point2, RgbU8, Rotation3, Vector3};
use cv_parallel::prelude::*;

/// A landscape: sky with a sun, hills, a row of houses, a meadow.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Vista {
    seed: u32,
    detail: f32,
}

impl Vista {
    /// Creates a landscape whose finest texture has `detail` periods per radian, 50 to 5000; a quarter of the focal
    /// length in pixels is suitable.
    pub fn new(seed: u64, detail: f32) -> Self {
        Self {
            seed: Rng::new(seed, 70).seed32(),
            detail: if detail.is_nan() { 250.0 } else { detail.clamp(50.0, 5000.0) },
        }
    }

    /// Returns the linear radiance from a direction; 1 is white in a well-exposed image, the sun is brighter. X right,
    /// Y down, Z forward; any length.
    pub fn radiance(&self, ray: &Vector3<f64>) -> Rgb {
        let across = ray.x.hypot(ray.z);
        let (az, el) = (ray.x.atan2(ray.z) as f32, (-ray.y).atan2(across) as f32);
        let ridge = 0.10 + 0.05 * noise2(2.3 * az, 3.1, self.seed) + 0.008 * noise2(23.0 * az, 7.7, self.seed);
        if el > ridge {
            return self.sky(ray, el);
        }
        if el > -0.16 && (0.2 + noise2(0.9 * az, 11.3, self.seed)) > 0.0 && el < 0.07 {
            return self.houses(az, el);
        }
        let grass = self.texture(az, el, 6.0);
        let (near, far): (Rgb, Rgb) = ([0.10, 0.16, 0.05], [0.12, 0.17, 0.16]);
        let t = ((el + 0.25) / 0.35).clamp(0.0, 1.0);
        std::array::from_fn(|c| (near[c] + t * (far[c] - near[c])) * grass)
    }

    fn sky(&self, ray: &Vector3<f64>, el: f32) -> Rgb {
        let sun = Vector3::new(0.5, -0.55, 1.0).normalize();
        let one_minus_cos = 1.0 - ray.normalize().dot(&sun) as f32;
        let glow = 0.5 * (-one_minus_cos * 12.0).exp() + if one_minus_cos < 1e-4 { 40.0 } else { 0.0 };
        let t = (el / 1.2).clamp(0.0, 1.0).sqrt();
        let (low, high): (Rgb, Rgb) = ([0.52, 0.62, 0.72], [0.14, 0.28, 0.58]);
        std::array::from_fn(|c| low[c] + t * (high[c] - low[c]) + glow)
    }

    /// Returns the radiance of plastered walls with windows.
    fn houses(&self, az: f32, el: f32) -> Rgb {
        let (u, v) = (az * 14.0, (el + 0.16) * 30.0);
        let (house, story) = ((u / 4.0).floor(), v.floor());
        let tint = noise2(house * 1.7 + 0.3, 5.1, self.seed);
        let (fu, fv) = (u - u.floor(), v - v.floor());
        if (0.3..0.7).contains(&fu) && (0.25..0.75).contains(&fv) {
            let dark = 0.03 + 0.03 * noise2(u.floor() * 3.3, story * 2.9, self.seed).abs();
            return [dark, 1.1 * dark, 1.3 * dark];
        }
        let rough = 0.6 + 0.4 * self.texture(az, el, 20.0);
        let wall = (0.42 + 0.25 * tint) * rough;
        [wall, 0.9 * wall, (0.75 - 0.15 * tint) * wall]
    }

    /// Returns octaves of noise from `first` periods per radian to the finest, around 1.
    fn texture(&self, az: f32, el: f32, first: f32) -> f32 {
        let (mut sum, mut frequency, mut octave) = (0.0, first, 0);
        while frequency <= self.detail {
            sum += 0.28 * noise2(frequency * az, frequency * el, self.seed ^ octave);
            frequency *= 2.6;
            octave += 1;
        }
        (1.0 + sum).max(0.15)
    }
}

/// Options of [`vista_photos`].
#[derive(Debug, Clone, PartialEq)]
pub struct VistaOptions {
    /// Number of images. Default 8.
    pub views: usize,
    /// Overlap of neighboring images, as a ratio of the width, 0.1 to 0.9. Default 0.45.
    pub overlap: f64,
    /// Range of exposures, in stops: from minus to plus this, and both occur. Default 1.
    pub exposure: f32,
    /// Largest relative error of red and blue, different for each image. Default 0.
    pub white_balance: f32,
    /// Vignetting: relative loss at the corners. Default 0.35, a wide-angle lens wide open.
    pub vignetting: f32,
    /// Strength of the S-shaped response curve on top of sRGB, 0 to 0.8. Default 0.4.
    pub contrast: f32,
    /// Standard deviation of the noise in gray levels. Default 1.
    pub noise: f32,
    /// Samples along each side of a pixel. Default 2.
    pub samples: usize,
    /// Largest pitch, roll and yaw error, in radians. Default 0.02.
    pub shake: f64,
    /// Whether a person stands at another place in every image. Default false.
    pub walker: bool,
}

impl Default for VistaOptions {
    fn default() -> Self {
        Self {
            views: 8,
            overlap: 0.45,
            exposure: 1.0,
            white_balance: 0.0,
            vignetting: 0.35,
            contrast: 0.4,
            noise: 1.0,
            samples: 2,
            shake: 0.02,
            walker: false,
        }
    }
}

/// An image with its ground truth.
#[derive(Debug, Clone)]
pub struct VistaPhoto {
    /// The image as the camera stores it.
    pub image: RgbU8,
    /// The camera.
    pub camera: Camera,
    /// Rotation from world to camera.
    pub from_world: Rotation3<f64>,
    /// Exposure in stops.
    pub exposure: f32,
    /// White balance factors of red, green and blue.
    pub white_balance: Rgb,
    /// Mask of the person.
    pub walker: Mask,
}

/// Returns the camera response: the level, 0 to 1, that a camera of this contrast stores for a linear intensity, sRGB
/// followed by `v + contrast · v (1 − v) (2 v − 1)`.
pub fn vista_response(intensity: f32, contrast: f32) -> f32 {
    let v = encode_srgb(intensity.clamp(0.0, 1.0));
    v + contrast * v * (1.0 - v) * (2.0 * v - 1.0)
}

/// Renders images of a landscape by a camera that rotates to the right, with the given overlap.
///
/// # Errors
/// [`SynthError::Camera`] or [`SynthError::Size`] if the camera is not valid.
pub fn vista_photos(
    vista: &Vista,
    seed: u64,
    camera: &Camera,
    options: &VistaOptions,
) -> Result<Vec<VistaPhoto>, SynthError> {
    camera.validate()?;
    let (width, height) = (camera.width, camera.height);
    if width == 0 || height == 0 {
        return Err(SynthError::Size { width, height });
    }
    let mut rng = Rng::new(seed, 71);
    let field = 2.0 * (width as f64 / (2.0 * camera.fx)).atan();
    let (n, step) = (options.views, field * (1.0 - options.overlap.clamp(0.1, 0.9)));
    let mut exposures: Vec<f32> = (0..n).map(|_| rng.range32(-1.0, 1.0)).collect();
    let extreme = |of: fn(f32, f32) -> f32| exposures.iter().copied().reduce(of).unwrap_or(0.0);
    let (low, high) = (extreme(f32::min), extreme(f32::max));
    exposures.iter_mut().for_each(|e| *e = options.exposure * (2.0 * (*e - low) / (high - low).max(1e-6) - 1.0));
    let photos = exposures.into_iter().enumerate().map(|(k, exposure)| {
        let mut jitter = || rng.range(-options.shake, options.shake);
        let yaw = step * (k as f64 - 0.5 * (n as f64 - 1.0)) + jitter();
        let (pitch, roll) = (0.08 + jitter(), jitter());
        let from_world = Rotation3::from_axis_angle(&Vector3::z_axis(), roll)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), -pitch)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
        let mut factor = || 1.0 + rng.range32(-options.white_balance, options.white_balance);
        let white_balance = [factor(), 1.0, factor()];
        let walker_azimuth = options.walker.then(|| (yaw + rng.range(-0.35, 0.35) * field) as f32);
        let shot = Exposure { vista, camera, from_world, exposure, white_balance, walker_azimuth, options };
        shot.photo(seed ^ (k as u64) << 32)
    });
    Ok(photos.collect())
}

/// The parameters of one image.
struct Exposure<'a> {
    vista: &'a Vista,
    camera: &'a Camera,
    from_world: Rotation3<f64>,
    exposure: f32,
    white_balance: Rgb,
    /// Azimuth of the person.
    walker_azimuth: Option<f32>,
    options: &'a VistaOptions,
}

impl Exposure<'_> {
    fn is_walker(&self, ray: &Vector3<f64>) -> bool {
        let Some(walker_azimuth) = self.walker_azimuth else { return false };
        let (az, el) = (ray.x.atan2(ray.z) as f32, (-ray.y).atan2(ray.x.hypot(ray.z)) as f32);
        let body = ((az - walker_azimuth) / 0.035).powi(2) + ((el + 0.20) / 0.11).powi(2);
        let head = ((az - walker_azimuth) / 0.016).powi(2) + ((el + 0.075) / 0.022).powi(2);
        body < 1.0 || head < 1.0
    }

    fn photo(&self, seed: u64) -> VistaPhoto {
        let (camera, options) = (self.camera, self.options);
        let (width, height) = (camera.width, camera.height);
        let world = self.from_world.inverse();
        let ray = |x: f64, y: f64| {
            let p = camera.normalize(Point2::new(x, y));
            world * Vector3::new(p.x, p.y, 1.0)
        };
        let radiance_of = |ray: &Vector3<f64>| {
            if self.is_walker(ray) { [0.35, 0.05, 0.06] } else { self.vista.radiance(ray) }
        };
        let n = options.samples.max(1);
        let (cx, cy) = (0.5 * (width as f32 - 1.0), 0.5 * (height as f32 - 1.0));
        let corner = (cx * cx + cy * cy).max(1.0);
        let mut image = RgbU8::new(width, height, [0; 3]);
        image.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
            for (x, out) in row.as_chunks_mut::<3>().0.iter_mut().enumerate() {
                let mut sum = [0.0; 3];
                for i in 0..n * n {
                    let offset = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
                    let l = radiance_of(&ray(x as f64 + offset(i % n), y as f64 + offset(i / n)));
                    (0..3).for_each(|c| sum[c] += l[c] / (n * n) as f32);
                }
                let (dx, dy) = (x as f32 - cx, y as f32 - cy);
                let factor = self.exposure.exp2() * (1.0 - options.vignetting * (dx * dx + dy * dy) / corner);
                let counter = 2 * (y * width + x) as u64;
                let noise = if options.noise > 0.0 {
                    let (a, b) = normal_pair(seed, counter);
                    [a, b, normal_pair(seed, counter + 1).0]
                } else {
                    [0.0; 3]
                };
                for c in 0..3 {
                    let level = vista_response(sum[c] * factor * self.white_balance[c], options.contrast);
                    // Clipped pixels have no noise.
                    let noise = if level >= 1.0 { 0.0 } else { options.noise * noise[c] };
                    out[c] = (255.0 * level + noise).clamp(0.0, 255.0).round() as u8;
                }
            }
        });
        let mut walker = Mask::new(width, height, [false]);
        if self.walker_azimuth.is_some() {
            walker.as_mut_slice().par_chunks_mut(width).enumerate().for_each(|(y, row)| {
                row.iter_mut().enumerate().for_each(|(x, m)| *m = self.is_walker(&ray(x as f64, y as f64)));
            });
        }
        let Self { from_world, exposure, white_balance, .. } = *self;
        VistaPhoto { image, camera: *camera, from_world, exposure, white_balance, walker }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_image_shows_the_radiance_of_its_directions() {
        let (vista, camera) = (Vista::new(3, 40.0), Camera::from_focal(96, 64, 90.0));
        let plain = VistaOptions { views: 3, vignetting: 0.0, noise: 0.0, samples: 1, ..VistaOptions::default() };
        let photos = vista_photos(&vista, 5, &camera, &plain).unwrap();
        assert_eq!(photos.len(), 3);
        let stops: Vec<f32> = photos.iter().map(|p| p.exposure).collect();
        // Both ends of the range occur.
        assert!(stops.contains(&-1.0) && stops.iter().any(|e| (e - 1.0).abs() < 1e-6), "{stops:?}");
        for photo in &photos {
            for (x, y) in [(5, 7), (50, 20), (90, 60)] {
                let n = camera.normalize(Point2::new(x as f64, y as f64));
                let radiance = vista.radiance(&(photo.from_world.inverse() * Vector3::new(n.x, n.y, 1.0)));
                let level = radiance.map(|l| 255.0 * vista_response(l * photo.exposure.exp2(), 0.4));
                let off = photo.image.at(x, y).into_iter().zip(level).map(|(a, b)| (f32::from(a) - b).abs());
                // Rounding to bytes.
                assert!(off.fold(0.0, f32::max) <= 0.501, "{x} {y}");
            }
        }
        let dark = VistaOptions { vignetting: 0.5, ..plain.clone() };
        let corner = vista_photos(&vista, 5, &camera, &dark).unwrap()[0].image.at(0, 0)[1];
        assert!(corner < photos[0].image.at(0, 0)[1]);
        let someone = vista_photos(&vista, 5, &camera, &VistaOptions { walker: true, ..plain }).unwrap();
        assert!(someone.iter().all(|p| p.walker.as_slice().iter().filter(|m| **m).count() > 20));
    }

    #[test]
    fn the_camera_response_is_monotonic() {
        for contrast in [0.0, 0.4, 0.8] {
            let levels: Vec<f32> = (0..=100).map(|i| vista_response(i as f32 / 100.0, contrast)).collect();
            assert!(levels.is_sorted() && levels[0] == 0.0 && (levels[100] - 1.0).abs() < 1e-5);
        }
    }
}
