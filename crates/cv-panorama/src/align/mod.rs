//! Alignment: from verified pairs to the pose and intrinsics of every photograph.

mod bundle;
mod focal;
mod group;
mod metric;
mod refine;
mod straighten;
mod view;

pub use refine::refine_alignment;
pub(crate) use straighten::turn;
pub use view::View;

use cv_core::{Camera, Cancelled, Correspondence, Point2, Progress, Scaling, Stage, named};
use cv_geometry::VerifiedPair;
use group::Group;

/// A photograph's size and what is known of its intrinsics beforehand.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Photo {
    /// Width in pixels.
    pub width: usize,
    /// Height in pixels.
    pub height: usize,
    /// Prior focal length in pixels, from EXIF; refined by the adjustment.
    pub focal: Option<f64>,
    /// The calibrated camera; kept constant. Its size must be that of the photograph.
    pub camera: Option<Camera>,
}

impl Photo {
    /// A photograph of which only the size is known.
    pub fn new(width: usize, height: usize) -> Self {
        Self { width, height, focal: None, camera: None }
    }

    /// Returns whether two photographs share their intrinsics: equal size (in either orientation) and equal prior.
    pub(crate) fn shares_lens(&self, other: &Self) -> bool {
        let size = |p: &Self| (p.width.min(p.height), p.width.max(p.height));
        let same_hint = match (self.focal, other.focal) {
            (Some(a), Some(b)) => (a / b).ln().abs() < 0.01,
            (None, None) => true,
            _ => false,
        };
        size(self) == size(other) && same_hint && self.camera == other.camera
    }

    pub(crate) fn long_side(&self) -> f64 {
        self.width.max(self.height) as f64
    }

    /// Returns the focal length of the camera, that of EXIF, or the longer side: a field of view of 53°, a common wide-angle lens.
    pub(crate) fn expected_focal(&self) -> f64 {
        let known = self.camera.map(|c| c.fx).or(self.focal.filter(|f| f.is_finite() && *f > 0.0));
        known.unwrap_or_else(|| self.long_side())
    }
}

/// Motion model of the camera between photographs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum CameraMotion {
    /// [`Rotation`](Self::Rotation), unless [`Homography`](Self::Homography) has far smaller residuals.
    #[default]
    Auto,
    /// Rotation about the camera center.
    Rotation,
    /// Planar scene (a wall, a page, the ground from above) and arbitrary camera motion. The result is metrically rectified as far as the focal length is
    /// known; without, a field of view of 53 degrees is assumed, and a tilt common to all photographs remains.
    Homography,
}

named!(CameraMotion { Auto = "auto", Rotation = "rotation", Homography = "plane" | "homography" });

/// Options of [`align`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AlignOptions {
    /// Motion model. Default [`CameraMotion::Auto`].
    pub motion: CameraMotion,
    /// Scale of the Cauchy loss on transfer errors, in pixels, above 0. Default 2, the σ of Brown & Lowe's robust loss.
    pub outlier_px: f64,
    /// Estimate one radial distortion coefficient where no camera is given and it reduces the cost significantly. Default true.
    pub refine_distortion: bool,
    /// Level the result (wave correction). Default true; false keeps the frame of the reference photograph.
    pub straighten: bool,
}

impl Default for AlignOptions {
    fn default() -> Self {
        Self { motion: CameraMotion::Auto, outlier_px: 2.0, refine_distortion: true, straighten: true }
    }
}

/// Why photographs could not be aligned.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum AlignError {
    /// Fewer than two photographs.
    #[error("a panorama needs at least 2 photographs, got {got}")]
    TooFewPhotos {
        /// Photographs given.
        got: usize,
    },
    /// There is no verified pair.
    #[error("no two of the {photos} photographs overlap")]
    NoOverlap {
        /// Photographs given.
        photos: usize,
    },
    /// A pair has an index out of range, or twice the same.
    #[error("a pair names photographs {a} and {b} of {photos}")]
    BadPair {
        /// First of the pair.
        a: usize,
        /// Second of the pair.
        b: usize,
        /// Photographs given.
        photos: usize,
    },
    /// A photograph is empty, or its camera is invalid or of another size.
    #[error("photograph {index} is empty or its camera does not fit it")]
    BadPhoto {
        /// Which.
        index: usize,
    },
    /// The work was stopped by its progress callback.
    #[error(transparent)]
    Cancelled(#[from] Cancelled),
    /// No alignment is consistent with the matches.
    #[error("the overlaps of the {photos} photographs contradict each other")]
    Inconsistent {
        /// Photographs in the group.
        photos: usize,
    },
}

