//! Diffuse light, worked out once per scene on a grid over every surface.

use crate::rng::{hash3, unit};
use crate::scene::{Light, Scene};
use crate::shape::{Ray, Shape, complete};
use crate::texture::{Rgb, Texture};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;

/// Irradiance over π on a surface: what a white surface would send back.
#[derive(Debug, Clone)]
pub(crate) struct Map {
    columns: usize,
    rows: usize,
    wraps: bool,
    front: Vec<Rgb>,
    back: Vec<Rgb>,
}

/// Samples per light and side, and of the hemisphere.
const LIGHT: usize = 4;
const HEMISPHERE: usize = 5;

impl Map {
    fn empty(shape: &Shape) -> Self {
        let (u, v) = shape.extent();
        // A shadow's edge is a few centimeters wide a meter from what throws it: finer grids show little more. Shadows
        // fall on wide surfaces; the light on slender ones changes little but from end to end.
        let spacing = if u.min(v) < 0.3 { 0.11 } else { (u * v).sqrt().mul_add(0.014, 0.026).min(0.09) };
        let count = |length: f64, least: usize| ((length / spacing).ceil() as usize).clamp(least, 160);
        let wraps = shape.wraps();
        Self { columns: count(u, if wraps { 10 } else { 2 }), rows: count(v, 2), wraps, front: vec![], back: vec![] }
    }

    /// Bilinear in between, held at the borders.
    pub(crate) fn at(&self, s: f32, t: f32, back: bool) -> Rgb {
        let data = if back { &self.back } else { &self.front };
        if data.is_empty() {
            return [0.0; 3];
        }
        let x = s * self.columns as f32 - 0.5;
        let y = (t * self.rows as f32 - 0.5).clamp(0.0, (self.rows - 1) as f32);
        let (x0, y0) = (x.floor(), y.floor());
        let (fx, fy) = (x - x0, y - y0);
        let column = |i: f32| {
            if self.wraps {
                (i as i64).rem_euclid(self.columns as i64) as usize
            } else {
                i.clamp(0.0, (self.columns - 1) as f32) as usize
            }
        };
        let (c0, c1) = (column(x0), column(x0 + 1.0));
        let (r0, r1) = (y0 as usize, (y0 as usize + 1).min(self.rows - 1));
        let p = |r: usize, c: usize| data[r * self.columns + c];
        let (a, b, c, d) = (p(r0, c0), p(r0, c1), p(r1, c0), p(r1, c1));
        std::array::from_fn(|i| {
            let top = a[i] + fx * (b[i] - a[i]);
            top + fy * (c[i] + fx * (d[i] - c[i]) - top)
        })
    }

    /// A 3×3 mean, which takes the noise of few samples away.
    fn smooth(&self, data: &[Rgb]) -> Vec<Rgb> {
        let (w, h) = (self.columns as i64, self.rows as i64);
        let cell = |x: i64, y: i64| {
            let x = if self.wraps { x.rem_euclid(w) } else { x.clamp(0, w - 1) };
            data[(y.clamp(0, h - 1) * w + x) as usize]
        };
        let mean = |i: i64| {
            let (x, y) = (i % w, i / w);
            let mut sum = [0.0f32; 3];
            for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
                let value = cell(x + dx, y + dy);
                (0..3).for_each(|c| sum[c] += value[c] / 9.0);
            }
            sum
        };
        (0..w * h).map(mean).collect()
    }
}

