//! Ctrl-C, and being told to terminate: the command gives up, nothing is left behind.

use super::progress::Bar;
use cv_pipeline::Cancelled;
use std::{
    process::ExitCode,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
};

/// As shells have it for a program that Ctrl-C ended: 128 and the number of the signal.
const EXIT_CODE: u8 = 130;

/// Whether the person asked the program to stop.
#[derive(Clone)]
pub(super) struct Stop {
    asked: Arc<AtomicBool>,
    /// Whether it is decided how the program ends: by its result or as stopped.
    decided: Arc<AtomicBool>,
    bar: Arc<Bar>,
}

impl Stop {
    /// Listens from now on. The first signal asks the command to stop; where that takes long (a picture of a hundred megapixels is
    /// being encoded, say), and at the second signal, the program ends all the same.
    pub(super) fn listen(bar: &Arc<Bar>) -> Self {
        let stop = Self { asked: Arc::default(), decided: Arc::default(), bar: bar.clone() };
        #[cfg(unix)]
        stop.listen_to_signals();
        stop
    }

    /// Where signals cannot be listened to, they end the program as if this were not here.
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
        /// Time that a command has to give up by itself. Memory of gigabytes takes some more to be given back.
        const GRACE: Duration = Duration::from_millis(100);
        let Ok(mut signals) = Signals::new([SIGINT, SIGTERM]) else { return };
        let stop = self.clone();
        thread::spawn(move || {
            if signals.forever().next().is_none() {
                return;
            }
            stop.asked.store(true, Ordering::Relaxed);
            let mut wait = || {
                let end = Instant::now() + GRACE;
                while Instant::now() < end && signals.pending().next().is_none() {
                    thread::sleep(Duration::from_millis(5));
                }
            };
            wait();
            cv_io::abandon_writes();
            if !stop.tell() {
                // The result is being printed, maybe into a pipe that nobody reads.
                wait();
            }
            std::process::exit(EXIT_CODE.into());
        });
    }

    /// Whether the command is to go on.
    pub(super) fn check(&self) -> Result<(), Cancelled> {
        if self.asked.load(Ordering::Relaxed) { Err(Cancelled) } else { Ok(()) }
    }

    /// Decides that the program ends by its result, which is printed next. False where it has ended as stopped already.
    pub(super) fn finish(&self) -> bool {
        !self.decided.swap(true, Ordering::Relaxed)
    }

    /// Decides that the program ends as stopped, and says so. False where it was decided before.
    fn tell(&self) -> bool {
        let first = self.finish();
        if first {
            self.bar.clear();
            self.bar.print("stopped");
        }
        first
    }

    /// Ends the program as stopped.
    pub(super) fn end(&self) -> ExitCode {
        self.tell();
        ExitCode::from(EXIT_CODE)
    }
}