/// Why a photograph is not registered.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Unplaced {
    /// It has no verified pair.
    NoOverlap,
    /// It belongs to another, smaller component of the match graph.
    OtherComponent {
        /// Photographs in that component.
        size: usize,
    },
    /// Its pairs are inconsistent with the others.
    Inconsistent,
}

/// A pair that is consistent with the alignment.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignedPair {
    /// First photograph.
    pub a: usize,
    /// Second photograph.
    pub b: usize,
    /// Indices of the inliers among the tentative matches, as in [`VerifiedPair::inliers`].
    pub inliers: Vec<usize>,
    /// The matches, in pixels.
    pub matches: Vec<Correspondence>,
    /// Root mean square transfer error, in pixels.
    pub rms_px: f64,
}

/// Poses and intrinsics of all photographs.
#[derive(Debug, Clone)]
pub struct Alignment {
    /// The view of each photograph, or why it is not registered; one entry per input.
    pub views: Vec<Result<View, Unplaced>>,
    /// The photograph in the center of the match graph.
    pub reference: usize,
    /// [`CameraMotion::Rotation`] or [`CameraMotion::Homography`].
    pub motion: CameraMotion,
    /// The consistent pairs.
    pub pairs: Vec<AlignedPair>,
    /// Root mean square transfer error of all matches, in pixels, averaged over both directions.
    pub rms_px: f64,
    /// Median transfer error of all matches, in pixels.
    pub median_px: f64,
}

