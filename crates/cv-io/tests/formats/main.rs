//! Every file format through the public functions: files are written, read back, damaged and refused. One binary: each further one takes as long to
//! compile as its tests run.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod camera_positions;
mod cameras;
mod colmap;
mod colmap_binary;
mod colmap_text;
mod depth_png;
mod encode_dzi;
mod encode_exr;
mod encode_jpeg;
mod encode_rows;
mod encode_tiff;
mod features;
mod files;
mod image_exif;
mod image_memory;
mod images;
mod maps;
mod matches;
mod npy;
mod npz;
mod pfm;
mod ply;
mod samples;
mod transforms;
