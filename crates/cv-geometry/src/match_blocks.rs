//! Correspondences, normalized and in blocks of lanes for vector units.

use crate::ransac::RansacData;
use crate::{EstimateError, error::Degeneracy};
use cv_core::{Correspondence, Matrix3, Point2, Vector3, median};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};

/// Number of matches in a block: two AVX2 registers of f32, one AVX-512 register.
pub const LANES: usize = 16;

/// [`LANES`] correspondences, coordinate by coordinate. Lanes beyond the last match hold NaN, which fits no model.
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

/// Normalized coordinates `(p − center) · scale`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Normalizer {
    pub(crate) center: Point2<f64>,
    pub(crate) scale: f64,
}

impl Normalizer {
    pub(crate) const IDENTITY: Self = Self { center: Point2::new(0.0, 0.0), scale: 1.0 };

    /// As a 3×3 matrix.
    pub(crate) fn matrix(&self) -> Matrix3<f64> {
        let (s, c) = (self.scale, self.center);
        Matrix3::new(s, 0.0, -s * c.x, 0.0, s, -s * c.y, 0.0, 0.0, 1.0)
    }

    /// The inverse of [`Self::matrix`].
    pub(crate) fn inverse_matrix(&self) -> Matrix3<f64> {
        let (s, c) = (self.scale, self.center);
        Matrix3::new(1.0 / s, 0.0, c.x, 0.0, 1.0 / s, c.y, 0.0, 0.0, 1.0)
    }

    #[inline]
    pub(crate) fn apply(&self, p: Point2<f64>) -> Point2<f64> {
        Point2::from((p - self.center) * self.scale)
    }
}

/// Normalized correspondences, in the caller's order in f64 and shuffled into blocks in f32.
///
/// The centers are medians and the scale is a median distance, so that a wild match cannot squeeze the others together;
/// one scale for both images keeps every image distance in proportion to pixels.
#[derive(Debug, Clone)]
pub(crate) struct NormalizedMatches {
    /// Normalized, in the caller's order: x1, y1, x2, y2.
    pub(crate) pairs: Vec<[f64; 4]>,
    /// The same, in random order: the first blocks are a fair sample of all matches.
    pub(crate) blocks: Vec<MatchBlock>,
    /// The place in `pairs` of each lane of `blocks`.
    pub(crate) order: Vec<u32>,
    /// Of the first image.
    pub(crate) first: Normalizer,
    /// Of the second image; the same scale.
    pub(crate) second: Normalizer,
}

impl NormalizedMatches {
    /// Normalizes and checks `matches`.
    pub(crate) fn new(matches: &[Correspondence], needed: usize) -> Result<Self, EstimateError> {
        check(matches, needed)?;
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
        // A point is then about one unit from the origin in each coordinate.
        let scale = 4.0 / spread;
        Ok(Self::with(matches, Normalizer { center: c1, scale }, Normalizer { center: c2, scale }))
    }

