//! The graph of photographs (nodes) and their verified pairs (edges).

use cv_core::UnionFind;
use std::collections::VecDeque;

/// A verified pair of photographs `a` and `b`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairEdge {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// How firmly they hold together, such as the number of inliers; more is firmer.
    pub weight: f64,
}

/// An edge names a node that is not there.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[error("edge {edge} joins {a} and {b} of {nodes} nodes")]
pub struct NoSuchNode {
    /// Index of the edge.
    pub edge: usize,
    /// Its first node.
    pub a: usize,
    /// Its second node.
    pub b: usize,
    /// Nodes of the graph.
    pub nodes: usize,
}

/// The graph of photographs and their verified pairs. What it answers depends on the order of nodes and edges only where weights are equal.
///
/// ```
/// use cv_geometry::{PairEdge, PairGraph};
///
/// let edge = |a, b, weight| PairEdge { a, b, weight };
/// let graph = PairGraph::new(5, vec![edge(0, 1, 90.0), edge(1, 2, 80.0), edge(0, 2, 10.0)])?;
/// assert_eq!(graph.connected_components(), [vec![0, 1, 2], vec![3], vec![4]]);
/// let tree = graph.maximum_spanning_forest();
/// assert_eq!((&tree[..], graph.center(&tree)), (&[0, 1][..], Some(1)));
/// # Ok::<(), cv_geometry::NoSuchNode>(())
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct PairGraph {
    nodes: usize,
    edges: Vec<PairEdge>,
}

/// One step of a walk over a tree: `node` is reached from `parent` through edge `edge`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TreeStep {
    /// The node that was reached before.
    pub parent: usize,
    /// The node that is reached.
    pub node: usize,
    /// Index of the edge between them.
    pub edge: usize,
}

impl PairGraph {
    /// A graph of the nodes `0..nodes`.
    ///
    /// # Errors
    /// [`NoSuchNode`].
    pub fn new(nodes: usize, edges: Vec<PairEdge>) -> Result<Self, NoSuchNode> {
        match edges.iter().position(|e| e.a >= nodes || e.b >= nodes) {
            Some(edge) => Err(NoSuchNode { edge, a: edges[edge].a, b: edges[edge].b, nodes }),
            None => Ok(Self { nodes, edges }),
        }
    }

    /// Number of nodes.
    pub fn nodes(&self) -> usize {
        self.nodes
    }

    /// The edges, as they were given.
    pub fn edges(&self) -> &[PairEdge] {
        &self.edges
    }

    /// The connected components, the largest first (of equals, the one with the greater sum of weights, then the one with the lowest
    /// node). Nodes ascend within each; a node without edges is a component of its own.
    pub fn connected_components(&self) -> Vec<Vec<usize>> {
        let mut sets = UnionFind::new(self.nodes);
        for e in &self.edges {
            sets.union(e.a as u32, e.b as u32);
        }
        let roots = sets.into_roots();
        let mut components: Vec<(f64, Vec<usize>)> = vec![(0.0, Vec::new()); self.nodes];
        for (node, root) in roots.iter().enumerate() {
            components[*root as usize].1.push(node);
        }
        for e in &self.edges {
            components[roots[e.a] as usize].0 += e.weight;
        }
        components.retain(|(_, nodes)| !nodes.is_empty());
        components.sort_by(|x, y| y.1.len().cmp(&x.1.len()).then(y.0.total_cmp(&x.0)).then(x.1.cmp(&y.1)));
        components.into_iter().map(|(_, nodes)| nodes).collect()
    }

