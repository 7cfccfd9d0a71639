//! The dense cloud of the largest model.

use super::photographs::Photograph;
use crate::frame::{CLOUD, Context, Failure, Output};
use crate::words;
use cv_core::Stage;
use cv_io::ply::PlyEncoding;
use cv_pipeline::many_views::SfmModel;
use cv_pipeline::{DensePhoto, SfmDense, SfmDenseOptions, SfmPhoto, sfm_dense};
use std::path::{Path, PathBuf};

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Dense cloud")]
pub(super) struct DenseArgs {
    /// Where to write a dense cloud of the largest model, with colors and normals, as PLY: every photograph is matched densely with its neighbors, and points confirmed by two pairs are kept.
    #[arg(long, value_name = "FILE")]
    dense: Option<PathBuf>,
    /// Longer side in pixels to which the photographs are downscaled for it.
    #[arg(long, value_name = "PX", default_value_t = SfmDenseOptions::default().pair.max_size, requires = "dense")]
    dense_size: usize,
}

impl DenseArgs {
    pub(super) fn path(&self) -> Option<&Path> {
        self.dense.as_deref()
    }

    /// Computes and writes the cloud, if requested. `used` are the photographs of the model's views.
    pub(super) fn write(
        &self,
        model: &SfmModel,
        photos: &[SfmPhoto],
        all: &[Photograph],
        used: &[usize],
        context: &Context,
    ) -> Result<Option<SfmDense>, Failure> {
        let Some(path) = &self.dense else { return Ok(None) };
        let mut options = SfmDenseOptions::default();
        options.pair.max_size = self.dense_size;
        let stage = Stage::new(context, "reduce", photos.len())?;
        let mut downscaled = Vec::with_capacity(photos.len());
        for ((photo, pose), at) in photos.iter().zip(&model.poses).zip(used) {
            stage.add(1)?;
            downscaled.push(match pose {
                Some(_) => {
                    let image = cv_io::read_rgb(&all[*at].path)?;
                    Some(DensePhoto::new(image.view(), &model.cameras[photo.camera], self.dense_size)?)
                }
                None => None,
            });
        }
        let dense = sfm_dense(model, &downscaled, &options, context).map_err(words::many_views::no_dense_cloud)?;
        let write = |path: &Path| cv_io::ply::write_cloud(path, &dense.cloud, PlyEncoding::Binary);
        context.write(Output::File(path, CLOUD), write)?;
        Ok(Some(dense))
    }
}
