//! Exact nearest neighbors of descriptors in bytes, by integer products.
//!
//! |q − t|² = |q|² + |t|² − 2 q·t, all in 32-bit integers, so every instruction set finds the same. The products of six queries with a panel of candidates
//! stay in registers, four bytes to a step where the machine multiplies bytes (AVX-512 VNNI), two as 16-bit numbers elsewhere. They are compared with what a
//! query, or a candidate, has found so far; the places are looked at only where something is nearer, which soon is seldom.

use crate::ByteDescriptors;
use crate::nearest_neighbors::NONE;
use cv_core::{Cancelled, Stage};
use fearless_simd::{Level, dispatch, prelude::*};
use rayon::prelude::*;

/// The nearest and second-nearest neighbor of a descriptor; distances as sums of squared differences of bytes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct TwoNearestBytes {
    pub(crate) best: u32,
    pub(crate) ssd: i32,
    /// `None` where there is only one candidate.
    pub(crate) second_ssd: Option<i32>,
}

/// Most numbers of a descriptor: the sums then stay below 2³¹.
pub(crate) const MAX_DIMENSION: usize = 8192;
/// Queries of a register block.
const QUERIES: usize = 6;
/// Queries of a task: many, since a candidate starts anew in each, and few enough for the second-level cache.
pub(crate) const TASK: usize = 128 * QUERIES;
/// Panels that a task goes through without asking whether to go on: some milliseconds.
const PANELS_UNASKED: usize = 32;
/// |q|² of a query that is not there: no sum with it is the least, and none overflows.
const FAR: i32 = 1_500_000_000;

/// For each query its two nearest candidates and, where asked for, for each candidate its nearest query. Of equally near ones the first counts.
///
/// Both sets must hold at least one descriptor, of the same dimension of at most [`MAX_DIMENSION`], and fewer than 2³² − 1.
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

/// How bytes are multiplied: those of a 32-bit word at once.
trait Products<S: Simd>: Copy + Send + Sync {
    /// Bytes in a word.
    const BYTES: usize;
    /// What is taken from the bytes of queries to make them signed.
    const OFFSET: i32;
    fn query_word(bytes: &[u8]) -> i32;
    fn candidate_word(bytes: &[u8]) -> i32;
    /// `sums` and in each lane the sum of the products of the bytes of two words.
    fn add(self, sums: S::i32s, query: S::i32s, candidates: S::i32s) -> S::i32s;
}

/// Two bytes of a word, each in 16 bits.
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

/// Four bytes of a word: those of queries signed, those of candidates not.
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

/// |v|², and the sum of the bytes.
fn squares(row: &[u8]) -> (i32, i32) {
    row.iter().fold((0, 0), |(squares, sum), &b| (squares + i32::from(b) * i32::from(b), sum + i32::from(b)))
}

/// Candidates, some vectors of them side by side, transposed so that a step of the product reads along.
struct Panels {
    /// Panel after panel: a row of `wide` words for each word of a descriptor.
    words: Vec<i32>,
    /// What 2 × the sum of products is taken from to give |t|² − 2 q·t; the largest number beyond the last candidate.
    norms: Vec<i32>,
    wide: usize,
    /// Words of a descriptor.
    count: usize,
}

impl Panels {
    fn new<S: Simd, P: Products<S>>(set: &ByteDescriptors, wide: usize) -> Self {
        let d = set.kind().dimension;
        let count = d.div_ceil(P::BYTES);
        let panels = set.len().div_ceil(wide);
        let (mut words, mut norms) = (vec![0i32; panels * wide * count], vec![i32::MAX; panels * wide]);
        let rows =
            words.par_chunks_mut(wide * count).zip(norms.par_chunks_mut(wide)).zip(set.as_slice().par_chunks(wide * d));
        rows.for_each(|((panel, norms), rows)| {
            for (j, row) in rows.chunks_exact(d).enumerate() {
                for (k, bytes) in row.chunks(P::BYTES).enumerate() {
                    panel[k * wide + j] = P::candidate_word(bytes);
                }
                let (squares, sum) = squares(row);
                norms[j] = squares - 2 * P::OFFSET * sum;
            }
        });
        Self { words, norms, wide, count }
    }
}

/// What one task finds: the two nearest of its queries, and of each candidate the nearest of its queries.
type Task = (Vec<TwoNearestBytes>, Vec<(i32, u32)>);

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
    let tasks: Vec<Task> = query
        .as_slice()
        .par_chunks(TASK * d)
        .enumerate()
        .map(|(task, rows)| {
            let found = simd.vectorize(
                #[inline(always)]
                || block::<S, P, V>(simd, products, rows, (task * TASK) as u32, d, &panels, both_ways, stage),
            )?;
            stage.add(1)?;
            Ok(found)
        })
        .collect::<Result<_, Cancelled>>()?;
    let mut forward = Vec::with_capacity(query.len());
    let mut backward = vec![(i32::MAX, NONE); if both_ways { train.len() } else { 0 }];
    for (rows, columns) in tasks {
        forward.extend(rows);
        for (best, found) in backward.iter_mut().zip(columns) {
            // Tasks come in order of their queries: the first of equals stays.
            if found.0 < best.0 {
                *best = found;
            }
        }
    }
    Ok((forward, backward.into_iter().map(|b| b.1).collect()))
}

