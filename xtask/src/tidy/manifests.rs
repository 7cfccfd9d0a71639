//! Rules of the manifests: allowed dependencies between crates, and required entries of every `Cargo.toml`.

use super::{Found, walk};
use anyhow::{Context, Result};
use serde::Deserialize;
use serde_json::{Map, Value};
use std::{collections::BTreeMap, fs, path::Path};

/// The lowest tier of programs; crates below are libraries.
const FIRST_PROGRAM_TIER: u8 = 5;

/// The top-level keys and values of a TOML file.
pub(super) type Table = Map<String, Value>;

/// Contents of `tiers.toml`.
#[derive(Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(super) struct Rules {
    pub(super) crates: BTreeMap<String, CrateRule>,
    only_in: BTreeMap<String, Vec<String>>,
    unsafe_code: Vec<String>,
}

#[derive(Deserialize)]
pub(super) struct CrateRule {
    tier: u8,
    uses: Vec<String>,
}

/// Returns the rules of `tiers.toml`.
pub(super) fn rules() -> Result<Rules> {
    basic_toml::from_str(include_str!("../tiers.toml")).context("tiers.toml")
}

/// Reads a TOML file.
pub(super) fn table(path: &Path) -> Result<Table> {
    basic_toml::from_str(&fs::read_to_string(path)?).with_context(|| path.display().to_string())
}

/// Checks that the allowed dependencies in `tiers.toml` go to lower tiers.
pub(super) fn check_tiers(rules: &Rules, found: &mut Found) {
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

pub(super) fn name(manifest: &Table) -> String {
    manifest.get("package").and_then(|package| package.get("name")).and_then(Value::as_str).unwrap_or("").to_owned()
}

pub(super) fn check_manifest(
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
    let lints = manifest.get("lints");
    if rules.unsafe_code.contains(&name) {
        let documented = lints.and_then(|v| v.get("clippy")).and_then(|v| v.get("undocumented_unsafe_blocks"));
        if documented.and_then(Value::as_str) != Some("deny") {
            found.problems.push(format!("{name}: Cargo.toml does not deny `clippy::undocumented_unsafe_blocks`"));
        }
    } else if !inherits(lints) {
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
        for (dependency, value) in manifest.get(section).and_then(Value::as_object).into_iter().flatten() {
            used.push(dependency.clone());
            if !inherits(Some(value)) {
                found.problems.push(format!("{name}: {dependency} names its own version, not the workspace's"));
            }
            if !dev && rule.tier < FIRST_PROGRAM_TIER && selects_features(value) {
                found.problems.push(format!(
                    "{name}: {dependency} with features of its own: name them in the workspace's dependencies, so that the libraries \
                     build alone as they do together"
                ));
            }
            if rules.crates.contains_key(dependency) {
                let allowed = rule.uses.iter().any(|used| used == dependency || used == "*");
                // Ground truth for tests; cv-synth itself depends only on cv-core, so there is no cycle.
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
                // Packages whose library has another name.
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

/// Returns whether a dependency enables or disables features beside those of the workspace's definition.
fn selects_features(dependency: &Value) -> bool {
    ["features", "default-features"].iter().any(|key| dependency.get(key).is_some())
}

/// Returns the text of a Rust file, or of all Rust files in a folder; empty if there is none.
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

/// Returns whether the text contains the crate's name as the start of a path, in a `use`, or in an attribute.
fn mentions(text: &str, import: &str) -> bool {
    text.lines().any(|line| {
        line.match_indices(import).any(|(at, _)| {
            let before = line[..at].chars().next_back();
            let after = line[at + import.len()..].trim_start();
            let is_whole_word = !before.is_some_and(|c| c.is_alphanumeric() || c == '_');
            is_whole_word
                && (after.starts_with("::")
                    || after.starts_with(';')
                    || after.starts_with("]")
                    || after.starts_with(" as "))
        })
    })
}

/// Lists the files under `src` without a `mod` line.
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dependency_with_features_of_its_own_is_found() {
        let manifest: Table = basic_toml::from_str(
            "plain.workspace = true\n\
             optional = { workspace = true, optional = true }\n\
             more = { workspace = true, features = [\"std\"] }\n\
             less = { workspace = true, default-features = false }",
        )
        .unwrap();
        let found: Vec<_> =
            manifest.iter().filter(|(_, value)| selects_features(value)).map(|(name, _)| name.as_str()).collect();
        assert_eq!(found, ["less", "more"]);
    }

    #[test]
    fn a_name_inside_another_is_not_a_use() {
        assert!(mentions("use rand::Rng;", "rand") && mentions("    rand_chacha::x()", "rand_chacha"));
        assert!(!mentions("let operand = 1;", "rand") && !mentions("use operand::x;", "rand"));
    }
}
