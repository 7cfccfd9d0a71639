//! Registry of unfinished writes, so that a program that exits early leaves no temporary files.

use crate::{FormatError, IoError};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, SystemTime};
use std::{
    fs::{self, File, TryLockError},
    io,
};

/// Prefix and suffix of the names of temporary files and folders.
pub(crate) const PREFIX: &str = ".cv-";
pub(crate) const SUFFIX: &str = ".part";

/// The temporary files and folders of all unfinished writes of this process.
static PENDING_PATHS: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());

fn pending_paths() -> MutexGuard<'static, BTreeSet<PathBuf>> {
    PENDING_PATHS.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A temporary file or folder of an unfinished write, which stays locked. The operating system releases the lock of a killed process, which
/// shows [`remove_abandoned`] that the write is abandoned.
pub(crate) struct PendingWrite {
    path: PathBuf,
    /// `None` where the file system or the operating system does not support locks.
    _lock: Option<File>,
}

impl PendingWrite {
    /// Creates and registers a temporary file or folder, atomically with respect to [`abandon_writes`]. (The second result is dropped first, so
    /// that it is removed while still registered.)
    pub(crate) fn make<T>(make: impl Fn() -> io::Result<T>, path: impl Fn(&T) -> &Path) -> io::Result<(Self, T)> {
        let mut all = pending_paths();
        loop {
            let made = make()?;
            let path = path(&made).to_owned();
            let lock = lock(&path);
            // Before it was locked, another process may have taken it for abandoned.
            if matches!(lock, Lock::HeldElsewhere) || !path.exists() {
                continue;
            }
            all.insert(path.clone());
            let lock = if let Lock::Acquired(file) = lock { Some(file) } else { None };
            return Ok((Self { path, _lock: lock }, made));
        }
    }

    /// Moves it to its final path by `place`, atomically with respect to [`abandon_writes`].
    pub(crate) fn finish<T>(self, place: impl FnOnce() -> T) -> T {
        let mut all = pending_paths();
        let placed = place();
        all.remove(&self.path);
        drop(all);
        placed
    }
}

/// Result of trying to lock a file or folder.
enum Lock {
    Acquired(File),
    /// Locked by another process.
    HeldElsewhere,
    /// Locks are not supported here.
    Unsupported,
}

/// Tries to lock a path. Only on Unix: elsewhere a lock would block writes of the same process by another handle, and folders cannot be opened.
fn lock(path: &Path) -> Lock {
    if !cfg!(unix) {
        return Lock::Unsupported;
    }
    let Ok(file) = File::open(path) else { return Lock::Unsupported };
    match file.try_lock() {
        Ok(()) => Lock::Acquired(file),
        Err(TryLockError::WouldBlock) => Lock::HeldElsewhere,
        Err(TryLockError::Error(_)) => Lock::Unsupported,
    }
}

/// Removes temporary files and folders that writes of killed processes left in a folder. Those of running processes stay. Where locks are not
/// supported (not Unix, some file systems), those older than an hour are removed: a write takes seconds.
pub fn remove_abandoned(folder: impl AsRef<Path>) {
    let Ok(entries) = fs::read_dir(folder) else { return };
    for entry in entries.flatten() {
        let (name, path) = (entry.file_name(), entry.path());
        let ours = name.to_str().is_some_and(|name| name.starts_with(PREFIX) && name.ends_with(SUFFIX));
        if !ours || pending_paths().contains(&path) {
            continue;
        }
        let age = || SystemTime::now().duration_since(entry.metadata().ok()?.modified().ok()?).ok();
        // The lock is kept until the removal.
        let lock = lock(&path);
        let abandoned = match lock {
            Lock::Acquired(_) => true,
            Lock::HeldElsewhere => false,
            Lock::Unsupported => age().is_some_and(|age| age > Duration::from_secs(3600)),
        };
        if abandoned {
            // A later run will retry failed removals.
            let _ = if path.is_dir() { fs::remove_dir_all(&path) } else { fs::remove_file(&path) };
        }
    }
}

impl Drop for PendingWrite {
    fn drop(&mut self) {
        pending_paths().remove(&self.path);
    }
}

/// Abandons all writes of this process: removes temporary files, and blocks all threads that write from then on.
///
/// For a program that exits immediately, from any thread: each file is then the new one or the old one, and no temporary file remains.
pub fn abandon_writes() {
    let all = pending_paths();
    for path in &*all {
        // A later run will retry failed removals.
        let _ = if path.is_dir() { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    }
    std::mem::forget(all);
}

/// Writes several files of one folder atomically: all or none.
///
/// `write` writes the files `names` into a temporary folder inside `folder`, which must exist; after success they are moved to `folder`. Where one
/// cannot be written, or a folder exists at its path, nothing changes.
///
/// # Errors
/// Errors of `write`, and [`IoError`].
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
    let (pending, temporary) = PendingWrite::make(make, |made| made.path()).map_err(|error| fail(folder, error))?;
    write(temporary.path())?;
    pending.finish(|| {
        names.iter().try_for_each(|name| {
            let path = folder.join(name);
            fs::rename(temporary.path().join(name), &path).map_err(|error| fail(&path, error))
        })?;
        // The temporary folder is empty now.
        temporary.close().map_err(|error| fail(folder, error))
    })?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_write_is_registered_until_it_is_finished() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.part");
        let known = || pending_paths().contains(&path);
        let make = || fs::write(&path, "half").map(|()| path.clone());
        let (pending, _) = PendingWrite::make(make, |path| path).unwrap();
        assert!(known());
        remove_abandoned(folder.path());
        assert!(path.exists());
        drop(pending);
        assert!(!known());
        let (pending, _) = PendingWrite::make(make, |path| path).unwrap();
        // The registry is locked while the file is moved.
        assert!(pending.finish(|| PENDING_PATHS.try_lock().is_err()) && !known());
        assert!(PendingWrite::make(|| Err::<PathBuf, _>(io::Error::other("no")), |path| path).is_err());
    }
}
