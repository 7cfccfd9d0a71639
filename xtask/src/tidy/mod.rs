//! `cargo xtask tidy`: the rules of the workspace that no compiler checks. Also a test, so `cargo test` runs it.

mod manifests;
mod options_in_text;
mod supply;
mod text;
mod type_names;

use anyhow::{Context, Result, ensure};
use manifests::{check_manifest, check_tiers, name, rules, table};
use serde_json::Value;
use std::{
    fs,
    path::{Path, PathBuf},
};
use text::check_text;
use type_names::check_type_names;

/// Maximum total size of the files under `fixtures/`, in bytes.
const MAX_FIXTURES_BYTES: u64 = 1 << 20;

/// Prints the violations; returns whether there are none.
pub(crate) fn run() -> Result<bool> {
    let found = check_workspace()?;
    for note in &found.notes {
        println!("note: {note}");
    }
    for problem in &found.problems {
        println!("untidy: {problem}");
    }
    println!("tidy: {} files, {} problems", found.files, found.problems.len());
    Ok(found.problems.is_empty())
}

#[derive(Debug, Default)]
struct Found {
    files: usize,
    notes: Vec<String>,
    problems: Vec<String>,
}

/// Checks every rule on this workspace.
fn check_workspace() -> Result<Found> {
    let mut found = check_files(crate::root())?;
    supply::check(crate::root(), &mut found)?;
    Ok(found)
}

/// Checks the rules that depend on the files alone.
fn check_files(root: &Path) -> Result<Found> {
    let rules = rules()?;
    let mut found = Found::default();
    let mut files = Vec::new();
    walk(root, &mut files)?;
    found.files = files.len();
    ensure!(!files.is_empty(), "there are no files in {}", root.display());

    check_tiers(&rules, &mut found);
    let mut used = Vec::new();
    let mut crate_names = Vec::new();
    for manifest in files.iter().filter(|file| file.ends_with("Cargo.toml") && file.parent() != Some(root)) {
        let table = table(manifest)?;
        // A manifest with its own workspace, such as peers/rust, is not a member of this one.
        if table.contains_key("workspace") {
            continue;
        }
        check_manifest(manifest, &table, &rules, &mut used, &mut found)?;
        crate_names.push(name(&table));
    }
    for missing in rules.crates.keys().filter(|name| !crate_names.contains(name)) {
        found.problems.push(format!("tiers.toml lists {missing}, which is not there"));
    }
    let workspace = table(&root.join("Cargo.toml"))?;
    let shared = workspace.get("workspace").and_then(|workspace| workspace.get("dependencies"));
    for name in shared.and_then(Value::as_object).into_iter().flat_map(|table| table.keys()) {
        if !used.contains(name) {
            found.problems.push(format!("Cargo.toml: no crate uses the workspace dependency {name}"));
        }
    }
    check_type_names(root, &files, &mut found)?;
    for file in &files {
        let shown = file.strip_prefix(root).unwrap_or(file).display().to_string();
        // Binary files are skipped.
        if let Ok(text) = fs::read_to_string(file) {
            check_text(&shown, &text, &mut found);
        }
    }
    let fixtures = root.join("fixtures");
    let size: u64 =
        files.iter().filter(|file| file.starts_with(&fixtures)).flat_map(fs::metadata).map(|data| data.len()).sum();
    if size > MAX_FIXTURES_BYTES {
        found.problems.push(format!("fixtures/ has {size} bytes, more than {MAX_FIXTURES_BYTES}"));
    }
    Ok(found)
}

