//! A matcher implemented outside of `cv-stereo`, through its trait.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{GrayF32, GrayU8, Image, ImageView, Progress, Silent};
use cv_stereo::{DisparityMap, DisparityMatcher, PixelState, StereoError, StereoMatcher, StereoOptions};

/// The smallest sum of absolute differences over 7×7 pixels, confirmed by nothing.
struct BlockMatcher {
    disparities: usize,
}

impl DisparityMatcher<u8, 1> for BlockMatcher {
    fn compute_into(
        &mut self,
        left: ImageView<'_, u8, 1>,
        right: ImageView<'_, u8, 1>,
        map: &mut DisparityMap,
        progress: &dyn Progress,
    ) -> Result<(), StereoError> {
        if left.size() != right.size() {
            return Err(StereoError::SizeMismatch { left: left.size(), right: right.size() });
        }
        let (width, height) = left.size();
        let cost = |x: usize, y: usize, d: usize| -> u32 {
            let at = |v: ImageView<'_, u8, 1>, x: usize, y: usize| v.at(x.min(width - 1), y.min(height - 1))[0];
            let window = (0..49).map(|i| (i % 7, i / 7));
            window
                .map(|(i, j)| {
                    let (x, y) = ((x + i).saturating_sub(3), (y + j).saturating_sub(3));
                    u32::from(at(left, x, y).abs_diff(at(right, x.saturating_sub(d), y)))
                })
                .sum()
        };
        map.disparity = GrayF32::new(width, height, [f32::NAN]);
        map.state = Image::new(width, height, [PixelState::OutOfView]);
        for y in 0..height {
            progress.report("blocks", y, height)?;
            for x in self.disparities..width {
                if let Some(d) = (0..self.disparities).min_by_key(|d| cost(x, y, *d)) {
                    map.disparity.set(x, y, [d as f32]);
                    map.state.set(x, y, [PixelState::Matched]);
                }
            }
        }
        Ok(())
    }

    fn disparities(&self) -> (i32, usize) {
        (0, self.disparities)
    }
}

/// A wall of noise, shifted by `shift` pixels to the left.
fn wall(shift: usize) -> GrayU8 {
    GrayU8::from_fn(80, 40, |x, y| {
        let mut v = ((x + shift) as u32).wrapping_mul(0x9E37_79B9) ^ (y as u32).wrapping_mul(0x85EB_CA6B);
        v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
        [(v >> 24) as u8]
    })
}

#[test]
fn ours_and_another_find_the_same_wall() {
    let ours = StereoMatcher::new(StereoOptions { disparities: 16, ..StereoOptions::default() }).unwrap();
    let matchers: [Box<dyn DisparityMatcher<u8, 1>>; 2] = [Box::new(ours), Box::new(BlockMatcher { disparities: 16 })];
    let (left, right) = (wall(0), wall(5));
    for (i, mut matcher) in matchers.into_iter().enumerate() {
        let mut map = DisparityMap::empty();
        matcher.compute_into(left.view(), right.view(), &mut map, &Silent).unwrap();
        assert_eq!((map.disparity.size(), matcher.disparities()), ((80, 40), (0, 16)));
        // The same noise to the last bit: nothing else fits, away from the borders.
        for (x, y) in (20..76).flat_map(|x| (4..36).map(move |y| (x, y))) {
            assert!((map.disparity.at(x, y)[0] - 5.0).abs() < 0.5, "{i}: {} at {x} {y}", map.disparity.at(x, y)[0]);
        }
        // What the trait says of those that do not know.
        let sigma = matcher.uncertainty(&map);
        assert_eq!((sigma.size(), sigma.at(40, 20)[0].is_nan()), ((80, 40), i == 1));
        let other = GrayU8::new(81, 40, [0]);
        let error = matcher.compute_into(left.view(), other.view(), &mut map, &Silent).unwrap_err();
        assert_eq!(error, StereoError::SizeMismatch { left: (80, 40), right: (81, 40) });
    }
}
