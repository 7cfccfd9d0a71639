//! Adaptive non-maximal suppression.
//!
//! Source: M. Brown, R. Szeliski & S. Winder, "Multi-image matching using multi-scale oriented patches", CVPR 2005, section 3.
//! A corner's suppression radius is the distance to the nearest corner that is stronger by the factor `1 / robust`; the `n` corners with the
//! largest radii are kept. The definition costs O(n²); here a k-d tree whose nodes know their largest response answers
//! "nearest sufficiently stronger corner" by branch and bound, near O(n log n) in all, with the same result.

use cv_core::Keypoint;
use rayon::prelude::*;

/// Corners in a leaf of the tree.
const LEAF: usize = 8;

/// Keeps the `n` corners with the largest suppression radii, in order of falling radius.
///
/// Radius of corner i: the smallest distance to a corner j with `response_i < robust · response_j`, infinite where there is none. Equal radii are
/// ordered by falling response, then by index. `robust` is 0 to 1; Brown, Szeliski & Winder use 0.9. Corners whose position
/// or response is not finite are never chosen and suppress nothing.
pub fn anms(corners: &[Keypoint], n: usize, robust: f32) -> Vec<usize> {
    let radii = suppression_radii(corners, robust);
    let mut order: Vec<usize> = (0..corners.len()).filter(|&i| !radii[i].is_nan()).collect();
    let by_radius = |&a: &usize, &b: &usize| {
        radii[b].total_cmp(&radii[a]).then(corners[b].response.total_cmp(&corners[a].response)).then(a.cmp(&b))
    };
    if n == 0 {
        return Vec::new();
    }
    if n < order.len() {
        order.select_nth_unstable_by(n - 1, by_radius);
        order.truncate(n);
    }
    order.sort_unstable_by(by_radius);
    order
}

/// The squared suppression radius of each corner, in square pixels; NaN for a corner that is not finite. See [`anms`].
pub fn suppression_radii(corners: &[Keypoint], robust: f32) -> Vec<f32> {
    let mut points: Vec<Point> = corners
        .iter()
        .enumerate()
        .filter(|(_, c)| usable(c))
        .map(|(i, c)| Point { at: [c.position.x, c.position.y], suppresses: robust * c.response, index: i as u32 })
        .collect();
    let mut radii = vec![f32::NAN; corners.len()];
    if points.is_empty() {
        return radii;
    }
    let mut nodes = vec![Node::default(); 2 * points.len().div_ceil(LEAF).next_power_of_two()];
    build(&mut nodes, 1, &mut points);
    let found: Vec<(u32, f32)> = points
        .par_iter()
        .with_min_len(256)
        .map(|p| {
            let mut best = f32::INFINITY;
            nearest(&nodes, &points, 1, (0, points.len()), p.at, corners[p.index as usize].response, &mut best);
            (p.index, best)
        })
        .collect();
    for (index, radius) in found {
        radii[index as usize] = radius;
    }
    radii
}

fn usable(c: &Keypoint) -> bool {
    c.position.x.is_finite() && c.position.y.is_finite() && c.response.is_finite()
}

#[derive(Clone, Copy)]
struct Point {
    at: [f32; 2],
    /// Corners with a response below this are suppressed by this one.
    suppresses: f32,
    index: u32,
}

/// A node of the implicit tree: the box of its corners and the largest `suppresses` among them. Node `i` has children `2i` and `2i + 1`, each
/// with half of the corners.
#[derive(Clone, Copy)]
struct Node {
    low: [f32; 2],
    high: [f32; 2],
    suppresses: f32,
}

impl Default for Node {
    fn default() -> Self {
        Self { low: [f32::INFINITY; 2], high: [f32::NEG_INFINITY; 2], suppresses: f32::NEG_INFINITY }
    }
}

impl Node {
    /// Squared distance from the box.
    fn distance(&self, p: [f32; 2]) -> f32 {
        let d = |i: usize| (self.low[i] - p[i]).max(p[i] - self.high[i]).max(0.0);
        let (x, y) = (d(0), d(1));
        x * x + y * y
    }
}

