//! Alignment of a model to external measurements: the vertical, the metric scale, known camera centers.

use crate::SfmModel;
use cv_core::{Cancelled, Matrix3, Point3, Pose, Progress, Rotation3, Vector3, median, upright_frame};
use cv_geometry::{EstimateError, RobustOptions, Similarity, SimilarityFreedom, estimate_similarity};
use cv_numeric::{svd3, symmetric_eigen};

/// Measurements of camera centers from a source other than the images, such as GPS or a tape.
#[derive(Debug, Clone, Copy, Default)]
pub struct KnownPlaces<'a> {
    /// Camera center of each view, in one unit (meters), with X and Y horizontal and Z up. Empty: none is known.
    pub centers: &'a [Option<Point3<f64>>],
    /// Pairs of views with the measured distance of their camera centers, in the same unit.
    pub distances: &'a [(usize, usize, f64)],
}

/// The alignment of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct ModelAlignment {
    /// From the model's frame to the new one, which has Z up.
    pub similarity: Similarity,
    /// Whether the new frame has the unit of the measurements; else the scale is unchanged.
    pub metric: bool,
    /// Fit of the known centers; `None` where there are none.
    pub centers: Option<CenterFit>,
    /// Largest relative error of a known distance; `None` where there are none.
    pub distance_error: Option<f64>,
}

/// Fit of known camera centers to a model.
#[derive(Debug, Clone, PartialEq)]
pub struct CenterFit {
    /// Inliers: views of the model whose known center agrees, ascending.
    pub inliers: Vec<usize>,
    /// Outliers: the other views with a known center.
    pub outliers: Vec<usize>,
    /// Root mean square distance of the inliers from their known centers.
    pub rms: f64,
    /// Root mean square distance of the inliers' known centers from their mean.
    pub spread: f64,
    /// Whether the known centers determine the tilt. Collinear centers do not; the vertical then comes from the images.
    pub tilt: bool,
    /// Ratio of the scale by the centers to that by the known distances, where both are known.
    pub scale_ratio: Option<f64>,
}

/// Why a model cannot be aligned to the measurements.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum ModelAlignError {
    /// Fewer than three views of the model have a known center.
    #[error("{got} views of the model have a known center, {needed} are needed")]
    TooFew {
        /// Views with a known center.
        got: usize,
        /// Number that is needed.
        needed: usize,
    },
    /// Degenerate configuration: the known centers coincide, or are all on one vertical line.
    #[error("the known centers coincide or are on one vertical line")]
    OnePlace,
    /// The known centers do not have the shape of the model's centers.
    #[error("{agree} of {of} known centers agree with the model, with an rms error of {rms} at a spread of {spread}")]
    Contradiction {
        /// Inliers of the best alignment.
        agree: usize,
        /// Number of known centers.
        of: usize,
        /// Root mean square error of the inliers, or an upper bound of it.
        rms: f64,
        /// Root mean square distance of the inliers' known centers from their mean.
        spread: f64,
    },
    /// A view with a known distance is not in the model.
    #[error("view {view} has a known distance but is not in the model")]
    NotInModel {
        /// Index of the view.
        view: usize,
    },
    /// Two views with a known distance have the same center in the model.
    #[error("views {a} and {b} have a known distance but coincide in the model")]
    NoDistance {
        /// Index of the first view.
        a: usize,
        /// Index of the second view.
        b: usize,
    },
    /// A known center or distance is not finite, too large, or a distance is not positive.
    #[error("known center or distance {index} is out of range")]
    NotFinite {
        /// Index of the view, or of the distance.
        index: usize,
    },
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Minimum number of known centers: the minimal sample of a similarity.
const MIN_CENTERS: usize = 3;
/// Largest rms error of the known centers, as a ratio of their spread: at 0.5 the model explains three quarters of the
/// variance. Random centers with an error as large as the scene pass at any scale without it.
const MAX_RMS_RATIO: f64 = 0.5;
/// Largest standard deviation of the tilt by known centers, in radians. Above it the vertical is taken from the images,
/// whose mean camera roll and pitch are about this accurate.
const MAX_TILT_SIGMA: f64 = 0.05;
/// Median of the χ distribution with three degrees of freedom: the median length of an isotropic normal error, in
/// standard deviations of a coordinate.
const CHI3_MEDIAN: f64 = 1.5382;
/// Inlier threshold in standard deviations of a coordinate. 99 % of inliers are below 3.37; the rest allows for the
/// error of a standard deviation that is estimated from a dozen centers (a quarter).
const THRESHOLD_SIGMAS: f64 = 5.0;
/// Smallest inlier threshold as a ratio of the spread: the drift of the model itself (kitti-2: 2.5 %).
const MIN_THRESHOLD_RATIO: f64 = 0.01;

