//! Two-view reconstruction: relative pose and points from two images.

mod dense;
mod error;
mod model;

pub use dense::{DenseError, DenseOptions, DenseResult, reconstruct_dense};
pub use error::ReconstructError;

use crate::guided::{GuidedOptions, match_epipolar};
use crate::matching::match_reduced;
use crate::{MatchingOptions, MatchingResult, Progress};
use cv_core::{Correspondence, ImageView, Point2, PointCloud, StageClock};
use cv_geometry::{
    Intrinsics, MatchedViews, TwoViewAdjustment, TwoViewOptions, TwoViewPoint, TwoViewReconstruction,
    estimate_two_view_geometry,
};

/// Settings of [`reconstruct`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct ReconstructOptions {
    /// Features and matches.
    pub matching: MatchingOptions,
    /// Images with a longer side above this are reduced to it for feature extraction, in pixels; positions are in
    /// pixels of the full image. 8 or more; default 2400 (COLMAP's high quality): finer features are noise.
    pub max_size: usize,
    /// Whether guided matching along the epipolar lines follows once the motion is known, which finds features that
    /// fail the ratio test (as in COLMAP). Default true.
    pub guided: bool,
    /// Knowledge of the cameras, estimation of the motion, and acceptance of the points.
    pub two_view: TwoViewOptions,
}

impl ReconstructOptions {
    /// Creates the default options for given intrinsics.
    pub fn new(intrinsics: Intrinsics) -> Self {
        Self { two_view: TwoViewOptions { intrinsics, ..TwoViewOptions::default() }, ..Self::default() }
    }
}

impl Default for ReconstructOptions {
    fn default() -> Self {
        Self { matching: MatchingOptions::default(), max_size: 2400, guided: true, two_view: TwoViewOptions::default() }
    }
}

/// Result of [`reconstruct`].
#[derive(Debug, Clone, PartialEq)]
pub struct ReconstructResult {
    /// Features and tentative matches.
    pub matching: MatchingResult,
    /// Cameras, pose and points.
    pub scene: TwoViewReconstruction,
    /// Color of each point in the first image.
    pub colors: Vec<[u8; 3]>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl ReconstructResult {
    /// Returns the two pixels of a point.
    ///
    /// # Panics
    /// For a point of another scene.
    pub fn pair(&self, point: &TwoViewPoint) -> Correspondence {
        self.matching.pair(&self.scene.matches[point.match_index])
    }

    /// Returns whether an estimated focal length has a large standard deviation: the depth of the scene scales with it.
    pub fn focal_is_doubtful(&self) -> bool {
        // The typical error of an EXIF focal length.
        self.scene.focal_deviation > 0.05
    }

    /// Returns the points with their colors.
    pub fn cloud(&self) -> PointCloud {
        let positions = self.scene.points.iter().map(|p| p.position.coords.cast().into()).collect();
        PointCloud::colored(positions, self.colors.clone())
    }
}

/// Reconstructs the scene of two images: features, matches, and from those ([`TwoViewAdjustment`]) relative pose and
/// points.
///
/// The world frame is that of the first camera, and its unit the baseline, since the scale is not observable.
///
/// # Errors
/// [`ReconstructError`].
pub fn reconstruct(
    a: ImageView<'_, u8, 3>,
    b: ImageView<'_, u8, 3>,
    options: &ReconstructOptions,
    progress: &dyn Progress,
) -> Result<ReconstructResult, ReconstructError> {
    let mut clock = StageClock::new();
    let sizes = [a.size(), b.size()];
    // Before the features, which take long.
    options.two_view.intrinsics.cameras(sizes)?;
    let matching = match_reduced([a, b], options.max_size, &options.matching, progress)?;
    for &(stage, seconds) in &matching.stages {
        clock.add(stage, seconds);
    }
    let [fa, fb] = &matching.features;
    let keypoints = [&fa.keypoints[..], &fb.keypoints];
    let views = MatchedViews { sizes, keypoints, matches: &matching.matches };
    let geometry = clock.time("pose", || estimate_two_view_geometry(&views, &options.two_view, progress))?;
    let mut adjustment =
        clock.time("bundle", || TwoViewAdjustment::new(&views, geometry, &options.two_view, progress))?;
    if options.guided {
        let threshold = options.two_view.robust.threshold as f32;
        let guided_options = GuidedOptions { threshold, ..GuidedOptions::default() };
        let guided_matches =
            match_epipolar(fa, fb, adjustment.cameras(), &adjustment.fundamental(), &guided_options, progress)?;
        clock.lap("guided");
        adjustment.add_matches(&guided_matches, progress)?;
        clock.lap("bundle");
    }
    progress.report("filter", 0, 1)?;
    let scene = adjustment.finish()?;
    let color_of = |p: &TwoViewPoint| color_at(a, matching.pair(&scene.matches[p.match_index]).a);
    let colors = scene.points.iter().map(color_of).collect();
    clock.lap("filter");
    Ok(ReconstructResult { matching, scene, colors, stages: clock.into_stages() })
}

/// Returns the color of the nearest pixel.
fn color_at(photo: ImageView<'_, u8, 3>, p: Point2<f64>) -> [u8; 3] {
    let nearest = |v: f64, n: usize| v.round().clamp(0.0, n.saturating_sub(1) as f64) as usize;
    photo.get(nearest(p.x, photo.width()), nearest(p.y, photo.height())).unwrap_or([0; 3])
}
