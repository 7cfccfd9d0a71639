//! The view graph: images (nodes) and verified pairs (edges).

use cv_core::UnionFind;
use std::collections::VecDeque;

/// An edge of the view graph: a verified image pair.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PairEdge {
    /// Index of the first image.
    pub a: usize,
    /// Index of the second image.
    pub b: usize,
    /// Strength of the connection, such as the number of inliers; larger is stronger.
    pub weight: f64,
}

/// An edge has a node index out of range.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[error("edge {edge} connects nodes {a} and {b}, but there are only {nodes} nodes")]
pub struct NoSuchNode {
    /// Index of the edge.
    pub edge: usize,
    /// Its first node.
    pub a: usize,
    /// Its second node.
    pub b: usize,
    /// Number of nodes of the graph.
    pub nodes: usize,
}

/// The view graph. Results depend on the order of nodes and edges only for ties of weights.
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

/// A step of a tree traversal: `node` is reached from `parent` by edge `edge`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TreeStep {
    /// The node that was visited before.
    pub parent: usize,
    /// The newly visited node.
    pub node: usize,
    /// Index of the edge between them.
    pub edge: usize,
}

impl PairGraph {
    /// Creates a graph with the nodes `0..nodes`.
    ///
    /// # Errors
    /// [`NoSuchNode`].
    pub fn new(nodes: usize, edges: Vec<PairEdge>) -> Result<Self, NoSuchNode> {
        match edges.iter().position(|e| e.a >= nodes || e.b >= nodes) {
            Some(edge) => Err(NoSuchNode { edge, a: edges[edge].a, b: edges[edge].b, nodes }),
            None => Ok(Self { nodes, edges }),
        }
    }

    /// Returns the number of nodes.
    pub fn nodes(&self) -> usize {
        self.nodes
    }

    /// Returns the edges in their original order.
    pub fn edges(&self) -> &[PairEdge] {
        &self.edges
    }

    /// Computes the connected components, by decreasing size (ties: by decreasing sum of weights, then by the lowest
    /// node). Nodes are ascending; an isolated node is a component.
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

