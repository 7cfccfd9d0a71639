//! Diffuse light on a grid over every surface, worked out once per scene, cell by cell where it is asked for: pictures show few of a
//! scene's surfaces.

use crate::noise::floor;
use crate::rng::{hash3, unit};
use crate::shape::{Ray, Shape, complete};
use crate::texture::{Rgb, Texture};
use crate::world::{Light, Prim, World};
use nalgebra::{Point3, Vector3};
use std::sync::{Arc, OnceLock};

/// Samples per light and side, and of the hemisphere.
const LIGHT: usize = 4;
const HEMISPHERE: usize = 5;

/// Light on every surface, and the factor that exposes a picture of it well.
#[derive(Debug, Clone)]
pub(crate) struct Lighting {
    layers: Vec<Arc<Layer>>,
    pub(crate) gain: f32,
}

impl Lighting {
    /// Light on all surfaces of a scene, not exposed.
    pub(crate) fn new(world: &Arc<World>) -> Self {
        Self { layers: vec![Arc::new(Layer::new(world, 0))], gain: 1.0 }
    }

    /// The same light on the same surfaces, and light on those that `world` has more.
    pub(crate) fn with(&self, world: &Arc<World>) -> Self {
        let first = self.layers.last().map_or(0, |layer| layer.first + layer.maps.len());
        let more = Arc::new(Layer::new(world, first));
        Self { layers: self.layers.iter().cloned().chain([more]).collect(), gain: self.gain }
    }

    /// Irradiance over π at surface coordinates of a surface: what a white surface would send back.
    pub(crate) fn at(&self, prim: usize, s: f32, t: f32, back: bool) -> Rgb {
        let layer = self.layers.iter().rfind(|layer| prim >= layer.first);
        layer.map_or([0.0; 3], |layer| {
            let map = &layer.maps[prim - layer.first];
            map.sides[usize::from(back)].as_ref().map_or([0.0; 3], |side| {
                map.grid.between(s, t, |cell| *side.whole[cell].get_or_init(|| layer.whole(prim, back, side, cell)))
            })
        })
    }
}

/// The light on the surfaces from index `first` on.
#[derive(Debug)]
struct Layer {
    world: Arc<World>,
    first: usize,
    maps: Vec<Map>,
}

#[derive(Debug)]
struct Map {
    grid: Grid,
    /// Front and back; none where no light falls or it is not asked for.
    sides: [Option<Side>; 2],
}

/// The light on the cells of one side of a surface.
///
/// A cell's whole light needs bounced light and that needs direct light, never the other way round: threads that wait for each other's
/// cells never wait in a circle.
#[derive(Debug)]
struct Side {
    direct: Vec<OnceLock<Rgb>>,
    bounced: Vec<OnceLock<Rgb>>,
    whole: Vec<OnceLock<Rgb>>,
}

impl Side {
    fn new(cells: usize) -> Self {
        let none = || (0..cells).map(|_| OnceLock::new()).collect();
        Self { direct: none(), bounced: none(), whole: none() }
    }
}

/// Cells over a surface.
#[derive(Debug, Clone, Copy)]
struct Grid {
    columns: usize,
    rows: usize,
    wraps: bool,
}

impl Grid {
    fn new(shape: &Shape) -> Self {
        let (u, v) = shape.extent();
        // A shadow's edge is a few centimeters wide a meter from what throws it: finer grids show little more. Shadows
        // fall on wide surfaces; the light on slender ones changes little but from end to end.
        let spacing = if u.min(v) < 0.3 { 0.11 } else { (u * v).sqrt().mul_add(0.014, 0.026).min(0.09) };
        let count = |length: f64, least: usize| ((length / spacing).ceil() as usize).clamp(least, 160);
        let wraps = shape.wraps();
        Self { columns: count(u, if wraps { 10 } else { 2 }), rows: count(v, 2), wraps }
    }

    /// Bilinear in between the cells' values, held at the borders.
    fn between(&self, s: f32, t: f32, value: impl Fn(usize) -> Rgb) -> Rgb {
        let x = s * self.columns as f32 - 0.5;
        let y = (t * self.rows as f32 - 0.5).clamp(0.0, (self.rows - 1) as f32);
        let (x0, y0) = (floor(x), floor(y));
        let (fx, fy) = (x - x0 as f32, y - y0 as f32);
        let (c0, c1) = (self.column(x0), self.column(x0.saturating_add(1)));
        let (r0, r1) = (y0 as usize, (y0 as usize + 1).min(self.rows - 1));
        let p = |r: usize, c: usize| value(r * self.columns + c);
        let (a, b, c, d) = (p(r0, c0), p(r0, c1), p(r1, c0), p(r1, c1));
        std::array::from_fn(|i| {
            let top = a[i] + fx * (b[i] - a[i]);
            top + fy * (c[i] + fx * (d[i] - c[i]) - top)
        })
    }

    fn column(&self, i: i32) -> usize {
        let n = self.columns as i32;
        (if self.wraps { i.rem_euclid(n) } else { i.clamp(0, n - 1) }) as usize
    }

    /// A mean over 3×3 cells, which takes the noise of few samples away.
    fn mean(&self, cell: usize, value: impl Fn(usize) -> Rgb) -> Rgb {
        let (x, y) = ((cell % self.columns) as i32, (cell / self.columns) as i32);
        let mut sum = [0.0f32; 3];
        for (dx, dy) in (-1..=1).flat_map(|dy| (-1..=1).map(move |dx| (dx, dy))) {
            let row = (y + dy).clamp(0, self.rows as i32 - 1) as usize;
            let value = value(row * self.columns + self.column(x + dx));
            (0..3).for_each(|c| sum[c] += value[c] / 9.0);
        }
        sum
    }
}

