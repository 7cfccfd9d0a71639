//! Times calls, for the benchmarks of all crates, which take it in by its path. (A benchmark library would be a tenth of
//! all packages that the workspace needs.)

use std::hint::black_box;
use std::time::{Duration, Instant};

/// Samples of a benchmark.
const SAMPLES: usize = 15;
/// A sample is at least so long: clocks and interrupts are then below 1 % of it.
const LEAST: Duration = Duration::from_millis(5);

/// Whether `cargo bench` has started this program; `cargo test --all-targets` only asks whether it builds and starts.
pub(crate) fn asked() -> bool {
    std::env::args().any(|argument| argument == "--bench")
}

/// Prints the fastest and the median time of a call, warm, and returns the median in seconds.
pub(crate) fn time<R>(name: &str, mut call: impl FnMut() -> R) -> f64 {
    let mut sample = |calls: u32| {
        let start = Instant::now();
        (0..calls).for_each(|_| {
            black_box(call());
        });
        start.elapsed()
    };
    let mut calls = 1;
    while sample(calls) < LEAST {
        calls *= 2;
    }
    let mut seconds = [0.0; SAMPLES];
    seconds.fill_with(|| sample(calls).as_secs_f64() / f64::from(calls));
    seconds.sort_by(f64::total_cmp);
    let median = seconds[SAMPLES / 2];
    println!("{name:48} {:>10}, median {:>10}", shown(seconds[0]), shown(median));
    median
}

fn shown(seconds: f64) -> String {
    match seconds {
        s if s < 1e-6 => format!("{:.1} ns", 1e9 * s),
        s if s < 1e-3 => format!("{:.2} us", 1e6 * s),
        s => format!("{:.3} ms", 1e3 * s),
    }
}