    /// Computes the edges (indices, by decreasing weight) of the maximum spanning tree of each component (Kruskal
    /// 1956).
    pub fn maximum_spanning_forest(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..self.edges.len()).collect();
        order.sort_by(|&i, &j| self.edges[j].weight.total_cmp(&self.edges[i].weight).then(i.cmp(&j)));
        let mut sets = UnionFind::new(self.nodes);
        order.retain(|&i| sets.union(self.edges[i].a as u32, self.edges[i].b as u32));
        order
    }

    /// Traverses the edges `tree` breadth-first from `root`; the result does not contain `root`.
    pub fn breadth_first(&self, tree: &[usize], root: usize) -> Vec<TreeStep> {
        let mut neighbors: Vec<Vec<(usize, usize)>> = vec![Vec::new(); self.nodes];
        for (e, edge) in tree.iter().filter_map(|&e| Some((e, self.edges.get(e)?))) {
            neighbors[edge.a].push((edge.b, e));
            neighbors[edge.b].push((edge.a, e));
        }
        let mut is_visited = vec![false; self.nodes];
        let (mut steps, mut queue) = (Vec::new(), VecDeque::new());
        if let Some(visited) = is_visited.get_mut(root) {
            *visited = true;
            queue.push_back(root);
        }
        while let Some(parent) = queue.pop_front() {
            for &(node, edge) in &neighbors[parent] {
                if !std::mem::replace(&mut is_visited[node], true) {
                    steps.push(TreeStep { parent, node, edge });
                    queue.push_back(node);
                }
            }
        }
        steps
    }

    /// Finds the center of the tree (of the largest tree of a forest): the node of minimum eccentricity, then of
    /// minimum sum of distances, then of maximum weight of its edges. `None` without nodes. O(nodes²).
    pub fn center(&self, tree: &[usize]) -> Option<usize> {
        let criteria = |root: usize| {
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
        let compare = |x: &(usize, usize, usize, f64), y: &(usize, usize, usize, f64)| {
            y.0.cmp(&x.0).then(x.1.cmp(&y.1)).then(x.2.cmp(&y.2)).then(y.3.total_cmp(&x.3))
        };
        let candidates = (0..self.nodes).map(|node| (criteria(node), node));
        candidates.min_by(|(x, i), (y, j)| compare(x, y).then(i.cmp(j))).map(|(_, node)| node)
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
    fn components_are_sorted_by_decreasing_size() {
        let graph = graph(6, &[(4, 0, 9.0), (1, 2, 5.0), (2, 5, 5.0)]);
        assert_eq!(graph.connected_components(), vec![vec![1, 2, 5], vec![0, 4], vec![3]]);
    }

    #[test]
    fn the_spanning_tree_has_the_strongest_edges() {
        let graph = graph(4, &[(0, 1, 10.0), (1, 2, 20.0), (0, 2, 30.0), (2, 3, 1.0)]);
        assert_eq!(graph.maximum_spanning_forest(), vec![2, 1, 3]);
    }

    #[test]
    fn the_center_of_a_chain_does_not_depend_on_the_numbering() {
        // A chain of five images in the order 3 - 0 - 4 - 1 - 2.
        let graph = graph(5, &[(3, 0, 1.0), (4, 1, 1.0), (1, 2, 1.0), (0, 4, 1.0)]);
        let tree = graph.maximum_spanning_forest();
        assert_eq!(graph.center(&tree), Some(4));
        let steps = graph.breadth_first(&tree, 4);
        assert_eq!(steps.iter().map(|s| (s.parent, s.node)).collect::<Vec<_>>(), vec![(4, 1), (4, 0), (1, 2), (0, 3)]);
    }

    #[test]
    fn empty_graphs_and_indices_out_of_range() {
        let empty = graph(0, &[]);
        assert_eq!((empty.connected_components().len(), empty.center(&[])), (0, None));
        let edge = PairEdge { a: 0, b: 3, weight: 1.0 };
        assert_eq!(PairGraph::new(3, vec![edge]), Err(NoSuchNode { edge: 0, a: 0, b: 3, nodes: 3 }));
        assert!(graph(3, &[(0, 1, 1.0)]).breadth_first(&[0, 7], 9).is_empty());
        // The isolated node has eccentricity 0, but is not in the largest tree.
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
        fn nodes_are_in_one_component_if_a_path_connects_them(graph in any_graph()) {
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
        fn the_spanning_forest_has_the_maximum_weight(graph in any_graph()) {
            let forest = graph.maximum_spanning_forest();
            let total_weight = |edges: &[usize]| edges.iter().map(|&e| graph.edges()[e].weight).sum::<f64>();
            let rank = graph.nodes() - graph.connected_components().len();
            prop_assert_eq!(forest.len(), rank);
            // All spanning forests by exhaustive enumeration.
            for bits in 0..1_u32 << graph.edges().len() {
                let chosen: Vec<usize> = (0..graph.edges().len()).filter(|e| bits >> e & 1 == 1).collect();
                if chosen.len() == rank && distances(&graph, &chosen) .iter().flatten().filter(|d| **d < usize::MAX / 2).count()
                    == distances(&graph, &forest).iter().flatten().filter(|d| **d < usize::MAX / 2).count() {
                    prop_assert!(total_weight(&chosen) <= total_weight(&forest));
                }
            }
        }

        #[test]
        fn the_center_has_the_minimum_eccentricity_of_the_largest_tree(graph in any_graph()) {
            let tree = graph.maximum_spanning_forest();
            let d = distances(&graph, &tree);
            let reached = |i: usize| d[i].iter().filter(|d| **d < usize::MAX / 2).count();
            let eccentricity = |i: usize| d[i].iter().copied().filter(|d| *d < usize::MAX / 2).max();
            let center = graph.center(&tree).unwrap();
            for i in 0..graph.nodes() {
                prop_assert!(reached(center) >= reached(i));
                prop_assert!(reached(center) > reached(i) || eccentricity(center) <= eccentricity(i));
            }
            for step in graph.breadth_first(&tree, center) {
                prop_assert_eq!(d[center][step.node], d[center][step.parent] + 1);
            }
        }
    }
}