impl Layer {
    fn new(world: &Arc<World>, first: usize) -> Self {
        let map = |prim: &Prim| {
            let grid = Grid::new(&prim.shape);
            let lit = !matches!(prim.texture, Texture::Emissive(_));
            let side = |there: bool| (lit && there).then(|| Side::new(grid.columns * grid.rows));
            Map { grid, sides: [side(true), side(prim.two_sided)] }
        };
        Self { world: world.clone(), first, maps: world.prims[first..].iter().map(map).collect() }
    }

    /// The middle of a cell, a hair above the surface, and the normal there.
    fn place(&self, prim: usize, back: bool, cell: usize) -> (Point3<f64>, Vector3<f64>) {
        let grid = &self.maps[prim - self.first].grid;
        let s = ((cell % grid.columns) as f64 + 0.5) / grid.columns as f64;
        let t = ((cell / grid.columns) as f64 + 0.5) / grid.rows as f64;
        let (point, normal) = self.world.prims[prim].shape.at(s, t);
        let normal = if back { -normal } else { normal };
        (point + normal * 1e-5, normal)
    }

    fn whole(&self, prim: usize, back: bool, side: &Side, cell: usize) -> Rgb {
        let grid = &self.maps[prim - self.first].grid;
        let bounced = grid.mean(cell, |c| *side.bounced[c].get_or_init(|| self.bounced(prim, back, c)));
        add(self.direct(prim, back, side, cell), bounced)
    }

    /// From the lights.
    fn direct(&self, prim: usize, back: bool, side: &Side, cell: usize) -> Rgb {
        *side.direct[cell].get_or_init(|| {
            let (point, normal) = self.place(prim, back, cell);
            let lights = self.world.lights.iter();
            lights.fold([0.0; 3], |sum, light| add(sum, from_light(&self.world, light, &point, &normal)))
        })
    }

    /// The direct light between the cells of a surface that a ray of bounced light comes from.
    fn direct_at(&self, prim: usize, s: f32, t: f32, back: bool) -> Rgb {
        // The first surfaces' light is known already where only the later ones are asked for.
        let Some(map) = prim.checked_sub(self.first).map(|i| &self.maps[i]) else {
            return self.world.ambient.map(|c| 0.2 * c);
        };
        let side = map.sides[usize::from(back)].as_ref();
        side.map_or([0.0; 3], |side| map.grid.between(s, t, |cell| self.direct(prim, back, side, cell)))
    }

    /// From all that is around.
    fn bounced(&self, prim: usize, back: bool, cell: usize) -> Rgb {
        let (point, normal) = self.place(prim, back, cell);
        let (a, b) = complete(&normal);
        let turn = |salt| f64::from(unit(hash3(prim as i32, cell as i32, salt, 0x11)));
        let (turn_u, turn_v) = (turn(0), turn(1));
        // How far from the normal and how far along it, and the way about it.
        let tilts: [(f64, f64); HEMISPHERE] = std::array::from_fn(|k| {
            let u = (k as f64 + turn_u) / HEMISPHERE as f64;
            (u.sqrt(), (1.0 - u).max(0.0).sqrt())
        });
        let ways: [(f64, f64); HEMISPHERE] = std::array::from_fn(|k| {
            let phi = (k as f64 + turn_v) / HEMISPHERE as f64 * std::f64::consts::TAU;
            (phi.cos(), phi.sin())
        });
        let mut sum = [0.0f32; 3];
        for (cos, sin) in ways {
            for (r, up) in tilts {
                let dir = a * (r * cos) + b * (r * sin) + normal * up;
                sum = add(sum, self.radiance(&Ray { origin: point, dir }));
            }
        }
        sum.map(|c| c / (HEMISPHERE * HEMISPHERE) as f32)
    }

    /// The light along a ray of bounced light.
    fn radiance(&self, ray: &Ray) -> Rgb {
        let world = &*self.world;
        let Some(hit) = world.hit(ray) else { return world.ambient };
        let prim = &world.prims[hit.prim];
        if matches!(prim.texture, Texture::Emissive(_)) {
            // Lamps and windows are lights of their own.
            return [0.0; 3];
        }
        let surface = prim.shape.surface(ray, hit.t);
        let light = self.direct_at(hit.prim, surface.s, surface.t, surface.normal.dot(&ray.dir) > 0.0);
        let color = world.albedo(hit.prim, &surface, 0.3);
        // Further bounces, as if half of all light went on.
        std::array::from_fn(|c| color[c] * (1.5 * light[c] + 0.12 * world.ambient[c]))
    }
}

fn add(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|c| a[c] + b[c])
}

/// Irradiance over π at a point from one light, by a grid of points on it.
fn from_light(world: &World, light: &Light, point: &Point3<f64>, normal: &Vector3<f64>) -> Rgb {
    let front = light.ev.cross(&light.eu);
    let mut sum = 0.0;
    for k in 0..LIGHT * LIGHT {
        let a = ((k % LIGHT) as f64 + 0.5) / LIGHT as f64;
        let b = ((k / LIGHT) as f64 + 0.5) / LIGHT as f64;
        let d = light.corner + light.eu * a + light.ev * b - point;
        let (cos, emitted) = (normal.dot(&d), -front.dot(&d));
        if cos > 0.0 && emitted > 0.0 && !world.blocked(&Ray { origin: *point, dir: d }, 1e-6, 1.0 - 1e-4) {
            sum += cos * emitted / d.norm_squared().powi(2);
        }
    }
    let share = (sum / ((LIGHT * LIGHT) as f64 * std::f64::consts::PI)) as f32;
    light.radiance.map(|c| c * share)
}
