//! Procedural textures, band-limited to the sample width.

use crate::font::text;
use crate::noise::{Octaves, contrast, edge, fbm, fbm3, floor, noise2};
use crate::poster::Poster;
use crate::print::Print;
use crate::rng::{hash2, unit};
use std::sync::Arc;

/// Linear RGB.
pub type Rgb = [f32; 3];

/// Converts an sRGB color `0xRRGGBB` to linear RGB.
pub fn srgb(hex: u32) -> Rgb {
    [16, 8, 0].map(|shift| {
        let c = ((hex >> shift) & 255) as f32 / 255.0;
        if c <= 0.04045 { c / 12.92 } else { ((c + 0.055) / 1.055).powf(2.4) }
    })
}

#[inline]
pub(crate) fn mix(a: Rgb, b: Rgb, t: f32) -> Rgb {
    std::array::from_fn(|c| a[c] + t * (b[c] - a[c]))
}

#[inline]
pub(crate) fn scale(a: Rgb, s: f32) -> Rgb {
    a.map(|c| (c * s).max(0.0))
}

/// A sample position on a surface.
#[derive(Debug, Clone, Copy)]
pub(crate) struct SurfacePoint {
    /// Meters along the surface from its corner.
    pub(crate) u: f32,
    pub(crate) v: f32,
    /// Position relative to the center of the shape, for solid textures.
    pub(crate) local: [f32; 3],
    /// Size of the surface in meters.
    pub(crate) size: (f32, f32),
    /// Sample width on the surface in meters.
    pub(crate) width: f32,
}

/// Texture of a surface. Lengths are meters; colors are linear reflectances.
#[derive(Debug, Clone)]
pub enum Texture {
    /// One color.
    Plain(Rgb),
    /// An emitter: a lamp or a window.
    Emissive(Rgb),
    /// A checkerboard with squares of `square` meters, `colors[0]` at the corner.
    Checker {
        /// Side of a square.
        square: f32,
        /// The two colors.
        colors: [Rgb; 2],
    },
    /// A calibration board: `squares` × `squares` of `square` meters, centered on a white sheet.
    Board {
        /// Columns and rows of squares.
        squares: (u32, u32),
        /// Side of a square.
        square: f32,
    },
    /// A printed calibration board of any kind.
    Print(Arc<Print>),
    /// Rolled wall paint: faint mottling at all scales.
    Paint {
        /// Mean color.
        color: Rgb,
        /// Seed of the pattern.
        seed: u32,
    },
    /// Rough plaster, concrete or stone: weak low frequencies, strong grain from centimeters down to millimeters.
    Stone {
        /// Dark and light.
        colors: [Rgb; 2],
        /// Seed of the pattern.
        seed: u32,
    },
    /// Paper with scattered leaves and blossoms.
    Wallpaper {
        /// The paper.
        ground: Rgb,
        /// Printing inks.
        inks: [Rgb; 3],
        /// Mean distance between motifs.
        cell: f32,
        /// Seed of the pattern.
        seed: u32,
    },
    /// A brick wall.
    Bricks {
        /// Two brick colors.
        colors: [Rgb; 2],
        /// Mortar.
        mortar: Rgb,
        /// Seed of the pattern.
        seed: u32,
    },
    /// A floor of planks along u.
    Planks {
        /// Dark and light wood.
        colors: [Rgb; 2],
        /// Width of a plank.
        plank: f32,
        /// Seed of the pattern.
        seed: u32,
    },
    /// Furniture wood, grain along u.
    Wood {
        /// Dark and light wood.
        colors: [Rgb; 2],
        /// Seed of the pattern.
        seed: u32,
    },
    /// Veined stone tiles.
    Tiles {
        /// Vein and ground.
        colors: [Rgb; 2],
        /// Side of a tile.
        tile: f32,
        /// Seed of the pattern.
        seed: u32,
    },
    /// A bordered rug.
    Rug {
        /// Field, border, ornament.
        colors: [Rgb; 3],
        /// Seed of the pattern.
        seed: u32,
    },
    /// Woven cloth with a large print.
    Fabric {
        /// Ground and print.
        colors: [Rgb; 2],
        /// Seed of the pattern.
        seed: u32,
    },
    /// The spine of a book, title along v.
    Spine {
        /// Cloth and lettering.
        colors: [Rgb; 2],
        /// Seed of the pattern.
        seed: u32,
    },
    /// The cut edges of pages, along u.
    Pages {
        /// Seed of the pattern.
        seed: u32,
    },
    /// A solid ball of nearly one color, dimpled.
    Ball {
        /// Color.
        color: Rgb,
        /// Seed of the pattern.
        seed: u32,
    },
    /// A poster that fills the surface.
    Poster(Arc<Poster>),
    /// A surface with posters on it, all in one plane.
    Collage(Arc<Collage>),
}

