//! Alpha expansion (Boykov, Veksler & Zabih 2001): every label in turn is expanded by a minimum cut, until the energy no longer decreases.

use crate::blend::NO_PHOTO;
use crate::rows::{for_each_row, is_check_due};
use crate::surface::{Bounds, WarpedPhoto};
use cv_core::{Cancelled, Image, Stage, UnionFind};
use cv_imgproc::{GridCut, grid_neighbors};
use cv_parallel::prelude::*;

/// Smoothness cost per unit of seam length.
pub(super) const LENGTH_COST: i32 = 4 * 3;

/// The energy of a labeling: data term and smoothness term.
pub(super) struct Labeling<'a, U, D, F> {
    /// The photograph of each label, which limits where the label is allowed.
    pub(super) photos: &'a [Option<&'a WarpedPhoto>],
    /// Data term `unary(label, x, y)`.
    pub(super) unary: U,
    /// Difference of two labels at a pixel, `difference(a, b, x, y)`. The smoothness term is `LENGTH_COST` plus the differences at both neighbors.
    pub(super) difference: D,
    /// Returns which pixels of a row may change their labels.
    pub(super) free: F,
    /// Of a canvas that spans 360°: the smoothness term of a label at a pixel of the first or last column and another at the pixel beyond that border, in the other of
    /// these columns, `beyond(label, other, x, y)`.
    pub(super) beyond: Option<&'a BeyondCost<'a>>,
}

/// See [`Labeling::beyond`].
pub(super) type BeyondCost<'a> = dyn Fn(usize, usize, usize, usize) -> i32 + Sync + 'a;

/// Pixels of a row that are skipped at once where none may change its label.
const RUN: usize = 32;

/// Nodes processed between two checks for cancellation.
const NODES_PER_CHECK: usize = 1 << 14;

/// Infinite capacity.
const INFINITE: i32 = 1 << 28;

