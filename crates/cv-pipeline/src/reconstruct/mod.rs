//! Points and camera poses from two photographs.

mod dense;
mod error;
mod initial;
mod lens;
mod neighbors;

pub use dense::{DenseError, DenseOptions, DenseResult, reconstruct_dense};
pub use error::ReconstructError;
use initial::{Initial, cameras, initial};
use neighbors::like_their_neighbors;

use crate::guided::{GuidedOptions, match_along_lines};
use crate::matching::match_reduced;
use crate::{MatchingOptions, MatchingResult, Progress, correspondences};
use cv_core::{
    Camera, Correspondence, ImageView, Matrix3, Point2, Point3, PointCloud, Pose, StageClock, Vector3, median,
};
use cv_features::SiftOptions;
use cv_geometry::{
    BundleOptions, BundleReport, RobustLoss, RobustOptions, TwoViewBundle, adjust_two_views, essential_from_pose,
    estimate_homography, normalize_matches, parallax_angle, pose_stability, rotation_between, triangulate,
};

/// What is known of the cameras.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Intrinsics {
    /// Both cameras are calibrated.
    Known([Camera; 2]),
    /// A focal length in pixels for each photograph, such as from EXIF; principal points in the middle;
    /// radial distortion is estimated where it shows.
    Focal([f64; 2]),
    /// One unknown focal length for both photographs; principal points in the middle; radial distortion is estimated where it shows.
    Unknown,
}

/// Settings of [`reconstruct`].
#[derive(Debug, Clone, PartialEq)]
pub struct ReconstructOptions {
    /// Features and matches. Default as of [`MatchingOptions`], but the coarsest SIFT features are kept, not the strongest.
    pub matching: MatchingOptions,
    /// Photographs whose longer side is above this are reduced to it before features are looked for, in pixels; positions are given in
    /// pixels of the photograph all the same. 8 or more; default 2400 (COLMAP's high quality); finer
    /// features are grain.
    pub max_size: usize,
    /// What is known of the cameras. Default unknown.
    pub intrinsics: Intrinsics,
    /// The search for the pose. The threshold is in pixels; default 2 px, three to four times what a SIFT point is good to.
    pub robust: RobustOptions,
    /// Fewest matches that must agree. Default 30, COLMAP's for a first pair being 100 and for any pair 15.
    pub min_inliers: usize,
    /// Smallest share of matches that must agree. 0 to 1; default 0.1: fewer may well agree by chance.
    pub min_inlier_share: f64,
    /// Smallest median angle between the two rays of a point, in radians. Default 0.5 degrees: depth is then known to a fifth
    /// or so, for a point good to half a pixel at a focal length of 1000 px.
    pub min_median_angle: f64,
    /// Largest standard deviation of the direction of the translation, in radians, and largest angle to another direction that the
    /// matches do not exclude. Default 3 degrees: beyond, depths along the motion are off by a tenth and more.
    pub max_deviation: f64,
    /// Smallest angle between the two rays of a point that is kept, in radians. Default 0.1 degrees.
    pub min_angle: f64,
    /// Largest reprojection error of a point that is kept, in pixels, in either photograph. Default 2 px.
    pub max_reprojection: f64,
    /// Whether features are matched once more along the epipolar lines when the motion is known, which finds those that look alike
    /// elsewhere (as COLMAP's guided matching does). Default true.
    pub guided: bool,
    /// A homography (or a rotation) that explains this share of the matches that agree makes the scene a plane (or the motion a
    /// turn). 0 to 1; default 0.95.
    pub degenerate_share: f64,
}

impl Default for ReconstructOptions {
    fn default() -> Self {
        Self {
            matching: MatchingOptions {
                sift: SiftOptions { coarse_first: true, ..SiftOptions::default() },
                ..MatchingOptions::default()
            },
            max_size: 2400,
            intrinsics: Intrinsics::Unknown,
            robust: RobustOptions { threshold: 2.0, ..RobustOptions::default() },
            min_inliers: 30,
            min_inlier_share: 0.1,
            min_median_angle: 0.5f64.to_radians(),
            max_deviation: 3f64.to_radians(),
            min_angle: 0.1f64.to_radians(),
            max_reprojection: 2.0,
            guided: true,
            degenerate_share: 0.95,
        }
    }
}

/// A reconstructed point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ScenePoint {
    /// In the first camera's frame; the unit is the distance between the cameras.
    pub position: Point3<f64>,
    /// Of the first photograph.
    pub color: [u8; 3],
    /// Where it was seen in the two photographs, in pixels.
    pub pair: Correspondence,
    /// Root mean square of its reprojection errors in the two photographs, in pixels.
    pub reprojection: f64,
    /// Angle between its two rays, in radians.
    pub angle: f64,
    /// Covariance of the position.
    pub covariance: Matrix3<f64>,
}

