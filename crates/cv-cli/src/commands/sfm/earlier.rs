//! `--from`: an earlier model of some of the photographs, which a run continues.

use super::photographs::Photograph;
use super::places::Frame;
use crate::frame::{Context, Explain, Failure};
use cv_core::{Camera, Pose, SparseModel};
use cv_io::colmap;
use cv_pipeline::many_views::{SfmModel, align_to_poses};
use serde_json::json;
use std::path::{Path, PathBuf};

/// Poses and cameras of an earlier model, by photograph.
pub(super) struct Earlier {
    folder: PathBuf,
    model: SparseModel,
    /// Of each photograph: the id of its camera in the model, and its pose.
    views: Vec<Option<(u32, Pose)>>,
}

/// Largest logarithm of the ratio of a photograph's EXIF focal length to that of a camera of the model at which the camera is taken to be the same (constant zoom).
const MAX_LOG_FOCAL_RATIO: f64 = 0.1;

impl Earlier {
    pub(super) fn read(folder: &Path, all: &[Photograph], context: &Context) -> Result<Self, Failure> {
        let model = colmap::read(folder)
            .advice("the folder of a model with cameras and images, as written by `cv sfm -o` and COLMAP")?;
        let file = |name: &str| name.rsplit(['/', '\\']).next().unwrap_or(name).to_owned();
        let view = |one: &Photograph| {
            // By the full name, or by the file name if it is unique.
            let whole = model.images.values().find(|image| image.name == one.name);
            let mut alike = model.images.values().filter(|image| file(&image.name) == file(&one.name));
            let only = alike.next().filter(|_| alike.next().is_none());
            whole.or(only).filter(|image| model.cameras.contains_key(&image.camera)).map(|i| (i.camera, i.pose))
        };
        let views: Vec<Option<(u32, Pose)>> = all.iter().map(view).collect();
        let found = views.iter().flatten().count();
        if found < 2 {
            let what = format!(
                "{found} of the {} photographs of the model {} are among the arguments",
                model.images.len(),
                folder.display()
            );
            return Err(
                Failure::new(what).advice("give two or more photographs of the model too, under their names in it")
            );
        }
        if found < model.images.len() {
            context.note(format!(
                "{}: {} of its {} photographs are not among the arguments and are left out",
                folder.display(),
                model.images.len() - found,
                model.images.len()
            ));
        }
        Ok(Self { folder: folder.to_owned(), model, views })
    }

    /// Returns the camera of a photograph: that of the model, or for a new photograph the only one of that size (and EXIF focal length).
    pub(super) fn camera(&self, at: usize, size: (usize, usize), focal: Option<f64>) -> Option<(u32, Camera)> {
        if let Some((number, _)) = self.views[at] {
            return Some((number, self.model.cameras[&number]));
        }
        let fits = |camera: &Camera| {
            (camera.width, camera.height) == size
                && focal.is_none_or(|f| (f / camera.fx).ln().abs() < MAX_LOG_FOCAL_RATIO)
        };
        let mut alike = self.model.cameras.iter().filter(|(_, camera)| fits(camera));
        let only = alike.next().filter(|_| alike.next().is_none());
        only.map(|(number, camera)| (*number, *camera))
    }

    /// Returns the poses of the used photographs.
    pub(super) fn poses(&self, used: &[usize]) -> Vec<Option<Pose>> {
        used.iter().map(|at| self.views[*at].map(|view| view.1)).collect()
    }

    /// Aligns a model to the frame of this one; `None` if they share too few photographs.
    pub(super) fn align(&self, model: &mut SfmModel, used: &[usize]) -> Option<Frame> {
        let known = self.poses(used);
        let similarity = align_to_poses(model, &known)?;
        model.transform(&similarity);
        let both = model.poses.iter().zip(&known).filter(|(a, b)| a.is_some() && b.is_some()).count();
        Some(Frame {
            text: format!("in the frame of {}, aligned by {both} common photographs", self.folder.display()),
            json: json!({ "by": "model", "unit": "as before", "agree": both }),
        })
    }

    pub(super) fn folder(&self) -> &Path {
        &self.folder
    }
}
