//! Reference implementation of semi-global matching with whole cost volumes, which the fast matcher must equal.

use crate::border_mask::PairMasks;
use crate::coarse_prior::Prior;
use crate::winner::{NO_SUM, Winner, outside_cost, p2_table};
use crate::{IntensityCost, Paths, StereoOptions};

/// Returns the winners of the left image and the winning indices of the right one, in raster order.
pub(crate) fn match_reference(
    options: &StereoOptions,
    gray: &[u16],
    [left, right]: [&[u64]; 2],
    intensity_cost: &[Vec<u8>; 2],
    priors: &[Prior],
    masks: PairMasks<'_>,
    (width, height): (usize, usize),
) -> (Vec<Winner>, Vec<u16>) {
    let n = options.disparities;
    let column = |x: usize, y: usize, k: usize| {
        let xr = x as i64 - i64::from(options.min_disparity) - k as i64;
        let has_data = |xr: &usize| !masks.row(y).is_some_and(|row| row.hides_right(*xr));
        usize::try_from(xr).ok().filter(|&xr| xr < width).filter(has_data)
    };
    let bits = |i: usize, j: usize| {
        let more = if options.intensity_cost == IntensityCost::None {
            0
        } else {
            intensity_cost[0][i].abs_diff(intensity_cost[1][j])
        };
        (left[i] ^ right[j]).count_ones() as u8 + more.min(options.intensity_cost.cap())
    };
    let prior_cost = |i: usize, k: usize| {
        let cost = |prior: &Prior| {
            usize::from(prior.index()).abs_diff(k).saturating_sub(1).min(usize::from(prior.cap())) as u8
        };
        priors.get(i).map_or(0, cost)
    };
    let costs: Vec<u8> = (0..width * height)
        .flat_map(|i| {
            let (x, y, row) = (i % width, i / width, i / width * width);
            if masks.row(y).is_some_and(|row| row.hides_left(x)) {
                return vec![254 - options.p2; n];
            }
            let inside: Vec<Option<u8>> =
                (0..n).map(|k| column(x, y, k).map(|xr| bits(i, row + xr) + prior_cost(i, k))).collect();
            let known = inside.iter().flatten();
            let outside = outside_cost(known.clone().map(|&c| u32::from(c)).sum(), known.count());
            inside.into_iter().map(move |cost| cost.unwrap_or(outside)).collect()
        })
        .collect();
    let cost = |x: usize, y: usize, k: usize| u32::from(costs[(y * width + x) * n + k]);
    let table = p2_table(options);
    let p1 = u32::from(options.p1);
    let directions: &[(i64, i64)] = match options.paths {
        Paths::Four => &[(-1, 0), (0, -1), (1, 0), (0, 1)],
        Paths::Eight => &[(-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1)],
    };
    // The sums of both sweeps, each of which saturates.
    let mut halves = [vec![0u16; width * height * n], vec![0u16; width * height * n]];
    let mut path = vec![0u32; width * height * n];
    for (number, &(dx, dy)) in directions.iter().enumerate() {
        let sums = &mut halves[usize::from(number >= directions.len() / 2)];
        let rows: Vec<usize> = if dy > 0 { (0..height).rev().collect() } else { (0..height).collect() };
        let columns: Vec<usize> = if dx > 0 { (0..width).rev().collect() } else { (0..width).collect() };
        for &y in &rows {
            for &x in &columns {
                let (px, py) = (x as i64 + dx, y as i64 + dy);
                let here = (y * width + x) * n;
                if px < 0 || py < 0 || px >= width as i64 || py >= height as i64 {
                    for k in 0..n {
                        path[here + k] = cost(x, y, k);
                    }
                } else {
                    let (px, py) = (px as usize, py as usize);
                    let step = (gray[y * width + x] >> 8).abs_diff(gray[py * width + px] >> 8);
                    let p2 = u32::from(table[usize::from(step)]);
                    let before: Vec<u32> = path[(py * width + px) * n..][..n].to_vec();
                    let smallest = before.iter().copied().min().unwrap_or(0);
                    for k in 0..n {
                        let mut best = before[k].min(smallest + p2);
                        if k > 0 {
                            best = best.min(before[k - 1] + p1);
                        }
                        if k + 1 < n {
                            best = best.min(before[k + 1] + p1);
                        }
                        path[here + k] = cost(x, y, k) + best - smallest;
                    }
                }
                for k in 0..n {
                    sums[here + k] = (sums[here + k] + path[here + k] as u16).min(255);
                }
            }
        }
    }
    let sums: Vec<u16> = halves[0].iter().zip(&halves[1]).map(|(a, b)| a + b).collect();
    let mut winners = vec![Winner::default(); width * height];
    let mut right_best = vec![(NO_SUM, 0u16); width * height];
    for y in 0..height {
        for x in 0..width {
            let s = &sums[(y * width + x) * n..][..n];
            let at = |k: usize| s.get(k).copied().unwrap_or(NO_SUM);
            let index = (0..n).min_by_key(|&k| (s[k], k)).filter(|&k| s[k] < NO_SUM).unwrap_or(0);
            let flat = at(index + 1) == s[index] && (index + 2 >= n || at(index + 2) == s[index]);
            let far = (0..n).filter(|k| options.confidence && k.abs_diff(index) > 1);
            let second = far.map(at).min().unwrap_or(NO_SUM);
            winners[y * width + x] = Winner {
                index: index as u16,
                cost: s[index].min(NO_SUM),
                second,
                below: if flat { s[index] } else { at(index.wrapping_sub(1)) },
                above: at(index + 1),
            };
            for (k, &sum) in s.iter().enumerate() {
                let xr = x as i64 - i64::from(options.min_disparity) - k as i64;
                if xr >= 0 && xr < width as i64 {
                    let best = &mut right_best[y * width + xr as usize];
                    if sum < best.0 {
                        *best = (sum, k as u16);
                    }
                }
            }
        }
    }
    (winners, right_best.into_iter().map(|(_, k)| k).collect())
}

