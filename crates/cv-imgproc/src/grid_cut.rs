//! Minimum cuts of four-connected pixel graphs (Boykov & Kolmogorov 2004).

use cv_core::{Cancelled, Stage};

/// Directions of the arcs: right, left, down, up. Opposite directions differ in the last bit.
const RIGHT: usize = 0;
const DOWN: usize = 2;

const FREE: u8 = 0;
const SOURCE: u8 = 1;
const SINK: u8 = 2;

/// `parent` of a node connected to its terminal.
const TERMINAL: u8 = 4;
/// `parent` of an orphan or of a free node.
const ORPHAN: u8 = 5;

/// A node with its arcs, stored together: visiting a neighbor touches one cache line.
#[derive(Debug, Clone, Copy)]
struct Node {
    /// Residual capacity of the four outgoing arcs.
    capacity: [i32; 4],
    /// Heads of the arcs; where there is no neighbor, a dummy node without capacities.
    neighbor: [u32; 4],
    /// Residual capacity from the source (positive) or to the sink (negative).
    terminal: i32,
    timestamp: u32,
    distance: u32,
    tree: u8,
    parent: u8,
    is_active: bool,
    is_dominated: bool,
}

/// A pixel graph with edges between four-neighbors and to the source and sink terminals; [`Self::solve`] computes its minimum cut (Boykov &
/// Kolmogorov, "An experimental comparison of min-cut/max-flow algorithms for energy minimization in vision", PAMI 2004). Only the listed
/// pixels have nodes, so that the cost is that of a narrow band, not of its bounding box. O(n²) augmentations of n nodes in the worst case;
/// nearly linear on images.
///
/// ```
/// use cv_core::{Silent, Stage};
/// use cv_imgproc::GridCut;
///
/// // Three pixels in a row: the first prefers the source side, the last the sink side, and the first edge costs more than the second.
/// let stage = Stage::new(&Silent, "cut", 1)?;
/// let mut cut = GridCut::default();
/// cut.set_rectangle(3, 1);
/// cut.add_terminal(0, 10, 0);
/// cut.add_terminal(2, 0, 10);
/// cut.add_right(0, 4, 4);
/// cut.add_right(1, 3, 3);
/// cut.solve(&stage)?;
/// assert_eq!([0, 1, 2].map(|pixel| cut.is_on_sink_side(pixel)), [false, false, true]);
/// # Ok::<(), cv_core::Cancelled>(())
/// ```
#[derive(Debug, Default)]
pub struct GridCut {
    /// One per pixel, and the dummy for missing neighbors.
    nodes: Vec<Node>,
    active: std::collections::VecDeque<u32>,
    orphans: std::collections::VecDeque<u32>,
    clock: u32,
}

/// Calls `visit` with the index of each of distinct `pixels` (column, row), given in row-major order, and the indices of the pixels right of it and below, if they are among them.
///
/// # Errors
/// The first of `visit`.
#[inline]
pub fn grid_neighbors<E>(
    pixels: &[[u32; 2]],
    mut visit: impl FnMut(usize, Option<usize>, Option<usize>) -> Result<(), E>,
) -> Result<(), E> {
    // The first pixel that does not precede the lower neighbor in row-major order.
    let mut below = 0;
    for (i, &[x, y]) in pixels.iter().enumerate() {
        while pixels.get(below).is_some_and(|&[u, v]| (v, u) < (y + 1, x)) {
            below += 1;
        }
        let neighbor = |j: usize, at: [u32; 2]| (pixels.get(j) == Some(&at)).then_some(j);
        visit(i, neighbor(i + 1, [x + 1, y]), neighbor(below, [x, y + 1]))?;
    }
    Ok(())
}