    /// With given normalizations.
    pub(crate) fn with(matches: &[Correspondence], first: Normalizer, second: Normalizer) -> Self {
        let pairs: Vec<[f64; 4]> = matches
            .iter()
            .map(|m| {
                let (a, b) = (first.apply(m.a), second.apply(m.b));
                [a.x, a.y, b.x, b.y]
            })
            .collect();
        let mut order: Vec<u32> = (0..pairs.len() as u32).collect();
        // A fixed shuffle: it decides only how early a bad model is given up.
        let mut rng = ChaCha8Rng::seed_from_u64(0);
        for i in (1..order.len()).rev() {
            order.swap(i, below(&mut rng, i as u32 + 1) as usize);
        }
        let lane = |chunk: &[u32], k: usize| -> [f32; LANES] {
            std::array::from_fn(|i| chunk.get(i).map_or(f32::NAN, |&j| pairs[j as usize][k] as f32))
        };
        let blocks = order
            .chunks(LANES)
            .map(|c| MatchBlock { x1: lane(c, 0), y1: lane(c, 1), x2: lane(c, 2), y2: lane(c, 3) })
            .collect();
        Self { pairs, blocks, order, first, second }
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

    fn background(&self, most: usize) -> Vec<MatchBlock> {
        let mut pairs = different(self.order.len(), most);
        let mut blocks = Vec::with_capacity(most / LANES + 1);
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

/// Indices of two different ones of `n` data, each pair once before any comes twice: about `most`, a multiple of [`LANES`].
pub(crate) fn different(n: usize, most: usize) -> impl Iterator<Item = (usize, usize)> {
    let count = if n < 2 { 0 } else { (n * (n - 1)).min(most).next_multiple_of(LANES) };
    let apart =
        (1..n).flat_map(move |shift| (0..n).map(move |i| (i, if i + shift < n { i + shift } else { i + shift - n })));
    apart.cycle().take(count)
}

/// Whether the chosen points, in either image, are fewer than `needed` different ones, or lie on a line: their root mean
/// square distance from it is at most `width`, in normalized units.
pub(crate) fn point_degeneracy<'a>(
    pairs: impl Iterator<Item = &'a [f64; 4]> + Clone,
    needed: usize,
    width: f64,
) -> Option<Degeneracy> {
    in_either_image(pairs, needed, |points| {
        let n = points.len() as f64;
        let (mx, my) = points.iter().fold((0.0, 0.0), |(x, y), p| (x + p[0] / n, y + p[1] / n));
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for [x, y] in points {
            xx += (x - mx) * (x - mx) / n;
            xy += (x - mx) * (y - my) / n;
            yy += (y - my) * (y - my) / n;
        }
        // The smaller eigenvalue of the covariance, from the larger one so that no digits cancel.
        let half = (xx + yy) / 2.0;
        let larger = half + ((xx - yy) / 2.0).hypot(xy);
        let smaller = (xx * yy - xy * xy).max(0.0) / larger;
        // Rounding of the products above.
        (smaller <= (width * width).max(1e-14 * larger)).then_some(Degeneracy::Collinear)
    })
}

/// As [`point_degeneracy`] for normalized coordinates of calibrated cameras, in which a line is a plane of rays: their root mean square angle from the
/// plane, or from one ray, is at most `width`. Far from the middle of the image, that is not what the coordinates say.
pub(crate) fn ray_degeneracy<'a>(
    pairs: impl Iterator<Item = &'a [f64; 4]> + Clone,
    needed: usize,
    width: f64,
) -> Option<Degeneracy> {
    in_either_image(pairs, needed, |points| {
        let mut moment = Matrix3::zeros();
        for &[x, y] in points {
            let ray = Vector3::new(x, y, 1.0).normalize();
            moment += ray * ray.transpose();
        }
        let mut squares = (moment / points.len() as f64).symmetric_eigenvalues();
        squares.as_mut_slice().sort_unstable_by(f64::total_cmp);
        // Rounding of the products above.
        let limit = (width * width).max(1e-14);
        let kind = if squares[1] <= limit { Degeneracy::Coincident } else { Degeneracy::Collinear };
        (squares[0] <= limit).then_some(kind)
    })
}

/// What is wrong with the points of the first image, or else of the second: fewer than `needed` different ones, or what `judge` finds.
fn in_either_image<'a>(
    pairs: impl Iterator<Item = &'a [f64; 4]> + Clone,
    needed: usize,
    judge: impl Fn(&[[f64; 2]]) -> Option<Degeneracy>,
) -> Option<Degeneracy> {
    [0, 2].into_iter().find_map(|image| {
        let points: Vec<[f64; 2]> = pairs.clone().map(|p| [p[image], p[image + 1]]).collect();
        if fewer_than(needed, &points) { Some(Degeneracy::Coincident) } else { judge(&points) }
    })
}

/// Whether there are fewer than `needed` different points.
fn fewer_than(needed: usize, points: &[[f64; 2]]) -> bool {
    let mut different: Vec<[f64; 2]> = Vec::with_capacity(needed);
    for p in points {
        if different.len() == needed {
            break;
        }
        if !different.contains(p) {
            different.push(*p);
        }
    }
    different.len() < needed
}

/// A number in `0..n` (n > 0), by multiplication; the bias is below n/2³².
#[inline]
pub(crate) fn below(rng: &mut ChaCha8Rng, n: u32) -> u32 {
    ((u64::from(rng.next_u32()) * u64::from(n)) >> 32) as u32
}

/// Refuses too few matches and useless coordinates.
pub(crate) fn check(matches: &[Correspondence], needed: usize) -> Result<(), EstimateError> {
    if matches.len() < needed {
        return Err(EstimateError::NotEnoughMatches { got: matches.len(), needed });
    }
    // Beyond this, squares of differences of squares lose every digit or overflow.
    const LIMIT: f64 = 1e12;
    let useless = |m: &Correspondence| [m.a.x, m.a.y, m.b.x, m.b.y].iter().any(|v| v.is_nan() || v.abs() > LIMIT);
    match matches.iter().position(useless) {
        Some(index) => Err(EstimateError::NotFinite { index }),
        None => Ok(()),
    }
}

fn median_of(scratch: &mut Vec<f64>, values: impl Iterator<Item = f64>) -> f64 {
    scratch.clear();
    scratch.extend(values);
    median(scratch).unwrap_or(0.0)
}

/// Hartley's normalization: centroid at the origin, mean distance √2. `None` where all points coincide.
pub(crate) fn hartley(points: impl Iterator<Item = Point2<f64>> + Clone) -> Option<Normalizer> {
    let mut n = 0.0;
    let mut sum = cv_core::Vector2::zeros();
    for p in points.clone() {
        sum += p.coords;
        n += 1.0;
    }
    let center = Point2::from(sum / n);
    let mean = points.map(|p| (p - center).norm()).sum::<f64>() / n;
    // Below this the spread is rounding of the coordinates themselves.
    (mean > 1e-14 * (1.0 + center.coords.norm())).then(|| Normalizer { center, scale: std::f64::consts::SQRT_2 / mean })
}
