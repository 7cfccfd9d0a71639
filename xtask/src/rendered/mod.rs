//! Many views on rendered photographs, whose poses are known exactly: walks through a room and along streets, each figure against its bar.
//!
//! Photographs have 1200×900 pixels, 67° wide: what a phone's photograph is reduced to before a walk of some hundred is reconstructed, and enough for the bars to be
//! asked for (a hundredth of a degree is a sixth of a pixel). They are noisy, blurred by the lens and darker in the corners, as the defaults of [`RenderOptions`] say. They are kept below
//! the folder that the build goes into, by what the renderer makes of a small one, so that a second run does not render them anew.

mod accuracy;

use crate::checks::{self, Check};
use anyhow::Result;
use cv_core::{Camera, Pose, RgbU8};
use cv_pipeline::{SfmJobOptions, SfmPhoto, Silent, sfm_photo};
use cv_synth::{RenderOptions, Scene, render};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

type Job = fn() -> Result<Vec<Check>>;

const JOBS: &[checks::Named<Job>] = &[
    ("room-12", accuracy::room_12),
    ("room-50", accuracy::room_50),
    ("street-12", accuracy::street_12),
    ("street-50", accuracy::street_50),
    ("street-200", accuracy::street_200),
];

/// Jobs that take many minutes where nothing is rendered yet: they run where they are named, or all are.
const LONG: [&str; 1] = ["street-200"];

/// Runs all jobs but the long ones, or the one named, or `all`; true where every figure meets its bar.
pub(crate) fn run(only: Option<&str>) -> Result<bool> {
    let mut jobs = checks::select(JOBS, only)?;
    jobs.retain(|(name, _)| only.is_some() || !LONG.contains(name));
    Ok(checks::run(&jobs, |job| job()))
}

/// A scene and where it is photographed from.
struct Walk {
    scene: Scene,
    poses: Vec<Pose>,
    camera: Camera,
}

impl Walk {
    fn new(scene: Scene, poses: Vec<Pose>) -> Self {
        Self { scene, poses, camera: Camera::from_focal(1200, 900, 900.0) }
    }

    fn photograph(&self, camera: &Camera, index: usize) -> Result<RgbU8> {
        let options = RenderOptions::default().with_seed(index as u64);
        Ok(render(&self.scene, camera, &self.poses[index], &options)?.image)
    }

    /// Where its photographs are kept: other pixels of a small one, other folder.
    fn folder(&self) -> Result<PathBuf> {
        let mut hasher = DefaultHasher::new();
        for index in [0, self.poses.len() / 2] {
            self.photograph(&self.camera.resized(80, 60), index)?.as_slice().hash(&mut hasher);
        }
        self.poses.iter().flat_map(|p| p.center().coords.map(f64::to_bits).data.0[0]).for_each(|v| v.hash(&mut hasher));
        Ok(crate::target_dir()?.join("rendered").join(format!("{:016x}", hasher.finish())))
    }

    /// What is found in its photographs.
    fn photos(&self, options: &SfmJobOptions) -> Result<Vec<SfmPhoto>> {
        let folder = self.folder()?;
        let one = |index: usize| {
            let name = format!("{index:04}.png");
            let image = kept(&folder.join(&name), || self.photograph(&self.camera, index))?;
            Ok(sfm_photo(image.view(), name, 0, &options.features, &Silent)?)
        };
        (0..self.poses.len()).map(one).collect()
    }
}

/// A picture from its file, or a new one, which is kept there.
fn kept(path: &Path, make: impl FnOnce() -> Result<RgbU8>) -> Result<RgbU8> {
    if path.exists() {
        return Ok(cv_io::read_rgb(path)?);
    }
    let image = make()?;
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    cv_io::write_png(path, image.view())?;
    Ok(image)
}
