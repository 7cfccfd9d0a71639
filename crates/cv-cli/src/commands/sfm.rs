//! `cv sfm`: cameras and points from many photographs.

mod photographs;
mod pinhole;
mod report;

use crate::frame::{CLOUD, Context, Failure, JSON, Outcome, Output, Run, Step, expand_images, named, steps};
use crate::{rig, words};
use cv_core::{Camera, Distortion, ModelImage, PointCloud, Pose, SparseModel};
use cv_io::colmap::{self, ModelFormat};
use cv_io::ply::PlyEncoding;
use cv_io::{CalibrationFormat, DynImage};
use cv_pipeline::features::FeatureError;
use cv_pipeline::many_views::{CameraKnowledge, Solver, ViewOutcome};
use cv_pipeline::{Cancelled, Progress, SfmCamera, SfmJobOptions, SfmPhoto, SfmPhotoError, SfmResult, sfm, sfm_photo};
use photographs::{Photograph, photographs, seen_from};
use pinhole::PinholeFolder;
use serde_json::{Value, json};
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Reconstruct cameras and a sparse cloud of points from many photographs (structure from motion).
///
/// The photographs need no order. Without --camera and --focal, focal lengths come from EXIF and are refined; photographs of one size and one focal length share a camera. The unit of the
/// model is arbitrary. A photograph that cannot be read, or that shows something else, is left out and told of.
///
/// The model is COLMAP's: cameras, images and points3D, as .txt or .bin. One that is in the folder is replaced. Where the photographs fall apart into several models, the one with most
/// photographs is written into the folder itself, the others into its folders 1, 2, …
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv sfm photos/ -o model --report page\n  \
    cv sfm 'photos/*.jpg' --camera cam.yaml -o model --cloud points.ply\n  \
    cv sfm photos/ --focal 2900 -o sparse/0 --format colmap-binary --json\n  \
    cv sfm photos/ -o model --transforms photos/transforms.json        # for Nerfstudio and instant-ngp\n  \
    cv sfm photos/ -o model --pinhole dense                            # for dense reconstruction, by COLMAP or OpenMVS")]
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
    /// How poses are found.
    #[arg(long, value_name = "SOLVER", value_parser = named::<Solver>(), default_value_t = Solver::default())]
    solver: Solver,
    /// Most features in a photograph [default: 13000].
    #[arg(long, value_name = "N")]
    features: Option<usize>,
    /// Form of the model's files.
    #[arg(long, value_name = "FORM", value_parser = named::<ModelFormat>(), default_value_t = ModelFormat::default())]
    format: ModelFormat,
    /// Where to write the points of the largest model as a cloud, as PLY.
    #[arg(long, value_name = "FILE")]
    cloud: Option<PathBuf>,
    /// Where to write the cameras of the largest model as a transforms.json, which Nerfstudio and instant-ngp read; it names the photographs as seen from its folder.
    #[arg(long, value_name = "FILE")]
    transforms: Option<PathBuf>,
    /// Where to write the photographs of the largest model without lens distortion (images/), and the model of their pinhole cameras (sparse/): a folder.
    #[arg(long, value_name = "DIR")]
    pinhole: Option<PathBuf>,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let mut all = vec![Output::Folder(&self.output)];
        all.extend(self.cloud.iter().map(|path| Output::File(path, CLOUD)));
        all.extend(self.transforms.iter().map(|path| Output::File(path, JSON)));
        all.extend(self.pinhole.iter().map(|path| Output::Folder(path)));
        all
    }

    fn steps(&self) -> Vec<Step> {
        let mut all = vec![steps::PHOTOGRAPHS, steps::PAIRS, steps::MODEL];
        all.extend(self.pinhole.iter().map(|_| steps::UNDISTORT));
        all
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let options = self.options(context)?;
        let named = expand_images(&self.photographs)?;
        if let [only] = &named[..] {
            return Err(Failure::usage(format!("{} is one photograph, too few for a model", only.display()))
                .advice("two at least; ten or more of one place are usual"));
        }
        let mut all = photographs(named)?;
        let pinhole = self.pinhole.as_ref().map(|folder| PinholeFolder::new(folder, &all)).transpose()?;
        let mut clock = cv_core::StageClock::new();
        let (mut cameras, mut photos, mut used) = (Cameras::default(), Vec::new(), Vec::new());
        let total = all.len();
        for (i, one) in all.iter_mut().enumerate() {
            if one.refused.is_none() {
                match self.features_of(one, &mut cameras, &options, &Place { context, done: i, total })? {
                    Ok(photo) => {
                        photos.push(photo);
                        used.push(i);
                    }
                    Err(reason) => one.refused = Some(reason),
                }
            }
            if let Some(reason) = &one.refused {
                context.warn(format!("{} is left out: {reason}", one.path.display()));
            }
        }
        if photos.len() < 2 {
            let refused: Vec<(&Path, &str)> =
                all.iter().filter_map(|p| Some((&*p.path, p.refused.as_deref()?))).collect();
            return Err(words::many_views::too_few(photos.len(), &refused));
        }
        clock.lap("features");
        let result = sfm(&photos, &cameras.list, &options, context).map_err(words::many_views::no_model)?;
        let models: Vec<SparseModel> =
            (0..result.models.len()).filter_map(|m| result.sparse_model(m, &photos)).collect();
        let Some(main) = models.first() else { return Err(Failure::new("there is no model")) };
        let fates = fates(&all, &used, &result.outcomes);
        let mut stages = clock.into_stages();
        stages.extend(result.stages.iter().copied());
        let mut clock = cv_core::StageClock::new();
        self.write(&models, &all, &used, context)?;
        if let Some(folder) = &pinhole {
            folder.write(main, &all, &used, self.format, context)?;
        }
        clock.lap("write");
        stages.extend(clock.into_stages());
        if let Some(text) = doubt(&models, &fates) {
            context.warn(text);
        }
        context.report(|| report::report(&all, &fates, &models, &stages))?;
        Ok(outcome(&all, &fates, &models, &result, stages))
    }
}

