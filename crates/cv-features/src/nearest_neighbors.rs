//! Exact nearest neighbors of descriptors by blocked matrix products.
//!
//! |q − t|² = |q|² + |t|² − 2 q·t: the nearest candidate of a query maximizes the score q·t − |t|²/2. The products of
//! six queries with a panel of candidates stay in registers, and the two best of each are selected before anything is
//! stored. The same products determine the nearest query of each candidate. The distances of the selected candidates
//! are then recomputed as sums of squared differences, so equal descriptors have distance zero.

use crate::Descriptors;
use cv_core::{Cancelled, Progress, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};

/// The nearest and second-nearest neighbor of a descriptor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TwoNearest {
    pub(crate) best: u32,
    pub(crate) ssd: f32,
    /// Infinite if there is only one candidate.
    pub(crate) second_ssd: f32,
}

/// Number of queries of a register block.
const QUERIES: usize = 6;
/// Number of queries of a parallel task: they and a panel fit the L2 cache.
const TASK_QUERIES: usize = 16 * QUERIES;
/// Panels between checks for cancellation: some milliseconds.
const PANELS_PER_CHECK: usize = 128;
/// Index of no candidate.
pub(crate) const NONE: u32 = u32::MAX;

/// Finds the two nearest candidates of each query and, if `both_ways`, the nearest query of each candidate. Ties by
/// index.
///
/// Both sets must have at least one and fewer than 2³² − 1 descriptors, of the same dimension.
pub(crate) fn nearest(
    level: Level,
    query: &Descriptors,
    train: &Descriptors,
    both_ways: bool,
    progress: &dyn Progress,
) -> Result<(Vec<TwoNearest>, Vec<u32>), Cancelled> {
    let stage = Stage::new(progress, "match", query.len().div_ceil(TASK_QUERIES))?;
    dispatch!(level, simd => nearest_impl(simd, query, train, both_ways, &stage))
}

#[inline(always)]
fn nearest_impl<S: Simd>(
    simd: S,
    query: &Descriptors,
    train: &Descriptors,
    both_ways: bool,
    stage: &Stage<'_>,
) -> Result<(Vec<TwoNearest>, Vec<u32>), Cancelled> {
    // As many sums as fit the registers of the instruction set.
    if S::f32s::LEN >= 16 {
        blocked::<S, 4>(simd, query, train, both_ways, stage)
    } else {
        blocked::<S, 2>(simd, query, train, both_ways, stage)
    }
}

/// Candidates in panels of `V` vectors, transposed for sequential access.
struct Panels {
    /// For each panel, `dimension` rows of `width` values.
    data: Vec<f32>,
    /// |t|²/2; infinite for padding.
    half_norms: Vec<f32>,
    /// Candidates per panel.
    width: usize,
}

impl Panels {
    fn new(set: &Descriptors, width: usize) -> Self {
        let d = set.dimension();
        let count = set.len().div_ceil(width);
        let mut data = vec![0.0f32; count * width * d];
        data.par_chunks_mut(width * d).enumerate().for_each(|(p, panel)| {
            for (j, row) in set.as_slice().chunks_exact(d).skip(p * width).take(width).enumerate() {
                for (k, v) in row.iter().enumerate() {
                    panel[k * width + j] = *v;
                }
            }
        });
        let mut half_norms = vec![f32::INFINITY; count * width];
        half_norms.iter_mut().zip(set.as_slice().chunks_exact(d)).for_each(|(o, row)| *o = 0.5 * dot(row, row));
        Self { data, half_norms, width }
    }
}

/// The best and second best candidates of the queries so far, lane by lane.
struct Best {
    score: Vec<f32>,
    second: Vec<f32>,
    index: Vec<u32>,
    second_index: Vec<u32>,
}

/// Result of a task: the two nearest candidates of its queries, and the best of its queries for each candidate.
type TaskResult = (Vec<TwoNearest>, Vec<(f32, u32)>);

fn blocked<S: Simd, const V: usize>(
    simd: S,
    query: &Descriptors,
    train: &Descriptors,
    both_ways: bool,
    stage: &Stage<'_>,
) -> Result<(Vec<TwoNearest>, Vec<u32>), Cancelled> {
    let d = query.dimension();
    let panels = Panels::new(train, V * S::f32s::LEN);
    let tasks: Vec<TaskResult> = query
        .as_slice()
        .par_chunks(TASK_QUERIES * d)
        .enumerate()
        .map(|(task, rows)| {
            let nearest = simd.vectorize(
                #[inline(always)]
                || block::<S, V>(simd, rows, (task * TASK_QUERIES) as u32, d, train, &panels, both_ways, stage),
            )?;
            stage.add(1)?;
            Ok(nearest)
        })
        .try_collect::<_, Cancelled>()?;
    let mut forward = Vec::with_capacity(query.len());
    let mut backward = vec![(f32::NEG_INFINITY, NONE); if both_ways { train.len() } else { 0 }];
    for (rows, columns) in tasks {
        forward.extend(rows);
        for (best, candidate) in backward.iter_mut().zip(columns) {
            // Tasks are in order of their queries, so ties are resolved by index.
            if candidate.0 > best.0 {
                *best = candidate;
            }
        }
    }
    Ok((forward, backward.into_iter().map(|b| b.1).collect()))
}

