//! Models of many views: the job as a whole.

use crate::complete::FeatureDistance;
use crate::finish::finish;
use crate::focal_length::start_cameras;
use crate::incremental::{begin, extend};
use crate::initial_pair::initial_pairs;
use crate::known_poses::place_known;
use crate::model::{SfmModel, ViewOutcome};
use crate::pair_scales::{Distances, measure};
use crate::repeated_structure::refuse_repeated;
use crate::scene::Scene;
use crate::view_graph::{RefusedPair, ViewGraph};
use crate::{CameraKnowledge, PairMatches, SfmView, Tracks, ViewPairModel, global};
use cv_core::{Camera, Cancelled, OptionError, Pose, Progress, Stage};

/// How poses are found; points, adjustment, completion and what views are left are the same for both ways.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Solver {
    /// All at once where the cameras are calibrated, and else, or where that gives no model of half of the views with which most matches agree, one after the other. Of fountain-P11, templeRing
    /// and kitti-2 with their cameras, AUC at 1 degree is the same or better all at once, in 0.7 to 0.8 of the time; in 0.63 of it for 1,000 generated views. With focal lengths that are only
    /// about right (sceaux, fountain-P11 without its camera) nothing is gained, and of a flat scene whose focal length is not known there is no model.
    #[default]
    Auto,
    /// One view after the other, from two on.
    Incremental,
    /// All at once: rotations of the view graph, then positions. At least three views that see the same points.
    Global,
}

cv_core::named!(Solver {
    Auto = "auto": "global where the cameras are known and it holds, else incremental",
    Incremental = "incremental": "one view after the other, from two on",
    Global = "global": "all poses at once from those of the pairs",
});

/// Settings of [`reconstruct_views`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SfmOptions {
    /// Largest reprojection error of an observation that agrees with its point, in pixels; while the model grows, twice that. Default 2.5 (COLMAP: 4): with it, the mean errors of
    /// fountain-P11, templeRing and kitti-2 are below COLMAP's, and no AUC is lower than with 4.
    pub max_error: f64,
    /// Smallest angle between two rays of a point, in radians. Default 1.5 degrees, COLMAP's.
    pub min_angle: f64,
    /// Fewest points that must agree with the pose of a view. Default 20 (COLMAP: 30).
    pub min_pose_inliers: usize,
    /// Smallest share of the points it sees that must agree, 0 to 1. Default 0.25, COLMAP's.
    pub min_pose_share: f64,
    /// Fewest views of a point, 2 or more, in models of twice as many views and more; 2 in smaller ones. Default 3 (GLOMAP's): a point of two views is confirmed by one number only, its
    /// distance from the epipolar line.
    pub min_point_views: usize,
    /// Fewest views of a model. Default 3.
    pub min_model_size: usize,
    /// All points are adjusted again when the model has grown by this factor. Above 1; default 1.2.
    pub growth: f64,
    /// How poses are found. Default [`Solver::Auto`].
    pub solver: Solver,
    /// Seed of the random samples. Default 0.
    pub seed: u64,
}

impl Default for SfmOptions {
    fn default() -> Self {
        Self {
            max_error: 2.5,
            min_angle: 1.5f64.to_radians(),
            min_pose_inliers: 20,
            min_pose_share: 0.25,
            min_point_views: 3,
            min_model_size: 3,
            growth: 1.2,
            solver: Solver::Auto,
            seed: 0,
        }
    }
}

impl SfmOptions {
    /// Largest reprojection error while the model grows, in pixels.
    pub(crate) fn growing_error(&self) -> f64 {
        2.0 * self.max_error
    }
}

