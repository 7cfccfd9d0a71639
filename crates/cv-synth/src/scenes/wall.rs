//! A wall with posters in one exact plane.

use super::furniture::{at, v, wall_texture};
use crate::poster::Poster;
use crate::rng::Rng;
use crate::scene::{Scene, SceneBuilder};
use crate::texture::{Collage, Texture};
use cv_core::Pose;
use nalgebra::{Point3, Vector3};
use std::sync::Arc;

/// The plane of [`Scene::poster_wall`].
pub(crate) struct Wall;

impl Wall {
    /// Half the width and half the height in meters.
    pub(crate) const HALF: (f64, f64) = (6.0, 4.0);
    /// Distance of the plane from the world's origin along z.
    pub(crate) const Z: f64 = 3.0;

    /// Returns the center of the wall.
    pub(crate) fn center() -> Point3<f64> {
        at(0.0, 0.0, Self::Z)
    }
}

impl Scene {
    /// A wall at z = 3 m, 12 × 8 m about the optical axis of the world frame, with posters exactly in its plane: every
    /// pair of views is related by an exact homography.
    pub fn poster_wall(seed: u64) -> Scene {
        let mut rng = Rng::new(seed, 2);
        let (w, h) = Wall::HALF;
        let kind = rng.index(4);
        let ground = wall_texture(kind, &mut rng);
        let mut posters = Vec::new();
        let mut left = -w + 0.1;
        while left < w {
            let width = rng.range(0.45, 1.0);
            let mut top = -h + rng.range(0.0, 0.4);
            while top < h {
                let height = width * rng.pick([1.41, 1.25, 0.75]);
                let corner = ((left + w) as f32, (top + h) as f32);
                posters.push((corner, Poster::new(width as f32, height as f32, rng.next())));
                top += height + rng.range(0.05, 0.35);
            }
            left += width + rng.range(0.04, 0.25);
        }
        let wall = Texture::Collage(Arc::new(Collage::new(ground, posters)));
        let mut b = SceneBuilder::new();
        b.object("wall").shiny(0.015, 12.0);
        b.rect(at(-w, -h, Wall::Z), v(2.0 * w, 0.0, 0.0), v(0.0, 2.0 * h, 0.0), wall);
        b.ambient([0.55, 0.58, 0.62]);
        let x = rng.range(-2.0, 2.0);
        b.light(at(x + 0.8, -2.6, -0.4), v(-1.6, 0.0, 0.0), v(0.0, 1.2, -0.6), [11.0, 10.3, 9.4]);
        let pose = Pose::look_at(at(0.0, 0.0, 0.0), Wall::center(), Vector3::y());
        b.build(pose.unwrap_or_else(Pose::identity))
    }
}
