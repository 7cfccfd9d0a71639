//! Atomic writing of one file and of several.

use std::fs;
use std::io;
use std::path::Path;

use cv_io::{FormatError, IoError, read_bytes, write_atomic, write_bytes, write_together};

fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<_> =
        fs::read_dir(folder).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn a_failed_write_leaves_the_old_file_and_no_temporary_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.txt");
    write_bytes(&path, b"old").unwrap();
    let error = write_atomic(&path, |sink| {
        sink.write_all(&[7; 1 << 20])?;
        Err::<(), io::Error>(io::Error::other("the well ran dry"))
    })
    .unwrap_err();
    assert!(error.to_string().contains("the well ran dry") && error.to_string().contains("a.txt"), "{error}");
    assert_eq!(fs::read(&path).unwrap(), b"old");
    assert_eq!(names(folder.path()), ["a.txt"]);
}

#[test]
fn a_panic_while_writing_leaves_no_temporary_file() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.txt");
    let result =
        std::panic::catch_unwind(|| write_atomic(&path, |_| -> Result<(), io::Error> { panic!("on purpose") }));
    assert!(result.is_err());
    assert!(names(folder.path()).is_empty());
}

#[cfg(unix)]
#[test]
fn permissions_follow_the_umask_and_survive_replacement() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let plain = folder.path().join("plain");
    fs::write(&plain, b"x").unwrap();
    let ours = folder.path().join("ours");
    write_bytes(&ours, b"x").unwrap();
    let mode = |p: &Path| fs::metadata(p).unwrap().permissions().mode() & 0o777;
    assert_eq!(mode(&ours), mode(&plain));
    fs::set_permissions(&ours, fs::Permissions::from_mode(0o640)).unwrap();
    write_bytes(&ours, b"y").unwrap();
    assert_eq!((mode(&ours), fs::read(&ours).unwrap()), (0o640, b"y".to_vec()));
}

#[cfg(unix)]
#[test]
fn a_symbolic_link_is_followed() {
    let folder = tempfile::tempdir().unwrap();
    let (real, link) = (folder.path().join("real"), folder.path().join("link"));
    fs::write(&real, b"old").unwrap();
    std::os::unix::fs::symlink(&real, &link).unwrap();
    write_bytes(&link, b"new").unwrap();
    assert!(link.is_symlink());
    assert_eq!(fs::read(&real).unwrap(), b"new");
}

#[test]
fn a_missing_folder_and_a_folder_at_the_path_are_reported() {
    let folder = tempfile::tempdir().unwrap();
    let error = write_bytes(folder.path().join("no/such/a.txt"), b"x").unwrap_err().to_string();
    assert!(error.contains("does not exist"), "{error}");
    let error = write_bytes(folder.path(), b"x").unwrap_err().to_string();
    assert!(error.contains("folder"), "{error}");
    let error = read_bytes(folder.path()).unwrap_err().to_string();
    assert!(error.contains("folder"), "{error}");
}

#[test]
fn an_empty_file_is_reported_as_such() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("empty.png");
    fs::write(&path, b"").unwrap();
    assert!(matches!(read_bytes(&path).unwrap_err().reason, FormatError::Empty));
}

#[test]
fn several_files_are_written_all_or_none() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path();
    let write = |text: &'static str, fails: bool| {
        write_together(path, &["a", "b"], |temporary| -> Result<(), IoError> {
            write_bytes(temporary.join("a"), text.as_bytes())?;
            if fails {
                return Err(IoError { path: path.to_owned(), writing: true, reason: FormatError::Empty });
            }
            write_bytes(temporary.join("b"), text.as_bytes())
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

#[cfg(unix)]
#[test]
fn only_abandoned_writes_are_removed() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    for name in [".cv-dead.part", ".cv-busy.part", ".x.part", ".cv-other", "result.png"] {
        fs::write(path(name), "half").unwrap();
    }
    fs::create_dir(path(".cv-several.part")).unwrap();
    fs::write(path(".cv-several.part/left.png"), "half").unwrap();
    // Locks belong to the open file: a second handle simulates another process.
    let busy = fs::File::open(path(".cv-busy.part")).unwrap();
    busy.lock().unwrap();
    cv_io::remove_abandoned(folder.path());
    assert_eq!(names(folder.path()), [".cv-busy.part", ".cv-other", ".x.part", "result.png"]);
    drop(busy);
    cv_io::remove_abandoned(folder.path());
    assert_eq!(names(folder.path()), [".cv-other", ".x.part", "result.png"]);
}
