//! Files to write: checked before the work, and never those that are read.
//!
//! Folders that are missing are made when the first file is ready to go there, not before: a job that fails leaves none behind. That they can be
//! made, and written to, is found out before the work.

use super::{Context, Explain, Failure};
use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
};

/// Pictures for people.
pub(crate) const PICTURE: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff"];
/// Pictures whose values must stay as they are.
pub(crate) const PNG: &[&str] = &["png"];
/// Maps of numbers.
pub(crate) const MAP: &[&str] = &["pfm", "npy", "png"];
/// Clouds of points.
pub(crate) const CLOUD: &[&str] = &["ply"];
/// Rows of numbers.
pub(crate) const TEXT: &[&str] = &["txt"];
/// Cameras and rigs.
pub(crate) const YAML: &[&str] = &["yaml", "yml"];
/// Models.
pub(crate) const JSON: &[&str] = &["json"];

/// Something that a command writes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Output<'a> {
    /// A file, and the endings that its name may have. Of stdout (`-`) and of a device the first one holds.
    File(&'a Path, &'static [&'static str]),
    /// A folder of files.
    Folder(&'a Path),
}

impl<'a> Output<'a> {
    fn path(self) -> &'a Path {
        match self {
            Self::File(path, _) | Self::Folder(path) => path,
        }
    }

    /// Whether the format, if there are several, is told by the name of the file.
    fn has_name(self) -> bool {
        !is_stdout(self.path()) && (self.path().is_dir() || self.path().is_file() || !self.path().exists())
    }

    /// The folder that must be there.
    fn folder(self) -> &'a Path {
        match self {
            Self::File(path, _) => folder_of(path),
            Self::Folder(path) => path,
        }
    }

    /// Whether it can be written, as far as can be told without writing it.
    fn check(self) -> Result<(), Failure> {
        let path = self.path();
        match self {
            Self::Folder(_) if is_stdout(path) => {
                return Err(Failure::usage("- is stdout, and this output is a folder of files")
                    .advice("name a folder (./- for one of that name)"));
            }
            Self::File(..) if path.is_dir() || path.file_name().is_none() => {
                return Err(Failure::new(format!("{} is a folder, not a file to write", path.display())));
            }
            Self::File(_, endings) if self.has_name() => {
                let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
                if !endings.contains(&ending.as_str()) {
                    let what = if ending.is_empty() { "no ending".to_owned() } else { format!("the ending .{ending}") };
                    let list: Vec<String> = endings.iter().map(|e| format!(".{e}")).collect();
                    return Err(Failure::usage(format!("{} has {what}, which tells no format", path.display()))
                        .advice(format!("a name that ends in {}", list.join(" or "))));
                }
            }
            _ => {}
        }
        if !self.has_name() {
            return Ok(());
        }
        let folder = nearest(self.folder());
        let cannot =
            |what: String| Failure::new(format!("cannot write {}: {} {what}", path.display(), folder.display()));
        if !folder.is_dir() {
            return Err(cannot("is not a folder".to_owned()).advice("name an output in a folder"));
        }
        let readonly = fs::metadata(folder).is_ok_and(|data| data.permissions().readonly());
        // A file without a name, which is gone at once.
        let refused = if readonly { Some("it is read-only".to_owned()) } else { probe(folder) };
        match refused {
            Some(why) => {
                Err(cannot(format!("cannot be written to ({why})")).advice("name an output in a folder of your own"))
            }
            None => Ok(()),
        }
    }
}

/// Why no file can be made in a folder.
fn probe(folder: &Path) -> Option<String> {
    tempfile::tempfile_in(folder).err().map(|error| error.to_string())
}