impl Texture {
    /// Returns the reflectance (or the radiance of [`Texture::Emissive`]) at a point.
    pub(crate) fn color(&self, p: &SurfacePoint) -> Rgb {
        let (u, v, w) = (p.u, p.v, p.width);
        match self {
            Self::Plain(color) | Self::Emissive(color) => *color,
            Self::Checker { square, colors } => mix(colors[0], colors[1], checker(u / square, v / square, w / square)),
            Self::Board { squares, square } => {
                let (n, m) = (squares.0 as f32, squares.1 as f32);
                let x = (u - 0.5 * (p.size.0 - n * square)) / square;
                let y = (v - 0.5 * (p.size.1 - m * square)) / square;
                let w = w / square;
                let inside = edge(x, w) * edge(n - x, w) * edge(y, w) * edge(m - y, w);
                mix([0.85; 3], [0.03; 3], inside * (1.0 - checker(x, y, w)))
            }
            Self::Print(print) => mix([0.85; 3], [0.03; 3], print.black_fraction(u, v, w)),
            Self::Paint { color, seed } => {
                let mottle = 0.030 * fbm(u, v, const { &Octaves::new(1.3, 4, 0.7) }, *seed, w);
                let roller = 0.055 * fbm(u, v, const { &Octaves::new(45.0, 3, 0.8) }, seed ^ 7, w);
                scale(*color, 1.0 + mottle + roller)
            }
            Self::Stone { colors, seed } => {
                let cloud = 0.20 * fbm(u, v, const { &Octaves::new(1.7, 4, 0.7) }, *seed, w);
                let grain = 0.34 * fbm(u, v, const { &Octaves::new(24.0, 6, 0.85) }, seed ^ 1, w);
                mix(colors[0], colors[1], (0.5 + cloud + grain).clamp(0.0, 1.0))
            }
            Self::Wallpaper { ground, inks, cell, seed } => wallpaper(*ground, inks, *cell, *seed, p),
            Self::Bricks { colors, mortar, seed } => bricks(colors, *mortar, *seed, p),
            Self::Planks { colors, plank, seed } => planks(colors, *plank, *seed, p),
            Self::Wood { colors, seed } => wood(colors, *seed, u, v, w),
            Self::Tiles { colors, tile, seed } => tiles(colors, *tile, *seed, p),
            Self::Rug { colors, seed } => rug(colors, *seed, p),
            Self::Fabric { colors, seed } => {
                let print = edge(fbm(u, v, const { &Octaves::new(5.0, 3, 0.5) }, *seed, w) - 0.18, 0.12 + 6.0 * w);
                let weave = 0.10 * fbm(u, v, const { &Octaves::new(160.0, 3, 0.8) }, seed ^ 3, w)
                    + 0.08 * fbm(u, v, const { &Octaves::new(9.0, 3, 0.6) }, seed ^ 5, w);
                scale(mix(colors[0], colors[1], print), 1.0 + weave)
            }
            Self::Spine { colors, seed } => spine(colors, *seed, p),
            Self::Pages { seed } => {
                let lines = 0.16 * contrast(900.0, w) * noise2(u * 6.0, v * 900.0, *seed);
                let bands = 0.10 * fbm(u * 0.2, v, const { &Octaves::new(60.0, 2, 0.7) }, seed ^ 1, w);
                scale([0.66, 0.61, 0.50], 1.0 + lines + bands)
            }
            Self::Ball { color, seed } => {
                let tone = 0.10 * fbm3(p.local, 14.0, 2, 0.6, *seed, w);
                let dimples = 0.16 * fbm3(p.local, 260.0, 2, 0.7, seed ^ 1, w);
                scale(*color, 1.0 + tone + dimples)
            }
            Self::Poster(poster) => poster.color(u, v, w),
            Self::Collage(collage) => collage.color(p),
        }
    }
}

/// A ground with posters; see [`Texture::Collage`].
#[derive(Debug, Clone)]
pub struct Collage {
    ground: Texture,
    posters: Vec<((f32, f32), Poster)>,
    /// For each meter along u from 0, the posters that may be visible there.
    columns: Vec<Vec<usize>>,
}

