//! `cv sfm`: cameras and points from many photographs.

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
use crate::words;
use cameras::Cameras;
use checkpoint::{Checkpoint, Seen};
use cv_core::{PointCloud, SparseModel};
use cv_io::colmap::{self, ModelFormat};
use cv_io::ply::PlyEncoding;
use cv_pipeline::features::FeatureError;
use cv_pipeline::many_views::{SfmModel, Solver};
use cv_pipeline::{
    PhotoOrder, PhotoProgress, Progress, SfmJobOptions, SfmPhoto, SfmPhotoError, sfm_covariance, sfm_pairs, sfm_photo,
    sfm_solve,
};
use dense::DenseArgs;
use earlier::Earlier;
use outcome::{doubt, fates, outcome};
use photographs::{Photograph, photographs, seen_from};
use pinhole::PinholeFolder;
use places::{Frame, PlaceArgs, Places};
use std::path::{Path, PathBuf};

/// Reconstruct cameras and a sparse cloud of points from many photographs (structure from motion).
///
/// The photographs need no order. Without --camera and --focal, focal lengths come from EXIF and are refined; photographs of one size and one focal length share a camera. A photograph that
/// cannot be read, or that shows something else, is left out and told of.
///
/// The model stands upright, Z up. Where three photographs or more tell their GPS position, it is in meters from the first of them (X east, Y north); else --known or --distance tell meters, or
/// its unit is arbitrary.
///
/// The model is COLMAP's: cameras, images and points3D, as .txt or .bin. One that is in the folder is replaced. Where the photographs fall apart into several models, the one with most
/// photographs is written into the folder itself, the others into its folders 1, 2, …
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv sfm photos/ -o model --report page\n  \
    cv sfm 'photos/*.jpg' --camera cam.yaml -o model --cloud points.ply\n  \
    cv sfm 'frames/*.png' --order sequence -o model                    # frames of a video, or of a drive\n  \
    cv sfm photos/ --focal 2900 -o sparse/0 --format colmap-binary --json\n  \
    cv sfm photos/ -o model --distance a.jpg b.jpg 2.5                 # meters between two photographs\n  \
    cv sfm photos/ more/ --from model -o model                         # more photographs of the same place\n  \
    cv sfm photos/ -o model --transforms photos/transforms.json        # for Nerfstudio and instant-ngp\n  \
    cv sfm photos/ -o model --dense dense.ply                          # surfaces as points with normals\n  \
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
    /// A model of some of the photographs, as COLMAP's text or binary: its poses are gone on from, its lenses stay as they are, its frame is kept, and the photographs that it lacks are added.
    #[arg(long, value_name = "DIR", conflicts_with_all = ["camera", "focal"])]
    from: Option<PathBuf>,
    /// Estimate the focal length even where the photographs' EXIF has one.
    #[arg(long, conflicts_with_all = ["camera", "focal"])]
    ignore_exif: bool,
    /// Largest reprojection error of a point that is kept, in pixels.
    #[arg(long, value_name = "PX", default_value_t = SfmJobOptions::default().solve.max_error)]
    max_error: f64,
    /// How poses are found.
    #[arg(long, value_name = "SOLVER", value_parser = named::<Solver>(), default_value_t = Solver::default())]
    solver: Solver,
    /// In what order the photographs come: it tells which pairs are tried.
    #[arg(long, value_name = "ORDER", value_parser = named::<PhotoOrder>(), default_value_t = PhotoOrder::default())]
    order: PhotoOrder,
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
    /// Where to write how well the cameras and points of the largest model are known: standard deviations, as JSON. They are relative to one photograph's pose and its distance from another.
    #[arg(long, value_name = "FILE")]
    covariance: Option<PathBuf>,
    /// Go on with a run into the same folder that was stopped: what it found in the same photographs by the same options is taken.
    #[arg(long)]
    resume: bool,
    /// Keep features and pairs (in .cv-sfm of the output's folder) when the model is done, for runs with --resume over more photographs or by other options of the solution.
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
            return Err(Failure::usage(format!("{} is one photograph, too few for a model", only.display()))
                .advice("two at least; ten or more of one place are usual"));
        }
        let all = photographs(named)?;
        let places = self.places.read(&all, context)?;
        let pinhole = self.pinhole.as_ref().map(|folder| PinholeFolder::new(folder, &all)).transpose()?;
        let earlier = self.from.as_ref().map(|folder| Earlier::read(folder, &all, context)).transpose()?;
        let checkpoint = Checkpoint::new(&self.output, self.resume, context);
        let told = Told { places, earlier, pinhole };
        let outcome = self.reconstruct(all, told, &options, &checkpoint, context);
        checkpoint.end(self.keep, outcome.is_ok());
        outcome
    }
}