impl GridCut {
    /// Builds the graph of distinct `pixels` (column, row), given in row-major order.
    ///
    /// # Errors
    /// [`Cancelled`] by `stage`.
    pub fn new(pixels: &[[u32; 2]], stage: &Stage<'_>) -> Result<Self, Cancelled> {
        stage.check()?;
        let mut cut = Self::default();
        cut.clear(pixels.len());
        let nodes = &mut cut.nodes;
        grid_neighbors(pixels, |i, right, below| {
            if i % (1 << 20) == 0 {
                stage.check()?;
            }
            for (direction, other) in [(RIGHT, right), (DOWN, below)] {
                if let Some(other) = other {
                    nodes[i].neighbor[direction] = other as u32;
                    nodes[other].neighbor[direction + 1] = i as u32;
                }
            }
            Ok(())
        })?;
        Ok(cut)
    }

    /// Resets to the graph of all pixels of a rectangle, row-major, with zero capacities; reuses the memory.
    pub fn set_rectangle(&mut self, width: usize, height: usize) {
        self.clear(width * height);
        let absent = (width * height) as u32;
        for (y, row) in self.nodes[..width * height].chunks_exact_mut(width.max(1)).enumerate() {
            for (x, node) in row.iter_mut().enumerate() {
                let i = (y * width + x) as u32;
                let if_exists = |exists: bool, other: u32| if exists { other } else { absent };
                node.neighbor = [
                    if_exists(x + 1 < width, i + 1),
                    if_exists(x > 0, i.wrapping_sub(1)),
                    if_exists(y + 1 < height, i + width as u32),
                    if_exists(y > 0, i.wrapping_sub(width as u32)),
                ];
            }
        }
    }

    /// Resets to `pixels` nodes without neighbors.
    fn clear(&mut self, pixels: usize) {
        let node = Node {
            capacity: [0; 4],
            neighbor: [pixels as u32; 4],
            terminal: 0,
            timestamp: 0,
            distance: 0,
            tree: FREE,
            parent: ORPHAN,
            is_active: false,
            is_dominated: false,
        };
        self.nodes.clear();
        self.nodes.resize(pixels + 1, node);
        self.active.clear();
        self.orphans.clear();
        self.clock = 0;
    }

    #[inline(always)]
    fn neighbor(&self, node: usize, direction: usize) -> usize {
        self.nodes[node].neighbor[direction & 3] as usize
    }

    /// Returns the right neighbor of a node, if any.
    pub fn right(&self, node: usize) -> Option<usize> {
        self.existing(node, RIGHT)
    }

    /// Returns the lower neighbor of a node, if any.
    pub fn below(&self, node: usize) -> Option<usize> {
        self.existing(node, DOWN)
    }

    /// Whether a node has a left, and an upper neighbor.
    pub fn has_left_and_upper(&self, node: usize) -> [bool; 2] {
        [RIGHT + 1, DOWN + 1].map(|direction| self.existing(node, direction).is_some())
    }

    fn existing(&self, node: usize, direction: usize) -> Option<usize> {
        Some(self.neighbor(node, direction)).filter(|&other| other + 1 < self.nodes.len())
    }

    /// Adds terminal capacities (t-links, at least 0): a node on the sink side pays `source`, one on the source side `sink`.
    pub fn add_terminal(&mut self, node: usize, source: i32, sink: i32) {
        self.nodes[node].terminal += source - sink;
    }

    /// Adds capacities (n-links) between a node and its right neighbor, which must exist: `forward` is paid where the node is on the source
    /// side and the neighbor on the sink side, `backward` in the opposite case.
    pub fn add_right(&mut self, node: usize, forward: i32, backward: i32) {
        self.add_edge(node, RIGHT, forward, backward);
    }

    /// As [`Self::add_right`], for the neighbor below.
    pub fn add_down(&mut self, node: usize, forward: i32, backward: i32) {
        self.add_edge(node, DOWN, forward, backward);
    }

    fn add_edge(&mut self, node: usize, direction: usize, forward: i32, backward: i32) {
        let other = self.neighbor(node, direction);
        assert!(other + 1 < self.nodes.len());
        self.nodes[node].capacity[direction] += forward;
        self.nodes[other].capacity[direction ^ 1] += backward;
    }

