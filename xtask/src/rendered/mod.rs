//! Structure from motion on rendered photographs with exact poses: walks through a room and along streets; each figure is compared with its target.
//!
//! Photographs have 1200×900 pixels and a field of view of 67°, the size to which a phone's photographs are reduced before a reconstruction of some hundred; 0.01° is
//! a sixth of a pixel. Noise, blur and vignetting are the defaults of [`RenderOptions`]. They are cached in the target folder under a hash of
//! two renderings at a small size, so that a change of the renderer invalidates the cache.

mod accuracy;
mod self_calibration;

use crate::checks::{self, Check};
use anyhow::Result;
use cv_core::{Camera, Distortion, Pose, RgbU8};
use cv_pipeline::many_views::CameraKnowledge;
use cv_pipeline::{SfmCamera, SfmJobOptions, SfmPhoto, Silent, sfm_photo};
use cv_synth::{RenderOptions, Scene, render};
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

type Job = fn() -> Result<Vec<Check>>;

const JOBS: &[checks::Named<Job>] = &[
    ("room-12", accuracy::room_12),
    ("room-50", accuracy::room_50),
    ("street-12", accuracy::street_12),
    ("street-50", accuracy::street_50),
    ("street-gaps", accuracy::street_gaps),
    ("self-calibration", self_calibration::self_calibration),
    ("street-200", accuracy::street_200),
];

/// Jobs that take many minutes without cached photographs: they run only by their name or with `all`.
const LONG: [&str; 1] = ["street-200"];

/// Runs all jobs but the long ones, or the one named, or `all`; true if every figure meets its target.
pub(crate) fn run(only: Option<&str>) -> Result<bool> {
    let mut jobs = checks::select(JOBS, only)?;
    jobs.retain(|(name, _)| only.is_some() || !LONG.contains(name));
    Ok(checks::run(&jobs, |job| job()))
}

/// A scene, the poses of its photographs and their camera.
struct Walk {
    scene: Scene,
    poses: Vec<Pose>,
    camera: Camera,
}

impl Walk {
    fn new(scene: Scene, poses: Vec<Pose>) -> Self {
        Self { scene, poses, camera: Camera::from_focal(1200, 900, 900.0) }
    }

    /// Returns the program's initial camera without EXIF.
    fn unknown_camera(&self) -> SfmCamera {
        let camera = self.undistorted_camera(1.2 * self.camera.width as f64);
        SfmCamera { camera, knowledge: CameraKnowledge::Unknown }
    }

    /// Returns a camera of the same size, without distortion.
    fn undistorted_camera(&self, focal: f64) -> Camera {
        let distortion = Distortion::radial(0.0, 0.0);
        Camera { distortion, ..Camera::from_focal(self.camera.width, self.camera.height, focal) }
    }

    fn photograph(&self, camera: &Camera, index: usize) -> Result<RgbU8> {
        let options = RenderOptions::default().with_seed(index as u64);
        Ok(render(&self.scene, camera, &self.poses[index], &options)?.image)
    }

    /// Returns the cache folder of its photographs, named by a hash of two small renderings and the poses.
    fn cache_folder(&self) -> Result<PathBuf> {
        let mut hasher = DefaultHasher::new();
        for index in [0, self.poses.len() / 2] {
            self.photograph(&self.camera.resized(80, 60), index)?.as_slice().hash(&mut hasher);
        }
        self.poses.iter().flat_map(|p| p.center().coords.map(f64::to_bits).data.0[0]).for_each(|v| v.hash(&mut hasher));
        Ok(crate::target_dir()?.join("rendered").join(format!("{:016x}", hasher.finish())))
    }

    /// Renders its photographs, or reads them from the cache, and extracts their features.
    fn photos(&self, options: &SfmJobOptions) -> Result<Vec<SfmPhoto>> {
        let folder = self.cache_folder()?;
        let extract = |index: usize| {
            let name = format!("{index:04}.png");
            let image = read_or_render(&folder.join(&name), || self.photograph(&self.camera, index))?;
            Ok(sfm_photo(image.view(), name, 0, &options.features, &Silent)?)
        };
        (0..self.poses.len()).map(extract).collect()
    }
}

/// Reads an image from its file, or renders and writes it.
fn read_or_render(path: &Path, render: impl FnOnce() -> Result<RgbU8>) -> Result<RgbU8> {
    if path.exists() {
        return Ok(cv_io::read_rgb(path)?);
    }
    let image = render()?;
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    cv_io::write_png(path, image.view())?;
    Ok(image)
}
