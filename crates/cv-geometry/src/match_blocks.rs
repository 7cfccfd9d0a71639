//! Normalized correspondences, also in blocks (structure of arrays) for SIMD, and degeneracy tests of point sets.

use crate::ransac::RansacData;
use crate::{EstimateError, error::Degeneracy};
use cv_core::{Correspondence, Matrix3, Point2, Vector3, median};
use fearless_simd::{f64x8, prelude::*};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Number of matches in a block: two AVX2 registers of f32, one AVX-512 register.
pub const LANES: usize = 16;

/// [`LANES`] correspondences as a structure of arrays. Padding lanes after the last match are NaN, which is an outlier
/// of every model.
#[derive(Debug, Clone, Copy)]
pub struct MatchBlock {
    /// x in the first image.
    pub x1: [f32; LANES],
    /// y in the first image.
    pub y1: [f32; LANES],
    /// x in the second image.
    pub x2: [f32; LANES],
    /// y in the second image.
    pub y2: [f32; LANES],
}

/// The normalizing transformation `(p − center) · scale`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Normalizer {
    pub(crate) center: Point2<f64>,
    pub(crate) scale: f64,
}

impl Normalizer {
    pub(crate) const IDENTITY: Self = Self { center: Point2::new(0.0, 0.0), scale: 1.0 };

    /// Returns the transformation as a 3×3 matrix.
    pub(crate) fn matrix(&self) -> Matrix3<f64> {
        let (s, c) = (self.scale, self.center);
        Matrix3::new(s, 0.0, -s * c.x, 0.0, s, -s * c.y, 0.0, 0.0, 1.0)
    }

    /// Returns the inverse of [`Self::matrix`].
    pub(crate) fn inverse_matrix(&self) -> Matrix3<f64> {
        let (s, c) = (self.scale, self.center);
        Matrix3::new(1.0 / s, 0.0, c.x, 0.0, 1.0 / s, c.y, 0.0, 0.0, 1.0)
    }

    #[inline]
    pub(crate) fn apply(&self, p: Point2<f64>) -> Point2<f64> {
        Point2::from((p - self.center) * self.scale)
    }
}

/// A block of [`LANES`] values in f64, half of them in each array: one AVX-512 register, two of AVX2.
pub(crate) type Halves = [[f64; LANES / 2]; 2];

/// Correspondences in f64 as blocks of [`LANES`] (structure of arrays): x1, y1, x2, y2; zero after the last one. Sums over
/// them in vectors.
#[derive(Debug, Clone)]
pub(crate) struct PairBlocks {
    blocks: Vec<[Halves; 4]>,
    /// Number of pairs.
    count: usize,
}

impl PairBlocks {
    pub(crate) fn new(pairs: &[[f64; 4]]) -> Self {
        let lane = |chunk: &[[f64; 4]], k: usize, i: usize| chunk.get(i).map_or(0.0, |pair| pair[k]);
        let halves = |chunk: &[[f64; 4]], k: usize| -> Halves {
            std::array::from_fn(|half| std::array::from_fn(|i| lane(chunk, k, half * LANES / 2 + i)))
        };
        let blocks = pairs.chunks(LANES).map(|chunk| std::array::from_fn(|k| halves(chunk, k))).collect();
        Self { blocks, count: pairs.len() }
    }

    /// Returns the blocks, each with the number of its lanes that hold pairs.
    #[inline(always)]
    pub(crate) fn iter(&self) -> impl Iterator<Item = (&[Halves; 4], usize)> {
        self.blocks.iter().enumerate().map(|(index, block)| (block, (self.count - index * LANES).min(LANES)))
    }

    /// Returns the sum of the losses of all pairs, given those of the lanes. Lanes after the last pair have a loss of 1.
    #[inline(always)]
    pub(crate) fn cost<S: Simd>(&self, losses: f64x8<S>) -> f64 {
        sum_lanes(losses) - (self.blocks.len() * LANES - self.count) as f64
    }
}