    /// After [`Self::solve`]: whether a node is on the sink side of the cut. Nodes that could be on either are on the source side.
    pub fn is_on_sink_side(&self, node: usize) -> bool {
        self.nodes[node].tree == SINK
    }

    /// Computes a minimum cut.
    ///
    /// # Errors
    /// [`Cancelled`] by `stage`.
    pub fn solve(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        for node in 0..self.nodes.len() - 1 {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            self.fix_dominated_node(node);
        }
        for node in (0..self.nodes.len() - 1).rev() {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            self.fix_dominated_node(node);
        }
        for node in 0..self.nodes.len() - 1 {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            self.push_short_paths(node);
        }
        for node in 0..self.nodes.len() {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            let t = self.nodes[node].terminal;
            if t != 0 {
                self.nodes[node].tree = if t > 0 { SOURCE } else { SINK };
                self.nodes[node].parent = TERMINAL;
                self.nodes[node].distance = 1;
                // Dominated nodes have no arcs to grow along.
                if !self.nodes[node].is_dominated {
                    self.activate(node);
                }
            }
        }
        while let Some(node) = self.active.pop_front() {
            let node = node as usize;
            self.nodes[node].is_active = false;
            // A node stays active until it no longer touches the other tree.
            while self.nodes[node].tree != FREE {
                let Some((s, direction)) = self.grow(node) else { break };
                self.clock += 1;
                self.augment(s, direction);
                while let Some(orphan) = self.orphans.pop_front() {
                    self.adopt(orphan as usize);
                }
                // An augmentation with its adoptions takes microseconds.
                if self.clock.is_multiple_of(4096) {
                    stage.check()?;
                }
            }
        }
        Ok(())
    }

    /// Fixes a node whose terminal capacity dominates all its edges to that side, and moves the edges' capacities to the neighbors' terminals.
    fn fix_dominated_node(&mut self, node: usize) {
        let Node { capacity, neighbor, terminal, .. } = self.nodes[node];
        if terminal > 0 && terminal >= capacity.iter().sum() {
            for (direction, other) in neighbor.into_iter().enumerate() {
                let other = &mut self.nodes[other as usize];
                other.terminal += capacity[direction];
                other.capacity[direction ^ 1] = 0;
            }
            (self.nodes[node].capacity, self.nodes[node].is_dominated) = ([0; 4], true);
        } else if terminal < 0 {
            let into: [i32; 4] = std::array::from_fn(|d| self.nodes[neighbor[d] as usize].capacity[d ^ 1]);
            if -terminal > into.iter().sum() {
                for (direction, other) in neighbor.into_iter().enumerate() {
                    let other = &mut self.nodes[other as usize];
                    other.terminal -= into[direction];
                    other.capacity[direction ^ 1] = 0;
                }
                (self.nodes[node].capacity, self.nodes[node].is_dominated) = ([0; 4], true);
            }
        }
    }

    /// Augments the shortest paths, source – node – neighbor – sink, without search trees.
    fn push_short_paths(&mut self, node: usize) {
        for direction in 0..4 {
            let Node { terminal, capacity, .. } = self.nodes[node];
            let other = self.neighbor(node, direction);
            let flow = terminal.min(capacity[direction]).min(-self.nodes[other].terminal);
            if flow > 0 {
                self.nodes[node].terminal -= flow;
                self.nodes[node].capacity[direction] -= flow;
                self.nodes[other].terminal += flow;
                self.nodes[other].capacity[direction ^ 1] += flow;
            }
        }
    }

    fn activate(&mut self, node: usize) {
        if !std::mem::replace(&mut self.nodes[node].is_active, true) {
            self.active.push_back(node as u32);
        }
    }

