//! Scenes: surfaces, lights, and the irradiance of the surfaces.

use crate::irradiance::Lighting;
use crate::render::auto_exposure;
use crate::shape::{Ray, Shape};
use crate::texture::{Rgb, Texture};
use crate::world::{Block, Light, Prim, World};
use cv_core::Pose;
use nalgebra::{Point3, Rotation3, Vector3};
use std::sync::Arc;

/// Textured surfaces under lights, in meters; X right, Y **down**, Z forward. The floor of the presets is at y = 0.
///
/// Irradiance is computed on demand and cached: diffuse direct light with soft shadows, and one bounce. It depends on
/// the scene only, so that all views agree.
#[derive(Debug, Clone)]
pub struct Scene {
    pub(crate) world: Arc<World>,
    names: Vec<&'static str>,
    /// Spheres for ambient occlusion by objects that were added after the irradiance was computed.
    pub(crate) occluders: Vec<(Point3<f64>, f64)>,
    viewpoint: Pose,
    pub(crate) lighting: Lighting,
}

impl Scene {
    /// Returns a pose with a good view of the scene.
    pub fn viewpoint(&self) -> Pose {
        self.viewpoint
    }

    /// Returns the identifier of an object in [`crate::Rendered::ids`]; `None` if there is no object of that name.
    pub fn object_id(&self, name: &str) -> Option<u32> {
        self.names.iter().position(|&n| n == name).map(|i| i as u32 + 1)
    }

    /// Returns the names of all objects; the object at index `i` has the identifier `i + 1`.
    pub fn object_names(&self) -> &[&'static str] {
        &self.names
    }

    /// Casts a ray. Returns the distance in units of `direction` to the first surface, and the identifier of its
    /// object.
    pub fn cast(&self, origin: &Point3<f64>, direction: &Vector3<f64>) -> Option<(f64, u32)> {
        let hit = self.world.hit(&Ray { origin: *origin, dir: *direction })?;
        Some((hit.t, self.world.prims[hit.prim].object))
    }

    /// Returns whether the line of sight between two points is free; surfaces within a relative 1e-6 of the ends are
    /// ignored.
    pub fn has_line_of_sight(&self, from: &Point3<f64>, to: &Point3<f64>) -> bool {
        !self.world.is_occluded(&Ray { origin: *from, dir: to - from }, 1e-6, 1.0 - 1e-6)
    }

    /// Adds objects to the scene. The irradiance of existing surfaces is kept, except for ambient occlusion.
    pub(crate) fn with_objects(&self, more: SceneBuilder, occluders: Vec<(Point3<f64>, f64)>) -> Self {
        let offset = self.names.len() as u32;
        let prims = more.prims.into_iter().map(|p| Prim { object: p.object + offset, ..p });
        let world = Arc::new(self.world.with(prims, more.blocks));
        let names = self.names.iter().copied().chain(more.names).collect();
        let lighting = self.lighting.with(&world);
        Self { world, names, occluders, viewpoint: self.viewpoint, lighting }
    }
}

/// Builds a scene; [`Scene`] has presets.
///
/// ```
/// use cv_synth::{SceneBuilder, Texture, srgb};
/// use nalgebra::{Point3, Vector3};
///
/// let mut builder = SceneBuilder::new();
/// builder.object("wall").rect(
///     Point3::new(-2.0, -2.0, 3.0),
///     Vector3::new(4.0, 0.0, 0.0),
///     Vector3::new(0.0, 4.0, 0.0),
///     Texture::Paint { color: srgb(0xC8B89A), seed: 1 },
/// );
/// let scene = builder.build(cv_core::Pose::identity());
/// let (distance, object) = scene.cast(&Point3::origin(), &Vector3::z()).unwrap();
/// assert!((distance - 3.0).abs() < 1e-12 && Some(object) == scene.object_id("wall"));
/// ```
#[derive(Debug, Clone)]
pub struct SceneBuilder {
    prims: Vec<Prim>,
    blocks: Vec<Block>,
    names: Vec<&'static str>,
    lights: Vec<Light>,
    ambient: Rgb,
    specular: (f32, f32),
    two_sided: bool,
}

impl Default for SceneBuilder {
    fn default() -> Self {
        Self::new()
    }
}

impl SceneBuilder {
    /// Creates an empty scene with a uniform gray ambient light.
    pub fn new() -> Self {
        Self {
            prims: Vec::new(),
            blocks: Vec::new(),
            names: Vec::new(),
            lights: Vec::new(),
            ambient: [0.25; 3],
            specular: (0.0, 1.0),
            two_sided: false,
        }
    }

    /// Starts an object. The surfaces added next belong to it, and are matt and one-sided by default.
    pub fn object(&mut self, name: &'static str) -> &mut Self {
        self.names.push(name);
        self.specular = (0.0, 1.0);
        self.two_sided = false;
        self
    }

    /// Makes the next surfaces of the object glossy: specular reflectance (0 to 0.3) and exponent (10 to 200).
    pub fn shiny(&mut self, reflectance: f32, exponent: f32) -> &mut Self {
        self.specular = (reflectance, exponent);
        self
    }