/// Loads a half of a block: x1, y1, x2, y2.
#[inline(always)]
pub(crate) fn load_half<S: Simd>(simd: S, [x, y, s, t]: &[Halves; 4], half: usize) -> [f64x8<S>; 4] {
    [
        f64x8::from_slice(simd, &x[half]),
        f64x8::from_slice(simd, &y[half]),
        f64x8::from_slice(simd, &s[half]),
        f64x8::from_slice(simd, &t[half]),
    ]
}

/// Sums the lanes pairwise, in a fixed order.
#[inline(always)]
pub(crate) fn sum_lanes<S: Simd>(lanes: f64x8<S>) -> f64 {
    let mut v = [0.0; LANES / 2];
    lanes.store_slice(&mut v);
    ((v[0] + v[4]) + (v[1] + v[5])) + ((v[2] + v[6]) + (v[3] + v[7]))
}

/// Normalized correspondences, in the caller's order in f64 and shuffled into blocks in f32.
///
/// Center and scale are medians, so they are robust to outliers with extreme coordinates. Both images have the same
/// scale, so distances stay proportional to pixels.
#[derive(Debug, Clone)]
pub(crate) struct NormalizedMatches {
    /// Normalized, in the caller's order: x1, y1, x2, y2.
    pub(crate) pairs: Vec<[f64; 4]>,
    /// The same in blocks.
    pub(crate) pair_blocks: PairBlocks,
    /// The same in random order: the first blocks are a random sample of all matches.
    pub(crate) blocks: Vec<MatchBlock>,
    /// The index in `pairs` of each lane of `blocks`.
    pub(crate) order: Vec<u32>,
    /// Normalization of the first image.
    pub(crate) first: Normalizer,
    /// Normalization of the second image; the same scale.
    pub(crate) second: Normalizer,
}

impl NormalizedMatches {
    /// Validates and normalizes `matches`.
    pub(crate) fn new(matches: &[Correspondence], needed: usize) -> Result<Self, EstimateError> {
        check_matches(matches, needed)?;
        let mut scratch = Vec::with_capacity(matches.len());
        let mut center = |of: fn(&Correspondence) -> Point2<f64>| {
            Point2::new(
                median_of(&mut scratch, matches.iter().map(|m| of(m).x)),
                median_of(&mut scratch, matches.iter().map(|m| of(m).y)),
            )
        };
        let (c1, c2) = (center(|m| m.a), center(|m| m.b));
        let distance = |m: &Correspondence| {
            (m.a.x - c1.x).abs() + (m.a.y - c1.y).abs() + (m.b.x - c2.x).abs() + (m.b.y - c2.y).abs()
        };
        let mut spread = median_of(&mut scratch, matches.iter().map(distance));
        if spread == 0.0 {
            // More than half of the matches coincide.
            spread = matches.iter().map(distance).sum::<f64>() / matches.len() as f64;
        }
        if spread == 0.0 {
            return Err(EstimateError::Degenerate { kind: Degeneracy::Coincident });
        }
        // The sum of four coordinate magnitudes is then about 4: about 1 for each coordinate.
        let scale = 4.0 / spread;
        Ok(Self::with(matches, Normalizer { center: c1, scale }, Normalizer { center: c2, scale }))
    }

    /// Applies given normalizations.
    pub(crate) fn with(matches: &[Correspondence], first: Normalizer, second: Normalizer) -> Self {
        let pairs: Vec<[f64; 4]> = matches
            .iter()
            .map(|m| {
                let (a, b) = (first.apply(m.a), second.apply(m.b));
                [a.x, a.y, b.x, b.y]
            })
            .collect();
        let mut order: Vec<u32> = (0..pairs.len() as u32).collect();
        // A shuffle with a fixed seed: it only affects how early the scoring of bad models stops.
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for i in (1..order.len()).rev() {
            order.swap(i, random_below(&mut rng, i as u32 + 1) as usize);
        }
        let lane = |chunk: &[u32], k: usize| -> [f32; LANES] {
            std::array::from_fn(|i| chunk.get(i).map_or(f32::NAN, |&j| pairs[j as usize][k] as f32))
        };
        let blocks = order
            .chunks(LANES)
            .map(|c| MatchBlock { x1: lane(c, 0), y1: lane(c, 1), x2: lane(c, 2), y2: lane(c, 3) })
            .collect();
        Self { pair_blocks: PairBlocks::new(&pairs), pairs, blocks, order, first, second }
    }
}

