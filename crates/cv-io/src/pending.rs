//! What is being written, so that a program that has to end at once leaves nothing of it behind.

use crate::{FormatError, IoError};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};
use std::{
    fs::{self, File, TryLockError},
    io,
};

/// Names of temporary files and folders begin and end so.
pub(crate) const PREFIX: &str = ".cv-";
pub(crate) const SUFFIX: &str = ".part";

/// The temporary files and folders of all writes that go on.
static ALL: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

fn all() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    ALL.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A temporary file or folder of a write that goes on, locked as long: the lock of a process that is killed is free again, which tells
/// [`remove_abandoned`] that nobody will finish it.
pub(crate) struct Pending {
    path: PathBuf,
    /// None where the file system, or the operating system, has none of the kind.
    _lock: Option<File>,
}

impl Pending {
    /// Makes it. To [`abandon_writes`] it is there from the first moment, or not at all. (Of the two results the second is dropped first, and so removed
    /// while it is still known.)
    pub(crate) fn make<T>(make: impl Fn() -> io::Result<T>, path: impl Fn(&T) -> &Path) -> io::Result<(Self, T)> {
        let mut all = all();
        loop {
            let made = make()?;
            let path = path(&made).to_owned();
            let lock = lock(&path);
            // Between the two, another process may have taken it for abandoned.
            if matches!(lock, Lock::Held) || !path.exists() {
                continue;
            }
            all.insert(path.clone());
            let lock = if let Lock::Ours(file) = lock { Some(file) } else { None };
            return Ok((Self { path, _lock: lock }, made));
        }
    }

    /// Gives it its place. To [`abandon_writes`] it is still temporary, or all in its place.
    pub(crate) fn finish<T>(self, place: impl FnOnce() -> T) -> T {
        let mut all = all();
        let placed = place();
        all.remove(&self.path);
        drop(all);
        placed
    }
}

/// What comes of trying to lock a file or folder.
enum Lock {
    Ours(File),
    /// By another process.
    Held,
    /// It cannot be locked here.
    Unknown,
}

/// On other systems than Unix a lock would keep its own process from writing by another handle, and folders cannot be opened.
fn lock(path: &Path) -> Lock {
    if !cfg!(unix) {
        return Lock::Unknown;
    }
    let Ok(file) = File::open(path) else { return Lock::Unknown };
    match file.try_lock() {
        Ok(()) => Lock::Ours(file),
        Err(TryLockError::WouldBlock) => Lock::Held,
        Err(TryLockError::Error(_)) => Lock::Unknown,
    }
}

/// Removes from a folder what writes of this crate left behind whose process was killed: temporary files, and folders of several. What another process is
/// writing stays. Where that cannot be told (not Unix, a file system without locks), what is an hour old goes: a write takes seconds.
pub fn remove_abandoned(folder: impl AsRef<Path>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let (name, path) = (entry.file_name(), entry.path());
        let ours = name.to_str().is_some_and(|name| name.starts_with(PREFIX) && name.ends_with(SUFFIX));
        if !ours || all().contains(&path) {
            continue;
        }
        let age = || SystemTime::now().duration_since(entry.metadata().ok()?.modified().ok()?).ok();
        // Held until it is gone.
        let lock = lock(&path);
        let abandoned = match lock {
            Lock::Ours(_) => true,
            Lock::Held => false,
            Lock::Unknown => age().is_some_and(|age| age > Duration::from_secs(3600)),
        };
        if abandoned {
            // What cannot be removed, a later run will try again.
            let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        }
    }
}

impl Drop for Pending {
    fn drop(&mut self) {
        all().remove(&self.path);
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
    let make = || tempfile::Builder::new().prefix(PREFIX).suffix(SUFFIX).tempdir_in(folder);
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
        remove_abandoned(folder.path());
        assert!(path.exists());
        drop(pending);
        assert!(!known());
        let (pending, _) = Pending::make(make, |path| path).unwrap();
        // The lock is held: nobody sees the moment between.
        assert!(pending.finish(|| ALL.try_lock().is_err()) && !known());
        assert!(Pending::make(|| Err::<PathBuf, _>(io::Error::other("no")), |path| path).is_err());
    }

    #[cfg(unix)]
    #[test]
    fn what_nobody_writes_any_more_is_removed_and_nothing_else() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        for name in [".cv-dead.part", ".cv-busy.part", ".x.part", ".cv-other", "result.png"] {
            fs::write(path(name), "half").unwrap();
        }
        fs::create_dir(path(".cv-several.part")).unwrap();
        fs::write(path(".cv-several.part/left.png"), "half").unwrap();
        // A lock is that of the open file: a second one stands for another process.
        let busy = File::open(path(".cv-busy.part")).unwrap();
        busy.lock().unwrap();
        remove_abandoned(folder.path());
        assert_eq!(names(folder.path()), [".cv-busy.part", ".cv-other", ".x.part", "result.png"]);
        drop(busy);
        remove_abandoned(folder.path());
        assert_eq!(names(folder.path()), [".cv-other", ".x.part", "result.png"]);
    }
}