/// Views, their cameras, and the pairs among them that hold.
#[derive(Clone, Copy)]
pub struct SfmInput<'a> {
    /// The views.
    pub views: &'a [SfmView<'a>],
    /// The cameras, as far as they are known: size, and a focal length to begin with.
    pub cameras: &'a [Camera],
    /// What is known of each.
    pub knowledge: &'a [CameraKnowledge],
    /// Matches that agree with the geometry of their pair.
    pub pairs: &'a [PairMatches],
    /// The geometry of each pair.
    pub geometry: &'a [ViewPairModel],
    /// How alike features are, by which points are looked for in views that lack them; without, tracks stay as the matches say.
    pub alike: Option<&'a dyn FeatureDistance>,
}

/// What [`reconstruct_views`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct SfmOutcome {
    /// The models, the one with most views first.
    pub models: Vec<SfmModel>,
    /// How each of them was found: [`Solver::Incremental`] or [`Solver::Global`].
    pub solvers: Vec<Solver>,
    /// What became of each view.
    pub views: Vec<ViewOutcome>,
    /// The pairs that were not used, by index.
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
    /// A view's camera, or a pair's view or geometry, is not there.
    #[error("{what} {index} names a {of} that there is not")]
    Missing {
        /// What names it.
        what: &'static str,
        /// Its index.
        index: usize,
        /// What is missing.
        of: &'static str,
    },
    /// No pair of views is good to start from.
    #[error("none of {pairs} pairs of views shows enough points from two places")]
    NoInitialPair {
        /// Pairs that share matches.
        pairs: usize,
    },
    /// Pairs of views hold, but no model that most of their matches agree with: a wrong focal length, repeated structure, or a scene that moves.
    #[error("of {of} matched keypoints of the best model's views {agree} agree with it")]
    Inconsistent {
        /// Keypoints that agree.
        agree: usize,
        /// Keypoints of tracks that are seen from two of the model's views and more.
        of: usize,
    },
    /// An option is outside its range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Cameras, poses and points of views from the matches of their pairs.
///
/// Pairs that contradict others, or that show different things that look alike, are refused first, where focal lengths are known ([`SfmOutcome::refused`]). Poses are then found all at once from
/// those of the pairs, or one after the other ([`Solver`]): from the pair that shows most points at wide angles, the view that sees most points, spread over its picture, is added next. Points are
/// triangulated from whole tracks, and adjusted with the poses: those near a new view at once, all of them when the model has grown. Views that no model takes up start another.
/// O(observations) for each adjustment; a model of n views is adjusted O(log n) times as a whole.
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

