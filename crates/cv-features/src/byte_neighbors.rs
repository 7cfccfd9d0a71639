//! Exact nearest neighbors of byte descriptors by blocked integer matrix products.
//!
//! |q − t|² = |q|² + |t|² − 2 q·t in 32-bit integers, so all instruction sets give identical results. The products of
//! six queries with a panel of candidates stay in registers, with four bytes per step where byte products are available
//! (AVX-512 VNNI), and two 16-bit values elsewhere. They are compared with the current nearest distances of queries and
//! candidates; indices are updated only where a distance is smaller, which soon is rare.

use crate::ByteDescriptors;
use crate::nearest_neighbors::NONE;
use cv_core::{Cancelled, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{Level, dispatch, prelude::*};

/// The nearest and second-nearest neighbor of a descriptor; distances as sums of squared differences of bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TwoNearestBytes {
    pub(crate) best: u32,
    pub(crate) ssd: i32,
    /// `None` if there is only one candidate.
    pub(crate) second_ssd: Option<i32>,
}

/// Maximum dimension of a descriptor: the sums then stay below 2³¹.
pub(crate) const MAX_DIMENSION: usize = 8192;
/// Number of queries of a register block.
const QUERIES: usize = 6;
/// Number of queries of a parallel task: many, since the nearest queries of the candidates restart in each, and few
/// enough for the L2 cache.
pub(crate) const TASK_QUERIES: usize = 128 * QUERIES;
/// Panels between checks for cancellation: some milliseconds.
const PANELS_PER_CHECK: usize = 32;
/// |q|² of padding queries: larger than any distance, without overflow.
const PADDING_NORM: i32 = 1_500_000_000;

/// Finds the two nearest candidates of each query and, if `both_ways`, the nearest query of each candidate. Ties by
/// index.
///
/// Both sets must have at least one and fewer than 2³² − 1 descriptors, of the same dimension of at most
/// [`MAX_DIMENSION`].
pub(crate) fn nearest_bytes(
    level: Level,
    query: &ByteDescriptors,
    train: &ByteDescriptors,
    both_ways: bool,
    stage: &Stage<'_>,
) -> Result<(Vec<TwoNearestBytes>, Vec<u32>), Cancelled> {
    #[cfg(target_arch = "x86_64")]
    if let Some(avx512) = level.as_avx512() {
        return blocked::<_, Quads, 4>(avx512, Quads(avx512), query, train, both_ways, stage);
    }
    dispatch!(level, simd => blocked::<_, Pairs, 2>(simd, Pairs, query, train, both_ways, stage))
}

/// Dot products of packed bytes in 32-bit words.
trait Products<S: Simd>: Copy + Send + Sync {
    /// Bytes per word.
    const BYTES: usize;
    /// Offset subtracted from query bytes to make them signed.
    const OFFSET: i32;
    fn query_word(bytes: &[u8]) -> i32;
    fn candidate_word(bytes: &[u8]) -> i32;
    /// Adds in each lane the dot product of the bytes of two words to `sums`.
    fn add(self, sums: S::i32s, query: S::i32s, candidates: S::i32s) -> S::i32s;
}

/// Two bytes per word, each in 16 bits.
#[derive(Clone, Copy)]
struct Pairs;

impl<S: Simd> Products<S> for Pairs {
    const BYTES: usize = 2;
    const OFFSET: i32 = 0;

    fn query_word(bytes: &[u8]) -> i32 {
        let byte = |i: usize| bytes.get(i).map_or(0, |&b| i32::from(b));
        byte(0) | byte(1) << 16
    }

    fn candidate_word(bytes: &[u8]) -> i32 {
        <Self as Products<S>>::query_word(bytes)
    }

    #[inline(always)]
    fn add(self, sums: S::i32s, query: S::i32s, candidates: S::i32s) -> S::i32s {
        let (q, t): (S::i16s, S::i16s) = (query.bitcast(), candidates.bitcast());
        sums + q.pairwise_dot_product(t)
    }
}

/// Four bytes per word: signed for queries, unsigned for candidates (VNNI).
#[cfg(target_arch = "x86_64")]
#[derive(Clone, Copy)]
struct Quads(fearless_simd::Avx512);

#[cfg(target_arch = "x86_64")]
impl Products<fearless_simd::Avx512> for Quads {
    const BYTES: usize = 4;
    const OFFSET: i32 = 128;

    fn query_word(bytes: &[u8]) -> i32 {
        i32::from_le_bytes(std::array::from_fn(|i| bytes.get(i).map_or(0, |b| b.wrapping_sub(128))))
    }