    /// Whether the arc between a node and its neighbor has residual capacity in the direction of growth of `tree`.
    fn has_residual(&self, tree: u8, node: usize, direction: usize, other: usize) -> bool {
        if tree == SOURCE {
            self.nodes[node].capacity[direction] > 0
        } else {
            self.nodes[other].capacity[direction ^ 1] > 0
        }
    }

    /// Growth stage: adds free neighbors to the node's tree; returns an arc from the source tree to the sink tree where they touch.
    fn grow(&mut self, node: usize) -> Option<(usize, usize)> {
        let tree = self.nodes[node].tree;
        for direction in 0..4 {
            let other = self.neighbor(node, direction);
            if !self.has_residual(tree, node, direction, other) {
                continue;
            }
            if self.nodes[other].tree == FREE {
                self.nodes[other].tree = tree;
                self.nodes[other].parent = (direction ^ 1) as u8;
                self.nodes[other].timestamp = self.nodes[node].timestamp;
                self.nodes[other].distance = self.nodes[node].distance + 1;
                self.activate(other);
            } else if self.nodes[other].tree != tree {
                return Some(if tree == SOURCE { (node, direction) } else { (other, direction ^ 1) });
            } else if self.nodes[other].timestamp <= self.nodes[node].timestamp
                && self.nodes[other].distance > self.nodes[node].distance + 1
            {
                // A shorter path to the same terminal.
                self.nodes[other].parent = (direction ^ 1) as u8;
                self.nodes[other].timestamp = self.nodes[node].timestamp;
                self.nodes[other].distance = self.nodes[node].distance + 1;
            }
        }
        None
    }

    /// Augmentation stage: pushes the bottleneck capacity along the path through the arc; saturated tree arcs make orphans.
    fn augment(&mut self, s: usize, direction: usize) {
        let t = self.neighbor(s, direction);
        let mut flow = self.nodes[s].capacity[direction];
        let mut node = s;
        while self.nodes[node].parent != TERMINAL {
            let d = self.nodes[node].parent as usize;
            let up = self.neighbor(node, d);
            flow = flow.min(self.nodes[up].capacity[d ^ 1]);
            node = up;
        }
        flow = flow.min(self.nodes[node].terminal);
        node = t;
        while self.nodes[node].parent != TERMINAL {
            let d = self.nodes[node].parent as usize;
            flow = flow.min(self.nodes[node].capacity[d]);
            node = self.neighbor(node, d);
        }
        flow = flow.min(-self.nodes[node].terminal);

        self.nodes[s].capacity[direction] -= flow;
        self.nodes[t].capacity[direction ^ 1] += flow;
        node = s;
        while self.nodes[node].parent != TERMINAL {
            let d = self.nodes[node].parent as usize;
            let up = self.neighbor(node, d);
            self.nodes[node].capacity[d] += flow;
            self.nodes[up].capacity[d ^ 1] -= flow;
            if self.nodes[up].capacity[d ^ 1] == 0 {
                self.make_orphan(node);
            }
            node = up;
        }
        self.nodes[node].terminal -= flow;
        if self.nodes[node].terminal == 0 {
            self.make_orphan(node);
        }
        node = t;
        while self.nodes[node].parent != TERMINAL {
            let d = self.nodes[node].parent as usize;
            let up = self.neighbor(node, d);
            self.nodes[up].capacity[d ^ 1] += flow;
            self.nodes[node].capacity[d] -= flow;
            if self.nodes[node].capacity[d] == 0 {
                self.make_orphan(node);
            }
            node = up;
        }
        self.nodes[node].terminal += flow;
        if self.nodes[node].terminal == 0 {
            self.make_orphan(node);
        }
    }

    fn make_orphan(&mut self, node: usize) {
        self.nodes[node].parent = ORPHAN;
        self.orphans.push_back(node as u32);
    }

