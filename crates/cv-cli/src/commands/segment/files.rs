//! Pairing of photographs and masks.

use crate::frame::{Context, Failure, expand_images};
use cv_core::{Mask, RgbU8};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// A photograph and its mask.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Pair {
    pub(super) photo: PathBuf,
    pub(super) mask: PathBuf,
}

/// Returns the file name without folder and extension.
pub(super) fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Removes the masks of other files in the list: `NAME_mask` if there is a `NAME`.
pub(super) fn without_masks(paths: Vec<PathBuf>) -> Vec<PathBuf> {
    let names: BTreeSet<PathBuf> = paths.iter().map(|p| p.with_extension("")).collect();
    let is_mask = |path: &PathBuf| {
        stem(path).strip_suffix("_mask").is_some_and(|photo| names.contains(&path.with_file_name(photo)))
    };
    paths.into_iter().filter(|path| !is_mask(path)).collect()
}

/// Pairs photographs with the masks of a folder by name. Photographs without a mask are skipped with a warning.
pub(super) fn pair(images: &[PathBuf], masks: &Path, context: &Context) -> Result<Vec<Pair>, Failure> {
    if !masks.is_dir() {
        let what = if masks.exists() { "is not a folder" } else { "does not exist" };
        return Err(Failure::new(format!("the folder of masks {} {what}", masks.display()))
            .advice("name the folder with NAME_mask.png or NAME.png for each photograph NAME"));
    }
    let candidates = expand_images(&[masks.to_path_buf()])?;
    let photos = without_masks(expand_images(images)?);
    let mut missing = Vec::new();
    let mut pairs = Vec::new();
    for photo in photos {
        let name = stem(&photo);
        let same = |path: &Path| match (path.canonicalize(), photo.canonicalize()) {
            (Ok(a), Ok(b)) => a == b,
            _ => false,
        };
        let named = |wanted: &str| {
            // PNG files are preferred.
            let all = || candidates.iter().filter(|path| stem(path) == wanted && !same(path));
            all().find(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png"))).or_else(|| all().next())
        };
        match named(&format!("{name}_mask")).or_else(|| named(&name)) {
            Some(mask) => pairs.push(Pair { mask: mask.clone(), photo }),
            None => missing.push(photo),
        }
    }
    if pairs.is_empty() {
        let example = missing.first().map_or_else(|| "NAME".to_owned(), |path| stem(path));
        return Err(Failure::new(format!(
            "none of the {} photographs has a mask in {}",
            missing.len(),
            masks.display()
        ))
        .advice(format!("name the masks after the photographs: {example}_mask.png or {example}.png")));
    }
    if let Some(first) = missing.first() {
        context.warn(format!(
            "{} photographs have no mask and are left out, {} the first",
            missing.len(),
            first.display()
        ));
    }
    Ok(pairs)
}

/// Reads a photograph and its mask. In masks with the values 0 and 1 only, 1 is white.
pub(super) fn read_pair(pair: &Pair, context: &Context) -> Result<(RgbU8, Mask), Failure> {
    let photo = cv_io::read_rgb(&pair.photo)?;
    let values = cv_io::read_gray_u8(&pair.mask)?;
    let brightest = values.as_slice().iter().copied().max().unwrap_or(0);
    let between = values.as_slice().iter().filter(|v| (64..192).contains(*v)).count();
    if between * 10 > values.as_slice().len() {
        context.warn(format!(
            "{} may not be a mask: {:.0} % of its pixels are neither black nor white",
            pair.mask.display(),
            100.0 * between as f64 / values.as_slice().len() as f64
        ));
    }
    let threshold = if brightest == 1 { 0 } else { 127 };
    Ok((photo, values.map(|[v]| [v > threshold])))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn masks_are_removed_from_lists_of_photographs() {
        let paths =
            ["a/1.jpg", "a/1_mask.png", "a/gas_mask.jpg", "b/1_mask.png", "a/2.png"].map(PathBuf::from).to_vec();
        let left: Vec<String> = without_masks(paths).iter().map(|p| p.display().to_string()).collect();
        // No photograph "gas", and no photograph in b.
        assert_eq!(left, ["a/1.jpg", "a/gas_mask.jpg", "b/1_mask.png", "a/2.png"]);
    }
}
