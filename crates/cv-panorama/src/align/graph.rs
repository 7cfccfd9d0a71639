//! The graph of photographs (nodes) and verified overlaps (edges): groups, spanning tree, middle.

use cv_core::UnionFind;
use std::cmp::Ordering;

/// An overlap between nodes `a` and `b`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Edge {
    pub(crate) a: usize,
    pub(crate) b: usize,
    pub(crate) weight: f64,
}

/// The connected groups of nodes `0..n`, the largest first (of equals, the one with the greater sum of weights, then the one
/// with the lowest node). Nodes ascend within a group.
pub(crate) fn groups(n: usize, edges: &[Edge]) -> Vec<Vec<usize>> {
    let mut sets = UnionFind::new(n);
    for e in edges {
        sets.union(e.a as u32, e.b as u32);
    }
    let roots = sets.into_roots();
    let mut members: Vec<(f64, Vec<usize>)> = vec![(0.0, Vec::new()); n];
    for i in 0..n {
        members[roots[i] as usize].1.push(i);
    }
    for e in edges {
        members[roots[e.a] as usize].0 += e.weight;
    }
    members.retain(|(_, m)| !m.is_empty());
    members.sort_by(|x, y| y.1.len().cmp(&x.1.len()).then(y.0.total_cmp(&x.0)).then(x.1.cmp(&y.1)));
    members.into_iter().map(|(_, m)| m).collect()
}

/// The edges (as indices) of the spanning tree of greatest weight over the nodes that `edges` connect (Kruskal).
pub(crate) fn maximum_spanning_tree(n: usize, edges: &[Edge]) -> Vec<usize> {
    let mut order: Vec<usize> = (0..edges.len()).collect();
    order.sort_by(|&i, &j| edges[j].weight.total_cmp(&edges[i].weight).then(i.cmp(&j)));
    let mut sets = UnionFind::new(n);
    order.retain(|&i| sets.union(edges[i].a as u32, edges[i].b as u32));
    order
}

/// One step of a walk over the tree: `node` is reached from `parent` through edge `edge`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Step {
    pub(crate) parent: usize,
    pub(crate) node: usize,
    pub(crate) edge: usize,
}

/// Breadth-first walk over the tree's edges from `root`.
pub(crate) fn walk(n: usize, edges: &[Edge], tree: &[usize], root: usize) -> Vec<Step> {
    let mut neighbors: Vec<Vec<(usize, usize)>> = vec![Vec::new(); n];
    for &e in tree {
        neighbors[edges[e].a].push((edges[e].b, e));
        neighbors[edges[e].b].push((edges[e].a, e));
    }
    let mut seen = vec![false; n];
    seen[root] = true;
    let (mut steps, mut queue) = (Vec::new(), std::collections::VecDeque::from([root]));
    while let Some(parent) = queue.pop_front() {
        for &(node, edge) in &neighbors[parent] {
            if !std::mem::replace(&mut seen[node], true) {
                steps.push(Step { parent, node, edge });
                queue.push_back(node);
            }
        }
    }
    steps
}

/// The node in the middle of the tree: the least distance to its farthest node, then the least sum of distances, then the greatest
/// weight of its edges, so that the choice does not follow the order of the files.
pub(crate) fn middle(n: usize, edges: &[Edge], tree: &[usize], members: &[usize]) -> Option<usize> {
    let rate = |root: usize| {
        let mut depth = vec![0_usize; n];
        let (mut deepest, mut sum) = (0, 0);
        for step in walk(n, edges, tree, root) {
            depth[step.node] = depth[step.parent] + 1;
            deepest = deepest.max(depth[step.node]);
            sum += depth[step.node];
        }
        let weight: f64 = edges.iter().filter(|e| e.a == root || e.b == root).map(|e| e.weight).sum();
        (deepest, sum, weight)
    };
    members
        .iter()
        .copied()
        .map(|m| (rate(m), m))
        .min_by(|(x, i), (y, j)| {
            x.0.cmp(&y.0).then(x.1.cmp(&y.1)).then(y.2.total_cmp(&x.2)).then(i.cmp(j)).then(Ordering::Equal)
        })
        .map(|(_, m)| m)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn edge(a: usize, b: usize, weight: f64) -> Edge {
        Edge { a, b, weight }
    }

    #[test]
    fn two_groups_are_told_apart_and_the_larger_comes_first() {
        let edges = [edge(4, 0, 9.0), edge(1, 2, 5.0), edge(2, 5, 5.0)];
        assert_eq!(groups(6, &edges), vec![vec![1, 2, 5], vec![0, 4], vec![3]]);
    }

    #[test]
    fn the_spanning_tree_takes_the_strongest_edges() {
        let edges = [edge(0, 1, 10.0), edge(1, 2, 20.0), edge(0, 2, 30.0), edge(2, 3, 1.0)];
        assert_eq!(maximum_spanning_tree(4, &edges), vec![2, 1, 3]);
    }

    #[test]
    fn the_middle_of_a_chain_is_found_in_any_file_order() {
        // A chain of five, its photographs numbered in shuffled order: 3 - 0 - 4 - 1 - 2.
        let edges = [edge(3, 0, 1.0), edge(4, 1, 1.0), edge(1, 2, 1.0), edge(0, 4, 1.0)];
        let tree = maximum_spanning_tree(5, &edges);
        assert_eq!(middle(5, &edges, &tree, &[0, 1, 2, 3, 4]), Some(4));
        let steps = walk(5, &edges, &tree, 4);
        assert_eq!(steps.iter().map(|s| (s.parent, s.node)).collect::<Vec<_>>(), vec![(4, 1), (4, 0), (1, 2), (0, 3)]);
    }
}