    /// Adoption stage: finds a new parent for an orphan, or frees it.
    fn adopt(&mut self, node: usize) {
        let tree = self.nodes[node].tree;
        let mut best: Option<(u32, usize)> = None;
        for direction in 0..4 {
            let other = self.neighbor(node, direction);
            // Flow is from the other node to this one in the source tree, the reverse in the sink tree.
            let open = if tree == SOURCE {
                self.nodes[other].capacity[direction ^ 1] > 0
            } else {
                self.nodes[node].capacity[direction] > 0
            };
            if !open || self.nodes[other].tree != tree {
                continue;
            }
            if let Some(distance) = self.distance_to_terminal(other)
                && best.is_none_or(|(d, _)| distance < d)
            {
                best = Some((distance, direction));
            }
        }
        if let Some((distance, direction)) = best {
            self.nodes[node].parent = direction as u8;
            self.nodes[node].timestamp = self.clock;
            self.nodes[node].distance = distance + 1;
            return;
        }
        self.nodes[node].tree = FREE;
        for direction in 0..4 {
            let other = self.neighbor(node, direction);
            if self.nodes[other].tree != tree {
                continue;
            }
            let open = if tree == SOURCE {
                self.nodes[other].capacity[direction ^ 1] > 0
            } else {
                self.nodes[node].capacity[direction] > 0
            };
            if open {
                self.activate(other);
            }
            if usize::from(self.nodes[other].parent) == direction ^ 1 {
                self.make_orphan(other);
            }
        }
    }

    /// Computes the distance of a node to its tree's terminal and caches it along the path; `None` where the path ends at an orphan.
    fn distance_to_terminal(&mut self, start: usize) -> Option<u32> {
        let (mut node, mut steps) = (start, 0);
        let total = loop {
            if self.nodes[node].timestamp == self.clock {
                break steps + self.nodes[node].distance;
            }
            match self.nodes[node].parent {
                TERMINAL => {
                    self.nodes[node].timestamp = self.clock;
                    self.nodes[node].distance = 1;
                    break steps + 1;
                }
                ORPHAN => return None,
                direction => {
                    steps += 1;
                    node = self.neighbor(node, usize::from(direction));
                }
            }
        };
        let (mut node, mut distance) = (start, total);
        while self.nodes[node].timestamp != self.clock {
            self.nodes[node].timestamp = self.clock;
            self.nodes[node].distance = distance;
            distance -= 1;
            node = self.neighbor(node, usize::from(self.nodes[node].parent));
        }
        Some(total)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;
    use proptest::prelude::*;

    fn stage() -> Stage<'static> {
        Stage::new(&Silent, "cut", 1).unwrap()
    }

    /// All pixels of a grid, row-major.
    fn all_pixels(w: usize, h: usize) -> Vec<[u32; 2]> {
        (0..h as u32).flat_map(|y| (0..w as u32).map(move |x| [x, y])).collect()
    }

    proptest! {
        #[test]
        fn neighbors_are_the_adjacent_pixels(mask in proptest::collection::vec(any::<bool>(), 35)) {
            let pixels: Vec<_> = all_pixels(7, 5).into_iter().zip(&mask).filter(|(_, m)| **m).map(|(p, _)| p).collect();
            let cut = GridCut::new(&pixels, &stage()).unwrap();
            let find = |pixel: [u32; 2]| pixels.iter().position(|p| *p == pixel);
            for (i, &[x, y]) in pixels.iter().enumerate() {
                prop_assert_eq!(cut.right(i), find([x + 1, y]));
                prop_assert_eq!(cut.below(i), find([x, y + 1]));
                let before = [find([x.wrapping_sub(1), y]).is_some(), find([x, y.wrapping_sub(1)]).is_some()];
                prop_assert_eq!(cut.has_left_and_upper(i), before);
            }
        }
    }

    /// Reference: the energy of a labeling (bit set: source side).
    #[derive(Debug)]
    struct ReferenceProblem {
        w: usize,
        h: usize,
        terminals: Vec<(i32, i32)>,
        right: Vec<(i32, i32)>,
        down: Vec<(i32, i32)>,
    }

