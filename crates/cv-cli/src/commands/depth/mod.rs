//! `cv depth`: disparity, depth and a cloud from two photographs.

mod frames;
mod maps;
mod options;
mod pairing;
mod report;

use super::size;
use crate::frame::{CLOUD, Context, Failure, Global, MAP, Outcome, Output, PNG, Run, named, stands_for_many};
use crate::photos::{Photos, at_own_depth};
use crate::{rig, words};
use cv_core::{ImageView, PointCloud};
use cv_io::ply::PlyEncoding;
use cv_pipeline::stereo::{
    Census, IntensityCost, Paths, PixelState, Rectification, RectifyOptions, Smoothing, StereoGeometry, StereoMatcher,
    StereoOptions,
};
use cv_pipeline::{DepthError, DepthOptions, DepthResult, RigDepthResult, depth, depth_by_rig};
use maps::write_map;
use options::{Range, parse_range};
use pairing::PairBy;
use std::path::{Path, PathBuf};

pub(crate) use maps::read_map;
pub(crate) use report::fractions;

/// Compute disparity, and depth where the geometry is known, from a left and a right photograph.
///
/// Without --rig the photographs must be rectified: the same scene point lies in the same row of both. Disparity is the
/// column in the left photograph minus that in the right one. Pixels that only the left camera sees are filled from their
/// surroundings unless --no-fill is given.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv depth left.png right.png -o disparity.pfm\n  \
    cv depth left.png right.png -o d.pfm --focal 1000 --baseline 0.12 --depth depth.pfm --cloud cloud.ply\n  \
    cv depth left.png right.png --disparities auto -o disparity.npy\n  \
    cv depth left right -o disparities\n  \
    cv depth left.jpg right.jpg --rig rig.yaml -o disparity.png --depth depth.png --report out\n\n\
    The ending of a file tells its format: .pfm (floats, +inf where unknown), .npy (floats, NaN), .png (disparity as KITTI's\n\
    16-bit PNG, 256 steps a pixel; depth as 16-bit millimeters, where the baseline is in meters or the rig file tells its unit); 0 is unknown in both.")]
pub(crate) struct Args {
    /// The left photograph, or a folder or quoted pattern ('left/*.png', 'left_%04d.png') of frames.
    left: PathBuf,
    /// The right photograph, or as many frames.
    right: PathBuf,
    /// What a shell makes of a pattern without quotes.
    #[arg(hide = true)]
    more: Vec<PathBuf>,
    /// Where to write the disparity: .pfm, .png or .npy; for frames a folder, which gets NAME.pfm of each.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// How frames are paired [default: by name where the names are the same, else by number]. Frames without a partner are
    /// refused.
    #[arg(long, value_name = "HOW", value_parser = named::<PairBy>())]
    pair_by: Option<PairBy>,
    /// Where to write the depth, in the unit of the baseline: .pfm, .png or .npy. Needs --rig, or --focal and --baseline.
    #[arg(long, value_name = "FILE")]
    depth: Option<PathBuf>,
    /// Where to write a colored point cloud, as PLY, in the frame of the left camera: x right, y down, z ahead. Needs what --depth
    /// needs.
    #[arg(long, value_name = "FILE")]
    cloud: Option<PathBuf>,
    /// Calibration of the rig, ours, OpenCV's or Kalibr's YAML, twice for OpenCV's two files (see `cv rectify --help`): the photographs are rectified first, and the maps
    /// are those of the rectified left (or upper) one, which `cv rectify` writes.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["focal", "baseline"])]
    rig: Vec<PathBuf>,
    /// The rig file has the cameras in the other order: its first one took the right (or lower) photograph.
    #[arg(long, requires = "rig")]
    exchange: bool,
    /// Width and height of the rectified photographs, such as 1280x960 [default: as `cv rectify`].
    #[arg(long, value_name = "WxH", value_parser = size, requires = "rig")]
    size: Option<(usize, usize)>,
    /// Number of disparities to try, in pixels, or auto: from feature matches.
    #[arg(long, value_name = "N|auto", default_value = "128", value_parser = parse_range)]
    disparities: Range,
    /// Smallest disparity to try, in pixels; may be negative [default: 0, or that of auto].
    #[arg(long, value_name = "PX", allow_negative_numbers = true)]
    min_disparity: Option<i32>,
    /// Focal length of the rectified photographs in pixels.
    #[arg(long, value_name = "PX", requires = "baseline")]
    focal: Option<f64>,
    /// Distance between the cameras; its unit is the unit of the depth.
    #[arg(long, value_name = "B", requires = "focal")]
    baseline: Option<f64>,
    /// Right principal point minus left one, x, in pixels (doffs of Middlebury's calib.txt).
    #[arg(long, value_name = "PX", default_value_t = 0.0, allow_negative_numbers = true, requires = "focal")]
    offset: f64,
    /// Nearest depth to keep.
    #[arg(long, value_name = "Z", default_value_t = 0.0)]
    near: f32,
    /// Farthest depth to keep [default: all].
    #[arg(long, value_name = "Z")]
    far: Option<f32>,
    /// Directions of cost aggregation.
    #[arg(long, value_name = "N", value_parser = named::<Paths>(), default_value_t = StereoOptions::default().paths)]
    paths: Paths,
    /// Matching window.
    #[arg(long, value_name = "N", value_parser = named::<Census>(), default_value_t = StereoOptions::default().census)]
    census: Census,
    /// Penalty for a disparity step of one pixel, in bits of the window.
    #[arg(long, value_name = "BITS", default_value_t = StereoOptions::default().p1)]
    p1: u8,
    /// Penalty for a larger step where the photograph has no edge, in bits of the window.
    #[arg(long, value_name = "BITS", default_value_t = StereoOptions::default().p2)]
    p2: u8,
    /// By how many percent the best match must beat the rest.
    #[arg(long, value_name = "PERCENT", default_value_t = StereoOptions::default().uniqueness)]
    uniqueness: u8,
    /// Remove patches of up to this many pixels; 0 for none.
    #[arg(long, value_name = "PIXELS", default_value_t = StereoOptions::default().speckle_size)]
    speckle_size: usize,
    /// Leave pixels without a match of their own unknown.
    #[arg(long)]
    no_fill: bool,
    /// What to add to the number of differing bits: sharper outlines.
    #[arg(long, value_name = "WHAT", value_parser = named::<IntensityCost>(), default_value_t = StereoOptions::default().intensity_cost)]
    blend: IntensityCost,
    /// Edge-preserving smoothing.
    #[arg(long, value_name = "HOW", value_parser = named::<Smoothing>(), default_value_t = StereoOptions::default().smoothing)]
    smoothing: Smoothing,
    /// Strength of --smoothing wls [default: 100].
    #[arg(long, value_name = "L")]
    lambda: Option<f32>,
    /// Gray levels (of 255) across which --smoothing does not reach [default: 24; 1.5 for wls].
    #[arg(long, value_name = "LEVELS")]
    sigma: Option<f32>,
    /// Where to write how sure each disparity is, from 0 to 1 (0 where filled): .pfm, .npy or .png (0 to 255).
    #[arg(long, value_name = "FILE")]
    confidence: Option<PathBuf>,
    /// Where to write where each disparity comes from, as a PNG: 255 matched, 0 filled.
    #[arg(long, value_name = "PNG")]
    matched: Option<PathBuf>,
    /// Where to write the standard deviation of the depth, or of the disparity without a geometry; unknown where filled:
    /// .pfm, .npy or .png (as --depth or the disparity).
    #[arg(long, value_name = "FILE")]
    uncertainty: Option<PathBuf>,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        if stands_for_many(&self.left) {
            return vec![Output::Folder(&self.output)];
        }
        let maps = [Some(&self.output), self.depth.as_ref(), self.confidence.as_ref(), self.uncertainty.as_ref()];
        let maps = maps.into_iter().flatten().map(|path| Output::File(path, MAP));
        let others = [(&self.cloud, CLOUD), (&self.matched, PNG)];
        maps.chain(others.into_iter().filter_map(|(path, endings)| Some(Output::File(path.as_ref()?, endings))))
            .collect()
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        if !self.more.is_empty() {
            return Err(Failure::usage(format!(
                "a left and a right photograph are needed, not {}",
                2 + self.more.len()
            ))
            .advice("for frames give two folders, or two patterns in quotes: 'left/*.png' 'right/*.png'"));
        }
        if stands_for_many(&self.left) || stands_for_many(&self.right) {
            return self.run_frames(context);
        }
        if self.pair_by.is_some() {
            return Err(Failure::usage("--pair-by is for frames, and these are two photographs"));
        }
        if (self.depth.is_some() || self.cloud.is_some()) && self.rig.is_empty() && self.focal.is_none() {
            return Err(Failure::usage("depth needs the geometry of the cameras")
                .advice("give --focal and --baseline, or --rig"));
        }
        let photos = Photos::read(&self.left, &self.right)?;
        let options = self.options(context);
        // A baseline that is given by itself counts as one in meters.
        let (job, meters) = match self.rig.first() {
            Some(path) => self.by_rig(path, &photos, &options, context)?,
            None => (self.rectified(photos, &options, context)?, 1.0),
        };
        let write_depth = |path: &Path, map: ImageView<'_, f32, 1>| {
            cv_io::depth_mm::write(path, map.to_image().map(|[z]| [(f64::from(z) * meters) as f32]).view())
        };
        let DepthResult { map, depth, disparities, .. } = &job.maps;
        if self.disparities == Range::Auto {
            context.note(format!("disparities {} to {}", disparities.0, disparities.0 + disparities.1 as i32 - 1));
        }
        if let Some(lost) =
            write_map(context, &self.output, map.disparity.view(), |path, map| cv_io::kitti::write(path, map))?
        {
            context
                .warn(format!("{lost} disparities do not fit KITTI's range of 0 to 256 px and are stored as unknown"));
        }
        if let (Some(path), Some(depth)) = (&self.depth, depth)
            && let Some(lost) = write_map(context, path, depth.view(), write_depth)?
        {
            context.warn(format!("{lost} depths do not fit 0 to 65.535 m and are stored as unknown"));
        }
        self.write_quality(&job.maps, write_depth, context)?;
        if let Some(path) = &self.cloud {
            let cloud = |path: &Path| cv_io::ply::write_cloud(path, &job.cloud, PlyEncoding::Binary);
            context.write(Output::File(path, CLOUD), cloud)?;
        }
        context.report(|| report::report(&job))?;
        let (valid, matched) = (map.valid_fraction(), map.matched_fraction());
        if job.maps.is_mostly_filled() {
            context.warn(format!(
                "only {:.1} % of the pixels were matched; the others are filled in from around, and of such pixels about four in ten are wrong (--no-fill leaves them unknown)",
                100.0 * matched
            ));
        }
        let (width, height) = map.disparity.size();
        Ok(Outcome::new(job.maps.stages.clone())
            .with("width", width)
            .with("height", height)
            .with("valid_fraction", valid)
            .with("matched_fraction", matched)
            .with("disparities", disparities.1)
            .with("min_disparity", disparities.0)
            .summary(format!(
                "{width}×{height} px, {:.1} % matched and confirmed, {:.1} % with a disparity",
                100.0 * matched,
                100.0 * valid
            )))
    }
}

