//! `cv calibration`: calibration files of other programs.

use crate::frame::{Context, Failure, Global, Outcome, Output, Run, spare_inputs};
use crate::rig;
use cv_core::{Camera, Pose};
use cv_io::{CalibrationFormat, CalibrationNote, CameraArray, RigFile};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// Show a calibration file, or convert it to the format of another program.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibration show camera.yaml\n  \
    cv calibration convert camchain.yaml -o rig.yml --format opencv")]
pub(crate) struct Args {
    #[command(subcommand)]
    what: What,
}

#[derive(Debug, clap::Subcommand)]
enum What {
    Convert(Convert),
    Show(Show),
}

/// Convert a camera or a rig to another format; every number round-trips exactly.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibration convert camchain.yaml -o rig.yml --format opencv\n  \
    cv calibration convert intrinsics.yml extrinsics.yml -o rig.yaml --format own\n  \
    cv calibration convert camera.yaml -o cam.cameramodel --format mrcal")]
struct Convert {
    #[command(flatten)]
    input: Input,
    /// Where to write it.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// The format to write.
    #[arg(long, value_name = "FORMAT", value_parser = writable_formats())]
    format: String,
}

/// Show the contents of a calibration file.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv calibration show camera.yaml\n  \
    cv calibration show K.txt --size 1920x1080")]
struct Show {
    #[command(flatten)]
    input: Input,
}

#[derive(Debug, clap::Args)]
struct Input {
    /// The file; two for a rig in OpenCV's intrinsics and extrinsics files.
    #[arg(required = true, num_args = 1..=2, value_name = "FILE")]
    files: Vec<PathBuf>,
    /// Width and height of the images, for files without them.
    #[arg(long, value_name = "WxH", value_parser = super::size)]
    size: Option<(usize, usize)>,
}

/// Names of the formats that can be written.
fn writable_formats() -> Vec<&'static str> {
    CalibrationFormat::all().filter(|f| f.writes_cameras() || f.writes_rigs()).map(CalibrationFormat::name).collect()
}

/// The extensions of the formats that can be written.
const ENDINGS: &[&str] = &["yaml", "yml", "txt", "xml", "json", "cameramodel"];

/// The contents of a calibration file.
enum Calibration {
    Camera(Camera),
    Rig(Box<RigFile>),
    /// More than two cameras.
    Array(CameraArray),
}

impl Input {
    /// Reads a rig, or else a single camera.
    fn read(&self, context: &Context) -> Result<(Calibration, Vec<CalibrationNote>), Failure> {
        if let [file] = self.files.as_slice()
            && let Ok(array) = cv_io::read_camera_array(file)
            && array.cameras.len() > 2
        {
            return Ok((Calibration::Array(array), Vec::new()));
        }
        match cv_io::read_rig_with_notes(&self.files, self.size) {
            Ok((file, notes)) => Ok((Calibration::Rig(Box::new(file)), notes)),
            Err(error) if self.files.len() > 1 => Err(error.into()),
            // A file that is no rig is reported as a camera file.
            Err(_) => Ok((Calibration::Camera(rig::camera(&self.files[0], self.size, context)?), Vec::new())),
        }
    }
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        match &self.what {
            What::Convert(args) => vec![Output::File(&args.output, ENDINGS)],
            What::Show(_) => Vec::new(),
        }
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        &[Global::Seed, Global::Report]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        let input = match &self.what {
            What::Convert(args) => &args.input,
            What::Show(args) => &args.input,
        };
        let (held, notes) = input.read(context)?;
        notes.iter().for_each(|note| context.note(note));
        let outcome = match &held {
            Calibration::Camera(camera) => {
                Outcome::new(Vec::new()).with("kind", "camera").with("camera", camera_json(camera))
            }
            Calibration::Rig(file) => Outcome::new(Vec::new())
                .with("kind", "rig")
                .with("left", camera_json(&file.rig.left))
                .with("right", camera_json(&file.rig.right))
                .with("rotation", rotation_rows(&file.rig.right_from_left))
                .with("translation", file.rig.right_from_left.translation.as_slice())
                .with("baseline", file.rig.baseline())
                .with("unit", &file.unit),
            Calibration::Array(file) => {
                let one = |c: &cv_io::ArrayCamera| {
                    json!({
                        "name": c.name,
                        "camera": camera_json(&c.camera),
                        "rotation": rotation_rows(&c.from_first),
                        "translation": c.from_first.translation.as_slice(),
                    })
                };
                Outcome::new(Vec::new())
                    .with("kind", "rig")
                    .with("cameras", file.cameras.iter().map(one).collect::<Vec<_>>())
                    .with("unit", &file.unit)
            }
        };
        match self.what {
            What::Show(_) => Ok(outcome.summary(summary(&held))),
            What::Convert(args) => {
                let inputs: Vec<&Path> = args.input.files.iter().map(PathBuf::as_path).collect();
                spare_inputs(std::slice::from_ref(&args.output), &inputs)?;
                let format = CalibrationFormat::from_name(&args.format);
                let Some(format) = format else { return Err(Failure::usage("there is no such format")) };
                let text = match &held {
                    Calibration::Camera(camera) => format.camera_text(camera, &[])?,
                    Calibration::Rig(file) => format.rig_text(file, &[])?,
                    Calibration::Array(file) => format.array_text(file, &[])?,
                };
                context.write(Output::File(&args.output, ENDINGS), |path| cv_io::write_bytes(path, text.as_bytes()))?;
                Ok(outcome.with("format", format.name()).summary(summary(&held)))
            }
        }
    }
}

