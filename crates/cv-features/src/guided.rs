//! Matching once the geometry of two views is known: only candidates near where a feature must be.

use crate::matching::{MatchError, same_kind};
use crate::nearest_neighbors::ssd;
use crate::simd;
use crate::{ByteDescriptors, DescriptorKind, Descriptors, Features};
use cv_core::{Cancelled, DMatch, Keypoint, OptionError, Progress, Stage};
use fearless_simd::{dispatch, prelude::*};
use nalgebra::{Matrix3, Point2, Vector3};
use rayon::prelude::*;

/// The geometry of two views, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum TwoViewModel {
    /// `b ~ H a`. The distance is that from `H a` to `b`.
    Homography(Matrix3<f64>),
    /// `bᵀ F a = 0`. The distance is Sampson's.
    Fundamental(Matrix3<f64>),
}

/// Settings of [`match_guided`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct GuidedOptions {
    /// Largest distance from the geometry, in pixels. Above 0; default 2.
    pub threshold: f32,
    /// Largest ratio of the SSD of the best candidate to that of the second. 0 to 1; default 0.8, looser than without a geometry: there are far fewer candidates, so far
    /// fewer chances to be wrong.
    pub ratio: f32,
    /// Largest SSD, in the descriptors' unit. Default `None`: [`DescriptorKind::max_ssd`](crate::DescriptorKind::max_ssd).
    pub max_ssd: Option<f32>,
    /// A second candidate nearer than this to the best one is the same point, in pixels. Default 2.
    pub same: f32,
}

impl Default for GuidedOptions {
    fn default() -> Self {
        Self { threshold: 2.0, ratio: 0.8, max_ssd: None, same: 2.0 }
    }
}

/// Matches between features that agree with a known geometry, each the best of both, in order of the first set.
///
/// `positions` are those of the features in the pixels of the geometry (undistorted, say); `None` takes the keypoints' own. Descriptors are compared as bytes where
/// their kind has a [`ByteScale`](crate::ByteScale). Candidates come from a grid, so the time grows with those along a line.
///
/// # Errors
/// [`MatchError`] for sets of different kinds, empty sets, or positions that are not as many as the features.
pub fn match_guided(
    a: &Features,
    b: &Features,
    positions: Option<[&[Point2<f32>]; 2]>,
    model: &TwoViewModel,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    let (da, db) = (&a.descriptors, &b.descriptors);
    let own = [a, b].map(|d| d.keypoints.iter().map(|k: &Keypoint| k.position).collect::<Vec<_>>());
    let [pa, pb] = positions.unwrap_or([&own[0], &own[1]]);
    match (ByteDescriptors::new(da), ByteDescriptors::new(db)) {
        (Some(da), Some(db)) => match_guided_bytes((&da, pa), (&db, pb), model, options, progress),
        _ => guided((da, pa), (db, pb), model, options, progress),
    }
}

/// As [`match_guided`], between descriptors that are bytes already, with their positions in the pixels of the geometry.
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

/// Rows that can be compared.
trait Rows: Sync {
    fn kind(&self) -> DescriptorKind;
    fn len(&self) -> usize;
    /// Sum of squared differences between row `i` and row `j` of another set, in the unit of the kind.
    fn ssd(&self, i: usize, other: &Self, j: usize) -> f32;
}

