//! Files to write: checked before the work, and never those that are read.

use super::{Explain, Failure};
use std::{
    fs,
    path::{Path, PathBuf},
    time::{Duration, SystemTime},
};

/// Finds out before the work whether its results can be written.
pub(crate) fn check_outputs(paths: &[&Path]) -> Result<(), Failure> {
    for (i, path) in paths.iter().enumerate() {
        if paths[..i].contains(path) {
            return Err(Failure::usage(format!("{} is named for two outputs", path.display()))
                .advice("give each output its own name"));
        }
        if path.is_dir() || path.file_name().is_none() {
            return Err(Failure::new(format!("{} is a folder, not a file to write", path.display())));
        }
        let folder = folder_of(path);
        if !folder.is_dir() {
            let what = if folder.exists() { "is not a folder" } else { "does not exist" };
            return Err(Failure::new(format!("cannot write {}: {} {what}", path.display(), folder.display()))
                .advice(format!("mkdir -p {}", folder.display())));
        }
        if fs::metadata(folder).is_ok_and(|data| data.permissions().readonly()) {
            return Err(Failure::new(format!("cannot write {}: the folder is read-only", path.display()))
                .advice("name an output in a folder of your own"));
        }
        remove_stale(folder);
    }
    Ok(())
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Whether two paths lead to one file. What cannot be looked at does not exist yet, or will be told of when it is read.
pub(crate) fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// Refuses to write over what is read: outputs whose names the person did not type.
pub(crate) fn spare_inputs(outputs: &[PathBuf], inputs: &[&Path]) -> Result<(), Failure> {
    match outputs.iter().find(|output| inputs.iter().any(|input| same_file(output, input))) {
        Some(path) => Err(Failure::new(format!("{} would be written over, and is read", path.display()))
            .advice("give another folder for the results")),
        None => Ok(()),
    }
}

/// Makes a folder for outputs, and those above it.
pub(crate) fn create_dir(path: &Path) -> Result<(), Failure> {
    fs::create_dir_all(path).during(format!("cannot make the folder {}", path.display()))?;
    remove_stale(path);
    Ok(())
}

/// Removes what a run left behind that was killed while it wrote: `cv_io`'s temporary files, and folders of several. A write
/// takes seconds, so one that is an hour old belongs to nobody.
fn remove_stale(folder: &Path) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let name = entry.file_name();
        let ours = name.to_str().is_some_and(|name| name.starts_with(".cv-") && name.ends_with(".part"));
        let age = || SystemTime::now().duration_since(entry.metadata().ok()?.modified().ok()?).ok();
        if ours && age().is_some_and(|age| age > Duration::from_secs(3600)) {
            let folder = entry.file_type().is_ok_and(|kind| kind.is_dir());
            // Not ours to worry about where it cannot be removed.
            let _ = if folder { fs::remove_dir_all(entry.path()) } else { fs::remove_file(entry.path()) };
        }
    }
}

/// For `value_parser`: the name of a picture to write, whose ending says in which format. Wrong usage is told at once.
pub(crate) fn picture_name(text: &str) -> Result<PathBuf, String> {
    let path = PathBuf::from(text);
    let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    if ["png", "jpg", "jpeg"].contains(&ending.as_str()) {
        Ok(path)
    } else {
        Err("pictures are written as .png, .jpg or .jpeg".to_owned())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_old_leftovers_are_removed() {
        let folder = tempfile::tempdir().unwrap();
        let [old, new, foreign] = [".cv-old.part", ".cv-new.part", ".x.part"].map(|name| folder.path().join(name));
        for path in [&old, &new, &foreign] {
            fs::write(path, "half").unwrap();
        }
        for path in [&old, &foreign] {
            let file = fs::File::options().write(true).open(path).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(4000)).unwrap();
        }
        let several = folder.path().join(".cv-several.part");
        fs::create_dir(&several).unwrap();
        fs::write(several.join("left.png"), "half").unwrap();
        fs::File::open(&several).unwrap().set_modified(SystemTime::now() - Duration::from_secs(4000)).unwrap();
        check_outputs(&[&folder.path().join("out.txt")]).unwrap();
        assert!(!old.exists() && !several.exists() && new.exists() && foreign.exists());
    }

    #[test]
    fn outputs_that_cannot_be_written_are_told_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let (file, missing) = (folder.path().join("a.png"), folder.path().join("no/a.png"));
        check_outputs(&[&file]).unwrap();
        assert!(check_outputs(&[&file, &file]).unwrap_err().is_usage());
        let failure = check_outputs(&[&missing]).unwrap_err();
        assert!(!failure.is_usage() && failure.text().contains("try: mkdir -p "), "{}", failure.text());
        assert!(check_outputs(&[folder.path()]).unwrap_err().text().contains("is a folder"));
    }
}
