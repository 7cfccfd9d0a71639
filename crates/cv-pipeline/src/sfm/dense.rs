//! A dense cloud of a model of many views: depths of neighboring pairs, joined where pairs agree.

use super::fusion::{ViewDepth, fuse, joined};
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
    /// How each pair is matched. Default that of two photographs, but for a longer side of 1200 px: each surface is seen by several pairs.
    pub pair: DenseOptions,
    /// Photographs that each one is matched with at the most, 1 or more. Default 3.
    pub partners: usize,
    /// Smallest and largest median angle between the rays of the points that two photographs share, in radians, for them to be matched. Default 3 and 25 degrees: depths are uncertain below, and
    /// things look different above.
    pub angles: [f64; 2],
    /// Largest relative difference of two depths that agree. Above 0; default 0.01.
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

/// A photograph for [`sfm_dense`], reduced.
#[derive(Debug, Clone, PartialEq)]
pub struct DensePhoto {
    /// Its camera, of the reduced photograph.
    pub(super) camera: Camera,
    pub(super) image: RgbU8,
}

impl DensePhoto {
    /// The photograph of a camera, its longer side reduced to `max_size`.
    ///
    /// # Errors
    /// [`SfmDenseError::PhotoSize`] for a photograph that is not of the camera's size.
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

/// What [`sfm_dense`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct SfmDense {
    /// The points, with colors and normals, in the frame and unit of the model.
    pub cloud: PointCloud,
    /// Pairs of photographs that were matched, by the views of each: the first one's depths.
    pub pairs: Vec<(usize, usize)>,
    /// Pairs that could not be matched: one camera ahead of the other, or hardly anything confirmed.
    pub failed: usize,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

/// Why there is no dense cloud of many views.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum SfmDenseError {
    /// A photograph has another size than its camera.
    #[error("a photograph has {photo:?} pixels where its camera has {camera:?}")]
    PhotoSize {
        /// Its width and height.
        photo: (usize, usize),
        /// The camera's.
        camera: (usize, usize),
    },
    /// No two photographs see the same from different enough places.
    #[error("no two of {views} photographs share {needed} points at an angle that depths can be told from")]
    NoPairs {
        /// Photographs of the model that are given.
        views: usize,
        /// Points that are needed.
        needed: usize,
    },
    /// None of the pairs can be matched.
    #[error("none of {pairs} pairs can be matched; the last one: {last}")]
    NoDepths {
        /// Pairs that were tried.
        pairs: usize,
        /// Why not.
        last: DenseError,
    },
    /// No two pairs agree on anything.
    #[error("no depth of {pairs} pairs is confirmed by another pair")]
    NoAgreement {
        /// Pairs that were matched.
        pairs: usize,
    },
    /// An option is out of range.
    #[error(transparent)]
    Option(#[from] OptionError),
    /// The job was stopped by its progress callback.
    #[error("stopped")]
    Cancelled(#[from] Cancelled),
}

/// Fewest points that two photographs share to be matched.
const SHARED: usize = 20;
/// Angle up to which more of it makes a better pair, in radians: 8 degrees.
const WIDE_ENOUGH: f64 = 0.14;

/// A dense cloud of a model's views: each photograph is rectified and matched semi-globally with those that share most points with it at an angle that tells depths
/// ([`SfmDenseOptions`]), and a depth stays where another pair of photographs says the same, of the same photograph or of another one that sees the place, and where not more photographs see
/// through it. Of the places that several photographs show one point is kept.
///
/// `photos` are by view; `None` where one is not in the model, or is to be left out. O(photographs · partners) matches of a pair, and some bytes for each pixel of all photographs.
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
    let given = |v: usize| Some((photos.get(v)?.as_ref()?, model.poses.get(v).copied().flatten()?));
    let shared = shared_points(model, |v| given(v).is_some());
    let partners = partners(model.poses.len(), &shared, options);
    let total: usize = partners.iter().map(Vec::len).sum();
    if total == 0 {
        let views = (0..photos.len()).filter(|v| given(*v).is_some()).count();
        return Err(SfmDenseError::NoPairs { views, needed: SHARED });
    }
    let stage = Stage::new(progress, "dense", total)?;
    let (mut pairs, mut last) = (Vec::new(), None);
    let mut views: Vec<Option<ViewDepth<'_>>> = Vec::with_capacity(photos.len());
    for (v, of) in partners.iter().enumerate() {
        let Some((photo, pose)) = given(v) else {
            views.push(None);
            continue;
        };
        let mut maps: Vec<(usize, GrayF32)> = Vec::new();
        for &p in of {
            let Some((other, other_pose)) = given(p) else { continue };
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
        views.push(Some(joined(photo, pose, &maps, options.tolerance)));
    }
    clock.lap("dense_match");
    if let (true, Some(last)) = (pairs.is_empty(), last) {
        return Err(SfmDenseError::NoDepths { pairs: total, last });
    }
    let near = neighbors(model.poses.len(), &pairs);
    let cloud = fuse(&views, &near, options.tolerance, progress)?;
    if cloud.is_empty() {
        return Err(SfmDenseError::NoAgreement { pairs: pairs.len() });
    }
    clock.lap("dense_join");
    Ok(SfmDense { cloud, failed: total - pairs.len(), pairs, stages: clock.into_stages() })
}

/// What two views have in common.
#[derive(Default)]
struct Shared {
    /// Indices of points.
    points: Vec<u32>,
    /// The angle between the rays of each.
    angles: Vec<f64>,
}

/// Of each two views that count, the first by index first.
fn shared_points(model: &SfmModel, counts: impl Fn(usize) -> bool) -> BTreeMap<(usize, usize), Shared> {
    let mut shared: BTreeMap<(usize, usize), Shared> = BTreeMap::new();
    for (i, point) in model.points.iter().enumerate() {
        let rays: Vec<_> = point
            .observations
            .iter()
            .map(|o| o.view as usize)
            .filter(|v| counts(*v))
            .filter_map(|v| Some((v, point.position - model.poses[v]?.center())))
            .collect();
        for (k, a) in rays.iter().enumerate() {
            for b in &rays[..k] {
                let of = shared.entry((a.0.min(b.0), a.0.max(b.0))).or_default();
                of.points.push(i as u32);
                of.angles.push(a.1.angle(&b.1));
            }
        }
    }
    shared
}

/// The views that each one is matched with, the best first.
fn partners(views: usize, shared: &BTreeMap<(usize, usize), Shared>, options: &SfmDenseOptions) -> Vec<Vec<usize>> {
    let mut candidates: Vec<Vec<(f64, usize)>> = vec![Vec::new(); views];
    for (&(a, b), of) in shared {
        let Some(angle) = cv_core::median(&mut of.angles.clone()) else { continue };
        if of.points.len() < SHARED || angle < options.angles[0] || angle > options.angles[1] {
            continue;
        }
        let score = of.points.len() as f64 * (angle / WIDE_ENOUGH).min(1.0);
        candidates[a].push((score, b));
        candidates[b].push((score, a));
    }
    for list in &mut candidates {
        list.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        list.truncate(options.partners);
    }
    candidates.into_iter().map(|list| list.into_iter().map(|(_, v)| v).collect()).collect()
}

/// The views that each one was matched with, from either side.
fn neighbors(views: usize, pairs: &[(usize, usize)]) -> Vec<Vec<usize>> {
    let mut near = vec![Vec::new(); views];
    for &(a, b) in pairs {
        near[a].push(b);
        near[b].push(a);
    }
    for list in &mut near {
        list.sort_unstable();
        list.dedup();
    }
    near
}
