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