impl Args {
    fn options(&self, context: &Context) -> Result<SfmJobOptions, Failure> {
        if self.focal.is_some_and(|f| !(f > 0.0 && f.is_finite())) {
            return Err(Failure::usage("--focal must be above 0"));
        }
        if !(self.max_error > 0.0 && self.max_error.is_finite()) {
            return Err(Failure::usage(format!("--max-error must be above 0, not {}", self.max_error)));
        }
        let mut options = SfmJobOptions::default();
        options.solve.max_error = self.max_error;
        options.solve.solver = self.solver;
        if let Some(n) = self.features {
            options.features = options.features.at_most(n);
        }
        if let Some(seed) = context.seed {
            (options.pairs.seed, options.solve.seed) = (seed, seed);
        }
        Ok(options)
    }

    /// The features of a photograph, or why it is left out.
    fn features_of(
        &self,
        one: &Photograph,
        cameras: &mut Cameras,
        options: &SfmJobOptions,
        place: &Place<'_>,
    ) -> Result<Result<SfmPhoto, String>, Failure> {
        let image = match cv_io::read_image(&one.path) {
            Ok(image) => image,
            Err(error) => return Ok(Err(words::many_views::not_read(&error))),
        };
        let camera = match cameras.of(&image, self, place.context)? {
            Ok(camera) => camera,
            Err(reason) => return Ok(Err(reason)),
        };
        let rgb = image.into_rgb8();
        match sfm_photo(rgb.view(), one.name.clone(), camera, &options.features, place) {
            Ok(photo) => Ok(Ok(photo)),
            Err(SfmPhotoError::Features(
                error @ (FeatureError::ImageTooSmall { .. } | FeatureError::NotFinite { .. }),
            )) => Ok(Err(error.to_string())),
            Err(error) => Err(error.into()),
        }
    }