mod tests {
    use super::*;
    use crate::aligned_buffer::AlignedBuffer;
    use crate::border_mask::BorderMask;
    use crate::census::{Gray, MARGIN, describe, describe_mirrored, planes};
    use crate::cost::{Frame, Penalties};
    use crate::layout::Layout;
    use crate::search_window::{SearchWindows, WINDOW};
    use crate::sgm::Aggregator;
    use crate::{Census, StereoOptions, window_sweep};
    use cv_core::Mask;
    use cv_synth::instruction_sets;
    use fearless_simd::Level;
    use proptest::prelude::*;

    /// Census bits by definition.
    fn census_reference(gray: &[u16], width: usize, height: usize, window: Census) -> Vec<u64> {
        let (w, h) = window.size();
        let at = |x: i64, y: i64| {
            gray[y.clamp(0, height as i64 - 1) as usize * width + x.clamp(0, width as i64 - 1) as usize]
        };
        (0..width * height)
            .map(|i| {
                let (x, y) = ((i % width) as i64, (i / width) as i64);
                let mut bits = 0;
                let mut index = 0;
                for dy in -(h as i64 / 2)..=h as i64 / 2 {
                    for dx in -(w as i64 / 2)..=w as i64 / 2 {
                        if (dx, dy) != (0, 0) {
                            bits |= u64::from(at(x + dx, y + dy) < at(x, y)) << index;
                            index += 1;
                        }
                    }
                }
                bits
            })
            .collect()
    }

    /// What the intensity cost compares, by definition.
    fn intensity_reference(gray: &[u16], width: usize, intensity_cost: IntensityCost) -> Vec<u8> {
        let value = |i: usize| {
            let at = |x: usize| i32::from(gray[i / width * width + x]);
            let x = i % width;
            match intensity_cost {
                IntensityCost::None => 0,
                IntensityCost::Gray { per_bit, .. } => {
                    (f64::from(at(x)) / 257.0 / f64::from(per_bit) + 1e-9).round() as u8
                }
                IntensityCost::Gradient { per_bit, .. } => {
                    let slope = at((x + 1).min(width - 1)) - at(x.saturating_sub(1));
                    (128.0 + (f64::from(slope) / 514.0 / f64::from(per_bit)).trunc()).clamp(0.0, 255.0) as u8
                }
            }
        };
        (0..gray.len()).map(value).collect()
    }

    fn padded(values: &[u16], width: usize, height: usize) -> Gray {
        let mut gray = Gray { values: Vec::new(), width, height };
        for row in values.chunks_exact(width) {
            gray.values.extend([row[0]; MARGIN]);
            gray.values.extend_from_slice(row);
            gray.values.extend([row[width - 1]; MARGIN]);
        }
        gray
    }

