//! The surfaces and lights of a scene: what rays meet.

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
    /// Share of the light mirrored, 0 to about 0.3, and the exponent of its lobe.
    pub(crate) specular: f32,
    pub(crate) gloss: f32,
    pub(crate) two_sided: bool,
}

/// Six rectangles that are the faces of a box.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Block {
    pub(crate) first: usize,
    pub(crate) center: Point3<f64>,
    pub(crate) turn: Rotation3<f64>,
    pub(crate) size: [f64; 3],
}

/// A rectangle that shines from its front.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Light {
    pub(crate) corner: Point3<f64>,
    pub(crate) eu: Vector3<f64>,
    pub(crate) ev: Vector3<f64>,
    pub(crate) radiance: Rgb,
}

/// Where a ray meets the scene.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Hit {
    pub(crate) prim: usize,
    pub(crate) t: f64,
}

/// Surfaces, lights, and the tree over the surfaces.
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
        let bvh = tree(&prims, &blocks);
        Self { prims, blocks, lights, ambient, bvh }
    }

    /// With more surfaces, whose objects have numbers of their own.
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

    pub(crate) fn hit(&self, ray: &Ray) -> Option<Hit> {
        let mut best = None;
        self.bvh.walk(ray, f64::INFINITY, |item, far| match item.intersect(ray, 1e-9, far) {
            Some((t, prim)) => {
                best = Some(Hit { prim: prim as usize, t });
                t
            }
            None => far,
        });
        best
    }

    pub(crate) fn blocked(&self, ray: &Ray, near: f64, far: f64) -> bool {
        let mut found = false;
        self.bvh.walk(ray, far, |item, far| {
            if !found && item.intersect(ray, near, far).is_some() {
                found = true;
            }
            if found { f64::NEG_INFINITY } else { far }
        });
        found
    }

    /// Reflectance (or radiance) of a surface seen with a sample of `width` meters.
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

/// The tree over all surfaces, boxes as wholes.
fn tree(prims: &[Prim], blocks: &[Block]) -> Bvh {
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