/// [`reconstruct_views`], the first model of which goes on from poses that are known, to some pixels: those of an earlier model in its frame ([`align_to_poses`](crate::align_to_poses) brings it
/// back there to the last digit). `known` is by view; empty: none. A pose that the matches do not agree with is found anew.
///
/// # Errors
/// [`SfmError`].
pub fn reconstruct_views_from(
    input: &SfmInput<'_>,
    known: &[Option<Pose>],
    options: &SfmOptions,
    progress: &dyn Progress,
) -> Result<SfmOutcome, SfmError> {
    check(input, options)?;
    let cameras = start_cameras(input);
    let stage = Stage::new(progress, "register", input.views.len())?;
    let mut graph = None;
    let (mut refused, mut distances) = (Vec::new(), Vec::new());
    // A focal length that nothing but the pairs tells may be quite wrong, of flat scenes above all: relative poses by it contradict each other though the pairs are right.
    let focal_known = input.views.iter().all(|v| input.knowledge[v.camera] != CameraKnowledge::Unknown);
    if focal_known || options.solver == Solver::Global {
        let mut all = ViewGraph::new(input, &cameras[0], options, &stage)?;
        if focal_known {
            refused.extend(all.refuse_by_triplets(input, &cameras[0], options, &stage)?);
        }
        // Of each pair, so that links can be removed.
        let measured = measure(&all, input, &cameras[0], options.min_angle, &stage)?;
        distances.resize(input.pairs.len(), Distances::default());
        all.links.iter().zip(measured).for_each(|(l, of)| distances[l.pair] = of);
        if focal_known {
            refused.extend(refuse_repeated(&mut all, &distances, input, &cameras[0], options, &stage)?);
        }
        graph = Some(all);
    }
    let mut usable = vec![true; input.pairs.len()];
    refused.iter().for_each(|r: &RefusedPair| usable[r.pair] = false);
    let pairs: Vec<&PairMatches> = input.pairs.iter().zip(&usable).filter(|p| *p.1).map(|p| p.0).collect();
    let keypoints: Vec<_> = input.views.iter().map(|v| v.keypoints).collect();
    let tracks = Tracks::build(&keypoints, pairs.iter().copied());
    let scene = Scene::new(input.views, &cameras[0], input.knowledge, tracks.clone());
    let mut paired = vec![false; input.views.len()];
    pairs.iter().for_each(|p| (paired[p.a], paired[p.b]) = (true, true));
    let unseen = |paired: &bool| match paired {
        true => ViewOutcome::TooFewPoints { seen: 0, needed: options.min_pose_inliers },
        false => ViewOutcome::NoPairs,
    };
    let mut job = Job {
        input,
        options,
        pairs,
        graph,
        distances,
        tracks,
        scene,
        taken: vec![false; input.views.len()],
        outcomes: paired.iter().map(unseen).collect(),
        weakest: None,
        stage,
    };
    let (mut models, mut solvers): (Vec<SfmModel>, Vec<Solver>) = Default::default();
    loop {
        let known_first = if models.is_empty() { job.of_known(known, &cameras[0])? } else { None };
        let Some(found) = known_first.map_or_else(|| job.next_model(&cameras), |found| Ok(Some(found)))? else { break };
        if found.model.registered() < options.min_model_size.min(input.views.len()) {
            break;
        }
        job.outcomes = found.outcomes;
        for (v, _) in found.model.poses.iter().enumerate().filter(|(_, p)| p.is_some()) {
            job.taken[v] = true;
            job.outcomes[v] = ViewOutcome::Registered { model: models.len() };
        }
        models.push(found.model);
        solvers.push(found.solver);
    }
    if models.is_empty() {
        return Err(match job.weakest {
            Some((agree, of)) => SfmError::Inconsistent { agree, of },
            None => SfmError::NoInitialPair { pairs: input.pairs.len() },
        });
    }
    Ok(SfmOutcome { models, solvers, views: job.outcomes, refused })
}

/// A model, and what became of the views that it lacks.
struct Found {
    model: SfmModel,
    solver: Solver,
    outcomes: Vec<ViewOutcome>,
}

/// What [`reconstruct_views`] has at hand.
struct Job<'a, 'p> {
    input: &'a SfmInput<'a>,
    options: &'a SfmOptions,
    /// Those that are not refused.
    pairs: Vec<&'a PairMatches>,
    /// Relative poses, where focal lengths are known.
    graph: Option<ViewGraph>,
    /// Of each pair, where there are relative poses.
    distances: Vec<Distances>,
    tracks: Tracks,
    scene: Scene<'a>,
    /// Of each view, whether a model has it.
    taken: Vec<bool>,
    outcomes: Vec<ViewOutcome>,
    /// Support of the last model that was refused for it.
    weakest: Option<(usize, usize)>,
    stage: Stage<'p>,
}