impl Args {
    /// Matches photographs that are rectified already.
    fn rectified(&self, photos: Photos, options: &DepthOptions, context: &Context) -> Result<RigDepthResult, Failure> {
        let [(width, height), right] = photos.sizes();
        if (width, height) != right {
            return Err(Failure::new(format!(
                "{} is {width}×{height} px, {} is {}×{} px: both must have the same size",
                self.left.display(),
                self.right.display(),
                right.0,
                right.1
            )));
        }
        let geometry = match (self.focal, self.baseline) {
            (Some(focal), Some(baseline)) => {
                let geometry = StereoGeometry::from_focal(width, height, focal, baseline)
                    .map_err(|error| Failure::usage(error).advice("give positive numbers"))?;
                Some(StereoGeometry { offset: self.offset, ..geometry })
            }
            _ => None,
        };
        self.say_memory(options, (width, height), context)?;
        let maps = at_own_depth!(photos, |a, b| depth(a, b, geometry.as_ref(), options, context))
            .map_err(|error| words::no_depth(error, false))?;
        let images = photos.into_rgb();
        let wanted = self.cloud.is_some() || context.wants_report();
        let cloud = if wanted { maps.cloud(images[0].view()).unwrap_or_default() } else { PointCloud::default() };
        Ok(RigDepthResult { images, maps, cloud })
    }

