//! Procedural posters: landscapes, abstract shapes, text pages, maps.

use crate::font::text;
use crate::noise::{Octaves, edge, fbm, noise2};
use crate::rng::Rng;
use crate::texture::{Rgb, mix, scale, srgb};

/// Inks of a poster: paper, dark, three colors.
const PALETTES: [[u32; 5]; 6] = [
    [0xF1EDE2, 0x1F2A36, 0xC8402F, 0xE0A526, 0x2F6F8F],
    [0xE9E4D4, 0x27221F, 0x6B8E4E, 0xD98F4E, 0x3A506B],
    [0xF4F1EC, 0x16161A, 0xB23A48, 0x2E86AB, 0xF2C14E],
    [0xE4EAEC, 0x202C39, 0x283845, 0xF29559, 0xB8B08D],
    [0xF3EEE9, 0x2B2118, 0x8C2F39, 0x4F7CAC, 0x9EB25D],
    [0xF7F3E3, 0x252323, 0x6F9CEB, 0xAF4D98, 0xD66853],
];

#[derive(Debug, Clone)]
enum Print {
    /// Sun, sky and hills.
    Landscape,
    /// Overlapping figures.
    Shapes(Vec<Figure>),
    /// A headline above columns of text with an image.
    Sheet,
    /// Contour lines, woods, water and roads.
    Map,
}

#[derive(Debug, Clone, Copy)]
struct Figure {
    kind: u8,
    x: f32,
    y: f32,
    radius: f32,
    cos: f32,
    sin: f32,
    ink: Rgb,
}

/// A printed poster.
#[derive(Debug, Clone)]
pub struct Poster {
    width: f32,
    height: f32,
    print: Print,
    inks: [Rgb; 5],
    seed: u32,
}

impl Poster {
    /// Creates a poster of `width` × `height` meters; the seed determines its content.
    pub fn new(width: f32, height: f32, seed: u64) -> Self {
        let mut rng = Rng::new(seed, 0x706F_7374);
        let inks = rng.pick(PALETTES).map(srgb);
        let short = width.min(height);
        let print = match rng.index(4) {
            0 => Print::Landscape,
            1 => Print::Shapes(
                (0..14)
                    .map(|_| {
                        let (sin, cos) = rng.range32(0.0, std::f32::consts::TAU).sin_cos();
                        Figure {
                            kind: rng.index(4) as u8,
                            x: rng.range32(0.1, 0.9) * width,
                            y: rng.range32(0.08, 0.8) * height,
                            radius: short * rng.range32(0.04, 0.27),
                            cos,
                            sin,
                            ink: inks[1 + rng.index(4)],
                        }
                    })
                    .collect(),
            ),
            2 => Print::Sheet,
            _ => Print::Map,
        };
        Self { width, height, print, inks, seed: rng.seed32() }
    }

    /// Returns width and height in meters.
    pub fn size(&self) -> (f32, f32) {
        (self.width, self.height)
    }

    /// Returns the color at `(u, v)` meters from the corner, for a sample of width `w`.
    pub(crate) fn color(&self, u: f32, v: f32, w: f32) -> Rgb {
        let [paper, dark, ..] = self.inks;
        let short = self.width.min(self.height);
        let margin = 0.05 * short;
        let inset = (u - margin).min(self.width - margin - u).min(v - margin).min(self.height - margin - v);
        let inside = edge(inset, w);
        let fibre = 1.0 + 0.02 * fbm(u, v, const { &Octaves::new(90.0, 3, 0.8) }, self.seed ^ 1, w);
        let color = if inside <= 0.0 {
            paper
        } else {
            let printed = match &self.print {
                Print::Landscape => self.landscape(u, v, w),
                Print::Shapes(figures) => self.shapes(figures, u, v, w),
                Print::Sheet => self.sheet(u, v, w),
                Print::Map => self.map(u, v, w),
            };
            mix(paper, printed, inside)
        };
        // A thin dark line at the border of the sheet.
        let rim = edge(0.0015 - u.min(v).min(self.width - u).min(self.height - v), w);
        scale(mix(color, dark, 0.3 * rim), fibre)
    }