    /// The edges (as indices, the firmest first) of the spanning tree of greatest weight of every component (Kruskal 1956).
    pub fn maximum_spanning_forest(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.edges.len()).collect();
        order.sort_by(|&i, &j| self.edges[j].weight.total_cmp(&self.edges[i].weight).then(i.cmp(&j)));
        let mut sets = UnionFind::new(self.nodes);
        order.retain(|&i| sets.union(self.edges[i].a as u32, self.edges[i].b as u32));
        order
    }

    /// Breadth-first walk over the edges `tree` from `root`, without `root` itself.
    pub fn breadth_first(&self, tree: &[usize], root: usize) -> Vec<TreeStep> {
        let mut neighbors: Vec<Vec<(usize, usize)>> = vec![Vec::new(); self.nodes];
        for (e, edge) in tree.iter().filter_map(|&e| Some((e, self.edges.get(e)?))) {
            neighbors[edge.a].push((edge.b, e));
            neighbors[edge.b].push((edge.a, e));
        }
        let mut seen = vec![false; self.nodes];
        let (mut steps, mut queue) = (Vec::new(), VecDeque::new());
        if let Some(seen) = seen.get_mut(root) {
            *seen = true;
            queue.push_back(root);
        }
        while let Some(parent) = queue.pop_front() {
            for &(node, edge) in &neighbors[parent] {
                if !std::mem::replace(&mut seen[node], true) {
                    steps.push(TreeStep { parent, node, edge });
                    queue.push_back(node);
                }
            }
        }
        steps
    }

    /// The center of the tree (of the largest one of a forest): the node with the least distance to its farthest node, then with the least sum of
    /// distances, then with the greatest weight of its edges. `None` without nodes. O(nodes²).
    pub fn center(&self, tree: &[usize]) -> Option<usize> {
        let rate = |root: usize| {
            let mut depth = vec![0_usize; self.nodes];
            let (mut eccentricity, mut sum) = (0, 0);
            let steps = self.breadth_first(tree, root);
            for step in &steps {
                depth[step.node] = depth[step.parent] + 1;
                eccentricity = eccentricity.max(depth[step.node]);
                sum += depth[step.node];
            }
            let weight: f64 = self.edges.iter().filter(|e| e.a == root || e.b == root).map(|e| e.weight).sum();
            (steps.len(), eccentricity, sum, weight)
        };
        let better = |x: &(usize, usize, usize, f64), y: &(usize, usize, usize, f64)| {
            y.0.cmp(&x.0).then(x.1.cmp(&y.1)).then(x.2.cmp(&y.2)).then(y.3.total_cmp(&x.3))
        };
        let rated = (0..self.nodes).map(|node| (rate(node), node));
        rated.min_by(|(x, i), (y, j)| better(x, y).then(i.cmp(j))).map(|(_, node)| node)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn graph(nodes: usize, edges: &[(usize, usize, f64)]) -> PairGraph {
        let edges = edges.iter().map(|&(a, b, weight)| PairEdge { a, b, weight }).collect();
        PairGraph::new(nodes, edges).unwrap()
    }

    #[test]
    fn two_components_are_told_apart_and_the_larger_comes_first() {
        let graph = graph(6, &[(4, 0, 9.0), (1, 2, 5.0), (2, 5, 5.0)]);
        assert_eq!(graph.connected_components(), vec![vec![1, 2, 5], vec![0, 4], vec![3]]);
    }

    #[test]
    fn the_spanning_tree_takes_the_strongest_edges() {
        let graph = graph(4, &[(0, 1, 10.0), (1, 2, 20.0), (0, 2, 30.0), (2, 3, 1.0)]);
        assert_eq!(graph.maximum_spanning_forest(), vec![2, 1, 3]);
    }

    #[test]
    fn the_center_of_a_chain_is_found_in_any_file_order() {
        // A chain of five, its photographs numbered in shuffled order: 3 - 0 - 4 - 1 - 2.
        let graph = graph(5, &[(3, 0, 1.0), (4, 1, 1.0), (1, 2, 1.0), (0, 4, 1.0)]);
        let tree = graph.maximum_spanning_forest();
        assert_eq!(graph.center(&tree), Some(4));
        let steps = graph.breadth_first(&tree, 4);
        assert_eq!(steps.iter().map(|s| (s.parent, s.node)).collect::<Vec<_>>(), vec![(4, 1), (4, 0), (1, 2), (0, 3)]);
    }

    #[test]
    fn nothing_and_what_is_not_there_have_answers() {
        let empty = graph(0, &[]);
        assert_eq!((empty.connected_components().len(), empty.center(&[])), (0, None));
        let edge = PairEdge { a: 0, b: 3, weight: 1.0 };
        assert_eq!(PairGraph::new(3, vec![edge]), Err(NoSuchNode { edge: 0, a: 0, b: 3, nodes: 3 }));
        assert!(graph(3, &[(0, 1, 1.0)]).breadth_first(&[0, 7], 9).is_empty());
        // The one node without edges would be nearest to all it reaches.
        assert_eq!(graph(3, &[(1, 2, 1.0)]).center(&[0]), Some(1));
    }

    fn any_graph() -> impl Strategy<Value = PairGraph> {
        (1..7_usize).prop_flat_map(|nodes| {
            let edge = (0..nodes, 0..nodes, 0..50_u32).prop_map(|(a, b, w)| PairEdge { a, b, weight: f64::from(w) });
            proptest::collection::vec(edge, 0..9).prop_map(move |edges| PairGraph::new(nodes, edges).unwrap())
        })
    }

    /// Shortest paths over edges by Floyd and Warshall.
    fn distances(graph: &PairGraph, edges: &[usize]) -> Vec<Vec<usize>> {
        let n = graph.nodes();
        let mut d = vec![vec![usize::MAX / 2; n]; n];
        d.iter_mut().enumerate().for_each(|(i, row)| row[i] = 0);
        for e in edges.iter().map(|&e| graph.edges()[e]).filter(|e| e.a != e.b) {
            d[e.a][e.b] = 1;
            d[e.b][e.a] = 1;
        }
        for k in 0..n {
            for i in 0..n {
                for j in 0..n {
                    d[i][j] = d[i][j].min(d[i][k] + d[k][j]);
                }
            }
        }
        d
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn components_are_what_paths_connect(graph in any_graph()) {
            let all: Vec<usize> = (0..graph.edges().len()).collect();
            let d = distances(&graph, &all);
            let components = graph.connected_components();
            prop_assert_eq!(components.iter().map(Vec::len).sum::<usize>(), graph.nodes());
            for (i, one) in components.iter().enumerate() {
                for (j, two) in components.iter().enumerate() {
                    for (a, b) in one.iter().flat_map(|a| two.iter().map(move |b| (*a, *b))) {
                        prop_assert_eq!(d[a][b] < usize::MAX / 2, i == j);
                    }
                }
            }
            prop_assert!(components.windows(2).all(|w| w[0].len() >= w[1].len()));
        }

        #[test]
        fn no_spanning_forest_weighs_more(graph in any_graph()) {
            let forest = graph.maximum_spanning_forest();
            let weigh = |edges: &[usize]| edges.iter().map(|&e| graph.edges()[e].weight).sum::<f64>();
            let rank = graph.nodes() - graph.connected_components().len();
            prop_assert_eq!(forest.len(), rank);
            // Every choice of as many edges that connects as much.
            for bits in 0..1_u32 << graph.edges().len() {
                let chosen: Vec<usize> = (0..graph.edges().len()).filter(|e| bits >> e & 1 == 1).collect();
                if chosen.len() == rank && distances(&graph, &chosen) .iter().flatten().filter(|d| **d < usize::MAX / 2).count()
                    == distances(&graph, &forest).iter().flatten().filter(|d| **d < usize::MAX / 2).count() {
                    prop_assert!(weigh(&chosen) <= weigh(&forest));
                }
            }
        }

        #[test]
        fn no_node_of_the_largest_tree_is_nearer_to_its_farthest(graph in any_graph()) {
            let tree = graph.maximum_spanning_forest();
            let d = distances(&graph, &tree);
            let reached = |i: usize| d[i].iter().filter(|d| **d < usize::MAX / 2).count();
            let farthest = |i: usize| d[i].iter().copied().filter(|d| *d < usize::MAX / 2).max();
            let center = graph.center(&tree).unwrap();
            for i in 0..graph.nodes() {
                prop_assert!(reached(center) >= reached(i));
                prop_assert!(reached(center) > reached(i) || farthest(center) <= farthest(i));
            }
            for step in graph.breadth_first(&tree, center) {
                prop_assert_eq!(d[center][step.node], d[center][step.parent] + 1);
            }
        }
    }
}
