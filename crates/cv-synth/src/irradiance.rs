//! Irradiance of every surface of a scene on a grid of cells, computed once for each cell on demand: an image shows few
//! of a scene's surfaces.

use crate::noise::floor;
use crate::rng::{hash3, unit};
use crate::shape::{Ray, Shape, complete_basis};
use crate::texture::{Rgb, Texture};
use crate::world::{Light, Prim, World};
use nalgebra::{Point3, Vector3};
use std::sync::{Arc, OnceLock};

/// Samples along each side of a light.
const LIGHT_SAMPLES: usize = 4;
/// Samples of the hemisphere along each of its two coordinates.
const HEMISPHERE_SAMPLES: usize = 5;

/// Irradiance of every surface, and the exposure gain.
#[derive(Debug, Clone)]
pub(crate) struct Lighting {
    layers: Vec<Arc<Layer>>,
    pub(crate) gain: f32,
}

impl Lighting {
    /// Creates the irradiance of all surfaces of a scene, with a gain of 1.
    pub(crate) fn new(world: &Arc<World>) -> Self {
        Self { layers: vec![Arc::new(Layer::new(world, 0))], gain: 1.0 }
    }

    /// Keeps the irradiance of the same surfaces, and adds the further surfaces of `world`.
    pub(crate) fn with(&self, world: &Arc<World>) -> Self {
        let first = self.layers.last().map_or(0, |layer| layer.first + layer.maps.len());
        let more = Arc::new(Layer::new(world, first));
        Self { layers: self.layers.iter().cloned().chain([more]).collect(), gain: self.gain }
    }

    /// Returns the irradiance over π at surface coordinates of a surface: the radiance of a white surface there.
    pub(crate) fn at(&self, prim: usize, s: f32, t: f32, back: bool) -> Rgb {
        let layer = self.layers.iter().rfind(|layer| prim >= layer.first);
        layer.map_or([0.0; 3], |layer| {
            let map = &layer.maps[prim - layer.first];
            map.sides[usize::from(back)].as_ref().map_or([0.0; 3], |side| {
                map.grid.interpolate(s, t, |cell| *side.total[cell].get_or_init(|| layer.total(prim, back, side, cell)))
            })
        })
    }
}

/// The irradiance of the surfaces from index `first` on.
#[derive(Debug)]
struct Layer {
    world: Arc<World>,
    first: usize,
    maps: Vec<SurfaceIrradiance>,
}

#[derive(Debug)]
struct SurfaceIrradiance {
    grid: Grid,
    /// Front and back; `None` for emitters and for backs that are not lit.
    sides: [Option<Side>; 2],
}

/// The irradiance of the cells of one side of a surface.
///
/// The total of a cell depends on bounced light, and that on direct light, never the reverse: threads that wait for
/// each other's cells never deadlock.
#[derive(Debug)]
struct Side {
    direct: Vec<OnceLock<Rgb>>,
    bounced: Vec<OnceLock<Rgb>>,
    total: Vec<OnceLock<Rgb>>,
}

impl Side {
    fn new(cells: usize) -> Self {
        let empty = || (0..cells).map(|_| OnceLock::new()).collect();
        Self { direct: empty(), bounced: empty(), total: empty() }
    }
}

/// The grid of cells of a surface.
#[derive(Debug, Clone, Copy)]
struct Grid {
    columns: usize,
    rows: usize,
    wraps: bool,
}

impl Grid {
    fn new(shape: &Shape) -> Self {
        let (u, v) = shape.extent();
        // Shadow edges are a few centimeters wide at a meter from the occluder: finer grids show little more. Shadows
        // fall on large surfaces; the irradiance of slender ones varies only along them.
        let spacing = if u.min(v) < 0.3 { 0.11 } else { (u * v).sqrt().mul_add(0.014, 0.026).min(0.09) };
        let count = |length: f64, min: usize| ((length / spacing).ceil() as usize).clamp(min, 160);
        let wraps = shape.is_periodic();
        Self { columns: count(u, if wraps { 10 } else { 2 }), rows: count(v, 2), wraps }
    }

