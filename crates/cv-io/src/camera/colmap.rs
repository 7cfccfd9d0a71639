//! COLMAP's camera models: a line of `cameras.txt`.

use std::fmt::Write as _;

use cv_core::{Camera, ColmapModel, Distortion, DistortionModel};

use super::format::{Format, comments, unsupported_lens};
use crate::FormatError;

const NAME: &str = "COLMAP camera";

/// Offset of COLMAP's pixel centers from ours.
pub(crate) const CENTER: f64 = 0.5;

pub(super) const FORMAT: Format = Format {
    name: "colmap",
    matches: |text| !matches!(parse_first_camera(text), Err(FormatError::UnknownFormat { .. })),
    camera: |text, _| parse_first_camera(text),
    rig: None,
    camera_text: Some(camera_text),
    rig_text: None,
    array: None,
    array_text: None,
};

/// Iterates over COLMAP's models with our corresponding lens model.
fn all_models() -> impl Iterator<Item = (DistortionModel, &'static ColmapModel)> {
    DistortionModel::ALL.iter().flat_map(|lens| lens.info().colmap.iter().map(|model| (*lens, model)))
}

/// Makes the camera of a COLMAP model name and its parameters.
pub(crate) fn parse_model(model: &str, width: usize, height: usize, parameters: &[f64]) -> Result<Camera, FormatError> {
    let found = all_models().find(|(_, m)| m.name == model);
    camera(found.ok_or_else(|| unknown_model(model))?, width, height, parameters)
}

/// Makes the camera of a COLMAP model id (`cameras.bin`), with parameters taken from `next`.
pub(crate) fn camera_by_id(
    id: i32,
    width: usize,
    height: usize,
    mut next: impl FnMut() -> Result<f64, FormatError>,
) -> Result<Camera, FormatError> {
    let found = all_models().find(|(_, m)| m.id == id).ok_or_else(|| unknown_model(&format!("number {id}")))?;
    let count = found.1.focal_lengths + 2 + found.1.parameters;
    let parameters: Vec<f64> = (0..count).map(|_| next()).collect::<Result<_, _>>()?;
    camera(found, width, height, &parameters)
}

fn unknown_model(model: &str) -> FormatError {
    let names: Vec<&str> = all_models().map(|(_, m)| m.name).collect();
    FormatError::unsupported(NAME, format!("the model {model} (it is one of {})", names.join(", ")))
}

fn camera(
    (lens, form): (DistortionModel, &'static ColmapModel),
    width: usize,
    height: usize,
    parameters: &[f64],
) -> Result<Camera, FormatError> {
    let wrong_count =
        || FormatError::corrupt(NAME, format!("{} does not have {} parameters", form.name, parameters.len()));
    let (fx, fy, rest) = match (form.focal_lengths, parameters) {
        (1, [f, rest @ ..]) => (*f, *f, rest),
        (2, [fx, fy, rest @ ..]) => (*fx, *fy, rest),
        _ => return Err(wrong_count()),
    };
    let [cx, cy, coefficients @ ..] = rest else { return Err(wrong_count()) };
    if coefficients.len() != form.parameters {
        return Err(wrong_count());
    }
    let mut all = coefficients.to_vec();
    all.resize(lens.parameter_count(), 0.0);
    let distortion = Distortion::new(lens, &all).map_err(|_| wrong_count())?;
    Ok(Camera { distortion, ..Camera::pinhole(width, height, fx, fy, cx - CENTER, cy - CENTER) })
}

/// Finds COLMAP's model with the fewest parameters that represents a camera, and those parameters.
pub(crate) fn model_of(camera: &Camera) -> Result<(&'static ColmapModel, Vec<f64>), FormatError> {
    let represent = |(lens, form): (DistortionModel, &'static ColmapModel)| {
        let distortion = camera.distortion.converted(lens)?;
        let rest = distortion.parameters()[form.parameters..].iter();
        let is_exact = (form.focal_lengths == 2 || camera.fx == camera.fy) && rest.into_iter().all(|v| *v == 0.0);
        is_exact.then_some((form, distortion))
    };
    let (form, distortion) = all_models()
        .filter_map(represent)
        .min_by_key(|(form, _)| form.focal_lengths + form.parameters)
        .ok_or_else(|| unsupported_lens(camera, NAME))?;
    let focal = [camera.fx, camera.fy];
    let center = [camera.cx + CENTER, camera.cy + CENTER];
    let coefficients = &distortion.parameters()[..form.parameters];
    Ok((form, [&focal[..form.focal_lengths], &center, coefficients].concat()))
}

/// Formats a camera as `MODEL width height parameters`.
pub(crate) fn model_line(camera: &Camera) -> Result<String, FormatError> {
    let (form, parameters) = model_of(camera)?;
    let mut line = format!("{} {} {}", form.name, camera.width, camera.height);
    for v in parameters {
        let _ = write!(line, " {v}");
    }
    Ok(line)
}

fn camera_text(camera: &Camera, notes: &[&str]) -> Result<String, FormatError> {
    let mut text = comments(notes);
    let _ = writeln!(text, "# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n1 {}", model_line(camera)?);
    Ok(text)
}

/// Parses the first camera in a text: a line of `cameras.txt`, a bare `MODEL w h parameters`, or either after `# camera:`, with the size also
/// as `w×h` and the word `params` before the parameters.
fn parse_first_camera(text: &str) -> Result<Camera, FormatError> {
    for (index, line) in text.lines().enumerate() {
        let content = match line.trim().strip_prefix('#') {
            Some(comment) => match comment.trim_start().strip_prefix("camera:") {
                Some(rest) => rest,
                None => continue,
            },
            None => line,
        };
        let words: Vec<&str> = content.split_whitespace().collect();
        let is_model =
            |w: &&str| w.len() > 2 && w.bytes().all(|b| b.is_ascii_uppercase() || b.is_ascii_digit() || b == b'_');
        let words = match &words[..] {
            [model, rest @ ..] if is_model(model) && model.parse::<f64>().is_err() => (*model, rest),
            [id, model, rest @ ..] if id.parse::<u32>().is_ok() && is_model(model) => (*model, rest),
            [] => continue,
            _ => break,
        };
        return parse_parameters(words.0, words.1).map_err(|e| match e {
            FormatError::Corrupt { reason, .. } => FormatError::line(index + 1, reason),
            other => other,
        });
    }
    Err(FormatError::UnknownFormat { expected: "a COLMAP camera" })
}

fn parse_parameters(model: &str, words: &[&str]) -> Result<Camera, FormatError> {
    let no_size = || FormatError::corrupt(NAME, "no width and height after the model");
    let side = |w: &str| w.parse::<usize>().ok();
    let (width, height, rest) = match words {
        [both, rest @ ..] if both.contains(['x', '×']) => {
            let (w, h) = both.split_once(['x', '×']).ok_or_else(no_size)?;
            (side(w).ok_or_else(no_size)?, side(h).ok_or_else(no_size)?, rest)
        }
        [w, h, rest @ ..] => (side(w).ok_or_else(no_size)?, side(h).ok_or_else(no_size)?, rest),
        _ => return Err(no_size()),
    };
    let rest = rest.strip_prefix(&["params"]).unwrap_or(rest);
    // A remark in parentheses may follow.
    let parameters: Vec<f64> = rest
        .iter()
        .take_while(|w| !w.starts_with('('))
        .map(|w| w.parse().map_err(|_| FormatError::corrupt(NAME, format!("“{w}” is not a number"))))
        .collect::<Result<_, _>>()?;
    parse_model(model, width, height, &parameters)
}
