//! Third-party packages: number, source and license, against the lists of `deny.toml`; `cargo deny` reads the same lists and also
//! checks advisories, which requires the network.

use super::Found;
use super::manifests::table;
use anyhow::{Context, Result, bail, ensure};
use serde::Deserialize;
use serde_json::Value;
use std::{path::Path, process::Command};

/// Maximum number of packages in `Cargo.lock`. 12 of them are for Python only.
const MAX_PACKAGES: usize = 187;

/// Checks `Cargo.lock`, and the packages compiled on this machine, against `deny.toml`.
pub(super) fn check(root: &Path, found: &mut Found) -> Result<()> {
    let deny = Deny::deserialize(Value::Object(table(&root.join("deny.toml"))?)).context("deny.toml")?;
    let lock = Lock::deserialize(Value::Object(table(&root.join("Cargo.lock"))?)).context("Cargo.lock")?;
    check_lock(&lock, &deny, found);
    check_licenses(&compiled_packages(root)?, &deny, found);
    Ok(())
}

#[derive(Deserialize)]
struct Lock {
    package: Vec<Package>,
}

#[derive(Deserialize)]
struct Package {
    name: String,
    version: String,
    /// None for the crates of the workspace.
    source: Option<String>,
    /// Not in `Cargo.lock`.
    license: Option<String>,
}

#[derive(Deserialize)]
struct Deny {
    licenses: Licenses,
    bans: Bans,
    sources: Sources,
}

#[derive(Deserialize)]
struct Licenses {
    allow: Vec<String>,
    exceptions: Vec<Exception>,
}

#[derive(Deserialize)]
struct Exception {
    #[serde(rename = "crate")]
    name: String,
    allow: Vec<String>,
}

#[derive(Deserialize)]
struct Bans {
    deny: Vec<Ban>,
}

#[derive(Deserialize)]
struct Ban {
    #[serde(rename = "crate")]
    name: String,
    /// Whether only a second version is refused.
    #[serde(default, rename = "deny-multiple-versions")]
    allows_one: bool,
}

#[derive(Deserialize)]
struct Sources {
    #[serde(rename = "allow-registry")]
    allow_registry: Vec<String>,
}

fn check_lock(lock: &Lock, deny: &Deny, found: &mut Found) {
    let count = lock.package.len();
    found.notes.push(format!("Cargo.lock has {count} packages, of at most {MAX_PACKAGES}"));
    if count > MAX_PACKAGES {
        found.problems.push(format!("Cargo.lock has {count} packages, more than {MAX_PACKAGES}"));
    }
    for ban in &deny.bans.deny {
        let versions: Vec<&str> =
            lock.package.iter().filter(|package| package.name == ban.name).map(|p| p.version.as_str()).collect();
        if versions.len() > usize::from(ban.allows_one) {
            found.problems.push(format!("Cargo.lock: {} {} is refused by deny.toml", ban.name, versions.join(", ")));
        }
    }
    for package in &lock.package {
        let Some(source) = &package.source else { continue };
        if !deny.sources.allow_registry.iter().any(|registry| source.strip_prefix("registry+") == Some(registry)) {
            found.problems.push(format!("Cargo.lock: {} comes from {source}", package.name));
        }
    }
}

fn check_licenses(packages: &[Package], deny: &Deny, found: &mut Found) {
    for package in packages {
        let exceptions = deny.licenses.exceptions.iter().filter(|exception| exception.name == package.name);
        let allowed: Vec<&str> = deny
            .licenses
            .allow
            .iter()
            .chain(exceptions.flat_map(|exception| &exception.allow))
            .map(String::as_str)
            .collect();
        let license = package.license.as_deref().unwrap_or("none");
        if !permits(license, &allowed) {
            found.problems.push(format!("{} {}: its license is {license}", package.name, package.version));
        }
    }
}

/// Returns the packages of `Cargo.lock` that are compiled on this machine.
fn compiled_packages(root: &Path) -> Result<Vec<Package>> {
    #[derive(Deserialize)]
    struct Metadata {
        packages: Vec<Package>,
    }
    let output = |command: &mut Command| -> Result<String> {
        let output = command.current_dir(root).output().with_context(|| format!("{command:?}"))?;
        ensure!(output.status.success(), "{command:?}: {}", String::from_utf8_lossy(&output.stderr));
        Ok(String::from_utf8(output.stdout)?)
    };
    let version = output(Command::new("rustc").arg("-vV"))?;
    let Some(host) = version.lines().find_map(|line| line.strip_prefix("host: ")) else { bail!("rustc has no host") };
    let cargo = std::env::var_os("CARGO").unwrap_or("cargo".into());
    let arguments = ["metadata", "--format-version", "1", "--locked", "--filter-platform", host];
    let metadata: Metadata = serde_json::from_str(&output(Command::new(cargo).args(arguments))?)?;
    Ok(metadata.packages)
}