impl<'a, U, D, F> Labeling<'a, U, D, F>
where
    U: Fn(usize, usize, usize) -> i32 + Sync,
    D: Fn(usize, usize, usize, usize) -> i32 + Sync,
    F: Fn(usize) -> &'a [bool] + Sync,
{
    /// Expands every label in turn until the energy no longer decreases, at most `rounds` times.
    pub(super) fn expand(&self, labels: &mut Image<u16, 1>, rounds: usize, stage: &Stage<'_>) -> Result<(), Cancelled> {
        let bounds: Vec<Option<Bounds>> = self.photos.iter().map(|photo| photo.map(|p| p.bounds)).collect();
        let circle = self.beyond.map(|_| labels.width());
        let groups = independent_groups(&bounds, circle);
        // A label is tried again only if a label near it changed.
        let mut stale = vec![true; self.photos.len()];
        for _ in 0..rounds {
            for group in &groups {
                let turn: Vec<usize> =
                    group.iter().copied().filter(|&k| std::mem::replace(&mut stale[k], false)).collect();
                let snapshot = &*labels;
                let changes: Vec<Vec<usize>> =
                    turn.par_iter().map(|&alpha| self.expand_one(snapshot, alpha, stage)).try_collect()?;
                for (&alpha, changed) in turn.iter().zip(&changes).filter(|(_, changed)| !changed.is_empty()) {
                    changed.iter().for_each(|&i| labels.as_mut_slice()[i] = alpha as u16);
                    for (other, s) in stale.iter_mut().enumerate() {
                        *s |= other != alpha && touch(&bounds, circle, other, alpha);
                    }
                }
            }
            if !stale.contains(&true) {
                break;
            }
        }
        Ok(())
    }

    /// Returns the indices of the pixels that the optimal expansion of `alpha` relabels, in ascending order.
    pub(super) fn expand_one(
        &self,
        labels: &Image<u16, 1>,
        alpha: usize,
        stage: &Stage<'_>,
    ) -> Result<Vec<usize>, Cancelled> {
        let (width, height) = labels.size();
        let Some(own) = self.photos[alpha] else { return Ok(Vec::new()) };
        let Some(b) = own.bounds.intersection(&Bounds { left: 0, top: 0, right: width, bottom: height }) else {
            return Ok(Vec::new());
        };
        let label_at = |x: usize, y: usize| labels.as_slice()[y * width + x];
        // Nodes: free pixels of other labels that alpha covers.
        let mut places: Vec<[u32; 2]> = Vec::new();
        for y in b.top..b.bottom {
            if is_check_due(y, b.width()) {
                stage.check()?;
            }
            let free = &(self.free)(y)[b.left..b.right];
            for (start, free) in (b.left..).step_by(RUN).zip(free.chunks(RUN)) {
                if !free.iter().fold(false, |any, free| any | free) {
                    continue;
                }
                for (x, free) in (start..).zip(free) {
                    let label = label_at(x, y);
                    if *free && label != NO_PHOTO && usize::from(label) != alpha && own.reaches(x, y) {
                        places.push([x as u32, y as u32]);
                    }
                }
            }
        }
        // A cut does not depend on nodes that are not connected to it: of the other seams of the photograph.
        let parts = connected_parts(&places, stage)?;
        let changed = parts.par_iter().map(|places| self.expand_part(labels, alpha, places, stage)).try_collect()?;
        let mut changed: Vec<usize> = changed.concat();
        // Several parts may extend over the same rows.
        changed.sort_unstable();
        Ok(changed)
    }

    /// Returns the indices of the pixels of a connected part of the nodes that the optimal expansion of `alpha` relabels.
    fn expand_part(
        &self,
        labels: &Image<u16, 1>,
        alpha: usize,
        places: &[[u32; 2]],
        stage: &Stage<'_>,
    ) -> Result<Vec<usize>, Cancelled> {
        let (width, height) = labels.size();
        let label_at = |x: usize, y: usize| labels.as_slice()[y * width + x];
        let differ = &self.difference;
        let place = |i: usize| (places[i][0] as usize, places[i][1] as usize);
        // Difference of alpha and the current label at each node: all that most edges, between pixels of one label, need.
        let mut shown = vec![0; places.len()];
        for_each_row(&mut shown, NODES_PER_CHECK, stage, |chunk, out| {
            for (i, out) in (chunk * NODES_PER_CHECK..).zip(out) {
                let (x, y) = place(i);
                *out = differ(alpha, usize::from(label_at(x, y)), x, y);
            }
        })?;
        let mut cut = GridCut::new(places, stage)?;
        // Source side: keeps its label. Sink side: switches to alpha.
        for i in 0..places.len() {
            if i % NODES_PER_CHECK == 0 {
                stage.check()?;
            }
            let (x, y) = place(i);
            let p = usize::from(label_at(x, y));
            cut.add_terminal(i, (self.unary)(alpha, x, y), (self.unary)(p, x, y));
            let [left, above] = cut.has_left_and_upper(i);
            let fixed = |x: usize, y: usize, is_node: bool| (!is_node).then_some((x, y));
            let (right, below) = (cut.right(i), cut.below(i));
            let beside = [
                fixed(x.wrapping_sub(1), y, left || x == 0),
                fixed(x, y.wrapping_sub(1), above || y == 0),
                fixed(x + 1, y, right.is_some() || x + 1 == width),
                fixed(x, y + 1, below.is_some() || y + 1 == height),
            ];
            // An edge to a fixed neighbor is a data term.
            for (nx, ny) in beside.into_iter().flatten().filter(|&(nx, ny)| label_at(nx, ny) != NO_PHOTO) {
                let q = usize::from(label_at(nx, ny));
                let keep = if p == q { 0 } else { LENGTH_COST + differ(p, q, x, y) + differ(p, q, nx, ny) };
                let here = if p == q { shown[i] } else { differ(alpha, q, x, y) };
                let switch = if q == alpha { 0 } else { LENGTH_COST + here + differ(alpha, q, nx, ny) };
                add_signed(&mut cut, i, switch - keep);
            }
            // As of a fixed neighbor, although it may be a node, too, of a photograph placed on both sides at once (around a pole).
            if let Some(beyond) = self.beyond.filter(|_| x == 0 || x + 1 == width) {
                let q = label_at(width - 1 - x, y);
                if q != NO_PHOTO {
                    let q = usize::from(q);
                    add_signed(&mut cut, i, beyond(alpha, q, x, y) - beyond(p, q, x, y));
                }
            }
            for (j, nx, ny) in
                [(right, x + 1, y), (below, x, y + 1)].into_iter().filter_map(|(j, x, y)| Some((j?, x, y)))
            {
                let q = usize::from(label_at(nx, ny));
                // Energy if both keep their labels, if only the first and if only the second switches.
                let (keep, first, second) = if p == q {
                    let either = LENGTH_COST + shown[i] + shown[j];
                    (0, either, either)
                } else {
                    let keep = LENGTH_COST + differ(p, q, x, y) + differ(p, q, nx, ny);
                    (
                        keep,
                        LENGTH_COST + differ(alpha, q, x, y) + shown[j],
                        LENGTH_COST + shown[i] + differ(alpha, p, nx, ny),
                    )
                };
                // Submodularity, E(keep, keep) ≤ E(alpha, keep) + E(keep, alpha), is a triangle inequality; it is enforced at borders.
                let second = second.max(keep - first);
                // E = keep·[both keep] + first·[first only] + second·[second only], as terminals and one arc:
                // first's switching costs (first − keep), second's then costs −first, and splitting pays the rest.
                add_signed(&mut cut, i, first - keep);
                add_signed(&mut cut, j, -first);
                let arc = first + second - keep;
                // Paid where the first keeps (source) and the second switches (sink).
                if ny == y { cut.add_right(i, arc, 0) } else { cut.add_down(i, arc, 0) }
            }
        }
        cut.solve(stage)?;
        let taken = (0..places.len()).filter(|&i| cut.is_on_sink_side(i));
        Ok(taken.map(|i| places[i][1] as usize * width + places[i][0] as usize).collect())
    }
}

