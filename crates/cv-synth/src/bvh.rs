//! A bounding volume hierarchy for ray casting.

use crate::shape::{Ray, Shape};
use fearless_simd::{Level, dispatch, f32x8, prelude::*};
use fearless_simd_macros::simd;
use nalgebra::{Point3, Vector3};

/// An item of a leaf.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Item {
    /// The surface with this index.
    Surface(u32, Shape),
    /// A box of six rectangles, the first with this index, in the order −z, +z, +x, −x, −y, +y of the box's own axes.
    Block { first: u32, center: Point3<f64>, axes: [Vector3<f64>; 3], half: [f64; 3] },
}

impl Item {
    /// Returns the corners of the axis-aligned bounding box.
    fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        match self {
            Self::Surface(_, shape) => shape.bounds(),
            Self::Block { center, axes, half, .. } => {
                let half_diagonal = axes[0].abs() * half[0] + axes[1].abs() * half[1] + axes[2].abs() * half[2];
                let half_diagonal = half_diagonal + Vector3::repeat(1e-6);
                (center - half_diagonal, center + half_diagonal)
            }
        }
    }

    /// Returns distance and index of the first surface hit in `(near, far)`.
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

/// A node of the binary tree.
struct Branch {
    bounds: Bounds,
    /// Leaf: first index into `entries`; inner node: index of its right child (the left child follows the node).
    first: u32,
    /// Leaf: number of items; inner node: 0.
    count: u32,
    axis: usize,
}

/// Number of children of a wide node: the lanes of the widest vectors.
const CHILDREN: usize = 8;

/// A node of the wide tree that rays traverse: several levels of the binary tree, whose boxes are tested against a ray
/// at once.
///
/// In single precision, which halves the memory: box tests are conservative, and items are intersected in double
/// precision.
#[derive(Debug, Clone)]
#[repr(align(64))]
struct Node {
    /// For each axis the lower and upper sides of the children's boxes; boxes of missing children are empty.
    sides: [[[f32; CHILDREN]; 2]; 3],
    children: [Child; CHILDREN],
    /// For each octant of directions (bit 0: negative x, bit 1: negative y, bit 2: negative z) the children from far to
    /// near, four bits each, from the lowest bits up.
    order: [u32; 8],
}

/// Inner node: twice its index; leaf: twice the index of its first item, plus one.
#[derive(Debug, Clone, Copy, Default)]
struct Child(u32);

/// An item, in the list of all leaves.
#[derive(Debug, Clone, Copy)]
struct Entry {
    item: Item,
    /// Whether it is the last one of its leaf.
    last: bool,
}

/// A tree built by the surface area heuristic (MacDonald & Booth 1990) and collapsed to wide nodes (Dammertz, Hanika &
/// Keller 2008).
#[derive(Debug, Clone)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    entries: Vec<Entry>,
    /// The largest absolute coordinate of the boxes.
    extent: f64,
    level: Level,
}

/// Maximum depth: enough for a balanced tree of fewer than 2³² items; deeper subtrees become leaves.
const MAX_DEPTH: usize = 48;
/// Minimum number of binary levels in a wide node.
const LEVELS_PER_NODE: usize = CHILDREN.ilog2() as usize;
/// Size of the traversal stack: for every node on the path, all children but one.
const STACK_SIZE: usize = MAX_DEPTH / LEVELS_PER_NODE * (CHILDREN - 1) + CHILDREN;

#[derive(Clone, Copy)]
struct Bounds(Point3<f64>, Point3<f64>);

impl Bounds {
    const EMPTY: Self = Self(
        Point3::new(f64::INFINITY, f64::INFINITY, f64::INFINITY),
        Point3::new(f64::NEG_INFINITY, f64::NEG_INFINITY, f64::NEG_INFINITY),
    );

    fn union(&self, other: &Self) -> Self {
        Self(self.0.inf(&other.0), self.1.sup(&other.1))
    }

    fn area(&self) -> f64 {
        let d = self.1 - self.0;
        d.x * d.y + d.y * d.z + d.z * d.x
    }
}

/// The binary tree under construction.
#[derive(Default)]
struct Builder {
    branches: Vec<Branch>,
    entries: Vec<Entry>,
}