impl Job<'_, '_> {
    /// The best model of the views that no model has. None where there is none.
    fn next_model(&mut self, cameras: &[Vec<Camera>]) -> Result<Option<Found>, Cancelled> {
        let taken = &self.taken;
        let left: Vec<&PairMatches> = self.pairs.iter().filter(|p| !taken[p.a] && !taken[p.b]).copied().collect();
        let mut open = vec![false; taken.len()];
        left.iter().for_each(|p| (open[p.a], open[p.b]) = (true, true));
        let open = open.into_iter().filter(|o| *o).count();
        let mut best: Option<Found> = None;
        for (n, cameras) in cameras.iter().enumerate() {
            if n == 0
                && let Some(found) = self.globally(cameras)?
            {
                if 2 * found.model.registered() >= open {
                    return Ok(Some(found));
                }
                best = Some(found);
            }
            if self.options.solver == Solver::Global {
                break;
            }
            self.scene.clear(cameras, &self.tracks);
            let starts = initial_pairs(&self.scene, &left, self.options, &self.stage)?;
            for start in starts.iter().take(MOST_STARTS) {
                self.scene.clear(cameras, &self.tracks);
                begin(&mut self.scene, start, self.options, &self.stage)?;
                let Some(found) = self.completed(Solver::Incremental)? else { continue };
                let whole = 2 * found.model.registered() >= open;
                if best.as_ref().is_none_or(|b| found.model.registered() > b.model.registered()) {
                    best = Some(found);
                }
                if whole {
                    return Ok(best);
                }
            }
        }
        Ok(best)
    }

    /// The model that goes on from known poses, where there are any that the matches agree with.
    fn of_known(&mut self, known: &[Option<Pose>], cameras: &[Camera]) -> Result<Option<Found>, Cancelled> {
        if known.iter().all(Option::is_none) {
            return Ok(None);
        }
        self.scene.clear(cameras, &self.tracks);
        match place_known(&mut self.scene, known, self.options, &self.stage)? {
            true => self.completed(Solver::Incremental),
            false => Ok(None),
        }
    }

    /// A model of the largest part of the view graph at once, where the options have it so.
    fn globally(&mut self, cameras: &[Camera]) -> Result<Option<Found>, Cancelled> {
        let wanted = match self.options.solver {
            Solver::Incremental => false,
            Solver::Global => true,
            Solver::Auto => self.input.knowledge.iter().all(CameraKnowledge::is_calibrated),
        };
        let Some(graph) = self.graph.as_ref().filter(|_| wanted) else { return Ok(None) };
        let graph = graph.filtered(|l| !self.taken[l.a] && !self.taken[l.b]);
        self.scene.clear(cameras, &self.tracks);
        match global::place(&mut self.scene, &graph, &self.distances, self.options, &self.stage)? {
            true => self.completed(Solver::Global),
            false => Ok(None),
        }
    }

    /// The scene with all views that it can take up, adjusted; `None` where the matches do not agree with it.
    fn completed(&mut self, solver: Solver) -> Result<Option<Found>, Cancelled> {
        let mut outcomes = self.outcomes.clone();
        extend(&mut self.scene, &self.taken, self.options, &mut outcomes, &self.stage)?;
        finish(&mut self.scene, self.input.alike, self.options, &self.stage)?;
        let (agree, of) = self.scene.support();
        if (agree as f64) < LEAST_SUPPORT * of as f64 {
            self.weakest = Some((agree, of));
            return Ok(None);
        }
        let model = SfmModel::of(&self.scene, self.options.min_point_views);
        Ok(Some(Found { model, solver, outcomes }))
    }
}

/// Smallest share of the matched keypoints of a model's views that agree with it. Of fountain-P11, sceaux, templeRing and a drive 82 to 99 % do; of models with a wrong focal length 1 %.
const LEAST_SUPPORT: f64 = 0.3;
/// Starts that are tried where the first ones lead to less than half of the views.
const MOST_STARTS: usize = 4;
fn check(input: &SfmInput<'_>, options: &SfmOptions) -> Result<(), SfmError> {
    OptionError::check("max_error", options.max_error, "above 0 and finite", |v| v > 0.0 && v.is_finite())?;
    OptionError::check("min_angle", options.min_angle, "from 0 to 1 radian", |v| (0.0..=1.0).contains(&v))?;
    OptionError::check("min_point_views", options.min_point_views as f64, "2 or more", |v| v >= 2.0)?;
    OptionError::check("growth", options.growth, "above 1 and finite", |v| v > 1.0 && v.is_finite())?;
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
