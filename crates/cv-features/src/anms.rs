//! Adaptive non-maximal suppression.
//!
//! Source: M. Brown, R. Szeliski & S. Winder, "Multi-image matching using multi-scale oriented patches", CVPR 2005,
//! section 3. A corner's suppression radius is the distance to the nearest corner that is stronger by the factor `1 /
//! robust`; the `n` corners with the largest radii are kept. The definition is O(n²). Here a bounding volume hierarchy
//! with the maximum response of each node finds the nearest sufficiently stronger corner by branch and bound, and most
//! corners are pruned before: about O(n log n), with the same result.

use cv_core::Keypoint;
use cv_parallel::prelude::*;

/// Number of corners in a leaf of the tree.
const LEAF_SIZE: usize = 8;

/// Returns the indices of the `n` corners with the largest suppression radii, by decreasing radius.
///
/// The radius of corner i is the minimum distance to a corner j with `response_i < robust · response_j`, infinite if
/// there is none. Ties are ordered by decreasing response, then by index. `robust` is 0 to 1; Brown, Szeliski & Winder
/// use 0.9. Corners whose position or response is not finite are ignored.
pub fn anms(corners: &[Keypoint], n: usize, robust: f32) -> Vec<usize> {
    let tree = Tree::new(corners, robust);
    let total = tree.points.len();
    if n == 0 || total == 0 {
        return Vec::new();
    }
    let mut corner_radii = if total > 4 * n {
        // The n-th largest radius of any subset is a lower bound of the n-th largest of all: corners with a suppressor
        // closer than that are pruned without computing their radius. Strong corners have large radii.
        let mut strongest: Vec<u32> = (0..total as u32).collect();
        let response = |p: u32| tree.points[p as usize].response;
        strongest.select_nth_unstable_by(2 * n, |&a, &b| response(b).total_cmp(&response(a)).then(a.cmp(&b)));
        strongest.truncate(2 * n);
        let mut radii: Vec<f32> = tree.radii(&strongest, 0.0).into_iter().map(|f| f.1).collect();
        let bound = *radii.select_nth_unstable_by(n - 1, |a, b| b.total_cmp(a)).1;
        tree.radii(&tree.candidates(bound), bound)
    } else {
        tree.radii(&(0..total as u32).collect::<Vec<_>>(), 0.0)
    };
    let by_radius = |a: &(u32, f32), b: &(u32, f32)| {
        let response = |i: u32| corners[i as usize].response;
        b.1.total_cmp(&a.1).then(response(b.0).total_cmp(&response(a.0))).then(a.0.cmp(&b.0))
    };
    if n < corner_radii.len() {
        corner_radii.select_nth_unstable_by(n - 1, by_radius);
        corner_radii.truncate(n);
    }
    corner_radii.sort_unstable_by(by_radius);
    corner_radii.into_iter().map(|f| f.0 as usize).collect()
}

/// Computes the squared suppression radius of each corner, in squared pixels; NaN for corners that are not finite. See
/// [`anms`].
pub fn suppression_radii(corners: &[Keypoint], robust: f32) -> Vec<f32> {
    let tree = Tree::new(corners, robust);
    let mut radii = vec![f32::NAN; corners.len()];
    for (index, radius) in tree.radii(&(0..tree.points.len() as u32).collect::<Vec<_>>(), 0.0) {
        radii[index as usize] = radius;
    }
    radii
}

pub(crate) fn is_finite(c: &Keypoint) -> bool {
    c.position.x.is_finite() && c.position.y.is_finite() && c.response.is_finite()
}

#[derive(Clone, Copy)]
struct Point {
    at: [f32; 2],
    response: f32,
    /// Corners with a response below this value are suppressed by this one.
    suppresses: f32,
    index: u32,
}

/// The bounding box of some corners and the maximum of their `suppresses`.
#[derive(Clone, Copy)]
struct Node {
    low: [f32; 2],
    high: [f32; 2],
    suppresses: f32,
}

impl Node {
    const EMPTY: Self = Self { low: [f32::INFINITY; 2], high: [f32::NEG_INFINITY; 2], suppresses: f32::NEG_INFINITY };

    /// Returns the union of two nodes.
    fn union(&self, other: &Self) -> Self {
        Self {
            low: [self.low[0].min(other.low[0]), self.low[1].min(other.low[1])],
            high: [self.high[0].max(other.high[0]), self.high[1].max(other.high[1])],
            suppresses: self.suppresses.max(other.suppresses),
        }
    }

    /// Computes the squared distance of a point from the box.
    fn distance(&self, p: [f32; 2]) -> f32 {
        let d = |i: usize| (self.low[i] - p[i]).max(p[i] - self.high[i]).max(0.0);
        let (x, y) = (d(0), d(1));
        x * x + y * y
    }

    /// Computes the squared length of the diagonal, an upper bound of the squared distances of corners in the box (in
    /// the same arithmetic).
    fn diagonal(&self) -> f32 {
        let (x, y) = (self.high[0] - self.low[0], self.high[1] - self.low[1]);
        x * x + y * y
    }
}

/// A bounding volume hierarchy: the finite corners in Morton order in leaves of [`LEAF_SIZE`], and a binary tree of
/// boxes in which node `i` has the children `2i` and `2i + 1`.
struct Tree {
    nodes: Vec<Node>,
    points: Vec<Point>,
}

