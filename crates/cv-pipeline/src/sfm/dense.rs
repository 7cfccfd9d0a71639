//! Dense point cloud of a multi-view model: depth maps of neighboring pairs, and their fusion.

use super::fusion::{ViewDepth, fuse, merge_depth_maps};
use crate::pair_depth::pair_depth;
use crate::{DenseError, DenseOptions, Progress};
use cv_core::{
    Camera, Cancelled, GrayF32, ImageView, OptionError, Point3, PointCloud, Pose, RgbU8, Stage, StageClock, StereoRig,
};
use cv_imgproc::resize_area;
use cv_sfm::SfmModel;
use std::collections::BTreeMap;

/// Settings of [`sfm_dense`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct SfmDenseOptions {
    /// Options of each pair. Default those of two images, with a longer side of at most 1200 px: each surface is
    /// observed by several pairs.
    pub pair: DenseOptions,
    /// Maximum number of photographs that each is matched with, 1 or more. Default 3.
    pub partners: usize,
    /// Range of the median triangulation angle of the common points of a pair, in radians. Default 3 to 25 degrees:
    /// below, depths are uncertain, above, the appearance changes.
    pub angles: [f64; 2],
    /// Largest relative difference of two consistent depths. Above 0; default 0.01.
    pub tolerance: f32,
}

impl Default for SfmDenseOptions {
    fn default() -> Self {
        Self {
            pair: DenseOptions { max_size: 1200, ..DenseOptions::default() },
            partners: 3,
            angles: [3f64.to_radians(), 25f64.to_radians()],
            tolerance: 0.01,
        }
    }
}

/// A reduced photograph for [`sfm_dense`].
#[derive(Debug, Clone, PartialEq)]
pub struct DensePhoto {
    /// Its camera, at the reduced size.
    pub(super) camera: Camera,
    pub(super) image: RgbU8,
}

impl DensePhoto {
    /// Reduces the photograph of a camera to a longer side of at most `max_size`.
    ///
    /// # Errors
    /// [`SfmDenseError::PhotoSize`] for a photograph that does not have the camera's size.
    pub fn new(photo: ImageView<'_, u8, 3>, camera: &Camera, max_size: usize) -> Result<Self, SfmDenseError> {
        let size_differs = SfmDenseError::PhotoSize { photo: photo.size(), camera: (camera.width, camera.height) };
        if photo.size() != (camera.width, camera.height) {
            return Err(size_differs);
        }
        let factor = (max_size as f64 / camera.width.max(camera.height) as f64).min(1.0);
        let side = |n: usize| ((n as f64 * factor).round() as usize).max(1);
        let camera = camera.resized(side(camera.width), side(camera.height));
        let image = resize_area(photo, camera.width, camera.height).map_err(|_| size_differs)?;
        Ok(Self { camera, image })
    }
}

