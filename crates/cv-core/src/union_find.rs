//! Union-find over numbered items (Tarjan & van Leeuwen, "Worst-case analysis of set union algorithms", 1984).

/// Disjoint sets of the items 0, 1, 2, …, with path halving. The root of a set is its smallest item, whatever the order of the
/// unions. O(log n) amortized per operation, near constant where unions come in scan order.
///
/// ```
/// use cv_core::UnionFind;
///
/// let mut sets = UnionFind::new(4);
/// sets.union(3, 1);
/// assert_eq!((sets.find(3), sets.find(2)), (1, 2));
/// assert_eq!(sets.flatten(), [0, 1, 2, 1]);
/// ```
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct UnionFind {
    parents: Vec<u32>,
}

impl UnionFind {
    /// Makes `n` sets of one item each.
    pub fn new(n: usize) -> Self {
        Self { parents: (0..n as u32).collect() }
    }

    /// Number of items.
    #[inline]
    pub fn len(&self) -> usize {
        self.parents.len()
    }

    /// Whether there are no items.
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.parents.is_empty()
    }

    /// Removes all items and keeps the allocation.
    pub fn clear(&mut self) {
        self.parents.clear();
    }

    /// Adds an item in a set of its own and returns its index.
    #[inline]
    pub fn push(&mut self) -> u32 {
        let item = self.parents.len() as u32;
        self.parents.push(item);
        item
    }

    /// Appends the items and sets of `other`; their indices are offset by the number of items here.
    pub fn append(&mut self, other: &Self) {
        let offset = self.parents.len() as u32;
        self.parents.extend(other.parents.iter().map(|parent| parent + offset));
    }

    /// Finds the root (smallest item) of the set of `i`.
    ///
    /// # Panics
    /// Where there is no item `i`.
    #[inline]
    pub fn find(&mut self, mut i: u32) -> u32 {
        let parents = &mut self.parents[..];
        while parents[i as usize] != i {
            let up = parents[parents[i as usize] as usize];
            parents[i as usize] = up;
            i = up;
        }
        i
    }

    /// Merges the sets of `a` and `b`. Returns false where they were one set already.
    ///
    /// # Panics
    /// Where there is no item `a` or `b`.
    #[inline]
    pub fn union(&mut self, a: u32, b: u32) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        self.parents[a.max(b) as usize] = a.min(b);
        a != b
    }

    /// Compresses all paths and returns the root of each item. One pass: a parent's index is never above its child's.
    pub fn flatten(&mut self) -> &[u32] {
        for i in 0..self.parents.len() {
            self.parents[i] = self.parents[self.parents[i] as usize];
        }
        &self.parents
    }

    /// As [`Self::flatten`], by value.
    pub fn into_roots(mut self) -> Vec<u32> {
        self.flatten();
        self.parents
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn sets_equal_those_of_naive_relabeling(n in 1usize..30, pairs in prop::collection::vec((0u32..30, 0u32..30), 0..40), cut in 0usize..40) {
            // The definition: every item carries the smallest label of its set.
            let mut plain: Vec<u32> = (0..n as u32).collect();
            let mut sets = UnionFind::new(n);
            for (i, (a, b)) in pairs.into_iter().enumerate() {
                let (a, b) = (a % n as u32, b % n as u32);
                let (x, y) = (plain[a as usize], plain[b as usize]);
                plain.iter_mut().filter(|l| **l == x.max(y)).for_each(|l| *l = x.min(y));
                prop_assert_eq!(sets.union(a, b), x != y);
                if i == cut {
                    sets.flatten();
                }
            }
            for (i, root) in plain.iter().enumerate() {
                prop_assert_eq!(sets.clone().find(i as u32), *root);
            }
            let mut flat = sets.clone();
            prop_assert_eq!(flat.flatten(), &plain[..]);
            let mut two = sets.clone();
            two.append(&sets);
            prop_assert_eq!(two.push() as usize, 2 * n);
            let expected: Vec<u32> = plain.iter().copied().chain(plain.iter().map(|l| l + n as u32)).chain([2 * n as u32]).collect();
            prop_assert_eq!(two.flatten(), &expected[..]);
            prop_assert_eq!(two.into_roots(), expected);
        }
    }
}