fn rotation_rows(motion: &Pose) -> Vec<Vec<f64>> {
    motion.rotation.matrix().row_iter().map(|r| r.iter().copied().collect()).collect()
}

fn camera_json(camera: &Camera) -> Value {
    let model = camera.distortion.model().info();
    let coefficients: serde_json::Map<String, Value> = (model.parameters.iter())
        .zip(camera.distortion.parameters())
        .map(|(name, value)| ((*name).to_owned(), json!(value)))
        .collect();
    json!({
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "lens": model.name,
        "coefficients": coefficients,
    })
}

fn summary(held: &Calibration) -> String {
    let camera = |c: &Camera| {
        let model = c.distortion.model().info();
        let numbers: Vec<String> =
            model.parameters.iter().zip(c.distortion.parameters()).map(|(n, v)| format!("{n} {v:.6}")).collect();
        let lens = if numbers.is_empty() {
            "no distortion".to_owned()
        } else {
            format!("{}: {}", model.name, numbers.join(", "))
        };
        let across = 2.0 * (c.width as f64 / (2.0 * c.fx)).atan().to_degrees();
        format!(
            "{}×{} px, focal length {:.3} × {:.3} px ({across:.0}° horizontal field of view without distortion), principal point ({:.3}, {:.3}); {lens}",
            c.width, c.height, c.fx, c.fy, c.cx, c.cy
        )
    };
    match held {
        Calibration::Camera(c) => camera(c),
        Calibration::Array(file) => {
            let one = |c: &cv_io::ArrayCamera| {
                let far = c.from_first.inverse().translation.norm();
                let turn = c.from_first.rotation_angle().to_degrees();
                let place = format!("{far:.6} {} from the first camera, rotated by {turn:.3}°", file.unit);
                format!("{}: {}\n  {place}", c.name, camera(&c.camera))
            };
            file.cameras.iter().map(one).collect::<Vec<_>>().join("\n")
        }
        Calibration::Rig(file) => {
            let t = file.rig.right_from_left.translation;
            let turn = file.rig.right_from_left.rotation_angle().to_degrees();
            format!(
                "left: {}\nright: {}\nbaseline {:.6} {} ({:.6}, {:.6}, {:.6}), rotation {turn:.3}°",
                camera(&file.rig.left),
                camera(&file.rig.right),
                file.rig.baseline(),
                file.unit,
                t.x,
                t.y,
                t.z
            )
        }
    }
}