impl Alignment {
    /// Returns the alignment of the photographs resized: each scaled by its factor and then of the given size.
    ///
    /// Errors are scaled by the median factor of the registered photographs.
    pub fn resized(&self, sizes: &[(f64, (usize, usize))]) -> Self {
        let mut out = self.clone();
        for (view, (factor, size)) in out.views.iter_mut().zip(sizes) {
            if let Ok(view) = view {
                view.camera = view.camera.scaled(*factor);
                (view.camera.width, view.camera.height) = *size;
            }
        }
        let factor = |i: usize| sizes.get(i).map_or(1.0, |s| s.0);
        let place = |p, f| Scaling::uniform(f).point(p);
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

    /// Recomputes the errors of all matches.
    fn measure(&mut self) {
        let rms = |squares: &[f64]| (squares.iter().sum::<f64>() / squares.len().max(1) as f64).sqrt();
        let mut all = Vec::new();
        for pair in &mut self.pairs {
            let (Some(Ok(a)), Some(Ok(b))) = (self.views.get(pair.a), self.views.get(pair.b)) else { continue };
            let square =
                |from: &View, to: &View, p, q: Point2<f64>| Some((to.project(&from.ray(p)?)? - q).norm_squared());
            let both = |m: &Correspondence| Some(0.5 * (square(a, b, m.a, m.b)? + square(b, a, m.b, m.a)?));
            let squares: Vec<f64> = pair.matches.iter().filter_map(both).collect();
            pair.rms_px = rms(&squares);
            all.extend(squares);
        }
        self.rms_px = rms(&all);
        self.median_px = cv_core::median(&mut all).unwrap_or(0.0).sqrt();
    }

    /// Iterates over the registered photographs.
    pub fn used(&self) -> impl Iterator<Item = (usize, &View)> {
        self.views.iter().enumerate().filter_map(|(i, v)| v.as_ref().ok().map(|v| (i, v)))
    }
}

/// Median transfer error relative to the scale of the loss up to which an alignment is good: other models and sets of pairs are not tried.
const GOOD_FIT: f64 = 0.75;

/// Aligns photographs by their verified pairs: initialization along the spanning tree from the center of the match graph, bundle adjustment over all
/// overlaps with a robust loss, then leveling.
///
/// Registers the largest connected component. Focal lengths come from the cameras, the priors, or the homographies. Complexity
/// O(matches · iterations + photographs³). Reports as the stage "align", of unknown length.
///
/// # Errors
/// [`AlignError`].
pub fn align(
    photos: &[Photo],
    pairs: &[VerifiedPair],
    options: &AlignOptions,
    progress: &dyn Progress,
) -> Result<Alignment, AlignError> {
    let stage = Stage::new(progress, "align", 0)?;
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
    // Sorted: the result must not depend on the order of the input pairs.
    let mut pairs: Vec<&VerifiedPair> = pairs.iter().filter(|p| !p.matches.is_empty()).collect();
    pairs.sort_by_key(|p| (p.a.min(p.b), p.a.max(p.b)));
    let mut inconsistent = vec![false; n];
    loop {
        let mut group = Group::largest(photos, &pairs)?;
        let (mut solution, mut motion) = group.solve(options, &stage)?;
        let typical = group.median_error(motion, &solution);
        if typical > GOOD_FIT * options.outlier_px {
            // A false pair at the ends of a chain closes a circle that is none, and its residuals spread over all others.
            let kept = group.without_weak_closures();
            if kept.len() < group.pairs.len() {
                let open = Group::largest(photos, &kept)?;
                let (better, kind) = open.solve(options, &stage)?;
                if open.median_error(kind, &better) < 0.5 * typical {
                    (pairs, group, solution, motion) = (kept, open, better, kind);
                }
            }
        }
        let bad = group.worst_inconsistency(&solution, motion, options);
        if let Some(bad) = bad {
            // One at a time: a false pair raises the residuals of the pairs around it.
            let pair = group.pairs[bad];
            pairs.retain(|p| !std::ptr::eq(*p, pair));
            for i in [pair.a, pair.b] {
                inconsistent[i] = true;
            }
            continue;
        }
        let solution = if motion == CameraMotion::Homography { group.as_plan(solution) } else { solution };
        return group.finish(photos, &solution, motion, &inconsistent, options);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::StopAt;
    use cv_core::{Distortion, Matrix3, Point2, Silent, Vector2, Vector3};
    use nalgebra::Rotation3;

    /// Views turned by these yaws, pitches and rolls, at a focal length.
    fn views(turns: &[(f64, f64, f64)], focal: f64) -> Vec<View> {
        let turned = |&(yaw, pitch, roll): &(f64, f64, f64)| View {
            camera: Camera::from_focal(600, 400, focal),
            from_world: (Rotation3::from_axis_angle(&Vector3::z_axis(), roll)
                * Rotation3::from_axis_angle(&Vector3::x_axis(), pitch)
                * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw))
            .into_inner(),
        };
        turns.iter().map(turned).collect()
    }

    fn sweep() -> Vec<View> {
        views(&[(-0.5, 0.02, 0.01), (0.0, -0.03, 0.0), (0.45, 0.05, -0.02), (0.9, 0.0, 0.01)], 550.0)
    }

    /// Exact matches of what two views both see, a pixel of the first every 40; `None` where that is little.
    fn pair(a: usize, b: usize, views: &[View]) -> Option<VerifiedPair> {
        let grid =
            (0..10).flat_map(|y| (0..15).map(move |x| Point2::new(20.0 + 40.0 * x as f64, 20.0 + 40.0 * y as f64)));
        let seen = |p: Point2<f64>| {
            let q = views[b].project(&views[a].ray(p)?)?;
            views[b].contains(q).then_some(Correspondence { a: p, b: q })
        };
        let matches: Vec<Correspondence> = grid.filter_map(seen).collect();
        let h = views[b].camera.matrix()
            * views[b].from_world
            * views[a].from_world.try_inverse()?
            * views[a].camera.matrix().try_inverse()?;
        let inliers = (0..matches.len()).collect();
        (matches.len() > 20).then(|| VerifiedPair { a, b, homography: h / h[(2, 2)], inliers, matches })
    }

    fn pairs(views: &[View]) -> Vec<VerifiedPair> {
        let all = (0..views.len()).flat_map(|a| (a + 1..views.len()).map(move |b| (a, b)));
        all.filter_map(|(a, b)| pair(a, b, views)).collect()
    }

    fn photos(n: usize) -> Vec<Photo> {
        vec![Photo::new(600, 400); n]
    }

    /// Largest angle, in radians, between relative rotations as found and as they are.
    fn rotation_error(found: &Alignment, truth: &[View]) -> f64 {
        let used: Vec<(usize, &View)> = found.used().collect();
        let relative = |a: &View, b: &View| b.from_world * a.from_world.transpose();
        let errors =
            used.iter().flat_map(|&(i, a)| used.iter().map(move |&(j, b)| (i, a, j, b))).map(|(i, a, j, b)| {
                let off = relative(a, b) * relative(&truth[i], &truth[j]).transpose();
                // The angle from the skew part: exact for small ones.
                Vector3::new(off[(2, 1)], off[(0, 2)], off[(1, 0)]).norm()
            });
        errors.fold(0.0, f64::max)
    }

    #[test]
    fn exact_matches_give_the_views_back_with_their_focal_length() {
        let truth = sweep();
        let pairs = pairs(&truth);
        assert!(pairs.len() >= 3);
        let found = align(&photos(4), &pairs, &AlignOptions::default(), &Silent).unwrap();
        assert_eq!((found.motion, found.pairs.len(), found.used().count()), (CameraMotion::Rotation, pairs.len(), 4));
        // The prior on the focal length (0.7 in its logarithm, against hundreds of matches of 2 px) moves it by 1e-5 or so.
        assert!(rotation_error(&found, &truth) < 1e-4, "{}", rotation_error(&found, &truth));
        for (_, view) in found.used() {
            assert!((view.camera.fx / 550.0 - 1.0).abs() < 1e-3, "{}", view.camera.fx);
        }
        assert!(found.rms_px < 0.05 && found.median_px <= found.rms_px);
        // Level: the vertical of the world is seen as vertical but for what rolls and pitches leave open.
        let up = found.used().map(|(_, v)| v.from_world.column(1).y).fold(f64::INFINITY, f64::min);
        assert!(up > 0.99, "{up}");
    }

    #[test]
    fn photographs_that_overlap_with_none_or_few_say_so() {
        // Two that overlap each other far away from three others, and one alone.
        let turns =
            [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-1.6, 0.0, 0.0), (0.8, 0.0, 0.0), (3.3, 0.0, 0.0)];
        let truth = views(&turns, 550.0);
        let found = align(&photos(6), &pairs(&truth), &AlignOptions::default(), &Silent).unwrap();
        let used: Vec<usize> = found.used().map(|(i, _)| i).collect();
        assert_eq!(used, [0, 2, 4]);
        assert_eq!(found.reference, 2);
        assert_eq!(found.views[1], Err(Unplaced::OtherComponent { size: 2 }));
        assert_eq!(found.views[5], Err(Unplaced::OtherComponent { size: 2 }));
        assert_eq!(found.views[3], Err(Unplaced::NoOverlap));
    }

