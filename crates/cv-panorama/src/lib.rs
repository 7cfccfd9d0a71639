//! Image stitching: alignment, projection, exposure compensation, seam finding and blending of overlapping photographs.
//!
//! Takes matches, never detectors: `cv-pipeline` joins the two. From tentative matches to the panorama in three steps,
//! [`verify_pair`], [`align`], [`render`]:
//!
//! ```
//! use cv_core::{Correspondence, RgbU8, Silent};
//! use cv_panorama::{AlignOptions, CameraMotion, Photo, CompositingOptions, VerifyOptions, align, render, verify_pair};
//!
//! // Two windows of one image, 60 pixels apart; matches on a grid.
//! let scene = |x: usize, y: usize| [(x * 2 % 256) as u8, (y * 3 % 256) as u8, ((x * y) % 256) as u8];
//! let left = RgbU8::from_fn(160, 120, scene);
//! let right = RgbU8::from_fn(160, 120, |x, y| scene(x + 60, y));
//! let matches: Vec<_> = (0..60)
//!     .map(|i| (65.0 + f64::from(i % 10) * 9.0, 5.0 + f64::from(i / 10) * 20.0))
//!     .map(|(x, y)| Correspondence::new(x, y, x - 60.0, y))
//!     .collect();
//!
//! let pair = verify_pair((0, left.size()), (1, right.size()), &matches, &VerifyOptions::default())?;
//! let photos = [Photo::new(160, 120), Photo::new(160, 120)];
//! let options = AlignOptions { motion: CameraMotion::Homography, ..AlignOptions::default() };
//! let alignment = align(&photos, &[pair], &options, &Silent)?;
//! let panorama = render(&[left.view(), right.view()], &alignment, &CompositingOptions::default(), &Silent)?;
//! assert!(panorama.image.width().abs_diff(220) <= 1 && alignment.rms_px < 0.01);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Conventions
//!
//! * A [`View`] maps world rays to a photograph's pixels: `pixel ~ camera(from_world · ray)`. World frame: X right, Y down, Z toward the
//!   center of the panorama.
//! * The result does not depend on the order of photographs and pairs, up to rounding.
//! * The same input and options give the same bytes at any number of threads.

mod align;
mod bit_depth;
mod blend;
mod brackets;
mod compensation;
mod masks;
mod photometric;
mod regions;
mod registration;
mod render;
mod rows;
mod seams;
mod stream;
mod surface;
#[cfg(test)]
mod testing;

pub use align::{
    AlignError, AlignOptions, AlignedPair, Alignment, CameraMotion, Photo, Unplaced, View, align, refine_alignment,
};
pub use bit_depth::{EightBits, PhotoSample};
pub use blend::{BlendMode, Blender, Composition, NO_PHOTO};
pub use cv_geometry::{PairRejection, VerifiedPair, VerifyOptions, verify_pair};
pub use cv_imgproc::Interpolation;
pub use masks::{PhotoMask, PhotoUse};
pub use photometric::{Exposure, Gains};
pub use registration::{Pto, PtoError, Registration, RegistrationError};
pub use render::{CompositingOptions, Panorama, RenderError, check_masks, render, render_masked, render_with};
pub use seams::Seams;
pub use stream::{
    Layer, MemoryLimit, NotWritten, PhotoSource, RowSink, ScratchFile, StreamError, StreamedFrame, render_streamed,
};
pub use surface::{Bounds, Canvas, Framing, LayoutError, PhotoMap, Projection, WarpedPhoto};
