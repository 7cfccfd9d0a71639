//! `cv sfm`: structure from motion.

mod cameras;
mod checkpoint;
mod covariance;
mod dense;
mod earlier;
mod outcome;
mod photographs;
mod pinhole;
mod places;
mod report;

use crate::frame::{CLOUD, Context, Failure, JSON, Outcome, Output, Run, Step, expand_images, named, steps};
use crate::photos::ReadAhead;
use crate::words;
use cameras::Cameras;
use checkpoint::{Checkpoint, Extracted};
use cv_core::{PointCloud, SparseModel};
use cv_io::colmap::{self, ModelFormat};
use cv_io::ply::PlyEncoding;
use cv_pipeline::features::FeatureError;
use cv_pipeline::many_views::{SfmModel, Solver};
use cv_pipeline::{
    PhotoOrder, PhotoProgress, Progress, SfmJobOptions, SfmPhoto, SfmPhotoError, sfm_covariance, sfm_focal_deviations,
    sfm_pairs, sfm_photo, sfm_solve,
};
use dense::DenseArgs;
use earlier::Earlier;
use outcome::{completeness_warning, outcome, registration_outcomes};
use photographs::{Photograph, photographs, relative_path};
use pinhole::PinholeFolder;
use places::{Frame, PlaceArgs, Places};
use std::path::{Path, PathBuf};

/// Maximum number of views of a model whose focal length is checked: the normal equations are dense, O(views³).
const MAX_VIEWS_OF_DEVIATIONS: usize = 200;

/// Reconstruct camera poses and a sparse point cloud from many photographs (structure from motion).
///
/// The photographs may be unordered. Without --camera and --focal, focal lengths are taken from EXIF and refined; photographs of the same size and focal length share a camera. A photograph that
/// cannot be read or registered is left out with a reason.
///
/// The model is upright, Z up. If three or more photographs have GPS positions, it is georeferenced in meters, relative to the first of them (X east, Y north). Otherwise --known or --distance
/// determine the scale, or its unit is arbitrary.
///
/// The model is in COLMAP's format: cameras, images and points3D, as .txt or .bin. An existing model in the folder is replaced. If the view graph falls into several components, the model with
/// the most photographs is written to the folder itself, the others to its subfolders 1, 2, …
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv sfm photos/ -o model --report page\n  \
    cv sfm 'photos/*.jpg' --camera cam.yaml -o model --cloud points.ply\n  \
    cv sfm 'frames/*.png' --order sequence -o model                    # video frames\n  \
    cv sfm photos/ --focal 2900 -o sparse/0 --format colmap-binary --json\n  \
    cv sfm photos/ -o model --distance a.jpg b.jpg 2.5                 # distance of two camera centers in meters\n  \
    cv sfm photos/ more/ --from model -o model                         # more photographs of the same place\n  \
    cv sfm photos/ -o model --transforms photos/transforms.json        # for Nerfstudio and instant-ngp\n  \
    cv sfm photos/ -o model --dense dense.ply                          # a dense cloud with normals\n  \
    cv sfm photos/ -o model --pinhole dense                            # for dense reconstruction with COLMAP or OpenMVS")]