    /// Draws a headline `top` meters below the upper border.
    fn headline(&self, under: Rgb, u: f32, v: f32, top: f32, size: f32, w: f32) -> Rgb {
        let left = 0.09 * self.width;
        let (x, y) = (u - left, v - top);
        if !(0.0..1.2 * size).contains(&y) {
            return under;
        }
        mix(under, self.inks[1], text(x, y, size, self.width - 2.0 * left, 0.75, self.seed ^ 77, w))
    }

    fn landscape(&self, u: f32, v: f32, w: f32) -> Rgb {
        let [paper, dark, warm, gold, cool] = self.inks;
        let (s, t) = (u / self.width, v / self.height);
        let mut color = mix(cool, mix(gold, paper, 0.5), (1.6 * t).clamp(0.0, 1.0));
        let clouds = fbm(u * 0.4, v, &Octaves::new(6.0 / self.height, 6, 0.6), self.seed, w);
        color = mix(color, paper, (0.5 * clouds).clamp(0.0, 0.6));
        let (sx, sy) = (0.3 * self.width, 0.28 * self.height);
        let sun = 0.11 * self.width - ((u - sx).powi(2) + (v - sy).powi(2)).sqrt();
        color = mix(color, mix(gold, warm, 0.4), edge(sun, w));
        for layer in 0..4u32 {
            let depth = layer as f32 / 3.0;
            let ridge = noise2(s * (2.0 + 2.0 * depth), 7.7, self.seed ^ layer)
                + 0.35 * noise2(s * 11.0, 3.3, self.seed ^ layer)
                + 0.12 * noise2(s * 41.0, 1.3, self.seed ^ layer);
            let top = (0.42 + 0.14 * depth + 0.07 * ridge) * self.height;
            let hill = mix(mix(cool, paper, 0.45), mix(dark, cool, 0.25), depth);
            let rough = 1.0 + 0.45 * fbm(u, v, &Octaves::new(20.0 / self.height, 6, 0.75), self.seed ^ (9 + layer), w);
            color = mix(color, scale(hill, rough), edge(v - top, w));
        }
        let band = edge(v - 0.85 * self.height, w);
        color = mix(color, paper, band);
        self.headline(color, u, v, 0.87 * self.height, 0.055 * self.height, w)
    }

    fn shapes(&self, figures: &[Figure], u: f32, v: f32, w: f32) -> Rgb {
        let [paper, dark, .., cool] = self.inks;
        let mut color = mix(paper, cool, 0.12 + 0.1 * v / self.height);
        for f in figures {
            let (x, y) = (u - f.x, v - f.y);
            if x * x + y * y > 2.6 * f.radius * f.radius {
                continue;
            }
            let (lx, ly) = (f.cos * x + f.sin * y, f.cos * y - f.sin * x);
            let r = (x * x + y * y).sqrt();
            let inside = match f.kind {
                0 => edge(f.radius - r, w),
                1 => edge((0.18 * f.radius) - (r - 0.75 * f.radius).abs(), w),
                2 => edge(f.radius - lx.abs(), w) * edge(0.45 * f.radius - ly.abs(), w),
                _ => edge(ly + 0.5 * f.radius, w) * edge(0.5 * f.radius - 0.87 * lx.abs() - 0.5 * ly, w),
            };
            let grain =
                1.0 + 0.22 * fbm(u, v, &Octaves::new(3.0 / f.radius, 5, 0.75), self.seed ^ (f.radius * 1e4) as u32, w);
            color = mix(color, scale(f.ink, grain), 0.92 * inside);
        }
        let band = edge(v - 0.86 * self.height, w);
        color = mix(color, dark, band);
        let (x, y) = (u - 0.09 * self.width, v - 0.885 * self.height);
        if y > 0.0 && y < 0.06 * self.height {
            let ink = text(x, y, 0.045 * self.height, 0.8 * self.width, 0.7, self.seed ^ 5, w);
            color = mix(color, paper, ink * band);
        }
        color
    }