impl Builder {
    /// Builds the subtree of some items.
    fn build(&mut self, entries: &mut [(Bounds, Item)], depth: usize) {
        let bounds = entries.iter().fold(Bounds::EMPTY, |b, e| b.union(&e.0));
        let index = self.branches.len();
        let branch =
            |first: usize, count: usize, axis| Branch { bounds, first: first as u32, count: count as u32, axis };
        let n = entries.len();
        // The best split of the items along an axis by the surface area heuristic: a leaf costs its items, an inner
        // node one traversal step more.
        let mut best = (n as f64 * bounds.area(), None);
        if n > 1 && depth + 2 < MAX_DEPTH {
            for axis in 0..3 {
                entries.sort_by(|a, b| (a.0.0[axis] + a.0.1[axis]).total_cmp(&(b.0.0[axis] + b.0.1[axis])));
                let mut right = vec![0.0; n];
                let mut b = Bounds::EMPTY;
                for i in (1..n).rev() {
                    b = b.union(&entries[i].0);
                    right[i] = b.area();
                }
                let mut b = Bounds::EMPTY;
                for i in 1..n {
                    b = b.union(&entries[i - 1].0);
                    let cost = 1.2 * bounds.area() + b.area() * i as f64 + right[i] * (n - i) as f64;
                    if cost < best.0 {
                        best = (cost, Some((axis, i)));
                    }
                }
            }
        }
        let Some((axis, cut)) = best.1 else {
            self.branches.push(branch(self.entries.len(), n, 0));
            self.entries.extend(entries.iter().enumerate().map(|(i, e)| Entry { item: e.1, last: i + 1 == n }));
            return;
        };
        entries.sort_by(|a, b| (a.0.0[axis] + a.0.1[axis]).total_cmp(&(b.0.0[axis] + b.0.1[axis])));
        self.branches.push(branch(0, 0, axis));
        let (left, right) = entries.split_at_mut(cut);
        self.build(left, depth + 1);
        self.branches[index].first = self.branches.len() as u32;
        self.build(right, depth + 1);
    }

    /// Collapses a subtree of the binary tree to wide nodes, and returns the index of its root.
    fn collapse(&self, root: u32, nodes: &mut Vec<Node>) -> u32 {
        // Branches that become children, with their depth below the root, and branches that are collapsed into the
        // node.
        let mut children = vec![(root, 0)];
        let mut collapsed = Vec::new();
        while children.len() < CHILDREN {
            // First all levels that always fit, then the largest boxes.
            let rank = |&(branch, depth): &(u32, usize)| {
                (depth < LEVELS_PER_NODE, self.branches[branch as usize].bounds.area())
            };
            let inner = children.iter().enumerate().filter(|(_, c)| self.branches[c.0 as usize].count == 0);
            let largest = inner.max_by(|a, b| {
                let (a, b) = (rank(a.1), rank(b.1));
                a.0.cmp(&b.0).then(a.1.total_cmp(&b.1))
            });
            let Some((i, &(branch, depth))) = largest else { break };
            children[i] = (branch + 1, depth + 1);
            children.push((self.branches[branch as usize].first, depth + 1));
            collapsed.push(branch);
        }
        let index = nodes.len();
        let mut node = Node {
            sides: [[[f32::INFINITY; CHILDREN], [f32::NEG_INFINITY; CHILDREN]]; 3],
            children: [Child::default(); CHILDREN],
            order: [0; 8],
        };
        for (i, (branch, _)) in children.iter().enumerate() {
            let Bounds(low, high) = self.branches[*branch as usize].bounds;
            for axis in 0..3 {
                node.sides[axis][0][i] = (low[axis] as f32).next_down();
                node.sides[axis][1][i] = (high[axis] as f32).next_up();
            }
        }
        for (octant, order) in node.order.iter_mut().enumerate() {
            // Far children first. Missing children come last; they are never hit.
            let mut positions = 0..CHILDREN;
            let mut append =
                |child: usize| positions.next().into_iter().for_each(|place| *order |= (child as u32) << (4 * place));
            let mut stack = vec![root];
            while let Some(branch) = stack.pop() {
                if collapsed.contains(&branch) {
                    let Branch { first: right, axis, .. } = self.branches[branch as usize];
                    let forward = octant >> axis & 1 == 0;
                    stack.extend(if forward { [branch + 1, right] } else { [right, branch + 1] });
                } else {
                    children.iter().position(|c| c.0 == branch).into_iter().for_each(&mut append);
                }
            }
            (children.len()..CHILDREN).for_each(append);
        }
        nodes.push(node);
        for (i, (branch, _)) in children.iter().enumerate() {
            let Branch { first, count, .. } = self.branches[*branch as usize];
            nodes[index].children[i] = Child(if count > 0 { 2 * first + 1 } else { 2 * self.collapse(*branch, nodes) });
        }
        index as u32
    }
}

