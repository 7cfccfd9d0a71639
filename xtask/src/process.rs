//! Programs that chores start.

use anyhow::{Context, Result, ensure};
use std::process::Command;

/// Runs a program to its end.
///
/// # Errors
///
/// If it cannot be started or its exit status is not zero.
pub(crate) fn check(command: &mut Command) -> Result<()> {
    let status = command.status().with_context(|| format!("cannot start {command:?}"))?;
    ensure!(status.success(), "{command:?} failed: {status}");
    Ok(())
}
