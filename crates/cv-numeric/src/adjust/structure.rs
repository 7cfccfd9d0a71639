//! Sparsity structure of the normal equations, computed once per problem.

use super::residual::{Group, ResidualKind};
use super::schedule::{elimination_order, partition_tasks};
use std::collections::HashMap;
use std::ops::Range;

/// No block of the reduced system: fixed or eliminated.
pub(super) const NONE: u32 = u32::MAX;
/// Maximum number of columns of a block of the reduced system.
pub(super) const MAX_BLOCK_COLUMNS: usize = 64;
/// Number of columns up to which a dense factorization is faster for any pattern.
const MAX_DENSE_COLUMNS: usize = 400;
/// Fraction of filled blocks in the reduced system above which its factor is nearly dense.
const MAX_SPARSE_FILL: f64 = 0.3;

/// Maximum number of residuals summed in one batch: enough to amortize loading the sums, few enough that their rows stay in the L1 cache.
const MAX_RUN_LENGTH: usize = 32;

/// Lists of different lengths in one array (compressed sparse rows).
#[derive(Debug, Clone, Default)]
pub(super) struct JaggedArray<T> {
    /// Start of each list, and the end.
    start: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy> JaggedArray<T> {
    /// Builds the lists from pairs of list index and item; the items of a list keep their order.
    fn from_pairs(lists: usize, fill: T, pairs: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut start = vec![0u32; lists + 1];
        for (list, _) in pairs.clone() {
            start[list as usize + 1] += 1;
        }
        for i in 0..lists {
            start[i + 1] += start[i];
        }
        let mut next = start.clone();
        let mut items = vec![fill; start[lists] as usize];
        for (list, item) in pairs {
            let at = &mut next[list as usize];
            items[*at as usize] = item;
            *at += 1;
        }
        Self { start, items }
    }

    #[inline]
    pub(super) fn of(&self, list: usize) -> &[T] {
        &self.items[self.start[list] as usize..self.start[list + 1] as usize]
    }

    pub(super) fn iter(&self) -> impl Iterator<Item = &[T]> + Clone {
        self.start.windows(2).map(|range| &self.items[range[0] as usize..range[1] as usize])
    }
}

/// The columns of the reduced system that a block of a residual contributes to.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TargetColumns {
    /// Block of the reduced system, or [`NONE`].
    pub(super) block: u32,
    /// First column within that block.
    pub(super) within: u16,
    /// Number of columns.
    pub(super) width: u16,
    /// Offset of that block's columns among the cross blocks of the residual's eliminated block.
    pub(super) offset: u32,
    /// Number of columns of that block.
    pub(super) size: u32,
}

/// Incidence of a kind of residuals and the blocks. Items are processed in the order of *slots*: where a group is eliminated, by the ranks
/// of its blocks.
#[derive(Debug, Clone, Default)]
pub(super) struct Incidence {
    /// Index of the eliminated block among a residual's blocks.
    pub(super) eliminated: Option<usize>,
    pub(super) has_fixed: bool,
    fixed: Vec<Vec<u64>>,
    pub(super) targets: Vec<TargetColumns>,
    /// The item of each slot. The following fields are by slot.
    pub(super) items: Vec<u32>,
    /// First slot of each eliminated block, by its rank, and the end.
    point_start: Vec<u32>,
    /// Slots of each of [`Structure::tasks`].
    pub(super) residuals_of_task: JaggedArray<u32>,
}

impl Incidence {
    #[inline]
    pub(super) fn targets(&self, slot: usize, blocks: usize) -> &[TargetColumns] {
        &self.targets[slot * blocks..][..blocks]
    }

    /// Counts the leading consecutive slots that depend on the same blocks, at most [`MAX_RUN_LENGTH`]. `slots` ascend.
    #[inline]
    pub(super) fn run_length(&self, slots: impl Iterator<Item = usize>, blocks: usize) -> usize {
        let mut slots = slots.take(MAX_RUN_LENGTH);
        let Some(first) = slots.next() else { return 0 };
        let targets = self.targets(first, blocks);
        1 + (first + 1..).zip(slots).take_while(|(next, p)| next == p && self.targets(*p, blocks) == targets).count()
    }

