//! The pipelines on real photographs, each figure held against its bar.
//!
//! One file per job. A job is a function from the data folder to its [`Check`]s; register it with one line in `JOBS`.
//! A figure that is off its bar fails the run; so does an error. Jobs print what else a person wants to see.

pub(crate) mod depth;
pub(crate) mod estimate;
mod matching;
mod panorama;
mod reconstruct;
mod segment;

use anyhow::{Result, bail};
use std::{path::Path, time::Instant};

/// A job: its name on the command line and what it does.
type Job = (&'static str, fn(&Path) -> Result<Vec<Check>>);

const JOBS: &[Job] = &[
    ("depth", depth::run),
    ("estimate", estimate::run),
    ("matching", matching::run),
    ("panorama", panorama::run),
    ("reconstruct", reconstruct::run),
    ("segment", segment::run),
];

/// A figure and the bar it is held against.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Check {
    /// What was measured, with its unit.
    pub(crate) name: String,
    /// What came out.
    pub(crate) figure: f64,
    /// What is asked for, with its direction: `<= 2.2`.
    pub(crate) bar: String,
    /// Whether the figure meets the bar.
    pub(crate) ok: bool,
}

impl Check {
    /// A figure that must not be larger than `bar`. NaN fails.
    pub(crate) fn at_most(name: impl Into<String>, figure: f64, bar: f64) -> Self {
        Self { name: name.into(), figure, bar: format!("<= {bar}"), ok: figure <= bar }
    }

    /// A figure that must not be smaller than `bar`. NaN fails.
    pub(crate) fn at_least(name: impl Into<String>, figure: f64, bar: f64) -> Self {
        Self { name: name.into(), figure, bar: format!(">= {bar}"), ok: figure >= bar }
    }
}

/// Runs all jobs, or the one named; true where every figure meets its bar.
pub(crate) fn run(only: Option<&str>) -> Result<bool> {
    let jobs: Vec<&Job> = JOBS.iter().filter(|(name, _)| only.is_none_or(|only| only == *name)).collect();
    if let (Some(only), true) = (only, jobs.is_empty()) {
        let names: Vec<&str> = JOBS.iter().map(|(name, _)| *name).collect();
        bail!("there is no job {only}; try: {}", names.join(", "));
    }
    let Some(data) = crate::data_dir() else {
        println!(
            "real: skipped, there is no data: set CV_DATA_DIR to the folder that holds it (see docs/real-data.md)"
        );
        return Ok(true);
    };
    let mut ok = true;
    let mut table = Vec::new();
    for (name, job) in jobs {
        println!("== {name}");
        let start = Instant::now();
        match job(&data) {
            Ok(checks) => {
                // A job that measures nothing has not passed.
                ok &= !checks.is_empty() && checks.iter().all(|check| check.ok);
                table.extend(checks.into_iter().map(|check| (*name, check)));
            }
            Err(error) => {
                ok = false;
                println!("error: {name}: {error:#}");
            }
        }
        println!("== {name}: {:.1} s", start.elapsed().as_secs_f64());
    }
    print!("{}", render(&table));
    Ok(ok)
}

/// The table at the end of a run.
fn render(table: &[(&str, Check)]) -> String {
    let width = table.iter().map(|(job, check)| job.len() + 1 + check.name.len()).max().unwrap_or(0);
    table
        .iter()
        .map(|(job, check)| {
            let verdict = if check.ok { "ok" } else { "OFF THE BAR" };
            let name = format!("{job} {}", check.name);
            format!("{name:width$}  {:>10.4}  {:>10}  {verdict}\n", check.figure, check.bar)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_figure_that_is_no_number_meets_no_bar() {
        assert!(!Check::at_most("x", f64::NAN, 1.0).ok && !Check::at_least("x", f64::NAN, 1.0).ok);
        assert!(Check::at_most("x", 1.0, 1.0).ok && !Check::at_most("x", 1.1, 1.0).ok);
        assert!(Check::at_least("x", 1.0, 1.0).ok && !Check::at_least("x", 0.9, 1.0).ok);
    }

    #[test]
    fn the_table_says_which_figure_is_off() {
        let table = [("depth", Check::at_most("a", 2.0, 1.0)), ("segment", Check::at_least("long name", 2.0, 1.0))];
        let text = render(&table);
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].ends_with("OFF THE BAR") && lines[1].ends_with("ok"));
        assert_eq!(lines[0].find("<="), lines[1].find(">="));
    }
}
