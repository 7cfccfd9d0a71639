//! Alignment of one connected component of the match graph: initialization along a spanning tree, then bundle adjustment over all overlaps.

use crate::align::bundle::{Lens, Limits, Motion, Overlap, Problem, State};
use crate::align::focal::focals_from_homography;
use crate::align::metric::{in_front, metric_frame};
use crate::align::straighten::straighten;
use crate::align::{AlignError, AlignOptions, AlignedPair, Alignment, CameraMotion, GOOD_FIT, Photo, Unplaced, View};
use cv_core::{Camera, Cancelled, Distortion, Point2, Stage};
use cv_geometry::{PairEdge, PairGraph, VerifiedPair};
use cv_numeric::{RobustLoss, svd3};
use nalgebra::{Matrix3, Vector2};

/// A connected component of the match graph; its photographs are indexed from 0.
pub(crate) struct Group<'a> {
    /// Photograph of each member.
    members: Vec<usize>,
    photos: Vec<Photo>,
    pub(crate) pairs: Vec<&'a VerifiedPair>,
    /// Of `pairs`, in members' indices and centered pixels.
    overlaps: Vec<Overlap>,
    graph: PairGraph,
    tree: Vec<usize>,
    reference: usize,
    components: Vec<Vec<usize>>,
}

/// Maximum number of matches per overlap in the initial adjustment: thirty times the three unknowns of a rotation.
const MAX_INITIAL_MATCHES: usize = 100;

/// Maximum number of matches per overlap in model selection.
const MAX_SELECTION_MATCHES: usize = 300;

/// Minimum spread of log focal lengths at which photographs get separate focal lengths (zoom); refocusing changes them by less.
const MIN_ZOOM_LOG_SPREAD: f64 = 0.03;

/// Returns the nearest rotation (Frobenius norm); the identity where it is undefined. (nalgebra's iteration does not terminate for matrices of rank one,
/// which focal lengths far from the truth produce.)
fn nearest_rotation(m: &Matrix3<f64>) -> Matrix3<f64> {
    let nearest = svd3(m).map(|svd| svd.nearest_rotation().into_inner());
    nearest.ok().filter(|r| r.iter().all(|v| v.is_finite())).unwrap_or_else(Matrix3::identity)
}

/// Returns the principal point: that of the camera, or the image center.
fn center(p: &Photo) -> Vector2<f64> {
    match p.camera {
        Some(c) => Vector2::new(c.cx, c.cy),
        None => Vector2::new((p.width as f64 - 1.0) / 2.0, (p.height as f64 - 1.0) / 2.0),
    }
}

/// Returns a pixel relative to the principal point, undistorted and with square pixels of focal length fx where the camera is calibrated.
fn undistorted(p: &Photo, pixel: Point2<f64>) -> Vector2<f64> {
    match p.camera {
        Some(c) => c.normalize(pixel).coords * c.fx,
        None => pixel.coords - center(p),
    }
}