    /// Slots of the residuals of the eliminated block of a rank.
    #[inline]
    pub(super) fn residuals_of_point(&self, rank: usize) -> Range<usize> {
        self.point_start[rank] as usize..self.point_start[rank + 1] as usize
    }

    #[inline]
    pub(super) fn fixed(&self, group: usize, block: u32) -> u64 {
        self.fixed[group][block as usize]
    }
}

/// A parameter block within a block of the reduced system.
#[derive(Debug, Clone, Copy)]
pub(super) struct Member {
    pub(super) group: usize,
    pub(super) block: u32,
    pub(super) within: usize,
    pub(super) width: usize,
}

/// A block of the reduced system: parameter blocks that occur in the same residuals, such as the pose and the lens of one image.
#[derive(Debug, Clone, Default)]
pub(super) struct ReducedBlock {
    pub(super) members: Vec<Member>,
    pub(super) column: usize,
    pub(super) size: usize,
}

/// A non-zero block of `W`: a block of the reduced system that shares residuals with an eliminated block.
#[derive(Debug, Clone, Copy)]
pub(super) struct CrossBlock {
    pub(super) block: u32,
    /// Offset of its columns among those of all cross blocks of the eliminated block.
    pub(super) offset: u32,
    pub(super) size: u32,
}

/// The eliminated group, called points as in bundle adjustment. Points are processed in the order of their ranks, those with the same
/// cross blocks consecutively, for cache locality.
#[derive(Debug, Clone)]
pub(super) struct Points {
    pub(super) group: usize,
    /// Degrees of freedom of a block.
    pub(super) size: usize,
    pub(super) count: usize,
    /// The block of each rank, and the rank of each block. The following fields are by rank.
    pub(super) order: Vec<u32>,
    pub(super) rank: Vec<u32>,
    /// Bit mask of the fixed degrees of freedom.
    pub(super) fixed: Vec<u64>,
    /// Blocks of the reduced system that share residuals with the point, ascending.
    pub(super) cross_blocks: JaggedArray<CrossBlock>,
    /// Start of the cross terms, and the end.
    pub(super) start: Vec<usize>,
}

/// Sparsity pattern of the reduced system: lower triangle by block columns; diagonal blocks are stored in full.
#[derive(Debug, Clone, Default)]
pub(super) struct Pattern {
    /// Start of each block column, and the end.
    pub(super) start: Vec<usize>,
    /// Number of rows of each block column.
    pub(super) height: Vec<usize>,
    /// Block and first row of each block of a column, ascending.
    pub(super) rows: Vec<Vec<(u32, u32)>>,
    /// Whether all blocks are non-zero.
    pub(super) dense: bool,
    /// First column of each block.
    column: Vec<usize>,
}

impl Pattern {
    /// Returns the first row of block `other`, which must be non-zero, in the block column of `b`.
    #[inline]
    pub(super) fn row(&self, b: usize, other: u32) -> usize {
        if self.dense {
            return self.column[other as usize] - self.column[b];
        }
        let rows = &self.rows[b];
        rows.binary_search_by_key(&other, |r| r.0).map_or(0, |i| rows[i].1 as usize)
    }
}

/// The sparsity structure of a problem.
#[derive(Debug, Clone)]
pub(super) struct Structure {
    pub(super) points: Option<Points>,
    pub(super) blocks: Vec<ReducedBlock>,
    /// Partition of the reduced system into tasks of consecutive blocks: first block of each, and the end. The order of summation into an
    /// entry does not depend on it.
    pub(super) tasks: Vec<usize>,
    /// For each task: the ranks of the eliminated blocks that share residuals with its blocks, ascending.
    pub(super) points_of_task: JaggedArray<u32>,
    pub(super) incidence: Vec<Incidence>,
    pub(super) pattern: Pattern,
    /// Number of columns of the reduced system.
    pub(super) columns: usize,
    /// Number of free columns; considered ones follow them.
    pub(super) free: usize,
    /// Block of the reduced system and index of the member in it, for each parameter block by group; [`NONE`] where there is none.
    pub(super) location: Vec<Vec<(u32, u32)>>,
    /// Standard deviations of the considered columns.
    pub(super) considered: Vec<f64>,
}

