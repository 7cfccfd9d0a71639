//! X-corners: places where two black and two white squares meet.
//!
//! Source: S. Bennett & J. Lasenby, "ChESS: quick and robust detection of chess-board features", CVIU 118, 2014. Sixteen samples on a
//! circle: sums of opposite samples differ by a quarter turn at an X-corner, opposite samples differ at an edge, and the circle's mean differs from the middle's on a line.
//! Here on several octaves of a pyramid. What passes is looked at once more: around it the circle must change between black and white exactly four times, at two
//! pairs of opposite places, which are the two edges.

use crate::line_buffer::LineBuffer;
use crate::simd;
use cv_core::{Cancelled, GrayF32, ImageView, Point2, Progress, Stage};
use cv_imgproc::{mirror_ends, mirror_index, pyr_down};
use fearless_simd::{Level, dispatch, prelude::*};
use rayon::prelude::*;

/// The circle: 16 samples, clockwise on screen from the top. The paper's has a radius of 5; on a pyramid a smaller one does, which has room in small squares.
const RING: [(isize, isize); 16] = [
    (0, -3),
    (1, -3),
    (2, -2),
    (3, -1),
    (3, 0),
    (3, 1),
    (2, 2),
    (1, 3),
    (0, 3),
    (-1, 3),
    (-2, 2),
    (-3, 1),
    (-3, 0),
    (-3, -1),
    (-2, -2),
    (-1, -3),
];
/// How far it reaches.
const R: usize = 3;
/// The middle.
const MIDDLE: [(isize, isize); 5] = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)];

/// Least share of the response of an ideal corner of the same contrast. One that is tilted by 60° keeps half, noise and blur take some more.
const SHAPE: f32 = 0.2;

/// Most candidates of one octave: the strongest are kept. A board of 200×200 is too much for one picture anyway; what counts is that a picture of gravel
/// takes no longer than this.
const MOST: usize = 4000;

/// A place that looks like an X-corner.
#[derive(Debug, Clone, Copy)]
pub(crate) struct XCorner {
    /// Position in pixels of the picture, to about half a pixel of its octave.
    pub(crate) position: Point2<f64>,
    /// Directions of the two edges, radians clockwise on screen from +x: the first in [0, π), the second within π beyond it. Between the first and the second
    /// lies white.
    pub(crate) axes: [f64; 2],
    /// White less black, in the unit of the picture.
    pub(crate) contrast: f32,
    /// Radius of the circle it was seen with, in pixels of the picture.
    pub(crate) radius: f64,
}

/// The X-corners of a picture, of all octaves, each place once, and the picture a little smoothed.
pub(crate) fn x_corners(
    view: ImageView<'_, f32, 1>,
    least_contrast: f32,
    progress: &dyn Progress,
) -> Result<(Vec<XCorner>, GrayF32), Cancelled> {
    let level = simd::level();
    let smooth = smoothed(view, level);
    let mut found = octave(&smooth, 1.0, least_contrast, progress)?;
    let mut image = pyr_down(view);
    for scale in [2.0, 4.0, 8.0, 16.0] {
        // Below this a board has no room beside its circles.
        if image.width().min(image.height()) < 30 {
            break;
        }
        found.extend(octave(&image, scale, least_contrast, progress)?);
        image = pyr_down(image.view());
    }
    Ok((each_once(found), smooth))
}

/// `[1 2 1]/4` both ways.
pub(super) fn smoothed(view: ImageView<'_, f32, 1>, level: Level) -> GrayF32 {
    let (w, h) = view.size();
    let mut out = GrayF32::new(w, h, [0.0]);
    let kernel = [0.5, 0.25];
    out.as_mut_slice().par_chunks_mut(w).enumerate().with_min_len(32).for_each_init(
        || vec![0.0f32; w + 2],
        |padded, (y, row)| {
            let rows = [-1, 0, 1].map(|d| view.row(mirror_index(y as isize + d, h)));
            simd::vertical(level, &mut padded[1..=w], &rows, &kernel);
            mirror_ends::<1>(padded, 1, 1);
            simd::horizontal(level, row, padded, &kernel);
        },
    );
    out
}

/// Peaks that are looked at without asking whether to go on: some milliseconds.
const UNASKED: usize = 512;