    fn candidate_word(bytes: &[u8]) -> i32 {
        i32::from_le_bytes(std::array::from_fn(|i| bytes.get(i).copied().unwrap_or(0)))
    }

    #[inline(always)]
    fn add(
        self,
        sums: fearless_simd::i32x16<fearless_simd::Avx512>,
        query: fearless_simd::i32x16<fearless_simd::Avx512>,
        candidates: fearless_simd::i32x16<fearless_simd::Avx512>,
    ) -> fearless_simd::i32x16<fearless_simd::Avx512> {
        use std::arch::x86_64::{__m512i, _mm512_dpbusd_epi32};
        fearless_simd::kernel!(
            #[inline(always)]
            fn products(avx512: Avx512, sums: __m512i, candidates: __m512i, query: __m512i) -> __m512i {
                _mm512_dpbusd_epi32(sums, candidates, query)
            }
        );
        products(self.0, sums.into(), candidates.into(), query.into()).simd_into(self.0)
    }
}

/// Computes |v|² and the sum of the bytes.
fn squared_norm_and_sum(row: &[u8]) -> (i32, i32) {
    row.iter().fold((0, 0), |(squares, sum), &b| (squares + i32::from(b) * i32::from(b), sum + i32::from(b)))
}

/// Candidates in panels of several vectors, transposed for sequential access.
struct Panels {
    /// For each panel, a row of `width` words for each word of a descriptor.
    words: Vec<i32>,
    /// |t|², corrected for the offset of the query bytes, so that subtracting 2 × the sum of products gives |t|² − 2
    /// q·t; the maximum integer for padding.
    norms: Vec<i32>,
    /// Candidates per panel.
    width: usize,
    /// Words per descriptor.
    count: usize,
}

impl Panels {
    fn new<S: Simd, P: Products<S>>(set: &ByteDescriptors, width: usize) -> Self {
        let d = set.kind().dimension;
        let count = d.div_ceil(P::BYTES);
        let panels = set.len().div_ceil(width);
        let (mut words, mut norms) = (vec![0i32; panels * width * count], vec![i32::MAX; panels * width]);
        let rows = words
            .par_chunks_mut(width * count)
            .zip(norms.par_chunks_mut(width))
            .zip(set.as_slice().par_chunks(width * d));
        rows.for_each(|((panel, norms), rows)| {
            for (j, row) in rows.chunks_exact(d).enumerate() {
                for (k, bytes) in row.chunks(P::BYTES).enumerate() {
                    panel[k * width + j] = P::candidate_word(bytes);
                }
                let (squared_norm, sum) = squared_norm_and_sum(row);
                norms[j] = squared_norm - 2 * P::OFFSET * sum;
            }
        });
        Self { words, norms, width, count }
    }
}

/// Result of a task: the two nearest candidates of its queries, and the nearest of its queries for each candidate.
type TaskResult = (Vec<TwoNearestBytes>, Vec<(i32, u32)>);

fn blocked<S: Simd, P: Products<S>, const V: usize>(
    simd: S,
    products: P,
    query: &ByteDescriptors,
    train: &ByteDescriptors,
    both_ways: bool,
    stage: &Stage<'_>,
) -> Result<(Vec<TwoNearestBytes>, Vec<u32>), Cancelled> {
    let d = query.kind().dimension;
    let panels = Panels::new::<S, P>(train, V * S::i32s::LEN);
    let tasks: Vec<TaskResult> = query
        .as_slice()
        .par_chunks(TASK_QUERIES * d)
        .enumerate()
        .map(|(task, rows)| {
            let nearest = simd.vectorize(
                #[inline(always)]
                || block::<S, P, V>(simd, products, rows, (task * TASK_QUERIES) as u32, d, &panels, both_ways, stage),
            )?;
            stage.add(1)?;
            Ok(nearest)
        })
        .try_collect::<_, Cancelled>()?;
    let mut forward = Vec::with_capacity(query.len());
    let mut backward = vec![(i32::MAX, NONE); if both_ways { train.len() } else { 0 }];
    for (rows, columns) in tasks {
        forward.extend(rows);
        for (best, candidate) in backward.iter_mut().zip(columns) {
            // Tasks are in order of their queries, so ties are resolved by index.
            if candidate.0 < best.0 {
                *best = candidate;
            }
        }
    }
    Ok((forward, backward.into_iter().map(|b| b.1).collect()))
}

