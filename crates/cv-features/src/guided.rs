//! Guided matching: matching with known two-view geometry, among candidates consistent with it.

use crate::matching::{MatchError, check_same_kind};
use crate::nearest_neighbors::ssd;
use crate::simd;
use crate::{ByteDescriptors, DescriptorKind, Descriptors, Features};
use cv_core::{Cancelled, DMatch, Keypoint, OptionError, Progress, Stage};
use cv_parallel::prelude::*;
use fearless_simd::{dispatch, prelude::*};
use nalgebra::{Matrix3, Point2, Vector3};

/// Two-view geometry in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum TwoViewModel {
    /// A homography, `b ~ H a`. The residual is the transfer error, from `H a` to `b`.
    Homography(Matrix3<f64>),
    /// A fundamental matrix, `bᵀ F a = 0`. The residual is the Sampson distance.
    Fundamental(Matrix3<f64>),
}

/// Options of [`match_guided`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct GuidedOptions {
    /// Maximum residual in pixels, above 0; default 2.
    pub threshold: f32,
    /// Maximum ratio of the SSDs of the nearest and second nearest candidate, 0 to 1. Default 0.8, larger than without
    /// geometry, since there are far fewer candidates.
    pub ratio: f32,
    /// Maximum SSD in the unit of the descriptors. Default `None`:
    /// [`DescriptorKind::max_ssd`](crate::DescriptorKind::max_ssd).
    pub max_ssd: Option<f32>,
    /// Candidates within this distance of the nearest, in pixels, count as the same point and are excluded from the
    /// ratio test. Default 2.
    #[cfg_attr(feature = "serde", serde(rename = "same"))]
    pub duplicate_radius: f32,
}

impl Default for GuidedOptions {
    fn default() -> Self {
        Self { threshold: 2.0, ratio: 0.8, max_ssd: None, duplicate_radius: 2.0 }
    }
}

/// Matches features consistent with a known geometry: mutual nearest neighbors, in the order of the first set.
///
/// `positions` are the positions of the features in the coordinates of the geometry (for example undistorted pixels);
/// `None` for those of the keypoints. Descriptors are quantized if their kind has a [`ByteScale`](crate::ByteScale).
/// Candidates are searched in a grid, so the time is proportional to their number.
///
/// # Errors
/// [`MatchError`] for different kinds, empty sets, or a number of positions other than that of the features.
pub fn match_guided(
    a: &Features,
    b: &Features,
    positions: Option<[&[Point2<f32>]; 2]>,
    model: &TwoViewModel,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    let (da, db) = (&a.descriptors, &b.descriptors);
    let keypoint_positions = [a, b].map(|d| d.keypoints.iter().map(|k: &Keypoint| k.position).collect::<Vec<_>>());
    let [pa, pb] = positions.unwrap_or([&keypoint_positions[0], &keypoint_positions[1]]);
    match (ByteDescriptors::new(da), ByteDescriptors::new(db)) {
        (Some(da), Some(db)) => match_guided_bytes((&da, pa), (&db, pb), model, options, progress),
        _ => guided((da, pa), (db, pb), model, options, progress),
    }
}

/// Matches byte descriptors as [`match_guided`], with their positions in the coordinates of the geometry.
///
/// # Errors
/// As [`match_guided`].
pub fn match_guided_bytes(
    a: (&ByteDescriptors, &[Point2<f32>]),
    b: (&ByteDescriptors, &[Point2<f32>]),
    model: &TwoViewModel,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    guided(a, b, model, options, progress)
}

/// Descriptors that can be compared.
trait Comparable: Sync {
    fn kind(&self) -> DescriptorKind;
    fn len(&self) -> usize;
    /// Computes the sum of squared differences between descriptor `i` and descriptor `j` of another set, in the unit of
    /// the kind.
    fn ssd(&self, i: usize, other: &Self, j: usize) -> f32;
}

impl Comparable for Descriptors {
    fn kind(&self) -> DescriptorKind {
        self.kind()
    }

    fn len(&self) -> usize {
        self.len()
    }

    #[inline(always)]
    fn ssd(&self, i: usize, other: &Self, j: usize) -> f32 {
        ssd(self.row(i), other.row(j))
    }
}

impl Comparable for ByteDescriptors {
    fn kind(&self) -> DescriptorKind {
        self.kind()
    }

    fn len(&self) -> usize {
        self.len()
    }

    #[inline(always)]
    fn ssd(&self, i: usize, other: &Self, j: usize) -> f32 {
        self.ssd(i, other, j)
    }
}

