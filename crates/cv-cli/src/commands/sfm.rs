//! `cv sfm`: cameras and points from many photographs.

use crate::frame::{CLOUD, Context, Failure, Outcome, Output, Run, Step, expand_images, steps};
use crate::rig;
use cv_core::{Camera, Distortion, PointCloud, SparseModel};
use cv_io::ply::PlyEncoding;
use cv_pipeline::many_views::{CameraKnowledge, ViewOutcome};
use cv_pipeline::{Cancelled, Progress, SfmCamera, SfmJobOptions, SfmPhoto, SfmResult, sfm, sfm_photo};
use serde_json::{Value, json};
use std::collections::{BTreeMap, HashSet};
use std::path::{Path, PathBuf};

/// Reconstruct cameras and a sparse cloud of points from many photographs (structure from motion).
///
/// The photographs need no order. Without --camera and --focal, focal lengths come from EXIF and are refined; photographs of one size and one focal length share a camera. Where the
/// photographs fall apart into several models, the largest is written into the folder itself, the others into its folders 1, 2, …
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv sfm photos/ -o model\n  \
    cv sfm 'photos/*.jpg' --camera cam.yaml -o model --cloud points.ply\n  \
    cv sfm photos/ --focal 2900 -o model --json\n\n\
    The model is COLMAP's text form: cameras.txt, images.txt, points3D.txt.")]
pub(crate) struct Args {
    /// Photographs, folders or quoted patterns of them.
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    photographs: Vec<PathBuf>,
    /// Where to write the model: a folder.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Camera of all photographs.
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    camera: Option<PathBuf>,
    /// The photographs are free of lens distortion, of which a calibration matrix does not tell.
    #[arg(long, requires = "camera")]
    undistorted: bool,
    /// About what focal length in pixels the photographs have.
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Estimate the focal length even where the photographs' EXIF has one.
    #[arg(long, conflicts_with_all = ["camera", "focal"])]
    ignore_exif: bool,
    /// Largest reprojection error of a point that is kept, in pixels.
    #[arg(long, value_name = "PX", default_value_t = SfmJobOptions::default().solve.max_error)]
    max_error: f64,
    /// Most features in a photograph [default: 13000].
    #[arg(long, value_name = "N")]
    features: Option<usize>,
    /// Where to write the points of the largest model as a cloud, as PLY.
    #[arg(long, value_name = "FILE")]
    cloud: Option<PathBuf>,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let folder = std::iter::once(Output::Folder(&self.output));
        folder.chain(self.cloud.iter().map(|path| Output::File(path, CLOUD))).collect()
    }

    fn steps(&self) -> Vec<Step> {
        vec![steps::PHOTOGRAPHS, steps::PAIRS, steps::MODEL]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        if self.focal.is_some_and(|f| !(f > 0.0 && f.is_finite())) {
            return Err(Failure::usage("--focal must be above 0"));
        }
        let paths = expand_images(&self.photographs)?;
        if paths.len() < 2 {
            return Err(Failure::usage(format!("{} photograph is too few for a model", paths.len()))
                .advice("two at least; ten or more of one place are usual"));
        }
        let mut options = SfmJobOptions::default();
        options.solve.max_error = self.max_error;
        if let Some(n) = self.features {
            options.features = options.features.at_most(n);
        }
        if let Some(seed) = context.seed {
            (options.pairs.seed, options.solve.seed) = (seed, seed);
        }
        let mut cameras = Cameras::default();
        let mut photos = Vec::with_capacity(paths.len());
        let mut clock = cv_core::StageClock::new();
        for (i, (path, name)) in paths.iter().zip(names(&paths)).enumerate() {
            let image = cv_io::read_image(path)?;
            let camera = cameras.of(path, &image, &self, context)?;
            let rgb = image.into_rgb8();
            let one = OnePhotograph { context, done: i, total: paths.len() };
            photos.push(sfm_photo(rgb.view(), name, camera, &options.features, &one)?);
        }
        clock.lap("features");
        let result = sfm(&photos, &cameras.list, &options, context)?;
        let models: Vec<SparseModel> =
            (0..result.models.len()).filter_map(|m| result.sparse_model(m, &photos)).collect();
        for (m, model) in models.iter().enumerate() {
            let own = self.output.join(m.to_string());
            let folder = Output::Folder(if m == 0 { &self.output } else { &own });
            context.write(folder, |folder| cv_io::colmap::write(folder, model))?;
        }
        if let (Some(path), Some(model)) = (&self.cloud, models.first()) {
            let positions = model.points.values().map(|p| p.position.coords.cast().into()).collect();
            let cloud = PointCloud::colored(positions, model.points.values().map(|p| p.color).collect());
            context
                .write(Output::File(path, CLOUD), |path| cv_io::ply::write_cloud(path, &cloud, PlyEncoding::Binary))?;
        }
        let mut stages = clock.into_stages();
        stages.extend(result.stages.iter().copied());
        Ok(outcome(&result, &photos, &paths, stages))
    }
}

