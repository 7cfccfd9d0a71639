//! Figures held against bars: what `cargo xtask real` and `cargo xtask peers` have in common.

use anyhow::{Result, bail};
use std::time::Instant;

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
        Self { name: name.into(), figure, bar: format!("<= {}", rounded(bar)), ok: figure <= bar }
    }

    /// A figure that must not be smaller than `bar`. NaN fails.
    pub(crate) fn at_least(name: impl Into<String>, figure: f64, bar: f64) -> Self {
        Self { name: name.into(), figure, bar: format!(">= {}", rounded(bar)), ok: figure >= bar }
    }
}

/// To three decimals, without zeros at the end.
fn rounded(bar: f64) -> f64 {
    (1e3 * bar).round() / 1e3
}

/// A job by its name on the command line.
pub(crate) type Named<J> = (&'static str, J);

/// All jobs, or the one named; `all` names all of them, too.
pub(crate) fn select<'a, J>(jobs: &'a [Named<J>], only: Option<&str>) -> Result<Vec<&'a Named<J>>> {
    let chosen: Vec<_> =
        jobs.iter().filter(|(name, _)| only.is_none_or(|only| only == *name || only == "all")).collect();
    if chosen.is_empty() {
        let names: Vec<&str> = jobs.iter().map(|(name, _)| *name).collect();
        bail!("there is no job {}; try: all, {}", only.unwrap_or_default(), names.join(", "));
    }
    Ok(chosen)
}

/// Runs jobs one after the other and prints every figure beside its bar at the end; true where all are met. A job that
/// fails does not keep the others from running.
pub(crate) fn run<J>(jobs: &[&Named<J>], call: impl Fn(&J) -> Result<Vec<Check>>) -> bool {
    let mut ok = true;
    let mut table = Vec::new();
    for (name, job) in jobs {
        println!("== {name}");
        let start = Instant::now();
        match call(job) {
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
    ok
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
