//! A tree of boxes around shapes, so that a ray meets few of them.

use crate::shape::{Ray, Shape};
use nalgebra::{Point3, Vector3};

/// What a leaf holds.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Item {
    /// The surface with this index.
    Surface(u32, Shape),
    /// Six rectangles, the first with this index, in the order −z, +z, +x, −x, −y, +y of the box's own axes.
    Block { first: u32, center: Point3<f64>, axes: [Vector3<f64>; 3], half: [f64; 3] },
}

impl Item {
    fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        match self {
            Self::Surface(_, shape) => shape.bounds(),
            Self::Block { center, axes, half, .. } => {
                let reach = axes[0].abs() * half[0] + axes[1].abs() * half[1] + axes[2].abs() * half[2];
                let reach = reach + Vector3::repeat(1e-6);
                (center - reach, center + reach)
            }
        }
    }

    /// Distance and index of the first surface met in `(near, far)`.
    #[inline]
    pub(crate) fn intersect(&self, ray: &Ray, near: f64, far: f64) -> Option<(f64, u32)> {
        match self {
            Self::Surface(index, shape) => shape.intersect(ray, near, far).map(|t| (t, *index)),
            Self::Block { first, center, axes, half } => {
                let d = center - ray.origin;
                let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
                let (mut face_in, mut face_out) = (0, 0);
                // The faces with the smaller and the larger coordinate on each axis.
                const FACES: [(u32, u32); 3] = [(3, 2), (4, 5), (0, 1)];
                for a in 0..3 {
                    let (o, v) = (d.dot(&axes[a]), ray.dir.dot(&axes[a]));
                    let (t0, t1) = ((o - half[a]) / v, (o + half[a]) / v);
                    let (low, high) = FACES[a];
                    let (t0, t1, f0, f1) = if v < 0.0 { (t1, t0, high, low) } else { (t0, t1, low, high) };
                    if t0 > enter {
                        (enter, face_in) = (t0, f0);
                    }
                    if t1 < leave {
                        (leave, face_out) = (t1, f1);
                    }
                }
                if enter > leave {
                    return None;
                }
                if enter > near && enter < far {
                    return Some((enter, first + face_in));
                }
                (leave > near && leave < far && enter <= near).then_some((leave, first + face_out))
            }
        }
    }
}

#[derive(Debug, Clone)]
struct Node {
    low: [f64; 3],
    high: [f64; 3],
    /// Leaf: first index into `items`; inner node: its right child (the left one follows it).
    first: u32,
    /// Leaf: number of items; inner node: 0.
    count: u32,
    axis: usize,
}

/// Split where the surface area heuristic (MacDonald & Booth 1990) is least.
#[derive(Debug, Clone, Default)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    items: Vec<Item>,
}

/// Enough for any tree of fewer than 2³² items that halves; deeper parts become leaves.
const DEPTH: usize = 48;

#[derive(Clone, Copy)]
struct Bounds(Point3<f64>, Point3<f64>);

impl Bounds {
    const EMPTY: Self = Self(
        Point3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        Point3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    );

    fn join(&self, other: &Self) -> Self {
        Self(self.0.inf(&other.0), self.1.sup(&other.1))
    }

    fn area(&self) -> f64 {
        let d = self.1 - self.0;
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

impl Bvh {
    pub(crate) fn new(items: Vec<Item>) -> Self {
        let mut entries: Vec<(Bounds, Item)> =
            items.into_iter().map(|i| (Bounds(i.bounds().0, i.bounds().1), i)).collect();
        let mut tree = Self::default();
        if !entries.is_empty() {
            tree.build(&mut entries, 0);
        }
        tree
    }

    fn build(&mut self, entries: &mut [(Bounds, Item)], depth: usize) {
        let around = entries.iter().fold(Bounds::EMPTY, |b, e| b.join(&e.0));
        let index = self.nodes.len();
        let node = |first: usize, count: usize, axis| Node {
            low: around.0.coords.into(),
            high: around.1.coords.into(),
            first: first as u32,
            count: count as u32,
            axis,
        };
        let n = entries.len();
        // The best cut of the items in order along some axis; a leaf costs its items, an inner node one step more.
        let mut best = (n as f64 * around.area(), None);
        if n > 1 && depth + 2 < DEPTH {
            for axis in 0..3 {
                entries.sort_by(|a, b| (a.0.0[axis] + a.0.1[axis]).total_cmp(&(b.0.0[axis] + b.0.1[axis])));
                let mut right = vec![0.0; n];
                let mut b = Bounds::EMPTY;
                for i in (1..n).rev() {
                    b = b.join(&entries[i].0);
                    right[i] = b.area();
                }
                let mut b = Bounds::EMPTY;
                for i in 1..n {
                    b = b.join(&entries[i - 1].0);
                    let cost = 1.2 * around.area() + b.area() * i as f64 + right[i] * (n - i) as f64;
                    if cost < best.0 {
                        best = (cost, Some((axis, i)));
                    }
                }
            }
        }
        let Some((axis, cut)) = best.1 else {
            self.nodes.push(node(self.items.len(), n, 0));
            self.items.extend(entries.iter().map(|e| e.1));
            return;
        };
        entries.sort_by(|a, b| (a.0.0[axis] + a.0.1[axis]).total_cmp(&(b.0.0[axis] + b.0.1[axis])));
        self.nodes.push(node(0, 0, axis));
        let (left, right) = entries.split_at_mut(cut);
        self.build(left, depth + 1);
        self.nodes[index].first = self.nodes.len() as u32;
        self.build(right, depth + 1);
    }

    /// Visits the items whose boxes the ray enters before `far`, near ones first; `visit` returns the new `far`,
    /// −∞ to stop.
    #[inline]
    pub(crate) fn walk(&self, ray: &Ray, mut far: f64, mut visit: impl FnMut(&Item, f64) -> f64) {
        let origin: [f64; 3] = ray.origin.coords.into();
        let inverse: [f64; 3] = ray.dir.map(|d| 1.0 / d).into();
        let enters = |node: &Node, far: f64| {
            let (mut enter, mut leave) = (0.0f64, far);
            for a in 0..3 {
                let t0 = (node.low[a] - origin[a]) * inverse[a];
                let t1 = (node.high[a] - origin[a]) * inverse[a];
                // Comparisons with the NaN of an origin on the face of a box the ray runs along are false.
                let (t0, t1) = if t1 < t0 { (t1, t0) } else { (t0, t1) };
                enter = if t0 > enter { t0 } else { enter };
                leave = if t1 < leave { t1 } else { leave };
            }
            enter <= leave
        };
        let (mut stack, mut depth) = ([0u32; DEPTH], usize::from(!self.nodes.is_empty()));
        while depth > 0 {
            depth -= 1;
            let index = stack[depth] as usize;
            let node = &self.nodes[index];
            if !enters(node, far) {
                continue;
            }
            if node.count > 0 {
                for item in &self.items[node.first as usize..(node.first + node.count) as usize] {
                    far = visit(item, far);
                }
            } else {
                let (left, right) = (index as u32 + 1, node.first);
                let forward = inverse[node.axis] >= 0.0;
                stack[depth] = if forward { right } else { left };
                stack[depth + 1] = if forward { left } else { right };
                depth += 2;
            }
        }
    }
}
