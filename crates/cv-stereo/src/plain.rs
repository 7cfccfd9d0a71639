//! Semi-global matching as it is written down, with whole volumes and no tricks: what the fast matcher must equal.

use crate::{Paths, StereoOptions};

/// The best disparity of one pixel, as an index from `min_disparity`, with the sums around it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub(crate) struct Winner {
    /// Index of the smallest sum, the first of equals.
    pub(crate) index: u16,
    /// The smallest sum.
    pub(crate) cost: u16,
    /// The smallest sum at indices not next to the winner; `u16::MAX` where there are none.
    pub(crate) second: u16,
    /// The sum one index below; `u16::MAX` at the end of the range.
    pub(crate) below: u16,
    /// The sum one index above; `u16::MAX` at the end of the range.
    pub(crate) above: u16,
}

/// What a match outside the right image costs: as much as a neutral neighbourhood, half of whose bits differ by chance.
pub(crate) fn outside_cost(options: &StereoOptions) -> u8 {
    (options.census.bits() / 2) as u8
}

/// P2 by the absolute difference of neighbouring grey levels (0 to 255).
pub(crate) fn p2_table(options: &StereoOptions) -> [u8; 256] {
    let (low, high) = (u32::from(options.p2_min), u32::from(options.p2));
    let half = u32::from(options.p2_gradient);
    std::array::from_fn(|g| {
        if half == 0 {
            high as u8
        } else {
            (low + ((high - low) * half + (half + g as u32) / 2) / (half + g as u32)) as u8
        }
    })
}

/// Winners of the left image and indices of the right one's, row by row.
pub(crate) fn match_plain(
    options: &StereoOptions,
    grey: &[u16],
    left: &[u64],
    right: &[u64],
    width: usize,
    height: usize,
) -> (Vec<Winner>, Vec<u16>) {
    let n = options.disparities;
    let outside = outside_cost(options);
    let cost = |x: usize, y: usize, k: usize| -> u32 {
        let xr = x as i64 - i64::from(options.min_disparity) - k as i64;
        if xr < 0 || xr >= width as i64 {
            return u32::from(outside);
        }
        (left[y * width + x] ^ right[y * width + xr as usize]).count_ones()
    };
    let table = p2_table(options);
    let p1 = u32::from(options.p1);
    let directions: &[(i64, i64)] = match options.paths {
        Paths::Four => &[(-1, 0), (0, -1), (1, 0), (0, 1)],
        Paths::Eight => &[(-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1)],
    };
    let mut sums = vec![0u16; width * height * n];
    let mut path = vec![0u32; width * height * n];
    for &(dx, dy) in directions {
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
                    let step = grey[y * width + x].abs_diff(grey[py * width + px]) >> 8;
                    let p2 = u32::from(table[usize::from(step)]);
                    let before: Vec<u32> = path[(py * width + px) * n..][..n].to_vec();
                    let least = before.iter().copied().min().unwrap_or(0);
                    for k in 0..n {
                        let mut best = before[k].min(least + p2);
                        if k > 0 {
                            best = best.min(before[k - 1] + p1);
                        }
                        if k + 1 < n {
                            best = best.min(before[k + 1] + p1);
                        }
                        path[here + k] = cost(x, y, k) + best - least;
                    }
                }
                for k in 0..n {
                    sums[here + k] += path[here + k] as u16;
                }
            }
        }
    }
    let mut winners = vec![Winner::default(); width * height];
    let mut right_best = vec![(u16::MAX, 0u16); width * height];
    for y in 0..height {
        for x in 0..width {
            let s = &sums[(y * width + x) * n..][..n];
            let at = |k: usize| s.get(k).copied().unwrap_or(u16::MAX);
            let index = (0..n).min_by_key(|&k| (s[k], k)).unwrap_or(0);
            let second = (0..n).filter(|k| k.abs_diff(index) > 1).map(at).min().unwrap_or(u16::MAX);
            winners[y * width + x] = Winner {
                index: index as u16,
                cost: s[index],
                second,
                below: at(index.wrapping_sub(1)),
                above: at(index + 1),
            };
            for (k, &sum) in s.iter().enumerate() {
                let xr = x as i64 - i64::from(options.min_disparity) - k as i64;
                if xr >= 0 && xr < width as i64 {
                    let best = &mut right_best[y * width + xr as usize];
                    *best = (*best).min((sum, k as u16));
                }
            }
        }
    }
    (winners, right_best.into_iter().map(|(_, k)| k).collect())
}