/// What [`reconstruct`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct ReconstructResult {
    /// Features and tentative matches.
    pub matching: MatchingResult,
    /// Indices of the matches that obey the epipolar geometry, ascending.
    pub inliers: Vec<usize>,
    /// Matches found along the epipolar lines at the depth of their neighbors, those of `inliers` that came back included; 0 where that was not
    /// asked for.
    pub guided: usize,
    /// The cameras, refined where they were not known.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// The points that were kept.
    pub points: Vec<ScenePoint>,
    /// Root mean square reprojection error of the points, over both photographs, in pixels.
    pub reprojection_rms: f64,
    /// Median angle between the two rays of a point, in radians.
    pub median_angle: f64,
    /// Standard deviations of the rotation and of the direction of the translation, in radians: the larger of what the residuals say
    /// and of what leaving out one part of the photograph after the other does ([`pose_stability`]).
    pub pose_deviation: [f64; 2],
    /// Relative standard deviation of the focal length; 0 where it was given.
    pub focal_deviation: f64,
    /// Share of the inliers that one homography explains.
    pub planar_share: f64,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl ReconstructResult {
    /// The fundamental matrix between undistorted pixels.
    pub fn fundamental(&self) -> Matrix3<f64> {
        fundamental_of(&self.cameras, &self.pose)
    }

    /// The points with their colors.
    pub fn cloud(&self) -> PointCloud {
        let position = |p: &ScenePoint| -> [f32; 3] { p.position.coords.cast().into() };
        let (positions, colors) = self.points.iter().map(|p| (position(p), p.color)).unzip();
        PointCloud::colored(positions, colors)
    }
}