    /// Rectifies and matches photographs of a rig. Also tells how many meters its unit has.
    fn by_rig(
        &self,
        path: &Path,
        photos: &Photos,
        options: &DepthOptions,
        context: &Context,
    ) -> Result<(RigDepthResult, f64), Failure> {
        let [left, right] = photos.sizes();
        let file = rig::read(&self.rig, left, self.exchange, context)?;
        let (meters, rig) = (file.meters_per_unit().unwrap_or(1.0), file.rig);
        rig::check_size(path, &self.left, left, &rig.left)?;
        rig::check_size(path, &self.right, right, &rig.right)?;
        let settings = RectifyOptions { size: self.size, ..RectifyOptions::default() };
        let rectification =
            Rectification::new(&rig, &settings).map_err(|error| words::no_rectification(error, path, self.exchange))?;
        if rectification.vertical {
            context.note("the rig is vertical: the maps are those of the photograph turned by a quarter, as `cv rectify` turns it");
        }
        let camera = &rectification.left.camera;
        self.say_memory(options, (camera.width, camera.height), context)?;
        at_own_depth!(photos, |a, b| depth_by_rig(a, b, &rectification, options, context))
            .map(|result| (result, meters))
            .map_err(|error| match error {
                DepthError::Rectify(error) => words::no_rectification(error, path, self.exchange),
                error => words::no_depth(error, true),
            })
    }