impl Collage {
    /// Creates a collage from the corner (u, v) of each poster in meters from the surface's corner; later posters are
    /// on top.
    pub fn new(ground: Texture, posters: Vec<((f32, f32), Poster)>) -> Self {
        let column_range = |&((left, _), ref poster): &((f32, f32), Poster)| {
            let column = |u: f32| u.clamp(0.0, 1e4) as usize;
            (column(left - Self::MARGIN), column(left + poster.size().0 + Self::MARGIN))
        };
        let count = posters.iter().map(|p| column_range(p).1 + 1).max().unwrap_or(0);
        let mut columns = vec![Vec::new(); count];
        for (i, poster) in posters.iter().enumerate() {
            let (from, to) = column_range(poster);
            columns[from..=to].iter_mut().for_each(|c| c.push(i));
        }
        Self { ground, posters, columns }
    }

    /// Margin of the posters in meters; samples wider than twice this blur a poster's border too little.
    const MARGIN: f32 = 0.02;

    fn color(&self, p: &SurfacePoint) -> Rgb {
        let w = p.width;
        let mut color = None;
        for &i in self.columns.get(p.u.max(0.0) as usize).into_iter().flatten() {
            let ((left, top), poster) = &self.posters[i];
            let (x, y) = (p.u - left, p.v - top);
            let (width, height) = poster.size();
            let inset = x.min(y).min(width - x).min(height - y);
            if inset > -Self::MARGIN {
                let cover = edge(x, w) * edge(width - x, w) * edge(y, w) * edge(height - y, w);
                if cover > 0.0 {
                    let behind = if cover < 1.0 { color.unwrap_or_else(|| self.ground.color(p)) } else { [0.0; 3] };
                    color = Some(mix(behind, poster.color(x, y, w), cover));
                }
            }
        }
        color.unwrap_or_else(|| self.ground.color(p))
    }
}

/// Returns 0 on the square at the corner, 1 on its neighbors; lengths in squares.
fn checker(x: f32, y: f32, w: f32) -> f32 {
    // For each axis a square wave of ±1, +1 just above even edges, box-filtered at the nearest edge.
    let wave = |t: f32| {
        let nearest = floor(t + 0.5);
        let side = 2.0 * edge(t - nearest as f32, w) - 1.0;
        if nearest & 1 == 0 { side } else { -side }
    };
    0.5 - 0.5 * wave(x) * wave(y) * contrast(0.5, w)
}

fn wallpaper(ground: Rgb, inks: &[Rgb; 3], cell: f32, seed: u32, p: &SurfacePoint) -> Rgb {
    let (u, v, w) = (p.u, p.v, p.width);
    let grain = 0.07 * fbm(u, v, const { &Octaves::new(11.0, 6, 0.85) }, seed ^ 11, w)
        + 0.04 * fbm(u, v, const { &Octaves::new(1.1, 3, 0.6) }, seed ^ 12, w);
    let mut color = ground;
    let (cx, cy) = (floor(u / cell), floor(v / cell));
    for dy in -1..=1 {
        for dx in -1..=1 {
            let (x, y) = (cx + dx, cy + dy);
            let h = |salt: u32| unit(hash2(x, y, seed ^ salt));
            let (px, py) = ((x as f32 + 0.2 + 0.6 * h(1)) * cell, (y as f32 + 0.2 + 0.6 * h(2)) * cell);
            let (ex, ey) = (u - px, v - py);
            let radius = cell * (0.35 + 0.25 * h(3));
            if ex * ex + ey * ey > radius * radius * 1.1 {
                continue;
            }
            let (sin, cos) = (std::f32::consts::TAU * h(4)).sin_cos();
            let (lx, ly) = ((cos * ex + sin * ey) / radius, (cos * ey - sin * ex) / radius);
            let r = (lx * lx + ly * ly).sqrt();
            let ww = w / radius;
            let inside = if h(5) < 0.55 {
                // Four to seven petals round a heart.
                let petals = 4.0 + floor(4.0 * h(6)) as f32;
                let angle = ly.atan2(lx);
                let outline = 0.55 + 0.40 * (petals * angle).cos();
                let flower = edge((outline - r) * 0.5, ww) * edge(r - 0.22, ww);
                flower + edge(0.13 - r, ww)
            } else {
                // A stalk with pairs of leaves.
                let stalk = edge(0.03 - ly.abs(), ww) * edge(0.95 - lx.abs(), ww);
                let k = (lx * 4.0 + 0.5) as i32 as f32 - if lx < -0.125 { 1.0 } else { 0.0 };
                let (qx, qy) = (lx * 4.0 - k, (ly.abs() - 0.22) * 5.0);
                let leaf = edge((1.0 - (qx * 1.5 + qy * 0.6).powi(2) * 2.0 - qy * qy) * 0.1, ww);
                stalk.max(leaf * edge(0.8 - lx.abs(), ww))
            };
            let ink = inks[(hash2(x, y, seed ^ 9) % 3) as usize];
            color = mix(color, ink, 0.85 * inside.clamp(0.0, 1.0));
        }
    }
    scale(color, 1.0 + grain)
}