    /// The models, and of the largest its points and cameras in the other forms that are asked for.
    fn write(
        &self,
        models: &[SparseModel],
        all: &[Photograph],
        used: &[usize],
        context: &Context,
    ) -> Result<(), Failure> {
        for (m, model) in models.iter().enumerate() {
            let own = self.output.join(m.to_string());
            let folder = if m == 0 { &self.output } else { &own };
            let write = |folder: &Path| colmap::replace(folder, model, self.format);
            if context.write(Output::Folder(folder), write)? {
                context.note(format!("{}: the files of an older model were removed", folder.display()));
            }
        }
        // Of an earlier run, or somebody else's: not ours to remove.
        let older = self.output.join(models.len().to_string());
        if ["cameras.txt", "cameras.bin"].iter().any(|name| older.join(name).exists()) {
            context.warn(format!("{} holds a model that is not of this run", older.display()));
        }
        let Some(model) = models.first() else { return Ok(()) };
        if let Some(path) = &self.cloud {
            let positions = model.points.values().map(|p| p.position.coords.cast().into()).collect();
            let cloud = PointCloud::colored(positions, model.points.values().map(|p| p.color).collect());
            context
                .write(Output::File(path, CLOUD), |path| cv_io::ply::write_cloud(path, &cloud, PlyEncoding::Binary))?;
        }
        if let Some(path) = &self.transforms {
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            context.write(Output::File(path, JSON), |file| {
                // The folder is there by now, so that links in its path can be followed.
                let mut seen = model.clone();
                for (id, image) in &mut seen.images {
                    if let Some(at) = used.get(*id as usize - 1) {
                        image.name = seen_from(folder, &all[*at].path);
                    }
                }
                cv_io::write_transforms(file, &seen, "")
            })?;
        }
        Ok(())
    }
}

/// How many of the photographs have been looked at.
struct Place<'a> {
    context: &'a Context,
    done: usize,
    total: usize,
}

impl Progress for Place<'_> {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        Progress::report(self.context, "photographs", self.done, self.total)
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
    /// The index of a photograph's camera, or why it has none.
    fn of(&mut self, image: &DynImage, args: &Args, context: &Context) -> Result<Result<usize, String>, Failure> {
        let (width, height) = image.size();
        let exif = image.exif.focal.map(|f| f.pixels).filter(|_| !args.ignore_exif && args.camera.is_none());
        let focal = args.focal.or(exif);
        let key = (width, height, focal.map_or(0, |f| (f * 1000.0).round() as u64));
        if let Some(index) = self.known.get(&key) {
            return Ok(Ok(*index));
        }
        let lens = |camera: Camera| Camera { distortion: Distortion::radial(0.0, 0.0), ..camera };
        let camera = if let Some(file) = &args.camera {
            let (camera, lens_known) = rig::camera_and_lens(file, Some((width, height)), context)?;
            if (camera.width, camera.height) != (width, height) {
                let (w, h) = (camera.width, camera.height);
                return Ok(Err(format!("it is {width}×{height} px, its camera in {} is {w}×{h} px", file.display())));
            }
            match lens_known || args.undistorted {
                true => {
                    args.check_lens(file, &camera)?;
                    SfmCamera { camera, knowledge: CameraKnowledge::Known }
                }
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
        Ok(Ok(self.list.len() - 1))
    }
}

impl Args {
    /// Refuses, before the work, a lens that the outputs cannot hold.
    fn check_lens(&self, file: &Path, camera: &Camera) -> Result<(), Failure> {
        let refuse = |error: cv_io::FormatError| {
            Failure::new(format!("{}: {error}", file.display()))
                .advice("photographs without distortion (`cv undistort`) and their camera")
        };
        if let Some(format) = CalibrationFormat::from_name("colmap") {
            format.camera_text(camera, &[]).map_err(refuse)?;
        }
        if self.transforms.is_some() {
            let image =
                ModelImage { name: "photograph".to_owned(), camera: 1, pose: Pose::identity(), points: Vec::new() };
            let model =
                SparseModel { cameras: [(1, *camera)].into(), images: [(1, image)].into(), ..SparseModel::default() };
            cv_io::transforms_json(&model, "").map_err(refuse)?;
        }
        Ok(())
    }
}

/// Relative standard deviation of focal lengths by EXIF.
const EXIF_DEVIATION: f64 = 0.03;

/// What became of a photograph: the model it is in, or why it is in none.
type Fate = Result<usize, String>;

fn fates(all: &[Photograph], used: &[usize], outcomes: &[ViewOutcome]) -> Vec<Fate> {
    let mut fates: Vec<Fate> = all.iter().map(|p| Err(p.refused.clone().unwrap_or_default())).collect();
    for (at, outcome) in used.iter().zip(outcomes) {
        fates[*at] = match outcome {
            ViewOutcome::Registered { model } => Ok(*model),
            other => Err(words::many_views::left_out(other).unwrap_or_default()),
        };
    }
    fates
}

/// What to think of a model that is not of most photographs.
fn doubt(models: &[SparseModel], fates: &[Fate]) -> Option<String> {
    let inside = fates.iter().filter(|fate| **fate == Ok(0)).count();
    let more = "photographs in between join them";
    match models.len() {
        1 if 2 * inside >= fates.len() => None,
        1 => Some(format!("only {inside} of {} photographs are in the model; {more}", fates.len())),
        n => Some(format!(
            "the photographs fall apart into {n} models, whose places to each other are unknown; {inside} of {} are in the largest; {more}",
            fates.len()
        )),
    }
}

/// Root mean square distance in pixels between the points' projections and where they were seen, over all observations.
fn reprojection_rms(model: &SparseModel) -> f64 {
    let errors: Vec<f64> = reprojections(model).collect();
    (errors.iter().map(|e| e * e).sum::<f64>() / errors.len() as f64).sqrt()
}

/// The distance of each observation from its point's projection, in pixels.
fn reprojections(model: &SparseModel) -> impl Iterator<Item = f64> + '_ {
    model.points.values().flat_map(move |point| {
        point.track.iter().filter_map(move |(id, index)| {
            let image = model.images.get(id)?;
            let at = image.points.get(*index as usize)?.0;
            let pixel = model.cameras.get(&image.camera)?.project(&image.pose.transform(&point.position))?;
            Some((pixel - at).norm())
        })
    })
}