/// Matches the queries of a task with all panels.
#[allow(clippy::too_many_arguments)]
#[inline(always)]
fn block<S: Simd, const V: usize>(
    simd: S,
    rows: &[f32],
    first: u32,
    d: usize,
    train: &Descriptors,
    panels: &Panels,
    both_ways: bool,
    stage: &Stage<'_>,
) -> Result<TaskResult, Cancelled> {
    let n = S::f32s::LEN;
    let width = panels.width;
    let count = rows.len() / d;
    let groups = count.div_ceil(QUERIES);
    // Interleaved groups: the values of six queries are adjacent. Padding queries are zero; their results are not used.
    let mut packed = vec![0.0f32; groups * QUERIES * d];
    for (i, row) in rows.chunks_exact(d).enumerate() {
        let group = &mut packed[i / QUERIES * QUERIES * d..];
        for (k, v) in row.iter().enumerate() {
            group[k * QUERIES + i % QUERIES] = *v;
        }
    }
    let mut half_norms = vec![f32::INFINITY; groups * QUERIES];
    half_norms.iter_mut().zip(rows.chunks_exact(d)).for_each(|(o, row)| *o = 0.5 * dot(row, row));
    let mut best = Best {
        score: vec![f32::NEG_INFINITY; groups * QUERIES * n],
        second: vec![f32::NEG_INFINITY; groups * QUERIES * n],
        index: vec![NONE; groups * QUERIES * n],
        second_index: vec![NONE; groups * QUERIES * n],
    };
    let mut columns = vec![(f32::NEG_INFINITY, NONE); 0];
    let mut column_score = vec![f32::NEG_INFINITY; if both_ways { panels.half_norms.len() } else { 0 }];
    let mut column_index = vec![NONE; column_score.len()];
    let lanes: Vec<u32> = (0..n as u32).collect();
    let lanes = S::u32s::from_slice(simd, &lanes);
    for (p, panel) in panels.data.chunks_exact(width * d).enumerate() {
        if p.is_multiple_of(PANELS_PER_CHECK) {
            stage.check()?;
        }
        let candidates = &panels.half_norms[p * width..(p + 1) * width];
        for (g, group) in packed.chunks_exact(QUERIES * d).enumerate() {
            let products = product::<S, V>(simd, group, panel);
            for (i, products) in products.iter().enumerate() {
                let at = (g * QUERIES + i) * n;
                let mut score = S::f32s::from_slice(simd, &best.score[at..at + n]);
                let mut second = S::f32s::from_slice(simd, &best.second[at..at + n]);
                let mut index = S::u32s::from_slice(simd, &best.index[at..at + n]);
                let mut second_index = S::u32s::from_slice(simd, &best.second_index[at..at + n]);
                for (v, product) in products.iter().enumerate() {
                    let indices = lanes + (p * width + v * n) as u32;
                    let s = *product - S::f32s::from_slice(simd, &candidates[v * n..(v + 1) * n]);
                    let better = s.simd_gt(score);
                    let next = s.simd_gt(second);
                    second_index = better.select(index, next.select(indices, second_index));
                    second = better.select(score, next.select(s, second));
                    index = better.select(indices, index);
                    score = better.select(s, score);
                }
                score.store_slice(&mut best.score[at..at + n]);
                second.store_slice(&mut best.second[at..at + n]);
                index.store_slice(&mut best.index[at..at + n]);
                second_index.store_slice(&mut best.second_index[at..at + n]);
            }
            if both_ways {
                for v in 0..V {
                    let at = p * width + v * n;
                    let mut score = S::f32s::from_slice(simd, &column_score[at..at + n]);
                    let mut index = S::u32s::from_slice(simd, &column_index[at..at + n]);
                    for (i, products) in products.iter().enumerate() {
                        let query = g * QUERIES + i;
                        let s = products[v] - half_norms[query];
                        let better = s.simd_gt(score);
                        index = better.select(S::u32s::splat(simd, first + query as u32), index);
                        score = better.select(s, score);
                    }
                    score.store_slice(&mut column_score[at..at + n]);
                    index.store_slice(&mut column_index[at..at + n]);
                }
            }
        }
    }
    if both_ways {
        columns = column_score.into_iter().zip(column_index).take(train.len()).collect();
    }
    let two = rows
        .chunks_exact(d)
        .enumerate()
        .map(|(i, row)| {
            let lanes = i * n..(i + 1) * n;
            let firsts = lanes.clone().map(|l| (best.score[l], best.index[l]));
            let seconds = lanes.map(|l| (best.second[l], best.second_index[l]));
            select_two(row, train, firsts.chain(seconds))
        })
        .collect();
    Ok((two, columns))
}

