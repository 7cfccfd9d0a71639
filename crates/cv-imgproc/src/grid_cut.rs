//! Minimum cuts of four-connected pixels (Boykov & Kolmogorov 2004).

use cv_core::{Cancelled, Stage};

/// Steps to the neighbors: right, left, down, up. Opposite directions differ in the last bit.
const RIGHT: usize = 0;
const DOWN: usize = 2;

const FREE: u8 = 0;
const SOURCE: u8 = 1;
const SINK: u8 = 2;

/// `parent` of a root: its terminal.
const TERMINAL: u8 = 4;
/// `parent` of a node that lost its way to a terminal.
const ORPHAN: u8 = 5;

/// All of a node beside each other: a step to a neighbor touches one cache line.
#[derive(Debug, Clone, Copy)]
struct Node {
    /// Residual capacity of the four outgoing arcs.
    capacity: [i32; 4],
    /// The nodes they lead to; where there is none, one without capacities that is in no tree.
    neighbor: [u32; 4],
    /// Residual capacity from the source (positive) or to the sink (negative).
    terminal: i32,
    time: u32,
    distance: u32,
    tree: u8,
    parent: u8,
    is_active: bool,
    is_settled: bool,
}

/// A graph of pixels with edges between four-neighbors and to two terminals, of which [`Self::solve`] finds a minimum cut (Boykov & Kolmogorov, "An experimental
/// comparison of min-cut/max-flow algorithms for energy minimization in vision", PAMI 2004). Only the pixels that are named have nodes, so that a narrow band costs what
/// it has, however it winds. Of n nodes: O(n²) augmentations at the worst; on pictures about linear.
///
/// ```
/// use cv_core::{Silent, Stage};
/// use cv_imgproc::GridCut;
///
/// // Three pixels in a row: the first wants the source's side, the last the sink's, and the edge between the first two is the dearer one.
/// let stage = Stage::new(&Silent, "cut", 1)?;
/// let mut cut = GridCut::default();
/// cut.set_rectangle(3, 1);
/// cut.add_terminal(0, 10, 0);
/// cut.add_terminal(2, 0, 10);
/// cut.add_right(0, 4, 4);
/// cut.add_right(1, 3, 3);
/// cut.solve(&stage)?;
/// assert_eq!([0, 1, 2].map(|pixel| cut.on_sink_side(pixel)), [false, false, true]);
/// # Ok::<(), cv_core::Cancelled>(())
/// ```
#[derive(Debug, Default)]
pub struct GridCut {
    /// One for each place, and the one that stands for neighbors that are not there.
    nodes: Vec<Node>,
    active: std::collections::VecDeque<u32>,
    orphans: std::collections::VecDeque<u32>,
    clock: u32,
}

impl GridCut {
    /// `places` are columns and rows of different pixels, row by row from left to right.
    ///
    /// # Errors
    /// [`Cancelled`] where `stage` says stop.
    pub fn new(places: &[[u32; 2]], stage: &Stage<'_>) -> Result<Self, Cancelled> {
        stage.check()?;
        let mut cut = Self::default();
        cut.clear(places.len());
        let nodes = &mut cut.nodes;
        // The first place that does not come before the one below.
        let mut below = 0;
        for (i, &[x, y]) in places.iter().enumerate() {
            if i % (1 << 20) == 0 {
                stage.check()?;
            }
            if places.get(i + 1) == Some(&[x + 1, y]) {
                nodes[i].neighbor[RIGHT] = i as u32 + 1;
                nodes[i + 1].neighbor[RIGHT + 1] = i as u32;
            }
            while places.get(below).is_some_and(|&[u, v]| (v, u) < (y + 1, x)) {
                below += 1;
            }
            if places.get(below) == Some(&[x, y + 1]) {
                nodes[i].neighbor[DOWN] = below as u32;
                nodes[below].neighbor[DOWN + 1] = i as u32;
            }
        }
        Ok(cut)
    }

