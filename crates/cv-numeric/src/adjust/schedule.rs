//! The order in which points are eliminated, and what of the reduced system each task sums: for speed alone.

use super::residual::Kind;
use super::structure::{Cell, Links, Lists, NONE, ReducedBlock};

/// The eliminated blocks by the first two blocks that see them, given all pairs, those of one block in ascending order.
pub(super) fn order(points: usize, sights: impl Iterator<Item = (u32, Cell)>) -> Vec<u32> {
    let mut keys: Vec<([u32; 2], u32)> = (0..points as u32).map(|p| ([NONE; 2], p)).collect();
    for (p, cell) in sights {
        if let Some(free) = keys[p as usize].0.iter_mut().find(|k| **k == NONE) {
            *free = cell.block;
        }
    }
    keys.sort_unstable();
    keys.into_iter().map(|k| k.1).collect()
}

/// Tasks for each thread: more, for they are not all of the same length.
const TASKS: usize = 4;

/// Parts of about the same work: see [`Structure::tasks`].
pub(super) fn tasks(
    blocks: &[ReducedBlock],
    kinds: &[Box<dyn Kind + '_>],
    links: &[Links],
    cells: &Lists<Cell>,
) -> Vec<usize> {
    let mut work = vec![0; blocks.len()];
    for list in cells.iter() {
        let mut height = 0;
        for cell in list.iter().rev() {
            height += u64::from(cell.size);
            work[cell.block as usize] += u64::from(cell.size) * height;
        }
    }
    for (kind, links) in kinds.iter().zip(links) {
        for item in links.targets.chunks(kind.groups().len().max(1)) {
            let height: u64 = item.iter().map(|t| u64::from(t.width)).sum();
            let free = item.iter().filter(|t| t.block != NONE);
            free.for_each(|t| work[t.block as usize] += u64::from(t.width) * height);
        }
    }
    let threads = rayon::current_num_threads();
    let count = if threads == 1 { 1 } else { (TASKS * threads) as u64 };
    let share = work.iter().sum::<u64>() / count + 1;
    let (mut tasks, mut done) = (vec![0], 0);
    for (b, work) in work.iter().enumerate() {
        done += work;
        if done >= share * tasks.len() as u64 && b + 1 < blocks.len() {
            tasks.push(b + 1);
        }
    }
    tasks.push(blocks.len());
    tasks
}
