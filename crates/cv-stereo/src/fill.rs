//! Disparities for pixels that have none of their own (Hirschmüller, "Stereo processing by semiglobal matching and
//! mutual information", PAMI 2008, section 2.6.4).

use crate::PixelState;
use rayon::prelude::*;

/// Fills every NaN from the nearest values along eight directions: an occluded pixel belongs to the background and
/// takes the second smallest, a mismatched one takes the median. Pixels whose eight rays meet nothing stay NaN.
///
/// Two sweeps, linear in the number of pixels.
pub(crate) fn fill_holes(disparity: &mut [f32], states: &[PixelState], width: usize, height: usize) {
    if width == 0 || height == 0 {
        return;
    }
    // Down with the rays from the left and from above, up with the other four, at the same time.
    let (down, up) = rayon::join(|| rays(disparity, width, height, false), || rays(disparity, width, height, true));
    // Holes before the first, second ... row.
    let mut first = Vec::with_capacity(height);
    let mut count = 0;
    for row in disparity.chunks_exact(width) {
        first.push(count);
        count += row.iter().map(|d| usize::from(d.is_nan())).sum::<usize>();
    }
    let rows = disparity.par_chunks_mut(width).zip(states.par_chunks(width)).zip(&first);
    rows.for_each(|((row, states), &first)| {
        let holes = row.iter_mut().zip(states).filter(|(d, _)| d.is_nan());
        // The sweep upwards met the holes in the opposite order.
        for ((d, state), (a, b)) in holes.zip(down[first..].iter().zip(up[..count - first].iter().rev())) {
            let seen = sorted([a[0], a[1], a[2], a[3], b[0], b[1], b[2], b[3]]);
            let n = seen.iter().filter(|v| !v.is_nan()).count();
            if n > 0 {
                *d = match state {
                    PixelState::Mismatched | PixelState::Matched => seen[(n - 1) / 2],
                    PixelState::Occluded | PixelState::OutOfView => seen[1.min(n - 1)],
                };
            }
        }
    });
}

/// Eight values in ascending order, NaN behind every number (Batcher's odd-even merge network; integers with the order
/// of the floats, as in `f32::total_cmp`).
fn sorted(values: [f32; 8]) -> [f32; 8] {
    // Its own inverse.
    let flip = |bits: i32| bits ^ (((bits >> 31) as u32) >> 1) as i32;
    let mut v = values.map(|f| flip(f.to_bits() as i32));
    const PAIRS: [(usize, usize); 19] = [
        (0, 1), (2, 3), (4, 5), (6, 7), (0, 2), (1, 3), (4, 6), (5, 7), (1, 2), (5, 6), (0, 4), (1, 5), (2, 6), (3, 7),
        (2, 4), (3, 5), (1, 2), (3, 4), (5, 6),
    ];
    for (i, j) in PAIRS {
        (v[i], v[j]) = (v[i].min(v[j]), v[i].max(v[j]));
    }
    v.map(|bits| f32::from_bits(flip(bits) as u32))
}

/// What each hole sees along four rays, of the holes in order: from beside, and from the row before straight and along
/// both diagonals. From the bottom right with all rays turned round where `mirrored`.
fn rays(disparity: &[f32], width: usize, height: usize, mirrored: bool) -> Vec<[f32; 4]> {
    let mut found = Vec::new();
    // What the row before saw at each column along the three rays, with a column of nothing on both sides.
    let mut behind = vec![f32::NAN; width + 2];
    let mut straight = behind.clone();
    let mut ahead = behind.clone();
    let mut next = behind.clone();
    let keep = |d: f32, ray: f32| if d.is_nan() { ray } else { d };
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
        let (from_behind, from_ahead) = if mirrored { (right, left) } else { (left, right) };
        update(&mut next, &behind[from_behind..]);
        std::mem::swap(&mut behind, &mut next);
        update(&mut next, &straight[1..]);
        std::mem::swap(&mut straight, &mut next);
        update(&mut next, &ahead[from_ahead..]);
        std::mem::swap(&mut ahead, &mut next);
        let mut beside = f32::NAN;
        let mut visit = |x: usize, d: f32| {
            if d.is_nan() {
                found.push([beside, behind[x + 1], straight[x + 1], ahead[x + 1]]);
            } else {
                beside = d;
            }
        };
        if mirrored {
            row.iter().enumerate().rev().for_each(|(x, &d)| visit(x, d));
        } else {
            row.iter().enumerate().for_each(|(x, &d)| visit(x, d));
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn an_occluded_hole_takes_the_background_and_a_mismatch_the_median() {
        // Left half at 2 (far), right half at 9 (near), a hole between them.
        let (width, height) = (9, 5);
        let mut d: Vec<f32> = (0..45).map(|i| if i % width < 4 { 2.0 } else { 9.0 }).collect();
        let mut states = vec![PixelState::Matched; 45];
        d[2 * width + 4] = f32::NAN;
        states[2 * width + 4] = PixelState::Occluded;
        let mut mismatch = d.clone();
        fill_holes(&mut d, &states, width, height);
        assert_eq!(d[2 * width + 4], 2.0);
        states[2 * width + 4] = PixelState::Mismatched;
        fill_holes(&mut mismatch, &states, width, height);
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
                f32::NAN.to_bits()
            };
            for (mirrored, sign) in [(false, -1), (true, 1)] {
                let mut found = rays(d, width, height, mirrored);
                if mirrored {
                    found.reverse();
                }
                prop_assert_eq!(found.len(), holes.len());
                for (&i, seen) in holes.iter().zip(found) {
                    let expected = [(sign, 0), (sign, sign), (0, sign), (-sign, sign)].map(|step| walk(i, step));
                    prop_assert_eq!(seen.map(f32::to_bits), expected);
                }
            }
        }
    }

    proptest! {
        #[test]
        fn eight_values_come_out_in_order(
            values in proptest::array::uniform8(prop_oneof![9 => -9f32..9.0, 1 => Just(f32::NAN), 1 => Just(-0.0f32)]),
        ) {
            let mut expected = values;
            expected.sort_by(f32::total_cmp);
            prop_assert_eq!(sorted(values).map(f32::to_bits), expected.map(f32::to_bits));
        }
    }

    #[test]
    fn nothing_to_fill_from_leaves_nothing() {
        let mut d = vec![f32::NAN; 12];
        fill_holes(&mut d, &[PixelState::Occluded; 12], 4, 3);
        assert!(d.iter().all(|v| v.is_nan()));
        fill_holes(&mut [], &[], 0, 0);
    }
}
