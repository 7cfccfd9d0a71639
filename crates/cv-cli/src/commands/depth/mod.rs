//! `cv depth`: disparity, depth and a point cloud from a stereo pair.

mod frames;
mod maps;
mod options;
pub(super) mod pairing;
mod report;

use super::size;
use crate::frame::{
    CLOUD, Context, Failure, Global, MAP, Outcome, Output, PNG, Run, Step, named, stands_for_many, steps,
};
use crate::photos::{Photos, at_own_depth};
use crate::{rig, words};
use cv_core::ImageView;
use cv_io::ply::PlyEncoding;
use cv_pipeline::stereo::{
    Census, DisparityMap, IntensityCost, Paths, PixelState, Rectification, RectifyOptions, Search, Smoothing,
    StereoGeometry, StereoMatcher, StereoOptions, VerticalOffset,
};
use cv_pipeline::{DepthError, DepthOptions, DepthResult, FrameDepth, RigDepthResult};
use maps::write_map;
use options::{Range, parse_range};
use pairing::PairBy;
use std::path::{Path, PathBuf};

pub(crate) use maps::read_map;
pub(crate) use report::{fractions, scene};

/// Compute a disparity map, and depth if the geometry is known, from a stereo pair.
///
/// Without --rig the pair must be rectified: corresponding points lie in the same row. Disparity is the column in the
/// left image minus the column in the right one. Occluded and mismatched pixels are filled from their surroundings
/// unless --no-fill is given. The black borders of rectified images have no disparity.
#[derive(Debug, Clone, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv depth left.png right.png -o disparity.pfm\n  \
    cv depth left.png right.png -o d.pfm --focal 1000 --baseline 0.12 --depth depth.pfm --cloud cloud.ply\n  \
    cv depth left.png right.png --disparities auto -o disparity.npy\n  \
    cv depth left.png right.png --quality -o disparity.pfm\n  \
    cv depth left right --sequence -o disparities\n  \
    cv depth left.jpg right.jpg --rig rig.yaml -o disparity.png --depth depth.png --report out\n\n\
    The extension selects the format: .pfm (floats, invalid +inf), .npy (floats, invalid NaN), .png (disparity as KITTI's\n\
    16-bit PNG, 256 steps a pixel; depth as 16-bit millimeters, if the baseline is in meters or the rig file has its unit; invalid 0).")]
pub(crate) struct Args {
    /// The left photograph, or a folder or quoted pattern ('left/*.png', 'left_%04d.png') of frames.
    left: PathBuf,
    /// The right photograph, or the frames of the right camera.
    right: PathBuf,
    /// Further arguments: an unquoted pattern, expanded by the shell.
    #[arg(hide = true)]
    more: Vec<PathBuf>,
    /// Where to write the disparity: .pfm, .png or .npy; for frames a folder, which gets NAME.pfm of each. For frames, all other outputs are folders
    /// too, which get NAME.pfm, NAME.ply (--cloud) or NAME.png (--matched).
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// How frames are paired [default: by name if the names are the same, else by number]. Unpaired frames are refused.
    #[arg(long, value_name = "HOW", value_parser = named::<PairBy>())]
    pair_by: Option<PairBy>,
    /// The frames are consecutive: average noise over time where the images do not change, so that disparities flicker half as much. Objects that move leave no trail; while
    /// the camera moves, nothing is averaged.
    #[arg(long)]
    sequence: bool,
    /// Where to write the depth, in the unit of the baseline: .pfm, .png or .npy. Needs --rig, or --focal and --baseline.
    #[arg(long, value_name = "FILE")]
    depth: Option<PathBuf>,
    /// Where to write a colored point cloud, as PLY, in the frame of the left camera: x right, y down, z forward. Needs --rig, or --focal and
    /// --baseline.
    #[arg(long, value_name = "FILE")]
    cloud: Option<PathBuf>,
    /// Calibration of the rig: our, OpenCV's or Kalibr's YAML; twice for OpenCV's two files (see `cv rectify --help`). The pair is rectified first; the maps are those of the
    /// rectified left (or upper) image, as written by `cv rectify`.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["focal", "baseline"])]
    rig: Vec<PathBuf>,
    /// The first camera of the rig file took the right (or lower) photograph.
    #[arg(long, requires = "rig")]
    exchange: bool,
    /// Width and height of the rectified images, such as 1280x960 [default: as `cv rectify`].
    #[arg(long, value_name = "WxH", value_parser = size, requires = "rig")]
    size: Option<(usize, usize)>,
    /// Size of the disparity search range in pixels, or auto: from the images at a fraction of their size (for frames, of the first pair).
    #[arg(long, value_name = "N|auto", default_value = "128", value_parser = parse_range)]
    disparities: Range,
    /// Smallest disparity of the search range in pixels; may be negative [default: 0, or from auto].
    #[arg(long, value_name = "PX", allow_negative_numbers = true)]
    min_disparity: Option<i32>,
    /// Focal length of the rectified images in pixels.
    #[arg(long, value_name = "PX", requires = "baseline")]
    focal: Option<f64>,
    /// Baseline: the distance between the cameras. Its unit is the unit of the depth.
    #[arg(long, value_name = "B", requires = "focal")]
    baseline: Option<f64>,
    /// Difference cx_right - cx_left of the principal points in pixels (`doffs` in Middlebury's calib.txt).
    #[arg(long, value_name = "PX", default_value_t = 0.0, allow_negative_numbers = true, requires = "focal")]
    offset: f64,
    /// Nearest depth to keep.
    #[arg(long, value_name = "Z", default_value_t = 0.0)]
    near: f32,
    /// Farthest depth to keep [default: all].
    #[arg(long, value_name = "Z")]
    far: Option<f32>,
    /// Disparities that each pixel is compared at. `auto` is hierarchical from 2^28 pixels times disparities on (6 megapixels at 45).
    #[arg(long, value_name = "HOW", value_parser = named::<Search>(), default_value_t = StereoOptions::default().search)]
    search: Search,
    /// Directions of cost aggregation.
    #[arg(long, value_name = "N", value_parser = named::<Paths>(), default_value_t = StereoOptions::default().paths)]
    paths: Paths,
    /// Census window.
    #[arg(long, value_name = "N", value_parser = named::<Census>(), default_value_t = StereoOptions::default().census)]
    census: Census,
    /// Smoothness penalty P1 for a disparity change of one pixel, in bits of the census window.
    #[arg(long, value_name = "BITS", default_value_t = StereoOptions::default().p1)]
    p1: u8,
    /// Smoothness penalty P2 for a larger change where the image has no gradient, in bits of the census window.
    #[arg(long, value_name = "BITS", default_value_t = StereoOptions::default().p2)]
    p2: u8,
    /// Pyramid levels, each of half the resolution, that guide low-texture regions (roads, walls); 0 for none.
    #[arg(long, value_name = "N", default_value_t = StereoOptions::default().pyramid_levels)]
    pyramid_levels: u8,
    /// Uniqueness ratio: margin in percent by which the lowest cost must be below the second lowest.
    #[arg(long, value_name = "PERCENT", default_value_t = StereoOptions::default().uniqueness)]
    uniqueness: u8,
    /// Remove speckles of up to this many pixels; 0 for none.
    #[arg(long, value_name = "PIXELS", default_value_t = StereoOptions::default().speckle_size)]
    speckle_size: usize,
    /// Leave unmatched pixels invalid instead of filling them.
    #[arg(long)]
    no_fill: bool,
    /// Quality mode: local expansion moves over slanted planes. Sharper depth discontinuities and planar surfaces, a fifth fewer errors, half as many on roads, about forty-five times the time.
    #[arg(long)]
    quality: bool,
    /// Intensity term added to the census cost, for sharper depth discontinuities.
    #[arg(long, value_name = "WHAT", value_parser = named::<IntensityCost>(), default_value_t = StereoOptions::default().intensity_cost)]
    blend: IntensityCost,
    /// Edge-preserving smoothing.
    #[arg(long, value_name = "HOW", value_parser = named::<Smoothing>(), default_value_t = StereoOptions::default().smoothing)]
    smoothing: Smoothing,
    /// Strength of --smoothing wls [default: 100].
    #[arg(long, value_name = "L")]
    lambda: Option<f32>,
    /// Intensity difference, in gray levels of 255, above which --smoothing preserves edges [default: 24; 1.5 for wls].
    #[arg(long, value_name = "LEVELS")]
    sigma: Option<f32>,
    /// Do not correct vertical disparity. By default, a vertical disparity of a tenth of a pixel to 8 px (epipolar misalignment) is estimated and the right image warped;
    /// for frames, the correction of the first pair that determines it, of eight, is used for all.
    #[arg(long)]
    no_align: bool,
    /// Keep the result of a poorly matched pair. By default, a pair of which less than a fifth of the pixels is matched is refused if feature matches show what is wrong
    /// with it.
    #[arg(long)]
    force: bool,
    /// Where to write the confidence of each disparity, from 0 to 1 (0 where filled): .pfm, .npy or .png (0 to 255).
    #[arg(long, value_name = "FILE")]
    confidence: Option<PathBuf>,
    /// Where to write the mask of matched pixels, as a PNG: 255 matched, 0 filled or invalid.
    #[arg(long, value_name = "PNG")]
    matched: Option<PathBuf>,
    /// Where to write the standard deviation of the depth, or of the disparity without a geometry; of filled pixels by how far their surface was extrapolated:
    /// .pfm, .npy or .png (as --depth or the disparity).
    #[arg(long, value_name = "FILE")]
    uncertainty: Option<PathBuf>,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let maps = [Some(&self.output), self.depth.as_ref(), self.confidence.as_ref(), self.uncertainty.as_ref()];
        let maps = maps.into_iter().flatten().map(|path| (path, MAP));
        let others = [(&self.cloud, CLOUD), (&self.matched, PNG)];
        let others = others.into_iter().filter_map(|(path, endings)| Some((path.as_ref()?, endings)));
        // One file per frame.
        let many = stands_for_many(&self.left);
        let output = |(path, endings)| if many { Output::Folder(path) } else { Output::File(path, endings) };
        maps.chain(others).map(|(path, endings): (&PathBuf, _)| output((path.as_path(), endings))).collect()
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed]
    }

    fn steps(&self) -> Vec<Step> {
        if stands_for_many(&self.left) {
            return vec![steps::FRAMES];
        }
        let rectified = (!self.rig.is_empty()).then_some(steps::RECTIFY);
        let range = (self.disparities == Range::Auto).then_some(steps::RANGE);
        let quality = self.quality.then_some(steps::EXPAND);
        rectified.into_iter().chain(range).chain([steps::DISPARITIES]).chain(quality).chain([steps::DEPTH]).collect()
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        if !self.more.is_empty() {
            return Err(Failure::usage(format!(
                "a left and a right photograph are needed, got {}",
                2 + self.more.len()
            ))
            .advice("for frames give two folders, or two patterns in quotes: 'left/*.png' 'right/*.png'"));
        }
        if (self.depth.is_some() || self.cloud.is_some()) && self.rig.is_empty() && self.focal.is_none() {
            return Err(Failure::usage("depth needs the geometry of the cameras")
                .advice("give --focal and --baseline, or --rig"));
        }
        if stands_for_many(&self.left) || stands_for_many(&self.right) {
            return self.run_frames(context);
        }
        if self.pair_by.is_some() {
            return Err(Failure::usage("--pair-by applies to sequences of frames, not to a single pair"));
        }
        if self.sequence {
            return Err(Failure::usage("--sequence applies to frames, not to a single pair")
                .advice("give two folders or patterns of frames"));
        }
        let photos = Photos::read(&self.left, &self.right)?;
        let mut sequence = self.sequence(&photos, [&self.left, &self.right], context)?;
        let points = self.wants_points(context);
        let job = at_own_depth!(photos, |a, b| sequence.frames.next_depth(a, b, points, context));
        let job = job.map_err(|error| self.failure(error))?;
        self.report_range(&sequence, context);
        self.write(&job, sequence.meters_per_unit, context)?;
        let DepthResult { map, disparities, .. } = &job.maps;
        let (valid, matched) = (map.valid_fraction(), map.matched_fraction());
        if let Some(offset) = &job.maps.vertical_offset {
            report_alignment(offset, context);
        }
        warn_of_filling(&job.maps, context);
        report_border(map.no_data_fraction(), context);
        context.report(|| report::report(&job, &[]))?;
        let (width, height) = map.disparity.size();
        Ok(Outcome::new(job.maps.stages.clone())
            .with("width", width)
            .with("height", height)
            .with("valid_fraction", valid)
            .with("matched_fraction", matched)
            .with("no_data_fraction", map.no_data_fraction())
            .with("disparities", disparities.1)
            .with("min_disparity", disparities.0)
            .with("vertical_offset", job.maps.vertical_offset.map(|offset| offset.coefficients()))
            .summary(format!(
                "{width}×{height} px, {:.1} % matched and confirmed, {:.1} % with a disparity",
                100.0 * matched,
                100.0 * valid
            )))
    }
}

