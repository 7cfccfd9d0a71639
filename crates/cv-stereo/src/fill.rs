//! Disparities for pixels that have none of their own (Hirschmüller, "Stereo processing by semiglobal matching and
//! mutual information", PAMI 2008, section 2.6.4).

use crate::PixelState;

/// Fills every NaN from the nearest values along eight directions: an occluded pixel belongs to the background and
/// takes the second smallest, a mismatched one takes the median. Pixels whose eight rays meet nothing stay NaN.
///
/// Two sweeps, linear in the number of pixels.
pub(crate) fn fill_holes(disparity: &mut [f32], states: &[PixelState], width: usize, height: usize) {
    if width == 0 || height == 0 {
        return;
    }
    let holes: Vec<u32> = (0..disparity.len()).filter(|&i| disparity[i].is_nan()).map(|i| i as u32).collect();
    let mut rays = vec![[f32::NAN; 8]; holes.len()];
    // Down with the rays from the left and from above, then up with the other four. A row of `reach` holds what the
    // row before saw at each column along the three slanted or vertical rays.
    for (pass, first_ray) in [(0, 0), (1, 4)] {
        let mut reach = vec![[f32::NAN; 3]; width];
        let mut next = reach.clone();
        let mut hole = if pass == 0 { 0 } else { holes.len() };
        for row in 0..height {
            let y = if pass == 0 { row } else { height - 1 - row };
            let mut beside = f32::NAN;
            for column in 0..width {
                let x = if pass == 0 { column } else { width - 1 - column };
                let i = y * width + x;
                let seen = if disparity[i].is_nan() {
                    let seen = [
                        if x > 0 { reach[x - 1][0] } else { f32::NAN },
                        reach[x][1],
                        if x + 1 < width { reach[x + 1][2] } else { f32::NAN },
                    ];
                    if pass == 1 {
                        hole -= 1;
                    }
                    rays[hole][first_ray] = beside;
                    rays[hole][first_ray + 1..first_ray + 4].copy_from_slice(&seen);
                    if pass == 0 {
                        hole += 1;
                    }
                    seen
                } else {
                    beside = disparity[i];
                    [disparity[i]; 3]
                };
                next[x] = seen;
            }
            std::mem::swap(&mut reach, &mut next);
        }
    }
    for (&i, mut seen) in holes.iter().zip(rays) {
        // NaN sorts behind every number.
        seen.sort_unstable_by(f32::total_cmp);
        let n = seen.iter().filter(|v| !v.is_nan()).count();
        if n > 0 {
            disparity[i as usize] = match states[i as usize] {
                PixelState::Mismatched | PixelState::Matched => seen[(n - 1) / 2],
                PixelState::Occluded | PixelState::OutOfView => seen[1.min(n - 1)],
            };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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

    #[test]
    fn nothing_to_fill_from_leaves_nothing() {
        let mut d = vec![f32::NAN; 12];
        fill_holes(&mut d, &[PixelState::Occluded; 12], 4, 3);
        assert!(d.iter().all(|v| v.is_nan()));
        fill_holes(&mut [], &[], 0, 0);
    }
}