/// Matches the queries of a task with all panels.
#[allow(clippy::too_many_arguments)]
#[allow(clippy::needless_range_loop, reason = "over columns of an array of rows")]
#[inline(always)]
fn block<S: Simd, P: Products<S>, const V: usize>(
    simd: S,
    products: P,
    rows: &[u8],
    first: u32,
    d: usize,
    panels: &Panels,
    both_ways: bool,
    stage: &Stage<'_>,
) -> Result<TaskResult, Cancelled> {
    let n = S::i32s::LEN;
    let (width, count) = (panels.width, panels.count);
    let groups = (rows.len() / d).div_ceil(QUERIES);
    // Interleaved groups: the words of six queries are adjacent.
    let mut packed = vec![0i32; groups * QUERIES * count];
    let mut norms = vec![PADDING_NORM; groups * QUERIES];
    for (i, row) in rows.chunks_exact(d).enumerate() {
        let group = &mut packed[i / QUERIES * QUERIES * count..];
        for (k, bytes) in row.chunks(P::BYTES).enumerate() {
            group[k * QUERIES + i % QUERIES] = P::query_word(bytes);
        }
        norms[i] = squared_norm_and_sum(row).0;
    }
    // |t|² − 2 q·t of the two nearest candidates of each query, and the index of the nearest.
    let mut nearest = vec![[i32::MAX; 2]; groups * QUERIES];
    let mut indices = vec![NONE; groups * QUERIES];
    let mut column_nearest = vec![i32::MAX; if both_ways { panels.norms.len() } else { 0 }];
    let mut column_indices = vec![NONE; column_nearest.len()];
    for (p, panel) in panels.words.chunks_exact(width * count).enumerate() {
        if p.is_multiple_of(PANELS_PER_CHECK) {
            stage.check()?;
        }
        let candidates = &panels.norms[p * width..(p + 1) * width];
        for (g, group) in packed.chunks_exact(QUERIES * count).enumerate() {
            let products = product::<S, P, V>(simd, products, group, panel);
            // A separate array: indexing the products in a loop would keep them in memory instead of registers.
            let mut sums = [[S::i32s::splat(simd, 0); V]; QUERIES];
            for i in 0..QUERIES {
                for v in 0..V {
                    let norm = S::i32s::from_slice(simd, &candidates[v * n..(v + 1) * n]);
                    sums[i][v] = norm - (products[i][v] + products[i][v]);
                }
            }
            for (i, row) in sums.iter().enumerate() {
                let query = g * QUERIES + i;
                let limit = S::i32s::splat(simd, nearest[query][1]);
                let min = row[1..].iter().fold(row[0], |a, b| a.min(*b));
                if min.simd_lt(limit).to_bitmask() == 0 {
                    continue;
                }
                for (v, lanes) in row.iter().enumerate() {
                    let mut hits = lanes.simd_lt(limit).to_bitmask();
                    let lanes = lanes.as_slice();
                    while hits != 0 {
                        let lane = hits.trailing_zeros() as usize;
                        hits &= hits - 1;
                        let (value, two) = (lanes[lane], &mut nearest[query]);
                        if value < two[0] {
                            *two = [value, two[0]];
                            indices[query] = (p * width + v * n + lane) as u32;
                        } else if value < two[1] {
                            two[1] = value;
                        }
                    }
                }
            }
            if both_ways {
                let norms = &norms[g * QUERIES..(g + 1) * QUERIES];
                for v in 0..V {
                    let at = p * width + v * n;
                    let mut best = S::i32s::from_slice(simd, &column_nearest[at..at + n]);
                    let mut min = sums[0][v] + norms[0];
                    for i in 1..QUERIES {
                        min = min.min(sums[i][v] + norms[i]);
                    }
                    if min.simd_lt(best).to_bitmask() == 0 {
                        continue;
                    }
                    let mut index = S::u32s::from_slice(simd, &column_indices[at..at + n]);
                    for i in 0..QUERIES {
                        let distance = sums[i][v] + norms[i];
                        let better = distance.simd_lt(best);
                        best = better.select(distance, best);
                        index = better.select(S::u32s::splat(simd, first + (g * QUERIES + i) as u32), index);
                    }
                    best.store_slice(&mut column_nearest[at..at + n]);
                    index.store_slice(&mut column_indices[at..at + n]);
                }
            }
        }
    }
    let two = (0..rows.len() / d).map(|i| TwoNearestBytes {
        best: indices[i],
        ssd: nearest[i][0] + norms[i],
        second_ssd: (nearest[i][1] < i32::MAX).then(|| nearest[i][1] + norms[i]),
    });
    Ok((two.collect(), column_nearest.into_iter().zip(column_indices).collect()))
}

