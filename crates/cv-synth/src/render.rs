//! Rendering of scenes.

use crate::error::SynthError;
use crate::scene::Scene;
use crate::sensor::{self, RenderOptions};
use crate::shape::Ray;
use crate::texture::{Rgb, Texture};
use crate::world::Hit;
use cv_core::{Camera, GrayF32, Image, Mask, Point2, Pose, RgbF32, RgbU8};
use cv_parallel::prelude::*;
use nalgebra::{Matrix2, Point3, Vector3};

/// An image with its ground truth: that of the ray through each pixel's center.
#[derive(Debug, Clone)]
pub struct Rendered {
    /// The image as a camera stores it: with noise, sRGB encoded.
    pub image: RgbU8,
    /// The linear image, 1 = white: with blur, exposure, white balance and vignetting, without noise and clipping.
    pub linear: RgbF32,
    /// Depth (Z in the camera frame) in meters; NaN without a surface, or outside the range of the distortion model.
    pub depth: GrayF32,
    /// Object identifiers (see [`Scene::object_id`]); 0 = none.
    pub ids: Image<u32, 1>,
    /// The camera.
    pub camera: Camera,
    /// World to camera.
    pub pose: Pose,
}

impl Rendered {
    /// Returns the mask of an object.
    pub fn mask(&self, object: u32) -> Mask {
        self.ids.map(|[id]| [id == object])
    }

    /// Returns the world position of the surface at a pixel's center; `None` outside the image or without a surface.
    ///
    /// Accurate to the `f32` depth: 6e-8 of it. [`Scene::point_at`] is exact.
    pub fn world_point(&self, x: usize, y: usize) -> Option<Point3<f64>> {
        let z = f64::from(self.depth.get(x, y)?[0]);
        let ray = self.camera.normalize(Point2::new(x as f64, y as f64));
        let p = Point3::new(ray.x * z, ray.y * z, z);
        (z > 0.0).then(|| self.pose.inverse().transform(&p))
    }

    /// Returns another photograph of the same view, without rendering it again: exposed longer by `stops`, with the noise of
    /// `options` (its other fields have no effect).
    pub fn retake(&self, stops: f32, options: &RenderOptions) -> Self {
        let gain = stops.exp2();
        let linear = self.linear.map(|color| color.map(|c| c * gain));
        Self { image: sensor::develop(&linear, options), linear, ..self.clone() }
    }
}

/// Renders a view of a scene.
///
/// # Errors
/// [`SynthError`] if the camera, its size or the pose is not valid.
pub fn render(scene: &Scene, camera: &Camera, pose: &Pose, options: &RenderOptions) -> Result<Rendered, SynthError> {
    let (width, height) = validate(camera, pose)?;
    let view = View::new(scene, camera, pose);

    // Ground truth: one ray for each pixel center.
    let mut centers: Vec<Option<Hit>> = vec![None; width * height];
    centers.par_chunks_mut(width).enumerate().for_each(|(y, row)| {
        for (x, hit) in row.iter_mut().enumerate() {
            *hit = view.ray(Point2::new(x as f64, y as f64)).and_then(|ray| scene.world.hit(&ray));
        }
    });
    let depth = Image::from_fn(width, height, |x, y| [centers[y * width + x].map_or(f32::NAN, |h| h.t as f32)]);
    let ids =
        Image::from_fn(width, height, |x, y| [centers[y * width + x].map_or(0, |h| scene.world.prims[h.prim].object)]);

    let mut linear = Image::new(width, height, [0.0; 3]);
    let samples = options.samples.clamp(1, 8);
    let prim = |x: usize, y: usize| centers[y.min(height - 1) * width + x.min(width - 1)].map(|h| h.prim);
    linear.as_mut_slice().par_chunks_mut(3 * width).enumerate().for_each(|(y, row)| {
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let here = prim(x, y);
            let is_inside =
                (y.saturating_sub(1)..=y + 1).all(|j| (x.saturating_sub(1)..=x + 1).all(|i| prim(i, j) == here));
            let n = if is_inside { samples } else { 2 * samples };
            // Away from object boundaries the whole pixel shows the surface at its center; an object thinner than the
            // spacing of pixel centers may be lost there.
            let only = if is_inside { here } else { None };
            pixel.copy_from_slice(&view.pixel(Point2::new(x as f64, y as f64), n, only));
        }
    });
    let mut linear = sensor::blur(&linear, options.blur);
    sensor::expose(&mut linear, options);
    let image = sensor::develop(&linear, options);
    Ok(Rendered { image, linear, depth, ids, camera: *camera, pose: *pose })
}

/// Validates camera and pose, and returns the image size.
pub(crate) fn validate(camera: &Camera, pose: &Pose) -> Result<(usize, usize), SynthError> {
    camera.validate()?;
    let (width, height) = (camera.width, camera.height);
    if width == 0 || height == 0 || width.checked_mul(height).is_none_or(|n| n > u32::MAX as usize) {
        return Err(SynthError::Size { width, height });
    }
    let is_finite = pose.rotation.matrix().iter().chain(pose.translation.iter()).all(|v| v.is_finite());
    if is_finite { Ok((width, height)) } else { Err(SynthError::Pose) }
}