impl Rows for Descriptors {
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

impl Rows for ByteDescriptors {
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

fn guided<R: Rows>(
    (da, pa): (&R, &[Point2<f32>]),
    (db, pb): (&R, &[Point2<f32>]),
    model: &TwoViewModel,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    same_kind(da.kind(), db.kind())?;
    if da.len() == 0 || db.len() == 0 {
        return Err(MatchError::Empty { query: da.len(), train: db.len() });
    }
    OptionError::check("ratio", options.ratio.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    if pa.len() != da.len() || pb.len() != db.len() {
        return Err(MatchError::Empty { query: pa.len(), train: pb.len() });
    }
    let stage = Stage::new(progress, "guided", pa.len() + pb.len())?;
    let (forth, back) = match model {
        TwoViewModel::Fundamental(f) => {
            // Sampson's distance is that of a pair: it is the same from both sides.
            let search = Search::new(*f, true, (da, pa), (db, pb), options);
            let found = search.run(&stage)?;
            stage.add(pb.len())?;
            found
        }
        TwoViewModel::Homography(h) => {
            let Some(inverse) = h.try_inverse() else { return Ok(Vec::new()) };
            let forth = Search::new(*h, false, (da, pa), (db, pb), options).run(&stage)?.0;
            let back = Search::new(inverse, false, (db, pb), (da, pa), options).run(&stage)?.0;
            (forth, back.into_iter().map(|b| b.map_or(NOBODY, |b| (b.ssd, b.index))).collect())
        }
    };
    let max_ssd = options.max_ssd.unwrap_or(da.kind().max_ssd);
    let mutual = |(i, best): (usize, &Option<Best>)| {
        let best = (*best)?;
        let sure = best.ssd <= options.ratio * best.second && best.ssd <= max_ssd;
        (back[best.index as usize].1 as usize == i && sure).then(|| DMatch {
            query: i as u32,
            train: best.index,
            distance: best.ssd,
            ratio: best.ssd / best.second.max(f32::MIN_POSITIVE),
        })
    };
    Ok(forth.iter().enumerate().filter_map(mutual).collect())
}

/// Best and second-best candidate of a feature.
#[derive(Clone, Copy)]
struct Best {
    index: u32,
    ssd: f32,
    second: f32,
}

/// The distance and index of the nearest feature of the first set, where there is none.
const NOBODY: (f32, u32) = (f32::INFINITY, u32::MAX);
/// Features of a task.
const TASK: usize = 1024;
/// Features that are worked without asking whether to go on: some milliseconds where every feature is a candidate.
const UNASKED: usize = 64;

/// The best candidate of each feature of the first set, and for each of the second the nearest of those it is a candidate of.
type Found = (Vec<Option<Best>>, Vec<(f32, u32)>);

/// A search for the candidates of the features of one set in another.
struct Search<'a, R> {
    model: Matrix3<f32>,
    epipolar: bool,
    a: (&'a R, &'a [Point2<f32>]),
    b: (&'a R, &'a [Point2<f32>]),
    /// The second set in strips of columns and, for steep lines, of rows.
    strips: [Strips; 2],
    threshold: f32,
    max_ssd: f32,
    same: f32,
}

impl<'a, R: Rows> Search<'a, R> {
    fn new(
        model: Matrix3<f64>,
        epipolar: bool,
        a: (&'a R, &'a [Point2<f32>]),
        b: (&'a R, &'a [Point2<f32>]),
        options: &GuidedOptions,
    ) -> Self {
        let m: Matrix3<f32> = model.cast::<f32>() * (1.0 / model.norm()) as f32;
        // The part of Sampson's denominator that belongs to the second point.
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
            same: options.same,
        }
    }

    /// The best candidate of each feature of the first set, and for each of the second the nearest of those it is a candidate of; of equals the first.
    fn run(&self, stage: &Stage<'_>) -> Result<Found, Cancelled> {
        let level = simd::level();
        let tasks: Vec<_> = (0..self.a.1.len())
            .step_by(TASK)
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|from| {
                let to = (from + TASK).min(self.a.1.len());
                dispatch!(level, simd => self.task(simd, from, to, stage))
            })
            .collect::<Result<_, Cancelled>>()?;
        let mut forth = Vec::with_capacity(self.a.1.len());
        let mut back = vec![NOBODY; self.b.1.len()];
        for (best, nearest) in tasks {
            forth.extend(best);
            for (least, found) in back.iter_mut().zip(nearest) {
                if found.0 < least.0 {
                    *least = found;
                }
            }
        }
        Ok((forth, back))
    }

    #[inline(always)]
    fn task<S: Simd>(&self, _: S, from: usize, to: usize, stage: &Stage<'_>) -> Result<Found, Cancelled> {
        let (da, pa) = self.a;
        let (db, pb) = self.b;
        let mut back = vec![NOBODY; pb.len()];
        let (mut places, mut near) = (vec![0; self.strips[0].points.len() + 1], Vec::new());
        let mut forth = Vec::with_capacity(to - from);
        for (i, &p) in (from..to).zip(&pa[from..to]) {
            if i % UNASKED == 0 {
                stage.add(UNASKED.min(to - i))?;
            }
            let count = self.candidates(p, &mut places);
            near.clear();
            near.extend(places[..count].iter().map(|&j| (da.ssd(i, db, j as usize), j)));
            let mut best = NOBODY;
            for &(ssd, j) in &near {
                if ssd < best.0 || (ssd == best.0 && j < best.1) {
                    best = (ssd, j);
                }
                let least = &mut back[j as usize];
                if ssd < least.0 {
                    *least = (ssd, i as u32);
                }
            }
            let (ssd, index) = best;
            forth.push((index != u32::MAX).then(|| {
                let at = pb[index as usize];
                // A lone candidate has to be good by itself.
                let mut second = self.max_ssd;
                for &(ssd, j) in &near {
                    if ssd < second && (pb[j as usize] - at).norm() > self.same {
                        second = ssd;
                    }
                }
                Best { index, ssd, second }
            }));
        }
        Ok((forth, back))
    }

