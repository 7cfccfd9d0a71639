//! What all commands share: global arguments, failures and exit codes, progress, outputs, and the JSON object.

use clap::{Args, value_parser};
use cv_io::IoError;
use cv_pipeline::{Cancelled, Progress};
use indicatif::{ProgressBar, ProgressStyle};
use serde::Serialize;
use serde_json::{Map, Value, json};
use std::{
    cmp::Ordering,
    fmt::Display,
    fs,
    io::{self, IsTerminal, Write},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    process::ExitCode,
    sync::Mutex,
    time::{Duration, Instant, SystemTime},
};

/// Arguments that every command takes.
#[derive(Debug, Clone, Args)]
#[command(next_help_heading = "Everywhere")]
pub(crate) struct Globals {
    /// Print one JSON object on stdout, and nothing else there.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    /// No progress bar, no summary; errors and warnings only.
    #[arg(short, long, global = true)]
    pub(crate) quiet: bool,
    /// Threads to use [default: one per core]. The result is the same for any number.
    #[arg(long, global = true, value_name = "N", value_parser = value_parser!(u16).range(1..=1024))]
    pub(crate) threads: Option<u16>,
    /// Seed of random choices [default: that of the pipeline]. The same seed gives the same result.
    #[arg(long, global = true, value_name = "S")]
    pub(crate) seed: Option<u64>,
    /// Write DIR/report.html, one file with the pictures and figures of this run inside.
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) report: Option<PathBuf>,
}

/// A subcommand.
pub(crate) trait Run: Args {
    /// The files this run will write. The frame checks them before the work starts.
    fn outputs(&self) -> Vec<&Path> {
        Vec::new()
    }

    /// Does the job.
    fn run(self, context: &Context) -> Result<Outcome, Failure>;
}

/// What a command achieved: the JSON object, the stage times, and a summary for people.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    stages: Vec<(&'static str, f64)>,
    values: Map<String, Value>,
    unserializable: Option<String>,
    summary: String,
    stdout: Vec<u8>,
    but: Option<Failure>,
}

impl Outcome {
    /// An outcome with the seconds of its stages.
    pub(crate) fn new(stages: Vec<(&'static str, f64)>) -> Self {
        Self { stages, ..Self::default() }
    }

    /// Adds a key of the JSON object. NaN becomes `null`.
    pub(crate) fn with(mut self, key: &str, value: impl Serialize) -> Self {
        match serde_json::to_value(value) {
            Ok(value) => {
                self.values.insert(key.to_owned(), value);
            }
            Err(error) => self.unserializable = Some(format!("{key}: {error}")),
        }
        self
    }

    /// The lines that a person sees on stderr when the job is done.
    pub(crate) fn summary(mut self, text: impl Into<String>) -> Self {
        self.summary = text.into();
        self
    }

    /// Text that is the very result of the command: printed on stdout, or a key of the object under `--json`.
    pub(crate) fn text(mut self, key: &str, text: Vec<u8>) -> Self {
        self = self.with(key, String::from_utf8_lossy(&text));
        self.stdout = text;
        self
    }

    /// The result is there and is printed, yet it is not what it should be: exit code 1 with this reason.
    pub(crate) fn but(mut self, failure: Failure) -> Self {
        self.but = Some(failure);
        self
    }

    fn into_json(mut self, total: f64) -> Value {
        let mut seconds: Map<String, Value> =
            self.stages.iter().map(|(stage, seconds)| ((*stage).to_owned(), json!(seconds))).collect();
        seconds.insert("total".to_owned(), json!(total));
        self.values.insert("seconds".to_owned(), Value::Object(seconds));
        self.values.insert("threads".to_owned(), json!(rayon::current_num_threads()));
        self.values.insert("version".to_owned(), json!(env!("CARGO_PKG_VERSION")));
        Value::Object(self.values)
    }
}

/// Why a command ends without its result.
#[derive(Debug)]
pub(crate) struct Failure {
    what: String,
    advice: Option<String>,
    usage: bool,
}

impl Failure {
    /// The job could not be done: exit code 1.
    pub(crate) fn new(what: impl Display) -> Self {
        Self { what: what.to_string(), advice: None, usage: false }
    }

    /// The arguments make no sense together: exit code 2.
    pub(crate) fn usage(what: impl Display) -> Self {
        Self { usage: true, ..Self::new(what) }
    }

    /// What the person can do about it.
    pub(crate) fn advice(mut self, advice: impl Display) -> Self {
        self.advice = Some(advice.to_string());
        self
    }

    /// The lines on stderr.
    fn text(&self) -> String {
        match &self.advice {
            Some(advice) => format!("error: {}; try: {advice}", self.what),
            None => format!("error: {}", self.what),
        }
    }
}

/// Every error becomes a failure, its causes joined by colons where the error does not already name them. The hint of
/// a file error becomes the advice.
impl<E: std::error::Error + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        let error: &(dyn std::error::Error + 'static) = &error;
        if let Some(IoError { path, writing, reason }) = error.downcast_ref() {
            let verb = if *writing { "write" } else { "read" };
            let failure = Self::new(format!("cannot {verb} {}: {reason}", path.display()));
            return Self { advice: reason.hint().map(str::to_owned), ..failure };
        }
        let mut what = error.to_string();
        let mut source = error.source();
        while let Some(cause) = source {
            let text = cause.to_string();
            if !what.contains(&text) {
                what = format!("{what}: {text}");
            }
            source = cause.source();
        }
        Self::new(what)
    }
}