/// Returns the exposure gain of a camera at the scene's viewpoint: a mean of middle gray, with at most 2 % of the image
/// clipped. Emitters are ignored.
pub(crate) fn auto_exposure(scene: &Scene) -> f32 {
    let camera = Camera::from_focal(40, 30, 33.0);
    let view = View::new(scene, &camera, &scene.viewpoint());
    let level = |i: i32| {
        let ray = view.ray(Point2::new(f64::from(i % 40), f64::from(i / 40)))?;
        let is_emitter = |hit: Hit| matches!(scene.world.prims[hit.prim].texture, Texture::Emissive(_));
        let [r, g, b] =
            if scene.world.hit(&ray).is_some_and(is_emitter) { return None } else { view.color(&ray, 1.0, None) };
        Some(0.2126 * r + 0.7152 * g + 0.0722 * b)
    };
    let mut levels: Vec<f32> = (0..40 * 30).into_par_iter().map(level).collect().into_iter().flatten().collect();
    levels.sort_by(f32::total_cmp);
    let mean = levels.iter().sum::<f32>() / levels.len().max(1) as f32;
    let bright = levels.get(levels.len() * 49 / 50).copied().unwrap_or(0.0);
    // 0.25 linear is 54 % of the sRGB range.
    let gain = (0.25 / mean).min(0.95 / bright);
    if gain.is_finite() { gain } else { 1.0 }
}

/// A camera in a scene.
struct View<'a> {
    scene: &'a Scene,
    camera: Camera,
    center: Point3<f64>,
    to_world: Pose,
}

impl<'a> View<'a> {
    fn new(scene: &'a Scene, camera: &Camera, pose: &Pose) -> Self {
        Self { scene, camera: *camera, center: pose.center(), to_world: pose.inverse() }
    }

    /// Returns the ray of normalized coordinates; its `t` is the depth.
    #[inline]
    fn ray_through(&self, n: Point2<f64>) -> Ray {
        Ray { origin: self.center, dir: self.to_world.rotation * Vector3::new(n.x, n.y, 1.0) }
    }

    /// Returns the ray of a pixel; `None` outside the range of the distortion model.
    fn ray(&self, pixel: Point2<f64>) -> Option<Ray> {
        let n = self.camera.normalize(pixel);
        n.x.is_finite().then(|| self.ray_through(n))
    }

    /// Returns the mean radiance over a pixel's area, by an `n` × `n` grid of samples.
    fn pixel(&self, center: Point2<f64>, n: usize, only: Option<usize>) -> Rgb {
        let center_ray = self.camera.normalize(center);
        if !center_ray.x.is_finite() {
            return [0.0; 3];
        }
        // Within a pixel the distortion is linear: its second derivative moves a ray by less than 1e-5 px.
        let (_, jacobian) = self.camera.distortion.distort_with_jacobian(center_ray);
        let inverse = jacobian.try_inverse().unwrap_or_else(Matrix2::identity);
        let mut sum = [0.0; 3];
        for j in 0..n {
            for i in 0..n {
                let offset = |k: usize| (k as f64 + 0.5) / n as f64 - 0.5;
                let d = inverse * nalgebra::Vector2::new(offset(i) / self.camera.fx, offset(j) / self.camera.fy);
                let color = self.color(&self.ray_through(center_ray + d), 1.0 / n as f64, only);
                (0..3).for_each(|c| sum[c] += color[c]);
            }
        }
        sum.map(|c| c / (n * n) as f32)
    }

    /// Returns the radiance along a ray; `sample_width` is the side of the sample in pixels, `only` the surface that is
    /// hit, if it is known.
    fn color(&self, ray: &Ray, sample_width: f64, only: Option<usize>) -> Rgb {
        let known = only.and_then(|prim| {
            let t = self.scene.world.prims[prim].shape.intersect(ray, 1e-9, f64::INFINITY)?;
            Some(Hit { prim, t })
        });
        let Some(hit) = known.or_else(|| self.scene.world.hit(ray)) else {
            return self.scene.world.ambient.map(|c| c * self.scene.lighting.gain);
        };
        let prim = &self.scene.world.prims[hit.prim];
        let surface = prim.shape.surface(ray, hit.t);
        let length = ray.dir.norm();
        let facing = -surface.normal.dot(&ray.dir) / length;
        // Sample width on the surface: the geometric mean of its sides, one of which is stretched by the slant.
        let slant = facing.abs().max(0.04);
        let width = (hit.t * length * sample_width / self.camera.fx / slant.sqrt()) as f32;
        let color = self.scene.world.albedo(hit.prim, &surface, width);
        if matches!(prim.texture, Texture::Emissive(_)) {
            return color;
        }
        let mut irradiance = self.scene.lighting.at(hit.prim, surface.s, surface.t, facing < 0.0);
        let normal = if facing < 0.0 { -surface.normal } else { surface.normal };
        for (center, radius) in &self.scene.occluders {
            let d = center - surface.point;
            let r2 = d.norm_squared();
            if r2 < 40.0 * radius * radius && r2 > 1.0001 * radius * radius {
                // Ambient occlusion by a sphere (Quilez): cos · r² / d².
                let occlusion = (normal.dot(&d) / r2.sqrt()).max(0.0) * radius * radius / r2;
                irradiance = irradiance.map(|c| c * (1.0 - occlusion.min(0.9)) as f32);
            }
        }
        let mut out: Rgb = std::array::from_fn(|c| color[c] * irradiance[c]);
        if prim.specular > 0.0 {
            let eye = -ray.dir / length;
            let fresnel = prim.specular + (1.0 - prim.specular) * 0.25 * (1.0 - facing.abs() as f32).powi(5);
            for source in &self.scene.world.lights {
                let toward = source.corner + (source.eu + source.ev) * 0.5 - surface.point;
                let half = (toward.normalize() + eye).normalize();
                let lobe = (normal.dot(&half).max(0.0) as f32).powf(prim.gloss);
                let strength = fresnel * lobe * (prim.gloss + 2.0) / (8.0 * self.scene.world.lights.len() as f32);
                (0..3).for_each(|c| out[c] += strength * irradiance[c] * 0.5);
            }
        }
        out.map(|c| c * self.scene.lighting.gain)
    }
}
