//! Files of float maps.

use crate::frame::{Context, Explain, Failure, MAP, Output};
use cv_core::{GrayF32, ImageView};
use cv_io::FormatError;
use std::path::Path;

/// Writes a map in the format of its extension; PNG files by `png`. Returns the number of values outside the range of the format, if any.
pub(super) fn write_map<'m>(
    context: &Context,
    path: &Path,
    map: ImageView<'m, f32, 1>,
    png: impl FnOnce(&Path, ImageView<'m, f32, 1>) -> Result<usize, cv_io::IoError>,
) -> Result<Option<usize>, Failure> {
    let lost = context.write(Output::File(path, MAP), |path| {
        match path.extension().unwrap_or_default().to_string_lossy().to_lowercase().as_str() {
            "npy" => cv_io::npy::write(path, &cv_io::npy::NpyArray::from_view(map)).map(|()| 0),
            "png" => png(path, map),
            _ => cv_io::pfm::write(path, map).map(|()| 0),
        }
    })?;
    Ok(Some(lost).filter(|&lost| lost > 0))
}

/// Reads a disparity map: PFM, npy, npz, KITTI PNG, or with `scale` an image of gray value / scale.
pub(crate) fn read_map(path: &Path, scale: Option<f64>) -> Result<GrayF32, Failure> {
    let map = match path.extension().unwrap_or_default().to_string_lossy().to_lowercase().as_str() {
        "pfm" => cv_io::pfm::read(path)?,
        "npy" => gray(path, cv_io::npy::read(path)?.into_gray())?,
        "npz" => gray(path, cv_io::npz::read_single(path)?.into_gray())?,
        // Images, whatever their extension.
        _ => {
            return match scale {
                Some(scale) => Ok(cv_io::scaled::read(path, scale)?),
                None => cv_io::kitti::read(path).map_err(|error| {
                    let too_large = matches!(error.reason, FormatError::TooMuchMemory { .. });
                    let failure = Failure::from(error);
                    if too_large {
                        failure
                    } else {
                        failure.advice("for other images give the scale (--truth-scale, --estimate-scale)")
                    }
                }),
            };
        }
    };
    Ok(match scale {
        Some(scale) => map.map(|[v]| [(f64::from(v) / scale) as f32]),
        None => map,
    })
}

fn gray(path: &Path, map: Result<GrayF32, FormatError>) -> Result<GrayF32, Failure> {
    map.during(format!("cannot read {}", path.display()))
}
