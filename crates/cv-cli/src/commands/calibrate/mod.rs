//! `cv calibrate`: cameras and rigs from photographs of a board.

mod json;
mod report;

use super::depth::pairing::{PairBy, join};
use crate::boards::{BoardArgs, describe_board};
use crate::frame::{
    Context, Failure, Global, Outcome, Output, Run, Step, YAML, expand_images, named, spare_inputs, steps,
};
use crate::words::calibration::{no_calibration, note, refusal};
use cv_core::GrayF32;
use cv_io::{ArrayCamera, CameraArray, IoError, RigFile};
use cv_pipeline::calibration::{CalibrateOptions, LensChoice};
use cv_pipeline::{BoardCalibration, BoardCalibrationError, BoardCalibrationOptions, PhotoRefusal, calibrate};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Calibrate a camera, or the cameras of a rig, from photographs of a board (chessboard, ChArUco, ArUco grid, AprilGrid).
///
/// Detects the board, selects the distortion model by cross-validation, jointly refines intrinsics, poses and the shape of the board, rejects outliers with a reason,
/// reports the uncertainty of the result, and advises which photographs to add.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibrate mono --board 9x6 --square 25 photos/*.jpg -o camera.yaml --report out\n  \
    cv calibrate stereo --board 9x6 --square 25 --left left --right right -o rig.yaml\n  \
    cv calibrate rig --kind aprilgrid --board 6x6 --marker 45 --cameras left right third -o rig.yaml")]
pub(crate) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Mono(Mono),
    Stereo(Stereo),
    Rig(Rig),
}

/// The board and the options of the fit.
#[derive(Debug, clap::Args)]
struct Board {
    #[command(flatten)]
    board: BoardArgs,
    /// Unit of --square and --marker; without them, lengths are in squares.
    #[arg(long, value_name = "UNIT", default_value = "mm", value_parser = ["mm", "cm", "m"])]
    unit: String,
    /// Distortion model.
    #[arg(long, value_parser = named::<LensChoice>(), default_value_t)]
    lens: LensChoice,
    /// Assume a flat board; by default two deflection parameters of its shape are estimated, since paper bends.
    #[arg(long)]
    flat: bool,
    /// Reject corners whose residual exceeds this many standard deviations.
    #[arg(long, value_name = "N", default_value_t = CalibrateOptions::default().outlier_deviations)]
    outliers: f64,
}

impl Board {
    fn options(&self) -> Result<BoardCalibrationOptions, Failure> {
        let solve = CalibrateOptions {
            lens: self.lens,
            board_shape: !self.flat,
            outlier_deviations: self.outliers,
            ..CalibrateOptions::default()
        };
        Ok(BoardCalibrationOptions { board: self.board.choice()?, solve, ..BoardCalibrationOptions::default() })
    }

    /// Returns the unit of lengths.
    fn unit(&self) -> &str {
        if self.board.has_lengths() { &self.unit } else { "squares" }
    }
}

