//! Furniture and other objects of rooms.

use crate::poster::Poster;
use crate::rng::Rng;
use crate::scene::SceneBuilder;
use crate::texture::{Rgb, Texture, scale, srgb};
use nalgebra::{Point3, Rotation3, Vector3};
use std::f64::consts::{FRAC_PI_2, TAU};
use std::sync::Arc;

/// A point from its coordinates.
pub(crate) fn at(x: f64, y: f64, z: f64) -> Point3<f64> {
    Point3::new(x, y, z)
}

/// A vector from its coordinates.
pub(crate) fn v(x: f64, y: f64, z: f64) -> Vector3<f64> {
    Vector3::new(x, y, z)
}

const CLOTHS: [u32; 14] = [
    0x7A2E2A, 0x2F4858, 0x33658A, 0x86BBD8, 0xC9A24B, 0x4F6D4A, 0x8A8D8F, 0xE3DAC9, 0x3B3A3A, 0x6B4E71, 0xB5651D,
    0xF1E9DA, 0x274029, 0xA23E48,
];

const WOODS: [[u32; 2]; 4] = [[0x6B4526, 0xA87B4C], [0x4A2F1C, 0x7B5330], [0x9C7447, 0xD0AC7C], [0x5C4033, 0x8E6B4E]];

pub(crate) fn wood(rng: &mut Rng) -> Texture {
    Texture::Wood { colors: rng.pick(WOODS).map(srgb), seed: rng.seed32() }
}

pub(crate) fn planks(rng: &mut Rng) -> Texture {
    Texture::Planks { colors: rng.pick(WOODS).map(srgb), plank: rng.range32(0.09, 0.16), seed: rng.seed32() }
}

pub(crate) fn cloth(rng: &mut Rng) -> Rgb {
    srgb(rng.pick(CLOTHS))
}

pub(crate) fn fabric(rng: &mut Rng) -> Texture {
    let ground = cloth(rng);
    Texture::Fabric { colors: [ground, scale(cloth(rng), 0.9)], seed: rng.seed32() }
}

pub(crate) fn poster(width: f64, height: f64, rng: &mut Rng) -> Texture {
    Texture::Poster(Arc::new(Poster::new(width as f32, height as f32, rng.next())))
}

/// Returns wallpaper, bricks, plaster or veined tiles.
pub(crate) fn wall_texture(kind: usize, rng: &mut Rng) -> Texture {
    let seed = rng.seed32();
    match kind % 4 {
        0 => Texture::Bricks { colors: [srgb(0x8E4A35), srgb(0xB5745A)], mortar: srgb(0xB7AEA2), seed },
        1 => {
            let [ground, a, b, c] = rng.pick([
                [0xE6DFCC, 0x6F8F72, 0xB5838D, 0xC8A45C],
                [0xD5DEE3, 0x48708A, 0x8FA9B8, 0xB9936C],
                [0xE9E1D4, 0x9C6644, 0x7F8F6A, 0x4F5D75],
            ]);
            Texture::Wallpaper { ground: srgb(ground), inks: [srgb(a), srgb(b), srgb(c)], cell: 0.17, seed }
        }
        2 => Texture::Stone { colors: [srgb(0x8C8579), srgb(0xD8D0C0)], seed },
        _ => Texture::Tiles { colors: [srgb(0x8C8F8C), srgb(0xD9D6CC)], tile: 0.3, seed },
    }
}

/// Adds a standing book, its spine toward −z before the rotation by `yaw`; `foot` is the center of its underside.
pub(crate) fn book(b: &mut SceneBuilder, foot: Point3<f64>, size: [f64; 3], yaw: f64, rng: &mut Rng) {
    let colors = [cloth(rng), srgb(rng.pick([0xE8D9A0, 0xF4F1E8, 0x1E1E1E, 0xC9A24B]))];
    let seed = rng.seed32();
    let cover = Texture::Fabric { colors: [colors[0], scale(colors[0], 0.96)], seed };
    let spine = Texture::Spine { colors, seed };
    b.block(foot, size, yaw, [&spine, &cover, &Texture::Pages { seed }]);
}

/// Adds a bookcase of `width` × `height` × `depth`, open toward −z before the rotation by `yaw` about `foot`.
pub(crate) fn bookcase(b: &mut SceneBuilder, foot: Point3<f64>, size: [f64; 3], yaw: f64, rng: &mut Rng) {
    let [width, height, depth] = size;
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw);
    let place = |x: f64, y: f64, z: f64| foot + turn * v(x, y, z);
    let wood = wood(rng);
    let panel = 0.022;
    b.object("bookcase");
    for side in [-1.0, 1.0] {
        b.block(place(side * (width - panel) / 2.0, 0.0, 0.0), [panel, height, depth], yaw, [&wood, &wood, &wood]);
    }
    b.block(place(0.0, 0.0, depth / 2.0 - 0.006), [width, height, 0.008], yaw, [&wood, &wood, &wood]);
    let shelves = (height / 0.34).floor() as usize;
    let gap = (height - panel) / shelves as f64;
    for i in 0..=shelves {
        b.block(place(0.0, -gap * i as f64, 0.0), [width - 2.0 * panel, panel, depth], yaw, [&wood, &wood, &wood]);
    }
    b.object("books");
    for i in 0..shelves {
        let floor = -gap * i as f64 - panel;
        let mut x = -width / 2.0 + panel + 0.01;
        let end = width / 2.0 - panel - 0.01;
        while x < end - 0.06 {
            if rng.chance(0.06) {
                x += rng.range(0.04, 0.2);
                continue;
            }
            let thick = rng.range(0.016, 0.055);
            let tall = rng.range(0.62, 0.93) * (gap - panel);
            let deep = rng.range(0.6, 0.85) * depth;
            if x + thick > end {
                break;
            }
            let z = -depth / 2.0 + deep / 2.0 + rng.range(0.008, 0.035);
            book(b, place(x + thick / 2.0, floor, z), [thick, tall, deep], yaw, rng);
            x += thick + 0.001;
        }
    }
}

