//! Reconstruction of models from verified pairs: the job as a whole.

use crate::complete::FeatureDistance;
use crate::focal_length::initial_cameras;
use crate::incremental::{extend, growing_limits, initialize};
use crate::initial_pair::initial_pairs;
use crate::known_poses::register_known_poses;
use crate::model::{SfmModel, ViewOutcome};
use crate::model_parts::{Consistency, RemovedView, covisible_pairs, keep_largest_consistent_component};
use crate::pair_scales::{Distances, measure_distances};
use crate::refine_model::refine_model;
use crate::repeated_structure::reject_repeated_structure;
use crate::rotation_only::is_rotation_only;
use crate::scene::Scene;
use crate::triangulate_track::update_tracks;
use crate::view_graph::{RefusedPair, ViewGraph};
use crate::{CameraKnowledge, PairMatches, SfmOptions, SfmView, Solver, Tracks, ViewPairModel, global};
use cv_core::{Camera, Cancelled, OptionError, Pose, Progress, Stage};

/// Views, their cameras, and the verified pairs of views.
#[derive(Clone, Copy)]
pub struct SfmInput<'a> {
    /// The views.
    pub views: &'a [SfmView<'a>],
    /// The cameras: image size, and an initial focal length.
    pub cameras: &'a [Camera],
    /// Prior knowledge of each camera's intrinsics.
    pub knowledge: &'a [CameraKnowledge],
    /// Inlier matches of each pair.
    pub pairs: &'a [PairMatches],
    /// The geometry of each pair.
    pub geometry: &'a [ViewPairModel],
    /// Descriptor distance for track completion; without it, tracks are those of the matches.
    pub feature_distance: Option<&'a dyn FeatureDistance>,
}

/// Result of [`reconstruct_views`].
#[derive(Debug, Clone, PartialEq)]
pub struct SfmOutcome {
    /// The models, the one with most views first.
    pub models: Vec<SfmModel>,
    /// How the poses of each model were estimated: [`Solver::Incremental`] or [`Solver::Global`].
    pub solvers: Vec<Solver>,
    /// Outcome of each view.
    pub views: Vec<ViewOutcome>,
    /// The pairs that were rejected, by index.
    pub refused: Vec<RefusedPair>,
}

/// Why nothing was reconstructed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmError {
    /// Fewer than two views.
    #[error("{got} views are too few: 2 are needed")]
    TooFewViews {
        /// Number of views.
        got: usize,
    },
    /// A view refers to a missing camera, or a pair to a missing view or geometry.
    #[error("{what} {index} refers to a missing {of}")]
    Missing {
        /// Kind of the referring item.
        what: &'static str,
        /// Its index.
        index: usize,
        /// Kind of the missing item.
        of: &'static str,
    },
    /// No pair is suitable as initial pair.
    #[error("none of {pairs} pairs of views has enough inliers with parallax to start from")]
    NoInitialPair {
        /// Number of pairs.
        pairs: usize,
    },
    /// A model was built, but most matches disagree with it: a wrong focal length, repeated structure, or a moving
    /// scene.
    #[error("only {agree} of {of} matched keypoints agree with the best model")]
    Inconsistent {
        /// Keypoints that agree.
        agree: usize,
        /// Keypoints of tracks that at least two registered views observe.
        of: usize,
    },
    /// An option is outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Reconstructs cameras, poses and points from the verified matches of pairs of views.