impl Args {
    fn reconstruct(
        &self,
        mut all: Vec<Photograph>,
        told: Told<'_>,
        options: &SfmJobOptions,
        checkpoint: &Checkpoint<'_>,
        context: &Context,
    ) -> Result<Outcome, Failure> {
        let mut clock = cv_core::StageClock::new();
        let (mut cameras, mut photos, mut used) = (Cameras::default(), Vec::new(), Vec::new());
        let total = all.len();
        for (i, one) in all.iter_mut().enumerate() {
            if one.refused.is_none() {
                let camera = |cameras: &mut Cameras, size, exif: Option<f64>| match told
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
        let known = told.earlier.as_ref().map_or_else(Vec::new, |earlier| earlier.poses(&used));
        let mut result = sfm_solve(&photos, cameras.list(), (pairs, &geometry), &known, options, context)
            .map_err(words::many_views::no_model)?;
        let frames = told.frames(&self.places, &mut result.models, &all, &used, context)?;
        let models: Vec<SparseModel> =
            (0..result.models.len()).filter_map(|m| result.sparse_model(m, &photos)).collect();
        let Some(main) = models.first() else { return Err(Failure::new("there is no model")) };
        let fates = fates(&all, &used, &result.outcomes);
        let mut stages = clock.into_stages();
        stages.extend(result.stages.iter().copied());
        let mut clock = cv_core::StageClock::new();
        self.write(&models, &all, &used, context)?;
        if let Some(folder) = &told.pinhole {
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
            let of = sfm_covariance(&photos, cameras.list(), model)?;
            let text = covariance::deviations(&of, &names, &frame.json["unit"]).to_string();
            context.write(Output::File(path, JSON), |path| cv_io::write_bytes(path, text.as_bytes()))?;
            clock.lap("covariance");
        }
        stages.extend(clock.into_stages());
        if let Some(text) = doubt(&models, &fates) {
            context.warn(text);
        }
        context.report(|| report::report(&all, &fates, &models, &frames, &stages))?;
        let done = outcome(&all, &fates, &models, &frames, &result, checkpoint.taken(), stages);
        Ok(match &dense {
            Some(dense) => done.with("dense_points", dense.cloud.len()).with("dense_pairs", dense.pairs.len()),
            None => done,
        })
    }

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
        options.order = self.order;
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
        one: &mut Photograph,
        mut camera: impl FnMut((usize, usize), Option<f64>) -> Result<Result<usize, String>, Failure>,
        options: &SfmJobOptions,
        checkpoint: &Checkpoint<'_>,
        place: &PhotoProgress<'_>,
    ) -> Result<Result<SfmPhoto, String>, Failure> {
        place.report("photographs", 0, 0)?;
        let (key, found) = checkpoint.seen(one, options);
        let new = found.is_none();
        let seen = match found {
            Some(seen) => seen,
            None => match self.look_at(one, &mut camera, options, place)? {
                Ok(seen) => seen,
                Err(reason) => return Ok(Err(reason)),
            },
        };
        let camera = match camera(seen.photo.size, seen.focal)? {
            Ok(camera) => camera,
            Err(reason) => return Ok(Err(reason)),
        };
        if new {
            checkpoint.keep_seen(key, &seen);
        }
        checkpoint.add(key);
        one.gps = seen.gps;
        Ok(Ok(SfmPhoto { name: one.name.clone(), camera, ..seen.photo }))
    }

    /// What a photograph shows, or why it is left out.
    fn look_at(
        &self,
        one: &Photograph,
        mut camera: impl FnMut((usize, usize), Option<f64>) -> Result<Result<usize, String>, Failure>,
        options: &SfmJobOptions,
        place: &PhotoProgress<'_>,
    ) -> Result<Result<Seen, String>, Failure> {
        let image = match cv_io::read_image(&one.path) {
            Ok(image) => image,
            Err(error) => return Ok(Err(words::many_views::not_read(&error))),
        };
        let (focal, gps) = (image.exif.focal.map(|f| f.pixels), image.exif.gps);
        // Before the work.
        if let Err(reason) = camera(image.size(), focal)? {
            return Ok(Err(reason));
        }
        let rgb = image.into_rgb8();
        match sfm_photo(rgb.view(), String::new(), 0, &options.features, place) {
            Ok(photo) => Ok(Ok(Seen { focal, gps, photo })),
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

/// What the person tells of the photographs, and the folder of those without distortion.
struct Told<'a> {
    places: Places,
    earlier: Option<Earlier>,
    pinhole: Option<PinholeFolder<'a>>,
}

impl Told<'_> {
    /// Brings each model to what is known: by the person's own numbers, by an earlier model, or by what the photographs say of themselves.
    fn frames(
        &self,
        args: &PlaceArgs,
        models: &mut [SfmModel],
        all: &[Photograph],
        used: &[usize],
        context: &Context,
    ) -> Result<Vec<Frame>, Failure> {
        let earlier = self.earlier.as_ref().filter(|_| !self.places.is_told());
        let places = self.places.with_gps(args, all);
        let one = |model: &mut SfmModel| match earlier.and_then(|earlier| earlier.align(model, used)) {
            Some(frame) => Ok(frame),
            None => places.align(model, all, used, context),
        };
        models.iter_mut().map(one).collect()
    }
}
