//! Pairing of photographs and masks.

use crate::frame::{Context, Failure, expand_images};
use crate::masks::{read_mask, stem, without_masks};
use cv_core::{Mask, RgbU8};
use std::path::{Path, PathBuf};

/// A photograph and its mask.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Pair {
    pub(super) photo: PathBuf,
    pub(super) mask: PathBuf,
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

/// Reads a photograph and its mask.
pub(super) fn read_pair(pair: &Pair, context: &Context) -> Result<(RgbU8, Mask), Failure> {
    Ok((cv_io::read_rgb(&pair.photo)?, read_mask(&pair.mask, context)?))
}