impl RansacData for NormalizedMatches {
    type Block = MatchBlock;

    fn count(&self) -> usize {
        self.pairs.len()
    }

    fn blocks(&self) -> &[MatchBlock] {
        &self.blocks
    }

    fn order(&self) -> &[u32] {
        &self.order
    }

    fn background(&self, max_count: usize) -> Vec<MatchBlock> {
        let mut pairs = distinct_pairs(self.order.len(), max_count);
        let mut blocks = Vec::with_capacity(max_count / LANES + 1);
        while let Some(first) = pairs.next() {
            let mut block = MatchBlock { x1: [0.0; LANES], y1: [0.0; LANES], x2: [0.0; LANES], y2: [0.0; LANES] };
            for (lane, (i, j)) in std::iter::once(first).chain(pairs.by_ref().take(LANES - 1)).enumerate() {
                let (a, b) = (&self.pairs[self.order[i] as usize], &self.pairs[self.order[j] as usize]);
                (block.x1[lane], block.y1[lane]) = (a[0] as f32, a[1] as f32);
                (block.x2[lane], block.y2[lane]) = (b[2] as f32, b[3] as f32);
            }
            blocks.push(block);
        }
        blocks
    }
}

/// Enumerates about `max_count` (a multiple of [`LANES`]) ordered pairs of distinct indices below `n`; no pair repeats
/// before all have occurred.
pub(crate) fn distinct_pairs(n: usize, max_count: usize) -> impl Iterator<Item = (usize, usize)> {
    let count = if n < 2 { 0 } else { (n * (n - 1)).min(max_count).next_multiple_of(LANES) };
    let shifted =
        (1..n).flat_map(move |shift| (0..n).map(move |i| (i, if i + shift < n { i + shift } else { i + shift - n })));
    shifted.cycle().take(count)
}

/// Tests whether the points of either image are degenerate: fewer than `needed` distinct ones, or collinear (an RMS
/// distance from the fitted line of at most `width`, in normalized units).
pub(crate) fn point_degeneracy<'a>(
    pairs: impl Iterator<Item = &'a [f64; 4]> + Clone,
    needed: usize,
    width: f64,
) -> Option<Degeneracy> {
    degeneracy_in_either_image(pairs, needed, |points| {
        let n = points.len() as f64;
        let (mx, my) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p[0] / n, y + p[1] / n));
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for [x, y] in points {
            xx += (x - mx) * (x - mx) / n;
            xy += (x - mx) * (y - my) / n;
            yy += (y - my) * (y - my) / n;
        }
        // The smaller eigenvalue of the covariance, computed from the larger one to avoid cancellation.
        let mean = (xx + yy) / 2.0;
        let larger = mean + ((xx - yy) / 2.0).hypot(xy);
        let smaller = (xx * yy - xy * xy).max(0.0) / larger;
        // The lower bound is the rounding error of the products above.
        (smaller <= (width * width).max(1e-14 * larger)).then_some(Degeneracy::Collinear)
    })
}

