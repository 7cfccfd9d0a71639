//! A model in the frame of what is known of its cameras: up, meters, positions.

use crate::SfmModel;
use cv_core::{Cancelled, Matrix3, Point3, Pose, Progress, Rotation3, Vector3, median, upright_frame};
use cv_geometry::{EstimateError, RobustOptions, Similarity, SimilarityFreedom, estimate_similarity};
use cv_numeric::{svd3, symmetric_eigen};

/// What is known of where views were, by a source other than their pictures.
#[derive(Debug, Clone, Copy, Default)]
pub struct KnownPlaces<'a> {
    /// Of each view, where its camera's center was: X and Y level, Z up, in one unit (meters). Empty: nothing is known.
    pub centers: &'a [Option<Point3<f64>>],
    /// Pairs of views and how far apart their centers were, in the same unit.
    pub distances: &'a [(usize, usize, f64)],
}

/// How a model was aligned.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelAlignment {
    /// From the model's frame to the new one, which has Z up.
    pub similarity: Similarity,
    /// Whether lengths have the unit of what is known; else they are as before.
    pub metric: bool,
    /// How known centers fit, where they were used.
    pub centers: Option<CenterFit>,
    /// Largest relative error of a known distance, where some were used.
    pub distance_error: Option<f64>,
}

/// How known centers fit a model.
#[derive(Debug, Clone, PartialEq)]
pub struct CenterFit {
    /// Views of the model whose known center agrees, ascending.
    pub agree: Vec<usize>,
    /// Those whose known center does not.
    pub differ: Vec<usize>,
    /// Root mean square distance of those that agree from where they are known to be.
    pub rms: f64,
    /// Root mean square distance of their known centers from their mean.
    pub spread: f64,
    /// Whether the known centers tell how the model is tilted; on a line they do not, and up is that of the photographs.
    pub tilt: bool,
    /// The scale by the centers over that by the known distances, where there are both.
    pub scale_ratio: Option<f64>,
}