    #[test]
    fn a_false_pair_is_rejected_and_the_others_are_kept() {
        let truth = sweep();
        let mut pairs = pairs(&truth);
        // The first and the last, which show nothing in common, "match" like two neighbors: repeated windows.
        let mut wrong = pair(0, 1, &truth).unwrap();
        (wrong.a, wrong.b) = (0, 3);
        wrong.matches.truncate(30);
        let count = pairs.len();
        pairs.push(wrong);
        let found = align(&photos(4), &pairs, &AlignOptions::default(), &Silent).unwrap();
        assert_eq!((found.pairs.len(), found.used().count()), (count, 4));
        assert!(rotation_error(&found, &truth) < 1e-3, "{}", rotation_error(&found, &truth));
    }

    #[test]
    fn a_false_weak_pair_does_not_close_a_circle() {
        // Eight photographs over 270 degrees, and nine false matches between the first and the last, which would overlap at half of the focal length.
        let turns: Vec<(f64, f64, f64)> = (0..8).map(|i| (0.55 * f64::from(i) - 1.925, 0.0, 0.0)).collect();
        let truth = views(&turns, 600.0);
        let mut pairs: Vec<VerifiedPair> = (1..8).filter_map(|i| pair(i - 1, i, &truth)).collect();
        let near = views(&[(0.0, 0.0, 0.0), (0.55, 0.0, 0.0)], 600.0);
        let mut closing = pair(0, 1, &near).unwrap();
        (closing.a, closing.b) = (7, 0);
        closing.matches.truncate(9);
        closing.inliers.truncate(9);
        pairs.push(closing);
        let found = align(&photos(8), &pairs, &AlignOptions::default(), &Silent).unwrap();
        assert_eq!(found.pairs.len(), 7);
        assert!(rotation_error(&found, &truth) < 1e-3, "{}", rotation_error(&found, &truth));
        assert!((found.views[3].as_ref().unwrap().camera.fx - 600.0).abs() < 1.0);
    }