    /// Tells what matching will take, before it is asked for; of a range that is still to be found nothing can be told.
    fn say_memory(&self, options: &DepthOptions, size: (usize, usize), context: &Context) -> Result<(), Failure> {
        if self.disparities == Range::Auto { Ok(()) } else { say_memory(&options.stereo, size, context) }
    }

    /// Confidence, origin and uncertainty, where asked for.
    fn write_quality(
        &self,
        maps: &DepthResult,
        write_depth: impl FnOnce(&Path, ImageView<'_, f32, 1>) -> Result<usize, cv_io::IoError>,
        context: &Context,
    ) -> Result<(), Failure> {
        let DepthResult { map, confidence, sigma, .. } = maps;
        if let (Some(path), Some(confidence)) = (&self.confidence, confidence) {
            let gray = |path: &Path, map: ImageView<'_, f32, 1>| {
                let bytes =
                    cv_core::GrayU8::from_fn(map.width(), map.height(), |x, y| [(map.at(x, y)[0] * 255.0 + 0.5) as u8]);
                cv_io::write_png(path, bytes.view()).map(|()| 0)
            };
            write_map(context, path, confidence.view(), gray)?;
        }
        if let Some(path) = &self.matched {
            let matched = map.state.map(|[state]| [if state == PixelState::Matched { 255u8 } else { 0 }]);
            context.write(Output::File(path, PNG), |path| cv_io::write_png(path, matched.view()))?;
        }
        if let Some(path) = &self.uncertainty {
            let lost = match maps.depth_sigma() {
                Some(bars) => write_map(context, path, bars.view(), write_depth)?,
                None => write_map(context, path, sigma.view(), |path, map| cv_io::kitti::write(path, map))?,
            };
            if let Some(lost) = lost {
                context.warn(format!("{lost} uncertainties do not fit the format and are stored as unknown"));
            }
        }
        Ok(())
    }
}

/// Tells what matching will take, before it is asked for.
fn say_memory(options: &StereoOptions, (width, height): (usize, usize), context: &Context) -> Result<(), Failure> {
    let matcher = StereoMatcher::new(options.clone()).map_err(|error| words::no_depth(error.into(), false))?;
    let mib = matcher.memory(width, height) as f64 / f64::from(1 << 20);
    context.note(format!("matching {width}×{height} px at {} disparities takes {mib:.1} MiB", options.disparities));
    Ok(())
}
