//! The photographs of the command line: duplicates and their names in a model.

use crate::frame::{Failure, sort_by_name};
use cv_io::ExifGps;
use std::collections::{BTreeMap, HashSet};
use std::fs;
use std::path::{Path, PathBuf};

/// A photograph of the command line.
pub(super) struct Photograph {
    pub(super) path: PathBuf,
    /// Its name in the model.
    pub(super) name: String,
    /// Why it is not used.
    pub(super) refused: Option<String>,
    /// Its GPS position by EXIF.
    pub(super) gps: Option<ExifGps>,
}

/// Returns each file once, sorted by name, so that a model does not depend on the order of arguments. Byte-identical copies are refused: they are
/// views without a baseline.
pub(super) fn photographs(mut paths: Vec<PathBuf>) -> Result<Vec<Photograph>, Failure> {
    sort_by_name(&mut paths);
    let mut seen = HashSet::new();
    // A missing file has no canonical path; it is reported when it is read.
    paths.retain(|path| seen.insert(path.canonicalize().unwrap_or_else(|_| path.clone())));
    let names = names(&paths);
    let mut all: Vec<Photograph> =
        paths.into_iter().zip(names).map(|(path, name)| Photograph { path, name, refused: None, gps: None }).collect();
    // COLMAP's files cut names at white space.
    if let Some(odd) = all.iter().find(|p| p.name.split_whitespace().collect::<Vec<_>>().join(" ") != p.name) {
        let what = format!("{} has white space in its name that COLMAP's files cannot represent", odd.path.display());
        return Err(Failure::new(what).advice("rename it"));
    }
    refuse_copies(&mut all);
    Ok(all)
}

/// Returns the names in the model: file names, or if they are not unique, paths relative to the common folder.
fn names(paths: &[PathBuf]) -> Vec<String> {
    let file = |path: &PathBuf| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
    let mut seen = HashSet::new();
    if paths.iter().all(|path| seen.insert(file(path))) {
        return paths.iter().map(file).collect();
    }
    let whole: Vec<PathBuf> = paths.iter().map(|path| absolute(path)).collect();
    let mut common = whole.first().and_then(|path| path.parent()).unwrap_or(Path::new("")).to_owned();
    while !whole.iter().all(|path| path.starts_with(&common)) && common.pop() {}
    whole.iter().map(|path| joined(path.strip_prefix(&common).unwrap_or(path))).collect()
}

/// Returns the absolute path, with symbolic links resolved if it exists.
fn absolute(path: &Path) -> PathBuf {
    path.canonicalize().or_else(|_| std::path::absolute(path)).unwrap_or_else(|_| path.to_owned())
}

/// Joins a path with forward slashes on every system.
fn joined(path: &Path) -> String {
    path.components().map(|part| part.as_os_str().to_string_lossy()).collect::<Vec<_>>().join("/")
}

/// Returns the path of a file relative to a folder.
pub(super) fn relative_path(folder: &Path, file: &Path) -> String {
    let (folder, file) = (absolute(folder), absolute(file));
    let same = folder.components().zip(file.components()).take_while(|(a, b)| a == b).count();
    // On another drive there is no relative path.
    if same == 0 {
        return file.to_string_lossy().into_owned();
    }
    let up = folder.components().skip(same).map(|_| "..");
    let down: PathBuf =
        up.map(Path::new).chain(file.components().skip(same).map(|part| Path::new(part.as_os_str()))).collect();
    joined(&down)
}

/// Refuses byte-identical copies of an earlier file. Only files of the same length are compared.
fn refuse_copies(all: &mut [Photograph]) {
    let mut by_length: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for (i, photograph) in all.iter().enumerate() {
        if let Ok(data) = fs::metadata(&photograph.path).map(|data| data.len()) {
            by_length.entry(data).or_default().push(i);
        }
    }
    for group in by_length.values().filter(|group| group.len() > 1) {
        let mut known: Vec<(Vec<u8>, usize)> = Vec::new();
        for &i in group {
            // A file that cannot be read is reported later.
            let Ok(bytes) = cv_io::read_bytes(&all[i].path) else { continue };
            match known.iter().find(|(other, _)| *other == bytes) {
                Some(&(_, first)) => {
                    all[i].refused = Some(format!("it is identical, byte for byte, to {}", all[first].path.display()));
                }
                None => known.push((bytes, i)),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_file_names_or_paths_relative_to_the_common_folder() {
        let folder = tempfile::tempdir().unwrap();
        let of = |paths: &[&str]| {
            let paths: Vec<PathBuf> = paths.iter().map(|path| folder.path().join(path)).collect();
            paths.iter().for_each(|path| {
                fs::create_dir_all(path.parent().unwrap()).unwrap();
                fs::write(path, path.to_string_lossy().as_bytes()).unwrap();
            });
            let all = photographs(paths).unwrap();
            all.into_iter().map(|p| (p.name, p.refused.is_none())).collect::<Vec<_>>()
        };
        let named = |names: &[&str]| names.iter().map(|n| ((*n).to_owned(), true)).collect::<Vec<_>>();
        assert_eq!(of(&["x/2.jpg", "y/10.jpg", "x/2.jpg"]), named(&["2.jpg", "10.jpg"]));
        assert_eq!(of(&["p/y/1.jpg", "p/x/1.jpg", "p/x/z/3.jpg"]), named(&["x/1.jpg", "x/z/3.jpg", "y/1.jpg"]));
        assert!(photographs(vec![folder.path().join("a  b.jpg")]).is_err());
        assert_eq!(relative_path(&folder.path().join("x"), &folder.path().join("y/10.jpg")), "../y/10.jpg");
        assert_eq!(relative_path(folder.path(), &folder.path().join("y/10.jpg")), "y/10.jpg");
    }

    #[test]
    fn copies_are_detected_by_their_bytes() {
        let folder = tempfile::tempdir().unwrap();
        let paths = ["a", "b", "c", "d"].map(|name| folder.path().join(name));
        for (path, bytes) in paths.iter().zip(["one", "two", "one"]) {
            fs::write(path, bytes).unwrap();
        }
        let all = photographs(paths.to_vec()).unwrap();
        assert_eq!(all.iter().map(|p| p.refused.is_some()).collect::<Vec<_>>(), [false, false, true, false]);
    }
}
