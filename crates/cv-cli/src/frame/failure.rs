//! Failures of commands: cause and remedy.

use crate::words;
use cv_io::{FormatError, IoError};
use std::{fmt::Display, process::ExitCode};

/// Why a command failed, and what to try.
#[derive(Debug)]
pub(crate) struct Failure {
    what: String,
    advice: Option<String>,
    usage: bool,
}

impl Failure {
    /// A job that could not be done: exit code 1.
    pub(crate) fn new(what: impl Display) -> Self {
        Self { what: what.to_string(), advice: None, usage: false }
    }

    /// Invalid or incompatible arguments: exit code 2.
    pub(crate) fn usage(what: impl Display) -> Self {
        Self { usage: true, ..Self::new(what) }
    }

    /// Adds a remedy.
    pub(crate) fn advice(mut self, advice: impl Display) -> Self {
        self.advice = Some(advice.to_string());
        self
    }

    /// Returns 2 for wrong usage, else 1.
    pub(crate) fn exit_code(&self) -> ExitCode {
        ExitCode::from(if self.usage { 2 } else { 1 })
    }

    /// Formats the message for stderr.
    pub(crate) fn text(&self) -> String {
        match &self.advice {
            Some(advice) => format!("error: {}; try: {advice}", self.what),
            None => format!("error: {}", self.what),
        }
    }
}

/// Converts any error; causes that its message does not contain are appended, separated by colons. The hint of a file error
/// becomes the advice.
impl<E: std::error::Error + 'static> From<E> for Failure {
    fn from(error: E) -> Self {
        let error: &(dyn std::error::Error + 'static) = &error;
        if let Some(IoError { path, writing, reason }) = error.downcast_ref() {
            let verb = if *writing { "write" } else { "read" };
            let failure = Self::new(format!("cannot {verb} {}: {reason}", path.display()));
            return Self { advice: words::unreadable(reason), ..failure };
        }
        if let Some(reason) = error.downcast_ref::<FormatError>() {
            return Self { advice: words::unreadable(reason), ..Self::new(reason) };
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

/// Adds context to errors.
pub(crate) trait Explain<T> {
    /// Prepends a context: `words: error`.
    fn during(self, words: impl Display) -> Result<T, Failure>;
    /// Appends a remedy: `error; try: advice`.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_cause_of_an_error_is_stated_once() {
        #[derive(Debug, thiserror::Error)]
        #[error("outer")]
        struct Outer(#[source] std::io::Error);
        let failure: Failure = Outer(std::io::Error::other("inner")).into();
        assert_eq!(failure.advice("nothing").text(), "error: outer: inner; try: nothing");
    }

    #[test]
    fn the_hint_of_a_file_error_is_the_advice() {
        let failure: Failure = cv_io::read_rgb("no/such/photo.png").unwrap_err().into();
        let text = failure.text();
        assert!(text.starts_with("error: cannot read no/such/photo.png: ") && text.contains("; try: check"), "{text}");
    }
}