fn build(nodes: &mut [Node], node: usize, points: &mut [Point]) {
    let mut bounds = Node::default();
    for p in points.iter() {
        for (i, v) in p.at.into_iter().enumerate() {
            bounds.low[i] = bounds.low[i].min(v);
            bounds.high[i] = bounds.high[i].max(v);
        }
        bounds.suppresses = bounds.suppresses.max(p.suppresses);
    }
    nodes[node] = bounds;
    if points.len() > LEAF {
        let axis = usize::from(bounds.high[1] - bounds.low[1] > bounds.high[0] - bounds.low[0]);
        let middle = points.len() / 2;
        points.select_nth_unstable_by(middle, |a, b| a.at[axis].total_cmp(&b.at[axis]));
        let (left, right) = points.split_at_mut(middle);
        build(nodes, 2 * node, left);
        build(nodes, 2 * node + 1, right);
    }
}

/// Lowers `best` to the squared distance of the nearest corner that suppresses `response`.
fn nearest(
    nodes: &[Node],
    points: &[Point],
    node: usize,
    (from, to): (usize, usize),
    at: [f32; 2],
    response: f32,
    best: &mut f32,
) {
    if to - from <= LEAF {
        for p in &points[from..to] {
            let (x, y) = (p.at[0] - at[0], p.at[1] - at[1]);
            let d = x * x + y * y;
            if response < p.suppresses && d < *best {
                *best = d;
            }
        }
        return;
    }
    let middle = from + (to - from) / 2;
    let mut children = [(2 * node, (from, middle)), (2 * node + 1, (middle, to))];
    let mut distance = children.map(|(child, _)| nodes[child].distance(at));
    if distance[1] < distance[0] {
        children.swap(0, 1);
        distance.swap(0, 1);
    }
    for ((child, range), d) in children.into_iter().zip(distance) {
        if d < *best && response < nodes[child].suppresses {
            nearest(nodes, points, child, range, at, response, best);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// The definition, O(n²).
    fn plain(corners: &[Keypoint], n: usize, robust: f32) -> Vec<usize> {
        let radius = |i: usize| {
            let c = &corners[i];
            corners
                .iter()
                .filter(|o| usable(o) && c.response < robust * o.response)
                .map(|o| {
                    let d = o.position - c.position;
                    d.x * d.x + d.y * d.y
                })
                .fold(f32::INFINITY, f32::min)
        };
        let mut all: Vec<(f32, usize)> =
            (0..corners.len()).filter(|&i| usable(&corners[i])).map(|i| (radius(i), i)).collect();
        all.sort_by(|a, b| {
            b.0.total_cmp(&a.0).then(corners[b.1].response.total_cmp(&corners[a.1].response)).then(a.1.cmp(&b.1))
        });
        all.into_iter().take(n).map(|(_, i)| i).collect()
    }

    /// Positions on a coarse grid and few responses, so that coincident corners, equal distances and equal responses all occur.
    fn coarse() -> impl Strategy<Value = Vec<Keypoint>> {
        prop::collection::vec((0i32..40, 0i32..9, -2i32..12), 0..300)
            .prop_map(|v| v.into_iter().map(|(x, y, r)| Keypoint::new(x as f32, y as f32, r as f32 * 0.1)).collect())
    }

    fn fine() -> impl Strategy<Value = Vec<Keypoint>> {
        prop::collection::vec((0.0f32..1000.0, 0.0f32..700.0, 0.0f32..1.0), 0..600)
            .prop_map(|v| v.into_iter().map(|(x, y, r)| Keypoint::new(x, y, r * r)).collect())
    }

    proptest! {
        #[test]
        fn equals_the_definition(corners in prop_oneof![coarse(), fine()], n in 0usize..400, robust in prop_oneof![Just(0.9f32), 0.1f32..1.0]) {
            prop_assert_eq!(anms(&corners, n, robust), plain(&corners, n, robust));
        }
    }

    #[test]
    fn corners_that_are_not_finite_are_left_out() {
        let corners = [
            Keypoint::new(f32::NAN, 1.0, 9.0),
            Keypoint::new(1.0, 1.0, f32::INFINITY),
            Keypoint::new(5.0, 5.0, 1.0),
            Keypoint::new(5.0, 8.0, 0.5),
        ];
        assert_eq!(anms(&corners, 10, 0.9), [2, 3]);
        assert_eq!(suppression_radii(&corners, 0.9)[2..], [f32::INFINITY, 9.0]);
        assert_eq!(anms(&[], 10, 0.9), [0usize; 0]);
    }
}