/// Puts words around errors.
pub(crate) trait Explain<T> {
    /// `words: error`.
    fn during(self, words: impl Display) -> Result<T, Failure>;
    /// `error; try: advice`.
    fn advice(self, advice: impl Display) -> Result<T, Failure>;
}

impl<T, E: Into<Failure>> Explain<T> for Result<T, E> {
    fn during(self, words: impl Display) -> Result<T, Failure> {
        self.map_err(|error| {
            let failure: Failure = error.into();
            Failure { what: format!("{words}: {}", failure.what), ..failure }
        })
    }

    fn advice(self, advice: impl Display) -> Result<T, Failure> {
        self.map_err(|error| error.into().advice(advice))
    }
}

/// What a running command knows about how it was called. It is also the [`Progress`] that pipelines report to.
pub(crate) struct Context {
    /// `--seed`, where given.
    pub(crate) seed: Option<u64>,
    quiet: bool,
    report: Option<PathBuf>,
    bar: Bar,
}

impl Context {
    /// A message for people, on stderr; silent under `--quiet`.
    pub(crate) fn note(&self, text: impl Display) {
        if !self.quiet {
            self.bar.print(&text.to_string());
        }
    }

    /// Something the person should know about even under `--quiet`.
    pub(crate) fn warn(&self, text: impl Display) {
        self.bar.print(&format!("warning: {text}"));
    }

    /// Under `--report DIR`, writes `DIR/report.html`.
    pub(crate) fn report(&self, html: impl FnOnce() -> Result<String, Failure>) -> Result<(), Failure> {
        let Some(folder) = &self.report else { return Ok(()) };
        let html = html()?;
        create_dir(folder)?;
        let path = folder.join("report.html");
        cv_io::write_bytes(&path, html.as_bytes())?;
        self.note(format!("report: {}", path.display()));
        Ok(())
    }

    /// Whether `--report` was given: pictures for it are worth drawing.
    pub(crate) fn wants_report(&self) -> bool {
        self.report.is_some()
    }
}

impl Progress for Context {
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
        self.bar.show(stage, done, total);
        Ok(())
    }
}

/// A bar on stderr, hidden where stderr is not a terminal or nobody wants to see it.
struct Bar {
    bar: Option<ProgressBar>,
    stage: Mutex<&'static str>,
}

impl Bar {
    fn new(quiet: bool) -> Self {
        let bar = (!quiet && io::stderr().is_terminal()).then(|| {
            let bar = ProgressBar::new(0);
            // The template is a constant; were it wrong, indicatif's own style would do.
            if let Ok(style) = ProgressStyle::with_template("{msg:14} {bar:30} {pos}/{len} {elapsed}") {
                bar.set_style(style);
            }
            bar.enable_steady_tick(Duration::from_millis(120));
            bar
        });
        Self { bar, stage: Mutex::new("") }
    }

    fn show(&self, stage: &'static str, done: usize, total: usize) {
        let Some(bar) = &self.bar else { return };
        if let Ok(mut last) = self.stage.lock()
            && *last != stage
        {
            *last = stage;
            bar.set_message(stage);
        }
        bar.set_length(total as u64);
        bar.set_position(done as u64);
    }

    fn print(&self, text: &str) {
        let print = || {
            // Where stderr is closed there is nobody left to tell.
            let _ = writeln!(io::stderr(), "{text}");
        };
        match &self.bar {
            Some(bar) => bar.suspend(print),
            None => print(),
        }
    }

    fn clear(&self) {
        if let Some(bar) = &self.bar {
            bar.finish_and_clear();
        }
    }
}

/// Runs a command under the global arguments and turns what comes of it into output and exit code.
pub(crate) fn run(globals: &Globals, command: impl FnOnce(&Context) -> Result<Outcome, Failure>) -> ExitCode {
    let start = Instant::now();
    let context = Context {
        seed: globals.seed,
        quiet: globals.quiet,
        report: globals.report.clone(),
        bar: Bar::new(globals.quiet),
    };
    let result = start_threads(globals.threads).and_then(|()| {
        // A bug in the program is reported like any failure: the person sees what to do, scripts see exit code 1.
        catch_unwind(AssertUnwindSafe(|| command(&context))).unwrap_or_else(|_| {
            Err(Failure::new("the program stopped at a bug of its own (see above)")
                .advice("report it with the command line and, where you can, the input files"))
        })
    });
    context.bar.clear();
    let failure = match result {
        Ok(mut outcome) => {
            let but = outcome.but.take();
            match finish(outcome, globals, start).err().or(but) {
                None => return ExitCode::SUCCESS,
                Some(failure) => failure,
            }
        }
        Err(failure) => failure,
    };
    context.bar.print(&failure.text());
    ExitCode::from(if failure.usage { 2 } else { 1 })
}