/// Computes the products of six queries with a panel of candidates.
#[inline(always)]
fn product<S: Simd, const V: usize>(simd: S, group: &[f32], panel: &[f32]) -> [[S::f32s; V]; QUERIES] {
    let n = S::f32s::LEN;
    let mut sums = [[S::f32s::splat(simd, 0.0); V]; QUERIES];
    for (queries, candidates) in group.chunks_exact(QUERIES).zip(panel.chunks_exact(V * n)) {
        let mut step = [S::f32s::splat(simd, 0.0); V];
        for v in 0..V {
            step[v] = S::f32s::from_slice(simd, &candidates[v * n..(v + 1) * n]);
        }
        for i in 0..QUERIES {
            let q = S::f32s::splat(simd, queries[i]);
            for v in 0..V {
                sums[i][v] = q.mul_add(step[v], sums[i][v]);
            }
        }
    }
    sums
}

/// Selects the two best candidates of all lanes, and computes their distances.
fn select_two(row: &[f32], train: &Descriptors, found: impl Iterator<Item = (f32, u32)>) -> TwoNearest {
    let mut two = [(f32::NEG_INFINITY, NONE); 2];
    for (score, index) in found.filter(|f| f.1 != NONE) {
        let is_better = |other: (f32, u32)| score > other.0 || (score == other.0 && index < other.1);
        if is_better(two[0]) {
            two = [(score, index), two[0]];
        } else if is_better(two[1]) {
            two[1] = (score, index);
        }
    }
    let distance = |index: u32| if index == NONE { f32::INFINITY } else { ssd(row, train.row(index as usize)) };
    let (a, b) = (distance(two[0].1), distance(two[1].1));
    // The rounding of products and differences differs; the order is that of the differences.
    if b < a {
        TwoNearest { best: two[1].1, ssd: b, second_ssd: a }
    } else {
        TwoNearest { best: two[0].1, ssd: a, second_ssd: b }
    }
}

/// Computes the sum of squared differences with 16 partial sums, so that it vectorizes.
#[inline]
pub(crate) fn ssd(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 16];
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    for (a, b) in a.iter().zip(b) {
        for i in 0..16 {
            let d = a[i] - b[i];
            sums[i] += d * d;
        }
    }
    sums.iter().sum::<f32>() + rest_a.iter().zip(rest_b).map(|(a, b)| (a - b) * (a - b)).sum::<f32>()
}

fn dot(a: &[f32], b: &[f32]) -> f32 {
    let mut sums = [0.0f32; 16];
    let ((a, rest_a), (b, rest_b)) = (a.as_chunks::<16>(), b.as_chunks::<16>());
    for (a, b) in a.iter().zip(b) {
        for i in 0..16 {
            sums[i] += a[i] * b[i];
        }
    }
    sums.iter().sum::<f32>() + rest_a.iter().zip(rest_b).map(|(a, b)| a * b).sum::<f32>()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DescriptorKind;
    use cv_core::Silent;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    /// Reference: all distances in f64, ties by index.
    fn plain(query: &Descriptors, train: &Descriptors) -> Vec<(usize, f64, f64)> {
        let distance = |i: usize, j: usize| -> f64 {
            query.row(i).iter().zip(train.row(j)).map(|(a, b)| f64::from(a - b).powi(2)).sum()
        };
        (0..query.len())
            .map(|i| {
                let mut two = (0, f64::INFINITY, f64::INFINITY);
                for j in 0..train.len() {
                    let s = distance(i, j);
                    if s < two.1 {
                        two = (j, s, two.1);
                    } else if s < two.2 {
                        two.2 = s;
                    }
                }
                two
            })
            .collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn equals_exhaustive_search(nq in 1usize..230, nt in 1usize..260, values in 2u32..40, d in 1usize..70, seed in any::<u32>()) {
            // Integers, so that sums are exact and duplicates and ties occur.
            let mut state = seed | 1;
            let mut set = |n: usize| {
                let data = (0..n * d)
                    .map(|k| {
                        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                        // Few dimensions differ, so that descriptors coincide.
                        if k % d < 3 { (state >> 16) as f32 % values as f32 } else { 1.0 }
                    })
                    .collect();
                Descriptors::from_vec(DescriptorKind::foreign(d), data).unwrap()
            };
            let (query, train) = (set(nq), set(nt));
            let expected = plain(&query, &train);
            let back = plain(&train, &query);
            for level in instruction_sets() {
                for both_ways in [false, true] {
                    let (forward, backward) = nearest(level, &query, &train, both_ways, &Silent).unwrap();
                    for (f, e) in forward.iter().zip(&expected) {
                        prop_assert_eq!((f.best as usize, f64::from(f.ssd), f64::from(f.second_ssd)), *e, "{:?}", level);
                    }
                    prop_assert_eq!(forward.len(), nq);
                    prop_assert_eq!(backward.len(), if both_ways { nt } else { 0 });
                    for (b, e) in backward.iter().zip(&back) {
                        prop_assert_eq!(*b as usize, e.0, "{:?}", level);
                    }
                }
            }
        }
    }
}