pub(crate) struct Args {
    /// Photographs, folders or quoted patterns of them.
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    photographs: Vec<PathBuf>,
    /// Where to write the model: a folder.
    #[arg(short, long, value_name = "DIR")]
    output: PathBuf,
    /// Calibration of the camera of all photographs.
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    camera: Option<PathBuf>,
    /// The photographs have no lens distortion. For calibration matrices, which do not state it.
    #[arg(long, requires = "camera")]
    undistorted: bool,
    /// Approximate focal length of the photographs in pixels: a prior.
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Continue from a model of some of the photographs, in COLMAP's text or binary format: its poses are initial values, its intrinsics are kept fixed, its frame is kept, and the remaining
    /// photographs are registered.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["camera", "focal"])]
    from: Option<PathBuf>,
    /// Ignore the focal lengths of EXIF.
    #[arg(long, conflicts_with_all = ["camera", "focal"])]
    ignore_exif: bool,
    /// Largest reprojection error of an observation, in pixels.
    #[arg(long, value_name = "PX", default_value_t = SfmJobOptions::default().solve.max_error)]
    max_error: f64,
    /// Pose estimation.
    #[arg(long, value_name = "SOLVER", value_parser = named::<Solver>(), default_value_t = Solver::default())]
    solver: Solver,
    /// Order of the photographs, which determines the pairs to match.
    #[arg(long, value_name = "ORDER", value_parser = named::<PhotoOrder>(), default_value_t = PhotoOrder::default())]
    order: PhotoOrder,
    /// Maximum number of features per photograph [default: 13000].
    #[arg(long, value_name = "N")]
    features: Option<usize>,
    /// Format of the model's files.
    #[arg(long, value_name = "FORMAT", value_parser = named::<ModelFormat>(), default_value_t = ModelFormat::default())]
    format: ModelFormat,
    /// Where to write the points of the largest model as a cloud, as PLY.
    #[arg(long, value_name = "FILE")]
    cloud: Option<PathBuf>,
    /// Where to write the cameras of the largest model as a transforms.json for Nerfstudio and instant-ngp, with paths relative to its folder.
    #[arg(long, value_name = "FILE")]
    transforms: Option<PathBuf>,
    /// Where to write the undistorted images of the largest model (images/) and the model of their pinhole cameras (sparse/): a folder.
    #[arg(long, value_name = "DIR")]
    pinhole: Option<PathBuf>,
    /// Where to write the standard deviations of the camera centers, rotations and points of the largest model, as JSON. The gauge is fixed by one camera's pose and its distance from another.
    #[arg(long, value_name = "FILE")]
    covariance: Option<PathBuf>,
    /// Resume a stopped run into the same folder: features and pairs of unchanged photographs and options are reused.
    #[arg(long)]
    resume: bool,
    /// Keep features and pairs (in .cv-sfm of the output folder) after success, for --resume with more photographs or other solver options.
    #[arg(long)]
    keep: bool,
    #[command(flatten)]
    dense: DenseArgs,
    #[command(flatten)]
    places: PlaceArgs,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let mut all = vec![Output::Folder(&self.output)];
        all.extend(self.cloud.iter().map(|path| Output::File(path, CLOUD)));
        all.extend(self.transforms.iter().map(|path| Output::File(path, JSON)));
        all.extend(self.pinhole.iter().map(|path| Output::Folder(path)));
        all.extend(self.dense.path().map(|path| Output::File(path, CLOUD)));
        all.extend(self.covariance.iter().map(|path| Output::File(path, JSON)));
        all
    }

    fn steps(&self) -> Vec<Step> {
        let mut all = vec![steps::PHOTOGRAPHS, steps::PAIRS, steps::MODEL];
        all.extend(self.pinhole.iter().map(|_| steps::UNDISTORT));
        all.extend(self.dense.path().map(|_| steps::DENSE));
        all
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let options = self.options(context)?;
        let named = expand_images(&self.photographs)?;
        if let [only] = &named[..] {
            return Err(Failure::usage(format!("{} is one photograph, two or more are needed", only.display()))
                .advice("ten or more photographs of one scene"));
        }
        let all = photographs(named)?;
        let places = self.places.read(&all, context)?;
        let pinhole = self.pinhole.as_ref().map(|folder| PinholeFolder::new(folder, &all)).transpose()?;
        let earlier = self.from.as_ref().map(|folder| Earlier::read(folder, &all, context)).transpose()?;
        let checkpoint = Checkpoint::new(&self.output, self.resume, context);
        let inputs = Inputs { places, earlier, pinhole };
        let outcome = self.reconstruct(all, inputs, &options, &checkpoint, context);
        checkpoint.end(self.keep, outcome.is_ok());
        outcome
    }
}

