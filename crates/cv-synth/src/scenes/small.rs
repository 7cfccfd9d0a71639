//! Small scenes: a table top, and a ball on the floor.

use super::furniture::*;
use crate::rng::Rng;
use crate::scene::{Scene, SceneBuilder};
use crate::texture::{Texture, srgb};
use cv_core::Pose;
use nalgebra::{Rotation3, Vector3};
use std::f64::consts::TAU;

impl Scene {
    /// Objects on a table at 0.6 to 2 m, in front of a wall.
    pub fn tabletop(seed: u64) -> Scene {
        let mut rng = Rng::new(seed, 3);
        let rng = &mut rng;
        let mut b = SceneBuilder::new();
        b.ambient([0.34, 0.35, 0.37]);
        let light = rng.pick([[0x6B4526, 0xA87B4C], [0x9C7447, 0xD0AC7C], [0x8A5E36, 0xBE9160]]);
        let top = Texture::Wood { colors: light.map(srgb), seed: rng.seed32() };
        b.object("table").shiny(0.06, 80.0);
        b.block(at(0.0, 0.04, 0.1), [2.6, 0.04, 1.5], 0.0, [&top, &top, &top]);
        let kind = rng.index(3);
        let wall = wall_texture(kind, rng);
        b.object("wall").rect(at(-3.0, -2.2, 1.5), v(6.0, 0.0, 0.0), v(0.0, 3.2, 0.0), wall);
        for x in [-1.0, 0.15] {
            let (w, h) = (rng.range(0.45, 0.7), rng.range(0.5, 0.7));
            framed(&mut b, at(x + rng.range(0.0, 0.3), -0.95, 1.499), v(w, 0.0, 0.0), v(0.0, h, 0.0), rng);
        }
        b.light(at(1.6, -2.1, -1.2), v(-1.2, 0.0, 0.0), v(0.0, 0.5, 1.0), [9.5, 9.0, 8.2]);
        b.light(at(-2.6, -1.6, -0.8), v(0.0, 0.0, 1.4), v(0.0, 1.2, 0.0), [3.2, 3.5, 4.0]);
        // A row of books, a stack of books, packages, pots; then small objects in front.
        let mut x = -0.95;
        b.object("books");
        while x < -0.45 {
            let size = [rng.range(0.018, 0.05), rng.range(0.19, 0.27), rng.range(0.13, 0.18)];
            book(&mut b, at(x + size[0] / 2.0, 0.0, 0.52 + rng.range(-0.01, 0.01)), size, 0.0, rng);
            x += size[0] + 0.001;
        }
        let (mut y, sx) = (0.0, rng.range(0.25, 0.45));
        for _ in 0..4 {
            let thick = rng.range(0.02, 0.045);
            let cover = poster(0.24, 0.17, rng);
            let spine = Texture::Fabric { colors: [cloth(rng); 2], seed: rng.seed32() };
            b.block(at(sx, y, 0.18), [0.24, thick, 0.17], rng.range(-0.35, 0.35), [&spine, &spine, &cover]);
            y -= thick;
        }
        mug(&mut b, at(sx + rng.range(-0.04, 0.04), y, 0.18), rng);
        for (x, z) in [(-0.22, 0.45), (0.06, 0.58), (0.66, 0.5)] {
            let size = [rng.range(0.13, 0.2), rng.range(0.2, 0.32), rng.range(0.05, 0.1)];
            package(&mut b, at(x + rng.range(-0.04, 0.04), 0.0, z), size, rng.range(-0.7, 0.7), rng);
        }
        plant(&mut b, at(0.92, 0.0, 0.32), 0.45, rng);
        // A cup of pencils: thin objects in the foreground.
        let cup = at(rng.range(-0.3, -0.15), 0.0, 0.02);
        mug(&mut b, cup, rng);
        b.object("pencils").shiny(0.05, 60.0);
        for _ in 0..6 {
            let lean = v(rng.range(-0.05, 0.05), -0.19, rng.range(-0.05, 0.05));
            let foot = cup + v(-0.3 * lean.x, -0.01, -0.3 * lean.z);
            b.tube(foot, foot + lean, (0.0036, 0.0036), Texture::Plain(cloth(rng)));
        }
        b.object("fruit").shiny(0.05, 40.0);
        for i in 0..4 {
            let r = rng.range(0.03, 0.042);
            let color = srgb(rng.pick([0xD9822B, 0xA4342A, 0x8FA63A, 0xD8B13A]));
            // Far enough apart that they do not touch.
            let (x, z) = (-0.1 + 0.2 * (f64::from(i) + rng.range(0.0, 0.55)), rng.range(-0.15, -0.02));
            b.sphere(at(x, -r, z), r, Texture::Ball { color, seed: rng.seed32() });
        }
        b.object("leaflet");
        for (x, z) in [(-0.62, 0.1), (0.05, 0.2)] {
            let yaw = rng.range(-0.5, 0.5);
            let edge = Texture::Plain([0.8; 3]);
            let page = poster(0.21, 0.297, rng);
            b.block(at(x, 0.0, z), [0.21, 0.003, 0.297], yaw, [&edge, &edge, &page]);
        }
        mug(&mut b, at(-0.5, 0.0, rng.range(-0.15, -0.05)), rng);
        let eye = at(rng.range(-0.2, 0.2), -0.55, -0.85);
        let pose = Pose::look_at(eye, at(0.02, -0.1, 0.3), Vector3::y());
        b.build(pose.unwrap_or_else(Pose::identity))
    }

