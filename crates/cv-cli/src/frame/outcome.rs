//! The result of a command.

use super::Failure;
use serde::Serialize;
use serde_json::{Map, Value, json};

/// The result of a command: the JSON object, the stage times, and a summary for people.
#[derive(Debug, Default)]
pub(crate) struct Outcome {
    stages: Vec<(&'static str, f64)>,
    values: Map<String, Value>,
    unserializable: Option<String>,
    summary: String,
    stdout: Vec<u8>,
    failure: Option<Failure>,
}

impl Outcome {
    /// Creates an outcome with the seconds of its stages.
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

    /// Sets the summary, printed on stderr at the end.
    pub(crate) fn summary(mut self, text: impl Into<String>) -> Self {
        self.summary = text.into();
        self
    }

    /// Sets text that is the result of the command: printed on stdout, or a key of the object under `--json`.
    pub(crate) fn text(mut self, key: &str, text: Vec<u8>) -> Self {
        self = self.with(key, String::from_utf8_lossy(&text));
        self.stdout = text;
        self
    }

    /// Marks a result that is printed but unusable: exit code 1 with this failure.
    pub(crate) fn with_failure(mut self, failure: Failure) -> Self {
        self.failure = Some(failure);
        self
    }

    /// Takes the failure of [`Outcome::with_failure`].
    pub(super) fn take_failure(&mut self) -> Option<Failure> {
        self.failure.take()
    }

    /// Returns the text for stdout without `--json`.
    pub(super) fn stdout(&self) -> &[u8] {
        &self.stdout
    }

    /// Returns the summary for stderr.
    pub(super) fn summary_text(&self) -> &str {
        self.summary.trim_end()
    }

    /// Builds the object of `--json` for a run of `total` seconds.
    pub(super) fn into_json(mut self, total: f64) -> Result<Value, Failure> {
        if let Some(key) = self.unserializable {
            return Err(Failure::new(format!("cannot write the JSON value {key}")));
        }
        let mut seconds: Map<String, Value> =
            self.stages.iter().map(|(stage, seconds)| ((*stage).to_owned(), json!(seconds))).collect();
        seconds.insert("total".to_owned(), json!(total));
        self.values.insert("seconds".to_owned(), Value::Object(seconds));
        self.values.insert("threads".to_owned(), json!(rayon::current_num_threads()));
        self.values.insert("version".to_owned(), json!(env!("CARGO_PKG_VERSION")));
        Ok(Value::Object(self.values))
    }
}
