//! A straight street between two rows of houses.

use super::furniture::{at, framed, v, wall_texture};
use crate::rng::Rng;
use crate::scene::{Scene, SceneBuilder};
use crate::texture::{Texture, srgb};
use cv_core::Pose;
use nalgebra::Vector3;

/// Half the width of the street between the fronts, in meters.
const HALF_WIDTH: f64 = 5.0;
/// Width of a house, in meters.
const HOUSE_WIDTH: f64 = 6.0;

impl Scene {
    /// A street along z with `houses` houses of 6 m on either side, the fronts 10 m apart, under a white sky without
    /// depth. Every house of a side is identical to the one `every` houses before it, including its texture; `every` =
    /// 0: all differ.
    pub fn street(seed: u64, houses: usize, every: usize) -> Scene {
        let mut rng = Rng::new(seed, 9);
        let mut b = SceneBuilder::new();
        b.ambient([0.5, 0.54, 0.6]);
        let length = HOUSE_WIDTH * houses.max(1) as f64;
        let stone =
            |dark, light, rng: &mut Rng| Texture::Stone { colors: [srgb(dark), srgb(light)], seed: rng.seed32() };
        let asphalt = stone(0x45464A, 0x7A7B7F, &mut rng);
        b.object("road").rect(
            at(-HALF_WIDTH, 0.0, length),
            v(2.0 * HALF_WIDTH, 0.0, 0.0),
            v(0.0, 0.0, -length),
            asphalt,
        );
        let curb = stone(0x9B9890, 0xC9C6BE, &mut rng);
        for x in [-HALF_WIDTH + 0.75, HALF_WIDTH - 0.75] {
            b.object("pavement").block(at(x, 0.0, length / 2.0), [1.5, 0.12, length], 0.0, [&curb, &curb, &curb]);
        }
        // Rays without a hit see the sky: the ambient light.
        b.light(at(6.0, -30.0, length / 2.0 - 4.0), v(-8.0, 0.0, 0.0), v(0.0, 0.0, 8.0), [20.0, 19.0, 17.5]);
        for side in 0..2u64 {
            for i in 0..houses {
                let kind = if every == 0 { i } else { i % every };
                let mut rng = Rng::new(seed ^ (side << 32), 1000 + kind as u64);
                let from = HOUSE_WIDTH * i as f64;
                // The front's lower left corner from the street, and the sign of z to the right.
                let (x, z, right) =
                    if side == 0 { (-HALF_WIDTH, from, 1.0) } else { (HALF_WIDTH, from + HOUSE_WIDTH, -1.0) };
                house(&mut b, [x, z, right], kind, &mut rng);
            }
        }
        let pose = Pose::look_at(at(0.0, -1.6, 1.0), at(0.0, -2.2, length), Vector3::y());
        b.build(pose.unwrap_or_else(Pose::identity))
    }

    /// Returns `count` evenly spaced poses of a walk along [`Scene::street`] of that many houses: in the middle at eye
    /// height, with some sway, looking ahead and to the right. Views 2.5 m apart overlap by half, at 4 m by a third.
    pub fn street_walk(houses: usize, count: usize) -> Vec<Pose> {
        let length = HOUSE_WIDTH * houses.max(1) as f64 - 10.0;
        let step = |i: usize| {
            let s = i as f64 / count.saturating_sub(1).max(1) as f64;
            let z = 1.0 + length.max(0.0) * s;
            let eye = at(-1.5 + 0.3 * (0.9 * z).sin(), -1.6 + 0.05 * (2.1 * z).cos(), z);
            Pose::look_at(eye, eye + v(0.8 + 0.1 * (0.7 * z).sin(), -0.12, 1.0), Vector3::y())
        };
        (0..count).map(|i| step(i).unwrap_or_else(Pose::identity)).collect()
    }

    /// Returns `count` poses of a walk around the middle of [`Scene::room`]: on an ellipse of 1.8 × 3.2 m, looking at
    /// the opposite side of the room, so that the last overlaps the first. Of twelve, neighbors overlap by four tenths
    /// and more.
    pub fn room_walk(count: usize) -> Vec<Pose> {
        let middle = at(0.0, -1.25, 4.3);
        let step = |i: usize| {
            let (sin, cos) = (std::f64::consts::TAU * i as f64 / count.max(1) as f64).sin_cos();
            let eye = middle + v(0.9 * sin, -0.25 + 0.1 * (3.0 * sin).cos(), -1.6 * cos);
            Pose::look_at(eye, middle, Vector3::y())
        };
        (0..count).map(|i| step(i).unwrap_or_else(Pose::identity)).collect()
    }
}