    /// Makes the next surfaces of the object two-sided.
    pub fn two_sided(&mut self) -> &mut Self {
        self.two_sided = true;
        self
    }

    /// Sets the ambient radiance.
    pub fn ambient(&mut self, radiance: Rgb) -> &mut Self {
        self.ambient = radiance;
        self
    }

    /// Adds a rectangular light `corner + s·u + t·v`, `s, t` from 0 to 1, which emits to the side from which `u` points
    /// right and `v` down. It is invisible itself.
    pub fn light(&mut self, corner: Point3<f64>, u: Vector3<f64>, v: Vector3<f64>, radiance: Rgb) -> &mut Self {
        self.lights.push(Light { corner, eu: u, ev: v, radiance });
        self
    }

    fn push(&mut self, shape: Shape, texture: Texture) -> &mut Self {
        if self.names.is_empty() {
            self.names.push("object");
        }
        self.prims.push(Prim {
            shape,
            texture,
            object: self.names.len() as u32,
            specular: self.specular.0,
            gloss: self.specular.1,
            two_sided: self.two_sided,
        });
        self
    }

    /// Adds a rectangle with orthogonal edges `u` and `v`; from its front, `u` points right and `v` down.
    pub fn rect(&mut self, corner: Point3<f64>, u: Vector3<f64>, v: Vector3<f64>, texture: Texture) -> &mut Self {
        self.push(Shape::rect(corner, u, v, false), texture)
    }

    /// Adds the ellipse inscribed in [`SceneBuilder::rect`].
    pub fn disc(&mut self, corner: Point3<f64>, u: Vector3<f64>, v: Vector3<f64>, texture: Texture) -> &mut Self {
        self.push(Shape::rect(corner, u, v, true), texture)
    }

    /// Adds a sphere.
    pub fn sphere(&mut self, center: Point3<f64>, radius: f64, texture: Texture) -> &mut Self {
        self.push(Shape::Sphere { center, radius }, texture)
    }

    /// Adds the lateral surface of a cylinder or cone from `base` to `top`, open at the ends.
    pub fn tube(&mut self, base: Point3<f64>, top: Point3<f64>, radii: (f64, f64), texture: Texture) -> &mut Self {
        let d = top - base;
        let length = d.norm();
        self.push(Shape::Frustum { base, axis: d / length, length, radii }, texture)
    }

    /// Adds a cylinder or cone with end caps.
    pub fn solid_tube(
        &mut self,
        base: Point3<f64>,
        top: Point3<f64>,
        radii: (f64, f64),
        side: Texture,
        lid: Texture,
    ) -> &mut Self {
        let (a, b) = crate::shape::complete_basis(&(top - base).normalize());
        for (p, r, flip) in [(base, radii.0, 1.0), (top, radii.1, -1.0)] {
            let (u, v) = (a * (2.0 * r), b * (2.0 * r * flip));
            self.disc(p - u / 2.0 - v / 2.0, u, v, lid.clone());
        }
        self.tube(base, top, radii, side)
    }

    /// Adds a box of `size` (x, y, z) on `foot`, the center of its underside, rotated by `yaw` about the vertical.
    ///
    /// Textures: front and back (−z, +z), the two sides (±x), top and underside.
    pub fn block(&mut self, foot: Point3<f64>, size: [f64; 3], yaw: f64, faces: [&Texture; 3]) -> &mut Self {
        let rotation = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw);
        self.tilted_block(foot - Vector3::y() * (0.5 * size[1]), size, rotation, faces)
    }

    /// Adds a box around `center`, rotated by `rotation`; textures as for [`SceneBuilder::block`].
    pub fn tilted_block(
        &mut self,
        center: Point3<f64>,
        size: [f64; 3],
        rotation: Rotation3<f64>,
        faces: [&Texture; 3],
    ) -> &mut Self {
        let [x, y, z] = [0, 1, 2].map(|a| rotation * Vector3::ith(a, size[a]));
        let at = |a: f64, b: f64, c: f64| center + x * (0.5 * a) + y * (0.5 * b) + z * (0.5 * c);
        let [front, side, top] = faces;
        self.blocks.push(Block { first: self.prims.len(), center, turn: rotation, size });
        self.rect(at(-1.0, -1.0, -1.0), x, y, front.clone());
        self.rect(at(1.0, -1.0, 1.0), -x, y, front.clone());
        self.rect(at(1.0, -1.0, -1.0), z, y, side.clone());
        self.rect(at(-1.0, -1.0, 1.0), -z, y, side.clone());
        self.rect(at(-1.0, -1.0, 1.0), x, -z, top.clone());
        self.rect(at(-1.0, 1.0, -1.0), x, z, top.clone())
    }

    /// Builds the scene, with the pose of [`Scene::viewpoint`].
    pub fn build(self, viewpoint: Pose) -> Scene {
        let world = Arc::new(World::new(self.prims, self.blocks, self.lights, self.ambient));
        let lighting = Lighting::new(&world);
        let mut scene = Scene { world, names: self.names, occluders: Vec::new(), viewpoint, lighting };
        scene.lighting.gain = auto_exposure(&scene);
        scene
    }
}