fn bricks(colors: &[Rgb; 2], mortar: Rgb, seed: u32, p: &SurfacePoint) -> Rgb {
    let w = p.width;
    // Edges wander by about 3 mm.
    let u = p.u + 0.003 * fbm(p.u, p.v, const { &Octaves::new(14.0, 3, 0.6) }, seed ^ 21, w);
    let v = p.v + 0.003 * fbm(p.u, p.v, const { &Octaves::new(14.0, 3, 0.6) }, seed ^ 22, w);
    let (length, height, joint) = (0.225, 0.075, 0.010);
    let row = floor(v / height);
    let shift = if row & 1 == 0 { 0.0 } else { 0.5 * length };
    let column = floor((u + shift) / length);
    let (x, y) = (u + shift - column as f32 * length, v - row as f32 * height);
    let inside = edge(x - joint, w) * edge(length - x, w) * edge(y - joint, w) * edge(height - y, w);
    let h = |salt: u32| unit(hash2(column, row, seed ^ salt));
    let grain = 0.32 * fbm(u, v, const { &Octaves::new(18.0, 6, 0.75) }, seed ^ hash2(column, row, 5), w);
    let brick = scale(mix(colors[0], colors[1], h(1)), (0.75 + 0.5 * h(2)) * (1.0 + grain));
    let joint_color = scale(mortar, 1.0 + 0.25 * fbm(u, v, const { &Octaves::new(40.0, 4, 0.8) }, seed ^ 23, w));
    mix(joint_color, brick, inside)
}

fn wood(colors: &[Rgb; 2], seed: u32, u: f32, v: f32, w: f32) -> Rgb {
    // Growth rings: a slow slope across the board, bent; each ring darkens slowly and ends sharply.
    let bend = fbm(u * 0.35, v, const { &Octaves::new(2.2, 3, 0.5) }, seed, w);
    let place = 34.0 * v + 2.4 * bend;
    let phase = place - floor(place) as f32;
    let ring = contrast(34.0, w) * (phase * phase - 0.33);
    // Fibres: streaks of every width down to the pores, a few centimeters long.
    let fibre = fbm(u * 0.05, v, const { &Octaves::new(55.0, 5, 0.8) }, seed ^ 3, w);
    let cloud = fbm(u * 0.4, v, const { &Octaves::new(7.0, 3, 0.6) }, seed ^ 4, w);
    let t = 0.5 + 0.35 * ring + 0.20 * fibre + 0.22 * cloud + 0.15 * bend;
    // Pores: short dark strokes, some clusters of them, and the flecks of the rays across.
    let pores = contrast(420.0, w) * noise2(u * 60.0, v * 420.0, seed ^ 2).max(0.0);
    let flecks = 0.09 * fbm(u, v, const { &Octaves::new(70.0, 4, 0.85) }, seed ^ 5, w);
    scale(mix(colors[0], colors[1], t.clamp(0.0, 1.0)), (1.0 - 0.4 * pores) * (1.0 + flecks))
}

fn planks(colors: &[Rgb; 2], plank: f32, seed: u32, p: &SurfacePoint) -> Rgb {
    let (u, v, w) = (p.u, p.v, p.width);
    let length = 1.35;
    let row = floor(v / plank);
    let shift = length * unit(hash2(row, 0, seed ^ 31));
    let column = floor((u + shift) / length);
    let (x, y) = (u + shift - column as f32 * length, v - row as f32 * plank);
    let gap = 0.0025;
    let inside = edge(x - gap, w) * edge(length - x, w) * edge(y - gap, w) * edge(plank - y, w);
    let h = hash2(column, row, seed ^ 32);
    let tone = 0.78 + 0.44 * unit(h);
    let wear = 1.0 + 0.08 * fbm(u, v, const { &Octaves::new(3.0, 5, 0.7) }, seed ^ 33, w);
    let color = wood(colors, h, x + 3.0 * unit(h.rotate_left(9)), y, w);
    mix(scale(colors[0], 0.25), scale(color, tone * wear), inside)
}