/// Estimates the similarity from a model's frame to that of the measurements. The vertical comes from the images
/// ([`upright_frame`]), the scale from known distances, or all of it from known centers.
///
/// Known centers (GPS errors are of meters, with gross outliers) are fitted by a robust similarity
/// ([`estimate_similarity`]) whose threshold is estimated from the residuals. Collinear centers, as along a street,
/// leave the rotation about their line free; the images' vertical then fixes it. Known distances alone set the scale
/// where there are some. Without measurements: upright, the first view at the origin, looking along Y.
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
            let (scale, error) = fit_scale(model, distances)?;
            (Some(scale), Some(error))
        }
    };
    let base = scale_similarity(&base, scale.unwrap_or(1.0));
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
    if views.len() < MIN_CENTERS {
        return Err(ModelAlignError::TooFew { got: views.len(), needed: MIN_CENTERS });
    }
    let align = |tilt: bool| {
        CenterAlignment::estimate(&from, &to, SimilarityFreedom { scale: scale.is_none(), tilt }, seed, progress)
    };
    let fit = match align(true)? {
        Some(fit) if fit.tilt_sigma(&from) <= MAX_TILT_SIGMA => Some((fit, true)),
        _ => align(false)?.map(|fit| (fit, false)),
    };
    let (fit, tilt) = fit.ok_or(ModelAlignError::OnePlace)?;
    let agree = fit.inliers.len();
    if fit.rms > MAX_RMS_RATIO * fit.spread || 2 * agree < views.len() || agree < MIN_CENTERS {
        let (rms, spread) = (fit.rms, fit.spread);
        return Err(ModelAlignError::Contradiction { agree, of: views.len(), rms, spread });
    }
    let scale_ratio = match scale {
        Some(_) => CenterAlignment::estimate(&from, &to, SimilarityFreedom { scale: true, tilt }, seed, progress)?
            .map(|free| free.similarity.scale),
        None => None,
    };
    let inliers: Vec<usize> = fit.inliers.iter().map(|i| views[*i]).collect();
    let outliers = views.iter().copied().filter(|v| !inliers.contains(v)).collect();
    let (rms, spread) = (fit.rms, fit.spread);
    let centers = Some(CenterFit { inliers, outliers, rms, spread, tilt, scale_ratio });
    Ok(ModelAlignment { similarity: compose(&fit.similarity, &base), metric: true, centers, distance_error })
}

/// A similarity fitted to known centers.
struct CenterAlignment {
    similarity: Similarity,
    inliers: Vec<usize>,
    rms: f64,
    spread: f64,
}

