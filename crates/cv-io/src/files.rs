//! Reading and atomic writing of whole files.

use std::fs::{self, File};
use std::io::{self, BufWriter, Read, Write};
use std::path::{Path, PathBuf};

use crate::pending_writes::{PREFIX, PendingWrite, SUFFIX};
use crate::{FormatError, IoError, memory};

/// Maximum size of a file that is read into memory: 4 GiB, far above any photograph.
pub const MAX_FILE_BYTES: u64 = 4 << 30;

/// Reads a file of at most [`MAX_FILE_BYTES`] and [`default_max_memory`](crate::default_max_memory) bytes.
///
/// # Errors
/// [`IoError`]: cannot be opened or read, is a folder, is too large.
pub fn read_bytes(path: impl AsRef<Path>) -> Result<Vec<u8>, IoError> {
    read_bytes_within(path.as_ref(), memory::default_max_memory())
}

/// As [`read_bytes`], for a file of at most `max_memory` bytes.
pub(crate) fn read_bytes_within(path: &Path, max_memory: u64) -> Result<Vec<u8>, IoError> {
    let fail = |reason: FormatError| IoError::reading(path, reason);
    let check_size = |bytes: u64| {
        if bytes > MAX_FILE_BYTES {
            return Err(fail(FormatError::TooManyBytes { bytes, limit: MAX_FILE_BYTES }));
        }
        memory::check_limit(bytes, max_memory, None).map_err(fail)
    };
    let file = File::open(path).map_err(|e| fail(e.into()))?;
    let metadata = file.metadata().map_err(|e| fail(e.into()))?;
    if metadata.is_dir() {
        return Err(fail(io::Error::new(io::ErrorKind::IsADirectory, "it is a folder").into()));
    }
    let mut bytes = Vec::new();
    if metadata.is_file() {
        check_size(metadata.len())?;
        bytes.reserve_exact(metadata.len() as usize);
    }
    // The length of a pipe or a growing file is unknown: stop just past the limit.
    let limit = MAX_FILE_BYTES.min(max_memory).saturating_add(1);
    file.take(limit).read_to_end(&mut bytes).map_err(|e| fail(e.into()))?;
    check_size(bytes.len() as u64)?;
    if bytes.is_empty() { Err(fail(FormatError::Empty)) } else { Ok(bytes) }
}

/// Reads a UTF-8 text file without a leading byte order mark.
pub(crate) fn read_text(path: &Path) -> Result<String, IoError> {
    let text = String::from_utf8(read_bytes(path)?)
        .map_err(|_| IoError::reading(path, FormatError::corrupt("text", "it is not UTF-8 text")))?;
    Ok(match text.strip_prefix('\u{feff}') {
        Some(rest) => rest.to_owned(),
        None => text,
    })
}

/// Writes a file atomically.
///
/// The content goes to a temporary file in the same folder, which is renamed to `path` once `content` has succeeded;
/// after a failure it is removed, and an existing file at `path` is unchanged. Permissions are those of the replaced file, or
/// those of the umask. A symbolic link is followed; a device or a pipe is written to directly. The file is synced before the rename, so that
/// even after a power failure `path` is the old file or the new one, never a part. That costs a few milliseconds per file
/// (7 ms on a virtual disk, for a kilobyte as for 20 MB), and reports a full disk on file systems with delayed allocation.
///
/// # Errors
/// [`IoError`] with the path and the operating system's reason, or whatever `content` fails with.
pub fn write_atomic<R: Into<FormatError>>(
    path: impl AsRef<Path>,
    content: impl FnOnce(&mut dyn Write) -> Result<(), R>,
) -> Result<(), IoError> {
    let path = path.as_ref();
    let mut content = Some(content);
    let mut once = |file: File| {
        let mut sink = BufWriter::with_capacity(1 << 18, file);
        content.take().map_or(Ok(()), |content| content(&mut sink).map_err(Into::into))?;
        Ok(sink.flush()?)
    };
    write_atomic_file(path, &mut once).map_err(|reason| IoError::writing(path, reason))
}

/// As [`write_atomic`]; `content` writes to the file and closes it.
pub(crate) fn write_atomic_file(
    path: &Path,
    content: &mut dyn FnMut(File) -> Result<(), FormatError>,
) -> Result<(), FormatError> {
    let target: PathBuf = if path.is_symlink() { fs::canonicalize(path)? } else { path.to_owned() };
    let existing = fs::metadata(&target).ok();
    if let Some(metadata) = &existing {
        if metadata.is_dir() {
            return Err(io::Error::new(io::ErrorKind::IsADirectory, "it is a folder").into());
        }
        if !metadata.is_file() {
            return content(File::options().write(true).open(&target)?);
        }
    }
    let folder = match target.parent() {
        Some(parent) if !parent.as_os_str().is_empty() => parent,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        let reason = format!("the folder {} does not exist", folder.display());
        return Err(io::Error::new(io::ErrorKind::NotFound, reason).into());
    }
    let mut builder = tempfile::Builder::new();
    builder.prefix(PREFIX).suffix(SUFFIX);
    // Temporary files are private by default; outputs have the usual permissions by the umask.
    #[cfg(unix)]
    {
        use std::os::unix::fs::PermissionsExt;
        builder.permissions(fs::Permissions::from_mode(0o666));
    }
    let (pending, temporary) = PendingWrite::make(|| builder.tempfile_in(folder), |made| made.path())?;
    content(temporary.as_file().try_clone()?)?;
    if let Some(metadata) = existing {
        temporary.as_file().set_permissions(metadata.permissions())?;
    }
    // Otherwise the rename may reach the disk before the data, which would leave an empty file after a crash.
    temporary.as_file().sync_all()?;
    pending.finish(|| temporary.persist(&target)).map_err(|e| e.error)?;
    Ok(())
}

/// As [`write_atomic`], for bytes in memory.
///
/// # Errors
/// As [`write_atomic`].
pub fn write_bytes(path: impl AsRef<Path>, bytes: &[u8]) -> Result<(), IoError> {
    write_atomic(path, |sink| sink.write_all(bytes))
}
