//! Rules that check the lines of a file.

use super::Found;

/// Lines of a source file before its tests above which a note is printed.
const NOTE_LINES: usize = 500;
/// Lines of a source file before its tests above which the check fails.
pub(super) const MAX_LINES: usize = 600;

/// Calls that a library crate must not make: clocks, files, threads and processes panic or do not compile in a browser. The second
/// entry lists exceptions. The names are written in two halves, so that this file does not match itself.
const FORBIDDEN_IN_LIBRARIES: [([&str; 2], &[&str], &str); 6] = [
    (["Instant::", "now"], &["crates/cv-core/src/stage_clock.rs"], "reads a clock: use cv_core::StageClock"),
    (["System", "Time"], &["crates/cv-io/"], "reads a clock: use cv_core::StageClock"),
    (["std::", "fs"], &["crates/cv-io/"], "opens files: cv-io does that"),
    (["thread::", "sleep"], &[], "sleeps"),
    (["thread::", "spawn"], &[], "starts a thread: use rayon"),
    (["process::", "Command"], &[], "starts a program"),
];

pub(super) fn check_text(shown: &str, text: &str, found: &mut Found) {
    let rust = shown.ends_with(".rs");
    if rust {
        let lines = text.lines().take_while(|line| line.trim() != "#[cfg(test)]").count();
        // The length of test files is not limited.
        if !shown.contains("/tests/") && !shown.ends_with("tests.rs") {
            if lines > MAX_LINES {
                found
                    .problems
                    .push(format!("{shown}: {lines} lines before its tests, more than {MAX_LINES}: split it"));
            } else if lines > NOTE_LINES {
                found.notes.push(format!("{shown}: {lines} lines before its tests"));
            }
        }
    }
    let library = shown.starts_with("crates/") && shown.contains("/src/") && !shown.starts_with("crates/cv-cli/");
    if rust && library {
        for number in super::options_in_text::lines(text) {
            found.problems.push(format!(
                "{shown}:{number}: a library names an option or a command of the program: put the numbers into its error, the words into cv-cli"
            ));
        }
    }
    if rust && library && !shown.ends_with("tests.rs") {
        for (number, line) in text.lines().enumerate().take_while(|(_, line)| line.trim() != "#[cfg(test)]") {
            for (halves, places, what) in &FORBIDDEN_IN_LIBRARIES {
                if line.contains(&halves.concat()) && !places.iter().any(|place| shown.starts_with(place)) {
                    found.problems.push(format!("{shown}:{}: {what}", number + 1));
                }
            }
        }
    }
    // Written in two halves, so that this file does not match itself.
    let unfinished =
        [["TO", "DO"], ["FIX", "ME"], ["to", "do!("], ["unimple", "mented!("]].map(|halves| halves.concat());
    let paths =
        [["/wo", "rk/"], ["/ho", "me/"], ["/ro", "ot/"], ["/Use", "rs/"], ["C:", "\\"]].map(|halves| halves.concat());
    let unstable = [["Std", "Rng"], ["thread", "_rng"]].map(|halves| halves.concat());
    for (number, line) in text.lines().enumerate() {
        let mut complain = |what: &str| found.problems.push(format!("{shown}:{}: {what}", number + 1));
        if unfinished.iter().any(|word| line.contains(word)) {
            complain("unfinished work");
        }
        if paths.iter().any(|path| line.contains(path.as_str())) {
            complain("a path of one machine");
        }
        if rust && unstable.iter().any(|name| line.contains(name.as_str())) {
            complain("a random generator whose stream may change: use ChaCha8Rng with a seed");
        }
        if rust && line.trim() == "#[ignore]" {
            complain("an ignored test without its reason");
        }
    }
}
