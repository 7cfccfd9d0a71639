//! A living room, 6 m wide and 9 m long.

use super::furniture::*;
use crate::rng::Rng;
use crate::scene::{Scene, SceneBuilder};
use crate::texture::{Texture, srgb};
use cv_core::Pose;
use nalgebra::{Rotation3, Vector3};
use std::collections::VecDeque;
use std::f64::consts::FRAC_PI_2;
use std::sync::{Mutex, MutexGuard, PoisonError};

/// Width, height, length in meters.
const ROOM_SIZE: [f64; 3] = [6.0, 2.7, 9.0];

/// Number of cached rooms, some megabytes each.
const CACHED_ROOMS: usize = 16;

/// Returns the cache of the most recent rooms, by seed.
fn room_cache() -> MutexGuard<'static, VecDeque<(u64, Scene)>> {
    static ROOMS: Mutex<VecDeque<(u64, Scene)>> = Mutex::new(VecDeque::new());
    // The list is consistent even if a thread panicked with the lock.
    ROOMS.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Scene {
    /// A furnished room of 6 × 9 m from one end: surfaces at 1 to 9 m, slanted planes, thin objects, and many
    /// occlusions. It suits stereo, reconstruction and panoramas.
    ///
    /// The most recent rooms are cached: their irradiance takes longer than an image.
    pub fn room(seed: u64) -> Scene {
        if let Some((_, room)) = room_cache().iter().find(|(of, _)| *of == seed) {
            return room.clone();
        }
        // Without the lock: parallel work of the renderer may request another room on this thread.
        let room = Self::build_room(seed);
        let mut cache = room_cache();
        if cache.len() == CACHED_ROOMS {
            cache.pop_front();
        }
        cache.push_back((seed, room.clone()));
        room
    }

    fn build_room(seed: u64) -> Scene {
        let mut rng = Rng::new(seed, 1);
        let mut b = SceneBuilder::new();
        shell(&mut b, &mut rng);
        furnish(&mut b, &mut rng);
        let eye = at(rng.range(-0.4, 0.4), -1.45, 0.7);
        let pose = Pose::look_at(eye, at(rng.range(-0.3, 0.3), -1.0, 6.0), Vector3::y());
        b.build(pose.unwrap_or_else(Pose::identity))
    }
}

