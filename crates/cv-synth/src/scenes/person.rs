//! A walking person.

use super::furniture::{at, cloth, v};
use crate::rng::Rng;
use crate::scene::{Scene, SceneBuilder};
use crate::texture::{Texture, srgb};
use nalgebra::{Point3, Rotation3, Vector3};

/// Returns the scene with a person at `foot`, facing `yaw` (0 = toward −z), `phase` radians into the stride.
///
/// The clothes depend on the seed only: the same seed is the same person.
pub(crate) fn walker(scene: &Scene, foot: Point3<f64>, yaw: f64, phase: f64, seed: u64) -> Scene {
    let mut rng = Rng::new(seed, 5);
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), yaw);
    let place = |x: f64, y: f64, z: f64| foot + turn * v(x, -y, -z);
    let shirt = Texture::Fabric { colors: [cloth(&mut rng), cloth(&mut rng)], seed: rng.seed32() };
    let jeans = Texture::Fabric { colors: [srgb(0x2C3E57), srgb(0x263650)], seed: rng.seed32() };
    let skin = Texture::Plain(srgb(rng.pick([0xC98F6B, 0x8D5A3B, 0xE0B090])));
    let hair = Texture::Stone { colors: [srgb(0x1E1712), srgb(0x3A2A1E)], seed: rng.seed32() };
    let shoe = Texture::Plain(srgb(0x2B2B2B));
    let mut b = SceneBuilder::new();
    b.object("person");
    let mut limb = |from: Point3<f64>, to: Point3<f64>, radii: (f64, f64), texture: &Texture| {
        b.tube(from, to, radii, texture.clone());
        b.sphere(from, radii.0, texture.clone());
        b.sphere(to, radii.1, texture.clone());
    };
    let swing = 0.33 * phase.sin();
    for side in [-1.0, 1.0] {
        let s = side * swing;
        let bend = 0.12 * (1.0 - side * phase.cos()).max(0.0) * 0.5;
        let hip = place(0.095 * side, 0.9, 0.0);
        let knee = place(0.095 * side, 0.5, 0.42 * s + bend);
        let ankle = place(0.095 * side, 0.09 + 0.3 * bend, 0.85 * s - bend);
        limb(hip, knee, (0.085, 0.065), &jeans);
        limb(knee, ankle, (0.065, 0.05), &jeans);
        limb(ankle + v(0.0, 0.035, 0.0), ankle + turn * v(0.0, 0.045, -0.14), (0.048, 0.04), &shoe);
        let shoulder = place(0.19 * side, 1.4, 0.0);
        let elbow = place(0.235 * side, 1.12, -0.4 * s);
        let hand = place(0.235 * side, 0.9, -0.75 * s + 0.08);
        limb(shoulder, elbow, (0.058, 0.045), &shirt);
        limb(elbow, hand, (0.043, 0.032), &shirt);
        limb(hand, hand + v(0.0, 0.06, 0.0), (0.036, 0.03), &skin);
    }
    for x in [-0.07, 0.07] {
        limb(place(x, 0.92, 0.0), place(1.3 * x, 1.34, 0.0), (0.1, 0.115), &shirt);
    }
    limb(place(0.0, 1.42, 0.0), place(0.0, 1.54, 0.01), (0.055, 0.05), &skin);
    limb(place(0.0, 1.6, 0.02), place(0.0, 1.66, 0.02), (0.085, 0.09), &skin);
    limb(place(0.0, 1.66, -0.012), place(0.0, 1.685, 0.0), (0.096, 0.096), &hair);
    let occluders = vec![
        (place(0.0, 0.16, 0.85 * swing), 0.12),
        (place(0.0, 0.16, -0.85 * swing), 0.12),
        (place(0.0, 1.0, 0.0), 0.3),
    ];
    scene.with_objects(b, occluders)
}

/// Returns position, yaw and phase of the person in view `i` of `n`, crossing the living room from left to right.
pub(crate) fn path(i: usize, n: usize, seed: u64) -> (Point3<f64>, f64, f64) {
    let mut rng = Rng::new(seed, 6);
    let z = rng.range(4.9, 5.4);
    let f = (i as f64 + 0.5) / n.max(1) as f64;
    (at(-1.7 + 3.7 * f, 0.0, z + 0.2 * f), -std::f64::consts::FRAC_PI_2, 0.7 + 2.1 * i as f64)
}
