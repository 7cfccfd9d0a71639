//! Reading a marker whose place in the picture is known.

use super::dictionary::Dictionary;
use cv_core::{ImageView, Matrix3, Point2, Vector3};
use cv_imgproc::sample_bilinear;

/// How a marker is made.
#[derive(Debug, Clone, Copy)]
pub(super) struct MarkerShape {
    /// Inner cells along a side.
    pub(super) side: usize,
    /// Cells of its black frame.
    pub(super) frame: usize,
    /// How far outside its frame the paper is looked at, in sides of the marker.
    pub(super) rim: f64,
}

/// The homography from the unit square, corners clockwise from the origin, to four points (P. Heckbert, "Fundamentals of texture mapping and image warping", 1989).
pub(super) fn square_to_picture([a, b, c, d]: [Point2<f64>; 4]) -> Option<Matrix3<f64>> {
    let (s, d1, d2) = ((a - b) + (c - d), b - c, d - c);
    let det = d1.perp(&d2);
    let (g, h) = (s.perp(&d2) / det, d1.perp(&s) / det);
    let (ab, ad) = (b - a + b.coords * g, d - a + d.coords * h);
    let map = Matrix3::new(ab.x, ad.x, a.x, ab.y, ad.y, a.y, g, h, 1.0);
    map.iter().all(|v| v.is_finite()).then_some(map)
}

/// Where a homography takes a point.
pub(super) fn mapped(map: &Matrix3<f64>, x: f64, y: f64) -> Point2<f64> {
    let p = map * Vector3::new(x, y, 1.0);
    Point2::new(p.x / p.z, p.y / p.z)
}

/// The inner cells of a marker as bits, row by row from the corner that `map` takes (0, 0) to, the first in the highest bit; 1 is white. `map` takes the unit square to
/// the marker with its frame. `None` where that is no marker: its frame is not black, or a part is outside the picture.
pub(super) fn read_bits(view: ImageView<'_, f32, 1>, map: &Matrix3<f64>, shape: MarkerShape) -> Option<u64> {
    let n = shape.side + 2 * shape.frame;
    let at = |u: f64, v: f64| {
        let p = mapped(map, u, v);
        sample_bilinear(view, p.x, p.y).map(|[v]| v)
    };
    // White is that of the paper around, black that of the frame.
    let mut white = 0.0;
    for k in 0..8 {
        let (t, e) = (0.08 + 0.12 * k as f64, shape.rim);
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
    let on_frame = |i: usize| {
        let inner = shape.frame..n - shape.frame;
        !(inner.contains(&(i / n)) && inner.contains(&(i % n)))
    };
    let frame: Vec<f32> = (0..n * n).filter(|&i| on_frame(i)).map(|i| values[i]).collect();
    let black = frame.iter().sum::<f32>() / frame.len() as f32;
    let level = 0.5 * (white + black);
    let lit = frame.iter().filter(|&&v| v > level).count();
    if white - black < 0.02 || lit > 1 {
        return None;
    }
    Some((0..n * n).filter(|&i| !on_frame(i)).fold(0, |bits, i| (bits << 1) | u64::from(values[i] > level)))
}

/// The inner cells of the marker's mirror image.
pub(super) fn mirrored(bits: u64, side: usize) -> u64 {
    let at = |row: usize, column: usize| (bits >> (side * side - 1 - (row * side + column))) & 1;
    (0..side * side).fold(0, |out, i| (out << 1) | at(i / side, side - 1 - i % side))
}

/// The dictionaries that hold all others of their kind.
const LARGEST: [Dictionary; 5] = [
    Dictionary::AprilTag36h11,
    Dictionary::Aruco6x6x250,
    Dictionary::Aruco5x5x250,
    Dictionary::Aruco4x4x250,
    Dictionary::ArucoOriginal,
];

/// What else is in the places where markers were looked for and none of `asked` was found: another dictionary, or the mirror images. `read` gives the bits in
/// place `i` as those of a marker with so many inner cells along a side.
pub(super) fn what_else(
    places: usize,
    asked: Dictionary,
    read: impl Fn(usize, usize) -> Option<u64>,
) -> Option<super::BoardError> {
    // By chance one place or another reads as a marker; a quarter of them do not.
    let enough = |markers: usize| markers >= 3 && 4 * markers >= places.min(40);
    let count = |dictionary: Dictionary, mirror: bool| {
        let side = dictionary.side();
        let bits = (0..places).filter_map(|i| read(i, side));
        let turned = bits.map(|bits| if mirror { mirrored(bits, side) } else { bits });
        // Without a wrong bit: nobody asked for this one.
        turned.filter(|bits| dictionary.read_exactly(*bits)).count()
    };
    let markers = count(asked, true);
    if enough(markers) {
        return Some(super::BoardError::Mirrored { markers, dictionary: asked });
    }
    let seen = LARGEST.into_iter().map(|d| (count(d, false), d)).max_by_key(|c| c.0)?;
    // Markers of the board that do not lie as on it are not those of another dictionary.
    let other = seen.0 > 2 * count(asked, false);
    (enough(seen.0) && other).then_some(super::BoardError::OtherDictionary { seen: seen.1, markers: seen.0, asked })
}
