//! Runs jobs with the GIL released: other Python threads continue, Ctrl-C cancels the job, and a callable gets its progress.

use crate::errors::{Refused, internal};
use crate::options::Options;
use cv_core::{Cancelled, Progress};
use pyo3::exceptions::PyTypeError;
use pyo3::prelude::*;
use rayon::ThreadPool;
use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// Interval at which signals are checked and the callable is called: a small part of the 200 ms for cancellation, most of which jobs need.
const POLL_INTERVAL: Duration = Duration::from_millis(25);

/// The options of all jobs.
#[derive(Default)]
pub(crate) struct Run {
    /// Number of threads; `None`: one per processor.
    threads: Option<usize>,
    /// Called with the stage's name, the units done and their total.
    progress: Option<Py<PyAny>>,
}

impl Run {
    /// Reads `threads` and `progress`.
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let threads: Option<usize> = options.take("threads")?;
        if threads == Some(0) || threads.is_some_and(|n| n > MAX_THREADS) {
            return Err(pyo3::exceptions::PyValueError::new_err(format!("threads must be from 1 to {MAX_THREADS}")));
        }
        let progress = options.take_any("progress")?;
        if let Some(given) = progress.as_ref().filter(|given| !given.is_callable()) {
            let kind = given.get_type();
            return Err(PyTypeError::new_err(format!("progress must be callable, not {}", kind.name()?)));
        }
        Ok(Self { threads, progress: progress.map(Bound::unbind) })
    }

    /// Runs a job on its own thread pool, with the GIL released.
    ///
    /// # Errors
    /// Errors of the job as exceptions of `epipole.errors`; `KeyboardInterrupt` and other exceptions of the callable or a signal handler; a panic as
    /// `InternalError`.
    pub(crate) fn run<R: Send, E: Refused>(
        &self,
        py: Python<'_>,
        job: impl FnOnce(&dyn Progress) -> Result<R, E> + Send,
    ) -> PyResult<R> {
        let (mut job, mut result) = (Some(job), None);
        // `supervise` is not generic, so that it is compiled once, not for each job.
        let latest = self.supervise(py, &mut |progress| {
            if let Some(job) = job.take() {
                result = Some(job(progress));
            }
        })?;
        match result {
            Some(Ok(result)) => {
                // A short job may end before the first poll.
                if let (Some(progress), Some((stage, done, total))) = (&self.progress, latest) {
                    progress.call1(py, (stage, done, total))?;
                }
                Ok(result)
            }
            Some(Err(error)) => Err(error.exception(py)),
            None => Err(internal("the job ended without a result")),
        }
    }

    /// As [`Run::run`], for a job that stores its result itself and is called once; returns its last progress report.
    fn supervise(&self, py: Python<'_>, job: &mut (dyn FnMut(&dyn Progress) + Send)) -> PyResult<Option<Report>> {
        let monitor = Monitor::default();
        let progress = self.progress.as_ref();
        let ended = py.detach(|| {
            let pool = Pool::take(self.threads)?;
            let (done, wait) = channel();
            let ended = pool.threads.in_place_scope(|scope| {
                scope.spawn(|_| {
                    let ended = catch_unwind(AssertUnwindSafe(|| job(&monitor)));
                    // The receiver outlives the scope.
                    let _ = done.send(ended);
                });
                let mut raised = None;
                loop {
                    match wait.recv_timeout(POLL_INTERVAL) {
                        Ok(ended) => return Ok((ended, raised)),
                        Err(RecvTimeoutError::Timeout) if raised.is_none() => {
                            raised = Python::attach(|py| monitor.poll(py, progress)).err();
                        }
                        Err(RecvTimeoutError::Timeout) => {}
                        Err(RecvTimeoutError::Disconnected) => {
                            return Err(internal("the job ended without a result"));
                        }
                    }
                }
            });
            pool.give_back();
            ended
        });
        match ended? {
            // A job that was cancelled may have ended otherwise.
            (_, Some(raised)) => Err(raised),
            (Ok(()), None) => Ok(monitor.latest()),
            (Err(panic), None) => Err(internal(panic_message(&*panic))),
        }
    }
}

/// Returns the message of a panic.
fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("a panic without a message")
}