/// Adds a front with windows and a door; `x`, `z` of its lower left corner from the street, and the sign of z to the
/// right.
fn house(b: &mut SceneBuilder, [x, z, right]: [f64; 3], kind: usize, rng: &mut Rng) {
    let height = rng.range(6.0, 8.5);
    let wall = wall_texture(kind, rng);
    b.object("house").rect(at(x, -height, z), v(0.0, 0.0, right * HOUSE_WIDTH), v(0.0, height, 0.0), wall);
    let out = if x < 0.0 { 1.0 } else { -1.0 };
    let along = |s: f64| z + right * s;
    let frame = Texture::Paint { color: srgb(rng.pick([0xE6E2D8, 0x5A4636, 0x2F4F4F, 0x7A2E2A])), seed: rng.seed32() };
    // A ledge, a door with its frame, and windows: panes with textures behind, sills and lintels in relief.
    let ledge = rng.range(2.9, 3.2);
    b.object("ledge").block(
        at(x + out * 0.06, -ledge, along(HOUSE_WIDTH / 2.0)),
        [0.12, 0.15, HOUSE_WIDTH],
        0.0,
        [&frame; 3],
    );
    let door = rng.pick([0.7, 2.4, 4.1]);
    let leaf = Texture::Wood { colors: [srgb(0x5B3A21), srgb(0x9A6B3F)], seed: rng.seed32() };
    b.object("door").block(at(x + out * 0.04, 0.0, along(door + 0.6)), [0.08, 2.2, 1.2], 0.0, [&leaf; 3]);
    for (y, floor) in [(-1.0, 0), (-3.9, 1)] {
        for column in 0..3 {
            let s = 0.6 + 1.75 * f64::from(column) + rng.range(-0.08, 0.08);
            let (w, h) = (rng.range(1.0, 1.2), rng.range(1.2, 1.5));
            if floor == 0 && (s - door).abs() < 1.3 {
                continue;
            }
            b.object("window");
            framed(b, at(x + out * 0.01, y - h, along(s)), v(0.0, 0.0, right * w), v(0.0, h, 0.0), rng);
            b.object("sill").block(
                at(x + out * 0.1, y + 0.08, along(s + w / 2.0)),
                [0.2, 0.08, w + 0.2],
                0.0,
                [&frame; 3],
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::shape::Ray;
    use crate::texture::Rgb;
    use cv_core::{Camera, Point2};

    /// Returns the color and the distance of the surface beside a position on the road.
    fn surface_color(scene: &Scene, side: f64, y: f64, z: f64) -> (Rgb, f64) {
        let ray = Ray { origin: at(0.0, y, z), dir: v(side, 0.0, 0.0) };
        let hit = scene.world.hit(&ray).unwrap();
        let prim = &scene.world.prims[hit.prim];
        (scene.world.albedo(hit.prim, &prim.shape.surface(&ray, hit.t), 0.005), hit.t)
    }

    #[test]
    fn every_second_house_is_identical_and_no_others() {
        let (repeated, other) = (Scene::street(3, 4, 2), Scene::street(3, 4, 0));
        let (mut same, mut all) = (0, 0);
        for side in [-1.0, 1.0] {
            for k in 0..300 {
                let (y, z) = (-0.2 - 5.7 * f64::from(k % 20) / 20.0, 0.07 + 5.85 * f64::from(k / 20) / 15.0);
                let (a, b) =
                    (surface_color(&repeated, side, y, z), surface_color(&repeated, side, y, z + 2.0 * HOUSE_WIDTH));
                // In single precision, positions 12 m apart differ by 1e-6 m, and the texture is sampled at 5 mm.
                assert!(
                    (a.1 - b.1).abs() < 1e-9 && (0..3).all(|c| (a.0[c] - b.0[c]).abs() < 5e-3),
                    "{y} {z} {a:?} {b:?}"
                );
                let (a, b) = (surface_color(&other, side, y, z), surface_color(&other, side, y, z + 2.0 * HOUSE_WIDTH));
                same += usize::from((0..3).all(|c| (a.0[c] - b.0[c]).abs() < 5e-3));
                all += 1;
            }
        }
        assert!(same * 10 < all, "{same} of {all}");
    }

    /// Returns the fraction of a grid of pixels with a surface that another view shows too.
    fn overlap(scene: &Scene, camera: &Camera, a: &Pose, b: &Pose) -> f64 {
        let grid = |n: usize, k: usize| (k as f64 + 0.5) * n as f64 / 12.0;
        let (mut both, mut all) = (0.0, 0.0);
        for k in 0..144 {
            let pixel = Point2::new(grid(camera.width, k % 12), grid(camera.height, k / 12));
            let Some(point) = scene.point_at(camera, a, pixel) else { continue };
            all += 1.0;
            both += f64::from(u8::from(scene.pixel_of(camera, b, &point).is_some()));
        }
        both / all
    }

    #[test]
    fn views_of_a_walk_overlap_and_none_is_inside_an_object() {
        // A field of view of 67°.
        let camera = Camera::from_focal(640, 480, 480.0);
        let street = Scene::street(1, 5, 0);
        let room = Scene::room(1);
        for (scene, walk, closed) in [
            (&street, Scene::street_walk(5, 9), false),
            (&street, Scene::street_walk(5, 40), false),
            (&room, Scene::room_walk(12), true),
            (&room, Scene::room_walk(50), true),
        ] {
            let next = walk.iter().skip(1).chain(closed.then_some(&walk[0]));
            for (a, b) in walk.iter().zip(next) {
                // The documented overlaps, measured on a grid of 144.
                let fraction = overlap(scene, &camera, a, b);
                assert!(fraction > 0.4, "{fraction} of {} photographs", walk.len());
            }
            for pose in &walk {
                let eye = pose.center();
                let nearby = (0..200).filter_map(|k| {
                    let (t, u) = (f64::from(k) * 2.399, f64::from(k) / 100.0 - 1.0);
                    let r = (1.0 - u * u).sqrt();
                    scene.cast(&eye, &v(r * t.cos(), u, r * t.sin()))
                });
                assert!(nearby.map(|(distance, _)| distance).fold(f64::INFINITY, f64::min) > 0.25, "{eye}");
            }
        }
    }
}
