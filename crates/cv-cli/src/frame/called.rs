//! How the program was called, for the end of reports.

use clap::{ArgMatches, Command, parser::ValueSource};
use cv_report::Report;

/// The command line, and the value that each option had.
#[derive(Debug, Clone)]
pub(crate) struct Called {
    line: String,
    /// Name, value, and where that is from.
    options: Vec<[String; 3]>,
}

impl Called {
    /// Reads a command that was built and what it was given.
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

    /// Adds the last section of a report: what is needed to run it again.
    pub(super) fn tell(&self, page: &mut Report) {
        let version = format!("cv {} ({} {})", env!("CARGO_PKG_VERSION"), std::env::consts::OS, std::env::consts::ARCH);
        let threads = rayon::current_num_threads().to_string();
        page.section("This run")
            .facts("To have it again.", &[("command line", &self.line), ("version", &version), ("threads", &threads)]);
        page.folded("All options of the command", |page| {
            page.table("Options that had a value.", &["option", "value", "from"], &self.options);
        });
    }
}

/// A word as a shell takes it.
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