/// Lists all files of the project, without build outputs and hidden entries other than `.ci`, `.cargo` and `.gitignore`.
fn walk(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let mut entries: Vec<PathBuf> = fs::read_dir(folder)
        .with_context(|| folder.display().to_string())?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<std::io::Result<_>>()?;
    entries.sort();
    for path in entries {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let is_checked = [".ci", ".cargo", ".gitignore"].contains(&name.as_str());
        if name == "target" || (name.starts_with('.') && !is_checked) {
            continue;
        }
        if path.is_dir() { walk(&path, files)? } else { files.push(path) }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use text::MAX_LINES;

    #[test]
    fn the_workspace_is_tidy() {
        let found = check_workspace().unwrap();
        assert!(found.problems.is_empty(), "{:#?}", found.problems);
    }

    /// Returns the problems of a workspace with one crate, `cv-stereo`, of the given files.
    fn problems(manifest: &str, files: &[(&str, &str)]) -> Vec<String> {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("crates/cv-stereo");
        fs::create_dir_all(folder.join("src")).unwrap();
        fs::write(root.path().join("Cargo.toml"), "[workspace.dependencies]\nrayon = \"1\"\n").unwrap();
        let head = "[package]\nname = \"cv-stereo\"\nversion.workspace = true\nedition.workspace = true\n\
                    rust-version.workspace = true\nlicense.workspace = true\n";
        fs::write(folder.join("Cargo.toml"), format!("{head}{manifest}")).unwrap();
        for (name, text) in files {
            fs::write(folder.join(name), text).unwrap();
        }
        let mut problems = check_files(root.path()).unwrap().problems;
        problems.retain(|problem| !problem.contains("which is not there"));
        problems
    }

    const GOOD: &str = "[lints]\nworkspace = true\n[dependencies]\nrayon.workspace = true\n";
    const LIB: &str = "//! A map.\n//! ```\n//! ```\nuse rayon::prelude::*;\n";

    #[test]
    fn a_tidy_crate_passes() {
        assert_eq!(problems(GOOD, &[("src/lib.rs", LIB)]), [""; 0]);
    }

    #[test]
    fn each_rule_can_fail() {
        let two = format!("{LIB}pub struct Pixel;\nmod a {{ }}\npub enum Pixel {{}}\n");
        type Case<'a> = (&'a str, String, &'a [(&'a str, &'a str)]);
        let cases: [Case; 14] = [
            ("lacks `[lints]", GOOD.replace("true\n[dep", "false\n[dep"), &[("src/lib.rs", LIB)]),
            ("must not use cv-features", format!("{GOOD}cv-features.workspace = true\n"), &[("src/lib.rs", LIB)]),
            ("must not use png", format!("{GOOD}png.workspace = true\n"), &[("src/lib.rs", LIB)]),
            ("names its own version", format!("{GOOD}clap_lex = \"1\"\n"), &[("src/lib.rs", LIB)]),
            ("rayon (dependencies) is not used", GOOD.to_owned(), &[("src/lib.rs", "//! ```\n// rayon\n")]),
            ("does not open with", GOOD.to_owned(), &[("src/lib.rs", "//! Short.\nuse rayon::x;\n")]),
            ("never compiled", GOOD.to_owned(), &[("src/lib.rs", LIB), ("src/lost.rs", "\n")]),
            ("unfinished work", GOOD.to_owned(), &[("src/lib.rs", LIB), ("notes.md", concat!("FIX", "ME\n"))]),
            (
                "an option or a command",
                GOOD.to_owned(),
                &[("src/lib.rs", "//! ```\n//! ```\nuse rayon::prelude::*;\nconst A: &str = \"give --focal\";\n")],
            ),
            ("Pixel is the name of 2 public types", GOOD.to_owned(), &[("src/lib.rs", &two)]),
            ("reads a clock", GOOD.to_owned(), &[("src/lib.rs", LIB), ("src/x.rs", concat!("Instant::", "now()\n"))]),
            (
                "starts a thread",
                GOOD.to_owned(),
                &[("src/lib.rs", LIB), ("src/x.rs", concat!("thread::", "spawn()\n"))],
            ),
            ("opens files", GOOD.to_owned(), &[("src/lib.rs", LIB), ("src/x.rs", concat!("use std::", "fs;\n"))]),
            ("a path of one machine", GOOD.to_owned(), &[("src/lib.rs", LIB), ("notes.md", concat!("/ho", "me/x\n"))]),
        ];
        for (expected, manifest, files) in cases {
            let found = problems(&manifest, files);
            assert!(found.iter().any(|problem| problem.contains(expected)), "{expected}: {found:?}");
        }
        let long = LIB.to_owned() + &"\n".repeat(MAX_LINES);
        assert!(problems(GOOD, &[("src/lib.rs", &long)])[0].contains("split it"));
        let tested = format!("{LIB}#[cfg(test)]\n{}", "\n".repeat(MAX_LINES));
        assert_eq!(problems(GOOD, &[("src/lib.rs", &tested)]), [""; 0]);
        // The rules do not apply to tests.
        let clock = format!("{LIB}#[cfg(test)]\n{}\n", concat!("Instant::", "now()"));
        assert_eq!(problems(GOOD, &[("src/lib.rs", &clock)]), [""; 0]);
    }
}