fn guided<R: Comparable>(
    (da, pa): (&R, &[Point2<f32>]),
    (db, pb): (&R, &[Point2<f32>]),
    model: &TwoViewModel,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    check_same_kind(da.kind(), db.kind())?;
    if da.len() == 0 || db.len() == 0 {
        return Err(MatchError::Empty { query: da.len(), train: db.len() });
    }
    OptionError::check("ratio", options.ratio.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    if pa.len() != da.len() || pb.len() != db.len() {
        return Err(MatchError::Empty { query: pa.len(), train: pb.len() });
    }
    let stage = Stage::new(progress, "guided", pa.len() + pb.len())?;
    let (forward, backward) = match model {
        TwoViewModel::Fundamental(f) => {
            // The Sampson distance is symmetric: one search is enough for both directions.
            let search = Search::new(*f, true, (da, pa), (db, pb), options);
            let nearest = search.run(&stage)?;
            stage.add(pb.len())?;
            nearest
        }
        TwoViewModel::Homography(h) => {
            let Some(inverse) = h.try_inverse() else { return Ok(Vec::new()) };
            let forward = Search::new(*h, false, (da, pa), (db, pb), options).run(&stage)?.0;
            let backward = Search::new(inverse, false, (db, pb), (da, pa), options).run(&stage)?.0;
            (forward, backward.into_iter().map(|b| b.map_or(NO_MATCH, |b| (b.ssd, b.index))).collect())
        }
    };
    let max_ssd = options.max_ssd.unwrap_or(da.kind().max_ssd);
    let mutual = |(i, best): (usize, &Option<Best>)| {
        let best = (*best)?;
        let is_distinctive = best.ssd <= options.ratio * best.second && best.ssd <= max_ssd;
        (backward[best.index as usize].1 as usize == i && is_distinctive).then(|| DMatch {
            query: i as u32,
            train: best.index,
            distance: best.ssd,
            ratio: best.ssd / best.second.max(f32::MIN_POSITIVE),
        })
    };
    Ok(forward.iter().enumerate().filter_map(mutual).collect())
}

/// The nearest candidate of a feature, and the SSD of the second nearest.
#[derive(Clone, Copy)]
struct Best {
    index: u32,
    ssd: f32,
    second: f32,
}

/// SSD and index if there is no candidate.
const NO_MATCH: (f32, u32) = (f32::INFINITY, u32::MAX);
/// Number of features of a parallel task.
const TASK_FEATURES: usize = 1024;
/// Features between checks for cancellation: some milliseconds if every feature is a candidate.
const FEATURES_PER_CHECK: usize = 64;

/// The nearest candidate of each feature of the first set, and for each feature of the second set SSD and index of the
/// nearest feature of which it is a candidate.
type SearchResult = (Vec<Option<Best>>, Vec<(f32, u32)>);

/// A search for candidates of the features of one set in another.
struct Search<'a, R> {
    model: Matrix3<f32>,
    epipolar: bool,
    a: (&'a R, &'a [Point2<f32>]),
    b: (&'a R, &'a [Point2<f32>]),
    /// The second set in vertical strips and, for steep epipolar lines, in horizontal strips.
    strips: [Strips; 2],
    threshold: f32,
    max_ssd: f32,
    duplicate_radius: f32,
}

impl<'a, R: Comparable> Search<'a, R> {
    fn new(
        model: Matrix3<f64>,
        epipolar: bool,
        a: (&'a R, &'a [Point2<f32>]),
        b: (&'a R, &'a [Point2<f32>]),
        options: &GuidedOptions,
    ) -> Self {
        let m: Matrix3<f32> = model.cast::<f32>() * (1.0 / model.norm()) as f32;
        // The part of the Sampson denominator that depends on the second point.
        let weight = |q: Point2<f32>| {
            let x = m[(0, 0)] * q.x + m[(1, 0)] * q.y + m[(2, 0)];
            let y = m[(0, 1)] * q.x + m[(1, 1)] * q.y + m[(2, 1)];
            x * x + y * y
        };
        Self {
            model: m,
            epipolar,
            a,
            b,
            strips: [Strips::new(b.1, |p| (p.x, p.y), weight), Strips::new(b.1, |p| (p.y, p.x), weight)],
            threshold: options.threshold,
            max_ssd: options.max_ssd.unwrap_or(a.0.kind().max_ssd),
            duplicate_radius: options.duplicate_radius,
        }
    }

