//! Disparities for pixels that have none of their own (Hirschmüller, "Stereo processing by semiglobal matching and
//! mutual information", PAMI 2008, section 2.6.4).

use crate::PixelState;
use cv_core::{Cancelled, Stage};
use fearless_simd::{Level, dispatch, prelude::*};
use fearless_simd_macros::simd;
use rayon::prelude::*;

/// Memory of [`fill_holes`], kept between frames.
#[derive(Debug, Default)]
pub(crate) struct Holes {
    /// What each hole sees along four rays, hole by hole, [`f32::INFINITY`] where nothing: downwards and upwards.
    seen: [[Vec<f32>; 4]; 2],
    /// Number of holes before each row.
    first: Vec<usize>,
}

/// Fills every NaN from the nearest values along eight directions: an occluded pixel belongs to the background and
/// takes the second smallest, a mismatched one takes the median. Pixels whose eight rays meet nothing stay NaN.
///
/// Two sweeps, linear in the number of pixels.
pub(crate) fn fill_holes(
    level: Level,
    disparity: &mut [f32],
    states: &[PixelState],
    width: usize,
    Holes { seen, first }: &mut Holes,
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    if width == 0 || disparity.is_empty() {
        return Ok(());
    }
    let mut count = 0;
    first.clear();
    for row in disparity.chunks_exact(width) {
        first.push(count);
        count += row.iter().map(|d| u32::from(d.is_nan())).sum::<u32>() as usize;
    }
    // Down with the rays from the left and from above, up with the other four, at the same time.
    let [down, up] = seen;
    let view = &*disparity;
    rayon::join(
        || dispatch!(level, simd => rays(simd, view, width, count, false, down)),
        || dispatch!(level, simd => rays(simd, view, width, count, true, up)),
    );
    stage.check()?;
    // The median and the second smallest take the places of the first two rays.
    let [a, b, c, d] = down;
    let ahead = a.par_chunks_mut(PART).zip(b.par_chunks_mut(PART)).zip(c.par_chunks(PART).zip(d.par_chunks(PART)));
    ahead.enumerate().for_each(|(part, ((a, b), (c, d)))| {
        let up = [0, 1, 2, 3].map(|ray| &up[ray][part * PART..][..c.len()]);
        dispatch!(level, simd => ranks(simd, [a, b], [c, d], up));
    });
    stage.check()?;
    let (median, second) = (&*a, &*b);
    let rows = disparity.par_chunks_mut(width).zip(states.par_chunks(width)).zip(first);
    rows.for_each(|((row, states), &mut first)| {
        let holes = row.iter_mut().zip(states).filter(|(d, _)| d.is_nan());
        for ((d, state), (&median, &second)) in holes.zip(median[first..].iter().zip(&second[first..])) {
            let value = match state {
                PixelState::Mismatched | PixelState::Matched => median,
                PixelState::Occluded | PixelState::OutOfView => second,
            };
            *d = if value == f32::INFINITY { f32::NAN } else { value };
        }
    });
    stage.check()
}

/// Holes per task; a whole number of vectors of any instruction set.
const PART: usize = 4096;

/// Replaces the first two of each hole's eight values by the lower median and the second smallest of those that are not
/// infinite, the smallest where there is but one.
#[simd]
fn ranks<S: Simd>(simd: S, [a, b]: [&mut [f32]; 2], [c, d]: [&[f32]; 2], up: [&[f32]; 4]) {
    let lanes = S::f32s::LEN;
    for at in (0..a.len()).step_by(lanes) {
        let part = at..at + lanes;
        let mut v = [S::f32s::splat(simd, 0.0); 8];
        for (v, values) in v.iter_mut().zip([&*a, &*b, c, d, up[0], up[1], up[2], up[3]]) {
            *v = S::f32s::from_slice(simd, &values[part.clone()]);
        }
        // Batcher's odd-even merge network.
        macro_rules! sort {
            ($($i:literal $j:literal),*) => { $((v[$i], v[$j]) = (v[$i].min(v[$j]), v[$i].max(v[$j]));)* };
        }
        sort!(0 1, 2 3, 4 5, 6 7, 0 2, 1 3, 4 6, 5 7, 1 2, 5 6, 0 4, 1 5, 2 6, 3 7, 2 4, 3 5, 1 2, 3 4, 5 6);
        let known = |rank: usize| v[rank].simd_lt(S::f32s::splat(simd, f32::INFINITY));
        let median = known(6).select(v[3], known(4).select(v[2], known(2).select(v[1], v[0])));
        median.store_slice(&mut a[part.clone()]);
        known(1).select(v[1], v[0]).store_slice(&mut b[part]);
    }
}

