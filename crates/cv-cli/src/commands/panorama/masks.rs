//! The masks of `--keep` and `--remove`.

use crate::frame::{Context, Failure, expand_images, same_file};
use crate::masks::{read_mask, stem, without_masks};
use cv_pipeline::panorama_types::{PhotoMask, PhotoUse};
use std::path::{Path, PathBuf};

/// What a mask of a photograph is named, as advice.
const NAMES: &str = "name the mask of IMG_1.jpg IMG_1_mask.png or IMG_1.png";

/// The files of the masks of each photograph.
pub(super) struct MaskFiles {
    keep: Vec<Option<PathBuf>>,
    remove: Vec<Option<PathBuf>>,
}

impl MaskFiles {
    /// Assigns masks (files, patterns or folders) to photographs by name; masks among the photographs are taken from their list.
    pub(super) fn find(keep: &[PathBuf], remove: &[PathBuf], photos: &mut Vec<PathBuf>) -> Result<Self, Failure> {
        if !keep.is_empty() || !remove.is_empty() {
            let named: Vec<&PathBuf> = keep.iter().chain(remove).filter(|path| path.is_file()).collect();
            photos.retain(|photo| !named.iter().any(|mask| same_file(photo, mask)));
            *photos = without_masks(std::mem::take(photos));
        }
        Ok(Self { keep: assigned(keep, photos)?, remove: assigned(remove, photos)? })
    }

    /// Returns the paths of all masks.
    pub(super) fn paths(&self) -> impl Iterator<Item = &PathBuf> {
        self.keep.iter().chain(&self.remove).flatten()
    }

    /// Reads the masks.
    pub(super) fn read(&self, photos: &[PathBuf], context: &Context) -> Result<Vec<Option<PhotoMask>>, Failure> {
        let one = |(i, photo): (usize, &PathBuf)| -> Result<Option<PhotoMask>, Failure> {
            let (keep, remove) = (self.keep[i].as_ref(), self.remove[i].as_ref());
            if keep.is_none() && remove.is_none() {
                return Ok(None);
            }
            let (width, height) = cv_io::read_image_header(photo)?.size;
            let read = |mask: &PathBuf| {
                let values = read_mask(mask, context)?;
                let (w, h) = values.size();
                if (w, h) == (width, height) {
                    return Ok(values);
                }
                let text =
                    format!("{} has {width}×{height} pixels, its mask {} has {w}×{h}", photo.display(), mask.display());
                Err(Failure::new(text)
                    .advice("a mask of the photograph's full size, in the orientation shown by viewers"))
            };
            let (keep, remove) = (keep.map(read).transpose()?, remove.map(read).transpose()?);
            Ok(Some(PhotoMask::from_fn(width, height, |x, y| match (&remove, &keep) {
                (Some(mask), _) if mask.at(x, y)[0] => PhotoUse::Remove,
                (_, Some(mask)) if mask.at(x, y)[0] => PhotoUse::Keep,
                _ => PhotoUse::Free,
            })))
        };
        photos.iter().enumerate().map(one).collect()
    }
}

/// Returns the mask of each photograph among files and folders.
fn assigned(given: &[PathBuf], photos: &[PathBuf]) -> Result<Vec<Option<PathBuf>>, Failure> {
    let mut masks: Vec<Option<PathBuf>> = vec![None; photos.len()];
    for path in given {
        let is_folder = path.is_dir();
        let files = expand_images(std::slice::from_ref(path))?;
        let mut found = false;
        for mask in &files {
            let Some(photo) = photo_of(mask, photos, is_folder)? else { continue };
            found = true;
            if let Some(earlier) = masks[photo].replace(mask.clone()) {
                return Err(Failure::new(format!(
                    "{} and {} are both masks of {}",
                    earlier.display(),
                    mask.display(),
                    photos[photo].display()
                ))
                .advice("give one mask, white wherever one of the two is"));
            }
        }
        if !found {
            return Err(Failure::new(format!("no file in {} is named as the mask of a photograph", path.display()))
                .advice(NAMES));
        }
    }
    Ok(masks)
}

/// Returns the photograph of a mask by name. Files of a folder that belong to none are skipped: masks of other photographs, or photographs.
fn photo_of(mask: &Path, photos: &[PathBuf], in_folder: bool) -> Result<Option<usize>, Failure> {
    let name = stem(mask);
    let is_named = |photo: &Path| {
        let photo = stem(photo);
        name == photo || name.strip_suffix("_mask") == Some(&photo)
    };
    let fits = |(_, photo): &(usize, &PathBuf)| is_named(photo) && !same_file(photo, mask);
    let mut fitting = photos.iter().enumerate().filter(fits);
    match (fitting.next(), fitting.next()) {
        (Some((index, _)), None) => Ok(Some(index)),
        (Some((_, a)), Some((_, b))) => Err(Failure::new(format!(
            "{} is named as the mask of {} and of {}",
            mask.display(),
            a.display(),
            b.display()
        ))
        .advice("give the photographs different names")),
        (None, _) if in_folder => Ok(None),
        (None, _) => {
            let near = match photos {
                [] => String::new(),
                [first, ..] => format!(" ({} is the first of {})", first.display(), photos.len()),
            };
            Err(Failure::new(format!("{} is named as the mask of none of the photographs{near}", mask.display()))
                .advice(NAMES))
        }
    }
}
