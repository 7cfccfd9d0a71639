//! Output files: checked before the computation, never equal to an input.
//!
//! Missing folders are created when the first file is ready to be written, so that a failed job leaves none behind. Whether they can be created and
//! written to is checked before the computation.

use super::{Context, Explain, Failure};
use std::{
    fs,
    io::Write,
    path::{Path, PathBuf},
};

/// Extensions of images for people.
pub(crate) const IMAGE: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff"];
/// Extension of images that must be lossless.
pub(crate) const PNG: &[&str] = &["png"];
/// Extensions of float maps.
pub(crate) const MAP: &[&str] = &["pfm", "npy", "png"];
/// Extension of point clouds.
pub(crate) const CLOUD: &[&str] = &["ply"];
/// Extension of text tables.
pub(crate) const TEXT: &[&str] = &["txt"];
/// Extensions of cameras and rigs.
pub(crate) const YAML: &[&str] = &["yaml", "yml"];
/// Extension of models and other JSON.
pub(crate) const JSON: &[&str] = &["json"];

/// An output of a command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Output<'a> {
    /// A file, and the allowed extensions. For stdout (`-`) and devices the first one applies.
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

    /// Whether the output is a named file or folder, whose extension selects the format (not stdout or a device).
    fn has_name(self) -> bool {
        !is_stdout(self.path()) && (self.path().is_dir() || self.path().is_file() || !self.path().exists())
    }

    /// The folder that must exist or be created.
    fn folder(self) -> &'a Path {
        match self {
            Self::File(path, _) => folder_of(path),
            Self::Folder(path) => path,
        }
    }

    /// Checks whether it can be written, without writing it.
    fn check(self) -> Result<(), Failure> {
        let path = self.path();
        match self {
            Self::Folder(_) if is_stdout(path) => {
                return Err(Failure::usage("- is stdout, but this output is a folder of files")
                    .advice("name a folder (./- for one of that name)"));
            }
            Self::File(..) if path.is_dir() || path.file_name().is_none() => {
                return Err(Failure::new(format!("{} is a folder, not a file to write", path.display())));
            }
            Self::File(_, endings) if self.has_name() => {
                let ending = path.extension().unwrap_or_default().to_string_lossy().to_lowercase();
                if !endings.contains(&ending.as_str()) {
                    let what =
                        if ending.is_empty() { "no extension".to_owned() } else { format!("the extension .{ending}") };
                    let list: Vec<String> = endings.iter().map(|e| format!(".{e}")).collect();
                    return Err(Failure::usage(format!(
                        "{} has {what}, which is not one of this output's formats",
                        path.display()
                    ))
                    .advice(format!("a name with the extension {}", list.join(" or "))));
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
        // Tested with an unnamed temporary file, which is deleted at once.
        let refused = if readonly { Some("it is read-only".to_owned()) } else { probe(folder) };
        match refused {
            Some(why) => {
                Err(cannot(format!("cannot be written to ({why})")).advice("name an output in a folder of your own"))
            }
            None => Ok(()),
        }
    }
}

/// Returns why no file can be created in a folder.
fn probe(folder: &Path) -> Option<String> {
    tempfile::tempfile_in(folder).err().map(|error| error.to_string())
}

/// Whether a path means stdout.
fn is_stdout(path: &Path) -> bool {
    path.as_os_str() == "-"
}

/// Checks before the computation whether the results can be written. The report may share a folder with them.
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
            // Temporary files of killed runs.
            cv_io::remove_abandoned(output.folder());
        }
    }
    Ok(())
}

impl Context {
    /// Writes an output by `write`, which gets its path. Creates its folder, and removes it again if `write` fails.
    ///
    /// Output for stdout or a device is written to a temporary file first, so that it is complete or absent.
    pub(crate) fn write<T, E: Into<Failure>>(
        &self,
        output: Output<'_>,
        write: impl FnOnce(&Path) -> Result<T, E>,
    ) -> Result<T, Failure> {
        let target = Target::new(output)?;
        match write(&target.path) {
            Ok(result) => {
                self.deliver(output, &target)?;
                Ok(result)
            }
            Err(error) => {
                target.remove_folders();
                Err(error.into())
            }
        }
    }

    /// Passes a temporary file on to stdout or a device. Not generic, as is [`Target`]: `write` has an instance for every kind of output.
    fn deliver(&self, output: Output<'_>, target: &Target) -> Result<(), Failure> {
        if target.temporary.is_none() {
            return Ok(());
        }
        let (path, bytes) = (output.path(), cv_io::read_bytes(&target.path)?);
        if is_stdout(path) {
            self.keep_for_stdout(bytes);
            return Ok(());
        }
        let device = fs::File::options().write(true).open(path);
        device.and_then(|mut device| device.write_all(&bytes)).during(format!("cannot write {}", path.display()))
    }
}

/// Where an output is written to.
struct Target {
    path: PathBuf,
    /// The folder of `path`, if the output is for stdout or a device.
    temporary: Option<tempfile::TempDir>,
    /// Folders that were missing, the innermost first.
    created: Vec<PathBuf>,
}

impl Target {
    fn new(output: Output<'_>) -> Result<Self, Failure> {
        if let (Output::File(_, endings), false) = (output, output.has_name()) {
            let folder = tempfile::tempdir().during("cannot create a temporary folder")?;
            let path = folder.path().join("output").with_extension(endings.first().unwrap_or(&""));
            return Ok(Self { path, temporary: Some(folder), created: Vec::new() });
        }
        let created = create_folders(output.folder())?;
        Ok(Self { path: output.path().to_owned(), temporary: None, created })
    }

    /// Removes the folders created for an output that could not be written, if they are empty.
    fn remove_folders(&self) {
        self.created.iter().for_each(|folder| drop(fs::remove_dir(folder)));
    }
}

fn folder_of(path: &Path) -> &Path {
    match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    }
}

/// Returns the folder itself or its nearest existing ancestor.
fn nearest(folder: &Path) -> &Path {
    folder.ancestors().find(|above| above.exists()).unwrap_or(Path::new("."))
}

/// Creates a folder and its ancestors. Returns those that were missing, the innermost first.
fn create_folders(folder: &Path) -> Result<Vec<PathBuf>, Failure> {
    let missing: Vec<PathBuf> = folder.ancestors().take_while(|above| !above.exists()).map(Path::to_owned).collect();
    fs::create_dir_all(folder).during(format!("cannot create the folder {}", folder.display()))?;
    Ok(missing)
}

/// Whether two paths are the same file. False if one does not exist.
pub(crate) fn same_file(a: &Path, b: &Path) -> bool {
    matches!((a.canonicalize(), b.canonicalize()), (Ok(a), Ok(b)) if a == b)
}

/// Refuses two inputs with the same output; `outputs[i]` is that of `inputs[i]`.
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
        .advice("process them into different folders")),
        None => Ok(()),
    }
}

/// Refuses to overwrite an input by an output with a derived name.
pub(crate) fn spare_inputs(outputs: &[PathBuf], inputs: &[&Path]) -> Result<(), Failure> {
    match outputs.iter().find(|output| inputs.iter().any(|input| same_file(output, input))) {
        Some(path) => Err(Failure::new(format!("{} is an input and would be overwritten", path.display()))
            .advice("give another folder for the results")),
        None => Ok(()),
    }
}