    #[test]
    fn a_planar_scene_is_distinguished_from_a_rotating_camera() {
        // A wall seen from three places: homographies that no rotation explains.
        let pose = |x: f64, skew: f64| Matrix3::new(1.0, 0.02, x, 0.01, 1.0, 0.0, skew, 0.0, 1.0);
        let truth: Vec<View> = [pose(0.0, 0.0), pose(-0.35, 0.15), pose(-0.7, -0.12)]
            .iter()
            .map(|m| View { camera: Camera::from_focal(600, 400, 550.0), from_world: *m })
            .collect();
        let pairs = pairs(&truth);
        assert!(pairs.len() >= 2);
        let found = align(&photos(3), &pairs, &AlignOptions::default(), &Silent).unwrap();
        assert_eq!(found.motion, CameraMotion::Homography);
        // Exact matches of exact homographies.
        assert!(found.rms_px < 0.01, "{}", found.rms_px);
        let forced = AlignOptions { motion: CameraMotion::Rotation, ..AlignOptions::default() };
        // (At several pixels a pair may also be left out as inconsistent.)
        let turned = align(&photos(3), &pairs, &forced, &Silent).unwrap();
        assert!(turned.rms_px > 1.0 || turned.used().count() < 3, "{}", turned.rms_px);
    }

