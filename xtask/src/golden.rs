//! `cargo xtask golden`: every pipeline on the small inputs under `fixtures/`.
//!
//! Two questions are asked of each figure that comes out. Is it right: does it meet a bar against `fixtures/oracle`, the
//! analytic truth? And has it changed: is it within its tolerance of `fixtures/golden`, what came out before? The second
//! only says that something is different, never that it is good. `--check`, which the tests run, writes nothing; without it
//! the golden figures are rewritten and every change is shown.

mod jobs;

use crate::real::Check;
use anyhow::{Context, Result};
use serde_json::{Map, Value, json};
use std::path::{Path, PathBuf};

/// A figure, and by how much it may differ from the golden one before that counts as a change.
#[derive(Debug, Clone)]
struct Figure {
    name: &'static str,
    value: f64,
    tolerance: f64,
}

/// What a pipeline made of its fixtures.
struct Outcome {
    /// Held against the truth.
    checks: Vec<Check>,
    /// Held against the past.
    figures: Vec<Figure>,
}

/// A job: its name, which is that of its golden file, and what it does with the fixtures.
type Job = (&'static str, fn(&Path) -> Result<Outcome>);

/// Runs all jobs. With `check`, true where every figure is right and unchanged; without it, rewrites the golden files.
pub(crate) fn run(check: bool) -> Result<bool> {
    run_in(&crate::root().join("fixtures"), jobs::JOBS, check)
}

fn run_in(fixtures: &Path, jobs: &[Job], check: bool) -> Result<bool> {
    let mut ok = true;
    for (name, job) in jobs {
        let outcome = job(fixtures).with_context(|| (*name).to_owned())?;
        for Check { name: what, figure, bar, ok: right, .. } in &outcome.checks {
            let verdict = if *right { "ok" } else { "WRONG" };
            println!("{name}: {what} {figure:.4} {bar}: {verdict}");
            ok &= right;
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
        println!("golden: where a change is meant and right, run `cargo xtask golden` and commit what it writes");
    }
    Ok(ok)
}

/// What is not as it was.
fn compare(path: &PathBuf, figures: &[Figure]) -> Result<Vec<String>> {
    let golden: Map<String, Value> = match std::fs::read_to_string(path) {
        Ok(text) => serde_json::from_str(&text).with_context(|| path.display().to_string())?,
        Err(_) => return Ok(vec![format!("there is no {}", path.display())]),
    };
    let mut changes = Vec::new();
    for Figure { name, value, tolerance } in figures {
        match golden.get(*name).and_then(Value::as_f64) {
            None => changes.push(format!("{name} is new: {value}")),
            // NaN is a change.
            Some(old) if (value - old).abs() <= *tolerance => {}
            Some(old) => changes.push(format!("{name} was {old}, is {value} (tolerance {tolerance})")),
        }
    }
    for gone in golden.keys().filter(|key| !figures.iter().any(|figure| figure.name == key.as_str())) {
        changes.push(format!("{gone} is gone"));
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
    fn the_pipelines_are_right_and_as_they_were() {
        assert!(run(true).unwrap());
    }

    fn two(_: &Path) -> Result<Outcome> {
        let figure = |name, value| Figure { name, value, tolerance: 0.1 };
        Ok(Outcome { checks: vec![Check::at_most("x", 1.0, 2.0)], figures: vec![figure("a", 1.0), figure("b", 2.0)] })
    }

    fn wrong(_: &Path) -> Result<Outcome> {
        Ok(Outcome { checks: vec![Check::at_most("x", f64::NAN, 2.0)], figures: Vec::new() })
    }

    #[test]
    fn a_check_never_writes_and_sees_each_kind_of_change() {
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
    fn a_wrong_figure_cannot_be_made_golden() {
        let folder = tempfile::tempdir().unwrap();
        assert!(!run_in(folder.path(), &[("wrong", wrong as fn(&Path) -> Result<Outcome>)], false).unwrap());
    }
}