/// What each of `count` holes sees along four rays, of the holes in order: from beside, and from the row before straight
/// and along both diagonals. From the bottom right with all rays turned round where `mirrored`.
#[simd]
fn rays<S: Simd>(_: S, disparity: &[f32], width: usize, count: usize, mirrored: bool, found: &mut [Vec<f32>; 4]) {
    let height = disparity.len() / width;
    for ray in &mut *found {
        ray.resize(count.next_multiple_of(64), f32::INFINITY);
    }
    let [from_beside, from_behind, from_straight, from_ahead] = found;
    // What the row before saw at each column along the three rays, with a column of nothing on both sides.
    let mut behind = vec![f32::INFINITY; width + 2];
    let mut straight = behind.clone();
    let mut ahead = behind.clone();
    let mut next = behind.clone();
    let keep = |d: f32, ray: f32| if d.is_nan() { ray } else { d };
    let mut hole = if mirrored { count } else { 0 };
    for step in 0..height {
        let y = if mirrored { height - 1 - step } else { step };
        let row = &disparity[y * width..][..width];
        let update = |next: &mut [f32], from: &[f32]| {
            for ((n, &d), &ray) in next[1..=width].iter_mut().zip(row).zip(from) {
                *n = keep(d, ray);
            }
        };
        // In the mirrored sense the pixel behind is the one to the right.
        let (left, right) = (0, 2);
        let (one, other) = if mirrored { (right, left) } else { (left, right) };
        update(&mut next, &behind[one..]);
        std::mem::swap(&mut behind, &mut next);
        update(&mut next, &straight[1..]);
        std::mem::swap(&mut straight, &mut next);
        update(&mut next, &ahead[other..]);
        std::mem::swap(&mut ahead, &mut next);
        let mut beside = f32::INFINITY;
        let mut visit = |x: usize, at: usize, beside: f32| {
            from_beside[at] = beside;
            from_behind[at] = behind[x + 1];
            from_straight[at] = straight[x + 1];
            from_ahead[at] = ahead[x + 1];
        };
        if mirrored {
            for (x, &d) in row.iter().enumerate().rev() {
                if d.is_nan() {
                    hole -= 1;
                    visit(x, hole, beside);
                } else {
                    beside = d;
                }
            }
        } else {
            for (x, &d) in row.iter().enumerate() {
                if d.is_nan() {
                    visit(x, hole, beside);
                    hole += 1;
                } else {
                    beside = d;
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    fn fill(disparity: &mut [f32], states: &[PixelState], width: usize) {
        fill_holes(Level::new(), disparity, states, width, &mut Holes::default(), &Stage::new(&Silent, "", 0).unwrap())
            .unwrap();
    }

    #[test]
    fn an_occluded_hole_takes_the_background_and_a_mismatch_the_median() {
        // Left half at 2 (far), right half at 9 (near), a hole between them.
        let width = 9;
        let mut d: Vec<f32> = (0..45).map(|i| if i % width < 4 { 2.0 } else { 9.0 }).collect();
        let mut states = vec![PixelState::Matched; 45];
        d[2 * width + 4] = f32::NAN;
        states[2 * width + 4] = PixelState::Occluded;
        let mut mismatch = d.clone();
        fill(&mut d, &states, width);
        assert_eq!(d[2 * width + 4], 2.0);
        states[2 * width + 4] = PixelState::Mismatched;
        fill(&mut mismatch, &states, width);
        assert_eq!(mismatch[2 * width + 4], 9.0);
    }

    proptest! {
        #[test]
        fn the_sweeps_see_what_rays_walked_one_by_one_see(
            width in 1usize..12,
            values in proptest::collection::vec(prop_oneof![(0..9i32).prop_map(|v| v as f32), Just(f32::NAN)], 0..120),
        ) {
            let height = values.len() / width;
            let d = &values[..width * height];
            let holes: Vec<usize> = (0..d.len()).filter(|&i| d[i].is_nan()).collect();
            let walk = |i: usize, (dx, dy): (i32, i32)| {
                let (mut x, mut y) = ((i % width) as i32 + dx, (i / width) as i32 + dy);
                while x >= 0 && y >= 0 && x < width as i32 && y < height as i32 {
                    let value = d[y as usize * width + x as usize];
                    if !value.is_nan() {
                        return value.to_bits();
                    }
                    (x, y) = (x + dx, y + dy);
                }
                f32::INFINITY.to_bits()
            };
            for (mirrored, sign) in [(false, -1), (true, 1)] {
                let mut found: [Vec<f32>; 4] = Default::default();
                if width * height > 0 {
                    dispatch!(Level::new(), simd => rays(simd, d, width, holes.len(), mirrored, &mut found));
                }
                for (n, &i) in holes.iter().enumerate() {
                    let expected = [(sign, 0), (sign, sign), (0, sign), (-sign, sign)].map(|step| walk(i, step));
                    prop_assert_eq!([0, 1, 2, 3].map(|ray| found[ray][n].to_bits()), expected);
                }
            }
        }
    }

    proptest! {
        #[test]
        fn the_ranks_are_those_of_sorted_values(
            holes in proptest::collection::vec(
                proptest::array::uniform8(prop_oneof![3 => -9f32..9.0, 1 => Just(f32::INFINITY)]), 1..80),
        ) {
            for level in instruction_sets() {
                let n = holes.len().next_multiple_of(64);
                let mut rays: [Vec<f32>; 8] = std::array::from_fn(|ray| holes.iter().map(|h| h[ray]).collect());
                rays.iter_mut().for_each(|r| r.resize(n, f32::INFINITY));
                let [a, b, c, d, e, f, g, h] = &mut rays;
                dispatch!(level, simd => ranks(simd, [a, b], [c, d], [e, f, g, h]));
                for (i, hole) in holes.iter().enumerate() {
                    let mut known: Vec<f32> = hole.iter().copied().filter(|v| v.is_finite()).collect();
                    known.sort_by(f32::total_cmp);
                    let last = known.len().saturating_sub(1);
                    let at = |rank: usize| known.get(rank).copied().unwrap_or(f32::INFINITY);
                    prop_assert_eq!((a[i], b[i]), (at(last / 2), at(1.min(last))), "{:?}", level);
                }
            }
        }
    }

    #[test]
    fn nothing_to_fill_from_leaves_nothing() {
        let mut d = vec![f32::NAN; 12];
        fill(&mut d, &[PixelState::Occluded; 12], 4);
        assert!(d.iter().all(|v| v.is_nan()));
        fill(&mut [], &[], 0);
    }
}