fn tiles(colors: &[Rgb; 2], tile: f32, seed: u32, p: &SurfacePoint) -> Rgb {
    let (u, v, w) = (p.u, p.v, p.width);
    let (column, row) = (floor(u / tile), floor(v / tile));
    let (x, y) = (u - column as f32 * tile, v - row as f32 * tile);
    let grout = 0.004;
    let inside = edge(x - grout, w) * edge(tile - x, w) * edge(y - grout, w) * edge(tile - y, w);
    let h = hash2(column, row, seed);
    let field = fbm(u, v, const { &Octaves::new(4.5, 5, 0.6) }, h, w);
    let vein = (1.0 - 5.0 * field.abs()).max(0.0);
    let cloud = 0.5 + 0.4 * fbm(u, v, const { &Octaves::new(9.0, 5, 0.75) }, h ^ 1, w);
    let t = (0.75 * cloud + 0.35 - 0.7 * vein).clamp(0.0, 1.0);
    let color = scale(mix(colors[0], colors[1], t), 0.88 + 0.24 * unit(h));
    mix([0.30, 0.29, 0.27], color, inside)
}

fn rug(colors: &[Rgb; 3], seed: u32, p: &SurfacePoint) -> Rgb {
    let (u, v, w) = (p.u, p.v, p.width);
    let inset = u.min(p.size.0 - u).min(v).min(p.size.1 - v);
    let band = |from: f32, to: f32| edge(inset - from, w) * edge(to - inset, w);
    // Ornaments: level sets of a distorted field, mirrored about the center.
    let (mu, mv) = ((u - 0.5 * p.size.0).abs(), (v - 0.5 * p.size.1).abs());
    let field = fbm(mu, mv, const { &Octaves::new(4.0, 4, 0.55) }, seed, w);
    let soft = (9.0 * w).max(0.03);
    let lines = edge(0.10 - (field - 0.25).abs(), soft) + edge(0.07 - (field + 0.3).abs(), soft);
    let mut color = mix(colors[0], colors[2], 0.9 * lines.clamp(0.0, 1.0));
    let border = band(0.05, 0.24);
    let figure = edge(fbm(mu, mv, const { &Octaves::new(16.0, 2, 0.5) }, seed ^ 2, w) - 0.1, (20.0 * w).max(0.1));
    color = mix(color, mix(colors[1], colors[2], 0.8 * figure), border);
    color = mix(color, colors[2], band(0.24, 0.265) + band(0.035, 0.05));
    let pile = 0.22 * fbm(u, v, const { &Octaves::new(120.0, 3, 0.8) }, seed ^ 3, w)
        + 0.10 * fbm(u, v, const { &Octaves::new(7.0, 4, 0.7) }, seed ^ 4, w);
    scale(color, 1.0 + pile)
}

fn spine(colors: &[Rgb; 2], seed: u32, p: &SurfacePoint) -> Rgb {
    let (u, v, w) = (p.u, p.v, p.width);
    let (width, height) = p.size;
    let h = |salt: u32| unit(hash2(salt as i32, 0, seed));
    let cloth = 1.0
        + 0.10 * fbm(u, v, const { &Octaves::new(300.0, 3, 0.8) }, seed, w)
        + 0.07 * fbm(u, v, const { &Octaves::new(12.0, 4, 0.7) }, seed ^ 1, w);
    let mut ink = 0.0;
    // Title along the spine, bands at the ends.
    let letter = (0.45 * width).min(0.022);
    let start = 0.16 + 0.1 * h(1);
    ink += text(v - start * height, 0.5 * width + 0.5 * letter - u, letter, 0.6 * height, 0.45, seed ^ 2, w)
        * edge(0.5 * width + 0.55 * letter - u, w)
        * edge(u - 0.5 * width + 0.55 * letter, w);
    let band = |at: f32, half: f32| edge(half - (v - at).abs(), w);
    if h(2) < 0.7 {
        let half = 0.002 + 0.006 * h(3);
        ink += band(0.08 * height, half) + band(0.92 * height, half);
    }
    if h(4) < 0.4 {
        ink += band(0.88 * height, 0.0015) + band(0.12 * height, 0.0015);
    }
    // Rounded: darker toward the sides.
    let t = 2.0 * u / width.max(1e-4) - 1.0;
    scale(mix(colors[0], colors[1], ink.clamp(0.0, 1.0)), cloth * (1.0 - 0.35 * t * t * t * t))
}