    /// Makes it the graph of all pixels of a rectangle, row by row, without capacities; its memory is used again.
    pub fn set_rectangle(&mut self, width: usize, height: usize) {
        self.clear(width * height);
        let nobody = (width * height) as u32;
        for (y, row) in self.nodes[..width * height].chunks_exact_mut(width.max(1)).enumerate() {
            for (x, node) in row.iter_mut().enumerate() {
                let i = (y * width + x) as u32;
                let beside = |is_there: bool, other: u32| if is_there { other } else { nobody };
                node.neighbor = [
                    beside(x + 1 < width, i + 1),
                    beside(x > 0, i.wrapping_sub(1)),
                    beside(y + 1 < height, i + width as u32),
                    beside(y > 0, i.wrapping_sub(width as u32)),
                ];
            }
        }
    }

    /// `places` nodes without neighbors.
    fn clear(&mut self, places: usize) {
        let node = Node {
            capacity: [0; 4],
            neighbor: [places as u32; 4],
            terminal: 0,
            time: 0,
            distance: 0,
            tree: FREE,
            parent: ORPHAN,
            is_active: false,
            is_settled: false,
        };
        self.nodes.clear();
        self.nodes.resize(places + 1, node);
        self.active.clear();
        self.orphans.clear();
        self.clock = 0;
    }

    #[inline(always)]
    fn neighbor(&self, node: usize, direction: usize) -> usize {
        self.nodes[node].neighbor[direction & 3] as usize
    }

    /// The node to the right of a place, where there is one.
    pub fn right(&self, node: usize) -> Option<usize> {
        self.existing(node, RIGHT)
    }

    /// The node below a place, where there is one.
    pub fn below(&self, node: usize) -> Option<usize> {
        self.existing(node, DOWN)
    }

    /// Whether there is a node to the left of a place, and one above it.
    pub fn has_before(&self, node: usize) -> [bool; 2] {
        [RIGHT + 1, DOWN + 1].map(|direction| self.existing(node, direction).is_some())
    }

    fn existing(&self, node: usize, direction: usize) -> Option<usize> {
        Some(self.neighbor(node, direction)).filter(|&other| other + 1 < self.nodes.len())
    }

    /// Adds costs of being cut from the source and from the sink (both at least 0): a node on the sink's side pays the first.
    pub fn add_terminal(&mut self, node: usize, source: i32, sink: i32) {
        self.nodes[node].terminal += source - sink;
    }

    /// Adds capacities between a place and its right neighbor, which is there: paid where this one is on the source's side and that one on the
    /// sink's, and the other way round.
    pub fn add_right(&mut self, node: usize, forward: i32, backward: i32) {
        self.add_edge(node, RIGHT, forward, backward);
    }

    /// As [`Self::add_right`], for the neighbor below.
    pub fn add_down(&mut self, node: usize, forward: i32, backward: i32) {
        self.add_edge(node, DOWN, forward, backward);
    }

    fn add_edge(&mut self, node: usize, direction: usize, forward: i32, backward: i32) {
        let other = self.neighbor(node, direction);
        debug_assert!(other + 1 < self.nodes.len());
        self.nodes[node].capacity[direction] += forward;
        self.nodes[other].capacity[direction ^ 1] += backward;
    }

    /// After [`Self::solve`]: whether the place is on the sink's side of the cut. What could be on either is on the source's.
    pub fn on_sink_side(&self, node: usize) -> bool {
        self.nodes[node].tree == SINK
    }