    /// Runs the search; ties by index.
    fn run(&self, stage: &Stage<'_>) -> Result<SearchResult, Cancelled> {
        let level = simd::level();
        let tasks: Vec<_> = (0..self.a.1.len())
            .step_by(TASK_FEATURES)
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|from| {
                let to = (from + TASK_FEATURES).min(self.a.1.len());
                dispatch!(level, simd => self.task(simd, from, to, stage))
            })
            .try_collect::<_, Cancelled>()?;
        let mut forward = Vec::with_capacity(self.a.1.len());
        let mut backward = vec![NO_MATCH; self.b.1.len()];
        for (best, nearest) in tasks {
            forward.extend(best);
            for (best, candidate) in backward.iter_mut().zip(nearest) {
                if candidate.0 < best.0 {
                    *best = candidate;
                }
            }
        }
        Ok((forward, backward))
    }

    #[inline(always)]
    fn task<S: Simd>(&self, _: S, from: usize, to: usize, stage: &Stage<'_>) -> Result<SearchResult, Cancelled> {
        let (da, pa) = self.a;
        let (db, pb) = self.b;
        let mut backward = vec![NO_MATCH; pb.len()];
        let (mut indices, mut candidates) = (vec![0; self.strips[0].points.len() + 1], Vec::new());
        let mut forward = Vec::with_capacity(to - from);
        for (i, &p) in (from..to).zip(&pa[from..to]) {
            if i % FEATURES_PER_CHECK == 0 {
                stage.add(FEATURES_PER_CHECK.min(to - i))?;
            }
            let count = self.candidates(p, &mut indices);
            candidates.clear();
            candidates.extend(indices[..count].iter().map(|&j| (da.ssd(i, db, j as usize), j)));
            let mut best = NO_MATCH;
            for &(ssd, j) in &candidates {
                if ssd < best.0 || (ssd == best.0 && j < best.1) {
                    best = (ssd, j);
                }
                let nearest = &mut backward[j as usize];
                if ssd < nearest.0 {
                    *nearest = (ssd, i as u32);
                }
            }
            let (ssd, index) = best;
            forward.push((index != u32::MAX).then(|| {
                let at = pb[index as usize];
                // A single candidate is compared with the maximum SSD.
                let mut second = self.max_ssd;
                for &(ssd, j) in &candidates {
                    if ssd < second && (pb[j as usize] - at).norm() > self.duplicate_radius {
                        second = ssd;
                    }
                }
                Best { index, ssd, second }
            }));
        }
        Ok((forward, backward))
    }

    /// Writes the indices of the features of the second set that are consistent with a position in the first to the
    /// beginning of `found`; returns their number.
    #[inline(always)]
    fn candidates(&self, p: Point2<f32>, found: &mut [u32]) -> usize {
        let limit = self.threshold * self.threshold;
        let l = self.model * Vector3::new(p.x, p.y, 1.0);
        if !self.epipolar {
            let (x, y) = (l.x / l.z, l.y / l.z);
            let radius = self.threshold;
            return self.strips[0].visit(
                (x - radius, x + radius),
                |_, _| (y - radius, y + radius),
                |u, v, _| (u - x) * (u - x) + (v - y) * (v - y) < limit,
                found,
            );
        }
        let is_steep = l.x.abs() > l.y.abs();
        let strips = &self.strips[usize::from(is_steep)];
        let (along, across) = if is_steep { (l.y, l.x) } else { (l.x, l.y) };
        let first_weight = l.x * l.x + l.y * l.y;
        // With a margin for rounding.
        let radius = 1.01 * self.threshold * (first_weight + strips.max_weight).sqrt() / across.abs() + 0.05;
        let (slope, intercept) = (-along / across, -l.z / across);
        strips.visit(
            (f32::NEG_INFINITY, f32::INFINITY),
            |from, to| {
                let (a, b) = (slope * from + intercept, slope * to + intercept);
                (a.min(b) - radius, a.max(b) + radius)
            },
            |u, v, weight| {
                let c = along * u + across * v + l.z;
                c * c < limit * (first_weight + weight)
            },
            found,
        )
    }
}

/// Minimum width of a strip in pixels.
const MIN_STRIP_WIDTH: f32 = 128.0;
/// Minimum length of a cell of a strip in pixels.
const MIN_CELL_LENGTH: f32 = 8.0;
/// Maximum number of strips, and of cells per strip.
const MAX_COUNT: f32 = 512.0;

