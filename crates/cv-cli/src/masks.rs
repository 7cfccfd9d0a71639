//! Mask files: their names and their pixels.

use crate::frame::{Context, Failure};
use cv_core::Mask;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

/// Returns the file name without folder and extension.
pub(crate) fn stem(path: &Path) -> String {
    path.file_stem().unwrap_or_default().to_string_lossy().into_owned()
}

/// Removes the masks of other files in the list: `NAME_mask` if there is a `NAME`.
pub(crate) fn without_masks(paths: Vec<PathBuf>) -> Vec<PathBuf> {
    let names: BTreeSet<PathBuf> = paths.iter().map(|p| p.with_extension("")).collect();
    let is_mask = |path: &PathBuf| {
        stem(path).strip_suffix("_mask").is_some_and(|photo| names.contains(&path.with_file_name(photo)))
    };
    paths.into_iter().filter(|path| !is_mask(path)).collect()
}

/// Reads a mask, true where it is white. Of the values 0 and 1 only, 1 is white.
pub(crate) fn read_mask(path: &Path, context: &Context) -> Result<Mask, Failure> {
    let values = cv_io::read_gray_u8(path)?;
    let brightest = values.as_slice().iter().copied().max().unwrap_or(0);
    let between = values.as_slice().iter().filter(|v| (64..192).contains(*v)).count();
    if between * 10 > values.as_slice().len() {
        context.warn(format!(
            "{} may not be a mask: {:.0} % of its pixels are neither black nor white",
            path.display(),
            100.0 * between as f64 / values.as_slice().len() as f64
        ));
    }
    let threshold = if brightest == 1 { 0 } else { 127 };
    Ok(values.map(|[v]| [v > threshold]))
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
