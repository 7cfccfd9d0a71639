//! Checkpoints of a run that may be stopped: the features of each photograph, then the matched pairs, in a subfolder of the output until the model is complete.
//!
//! Entries are keyed by a hash of their inputs (file contents and options), not by time or path: entries of other inputs are ignored.

mod record;

use super::photographs::Photograph;
use crate::frame::{Context, Output};
use cv_core::Cancelled;
use cv_io::IoError;
use cv_pipeline::{SfmCamera, SfmJobOptions, SfmPhoto};
use record::Record;
pub(super) use record::{Extracted, Pairs};
use std::cell::{Cell, RefCell};
use std::fs;
use std::hash::{DefaultHasher, Hasher};
use std::path::{Path, PathBuf};

/// Name of the checkpoint's subfolder of the output folder.
const FOLDER: &str = ".cv-sfm";

/// The checkpoint of a run.
pub(super) struct Checkpoint<'a> {
    folder: PathBuf,
    /// Whether entries of an earlier run are reused.
    resume: bool,
    /// Whether there is a checkpoint of an earlier run.
    found: bool,
    /// Folders that did not exist before this run, the innermost first.
    missing: Vec<PathBuf>,
    context: &'a Context,
    /// Whether writing failed (on a full disk, for example). The run continues without checkpoints.
    broken: Cell<bool>,
    /// Keys of the photographs with features.
    keys: RefCell<Vec<u64>>,
    /// Number of photographs whose features are reused, and whether the pairs are.
    reused: Cell<(usize, bool)>,
}

impl<'a> Checkpoint<'a> {
    pub(super) fn new(output: &Path, resume: bool, context: &'a Context) -> Self {
        let folder = output.join(FOLDER);
        let missing = output.ancestors().take_while(|above| !above.exists()).map(Path::to_owned).collect();
        cv_io::remove_abandoned(&folder);
        let found = folder.exists();
        match (found, resume) {
            (true, false) => {
                context.note(format!("{} has the checkpoint of a stopped run; --resume continues it", folder.display()))
            }
            (false, true) => context.note(format!("{} does not exist: starting from the beginning", folder.display())),
            _ => {}
        }
        let (broken, keys, reused) = (Cell::new(false), RefCell::default(), Cell::new((0, false)));
        Self { folder, resume, found, missing, context, broken, keys, reused }
    }

    /// Returns the key of a photograph, and its features of an earlier run if there are any.
    pub(super) fn extracted(&self, photograph: &Photograph, options: &SfmJobOptions) -> (u64, Option<Extracted>) {
        // A file that cannot be read is reported when it is decoded.
        let bytes = cv_io::read_bytes(&photograph.path).unwrap_or_default();
        let key = key(&[&bytes, format!("{:?}", options.features).as_bytes()]);
        let kind = options.features.extractor().kind();
        let found = self.read(&features_file(key), key, |record| record.extracted(kind));
        if found.is_some() {
            self.reused.set((self.reused.get().0 + 1, false));
        }
        (key, found)
    }

    pub(super) fn store_extracted(&self, key: u64, extracted: &Extracted) {
        self.write(&features_file(key), key, || Record::of_extracted(extracted));
    }

    /// Adds a photograph to the key of the pairs.
    pub(super) fn add(&self, key: u64) {
        self.keys.borrow_mut().push(key);
    }

    /// Returns the pairs of all added photographs, from an earlier run or by `find`.
    pub(super) fn pairs(
        &self,
        photos: &[SfmPhoto],
        cameras: &[SfmCamera],
        options: &SfmJobOptions,
        find: impl FnOnce() -> Result<Pairs, Cancelled>,
    ) -> Result<Pairs, Cancelled> {
        let keys: Vec<u8> = self.keys.borrow().iter().flat_map(|key| key.to_le_bytes()).collect();
        let of: Vec<usize> = photos.iter().map(|photo| photo.camera).collect();
        // The pairs do not depend on the options of the solver.
        let options = SfmJobOptions { solve: SfmJobOptions::default().solve, ..options.clone() };
        let key = key(&[&keys, format!("{of:?} {cameras:?} {options:?}").as_bytes()]);
        let sizes: Vec<usize> = photos.iter().map(|photo| photo.keypoints.len()).collect();
        if let Some(found) = self.read("pairs", key, |record| record.pairs(&sizes)) {
            self.reused.set((self.reused.get().0, true));
            return Ok(found);
        }
        let found = find()?;
        self.write("pairs", key, || Record::of_pairs(&found));
        Ok(found)
    }

    fn read<T>(&self, file: &str, key: u64, parse: impl FnOnce(&mut Record) -> Option<T>) -> Option<T> {
        let path = self.folder.join(file);
        if !self.resume || !path.exists() {
            return None;
        }
        let found = cv_io::read_bytes(&path).ok().and_then(|bytes| {
            let mut record = Record::open(bytes, key)?;
            parse(&mut record).filter(|_| record.is_at_end())
        });
        if found.is_none() {
            self.context
                .note(format!("{} is corrupt, or of other photographs or options: it is recomputed", path.display()));
        }
        found
    }

    fn write(&self, file: &str, key: u64, record: impl FnOnce() -> Record) {
        if self.broken.get() {
            return;
        }
        let path = self.folder.join(file);
        let put = |_: &Path| -> Result<(), IoError> { cv_io::write_bytes(&path, &record().seal(key)) };
        if let Err(failure) = self.context.write(Output::Folder(&self.folder), put) {
            self.broken.set(true);
            self.context.note(format!("no checkpoint can be written for --resume: {}", failure.text()));
        }
    }

    /// Returns the number of photographs whose features are reused, and whether the pairs are.
    pub(super) fn reused(&self) -> (usize, bool) {
        self.reused.get()
    }

    /// Ends the run: removes the checkpoint, unless the run was stopped or `keep` is set.
    pub(super) fn end(&self, keep: bool, done: bool) {
        if !done && self.context.is_stopped() {
            if self.folder.exists() {
                self.context.note("--resume continues from here");
            }
            return;
        }
        // A failed run keeps the checkpoint of an earlier run, and leaves none of its own.
        if !keep && (done || !self.found) && self.folder.exists() {
            // A folder that cannot be removed does no harm.
            let _ = fs::remove_dir_all(&self.folder);
        }
        if !done {
            // Remove the empty folders that it created.
            self.missing.iter().for_each(|folder| drop(fs::remove_dir(folder)));
        }
    }
}

fn features_file(key: u64) -> String {
    format!("{key:016x}.features")
}

/// Hashes inputs together with the program's version. Another build may hash differently and then ignores the checkpoint.
fn key(parts: &[&[u8]]) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(env!("CARGO_PKG_VERSION").as_bytes());
    for part in parts {
        hasher.write_usize(part.len());
        hasher.write(part);
    }
    hasher.finish()
}
