//! Black quadrilaterals on white: where markers may be.
//!
//! Black is what lies below the middle between the darkest and the brightest pixel around, tile by tile (E. Olson, "AprilTag: a robust and flexible visual fiducial
//! system", ICRA 2011, and its later versions). The convex hull of what hangs together loses one side after the other, always the one that adds the least area,
//! until four are left. Then each side is a straight line through the steps from white to black along it. Time: pixels, and corners of hulls squared.

use cv_core::{Cancelled, GrayF32, ImageView, Mask, Point2, Stage, Vector2};
use cv_imgproc::{Connectivity, StructuringElement, connected_components, erode, pyr_down, sample_bilinear};
use rayon::prelude::*;

/// Pixels that are looked at for black regions; a larger picture is halved before, and its sides are then taken from the whole one.
const MOST_PIXELS: usize = 3_000_000;
/// Side of a tile in pixels; the brightness around is that of three by three.
const TILE: usize = 8;
/// Smallest side of a region in pixels: a marker of 6×6 cells and a frame of two has cells of a pixel then.
const LEAST_SIDE: usize = 10;

/// A side of a quadrilateral: a point of the line, its direction, and the standard deviation of the line at its ends, in pixels.
#[derive(Debug, Clone, Copy)]
struct Line {
    at: Point2<f64>,
    along: Vector2<f64>,
    deviation: f64,
}

/// The quadrilaterals of a picture, corners clockwise on screen, exact to about a tenth of a pixel.
pub(super) fn quads(
    view: ImageView<'_, f32, 1>,
    least_contrast: f32,
    stage: &Stage<'_>,
) -> Result<Vec<[Point2<f64>; 4]>, Cancelled> {
    let mut small: Option<GrayF32> = None;
    let mut scale = 1.0;
    loop {
        let now = small.as_ref().map_or(view, GrayF32::view);
        if now.width() * now.height() <= MOST_PIXELS {
            break;
        }
        small = Some(pyr_down(now));
        scale *= 2.0;
    }
    let image = small.as_ref().map_or(view, GrayF32::view);
    let black = black(image, least_contrast);
    stage.check()?;
    let mut rough = regions(black.view());
    // Once more without the rim of what is black: markers that touch each other, or a black square, at a corner come apart.
    let apart = erode(black.view(), &StructuringElement::square(1));
    stage.check()?;
    rough.extend(regions(apart.view()));
    let exact: Vec<Option<[Point2<f64>; 4]>> = rough
        .par_iter()
        .with_min_len(16)
        .map(|quad| {
            stage.check()?;
            let quad = quad.map(|p| p * scale);
            let Some(lines) = sides(view, &quad, 1.5 + 2.5 * scale) else { return Ok(None) };
            let near = corners(&lines).filter(|near| near.iter().zip(&quad).all(|(p, q)| (p - q).norm() < 6.0 * scale));
            let Some(near) = near else { return Ok(None) };
            Ok(sides(view, &near, 2.5).and_then(|lines| corners(&lines)))
        })
        .collect::<Result<_, Cancelled>>()?;
    let mut out: Vec<[Point2<f64>; 4]> = Vec::new();
    for quad in exact.into_iter().flatten() {
        // Both masks see most of them.
        let middle = |q: &[Point2<f64>; 4]| Point2::from((q[0].coords + q[1].coords + q[2].coords + q[3].coords) / 4.0);
        let known = |other: &[Point2<f64>; 4]| {
            let size = (other[0] - other[2]).norm();
            (middle(other) - middle(&quad)).norm() < 0.1 * size && ((quad[0] - quad[2]).norm() / size - 1.0).abs() < 0.2
        };
        if !out.iter().any(known) {
            out.push(quad);
        }
    }
    Ok(out)
}

/// Pixels that are darker than the middle between dark and bright around them, where there are both.
fn black(image: ImageView<'_, f32, 1>, least_contrast: f32) -> Mask {
    let (w, h) = image.size();
    let (columns, rows) = (w.div_ceil(TILE), h.div_ceil(TILE));
    let tiles: Vec<(f32, f32)> = (0..rows * columns)
        .into_par_iter()
        .with_min_len(64)
        .map(|t| {
            let (x0, y0) = (t % columns * TILE, t / columns * TILE);
            let mut range = (f32::INFINITY, f32::NEG_INFINITY);
            for y in y0..(y0 + TILE).min(h) {
                for &v in &image.row(y)[x0..(x0 + TILE).min(w)] {
                    range = (range.0.min(v), range.1.max(v));
                }
            }
            range
        })
        .collect();
    let levels: Vec<f32> = (0..rows * columns)
        .map(|t| {
            let near = |i: usize, n: usize| i.saturating_sub(1)..=(i + 1).min(n - 1);
            let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
            for j in near(t / columns, rows) {
                for i in near(t % columns, columns) {
                    let (l, h) = tiles[j * columns + i];
                    (low, high) = (low.min(l), high.max(h));
                }
            }
            if high - low >= least_contrast { 0.5 * (low + high) } else { f32::NEG_INFINITY }
        })
        .collect();
    Mask::from_fn(w, h, |x, y| [image.at(x, y)[0] < levels[y / TILE * columns + x / TILE]])
}