/// Tests degeneracy as [`point_degeneracy`], for the rays of calibrated cameras: collinear points correspond to
/// coplanar rays. Degenerate if the RMS angle in radians from the fitted plane, or from a single ray, is at most
/// `width`. (Far from the principal point, distances of normalized coordinates differ from angles.)
pub(crate) fn ray_degeneracy<'a>(
    pairs: impl Iterator<Item = &'a [f64; 4]> + Clone,
    needed: usize,
    width: f64,
) -> Option<Degeneracy> {
    degeneracy_in_either_image(pairs, needed, |points| {
        let mut moment = Matrix3::zeros();
        for &[x, y] in points {
            let ray = Vector3::new(x, y, 1.0).normalize();
            moment += ray * ray.transpose();
        }
        let mut eigenvalues = (moment / points.len() as f64).symmetric_eigenvalues();
        eigenvalues.as_mut_slice().sort_unstable_by(f64::total_cmp);
        // The lower bound is the rounding error of the products above.
        let limit = (width * width).max(1e-14);
        let kind = if eigenvalues[1] <= limit { Degeneracy::Coincident } else { Degeneracy::Collinear };
        (eigenvalues[0] <= limit).then_some(kind)
    })
}

/// Returns the degeneracy of the points of the first image, else of the second: fewer than `needed` distinct ones, or
/// the result of `test`.
fn degeneracy_in_either_image<'a>(
    pairs: impl Iterator<Item = &'a [f64; 4]> + Clone,
    needed: usize,
    test: impl Fn(&[[f64; 2]]) -> Option<Degeneracy>,
) -> Option<Degeneracy> {
    [0, 2].into_iter().find_map(|image| {
        let points: Vec<[f64; 2]> = pairs.clone().map(|p| [p[image], p[image + 1]]).collect();
        if has_fewer_distinct_than(needed, &points) { Some(Degeneracy::Coincident) } else { test(&points) }
    })
}

/// Returns whether there are fewer than `needed` distinct points. O(points × needed).
fn has_fewer_distinct_than(needed: usize, points: &[[f64; 2]]) -> bool {
    let mut distinct: Vec<[f64; 2]> = Vec::with_capacity(needed);
    for p in points {
        if distinct.len() == needed {
            break;
        }
        if !distinct.contains(p) {
            distinct.push(*p);
        }
    }
    distinct.len() < needed
}

/// Draws an integer in `0..n` (n > 0) by multiplication; the bias is below n/2³².
#[inline]
pub(crate) fn random_below(rng: &mut ChaCha8Rng, n: u32) -> u32 {
    ((u64::from(rng.next_u32()) * u64::from(n)) >> 32) as u32
}

/// Rejects too few matches and coordinates that are NaN, infinite or too large.
pub(crate) fn check_matches(matches: &[Correspondence], needed: usize) -> Result<(), EstimateError> {
    if matches.len() < needed {
        return Err(EstimateError::NotEnoughMatches { got: matches.len(), needed });
    }
    // Beyond this, differences of products lose all digits or overflow.
    const MAX_COORDINATE: f64 = 1e12;
    let is_invalid =
        |m: &Correspondence| [m.a.x, m.a.y, m.b.x, m.b.y].iter().any(|v| v.is_nan() || v.abs() > MAX_COORDINATE);
    match matches.iter().position(is_invalid) {
        Some(index) => Err(EstimateError::NotFinite { index }),
        None => Ok(()),
    }
}

fn median_of(scratch: &mut Vec<f64>, values: impl Iterator<Item = f64>) -> f64 {
    scratch.clear();
    scratch.extend(values);
    median(scratch).unwrap_or(0.0)
}

/// Computes Hartley's normalization: centroid at the origin, mean distance √2. `None` if all points coincide.
pub(crate) fn hartley_normalization(points: impl Iterator<Item = Point2<f64>> + Clone) -> Option<Normalizer> {
    let mut n = 0.0;
    let mut sum = cv_core::Vector2::zeros();
    for p in points.clone() {
        sum += p.coords;
        n += 1.0;
    }
    let center = Point2::from(sum / n);
    let mean = points.map(|p| (p - center).norm()).sum::<f64>() / n;
    // Below this, the differences are rounding errors of the coordinates.
    (mean > 1e-14 * (1.0 + center.coords.norm())).then(|| Normalizer { center, scale: std::f64::consts::SQRT_2 / mean })
}