/// Splits pixels (column, row) in row-major order into those that are connected along rows and columns, in the order of their first pixels.
fn connected_parts(pixels: &[[u32; 2]], stage: &Stage<'_>) -> Result<Vec<Vec<[u32; 2]>>, Cancelled> {
    let mut sets = UnionFind::new(pixels.len());
    grid_neighbors(pixels, |i, right, below| {
        if i % NODES_PER_CHECK == 0 {
            stage.check()?;
        }
        [right, below].into_iter().flatten().for_each(|other| {
            sets.union(i as u32, other as u32);
        });
        Ok(())
    })?;
    let mut parts: Vec<Vec<[u32; 2]>> = Vec::new();
    let mut part_of = vec![usize::MAX; pixels.len()];
    for (pixel, root) in pixels.iter().zip(sets.into_roots()) {
        let part = &mut part_of[root as usize];
        if *part == usize::MAX {
            *part = parts.len();
            parts.push(Vec::new());
        }
        parts[*part].push(*pixel);
    }
    Ok(parts)
}

/// Returns whether the bounds of two photographs overlap or touch, also across the border of a canvas that spans 360°, of width `circle`.
fn touch(bounds: &[Option<Bounds>], circle: Option<usize>, a: usize, b: usize) -> bool {
    let (Some(a), Some(b)) = (bounds[a], bounds[b]) else { return false };
    let meet = |a: Bounds, b: Bounds| a.left == 0 && circle.is_some_and(|width| b.right >= width);
    meet(a, b) || meet(b, a) || a.grown(1, usize::MAX, usize::MAX).intersection(&b).is_some()
}