impl<'a> Group<'a> {
    pub(crate) fn largest(photos: &[Photo], pairs: &[&'a VerifiedPair]) -> Result<Self, AlignError> {
        let n = photos.len();
        let edge = |p: &&VerifiedPair| PairEdge { a: p.a, b: p.b, weight: p.matches.len() as f64 };
        let graph = |nodes: usize, edges: Vec<PairEdge>| {
            PairGraph::new(nodes, edges).map_err(|e| AlignError::BadPair { a: e.a, b: e.b, photos: n })
        };
        let components = graph(n, pairs.iter().map(edge).collect())?.connected_components();
        let members = components.first().cloned().unwrap_or_default();
        if members.len() < 2 {
            return Err(AlignError::NoOverlap { photos: n });
        }
        let index = |photo: usize| members.binary_search(&photo).ok();
        let (mut kept, mut overlaps, mut edges) = (Vec::new(), Vec::new(), Vec::new());
        for pair in pairs {
            let (Some(i), Some(j)) = (index(pair.a), index(pair.b)) else { continue };
            let points = pair
                .matches
                .iter()
                .map(|c| (undistorted(&photos[pair.a], c.a), undistorted(&photos[pair.b], c.b)))
                .filter(|(a, b)| a.iter().chain(b.iter()).all(|v| v.is_finite()))
                .collect();
            kept.push(*pair);
            overlaps.push(Overlap { i, j, points });
            edges.push(PairEdge { a: i, b: j, ..edge(pair) });
        }
        let graph = graph(members.len(), edges)?;
        let tree = graph.maximum_spanning_forest();
        let reference = graph.center(&tree).unwrap_or(0);
        let photos = members.iter().map(|&m| photos[m]).collect();
        Ok(Self { members, photos, pairs: kept, overlaps, graph, tree, reference, components })
    }

    /// Groups photographs by shared intrinsics: the group of each photograph, and a representative photograph of each group.
    fn lenses(&self) -> (Vec<usize>, Vec<usize>) {
        let mut representatives: Vec<usize> = Vec::new();
        let of = (0..self.photos.len())
            .map(|i| match representatives.iter().position(|&h| self.photos[h].shares_lens(&self.photos[i])) {
                Some(lens) => lens,
                None => {
                    representatives.push(i);
                    representatives.len() - 1
                }
            })
            .collect();
        (of, representatives)
    }

    /// Returns the homography of an edge from member `from`, in (undistorted) pixels relative to the principal points.
    fn homography(&self, edge: usize, from: usize) -> Matrix3<f64> {
        let (pair, e) = (self.pairs[edge], self.graph.edges()[edge]);
        let shift = |v: Vector2<f64>| Matrix3::new(1.0, 0.0, v.x, 0.0, 1.0, v.y, 0.0, 0.0, 1.0);
        let h = shift(-center(&self.photos[e.b])) * pair.homography * shift(center(&self.photos[e.a]));
        if from == e.a { h } else { h.try_inverse().unwrap_or_else(Matrix3::identity) }
    }

    /// Returns the prior of each group's log focal length: mean and standard deviation.
    fn focal_guesses(&self, representatives: &[usize]) -> Vec<(f64, f64)> {
        // Focal lengths relative to the longer side, comparable between image sizes.
        let mut estimates: Vec<f64> = Vec::new();
        for (edge, &PairEdge { a, b, .. }) in self.graph.edges().iter().enumerate() {
            let (fa, fb) = focals_from_homography(&self.homography(edge, a));
            estimates.extend(fa.map(|f| f / self.photos[a].long_side()));
            estimates.extend(fb.map(|f| f / self.photos[b].long_side()));
        }
        // 0.25 is a lens of 127° across, 20 one of 3°.
        estimates.retain(|ratio| (0.25..20.0).contains(ratio));
        estimates.sort_by(f64::total_cmp);
        // Without an estimate: a field of view of 53°, a common wide-angle lens.
        let ratio = estimates.get(estimates.len() / 2).copied().unwrap_or(1.0);
        representatives
            .iter()
            .map(|&h| match (self.photos[h].camera, self.photos[h].focal) {
                // Calibrated: fixed.
                (Some(camera), _) => (camera.fx.ln(), 1e-6),
                // EXIF is accurate to a few percent unless the photograph was cropped.
                (None, Some(focal)) if focal.is_finite() && focal > 0.0 => (focal.ln(), 0.2),
                _ => ((ratio * self.photos[h].long_side()).ln(), 0.7),
            })
            .collect()
    }

    /// Chains relative motions along the spanning tree.
    fn compose(&self, kind: Motion, lens_of: &[usize], lenses: &[Lens]) -> Vec<Matrix3<f64>> {
        let mut motion = vec![Matrix3::identity(); self.photos.len()];
        let focal = |i: usize| lenses[lens_of[i]].log_focal.exp();
        let k = |f: f64| Matrix3::new(f, 0.0, 0.0, 0.0, f, 0.0, 0.0, 0.0, 1.0);
        for step in self.graph.breadth_first(&self.tree, self.reference) {
            let h = self.homography(step.edge, step.parent);
            let m = k(1.0 / focal(step.node)) * h * k(focal(step.parent));
            let m = m / m.determinant().cbrt();
            let m = if m.iter().all(|v| v.is_finite()) { m } else { Matrix3::identity() };
            let relative = match kind {
                Motion::Rotation => nearest_rotation(&m),
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

    /// Subsamples the matches of each overlap uniformly, to at most `most`.
    fn subsampled_overlaps(&self, most: usize) -> Vec<Overlap> {
        let subsample = |o: &Overlap| {
            let step = o.points.len().div_ceil(most).max(1);
            Overlap { points: o.points.iter().copied().step_by(step).collect(), ..*o }
        };
        self.overlaps.iter().map(subsample).collect()
    }

    pub(crate) fn solve(
        &self,
        options: &AlignOptions,
        stage: &Stage<'_>,
    ) -> Result<(Solution, CameraMotion), Cancelled> {
        let rotation = (options.motion != CameraMotion::Homography).then(|| self.solve_rotation(options, stage));
        Ok(match (options.motion, rotation.transpose()?) {
            (CameraMotion::Auto, Some(rotation)) => {
                let typical = self.median_error(CameraMotion::Rotation, &rotation);
                // The rotation model fits to within the σ of the loss: the homography model is not tried.
                if typical <= GOOD_FIT * options.outlier_px {
                    return Ok((rotation, CameraMotion::Rotation));
                }
                // Model selection: the homography model has five more unknowns per photograph and must fit far better.
                let flat = self.solve_homography(options, Limits::SELECTION, stage)?;
                if self.median_error(CameraMotion::Homography, &flat) < 0.4 * typical {
                    let flat = self.solve_homography(options, Limits::RESULT, stage)?;
                    if self.in_front(&flat) {
                        return Ok((flat, CameraMotion::Homography));
                    }
                }
                (rotation, CameraMotion::Rotation)
            }
            (_, Some(rotation)) => (rotation, CameraMotion::Rotation),
            (_, None) => (self.solve_homography(options, Limits::RESULT, stage)?, CameraMotion::Homography),
        })
    }

    /// Solves the rotation model: shared intrinsics first, from several initial focal lengths where none is known; then distortion and separate focal
    /// lengths where they reduce the cost significantly.
    fn solve_rotation(&self, options: &AlignOptions, stage: &Stage<'_>) -> Result<Solution, Cancelled> {
        let (lens_of, representatives) = self.lenses();
        let prior = self.focal_guesses(&representatives);
        let known = representatives.iter().all(|&h| self.photos[h].camera.is_some() || self.photos[h].focal.is_some());
        let factors: &[f64] = if known { &[1.0] } else { &[1.0, 0.6, 1.7, 3.0] };
        let few = self.subsampled_overlaps(MAX_INITIAL_MATCHES);
        let wide =
            Problem { overlaps: &few, ..self.problem(Motion::Rotation, &lens_of, &prior, 10.0 * options.outlier_px) };
        let start = |factor: &f64| {
            let lenses: Vec<Lens> = prior
                .iter()
                .zip(&representatives)
                .map(|(p, &h)| {
                    let free = self.photos[h].camera.is_none() && self.photos[h].focal.is_none();
                    Lens { log_focal: p.0 + if free { factor.ln() } else { 0.0 }, k1: 0.0 }
                })
                .collect();
            let motion = self.compose(Motion::Rotation, &lens_of, &lenses);
            stage.check()?;
            Ok(wide.solve(State { motion, lenses }, Limits::START))
        };
        let starts: Vec<(State, f64)> = factors.iter().map(start).collect::<Result<_, Cancelled>>()?;
        let Some((state, _)) = starts.into_iter().min_by(|x, y| x.1.total_cmp(&y.1)) else {
            return Ok(Solution { lens_of, prior, state: State { motion: Vec::new(), lenses: Vec::new() } });
        };
        stage.check()?;
        let some = self.subsampled_overlaps(MAX_SELECTION_MATCHES);
        let mut problem =
            Problem { overlaps: &some, ..self.problem(Motion::Rotation, &lens_of, &prior, options.outlier_px) };
        let (mut state, mut cost) = problem.solve(state, Limits::SELECTION);
        // Model selection: an unknown must reduce the cost by 5 %; parallax alone gives less.
        let is_significant = |new: f64, old: f64| new < 0.95 * old - 20.0 * options.outlier_px.powi(2);
        let calibrated = self.photos.iter().any(|p| p.camera.is_some());
        if options.refine_distortion && !calibrated {
            stage.check()?;
            let radial = Problem { free_k1: true, ..problem.clone() };
            let (with, new) = radial.solve(state.clone(), Limits::SELECTION);
            if is_significant(new, cost) {
                (state, cost) = (with, new);
                problem = radial;
            }
        }
        if !calibrated && lens_of.len() > representatives.len() {
            stage.check()?;
            let own: Vec<usize> = (0..lens_of.len()).collect();
            // Zoom between photographs: separate focal lengths with the common one as prior mean.
            let own_prior: Vec<(f64, f64)> = lens_of.iter().map(|&l| (state.lenses[l].log_focal, prior[l].1)).collect();
            let lenses = lens_of.iter().map(|&l| state.lenses[l]).collect();
            let apart = Problem { lens_of: &own, focal_prior: &own_prior, ..problem.clone() };
            let (with, new) = apart.solve(State { motion: state.motion.clone(), lenses }, Limits::SELECTION);
            // Without a significant spread the reduction is due to parallax.
            let focals = with.lenses.iter().map(|l| l.log_focal);
            let spread = focals.clone().fold(f64::MIN, f64::max) - focals.fold(f64::MAX, f64::min);
            if is_significant(new, cost) && new < 0.8 * cost && spread > MIN_ZOOM_LOG_SPREAD {
                let (state, _) = Problem { overlaps: &self.overlaps, ..apart }.solve(with, Limits::RESULT);
                return Ok(Solution { lens_of: own, prior: own_prior, state });
            }
        }
        let (state, _) = Problem { overlaps: &self.overlaps, ..problem }.solve(state, Limits::RESULT);
        Ok(Solution { lens_of, prior, state })
    }

    fn solve_homography(
        &self,
        options: &AlignOptions,
        limits: Limits,
        stage: &Stage<'_>,
    ) -> Result<Solution, Cancelled> {
        let (lens_of, representatives) = self.lenses();
        let prior = self.focal_guesses(&representatives);
        // The homographies absorb the focal length; only the metric frame depends on it.
        let lenses: Vec<Lens> = representatives
            .iter()
            .map(|&h| Lens { log_focal: self.photos[h].expected_focal().ln(), k1: 0.0 })
            .collect();
        let motion = self.compose(Motion::Homography, &lens_of, &lenses);
        let few = self.subsampled_overlaps(MAX_INITIAL_MATCHES);
        let wide =
            Problem { overlaps: &few, ..self.problem(Motion::Homography, &lens_of, &prior, 10.0 * options.outlier_px) };
        let (state, _) = wide.solve(State { motion, lenses }, Limits::START);
        stage.check()?;
        let problem = self.problem(Motion::Homography, &lens_of, &prior, options.outlier_px);
        let (state, _) = problem.solve(state, limits);
        Ok(Solution { lens_of, prior, state })
    }

    fn errors(&self, kind: Motion, s: &Solution) -> Vec<Vec<f64>> {
        let problem = self.problem(kind, &s.lens_of, &s.prior, 1.0);
        self.overlaps.iter().map(|o| problem.squared_errors(&s.state, o)).collect()
    }

    pub(crate) fn median_error(&self, motion: CameraMotion, s: &Solution) -> f64 {
        median(self.errors(kind_of(motion), s).into_iter().flatten().collect()).sqrt()
    }

    /// Returns the pairs without those that close a circle with less than half of the matches of every other pair of the circle along the spanning tree.
    pub(crate) fn without_weak_closures(&self) -> Vec<&'a VerifiedPair> {
        let edges = self.graph.edges();
        let is_weak = |edge: usize| {
            let PairEdge { a, b, weight } = edges[edge];
            let mut weakest = vec![f64::INFINITY; self.photos.len()];
            for step in self.graph.breadth_first(&self.tree, a) {
                weakest[step.node] = weakest[step.parent].min(edges[step.edge].weight);
            }
            !self.tree.contains(&edge) && weight < 0.5 * weakest[b]
        };
        (0..edges.len()).filter(|edge| !is_weak(*edge)).map(|edge| self.pairs[edge]).collect()
    }

    /// Returns whether no photograph reaches the vanishing line of the plane.
    fn in_front(&self, s: &Solution) -> bool {
        in_front(&(0..self.photos.len()).map(|i| self.view(i, s)).collect::<Vec<_>>())
    }

    /// Transforms the solution to the metric frame of the plane; unchanged where a photograph would reach its vanishing line.
    pub(crate) fn as_plan(&self, solution: Solution) -> Solution {
        let Some(frame) = metric_frame(&solution.state.motion) else { return solution };
        let motion = solution.state.motion.iter().map(|m| m * frame).collect();
        let state = State { motion, lenses: solution.state.lenses.clone() };
        let plan = Solution { lens_of: solution.lens_of.clone(), prior: solution.prior.clone(), state };
        if self.in_front(&plan) { plan } else { solution }
    }

    /// Returns the pair with the largest median residual among the inconsistent ones.
    pub(crate) fn worst_inconsistency(
        &self,
        s: &Solution,
        motion: CameraMotion,
        options: &AlignOptions,
    ) -> Option<usize> {
        let errors = self.errors(kind_of(motion), s);
        let typical = median(errors.iter().flatten().copied().collect()).sqrt();
        // Parallax causes residuals of a few pixels; false matches of repeated structure tens.
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
            distortion: if lens.k1 == 0.0 { Distortion::NONE } else { Distortion::simple_radial(lens.k1) },
            ..Camera::from_focal(p.width, p.height, lens.log_focal.exp())
        });
        View { camera, from_world: s.state.motion[i] }
    }

    pub(crate) fn finish(
        &self,
        photos: &[Photo],
        solution: &Solution,
        motion: CameraMotion,
        inconsistent: &[bool],
        options: &AlignOptions,
    ) -> Result<Alignment, AlignError> {
        if !solution.state.motion.iter().all(|m| m.iter().all(|v| v.is_finite())) {
            return Err(AlignError::Inconsistent { photos: self.members.len() });
        }
        let mut views: Vec<Result<View, Unplaced>> = (0..photos.len())
            .map(|i| {
                let size = self.components.iter().find(|g| g.contains(&i)).map_or(1, Vec::len);
                Err(match size {
                    _ if inconsistent[i] => Unplaced::Inconsistent,
                    1 => Unplaced::NoOverlap,
                    size => Unplaced::OtherComponent { size },
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
            .map(|(p, e)| AlignedPair {
                a: p.a,
                b: p.b,
                inliers: p.inliers.clone(),
                matches: p.matches.clone(),
                rms_px: rms(e),
            })
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

/// Estimated parameters.
pub(crate) struct Solution {
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

/// Returns the median; 0 for an empty list.
fn median(mut values: Vec<f64>) -> f64 {
    cv_core::median(&mut values).unwrap_or(0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Rotation3, Vector3};

    #[test]
    fn the_nearest_rotation_is_found_and_every_matrix_has_one() {
        let turned = Rotation3::new(Vector3::new(0.3, -2.0, 0.4)).into_inner();
        // Stretched alike in all directions it is still the nearest; rounding of a few products.
        for scale in [1e-200, 1e-3, 1.0, 50.0, 1e100] {
            assert!((nearest_rotation(&(turned * scale)) - turned).norm() < 1e-14, "{scale}");
        }
        let one = |r: usize, c: usize, v: f64| Matrix3::from_fn(|i, j| if (i, j) == (r, c) { v } else { 0.0 });
        let strange = [
            Matrix3::zeros(),
            one(0, 0, 1e300),
            one(2, 1, -1e-300),
            Matrix3::repeat(1e200),
            Matrix3::from_diagonal(&Vector3::new(1e150, 1e-150, -1.0)),
            Matrix3::repeat(f64::NAN),
        ];
        for m in strange {
            let r = nearest_rotation(&m);
            assert!((r * r.transpose() - Matrix3::identity()).norm() < 1e-12 && r.determinant() > 0.0, "{m}{r}");
        }
    }
}
