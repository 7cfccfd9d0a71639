//! Detection of black quadrilaterals on white, the candidates for markers.
//!
//! Adaptive thresholding: a pixel is black if it is below the mean of the local minimum and maximum, tile by tile (E.
//! Olson, "AprilTag: a robust and flexible visual fiducial system", ICRA 2011, and its later versions). The convex hull
//! of each connected component is simplified by removing the side that adds the least area until four are left. Then
//! each side is fitted to the white-to-black edges along it. O(pixels), and quadratic in the vertices of a hull.

use cv_core::{Cancelled, GrayF32, ImageView, Mask, Point2, Stage, Vector2};
use cv_imgproc::{Connectivity, StructuringElement, connected_components, erode, pyr_down, sample_bilinear};
use cv_parallel::prelude::*;

/// Maximum number of pixels for the detection of regions; larger images are downsampled, and the sides are then fitted
/// at full resolution.
const MAX_PIXELS: usize = 3_000_000;
/// Side of a tile in pixels; local extrema are those of 3×3 tiles.
const TILE_SIDE: usize = 8;
/// Minimum side of a region in pixels: cells of a pixel for a marker of 6×6 bits with a border of two.
const MIN_REGION_SIDE: usize = 10;

/// The line of a side: a point, the direction, and the standard deviation of the line at its ends, in pixels.
#[derive(Debug, Clone, Copy)]
struct Line {
    at: Point2<f64>,
    along: Vector2<f64>,
    deviation: f64,
}

/// Detects the quadrilaterals of an image, corners clockwise in the image, accurate to about a tenth of a pixel.
pub(super) fn detect_quads(
    view: ImageView<'_, f32, 1>,
    min_contrast: f32,
    stage: &Stage<'_>,
) -> Result<Vec<[Point2<f64>; 4]>, Cancelled> {
    let mut small: Option<GrayF32> = None;
    let mut scale = 1.0;
    loop {
        let now = small.as_ref().map_or(view, GrayF32::view);
        if now.width() * now.height() <= MAX_PIXELS {
            break;
        }
        small = Some(pyr_down(now));
        scale *= 2.0;
    }
    let image = small.as_ref().map_or(view, GrayF32::view);
    let black = threshold_adaptively(image, min_contrast);
    stage.check()?;
    let mut initial = region_quads(black.view());
    // Again after erosion, which separates markers that touch each other or a black square at a corner.
    let eroded = erode(black.view(), &StructuringElement::square(1));
    stage.check()?;
    initial.extend(region_quads(eroded.view()));
    let refined: Vec<Option<[Point2<f64>; 4]>> = initial
        .par_iter()
        .with_min_len(16)
        .map(|quad| {
            stage.check()?;
            let quad = quad.map(|p| p * scale);
            let Some(lines) = fit_sides(view, &quad, 1.5 + 2.5 * scale) else { return Ok(None) };
            let coarse = intersect_sides(&lines)
                .filter(|coarse| coarse.iter().zip(&quad).all(|(p, q)| (p - q).norm() < 6.0 * scale));
            let Some(coarse) = coarse else { return Ok(None) };
            Ok(fit_sides(view, &coarse, 2.5).and_then(|lines| intersect_sides(&lines)))
        })
        .try_collect::<_, Cancelled>()?;
    let mut out: Vec<[Point2<f64>; 4]> = Vec::new();
    for quad in refined.into_iter().flatten() {
        // Most are in both masks.
        let center = |q: &[Point2<f64>; 4]| Point2::from((q[0].coords + q[1].coords + q[2].coords + q[3].coords) / 4.0);
        let is_duplicate = |other: &[Point2<f64>; 4]| {
            let size = (other[0] - other[2]).norm();
            (center(other) - center(&quad)).norm() < 0.1 * size && ((quad[0] - quad[2]).norm() / size - 1.0).abs() < 0.2
        };
        if !out.iter().any(is_duplicate) {
            out.push(quad);
        }
    }
    Ok(out)
}