    /// Puts the features of the second set that agree with the geometry of a place in the first at the beginning of `found`; gives back how many they are.
    #[inline(always)]
    fn candidates(&self, p: Point2<f32>, found: &mut [u32]) -> usize {
        let limit = self.threshold * self.threshold;
        let l = self.model * Vector3::new(p.x, p.y, 1.0);
        if !self.epipolar {
            let (x, y) = (l.x / l.z, l.y / l.z);
            let reach = self.threshold;
            return self.strips[0].visit(
                (x - reach, x + reach),
                |_, _| (y - reach, y + reach),
                |u, v, _| (u - x) * (u - x) + (v - y) * (v - y) < limit,
                found,
            );
        }
        let steep = l.x.abs() > l.y.abs();
        let strips = &self.strips[usize::from(steep)];
        let (along, across) = if steep { (l.y, l.x) } else { (l.x, l.y) };
        let own = l.x * l.x + l.y * l.y;
        // A little more than the distance allows, for the rounding.
        let reach = 1.01 * self.threshold * (own + strips.largest_weight).sqrt() / across.abs() + 0.05;
        let (slope, start) = (-along / across, -l.z / across);
        strips.visit(
            (f32::NEG_INFINITY, f32::INFINITY),
            |from, to| {
                let (a, b) = (slope * from + start, slope * to + start);
                (a.min(b) - reach, a.max(b) + reach)
            },
            |u, v, weight| {
                let c = along * u + across * v + l.z;
                c * c < limit * (own + weight)
            },
            found,
        )
    }
}

/// Width of a strip, at least, in pixels.
const WIDTH: f32 = 128.0;
/// Length of a cell of a strip, at least.
const LENGTH: f32 = 8.0;
/// No more strips, and no more cells in one.
const MOST: f32 = 512.0;

/// Points in strips across one axis (`u`), those of a strip sorted into cells along the other (`v`): what lies near a line is one run of each strip.
struct Strips {
    /// Where the first strip and the first cell begin, and how large they are.
    origin: (f32, f32),
    size: (f32, f32),
    /// Strips, and cells of each.
    count: (usize, usize),
    /// Where the points of a cell begin, strip after strip; one more at the end.
    starts: Vec<u32>,
    /// `u`, `v` and weight of the points, and which they are.
    points: Vec<(f32, f32, f32, u32)>,
    largest_weight: f32,
}

