//! Bodies of the fuzz targets; `fuzz_targets/` has one file for each with its entry point.
//!
//! A target fails by a panic, by more than 10 s or 2 GiB, or by a violated invariant: a round trip changes the data, or a count is
//! inconsistent.

#[cfg(feature = "pipelines")]
pub mod boards;
#[cfg(feature = "pipelines")]
pub mod checkpoint;
#[cfg(feature = "pipelines")]
pub mod data;
pub mod parsers;
#[cfg(feature = "pipelines")]
pub mod pipelines;
#[cfg(feature = "pipelines")]
mod structured;

use libfuzzer_sys::Corpus;

/// Initializes a target before its first input. All work runs on this thread, so that coverage is counted per input and failures are reproducible.
pub fn start() {
    // An error means that the pool exists already.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global();
    // libFuzzer's own hook ends the process at every panic, also at those of third-party decoders that `cv_io::decode_image` catches and
    // returns as errors. An uncaught panic still ends the process.
    std::panic::set_hook(Box::new(|info| {
        if std::env::var_os("CV_FUZZ_SHOW_PANICS").is_some() {
            eprintln!("{info}");
        }
    }));
}

/// Rejects inputs of another format from the corpus.
fn keep_if(keep: bool) -> Corpus {
    if keep { Corpus::Keep } else { Corpus::Reject }
}
