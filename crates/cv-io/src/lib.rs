//! Reading and writing images, disparity and depth maps, clouds, cameras and matches.
//!
//! ```
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! # let folder = tempfile::tempdir()?;
//! # let path = folder.path().join("red.png");
//! let red = cv_core::RgbU8::new(4, 3, [255, 0, 0]);
//! cv_io::write_png(&path, red.view())?;
//! assert_eq!(cv_io::read_rgb(&path)?, red);
//!
//! let error = cv_io::read_rgb(folder.path().join("blue.png")).unwrap_err();
//! assert!(error.to_string().contains("blue.png"));
//! # Ok(()) }
//! ```
//!
//! # Conventions
//!
//! * What a file is, its content says, not its name.
//! * Every reader is given untrusted bytes: a lie in a header is an error before memory is asked for, and nothing panics.
//! * What reading a file will take is judged by its header against [`ReadOptions::max_memory`] before a pixel or value exists.
//! * Every writer is atomic ([`write_atomic`]): the whole file, or what was there before; several files likewise ([`write_together`]).
//! * A failure says which file, why, and what to try ([`IoError`]); the same reasons without a path are [`FormatError`].
//! * Unknown disparity and depth are NaN in memory, whatever the file's own sign for it.
//!
//! | what | where |
//! |---|---|
//! | pictures | [`read_rgb`], [`read_gray_u8`], [`read_mask`], [`read_image`], [`write_png`], [`write_jpeg`] |
//! | maps of floats | [`read_map`], [`pfm`], [`kitti`], [`depth_mm`], [`scaled`] |
//! | arrays | [`npy`], [`npz`] |
//! | clouds | [`ply`] |
//! | cameras and rigs | [`read_camera`], [`write_camera`], [`read_rig`], [`write_rig`], [`read_camera_array`], [`write_camera_array`], [`CalibrationFormat`] |
//! | sparse models | [`colmap`], text and binary; [`write_transforms`] |
//! | matches | [`read_matches`], [`write_matches`] |
//! | where photographs were taken | [`read_places`]; [`ExifInfo`] |

mod camera;
mod codec;
pub mod colmap;
mod depth_png;
mod encode;
mod encode_exr;
mod encode_tiff;
mod error;
mod exif_info;
mod features;
mod files;
mod maps;
mod matches;
mod memory;
mod metadata;
pub mod npy;
pub mod npz;
mod pending;
pub mod pfm;
mod picture;
mod places;
pub mod ply;
mod sensor_width;
mod sniff;
mod srgb;
mod transforms;

pub use camera::{
    ArrayCamera, CalibrationFormat, CalibrationNote, CameraArray, RigFile, parse_camera, parse_camera_array, parse_rig,
    read_camera, read_camera_array, read_camera_with_notes, read_rig, read_rig_with_notes, write_camera,
    write_camera_array, write_rig,
};
pub use depth_png::{depth_mm, kitti, scaled};
pub use encode::{
    JpegPixels, PngPixels, encode_jpeg, encode_png, encode_tiff, write_image, write_jpeg, write_png,
    write_png_to_print, write_png_with,
};
pub use encode_exr::{encode_exr, write_exr};
pub use error::{FormatError, IoError};
pub use exif_info::{ExifFocal, ExifGps, ExifInfo, FocalSource};
pub use features::{
    FeatureRows, descriptors_from_npy, descriptors_to_npy, keypoints_from_npy, keypoints_to_npy, parse_colmap_features,
    read_colmap_features, write_colmap_features,
};
pub use files::{MAX_FILE_BYTES, read_bytes, write_atomic, write_bytes};
pub use maps::{decode_map, read_map};
pub use matches::{Matches, parse_matches, read_matches, write_matches};
pub use memory::{DEFAULT_MAX_MEMORY, default_max_memory, set_default_max_memory};
pub use metadata::Metadata;
pub use pending::{abandon_writes, remove_abandoned, write_together};
pub use picture::{
    DEFAULT_MAX_PIXELS, DynImage, Pixels, ReadOptions, decode_image, read_gray_u8, read_image, read_image_info,
    read_image_with, read_mask, read_rgb,
};
pub use places::{NamedPlaces, parse_places, read_places};
pub use transforms::{transforms_json, write_transforms};