impl Strips {
    /// Points that are not finite are left out: they are near nothing.
    fn new(
        points: &[Point2<f32>],
        axes: impl Fn(Point2<f32>) -> (f32, f32),
        weight: impl Fn(Point2<f32>) -> f32,
    ) -> Self {
        let mut of: Vec<(f32, f32, f32, u32)> = Vec::with_capacity(points.len());
        for (i, &p) in points.iter().enumerate() {
            let ((u, v), weight) = (axes(p), weight(p));
            if u.is_finite() && v.is_finite() && weight.is_finite() {
                of.push((u, v, weight, i as u32));
            }
        }
        let range = |of: &dyn Fn(usize) -> f32, n: usize| {
            (0..n).map(of).fold((f32::INFINITY, f32::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)))
        };
        let (us, vs) = (range(&|i| of[i].0, of.len()), range(&|i| of[i].1, of.len()));
        let cut = |(least, most): (f32, f32), size: f32| {
            let size = size.max((most - least) / MOST);
            (size, if most >= least { (((most - least) / size) as usize).min(MOST as usize) + 1 } else { 1 })
        };
        let ((width, strips), (length, cells)) = (cut(us, WIDTH), cut(vs, LENGTH));
        let mut out = Self {
            origin: (us.0, vs.0),
            size: (width, length),
            count: (strips, cells),
            starts: vec![0; strips * cells + 1],
            points: vec![(0.0, 0.0, 0.0, 0); of.len()],
            largest_weight: of.iter().fold(0.0, |m, p| p.2.max(m)),
        };
        // Counting sort, which keeps the order of equals.
        let place = |out: &Self, p: &(f32, f32, f32, u32)| {
            let cell = |v: f32, origin: f32, size: f32, n: usize| (((v - origin) / size) as usize).min(n - 1);
            cell(p.0, out.origin.0, width, strips) * cells + cell(p.1, out.origin.1, length, cells)
        };
        for p in &of {
            let at = place(&out, p);
            out.starts[at + 1] += 1;
        }
        for i in 1..out.starts.len() {
            out.starts[i] += out.starts[i - 1];
        }
        let mut next = out.starts.clone();
        for p in &of {
            let at = place(&out, p);
            out.points[next[at] as usize] = *p;
            next[at] += 1;
        }
        out
    }

    /// Puts the points of the strips from `us.0` to `us.1` that `is_near`, which lie between the two `v` that `span` gives for the `u` of the two sides of a strip,
    /// at the beginning of `found`, which has room for one more than all; gives back how many they are.
    #[inline(always)]
    fn visit(
        &self,
        us: (f32, f32),
        span: impl Fn(f32, f32) -> (f32, f32),
        is_near: impl Fn(f32, f32, f32) -> bool,
        found: &mut [u32],
    ) -> usize {
        // What is not a number reaches from end to end.
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
                // Every point is written, and the next one over it where it was not near: no branch to guess.
                found[count] = index;
                count += usize::from(is_near(u, v, weight));
            }
        }
        count
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    fn described(points: &[(f32, f32)], values: &[f32]) -> Features {
        let data = values.iter().flat_map(|&v| std::iter::once(v).chain(std::iter::repeat_n(0.0, 63))).collect();
        Features {
            keypoints: points.iter().map(|&(x, y)| Keypoint::new(x, y, 1.0)).collect(),
            descriptors: Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap(),
            ..Features::new(DescriptorKind::PATCH)
        }
    }

    #[test]
    fn only_candidates_on_the_line_or_at_the_place_count() {
        // Pure sideways motion: epipolar lines are rows.
        let f = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        let a = described(&[(10.0, 20.0), (50.0, 40.0)], &[0.5, 0.1]);
        // The best descriptor for the first is on another row; on its own row are two.
        let b = described(&[(90.0, 60.0), (15.0, 20.5), (70.0, 21.0), (5.0, 40.0)], &[0.5, 0.45, 0.0, 0.12]);
        let options = GuidedOptions::default();
        let found = match_guided(&a, &b, None, &TwoViewModel::Fundamental(f), &options, &Silent).unwrap();
        assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 1), (1, 3)]);
        // The same through a shift of 5 px: the second goes elsewhere.
        let h = Matrix3::new(1.0, 0.0, 5.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
        let found = match_guided(&a, &b, None, &TwoViewModel::Homography(h), &options, &Silent).unwrap();
        assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 1)]);
        let strange = Features { descriptors: Descriptors::new(DescriptorKind::MOPS), ..a.clone() };
        let error = match_guided(&strange, &b, None, &TwoViewModel::Homography(h), &options, &Silent);
        assert!(matches!(error, Err(MatchError::KindsDiffer { .. })));
        let nothing = match_guided(&a, &b, None, &TwoViewModel::Homography(Matrix3::zeros()), &options, &Silent);
        assert_eq!(nothing, Ok(vec![]));
    }

    /// Numbers from 0 to 1, always the same.
    fn random(state: &mut u32) -> f32 {
        *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (*state >> 8) as f32 / (1 << 24) as f32
    }

    /// The definition: every pair is asked.
    fn plain(a: &Features, b: &Features, model: &TwoViewModel, options: &GuidedOptions) -> Vec<(u32, u32)> {
        let at = |f: &Features, i: usize| f.keypoints[i].position.cast::<f64>();
        let near = |i: usize, j: usize, model: &TwoViewModel, (a, b): (&Features, &Features)| {
            let (p, q) = (at(a, i), at(b, j));
            let (p, q) = (Vector3::new(p.x, p.y, 1.0), Vector3::new(q.x, q.y, 1.0));
            let limit = f64::from(options.threshold).powi(2);
            match model {
                TwoViewModel::Homography(h) => ((h * p) / (h * p).z - q).norm_squared() < limit,
                TwoViewModel::Fundamental(f) => {
                    let (l, m) = (f * p, f.transpose() * q);
                    q.dot(&l).powi(2) < limit * (l.xy().norm_squared() + m.xy().norm_squared())
                }
            }
        };
        let best = |i: usize, model: &TwoViewModel, (a, b): (&Features, &Features)| {
            let bytes = |f: &Features| ByteDescriptors::new(&f.descriptors).unwrap();
            let (da, db) = (bytes(a), bytes(b));
            let mut all: Vec<(f32, usize)> =
                (0..b.keypoints.len()).filter(|&j| near(i, j, model, (a, b))).map(|j| (da.ssd(i, &db, j), j)).collect();
            all.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
            let &(ssd, j) = all.first()?;
            let apart = |k: usize| (at(b, k) - at(b, j)).norm() > f64::from(options.same);
            let second = all.iter().find(|s| apart(s.1)).map_or(f32::INFINITY, |s| s.0);
            Some((j, ssd, second.min(a.descriptors.kind().max_ssd)))
        };
        let turned = match model {
            TwoViewModel::Homography(h) => TwoViewModel::Homography(h.try_inverse().unwrap()),
            TwoViewModel::Fundamental(f) => TwoViewModel::Fundamental(f.transpose()),
        };
        let one = |i: usize| {
            let (j, ssd, second) = best(i, model, (a, b))?;
            let back = best(j, &turned, (b, a))?.0;
            let sure = ssd <= options.ratio * second && ssd <= a.descriptors.kind().max_ssd;
            (back == i && sure).then_some((i as u32, j as u32))
        };
        (0..a.keypoints.len()).filter_map(one).collect()
    }

    #[test]
    fn the_grid_finds_what_asking_every_pair_finds() {
        let mut state = 7u32;
        // Epipolar lines along rows, along columns, through a point in the picture, and through one far away; a map that turns and shrinks.
        let cross = |x: f64, y: f64, z: f64| Matrix3::new(0.0, -z, y, z, 0.0, -x, -y, x, 0.0);
        let turn = Matrix3::new(0.9, -0.3, 120.0, 0.3, 0.9, -60.0, 1e-5, -2e-5, 1.0);
        let models = [
            TwoViewModel::Fundamental(cross(1.0, 0.0, 0.0)),
            TwoViewModel::Fundamental(cross(0.0, 1.0, 0.0)),
            TwoViewModel::Fundamental(cross(400.0, 300.0, 1.0)),
            TwoViewModel::Fundamental(cross(5000.0, -900.0, 1.0) * turn),
            TwoViewModel::Homography(turn),
        ];
        for model in models {
            let mut set = |n: usize| {
                let points: Vec<(f32, f32)> =
                    (0..n).map(|_| (800.0 * random(&mut state), 600.0 * random(&mut state))).collect();
                let values: Vec<f32> = (0..n).map(|_| 2.0 * random(&mut state)).collect();
                described(&points, &values)
            };
            let (a, mut b) = (set(600), set(700));
            // A third of the first set is seen again, where the geometry allows it.
            for i in 0..200 {
                let p = a.keypoints[i].position.cast::<f64>();
                let q = match model {
                    TwoViewModel::Homography(h) => {
                        (h * Vector3::new(p.x, p.y, 1.0)).xy() / (h * Vector3::new(p.x, p.y, 1.0)).z
                    }
                    TwoViewModel::Fundamental(f) => {
                        let l = f * Vector3::new(p.x, p.y, 1.0);
                        let q = b.keypoints[i].position.cast::<f64>().coords;
                        q - l.xy() * ((l.x * q.x + l.y * q.y + l.z) / l.xy().norm_squared())
                    }
                };
                b.keypoints[i].position = Point2::from(q).cast::<f32>();
                let row = a.descriptors.row(i).to_vec();
                let mut data = b.descriptors.as_slice().to_vec();
                data[i * 64..(i + 1) * 64].copy_from_slice(&row);
                b.descriptors = Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap();
            }
            // Of no finite place: near nothing.
            b.keypoints[699].position.x = f32::NAN;
            let options = GuidedOptions { max_ssd: None, ..GuidedOptions::default() };
            let found = match_guided(&a, &b, None, &model, &options, &Silent).unwrap();
            let got: Vec<(u32, u32)> = found.iter().map(|m| (m.query, m.train)).collect();
            assert!(got.len() > 20, "{model:?}: {}", got.len());
            assert_eq!(got, plain(&a, &b, &model, &options), "{model:?}");
        }
    }
}
