//! What the fuzz targets do with their input; `fuzz_targets/` only names them, one file each.
//!
//! A target fails by a panic, by more than 10 s or 2 GiB, or by an answer that cannot be: what has been written is read back as
//! something else, a count is off.

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

/// Before the first input. Work stays on this thread: coverage is counted per input, and finds repeat.
pub fn start() {
    // Fails where it has been done before, which does no harm.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(1).use_current_thread().build_global();
    // libFuzzer's own hook ends the process at every panic, also at those that `cv_io::decode_image` makes an error of: decoders are other
    // people's code. A panic that nobody catches still ends it.
    std::panic::set_hook(Box::new(|info| {
        if std::env::var_os("CV_FUZZ_SHOW_PANICS").is_some() {
            eprintln!("{info}");
        }
    }));
}

/// Inputs of another format are not worth a place in the corpus.
fn only_if(kept: bool) -> Corpus {
    if kept { Corpus::Keep } else { Corpus::Reject }
}