impl CenterAlignment {
    /// Estimates the similarity from `from` to `to`. `None` for a degenerate configuration.
    ///
    /// # Errors
    /// [`ModelAlignError::Contradiction`] without consensus, [`ModelAlignError::Cancelled`].
    fn estimate(
        from: &[Point3<f64>],
        to: &[Point3<f64>],
        freedom: SimilarityFreedom,
        seed: u64,
        progress: &dyn Progress,
    ) -> Result<Option<Self>, ModelAlignError> {
        let median_spread = median_spread(to);
        let estimate = |threshold: f64| {
            let options = RobustOptions { threshold, seed, ..RobustOptions::default() };
            match estimate_similarity(from, to, freedom, &options, progress) {
                Err(EstimateError::Cancelled(stop)) => Err(ModelAlignError::Cancelled(stop)),
                Err(EstimateError::NoConsensus { inliers: agree, .. }) => {
                    Err(ModelAlignError::Contradiction { agree, of: to.len(), rms: threshold, spread: median_spread })
                }
                fitted => Ok(fitted.ok()),
            }
        };
        let Some(coarse) = estimate(MAX_RMS_RATIO * median_spread.max(1e-9))? else { return Ok(None) };
        let mut errors: Vec<f64> = from.iter().zip(to).map(|(p, q)| (coarse.model.transform(p) - q).norm()).collect();
        // Three equations for each center, less the parameters of the similarity.
        let equations = 3.0 * from.len() as f64;
        let parameters = 3.0 + if freedom.tilt { 3.0 } else { 1.0 } + f64::from(u8::from(freedom.scale));
        let sigma = median(&mut errors).unwrap_or(0.0) / CHI3_MEDIAN * (equations / (equations - parameters)).sqrt();
        let threshold = (THRESHOLD_SIGMAS * sigma)
            .clamp(MIN_THRESHOLD_RATIO * median_spread, MAX_RMS_RATIO * median_spread)
            .max(1e-9);
        let Some(fine) = estimate(threshold)? else { return Ok(None) };
        let mean = fine.inliers.iter().map(|i| to[*i].coords).sum::<Vector3<f64>>() / fine.inliers.len() as f64;
        let square: f64 = fine.inliers.iter().map(|i| (to[*i].coords - mean).norm_squared()).sum();
        let spread = (square / fine.inliers.len() as f64).sqrt();
        Ok(Some(Self { similarity: fine.model, inliers: fine.inliers, rms: fine.rms, spread }))
    }

    /// Returns the standard deviation of the least certain rotation, the one about the line that best fits the centers,
    /// in radians.
    fn tilt_sigma(&self, from: &[Point3<f64>]) -> f64 {
        let n = self.inliers.len() as f64;
        let mean = self.inliers.iter().map(|i| from[*i].coords).sum::<Vector3<f64>>() / n;
        let scatter = self.inliers.iter().fold(Matrix3::zeros(), |sum, i| {
            let d = from[*i].coords - mean;
            sum + d * d.transpose()
        });
        let (values, _) = symmetric_eigen(&scatter);
        // Extent across that line, in the unit of the measurements.
        let across = self.similarity.scale * (values[0] + values[1]).max(0.0).sqrt();
        let degrees_of_freedom = (3.0 * n - 7.0).max(1.0);
        let sigma = self.rms * (n / degrees_of_freedom).sqrt();
        sigma / across
    }
}

/// Returns the median distance from the component-wise median.
fn median_spread(points: &[Point3<f64>]) -> f64 {
    let center = Point3::from(
        [0, 1, 2].map(|k: usize| median(&mut points.iter().map(|p| p[k]).collect::<Vec<_>>()).unwrap_or(0.0)),
    );
    median(&mut points.iter().map(|p| (p - center).norm()).collect::<Vec<_>>()).unwrap_or(0.0)
}