/// The candidates of one octave.
fn octave(
    image: &GrayF32,
    scale: f64,
    least_contrast: f32,
    progress: &dyn Progress,
) -> Result<Vec<XCorner>, Cancelled> {
    let (w, h) = image.size();
    if w <= 2 * R + 4 || h <= 2 * R + 4 {
        return Ok(Vec::new());
    }
    let level = simd::level();
    // Of an ideal corner the response is eight times the contrast; a strongly tilted or blurred one keeps about a third of it.
    let floor = 8.0 * 0.3 * least_contrast.max(1e-4);
    let (first, last) = (R, h - R);
    let rows = (last - first).div_ceil(4 * rayon::current_num_threads()).max(48);
    let stage = Stage::new(progress, "corners", (last - first).div_ceil(rows))?;
    let mut found: Vec<(f32, XCorner)> = (0..(last - first).div_ceil(rows))
        .into_par_iter()
        .map(|i| {
            stage.add(1)?;
            let (from, to) = (first + i * rows, (first + (i + 1) * rows).min(last));
            let looked = |&(x, y, dx, dy, response): &(usize, usize, f32, f32, f32)| {
                let corner = looked_at(image, (x, y), (dx, dy), scale)?;
                let fits = corner.contrast >= least_contrast && response >= 8.0 * SHAPE * corner.contrast;
                fits.then_some((response, corner))
            };
            let mut found = Vec::new();
            // Of noise, a strip has tens of thousands.
            for peaks in strip(image, from..to, floor, level).chunks(UNASKED) {
                stage.check()?;
                found.extend(peaks.iter().filter_map(looked));
            }
            Ok(found)
        })
        .collect::<Result<Vec<_>, Cancelled>>()?
        .concat();
    if found.len() > MOST {
        found.sort_by(|a, b| b.0.total_cmp(&a.0));
        found.truncate(MOST);
    }
    Ok(found.into_iter().map(|f| f.1).collect())
}

/// Peaks of the response in some rows: column, row, offset to the peak between pixels, response.
fn strip(
    image: &GrayF32,
    rows: std::ops::Range<usize>,
    floor: f32,
    level: Level,
) -> Vec<(usize, usize, f32, f32, f32)> {
    let (w, h) = image.size();
    let mut ring_rows = LineBuffer::new(0..w - 2 * R, 3);
    let (mut columns, mut found) = (Vec::new(), Vec::new());
    let (first, last) = (rows.start.saturating_sub(1).max(R), (rows.end + 1).min(h - R));
    for y in first..last {
        let around: [&[f32]; 2 * R + 1] = std::array::from_fn(|i| image.row(y + i - R));
        respond(level, around, ring_rows.row_mut(y));
        if y < first + 2 {
            continue;
        }
        let [above, here, below] = [y - 2, y - 1, y].map(|y| ring_rows.row(y));
        columns.clear();
        simd::peaks(level, [above, here, below], floor, &mut columns);
        for &x in &columns {
            let v = here[x];
            if v > above[x - 1] && v > above[x] && v > above[x + 1] && v > here[x - 1] {
                let (dx, dy) = crate::harris::quadratic_peak([above, here, below].map(|r| [r[x - 1], r[x], r[x + 1]]));
                found.push((x + R, y - 1, dx, dy, v));
            }
        }
    }
    found
}

/// The response of a row: seven rows of the image, the middle one its own; `out` begins at column 3.
fn respond(level: Level, rows: [&[f32]; 2 * R + 1], out: &mut [f32]) {
    dispatch!(level, simd => respond_impl(simd, rows, out));
}