    /// A pair of images with its priors, and the result of the reference.
    struct Pair<'a> {
        options: &'a StereoOptions,
        gray: [Gray; 2],
        priors: &'a [Prior],
        masks: PairMasks<'a>,
        p2: Penalties,
        expected: (Vec<Winner>, Vec<u16>),
    }

    impl<'a> Pair<'a> {
        fn new(
            options: &'a StereoOptions,
            images: &[Vec<u16>; 2],
            width: usize,
            priors: &'a [Prior],
            masks: PairMasks<'a>,
        ) -> Self {
            let height = images[0].len() / width;
            let bits = images.each_ref().map(|g| census_reference(g, width, height, options.census));
            let values = images.each_ref().map(|g| intensity_reference(g, width, options.intensity_cost));
            let bits = [&bits[0][..], &bits[1][..]];
            let expected = match_reference(options, &images[0], bits, &values, priors, masks, (width, height));
            let gray = images.each_ref().map(|g| padded(g, width, height));
            Self { options, gray, priors, masks, p2: Penalties::new(options), expected }
        }

        /// Calls `f` with the frame of the fast matcher on an instruction set.
        fn with_frame(&self, level: Level, layout: Layout, f: impl FnOnce(&Frame<'_>)) {
            let &StereoOptions { census, intensity_cost, disparities, min_disparity, p1, confidence, .. } =
                self.options;
            let min_disparity = i64::from(min_disparity);
            let (mut left, mut right, mut gray) = (Vec::new(), Vec::new(), Vec::new());
            describe(level, &self.gray[0], census, intensity_cost, &mut left);
            describe_mirrored(level, &self.gray[1], census, intensity_cost, min_disparity, layout, &mut right);
            self.gray[0].to_bytes(&mut gray);
            f(&Frame {
                width: self.gray[0].width,
                height: self.gray[0].height,
                min_disparity,
                disparities,
                layout,
                planes: planes(census, intensity_cost),
                left: &left,
                right: &right,
                gray: &gray,
                above: None,
                given: None,
                priors: self.priors,
                masks: self.masks,
                intensity_cap: (intensity_cost != IntensityCost::None).then_some(intensity_cost.cap()),
                p1,
                p2: &self.p2,
                second: confidence,
            });
        }
    }

    /// Borders of random widths, and holes in some rows.
    fn masks(width: usize, height: usize, has_masks: bool, noise: impl Fn(usize) -> u16) -> Option<BorderMask> {
        let at = |i: usize, n: usize| usize::from(noise(i)) * 31 % n;
        let has_data = |x: usize, y: usize| {
            let is_hole = at(3 * y + 5, 3) == 0 && (x / 3 + y) % 5 == 2;
            x >= at(3 * y, width) / 2 && x < width - at(3 * y + 1, width) / 2 && !is_hole
        };
        let valid = Mask::from_fn(width, height, |x, y| [has_data(x, y)]);
        BorderMask::from_valid(&valid).filter(|_| has_masks)
    }

    fn options() -> impl Strategy<Value = StereoOptions> {
        let window = prop_oneof![Just(Census::Window5x5), Just(Census::Window7x7), Just(Census::Window9x7)];
        // Ranges below, at and above one block and one group; penalties that do and do not saturate.
        let disparities = prop_oneof![1usize..70, Just(64), Just(128), 120usize..300];
        let intensity_cost = prop_oneof![
            Just(IntensityCost::None),
            (1u8.., 0u8..40).prop_map(|(per_bit, cap)| IntensityCost::Gray { per_bit, cap }),
            (1u8.., 0u8..40).prop_map(|(per_bit, cap)| IntensityCost::Gradient { per_bit, cap }),
        ];
        (window, disparities, -40i32..40, 0u8..30, 0u8..60, 0u8..60, 0u8..40, any::<bool>(), intensity_cost).prop_map(
            |(census, disparities, min_disparity, p1, more, most, p2_gradient, eight, intensity_cost)| StereoOptions {
                census,
                intensity_cost,
                disparities,
                min_disparity,
                p1,
                p2_min: p1 + more,
                p2: p1 + more + most,
                p2_gradient,
                paths: if eight { Paths::Eight } else { Paths::Four },
                confidence: disparities % 2 == 0,
                ..Default::default()
            },
        )
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]
        #[test]
        fn the_fast_matcher_equals_the_reference_on_every_instruction_set(
            options in options(),
            width in 9usize..40,
            height in 7usize..16,
            seed in any::<u64>(),
            has_priors in any::<bool>(),
            has_masks in any::<bool>(),
            levels_of_gray in prop_oneof![Just(2u16), Just(5), Just(200)],
        ) {
            options.validate().unwrap();
            // A splitmix sequence: noise on the left, shifted noise on the right.
            let noise = |i: usize| {
                let mut z = seed.wrapping_add((i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15));
                z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
                ((z >> 40) as u16 % levels_of_gray) * (65535 / levels_of_gray)
            };
            let left: Vec<u16> = (0..width * height).map(noise).collect();
            let right: Vec<u16> = (0..width * height).map(|i| noise(if i % 5 == 0 { i + 7 } else { i + 3 })).collect();
            let prior = |i: usize| Prior::new((noise(i + 11) as usize * 31 % options.disparities) as u16, (noise(i + 5) % 4) as u8);
            let priors: Vec<Prior> = if has_priors { (0..width * height).map(prior).collect() } else { Vec::new() };
            let borders = [0, 77].map(|salt| masks(width, height, has_masks, |i| noise(i + salt)));
            let masks = PairMasks { left: borders[0].as_ref(), right: borders[1].as_ref(), first: 0 };
            let pair = Pair::new(&options, &[left, right], width, &priors, masks);
            for level in instruction_sets() {
                let mut aggregator = Aggregator::default();
                pair.with_frame(level, Layout::new(level, options.disparities), |frame| {
                    // Twice, so that state left by a frame would show.
                    for _ in 0..2 {
                        let stage = cv_core::Stage::new(&cv_core::Silent, "", 0).unwrap();
                        aggregator.run(level, frame, height, options.paths == Paths::Eight, &stage).unwrap();
                        assert_eq!(aggregator.winners, pair.expected.0, "{level:?}");
                        assert_eq!(aggregator.right, pair.expected.1, "{level:?}");
                    }
                });
            }
        }

        #[test]
        fn strips_with_all_rows_below_have_the_winners_of_the_reference(
            options in options(),
            width in 9usize..40,
            height in 7usize..24,
            strip in 1usize..12,
            seed in any::<u64>(),
            has_masks in any::<bool>(),
        ) {
            let noise = |i: usize| ((seed.wrapping_add(i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as u16 % 5) * 13_107;
            let left: Vec<u16> = (0..width * height).map(noise).collect();
            let right: Vec<u16> = (0..width * height).map(|i| noise(i + 3)).collect();
            let prior = |i: usize| Prior::new((noise(i + 11) as usize * 31 % options.disparities) as u16, (noise(i + 5) % 4) as u8);
            let priors: Vec<Prior> = (0..width * height).map(prior).collect();
            let borders = [0, 77].map(|salt| masks(width, height, has_masks, |i| noise(i + salt)));
            let masks = PairMasks { left: borders[0].as_ref(), right: borders[1].as_ref(), first: 0 };
            let pair = Pair::new(&options, &[left, right], width, &priors, masks);
            let level = Level::new();
            let (mut aggregator, mut winners, mut chosen) = (Aggregator::default(), Vec::new(), Vec::new());
            pair.with_frame(level, Layout::new(level, options.disparities), |frame| {
                let stage = cv_core::Stage::new(&cv_core::Silent, "", 0).unwrap();
                for first in (0..height).step_by(strip) {
                    let below = Frame {
                        height: height - first,
                        left: &frame.left[first * frame.left.len() / height..],
                        right: &frame.right[first * frame.right.len() / height..],
                        gray: &frame.gray[first * width..],
                        above: first.checked_sub(1).map(|y| &frame.gray[y * width..][..width]),
                        priors: &frame.priors[first * width..],
                        masks: PairMasks { first, ..frame.masks },
                        ..*frame
                    };
                    aggregator.run(level, &below, strip.min(height - first), options.paths == Paths::Eight, &stage).unwrap();
                    winners.extend_from_slice(&aggregator.winners);
                    chosen.extend_from_slice(&aggregator.right);
                }
            });
            prop_assert_eq!(winners, pair.expected.0);
            prop_assert_eq!(chosen, pair.expected.1);
        }

        #[test]
        fn a_window_of_the_whole_range_has_the_winners_of_the_reference(
            options in options(),
            width in 9usize..90,
            height in 7usize..16,
            seed in any::<u64>(),
            has_masks in any::<bool>(),
        ) {
            let options = StereoOptions { disparities: WINDOW, paths: Paths::Four, ..options };
            let noise = |i: usize| ((seed.wrapping_add(i as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as u16 % 5) * 13_107;
            let left: Vec<u16> = (0..width * height).map(noise).collect();
            let right: Vec<u16> = (0..width * height).map(|i| noise(i + 3)).collect();
            let priors: Vec<Prior> = (0..width * height).map(|i| Prior::new(noise(i + 11) % 32, (noise(i + 5) % 4) as u8)).collect();
            let borders = [0, 77].map(|salt| masks(width, height, has_masks, |i| noise(i + salt)));
            let masks = PairMasks { left: borders[0].as_ref(), right: borders[1].as_ref(), first: 0 };
            let pair = Pair::new(&options, &[left, right], width, &priors, masks);
            let mut windows = SearchWindows::default();
            for level in instruction_sets() {
                windows.set(level, &vec![5.0; (width / 2) * (height / 2)], width / 2, (options.min_disparity, options.disparities));
                let mut winners = vec![Winner::default(); width * height];
                let mut right = vec![0; width * height];
                let stage = cv_core::Stage::new(&cv_core::Silent, "", 0).unwrap();
                let output = (&mut winners[..], &mut right[..]);
                pair.with_frame(level, Layout::new(level, options.disparities).contiguous(), |frame| {
                    let buffers = (&mut AlignedBuffer::default(), &mut Vec::new());
                    window_sweep::aggregate(level, frame, &windows, buffers, output, &stage).unwrap();
                });
                prop_assert_eq!(&winners, &pair.expected.0, "{:?}", level);
            }
        }
    }
}