/// Marks the pixels below the mean of the local minimum and maximum, where their difference is at least `min_contrast`.
fn threshold_adaptively(image: ImageView<'_, f32, 1>, min_contrast: f32) -> Mask {
    let (w, h) = image.size();
    let (columns, rows) = (w.div_ceil(TILE_SIDE), h.div_ceil(TILE_SIDE));
    let tiles: Vec<(f32, f32)> = (0..rows * columns)
        .into_par_iter()
        .with_min_len(64)
        .map(|t| {
            let (x0, y0) = (t % columns * TILE_SIDE, t / columns * TILE_SIDE);
            let mut range = (f32::INFINITY, f32::NEG_INFINITY);
            for y in y0..(y0 + TILE_SIDE).min(h) {
                for &v in &image.row(y)[x0..(x0 + TILE_SIDE).min(w)] {
                    range = (range.0.min(v), range.1.max(v));
                }
            }
            range
        })
        .collect();
    let thresholds: Vec<f32> = (0..rows * columns)
        .map(|t| {
            let neighborhood = |i: usize, n: usize| i.saturating_sub(1)..=(i + 1).min(n - 1);
            let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
            for j in neighborhood(t / columns, rows) {
                for i in neighborhood(t % columns, columns) {
                    let (l, h) = tiles[j * columns + i];
                    (low, high) = (low.min(l), high.max(h));
                }
            }
            if high - low >= min_contrast { 0.5 * (low + high) } else { f32::NEG_INFINITY }
        })
        .collect();
    Mask::from_fn(w, h, |x, y| [image.at(x, y)[0] < thresholds[y / TILE_SIDE * columns + x / TILE_SIDE]])
}

/// Computes the quadrilaterals around the 4-connected components of a mask, accurate to one or two pixels.
fn region_quads(mask: ImageView<'_, bool, 1>) -> Vec<[Point2<f64>; 4]> {
    let (w, h) = mask.size();
    let components = connected_components(mask, Connectivity::Four);
    let is_candidate: Vec<bool> = components
        .stats
        .iter()
        .map(|s| {
            let inside = s.left > 0 && s.top > 0 && s.left + s.width < w && s.top + s.height < h;
            inside && s.width.min(s.height) >= MIN_REGION_SIDE && s.area >= 2 * (s.width + s.height)
        })
        .collect();
    // Row, first and last column of each region in each of its rows.
    let mut ends: Vec<Vec<[u32; 3]>> = vec![Vec::new(); components.stats.len()];
    for y in 0..h {
        for (x, &label) in components.labels.row(y).iter().enumerate() {
            let Some(i) = (label as usize).checked_sub(1).filter(|i| is_candidate[*i]) else { continue };
            match ends[i].last_mut().filter(|end| end[0] == y as u32) {
                Some(end) => end[2] = x as u32,
                None => ends[i].push([y as u32, x as u32, x as u32]),
            }
        }
    }
    let quads = ends.into_par_iter().with_min_len(16).map(|ends| simplify_to_quad(convex_hull(&ends))).collect();
    quads.into_iter().flatten().collect()
}

/// Returns twice the signed area of a triangle (the orientation predicate).
fn orientation(a: Point2<f64>, b: Point2<f64>, c: Point2<f64>) -> f64 {
    (b - a).perp(&(c - b))
}

/// Computes the convex hull of rows of pixels, clockwise in the image (A. M. Andrew's monotone chain, 1979).
fn convex_hull(ends: &[[u32; 3]]) -> Vec<Point2<f64>> {
    let chain = |points: &mut dyn Iterator<Item = Point2<f64>>| {
        let mut out: Vec<Point2<f64>> = Vec::new();
        for p in points {
            while out.len() > 1 && orientation(out[out.len() - 2], out[out.len() - 1], p) <= 0.0 {
                out.pop();
            }
            out.push(p);
        }
        out
    };
    let at = |x: u32, y: u32| Point2::new(f64::from(x), f64::from(y));
    // Downwards along the right ends, upwards along the left ends.
    let mut all = chain(&mut ends.iter().map(|e| at(e[2], e[0])));
    all.extend(chain(&mut ends.iter().rev().map(|e| at(e[1], e[0]))));
    all.dedup();
    if all.first() == all.last() {
        all.pop();
    }
    all
}

/// Computes the signed area of a polygon.
fn area(polygon: &[Point2<f64>]) -> f64 {
    let n = polygon.len();
    (0..n).map(|i| polygon[i].coords.perp(&polygon[(i + 1) % n].coords)).sum::<f64>() / 2.0
}

/// Intersects two lines; `None` if they are nearly parallel.
fn intersect_lines(
    a: Point2<f64>,
    along_a: Vector2<f64>,
    b: Point2<f64>,
    along_b: Vector2<f64>,
) -> Option<Point2<f64>> {
    let det = along_a.perp(&along_b);
    let p = a + along_a * ((b - a).perp(&along_b) / det);
    (det.abs() > 1e-3 * along_a.norm() * along_b.norm() && p.x.is_finite() && p.y.is_finite()).then_some(p)
}

