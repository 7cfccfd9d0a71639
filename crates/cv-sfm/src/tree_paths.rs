//! Paths through a spanning forest.

use cv_geometry::TreeStep;

/// Rooted trees: paths between their nodes.
#[derive(Debug)]
pub(crate) struct TreePaths {
    /// Of each node: its parent, its depth, and the root of its tree. Roots are their own parents.
    nodes: Vec<(usize, usize, usize)>,
}

impl TreePaths {
    /// Creates `nodes` trees of one node each.
    pub(crate) fn new(nodes: usize) -> Self {
        Self { nodes: (0..nodes).map(|n| (n, 0, n)).collect() }
    }

    /// Adds a tree of one node to that of its parent.
    pub(crate) fn add(&mut self, step: &TreeStep) {
        let (_, depth, root) = self.nodes[step.parent];
        self.nodes[step.node] = (step.parent, depth + 1, root);
    }

    /// Returns the root of the tree of a node.
    pub(crate) fn root(&self, node: usize) -> usize {
        self.nodes[node].2
    }

    /// Returns the edges of the path between two nodes of a tree, each as its node farther from the root; `None`
    /// between nodes of different trees. O(depth).
    pub(crate) fn between(&self, mut a: usize, mut b: usize) -> Option<impl Iterator<Item = usize> + '_> {
        (self.root(a) == self.root(b)).then(|| {
            std::iter::from_fn(move || {
                if a == b {
                    return None;
                }
                let deeper = if self.nodes[a].1 >= self.nodes[b].1 { &mut a } else { &mut b };
                let node = *deeper;
                *deeper = self.nodes[node].0;
                Some(node)
            })
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn paths_have_the_edges_between_their_ends() {
        // Two trees, with 1 and 5 as roots; 7 is alone.
        let mut paths = TreePaths::new(8);
        for (parent, node) in [(1, 0), (1, 2), (1, 3), (3, 4), (5, 6)] {
            paths.add(&TreeStep { parent, node, edge: 0 });
        }
        let between = |a, b| {
            let mut nodes: Vec<usize> = paths.between(a, b)?.collect();
            nodes.sort_unstable();
            Some(nodes)
        };
        assert_eq!(between(2, 4), Some(vec![2, 3, 4]));
        assert_eq!(between(0, 4), Some(vec![0, 3, 4]));
        assert_eq!(between(4, 0), between(0, 4));
        assert_eq!(between(3, 3), Some(vec![]));
        assert_eq!(between(5, 6), Some(vec![6]));
        assert_eq!((between(0, 5), between(7, 0)), (None, None));
        assert_eq!((paths.root(4), paths.root(6), paths.root(7)), (1, 5, 7));
    }
}