/// Reconstructs what two photographs show: features, matches, relative pose, points.
///
/// The world is the first camera's frame and its unit the distance between the cameras, which photographs cannot tell.
///
/// # Errors
/// [`ReconstructError`], each with its numbers.
pub fn reconstruct(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    options: &ReconstructOptions,
    progress: &dyn Progress,
) -> Result<ReconstructResult, ReconstructError> {
    let mut clock = StageClock::new();
    let prior = cameras(options.intrinsics, [a.size(), b.size()])?;
    let matching = match_reduced([a, b], options.max_size, &options.matching, progress)?;
    for &(stage, seconds) in &matching.stages {
        clock.add(stage, seconds);
    }
    let pairs = &matching.pairs;
    if pairs.len() < options.min_inliers {
        return Err(ReconstructError::TooFewMatches { got: pairs.len(), needed: options.min_inliers });
    }
    progress.report("pose", 0, 1)?;
    let simple = clock.time("degeneracy", || Simple::new(pairs, prior.as_ref(), options));
    // Nothing can have more inliers than there are matches.
    simple.check(pairs.len(), options)?;
    let found = clock.time("pose", || initial(pairs, [a.size(), b.size()], prior, options));
    // Of a turn, a search for a moving camera finds but a part: half of the points are behind whatever it supposes.
    if let Err(
        ReconstructError::TooFewInliers { inliers, .. }
        | ReconstructError::UncertainPose { inliers, .. }
        | ReconstructError::WrongFocal { inliers, .. },
    ) = &found
    {
        simple.check(*inliers, options)?;
    }
    let Initial { cameras, pose, inliers, focal_range } = found?;
    simple.check(inliers.len(), options)?;
    let planar_share = simple.planar as f64 / inliers.len() as f64;
    let chosen: Vec<Correspondence> = inliers.iter().map(|&i| pairs[i]).collect();

    let too_few = |n| ReconstructError::TooFewInliers { inliers: n, matches: pairs.len(), needed: options.min_inliers };
    let settings = BundleOptions {
        refine_focal: prior.is_none(),
        // Where it was found to bend; the search knows k1 only, and not to its last digit.
        refine_radial: !matches!(options.intrinsics, Intrinsics::Known(_)),
        ..BundleOptions::default()
    };
    progress.report("points", 0, 1)?;
    let mut fit = clock.time("bundle", || fit(&chosen, cameras, pose, &settings)).ok_or_else(|| too_few(0))?;
    // Before the matches along the lines: those agree with the pose because they were looked for where it says.
    let (normalized, unit) = normalize_matches(&fit.observed, &fit.bundle.cameras[0], &fit.bundle.cameras[1]);
    let reach = options.robust.threshold * unit;
    let stability = clock.time("stability", || pose_stability(&fit.bundle.pose, &normalized, reach));
    let mut guided = 0;
    if options.guided {
        let [fa, fb] = &matching.features;
        let along = GuidedOptions { threshold: options.robust.threshold as f32, ..GuidedOptions::default() };
        let matches = match_along_lines(
            fa,
            fb,
            &fit.bundle.cameras,
            &fundamental_of(&fit.bundle.cameras, &fit.bundle.pose),
            &along,
        );
        clock.lap("guided");
        let more = correspondences(fa, fb, &matches);
        let TwoViewBundle { cameras, pose, points } = &fit.bundle;
        let more = like_their_neighbors(&more, &fit.observed, points, cameras, pose);
        guided = more.len();
        // Fewer would mean that the first matches were not what the lines say.
        if more.len() > chosen.len()
            && let Some(better) = fit_again(&more, &fit, &settings)
        {
            fit = better;
        }
        clock.lap("bundle");
    }
    let Fit { bundle, observed, report } = fit;
    let pose_deviation = [0, 1].map(|i| stability[i].max(report.pose_deviation[i]));
    let focal = bundle.cameras[0].fx;
    let focal_deviation = report.focal_deviation.max(focal_range / 2.0);
    if prior.is_none() {
        let side = [a, b].map(|photo| photo.width().max(photo.height())).into_iter().max().unwrap_or(0);
        ReconstructError::check_focal(focal, focal_deviation, side)?;
    }

    let mut scene = Vec::new();
    for (j, (point, m)) in bundle.points.iter().zip(&observed).enumerate() {
        let Some(errors) = reprojection(&bundle, point, m) else { continue };
        let angle = parallax_angle(point, &bundle.pose);
        if angle >= options.min_angle && errors.iter().all(|e| *e <= options.max_reprojection) {
            scene.push(ScenePoint {
                position: *point,
                color: color_at(a, m.a),
                pair: *m,
                reprojection: ((errors[0] * errors[0] + errors[1] * errors[1]) / 2.0).sqrt(),
                angle,
                covariance: report.covariances[j],
            });
        }
    }
    if scene.len() < options.min_inliers {
        return Err(too_few(scene.len()));
    }
    let mut angles: Vec<f64> = scene.iter().map(|p| p.angle).collect();
    let median_angle = median(&mut angles).unwrap_or(0.0);
    if median_angle < options.min_median_angle {
        return Err(ReconstructError::LittleParallax {
            degrees: median_angle.to_degrees(),
            needed: options.min_median_angle.to_degrees(),
        });
    }
    if pose_deviation[1] > options.max_deviation {
        return Err(ReconstructError::UncertainPose {
            degrees: pose_deviation[1].to_degrees(),
            allowed: options.max_deviation.to_degrees(),
            inliers: scene.len(),
            matches: pairs.len().max(guided),
        });
    }
    let squares: f64 = scene.iter().map(|p| p.reprojection * p.reprojection).sum();
    clock.lap("filter");
    Ok(ReconstructResult {
        inliers,
        guided,
        cameras: bundle.cameras,
        pose: bundle.pose,
        reprojection_rms: (squares / scene.len() as f64).sqrt(),
        points: scene,
        median_angle,
        pose_deviation,
        focal_deviation,
        planar_share,
        matching,
        stages: clock.into_stages(),
    })
}

/// The fundamental matrix between undistorted pixels.
fn fundamental_of([a, b]: &[Camera; 2], pose: &Pose) -> Matrix3<f64> {
    b.inverse_matrix().transpose() * essential_from_pose(pose) * a.inverse_matrix()
}

/// A bundle, what it was fitted to, and how well.
struct Fit {
    bundle: TwoViewBundle,
    observed: Vec<Correspondence>,
    report: BundleReport,
}

/// Triangulates and adjusts; `None` where nothing can be triangulated.
fn fit(matches: &[Correspondence], cameras: [Camera; 2], pose: Pose, settings: &BundleOptions) -> Option<Fit> {
    let (normalized, _) = normalize_matches(matches, &cameras[0], &cameras[1]);
    let seen = |(m, n): (&Correspondence, &Correspondence)| Some((*m, triangulate(n, &pose).ok()?));
    let (observed, points): (Vec<_>, Vec<_>) = matches.iter().zip(&normalized).filter_map(seen).unzip();
    let mut bundle = TwoViewBundle { cameras, pose, points };
    let report = adjust_two_views(&mut bundle, &observed, settings)?;
    if !settings.refine_focal {
        return Some(Fit { bundle, observed, report });
    }
    // Once more with the noise that these matches have, for which a pixel may be wide: what is near but wrong shows in the focal length first.
    let seen = bundle.points.iter().zip(&observed).filter_map(|(x, m)| reprojection(&bundle, x, m));
    let mut errors: Vec<f64> = seen.flatten().collect();
    let median = median(&mut errors).unwrap_or(1.0);
    // The median of an absolute normal error is 0.6745 deviations; Cauchy's loss is 95 % as good as least squares on such errors at 2.385 of them (Huber & Ronchetti,
    // "Robust statistics", 2009).
    let loss = RobustLoss::Cauchy { scale: (2.385 / 0.6745 * median).clamp(0.1, 1.0) };
    let report = adjust_two_views(&mut bundle, &observed, &BundleOptions { loss, ..*settings })?;
    Some(Fit { bundle, observed, report })
}