/// Result of [`sfm_dense`].
#[derive(Debug, Clone, PartialEq)]
pub struct SfmDense {
    /// The points, with colors and normals, in the frame and unit of the model.
    pub cloud: PointCloud,
    /// Matched pairs by view index; the depth map is that of the first view.
    pub pairs: Vec<(usize, usize)>,
    /// Number of pairs that could not be matched.
    pub failed: usize,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why there is no dense cloud.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmDenseError {
    /// A photograph has another size than its camera.
    #[error("a photograph has {photo:?} pixels but its camera has {camera:?}")]
    PhotoSize {
        /// Its width and height.
        photo: (usize, usize),
        /// Width and height of the camera.
        camera: (usize, usize),
    },
    /// No two photographs share enough points with parallax.
    #[error("no two of {views} photographs share {needed} points with enough parallax")]
    NoPairs {
        /// Number of photographs of the model.
        views: usize,
        /// Number of common points that is needed.
        needed: usize,
    },
    /// None of the pairs can be matched.
    #[error("none of {pairs} pairs can be matched; the last one: {last}")]
    NoDepths {
        /// Number of pairs.
        pairs: usize,
        /// Error of the last one.
        last: DenseError,
    },
    /// No depth is confirmed by another pair.
    #[error("no depth of {pairs} pairs is confirmed by another pair")]
    NoAgreement {
        /// Number of matched pairs.
        pairs: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Minimum number of common points of a pair.
const MIN_SHARED_POINTS: usize = 20;
/// Triangulation angle in radians (8 degrees) up to which the score of a pair increases.
const SATURATION_ANGLE: f64 = 0.14;

/// Computes a dense point cloud of a model. Each photograph is rectified and matched semi-globally with those that
/// share most points at suitable triangulation angles ([`SfmDenseOptions`]). A depth is kept if another pair, of the
/// same photograph or of another one that observes the point, confirms it and free-space violations are no majority.
/// Duplicate points of several photographs are merged.
///
/// `photos` are by view; `None` if one is not in the model or not to be used. O(photographs · partners) stereo
/// matchings, and some bytes for each pixel of all photographs.
///
/// # Errors
/// [`SfmDenseError`].
pub fn sfm_dense(
    model: &SfmModel,
    photos: &[Option<DensePhoto>],
    options: &SfmDenseOptions,
    progress: &dyn Progress,
) -> Result<SfmDense, SfmDenseError> {
    OptionError::check("max_size", options.pair.max_size as f64, "at least 32 px", |v| v >= 32.0)?;
    OptionError::check("partners", options.partners as f64, "1 or more", |v| v >= 1.0)?;
    OptionError::check("tolerance", options.tolerance.into(), "above 0 and below 1", |v| v > 0.0 && v < 1.0)?;
    let mut clock = StageClock::new();
    let view_of = |v: usize| Some((photos.get(v)?.as_ref()?, model.poses.get(v).copied().flatten()?));
    let shared = shared_points(model, |v| view_of(v).is_some());
    let partners = select_partners(model.poses.len(), &shared, options);
    let total: usize = partners.iter().map(Vec::len).sum();
    if total == 0 {
        let views = (0..photos.len()).filter(|v| view_of(*v).is_some()).count();
        return Err(SfmDenseError::NoPairs { views, needed: MIN_SHARED_POINTS });
    }
    let stage = Stage::new(progress, "dense", total)?;
    let (mut pairs, mut last) = (Vec::new(), None);
    let mut views: Vec<Option<ViewDepth<'_>>> = Vec::with_capacity(photos.len());
    for (v, partners) in partners.iter().enumerate() {
        let Some((photo, pose)) = view_of(v) else {
            views.push(None);
            continue;
        };
        let mut maps: Vec<(usize, GrayF32)> = Vec::new();
        for &p in partners {
            let Some((other, other_pose)) = view_of(p) else { continue };
            let rig = StereoRig {
                left: photo.camera,
                right: other.camera,
                right_from_left: Pose::relative(&pose, &other_pose),
            };
            let common = shared.get(&(v.min(p), v.max(p))).map_or(&[][..], |s| &s.points);
            let positions: Vec<Point3<f64>> =
                common.iter().map(|i| pose.transform(&model.points[*i as usize].position)).collect();
            let images = [photo.image.view(), other.image.view()];
            match pair_depth(images, &rig, &positions, &options.pair, &stage) {
                Ok(pair) => {
                    maps.push((p, pair.depth_map(&photo.camera, &stage)?));
                    pairs.push((v, p));
                }
                Err(DenseError::Cancelled(stop)) => return Err(stop.into()),
                Err(error) => last = Some(error),
            }
            stage.add(1)?;
        }
        views.push(Some(merge_depth_maps(photo, pose, &maps, options.tolerance)));
    }
    clock.lap("dense_match");
    if let (true, Some(last)) = (pairs.is_empty(), last) {
        return Err(SfmDenseError::NoDepths { pairs: total, last });
    }
    let neighboring = neighbors(model.poses.len(), &pairs);
    let cloud = fuse(&views, &neighboring, options.tolerance, progress)?;
    if cloud.is_empty() {
        return Err(SfmDenseError::NoAgreement { pairs: pairs.len() });
    }
    clock.lap("dense_join");
    Ok(SfmDense { cloud, failed: total - pairs.len(), pairs, stages: clock.into_stages() })
}

/// Common points of a pair of views.
#[derive(Default)]
struct Shared {
    /// Indices of the points.
    points: Vec<u32>,
    /// Triangulation angle of each.
    angles: Vec<f64>,
}

/// Returns the common points of all pairs of usable views, with the smaller index first.
fn shared_points(model: &SfmModel, is_usable: impl Fn(usize) -> bool) -> BTreeMap<(usize, usize), Shared> {
    let mut shared: BTreeMap<(usize, usize), Shared> = BTreeMap::new();
    for (i, point) in model.points.iter().enumerate() {
        let rays: Vec<_> = point
            .observations
            .iter()
            .map(|o| o.view as usize)
            .filter(|v| is_usable(*v))
            .filter_map(|v| Some((v, point.position - model.poses[v]?.center())))
            .collect();
        for (k, a) in rays.iter().enumerate() {
            for b in &rays[..k] {
                let pair = shared.entry((a.0.min(b.0), a.0.max(b.0))).or_default();
                pair.points.push(i as u32);
                pair.angles.push(a.1.angle(&b.1));
            }
        }
    }
    shared
}

/// Selects the views that each view is matched with, best first.
fn select_partners(
    views: usize,
    shared: &BTreeMap<(usize, usize), Shared>,
    options: &SfmDenseOptions,
) -> Vec<Vec<usize>> {
    let mut candidates: Vec<Vec<(f64, usize)>> = vec![Vec::new(); views];
    for (&(a, b), common) in shared {
        let Some(angle) = cv_core::median(&mut common.angles.clone()) else { continue };
        if common.points.len() < MIN_SHARED_POINTS || angle < options.angles[0] || angle > options.angles[1] {
            continue;
        }
        let score = common.points.len() as f64 * (angle / SATURATION_ANGLE).min(1.0);
        candidates[a].push((score, b));
        candidates[b].push((score, a));
    }
    for list in &mut candidates {
        list.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        list.truncate(options.partners);
    }
    candidates.into_iter().map(|list| list.into_iter().map(|(_, v)| v).collect()).collect()
}

/// Returns the views that each view was matched with, in either direction.
fn neighbors(views: usize, pairs: &[(usize, usize)]) -> Vec<Vec<usize>> {
    let mut neighbors = vec![Vec::new(); views];
    for &(a, b) in pairs {
        neighbors[a].push(b);
        neighbors[b].push(a);
    }
    for list in &mut neighbors {
        list.sort_unstable();
        list.dedup();
    }
    neighbors
}
