//! The surfaces and lights of a scene, for ray casting.

use crate::bvh::{Bvh, Item};
use crate::shape::{Ray, Shape, Surface};
use crate::texture::{Rgb, SurfacePoint, Texture};
use nalgebra::{Point3, Rotation3, Vector3};

/// A surface of an object.
#[derive(Debug, Clone)]
pub(crate) struct Prim {
    pub(crate) shape: Shape,
    pub(crate) texture: Texture,
    pub(crate) object: u32,
    /// Specular reflectance, 0 to about 0.3, and the exponent of its lobe.
    pub(crate) specular: f32,
    pub(crate) gloss: f32,
    pub(crate) two_sided: bool,
}

/// A box of six rectangles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    pub(crate) first: usize,
    pub(crate) center: Point3<f64>,
    pub(crate) turn: Rotation3<f64>,
    pub(crate) size: [f64; 3],
}

/// A rectangular light that emits from its front.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Light {
    pub(crate) corner: Point3<f64>,
    pub(crate) eu: Vector3<f64>,
    pub(crate) ev: Vector3<f64>,
    pub(crate) radiance: Rgb,
}

/// A ray hit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    pub(crate) prim: usize,
    pub(crate) t: f64,
}

/// Surfaces, lights, and the bounding volume hierarchy.
#[derive(Debug)]
pub(crate) struct World {
    pub(crate) prims: Vec<Prim>,
    pub(crate) blocks: Vec<Block>,
    pub(crate) lights: Vec<Light>,
    pub(crate) ambient: Rgb,
    bvh: Bvh,
}

impl World {
    pub(crate) fn new(prims: Vec<Prim>, blocks: Vec<Block>, lights: Vec<Light>, ambient: Rgb) -> Self {
        let bvh = build_bvh(&prims, &blocks);
        Self { prims, blocks, lights, ambient, bvh }
    }

    /// Returns the world with further surfaces, whose objects have identifiers of their own.
    pub(crate) fn with(&self, prims: impl IntoIterator<Item = Prim>, blocks: impl IntoIterator<Item = Block>) -> Self {
        let first = self.prims.len();
        let blocks = blocks.into_iter().map(|b| Block { first: b.first + first, ..b });
        Self::new(
            self.prims.iter().cloned().chain(prims).collect(),
            self.blocks.iter().copied().chain(blocks).collect(),
            self.lights.clone(),
            self.ambient,
        )
    }

    /// Returns the first hit of a ray.
    pub(crate) fn hit(&self, ray: &Ray) -> Option<Hit> {
        let mut best = None;
        self.bvh.traverse(ray, f64::INFINITY, |item, far| match item.intersect(ray, 1e-9, far) {
            Some((t, prim)) => {
                best = Some(Hit { prim: prim as usize, t });
                t
            }
            None => far,
        });
        best
    }

    /// Returns whether a ray hits a surface in `(near, far)`.
    pub(crate) fn is_occluded(&self, ray: &Ray, near: f64, far: f64) -> bool {
        let mut is_hit = false;
        self.bvh.traverse(ray, far, |item, far| {
            if !is_hit && item.intersect(ray, near, far).is_some() {
                is_hit = true;
            }
            if is_hit { f64::NEG_INFINITY } else { far }
        });
        is_hit
    }

    /// Returns the reflectance (or radiance) of a surface for a sample of `width` meters.
    #[inline]
    pub(crate) fn albedo(&self, prim: usize, surface: &Surface, width: f32) -> Rgb {
        let Prim { shape, texture, .. } = &self.prims[prim];
        let (u, v) = shape.extent();
        texture.color(&SurfacePoint {
            u: surface.s * u as f32,
            v: surface.t * v as f32,
            local: (surface.point - shape.center()).cast::<f32>().into(),
            size: (u as f32, v as f32),
            width,
        })
    }
}

/// Builds the hierarchy over all surfaces, with boxes as single items.
fn build_bvh(prims: &[Prim], blocks: &[Block]) -> Bvh {
    let mut items = Vec::new();
    let mut next = 0;
    for block in blocks {
        items.extend((next..block.first).map(|i| Item::Surface(i as u32, prims[i].shape)));
        let axes = [0, 1, 2].map(|a| block.turn * Vector3::ith(a, 1.0));
        items.push(Item::Block {
            first: block.first as u32,
            center: block.center,
            axes,
            half: block.size.map(|s| s / 2.0),
        });
        next = block.first + 6;
    }
    items.extend((next..prims.len()).map(|i| Item::Surface(i as u32, prims[i].shape)));
    Bvh::new(items)
}
