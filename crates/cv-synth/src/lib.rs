//! Ray-cast synthetic scenes with exact ground truth: realistic images of rooms and streets. For tests, measurements
//! and the demonstration; no algorithm of the workspace depends on it.
//!
//! ```
//! use cv_core::Camera;
//! use cv_synth::{RenderOptions, Scene, stereo_pair};
//!
//! let scene = Scene::tabletop(7);
//! let camera = Camera::from_focal(64, 48, 60.0);
//! let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.06, &RenderOptions::default())?;
//! let (depth, disparity) = (pair.left.depth.at(32, 40)[0], pair.disparity.at(32, 40)[0]);
//! assert!((disparity - 60.0 * 0.06 / depth).abs() < 1e-6);
//! # Ok::<(), cv_synth::SynthError>(())
//! ```
//!
//! * Scenes: [`Scene::room`], [`Scene::street`], [`Scene::tabletop`], [`Scene::ball`], [`Scene::poster_wall`], each
//!   with a layout by its seed; [`SceneBuilder`] for other scenes.
//! * Many views: [`Scene::room_walk`] and [`Scene::street_walk`] are poses to render; [`FeatureViews`] are keypoints
//!   and matches of any number of views, without images.
//! * One image: [`render`] with a [`cv_core::Camera`] (distortion included), a pose and [`RenderOptions`].
//! * Sets with ground truth: [`stereo_pair`], [`homography_pair`], [`panorama_views`], [`two_view`], [`ball_photos`];
//!   [`vista_photos`], a landscape of known radiance by a camera with a response curve, vignetting and noise.
//! * Images of one planar sheet, such as a calibration board: [`Sheet`], [`chessboard_photo`], [`photo_without_board`].
//! * Further ground truth: [`Scene::correspondences`], [`Scene::visible_in_both`], [`Scene::point_at`],
//!   [`Scene::pixel_of`], [`plane_homography`], [`rotation_homography`].
//! * Measures: [`homography_corner_error`], [`alignment_error`], [`rotation_error`], [`direction_error`],
//!   [`depth_score`], [`MaskScore`].
//! * Corrupted files, for robustness tests: [`corrupt`].
//! * The instruction sets that tests of vectorized code run with: [`instruction_sets`].
//!
//! # Conventions
//!
//! Those of `cv-core`: pixel centers at integers, y down, poses world to camera. Worlds are in meters with y down.
//! Ground truth is that of the ray through the pixel's center; colors are means over the pixel's area. The same seeds
//! give the same bytes with any number of threads.

mod bvh;
mod corrupt;
mod error;
mod feature_views;
mod font;
mod instruction_sets;
mod irradiance;
mod noise;
mod poster;
mod print;
mod render;
mod rng;
mod scene;
mod scenes;
mod score;
mod sensor;
mod sets;
mod shape;
mod sheet_photo;
mod texture;
mod truth;
mod vista;
mod world;

pub use corrupt::corrupt;
pub use error::SynthError;
pub use feature_views::{FeatureViews, FeatureViewsOptions};
pub use instruction_sets::instruction_sets;
pub use poster::Poster;
pub use print::Print;
pub use render::{Rendered, render};
pub use scene::{Scene, SceneBuilder};
pub use score::{
    DepthScore, MaskScore, alignment_error, depth_score, direction_error, homography_corner_error, rotation_error,
};
pub use sensor::{RenderOptions, encode_srgb};
pub use sets::{
    BallPhoto, HomographyPair, PanoramaSetOptions, PanoramaViews, StereoPair, TwoView, ball_photos, homography_pair,
    panorama_views, stereo_pair, two_view,
};
pub use sheet_photo::{ChessboardPhoto, ChessboardTrial, Sheet, chessboard_photo, photo_without_board};
pub use texture::{Collage, Rgb, Texture, srgb};
pub use truth::{plane_homography, rotation_homography};
pub use vista::{Vista, VistaOptions, VistaPhoto, vista_photos, vista_response};
