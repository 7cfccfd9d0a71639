//! The work of a run that may be stopped: features as each photograph has them, then the pairs, in a folder beside the result until that is whole.
//!
//! What is there is told by what it was made of, bytes and options, and not by when or from where: a checkpoint of anything else is not taken.

mod record;

use super::photographs::Photograph;
use crate::frame::{Context, Output};
use cv_core::Cancelled;
use cv_io::IoError;
use cv_pipeline::{SfmCamera, SfmJobOptions, SfmPhoto};
use record::Record;
pub(super) use record::{Pairs, Seen};
use std::cell::{Cell, RefCell};
use std::fs;
use std::hash::{DefaultHasher, Hasher};
use std::path::{Path, PathBuf};

/// The folder, within that of the result.
const FOLDER: &str = ".cv-sfm";

/// The work of a run so far.
pub(super) struct Checkpoint<'a> {
    folder: PathBuf,
    /// Whether an earlier run's work is taken.
    resume: bool,
    /// Whether there is any.
    found: bool,
    /// Folders that were not there before this run, the innermost first.
    missing: Vec<PathBuf>,
    context: &'a Context,
    /// Whether writing failed: the disk is full, say. The run goes on without.
    broken: Cell<bool>,
    /// Of each photograph whose features are known.
    keys: RefCell<Vec<u64>>,
    /// How many photographs' features, and whether pairs, are of an earlier run.
    taken: Cell<(usize, bool)>,
}

impl<'a> Checkpoint<'a> {
    pub(super) fn new(output: &Path, resume: bool, context: &'a Context) -> Self {
        let folder = output.join(FOLDER);
        let missing = output.ancestors().take_while(|above| !above.exists()).map(Path::to_owned).collect();
        cv_io::remove_abandoned(&folder);
        let found = folder.exists();
        match (found, resume) {
            (true, false) => context.note(format!(
                "{} holds the work of a run that was stopped, which --resume goes on with",
                folder.display()
            )),
            (false, true) => context.note(format!("{} is not there: from the start", folder.display())),
            _ => {}
        }
        let (broken, keys, taken) = (Cell::new(false), RefCell::default(), Cell::new((0, false)));
        Self { folder, resume, found, missing, context, broken, keys, taken }
    }

    /// What an earlier run has seen in a photograph, and the key under which this run puts it where there is nothing.
    pub(super) fn seen(&self, photograph: &Photograph, options: &SfmJobOptions) -> (u64, Option<Seen>) {
        // What cannot be read is told of where it is decoded.
        let bytes = cv_io::read_bytes(&photograph.path).unwrap_or_default();
        let key = key(&[&bytes, format!("{:?}", options.features).as_bytes()]);
        let kind = options.features.extractor().kind();
        let found = self.read(&features_file(key), key, |record| record.seen(kind));
        if found.is_some() {
            self.taken.set((self.taken.get().0 + 1, false));
        }
        (key, found)
    }

    pub(super) fn keep_seen(&self, key: u64, seen: &Seen) {
        self.write(&features_file(key), key, || Record::of_seen(seen));
    }

    /// The photograph counts.
    pub(super) fn add(&self, key: u64) {
        self.keys.borrow_mut().push(key);
    }

    /// The pairs of all photographs that count, by an earlier run or by `find`.
    pub(super) fn pairs(
        &self,
        photos: &[SfmPhoto],
        cameras: &[SfmCamera],
        options: &SfmJobOptions,
        find: impl FnOnce() -> Result<Pairs, Cancelled>,
    ) -> Result<Pairs, Cancelled> {
        let keys: Vec<u8> = self.keys.borrow().iter().flat_map(|key| key.to_le_bytes()).collect();
        let of: Vec<usize> = photos.iter().map(|photo| photo.camera).collect();
        // The solution's own options have no part in the pairs.
        let options = SfmJobOptions { solve: SfmJobOptions::default().solve, ..options.clone() };
        let key = key(&[&keys, format!("{of:?} {cameras:?} {options:?}").as_bytes()]);
        let sizes: Vec<usize> = photos.iter().map(|photo| photo.keypoints.len()).collect();
        if let Some(found) = self.read("pairs", key, |record| record.pairs(&sizes)) {
            self.taken.set((self.taken.get().0, true));
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
                .note(format!("{} is damaged or of other photographs or options: it is made anew", path.display()));
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
            self.context.note(format!("the work cannot be kept for --resume: {}", failure.text()));
        }
    }

    /// How many photographs' features, and whether the pairs, are of an earlier run.
    pub(super) fn taken(&self) -> (usize, bool) {
        self.taken.get()
    }

    /// The result is whole, or there is none.
    pub(super) fn end(&self, keep: bool, done: bool) {
        if !done && self.context.is_stopped() {
            if self.folder.exists() {
                self.context.note("--resume goes on from here");
            }
            return;
        }
        // A job that fails leaves an earlier one's work as it was, and none of its own.
        if !keep && (done || !self.found) && self.folder.exists() {
            // What cannot be removed is in nobody's way.
            let _ = fs::remove_dir_all(&self.folder);
        }
        if !done {
            // Nor folders that are empty.
            self.missing.iter().for_each(|folder| drop(fs::remove_dir(folder)));
        }
    }
}

fn features_file(key: u64) -> String {
    format!("{key:016x}.features")
}

/// A number for what something is made of, by this build of the program: another one may have another, and does not take what it finds.
fn key(parts: &[&[u8]]) -> u64 {
    let mut hasher = DefaultHasher::new();
    hasher.write(env!("CARGO_PKG_VERSION").as_bytes());
    for part in parts {
        hasher.write_usize(part.len());
        hasher.write(part);
    }
    hasher.finish()
}