/// Partitions the photographs into groups that do not [`touch`]: expansions within a group are independent and run in parallel.
pub(super) fn independent_groups(bounds: &[Option<Bounds>], circle: Option<usize>) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for k in 0..bounds.len() {
        match groups.iter_mut().find(|group| group.iter().all(|&other| !touch(bounds, circle, k, other))) {
            Some(group) => group.push(k),
            None => groups.push(vec![k]),
        }
    }
    groups
}

/// Adds a cost (of either sign) of switching to alpha, i.e. of the sink side.
fn add_signed(cut: &mut GridCut, place: usize, cost: i32) {
    cut.add_terminal(place, cost.clamp(0, INFINITE), (-cost).clamp(0, INFINITE));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{drawn, stage};
    use proptest::prelude::*;

    /// Three labels on 3 × 3 pixels: colors, whose differences are a metric, unary costs, and which pixels may change.
    #[derive(Debug, Clone)]
    struct Tiny {
        colors: Vec<i32>,
        unary: Vec<i32>,
        start: Vec<u16>,
        free: Vec<bool>,
    }

    const N: usize = 9;

    fn tiny() -> impl Strategy<Value = Tiny> {
        let lists = (
            proptest::collection::vec(0..60_i32, 3 * N),
            proptest::collection::vec(0..40_i32, 3 * N),
            proptest::collection::vec(0..3_u16, N),
            proptest::collection::vec(proptest::bool::weighted(0.8), N),
        );
        lists.prop_map(|(colors, unary, start, free)| Tiny { colors, unary, start, free })
    }

    impl Tiny {
        fn unary(&self, label: usize, x: usize, y: usize) -> i32 {
            self.unary[label * N + 3 * y + x]
        }

        fn difference(&self, a: usize, b: usize, x: usize, y: usize) -> i32 {
            (self.colors[a * N + 3 * y + x] - self.colors[b * N + 3 * y + x]).abs()
        }

        /// The definition of the cost.
        fn cost(&self, labels: &[u16]) -> i32 {
            let at = |x: usize, y: usize| usize::from(labels[3 * y + x]);
            let mut cost = 0;
            for (x, y) in (0..3).flat_map(|y| (0..3).map(move |x| (x, y))) {
                cost += self.unary(at(x, y), x, y);
                for (nx, ny) in [(x + 1, y), (x, y + 1)] {
                    if nx < 3 && ny < 3 && at(x, y) != at(nx, ny) {
                        let (p, q) = (at(x, y), at(nx, ny));
                        cost += LENGTH_COST + self.difference(p, q, x, y) + self.difference(p, q, nx, ny);
                    }
                }
            }
            cost
        }

        fn expanded(&self, labels: usize, rounds: usize) -> Vec<u16> {
            let whole = Bounds { left: 0, top: 0, right: 3, bottom: 3 };
            let photos: Vec<WarpedPhoto> = (0..labels).map(|_| drawn(whole, |_, _| [0; 3])).collect();
            let photos: Vec<Option<&WarpedPhoto>> = photos.iter().map(Some).collect();
            let mut found = Image::from_fn(3, 3, |x, y| [self.start[3 * y + x].min(labels as u16 - 1)]);
            let labeling = Labeling {
                photos: &photos,
                unary: |l, x, y| self.unary(l, x, y),
                difference: |a, b, x, y| self.difference(a, b, x, y),
                free: |y: usize| &self.free[3 * y..3 * y + 3],
                beyond: None,
            };
            labeling.expand(&mut found, rounds, &stage()).unwrap();
            found.into_vec()
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        #[test]
        fn of_two_labels_the_cheapest_labeling_is_found(problem in tiny()) {
            let found = problem.expanded(2, 20);
            let start: Vec<u16> = problem.start.iter().map(|l| (*l).min(1)).collect();
            let mut least = i32::MAX;
            for bits in 0..1_u32 << N {
                let labels: Vec<u16> =
                    (0..N).map(|i| if problem.free[i] { (bits >> i & 1) as u16 } else { start[i] }).collect();
                least = least.min(problem.cost(&labels));
            }
            // An expansion of one label of two may take any set of pixels: after one of each, none is cheaper to take.
            prop_assert!(problem.cost(&found) <= problem.cost(&start));
            for (i, free) in problem.free.iter().enumerate() {
                prop_assert!(*free || found[i] == start[i]);
            }
            prop_assert_eq!(problem.cost(&found), least);
        }

        #[test]
        fn no_label_of_three_can_lower_the_cost_by_taking_over_pixels(problem in tiny()) {
            let found = problem.expanded(3, 50);
            let cost = problem.cost(&found);
            for alpha in 0..3_u16 {
                for bits in 0..1_u32 << N {
                    let taken = |i: usize| bits >> i & 1 == 1 && problem.free[i];
                    let labels: Vec<u16> = (0..N).map(|i| if taken(i) { alpha } else { found[i] }).collect();
                    prop_assert!(problem.cost(&labels) >= cost, "{alpha} {bits:b}");
                }
            }
        }
    }

    #[test]
    fn pixels_are_connected_along_rows_and_columns_only() {
        // Rows of pixels: a U, whose ends are connected by its last row, one that touches it diagonally, and one apart.
        let rows = ["x.x..", "x.x..", "xxx.x", "...x."];
        let pixels: Vec<[u32; 2]> = (0..4)
            .flat_map(|y| (0..5).map(move |x| [x, y]))
            .filter(|&[x, y]| rows[y as usize].as_bytes()[x as usize] == b'x')
            .collect();
        let parts = connected_parts(&pixels, &stage()).unwrap();
        let whole = [[0, 0], [2, 0], [0, 1], [2, 1], [0, 2], [1, 2], [2, 2]];
        assert_eq!(parts, [whole.to_vec(), vec![[4, 2]], vec![[3, 3]]]);
        assert!(connected_parts(&[], &stage()).unwrap().is_empty());
    }

    #[test]
    fn relabeled_pixels_of_several_parts_are_in_row_major_order() {
        // Two parts that take the other label: the second begins in the last row of the first, on its left.
        let rows = ["..xx", "x.x.", "x..."];
        let free: Vec<bool> = rows.iter().flat_map(|row| row.bytes().map(|b| b == b'x')).collect();
        let photo = drawn(Bounds { left: 0, top: 0, right: 4, bottom: 3 }, |_, _| [0; 3]);
        let labeling = Labeling {
            photos: &[Some(&photo), Some(&photo)],
            unary: |label, _, _| if label == 0 { 1000 } else { 0 },
            difference: |_, _, _, _| 0,
            free: |y: usize| &free[4 * y..4 * y + 4],
            beyond: None,
        };
        let changed = labeling.expand_one(&Image::new(4, 3, [0]), 1, &stage()).unwrap();
        assert_eq!(changed, [2, 3, 4, 6, 8]);
    }

    #[test]
    fn photographs_that_touch_are_never_tried_at_once() {
        let at = |left: usize, top: usize| Some(Bounds { left, top, right: left + 10, bottom: top + 10 });
        let photos = [at(0, 0), at(10, 0), at(21, 0), at(0, 11), at(40, 40), None];
        let groups = independent_groups(&photos, None);
        assert_eq!(groups.iter().map(Vec::len).sum::<usize>(), photos.len());
        for group in &groups {
            for (i, a) in group.iter().enumerate() {
                assert!(group[i + 1..].iter().all(|b| !touch(&photos, None, *a, *b)), "{groups:?}");
            }
        }
        // The first two are neighbors, the others lie apart from the first.
        assert_eq!(groups, [vec![0, 2, 3, 4, 5], vec![1]]);
        // Across the border of a canvas that spans 360°, too.
        let ends = [at(0, 0), at(30, 0), at(50, 0)];
        assert_eq!(independent_groups(&ends, None), [vec![0, 1, 2]]);
        assert_eq!(independent_groups(&ends, Some(60)), [vec![0, 1], vec![2]]);
    }
}
