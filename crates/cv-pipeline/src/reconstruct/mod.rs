//! Points and camera poses from two photographs.

mod dense;
mod error;
mod model;

pub use dense::{DenseError, DenseOptions, DenseResult, reconstruct_dense};
pub use error::ReconstructError;

use crate::guided::{GuidedOptions, match_along_lines};
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
    /// Photographs whose longer side is above this are reduced to it before features are looked for, in pixels; positions are given in
    /// pixels of the photograph all the same. 8 or more; default 2400 (COLMAP's high quality); finer
    /// features are grain.
    pub max_size: usize,
    /// Whether features are matched once more along the epipolar lines when the motion is known, which finds those that look alike
    /// elsewhere (as COLMAP's guided matching does). Default true.
    pub guided: bool,
    /// What is known of the cameras, the search for the motion, and what is asked of the points.
    pub two_view: TwoViewOptions,
}

impl ReconstructOptions {
    /// The defaults, with what is known of the cameras.
    pub fn new(intrinsics: Intrinsics) -> Self {
        Self { two_view: TwoViewOptions { intrinsics, ..TwoViewOptions::default() }, ..Self::default() }
    }
}

impl Default for ReconstructOptions {
    fn default() -> Self {
        Self { matching: MatchingOptions::default(), max_size: 2400, guided: true, two_view: TwoViewOptions::default() }
    }
}

/// What [`reconstruct`] found.
#[derive(Debug, Clone, PartialEq)]
pub struct ReconstructResult {
    /// Features and tentative matches.
    pub matching: MatchingResult,
    /// Cameras, pose and points.
    pub scene: TwoViewReconstruction,
    /// Color of each of the scene's points in the first photograph.
    pub colors: Vec<[u8; 3]>,
    /// Stage names and their seconds.
    pub stages: Vec<(&'static str, f64)>,
}

impl ReconstructResult {
    /// Where a point of the scene was seen in the two photographs, in pixels.
    ///
    /// # Panics
    /// For a point of another scene.
    pub fn pair(&self, point: &TwoViewPoint) -> Correspondence {
        self.matching.pair(&self.scene.matches[point.match_index])
    }

    /// Whether an estimated focal length is known so badly that it is worth a word: the depth of the scene goes with it.
    pub fn focal_is_doubtful(&self) -> bool {
        // The error of a usual EXIF entry.
        self.scene.focal_deviation > 0.05
    }

    /// The points with their colors.
    pub fn cloud(&self) -> PointCloud {
        let positions = self.scene.points.iter().map(|p| p.position.coords.cast().into()).collect();
        PointCloud::colored(positions, self.colors.clone())
    }
}

/// Reconstructs what two photographs show: features, matches, and from those ([`TwoViewAdjustment`]) relative pose and points.
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
        let along = GuidedOptions { threshold, ..GuidedOptions::default() };
        let more = match_along_lines(fa, fb, adjustment.cameras(), &adjustment.fundamental(), &along, progress)?;
        clock.lap("guided");
        adjustment.add_matches(&more, progress)?;
        clock.lap("bundle");
    }
    progress.report("filter", 0, 1)?;
    let scene = adjustment.finish()?;
    let at = |p: &TwoViewPoint| color_at(a, matching.pair(&scene.matches[p.match_index]).a);
    let colors = scene.points.iter().map(at).collect();
    clock.lap("filter");
    Ok(ReconstructResult { matching, scene, colors, stages: clock.into_stages() })
}

/// The color of the pixel nearest to a position.
fn color_at(photo: ImageView<'_, u8, 3>, p: Point2<f64>) -> [u8; 3] {
    let near = |v: f64, n: usize| v.round().clamp(0.0, n.saturating_sub(1) as f64) as usize;
    photo.get(near(p.x, photo.width()), near(p.y, photo.height())).unwrap_or([0; 3])
}