    /// Bilinear interpolation between the cells' values, clamped at the borders.
    fn interpolate(&self, s: f32, t: f32, value: impl Fn(usize) -> Rgb) -> Rgb {
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

    /// Returns the mean over 3×3 cells, which reduces the noise of few samples.
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
            let is_lit = !matches!(prim.texture, Texture::Emissive(_));
            let side = |exists: bool| (is_lit && exists).then(|| Side::new(grid.columns * grid.rows));
            SurfaceIrradiance { grid, sides: [side(true), side(prim.two_sided)] }
        };
        Self { world: world.clone(), first, maps: world.prims[first..].iter().map(map).collect() }
    }

    /// Returns the center of a cell, slightly above the surface, and the normal.
    fn cell_center(&self, prim: usize, back: bool, cell: usize) -> (Point3<f64>, Vector3<f64>) {
        let grid = &self.maps[prim - self.first].grid;
        let s = ((cell % grid.columns) as f64 + 0.5) / grid.columns as f64;
        let t = ((cell / grid.columns) as f64 + 0.5) / grid.rows as f64;
        let (point, normal) = self.world.prims[prim].shape.at(s, t);
        let normal = if back { -normal } else { normal };
        (point + normal * 1e-5, normal)
    }

    /// Returns the total irradiance of a cell, direct and bounced.
    fn total(&self, prim: usize, back: bool, side: &Side, cell: usize) -> Rgb {
        let grid = &self.maps[prim - self.first].grid;
        let bounced = grid.mean(cell, |c| *side.bounced[c].get_or_init(|| self.bounced(prim, back, c)));
        add(self.direct(prim, back, side, cell), bounced)
    }

    /// Returns the direct irradiance of a cell.
    fn direct(&self, prim: usize, back: bool, side: &Side, cell: usize) -> Rgb {
        *side.direct[cell].get_or_init(|| {
            let (point, normal) = self.cell_center(prim, back, cell);
            let lights = self.world.lights.iter();
            lights.fold([0.0; 3], |sum, light| add(sum, irradiance_by_light(&self.world, light, &point, &normal)))
        })
    }

    /// Returns the interpolated direct irradiance where a bounced ray hits a surface.
    fn direct_at(&self, prim: usize, s: f32, t: f32, back: bool) -> Rgb {
        // Surfaces of an earlier layer, whose irradiance this layer does not have.
        let Some(map) = prim.checked_sub(self.first).map(|i| &self.maps[i]) else {
            return self.world.ambient.map(|c| 0.2 * c);
        };
        let side = map.sides[usize::from(back)].as_ref();
        side.map_or([0.0; 3], |side| map.grid.interpolate(s, t, |cell| self.direct(prim, back, side, cell)))
    }

    /// Returns the bounced irradiance of a cell by sampling the hemisphere.
    fn bounced(&self, prim: usize, back: bool, cell: usize) -> Rgb {
        let (point, normal) = self.cell_center(prim, back, cell);
        let (a, b) = complete_basis(&normal);
        let jitter = |salt| f64::from(unit(hash3(prim as i32, cell as i32, salt, 0x11)));
        let (jitter_u, jitter_v) = (jitter(0), jitter(1));
        // Sine and cosine of the angle to the normal, and direction about it.
        let elevations: [(f64, f64); HEMISPHERE_SAMPLES] = std::array::from_fn(|k| {
            let u = (k as f64 + jitter_u) / HEMISPHERE_SAMPLES as f64;
            (u.sqrt(), (1.0 - u).max(0.0).sqrt())
        });
        let azimuths: [(f64, f64); HEMISPHERE_SAMPLES] = std::array::from_fn(|k| {
            let phi = (k as f64 + jitter_v) / HEMISPHERE_SAMPLES as f64 * std::f64::consts::TAU;
            (phi.cos(), phi.sin())
        });
        let mut sum = [0.0f32; 3];
        for (cos, sin) in azimuths {
            for (r, up) in elevations {
                let dir = a * (r * cos) + b * (r * sin) + normal * up;
                sum = add(sum, self.radiance(&Ray { origin: point, dir }));
            }
        }
        sum.map(|c| c / (HEMISPHERE_SAMPLES * HEMISPHERE_SAMPLES) as f32)
    }

    /// Returns the radiance along a bounced ray.
    fn radiance(&self, ray: &Ray) -> Rgb {
        let world = &*self.world;
        let Some(hit) = world.hit(ray) else { return world.ambient };
        let prim = &world.prims[hit.prim];
        if matches!(prim.texture, Texture::Emissive(_)) {
            // Emitters are sampled as lights.
            return [0.0; 3];
        }
        let surface = prim.shape.surface(ray, hit.t);
        let irradiance = self.direct_at(hit.prim, surface.s, surface.t, surface.normal.dot(&ray.dir) > 0.0);
        let color = world.albedo(hit.prim, &surface, 0.3);
        // Approximates further bounces as half of the direct light.
        std::array::from_fn(|c| color[c] * (1.5 * irradiance[c] + 0.12 * world.ambient[c]))
    }
}

fn add(a: Rgb, b: Rgb) -> Rgb {
    std::array::from_fn(|c| a[c] + b[c])
}

/// Returns the irradiance over π at a point by one light, sampled on a grid.
fn irradiance_by_light(world: &World, light: &Light, point: &Point3<f64>, normal: &Vector3<f64>) -> Rgb {
    let front = light.ev.cross(&light.eu);
    let mut sum = 0.0;
    for k in 0..LIGHT_SAMPLES * LIGHT_SAMPLES {
        let a = ((k % LIGHT_SAMPLES) as f64 + 0.5) / LIGHT_SAMPLES as f64;
        let b = ((k / LIGHT_SAMPLES) as f64 + 0.5) / LIGHT_SAMPLES as f64;
        let d = light.corner + light.eu * a + light.ev * b - point;
        let (cos, emitted) = (normal.dot(&d), -front.dot(&d));
        if cos > 0.0 && emitted > 0.0 && !world.is_occluded(&Ray { origin: *point, dir: d }, 1e-6, 1.0 - 1e-4) {
            sum += cos * emitted / d.norm_squared().powi(2);
        }
    }
    let factor = (sum / ((LIGHT_SAMPLES * LIGHT_SAMPLES) as f64 * std::f64::consts::PI)) as f32;
    light.radiance.map(|c| c * factor)
}