/// Returns the scale by least squares on known distances, and the largest relative error of a distance.
fn fit_scale(model: &SfmModel, distances: &[(usize, usize, f64)]) -> Result<(f64, f64), ModelAlignError> {
    let center = |view: usize| {
        let pose = model.poses.get(view).copied().flatten();
        pose.map(|pose| pose.center()).ok_or(ModelAlignError::NotInModel { view })
    };
    let mut pairs = Vec::with_capacity(distances.len());
    for (index, &(a, b, known)) in distances.iter().enumerate() {
        if !(known > 0.0 && known <= 1e12) {
            return Err(ModelAlignError::NotFinite { index });
        }
        let estimated = (center(a)? - center(b)?).norm();
        if estimated <= 1e-12 || estimated.is_nan() {
            return Err(ModelAlignError::NoDistance { a, b });
        }
        pairs.push((estimated, known));
    }
    // Relative errors are minimized: the error of a tape is proportional to its length.
    let (mut product, mut square) = (0.0, 0.0);
    for (estimated, known) in &pairs {
        (product, square) = (product + estimated / known, square + (estimated / known).powi(2));
    }
    let scale = product / square;
    let error = pairs.iter().map(|(estimated, known)| (estimated * scale / known - 1.0).abs()).fold(0.0, f64::max);
    Ok((scale, error))
}

/// Returns the similarity to a frame with Z up and its origin at the first view of the model, which looks along Y.
fn upright_similarity(model: &SfmModel) -> Similarity {
    let poses: Vec<Pose> = model.poses.iter().flatten().copied().collect();
    let level = upright_frame(&poses);
    // (x, y, z) with Y down becomes (x, z, −y) with Z up.
    let z_up = Rotation3::from_matrix_unchecked(Matrix3::new(1.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.0, -1.0, 0.0));
    Similarity { scale: 1.0, rotation: z_up * level.rotation, translation: z_up * level.translation }
}

/// Estimates the similarity from a model's frame to that of known poses of its views, from rotations and centers
/// together: two views are enough, collinear or not. `None` for fewer than two, or coincident centers.
pub fn align_to_poses(model: &SfmModel, known: &[Option<Pose>]) -> Option<Similarity> {
    let pairs = model.poses.iter().zip(known).filter_map(|(estimated, known)| Some(((*estimated)?, (*known)?)));
    let pairs: Vec<(Pose, Pose)> = pairs.collect();
    let sum = pairs.iter().fold(Matrix3::zeros(), |sum, (estimated, known)| {
        sum + (known.rotation.inverse() * estimated.rotation).into_inner()
    });
    let rotation = svd3(&sum).ok().filter(|svd| svd.s[1] > 1e-9)?.nearest_rotation();
    let mean = |of: fn(&(Pose, Pose)) -> Pose| {
        pairs.iter().map(|pair| of(pair).center().coords).sum::<Vector3<f64>>() / pairs.len() as f64
    };
    let (from, to) = (mean(|p| p.0), mean(|p| p.1));
    let (mut product, mut square) = (0.0, 0.0);
    for (estimated, known) in &pairs {
        let (p, q) = (rotation * (estimated.center().coords - from), known.center().coords - to);
        (product, square) = (product + p.dot(&q), square + p.norm_squared());
    }
    let scale = product / square;
    (pairs.len() >= 2 && scale > 0.0 && scale.is_finite()).then(|| Similarity {
        scale,
        rotation,
        translation: to - rotation * from * scale,
    })
}

fn scale_similarity(of: &Similarity, by: f64) -> Similarity {
    Similarity { scale: of.scale * by, translation: of.translation * by, ..*of }
}

/// Returns the composition: first `first`, then `second`.
fn compose(second: &Similarity, first: &Similarity) -> Similarity {
    Similarity {
        scale: second.scale * first.scale,
        rotation: second.rotation * first.rotation,
        translation: second.transform(&Point3::from(first.translation)).coords,
    }
}

impl SfmModel {
    /// Transforms poses and points to another frame. The projections stay the same.
    pub fn transform(&mut self, to: &Similarity) {
        for pose in self.poses.iter_mut().flatten() {
            // x_cam = R p + t with p = R_sᵀ (q − t_s) / s; s x_cam projects to the same pixel.
            let rotation = pose.rotation * to.rotation.inverse();
            *pose = Pose::new(rotation, pose.translation * to.scale - rotation * to.translation);
        }
        for point in &mut self.points {
            point.position = to.transform(&point.position);
        }
    }
}