/// Adds floor, ceiling, walls, window and lamps.
fn shell(b: &mut SceneBuilder, rng: &mut Rng) {
    let [width, height, length] = ROOM_SIZE;
    let half = width / 2.0;
    b.ambient([0.30, 0.32, 0.36]);
    let floor = if rng.chance(0.7) {
        planks(rng)
    } else {
        Texture::Tiles { colors: [srgb(0x7C776E), srgb(0xC9C2B4)], tile: 0.45, seed: rng.seed32() }
    };
    b.object("floor").shiny(0.05, 40.0);
    b.rect(at(-half, 0.0, length), v(width, 0.0, 0.0), v(0.0, 0.0, -length), floor);
    b.object("ceiling");
    let boards = [srgb(0xB9A98D), srgb(0xE2D7C0)];
    let ceiling = if rng.chance(0.5) {
        Texture::Planks { colors: boards, plank: 0.14, seed: rng.seed32() }
    } else {
        Texture::Stone { colors: [srgb(0xA9A598), srgb(0xF6F3EC)], seed: rng.seed32() }
    };
    // Boards along the room.
    b.rect(at(half, -height, 0.0), v(0.0, 0.0, length), v(-width, 0.0, 0.0), ceiling);
    let first = rng.index(3);
    let mut wall = |name, corner, u, kind: usize, rng: &mut Rng| {
        let texture = wall_texture(kind % 3, rng);
        b.object(name).rect(corner, u, v(0.0, height, 0.0), texture);
    };
    wall("far wall", at(-half, -height, length), v(width, 0.0, 0.0), first, rng);
    wall("left wall", at(-half, -height, 0.0), v(0.0, 0.0, length), first + 1, rng);
    wall("right wall", at(half, -height, length), v(0.0, 0.0, -length), first + 2, rng);
    wall("near wall", at(half, -height, 0.0), v(-width, 0.0, 0.0), first + 1, rng);
    b.object("skirting");
    let white = Texture::Paint { color: srgb(0xE6E2D8), seed: rng.seed32() };
    let white = [&white, &white, &white];
    b.block(at(0.0, 0.0, length - 0.01), [width, 0.09, 0.02], 0.0, white);
    b.block(at(-half + 0.01, 0.0, length / 2.0), [0.02, 0.09, length], 0.0, white);
    b.block(at(half - 0.01, 0.0, length / 2.0), [0.02, 0.09, length], 0.0, white);

    // The window: a bright pane, a frame with bars and a sill; a light of the pane's size just inside.
    let (z0, z1, sill, top) = (rng.range(2.3, 2.9), rng.range(4.3, 4.9), -0.85, -2.3);
    let x = -half + 0.02;
    b.object("window");
    let (corner, u, w) = (at(x - 0.01, top, z0), v(0.0, 0.0, z1 - z0), v(0.0, sill - top, 0.0));
    b.rect(corner, u, w, Texture::Emissive([0.94, 1.0, 1.08]));
    b.light(corner + v(0.03, 0.0, 0.0), u, w, [5.2, 5.6, 6.2]);
    b.object("window frame");
    for i in 0..=3 {
        let z = z0 + (z1 - z0) * f64::from(i) / 3.0;
        b.block(at(x, sill, z), [0.05, sill - top, 0.06], 0.0, white);
    }
    for y in [sill, (sill + top) / 2.0, top] {
        b.block(at(x, y + 0.03, (z0 + z1) / 2.0), [0.05, 0.06, z1 - z0], 0.0, white);
    }
    b.block(at(x + 0.06, sill + 0.05, (z0 + z1) / 2.0), [0.16, 0.03, z1 - z0 + 0.2], 0.0, white);
    // Two ceiling lamps.
    for z in [2.2, 6.4] {
        b.object("ceiling lamp");
        let side = 0.5;
        let corner = at(-side / 2.0, -height + 0.02, z - side / 2.0);
        b.disc(corner, v(side, 0.0, 0.0), v(0.0, 0.0, side), Texture::Emissive([1.05, 1.0, 0.92]));
        b.light(corner + v(0.0, 0.01, 0.0), v(side, 0.0, 0.0), v(0.0, 0.0, side), [13.0, 11.8, 9.8]);
    }
}