/// Reports that the vertical disparity of the pair was corrected; warns if the cameras should be calibrated again.
fn report_alignment(offset: &VerticalOffset, context: &Context) {
    let size = format!("vertical disparity of up to {:.2} px", offset.largest());
    if offset.is_notable() {
        context.warn(format!(
            "the pair had a {size} ({:+.2} at the center, {:+.2} from left to right, {:+.2} from top to bottom); the rows have been aligned: recalibrate the cameras, or see --no-align",
            offset.at_center, offset.across, offset.down
        ));
    } else {
        context.note(format!("a {size} has been corrected; --no-align disables this"));
    }
}

/// Reports the fraction of the left image that is a black border.
fn report_border(fraction: f64, context: &Context) {
    if fraction > 0.0 {
        context.note(format!(
            "{:.1} % of the left image is a black border of rectification: it has no disparity, and the other fractions are of the rest",
            100.0 * fraction
        ));
    }
}

/// Warns if few pixels were matched, and if most of the map is filled.
fn warn_of_filling(maps: &DepthResult, context: &Context) {
    if let Some(few) = maps.feature_agreement {
        let doubt = if few.is_enough() { "" } else { ", too few to trust the map" };
        context.warn(format!(
            "only {:.1} % of the pixels were matched and confirmed: low texture, repetitive structure or moving objects; of {} features on them {} have a consistent disparity{doubt}",
            100.0 * maps.map.matched_fraction(), few.seen, few.agree
        ));
    }
    if maps.is_mostly_filled() {
        context.warn(format!(
            "only {:.1} % of the pixels were matched; the others are filled from their surroundings, of which about one in four is wrong (--no-fill leaves them invalid)",
            100.0 * maps.map.matched_fraction()
        ));
    }
}