    impl ReferenceProblem {
        fn cost(&self, source_side: impl Fn(usize, usize) -> bool) -> i32 {
            let mut cost = 0;
            let pay = |a: bool, b: bool, (forward, backward): (i32, i32)| match (a, b) {
                (true, false) => forward,
                (false, true) => backward,
                _ => 0,
            };
            for y in 0..self.h {
                for x in 0..self.w {
                    let i = y * self.w + x;
                    let label = source_side(x, y);
                    cost += if label { self.terminals[i].1 } else { self.terminals[i].0 };
                    if x + 1 < self.w {
                        cost += pay(label, source_side(x + 1, y), self.right[i]);
                    }
                    if y + 1 < self.h {
                        cost += pay(label, source_side(x, y + 1), self.down[i]);
                    }
                }
            }
            cost
        }

        fn cut(&self) -> GridCut {
            self.fill(GridCut::new(&all_pixels(self.w, self.h), &stage()).unwrap())
        }

        fn fill(&self, mut g: GridCut) -> GridCut {
            for y in 0..self.h {
                for x in 0..self.w {
                    let i = y * self.w + x;
                    g.add_terminal(i, self.terminals[i].0, self.terminals[i].1);
                    if x + 1 < self.w {
                        g.add_right(i, self.right[i].0, self.right[i].1);
                    }
                    if y + 1 < self.h {
                        g.add_down(i, self.down[i].0, self.down[i].1);
                    }
                }
            }
            g.solve(&stage()).unwrap();
            g
        }
    }

    fn problem() -> impl Strategy<Value = ReferenceProblem> {
        (1..5_usize, 1..4_usize).prop_flat_map(|(w, h)| {
            let n = w * h;
            let pairs = |limit: i32| proptest::collection::vec((0..limit, 0..limit), n);
            (pairs(12), pairs(7), pairs(7)).prop_map(move |(terminals, right, down)| ReferenceProblem {
                w,
                h,
                terminals,
                right,
                down,
            })
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(600))]
        #[test]
        fn the_cut_has_the_minimum_energy_of_all_labelings(p in problem()) {
            let cut = p.cut();
            let cost = p.cost(|x, y| !cut.is_on_sink_side(y * p.w + x));
            let minimum = (0..1_u32 << (p.w * p.h)).map(|bits| p.cost(|x, y| bits >> (y * p.w + x) & 1 == 1)).min().unwrap();
            prop_assert_eq!(cost, minimum);
        }

        #[test]
        fn a_reset_rectangle_equals_a_new_graph_of_its_pixels(before in problem(), p in problem()) {
            // Independent of its previous content.
            let mut cut = before.cut();
            cut.set_rectangle(p.w, p.h);
            let (cut, expected) = (p.fill(cut), p.cut());
            for i in 0..p.w * p.h {
                prop_assert_eq!(cut.is_on_sink_side(i), expected.is_on_sink_side(i));
            }
        }
    }

    #[test]
    fn a_large_cut_follows_the_cheap_line() {
        // Left column source, right column sink; horizontal edges 200 except those across a sine-shaped line, 1 each.
        let (w, h) = (60, 40);
        let line = |y: usize| 20 + (y as f64 * 0.4).sin().mul_add(8.0, 0.0) as usize;
        let mut g = GridCut::new(&all_pixels(w, h), &stage()).unwrap();
        for y in 0..h {
            g.add_terminal(y * w, 1000, 0);
            g.add_terminal(y * w + w - 1, 0, 1000);
            for x in 0..w - 1 {
                let c = if x == line(y) { 1 } else { 200 };
                g.add_right(y * w + x, c, c);
            }
            for x in (0..w).filter(|_| y + 1 < h) {
                g.add_down(y * w + x, 1, 1);
            }
        }
        g.solve(&stage()).unwrap();
        for y in 0..h {
            for x in 0..w {
                assert_eq!(g.is_on_sink_side(y * w + x), x > line(y), "{x} {y}");
            }
        }
    }
}
