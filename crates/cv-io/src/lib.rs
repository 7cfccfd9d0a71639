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
//! * File formats are detected by content, not by name.
//! * Readers take untrusted bytes: a false header is an error before memory is allocated, and nothing panics.
//! * The memory for reading a file is estimated from its header and checked against [`ReadOptions::max_memory`] before decoding.
//! * Writers are atomic ([`write_atomic`]), also for several files ([`write_together`]).
//! * An error has path, reason and remedy ([`IoError`]); the same reasons without a path are [`FormatError`].
//! * Invalid disparity and depth are NaN in memory, whatever the file's own marker.
//!
//! | what | where |
//! |---|---|
//! | images | [`read_rgb`], [`read_gray_u8`], [`read_mask`], [`read_image`], [`write_png`], [`write_jpeg`] |
//! | float maps | [`read_map`], [`pfm`], [`kitti`], [`depth_mm`], [`scaled`] |
//! | arrays | [`npy`], [`npz`] |
//! | point clouds | [`ply`] |
//! | cameras and rigs | [`read_camera`], [`write_camera`], [`read_rig`], [`write_rig`], [`read_camera_array`], [`write_camera_array`], [`CalibrationFormat`] |
//! | sparse models | [`colmap`], text and binary; [`write_transforms`] |
//! | matches | [`read_matches`], [`write_matches`] |
//! | camera positions | [`read_camera_positions`]; [`ExifInfo`] |

mod big_tiff;
mod camera;
mod camera_positions;
mod codec;
pub mod colmap;
mod depth_png;
mod encode;
mod encode_dzi;
mod encode_exr;
mod encode_jpeg;
mod encode_rows;
mod encode_tiff;
mod error;
mod exif_info;
mod features;
mod files;
mod format_detection;
mod image_file;
mod maps;
mod matches;
mod memory;
mod metadata;
pub mod npy;
pub mod npz;
mod pending_writes;
pub mod pfm;
pub mod ply;
mod sensor_width;
mod srgb_encoding;
mod transforms;

pub use camera::{
    ArrayCamera, CalibrationFormat, CalibrationNote, CameraArray, RigFile, parse_camera, parse_camera_array, parse_rig,
    read_camera, read_camera_array, read_camera_with_notes, read_rig, read_rig_with_notes, write_camera,
    write_camera_array, write_rig,
};
pub use camera_positions::{NamedPositions, parse_camera_positions, read_camera_positions};
pub use depth_png::{depth_mm, kitti, scaled};
pub use encode::{PngPixels, encode_png, encode_tiff, write_image, write_png, write_png_to_print, write_png_with};
pub use encode_dzi::check_deep_zoom;
pub use encode_exr::{encode_exr, write_exr};
pub use encode_jpeg::{JpegPixels, encode_jpeg, write_jpeg};
pub use encode_rows::{RowWriter, write_image_rows};
pub use error::{FormatError, IoError};
pub use exif_info::{ExifFocal, ExifGps, ExifInfo, FocalSource};
pub use features::{
    FeatureRows, descriptors_from_npy, descriptors_to_npy, keypoints_from_npy, keypoints_to_npy, parse_colmap_features,
    read_colmap_features, write_colmap_features,
};
pub use files::{MAX_FILE_BYTES, read_bytes, write_atomic, write_bytes};
pub use image_file::{
    DEFAULT_MAX_PIXELS, DynImage, ImageHeader, Pixels, ReadOptions, decode_image, read_gray_u8, read_image,
    read_image_header, read_image_info, read_image_with, read_mask, read_rgb,
};
pub use maps::{decode_map, read_map};
pub use matches::{Matches, parse_matches, read_matches, write_matches};
pub use memory::{DEFAULT_MAX_MEMORY, default_max_memory, set_default_max_memory};
pub use metadata::Metadata;
pub use pending_writes::{abandon_writes, remove_abandoned, write_together};
pub use transforms::{transforms_json, write_transforms};
