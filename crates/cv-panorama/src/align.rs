//! From verified overlaps to the place of every photograph.

use crate::bundle::{Lens, Motion, Overlap, Problem, State};
use crate::focal::focals_from_homography;
use crate::graph::{self, Edge};
use crate::straighten::straighten;
use crate::verify::VerifiedPair;
use crate::view::View;
use cv_core::{Camera, Correspondence, Distortion, Point2};
use cv_numeric::RobustLoss;
use nalgebra::{Matrix3, Rotation3, Vector2};

/// What is known about a photograph before looking at its pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photo {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Focal length in pixels, from EXIF: a hint that the overlaps may correct.
    pub focal: Option<f64>,
    /// The calibrated camera, which is believed as it is. Its size must be the photograph's.
    pub camera: Option<Camera>,
}

impl Photo {
    /// A photograph of which only the size is known.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, focal: None, camera: None }
    }

    /// Photographs that are taken to share a lens: the same size (either way up) and the same hint.
    fn shares_lens(&self, other: &Self) -> bool {
        let size = |p: &Self| (p.width.min(p.height), p.width.max(p.height));
        let same_hint = match (self.focal, other.focal) {
            (Some(a), Some(b)) => (a / b).ln().abs() < 0.01,
            (None, None) => true,
            _ => false,
        };
        size(self) == size(other) && same_hint && self.camera == other.camera
    }

    fn long_side(&self) -> f64 {
        self.width.max(self.height) as f64
    }
}

/// What may have moved the camera between photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CameraMotion {
    /// [`Rotation`](Self::Rotation), unless [`Homography`](Self::Homography) explains the matches far better.
    #[default]
    Auto,
    /// The camera turned about its centre: the panorama proper.
    Rotation,
    /// The scene is flat (a wall, a page, the ground from above) and the camera moved anyhow.
    Homography,
}

/// Options of [`align`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// What moved the camera. Default [`CameraMotion::Auto`].
    pub motion: CameraMotion,
    /// Error of a match, in pixels, at which it starts to count less (the scale of a Cauchy loss), above 0. Default 2, the σ that
    /// Brown & Lowe give their robust loss.
    pub outlier_px: f64,
    /// Estimate one coefficient of radial distortion where no camera is given and the matches ask for it. Default true.
    pub refine_distortion: bool,
    /// Turn the result level. Default true; false keeps the frame of the middle photograph.
    pub straighten: bool,
}

impl Default for AlignOptions {
    fn default() -> Self {
        Self { motion: CameraMotion::Auto, outlier_px: 2.0, refine_distortion: true, straighten: true }
    }
}

/// Why photographs could not be aligned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum AlignError {
    /// A panorama needs two photographs.
    #[error("a panorama needs at least 2 photographs, got {got}")]
    TooFewPhotos {
        /// Photographs given.
        got: usize,
    },
    /// No two photographs overlap as far as the matches tell.
    #[error("no two of the {photos} photographs overlap")]
    NoOverlap {
        /// Photographs given.
        photos: usize,
    },
    /// A pair names a photograph that is not there, or itself.
    #[error("a pair names photographs {a} and {b} of {photos}")]
    BadPair {
        /// First of the pair.
        a: usize,
        /// Second of the pair.
        b: usize,
        /// Photographs given.
        photos: usize,
    },
    /// A photograph is empty, or its camera is no camera or of another size.
    #[error("photograph {index} is empty or its camera does not fit it")]
    BadPhoto {
        /// Which.
        index: usize,
    },
    /// No placement explains the matches.
    #[error("the overlaps of the {photos} photographs contradict each other")]
    Inconsistent {
        /// Photographs in the group.
        photos: usize,
    },
}

/// Why a photograph is not in the panorama.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unplaced {
    /// It overlaps no other photograph.
    Alone,
    /// It belongs to another, smaller group of photographs.
    OtherGroup {
        /// Photographs in that group.
        size: usize,
    },
    /// Its overlaps contradict those of the others.
    Contradicts,
}

/// An overlap that holds in the whole.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Matches, in pixels.
    pub matches: Vec<Correspondence>,
    /// Root mean square of their errors, in pixels.
    pub rms_px: f64,
}