/// A parameter block that is not eliminated, and is variable or considered.
struct ActiveBlock {
    group: usize,
    block: u32,
    width: usize,
    considered: Option<usize>,
}

impl Structure {
    /// Builds the structure. `consider`: whether considered blocks are columns, or fixed.
    pub(super) fn new(
        groups: &[Group<'_>],
        kinds: &[Box<dyn ResidualKind + '_>],
        eliminated: Option<usize>,
        consider: bool,
    ) -> Self {
        let fixed: Vec<Vec<u64>> = groups
            .iter()
            .enumerate()
            .map(|(g, group)| {
                let mut fixed = group.fixed.clone();
                for &(block, _) in group.considered.iter().filter(|_| consider && Some(g) != eliminated) {
                    fixed[block] = 0;
                }
                fixed
            })
            .collect();
        let has_fixed = fixed.iter().flatten().any(|h| *h != 0);
        let position: Vec<Option<usize>> =
            kinds.iter().map(|k| eliminated.and_then(|e| k.groups().iter().position(|g| *g == e))).collect();
        let (active_blocks, active_index) = collect_active_blocks(groups, kinds, eliminated, &fixed, consider);
        let points = eliminated.map_or(0, |e| groups[e].count);
        let observed_points = collect_observed_points(kinds, &position, active_blocks.len(), &active_index);
        let (blocks, location, members) = merge_blocks(groups, &active_blocks, &active_index, &observed_points);
        let columns: usize = blocks.iter().map(|b| b.size).sum();
        let (mut free, mut considered) = (columns, Vec::new());
        for (block, members) in blocks.iter().zip(&members) {
            for active in members {
                if let Some(index) = active_blocks[*active].considered {
                    free = free.min(block.column);
                    considered.extend_from_slice(&groups[active_blocks[*active].group].considered[index].1);
                }
            }
        }
        // Cross blocks of each eliminated block, ascending since the reduced blocks are visited in order.
        let cross_pairs = blocks.iter().enumerate().zip(&members).flat_map(|((b, block), members)| {
            observed_points[members[0]]
                .iter()
                .map(move |p| (*p, CrossBlock { block: b as u32, offset: 0, size: block.size as u32 }))
        });
        let order = elimination_order(points, cross_pairs.clone());
        let mut rank = vec![0; points];
        order.iter().enumerate().for_each(|(r, p)| rank[*p as usize] = r as u32);
        let cross_pairs = cross_pairs.map(|(p, cross_block)| (rank[p as usize], cross_block));
        let mut cross_blocks =
            JaggedArray::from_pairs(points, CrossBlock { block: NONE, offset: 0, size: 0 }, cross_pairs);
        let mut start = Vec::with_capacity(points + 1);
        start.push(0);
        let size = eliminated.map_or(0, |e| groups[e].size);
        for p in 0..points {
            let mut offset = 0;
            for cross_block in
                &mut cross_blocks.items[cross_blocks.start[p] as usize..cross_blocks.start[p + 1] as usize]
            {
                cross_block.offset = offset;
                offset += cross_block.size;
            }
            start.push(start[p] + size * offset as usize);
        }
        let mut incidence: Vec<Incidence> = Vec::with_capacity(kinds.len());
        for (kind, position) in kinds.iter().zip(&position) {
            let mut targets = Vec::with_capacity(kind.len() * kind.groups().len());
            let (items, point_start) = match position {
                Some(e) => {
                    let pairs = (0..kind.len()).map(|i| (rank[kind.blocks(i)[*e] as usize], i as u32));
                    let residuals_of_point = JaggedArray::from_pairs(points, 0, pairs);
                    (residuals_of_point.items, residuals_of_point.start)
                }
                None => ((0..kind.len() as u32).collect(), Vec::new()),
            };
            for item in &items {
                let ids = kind.blocks(*item as usize);
                let around = position.map_or(&[][..], |e| cross_blocks.of(rank[ids[e] as usize] as usize));
                for (&group, &id) in kind.groups().iter().zip(ids) {
                    let (block, member) = location[group][id as usize];
                    targets.push(if block == NONE {
                        TargetColumns { block, within: 0, width: 0, offset: 0, size: 0 }
                    } else {
                        let member = &blocks[block as usize].members[member as usize];
                        let cross_block =
                            around.binary_search_by_key(&block, |c| c.block).map_or(0, |i| around[i].offset);
                        TargetColumns {
                            block,
                            within: member.within as u16,
                            width: member.width as u16,
                            offset: cross_block,
                            size: blocks[block as usize].size as u32,
                        }
                    });
                }
            }
            incidence.push(Incidence {
                eliminated: *position,
                has_fixed,
                fixed: if has_fixed { fixed.clone() } else { Vec::new() },
                targets,
                items,
                point_start,
                residuals_of_task: JaggedArray::default(),
            });
        }
        let pattern = build_pattern(&blocks, kinds, &incidence, &cross_blocks, columns);
        let tasks = partition_tasks(&blocks, kinds, &incidence, &cross_blocks);
        let mut task_of = vec![0; blocks.len()];
        tasks.windows(2).enumerate().for_each(|(t, range)| task_of[range[0]..range[1]].fill(t as u32));
        for (kind, incidence) in kinds.iter().zip(&mut incidence) {
            let n = kind.groups().len();
            let task = |t: &TargetColumns| if t.block == NONE { NONE } else { task_of[t.block as usize] };
            let touches = incidence.targets.chunks(n.max(1)).enumerate().flat_map(|(item, all)| {
                let first = move |k: &usize| all[..*k].iter().all(|t| task(t) != task(&all[*k]));
                (0..n).filter(move |k| all[*k].block != NONE && first(k)).map(move |k| (task(&all[k]), item as u32))
            });
            incidence.residuals_of_task = JaggedArray::from_pairs(tasks.len() - 1, 0, touches);
        }
        let points_of_task = {
            let pairs = (0..points).flat_map(|r| {
                let task = |c: &CrossBlock| task_of[c.block as usize];
                cross_blocks.of(r).chunk_by(move |a, b| task(a) == task(b)).map(move |c| (task(&c[0]), r as u32))
            });
            JaggedArray::from_pairs(tasks.len() - 1, 0, pairs)
        };
        let points = eliminated.map(|group| {
            let fixed = order.iter().map(|p| groups[group].fixed[*p as usize]).collect();
            Points { group, size, count: points, order, rank, fixed, cross_blocks, start }
        });
        Self { points, blocks, tasks, points_of_task, incidence, pattern, columns, free, location, considered }
    }
}

/// Collects the blocks that are variable or considered, and their indices by group and block.
fn collect_active_blocks(
    groups: &[Group<'_>],
    kinds: &[Box<dyn ResidualKind + '_>],
    eliminated: Option<usize>,
    fixed: &[Vec<u64>],
    consider: bool,
) -> (Vec<ActiveBlock>, Vec<Vec<u32>>) {
    let mut touched: Vec<Vec<bool>> = groups.iter().map(|g| vec![false; g.count]).collect();
    for kind in kinds {
        for item in 0..kind.len() {
            for (&group, &block) in kind.groups().iter().zip(kind.blocks(item)) {
                touched[group][block as usize] = true;
            }
        }
    }
    let mut active_blocks = Vec::new();
    let mut active_index: Vec<Vec<u32>> = groups.iter().map(|g| vec![NONE; g.count]).collect();
    for (g, group) in groups.iter().enumerate().filter(|(g, _)| Some(*g) != eliminated) {
        for block in 0..group.count {
            let width = group.size - fixed[g][block].count_ones() as usize;
            if touched[g][block] && width > 0 {
                active_index[g][block] = active_blocks.len() as u32;
                let considered = group.considered.iter().position(|c| c.0 == block).filter(|_| consider);
                active_blocks.push(ActiveBlock { group: g, block: block as u32, width, considered });
            }
        }
    }
    (active_blocks, active_index)
}

/// Collects the eliminated blocks that share residuals with each active block, ascending.
fn collect_observed_points(
    kinds: &[Box<dyn ResidualKind + '_>],
    position: &[Option<usize>],
    active_blocks: usize,
    active_index: &[Vec<u32>],
) -> Vec<Vec<u32>> {
    let mut lists = vec![Vec::new(); active_blocks];
    for (kind, position) in kinds.iter().zip(position) {
        let Some(e) = *position else { continue };
        for item in 0..kind.len() {
            let ids = kind.blocks(item);
            for (&group, &block) in kind.groups().iter().zip(ids) {
                let active = active_index[group][block as usize];
                if active != NONE {
                    let list: &mut Vec<u32> = &mut lists[active as usize];
                    if list.last() != Some(&ids[e]) {
                        list.push(ids[e]);
                    }
                }
            }
        }
    }
    for list in &mut lists {
        if !list.is_sorted() {
            list.sort_unstable();
        }
        list.dedup();
    }
    lists
}

/// Blocks of the reduced system, the location of each parameter block, and the active blocks of each reduced block.
type MergedBlocks = (Vec<ReducedBlock>, Vec<Vec<(u32, u32)>>, Vec<Vec<usize>>);
/// Merges active blocks that share residuals with the same eliminated blocks into one block of the reduced system. Sorted by the number of
/// eliminated blocks, so that shared parameters come last, where a column has few rows; considered blocks after all others.
fn merge_blocks(
    groups: &[Group<'_>],
    active_blocks: &[ActiveBlock],
    active_index: &[Vec<u32>],
    observed_points: &[Vec<u32>],
) -> MergedBlocks {
    let mut known: HashMap<(bool, &[u32]), usize> = HashMap::new();
    let mut sets: Vec<(Vec<usize>, usize)> = Vec::new();
    for (u, active) in active_blocks.iter().enumerate() {
        let key = (active.considered.is_some(), observed_points[u].as_slice());
        match known.get(&key) {
            Some(&set) if !observed_points[u].is_empty() && sets[set].1 + active.width <= MAX_BLOCK_COLUMNS => {
                sets[set].0.push(u);
                sets[set].1 += active.width;
            }
            _ => {
                known.insert(key, sets.len());
                sets.push((vec![u], active.width));
            }
        }
    }
    sets.sort_by_key(|(members, _)| {
        (active_blocks[members[0]].considered.is_some(), observed_points[members[0]].len())
    });
    let mut location: Vec<Vec<(u32, u32)>> = active_index.iter().map(|g| vec![(NONE, 0); g.len()]).collect();
    assert_eq!(groups.len(), location.len());
    let (mut blocks, mut column) = (Vec::with_capacity(sets.len()), 0);
    for (b, (members, size)) in sets.iter().enumerate() {
        let mut block = ReducedBlock { members: Vec::with_capacity(members.len()), column, size: *size };
        let mut within = 0;
        for (m, &u) in members.iter().enumerate() {
            let active = &active_blocks[u];
            block.members.push(Member { group: active.group, block: active.block, within, width: active.width });
            location[active.group][active.block as usize] = (b as u32, m as u32);
            within += active.width;
        }
        column += size;
        blocks.push(block);
    }
    (blocks, location, sets.into_iter().map(|s| s.0).collect())
}

/// Computes the non-zero blocks of the reduced system.
fn build_pattern(
    blocks: &[ReducedBlock],
    kinds: &[Box<dyn ResidualKind + '_>],
    incidence: &[Incidence],
    cross_blocks: &JaggedArray<CrossBlock>,
    columns: usize,
) -> Pattern {
    let n = blocks.len();
    // For each block: the tails, from it on, of the lists of cross blocks that contain it, and its residuals.
    let tails = cross_blocks.iter().flat_map(|list| list.iter().enumerate().map(move |(i, c)| (c.block, &list[i..])));
    let cross_block_tails = JaggedArray::from_pairs(n, &[][..], tails);
    let items: Vec<JaggedArray<&[TargetColumns]>> = kinds
        .iter()
        .zip(incidence)
        .map(|(kind, incidence)| {
            let items = incidence.targets.chunks(kind.groups().len().max(1));
            let pairs = items.flat_map(|all| all.iter().filter(|t| t.block != NONE).map(move |t| (t.block, all)));
            JaggedArray::from_pairs(n, &[][..], pairs)
        })
        .collect();
    let mut rows: Vec<Vec<u32>> = Vec::with_capacity(n);
    let mut mark = vec![NONE; n];
    for b in 0..n {
        let mut list = vec![b as u32];
        mark[b] = b as u32;
        let mut add = |block: u32| {
            if block != NONE && block as usize > b && mark[block as usize] != b as u32 {
                mark[block as usize] = b as u32;
                list.push(block);
            }
        };
        cross_block_tails.of(b).iter().copied().flatten().for_each(|c| add(c.block));
        items.iter().flat_map(|kind| kind.of(b)).copied().flatten().for_each(|t| add(t.block));
        list.sort_unstable();
        rows.push(list);
    }
    let filled = rows.iter().map(Vec::len).sum::<usize>() as f64;
    let dense = columns <= MAX_DENSE_COLUMNS || filled > MAX_SPARSE_FILL * 0.5 * (n * (n + 1)) as f64;
    if dense {
        rows = (0..n).map(|b| (b as u32..n as u32).collect()).collect();
    }
    let column = blocks.iter().map(|b| b.column).collect();
    let mut pattern = Pattern { start: vec![0], dense, column, ..Pattern::default() };
    for (block, rows) in blocks.iter().zip(rows) {
        let mut height = 0;
        let placed = rows
            .into_iter()
            .map(|b| {
                let first = height;
                height += blocks[b as usize].size;
                (b, first as u32)
            })
            .collect();
        pattern.rows.push(placed);
        pattern.height.push(height);
        pattern.start.push(pattern.start[pattern.start.len() - 1] + height * block.size);
    }
    pattern
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::adjust::{Adjustment, Euclidean, Residual, RobustLoss};
    use nalgebra::{SMatrix, Vector2};

    /// Residuals of two positions in a plane, of which only the structure matters.
    struct Pairs;

    impl Residual<2, 2, 4> for Pairs {
        const DIMS: [usize; 2] = [2, 2];

        fn evaluate(&self, _: usize, _: [&[f64]; 2], _: Option<&mut SMatrix<f64, 2, 4>>) -> Option<Vector2<f64>> {
            None
        }
    }

    #[test]
    fn the_pattern_of_a_long_chain_with_shortcuts_is_sparse() {
        // That of tests/solvers, which compares its solution.
        let n = 300;
        let mut problem = Adjustment::default();
        let positions = problem.add_group("positions", Euclidean(2), vec![0.0; 2 * n as usize]).unwrap();
        let mut blocks: Vec<[u32; 2]> = (0..n).map(|i| [i, (i + 1) % n]).collect();
        blocks.extend((0..n).step_by(9).map(|i| [i, (i + 20) % n]));
        problem.add_residuals("pairs", Pairs, [positions; 2], blocks, RobustLoss::Trivial).unwrap();
        problem.fix(positions, 0).unwrap();
        assert!(!Structure::new(&problem.groups, &problem.kinds, None, false).pattern.dense);
    }
}