/// Why a model cannot be aligned to what is known.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum ModelAlignError {
    /// Fewer than three of the model's views have a known center.
    #[error("{got} views of the model have a known center where {needed} are needed")]
    TooFew {
        /// Views that have one.
        got: usize,
        /// How many are needed.
        needed: usize,
    },
    /// The known centers are one place, or all above each other.
    #[error("the known centers are in one place, or one above the other")]
    OnePlace,
    /// The known centers are not those of the model.
    #[error("{agree} of {of} known centers agree with the model, to {rms} where they are {spread} around their mean")]
    Contradiction {
        /// Centers that agree with the best alignment.
        agree: usize,
        /// Known centers.
        of: usize,
        /// Root mean square distance of those that agree, or what it is at the most.
        rms: f64,
        /// That of theirs from their mean.
        spread: f64,
    },
    /// A view with a known distance is not in the model.
    #[error("view {view}, to which a distance is known, is not in the model")]
    NotInModel {
        /// Index of the view.
        view: usize,
    },
    /// Two views with a known distance are in one place in the model.
    #[error("views {a} and {b}, between which a distance is known, are in one place")]
    NoDistance {
        /// Index of one.
        a: usize,
        /// Index of the other.
        b: usize,
    },
    /// A center or a distance is not a number of any use.
    #[error("known place {index} is not a number of any use")]
    NotFinite {
        /// Index of the view, or of the distance.
        index: usize,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Fewest known centers.
const FEWEST: usize = 3;
/// Largest root mean square distance of known centers from a model's, as a share of how far they are around their mean: with half of it, the model explains three quarters of the variance. Positions
/// with an error as large as the scene would pass for it at any scale.
const CONTRADICTION: f64 = 0.5;
/// Largest standard deviation of a tilt by known centers, in radians, before that of the photographs is taken: the mean of how people hold a camera is level to about so much.
const TILT: f64 = 0.05;
/// The median length of a normal error in space, in standard deviations of a coordinate (χ with three degrees of freedom).
const MEDIAN_LENGTH: f64 = 1.5382;
/// The longest error of a center that agrees, in the same: 99 % are below 3.37, and the median of a dozen errors tells the deviation to a quarter only, seldom to less than two thirds.
const LONGEST: f64 = 5.0;
/// What a model's own centers may be off by, as a share of how far they are around their mean (kitti-2: 2.5 %): no nearer place is called another.
const DRIFT: f64 = 0.01;

/// The similarity from a model's frame to that of what is known: up by the photographs themselves ([`upright_frame`]), the scale by known distances, all of it by known centers.
///
/// Centers (the satellites' are off by meters, some by much more) are fitted by a robust similarity ([`estimate_similarity`]) whose threshold is found from their own noise. Where they lie on a
/// line within their noise, as along a street, they say nothing of how the model is turned about it: the photographs' up does. A similarity never bends a model. With distances the scale is
/// theirs alone. Nothing known: upright, the first view in the origin, looking along Y.
///
/// # Errors
/// [`ModelAlignError`].
pub fn align_model(
    model: &SfmModel,
    known: &KnownPlaces<'_>,
    seed: u64,
    progress: &dyn Progress,
) -> Result<ModelAlignment, ModelAlignError> {
    let base = upright_similarity(model);
    let (scale, distance_error) = match known.distances {
        [] => (None, None),
        distances => {
            let (scale, error) = scale_by(model, distances)?;
            (Some(scale), Some(error))
        }
    };
    let base = scaled(&base, scale.unwrap_or(1.0));
    if known.centers.iter().all(Option::is_none) {
        return Ok(ModelAlignment { similarity: base, metric: scale.is_some(), centers: None, distance_error });
    }
    let (mut views, mut from, mut to) = (Vec::new(), Vec::new(), Vec::new());
    for (v, (pose, center)) in model.poses.iter().zip(known.centers).enumerate() {
        let (Some(pose), Some(center)) = (pose, center) else { continue };
        if !center.iter().all(|c| c.abs() <= 1e12) {
            return Err(ModelAlignError::NotFinite { index: v });
        }
        views.push(v);
        from.push(base.transform(&pose.center()));
        to.push(*center);
    }
    if views.len() < FEWEST {
        return Err(ModelAlignError::TooFew { got: views.len(), needed: FEWEST });
    }
    let fit = |tilt: bool| Fit::new(&from, &to, SimilarityFreedom { scale: scale.is_none(), tilt }, seed, progress);
    let found = match fit(true)? {
        Some(found) if found.tilt_deviation(&from) <= TILT => Some((found, true)),
        _ => fit(false)?.map(|found| (found, false)),
    };
    let (found, tilt) = found.ok_or(ModelAlignError::OnePlace)?;
    let agree = found.inliers.len();
    if found.rms > CONTRADICTION * found.spread || 2 * agree < views.len() || agree < FEWEST {
        let (rms, spread) = (found.rms, found.spread);
        return Err(ModelAlignError::Contradiction { agree, of: views.len(), rms, spread });
    }
    let scale_ratio = match scale {
        Some(_) => Fit::new(&from, &to, SimilarityFreedom { scale: true, tilt }, seed, progress)?
            .map(|free| free.similarity.scale),
        None => None,
    };
    let inside: Vec<usize> = found.inliers.iter().map(|i| views[*i]).collect();
    let differ = views.iter().copied().filter(|v| !inside.contains(v)).collect();
    let (rms, spread) = (found.rms, found.spread);
    let centers = Some(CenterFit { agree: inside, differ, rms, spread, tilt, scale_ratio });
    Ok(ModelAlignment { similarity: after(&found.similarity, &base), metric: true, centers, distance_error })
}

/// A similarity of known centers.
struct Fit {
    similarity: Similarity,
    inliers: Vec<usize>,
    rms: f64,
    spread: f64,
}

impl Fit {
    /// `None` where the centers determine none; [`ModelAlignError::Contradiction`] where they have another shape.
    fn new(
        from: &[Point3<f64>],
        to: &[Point3<f64>],
        freedom: SimilarityFreedom,
        seed: u64,
        progress: &dyn Progress,
    ) -> Result<Option<Self>, ModelAlignError> {
        let around = median_distance(to);
        let estimate = |threshold: f64| {
            let options = RobustOptions { threshold, seed, ..RobustOptions::default() };
            match estimate_similarity(from, to, freedom, &options, progress) {
                Err(EstimateError::Cancelled(stop)) => Err(ModelAlignError::Cancelled(stop)),
                Err(EstimateError::NoConsensus { inliers: agree, .. }) => {
                    Err(ModelAlignError::Contradiction { agree, of: to.len(), rms: threshold, spread: around })
                }
                found => Ok(found.ok()),
            }
        };
        // Half of how far they are apart is what a contradiction is.
        let Some(wide) = estimate(CONTRADICTION * around.max(1e-9))? else { return Ok(None) };
        let mut errors: Vec<f64> = from.iter().zip(to).map(|(p, q)| (wide.model.transform(p) - q).norm()).collect();
        // Three numbers each, of which the similarity takes up some.
        let numbers = 3.0 * from.len() as f64;
        let free = 3.0 + if freedom.tilt { 3.0 } else { 1.0 } + f64::from(u8::from(freedom.scale));
        let deviation = median(&mut errors).unwrap_or(0.0) / MEDIAN_LENGTH * (numbers / (numbers - free)).sqrt();
        let threshold = (LONGEST * deviation).clamp(DRIFT * around, CONTRADICTION * around).max(1e-9);
        let Some(fine) = estimate(threshold)? else { return Ok(None) };
        let mean = fine.inliers.iter().map(|i| to[*i].coords).sum::<Vector3<f64>>() / fine.inliers.len() as f64;
        let square: f64 = fine.inliers.iter().map(|i| (to[*i].coords - mean).norm_squared()).sum();
        let spread = (square / fine.inliers.len() as f64).sqrt();
        Ok(Some(Self { similarity: fine.model, inliers: fine.inliers, rms: fine.rms, spread }))
    }

    /// Standard deviation of the turn that is known least, about the line that the centers are nearest to, in radians.
    fn tilt_deviation(&self, from: &[Point3<f64>]) -> f64 {
        let n = self.inliers.len() as f64;
        let mean = self.inliers.iter().map(|i| from[*i].coords).sum::<Vector3<f64>>() / n;
        let spread = self.inliers.iter().fold(Matrix3::zeros(), |sum, i| {
            let d = from[*i].coords - mean;
            sum + d * d.transpose()
        });
        let (values, _) = symmetric_eigen(&spread);
        // What is across the line, and the standard deviation of a coordinate, in the unit of what is known.
        let across = self.similarity.scale * (values[0] + values[1]).max(0.0).sqrt();
        let spare = (3.0 * n - 7.0).max(1.0);
        let deviation = self.rms * (n / spare).sqrt();
        deviation / across
    }
}

/// Median distance from the median of each coordinate.
fn median_distance(points: &[Point3<f64>]) -> f64 {
    let middle = Point3::from(
        [0, 1, 2].map(|k: usize| median(&mut points.iter().map(|p| p[k]).collect::<Vec<_>>()).unwrap_or(0.0)),
    );
    median(&mut points.iter().map(|p| (p - middle).norm()).collect::<Vec<_>>()).unwrap_or(0.0)
}

/// The scale of least squares by known distances, and the largest relative error of one.
fn scale_by(model: &SfmModel, distances: &[(usize, usize, f64)]) -> Result<(f64, f64), ModelAlignError> {
    let center = |view: usize| {
        let pose = model.poses.get(view).copied().flatten();
        pose.map(|pose| pose.center()).ok_or(ModelAlignError::NotInModel { view })
    };
    let mut pairs = Vec::with_capacity(distances.len());
    for (index, &(a, b, known)) in distances.iter().enumerate() {
        if !(known > 0.0 && known <= 1e12) {
            return Err(ModelAlignError::NotFinite { index });
        }
        let found = (center(a)? - center(b)?).norm();
        if found <= 1e-12 || found.is_nan() {
            return Err(ModelAlignError::NoDistance { a, b });
        }
        pairs.push((found, known));
    }
    // Relative errors count alike: a tape is read to a share of its length.
    let (mut product, mut square) = (0.0, 0.0);
    for (found, known) in &pairs {
        (product, square) = (product + found / known, square + (found / known).powi(2));
    }
    let scale = product / square;
    let error = pairs.iter().map(|(found, known)| (found * scale / known - 1.0).abs()).fold(0.0, f64::max);
    Ok((scale, error))
}

/// To a world with Z up and its origin at the first view that is in the model, which looks along Y.
fn upright_similarity(model: &SfmModel) -> Similarity {
    let poses: Vec<Pose> = model.poses.iter().flatten().copied().collect();
    let level = upright_frame(&poses);
    // (x, y, z) with Y down to (x, z, −y) with Z up.
    let stand = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0));
    Similarity { scale: 1.0, rotation: stand * level.rotation, translation: stand * level.translation }
}