/// The place of every photograph.
#[derive(Debug, Clone)]
pub struct Alignment {
    /// The view of each photograph, or why it has none; as many as photographs were given.
    pub views: Vec<Result<View, Unplaced>>,
    /// The photograph in the middle of the match graph.
    pub reference: usize,
    /// [`CameraMotion::Rotation`] or [`CameraMotion::Homography`].
    pub motion: CameraMotion,
    /// The overlaps that hold.
    pub pairs: Vec<AlignedPair>,
    /// Root mean square error of all their matches, in pixels, the mean of the two directions.
    pub rms_px: f64,
    /// Median error of all their matches, in pixels.
    pub median_px: f64,
}

impl Alignment {
    /// The same alignment of photographs of other sizes: each made `factor` times as large and then of `size`.
    ///
    /// Errors are scaled by the median factor of the photographs used.
    pub fn resized(&self, sizes: &[(f64, (usize, usize))]) -> Self {
        let mut out = self.clone();
        for (view, (factor, size)) in out.views.iter_mut().zip(sizes) {
            if let Ok(view) = view {
                view.camera = view.camera.scaled(*factor);
                (view.camera.width, view.camera.height) = *size;
            }
        }
        let factor = |i: usize| sizes.get(i).map_or(1.0, |s| s.0);
        let place = |p: Point2<f64>, f: f64| Point2::from((p.coords.add_scalar(0.5) * f).add_scalar(-0.5));
        for pair in &mut out.pairs {
            let (fa, fb) = (factor(pair.a), factor(pair.b));
            pair.rms_px *= 0.5 * (fa + fb);
            for m in &mut pair.matches {
                (m.a, m.b) = (place(m.a, fa), place(m.b, fb));
            }
        }
        let mut factors: Vec<f64> = self.used().map(|(i, _)| factor(i)).collect();
        factors.sort_by(f64::total_cmp);
        let typical = factors.get(factors.len() / 2).copied().unwrap_or(1.0);
        out.rms_px *= typical;
        out.median_px *= typical;
        out
    }

    /// The photographs in the panorama.
    pub fn used(&self) -> impl Iterator<Item = (usize, &View)> {
        self.views.iter().enumerate().filter_map(|(i, v)| v.as_ref().ok().map(|v| (i, v)))
    }
}

/// Places photographs by their verified overlaps: spanning tree from the middle of the match graph, then all cameras at once over all
/// overlaps under a robust loss, then the world turned level.
///
/// The largest group of connected photographs is placed. Focal lengths come from the cameras, the hints, or the homographies
/// themselves. Costs O(matches · iterations + photographs³).
///
/// # Errors
/// [`AlignError`].
pub fn align(photos: &[Photo], pairs: &[VerifiedPair], options: &AlignOptions) -> Result<Alignment, AlignError> {
    let n = photos.len();
    if n < 2 {
        return Err(AlignError::TooFewPhotos { got: n });
    }
    for (index, p) in photos.iter().enumerate() {
        let fits = p.camera.is_none_or(|c| c.validate().is_ok() && (c.width, c.height) == (p.width, p.height));
        if p.width == 0 || p.height == 0 || !fits {
            return Err(AlignError::BadPhoto { index });
        }
    }
    if let Some(bad) = pairs.iter().find(|p| p.a >= n || p.b >= n || p.a == p.b) {
        return Err(AlignError::BadPair { a: bad.a, b: bad.b, photos: n });
    }
    // In an order of their own, so that the order of the pairs changes nothing.
    let mut pairs: Vec<&VerifiedPair> = pairs.iter().filter(|p| !p.inliers.is_empty()).collect();
    pairs.sort_by_key(|p| (p.a.min(p.b), p.a.max(p.b)));
    let mut contradicting = vec![false; n];
    loop {
        let group = Group::largest(photos, &pairs)?;
        let (solution, motion) = group.solve(options);
        let bad = group.worst_contradiction(&solution, motion, options);
        if let Some(bad) = bad {
            // One at a time: a false overlap bends the true ones around it.
            let pair = group.pairs[bad];
            pairs.retain(|p| !std::ptr::eq(*p, pair));
            for i in [pair.a, pair.b] {
                contradicting[i] = true;
            }
            continue;
        }
        return group.finish(photos, &solution, motion, &contradicting, options);
    }
}