/// Adds the furniture.
fn furnish(b: &mut SceneBuilder, rng: &mut Rng) {
    let [width, _, length] = ROOM_SIZE;
    let half = width / 2.0;
    // Right side: bookcase, chest with objects on it.
    let case_z = rng.range(4.2, 5.2);
    bookcase(b, at(half - 0.18, 0.0, case_z), [1.9, 2.1, 0.32], FRAC_PI_2, rng);
    // Left side: sofa under the window, facing the middle.
    sofa(b, at(-half + 0.62, 0.0, rng.range(3.4, 4.2)), -FRAC_PI_2, rng);
    // Rug and low table in the middle.
    let (x, z) = (rng.range(-0.4, 0.2), rng.range(3.3, 4.0));
    let colors = [cloth(rng), cloth(rng), srgb(0xE3D5B0)];
    b.object("rug").block(
        at(x, 0.0, z),
        [2.2, 0.012, 1.6],
        rng.range(-0.1, 0.1),
        [&Texture::Plain(colors[1]), &Texture::Plain(colors[1]), &Texture::Rug { colors, seed: rng.seed32() }],
    );
    let yaw = rng.range(-0.15, 0.15);
    table(b, at(x, -0.012, z), [1.1, 0.43, 0.6], yaw, rng);
    let top = -0.442;
    b.object("books");
    let mut y = top;
    for _ in 0..3 {
        let thick = rng.range(0.02, 0.04);
        let cover = poster(0.21, 0.28, rng);
        let pages = Texture::Pages { seed: rng.seed32() };
        b.block(at(x - 0.25, y, z), [0.21, thick, 0.28], rng.range(-0.4, 0.4), [&pages, &pages, &cover]);
        y -= thick;
    }
    mug(b, at(x + 0.1, top, z - 0.12), rng);
    b.object("fruit").shiny(0.04, 30.0);
    for (dx, dz) in [(0.32, 0.05), (0.395, 0.02), (0.36, 0.115)] {
        let color = srgb(rng.pick([0xD9822B, 0xA4342A, 0x8FA63A]));
        b.sphere(at(x + dx, top - 0.037, z + dz), 0.037, Texture::Ball { color, seed: rng.seed32() });
    }
    // Far end: table with chairs, pictures, plant, lamp.
    let (x, z) = (rng.range(-0.9, 0.6), rng.range(6.6, 7.1));
    table(b, at(x, 0.0, z), [1.5, 0.74, 0.8], 0.0, rng);
    for (dx, dz, yaw) in [(-0.4, -0.55, 3.1), (0.45, -0.6, 2.9), (-0.3, 0.55, 0.1), (0.4, 0.5, -0.2), (1.05, 0.0, 1.6)]
    {
        chair(b, at(x + dx, 0.0, z + dz), yaw + rng.range(-0.2, 0.2), rng);
    }
    plant(b, at(x + 0.3, -0.74, z), 0.42, rng);
    mug(b, at(x - 0.3, -0.74, z - 0.1), rng);
    let mut left = -half + rng.range(0.3, 0.6);
    while left < half - 1.0 {
        let (w, h) = (rng.range(0.5, 1.1), rng.range(0.6, 1.0));
        if left + w > half - 0.25 {
            break;
        }
        framed(b, at(left, -1.95 + rng.range(-0.2, 0.15), length - 0.001), v(w, 0.0, 0.0), v(0.0, h, 0.0), rng);
        left += w + rng.range(0.25, 0.6);
    }
    for z in [6.2, 7.4] {
        let (w, h) = (rng.range(0.6, 0.9), rng.range(0.7, 1.1));
        framed(b, at(-half + 0.001, -2.0, z), v(0.0, 0.0, w), v(0.0, h, 0.0), rng);
    }
    framed(b, at(half - 0.001, -1.9, 3.2), v(0.0, 0.0, -0.8), v(0.0, 1.0, 0.0), rng);
    framed(b, at(half - 0.001, -1.9, 7.9), v(0.0, 0.0, -0.9), v(0.0, 0.8, 0.0), rng);
    plant(b, at(half - 0.55, 0.0, rng.range(6.5, 7.5)), 1.25, rng);
    plant(b, at(-half + 0.5, 0.0, rng.range(5.4, 5.8)), 1.0, rng);
    floor_lamp(b, at(-half + 0.45, 0.0, 2.35), rng);
    // Slanted planes: boards that lean against the right wall.
    for (z, lean) in [(2.3, 0.28), (2.75, 0.22)] {
        let board = if rng.chance(0.5) { planks(rng) } else { poster(0.4, 1.7, rng) };
        let edge = wood(rng);
        let turn = Rotation3::from_axis_angle(&Vector3::z_axis(), lean)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), FRAC_PI_2);
        let center = at(half - 0.03 - 0.85 * lean.sin(), -0.85 * lean.cos(), z);
        b.object("board").tilted_block(center, [0.4, 1.7, 0.02], turn, [&board, &edge, &edge]);
    }
    // Packages here and there.
    for (x, z) in [(1.5, 2.9), (1.2, 5.9), (-1.7, 6.4)] {
        let size = [rng.range(0.3, 0.5), rng.range(0.25, 0.6), rng.range(0.25, 0.45)];
        package(b, at(x + rng.range(-0.2, 0.2), 0.0, z + rng.range(-0.2, 0.2)), size, rng.range(-0.6, 0.6), rng);
    }
}
