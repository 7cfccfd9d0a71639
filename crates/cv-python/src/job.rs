//! Runs a job without the interpreter: other Python threads go on, Ctrl-C stops it, and a callable hears how far it is.

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

/// How often signals are looked at, and the callable is called: Ctrl-C is to work within 200 ms, of which jobs need the most to hear of it.
const TICK: Duration = Duration::from_millis(25);

/// What every job takes.
#[derive(Default)]
pub(crate) struct Run {
    /// Threads; `None`: as many as there are processors.
    threads: Option<usize>,
    /// Called with the stage's name, units done and all of them.
    progress: Option<Py<PyAny>>,
}

impl Run {
    /// `threads` and `progress`.
    pub(crate) fn read(options: &mut Options<'_>) -> PyResult<Self> {
        let threads: Option<usize> = options.take("threads")?;
        if threads == Some(0) || threads.is_some_and(|n| n > MOST_THREADS) {
            return Err(pyo3::exceptions::PyValueError::new_err(format!("threads must be from 1 to {MOST_THREADS}")));
        }
        let progress = options.take_any("progress")?;
        if let Some(given) = progress.as_ref().filter(|given| !given.is_callable()) {
            let kind = given.get_type();
            return Err(PyTypeError::new_err(format!("progress must be callable, not {}", kind.name()?)));
        }
        Ok(Self { threads, progress: progress.map(Bound::unbind) })
    }

    /// Runs a job on threads of our own, without the interpreter.
    ///
    /// # Errors
    /// What the job refuses, as the exceptions of `epipole.errors`; `KeyboardInterrupt` and whatever else the callable or a signal's handler raises; a panic as
    /// `InternalError`.
    pub(crate) fn run<R: Send, E: Refused>(
        &self,
        py: Python<'_>,
        job: impl FnOnce(&dyn Progress) -> Result<R, E> + Send,
    ) -> PyResult<R> {
        let (mut job, mut result) = (Some(job), None);
        // All that takes long to compile is compiled once, not for each job.
        let latest = self.attend(py, &mut |progress| {
            if let Some(job) = job.take() {
                result = Some(job(progress));
            }
        })?;
        match result {
            Some(Ok(result)) => {
                // A short job has no tick.
                if let (Some(progress), Some((stage, done, total))) = (&self.progress, latest) {
                    progress.call1(py, (stage, done, total))?;
                }
                Ok(result)
            }
            Some(Err(error)) => Err(error.exception(py)),
            None => Err(internal("the job ended without a result")),
        }
    }

    /// The same for a job that keeps its result itself, called once; gives its last news.
    fn attend(&self, py: Python<'_>, job: &mut (dyn FnMut(&dyn Progress) + Send)) -> PyResult<Option<News>> {
        let monitor = Monitor::default();
        let progress = self.progress.as_ref();
        let ended = py.detach(|| {
            let pool = Pool::take(self.threads)?;
            let (done, wait) = channel();
            let ended = pool.threads.in_place_scope(|scope| {
                scope.spawn(|_| {
                    let ended = catch_unwind(AssertUnwindSafe(|| job(&monitor)));
                    // Somebody waits until this comes.
                    let _ = done.send(ended);
                });
                let mut raised = None;
                loop {
                    match wait.recv_timeout(TICK) {
                        Ok(ended) => return Ok((ended, raised)),
                        Err(RecvTimeoutError::Timeout) if raised.is_none() => {
                            raised = Python::attach(|py| monitor.tell(py, progress)).err();
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
            // Told to stop, it may have ended in another way.
            (_, Some(raised)) => Err(raised),
            (Ok(()), None) => Ok(monitor.latest()),
            (Err(panic), None) => Err(internal(message(&*panic))),
        }
    }
}

/// What a panic says.
fn message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("a panic without words")
}

/// Stage, units done, all of them.
type News = (&'static str, usize, usize);

/// Hears the job, and is asked by it whether to go on.
#[derive(Default)]
struct Monitor {
    stopped: AtomicBool,
    latest: Mutex<Option<News>>,
}

impl Monitor {
    fn latest(&self) -> Option<News> {
        *self.latest.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Lets signals be handled and the callable know; what either raises stops the job.
    fn tell(&self, py: Python<'_>, progress: Option<&Py<PyAny>>) -> PyResult<()> {
        let told = py.check_signals().and_then(|()| match (progress, self.latest()) {
            (Some(progress), Some((stage, done, total))) => progress.call1(py, (stage, done, total)).map(drop),
            _ => Ok(()),
        });
        self.stopped.fetch_or(told.is_err(), Ordering::Relaxed);
        told
    }
}

impl Progress for Monitor {
    fn report(&self, stage: &'static str, done: usize, total: usize) -> Result<(), Cancelled> {
        if self.stopped.load(Ordering::Relaxed) {
            return Err(Cancelled);
        }
        // Where another thread is just writing, its news are as new.
        if let Ok(mut latest) = self.latest.try_lock() {
            *latest = Some((stage, done, total));
        }
        Ok(())
    }
}

/// What threads share, of which one works with it at a time. Unlike a lock, it is waited for no longer than the job may go on.
pub(crate) struct Shared<T> {
    free: Mutex<Option<T>>,
    freed: Condvar,
}

impl<T> Shared<T> {
    pub(crate) fn new(value: T) -> Self {
        Self { free: Mutex::new(Some(value)), freed: Condvar::new() }
    }

    /// Waits until no other thread works with it, and gives it back at the end, also after a panic.
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
            free = self.freed.wait_timeout(free, TICK).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

/// What was taken of [`Shared`].
pub(crate) struct Taken<'a, T> {
    value: Option<T>,
    of: &'a Shared<T>,
}

impl<T> Taken<'_, T> {
    /// To work with.
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

/// More would be a mistake.
const MOST_THREADS: usize = 1024;

/// The threads of one job at a time, of this process: those of another process do not come along with `fork`.
struct Pool {
    process: u32,
    threads: ThreadPool,
}

/// Pools that no job uses.
static IDLE: Mutex<Vec<Pool>> = Mutex::new(Vec::new());

impl Pool {
    /// An idle pool of this process with so many threads, or a new one.
    fn take(threads: Option<usize>) -> PyResult<Self> {
        let process = std::process::id();
        let wanted = threads.unwrap_or_else(|| std::thread::available_parallelism().map_or(1, usize::from));
        // Locked for good where `fork` came at that very moment: then a pool more is made.
        if let Ok(mut idle) = IDLE.try_lock() {
            if let Some(at) =
                idle.iter().position(|p| p.process == process && p.threads.current_num_threads() == wanted)
            {
                return Ok(idle.swap_remove(at));
            }
            // The threads of the parent do not exist here: nobody must wait for them.
            let (ours, others) = std::mem::take(&mut *idle).into_iter().partition(|p| p.process == process);
            *idle = ours;
            let others: Vec<Self> = others;
            others.into_iter().for_each(std::mem::forget);
        }
        let made = rayon::ThreadPoolBuilder::new().num_threads(wanted).thread_name(|i| format!("epipole {i}")).build();
        let pool = made.map_err(|error| internal(&format!("no threads: {error}")))?;
        Ok(Self { process, threads: pool })
    }

    /// Keeps it for the next job; a few, as each Python thread that works at the same time takes one.
    fn give_back(self) {
        if let Ok(mut idle) = IDLE.try_lock()
            && idle.len() < MOST_IDLE
        {
            idle.push(self);
        }
    }
}

/// Idle pools that are kept.
const MOST_IDLE: usize = 16;