/// The connected photographs to be placed, under indices of their own.
struct Group<'a> {
    /// Photograph of each member.
    members: Vec<usize>,
    photos: Vec<Photo>,
    pairs: Vec<&'a VerifiedPair>,
    /// Of `pairs`, in members' indices and centred pixels.
    overlaps: Vec<Overlap>,
    edges: Vec<Edge>,
    tree: Vec<usize>,
    reference: usize,
    groups: Vec<Vec<usize>>,
}

/// Pixel centre of a photograph's middle, or its camera's principal point.
fn centre(p: &Photo) -> Vector2<f64> {
    match p.camera {
        Some(c) => Vector2::new(c.cx, c.cy),
        None => Vector2::new((p.width as f64 - 1.0) / 2.0, (p.height as f64 - 1.0) / 2.0),
    }
}

/// A pixel of the photograph as an ideal camera with square pixels of width fx would have it, from the principal point.
fn ideal(p: &Photo, pixel: Point2<f64>) -> Vector2<f64> {
    match p.camera {
        Some(c) => c.normalize(pixel).coords * c.fx,
        None => pixel.coords - centre(p),
    }
}

impl<'a> Group<'a> {
    fn largest(photos: &[Photo], pairs: &[&'a VerifiedPair]) -> Result<Self, AlignError> {
        let n = photos.len();
        let all: Vec<Edge> = pairs.iter().map(|p| Edge { a: p.a, b: p.b, weight: p.inliers.len() as f64 }).collect();
        let groups = graph::groups(n, &all);
        let members = groups.first().cloned().unwrap_or_default();
        if members.len() < 2 {
            return Err(AlignError::NoOverlap { photos: n });
        }
        let index = |photo: usize| members.binary_search(&photo).ok();
        let (mut kept, mut overlaps, mut edges) = (Vec::new(), Vec::new(), Vec::new());
        for (pair, edge) in pairs.iter().zip(&all) {
            let (Some(i), Some(j)) = (index(pair.a), index(pair.b)) else { continue };
            let points = pair
                .inliers
                .iter()
                .map(|c| (ideal(&photos[pair.a], c.a), ideal(&photos[pair.b], c.b)))
                .filter(|(a, b)| a.iter().chain(b.iter()).all(|v| v.is_finite()))
                .collect();
            kept.push(*pair);
            overlaps.push(Overlap { i, j, points });
            edges.push(Edge { a: i, b: j, weight: edge.weight });
        }
        let tree = graph::maximum_spanning_tree(members.len(), &edges);
        let own: Vec<usize> = (0..members.len()).collect();
        let reference = graph::middle(members.len(), &edges, &tree, &own).unwrap_or(0);
        let photos = members.iter().map(|&m| photos[m]).collect();
        Ok(Self { members, photos, pairs: kept, overlaps, edges, tree, reference, groups })
    }

    /// Photographs to lenses, and a representative photograph of each lens.
    fn lenses(&self) -> (Vec<usize>, Vec<usize>) {
        let mut heads: Vec<usize> = Vec::new();
        let of = (0..self.photos.len())
            .map(|i| match heads.iter().position(|&h| self.photos[h].shares_lens(&self.photos[i])) {
                Some(lens) => lens,
                None => {
                    heads.push(i);
                    heads.len() - 1
                }
            })
            .collect();
        (of, heads)
    }

    /// The homography of an edge from member `from`, in centred pixels.
    fn homography(&self, edge: usize, from: usize) -> Matrix3<f64> {
        let (pair, e) = (self.pairs[edge], self.edges[edge]);
        let shift = |v: Vector2<f64>| Matrix3::new(1.0, 0.0, v.x, 0.0, 1.0, v.y, 0.0, 0.0, 1.0);
        let h = shift(-centre(&self.photos[e.b])) * pair.homography * shift(centre(&self.photos[e.a]));
        if from == e.a { h } else { h.try_inverse().unwrap_or_else(Matrix3::identity) }
    }

    /// First guess of each lens's focal length with the standard deviation of its logarithm.
    fn focal_guesses(&self, heads: &[usize]) -> Vec<(f64, f64)> {
        // Focal lengths over long sides, so that photographs of other sizes can lend theirs.
        let mut estimates: Vec<f64> = Vec::new();
        for edge in 0..self.edges.len() {
            let (a, b) = (self.edges[edge].a, self.edges[edge].b);
            let (fa, fb) = focals_from_homography(&self.homography(edge, a));
            estimates.extend(fa.map(|f| f / self.photos[a].long_side()));
            estimates.extend(fb.map(|f| f / self.photos[b].long_side()));
        }
        // 0.25 is a lens of 127° across, 20 one of 3°.
        estimates.retain(|ratio| (0.25..20.0).contains(ratio));
        estimates.sort_by(f64::total_cmp);
        // Without any estimate: 53° across, a usual wide lens.
        let ratio = estimates.get(estimates.len() / 2).copied().unwrap_or(1.0);
        heads
            .iter()
            .map(|&h| match (self.photos[h].camera, self.photos[h].focal) {
                // Calibrated: not to be moved.
                (Some(camera), _) => (camera.fx.ln(), 1e-6),
                // EXIF is right to a few percent, unless the photograph was cropped.
                (None, Some(focal)) if focal.is_finite() && focal > 0.0 => (focal.ln(), 0.2),
                _ => ((ratio * self.photos[h].long_side()).ln(), 0.7),
            })
            .collect()
    }

    /// Motions chained along the spanning tree.
    fn chain(&self, kind: Motion, lens_of: &[usize], lenses: &[Lens]) -> Vec<Matrix3<f64>> {
        let mut motion = vec![Matrix3::identity(); self.photos.len()];
        let focal = |i: usize| lenses[lens_of[i]].log_focal.exp();
        let k = |f: f64| Matrix3::new(f, 0.0, 0.0, 0.0, f, 0.0, 0.0, 0.0, 1.0);
        for step in graph::walk(self.photos.len(), &self.edges, &self.tree, self.reference) {
            let h = self.homography(step.edge, step.parent);
            let m = k(1.0 / focal(step.node)) * h * k(focal(step.parent));
            let m = m / m.determinant().cbrt();
            let m = if m.iter().all(|v| v.is_finite()) { m } else { Matrix3::identity() };
            let relative = match kind {
                Motion::Rotation => Rotation3::from_matrix_eps(&m, 1e-10, 100, Rotation3::identity()).into_inner(),
                Motion::Homography => m,
            };
            motion[step.node] = relative * motion[step.parent];
        }
        motion
    }

    fn problem<'p>(&'p self, kind: Motion, lens_of: &'p [usize], prior: &'p [(f64, f64)], scale: f64) -> Problem<'p> {
        Problem {
            kind,
            overlaps: &self.overlaps,
            lens_of,
            fixed: self.reference,
            free_focal: kind == Motion::Rotation && self.photos.iter().any(|p| p.camera.is_none()),
            free_k1: false,
            focal_prior: prior,
            loss: RobustLoss::Cauchy { scale },
        }
    }

    fn solve(&self, options: &AlignOptions) -> (Solution, CameraMotion) {
        let rotation = (options.motion != CameraMotion::Homography).then(|| self.solve_rotation(options));
        let flat = || self.solve_homography(options);
        match (options.motion, rotation) {
            (CameraMotion::Auto, Some(rotation)) => {
                let typical = self.median_error(Motion::Rotation, &rotation);
                // Matches fit a turn to the σ of the loss: no need to look for another explanation.
                if typical <= 0.75 * options.outlier_px {
                    return (rotation, CameraMotion::Rotation);
                }
                let flat = flat();
                // Five more unknowns per photograph always fit better: only a far better fit means a flat scene.
                let better = self.median_error(Motion::Homography, &flat) < 0.4 * typical;
                if better && self.in_front(&flat) {
                    (flat, CameraMotion::Homography)
                } else {
                    (rotation, CameraMotion::Rotation)
                }
            }
            (_, Some(rotation)) => (rotation, CameraMotion::Rotation),
            (_, None) => (flat(), CameraMotion::Homography),
        }
    }

    /// Turning cameras: shared lenses first, from several focal lengths where none is known, then what the matches ask for.
    fn solve_rotation(&self, options: &AlignOptions) -> Solution {
        let (lens_of, heads) = self.lenses();
        let prior = self.focal_guesses(&heads);
        let known = heads.iter().all(|&h| self.photos[h].camera.is_some() || self.photos[h].focal.is_some());
        let factors: &[f64] = if known { &[1.0] } else { &[1.0, 0.6, 1.7, 3.0] };
        let wide = self.problem(Motion::Rotation, &lens_of, &prior, 10.0 * options.outlier_px);
        let start = |factor: &f64| {
            let lenses: Vec<Lens> = prior
                .iter()
                .zip(&heads)
                .map(|(p, &h)| {
                    let free = self.photos[h].camera.is_none() && self.photos[h].focal.is_none();
                    Lens { log_focal: p.0 + if free { factor.ln() } else { 0.0 }, k1: 0.0 }
                })
                .collect();
            let motion = self.chain(Motion::Rotation, &lens_of, &lenses);
            wide.solve(State { motion, lenses }, 30)
        };
        let Some((state, _)) = factors.iter().map(start).min_by(|x, y| x.1.total_cmp(&y.1)) else {
            return Solution { lens_of, prior, state: State { motion: Vec::new(), lenses: Vec::new() } };
        };
        let mut problem = self.problem(Motion::Rotation, &lens_of, &prior, options.outlier_px);
        let (mut state, mut cost) = problem.solve(state, 50);
        // A coefficient earns its place by a twentieth of the cost: less is what parallax gives to any new unknown.
        let earns = |new: f64, old: f64| new < 0.95 * old - 20.0 * options.outlier_px.powi(2);
        let calibrated = self.photos.iter().any(|p| p.camera.is_some());
        if options.refine_distortion && !calibrated {
            let radial = Problem { free_k1: true, ..problem.clone() };
            let (with, new) = radial.solve(state.clone(), 50);
            if earns(new, cost) {
                (state, cost) = (with, new);
                problem = radial;
            }
        }
        if !calibrated && lens_of.len() > heads.len() {
            let own: Vec<usize> = (0..lens_of.len()).collect();
            // Zoomed between photographs: each has a focal length of its own, near the common one.
            let own_prior: Vec<(f64, f64)> = lens_of.iter().map(|&l| (state.lenses[l].log_focal, prior[l].1)).collect();
            let lenses = lens_of.iter().map(|&l| state.lenses[l]).collect();
            let apart = Problem { lens_of: &own, focal_prior: &own_prior, ..problem.clone() };
            let (with, new) = apart.solve(State { motion: state.motion.clone(), lenses }, 50);
            if earns(new, cost) && new < 0.8 * cost {
                return Solution { lens_of: own, prior: own_prior, state: with };
            }
        }
        Solution { lens_of, prior, state }
    }

    fn solve_homography(&self, options: &AlignOptions) -> Solution {
        let (lens_of, heads) = self.lenses();
        let prior = self.focal_guesses(&heads);
        // Any focal length will do, as the homographies take up the difference; this one keeps the numbers near one.
        let lenses: Vec<Lens> = heads
            .iter()
            .map(|&h| Lens {
                log_focal: self.photos[h].camera.map_or(self.photos[h].long_side(), |c| c.fx).ln(),
                k1: 0.0,
            })
            .collect();
        let motion = self.chain(Motion::Homography, &lens_of, &lenses);
        let wide = self.problem(Motion::Homography, &lens_of, &prior, 10.0 * options.outlier_px);
        let (state, _) = wide.solve(State { motion, lenses }, 30);
        let problem = self.problem(Motion::Homography, &lens_of, &prior, options.outlier_px);
        let (state, _) = problem.solve(state, 50);
        Solution { lens_of, prior, state }
    }

    fn errors(&self, kind: Motion, s: &Solution) -> Vec<Vec<f64>> {
        let problem = self.problem(kind, &s.lens_of, &s.prior, 1.0);
        self.overlaps.iter().map(|o| problem.squared_errors(&s.state, o)).collect()
    }

    fn median_error(&self, kind: Motion, s: &Solution) -> f64 {
        median(self.errors(kind, s).into_iter().flatten().collect()).sqrt()
    }

    /// No photograph reaches the horizon of the common plane.
    fn in_front(&self, s: &Solution) -> bool {
        (0..self.photos.len()).all(|i| {
            let Some(inverse) = s.state.motion[i].try_inverse() else { return false };
            let view = self.view(i, s);
            view.border(1).iter().all(|&p| {
                let n = view.camera.normalize(p);
                let ray = inverse * nalgebra::Vector3::new(n.x, n.y, 1.0);
                ray.z > 0.05 * ray.norm()
            })
        })
    }

    /// The overlap that the solution contradicts most, where it contradicts one outright.
    fn worst_contradiction(&self, s: &Solution, motion: CameraMotion, options: &AlignOptions) -> Option<usize> {
        let errors = self.errors(kind_of(motion), s);
        let typical = median(errors.iter().flatten().copied().collect()).sqrt();
        // Parallax moves matches by some pixels; a false overlap of repeated structure is off by tens.
        let limit = (8.0 * options.outlier_px).max(6.0 * typical);
        errors
            .into_iter()
            .enumerate()
            .map(|(i, e)| (i, median(e).sqrt()))
            .filter(|(_, e)| *e > limit)
            .max_by(|x, y| x.1.total_cmp(&y.1))
            .map(|(i, _)| i)
    }

    fn view(&self, i: usize, s: &Solution) -> View {
        let lens = s.state.lenses[s.lens_of[i]];
        let p = &self.photos[i];
        let camera = p.camera.unwrap_or_else(|| Camera {
            distortion: if lens.k1 == 0.0 { Distortion::None } else { Distortion::Radial { k1: lens.k1, k2: 0.0 } },
            ..Camera::from_focal(p.width, p.height, lens.log_focal.exp())
        });
        View { camera, from_world: s.state.motion[i] }
    }

    fn finish(
        &self,
        photos: &[Photo],
        solution: &Solution,
        motion: CameraMotion,
        contradicting: &[bool],
        options: &AlignOptions,
    ) -> Result<Alignment, AlignError> {
        if !solution.state.motion.iter().all(|m| m.iter().all(|v| v.is_finite())) {
            return Err(AlignError::Inconsistent { photos: self.members.len() });
        }
        let mut views: Vec<Result<View, Unplaced>> = (0..photos.len())
            .map(|i| {
                let size = self.groups.iter().find(|g| g.contains(&i)).map_or(1, Vec::len);
                Err(match size {
                    _ if contradicting[i] => Unplaced::Contradicts,
                    1 => Unplaced::Alone,
                    size => Unplaced::OtherGroup { size },
                })
            })
            .collect();
        let upright = if options.straighten && motion == CameraMotion::Rotation {
            straighten(&solution.state.motion)
        } else {
            Matrix3::identity()
        };
        for (i, &member) in self.members.iter().enumerate() {
            let view = self.view(i, solution);
            views[member] = Ok(View { from_world: view.from_world * upright.transpose(), ..view });
        }
        let errors = self.errors(kind_of(motion), solution);
        let rms = |e: &[f64]| (e.iter().sum::<f64>() / e.len().max(1) as f64).sqrt();
        let pairs = self
            .pairs
            .iter()
            .zip(&errors)
            .map(|(p, e)| AlignedPair { a: p.a, b: p.b, matches: p.inliers.clone(), rms_px: rms(e) })
            .collect();
        let all: Vec<f64> = errors.concat();
        Ok(Alignment {
            views,
            reference: self.members[self.reference],
            motion,
            pairs,
            rms_px: rms(&all),
            median_px: median(all).sqrt(),
        })
    }
}

/// The unknowns, found.
struct Solution {
    lens_of: Vec<usize>,
    prior: Vec<(f64, f64)>,
    state: State,
}

fn kind_of(motion: CameraMotion) -> Motion {
    match motion {
        CameraMotion::Homography => Motion::Homography,
        CameraMotion::Auto | CameraMotion::Rotation => Motion::Rotation,
    }
}

/// The upper median; 0 of nothing.
fn median(mut values: Vec<f64>) -> f64 {
    if values.is_empty() {
        return 0.0;
    }
    let middle = values.len() / 2;
    *values.select_nth_unstable_by(middle, f64::total_cmp).1
}