/// The maps of the surfaces from index `first` on.
pub(crate) fn bake(scene: &Scene, first: usize) -> Vec<Map> {
    let mut maps: Vec<Map> = scene.prims[first..].iter().map(|p| Map::empty(&p.shape)).collect();
    // (surface, side, cell) of every cell, in a fixed order.
    let mut cells = Vec::new();
    for (i, map) in maps.iter().enumerate() {
        let prim = &scene.prims[first + i];
        if matches!(prim.texture, Texture::Emissive(_)) {
            continue;
        }
        for side in 0..=usize::from(prim.two_sided) {
            cells.extend((0..map.columns * map.rows).map(|cell| (i, side, cell)));
        }
    }
    let place = |&(i, side, cell): &(usize, usize, usize)| {
        let map = &maps[i];
        let s = ((cell % map.columns) as f64 + 0.5) / map.columns as f64;
        let t = ((cell / map.columns) as f64 + 0.5) / map.rows as f64;
        let (point, normal) = scene.prims[first + i].shape.at(s, t);
        let normal = if side == 1 { -normal } else { normal };
        (point + normal * 1e-5, normal)
    };
    let direct: Vec<Rgb> = cells
        .par_iter()
        .map(|cell| {
            let (point, normal) = place(cell);
            scene.lights.iter().fold([0.0; 3], |sum, light| add(sum, from_light(scene, light, &point, &normal)))
        })
        .collect();
    let spread = |maps: &mut Vec<Map>, values: &[Rgb], smooth: bool| {
        let mut from = 0;
        while from < cells.len() {
            let (i, side, _) = cells[from];
            let count = maps[i].columns * maps[i].rows;
            let slice = &values[from..from + count];
            let data = if smooth { maps[i].smooth(slice) } else { slice.to_vec() };
            let target = if side == 1 { &mut maps[i].back } else { &mut maps[i].front };
            if target.is_empty() {
                *target = data;
            } else {
                target.iter_mut().zip(data).for_each(|(t, d)| *t = add(*t, d));
            }
            from += count;
        }
    };
    let mut lit = maps.clone();
    spread(&mut lit, &direct, false);
    // The first surfaces' light is known already where only the later ones are asked for.
    let light_at = |prim: usize, s: f32, t: f32, back: bool| match prim.checked_sub(first) {
        Some(i) => lit[i].at(s, t, back),
        None => [0.2 * scene.ambient[0], 0.2 * scene.ambient[1], 0.2 * scene.ambient[2]],
    };
    let bounced: Vec<Rgb> = cells
        .par_iter()
        .map(|cell| {
            let (point, normal) = place(cell);
            let (a, b) = complete(&normal);
            let turn = |salt| f64::from(unit(hash3(cell.0 as i32 + first as i32, cell.2 as i32, salt, 0x11)));
            let (turn_u, turn_v) = (turn(0), turn(1));
            let mut sum = [0.0f32; 3];
            for k in 0..HEMISPHERE * HEMISPHERE {
                let u = ((k % HEMISPHERE) as f64 + turn_u) / HEMISPHERE as f64;
                let v = ((k / HEMISPHERE) as f64 + turn_v) / HEMISPHERE as f64;
                let (r, phi) = (u.sqrt(), v * std::f64::consts::TAU);
                let dir = a * (r * phi.cos()) + b * (r * phi.sin()) + normal * (1.0 - u).max(0.0).sqrt();
                let ray = Ray { origin: point, dir };
                let radiance = match scene.hit(&ray) {
                    None => scene.ambient,
                    Some(hit) => {
                        let surface = scene.prims[hit.prim].shape.surface(&ray, hit.t);
                        if matches!(scene.prims[hit.prim].texture, Texture::Emissive(_)) {
                            // Lamps and windows are lights of their own.
                            [0.0; 3]
                        } else {
                            let light = light_at(hit.prim, surface.s, surface.t, surface.normal.dot(&dir) > 0.0);
                            let color = scene.albedo(hit.prim, &surface, 0.3);
                            // Further bounces, as if half of all light went on.
                            std::array::from_fn(|c| color[c] * (1.5 * light[c] + 0.12 * scene.ambient[c]))
                        }
                    }
                };
                sum = add(sum, radiance);
            }
            sum.map(|c| c / (HEMISPHERE * HEMISPHERE) as f32)
        })
        .collect();
    spread(&mut maps, &direct, false);
    spread(&mut maps, &bounced, true);
    maps
}

fn add(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|c| a[c] + b[c])
}

/// Irradiance over π at a point from one light, by a grid of points on it.
fn from_light(scene: &Scene, light: &Light, point: &Point3<f64>, normal: &Vector3<f64>) -> Rgb {
    let front = light.ev.cross(&light.eu);
    let mut sum = 0.0;
    for k in 0..LIGHT * LIGHT {
        let a = ((k % LIGHT) as f64 + 0.5) / LIGHT as f64;
        let b = ((k / LIGHT) as f64 + 0.5) / LIGHT as f64;
        let d = light.corner + light.eu * a + light.ev * b - point;
        let (cos, emitted) = (normal.dot(&d), -front.dot(&d));
        if cos > 0.0 && emitted > 0.0 && !scene.blocked(&Ray { origin: *point, dir: d }, 1e-6, 1.0 - 1e-4) {
            sum += cos * emitted / d.norm_squared().powi(2);
        }
    }
    let share = (sum / ((LIGHT * LIGHT) as f64 * std::f64::consts::PI)) as f32;
    light.radiance.map(|c| c * share)
}
