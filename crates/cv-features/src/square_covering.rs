//! Non-maximal suppression by square covering (SSC) and by tiles, faster than [`anms`](crate::anms).

use crate::anms::is_finite;
use cv_core::Keypoint;

/// Returns the indices of `n` corners, each the strongest of a square around it, by decreasing response.
///
/// The side of the squares is determined by bisection such that between `n` and `1.1 n` corners remain, of which the
/// strongest `n` are returned (all, if there are fewer). Corners that are not finite are ignored. O(n log n) for
/// sorting, then a few linear passes.
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
    // The bracket of the bisection: from zero to the side of the bounding box.
    let (mut from, mut to) = (0.0f32, size[0].max(size[1]).max(f32::MIN_POSITIVE));
    let mut best = order.clone();
    // Each step halves the bracket; 24 steps exhaust the precision of f32.
    for _ in 0..24 {
        let side = 0.5 * (from + to);
        let selected = square_covering(corners, &order, low, size, side, n);
        if selected.len() < n {
            to = side;
            continue;
        }
        from = side;
        let is_close = selected.len() * 10 <= n * 11;
        best = selected;
        if is_close {
            break;
        }
    }
    best.truncate(n);
    best
}

/// Selects greedily the corners of `order` that are not in a cell covered by a previous one. Cells have half the side;
/// each corner covers two in each direction.
fn square_covering(
    corners: &[Keypoint],
    order: &[usize],
    low: [f32; 2],
    size: [f32; 2],
    side: f32,
    n: usize,
) -> Vec<usize> {
    let cell = 0.5 * side;
    let count = size.map(|s| (s / cell) as usize + 1);
    // With more cells than this, the squares are too small to suppress anything.
    let Some(cells) = count[0].checked_mul(count[1]).filter(|&cells| cells <= 64 * order.len().max(1024)) else {
        return order.to_vec();
    };
    let mut is_covered = vec![false; cells];
    let mut selected = Vec::with_capacity(n + n / 8);
    for &i in order {
        let p = corners[i].position;
        let at = [((p.x - low[0]) / cell) as usize, ((p.y - low[1]) / cell) as usize];
        if is_covered[at[1].min(count[1] - 1) * count[0] + at[0].min(count[0] - 1)] {
            continue;
        }
        selected.push(i);
        let range = |a: usize, n: usize| a.saturating_sub(2)..(a + 3).min(n);
        for y in range(at[1], count[1]) {
            is_covered[y * count[0]..][range(at[0], count[0])].fill(true);
        }
    }
    selected
}

/// Returns the indices of `n` corners, evenly from `columns` × `rows` tiles: the strongest of every tile, then the
/// second strongest of every tile, and so on.
///
/// Corners of the same rank are sorted by decreasing response. Corners that are not finite are ignored. O(n log n).
pub fn anms_tiled(corners: &[Keypoint], n: usize, (columns, rows): (usize, usize)) -> Vec<usize> {
    let order = by_response(corners);
    let (low, high) = bounds(corners, &order);
    let (columns, rows) = (columns.max(1), rows.max(1));
    let tile = |v: f32, i: usize, n: usize| {
        let fraction = (v - low[i]) / (high[i] - low[i]).max(f32::MIN_POSITIVE);
        ((fraction * n as f32) as usize).min(n - 1)
    };
    let mut counts = std::collections::BTreeMap::new();
    let mut ranked: Vec<(usize, usize)> = order
        .into_iter()
        .map(|i| {
            let p = corners[i].position;
            let rank = counts.entry((tile(p.y, 1, rows), tile(p.x, 0, columns))).or_insert(0);
            *rank += 1;
            (*rank, i)
        })
        .collect();
    ranked.sort_by_key(|r| r.0);
    ranked.into_iter().take(n).map(|r| r.1).collect()
}

/// Returns the indices of the finite corners by decreasing response; ties by index.
fn by_response(corners: &[Keypoint]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..corners.len()).filter(|&i| is_finite(&corners[i])).collect();
    order.sort_by(|&a, &b| corners[b].response.total_cmp(&corners[a].response));
    order
}

/// Computes the bounding box of the corners `of`.
fn bounds(corners: &[Keypoint], of: &[usize]) -> ([f32; 2], [f32; 2]) {
    of.iter().fold(([f32::INFINITY; 2], [f32::NEG_INFINITY; 2]), |(low, high), &i| {
        let p = corners[i].position;
        ([low[0].min(p.x), low[1].min(p.y)], [high[0].max(p.x), high[1].max(p.y)])
    })
}
