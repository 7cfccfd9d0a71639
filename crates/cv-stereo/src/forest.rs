//! Union–find over runs of pixels, with path halving. The root of a set is its smallest member, whatever the order of the joins.

/// The root of the set that `i` belongs to.
pub(crate) fn find(parents: &mut [u32], mut i: u32) -> u32 {
    while parents[i as usize] != i {
        let up = parents[parents[i as usize] as usize];
        parents[i as usize] = up;
        i = up;
    }
    i
}

/// Makes one set of those of `a` and `b`.
pub(crate) fn join(parents: &mut [u32], a: u32, b: u32) {
    let (a, b) = (find(parents, a), find(parents, b));
    parents[a.max(b) as usize] = a.min(b);
}
