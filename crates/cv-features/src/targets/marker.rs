//! Sampling the bits of a marker with known position.

use super::dictionary::Dictionary;
use cv_core::{ImageView, Matrix3, Point2, Vector3};
use cv_imgproc::sample_bilinear;

/// The cell layout of a marker.
#[derive(Debug, Clone, Copy)]
pub(super) struct MarkerShape {
    /// Inner cells (bits) along a side.
    pub(super) side: usize,
    /// Width of the black border in cells.
    pub(super) border: usize,
    /// Distance outside the border at which the white level is sampled, relative to the marker's side.
    pub(super) margin: f64,
}

/// Computes the homography from the unit square, corners clockwise from the origin, to four points (P. Heckbert,
/// "Fundamentals of texture mapping and image warping", 1989).
pub(super) fn unit_square_to_image([a, b, c, d]: [Point2<f64>; 4]) -> Option<Matrix3<f64>> {
    let (s, d1, d2) = ((a - b) + (c - d), b - c, d - c);
    let det = d1.perp(&d2);
    let (g, h) = (s.perp(&d2) / det, d1.perp(&s) / det);
    let (ab, ad) = (b - a + b.coords * g, d - a + d.coords * h);
    let map = Matrix3::new(ab.x, ad.x, a.x, ab.y, ad.y, a.y, g, h, 1.0);
    map.iter().all(|v| v.is_finite()).then_some(map)
}

/// Applies a homography to a point.
pub(super) fn apply_homography(map: &Matrix3<f64>, x: f64, y: f64) -> Point2<f64> {
    let p = map * Vector3::new(x, y, 1.0);
    Point2::new(p.x / p.z, p.y / p.z)
}

/// Samples the inner cells of a marker as bits, row by row from the corner `map(0, 0)`, the first in the highest bit; 1
/// is white. `map` is the homography from the unit square to the marker including its border. `None` if the border is
/// not black, or a part is outside the image.
pub(super) fn sample_bits(view: ImageView<'_, f32, 1>, map: &Matrix3<f64>, shape: MarkerShape) -> Option<u64> {
    let n = shape.side + 2 * shape.border;
    let at = |u: f64, v: f64| {
        let p = apply_homography(map, u, v);
        sample_bilinear(view, p.x, p.y).map(|[v]| v)
    };
    // The white level is that of the surrounding paper, the black level that of the border.
    let mut white = 0.0;
    for k in 0..8 {
        let (t, e) = (0.08 + 0.12 * k as f64, shape.margin);
        white += (at(t, -e)? + at(t, 1.0 + e)? + at(-e, t)? + at(1.0 + e, t)?) / 32.0;
    }
    let mut values = Vec::with_capacity(n * n);
    for row in 0..n {
        for column in 0..n {
            let mut sum = 0.0;
            for (du, dv) in (0..9).map(|k| (0.2 * f64::from(k % 3) - 0.2, 0.2 * f64::from(k / 3) - 0.2)) {
                sum += at((column as f64 + 0.5 + du) / n as f64, (row as f64 + 0.5 + dv) / n as f64)?;
            }
            values.push(sum / 9.0);
        }
    }
    let is_border = |i: usize| {
        let inner = shape.border..n - shape.border;
        !(inner.contains(&(i / n)) && inner.contains(&(i % n)))
    };
    let border: Vec<f32> = (0..n * n).filter(|&i| is_border(i)).map(|i| values[i]).collect();
    let black = border.iter().sum::<f32>() / border.len() as f32;
    let threshold = 0.5 * (white + black);
    let white_border_cells = border.iter().filter(|&&v| v > threshold).count();
    if white - black < 0.02 || white_border_cells > 1 {
        return None;
    }
    Some((0..n * n).filter(|&i| !is_border(i)).fold(0, |bits, i| (bits << 1) | u64::from(values[i] > threshold)))
}

/// Mirrors the bits of a marker.
pub(super) fn mirrored(bits: u64, side: usize) -> u64 {
    let at = |row: usize, column: usize| (bits >> (side * side - 1 - (row * side + column))) & 1;
    (0..side * side).fold(0, |out, i| (out << 1) | at(i / side, side - 1 - i % side))
}

/// The largest dictionaries of each family, which contain the others.
const LARGEST_DICTIONARIES: [Dictionary; 5] = [
    Dictionary::AprilTag36h11,
    Dictionary::Aruco6x6x250,
    Dictionary::Aruco5x5x250,
    Dictionary::Aruco4x4x250,
    Dictionary::ArucoOriginal,
];

/// Diagnoses why no marker of `asked` was decoded at the candidate positions: markers of another dictionary, or
/// mirrored ones. `read(i, side)` samples the bits of candidate `i` as a marker with `side` inner cells along a side.
pub(super) fn diagnose(
    candidates: usize,
    asked: Dictionary,
    read: impl Fn(usize, usize) -> Option<u64>,
) -> Option<super::BoardError> {
    // A few candidates decode as markers by chance; a quarter of them do not.
    let is_significant = |markers: usize| markers >= 3 && 4 * markers >= candidates.min(40);
    let count = |dictionary: Dictionary, mirror: bool| {
        let side = dictionary.side();
        let bits = (0..candidates).filter_map(|i| read(i, side));
        let oriented = bits.map(|bits| if mirror { mirrored(bits, side) } else { bits });
        // Without error correction, to avoid false positives.
        oriented.filter(|bits| dictionary.contains_exactly(*bits)).count()
    };
    let markers = count(asked, true);
    if is_significant(markers) {
        return Some(super::BoardError::Mirrored { markers, dictionary: asked });
    }
    let seen = LARGEST_DICTIONARIES.into_iter().map(|d| (count(d, false), d)).max_by_key(|c| c.0)?;
    // Not markers of the requested dictionary in another layout.
    let is_other = seen.0 > 2 * count(asked, false);
    (is_significant(seen.0) && is_other).then_some(super::BoardError::OtherDictionary {
        seen: seen.1,
        markers: seen.0,
        asked,
    })
}