/// The similarity that brings a model to poses that are known of its views, turns and places together: so two views are enough, on a line or not. `None` of fewer than two, and of those in one
/// place.
pub fn align_to_poses(model: &SfmModel, known: &[Option<Pose>]) -> Option<Similarity> {
    let both = model.poses.iter().zip(known).filter_map(|(found, known)| Some(((*found)?, (*known)?)));
    let both: Vec<(Pose, Pose)> = both.collect();
    let sum = both
        .iter()
        .fold(Matrix3::zeros(), |sum, (found, known)| sum + (known.rotation.inverse() * found.rotation).into_inner());
    let rotation = svd3(&sum).ok().filter(|svd| svd.s[1] > 1e-9)?.nearest_rotation();
    let mean = |of: fn(&(Pose, Pose)) -> Pose| {
        both.iter().map(|pair| of(pair).center().coords).sum::<Vector3<f64>>() / both.len() as f64
    };
    let (from, to) = (mean(|p| p.0), mean(|p| p.1));
    let (mut product, mut square) = (0.0, 0.0);
    for (found, known) in &both {
        let (p, q) = (rotation * (found.center().coords - from), known.center().coords - to);
        (product, square) = (product + p.dot(&q), square + p.norm_squared());
    }
    let scale = product / square;
    (both.len() >= 2 && scale > 0.0 && scale.is_finite()).then(|| Similarity {
        scale,
        rotation,
        translation: to - rotation * from * scale,
    })
}

fn scaled(of: &Similarity, by: f64) -> Similarity {
    Similarity { scale: of.scale * by, translation: of.translation * by, ..*of }
}

/// First `first`, then `second`.
fn after(second: &Similarity, first: &Similarity) -> Similarity {
    Similarity {
        scale: second.scale * first.scale,
        rotation: second.rotation * first.rotation,
        translation: second.transform(&Point3::from(first.translation)).coords,
    }
}

impl SfmModel {
    /// Moves poses and points to another frame: what the cameras see stays the same.
    pub fn transform(&mut self, to: &Similarity) {
        for pose in self.poses.iter_mut().flatten() {
            // x_cam = R p + t with p = R_sᵀ (q − t_s) / s, and s x_cam is the same pixel.
            let rotation = pose.rotation * to.rotation.inverse();
            *pose = Pose::new(rotation, pose.translation * to.scale - rotation * to.translation);
        }
        for point in &mut self.points {
            point.position = to.transform(&point.position);
        }
    }
}