impl Bvh {
    pub(crate) fn new(items: Vec<Item>) -> Self {
        let mut entries: Vec<(Bounds, Item)> =
            items.into_iter().map(|i| (Bounds(i.bounds().0, i.bounds().1), i)).collect();
        let (mut tree, mut nodes) = (Builder::default(), Vec::new());
        let mut extent = 0.0;
        if !entries.is_empty() {
            tree.build(&mut entries, 0);
            tree.collapse(0, &mut nodes);
            let Bounds(low, high) = tree.branches[0].bounds;
            extent = low.coords.amax().max(high.coords.amax());
        }
        Self { nodes, entries: tree.entries, extent, level: Level::new() }
    }

    /// Returns the same tree, traversed with another instruction set.
    #[cfg(test)]
    pub(crate) fn at_level(self, level: Level) -> Self {
        Self { level, ..self }
    }

    /// Visits the items whose boxes the ray enters before `far`, in approximate near-to-far order, and possibly others.
    /// `visit` returns the new `far`; −∞ stops the traversal.
    #[inline]
    pub(crate) fn traverse(&self, ray: &Ray, far: f64, visit: impl FnMut(&Item, f64) -> f64) {
        dispatch!(self.level, simd => traverse_impl(simd, self, ray, far, visit));
    }
}

/// Relative tolerance of the distances to the sides of boxes: more than two roundings of single precision.
const TOLERANCE: f32 = 1e-6;

