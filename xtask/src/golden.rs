//! `cargo xtask golden`: every pipeline on the small inputs under `fixtures/`.
//!
//! Each figure is checked twice. Accuracy: it meets its target against `fixtures/oracle`, the analytic ground truth. Regression:
//! it is within its tolerance of `fixtures/golden`, the figures of an earlier run; this detects a change, not an error. `--check`,
//! which the tests run, writes nothing; without it the golden figures are rewritten and every change is printed.

mod jobs;

use crate::real::Check;
use anyhow::{Context, Result};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};

/// A figure and the largest difference from the golden one that does not count as a change.
#[derive(Debug, Clone)]
struct Figure {
    name: &'static str,
    value: f64,
    tolerance: f64,
}

/// Results of a pipeline on its fixtures.
struct Outcome {
    /// Compared with the ground truth.
    checks: Vec<Check>,
    /// Compared with the golden figures.
    figures: Vec<Figure>,
}

/// A job: its name, which is that of its golden file, and its function of the fixtures' folder.
type Job = (&'static str, fn(&Path) -> Result<Outcome>);

/// Runs all jobs. With `check`, returns whether every figure meets its target and is unchanged; without it, rewrites the golden files.
pub(crate) fn run(check: bool) -> Result<bool> {
    run_in(&crate::root().join("fixtures"), jobs::JOBS, check)
}

fn run_in(fixtures: &Path, jobs: &[Job], check: bool) -> Result<bool> {
    let mut ok = true;
    for (name, job) in jobs {
        let outcome = job(fixtures).with_context(|| (*name).to_owned())?;
        for Check { name: quantity, figure, target, ok: is_met, .. } in &outcome.checks {
            let verdict = if *is_met { "ok" } else { "NOT MET" };
            println!("{name}: {quantity} {figure:.4} {target}: {verdict}");
            ok &= is_met;
        }
        let path = fixtures.join("golden").join(format!("{name}.json"));
        let changes = compare(&path, &outcome.figures)?;
        for change in &changes {
            println!("{name}: {change}");
        }
        if check {
            ok &= changes.is_empty();
        } else {
            write(&path, &outcome.figures)?;
        }
    }
    if !ok && check {
        println!("golden: if a change is intended and correct, run `cargo xtask golden` and commit the files");
    }
    Ok(ok)
}

/// Lists the differences from the golden figures.
fn compare(path: &PathBuf, figures: &[Figure]) -> Result<Vec<String>> {
    let golden: Map<String, Value> = match std::fs::read_to_string(path) {
        Ok(text) => serde_json::from_str(&text).with_context(|| path.display().to_string())?,
        Err(_) => return Ok(vec![format!("there is no {}", path.display())]),
    };
    let mut changes = Vec::new();
    for Figure { name, value, tolerance } in figures {
        match golden.get(*name).and_then(Value::as_f64) {
            None => changes.push(format!("{name} is new: {value}")),
            // The comparison is false for NaN, which counts as a change.
            Some(old) if (value - old).abs() <= *tolerance => {}
            Some(old) => changes.push(format!("{name} was {old}, is {value} (tolerance {tolerance})")),
        }
    }
    for missing in golden.keys().filter(|key| !figures.iter().any(|figure| figure.name == key.as_str())) {
        changes.push(format!("{missing} is missing"));
    }
    Ok(changes)
}

fn write(path: &Path, figures: &[Figure]) -> Result<()> {
    let object: Map<String, Value> = figures.iter().map(|f| (f.name.to_owned(), json!(f.value))).collect();
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder)?;
    }
    Ok(cv_io::write_bytes(path, (serde_json::to_string_pretty(&object)? + "\n").as_bytes())?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    #[test]
    fn the_pipelines_meet_their_targets_and_match_the_golden_figures() {
        assert!(run(true).unwrap());
    }

    fn two(_: &Path) -> Result<Outcome> {
        let figure = |name, value| Figure { name, value, tolerance: 0.1 };
        Ok(Outcome { checks: vec![Check::at_most("x", 1.0, 2.0)], figures: vec![figure("a", 1.0), figure("b", 2.0)] })
    }

    fn failing(_: &Path) -> Result<Outcome> {
        Ok(Outcome { checks: vec![Check::at_most("x", f64::NAN, 2.0)], figures: Vec::new() })
    }

    #[test]
    fn a_check_writes_nothing_and_detects_each_kind_of_change() {
        let folder = tempfile::tempdir().unwrap();
        let (path, jobs) = (folder.path().join("golden/two.json"), [("two", two as fn(&Path) -> Result<Outcome>)]);
        assert!(!run_in(folder.path(), &jobs, true).unwrap() && !path.exists());
        assert!(run_in(folder.path(), &jobs, false).unwrap() && run_in(folder.path(), &jobs, true).unwrap());
        for (golden, good) in [
            (r#"{"a": 1.05, "b": 2.0}"#, true),
            (r#"{"a": 1.2, "b": 2.0}"#, false),
            (r#"{"a": 1.0}"#, false),
            (r#"{"a": 1.0, "b": 2.0, "c": 3.0}"#, false),
            (r#"{"a": null, "b": 2.0}"#, false),
        ] {
            fs::write(&path, golden).unwrap();
            assert_eq!(run_in(folder.path(), &jobs, true).unwrap(), good, "{golden}");
            assert_eq!(fs::read_to_string(&path).unwrap(), golden);
        }
    }

    #[test]
    fn a_figure_that_does_not_meet_its_target_fails_the_rewrite_too() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!run_in(folder.path(), &[("failing", failing as fn(&Path) -> Result<Outcome>)], false).unwrap());
    }
}