/// Simplifies a convex polygon to a circumscribed quadrilateral; `None` if it is not nearly one.
fn simplify_to_quad(mut polygon: Vec<Point2<f64>>) -> Option<[Point2<f64>; 4]> {
    let hull_area = area(&polygon);
    while polygon.len() > 4 {
        let n = polygon.len();
        let mut best: Option<(f64, usize, Point2<f64>)> = None;
        for i in 0..n {
            let (a, b, c, d) = (polygon[(i + n - 1) % n], polygon[i], polygon[(i + 1) % n], polygon[(i + 2) % n]);
            // Remove the side from b to c: extend its neighbors to their intersection.
            let (Some(p), true) = (intersect_lines(a, b - a, c, d - c), (b - a).perp(&(d - c)) > 0.0) else { continue };
            let added = orientation(b, p, c).abs() / 2.0;
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
    // A marker at a tilt of 80° has an aspect ratio of six. Erosion and blur at the corners reduce the hull of small
    // ones by at most an eighth.
    (short >= 6.0 && long < 8.0 * short && hull_area > 0.8 * area(&quad)).then_some(quad)
}

/// Fits the lines of the four sides to the edges from white (outside) to black within `radius` pixels; `None` if a side
/// has none.
fn fit_sides(view: ImageView<'_, f32, 1>, quad: &[Point2<f64>; 4], radius: f64) -> Option<[Line; 4]> {
    let mut out = [Line { at: quad[0], along: Vector2::zeros(), deviation: 0.0 }; 4];
    for (k, line) in out.iter_mut().enumerate() {
        *line = fit_side(view, quad[k], quad[(k + 1) % 4], (0.1, 0.9), (radius, MIN_EDGE_SLOPE))?;
    }
    Some(out)
}

/// Intersects the lines of adjacent sides.
fn intersect_sides(lines: &[Line; 4]) -> Option<[Point2<f64>; 4]> {
    let corner = |k: usize| {
        let (a, b) = (&lines[(k + 3) % 4], &lines[k]);
        intersect_lines(a.at, a.along, b.at, b.along)
    };
    Some([corner(0)?, corner(1)?, corner(2)?, corner(3)?])
}

/// Minimum decrease of intensity per pixel at an edge, in sRGB; and in linear intensity, in which dark grays are closer
/// together.
const MIN_EDGE_SLOPE: f32 = 0.02;
const MIN_LINEAR_EDGE_SLOPE: f32 = 0.002;

/// Fits a line to the white-to-black edges between the fractions `first` and `last` of the side from one corner to the
/// next, clockwise around black.
fn fit_side(
    view: ImageView<'_, f32, 1>,
    from: Point2<f64>,
    to: Point2<f64>,
    (first, last): (f64, f64),
    (radius, min_slope): (f64, f32),
) -> Option<Line> {
    let length = (to - from).norm();
    if !(length > 4.0 && length.is_finite()) {
        return None;
    }
    let along = (to - from) / length;
    // The inward normal.
    let inward = Vector2::new(-along.y, along.x);
    let count = ((length * (last - first)).round() as usize).clamp(5, 60);
    let mut edge_points: Vec<Vector2<f64>> = Vec::with_capacity(count);
    for i in 0..count {
        let t = first + (last - first) * (i as f64 + 0.5) / count as f64;
        if let Some(offset) = locate_edge(view, from + along * (t * length), inward, (radius, min_slope)) {
            edge_points.push(Vector2::new(t * length, offset));
        }
    }
    // The second fit is without outliers.
    for round in 0..2 {
        if 3 * edge_points.len() < 2 * count {
            return None;
        }
        let n = edge_points.len() as f64;
        let mean = edge_points.iter().sum::<Vector2<f64>>() / n;
        let (sxx, sxy) = edge_points.iter().fold((0.0, 0.0), |(a, b), s| {
            let d = s - mean;
            (a + d.x * d.x, b + d.x * d.y)
        });
        let slope = sxy / sxx;
        let residual = |s: &Vector2<f64>| s.y - mean.y - slope * (s.x - mean.x);
        let sigma = (edge_points.iter().map(|s| residual(s).powi(2)).sum::<f64>() / (n - 2.0).max(1.0)).sqrt();
        if round == 0 {
            let limit = (2.5 * sigma).max(0.1);
            edge_points.retain(|s| residual(s).abs() <= limit);
        } else {
            let at = from + along * mean.x + inward * mean.y;
            let along = (along + inward * slope).normalize();
            // The standard deviation at the end of a line of n points is twice that at its center.
            return Some(Line { at, along, deviation: 2.0 * sigma / n.sqrt() });
        }
    }
    None
}

/// Locates the white-to-black edge along `inward` with sub-pixel accuracy: the maximum decrease within `radius`; `None`
/// if it is below `min_slope` per pixel.
fn locate_edge(
    view: ImageView<'_, f32, 1>,
    at: Point2<f64>,
    inward: Vector2<f64>,
    (radius, min_slope): (f64, f32),
) -> Option<f64> {
    const STEP: f64 = 0.5;
    let n = (radius / STEP).ceil() as i32 + 2;
    let mut values = Vec::with_capacity(2 * n as usize + 1);
    for i in -n..=n {
        let p = at + inward * (f64::from(i) * STEP);
        let [v] = sample_bilinear(view, p.x, p.y)?;
        values.push(v);
    }
    // Decreases over a pixel.
    let slopes: Vec<f32> = values.windows(3).map(|v| v[0] - v[2]).collect();
    let inner = 2..slopes.len().saturating_sub(2);
    let steepest = inner.max_by(|a, b| slopes[*a].total_cmp(&slopes[*b]))?;
    if slopes[steepest] < min_slope {
        return None;
    }
    let (mut sum, mut weight) = (0.0, 0.0);
    for (i, slope) in slopes.iter().enumerate().skip(steepest - 2).take(5) {
        let w = f64::from(slope.max(0.0));
        sum += w * (f64::from(i as i32 + 1 - n) * STEP);
        weight += w;
    }
    Some(sum / weight)
}

/// Refines a marker corner as the intersection of its two sides, and estimates its standard deviation along either
/// axis. Each side is fitted on its half next to the corner, to reduce the effect of lens distortion, except the last
/// `blur` pixels, where blur rounds the corner.
///
/// `linear` is the image in linear intensity, in which blur is symmetric. In sRGB, mixed pixels are brighter, which
/// shifts each edge toward black by a fifth of a pixel or more.
pub(super) fn refine_marker_corner(
    linear: ImageView<'_, f32, 1>,
    quad: &[Point2<f64>; 4],
    k: usize,
    blur: f64,
) -> Option<(Point2<f64>, f64)> {
    let (before, here, after) = (quad[(k + 3) % 4], quad[k], quad[(k + 1) % 4]);
    let excluded = |a: Point2<f64>, b: Point2<f64>| (blur / (a - b).norm()).min(0.3);
    let (p, q) = (excluded(before, here), excluded(here, after));
    let into = fit_side(linear, before, here, (0.45, 1.0 - p), (2.0, MIN_LINEAR_EDGE_SLOPE))?;
    let out = fit_side(linear, here, after, (q, 0.55), (2.0, MIN_LINEAR_EDGE_SLOPE))?;
    let at = intersect_lines(into.at, into.along, out.at, out.along)?;
    // Aliasing of sharp edges adds 0.02 px.
    Some((at, (0.5 * (into.deviation.powi(2) + out.deviation.powi(2))).sqrt().hypot(0.02)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Matrix3, Silent, Vector3};

    /// Renders a black quadrilateral on white by a homography from the unit square, with 4×4 samples per pixel.
    fn render(map: &Matrix3<f64>, (w, h): (usize, usize)) -> GrayF32 {
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
    fn corners_of_a_black_quadrilateral_are_accurate() {
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
            let image = render(&map, (side, side));
            let stage = Stage::new(&Silent, "quads", 0).unwrap();
            let found = detect_quads(image.view(), 0.03, &stage).unwrap();
            assert_eq!(found.len(), 1, "{size} {turn}");
            for (u, v) in [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)] {
                let p = map * Vector3::new(u, v, 1.0);
                let truth = Point2::new(p.x / p.z, p.y / p.z);
                let off = (0..4).map(|k| (found[0][k] - truth).norm()).fold(f64::INFINITY, f64::min);
                // An edge without blur, with aliasing of a fifth of a pixel, and fewer samples on a short side.
                assert!(off < if size < 20.0 { 0.3 } else { 0.1 }, "{size} {turn}: {off}");
                let k = (0..4).min_by(|a, b| (found[0][*a] - truth).norm().total_cmp(&(found[0][*b] - truth).norm()));
                let (fine, deviation) = refine_marker_corner(image.view(), &found[0], k.unwrap(), 2.5).unwrap();
                assert!((fine - truth).norm() < 0.3 && (0.02..0.3).contains(&deviation), "{size}: {fine} {truth}");
            }
        }
    }

    #[test]
    fn discs_and_flat_images_have_no_quadrilaterals() {
        let disc = GrayF32::from_fn(120, 120, |x, y| {
            let inside = (x as f64 - 60.0).hypot(y as f64 - 60.0) < 40.0;
            [if inside { 0.1 } else { 0.9 }]
        });
        let stage = Stage::new(&Silent, "quads", 0).unwrap();
        // The area of a disc is 0.785 of its circumscribed square.
        assert!(detect_quads(disc.view(), 0.03, &stage).unwrap().is_empty());
        let flat = GrayF32::new(64, 64, [0.4]);
        assert!(detect_quads(flat.view(), 0.03, &stage).unwrap().is_empty());
    }
}