#[simd]
fn traverse_impl<S: Simd, V: FnMut(&Item, f64) -> f64>(simd: S, tree: &Bvh, ray: &Ray, mut far: f64, mut visit: V) {
    // Finite for rays along an axis: infinity times a zero distance would be NaN.
    let inverse: [f32; 3] = std::array::from_fn(|a| (1.0 / ray.dir[a]).clamp(-1e30, 1e30) as f32);
    let is_negative: [usize; 3] = std::array::from_fn(|a| usize::from(ray.dir[a].is_sign_negative()));
    let octant = is_negative[0] | is_negative[1] << 1 | is_negative[2] << 2;
    // The ray's origin relative to the lower and upper sides of boxes, moved apart by more than the rounding errors, so
    // that boxes grow.
    let origins: [[f32; 2]; 3] = std::array::from_fn(|a| {
        let margin = (ray.origin[a].abs() + tree.extent) * 5e-7;
        [(ray.origin[a] + margin) as f32, (ray.origin[a] - margin) as f32]
    });
    let (mut stack, mut depth) = ([(Child::default(), 0.0); STACK_SIZE], usize::from(!tree.nodes.is_empty()));
    let mut limit = far as f32 * (1.0 + TOLERANCE);
    while depth > 0 {
        depth -= 1;
        let (Child(child), enter) = stack[depth];
        if enter > limit {
            continue;
        }
        let index = (child / 2) as usize;
        if child & 1 == 1 {
            for entry in &tree.entries[index..] {
                far = visit(&entry.item, far);
                if entry.last {
                    break;
                }
            }
            limit = far as f32 * (1.0 + TOLERANCE);
            continue;
        }
        let node = &tree.nodes[index];
        let (mut enter, mut leave) = (f32x8::splat(simd, 0.0), f32x8::splat(simd, f32::INFINITY));
        for a in 0..3 {
            let [near, far] = [is_negative[a], 1 - is_negative[a]]
                .map(|side| (f32x8::from_slice(simd, &node.sides[a][side]) - origins[a][side]) * inverse[a]);
            (enter, leave) = (near.max(enter), far.min(leave));
        }
        let leave = (leave * (1.0 + TOLERANCE)).min(f32x8::splat(simd, limit));
        let is_hit = enter.simd_le(leave).to_bitmask();
        let mut enters = [0.0; CHILDREN];
        enter.store_slice(&mut enters);
        let mut order = node.order[octant];
        for _ in 0..CHILDREN {
            // Written unconditionally and kept only for a hit: the branch would be unpredictable.
            let child = order as usize % CHILDREN;
            order >>= 4;
            stack[depth] = (node.children[child], enters[child]);
            depth += (is_hit >> child & 1) as usize;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::instruction_sets;
    use crate::rng::Rng;
    use nalgebra::Rotation3;

    /// Returns rectangles, spheres, frusta and boxes, some of them axis-aligned, up to 40 m from the origin.
    fn items(count: u32, rng: &mut Rng) -> Vec<Item> {
        let mut vector = |range: f64| Vector3::from_fn(|_, _| rng.range(-range, range));
        (0..count)
            .map(|i| {
                let (center, size, turn) = (Point3::from(vector(40.0)), vector(1.0), vector(1.0));
                let turn = if i % 2 == 0 { Rotation3::identity() } else { Rotation3::new(turn) };
                let [x, y, z] = [0, 1, 2].map(|a| turn * Vector3::ith(a, 1.0));
                let round = i % 4 == 0;
                match i % 5 {
                    0 => Item::Surface(6 * i, Shape::rect(center, x * 3.0, y * 5.0, round)),
                    1 => Item::Surface(6 * i, Shape::Sphere { center, radius: 2.0 * size.x.abs() }),
                    2 => Item::Surface(6 * i, Shape::Frustum { base: center, axis: z, length: 4.0, radii: (0.5, 1.5) }),
                    _ => {
                        Item::Block { first: 6 * i, center, axes: [x, y, z], half: size.map(|s| s.abs() + 0.01).into() }
                    }
                }
            })
            .collect()
    }

    #[test]
    fn rays_hit_the_same_surface_with_and_without_a_tree_on_every_instruction_set() {
        let mut rng = Rng::new(3, 4);
        let (mut met, mut missed) = (0, 0);
        for count in [0, 1, 2, 7, 9, 60, 700] {
            let items = items(count, &mut rng);
            for level in instruction_sets() {
                let tree = Bvh::new(items.clone()).at_level(level);
                for i in 0..2000 {
                    let mut vector = |reach: f64| Vector3::from_fn(|_, _| rng.range(-reach, reach));
                    let (mut origin, mut dir) = (Point3::from(vector(45.0)), vector(1.0));
                    if i % 3 == 0 {
                        // Along an axis, from the side or the center of an item's box.
                        dir = Vector3::ith(i % 9 / 3, dir.x.signum());
                        if let Some(item) = items.get(i % items.len().max(1)) {
                            origin = if i % 2 == 0 {
                                item.bounds().0
                            } else {
                                nalgebra::center(&item.bounds().0, &item.bounds().1)
                            };
                        }
                    }
                    let ray = Ray { origin, dir };
                    let mut found = None;
                    tree.traverse(&ray, f64::INFINITY, |item, far| {
                        let hit = item.intersect(&ray, 1e-9, far);
                        found = hit.or(found);
                        hit.map_or(far, |hit| hit.0)
                    });
                    let plain = items.iter().fold(None, |best: Option<(f64, u32)>, item| {
                        item.intersect(&ray, 1e-9, best.map_or(f64::INFINITY, |best| best.0)).or(best)
                    });
                    let bits = |hit: Option<(f64, u32)>| hit.map(|(t, index)| (t.to_bits(), index));
                    let (found, plain) = (bits(found), bits(plain));
                    assert_eq!(found, plain, "{level:?} {count} {ray:?}");
                    let counted = if found.is_some() { &mut met } else { &mut missed };
                    *counted += 1;
                }
            }
        }
        assert!(met > 2000 && missed > 2000, "{met} {missed}");
    }

    #[test]
    fn children_are_visited_in_the_order_of_the_binary_tree() {
        let mut rng = Rng::new(5, 6);
        let items = items(300, &mut rng);
        let mut entries: Vec<_> = items.iter().map(|i| (Bounds(i.bounds().0, i.bounds().1), *i)).collect();
        let mut binary = Builder::default();
        binary.build(&mut entries, 0);
        let tree = Bvh::new(items);
        for octant in 0..8 {
            let (mut plain, mut stack) = (Vec::new(), vec![0]);
            while let Some(i) = stack.pop() {
                let Branch { first, count, axis, .. } = binary.branches[i as usize];
                match (count, octant >> axis & 1) {
                    (0, 0) => stack.extend([first, i + 1]),
                    (0, _) => stack.extend([i + 1, first]),
                    _ => plain.push(first),
                }
            }
            let (mut found, mut stack) = (Vec::new(), vec![Child(0)]);
            while let Some(Child(child)) = stack.pop() {
                if child & 1 == 1 {
                    found.push(child / 2);
                    continue;
                }
                let node = &tree.nodes[(child / 2) as usize];
                let child = |k: usize| node.order[octant] as usize >> (4 * k) & 7;
                let children = (0..CHILDREN).map(child).filter(|&c| node.sides[0][0][c].is_finite());
                stack.extend(children.map(|c| node.children[c]));
            }
            assert_eq!(found, plain, "{octant}");
        }
    }
}
