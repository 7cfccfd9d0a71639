//! `cargo xtask tidy`: the rules of the workspace that no compiler checks. Also a test, so `cargo test` runs it.

mod options_in_text;

use anyhow::{Context, Result, ensure};
use serde::Deserialize;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};
use toml::{Table, Value};

/// Lines of a source file before its tests: above the first number it is mentioned, above the second it fails.
const LONG: usize = 500;
const TOO_LONG: usize = 600;

/// All generated files under `fixtures/` together.
const FIXTURES_BYTES: u64 = 1 << 20;

/// The list in `tiers.toml`.
#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
struct Rules {
    crates: BTreeMap<String, CrateRule>,
    only_in: BTreeMap<String, Vec<String>>,
}

#[derive(Deserialize)]
struct CrateRule {
    tier: u8,
    uses: Vec<String>,
}

/// Prints what is untidy; true where nothing is.
pub(crate) fn run() -> Result<bool> {
    let found = check(crate::root())?;
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

fn check(root: &Path) -> Result<Found> {
    let rules: Rules = toml::from_str(include_str!("tiers.toml")).context("tiers.toml")?;
    let mut found = Found::default();
    let mut files = Vec::new();
    walk(root, &mut files)?;
    found.files = files.len();
    ensure!(!files.is_empty(), "there are no files in {}", root.display());

    check_tiers(&rules, &mut found);
    let mut used = Vec::new();
    let mut seen = Vec::new();
    for manifest in files.iter().filter(|file| file.ends_with("Cargo.toml") && file.parent() != Some(root)) {
        let table: Table = fs::read_to_string(manifest)?.parse().with_context(|| manifest.display().to_string())?;
        // A workspace of its own, as peers/rust, is no crate of this one.
        if table.contains_key("workspace") {
            continue;
        }
        check_manifest(manifest, &table, &rules, &mut used, &mut found)?;
        seen.push(name(&table));
    }
    for missing in rules.crates.keys().filter(|name| !seen.contains(name)) {
        found.problems.push(format!("tiers.toml lists {missing}, which is not there"));
    }
    let workspace: Table = fs::read_to_string(root.join("Cargo.toml"))?.parse().context("Cargo.toml")?;
    for name in workspace["workspace"].get("dependencies").and_then(Value::as_table).into_iter().flat_map(Table::keys) {
        if !used.contains(name) {
            found.problems.push(format!("Cargo.toml: no crate uses the workspace dependency {name}"));
        }
    }
    check_type_names(root, &files, &mut found)?;
    for file in &files {
        let shown = file.strip_prefix(root).unwrap_or(file).display().to_string();
        // What is not text has no lines to look at.
        if let Ok(text) = fs::read_to_string(file) {
            check_text(&shown, &text, &mut found);
        }
    }
    let fixtures = root.join("fixtures");
    let size: u64 =
        files.iter().filter(|file| file.starts_with(&fixtures)).flat_map(fs::metadata).map(|data| data.len()).sum();
    if size > FIXTURES_BYTES {
        found.problems.push(format!("fixtures/ holds {size} bytes, more than {FIXTURES_BYTES}"));
    }
    Ok(found)
}

/// No two public types of the crates have one name: a reader who knows the name knows the type.
fn check_type_names(root: &Path, files: &[PathBuf], found: &mut Found) -> Result<()> {
    let mut types: BTreeMap<String, Vec<String>> = BTreeMap::new();
    let crates = root.join("crates");
    for file in files.iter().filter(|file| file.starts_with(&crates) && file.extension().is_some_and(|e| e == "rs")) {
        let shown = file.strip_prefix(root).unwrap_or(file).display().to_string();
        if !shown.contains("/src/") {
            continue;
        }
        let text = fs::read_to_string(file)?;
        for line in text.lines().take_while(|line| line.trim() != "#[cfg(test)]") {
            let declared =
                ["pub struct ", "pub enum ", "pub trait ", "pub type "].iter().find_map(|d| line.strip_prefix(d));
            if let Some(rest) = declared {
                let name: String = rest.chars().take_while(|c| c.is_alphanumeric() || *c == '_').collect();
                types.entry(name).or_default().push(shown.clone());
            }
        }
    }
    for (name, places) in types.iter().filter(|(_, places)| places.len() > 1) {
        found.problems.push(format!("{name} is the name of {} public types: {}", places.len(), places.join(", ")));
    }
    Ok(())
}

/// Every file of the project, without build outputs and hidden folders other than `.ci` and `.cargo`.
fn walk(folder: &Path, files: &mut Vec<PathBuf>) -> Result<()> {
    let mut entries: Vec<PathBuf> = fs::read_dir(folder)
        .with_context(|| folder.display().to_string())?
        .map(|entry| entry.map(|entry| entry.path()))
        .collect::<std::io::Result<_>>()?;
    entries.sort();
    for path in entries {
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let kept = [".ci", ".cargo", ".gitignore"].contains(&name.as_str());
        if name == "target" || (name.starts_with('.') && !kept) {
            continue;
        }
        if path.is_dir() { walk(&path, files)? } else { files.push(path) }
    }
    Ok(())
}

/// The list itself must obey the tiers.
fn check_tiers(rules: &Rules, found: &mut Found) {
    for (name, rule) in &rules.crates {
        for used in rule.uses.iter().filter(|used| *used != "*") {
            match rules.crates.get(used) {
                None => found.problems.push(format!("tiers.toml: {name} may use {used}, which is not listed")),
                Some(lower) if lower.tier >= rule.tier => found.problems.push(format!(
                    "tiers.toml: {name} (tier {}) may use {used} (tier {}), which is not lower",
                    rule.tier, lower.tier
                )),
                Some(_) => {}
            }
        }
    }
}

fn name(manifest: &Table) -> String {
    manifest.get("package").and_then(|package| package.get("name")).and_then(Value::as_str).unwrap_or("").to_owned()
}

fn check_manifest(
    path: &Path,
    manifest: &Table,
    rules: &Rules,
    used: &mut Vec<String>,
    found: &mut Found,
) -> Result<()> {
    let name = name(manifest);
    let Some(rule) = rules.crates.get(&name) else {
        found.problems.push(format!("{name}: not listed in tiers.toml"));
        return Ok(());
    };
    let inherits =
        |value: Option<&Value>| value.and_then(|v| v.get("workspace")).and_then(Value::as_bool) == Some(true);
    if !inherits(manifest.get("lints")) {
        found.problems.push(format!("{name}: Cargo.toml lacks `[lints] workspace = true`"));
    }
    for key in ["version", "edition", "rust-version", "license"] {
        if !inherits(manifest.get("package").and_then(|package| package.get(key))) {
            found.problems.push(format!("{name}: {key} is not the workspace's"));
        }
    }
    let folder = path.parent().unwrap_or(path);
    let source = sources(&folder.join("src"))? + &sources(&folder.join("build.rs"))?;
    let tests =
        sources(&folder.join("tests"))? + &sources(&folder.join("benches"))? + &sources(&folder.join("examples"))?;
    for (section, dev) in [("dependencies", false), ("dev-dependencies", true), ("build-dependencies", false)] {
        for (dependency, value) in manifest.get(section).and_then(Value::as_table).into_iter().flatten() {
            used.push(dependency.clone());
            if !inherits(Some(value)) {
                found.problems.push(format!("{name}: {dependency} names its own version, not the workspace's"));
            }
            if rules.crates.contains_key(dependency) {
                let allowed = rule.uses.iter().any(|used| used == dependency || used == "*");
                // Truth for tests; cv-synth itself uses nothing but cv-core, so no circle arises.
                let in_tests = dev && dependency == "cv-synth" && rule.tier >= 1;
                if !allowed && !in_tests {
                    found
                        .problems
                        .push(format!("{name} must not use {dependency} ({section}): see docs/architecture.md"));
                }
            }
            if let (Some(only), false) = (rules.only_in.get(dependency), dev)
                && !only.contains(&name)
            {
                found.problems.push(format!("{name} must not use {dependency}: only {} may", only.join(", ")));
            }
            let import = match dependency.as_str() {
                // Crates whose library has another name than their package.
                "kamadak-exif" => "exif".to_owned(),
                other => other.replace('-', "_"),
            };
            let mentions = |text: &str| mentions(text, &import);
            if !(mentions(&source) || dev && mentions(&tests)) {
                found.problems.push(format!("{name}: {dependency} ({section}) is not used"));
            }
        }
    }
    let library = folder.join("src/lib.rs");
    if let Ok(text) = fs::read_to_string(&library) {
        let docs: String = text.lines().take_while(|line| line.starts_with("//!")).collect::<Vec<_>>().join("\n");
        if !docs.contains("```") {
            found.problems.push(format!("{name}: lib.rs does not open with a description and an example"));
        }
    }
    for orphan in orphans(&folder.join("src"))? {
        found.problems.push(format!("{name}: no `mod` leads to {orphan}, so it is never compiled"));
    }
    Ok(())
}

/// The text of a Rust file, or of all Rust files in a folder; empty where there is none.
fn sources(path: &Path) -> Result<String> {
    let mut files = Vec::new();
    if path.is_dir() {
        walk(path, &mut files)?;
    } else if path.is_file() {
        files.push(path.to_owned());
    }
    let mut text = String::new();
    for file in files.iter().filter(|file| file.extension().is_some_and(|ending| ending == "rs")) {
        text += &fs::read_to_string(file)?;
    }
    Ok(text)
}

/// Whether the name stands in the text as a path or an attribute, outside line comments that are not doc examples.
fn mentions(text: &str, import: &str) -> bool {
    text.lines().any(|line| {
        line.match_indices(import).any(|(at, _)| {
            let before = line[..at].chars().next_back();
            let after = line[at + import.len()..].trim_start();
            let whole = !before.is_some_and(|c| c.is_alphanumeric() || c == '_');
            whole
                && (after.starts_with("::")
                    || after.starts_with(';')
                    || after.starts_with("]")
                    || after.starts_with(" as "))
        })
    })
}

/// Files under `src` that no `mod` line names.
fn orphans(folder: &Path) -> Result<Vec<String>> {
    if !folder.is_dir() {
        return Ok(Vec::new());
    }
    let text = sources(folder)?;
    let mut files = Vec::new();
    walk(folder, &mut files)?;
    Ok(files
        .iter()
        .filter(|file| file.extension().is_some_and(|ending| ending == "rs"))
        .filter(|file| {
            let stem = file.file_stem().unwrap_or_default().to_string_lossy().into_owned();
            let module = match stem.as_str() {
                "lib" | "main" => return false,
                "mod" => file.parent().and_then(Path::file_name).unwrap_or_default().to_string_lossy().into_owned(),
                _ => stem,
            };
            !text.contains(&format!("mod {module};"))
        })
        .map(|file| file.display().to_string())
        .collect())
}

/// Whether a file belongs to the source of a library crate, where only `StageClock` looks at the time.
fn clockless(shown: &str) -> bool {
    shown.starts_with("crates/")
        && shown.contains("/src/")
        && !shown.starts_with("crates/cv-cli/")
        && !shown.ends_with("cv-core/src/stage_clock.rs")
}

fn check_text(shown: &str, text: &str, found: &mut Found) {
    let rust = shown.ends_with(".rs");
    if rust {
        let lines = text.lines().take_while(|line| line.trim() != "#[cfg(test)]").count();
        // Files of tests only are as long as they need to be.
        if !shown.contains("/tests/") && !shown.ends_with("tests.rs") {
            if lines > TOO_LONG {
                found.problems.push(format!("{shown}: {lines} lines before its tests, more than {TOO_LONG}: split it"));
            } else if lines > LONG {
                found.notes.push(format!("{shown}: {lines} lines before its tests"));
            }
        }
    }
    let library = shown.starts_with("crates/") && !shown.starts_with("crates/cv-cli/") && shown.contains("/src/");
    if rust && library {
        for number in options_in_text::lines(text) {
            found.problems.push(format!(
                "{shown}:{number}: a library names an option or a command of the program: put the numbers into its error, the words into cv-cli"
            ));
        }
    }
    // Written in two halves, so that this file does not find itself.
    let unfinished =
        [["TO", "DO"], ["FIX", "ME"], ["to", "do!("], ["unimple", "mented!("]].map(|halves| halves.concat());
    let paths =
        [["/wo", "rk/"], ["/ho", "me/"], ["/ro", "ot/"], ["/Use", "rs/"], ["C:", "\\"]].map(|halves| halves.concat());
    let unstable = [["Std", "Rng"], ["thread", "_rng"]].map(|halves| halves.concat());
    let clock = ["Instant", "::now()"].concat();
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
        if rust && clockless(shown) && line.contains(&clock) {
            complain("a clock outside cv_core::StageClock: it panics in a browser");
        }
        if rust && line.trim() == "#[ignore]" {
            complain("an ignored test without its reason");
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_workspace_is_tidy() {
        let found = check(crate::root()).unwrap();
        assert!(found.problems.is_empty(), "{:#?}", found.problems);
    }

    /// A workspace with one crate, `cv-stereo`, whose files the test chooses.
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
        let mut problems = check(root.path()).unwrap().problems;
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
        let late = format!("{LIB}let t = {}{};\n", "Instant", "::now()");
        type Case<'a> = (&'a str, String, &'a [(&'a str, &'a str)]);
        let cases: [Case; 12] = [
            ("lacks `[lints]", GOOD.replace("true\n[dep", "false\n[dep"), &[("src/lib.rs", LIB)]),
            ("must not use cv-features", format!("{GOOD}cv-features.workspace = true\n"), &[("src/lib.rs", LIB)]),
            ("must not use image", format!("{GOOD}image.workspace = true\n"), &[("src/lib.rs", LIB)]),
            ("names its own version", format!("{GOOD}toml = \"1\"\n"), &[("src/lib.rs", LIB)]),
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
            ("a clock outside", GOOD.to_owned(), &[("src/lib.rs", &late)]),
            ("a path of one machine", GOOD.to_owned(), &[("src/lib.rs", LIB), ("notes.md", concat!("/ho", "me/x\n"))]),
        ];
        for (expected, manifest, files) in cases {
            let found = problems(&manifest, files);
            assert!(found.iter().any(|problem| problem.contains(expected)), "{expected}: {found:?}");
        }
        let long = LIB.to_owned() + &"\n".repeat(TOO_LONG);
        assert!(problems(GOOD, &[("src/lib.rs", &long)])[0].contains("split it"));
        let tested = format!("{LIB}#[cfg(test)]\n{}", "\n".repeat(TOO_LONG));
        assert_eq!(problems(GOOD, &[("src/lib.rs", &tested)]), [""; 0]);
    }

    #[test]
    fn a_name_inside_another_is_not_a_use() {
        assert!(mentions("use rand::Rng;", "rand") && mentions("    rand_chacha::x()", "rand_chacha"));
        assert!(!mentions("let operand = 1;", "rand") && !mentions("use operand::x;", "rand"));
    }
}