/// Whether a name stands for stdout.
fn is_stdout(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Finds out before the work whether its results can be written. The report may go into a folder of results.
pub(super) fn check(outputs: &[Output<'_>], report: Option<&Path>, json: bool) -> Result<(), Failure> {
    for (i, output) in outputs.iter().enumerate() {
        let path = output.path();
        if outputs[..i].iter().any(|other| other.path() == path) {
            return Err(Failure::usage(format!("{} is named for two outputs", path.display()))
                .advice("give each output its own name"));
        }
        if json && is_stdout(path) && matches!(output, Output::File(..)) {
            return Err(Failure::usage("--json and the output - would both be written to stdout")
                .advice("give the output a name, or leave out --json"));
        }
    }
    for output in outputs.iter().copied().chain(report.map(Output::Folder)) {
        output.check()?;
        if output.has_name() {
            // Of runs that were killed while they wrote.
            cv_io::remove_abandoned(output.folder());
        }
    }
    Ok(())
}

impl Context {
    /// Writes an output by `write`, which is given its path. Its folder is made; where `write` fails, it is removed again.
    ///
    /// What goes to stdout or to a device is written to a temporary file first: whole or not at all there too.
    pub(crate) fn write<T, E: Into<Failure>>(
        &self,
        output: Output<'_>,
        write: impl FnOnce(&Path) -> Result<T, E>,
    ) -> Result<T, Failure> {
        if let (Output::File(path, endings), false) = (output, output.has_name()) {
            let folder = tempfile::tempdir().during("cannot make a temporary folder")?;
            let file = folder.path().join("output").with_extension(endings.first().unwrap_or(&""));
            let result = write(&file).map_err(Into::into)?;
            let bytes = cv_io::read_bytes(&file)?;
            if is_stdout(path) {
                self.keep_for_stdout(bytes);
            } else {
                let device = fs::File::options().write(true).open(path);
                device
                    .and_then(|mut device| device.write_all(&bytes))
                    .during(format!("cannot write {}", path.display()))?;
            }
            return Ok(result);
        }
        let made = make_folders(output.folder())?;
        write(output.path()).map_err(|error| {
            // Those that are empty.
            made.iter().for_each(|folder| drop(fs::remove_dir(folder)));
            error.into()
        })
    }
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// The folder itself, or the nearest one above it that is there.
fn nearest(folder: &Path) -> &Path {
    folder.ancestors().find(|above| above.exists()).unwrap_or(Path::new("."))
}

/// Makes a folder and those above it. Gives those that were missing, the innermost first.
fn make_folders(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let missing: Vec<PathBuf> = folder.ancestors().take_while(|above| !above.exists()).map(Path::to_owned).collect();
    fs::create_dir_all(folder).during(format!("cannot make the folder {}", folder.display()))?;
    Ok(missing)
}

/// Whether two paths lead to one file. What cannot be looked at does not exist yet, or will be told of when it is read.
pub(crate) fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// Refuses two inputs that would become one output; `outputs[i]` is that of `inputs[i]`.
pub(crate) fn one_each(inputs: &[PathBuf], outputs: &[PathBuf]) -> Result<(), Failure> {
    let mut order: Vec<usize> = (0..inputs.len().min(outputs.len())).collect();
    order.sort_by_key(|i| &outputs[*i]);
    match order.windows(2).find(|pair| outputs[pair[0]] == outputs[pair[1]]) {
        Some(pair) => Err(Failure::usage(format!(
            "{} and {} would both be written to {}",
            inputs[pair[0]].display(),
            inputs[pair[1]].display(),
            outputs[pair[0]].display()
        ))
        .advice("run them into different folders")),
        None => Ok(()),
    }
}

/// Refuses to write over what is read: outputs whose names the person did not type.
pub(crate) fn spare_inputs(outputs: &[PathBuf], inputs: &[&Path]) -> Result<(), Failure> {
    match outputs.iter().find(|output| inputs.iter().any(|input| same_file(output, input))) {
        Some(path) => Err(Failure::new(format!("{} would be written over, and is read", path.display()))
            .advice("give another folder for the results")),
        None => Ok(()),
    }
}