impl Tree {
    fn new(corners: &[Keypoint], robust: f32) -> Self {
        let mut bounds = Node::EMPTY;
        for c in corners.iter().filter(|c| is_finite(c)) {
            let at = [c.position.x, c.position.y];
            bounds = bounds.union(&Node { low: at, high: at, suppresses: 0.0 });
        }
        // The range may overflow; half of it does not.
        let scale = [0, 1].map(|i| 32767.0 / (0.5 * bounds.high[i] - 0.5 * bounds.low[i]).max(f32::MIN_POSITIVE));
        let cell = |v: f32, i: usize| spread_bits(((0.5 * v - 0.5 * bounds.low[i]) * scale[i]) as u32 & 0xFFFF);
        let keys = corners.iter().enumerate().filter(|(_, c)| is_finite(c)).map(|(i, c)| {
            let key = cell(c.position.x, 0) | cell(c.position.y, 1) << 1;
            u64::from(key) << 32 | i as u64
        });
        let points: Vec<Point> = sorted_by_high_half(keys.collect())
            .into_iter()
            .map(|key| {
                let c = &corners[key as u32 as usize];
                let at = [c.position.x, c.position.y];
                Point { at, response: c.response, suppresses: robust * c.response, index: key as u32 }
            })
            .collect();
        let leaves = points.len().div_ceil(LEAF_SIZE).next_power_of_two();
        let mut nodes = vec![Node::EMPTY; 2 * leaves];
        for (node, points) in nodes[leaves..].iter_mut().zip(points.chunks(LEAF_SIZE)) {
            for p in points {
                *node = node.union(&Node { low: p.at, high: p.at, suppresses: p.suppresses });
            }
        }
        for i in (1..leaves).rev() {
            nodes[i] = nodes[2 * i].union(&nodes[2 * i + 1]);
        }
        Self { nodes, points }
    }

    /// Returns the positions in `points` of all corners except those that share a box with a squared diagonal below
    /// `bound` with a corner that suppresses them.
    fn candidates(&self, bound: f32) -> Vec<u32> {
        let leaves = self.nodes.len() / 2;
        let mut candidates = Vec::new();
        for (leaf, points) in self.points.chunks(LEAF_SIZE).enumerate() {
            let (mut node, mut suppresses) = (leaves + leaf, f32::NEG_INFINITY);
            while node > 0 && self.nodes[node].diagonal() < bound {
                suppresses = self.nodes[node].suppresses;
                node /= 2;
            }
            let remaining = points.iter().enumerate().filter(|(_, p)| p.response >= suppresses);
            candidates.extend(remaining.map(|(i, _)| (leaf * LEAF_SIZE + i) as u32));
        }
        candidates
    }

    /// Computes index and squared radius of the corners at the positions `of`. A radius below `bound` may be replaced
    /// by another value below `bound`.
    fn radii(&self, of: &[u32], bound: f32) -> Vec<(u32, f32)> {
        of.par_iter()
            .with_min_len(128)
            .map(|&place| (self.points[place as usize].index, self.radius(place as usize, bound)))
            .collect()
    }

    fn radius(&self, place: usize, bound: f32) -> f32 {
        let Point { at, response, .. } = self.points[place];
        let leaves = self.nodes.len() / 2;
        let mut best = f32::INFINITY;
        // Depth-first traversal: at most one pending node per depth, and the last two.
        let mut stack = [(0.0f32, 0u32); 33];
        (stack[0], stack[1]) = ((0.0, 0), (0.0, 1));
        let mut height = 2;
        while height > 1 && best >= bound {
            height -= 1;
            let (distance, node) = stack[height];
            let node = node as usize;
            if distance >= best {
                continue;
            }
            if node >= leaves {
                for p in self.points.iter().skip((node - leaves) * LEAF_SIZE).take(LEAF_SIZE) {
                    let (x, y) = (p.at[0] - at[0], p.at[1] - at[1]);
                    let d = x * x + y * y;
                    if response < p.suppresses && d < best {
                        best = d;
                    }
                }
                continue;
            }
            let mut children = [2 * node, 2 * node + 1].map(|child| (self.nodes[child].distance(at), child as u32));
            // The nearer child on top.
            if children[0].0 < children[1].0 {
                children.swap(0, 1);
            }
            for child in children {
                if child.0 < best && response < self.nodes[child.1 as usize].suppresses {
                    stack[height] = child;
                    height += 1;
                }
            }
        }
        best
    }
}

/// Spreads the 16 low bits to the even bit positions (Morton code).
fn spread_bits(v: u32) -> u32 {
    let v = (v | v << 8) & 0x00FF_00FF;
    let v = (v | v << 4) & 0x0F0F_0F0F;
    let v = (v | v << 2) & 0x3333_3333;
    (v | v << 1) & 0x5555_5555
}

/// Sorts stably by the upper 32 bits: a radix sort with four passes.
fn sorted_by_high_half(mut keys: Vec<u64>) -> Vec<u64> {
    let mut other = vec![0; keys.len()];
    for shift in [32, 40, 48, 56] {
        let digit = |key: u64| (key >> shift) as usize & 255;
        let mut offsets = [0usize; 256];
        keys.iter().for_each(|&key| offsets[digit(key)] += 1);
        let mut sum = 0;
        offsets.iter_mut().for_each(|p| sum += std::mem::replace(p, sum));
        for &key in &keys {
            let p = &mut offsets[digit(key)];
            other[*p] = key;
            *p += 1;
        }
        std::mem::swap(&mut keys, &mut other);
    }
    keys
}