#[inline(always)]
fn respond_impl<S: Simd>(simd: S, rows: [&[f32]; 2 * R + 1], out: &mut [f32]) {
    let n = S::f32s::LEN;
    let width = out.len();
    // Each sample's row, cut so that index x is its value for out[x].
    let mut samples: [&[f32]; 21] = [&[]; 21];
    for (sample, &(dx, dy)) in samples.iter_mut().zip(RING.iter().chain(&MIDDLE)) {
        *sample = &rows[(R as isize + dy) as usize][(R as isize + dx) as usize..][..width];
    }
    if width < n {
        for x in 0..width {
            out[x] = response_at(std::array::from_fn(|i| samples[i][x]));
        }
        return;
    }
    let zero = S::f32s::splat(simd, 0.0);
    let mut x = 0;
    while x < width {
        // The last vector overlaps the one before.
        x = x.min(width - n);
        let (mut sum, mut difference, mut mean) = (zero, zero, zero);
        for i in 0..4 {
            let a = S::f32s::from_slice(simd, &samples[i][x..x + n]);
            let b = S::f32s::from_slice(simd, &samples[i + 4][x..x + n]);
            let c = S::f32s::from_slice(simd, &samples[i + 8][x..x + n]);
            let d = S::f32s::from_slice(simd, &samples[i + 12][x..x + n]);
            let (one, other, across, down) = (a + c, b + d, a - c, b - d);
            let turned = one - other;
            sum += turned.max(zero - turned);
            mean += one + other;
            difference += across.max(zero - across) + down.max(zero - down);
        }
        let mut local = S::f32s::from_slice(simd, &samples[16][x..x + n]);
        for sample in &samples[17..] {
            local += S::f32s::from_slice(simd, &sample[x..x + n]);
        }
        let off = mean - local * 3.2;
        let response = sum - difference - off.max(zero - off);
        response.store_slice(&mut out[x..x + n]);
        x += n;
    }
}

/// The response from the sixteen samples of the circle and the five of the middle, as the vector loop sums them.
fn response_at(v: [f32; 21]) -> f32 {
    let (mut sum, mut difference, mut mean) = (0.0f32, 0.0f32, 0.0f32);
    for i in 0..4 {
        let [a, b, c, d] = [v[i], v[i + 4], v[i + 8], v[i + 12]];
        let (one, other) = (a + c, b + d);
        sum += (one - other).abs();
        mean += one + other;
        difference += (a - c).abs() + (b - d).abs();
    }
    let local = (((v[16] + v[17]) + v[18]) + v[19]) + v[20];
    sum - difference - (mean - local * 3.2).abs()
}

/// The corner at a peak of the response, where the circle around it shows two straight edges.
fn looked_at(image: &GrayF32, (x, y): (usize, usize), (dx, dy): (f32, f32), scale: f64) -> Option<XCorner> {
    let values = RING.map(|(i, j)| image.at((x as isize + i) as usize, (y as isize + j) as usize)[0]);
    let angle = |k: usize| (RING[k].1 as f64 - f64::from(dy)).atan2(RING[k].0 as f64 - f64::from(dx));
    let (axes, contrast) = edges(&values, angle)?;
    Some(XCorner {
        position: Point2::new(x as f64 + f64::from(dx), y as f64 + f64::from(dy)) * scale,
        axes,
        contrast,
        radius: R as f64 * scale,
    })
}

/// The directions of two edges through the middle of a circle of samples, and the difference between white and black: where the samples pass the level between
/// them exactly four times, and opposite places are opposite. `angle` of a sample; it rises along the circle.
pub(crate) fn edges(values: &[f32; 16], angle: impl Fn(usize) -> f64) -> Option<([f64; 2], f32)> {
    use std::f64::consts::{PI, TAU};
    let (mut low, mut high) = (f32::INFINITY, f32::NEG_INFINITY);
    for i in 0..16 {
        // Means of three, which a single wild sample does not decide.
        let mean = (values[i] + values[(i + 1) & 15] + values[(i + 15) & 15]) * (1.0 / 3.0);
        (low, high) = (low.min(mean), high.max(mean));
    }
    let level = 0.5 * (low + high);
    let mut crossings = [(0usize, 0.0f32); 4];
    let mut count = 0;
    for i in 0..16 {
        let (a, b) = (values[i] - level, values[(i + 1) & 15] - level);
        if (a < 0.0) != (b < 0.0) {
            if count == 4 {
                return None;
            }
            crossings[count] = (i, a / (a - b));
            count += 1;
        }
    }
    if count != 4 {
        return None;
    }
    let rising = values[crossings[0].0] < level;
    let crossings = crossings.map(|(i, part)| {
        let (a, b) = (angle(i), angle((i + 1) & 15));
        a + (b - a).rem_euclid(TAU) * f64::from(part)
    });
    // Opposite crossings: half a turn apart but for what the middle is off. 40° is half a pixel off in a circle of three, blurred, and some.
    let opposite = |a: f64, b: f64| ((b - a).rem_euclid(TAU) - PI).abs() < 0.7;
    if !opposite(crossings[0], crossings[2]) || !opposite(crossings[1], crossings[3]) {
        return None;
    }
    let axis = |i: usize| {
        let (a, b) = (crossings[i], crossings[i + 2]);
        (a + 0.5 * ((b - a).rem_euclid(TAU) - PI)).rem_euclid(PI)
    };
    // From black to white with rising angle comes first.
    let (a, b) = if rising { (axis(0), axis(1)) } else { (axis(1), axis(0)) };
    let b = if b < a { b + PI } else { b };
    // Edges that nearly coincide are a line.
    (0.2..PI - 0.2).contains(&(b - a)).then_some(([a, b], high - low))
}

