//! A tree of boxes around shapes, so that a ray meets few of them.

use crate::shape::{Ray, Shape};
use fearless_simd::{Level, dispatch, f32x8, prelude::*};
use fearless_simd_macros::simd;
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

/// A node of the tree that is built, whose inner nodes have two children.
struct Branch {
    around: Bounds,
    /// Leaf: first index into `entries`; inner node: its right child (the left one follows it).
    first: u32,
    /// Leaf: number of items; inner node: 0.
    count: u32,
    axis: usize,
}

/// Children of a node: as many as the widest vectors hold.
const WIDTH: usize = 8;

/// A node of the tree that rays walk: some levels of the one that was built, whose boxes are compared with a ray at once.
///
/// In single precision, which takes half of the memory: boxes are compared so that none is missed for it, and what is in them is
/// intersected in double precision.
#[derive(Debug, Clone)]
#[repr(align(64))]
struct Node {
    /// For each axis the low and the high sides of the children's boxes; those of missing children hold nothing.
    sides: [[[f32; WIDTH]; 2]; 3],
    children: [Child; WIDTH],
    /// For each octant of directions (bit 0: against x, bit 1: against y, bit 2: against z) the children from far to near, four bits
    /// each, from the lowest bits up.
    order: [u32; 8],
}

/// Inner node: its index times two; leaf: that of its first item times two, plus one.
#[derive(Debug, Clone, Copy, Default)]
struct Child(u32);

/// An item of a leaf.
#[derive(Debug, Clone, Copy)]
struct Entry {
    item: Item,
    /// True for the last one of its leaf.
    last: bool,
}

/// Split where the surface area heuristic (MacDonald & Booth 1990) is least, then widened (Dammertz, Hanika & Keller 2008).
#[derive(Debug, Clone)]
pub(crate) struct Bvh {
    nodes: Vec<Node>,
    entries: Vec<Entry>,
    /// The largest coordinate of the boxes, as an amount.
    extent: f64,
    level: Level,
}

/// Enough for any tree of fewer than 2³² items that halves; deeper parts become leaves.
const DEPTH: usize = 48;
/// Levels of the tree that was built in a node, at least.
const LEVELS: usize = WIDTH.ilog2() as usize;
/// Children that wait: of every node on the way down all but one.
const STACK: usize = DEPTH / LEVELS * (WIDTH - 1) + WIDTH;

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

/// The tree while it is built.
#[derive(Default)]
struct Builder {
    branches: Vec<Branch>,
    entries: Vec<Entry>,
}