/// A matcher for one pair or for consecutive frames of the same size.
struct Sequence {
    frames: FrameDepth,
    /// Width and height of the maps.
    size: (usize, usize),
    /// Meters per unit of the depth.
    meters_per_unit: f64,
}

impl Args {
    /// Prepares a matcher for this pair and for following pairs of the same size.
    fn sequence(&self, photos: &Photos, paths: [&Path; 2], context: &Context) -> Result<Sequence, Failure> {
        let options = self.options(context);
        let [left, right] = photos.sizes();
        let failure = |error| self.failure(error);
        let Some(path) = self.rig.first() else {
            if left != right {
                return Err(Failure::new(format!(
                    "{} is {}×{} px, {} is {}×{} px: both must have the same size",
                    paths[0].display(),
                    left.0,
                    left.1,
                    paths[1].display(),
                    right.0,
                    right.1
                )));
            }
            let geometry = match (self.focal, self.baseline) {
                (Some(focal), Some(baseline)) => {
                    let geometry = StereoGeometry::from_focal(left.0, left.1, focal, baseline)
                        .map_err(|error| Failure::usage(error).advice("give positive numbers"))?;
                    Some(StereoGeometry { offset: self.offset, ..geometry })
                }
                _ => None,
            };
            self.report_memory(&options, left, context)?;
            let frames = FrameDepth::new(options, geometry).map_err(failure)?;
            // --baseline is taken to be in meters.
            return Ok(Sequence { frames, size: left, meters_per_unit: 1.0 });
        };
        let file = rig::read(&self.rig, left, self.exchange, context)?;
        let (meters_per_unit, rig) = (file.meters_per_unit().unwrap_or(1.0), file.rig);
        rig::check_size(path, paths[0], left, &rig.left)?;
        rig::check_size(path, paths[1], right, &rig.right)?;
        let settings = RectifyOptions { size: self.size, ..RectifyOptions::default() };
        let rectification =
            Rectification::new(&rig, &settings).map_err(|error| words::no_rectification(error, path, self.exchange))?;
        if rectification.vertical {
            context.note("the rig is vertical: the maps are those of the image rotated by 90 degrees, as written by `cv rectify`");
        }
        let size = (rectification.left.camera.width, rectification.left.camera.height);
        self.report_memory(&options, size, context)?;
        let frames = FrameDepth::of_rig(options, &rectification).map_err(failure)?;
        Ok(Sequence { frames, size, meters_per_unit })
    }