/// Calibrate one camera.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibrate mono --board 9x6 --square 25 photos -o camera.yaml\n  \
    cv calibrate mono photos/*.jpg -o camera.yaml --lens fisheye4 --report out\n  \
    cv calibrate mono --kind charuco --board 7x5 --square 35 --marker 26 photos -o camera.yaml\n  \
    cv calibrate mono --kind aprilgrid --board 6x6 --marker 45 photos -o camera.yaml")]
struct Mono {
    /// Photographs of the board, or folders or quoted patterns of them.
    #[arg(required = true, value_name = "IMAGES")]
    images: Vec<PathBuf>,
    #[command(flatten)]
    board: Board,
    /// Where to write the camera.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

/// Calibrate a stereo rig: two rigidly mounted cameras.
///
/// Photographs are paired by name, or by the last number in the name. An unpaired photograph is used for its own camera only.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibrate stereo --board 9x6 --square 25 --left left --right right -o rig.yaml\n  \
    cv calibrate stereo --left 'left*.jpg' --right 'right*.jpg' -o rig.yaml --report out")]
struct Stereo {
    /// Photographs of the left (or upper) camera, or folders or quoted patterns of them.
    #[arg(long, value_name = "FILES", num_args = 1.., required = true)]
    left: Vec<PathBuf>,
    /// Photographs of the right (or lower) camera.
    #[arg(long, value_name = "FILES", num_args = 1.., required = true)]
    right: Vec<PathBuf>,
    /// How photographs are paired [default: by name if the names are the same, else by number].
    #[arg(long, value_name = "HOW", value_parser = named::<PairBy>())]
    pair_by: Option<PairBy>,
    #[command(flatten)]
    board: Board,
    /// Where to write the rig.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

/// Calibrate a rig of two or more rigidly mounted cameras.
///
/// Simultaneous photographs have the same name or the same last number in the name. Each camera must share photographs with another one, not necessarily with the first. Two
/// cameras are written as by `cv calibrate stereo`; rigs of more cameras can be converted for Kalibr by `cv calibration convert`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibrate rig --board 9x6 --square 25 --cameras left right third -o rig.yaml\n  \
    cv calibrate rig --kind aprilgrid --board 6x6 --marker 0.045 --unit m --cameras 'cam0/*.png' 'cam1/*.png' 'cam2/*.png' -o rig.yaml")]
struct Rig {
    /// The photographs of each camera: one folder or quoted pattern per camera; the first is the reference camera.
    #[arg(long, value_name = "FOLDER", num_args = 1.., required = true)]
    cameras: Vec<PathBuf>,
    /// How simultaneous photographs are grouped [default: by name if the names are the same, else by number].
    #[arg(long, value_name = "HOW", value_parser = named::<PairBy>())]
    pair_by: Option<PairBy>,
    #[command(flatten)]
    board: Board,
    /// Where to write the rig.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        match &self.what {
            What::Mono(args) => vec![Output::File(&args.output, YAML)],
            What::Stereo(args) => vec![Output::File(&args.output, YAML)],
            What::Rig(args) => vec![Output::File(&args.output, YAML)],
        }
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed]
    }

    fn steps(&self) -> Vec<Step> {
        vec![steps::BOARDS, steps::LENS, steps::ADJUST]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        match self.what {
            What::Mono(args) => args.run(context),
            What::Stereo(args) => args.run(context),
            What::Rig(args) => args.run(context),
        }
    }
}

/// The photographs of each view (moment), by camera.
type Views = Vec<Vec<Option<PathBuf>>>;

/// A finished calibration and its inputs.
struct Job {
    found: BoardCalibration,
    views: Views,
    /// Names of the cameras.
    names: Vec<String>,
    unit: String,
}

impl Mono {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let images = expand_images(&self.images)?;
        let views: Views = images.into_iter().map(|path| vec![Some(path)]).collect();
        let job = calibrate_views(views, vec!["camera".to_owned()], &self.board, &self.output, context)?;
        let camera = &job.found.calibration.cameras[0].camera;
        let notes = job.origin();
        context.write(Output::File(&self.output, YAML), |path| cv_io::write_camera(path, camera, &[&notes]))?;
        job.finish(context)
    }
}

impl Stereo {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let images = [expand_images(&self.left)?, expand_images(&self.right)?];
        let views = join(&images, self.pair_by)?;
        let alone = views.iter().filter(|view| view.iter().any(Option::is_none)).count();
        if alone > 0 {
            context.note(format!("{alone} photographs are unpaired and are used for their own camera only"));
        }
        let names = ["left", "right"].map(str::to_owned).to_vec();
        let job = calibrate_views(views, names, &self.board, &self.output, context)?;
        job.write(&self.output, context)?;
        job.finish(context)
    }
}

impl Rig {
    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let count = self.cameras.len();
        if count < 2 {
            return Err(Failure::usage("a rig needs two or more cameras, got one")
                .advice("a folder for each camera, --cameras left right third, or `cv calibrate mono`"));
        }
        let images: Vec<Vec<PathBuf>> =
            self.cameras.iter().map(|of| expand_images(std::slice::from_ref(of))).collect::<Result<_, _>>()?;
        let views = join(&images, self.pair_by)?;
        let alone = views.iter().filter(|view| view.iter().flatten().count() < 2).count();
        if alone > 0 {
            context
                .note(format!("{alone} photographs have no simultaneous one and are used for their own camera only"));
        }
        // The names of the folders, if they are unique.
        let mut names: Vec<String> = (self.cameras.iter())
            .map(|path| path.file_name().filter(|_| path.is_dir()).unwrap_or_default().to_string_lossy().into_owned())
            .collect();
        let is_unique = |name: &String| {
            let plain = name.chars().all(|c| c.is_ascii_alphanumeric() || "_-".contains(c));
            plain && !name.is_empty() && names.iter().filter(|other| *other == name).count() == 1
        };
        if !names.iter().all(is_unique) {
            names = (0..count).map(|i| format!("cam{i}")).collect();
        }
        let job = calibrate_views(views, names, &self.board, &self.output, context)?;
        job.write(&self.output, context)?;
        job.finish(context)
    }
}

/// Reads the photographs one at a time, detects the boards and calibrates.
fn calibrate_views(
    views: Views,
    names: Vec<String>,
    board: &Board,
    output: &Path,
    context: &Context,
) -> Result<Job, Failure> {
    let inputs: Vec<&Path> = views.iter().flatten().flatten().map(PathBuf::as_path).collect();
    spare_inputs(&[output.to_owned()], &inputs)?;
    let options = board.options()?;
    let unreadable: Mutex<Vec<(usize, usize, IoError)>> = Mutex::default();
    let photo = |view: usize, camera: usize| -> Option<GrayF32> {
        let path = views[view][camera].as_ref()?;
        match cv_io::read_gray_u8(path) {
            Ok(gray) => Some(gray.map(|p| [f32::from(p[0]) / 255.0])),
            Err(error) => {
                unreadable.lock().unwrap_or_else(PoisonError::into_inner).push((view, camera, error));
                None
            }
        }
    };
    let found = calibrate((views.len(), names.len()), photo, &options, context);
    let mut unreadable = unreadable.into_inner().unwrap_or_else(PoisonError::into_inner);
    unreadable.sort_by_key(|(view, camera, _)| (*view, *camera));
    if let Some((_, _, error)) = unreadable.into_iter().next() {
        return Err(error.into());
    }
    match found {
        Ok(found) => Ok(Job { found, views, names, unit: board.unit().to_owned() }),
        Err(error) => {
            let reasons = match &error {
                BoardCalibrationError::NoBoards { refusals } | BoardCalibrationError::Calibrate { refusals, .. } => {
                    most_common_refusal(refusals)
                }
                _ => String::new(),
            };
            Err(no_calibration(error, &names, &reasons))
        }
    }
}

/// Returns the most common reason for rejected photographs, in parentheses; empty if none is rejected.
fn most_common_refusal(refusals: &[Vec<Option<PhotoRefusal>>]) -> String {
    let mut counts: Vec<(String, usize)> = Vec::new();
    for refused in refusals.iter().flatten().flatten().filter(|r| **r != PhotoRefusal::NoPhoto) {
        let text = refusal(refused);
        match counts.iter_mut().find(|(known, _)| *known == text) {
            Some((_, count)) => *count += 1,
            None => counts.push((text, 1)),
        }
    }
    let most = counts.iter().rev().max_by_key(|(_, count)| *count);
    most.map_or(String::new(), |(text, count)| {
        if *count > 1 { format!(" ({count} of them: {text})") } else { format!(" (one of them: {text})") }
    })
}

impl Job {
    /// Describes the data of the calibration, as a comment for its file.
    fn origin(&self) -> String {
        let c = &self.found.calibration;
        let used = c.views.iter().filter(|v| v.pose.is_some()).count();
        let holdout = if c.holdout_rms_px.is_nan() {
            String::new()
        } else {
            format!(", {:.3} px on held-out views", c.holdout_rms_px)
        };
        format!(
            "calibrated from {used} views of a {}; rms {:.3} px{holdout}",
            describe_board(&self.found.board, &self.unit),
            c.rms_px
        )
    }

    /// Writes the rig; two cameras as a stereo rig, which all commands read.
    fn write(&self, output: &Path, context: &Context) -> Result<(), Failure> {
        let (c, notes, unit) = (&self.found.calibration, self.origin(), self.unit.clone());
        let output = Output::File(output, YAML);
        match c.stereo().filter(|_| c.cameras.len() == 2) {
            Some(rig) => {
                let file = RigFile { rig, unit };
                context.write(output, |path| cv_io::write_rig(path, &file, &[&notes]))
            }
            None => {
                let cameras = (c.cameras.iter().zip(&self.names))
                    .map(|(c, name)| ArrayCamera { name: name.clone(), camera: c.camera, from_first: c.from_first })
                    .collect();
                let file = CameraArray { cameras, unit };
                context.write(output, |path| cv_io::write_camera_array(path, &file, &[&notes]))
            }
        }
    }

    /// Returns the path of a photograph.
    fn path(&self, view: usize, camera: usize) -> Option<&Path> {
        self.views[view][camera].as_deref()
    }

    /// Writes the notes and the report, and returns the outcome.
    fn finish(&self, context: &Context) -> Result<Outcome, Failure> {
        let c = &self.found.calibration;
        for (view, cameras) in self.found.refusals.iter().enumerate() {
            for (camera, refused) in cameras.iter().enumerate() {
                if let (Some(refused), Some(path)) = (refused, self.path(view, camera)) {
                    context.note(format!("{}: left out: {}", path.display(), refusal(refused)));
                }
            }
        }
        context.report(|| report::report(self))?;
        let mut summary = Vec::new();
        for (camera, name) in c.cameras.iter().zip(&self.names) {
            let whose = if self.names.len() > 1 { format!("{name}: ") } else { String::new() };
            let holdout = if camera.holdout_rms_px.is_nan() {
                String::new()
            } else {
                format!(", {:.3} px on held-out views", camera.holdout_rms_px)
            };
            summary.push(format!(
                "{whose}{} lens, focal length {:.2} px, rms {:.3} px{holdout}; projection uncertainty {:.2} px (median over the image)",
                camera.camera.distortion.model().info().name,
                camera.camera.fx,
                camera.rms_px,
                camera.uncertainty.median(),
            ));
        }
        for (camera, name) in c.cameras.iter().zip(&self.names).skip(1).filter(|_| c.cameras.len() > 2) {
            let (far, first) = (camera.from_first.inverse().translation.norm(), &self.names[0]);
            summary.push(format!("{name}: {far:.4} {} from {first}", self.unit));
        }
        if let Some(rig) = c.stereo().filter(|_| c.cameras.len() == 2) {
            let rows = self.found.rectified_dy_px.map_or(String::new(), |(mean, _)| {
                format!(", mean vertical disparity after rectification {mean:.3} px")
            });
            summary.push(format!("baseline {:.4} {}{rows}", rig.baseline(), self.unit));
        }
        let used = c.views.iter().filter(|v| v.pose.is_some()).count();
        summary.push(format!("{used} of {} views used; the calibration is {}", c.views.len(), c.verdict.trust));
        summary.extend(c.verdict.notes.iter().map(|n| format!("  {}", note(n, &self.names))));
        Ok(json::outcome(self).summary(summary.join("\n")))
    }
}