/// The quadrilaterals around the regions of a mask, to a pixel or two.
fn regions(mask: ImageView<'_, bool, 1>) -> Vec<[Point2<f64>; 4]> {
    let (w, h) = mask.size();
    let found = connected_components(mask, Connectivity::Four);
    let fits: Vec<bool> = found
        .stats
        .iter()
        .map(|s| {
            let inside = s.left > 0 && s.top > 0 && s.left + s.width < w && s.top + s.height < h;
            inside && s.width.min(s.height) >= LEAST_SIDE && s.area >= 2 * (s.width + s.height)
        })
        .collect();
    // First and last pixel of each region in each of its rows.
    let mut ends: Vec<Vec<[u32; 3]>> = vec![Vec::new(); found.stats.len()];
    for y in 0..h {
        for (x, &label) in found.labels.row(y).iter().enumerate() {
            let Some(i) = (label as usize).checked_sub(1).filter(|i| fits[*i]) else { continue };
            match ends[i].last_mut().filter(|end| end[0] == y as u32) {
                Some(end) => end[2] = x as u32,
                None => ends[i].push([y as u32, x as u32, x as u32]),
            }
        }
    }
    ends.into_par_iter().with_min_len(16).filter_map(|ends| quadrilateral(hull(&ends))).collect()
}

fn turn(a: Point2<f64>, b: Point2<f64>, c: Point2<f64>) -> f64 {
    (b - a).perp(&(c - b))
}

/// The convex hull of rows of pixels, clockwise on screen (A. M. Andrew's monotone chain, 1979).
fn hull(ends: &[[u32; 3]]) -> Vec<Point2<f64>> {
    let chain = |points: &mut dyn Iterator<Item = Point2<f64>>| {
        let mut out: Vec<Point2<f64>> = Vec::new();
        for p in points {
            while out.len() > 1 && turn(out[out.len() - 2], out[out.len() - 1], p) <= 0.0 {
                out.pop();
            }
            out.push(p);
        }
        out
    };
    let at = |x: u32, y: u32| Point2::new(f64::from(x), f64::from(y));
    // Down along the right ends, up along the left ones.
    let mut all = chain(&mut ends.iter().map(|e| at(e[2], e[0])));
    all.extend(chain(&mut ends.iter().rev().map(|e| at(e[1], e[0]))));
    all.dedup();
    if all.first() == all.last() {
        all.pop();
    }
    all
}

fn area(polygon: &[Point2<f64>]) -> f64 {
    let n = polygon.len();
    (0..n).map(|i| polygon[i].coords.perp(&polygon[(i + 1) % n].coords)).sum::<f64>() / 2.0
}

/// Where two lines meet.
fn meet(a: Point2<f64>, along_a: Vector2<f64>, b: Point2<f64>, along_b: Vector2<f64>) -> Option<Point2<f64>> {
    let det = along_a.perp(&along_b);
    let p = a + along_a * ((b - a).perp(&along_b) / det);
    (det.abs() > 1e-3 * along_a.norm() * along_b.norm() && p.x.is_finite() && p.y.is_finite()).then_some(p)
}

/// The quadrilateral around a hull, where it is nearly one.
fn quadrilateral(mut polygon: Vec<Point2<f64>>) -> Option<[Point2<f64>; 4]> {
    let whole = area(&polygon);
    while polygon.len() > 4 {
        let n = polygon.len();
        let mut best: Option<(f64, usize, Point2<f64>)> = None;
        for i in 0..n {
            let (a, b, c, d) = (polygon[(i + n - 1) % n], polygon[i], polygon[(i + 1) % n], polygon[(i + 2) % n]);
            // The side from b to c goes; its neighbors meet outside.
            let (Some(p), true) = (meet(a, b - a, c, d - c), (b - a).perp(&(d - c)) > 0.0) else { continue };
            let added = turn(b, p, c).abs() / 2.0;
            if best.is_none_or(|best| added < best.0) {
                best = Some((added, i, p));
            }
        }
        let (_, i, p) = best?;
        polygon[i] = p;
        polygon.remove((i + 1) % n);
    }
    let quad: [Point2<f64>; 4] = polygon.try_into().ok()?;
    let sides: [f64; 4] = std::array::from_fn(|i| (quad[(i + 1) % 4] - quad[i]).norm());
    let (short, long) = sides.iter().fold((f64::INFINITY, 0.0f64), |(a, b), s| (a.min(*s), b.max(*s)));
    // A marker seen at 80° is six times as long as wide; its hull, eroded and blurred at the corners, lacks an eighth at most where it is small.
    (short >= 6.0 && long < 8.0 * short && whole > 0.8 * area(&quad)).then_some(quad)
}