/// Computes the products of six queries with a panel of candidates.
#[inline(always)]
fn product<S: Simd, P: Products<S>, const V: usize>(
    simd: S,
    products: P,
    group: &[i32],
    panel: &[i32],
) -> [[S::i32s; V]; QUERIES] {
    let n = S::i32s::LEN;
    let mut sums = [[S::i32s::splat(simd, 0); V]; QUERIES];
    for (queries, candidates) in group.chunks_exact(QUERIES).zip(panel.chunks_exact(V * n)) {
        let mut step = [S::i32s::splat(simd, 0); V];
        for v in 0..V {
            step[v] = S::i32s::from_slice(simd, &candidates[v * n..(v + 1) * n]);
        }
        for i in 0..QUERIES {
            let q = S::i32s::splat(simd, queries[i]);
            for v in 0..V {
                sums[i][v] = products.add(sums[i][v], q, step[v]);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{ByteScale, DescriptorKind, Descriptors};
    use cv_core::Silent;
    use cv_synth::instruction_sets;
    use proptest::prelude::*;

    /// Index and distance of the nearest neighbor, and distance of the second nearest.
    type Two = (u32, i32, Option<i32>);

    /// Reference: all distances, ties by index.
    fn plain(query: &[u8], train: &[u8], d: usize) -> Vec<Two> {
        let distance =
            |q: &[u8], t: &[u8]| -> i32 { q.iter().zip(t).map(|(a, b)| (i32::from(*a) - i32::from(*b)).pow(2)).sum() };
        let one = |q: &[u8]| {
            let mut all: Vec<(i32, usize)> =
                train.chunks_exact(d).enumerate().map(|(j, t)| (distance(q, t), j)).collect();
            all.sort();
            (all[0].1 as u32, all[0].0, all.get(1).map(|s| s.0))
        };
        query.chunks_exact(d).map(one).collect()
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(40))]
        #[test]
        fn equals_exhaustive_search(
            nq in 1usize..60, nt in 1usize..260, many in any::<bool>(), varied in 1usize..140, spread in 1u32..400, d in 1usize..140, seed in any::<u32>(),
        ) {
            // More than a task in some cases. In others few dimensions differ, so that descriptors coincide, and many
            // bytes are 0 or 255.
            let nq = if many { nq + TASK_QUERIES } else { nq };
            let kind = DescriptorKind { bytes: Some(ByteScale { offset: 0.0, factor: 1.0 }), ..DescriptorKind::foreign(d) };
            let mut state = seed | 1;
            let mut set = |n: usize| {
                let data = (0..n * d)
                    .map(|k| {
                        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                        let value = ((state >> 16) % spread) as f32 - 0.25 * spread as f32;
                        if k % d < varied { value } else { 255.0 }
                    })
                    .collect();
                ByteDescriptors::new(&Descriptors::from_vec(kind, data).unwrap()).unwrap()
            };
            let (query, train) = (set(nq), set(nt));
            let expected = plain(query.as_slice(), train.as_slice(), d);
            let back = plain(train.as_slice(), query.as_slice(), d);
            let stage = Stage::new(&Silent, "match", 2).unwrap();
            for level in instruction_sets() {
                for both_ways in [false, true] {
                    let (forward, backward) = nearest_bytes(level, &query, &train, both_ways, &stage).unwrap();
                    let got: Vec<Two> = forward.iter().map(|f| (f.best, f.ssd, f.second_ssd)).collect();
                    prop_assert_eq!(&got, &expected, "{:?}", level);
                    let indices: Vec<u32> = back.iter().map(|b| b.0).collect();
                    prop_assert_eq!(backward, if both_ways { indices } else { vec![] }, "{:?}", level);
                }
            }
        }
    }

    #[test]
    fn the_maximum_dimension_and_values_do_not_overflow() {
        let d = MAX_DIMENSION;
        let kind = DescriptorKind { bytes: Some(ByteScale { offset: 0.0, factor: 1.0 }), ..DescriptorKind::foreign(d) };
        let set = |values: &[f32]| {
            let data = values.iter().flat_map(|&v| std::iter::repeat_n(v, d)).collect();
            ByteDescriptors::new(&Descriptors::from_vec(kind, data).unwrap()).unwrap()
        };
        let (query, train) = (set(&[255.0, 0.0]), set(&[0.0, 255.0]));
        let stage = Stage::new(&Silent, "match", 1).unwrap();
        for level in instruction_sets() {
            let (forward, backward) = nearest_bytes(level, &query, &train, true, &stage).unwrap();
            let max_distance = Some(255 * 255 * d as i32);
            let expected = [1, 0].map(|best| TwoNearestBytes { best, ssd: 0, second_ssd: max_distance });
            assert_eq!((forward.as_slice(), backward), (expected.as_slice(), vec![1, 0]), "{level:?}");
        }
    }
}
