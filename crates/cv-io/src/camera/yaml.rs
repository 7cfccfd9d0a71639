//! Access to YAML documents by keys, with errors that name the keys.

use cv_core::{Matrix3, Pose, Rotation3, Vector3};
use saphyr::{LoadableYamlNode, Scalar, Yaml};

use crate::FormatError;

const NAME: &str = "YAML";
/// Maximum file size in bytes; camera files take a few kilobytes, calibration logs with all corners a few hundred.
const MAX_BYTES: usize = 4 << 20;
/// Maximum nesting, above that of any camera file and safe for a recursive parser.
const MAX_DEPTH: usize = 64;

/// Parses the first document.
pub(super) fn load(text: &str) -> Result<Yaml<'_>, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooManyBytes { bytes: text.len() as u64, limit: MAX_BYTES as u64 });
    }
    check_depth(text)?;
    let documents = Yaml::load_from_str(text).map_err(|e| FormatError::corrupt(NAME, e.to_string()))?;
    documents.into_iter().next().ok_or(FormatError::Empty)
}

/// Refuses deep nesting of brackets and blocks before parsing.
fn check_depth(text: &str) -> Result<(), FormatError> {
    let too_deep = || FormatError::corrupt(NAME, format!("nested more than {MAX_DEPTH} deep"));
    let mut depth = 0usize;
    for c in text.bytes() {
        match c {
            b'[' | b'{' => depth += 1,
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
        if depth > MAX_DEPTH {
            return Err(too_deep());
        }
    }
    for line in text.lines() {
        // "- - - x", "? ? x" and "a: &b" open a block per mark; indentation opens at most one per column.
        let marks = line.split(' ').take_while(|w| matches!(*w, "" | "-" | "?")).count();
        if marks > MAX_DEPTH {
            return Err(too_deep());
        }
    }
    Ok(())
}

/// Returns the value of the first of `keys` that is present.
pub(super) fn get<'a>(map: &'a Yaml<'a>, keys: &[&str]) -> Option<&'a Yaml<'a>> {
    keys.iter().find_map(|key| map.as_mapping_get(key))
}

pub(super) fn number(value: &Yaml<'_>) -> Option<f64> {
    match value {
        Yaml::Value(Scalar::Integer(v)) => Some(*v as f64),
        Yaml::Value(Scalar::FloatingPoint(v)) => Some((*v).into()),
        // OpenCV writes “.Nan” and “.Inf” in a case that YAML does not define.
        Yaml::Value(Scalar::String(s)) => s.trim_start_matches('.').parse().ok(),
        Yaml::Tagged(_, inner) => number(inner),
        _ => None,
    }
}

/// Returns all numbers of a list, of a list of lists, or of an OpenCV or ROS matrix (`rows`, `cols`, `data`).
pub(super) fn numbers(value: &Yaml<'_>) -> Option<Vec<f64>> {
    let value = match value {
        Yaml::Tagged(_, inner) => inner,
        other => other,
    };
    if let Some(data) = value.as_mapping_get("data") {
        let list = numbers(data)?;
        let side = |key| value.as_mapping_get(key).and_then(number);
        if let (Some(rows), Some(cols)) = (side("rows"), side("cols"))
            && rows * cols != list.len() as f64
        {
            return None;
        }
        return Some(list);
    }
    let mut out = Vec::new();
    for item in value.as_sequence()? {
        match item {
            Yaml::Sequence(inner) => {
                for v in inner {
                    out.push(number(v)?);
                }
            }
            other => out.push(number(other)?),
        }
    }
    Some(out)
}

pub(super) fn required<const N: usize>(
    map: &Yaml<'_>,
    format: &'static str,
    keys: &[&str],
) -> Result<[f64; N], FormatError> {
    let value = get(map, keys).ok_or_else(|| FormatError::missing(format, keys.join(" or ")))?;
    numbers(value)
        .and_then(|list| <[f64; N]>::try_from(list).ok())
        .ok_or_else(|| FormatError::corrupt(format, format!("{} is not {N} numbers", keys.join(" or "))))
}

/// Parses a size in whole pixels.
pub(super) fn size_of(value: &Yaml<'_>) -> Option<usize> {
    number(value).filter(|v| *v >= 1.0 && *v <= f64::from(1 << 20) && v.fract() == 0.0).map(|v| v as usize)
}

/// Makes a pose of R and t; R, orthogonal to within 1e-3 per entry, is replaced by the nearest rotation.
pub(super) fn pose(format: &'static str, r: [f64; 9], t: [f64; 3]) -> Result<Pose, FormatError> {
    let m = Matrix3::from_row_slice(&r);
    let orthogonality_error = (m * m.transpose() - Matrix3::identity()).abs().max();
    // NaN fails as well. Matrices rounded to three digits, as printed in papers, still pass.
    if !(orthogonality_error < 1e-3 && m.determinant() > 0.0) {
        return Err(FormatError::corrupt(format, "the matrix R is not a rotation"));
    }
    // Matrices of full precision are unchanged, so that files round-trip exactly.
    let rotation = if orthogonality_error < 1e-12 {
        Rotation3::from_matrix_unchecked(m)
    } else {
        Rotation3::from_matrix_eps(&m, 1e-15, 100, Rotation3::identity())
    };
    Ok(Pose::new(rotation, Vector3::from(t)))
}
