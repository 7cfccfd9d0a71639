//! What is being written, so that a program that has to end at once leaves nothing of it behind.

use crate::{FormatError, IoError};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::{fs, io};

/// The temporary files and folders of all writes that go on.
static ALL: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

fn all() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    ALL.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A temporary file or folder of a write that goes on.
pub(crate) struct Pending(PathBuf);

impl Pending {
    /// Makes it. To [`abandon_writes`] it is there from the first moment, or not at all. (Of the two results the second is dropped first, and so removed
    /// while it is still known.)
    pub(crate) fn make<T>(
        make: impl FnOnce() -> io::Result<T>,
        path: impl FnOnce(&T) -> &Path,
    ) -> io::Result<(Self, T)> {
        let mut all = all();
        let made = make()?;
        let path = path(&made).to_owned();
        all.insert(path.clone());
        Ok((Self(path), made))
    }

    /// Gives it its place. To [`abandon_writes`] it is still temporary, or all in its place.
    pub(crate) fn finish<T>(self, place: impl FnOnce() -> T) -> T {
        let mut all = all();
        let placed = place();
        all.remove(&self.0);
        drop(all);
        placed
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        all().remove(&self.0);
    }
}

/// Ends all writing of this process: what is there in part is removed, and whoever writes on, or begins to, waits for ever.
///
/// For a program that exits at once, from whatever thread: each file is then the new one or the old one, and nothing else is left.
pub fn abandon_writes() {
    let all = all();
    for path in &*all {
        // What cannot be removed, a later run will try again.
        let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    }
    std::mem::forget(all);
}

/// Writes several files of one folder, all or none.
///
/// `write` writes the files `names` into a temporary folder inside `folder`, which must exist; once it has succeeded they are moved up. Where one cannot be
/// written, or a folder stands where one is to go, nothing changes.
///
/// # Errors
/// Whatever `write` fails with, and [`IoError`].
pub fn write_together<E: From<IoError>>(
    folder: impl AsRef<Path>,
    names: &[&str],
    write: impl FnOnce(&Path) -> Result<(), E>,
) -> Result<(), E> {
    let folder = folder.as_ref();
    let fail = |path: &Path, error: io::Error| IoError::writing(path, FormatError::from(error));
    for path in names.iter().map(|name| folder.join(name)) {
        if path.is_dir() {
            return Err(fail(&path, io::Error::new(io::ErrorKind::IsADirectory, "it is a folder")).into());
        }
    }
    let make = || tempfile::Builder::new().prefix(".cv-").suffix(".part").tempdir_in(folder);
    let (pending, temporary) = Pending::make(make, |made| made.path()).map_err(|error| fail(folder, error))?;
    write(temporary.path())?;
    pending.finish(|| {
        names.iter().try_for_each(|name| {
            let path = folder.join(name);
            fs::rename(temporary.path().join(name), &path).map_err(|error| fail(&path, error))
        })?;
        // Empty now.
        temporary.close().map_err(|error| fail(folder, error))
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(folder: &Path) -> Vec<String> {
        let entries = fs::read_dir(folder).unwrap();
        let mut names: Vec<_> = entries.map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    #[test]
    fn several_files_are_written_all_or_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path();
        let write = |text: &'static str, fails: bool| {
            write_together(path, &["a", "b"], |temporary| -> Result<(), IoError> {
                crate::write_bytes(temporary.join("a"), text.as_bytes())?;
                if fails {
                    return Err(IoError::writing(path, FormatError::Empty));
                }
                crate::write_bytes(temporary.join("b"), text.as_bytes())
            })
        };
        assert!(write("first", true).is_err() && names(path).is_empty());
        write("second", false).unwrap();
        assert!(write("third", true).is_err());
        assert_eq!(names(path), ["a", "b"]);
        assert_eq!(fs::read(path.join("a")).unwrap(), b"second");
        fs::remove_file(path.join("b")).unwrap();
        fs::create_dir(path.join("b")).unwrap();
        assert!(write("fourth", false).is_err());
        assert_eq!(fs::read(path.join("a")).unwrap(), b"second");
    }

    #[test]
    fn what_is_written_is_known_until_it_is_in_its_place() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.part");
        let known = || all().contains(&path);
        let make = || fs::write(&path, "half").map(|()| path.clone());
        let (pending, _) = Pending::make(make, |path| path).unwrap();
        assert!(known());
        drop(pending);
        assert!(!known());
        let (pending, _) = Pending::make(make, |path| path).unwrap();
        // The lock is held: nobody sees the moment between.
        assert!(pending.finish(|| ALL.try_lock().is_err()) && !known());
        assert!(Pending::make(|| Err::<PathBuf, _>(io::Error::other("no")), |path| path).is_err());
    }
}
