//! Which block meets which: the pattern of the normal equations, found once for a problem.

use super::residual::{Group, Kind};
use super::schedule::{order, tasks};
use std::collections::HashMap;
use std::ops::Range;

/// No block: held, or eliminated.
pub(super) const NONE: u32 = u32::MAX;
/// Most columns of a block of the reduced system.
pub(super) const MOST_COLUMNS: usize = 64;
/// Below this size a dense factorization is faster whatever the pattern.
const SMALL: usize = 400;
/// Above this share of the reduced system's blocks, its factor is about full.
const FULL: f64 = 0.3;

/// Most residuals that are summed at once: so many that what they are added to is seldom fetched, and so few that their rows stay in the nearest cache.
const RUN: usize = 32;

/// Lists of different lengths, one after the other.
#[derive(Debug, Clone, Default)]
pub(super) struct Lists<T> {
    /// Where each list starts, and the end.
    start: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy> Lists<T> {
    /// From pairs of list and item; the items of a list keep their order.
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

/// Where a block of a residual goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Target {
    /// Block of the reduced system, or [`NONE`].
    pub(super) block: u32,
    /// First column within that block.
    pub(super) within: u16,
    /// Columns.
    pub(super) width: u16,
    /// First column of that block among the blocks that the residual's eliminated block is seen with.
    pub(super) place: u32,
    /// Columns of that block.
    pub(super) size: u32,
}

/// What a kind of residuals touches. Its items are worked on in an order of their own, that of their places: where a group is eliminated, by the ranks of
/// its blocks.
#[derive(Debug, Clone, Default)]
pub(super) struct Links {
    /// Which of a residual's blocks is eliminated.
    pub(super) eliminated: Option<usize>,
    pub(super) any_held: bool,
    held: Vec<Vec<u64>>,
    pub(super) targets: Vec<Target>,
    /// The item of each place. What follows is by place.
    pub(super) items: Vec<u32>,
    /// Where the residuals of each eliminated block begin, by its rank, and the end.
    point_start: Vec<u32>,
    /// Residuals of each of [`Structure::tasks`].
    pub(super) of_task: Lists<u32>,
}

impl Links {
    #[inline]
    pub(super) fn targets(&self, place: usize, blocks: usize) -> &[Target] {
        &self.targets[place * blocks..][..blocks]
    }

    /// How many of these places, which are ascending, from the first one on follow each other and depend on the same blocks: [`RUN`] at the most.
    #[inline]
    pub(super) fn run(&self, places: impl Iterator<Item = usize>, blocks: usize) -> usize {
        let mut places = places.take(RUN);
        let Some(first) = places.next() else { return 0 };
        let targets = self.targets(first, blocks);
        1 + (first + 1..).zip(places).take_while(|(next, p)| next == p && self.targets(*p, blocks) == targets).count()
    }

    /// Residuals of the eliminated block of a rank.
    #[inline]
    pub(super) fn of_point(&self, rank: usize) -> Range<usize> {
        self.point_start[rank] as usize..self.point_start[rank + 1] as usize
    }