/// The queries of a task against all panels.
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
) -> Result<Task, Cancelled> {
    let n = S::i32s::LEN;
    let (wide, count) = (panels.wide, panels.count);
    let groups = (rows.len() / d).div_ceil(QUERIES);
    // Each group interleaved: the six words of a step side by side.
    let mut packed = vec![0i32; groups * QUERIES * count];
    let mut norms = vec![FAR; groups * QUERIES];
    for (i, row) in rows.chunks_exact(d).enumerate() {
        let group = &mut packed[i / QUERIES * QUERIES * count..];
        for (k, bytes) in row.chunks(P::BYTES).enumerate() {
            group[k * QUERIES + i % QUERIES] = P::query_word(bytes);
        }
        norms[i] = squares(row).0;
    }
    // |t|² − 2 q·t of the two nearest of a query, and where the nearest is.
    let mut nearest = vec![[i32::MAX; 2]; groups * QUERIES];
    let mut places = vec![NONE; groups * QUERIES];
    let mut column_nearest = vec![i32::MAX; if both_ways { panels.norms.len() } else { 0 }];
    let mut column_places = vec![NONE; column_nearest.len()];
    for (p, panel) in panels.words.chunks_exact(wide * count).enumerate() {
        if p.is_multiple_of(PANELS_UNASKED) {
            stage.check()?;
        }
        let candidates = &panels.norms[p * wide..(p + 1) * wide];
        for (g, group) in packed.chunks_exact(QUERIES * count).enumerate() {
            let products = product::<S, P, V>(simd, products, group, panel);
            // Into an array of their own, since one that is gone through in a loop would lie in memory during the products too.
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
                let least = row[1..].iter().fold(row[0], |a, b| a.min(*b));
                if least.simd_lt(limit).to_bitmask() == 0 {
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
                            places[query] = (p * wide + v * n + lane) as u32;
                        } else if value < two[1] {
                            two[1] = value;
                        }
                    }
                }
            }
            if both_ways {
                let norms = &norms[g * QUERIES..(g + 1) * QUERIES];
                for v in 0..V {
                    let at = p * wide + v * n;
                    let mut best = S::i32s::from_slice(simd, &column_nearest[at..at + n]);
                    let mut least = sums[0][v] + norms[0];
                    for i in 1..QUERIES {
                        least = least.min(sums[i][v] + norms[i]);
                    }
                    if least.simd_lt(best).to_bitmask() == 0 {
                        continue;
                    }
                    let mut place = S::u32s::from_slice(simd, &column_places[at..at + n]);
                    for i in 0..QUERIES {
                        let own = sums[i][v] + norms[i];
                        let better = own.simd_lt(best);
                        best = better.select(own, best);
                        place = better.select(S::u32s::splat(simd, first + (g * QUERIES + i) as u32), place);
                    }
                    best.store_slice(&mut column_nearest[at..at + n]);
                    place.store_slice(&mut column_places[at..at + n]);
                }
            }
        }
    }
    let two = (0..rows.len() / d).map(|i| TwoNearestBytes {
        best: places[i],
        ssd: nearest[i][0] + norms[i],
        second_ssd: (nearest[i][1] < i32::MAX).then(|| nearest[i][1] + norms[i]),
    });
    Ok((two.collect(), column_nearest.into_iter().zip(column_places).collect()))
}

/// Six queries times a panel of candidates.
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

    /// Nearest, its distance, the second distance of a query.
    type Two = (u32, i32, Option<i32>);

    /// The definition: every distance, the first of equals.
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
        fn equals_the_definition(
            nq in 1usize..60, nt in 1usize..260, many in any::<bool>(), varied in 1usize..140, spread in 1u32..400, d in 1usize..140, seed in any::<u32>(),
        ) {
            // Beyond a task in some cases. Few of the dimensions differ in others, so that whole descriptors coincide, and many bytes are 0 or 255.
            let nq = if many { nq + TASK } else { nq };
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
                    let places: Vec<u32> = back.iter().map(|b| b.0).collect();
                    prop_assert_eq!(backward, if both_ways { places } else { vec![] }, "{:?}", level);
                }
            }
        }
    }

    #[test]
    fn the_longest_descriptors_of_the_largest_bytes_do_not_overflow() {
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
            let apart = Some(255 * 255 * d as i32);
            let expected = [1, 0].map(|best| TwoNearestBytes { best, ssd: 0, second_ssd: apart });
            assert_eq!((forward.as_slice(), backward), (expected.as_slice(), vec![1, 0]), "{level:?}");
        }
    }
}
