//! SIGINT (Ctrl-C) and SIGTERM: the command is cancelled and leaves nothing behind.

use super::progress::Bar;
use cv_pipeline::Cancelled;
use std::{
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// Exit code of a program ended by SIGINT, by shell convention: 128 plus the number of the signal.
const EXIT_CODE: u8 = 130;

/// Cancellation of the program by signals.
#[derive(Clone)]
pub(super) struct Stop {
    requested: Arc<AtomicBool>,
    /// Whether it is decided how the program ends: with its result or as stopped.
    decided: Arc<AtomicBool>,
    bar: Arc<Bar>,
}

impl Stop {
    /// Installs the signal handlers. The first signal requests cancellation; if that takes long (while a large image is encoded, for
    /// example), or at the second signal, the process exits.
    pub(super) fn listen(bar: &Arc<Bar>) -> Self {
        let stop = Self { requested: Arc::default(), decided: Arc::default(), bar: bar.clone() };
        #[cfg(unix)]
        stop.listen_to_signals();
        stop
    }

    /// If the handlers cannot be installed, signals keep their default action.
    #[cfg(unix)]
    fn listen_to_signals(&self) {
        use signal_hook::{
            consts::{SIGINT, SIGTERM},
            iterator::Signals,
        };
        use std::{
            thread,
            time::{Duration, Instant},
        };
        /// Time for a command to return by itself; freeing gigabytes of memory may take longer.
        const GRACE: Duration = Duration::from_millis(100);
        let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
        let stop = self.clone();
        thread::spawn(move || {
            if signals.forever().next().is_none() {
                return;
            }
            stop.requested.store(true, Ordering::Relaxed);
            let mut wait = || {
                let end = Instant::now() + GRACE;
                while Instant::now() < end && signals.pending().next().is_none() {
                    thread::sleep(Duration::from_millis(5));
                }
            };
            wait();
            cv_io::abandon_writes();
            if !stop.announce() {
                // The result is being printed, possibly into a blocked pipe.
                wait();
            }
            std::process::exit(EXIT_CODE.into());
        });
    }

    /// Returns `Cancelled` if cancellation was requested.
    pub(super) fn check(&self) -> Result<(), Cancelled> {
        if self.requested.load(Ordering::Relaxed) { Err(Cancelled) } else { Ok(()) }
    }

    /// Decides that the program ends with its result, which is printed next. False if it was stopped before.
    pub(super) fn finish(&self) -> bool {
        !self.decided.swap(true, Ordering::Relaxed)
    }

    /// Decides that the program ends as stopped, and prints that. False if the end was decided before.
    fn announce(&self) -> bool {
        let first = self.finish();
        if first {
            self.bar.clear();
            self.bar.print("stopped");
        }
        first
    }

    /// Ends the program as stopped.
    pub(super) fn end(&self) -> ExitCode {
        self.announce();
        ExitCode::from(EXIT_CODE)
    }
}