    #[inline]
    pub(super) fn held(&self, group: usize, block: u32) -> u64 {
        self.held[group][block as usize]
    }
}

/// A block of parameters within a block of the reduced system.
#[derive(Debug, Clone, Copy)]
pub(super) struct Member {
    pub(super) group: usize,
    pub(super) block: u32,
    pub(super) within: usize,
    pub(super) width: usize,
}

/// A block of the reduced system: blocks of parameters that occur in the same residuals, such as the pose and the lens of one photograph.
#[derive(Debug, Clone, Default)]
pub(super) struct ReducedBlock {
    pub(super) members: Vec<Member>,
    pub(super) column: usize,
    pub(super) size: usize,
}

/// A block of the reduced system that sees an eliminated block.
#[derive(Debug, Clone, Copy)]
pub(super) struct Cell {
    pub(super) block: u32,
    /// First of its columns among those of all that see the eliminated block.
    pub(super) place: u32,
    pub(super) size: u32,
}

/// The group that is eliminated. Its blocks are worked on in an order of their own, that of their ranks: blocks that are seen by the same blocks of the
/// reduced system one after the other, so that what they are added to stays in the cache.
#[derive(Debug, Clone)]
pub(super) struct Points {
    pub(super) group: usize,
    /// Degrees of freedom of a block.
    pub(super) size: usize,
    pub(super) count: usize,
    /// The block of each rank, and the rank of each block. What follows is by rank.
    pub(super) order: Vec<u32>,
    pub(super) rank: Vec<u32>,
    /// A bit for each degree of freedom that is held, of each block.
    pub(super) held: Vec<u64>,
    /// The blocks of the reduced system that see each, ascending.
    pub(super) cells: Lists<Cell>,
    /// Where the cross terms of each start, and the end.
    pub(super) start: Vec<usize>,
}

/// Lower triangle of the reduced system by block columns; blocks on the diagonal are whole.
#[derive(Debug, Clone, Default)]
pub(super) struct Pattern {
    /// Where each block column starts, and the end.
    pub(super) start: Vec<usize>,
    /// Rows of each block column.
    pub(super) height: Vec<usize>,
    /// Block and first row of each block of a column, ascending.
    pub(super) rows: Vec<Vec<(u32, u32)>>,
    /// Whether all blocks are there.
    pub(super) dense: bool,
    /// First column of each block.
    column: Vec<usize>,
}

impl Pattern {
    /// First row of block `other`, which is there, in the column of block `b`.
    #[inline]
    pub(super) fn row(&self, b: usize, other: u32) -> usize {
        if self.dense {
            return self.column[other as usize] - self.column[b];
        }
        let rows = &self.rows[b];
        rows.binary_search_by_key(&other, |r| r.0).map_or(0, |i| rows[i].1 as usize)
    }
}

/// All of it.
#[derive(Debug, Clone)]
pub(super) struct Structure {
    pub(super) points: Option<Points>,
    pub(super) blocks: Vec<ReducedBlock>,
    /// Consecutive blocks of the reduced system whose columns are summed by one task: where each begins, and the end. What is added to an entry, and in
    /// which order, does not depend on them.
    pub(super) tasks: Vec<usize>,
    /// For each task: the ranks of the eliminated blocks that its blocks see, ascending.
    pub(super) seen: Lists<u32>,
    pub(super) links: Vec<Links>,
    pub(super) pattern: Pattern,
    /// Columns of the reduced system.
    pub(super) columns: usize,
    /// Those that are free; considered ones come after them.
    pub(super) free: usize,
    /// Block of the reduced system and member of it of each block of parameters, by group; [`NONE`] where there is none.
    pub(super) place: Vec<Vec<(u32, u32)>>,
    /// Standard deviations of the considered columns.
    pub(super) considered: Vec<f64>,
}

/// A block of parameters that is not eliminated, and moves or is considered.
struct Unit {
    group: usize,
    block: u32,
    width: usize,
    considered: Option<usize>,
}

impl Structure {
    /// `consider`: whether considered blocks are columns, or held.
    pub(super) fn new(
        groups: &[Group<'_>],
        kinds: &[Box<dyn Kind + '_>],
        eliminated: Option<usize>,
        consider: bool,
    ) -> Self {
        let held: Vec<Vec<u64>> = groups
            .iter()
            .enumerate()
            .map(|(g, group)| {
                let mut held = group.held.clone();
                for &(block, _) in group.considered.iter().filter(|_| consider && Some(g) != eliminated) {
                    held[block] = 0;
                }
                held
            })
            .collect();
        let any_held = held.iter().flatten().any(|h| *h != 0);
        let position: Vec<Option<usize>> =
            kinds.iter().map(|k| eliminated.and_then(|e| k.groups().iter().position(|g| *g == e))).collect();
        let (units, unit_of) = units(groups, kinds, eliminated, &held, consider);
        let points = eliminated.map_or(0, |e| groups[e].count);
        let witnesses = witnesses(kinds, &position, units.len(), &unit_of);
        let (blocks, place, members) = merged(groups, &units, &unit_of, &witnesses);
        let columns: usize = blocks.iter().map(|b| b.size).sum();
        let (mut free, mut considered) = (columns, Vec::new());
        for (block, members) in blocks.iter().zip(&members) {
            for unit in members {
                if let Some(index) = units[*unit].considered {
                    free = free.min(block.column);
                    considered.extend_from_slice(&groups[units[*unit].group].considered[index].1);
                }
            }
        }
        // The blocks of the reduced system that see each eliminated one: ascending, as the blocks are gone through in order.
        let sights = blocks.iter().enumerate().zip(&members).flat_map(|((b, block), members)| {
            witnesses[members[0]].iter().map(move |p| (*p, Cell { block: b as u32, place: 0, size: block.size as u32 }))
        });
        let order = order(points, sights.clone());
        let mut rank = vec![0; points];
        order.iter().enumerate().for_each(|(r, p)| rank[*p as usize] = r as u32);
        let sights = sights.map(|(p, cell)| (rank[p as usize], cell));
        let mut cells = Lists::from_pairs(points, Cell { block: NONE, place: 0, size: 0 }, sights);
        let mut start = Vec::with_capacity(points + 1);
        start.push(0);
        let size = eliminated.map_or(0, |e| groups[e].size);
        for p in 0..points {
            let mut place = 0;
            for cell in &mut cells.items[cells.start[p] as usize..cells.start[p + 1] as usize] {
                cell.place = place;
                place += cell.size;
            }
            start.push(start[p] + size * place as usize);
        }
        let mut links: Vec<Links> = Vec::with_capacity(kinds.len());
        for (kind, position) in kinds.iter().zip(&position) {
            let mut targets = Vec::with_capacity(kind.len() * kind.groups().len());
            let (items, point_start) = match position {
                Some(e) => {
                    let pairs = (0..kind.len()).map(|i| (rank[kind.blocks(i)[*e] as usize], i as u32));
                    let of_point = Lists::from_pairs(points, 0, pairs);
                    (of_point.items, of_point.start)
                }
                None => ((0..kind.len() as u32).collect(), Vec::new()),
            };
            for item in &items {
                let ids = kind.blocks(*item as usize);
                let around = position.map_or(&[][..], |e| cells.of(rank[ids[e] as usize] as usize));
                for (&group, &id) in kind.groups().iter().zip(ids) {
                    let (block, member) = place[group][id as usize];
                    targets.push(if block == NONE {
                        Target { block, within: 0, width: 0, place: 0, size: 0 }
                    } else {
                        let member = &blocks[block as usize].members[member as usize];
                        let cell = around.binary_search_by_key(&block, |c| c.block).map_or(0, |i| around[i].place);
                        Target {
                            block,
                            within: member.within as u16,
                            width: member.width as u16,
                            place: cell,
                            size: blocks[block as usize].size as u32,
                        }
                    });
                }
            }
            links.push(Links {
                eliminated: *position,
                any_held,
                held: if any_held { held.clone() } else { Vec::new() },
                targets,
                items,
                point_start,
                of_task: Lists::default(),
            });
        }
        let pattern = pattern(&blocks, kinds, &links, &cells, columns);
        let tasks = tasks(&blocks, kinds, &links, &cells);
        let mut task_of = vec![0; blocks.len()];
        tasks.windows(2).enumerate().for_each(|(t, range)| task_of[range[0]..range[1]].fill(t as u32));
        for (kind, links) in kinds.iter().zip(&mut links) {
            let n = kind.groups().len();
            let task = |t: &Target| if t.block == NONE { NONE } else { task_of[t.block as usize] };
            let touches = links.targets.chunks(n.max(1)).enumerate().flat_map(|(item, all)| {
                let first = move |k: &usize| all[..*k].iter().all(|t| task(t) != task(&all[*k]));
                (0..n).filter(move |k| all[*k].block != NONE && first(k)).map(move |k| (task(&all[k]), item as u32))
            });
            links.of_task = Lists::from_pairs(tasks.len() - 1, 0, touches);
        }
        let seen = {
            let pairs = (0..points).flat_map(|r| {
                let task = |c: &Cell| task_of[c.block as usize];
                cells.of(r).chunk_by(move |a, b| task(a) == task(b)).map(move |c| (task(&c[0]), r as u32))
            });
            Lists::from_pairs(tasks.len() - 1, 0, pairs)
        };
        let points = eliminated.map(|group| {
            let held = order.iter().map(|p| groups[group].held[*p as usize]).collect();
            Points { group, size, count: points, order, rank, held, cells, start }
        });
        Self { points, blocks, tasks, seen, links, pattern, columns, free, place, considered }
    }
}

/// The blocks that move or are considered, and their numbers by group and block.
fn units(
    groups: &[Group<'_>],
    kinds: &[Box<dyn Kind + '_>],
    eliminated: Option<usize>,
    held: &[Vec<u64>],
    consider: bool,
) -> (Vec<Unit>, Vec<Vec<u32>>) {
    let mut touched: Vec<Vec<bool>> = groups.iter().map(|g| vec![false; g.count]).collect();
    for kind in kinds {
        for item in 0..kind.len() {
            for (&group, &block) in kind.groups().iter().zip(kind.blocks(item)) {
                touched[group][block as usize] = true;
            }
        }
    }
    let mut units = Vec::new();
    let mut unit_of: Vec<Vec<u32>> = groups.iter().map(|g| vec![NONE; g.count]).collect();
    for (g, group) in groups.iter().enumerate().filter(|(g, _)| Some(*g) != eliminated) {
        for block in 0..group.count {
            let width = group.size - held[g][block].count_ones() as usize;
            if touched[g][block] && width > 0 {
                unit_of[g][block] = units.len() as u32;
                let considered = group.considered.iter().position(|c| c.0 == block).filter(|_| consider);
                units.push(Unit { group: g, block: block as u32, width, considered });
            }
        }
    }
    (units, unit_of)
}

/// The eliminated blocks that each unit is seen with, ascending.
fn witnesses(
    kinds: &[Box<dyn Kind + '_>],
    position: &[Option<usize>],
    units: usize,
    unit_of: &[Vec<u32>],
) -> Vec<Vec<u32>> {
    let mut lists = vec![Vec::new(); units];
    for (kind, position) in kinds.iter().zip(position) {
        let Some(e) = *position else { continue };
        for item in 0..kind.len() {
            let ids = kind.blocks(item);
            for (&group, &block) in kind.groups().iter().zip(ids) {
                let unit = unit_of[group][block as usize];
                if unit != NONE {
                    let list: &mut Vec<u32> = &mut lists[unit as usize];
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

/// Units that are seen with the same eliminated blocks become one block of the reduced system. In order of their number of those, so that
/// what is shared by many comes last, where a column has few rows; considered ones after all others. With the place of each block of
/// parameters, and the units of each block.
type Merged = (Vec<ReducedBlock>, Vec<Vec<(u32, u32)>>, Vec<Vec<usize>>);
fn merged(groups: &[Group<'_>], units: &[Unit], unit_of: &[Vec<u32>], witnesses: &[Vec<u32>]) -> Merged {
    let mut known: HashMap<(bool, &[u32]), usize> = HashMap::new();
    let mut sets: Vec<(Vec<usize>, usize)> = Vec::new();
    for (u, unit) in units.iter().enumerate() {
        let key = (unit.considered.is_some(), witnesses[u].as_slice());
        match known.get(&key) {
            Some(&set) if !witnesses[u].is_empty() && sets[set].1 + unit.width <= MOST_COLUMNS => {
                sets[set].0.push(u);
                sets[set].1 += unit.width;
            }
            _ => {
                known.insert(key, sets.len());
                sets.push((vec![u], unit.width));
            }
        }
    }
    sets.sort_by_key(|(members, _)| (units[members[0]].considered.is_some(), witnesses[members[0]].len()));
    let mut place: Vec<Vec<(u32, u32)>> = unit_of.iter().map(|g| vec![(NONE, 0); g.len()]).collect();
    debug_assert_eq!(groups.len(), place.len());
    let (mut blocks, mut column) = (Vec::with_capacity(sets.len()), 0);
    for (b, (members, size)) in sets.iter().enumerate() {
        let mut block = ReducedBlock { members: Vec::with_capacity(members.len()), column, size: *size };
        let mut within = 0;
        for (m, &u) in members.iter().enumerate() {
            let unit = &units[u];
            block.members.push(Member { group: unit.group, block: unit.block, within, width: unit.width });
            place[unit.group][unit.block as usize] = (b as u32, m as u32);
            within += unit.width;
        }
        column += size;
        blocks.push(block);
    }
    (blocks, place, sets.into_iter().map(|s| s.0).collect())
}

fn pattern(
    blocks: &[ReducedBlock],
    kinds: &[Box<dyn Kind + '_>],
    links: &[Links],
    cells: &Lists<Cell>,
    columns: usize,
) -> Pattern {
    let n = blocks.len();
    // For each block: the rest of the lists that it stands in, and the residuals that it occurs in.
    let tails = cells.iter().flat_map(|list| list.iter().enumerate().map(move |(i, c)| (c.block, &list[i..])));
    let seen = Lists::from_pairs(n, &[][..], tails);
    let items: Vec<Lists<&[Target]>> = kinds
        .iter()
        .zip(links)
        .map(|(kind, links)| {
            let items = links.targets.chunks(kind.groups().len().max(1));
            let pairs = items.flat_map(|all| all.iter().filter(|t| t.block != NONE).map(move |t| (t.block, all)));
            Lists::from_pairs(n, &[][..], pairs)
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
        seen.of(b).iter().copied().flatten().for_each(|c| add(c.block));
        items.iter().flat_map(|kind| kind.of(b)).copied().flatten().for_each(|t| add(t.block));
        list.sort_unstable();
        rows.push(list);
    }
    let filled = rows.iter().map(Vec::len).sum::<usize>() as f64;
    let dense = columns <= SMALL || filled > FULL * 0.5 * (n * (n + 1)) as f64;
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