    /// Finds a minimum cut.
    ///
    /// # Errors
    /// [`Cancelled`] where `stage` says stop.
    pub fn solve(&mut self, stage: &Stage<'_>) -> Result<(), Cancelled> {
        for node in 0..self.nodes.len() - 1 {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            self.settle(node);
        }
        for node in (0..self.nodes.len() - 1).rev() {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            self.settle(node);
        }
        for node in 0..self.nodes.len() - 1 {
            if node % (1 << 20) == 0 {
                stage.check()?;
            }
            self.push(node);
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
                // What is settled has nowhere to grow.
                if !self.nodes[node].is_settled {
                    self.activate(node);
                }
            }
        }
        while let Some(node) = self.active.pop_front() {
            let node = node as usize;
            self.nodes[node].is_active = false;
            // A node stays at work until it meets the other tree no more.
            while self.nodes[node].tree != FREE {
                let Some((s, direction)) = self.grow(node) else { break };
                self.clock += 1;
                self.augment(s, direction);
                while let Some(orphan) = self.orphans.pop_front() {
                    self.adopt(orphan as usize);
                }
                // A path and its orphans: some microseconds.
                if self.clock.is_multiple_of(4096) {
                    stage.check()?;
                }
            }
        }
        Ok(())
    }

    /// A node whose terminal outweighs all its edges is on that side whatever its neighbors do, which then pay for their edges to it as to the terminal.
    fn settle(&mut self, node: usize) {
        let Node { capacity, neighbor, terminal, .. } = self.nodes[node];
        if terminal > 0 && terminal >= capacity.iter().sum() {
            for (direction, other) in neighbor.into_iter().enumerate() {
                let other = &mut self.nodes[other as usize];
                other.terminal += capacity[direction];
                other.capacity[direction ^ 1] = 0;
            }
            (self.nodes[node].capacity, self.nodes[node].is_settled) = ([0; 4], true);
        } else if terminal < 0 {
            let into: [i32; 4] = std::array::from_fn(|d| self.nodes[neighbor[d] as usize].capacity[d ^ 1]);
            if -terminal > into.iter().sum() {
                for (direction, other) in neighbor.into_iter().enumerate() {
                    let other = &mut self.nodes[other as usize];
                    other.terminal -= into[direction];
                    other.capacity[direction ^ 1] = 0;
                }
                (self.nodes[node].capacity, self.nodes[node].is_settled) = ([0; 4], true);
            }
        }
    }

    /// Sends flow along the paths of one edge, from the source to the node, a neighbor and the sink: no trees are needed for these.
    fn push(&mut self, node: usize) {
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

    /// Whether flow can still pass along the tree edge between a node and its neighbor toward the leaves of that tree.
    fn open(&self, tree: u8, node: usize, direction: usize, other: usize) -> bool {
        if tree == SOURCE {
            self.nodes[node].capacity[direction] > 0
        } else {
            self.nodes[other].capacity[direction ^ 1] > 0
        }
    }

    /// Lets the node's tree take its free neighbors; returns an arc from the source's tree to the sink's where they touch.
    fn grow(&mut self, node: usize) -> Option<(usize, usize)> {
        let tree = self.nodes[node].tree;
        for direction in 0..4 {
            let other = self.neighbor(node, direction);
            if !self.open(tree, node, direction, other) {
                continue;
            }
            if self.nodes[other].tree == FREE {
                self.nodes[other].tree = tree;
                self.nodes[other].parent = (direction ^ 1) as u8;
                self.nodes[other].time = self.nodes[node].time;
                self.nodes[other].distance = self.nodes[node].distance + 1;
                self.activate(other);
            } else if self.nodes[other].tree != tree {
                return Some(if tree == SOURCE { (node, direction) } else { (other, direction ^ 1) });
            } else if self.nodes[other].time <= self.nodes[node].time
                && self.nodes[other].distance > self.nodes[node].distance + 1
            {
                // A shorter way to the same terminal.
                self.nodes[other].parent = (direction ^ 1) as u8;
                self.nodes[other].time = self.nodes[node].time;
                self.nodes[other].distance = self.nodes[node].distance + 1;
            }
        }
        None
    }

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
                self.orphan(node);
            }
            node = up;
        }
        self.nodes[node].terminal -= flow;
        if self.nodes[node].terminal == 0 {
            self.orphan(node);
        }
        node = t;
        while self.nodes[node].parent != TERMINAL {
            let d = self.nodes[node].parent as usize;
            let up = self.neighbor(node, d);
            self.nodes[up].capacity[d ^ 1] += flow;
            self.nodes[node].capacity[d] -= flow;
            if self.nodes[node].capacity[d] == 0 {
                self.orphan(node);
            }
            node = up;
        }
        self.nodes[node].terminal += flow;
        if self.nodes[node].terminal == 0 {
            self.orphan(node);
        }
    }

    fn orphan(&mut self, node: usize) {
        self.nodes[node].parent = ORPHAN;
        self.orphans.push_back(node as u32);
    }

    fn adopt(&mut self, node: usize) {
        let tree = self.nodes[node].tree;
        let mut best: Option<(u32, usize)> = None;
        for direction in 0..4 {
            let other = self.neighbor(node, direction);
            // Flow runs from the other node to this one in the source's tree, the other way in the sink's.
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
            self.nodes[node].time = self.clock;
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
                self.orphan(other);
            }
        }
    }

    /// Steps from a node to its tree's terminal, remembering them on the way; `None` where the way ends at an orphan.
    fn distance_to_terminal(&mut self, start: usize) -> Option<u32> {
        let (mut node, mut steps) = (start, 0);
        let total = loop {
            if self.nodes[node].time == self.clock {
                break steps + self.nodes[node].distance;
            }
            match self.nodes[node].parent {
                TERMINAL => {
                    self.nodes[node].time = self.clock;
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
        while self.nodes[node].time != self.clock {
            self.nodes[node].time = self.clock;
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

    /// All pixels of a grid.
    fn whole(w: usize, h: usize) -> Vec<[u32; 2]> {
        (0..h as u32).flat_map(|y| (0..w as u32).map(move |x| [x, y])).collect()
    }

    proptest! {
        #[test]
        fn neighbors_are_the_pixels_beside_and_below(mask in proptest::collection::vec(any::<bool>(), 35)) {
            let places: Vec<_> = whole(7, 5).into_iter().zip(&mask).filter(|(_, m)| **m).map(|(p, _)| p).collect();
            let cut = GridCut::new(&places, &stage()).unwrap();
            let find = |place: [u32; 2]| places.iter().position(|p| *p == place);
            for (i, &[x, y]) in places.iter().enumerate() {
                prop_assert_eq!(cut.right(i), find([x + 1, y]));
                prop_assert_eq!(cut.below(i), find([x, y + 1]));
                let before = [find([x.wrapping_sub(1), y]).is_some(), find([x, y.wrapping_sub(1)]).is_some()];
                prop_assert_eq!(cut.has_before(i), before);
            }
        }
    }

    /// Cost of a labeling (bit set: source side).
    #[derive(Debug)]
    struct Plain {
        w: usize,
        h: usize,
        terminals: Vec<(i32, i32)>,
        right: Vec<(i32, i32)>,
        down: Vec<(i32, i32)>,
    }

    impl Plain {
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
                    let own = source_side(x, y);
                    cost += if own { self.terminals[i].1 } else { self.terminals[i].0 };
                    if x + 1 < self.w {
                        cost += pay(own, source_side(x + 1, y), self.right[i]);
                    }
                    if y + 1 < self.h {
                        cost += pay(own, source_side(x, y + 1), self.down[i]);
                    }
                }
            }
            cost
        }

        fn cut(&self) -> GridCut {
            self.fill(GridCut::new(&whole(self.w, self.h), &stage()).unwrap())
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

    fn problem() -> impl Strategy<Value = Plain> {
        (1..5_usize, 1..4_usize).prop_flat_map(|(w, h)| {
            let n = w * h;
            let pairs = |limit: i32| proptest::collection::vec((0..limit, 0..limit), n);
            (pairs(12), pairs(7), pairs(7)).prop_map(move |(terminals, right, down)| Plain {
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
        fn no_labeling_costs_less_than_the_cut(p in problem()) {
            let cut = p.cut();
            let found = p.cost(|x, y| !cut.on_sink_side(y * p.w + x));
            let least = (0..1_u32 << (p.w * p.h)).map(|bits| p.cost(|x, y| bits >> (y * p.w + x) & 1 == 1)).min().unwrap();
            prop_assert_eq!(found, least);
        }

        #[test]
        fn a_rectangle_is_the_graph_of_its_pixels(before in problem(), p in problem()) {
            // Whatever it held before.
            let mut cut = before.cut();
            cut.set_rectangle(p.w, p.h);
            let (cut, expected) = (p.fill(cut), p.cut());
            for i in 0..p.w * p.h {
                prop_assert_eq!(cut.on_sink_side(i), expected.on_sink_side(i));
            }
        }
    }

    #[test]
    fn a_large_cut_runs_through_the_cheap_column() {
        // Left column source, right column sink, every edge 10 but those over a winding line, 1 each.
        let (w, h) = (60, 40);
        let line = |y: usize| 20 + (y as f64 * 0.4).sin().mul_add(8.0, 0.0) as usize;
        let mut g = GridCut::new(&whole(w, h), &stage()).unwrap();
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
                assert_eq!(g.on_sink_side(y * w + x), x > line(y), "{x} {y}");
            }
        }
    }
}