impl Builder {
    fn build(&mut self, entries: &mut [(Bounds, Item)], depth: usize) {
        let around = entries.iter().fold(Bounds::EMPTY, |b, e| b.join(&e.0));
        let index = self.branches.len();
        let branch =
            |first: usize, count: usize, axis| Branch { around, first: first as u32, count: count as u32, axis };
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

    /// Makes a node of a branch and as many of those below it as it holds; returns its index.
    fn widen(&self, root: u32, nodes: &mut Vec<Node>) -> u32 {
        // Branches that become children, with their depth below the root, and those that become part of the node.
        let mut children = vec![(root, 0)];
        let mut within = Vec::new();
        while children.len() < WIDTH {
            // All levels that surely have room, then the largest boxes.
            let rank = |&(branch, depth): &(u32, usize)| (depth < LEVELS, self.branches[branch as usize].around.area());
            let inner = children.iter().enumerate().filter(|(_, c)| self.branches[c.0 as usize].count == 0);
            let largest = inner.max_by(|a, b| {
                let (a, b) = (rank(a.1), rank(b.1));
                a.0.cmp(&b.0).then(a.1.total_cmp(&b.1))
            });
            let Some((i, &(branch, depth))) = largest else { break };
            children[i] = (branch + 1, depth + 1);
            children.push((self.branches[branch as usize].first, depth + 1));
            within.push(branch);
        }
        let index = nodes.len();
        let mut node = Node {
            sides: [[[f32::INFINITY; WIDTH], [f32::NEG_INFINITY; WIDTH]]; 3],
            children: [Child::default(); WIDTH],
            order: [0; 8],
        };
        for (i, (branch, _)) in children.iter().enumerate() {
            let Bounds(low, high) = self.branches[*branch as usize].around;
            for axis in 0..3 {
                node.sides[axis][0][i] = (low[axis] as f32).next_down();
                node.sides[axis][1][i] = (high[axis] as f32).next_up();
            }
        }
        for (octant, order) in node.order.iter_mut().enumerate() {
            // Far ones first. The missing children come last; they are never met.
            let mut places = 0..WIDTH;
            let mut put =
                |child: usize| places.next().into_iter().for_each(|place| *order |= (child as u32) << (4 * place));
            let mut rest = vec![root];
            while let Some(branch) = rest.pop() {
                if within.contains(&branch) {
                    let Branch { first: right, axis, .. } = self.branches[branch as usize];
                    let forward = octant >> axis & 1 == 0;
                    rest.extend(if forward { [branch + 1, right] } else { [right, branch + 1] });
                } else {
                    children.iter().position(|c| c.0 == branch).into_iter().for_each(&mut put);
                }
            }
            (children.len()..WIDTH).for_each(put);
        }
        nodes.push(node);
        for (i, (branch, _)) in children.iter().enumerate() {
            let Branch { first, count, .. } = self.branches[*branch as usize];
            nodes[index].children[i] = Child(if count > 0 { 2 * first + 1 } else { 2 * self.widen(*branch, nodes) });
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
            tree.widen(0, &mut nodes);
            let Bounds(low, high) = tree.branches[0].around;
            extent = low.coords.amax().max(high.coords.amax());
        }
        Self { nodes, entries: tree.entries, extent, level: Level::new() }
    }

    /// The same tree, walked with another instruction set.
    #[cfg(test)]
    pub(crate) fn at_level(self, level: Level) -> Self {
        Self { level, ..self }
    }

    /// Visits the items whose boxes the ray enters before `far`, near ones first, and maybe some others; `visit` returns the new
    /// `far`, −∞ to stop.
    #[inline]
    pub(crate) fn walk(&self, ray: &Ray, far: f64, visit: impl FnMut(&Item, f64) -> f64) {
        dispatch!(self.level, simd => walk_impl(simd, self, ray, far, visit));
    }
}

/// More than the relative error of the distances to the sides of boxes: two roundings of single precision.
const SLACK: f32 = 1e-6;

#[simd]
fn walk_impl<S: Simd, V: FnMut(&Item, f64) -> f64>(simd: S, tree: &Bvh, ray: &Ray, mut far: f64, mut visit: V) {
    // Not infinite where a ray runs along an axis: times the nothing between its origin and the side of a box that were not a number.
    let inverse: [f32; 3] = std::array::from_fn(|a| (1.0 / ray.dir[a]).clamp(-1e30, 1e30) as f32);
    let against: [usize; 3] = std::array::from_fn(|a| usize::from(ray.dir[a].is_sign_negative()));
    let octant = against[0] | against[1] << 1 | against[2] << 2;
    // The ray's origin as seen from the low and the high sides of boxes: apart by more than the roundings of it and of the difference
    // between the two, so that boxes grow by them.
    let origins: [[f32; 2]; 3] = std::array::from_fn(|a| {
        let apart = (ray.origin[a].abs() + tree.extent) * 5e-7;
        [(ray.origin[a] + apart) as f32, (ray.origin[a] - apart) as f32]
    });
    let (mut stack, mut depth) = ([(Child::default(), 0.0); STACK], usize::from(!tree.nodes.is_empty()));
    let mut limit = far as f32 * (1.0 + SLACK);
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
            limit = far as f32 * (1.0 + SLACK);
            continue;
        }
        let node = &tree.nodes[index];
        let (mut enter, mut leave) = (f32x8::splat(simd, 0.0), f32x8::splat(simd, f32::INFINITY));
        for a in 0..3 {
            let [near, far] = [against[a], 1 - against[a]]
                .map(|side| (f32x8::from_slice(simd, &node.sides[a][side]) - origins[a][side]) * inverse[a]);
            (enter, leave) = (near.max(enter), far.min(leave));
        }
        let leave = (leave * (1.0 + SLACK)).min(f32x8::splat(simd, limit));
        let met = enter.simd_le(leave).to_bitmask();
        let mut enters = [0.0; WIDTH];
        enter.store_slice(&mut enters);
        let mut order = node.order[octant];
        for _ in 0..WIDTH {
            // Written in any case, kept only where the ray meets it: which is too random to branch on.
            let child = order as usize % WIDTH;
            order >>= 4;
            stack[depth] = (node.children[child], enters[child]);
            depth += (met >> child & 1) as usize;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::instruction_sets;
    use crate::rng::Rng;
    use nalgebra::Rotation3;

    /// Rectangles, spheres, tubes and boxes, some of them along the axes, up to 40 m from the origin.
    fn items(count: u32, rng: &mut Rng) -> Vec<Item> {
        let mut vector = |reach: f64| Vector3::from_fn(|_, _| rng.range(-reach, reach));
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
    fn rays_meet_what_they_meet_without_a_tree_on_every_instruction_set() {
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
                        // Along an axis, from the side of a box or from where it meets one.
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
                    tree.walk(&ray, f64::INFINITY, |item, far| {
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
    fn children_are_visited_in_the_order_of_the_tree_of_two() {
        let mut rng = Rng::new(5, 6);
        let items = items(300, &mut rng);
        let mut entries: Vec<_> = items.iter().map(|i| (Bounds(i.bounds().0, i.bounds().1), *i)).collect();
        let mut two = Builder::default();
        two.build(&mut entries, 0);
        let wide = Bvh::new(items);
        for octant in 0..8 {
            let (mut plain, mut rest) = (Vec::new(), vec![0]);
            while let Some(i) = rest.pop() {
                let Branch { first, count, axis, .. } = two.branches[i as usize];
                match (count, octant >> axis & 1) {
                    (0, 0) => rest.extend([first, i + 1]),
                    (0, _) => rest.extend([i + 1, first]),
                    _ => plain.push(first),
                }
            }
            let (mut found, mut rest) = (Vec::new(), vec![Child(0)]);
            while let Some(Child(child)) = rest.pop() {
                if child & 1 == 1 {
                    found.push(child / 2);
                    continue;
                }
                let node = &wide.nodes[(child / 2) as usize];
                let there = |k: usize| node.order[octant] as usize >> (4 * k) & 7;
                let children = (0..WIDTH).map(there).filter(|&c| node.sides[0][0][c].is_finite());
                rest.extend(children.map(|c| node.children[c]));
            }
            assert_eq!(found, plain, "{octant}");
        }
    }
}