/// Returns whether an SPDX expression is satisfied by the allowed licenses.
fn permits(expression: &str, allowed: &[&str]) -> bool {
    // The deprecated separator of alternatives.
    let spaced = expression.replace('/', " OR ").replace('(', " ( ").replace(')', " ) ");
    let words: Vec<&str> = spaced.split_whitespace().collect();
    let (met, rest) = parse_or(&words, allowed);
    met && rest.is_empty()
}

/// Parses an expression with OR; returns whether it is satisfied and the remaining words.
fn parse_or<'a, 'b>(words: &'a [&'b str], allowed: &[&str]) -> (bool, &'a [&'b str]) {
    let (mut met, mut rest) = parse_and(words, allowed);
    while let ["OR", after @ ..] = rest {
        let (other, after) = parse_and(after, allowed);
        (met, rest) = (met | other, after);
    }
    (met, rest)
}

/// Parses an expression with AND; returns whether it is satisfied and the remaining words.
fn parse_and<'a, 'b>(words: &'a [&'b str], allowed: &[&str]) -> (bool, &'a [&'b str]) {
    let (mut met, mut rest) = parse_term(words, allowed);
    while let ["AND", after @ ..] = rest {
        let (other, after) = parse_term(after, allowed);
        (met, rest) = (met & other, after);
    }
    (met, rest)
}

/// Parses a license, a license with an exception, or an expression in parentheses.
fn parse_term<'a, 'b>(words: &'a [&'b str], allowed: &[&str]) -> (bool, &'a [&'b str]) {
    match words {
        ["(", inner @ ..] => match parse_or(inner, allowed) {
            (met, [")", rest @ ..]) => (met, rest),
            (_, rest) => (false, rest),
        },
        [license, "WITH", exception, rest @ ..] => {
            (allowed.contains(&format!("{license} WITH {exception}").as_str()), rest)
        }
        [license, rest @ ..] => (allowed.contains(license), rest),
        [] => (false, words),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn license_expressions_are_evaluated() {
        let allowed = ["MIT", "Zlib", "Apache-2.0 WITH LLVM-exception"];
        for good in
            ["MIT", "GPL-3.0 OR MIT", "MIT/Apache-2.0", "(MIT OR GPL-3.0) AND Zlib", "Apache-2.0 WITH LLVM-exception"]
        {
            assert!(permits(good, &allowed), "{good}");
        }
        for bad in ["", "none", "Apache-2.0", "MIT AND GPL-3.0", "(MIT", "MIT MIT", "(MIT OR GPL-3.0) AND Apache-2.0"] {
            assert!(!permits(bad, &allowed), "{bad}");
        }
    }

    #[test]
    fn each_rule_can_fail() {
        let deny: Deny = basic_toml::from_str(
            "[licenses]\nallow = [\"MIT\"]\nexceptions = [{ crate = \"a\", allow = [\"IJG\"] }]\n\
             [bans]\ndeny = [{ crate = \"cc\" }, { crate = \"once\", deny-multiple-versions = true }]\n\
             [sources]\nallow-registry = [\"https://crates\"]\n",
        )
        .unwrap();
        let package = |name: &str, source: Option<&str>, license: Option<&str>| Package {
            name: name.to_owned(),
            version: "1.0.0".to_owned(),
            source: source.map(str::to_owned),
            license: license.map(str::to_owned),
        };
        let locked = |names: &[&str]| {
            let package = names.iter().map(|name| package(name, Some("registry+https://crates"), None)).collect();
            let mut found = Found::default();
            check_lock(&Lock { package }, &deny, &mut found);
            found.problems
        };
        assert_eq!(locked(&["a", "once"]), [""; 0]);
        assert!(locked(&["cc"])[0].contains("refused"));
        assert!(locked(&["once", "once"])[0].contains("refused"));
        assert!(locked(&["a"; MAX_PACKAGES + 1])[0].contains("more than"));
        let mut found = Found::default();
        check_lock(&Lock { package: vec![package("a", Some("git+https://crates"), None)] }, &deny, &mut found);
        assert!(found.problems[0].contains("comes from"));
        let licensed =
            [package("a", None, Some("IJG AND MIT")), package("b", None, Some("IJG")), package("c", None, None)];
        let mut found = Found::default();
        check_licenses(&licensed, &deny, &mut found);
        assert_eq!(found.problems, ["b 1.0.0: its license is IJG", "c 1.0.0: its license is none"]);
    }
}
