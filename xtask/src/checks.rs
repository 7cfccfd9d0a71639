//! Figures compared with targets: shared by `cargo xtask real`, `rendered`, `golden` and `peers`.

use anyhow::{Result, bail};
use std::time::Instant;

/// A figure and its target.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Check {
    /// The quantity, with its unit.
    pub(crate) name: String,
    /// The measured value.
    pub(crate) figure: f64,
    /// The limit, with its direction: `<= 2.2`.
    pub(crate) target: String,
    /// Whether the figure meets the target.
    pub(crate) ok: bool,
}

impl Check {
    /// A figure that must not be larger than `limit`. NaN fails.
    pub(crate) fn at_most(name: impl Into<String>, figure: f64, limit: f64) -> Self {
        Self { name: name.into(), figure, target: format!("<= {}", rounded(limit)), ok: figure <= limit }
    }

    /// A figure that must not be smaller than `limit`. NaN fails.
    pub(crate) fn at_least(name: impl Into<String>, figure: f64, limit: f64) -> Self {
        Self { name: name.into(), figure, target: format!(">= {}", rounded(limit)), ok: figure >= limit }
    }
}

/// Rounds to three decimals.
fn rounded(limit: f64) -> f64 {
    (1e3 * limit).round() / 1e3
}

/// A job and its name on the command line.
pub(crate) type Named<J> = (&'static str, J);

/// Returns the job of that name; all jobs for `None` or `all`.
pub(crate) fn select<'a, J>(jobs: &'a [Named<J>], only: Option<&str>) -> Result<Vec<&'a Named<J>>> {
    let chosen: Vec<_> =
        jobs.iter().filter(|(name, _)| only.is_none_or(|only| only == *name || only == "all")).collect();
    if chosen.is_empty() {
        let names: Vec<&str> = jobs.iter().map(|(name, _)| *name).collect();
        bail!("there is no job {}; try: all, {}", only.unwrap_or_default(), names.join(", "));
    }
    Ok(chosen)
}

/// Runs jobs one after the other and prints a table of all figures and targets at the end; true if all are met. The run
/// continues after a job that fails.
pub(crate) fn run<J>(jobs: &[&Named<J>], call: impl Fn(&J) -> Result<Vec<Check>>) -> bool {
    let mut ok = true;
    let mut table = Vec::new();
    for (name, job) in jobs {
        println!("== {name}");
        let start = Instant::now();
        match call(job) {
            Ok(checks) => {
                // A job without figures has not passed.
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
    ok
}

/// Returns the table of figures and targets.
fn render(table: &[(&str, Check)]) -> String {
    let width = table.iter().map(|(job, check)| job.len() + 1 + check.name.len()).max().unwrap_or(0);
    table
        .iter()
        .map(|(job, check)| {
            let verdict = if check.ok { "ok" } else { "NOT MET" };
            let name = format!("{job} {}", check.name);
            format!("{name:width$}  {:>10.4}  {:>10}  {verdict}\n", check.figure, check.target)
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nan_meets_no_target() {
        assert!(!Check::at_most("x", f64::NAN, 1.0).ok && !Check::at_least("x", f64::NAN, 1.0).ok);
        assert!(Check::at_most("x", 1.0, 1.0).ok && !Check::at_most("x", 1.1, 1.0).ok);
        assert!(Check::at_least("x", 1.0, 1.0).ok && !Check::at_least("x", 0.9, 1.0).ok);
    }

    #[test]
    fn the_table_marks_figures_that_do_not_meet_their_target() {
        let table = [("depth", Check::at_most("a", 2.0, 1.0)), ("segment", Check::at_least("long name", 2.0, 1.0))];
        let text = render(&table);
        let lines: Vec<&str> = text.lines().collect();
        assert!(lines[0].ends_with("NOT MET") && lines[1].ends_with("ok"));
        assert_eq!(lines[0].find("<="), lines[1].find(">="));
    }

    #[test]
    fn a_job_that_fails_or_measures_nothing_fails_the_run() {
        let jobs = [("good", 1), ("empty", 0), ("bad", 2)];
        let call = |kind: &i32| match kind {
            0 => Ok(Vec::new()),
            1 => Ok(vec![Check::at_most("x", 0.0, 1.0)]),
            _ => bail!("no"),
        };
        let passes = |only| run(&select(&jobs, only).unwrap(), call);
        assert!(passes(Some("good")) && !passes(Some("empty")) && !passes(Some("bad")));
        assert!(!passes(None) && !passes(Some("all")));
        assert!(select(&jobs, Some("other")).unwrap_err().to_string().contains("try: all, good"));
    }
}
