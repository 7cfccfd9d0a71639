//! Faster non-maximal suppression than [`anms`](crate::anms): suppression via square covering (SSC), and tiles.

use crate::anms::usable;
use cv_core::Keypoint;

/// Keeps `n` corners that are the strongest of squares around them, strongest first.
///
/// The side of the squares is found by bisection, so that between `n` and `1.1 n` corners remain, of which the strongest `n` are returned (all, where there are
/// no more). Corners that are not finite are left out. O(n log n) for the order, then a few passes.
///
/// Source: O. Bailo, F. Rameau, K. Joo, J. Park, O. Bogdan & I. Kweon, "Efficient adaptive non-maximal suppression algorithms for homogeneous spatial
/// keypoint distribution", Pattern Recognition Letters 106, 2018 (suppression via square covering).
pub fn anms_square_covering(corners: &[Keypoint], n: usize) -> Vec<usize> {
    let mut order = by_response(corners);
    if n == 0 || order.len() <= n {
        order.truncate(n);
        return order;
    }
    let (low, high) = bounds(corners, &order);
    let size = [high[0] - low[0], high[1] - low[1]];
    // Halves of the largest and smallest side that can matter: n squares that fill the box; and the whole box.
    let (mut from, mut to) = (0.0f32, size[0].max(size[1]).max(f32::MIN_POSITIVE));
    let mut best = order.clone();
    // Each step halves the range: 24 exhaust the digits of an f32.
    for _ in 0..24 {
        let side = 0.5 * (from + to);
        let kept = covered(corners, &order, low, size, side, n);
        if kept.len() < n {
            to = side;
            continue;
        }
        from = side;
        let done = kept.len() * 10 <= n * 11;
        best = kept;
        if done {
            break;
        }
    }
    best.truncate(n);
    best
}

/// Those of `order` that lie in no cell covered by one before them: cells of half a side, two in each direction.
fn covered(corners: &[Keypoint], order: &[usize], low: [f32; 2], size: [f32; 2], side: f32, n: usize) -> Vec<usize> {
    let cell = 0.5 * side;
    let count = size.map(|s| (s / cell) as usize + 1);
    // More cells than this, and every corner has one of its own: the squares are far too small.
    let Some(cells) = count[0].checked_mul(count[1]).filter(|&cells| cells <= 64 * order.len().max(1024)) else {
        return order.to_vec();
    };
    let mut taken = vec![false; cells];
    let mut kept = Vec::with_capacity(n + n / 8);
    for &i in order {
        let p = corners[i].position;
        let at = [((p.x - low[0]) / cell) as usize, ((p.y - low[1]) / cell) as usize];
        if taken[at[1].min(count[1] - 1) * count[0] + at[0].min(count[0] - 1)] {
            continue;
        }
        kept.push(i);
        let reach = |a: usize, n: usize| a.saturating_sub(2)..(a + 3).min(n);
        for y in reach(at[1], count[1]) {
            taken[y * count[0]..][reach(at[0], count[0])].fill(true);
        }
    }
    kept
}

/// Keeps `n` corners, as many from each of `columns` × `rows` tiles as there are: the strongest of every tile, then the second of every tile, and so on.
///
/// Within a round the strongest come first. Corners that are not finite are left out. O(n log n).
pub fn anms_tiled(corners: &[Keypoint], n: usize, (columns, rows): (usize, usize)) -> Vec<usize> {
    let order = by_response(corners);
    let (low, high) = bounds(corners, &order);
    let (columns, rows) = (columns.max(1), rows.max(1));
    let place = |v: f32, i: usize, n: usize| {
        let share = (v - low[i]) / (high[i] - low[i]).max(f32::MIN_POSITIVE);
        ((share * n as f32) as usize).min(n - 1)
    };
    let mut seen = std::collections::BTreeMap::new();
    let mut rounds: Vec<(usize, usize)> = order
        .into_iter()
        .map(|i| {
            let p = corners[i].position;
            let round = seen.entry((place(p.y, 1, rows), place(p.x, 0, columns))).or_insert(0);
            *round += 1;
            (*round, i)
        })
        .collect();
    rounds.sort_by_key(|r| r.0);
    rounds.into_iter().take(n).map(|r| r.1).collect()
}

/// The finite ones, strongest first, of equals the first.
fn by_response(corners: &[Keypoint]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..corners.len()).filter(|&i| usable(&corners[i])).collect();
    order.sort_by(|&a, &b| corners[b].response.total_cmp(&corners[a].response));
    order
}

fn bounds(corners: &[Keypoint], of: &[usize]) -> ([f32; 2], [f32; 2]) {
    of.iter().fold(([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]), |(low, high), &i| {
        let p = corners[i].position;
        ([low[0].min(p.x), low[1].min(p.y)], [high[0].max(p.x), high[1].max(p.y)])
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn random(count: usize) -> Vec<Keypoint> {
        let mut state = 3u32;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as f32 / (1 << 24) as f32
        };
        // A quarter of them in a tenth of the width.
        (0..count)
            .map(|i| Keypoint::new(if i % 4 == 0 { 80.0 * next() } else { 800.0 * next() }, 600.0 * next(), next()))
            .collect()
    }

    #[test]
    fn squares_keep_the_strongest_and_a_distance() {
        let corners = random(5000);
        let kept = anms_square_covering(&corners, 300);
        assert_eq!(kept.len(), 300);
        let strongest = (0..5000).max_by(|&a, &b| corners[a].response.total_cmp(&corners[b].response)).unwrap();
        assert_eq!(kept[0], strongest);
        let mut nearest = f32::INFINITY;
        for (i, &a) in kept.iter().enumerate() {
            assert!(i == 0 || corners[kept[i - 1]].response >= corners[a].response);
            for &b in &kept[..i] {
                let d = corners[a].position - corners[b].position;
                nearest = nearest.min(d.x.abs().max(d.y.abs()));
            }
        }
        // 330 squares that do not overlap by more than half fill 800 × 600 px at a side of 38 px; two cells of half a side, less the place within a
        // cell, keep at least that apart. Filled at random, a plane is half full: 27 px.
        assert!(nearest > 19.0, "{nearest}");
        assert_eq!(anms_square_covering(&corners[..10], 300).len(), 10);
        assert_eq!(anms_square_covering(&[corners[0]; 50], 3).len(), 3);
        assert!(anms_square_covering(&[], 3).is_empty() && anms_square_covering(&corners, 0).is_empty());
    }

    #[test]
    fn every_tile_gives_as_many() {
        let corners = random(5000);
        let kept = anms_tiled(&corners, 96, (4, 3));
        let mut counts = [0; 12];
        for i in kept {
            let p = corners[i].position;
            counts[(p.y / 200.0) as usize * 4 + (p.x / 200.0) as usize] += 1;
        }
        // Tiles lie on the box of the corners, here 800 × 600 less the gap to the outermost of 5000: a corner near a tile's edge may be its neighbor's.
        assert!(counts.iter().all(|c| (7..=9).contains(c)), "{counts:?}");
        assert_eq!(anms_tiled(&corners, 9999, (4, 3)).len(), 5000);
        assert!(anms_tiled(&[], 9, (0, 0)).is_empty());
        let bad = [Keypoint::new(f32::NAN, 0.0, 1.0), Keypoint::new(0.0, 0.0, 1.0)];
        assert_eq!((anms_tiled(&bad, 9, (2, 2)), anms_square_covering(&bad, 9)), (vec![1], vec![1]));
    }
}