/// A spatial index: points in strips across one axis (`u`), sorted into cells along the other (`v`). The points near a
/// line are a contiguous range of each strip.
struct Strips {
    /// Origin of the first strip and cell.
    origin: (f32, f32),
    /// Width of a strip and length of a cell.
    size: (f32, f32),
    /// Number of strips, and of cells per strip.
    count: (usize, usize),
    /// Start of the points of each cell, strip by strip, and the end.
    starts: Vec<u32>,
    /// `u`, `v`, weight and index of the points.
    points: Vec<(f32, f32, f32, u32)>,
    max_weight: f32,
}

impl Strips {
    /// Builds the index; points that are not finite are ignored.
    fn new(
        points: &[Point2<f32>],
        axes: impl Fn(Point2<f32>) -> (f32, f32),
        weight: impl Fn(Point2<f32>) -> f32,
    ) -> Self {
        let mut finite: Vec<(f32, f32, f32, u32)> = Vec::with_capacity(points.len());
        for (i, &p) in points.iter().enumerate() {
            let ((u, v), weight) = (axes(p), weight(p));
            if u.is_finite() && v.is_finite() && weight.is_finite() {
                finite.push((u, v, weight, i as u32));
            }
        }
        let range = |coordinate: &dyn Fn(usize) -> f32, n: usize| {
            (0..n).map(coordinate).fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)))
        };
        let (us, vs) = (range(&|i| finite[i].0, finite.len()), range(&|i| finite[i].1, finite.len()));
        let divide = |(min, max): (f32, f32), size: f32| {
            let size = size.max((max - min) / MAX_COUNT);
            (size, if max >= min { (((max - min) / size) as usize).min(MAX_COUNT as usize) + 1 } else { 1 })
        };
        let ((width, strips), (length, cells)) = (divide(us, MIN_STRIP_WIDTH), divide(vs, MIN_CELL_LENGTH));
        let mut out = Self {
            origin: (us.0, vs.0),
            size: (width, length),
            count: (strips, cells),
            starts: vec![0; strips * cells + 1],
            points: vec![(0.0, 0.0, 0.0, 0); finite.len()],
            max_weight: finite.iter().fold(0.0, |m, p| p.2.max(m)),
        };
        // A stable counting sort.
        let cell_index = |out: &Self, p: &(f32, f32, f32, u32)| {
            let cell = |v: f32, origin: f32, size: f32, n: usize| (((v - origin) / size) as usize).min(n - 1);
            cell(p.0, out.origin.0, width, strips) * cells + cell(p.1, out.origin.1, length, cells)
        };
        for p in &finite {
            let at = cell_index(&out, p);
            out.starts[at + 1] += 1;
        }
        for i in 1..out.starts.len() {
            out.starts[i] += out.starts[i - 1];
        }
        let mut next = out.starts.clone();
        for p in &finite {
            let at = cell_index(&out, p);
            out.points[next[at] as usize] = *p;
            next[at] += 1;
        }
        out
    }

    /// Writes the indices of the points that satisfy `is_near` to the beginning of `found` and returns their number.
    /// Only the strips from `us.0` to `us.1` and, in each, the cells in the interval of `v` that `span` returns for the
    /// two sides of the strip are searched. `found` must have one more element than there are points.
    #[inline(always)]
    fn visit(
        &self,
        us: (f32, f32),
        span: impl Fn(f32, f32) -> (f32, f32),
        is_near: impl Fn(f32, f32, f32) -> bool,
        found: &mut [u32],
    ) -> usize {
        // NaN extends to the ends.
        let first = |v: f32, n: usize| if v > 0.0 { (v as usize).min(n) } else { 0 };
        let last = |v: f32, n: usize| if v < (n - 1) as f32 { if v < 0.0 { 0 } else { v as usize + 1 } } else { n };
        let ((u0, v0), (width, length), (strips, cells)) = (self.origin, self.size, self.count);
        let (per_width, per_length) = (1.0 / width, 1.0 / length);
        let mut count = 0;
        for strip in first((us.0 - u0) * per_width, strips)..last((us.1 - u0) * per_width, strips) {
            let from = u0 + strip as f32 * width;
            let (low, high) = span(from, from + width);
            let (a, b) = (first((low - v0) * per_length, cells), last((high - v0) * per_length, cells));
            if a >= b {
                continue;
            }
            let (start, end) = (self.starts[strip * cells + a], self.starts[strip * cells + b]);
            for &(u, v, weight, index) in &self.points[start as usize..end as usize] {
                // Branch-free: every point is written, and overwritten by the next if it is not near.
                found[count] = index;
                count += usize::from(is_near(u, v, weight));
            }
        }
        count
    }
}