impl Args {
    fn reconstruct(
        &self,
        mut all: Vec<Photograph>,
        inputs: Inputs<'_>,
        options: &SfmJobOptions,
        checkpoint: &Checkpoint<'_>,
        context: &Context,
    ) -> Result<Outcome, Failure> {
        let mut clock = cv_core::StageClock::new();
        let (mut cameras, mut photos, mut used) = (Cameras::default(), Vec::new(), Vec::new());
        let total = all.len();
        let mut ahead = ReadAhead::default();
        for i in 0..total {
            let next = all.get(i + 1).filter(|next| next.refused.is_none()).map(|next| next.path.clone());
            let one = &mut all[i];
            if one.refused.is_none() {
                let camera = |cameras: &mut Cameras, size, exif: Option<f64>| match inputs
                    .earlier
                    .as_ref()
                    .and_then(|e| Some((e, e.camera(i, size, exif.filter(|_| !self.ignore_exif))?)))
                {
                    Some((earlier, camera)) => cameras.of_earlier(size, camera, earlier, self),
                    None => cameras.of(size, exif, self, context),
                };
                let place = PhotoProgress { progress: context, done: i, total };
                match self.features_of(
                    one,
                    (&mut ahead, next.as_deref()),
                    |size, exif| camera(&mut cameras, size, exif),
                    options,
                    checkpoint,
                    &place,
                )? {
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
        let find = || sfm_pairs(&photos, cameras.list(), options, context);
        let (pairs, geometry) = checkpoint.pairs(&photos, cameras.list(), options, find)?;
        clock.lap("match");
        let known = inputs.earlier.as_ref().map_or_else(Vec::new, |earlier| earlier.poses(&used));
        let mut result = sfm_solve(&photos, cameras.list(), (pairs, &geometry), &known, options, context)
            .map_err(words::many_views::no_model)?;
        let frames = inputs.frames(&self.places, &mut result.models, &all, &used, context)?;
        let models: Vec<SparseModel> =
            (0..result.models.len()).filter_map(|m| result.sparse_model(m, &photos)).collect();
        let Some(main) = models.first() else { return Err(Failure::new("there is no model")) };
        let registered = registration_outcomes(&all, &used, &result.outcomes);
        let mut stages = clock.into_stages();
        stages.extend(result.stages.iter().copied());
        let mut clock = cv_core::StageClock::new();
        self.write(&models, &all, &used, context)?;
        if let Some(folder) = &inputs.pinhole {
            folder.write(main, &all, &used, self.format, context)?;
        }
        clock.lap("write");
        stages.extend(clock.into_stages());
        let dense = match result.models.first() {
            Some(model) => self.dense.write(model, &photos, &all, &used, context)?,
            None => None,
        };
        stages.extend(dense.iter().flat_map(|dense| dense.stages.iter().copied()));
        let mut clock = cv_core::StageClock::new();
        if let (Some(path), Some(model), Some(frame)) = (&self.covariance, result.models.first(), frames.first()) {
            let names: Vec<&str> = photos.iter().map(|photo| photo.name.as_str()).collect();
            let covariance = sfm_covariance(&photos, cameras.list(), model)?;
            let text = covariance::deviations(&covariance, &names, &frame.json["unit"]).to_string();
            context.write(Output::File(path, JSON), |path| cv_io::write_bytes(path, text.as_bytes()))?;
            clock.lap("covariance");
        }
        stages.extend(clock.into_stages());
        if let Some(text) = completeness_warning(&models, &registered) {
            context.warn(text);
        }
        if let Some(model) = result.models.first().filter(|m| m.registered() <= MAX_VIEWS_OF_DEVIATIONS) {
            let deviations = sfm_focal_deviations(&photos, cameras.list(), model).unwrap_or_default();
            let mut of_cameras = model.cameras.iter().zip(&deviations);
            let warning = of_cameras.find_map(|(camera, of)| words::many_views::focal_uncertain(camera.fx, (*of)?));
            if let Some(text) = warning {
                context.warn(text);
            }
        }
        context.report(|| report::report(&all, &registered, &models, &frames, &stages))?;
        let done = outcome(&all, &registered, &models, &frames, &result, checkpoint.reused(), stages);
        Ok(match &dense {
            Some(dense) => done.with("dense_points", dense.cloud.len()).with("dense_pairs", dense.pairs.len()),
            None => done,
        })
    }

    fn options(&self, context: &Context) -> Result<SfmJobOptions, Failure> {
        if self.focal.is_some_and(|f| !(f > 0.0 && f.is_finite())) {
            return Err(Failure::usage("--focal must be positive"));
        }
        if !(self.max_error > 0.0 && self.max_error.is_finite()) {
            return Err(Failure::usage(format!("--max-error must be positive, not {}", self.max_error)));
        }
        let mut options = SfmJobOptions::default();
        options.solve.max_error = self.max_error;
        options.solve.solver = self.solver;
        options.order = self.order;
        if let Some(n) = self.features {
            options.features = options.features.at_most(n);
        }
        if let Some(seed) = context.seed {
            (options.pairs.seed, options.solve.seed) = (seed, seed);
        }
        Ok(options)
    }

    /// Returns the features of a photograph, from the checkpoint or computed, or the reason why it is left out.
    fn features_of(
        &self,
        one: &mut Photograph,
        ahead: (&mut ReadAhead, Option<&Path>),
        mut camera: impl FnMut((usize, usize), Option<f64>) -> Result<Result<usize, String>, Failure>,
        options: &SfmJobOptions,
        checkpoint: &Checkpoint<'_>,
        place: &PhotoProgress<'_>,
    ) -> Result<Result<SfmPhoto, String>, Failure> {
        place.report("photographs", 0, 0)?;
        let (key, stored) = checkpoint.extracted(one, options);
        let new = stored.is_none();
        let extracted = match stored {
            Some(extracted) => extracted,
            None => match self.extract(one, ahead, &mut camera, options, place)? {
                Ok(extracted) => extracted,
                Err(reason) => return Ok(Err(reason)),
            },
        };
        let camera = match camera(extracted.photo.size, extracted.focal)? {
            Ok(camera) => camera,
            Err(reason) => return Ok(Err(reason)),
        };
        if new {
            checkpoint.store_extracted(key, &extracted);
        }
        checkpoint.add(key);
        one.gps = extracted.gps;
        Ok(Ok(SfmPhoto { name: one.name.clone(), camera, ..extracted.photo }))
    }

    /// Reads a photograph and extracts its features and metadata, or returns the reason why it is left out. Reads the next one meanwhile.
    fn extract(
        &self,
        one: &Photograph,
        (ahead, next): (&mut ReadAhead, Option<&Path>),
        mut camera: impl FnMut((usize, usize), Option<f64>) -> Result<Result<usize, String>, Failure>,
        options: &SfmJobOptions,
        place: &PhotoProgress<'_>,
    ) -> Result<Result<Extracted, String>, Failure> {
        let image = match ahead.take(&one.path) {
            Ok(image) => image,
            Err(error) => return Ok(Err(words::many_views::not_read(&error))),
        };
        let (focal, gps) = (image.exif.focal.map(|f| f.pixels), image.exif.gps);
        // Checked before the expensive extraction.
        if let Err(reason) = camera(image.size(), focal)? {
            return Ok(Err(reason));
        }
        let rgb = image.into_rgb8();
        match ahead.during(next, || sfm_photo(rgb.view(), String::new(), 0, &options.features, place)) {
            Ok(photo) => Ok(Ok(Extracted { focal, gps, photo })),
            Err(SfmPhotoError::Features(
                error @ (FeatureError::ImageTooSmall { .. } | FeatureError::NotFinite { .. }),
            )) => Ok(Err(error.to_string())),
            Err(error) => Err(error.into()),
        }
    }

    /// Writes the models, and the points and cameras of the largest in the other requested formats.
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
        // Of an earlier run or of another program: not removed.
        let older = self.output.join(models.len().to_string());
        if ["cameras.txt", "cameras.bin"].iter().any(|name| older.join(name).exists()) {
            context.warn(format!("{} contains a model that is not from this run", older.display()));
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
                // The folder exists by now, so that symbolic links in its path can be resolved.
                let mut relative = model.clone();
                for (id, image) in &mut relative.images {
                    if let Some(at) = used.get(*id as usize - 1) {
                        image.name = relative_path(folder, &all[*at].path);
                    }
                }
                cv_io::write_transforms(file, &relative, "")
            })?;
        }
        Ok(())
    }
}

/// Control positions, the earlier model and the output folder of undistorted images.
struct Inputs<'a> {
    places: Places,
    earlier: Option<Earlier>,
    pinhole: Option<PinholeFolder<'a>>,
}

impl Inputs<'_> {
    /// Aligns each model: to positions and distances from the command line, to the earlier model, or to GPS positions, in this order.
    fn frames(
        &self,
        args: &PlaceArgs,
        models: &mut [SfmModel],
        all: &[Photograph],
        used: &[usize],
        context: &Context,
    ) -> Result<Vec<Frame>, Failure> {
        let earlier = self.earlier.as_ref().filter(|_| !self.places.is_given());
        let places = self.places.with_gps(args, all);
        let one = |model: &mut SfmModel| match earlier.and_then(|earlier| earlier.align(model, used)) {
            Some(frame) => Ok(frame),
            None => places.align(model, all, used, context),
        };
        models.iter_mut().map(one).collect()
    }
}