fn start_threads(threads: Option<u16>) -> Result<(), Failure> {
    let mut pool = rayon::ThreadPoolBuilder::new();
    if let Some(threads) = threads {
        pool = pool.num_threads(threads.into());
    }
    pool.build_global().during("cannot start the threads")
}

/// Prints what the person asked to see.
fn finish(mut outcome: Outcome, globals: &Globals, start: Instant) -> Result<(), Failure> {
    if let Some(key) = outcome.unserializable.take() {
        return Err(Failure::new(format!("cannot write the JSON value {key}")));
    }
    if globals.json {
        let object = outcome.into_json(start.elapsed().as_secs_f64());
        writeln!(io::stdout(), "{object}").during("cannot write to stdout")?;
        return Ok(());
    }
    io::stdout().write_all(&outcome.stdout).during("cannot write to stdout")?;
    if !globals.quiet && !outcome.summary.is_empty() {
        let _ = writeln!(io::stderr(), "{}", outcome.summary.trim_end());
    }
    Ok(())
}

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

/// The image files among the arguments: a file stands for itself, a folder for the images in it, by name
/// (`img2` before `img10`).
pub(crate) fn expand_images(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    const ENDINGS: [&str; 16] = [
        "png", "jpg", "jpeg", "jpe", "tif", "tiff", "bmp", "pnm", "ppm", "pgm", "pbm", "pam", "exr", "hdr", "pic",
        "jfif",
    ];
    let mut images = Vec::new();
    for path in paths {
        if !path.is_dir() {
            images.push(path.clone());
            continue;
        }
        let mut found = Vec::new();
        for entry in fs::read_dir(path).during(format!("cannot list {}", path.display()))? {
            let file = entry.during(format!("cannot list {}", path.display()))?.path();
            let ending = file.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            let hidden = file.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
            if ENDINGS.contains(&ending.as_str()) && !hidden && file.is_file() {
                found.push(file);
            }
        }
        if found.is_empty() {
            return Err(Failure::new(format!("there are no images in {}", path.display()))
                .advice(format!("a folder with files that end in {}", ENDINGS[..3].join(", "))));
        }
        found.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
        images.append(&mut found);
    }
    Ok(images)
}

/// Compares names with their runs of digits as numbers.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut rest_a, mut rest_b) = (a, b);
    loop {
        let (Some(first_a), Some(first_b)) = (rest_a.chars().next(), rest_b.chars().next()) else {
            // One is a prefix of the other, or they differ in leading zeros only.
            return rest_a.len().cmp(&rest_b.len()).then_with(|| a.cmp(b));
        };
        let order = if first_a.is_ascii_digit() && first_b.is_ascii_digit() {
            let (number_a, number_b);
            (number_a, rest_a) = split_digits(rest_a);
            (number_b, rest_b) = split_digits(rest_b);
            number_a.len().cmp(&number_b.len()).then_with(|| number_a.cmp(number_b))
        } else {
            rest_a = &rest_a[first_a.len_utf8()..];
            rest_b = &rest_b[first_b.len_utf8()..];
            first_a.cmp(&first_b)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

/// The digits at the start, without leading zeros, and what follows.
fn split_digits(text: &str) -> (&str, &str) {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    (text[..end].trim_start_matches('0'), &text[end..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_as_people_number_them() {
        let mut names = ["img10.png", "img2.png", "img1.png", "img02.png", "a.png", "img2b.png", "img.png"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["a.png", "img.png", "img1.png", "img02.png", "img2.png", "img2b.png", "img10.png"]);
    }

    #[test]
    fn the_causes_of_an_error_are_told_once() {
        #[derive(Debug, thiserror::Error)]
        #[error("outer")]
        struct Outer(#[source] io::Error);
        let failure: Failure = Outer(io::Error::other("inner")).into();
        assert_eq!(failure.advice("nothing").text(), "error: outer: inner; try: nothing");
    }

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
    fn the_hint_of_a_file_error_is_the_advice() {
        let failure: Failure = cv_io::read_rgb("no/such/picture.png").unwrap_err().into();
        let text = failure.text();
        assert!(
            text.starts_with("error: cannot read no/such/picture.png: ") && text.contains("; try: check"),
            "{text}"
        );
    }

    #[test]
    fn outputs_that_cannot_be_written_are_told_before_the_work() {
        let folder = tempfile::tempdir().unwrap();
        let (file, missing) = (folder.path().join("a.png"), folder.path().join("no/a.png"));
        check_outputs(&[&file]).unwrap();
        assert!(check_outputs(&[&file, &file]).unwrap_err().usage);
        let failure = check_outputs(&[&missing]).unwrap_err();
        assert!(!failure.usage && failure.text().contains("try: mkdir -p "), "{}", failure.text());
        assert!(check_outputs(&[folder.path()]).unwrap_err().text().contains("is a folder"));
    }
}
