//! Names of public types.

use super::Found;
use anyhow::Result;
use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
};

/// Checks that the names of public types are unique over all crates.
pub(super) fn check_type_names(root: &Path, files: &[PathBuf], found: &mut Found) -> Result<()> {
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