/// [`fit`] from the pose and cameras of an earlier one.
fn fit_again(matches: &[Correspondence], before: &Fit, settings: &BundleOptions) -> Option<Fit> {
    fit(matches, before.bundle.cameras, before.bundle.pose, settings)
}

/// What simpler explanations than a moving camera and a scene with depth make of the matches.
struct Simple {
    /// Matches that one homography explains.
    planar: usize,
    /// Whether the cameras are known, so that a turn can be told from a plane.
    calibrated: bool,
    /// Matches that a rotation explains, and its angle in degrees; needs cameras.
    turned: usize,
    degrees: f64,
}

impl Simple {
    fn new(pairs: &[Correspondence], cameras: Option<&[Camera; 2]>, options: &ReconstructOptions) -> Self {
        // Distances in two dimensions and two photographs, where the epipolar one is in one.
        let reach = 2.0 * options.robust.threshold;
        let straight: Vec<Correspondence> = match cameras {
            Some([a, b]) => pairs
                .iter()
                .map(|m| Correspondence { a: a.undistort_pixel(m.a), b: b.undistort_pixel(m.b) })
                .filter(Correspondence::is_finite)
                .collect(),
            None => pairs.to_vec(),
        };
        let robust = RobustOptions { threshold: reach, ..options.robust };
        let mut simple = Self { planar: 0, calibrated: cameras.is_some(), turned: 0, degrees: 0.0 };
        let Ok(h) = estimate_homography(&straight, &robust) else { return simple };
        simple.planar = h.inliers.len();
        if let Some([a, b]) = cameras {
            let on_plane: Vec<Correspondence> = h.inliers.iter().map(|&i| straight[i]).collect();
            let pinhole = |c: &Camera| Camera::pinhole(c.width, c.height, c.fx, c.fy, c.cx, c.cy);
            let (normalized, unit) = normalize_matches(&on_plane, &pinhole(a), &pinhole(b));
            if let Ok((rotation, share)) = rotation_between(&normalized, reach * unit) {
                simple.turned = (share * on_plane.len() as f64).round() as usize;
                simple.degrees = Pose::new(rotation, Vector3::zeros()).rotation_angle().to_degrees();
            }
        }
        simple
    }

    /// Names a camera that only turned and a scene that is one plane, beside `inliers` matches that a general motion explains.
    fn check(&self, inliers: usize, options: &ReconstructOptions) -> Result<(), ReconstructError> {
        let share = |n: usize| (n as f64 / inliers.max(1) as f64).min(1.0);
        let enough = |n: usize| n >= options.min_inliers && share(n) >= options.degenerate_share;
        if enough(self.turned) {
            return Err(ReconstructError::PureRotation { share: share(self.turned), degrees: self.degrees });
        }
        if enough(self.planar) {
            let share = share(self.planar);
            return Err(if self.calibrated {
                ReconstructError::Planar { share }
            } else {
                ReconstructError::PlanarOrTurned { share }
            });
        }
        Ok(())
    }
}

/// Reprojection errors in pixels in both photographs; `None` behind a camera.
fn reprojection(bundle: &TwoViewBundle, point: &Point3<f64>, m: &Correspondence) -> Option<[f64; 2]> {
    let first = bundle.cameras[0].project(point)?;
    let second = bundle.cameras[1].project(&bundle.pose.transform(point))?;
    Some([(first - m.a).norm(), (second - m.b).norm()])
}

/// The color of the pixel nearest to a position.
fn color_at(photo: ImageView<'_, u8, 3>, p: Point2<f64>) -> [u8; 3] {
    let near = |v: f64, n: usize| v.round().clamp(0.0, n.saturating_sub(1) as f64) as usize;
    photo.get(near(p.x, photo.width()), near(p.y, photo.height())).unwrap_or([0; 3])
}