    #[test]
    fn a_flat_map_of_twelve_views_is_a_plan_of_it() {
        // A map seen from a grid of 4 × 3 places at heights of 0.85 to 1.15, the camera tilted by up to ten degrees.
        let camera = Camera { distortion: Distortion::radial(-0.08, 0.01), ..Camera::from_focal(600, 400, 550.0) };
        let tilt = |k: usize, m: usize| 0.18 * (((k * m) % 7) as f64 / 3.0 - 1.0);
        let truth: Vec<View> = (0..12)
            .map(|k| {
                let r = Rotation3::from_euler_angles(tilt(k, 3), tilt(k, 5), 0.5 * tilt(k, 2)).into_inner();
                let from = Vector3::new(0.5 * (k % 4) as f64, 0.4 * (k / 4) as f64, -1.0 - 0.8 * tilt(k, 4));
                let to_camera = Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), -(r * from)]);
                View { camera, from_world: to_camera }
            })
            .collect();
        // Places of features on plain pictures are good to a tenth of a pixel: ±0.15.
        let mut state = 7_u32;
        let mut noise = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            0.3 * (f64::from(state >> 8) / f64::from(1 << 24) - 0.5)
        };
        let mut matched = pairs(&truth);
        for m in matched.iter_mut().flat_map(|p| &mut p.matches) {
            for p in [&mut m.a, &mut m.b] {
                (p.x, p.y) = (p.x + noise(), p.y + noise());
            }
        }
        let known = vec![Photo { camera: Some(camera), ..Photo::new(600, 400) }; 12];
        for motion in [CameraMotion::Auto, CameraMotion::Homography] {
            let options = AlignOptions { motion, ..AlignOptions::default() };
            let found = align(&known, &matched, &options, &Silent).unwrap();
            assert_eq!((found.motion, found.used().count()), (CameraMotion::Homography, 12));
            // Corners of all photographs on the plan and on the map, in pixels.
            let on_plane = |view: &View, corner: Point2<f64>| {
                let ray = view.ray(corner).unwrap();
                Vector2::new(ray.x / ray.z, ray.y / ray.z) * 550.0
            };
            let corners: Vec<(Vector2<f64>, Vector2<f64>)> = found
                .used()
                .flat_map(|(i, view)| view.border(1).into_iter().map(move |p| (i, *view, p)))
                .map(|(i, view, p)| (on_plane(&view, p), on_plane(&truth[i], p)))
                .collect();
            // The similarity that fits best, as complex numbers.
            let n = corners.len() as f64;
            let mean = corners.iter().fold((Vector2::zeros(), Vector2::zeros()), |m, c| (m.0 + c.0 / n, m.1 + c.1 / n));
            let (mut product, mut square) = (Vector2::zeros(), 0.0);
            for (a, b) in corners.iter().map(|c| (c.0 - mean.0, c.1 - mean.1)) {
                product += Vector2::new(a.dot(&b), a.x * b.y - a.y * b.x);
                square += a.norm_squared();
            }
            let turn = product / square;
            let drift = corners
                .iter()
                .map(|c| (c.0 - mean.0, c.1 - mean.1))
                .map(|(a, b)| (Vector2::new(turn.x * a.x - turn.y * a.y, turn.y * a.x + turn.x * a.y) - b).norm());
            let worst = drift.fold(0.0, f64::max);
            // The bar of panoramas of plans, in pixels of the photographs.
            assert!(worst < 1.0, "{motion:?}: {worst}");
            // As upright and as large as the photographs are.
            assert!((turn.norm() - 1.0).abs() < 0.1 && turn.y.abs() < 0.1, "{turn}");
        }
    }

    #[test]
    fn a_calibrated_camera_stays_constant_and_a_wrong_prior_is_corrected() {
        let truth = sweep();
        let pairs = pairs(&truth);
        let camera = truth[0].camera;
        let known: Vec<Photo> = photos(4).into_iter().map(|p| Photo { camera: Some(camera), ..p }).collect();
        let found = align(&known, &pairs, &AlignOptions::default(), &Silent).unwrap();
        assert!(found.used().all(|(_, v)| v.camera == camera));
        assert!(rotation_error(&found, &truth) < 1e-6);
        // A hint off by a third: hundreds of exact matches weigh more than a prior of 0.2.
        let hinted: Vec<Photo> = photos(4).into_iter().map(|p| Photo { focal: Some(750.0), ..p }).collect();
        let found = align(&hinted, &pairs, &AlignOptions::default(), &Silent).unwrap();
        assert!(found.used().all(|(_, v)| (v.camera.fx / 550.0 - 1.0).abs() < 0.01));
    }

    #[test]
    fn the_order_of_the_pairs_and_which_photograph_comes_first_in_them_change_nothing() {
        let truth = sweep();
        let one = pairs(&truth);
        let mut two = one.clone();
        two.reverse();
        let first = align(&photos(4), &one, &AlignOptions::default(), &Silent).unwrap();
        let second = align(&photos(4), &two, &AlignOptions::default(), &Silent).unwrap();
        assert_eq!(first.views, second.views);
    }

    #[test]
    fn resizing_keeps_directions_and_scales_errors() {
        let truth = sweep();
        let small = align(&photos(4), &pairs(&truth), &AlignOptions::default(), &Silent).unwrap();
        let large = small.resized(&[(2.5, (1500, 1000)); 4]);
        for ((_, a), (_, b)) in small.used().zip(large.used()) {
            assert_eq!((b.camera.width, b.camera.height), (1500, 1000));
            // Pixel centers at integers: (x + ½) scales.
            let (p, q) = (Point2::new(100.0, 300.0), Point2::new(100.5 * 2.5 - 0.5, 300.5 * 2.5 - 0.5));
            assert!((a.ray(p).unwrap() - b.ray(q).unwrap()).norm() < 1e-12);
        }
        assert!((large.rms_px - 2.5 * small.rms_px).abs() < 1e-12);
        assert!((large.pairs[0].matches[0].a.x - ((small.pairs[0].matches[0].a.x + 0.5) * 2.5 - 0.5)).abs() < 1e-9);
    }

    #[test]
    fn invalid_input_gives_typed_errors() {
        let truth = sweep();
        let pairs = pairs(&truth);
        let go = |photos: &[Photo], pairs: &[VerifiedPair]| {
            align(photos, pairs, &AlignOptions::default(), &Silent).unwrap_err()
        };
        assert_eq!(go(&photos(1), &[]), AlignError::TooFewPhotos { got: 1 });
        assert_eq!(go(&photos(3), &[]), AlignError::NoOverlap { photos: 3 });
        assert_eq!(go(&photos(2), &pairs), AlignError::BadPair { a: 1, b: 2, photos: 2 });
        let itself = VerifiedPair { b: 0, ..pairs[0].clone() };
        assert_eq!(go(&photos(4), &[itself]), AlignError::BadPair { a: 0, b: 0, photos: 4 });
        let mut empty = photos(4);
        empty[2].width = 0;
        assert_eq!(go(&empty, &pairs), AlignError::BadPhoto { index: 2 });
        let mut other = photos(4);
        other[1].camera = Some(Camera::from_focal(601, 400, 500.0));
        assert_eq!(go(&other, &pairs), AlignError::BadPhoto { index: 1 });
    }

    #[test]
    fn alignment_is_cancelled_at_any_report() {
        let truth = sweep();
        let pairs = pairs(&truth);
        let watched = StopAt::never();
        align(&photos(4), &pairs, &AlignOptions::default(), &watched).unwrap();
        assert!(watched.reports() >= 6);
        for at in 1..=watched.reports() {
            let stopped = align(&photos(4), &pairs, &AlignOptions::default(), &StopAt::report(at));
            assert_eq!(stopped.unwrap_err(), AlignError::Cancelled(Cancelled), "{at}");
        }
    }
}