/// Progress of the features of one photograph among many.
struct OnePhotograph<'a> {
    context: &'a Context,
    done: usize,
    total: usize,
}

impl Progress for OnePhotograph<'_> {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        Progress::report(self.context, "photographs", self.done, self.total)
    }
}

/// Names of photographs in the model: those of their files, or their paths where two files have one name.
fn names(paths: &[PathBuf]) -> Vec<String> {
    let file = |path: &PathBuf| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let mut seen = HashSet::new();
    if paths.iter().all(|path| seen.insert(file(path))) {
        paths.iter().map(file).collect()
    } else {
        paths.iter().map(|path| path.to_string_lossy().into_owned()).collect()
    }
}

/// The cameras of the photographs so far.
#[derive(Default)]
struct Cameras {
    list: Vec<SfmCamera>,
    /// By size and focal length in thousandths of a pixel.
    known: BTreeMap<(usize, usize, u64), usize>,
}

impl Cameras {
    /// The index of a photograph's camera.
    fn of(&mut self, path: &Path, image: &cv_io::DynImage, args: &Args, context: &Context) -> Result<usize, Failure> {
        let (width, height) = image.size();
        let focal = args.focal.or(image.exif.focal.map(|f| f.pixels).filter(|_| !args.ignore_exif));
        let key = (width, height, focal.map_or(0, |f| (f * 1000.0).round() as u64));
        if let Some(index) = self.known.get(&key) {
            return Ok(*index);
        }
        let lens = |camera: Camera| Camera { distortion: Distortion::radial(0.0, 0.0), ..camera };
        let camera = if let Some(file) = &args.camera {
            let (camera, lens_known) = rig::camera_and_lens(file, Some((width, height)), context)?;
            rig::check_size(file, path, (width, height), &camera)?;
            match lens_known || args.undistorted {
                true => SfmCamera { camera, knowledge: CameraKnowledge::Known },
                false => SfmCamera { camera: lens(camera), knowledge: CameraKnowledge::Matrix },
            }
        } else if let Some(focal) = focal {
            let camera = lens(Camera::from_focal(width, height, focal));
            SfmCamera { camera, knowledge: CameraKnowledge::Focal { focal, deviation: EXIF_DEVIATION } }
        } else {
            // 1.2 times the longer side, COLMAP's, where the pairs do not tell better.
            let camera = lens(Camera::from_focal(width, height, 1.2 * width.max(height) as f64));
            SfmCamera { camera, knowledge: CameraKnowledge::Unknown }
        };
        self.list.push(camera);
        self.known.insert(key, self.list.len() - 1);
        Ok(self.list.len() - 1)
    }
}

/// Relative standard deviation of focal lengths by EXIF.
const EXIF_DEVIATION: f64 = 0.03;

/// What became of a photograph, in words.
fn reason(outcome: &ViewOutcome) -> Option<String> {
    match *outcome {
        ViewOutcome::Registered { .. } => None,
        ViewOutcome::NoPairs => {
            Some("no other photograph shows enough of the same; try photographs in between".to_owned())
        }
        ViewOutcome::TooFewPoints { seen, needed } => {
            Some(format!("it sees {seen} points of the model where {needed} are needed; try photographs in between"))
        }
        ViewOutcome::NoPose { seen, agree, needed } => {
            Some(format!("of {seen} points it sees {agree} agree with a pose where {needed} are needed"))
        }
    }
}

fn outcome(result: &SfmResult, photos: &[SfmPhoto], paths: &[PathBuf], stages: Vec<(&'static str, f64)>) -> Outcome {
    let images: Vec<Value> = paths
        .iter()
        .zip(&result.outcomes)
        .map(|(path, outcome)| {
            let model = match outcome {
                ViewOutcome::Registered { model } => Some(*model),
                _ => None,
            };
            json!({ "path": path.display().to_string(), "used": model.is_some(), "model": model, "reason": reason(outcome) })
        })
        .collect();
    let used = images.iter().filter(|i| i["used"] == true).count();
    let main = result.models.first();
    let (points, observations) = main.map_or((0, 0), |m| (m.points.len(), m.observations()));
    let (length, error) = main.map_or((0.0, 0.0), |m| (m.mean_track_length(), m.mean_reprojection_error()));
    let mut summary = format!(
        "{used} of {} photographs in {} model{}; {points} points seen {length:.1} times each, {error:.3} px mean error",
        photos.len(),
        result.models.len(),
        if result.models.len() == 1 { "" } else { "s" },
    );
    for (path, outcome) in paths.iter().zip(&result.outcomes) {
        if let Some(reason) = reason(outcome) {
            summary += &format!("\n{}: left out: {reason}", path.display());
        }
    }
    Outcome::new(stages)
        .with("images", images)
        .with("models", result.models.len())
        .with("points", points)
        .with("observations", observations)
        .with("mean_track_length", length)
        .with("mean_reprojection_px", error)
        .with("focal_px", main.map_or_else(Vec::new, |m| m.cameras.iter().map(|c| c.fx).collect::<Vec<f64>>()))
        .summary(summary)
}