pub(crate) fn table(b: &mut SceneBuilder, foot: Point3<f64>, size: [f64; 3], yaw: f64, rng: &mut Rng) {
    let [width, height, depth] = size;
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw);
    let wood = wood(rng);
    b.object("table").shiny(0.04, 60.0);
    b.block(foot - Vector3::y() * (height - 0.035), [width, 0.035, depth], yaw, [&wood, &wood, &wood]);
    for (x, z) in [(-1.0, -1.0), (1.0, -1.0), (-1.0, 1.0), (1.0, 1.0)] {
        let leg = foot + turn * v(x * (width / 2.0 - 0.06), 0.0, z * (depth / 2.0 - 0.06));
        b.block(leg, [0.05, height - 0.035, 0.05], yaw, [&wood, &wood, &wood]);
    }
}

pub(crate) fn chair(b: &mut SceneBuilder, foot: Point3<f64>, yaw: f64, rng: &mut Rng) {
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw);
    let place = |x: f64, y: f64, z: f64| foot + turn * v(x, y, z);
    let wood = wood(rng);
    let seat = fabric(rng);
    b.object("chair");
    b.block(place(0.0, -0.43, 0.0), [0.42, 0.05, 0.42], yaw, [&seat, &seat, &seat]);
    for (x, z) in [(-0.19, -0.19), (0.19, -0.19)] {
        b.block(place(x, 0.0, z), [0.035, 0.43, 0.035], yaw, [&wood, &wood, &wood]);
    }
    for x in [-0.19, 0.19] {
        b.block(place(x, 0.0, 0.19), [0.035, 0.92, 0.035], yaw, [&wood, &wood, &wood]);
    }
    for y in [-0.58, -0.72, -0.86] {
        b.block(place(0.0, y, 0.19), [0.36, 0.06, 0.018], yaw, [&wood, &wood, &wood]);
    }
}

pub(crate) fn sofa(b: &mut SceneBuilder, foot: Point3<f64>, yaw: f64, rng: &mut Rng) {
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw);
    let place = |x: f64, y: f64, z: f64| foot + turn * v(x, y, z);
    let color = cloth(rng);
    let cover = Texture::Fabric { colors: [color, scale(color, 0.8)], seed: rng.seed32() };
    let cover = [&cover, &cover, &cover];
    b.object("sofa");
    b.block(place(0.0, -0.06, 0.0), [1.9, 0.22, 0.85], yaw, cover);
    for x in [-0.42, 0.42] {
        b.block(place(x, -0.28, -0.07), [0.82, 0.15, 0.7], yaw, cover);
    }
    for x in [-1.02, 1.02] {
        b.block(place(x, -0.03, 0.0), [0.16, 0.6, 0.9], yaw, cover);
    }
    b.block(place(0.0, -0.06, 0.38), [1.9, 0.78, 0.16], yaw, cover);
    b.object("cushion");
    for (x, lean, spin) in [(-0.6, 0.35, 0.2), (0.62, 0.4, -0.15), (0.25, 0.3, 0.1)] {
        let turn = turn * Rotation3::from_euler_angles(lean, spin + rng.range(-0.1, 0.1), 0.0);
        let print = fabric(rng);
        b.tilted_block(place(x, -0.63, 0.18), [0.42, 0.4, 0.11], turn, [&print, &print, &print]);
    }
}

pub(crate) fn mug(b: &mut SceneBuilder, foot: Point3<f64>, rng: &mut Rng) {
    let color = Texture::Plain(cloth(rng));
    let (r, h) = (rng.range(0.036, 0.045), rng.range(0.085, 0.11));
    let top = foot - Vector3::y() * h;
    b.object("mug").shiny(0.06, 120.0).two_sided();
    b.tube(foot, top, (r * 0.9, r), color.clone());
    b.tube(foot, top, (r * 0.9 - 0.004, r - 0.004), Texture::Plain(srgb(0xE9E4DA)));
    let surface = foot - Vector3::y() * (0.8 * h);
    b.disc(surface - v(r, 0.0, -r), v(2.0 * r, 0.0, 0.0), v(0.0, 0.0, -2.0 * r), Texture::Plain(srgb(0x2A1A10)));
    // The handle: a ring of short pieces.
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), rng.range(0.0, TAU));
    let joint = |i: usize| {
        let a = -FRAC_PI_2 + std::f64::consts::PI * i as f64 / 6.0;
        foot + turn * v(r * 0.92 + 0.6 * r * a.cos(), -0.52 * h + 0.3 * h * a.sin(), 0.0)
    };
    for i in 0..6 {
        b.tube(joint(i), joint(i + 1), (0.005, 0.005), color.clone());
    }
}