    fn sheet(&self, u: f32, v: f32, w: f32) -> Rgb {
        let [paper, dark, warm, gold, cool] = self.inks;
        let (width, height) = (self.width, self.height);
        let left = 0.09 * width;
        let mut color = paper;
        color = mix(color, warm, edge(0.16 * height - v, w));
        let (x, y) = (u - left, v - 0.065 * height);
        if y > 0.0 && y < 0.09 * height {
            color = mix(color, paper, text(x, y, 0.07 * height, 0.82 * width, 0.8, self.seed ^ 77, w));
        }
        // An image at the right, text around it in two columns.
        let image = edge(u - 0.5 * width, w)
            * edge(0.91 * width - u, w)
            * edge(v - 0.22 * height, w)
            * edge(0.52 * height - v, w);
        let column = if u < 0.48 * width { (left, 0.38 * width) } else { (0.5 * width, 0.41 * width) };
        let top = if u < 0.48 * width { 0.22 } else { 0.55 } * height;
        let size = 0.0135 * height;
        let ink = text(u - column.0, v - top, size, column.1, 0.5, self.seed ^ 8, w) * edge(0.93 * height - v, w);
        color = mix(color, dark, ink * (1.0 - image));
        if image > 0.0 {
            let bent = fbm(u, v, &Octaves::new(5.0 / width, 4, 0.6), self.seed ^ 2, w);
            let field = fbm(u + 0.1 * width * bent, v, &Octaves::new(9.0 / width, 6, 0.65), self.seed ^ 3, w);
            let tone = mix(mix(dark, cool, (0.9 + bent).clamp(0.0, 1.0)), gold, (0.4 + 0.8 * field).clamp(0.0, 1.0));
            color = mix(color, tone, image);
        }
        color
    }

    fn map(&self, u: f32, v: f32, w: f32) -> Rgb {
        let [paper, dark, warm, gold, cool] = self.inks;
        let f = 3.0 / self.width;
        let ground = fbm(u, v, &Octaves::new(f, 6, 0.5), self.seed, w);
        let water = edge(-0.28 - ground, (6.0 * f * w).max(0.01));
        let woods = edge(fbm(u, v, &Octaves::new(2.7 * f, 5, 0.6), self.seed ^ 1, w) - 0.12, (12.0 * f * w).max(0.04));
        let mut color = mix(paper, mix(cool, gold, 0.5), 0.35 * woods);
        // Contour lines every 0.08, about 0.012 wide, shown while a sample is smaller than their spacing.
        let level = ground / 0.08;
        let off = (level - level.round()).abs() * 0.08;
        let shown = (1.0 - 14.0 * f * w).clamp(0.0, 1.0);
        color = mix(color, mix(warm, dark, 0.3), 0.75 * shown * edge(0.006 - off, (3.0 * f * w).max(0.004)));
        color = mix(color, mix(cool, paper, 0.35), water);
        for road in 0..3u32 {
            let bent =
                0.12 * self.height * fbm(u, 0.37 * road as f32, &Octaves::new(f, 4, 0.5), self.seed ^ (40 + road), 0.0);
            let line = (v - (0.2 + 0.27 * road as f32) * self.height - bent).abs();
            color = mix(color, dark, edge(0.006 * self.height - line, 1.4 * w));
            color = mix(color, gold, edge(0.004 * self.height - line, 1.4 * w));
        }
        // Place names on a loose grid.
        let cell = 0.17 * self.height;
        let row = (v / cell).floor();
        let jitter = 0.5 + 0.5 * noise2(row * 3.7, 0.5, self.seed ^ 9);
        let (x, y) = (u - (0.12 + 0.3 * jitter) * self.width, v - (row + 0.4) * cell);
        if y > 0.0 && y < 0.03 * self.height {
            let name = text(x, y, 0.02 * self.height, 0.3 * self.width, 0.6, self.seed ^ row as u32, w);
            color = mix(color, dark, name);
        }
        let band = edge(0.11 * self.height - v, w);
        color = mix(color, paper, band);
        self.headline(color, u, v, 0.05 * self.height, 0.04 * self.height, w)
    }
}