/// The lines of the four sides, by the steps from white (outside) to black within `reach` pixels of them; `None` where a side has none.
fn sides(view: ImageView<'_, f32, 1>, quad: &[Point2<f64>; 4], reach: f64) -> Option<[Line; 4]> {
    let mut out = [Line { at: quad[0], along: Vector2::zeros(), deviation: 0.0 }; 4];
    for (k, line) in out.iter_mut().enumerate() {
        *line = side(view, quad[k], quad[(k + 1) % 4], (0.1, 0.9), (reach, LEAST_FALL))?;
    }
    Some(out)
}

/// The corners where the lines of neighboring sides meet.
fn corners(lines: &[Line; 4]) -> Option<[Point2<f64>; 4]> {
    let corner = |k: usize| {
        let (a, b) = (&lines[(k + 3) % 4], &lines[k]);
        meet(a.at, a.along, b.at, b.along)
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}

/// Least fall over a pixel that counts as an edge, in a picture of sRGB; and in linear light, where dark grays, which it may be between, lie closer together.
const LEAST_FALL: f32 = 0.02;
const LEAST_FALL_OF_LIGHT: f32 = 0.002;

/// The line of steps from white to black between two shares of the way from a corner to the next, which goes clockwise around black.
fn side(
    view: ImageView<'_, f32, 1>,
    from: Point2<f64>,
    to: Point2<f64>,
    (first, last): (f64, f64),
    (reach, least_fall): (f64, f32),
) -> Option<Line> {
    let length = (to - from).norm();
    if !(length > 4.0 && length.is_finite()) {
        return None;
    }
    let along = (to - from) / length;
    // To the right of the way, which is inside on screen.
    let inward = Vector2::new(-along.y, along.x);
    let count = ((length * (last - first)).round() as usize).clamp(5, 60);
    let mut steps: Vec<Vector2<f64>> = Vec::with_capacity(count);
    for i in 0..count {
        let t = first + (last - first) * (i as f64 + 0.5) / count as f64;
        if let Some(off) = step(view, from + along * (t * length), inward, (reach, least_fall)) {
            steps.push(Vector2::new(t * length, off));
        }
    }
    // Twice: then without those that lie far off.
    for round in 0..2 {
        if 3 * steps.len() < 2 * count {
            return None;
        }
        let n = steps.len() as f64;
        let mean = steps.iter().sum::<Vector2<f64>>() / n;
        let (sxx, sxy) = steps.iter().fold((0.0, 0.0), |(a, b), s| {
            let d = s - mean;
            (a + d.x * d.x, b + d.x * d.y)
        });
        let slope = sxy / sxx;
        let residual = |s: &Vector2<f64>| s.y - mean.y - slope * (s.x - mean.x);
        let spread = (steps.iter().map(|s| residual(s).powi(2)).sum::<f64>() / (n - 2.0).max(1.0)).sqrt();
        if round == 0 {
            let limit = (2.5 * spread).max(0.1);
            steps.retain(|s| residual(s).abs() <= limit);
        } else {
            let at = from + along * mean.x + inward * mean.y;
            let along = (along + inward * slope).normalize();
            // Of a line of n points its end is known to twice what its middle is.
            return Some(Line { at, along, deviation: 2.0 * spread / n.sqrt() });
        }
    }
    None
}

/// How far along `inward` from a place the picture turns from white to black: the steepest fall within `reach`, to a fraction of a pixel. `least_fall`: over a pixel;
/// less is no edge.
fn step(
    view: ImageView<'_, f32, 1>,
    at: Point2<f64>,
    inward: Vector2<f64>,
    (reach, least_fall): (f64, f32),
) -> Option<f64> {
    const STEP: f64 = 0.5;
    let n = (reach / STEP).ceil() as i32 + 2;
    let mut values = Vec::with_capacity(2 * n as usize + 1);
    for i in -n..=n {
        let p = at + inward * (f64::from(i) * STEP);
        let [v] = sample_bilinear(view, p.x, p.y)?;
        values.push(v);
    }
    // Differences over a pixel.
    let falls: Vec<f32> = values.windows(3).map(|v| v[0] - v[2]).collect();
    let inner = 2..falls.len().saturating_sub(2);
    let steepest = inner.max_by(|a, b| falls[*a].total_cmp(&falls[*b]))?;
    if falls[steepest] < least_fall {
        return None;
    }
    let (mut sum, mut weight) = (0.0, 0.0);
    for (i, fall) in falls.iter().enumerate().skip(steepest - 2).take(5) {
        let w = f64::from(fall.max(0.0));
        sum += w * (f64::from(i as i32 + 1 - n) * STEP);
        weight += w;
    }
    Some(sum / weight)
}

/// A corner of a marker, where its two sides meet: each by its half next to the corner, since a lens bends a whole side more, and without the end, where blur rounds it.
/// `blur`: pixels that are left out. With its standard deviation along either axis.
///
/// `light`: the picture in linear light. Blur mixes light, so that an edge is symmetric there alone: the curve of sRGB makes the mixed pixels brighter, which moves each edge
/// toward black by a fifth of a pixel and more.
pub(super) fn marker_corner(
    light: ImageView<'_, f32, 1>,
    quad: &[Point2<f64>; 4],
    k: usize,
    blur: f64,
) -> Option<(Point2<f64>, f64)> {
    let (before, here, after) = (quad[(k + 3) % 4], quad[k], quad[(k + 1) % 4]);
    let rounded = |a: Point2<f64>, b: Point2<f64>| (blur / (a - b).norm()).min(0.3);
    let (p, q) = (rounded(before, here), rounded(here, after));
    let into = side(light, before, here, (0.45, 1.0 - p), (2.0, LEAST_FALL_OF_LIGHT))?;
    let out = side(light, here, after, (q, 0.55), (2.0, LEAST_FALL_OF_LIGHT))?;
    let at = meet(into.at, into.along, out.at, out.along)?;
    // The sampling of sharp edges adds a fiftieth of a pixel.
    Some((at, (0.5 * (into.deviation.powi(2) + out.deviation.powi(2))).sqrt().hypot(0.02)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Matrix3, Silent, Vector3};

    /// Black within a quadrilateral by a homography from the unit square, white outside, sixteen samples to a pixel.
    fn picture(map: &Matrix3<f64>, (w, h): (usize, usize)) -> GrayF32 {
        let back = map.try_inverse().unwrap();
        GrayF32::from_fn(w, h, |x, y| {
            let black = (0..16)
                .filter(|k| {
                    let p = back
                        * Vector3::new(
                            x as f64 + f64::from(k % 4) / 4.0 - 0.375,
                            y as f64 + f64::from(k / 4) / 4.0 - 0.375,
                            1.0,
                        );
                    let inside = |v: f64| (0.0..1.0).contains(&(v / p.z));
                    inside(p.x) && inside(p.y)
                })
                .count();
            [0.9 - 0.8 * black as f32 / 16.0]
        })
    }

    #[test]
    fn corners_of_a_black_quadrilateral_are_exact() {
        for (size, turn) in [(14.0, 0.0), (18.0, 0.7), (90.0, 0.3), (700.0, 1.1)] {
            let (sin, cos) = f64::sin_cos(turn);
            let map = Matrix3::new(
                size * cos,
                -size * sin,
                0.9 * size + 8.0,
                size * sin,
                0.8 * size * cos,
                0.3 * size + 9.0,
                0.1,
                -0.15,
                1.0,
            );
            let side = (2.4 * size) as usize + 20;
            let image = picture(&map, (side, side));
            let stage = Stage::new(&Silent, "quads", 0).unwrap();
            let found = quads(image.view(), 0.03, &stage).unwrap();
            assert_eq!(found.len(), 1, "{size} {turn}");
            for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                let p = map * Vector3::new(u, v, 1.0);
                let truth = Point2::new(p.x / p.z, p.y / p.z);
                let off = (0..4).map(|k| (found[0][k] - truth).norm()).fold(f64::INFINITY, f64::min);
                // An edge of full contrast without blur, sampled between pixels: steps of a fifth of a pixel, fewer of them on a short side.
                assert!(off < if size < 20.0 { 0.3 } else { 0.1 }, "{size} {turn}: {off}");
                let k = (0..4).min_by(|a, b| (found[0][*a] - truth).norm().total_cmp(&(found[0][*b] - truth).norm()));
                let (fine, deviation) = marker_corner(image.view(), &found[0], k.unwrap(), 2.5).unwrap();
                assert!((fine - truth).norm() < 0.3 && (0.02..0.3).contains(&deviation), "{size}: {fine} {truth}");
            }
        }
    }

    #[test]
    fn what_is_no_quadrilateral_is_left_alone() {
        let disc = GrayF32::from_fn(120, 120, |x, y| {
            let inside = (x as f64 - 60.0).hypot(y as f64 - 60.0) < 40.0;
            [if inside { 0.1 } else { 0.9 }]
        });
        let stage = Stage::new(&Silent, "quads", 0).unwrap();
        // A disc has four fifths of the square around it.
        assert!(quads(disc.view(), 0.03, &stage).unwrap().is_empty());
        let flat = GrayF32::new(64, 64, [0.4]);
        assert!(quads(flat.view(), 0.03, &stage).unwrap().is_empty());
    }
}