/// Of corners of several octaves at one place the one with the largest contrast; a finer octave, which knows the place better, has an advantage.
fn each_once(mut found: Vec<XCorner>) -> Vec<XCorner> {
    // 15 % for each octave.
    let worth = |c: &XCorner| c.contrast * (c.radius as f32).powf(-0.23);
    found.sort_by(|a, b| {
        let by = worth(b).total_cmp(&worth(a)).then(a.position.y.total_cmp(&b.position.y));
        by.then(a.position.x.total_cmp(&b.position.x))
    });
    let mut kept: Vec<XCorner> = Vec::new();
    let mut cells: std::collections::HashMap<(i64, i64), Vec<usize>> = std::collections::HashMap::new();
    const CELL: f64 = 24.0;
    for corner in found {
        let cell = |v: f64| (v / CELL).floor() as i64;
        let (x, y) = (cell(corner.position.x), cell(corner.position.y));
        // Squares are larger than the smaller circle; and the larger one's place is not that exact.
        let near = |other: &XCorner| {
            let (small, large) = (other.radius.min(corner.radius), other.radius.max(corner.radius));
            (other.position - corner.position).norm() < (0.6 * small).max(0.12 * large).max(2.0)
        };
        let taken = (y - 1..=y + 1)
            .any(|j| (x - 1..=x + 1).any(|i| cells.get(&(i, j)).is_some_and(|c| c.iter().any(|&k| near(&kept[k])))));
        if !taken {
            cells.entry((x, y)).or_default().push(kept.len());
            kept.push(corner);
        }
    }
    kept
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn every_instruction_set_gives_the_plain_response(width in 1usize..70, seed in any::<u32>()) {
            let mut state = seed | 1;
            let rows: Vec<Vec<f32>> = (0..7)
                .map(|_| {
                    (0..width + 6)
                        .map(|_| {
                            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                            (state >> 8) as f32 / (1 << 24) as f32
                        })
                        .collect()
                })
                .collect();
            let around: [&[f32]; 7] = std::array::from_fn(|i| &rows[i][..]);
            let sample = |(dx, dy): (isize, isize), x: usize| rows[(3 + dy) as usize][(3 + x as isize + dx) as usize];
            let plain: Vec<f32> = (0..width)
                .map(|x| response_at(std::array::from_fn(|i| if i < 16 { sample(RING[i], x) } else { sample(MIDDLE[i - 16], x) })))
                .collect();
            for level in instruction_sets() {
                let mut out = vec![0.0; width];
                respond(level, around, &mut out);
                prop_assert_eq!(&out, &plain, "{:?}", level);
            }
        }
    }

    #[test]
    fn a_crossing_knows_its_edges_and_a_line_is_none() {
        // White between 0.3 and 1.5 radians, clockwise on screen, and opposite.
        let at = |x: usize, y: usize| {
            let angle = (y as f64 - 20.0).atan2(x as f64 - 20.0).rem_euclid(std::f64::consts::PI);
            [if (0.3..1.5).contains(&angle) { 0.8 } else { 0.1 }]
        };
        let image = GrayF32::from_fn(41, 41, at);
        let (found, _) = x_corners(image.view(), 0.03, &Silent).unwrap();
        let best = found.iter().min_by(|a, b| {
            let to = |c: &XCorner| (c.position - Point2::new(20.0, 20.0)).norm();
            to(a).total_cmp(&to(b))
        });
        let best = best.unwrap();
        // Sixteen samples on a circle of three pixels: a fifth of a step of 22°, and the jagged edge as much.
        assert!((best.axes[0] - 0.3).abs() < 0.15 && (best.axes[1] - 1.5).abs() < 0.15, "{best:?}");
        let line = GrayF32::from_fn(41, 41, |x, _| [(x == 20) as u8 as f32]);
        assert!(x_corners(line.view(), 0.03, &Silent).unwrap().0.is_empty());
    }
}