    /// Words an error of the matcher.
    fn failure(&self, error: DepthError) -> Failure {
        match (error, self.rig.first()) {
            (DepthError::Rectify(error), Some(path)) => words::no_rectification(error, path, self.exchange),
            (error, rig) => words::no_depth(error, rig.is_some()),
        }
    }

    fn wants_points(&self, context: &Context) -> bool {
        self.cloud.is_some() || context.wants_report()
    }

    /// Reports the estimated search range of `--disparities auto`.
    fn report_range(&self, sequence: &Sequence, context: &Context) {
        if let (Range::Auto, Some((first, count))) = (self.disparities, sequence.frames.disparities()) {
            context.note(format!("disparities {first} to {}", first + count as i32 - 1));
        }
    }

    /// Writes all requested files except the report.
    fn write(&self, job: &RigDepthResult, meters_per_unit: f64, context: &Context) -> Result<(), Failure> {
        let write_depth = |path: &Path, map: ImageView<'_, f32, 1>| {
            cv_io::depth_mm::write(path, map.to_image().map(|[z]| [(f64::from(z) * meters_per_unit) as f32]).view())
        };
        self.write_disparity(&job.maps.map, context)?;
        if let (Some(path), Some(depth)) = (&self.depth, &job.maps.depth)
            && let Some(lost) = write_map(context, path, depth.view(), write_depth)?
        {
            context.warn(format!("{lost} depths are outside 0 to 65.535 m and are stored as invalid"));
        }
        self.write_quality(&job.maps, write_depth, context)?;
        if let Some(path) = &self.cloud {
            let cloud = |path: &Path| cv_io::ply::write_cloud(path, &job.cloud, PlyEncoding::Binary);
            context.write(Output::File(path, CLOUD), cloud)?;
        }
        Ok(())
    }

    fn write_disparity(&self, map: &DisparityMap, context: &Context) -> Result<(), Failure> {
        let kitti = |path: &Path, map: ImageView<'_, f32, 1>| cv_io::kitti::write(path, map);
        if let Some(lost) = write_map(context, &self.output, map.disparity.view(), kitti)? {
            context
                .warn(format!("{lost} disparities are outside KITTI's range of 0 to 256 px and are stored as invalid"));
        }
        Ok(())
    }

    /// Reports the memory that matching will take; unknown for `--disparities auto`.
    fn report_memory(&self, options: &DepthOptions, size: (usize, usize), context: &Context) -> Result<(), Failure> {
        if self.disparities == Range::Auto {
            return Ok(());
        }
        let matcher = StereoMatcher::new(options.stereo.clone()).map_err(|error| self.failure(error.into()))?;
        let mib = matcher.memory(size.0, size.1) as f64 / f64::from(1 << 20);
        let disparities = options.stereo.disparities;
        context.note(format!("matching {}×{} px at {disparities} disparities takes {mib:.1} MiB", size.0, size.1));
        Ok(())
    }

    /// Writes confidence, matched mask and uncertainty, if requested.
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
                context.warn(format!(
                    "{lost} uncertainties are outside the range of the format and are stored as invalid"
                ));
            }
        }
        Ok(())
    }
}
