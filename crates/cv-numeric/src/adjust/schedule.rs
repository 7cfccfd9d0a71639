//! Elimination order of the points, and partition of the reduced system into tasks: for speed alone.

use super::residual::ResidualKind;
use super::structure::{CrossBlock, Incidence, JaggedArray, NONE, ReducedBlock};

/// Orders the eliminated blocks by the first two reduced blocks that share residuals with them. `cross_pairs`: all pairs of eliminated block and reduced block,
/// those of one eliminated block in ascending order.
pub(super) fn elimination_order(points: usize, cross_pairs: impl Iterator<Item = (u32, CrossBlock)>) -> Vec<u32> {
    let mut keys: Vec<([u32; 2], u32)> = (0..points as u32).map(|p| ([NONE; 2], p)).collect();
    for (p, cross_block) in cross_pairs {
        if let Some(free) = keys[p as usize].0.iter_mut().find(|k| **k == NONE) {
            *free = cross_block.block;
        }
    }
    keys.sort_unstable();
    keys.into_iter().map(|k| k.1).collect()
}

/// Tasks per thread, more than one to balance their different lengths.
const TASKS_PER_THREAD: usize = 4;

/// Partitions the reduced system into tasks of about equal work: see [`Structure::tasks`].
pub(super) fn partition_tasks(
    blocks: &[ReducedBlock],
    kinds: &[Box<dyn ResidualKind + '_>],
    incidence: &[Incidence],
    cross_blocks: &JaggedArray<CrossBlock>,
) -> Vec<usize> {
    let mut work = vec![0; blocks.len()];
    for list in cross_blocks.iter() {
        let mut height = 0;
        for cross_block in list.iter().rev() {
            height += u64::from(cross_block.size);
            work[cross_block.block as usize] += u64::from(cross_block.size) * height;
        }
    }
    for (kind, incidence) in kinds.iter().zip(incidence) {
        for item in incidence.targets.chunks(kind.groups().len().max(1)) {
            let height: u64 = item.iter().map(|t| u64::from(t.width)).sum();
            let free = item.iter().filter(|t| t.block != NONE);
            free.for_each(|t| work[t.block as usize] += u64::from(t.width) * height);
        }
    }
    let threads = rayon::current_num_threads();
    let count = if threads == 1 { 1 } else { (TASKS_PER_THREAD * threads) as u64 };
    let work_per_task = work.iter().sum::<u64>() / count + 1;
    let (mut tasks, mut done) = (vec![0], 0);
    for (b, work) in work.iter().enumerate() {
        done += work;
        if done >= work_per_task * tasks.len() as u64 && b + 1 < blocks.len() {
            tasks.push(b + 1);
        }
    }
    tasks.push(blocks.len());
    tasks
}
