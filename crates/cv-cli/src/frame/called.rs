//! The command line and option values, for the end of reports.

use clap::{ArgMatches, Command, parser::ValueSource};
use cv_report::Report;

/// The command line, and the value of each option.
#[derive(Debug, Clone)]
pub(crate) struct Called {
    line: String,
    /// Name, value, and its source (`default` or `given`).
    options: Vec<[String; 3]>,
}

impl Called {
    /// Collects the option values of a parsed command line.
    pub(crate) fn new(mut command: &Command, mut matches: &ArgMatches) -> Self {
        while let Some((name, inner)) = matches.subcommand() {
            let Some(found) = command.find_subcommand(name) else { break };
            (command, matches) = (found, inner);
        }
        let mut options = Vec::new();
        for arg in command.get_arguments() {
            let id = arg.get_id().as_str();
            let Ok(Some(values)) = matches.try_get_raw(id) else { continue };
            let values: Vec<_> = values.map(|value| value.to_string_lossy()).collect();
            let name = arg.get_long().map_or_else(|| id.to_owned(), |long| format!("--{long}"));
            let source = if matches.value_source(id) == Some(ValueSource::DefaultValue) { "default" } else { "given" };
            options.push([name, values.join(" "), source.to_owned()]);
        }
        let words = std::env::args_os().skip(1).map(|word| quoted(&word.to_string_lossy()));
        Self { line: std::iter::once("cv".to_owned()).chain(words).collect::<Vec<_>>().join(" "), options }
    }

    /// Adds the last section of a report: the information to reproduce the run.
    pub(super) fn add_to(&self, page: &mut Report) {
        let version = format!("cv {} ({} {})", env!("CARGO_PKG_VERSION"), std::env::consts::OS, std::env::consts::ARCH);
        let threads = rayon::current_num_threads().to_string();
        page.section("This run")
            .facts("To reproduce it.", &[("command line", &self.line), ("version", &version), ("threads", &threads)]);
        page.folded("All options of the command", |page| {
            page.table("Options with a value.", &["option", "value", "source"], &self.options);
        });
    }
}

/// Quotes a word for a shell.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_alphanumeric() || "-_./=:,+%@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_owned()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}

#[cfg(test)]
mod tests {
    #[test]
    fn words_that_a_shell_would_split_are_quoted() {
        let all = ["a.jpg", "my file", "it's", "", "*.png"].map(super::quoted);
        assert_eq!(all, ["a.jpg", "'my file'", r"'it'\''s'", "''", "'*.png'"]);
    }
}
