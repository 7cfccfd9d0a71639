//! A camera as COLMAP names and orders its parameters.

use cv_core::{Camera, Distortion};

use crate::FormatError;

const NAME: &str = "COLMAP camera";

/// COLMAP's pixel centers are at +0.5.
pub(crate) const CENTER: f64 = 0.5;

/// The camera of `model` with COLMAP's `parameters`.
pub(crate) fn parse_model(model: &str, width: usize, height: usize, parameters: &[f64]) -> Result<Camera, FormatError> {
    let build = |fx: f64, fy: f64, cx: f64, cy: f64, distortion: Distortion| Camera {
        width,
        height,
        fx,
        fy,
        cx: cx - CENTER,
        cy: cy - CENTER,
        distortion,
    };
    let brown = |k1, k2, p1, p2, k3| Distortion::BrownConrady { k1, k2, p1, p2, k3 };
    let fisheye = |k1, k2, k3, k4| Distortion::Fisheye { k1, k2, k3, k4 };
    Ok(match (model, parameters) {
        ("SIMPLE_PINHOLE", &[f, cx, cy]) => build(f, f, cx, cy, Distortion::None),
        ("PINHOLE", &[fx, fy, cx, cy]) => build(fx, fy, cx, cy, Distortion::None),
        ("SIMPLE_RADIAL", &[f, cx, cy, k1]) => build(f, f, cx, cy, Distortion::Radial { k1, k2: 0.0 }),
        ("RADIAL", &[f, cx, cy, k1, k2]) => build(f, f, cx, cy, Distortion::Radial { k1, k2 }),
        ("OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2]) => build(fx, fy, cx, cy, brown(k1, k2, p1, p2, 0.0)),
        ("FULL_OPENCV", &[fx, fy, cx, cy, k1, k2, p1, p2, k3, k4, k5, k6]) => {
            if [k4, k5, k6] != [0.0; 3] {
                return Err(FormatError::unsupported(NAME, "a rational lens model (FULL_OPENCV with k4, k5, k6)"));
            }
            build(fx, fy, cx, cy, brown(k1, k2, p1, p2, k3))
        }
        ("SIMPLE_RADIAL_FISHEYE", &[f, cx, cy, k1]) => build(f, f, cx, cy, fisheye(k1, 0.0, 0.0, 0.0)),
        ("RADIAL_FISHEYE", &[f, cx, cy, k1, k2]) => build(f, f, cx, cy, fisheye(k1, k2, 0.0, 0.0)),
        ("OPENCV_FISHEYE", &[fx, fy, cx, cy, k1, k2, k3, k4]) => build(fx, fy, cx, cy, fisheye(k1, k2, k3, k4)),
        (
            "SIMPLE_PINHOLE"
            | "PINHOLE"
            | "SIMPLE_RADIAL"
            | "RADIAL"
            | "OPENCV"
            | "FULL_OPENCV"
            | "SIMPLE_RADIAL_FISHEYE"
            | "RADIAL_FISHEYE"
            | "OPENCV_FISHEYE",
            list,
        ) => return Err(FormatError::corrupt(NAME, format!("{model} does not have {} parameters", list.len()))),
        _ => return Err(FormatError::unsupported(NAME, format!("the model {model}"))),
    })
}

/// The smallest COLMAP model that holds `camera`, and its parameters.
pub(crate) fn model_parameters(camera: &Camera) -> (&'static str, Vec<f64>) {
    let Camera { fx, fy, .. } = *camera;
    let (cx, cy) = (camera.cx + CENTER, camera.cy + CENTER);
    match camera.distortion {
        Distortion::None if fx == fy => ("SIMPLE_PINHOLE", vec![fx, cx, cy]),
        Distortion::None => ("PINHOLE", vec![fx, fy, cx, cy]),
        Distortion::Radial { k1, k2: 0.0 } if fx == fy => ("SIMPLE_RADIAL", vec![fx, cx, cy, k1]),
        Distortion::Radial { k1, k2 } if fx == fy => ("RADIAL", vec![fx, cx, cy, k1, k2]),
        Distortion::Radial { k1, k2 } => ("OPENCV", vec![fx, fy, cx, cy, k1, k2, 0.0, 0.0]),
        Distortion::BrownConrady { k1, k2, p1, p2, k3: 0.0 } => ("OPENCV", vec![fx, fy, cx, cy, k1, k2, p1, p2]),
        Distortion::BrownConrady { k1, k2, p1, p2, k3 } => {
            ("FULL_OPENCV", vec![fx, fy, cx, cy, k1, k2, p1, p2, k3, 0.0, 0.0, 0.0])
        }
        Distortion::Fisheye { k1, k2, k3, k4 } => ("OPENCV_FISHEYE", vec![fx, fy, cx, cy, k1, k2, k3, k4]),
    }
}

/// The first camera in a text: a line of `cameras.txt`, a bare `MODEL w h parameters`, or either behind `# camera:`, with the size also
/// as `w×h` and the word `params` before the parameters.
pub(super) fn find(text: &str) -> Result<Camera, FormatError> {
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
            |w: &&str| w.len() > 3 && w.bytes().all(|b| b.is_ascii_uppercase() || b.is_ascii_digit() || b == b'_');
        let words = match &words[..] {
            [model, rest @ ..] if is_model(model) && model.parse::<f64>().is_err() => (*model, rest),
            [id, model, rest @ ..] if id.parse::<u32>().is_ok() && is_model(model) => (*model, rest),
            [] => continue,
            _ => break,
        };
        return numbers(words.0, words.1).map_err(|e| match e {
            FormatError::Corrupt { reason, .. } => FormatError::line(index + 1, reason),
            other => other,
        });
    }
    Err(FormatError::UnknownFormat { expected: "a COLMAP camera" })
}

fn numbers(model: &str, words: &[&str]) -> Result<Camera, FormatError> {
    let no_size = || FormatError::corrupt(NAME, "no width and height behind the model");
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
    // A remark in brackets may follow.
    let parameters: Vec<f64> = rest
        .iter()
        .take_while(|w| !w.starts_with('('))
        .map(|w| w.parse().map_err(|_| FormatError::corrupt(NAME, format!("“{w}” is not a number"))))
        .collect::<Result<_, _>>()?;
    parse_model(model, width, height, &parameters)
}