///
/// Where focal lengths are known, pairs that contradict others, or that match different instances of repeated
/// structure, are rejected first ([`SfmOutcome::refused`]). Poses are then estimated globally or incrementally
/// ([`Solver`]): from the initial pair with most points at large triangulation angles, the next view is the one with
/// most visible points, evenly spread over the image. Points are triangulated from whole tracks. After each
/// registration a local bundle adjustment follows, and a global one when the model has grown. Parts of a model that the
/// matches across contradict, and, with [`SfmInput::feature_distance`], views that lack nearly all points in their field
/// of view, are removed ([`ViewOutcome::Contradicted`]). Where cameras are not calibrated, several initial focal lengths
/// are tried until nearly all views and keypoints agree with a model, and models that rotations about one center explain
/// are discarded. Views that no model contains start another one. O(observations) for each adjustment; a model of n views
/// has O(log n) global ones.
///
/// # Errors
/// [`SfmError`].
pub fn reconstruct_views(
    input: &SfmInput<'_>,
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<SfmOutcome, SfmError> {
    reconstruct_views_from(input, &[], options, progress)
}

/// As [`reconstruct_views`], with initial poses for the first model, accurate to some pixels: those of an earlier
/// model, in its frame ([`align_to_poses`](crate::align_to_poses) restores it exactly). `known` is by view; empty:
/// none. A pose without enough inliers is estimated again.
///
/// # Errors
/// [`SfmError`].
pub fn reconstruct_views_from(
    input: &SfmInput<'_>,
    known: &[Option<Pose>],
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<SfmOutcome, SfmError> {
    validate(input, options)?;
    let mut cameras = initial_cameras(input);
    let stage = Stage::new(progress, "register", input.views.len())?;
    let mut graph = None;
    let (mut refused, mut distances) = (Vec::new(), Vec::new());
    // A focal length estimated from the pairs alone may be quite wrong, above all for planar scenes: relative poses
    // then contradict each other although the pairs are right.
    let is_focal_known = input.views.iter().all(|v| input.knowledge[v.camera] != CameraKnowledge::Unknown);
    if is_focal_known || options.solver == Solver::Global {
        let mut all = ViewGraph::new(input, &cameras[0], options, &stage)?;
        if is_focal_known {
            refused.extend(all.reject_by_triplets(input, &cameras[0], options, &stage)?);
        }
        // By pair, so that links can be removed.
        let link_distances = measure_distances(&all, input, &cameras[0], options.min_angle, &stage)?;
        distances.resize(input.pairs.len(), Distances::default());
        all.links.iter().zip(link_distances).for_each(|(l, of)| distances[l.pair] = of);
        if is_focal_known {
            refused.extend(reject_repeated_structure(&mut all, &distances, input, &cameras[0], options, &stage)?);
        }
        graph = Some(all);
    }
    let mut is_usable = vec![true; input.pairs.len()];
    refused.iter().for_each(|r: &RefusedPair| is_usable[r.pair] = false);
    let pairs: Vec<&PairMatches> = input.pairs.iter().zip(&is_usable).filter(|p| *p.1).map(|p| p.0).collect();
    let keypoints: Vec<_> = input.views.iter().map(|v| v.keypoints).collect();
    let tracks = Tracks::build(&keypoints, pairs.iter().copied());
    let scene = Scene::new(input.views, &cameras[0], input.knowledge, tracks.clone());
    let mut is_paired = vec![false; input.views.len()];
    pairs.iter().for_each(|p| (is_paired[p.a], is_paired[p.b]) = (true, true));
    let initial_outcome = |is_paired: &bool| match is_paired {
        true => ViewOutcome::TooFewPoints { seen: 0, needed: options.min_pose_inliers },
        false => ViewOutcome::NoPairs,
    };
    let mut state = Reconstruction {
        input,
        options,
        pairs,
        graph,
        distances,
        tracks,
        scene,
        is_registered: vec![false; input.views.len()],
        outcomes: is_paired.iter().map(initial_outcome).collect(),
        rejected_support: None,
        has_rotation: false,
        rotating_views: 0,
        stage,
    };
    let (mut models, mut solvers): (Vec<SfmModel>, Vec<Solver>) = Default::default();
    loop {
        let known_first = if models.is_empty() { state.extend_known_poses(known, &cameras[0])? } else { None };
        let Some(candidate) =
            known_first.map_or_else(|| state.next_model(&cameras), |candidate| Ok(Some(candidate)))?
        else {
            break;
        };
        if candidate.model.registered() < options.min_model_size.min(input.views.len()) {
            break;
        }
        state.outcomes = candidate.outcomes;
        for (v, _) in candidate.model.poses.iter().enumerate().filter(|(_, p)| p.is_some()) {
            state.is_registered[v] = true;
            state.outcomes[v] = ViewOutcome::Registered { model: models.len() };
        }
        if models.is_empty() {
            // The others, of fewer views, determine intrinsics less well.
            cameras = vec![candidate.model.cameras.clone()];
        }
        models.push(candidate.model);
        solvers.push(candidate.solver);
    }
    if models.is_empty() {
        return Err(match state.rejected_support {
            Some((agree, of)) if !state.has_rotation => SfmError::Inconsistent { agree, of },
            _ => SfmError::NoInitialPair { pairs: input.pairs.len() },
        });
    }
    Ok(SfmOutcome { models, solvers, views: state.outcomes, refused })
}

/// A candidate model, and the outcomes of the views that it lacks.
struct Candidate {
    model: SfmModel,
    solver: Solver,
    outcomes: Vec<ViewOutcome>,
    /// Number of matched keypoints of the model's views, and of those that agree with it.
    of: usize,
    agree: usize,
}

/// State of [`reconstruct_views`].
struct Reconstruction<'a, 'p> {
    input: &'a SfmInput<'a>,
    options: &'a SfmOptions,
    /// The pairs that are not rejected.
    pairs: Vec<&'a PairMatches>,
    /// Relative poses, where focal lengths are known.
    graph: Option<ViewGraph>,
    /// By pair, where there are relative poses.
    distances: Vec<Distances>,
    tracks: Tracks,
    scene: Scene<'a>,
    /// By view: whether a model contains it.
    is_registered: Vec<bool>,
    outcomes: Vec<ViewOutcome>,
    /// Support of the last model that was rejected for too little of it: inliers and observations.
    rejected_support: Option<(usize, usize)>,
    /// Whether rotations explain a rejected model.
    has_rotation: bool,
    /// Number of views of the largest candidate of the present model that had enough support, but that rotations explain.
    rotating_views: usize,
    stage: Stage<'p>,
}

impl Reconstruction<'_, '_> {
    /// Returns the best model of the views that no model contains yet; `None` without an initial pair.
    fn next_model(&mut self, cameras: &[Vec<Camera>]) -> Result<Option<Candidate>, Cancelled> {
        let is_registered = &self.is_registered;
        let remaining: Vec<&PairMatches> =
            self.pairs.iter().filter(|p| !is_registered[p.a] && !is_registered[p.b]).copied().collect();
        let mut remaining_views = vec![false; is_registered.len()];
        remaining.iter().for_each(|p| (remaining_views[p.a], remaining_views[p.b]) = (true, true));
        let remaining_views = remaining_views.into_iter().filter(|o| *o).count();
        let mut best: Option<Candidate> = None;
        self.rotating_views = 0;
        for (n, cameras) in cameras.iter().enumerate() {
            if n == 0
                && let Some(candidate) = self.solve_globally(cameras)?
            {
                if 2 * candidate.model.registered() >= remaining_views {
                    return Ok(Some(candidate));
                }
                best = Some(candidate);
            }
            if self.options.solver == Solver::Global {
                break;
            }
            self.scene.clear(cameras, &self.tracks);
            let initial = initial_pairs(&self.scene, &remaining, self.options, &self.stage)?;
            for pair in initial.iter().take(MAX_INITIAL_PAIRS) {
                self.scene.clear(cameras, &self.tracks);
                initialize(&mut self.scene, pair, self.options, &self.stage)?;
                let Some(candidate) = self.complete_model(Solver::Incremental)? else {
                    // Other lenses only imitate parallax, too.
                    if 2 * self.rotating_views >= remaining_views {
                        return Ok(best);
                    }
                    continue;
                };
                let registered = candidate.model.registered();
                let is_complete = registered as f64 >= COMPLETE_MODEL * remaining_views as f64;
                let is_certain = is_complete && candidate.agree as f64 >= GOOD_SUPPORT * candidate.of as f64;
                if best.as_ref().is_none_or(|b| candidate.agree > b.agree) {
                    best = Some(candidate);
                }
                if is_certain {
                    return Ok(best);
                }
                // Rather another focal length than another initial pair.
                if 2 * registered >= remaining_views {
                    break;
                }
            }
        }
        Ok(best)
    }

    /// Returns the model that extends the known poses; `None` where too few of them have enough inliers.
    fn extend_known_poses(
        &mut self,
        known: &[Option<Pose>],
        cameras: &[Camera],
    ) -> Result<Option<Candidate>, Cancelled> {
        if known.iter().all(Option::is_none) {
            return Ok(None);
        }
        self.scene.clear(cameras, &self.tracks);
        match register_known_poses(&mut self.scene, known, self.options, &self.stage)? {
            true => self.complete_model(Solver::Incremental),
            false => Ok(None),
        }
    }

    /// Returns the model of the largest component of the view graph by the global solver, if the options select it.
    fn solve_globally(&mut self, cameras: &[Camera]) -> Result<Option<Candidate>, Cancelled> {
        let is_selected = match self.options.solver {
            Solver::Incremental => false,
            Solver::Global => true,
            Solver::Auto => self.scene.is_calibrated(),
        };
        let Some(graph) = self.graph.as_ref().filter(|_| is_selected) else { return Ok(None) };
        let graph = graph.filtered(|l| !self.is_registered[l.a] && !self.is_registered[l.b]);
        self.scene.clear(cameras, &self.tracks);
        match global::estimate_poses(&mut self.scene, &graph, &self.distances, self.options, &self.stage)? {
            true => self.complete_model(Solver::Global),
            false => Ok(None),
        }
    }

    /// Registers all views that the scene can take up and refines it; `None` where too few observations agree with it, or
    /// rotations explain them.
    fn complete_model(&mut self, solver: Solver) -> Result<Option<Candidate>, Cancelled> {
        let mut outcomes = self.outcomes.clone();
        let pairs: Vec<(usize, usize)> = self.pairs.iter().map(|p| (p.a, p.b)).collect();
        let all: Vec<usize> = (0..self.scene.tracks.len()).collect();
        for _ in 0..MAX_EXTENSIONS {
            extend(&mut self.scene, &self.is_registered, self.options, &mut outcomes, &self.stage)?;
            let limits = (1, self.options.min_model_size);
            if !self.remove_inconsistent_parts(&pairs, Consistency::Inliers, limits, &mut outcomes)? {
                break;
            }
            let limits = growing_limits(&self.scene, self.options);
            update_tracks(&mut self.scene, limits, &all);
        }
        refine_model(&mut self.scene, self.input.feature_distance, self.options, &self.stage)?;
        // Without completion, views may lack observations of points that they see.
        if self.input.feature_distance.is_some() {
            let pairs = covisible_pairs(&self.scene, &self.stage)?;
            if self.remove_inconsistent_parts(&pairs, Consistency::VisiblePoints, (1, 1), &mut outcomes)? {
                refine_model(&mut self.scene, self.input.feature_distance, self.options, &self.stage)?;
            }
        }
        let (agree, of) = self.scene.support();
        let is_calibrated = self.scene.is_calibrated();
        if (agree as f64) < MIN_SUPPORT * of as f64 {
            self.rejected_support = Some((agree, of));
            if !is_calibrated {
                self.scene.activate_all();
                self.has_rotation |=
                    is_rotation_only(&mut self.scene, MIN_MATCHES_OF_ROTATION, self.options, &self.stage)?;
            }
            return Ok(None);
        }
        if !is_calibrated && is_rotation_only(&mut self.scene, MIN_INLIERS_OF_ROTATION, self.options, &self.stage)? {
            self.has_rotation = true;
            self.rotating_views = self.rotating_views.max(self.scene.registered().len());
            return Ok(None);
        }
        let model = SfmModel::from_scene(&self.scene, self.options.min_point_views);
        Ok(Some(Candidate { model, solver, outcomes, of, agree }))
    }

    /// Removes the views of inconsistent parts of the model ([`keep_largest_consistent_component`]) and sets their
    /// outcomes; returns whether there are any.
    fn remove_inconsistent_parts(
        &mut self,
        pairs: &[(usize, usize)],
        consistency: Consistency,
        limits: (usize, usize),
        outcomes: &mut [ViewOutcome],
    ) -> Result<bool, Cancelled> {
        let removed = keep_largest_consistent_component(&mut self.scene, pairs, consistency, limits, &self.stage)?;
        for &RemovedView { view, agree, of } in &removed {
            outcomes[view] = ViewOutcome::Contradicted { agree, of };
        }
        Ok(!removed.is_empty())
    }
}

/// Minimum ratio of inliers among the matched keypoints of a model's views. Of fountain-P11, sceaux, templeRing and a
/// drive 82 to 99 % agree; with a wrong focal length 1 %.
const MIN_SUPPORT: f64 = 0.3;
/// Minimum ratio of the inliers of a model that rotations explain, for a rotating camera: 99.5 % and more of ten
/// photographs from a tripod, 97 % from a circle of 15 cm in a room.
const MIN_INLIERS_OF_ROTATION: f64 = 0.98;
/// The same of all matched keypoints, with their outliers.
const MIN_MATCHES_OF_ROTATION: f64 = 0.9;
/// Minimum ratio of inliers among the matched keypoints of a model with which no other focal length is tried: with one that
/// is far off, a model may have all views and 40 to 60 % agree.
const GOOD_SUPPORT: f64 = 0.75;
/// The same of registered views: with a wrong lens, a model may have half of the views and 90 % agree.
const COMPLETE_MODEL: f64 = 0.9;
/// Maximum number of times that a model is extended: its parts may turn out to be inconsistent where they meet, and only
/// the largest is kept then.
const MAX_EXTENSIONS: usize = 2;
/// Maximum number of initial pairs that are tried while models have fewer than half of the views.
const MAX_INITIAL_PAIRS: usize = 4;

fn validate(input: &SfmInput<'_>, options: &SfmOptions) -> Result<(), SfmError> {
    options.validate()?;
    if input.views.len() < 2 {
        return Err(SfmError::TooFewViews { got: input.views.len() });
    }
    let missing = |what, index, of| Err(SfmError::Missing { what, index, of });
    if let Some(i) = input.views.iter().position(|v| v.camera >= input.cameras.len().min(input.knowledge.len())) {
        return missing("view", i, "camera");
    }
    if let Some(i) = input.pairs.iter().position(|p| p.a.max(p.b) >= input.views.len() || p.a == p.b) {
        return missing("pair", i, "view");
    }
    if input.geometry.len() < input.pairs.len() {
        return missing("pair", input.geometry.len(), "geometry");
    }
    Ok(())
}