/// Adds a pot with a plant, `size` meters tall.
pub(crate) fn plant(b: &mut SceneBuilder, foot: Point3<f64>, size: f64, rng: &mut Rng) {
    let r = 0.16 * size;
    let rim = foot - Vector3::y() * (0.26 * size);
    let clay = Texture::Stone { colors: [srgb(0x9A5A3C), srgb(0xB97A58)], seed: rng.seed32() };
    b.object("pot");
    b.solid_tube(foot, rim, (0.75 * r, r), clay, Texture::Stone { colors: [srgb(0x2B2019), srgb(0x4A3A2C)], seed: 3 });
    b.object("plant").two_sided().shiny(0.05, 20.0);
    let stalk = Texture::Plain(srgb(0x5B6B35));
    for _ in 0..9 {
        let angle = rng.range(0.0, TAU);
        let spread = rng.range(0.1, 0.42) * size;
        let mut from = rim + v(0.3 * r * angle.cos(), 0.0, 0.3 * r * angle.sin());
        for k in 1..=3 {
            let f = f64::from(k) / 3.0;
            let to =
                rim + v(spread * f * f * angle.cos(), -rng.range(0.5, 0.75) * size * f, spread * f * f * angle.sin());
            b.tube(from, to, (0.004 * size + 0.002, 0.003 * size + 0.002), stalk.clone());
            let length = rng.range(0.16, 0.26) * size;
            let turn =
                Rotation3::from_euler_angles(rng.range(-0.9, 0.3), angle + rng.range(-0.8, 0.8), rng.range(-0.6, 0.6));
            let (u, w) = (turn * v(length, 0.0, 0.0), turn * v(0.0, 0.0, 0.4 * length));
            let green = [srgb(0x2E4A24), srgb(rng.pick([0x56803A, 0x6D8F45, 0x3F6B3A]))];
            b.disc(to - w / 2.0, u, w, Texture::Wood { colors: green, seed: rng.seed32() });
            from = to;
        }
    }
}

pub(crate) fn floor_lamp(b: &mut SceneBuilder, foot: Point3<f64>, rng: &mut Rng) {
    let metal = Texture::Plain(srgb(0x3A3A3C));
    let top = foot - Vector3::y() * 1.45;
    b.object("lamp").shiny(0.2, 60.0);
    b.solid_tube(foot, foot - Vector3::y() * 0.02, (0.14, 0.14), metal.clone(), metal.clone());
    b.tube(foot, top, (0.011, 0.011), metal);
    b.object("lampshade").two_sided();
    let shade = Texture::Fabric { colors: [srgb(0xE8DDC4), srgb(0xDDCDA8)], seed: rng.seed32() };
    b.tube(top + Vector3::y() * 0.12, top - Vector3::y() * 0.16, (0.2, 0.13), shade);
}

/// Adds a framed poster on a wall: `corner` is its top left, `u` and `w` its edges.
pub(crate) fn framed(b: &mut SceneBuilder, corner: Point3<f64>, u: Vector3<f64>, w: Vector3<f64>, rng: &mut Rng) {
    let out = w.cross(&u).normalize();
    let (eu, ev) = (u.normalize(), w.normalize());
    let frame = wood(rng);
    let (width, height, bar) = (u.norm(), w.norm(), 0.022);
    b.object("poster").rect(corner + out * 0.012, u, w, poster(width, height, rng));
    b.object("frame");
    let turn = Rotation3::from_basis_unchecked(&[eu, ev, -out]);
    let middle = corner + u / 2.0 + w / 2.0 + out * 0.012;
    for side in [-1.0, 1.0] {
        let across = middle + ev * (side * (height + bar) / 2.0);
        b.tilted_block(across, [width + 2.0 * bar, bar, 0.03], turn, [&frame, &frame, &frame]);
        let upright = middle + eu * (side * (width + bar) / 2.0);
        b.tilted_block(upright, [bar, height, 0.03], turn, [&frame, &frame, &frame]);
    }
}

/// Adds a cardboard box or a printed package.
pub(crate) fn package(b: &mut SceneBuilder, foot: Point3<f64>, size: [f64; 3], yaw: f64, rng: &mut Rng) {
    b.object("box");
    if rng.chance(0.6) {
        let front = poster(size[0], size[1], rng);
        let side = poster(size[2], size[1], rng);
        let top = poster(size[0], size[2], rng);
        b.block(foot, size, yaw, [&front, &side, &top]);
    } else {
        let card = Texture::Stone { colors: [srgb(0x9A7449), srgb(0xB89263)], seed: rng.seed32() };
        b.block(foot, size, yaw, [&card, &card, &card]);
    }
}