/// Stage, units done, total units.
type Report = (&'static str, usize, usize);

/// Receives the reports of a job and cancels it on request.
#[derive(Default)]
struct Monitor {
    stopped: AtomicBool,
    latest: Mutex<Option<Report>>,
}

impl Monitor {
    fn latest(&self) -> Option<Report> {
        *self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Handles signals and calls the callable; an exception of either cancels the job.
    fn poll(&self, py: Python<'_>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
        let polled = py.check_signals().and_then(|()| match (progress, self.latest()) {
            (Some(progress), Some((stage, done, total))) => progress.call1(py, (stage, done, total)).map(drop),
            _ => Ok(()),
        });
        self.stopped.fetch_or(polled.is_err(), Ordering::Relaxed);
        polled
    }
}

impl Progress for Monitor {
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
        if self.stopped.load(Ordering::Relaxed) {
            return Err(Cancelled);
        }
        // If another thread is writing, its report is as recent.
        if let Ok(mut latest) = self.latest.try_lock() {
            *latest = Some((stage, done, total));
        }
        Ok(())
    }
}

/// A value used by one thread at a time. Unlike with a mutex, waiting for it can be cancelled.
pub(crate) struct Shared<T> {
    free: Mutex<Option<T>>,
    freed: Condvar,
}

impl<T> Shared<T> {
    pub(crate) fn new(value: T) -> Self {
        Self { free: Mutex::new(Some(value)), freed: Condvar::new() }
    }

    /// Takes the value when it is free; it is returned on drop, also after a panic.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub(crate) fn take(&self, progress: &dyn Progress) -> Result<Taken<'_, T>, Cancelled> {
        let mut free = self.free.lock().unwrap_or_else(PoisonError::into_inner);
        loop {
            if let Some(value) = free.take() {
                return Ok(Taken { value: Some(value), of: self });
            }
            progress.report("wait", 0, 0)?;
            free = self.freed.wait_timeout(free, POLL_INTERVAL).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// The value taken from [`Shared`].
pub(crate) struct Taken<'a, T> {
    value: Option<T>,
    of: &'a Shared<T>,
}

impl<T> Taken<'_, T> {
    /// Borrows the value.
    pub(crate) fn get(&mut self) -> Option<&mut T> {
        self.value.as_mut()
    }
}

impl<T> Drop for Taken<'_, T> {
    fn drop(&mut self) {
        *self.of.free.lock().unwrap_or_else(PoisonError::into_inner) = self.value.take();
        self.of.freed.notify_one();
    }
}

/// Upper limit of `threads`, against mistakes.
const MAX_THREADS: usize = 1024;

/// A thread pool, used by one job at a time, with the process that made it: its threads do not survive a `fork`.
struct Pool {
    process: u32,
    threads: ThreadPool,
}

/// Pools that are not in use.
static IDLE: Mutex<Vec<Pool>> = Mutex::new(Vec::new());

impl Pool {
    /// Takes an idle pool of this process with that number of threads, or makes one.
    fn take(threads: Option<usize>) -> PyResult<Self> {
        let process = std::process::id();
        let wanted = threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
        // If the lock was held during a `fork`, it stays locked: a new pool is made then.
        if let Ok(mut idle) = IDLE.try_lock() {
            if let Some(at) =
                idle.iter().position(|p| p.process == process && p.threads.current_num_threads() == wanted)
            {
                return Ok(idle.swap_remove(at));
            }
            // Threads of the parent process do not exist here: dropping their pools would wait forever.
            let (ours, others) = std::mem::take(&mut *idle).into_iter().partition(|p| p.process == process);
            *idle = ours;
            let others: Vec<Self> = others;
            others.into_iter().for_each(std::mem::forget);
        }
        let made = rayon::ThreadPoolBuilder::new().num_threads(wanted).thread_name(|i| format!("epipole {i}")).build();
        let pool = made.map_err(|error| internal(&format!("cannot start threads: {error}")))?;
        Ok(Self { process, threads: pool })
    }

    /// Keeps the pool for the next job; concurrent Python threads use one each.
    fn give_back(self) {
        if let Ok(mut idle) = IDLE.try_lock()
            && idle.len() < MAX_IDLE
        {
            idle.push(self);
        }
    }
}

/// Maximum number of idle pools.
const MAX_IDLE: usize = 16;