    /// An orange ball of 10 cm radius (object `"ball"`) on the floor of a corner, with objects of similar colors: wood,
    /// cardboard, brick and a reddish cloth. The ball's distance and position depend on the seed.
    pub fn ball(seed: u64) -> Scene {
        let distance = Rng::new(seed, 40).range(0.8, 2.6);
        Self::ball_at(seed, seed, distance)
    }

    /// Returns the corner of seed `room` with the ball at `distance` meters from the camera, in its view.
    pub(crate) fn ball_at(room: u64, seed: u64, distance: f64) -> Scene {
        let mut rng = Rng::new(room, 4);
        let rng = &mut rng;
        let mut b = SceneBuilder::new();
        b.ambient([0.34, 0.35, 0.37]);
        b.object("floor").shiny(0.04, 40.0);
        b.rect(at(-3.0, 0.0, 4.0), v(6.0, 0.0, 0.0), v(0.0, 0.0, -5.0), planks(rng));
        let kind = 1 + rng.index(2);
        let wall = wall_texture(kind, rng);
        b.object("far wall").rect(at(-3.0, -2.6, 4.0), v(6.0, 0.0, 0.0), v(0.0, 2.6, 0.0), wall);
        let wall = wall_texture(0, rng);
        b.object("left wall").rect(at(-2.0, -2.6, -1.0), v(0.0, 0.0, 5.0), v(0.0, 2.6, 0.0), wall);
        let kind = 1 + rng.index(2);
        let wall = wall_texture(kind, rng);
        b.object("right wall").rect(at(2.4, -2.6, 4.0), v(0.0, 0.0, -5.0), v(0.0, 2.6, 0.0), wall);
        b.light(at(0.6, -2.6, 0.8), v(-1.0, 0.0, 0.0), v(0.0, 0.0, -1.0), [12.0, 11.0, 9.4]);
        b.light(at(2.39, -2.2, 1.6), v(0.0, 0.0, -1.6), v(0.0, 1.4, 0.0), [5.0, 5.4, 6.0]);
        bookcase(&mut b, at(1.3, 0.0, 3.8), [1.5, 1.75, 0.3], 0.0, rng);
        framed(&mut b, at(-1.4, -1.9, 3.999), v(0.8, 0.0, 0.0), v(0.0, 1.0, 0.0), rng);
        chair(&mut b, at(-0.9, 0.0, 3.1), rng.range(2.4, 3.6), rng);
        for (x, z) in [(-1.5, 2.4), (0.2, 3.5), (-1.6, 3.4)] {
            let size = [rng.range(0.3, 0.5), rng.range(0.25, 0.6), rng.range(0.25, 0.45)];
            package(&mut b, at(x, 0.0, z), size, rng.range(-0.6, 0.6), rng);
        }
        plant(&mut b, at(1.95, 0.0, 2.9), 1.0, rng);
        let turn = Rotation3::from_euler_angles(-0.25, rng.range(0.0, TAU), 0.05);
        let red = Texture::Fabric { colors: [srgb(0x9E3B2E), srgb(0x7E2E26)], seed: rng.seed32() };
        b.object("cushion").tilted_block(at(-0.35, -0.2, 3.3), [0.42, 0.4, 0.11], turn, [&red, &red, &red]);

        let mut rng = Rng::new(seed, 41);
        let eye = at(rng.range(-0.3, 0.3), -rng.range(0.75, 1.1), -0.6);
        let radius = 0.10;
        // On the floor at that distance, if possible; else in the air.
        let level = (distance * distance - (eye.y + radius).powi(2)).max(0.0).sqrt();
        let aim = rng.range(-0.22, 0.22);
        let place = if level > 0.3 {
            at(eye.x + level * aim, -radius, eye.z + level)
        } else {
            at(eye.x + distance * aim, eye.y + 0.2 * distance, eye.z + distance)
        };
        b.object("ball").shiny(0.05, 60.0);
        b.sphere(place, radius, Texture::Ball { color: srgb(0xF0761A), seed: 77 });
        let target = place + v(rng.range(-0.35, 0.35), -rng.range(0.0, 0.35), 0.0) * distance.min(1.2);
        let pose = Pose::look_at(eye, target, Vector3::y());
        b.build(pose.unwrap_or_else(Pose::identity))
    }
}
