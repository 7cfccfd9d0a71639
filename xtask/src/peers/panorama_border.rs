//! How well the two ends of a 360° panorama fit together.

use cv_core::{Mask, Point2, RgbU8};
use cv_pipeline::PanoramaResult;

/// Columns on either side of the border with which it is compared.
const REACH: usize = 40;

/// Returns whether a panorama spans 360°: its right edge lies in the direction of its left one.
pub(super) fn is_full_circle(result: &PanoramaResult) -> bool {
    let middle = 0.5 * result.size.1 as f64;
    let [left, right] = [0.0, result.size.0 as f64].map(|x| result.canvas.ray(Point2::new(x - 0.5, middle)));
    left.angle(&right) < 0.5 / result.canvas.scale
}

/// Computes the mean absolute difference of the last and the first column, relative to the largest between neighboring columns within [`REACH`] of them, in the rows that reach them.
pub(super) fn relative_step(image: &RgbU8, mask: &Mask) -> f64 {
    let (width, height) = image.size();
    let rows: Vec<usize> = (0..height).filter(|&y| [0, width - 1].iter().all(|&x| mask.at(x, y) == [true])).collect();
    let step = |x: usize| -> u64 {
        let difference = |&y: &usize| {
            let (a, b) = (image.at(x, y), image.at((x + 1) % width, y));
            (0..3).map(|c| u64::from(a[c].abs_diff(b[c]))).sum::<u64>()
        };
        rows.iter().map(difference).sum()
    };
    let beside = (1..=REACH.min((width - 1) / 2)).flat_map(|k| [k - 1, width - 1 - k]);
    step(width - 1) as f64 / beside.map(step).max().unwrap_or(0).max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_step_at_the_border_is_relative_to_those_beside_it() {
        let wave = |x: usize| (120.0 + 100.0 * (0.1 * std::f64::consts::PI * x as f64).cos()) as u8;
        let periodic = RgbU8::from_fn(40, 4, |x, _| [wave(x); 3]);
        assert!(relative_step(&periodic, &Mask::new(40, 4, [true])) <= 1.0);
        let ramp = RgbU8::from_fn(100, 4, |x, _| [2 * x as u8; 3]);
        assert!((relative_step(&ramp, &Mask::new(100, 4, [true])) - 99.0).abs() < 1e-9);
        assert!(relative_step(&ramp, &Mask::new(100, 4, [false])).abs() < 1e-9);
    }
}