fn outcome(
    all: &[Photograph],
    fates: &[Fate],
    models: &[SparseModel],
    result: &SfmResult,
    stages: Vec<(&'static str, f64)>,
) -> Outcome {
    let image = |(one, fate): (&Photograph, &Fate)| {
        let model = fate.as_ref().ok();
        json!({ "path": one.path.display().to_string(), "used": model.is_some(), "model": model, "reason": fate.as_ref().err() })
    };
    let images: Vec<Value> = all.iter().zip(fates).map(image).collect();
    let used = fates.iter().filter(|fate| fate.is_ok()).count();
    let main = result.models.first();
    let (points, observations) = main.map_or((0, 0), |m| (m.points.len(), m.observations()));
    let (length, error) = main.map_or((0.0, 0.0), |m| (m.mean_track_length(), m.mean_reprojection_error()));
    let rms = models.first().map_or(f64::NAN, reprojection_rms);
    let focal: Vec<f64> = models.first().map_or_else(Vec::new, |m| m.cameras.values().map(|c| c.fx).collect());
    let mut summary = format!(
        "{used} of {} photographs in {} model{}; {points} points seen {length:.1} times each, {rms:.3} px RMS",
        all.len(),
        models.len(),
        if models.len() == 1 { "" } else { "s" },
    );
    let refused = words::many_views::RefusedPairs::of(&result.refused);
    summary.extend(refused.text(result.pairs.len()).map(|text| format!("\n{text}")));
    // What was refused has been warned of.
    for (one, fate) in all.iter().zip(fates) {
        if let (Err(reason), None) = (fate, &one.refused) {
            summary += &format!("\n{}: left out: {reason}", one.path.display());
        }
    }
    Outcome::new(stages)
        .with("images", images)
        .with("models", models.len())
        .with("points", points)
        .with("observations", observations)
        .with("mean_track_length", length)
        .with("reprojection_rms_px", rms)
        .with("mean_reprojection_px", error)
        .with("focal_px", focal)
        .with("solvers", result.solvers.iter().map(ToString::to_string).collect::<Vec<_>>())
        .with("refused_pairs", json!({ "triplets": refused.triplets, "repeated": refused.repeated }))
        .summary(summary)
}
