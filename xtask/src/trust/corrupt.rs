//! Damaged inputs to every command: each run ends by itself with a message, within bounds, and leaves no half of a file behind.

use super::{Options, cases, program};
use anyhow::{Context, Result};
use cases::{CASES, Case};
use std::{
    fs,
    path::Path,
    process::{Command, Stdio},
    thread::sleep,
    time::{Duration, Instant},
};

/// Address space of a run in KiB: 2 GiB.
const MEMORY: u64 = 2 << 20;
const TIME: Duration = Duration::from_secs(10);

/// What the runs of a command came to.
#[derive(Default)]
struct Tally {
    done: u64,
    refused: u64,
    usage: u64,
    slowest: Duration,
}

pub(super) fn run(options: &Options) -> Result<bool> {
    let count = options.count.unwrap_or(10_000);
    let program = program()?;
    let folder = tempfile::tempdir()?;
    cases::prepare(folder.path(), &program)?;
    let kept = crate::root().join("target/corrupt");
    // A command that reads nothing has nothing to damage.
    let cases: Vec<_> = CASES.iter().filter(|case| !case.inputs.is_empty()).collect();
    let (mut tallies, mut finds): (Vec<Tally>, u64) = (cases.iter().map(|_| Tally::default()).collect(), 0);
    for case in CASES {
        let (code, stderr, _) = ran(&program, folder.path(), case)?;
        anyhow::ensure!(code == Some(0), "{} fails on whole inputs: {stderr}", case.name);
    }
    for i in 0..count {
        let which = i as usize % cases.len();
        let case = cases[which];
        let input = case.inputs[i as usize / cases.len() % case.inputs.len()];
        let path = folder.path().join("in").join(input);
        let whole = fs::read(&path).with_context(|| path.display().to_string())?;
        let seed = options.seed.wrapping_mul(1 << 32).wrapping_add(i);
        fs::write(&path, cv_synth::corrupt(&whole, seed))?;
        let (found, took, code) = one(&program, folder.path(), case)?;
        let tally = &mut tallies[which];
        match code {
            Some(0) => tally.done += 1,
            Some(2) => tally.usage += 1,
            _ => tally.refused += 1,
        }
        tally.slowest = tally.slowest.max(took);
        for what in &found {
            finds += 1;
            println!("FOUND: {} with {input}, run {i}: {what}; kept in {}", case.name, kept.display());
            fs::create_dir_all(&kept)?;
            fs::copy(&path, kept.join(format!("{i}-{}", input.replace('/', "-"))))?;
        }
        fs::write(&path, whole)?;
    }
    println!("{:28} {:>8} {:>8} {:>8} {:>10}", "command", "exit 0", "exit 1", "exit 2", "slowest");
    for (case, tally) in cases.iter().zip(&tallies) {
        let Tally { done, refused, usage, slowest } = tally;
        println!("{:28} {done:8} {refused:8} {usage:8} {:8.2} s", case.name, slowest.as_secs_f64());
    }
    println!("{count} runs, {finds} finds (none may take more than {} s or {} MiB)", TIME.as_secs(), MEMORY >> 10);
    Ok(finds == 0)
}

/// What a command does wrong on what is in `in/` now, the time it took, and its exit code.
fn one(program: &Path, folder: &Path, case: &Case) -> Result<(Vec<String>, Duration, Option<i32>)> {
    let out = folder.join("out");
    fs::remove_dir_all(&out)?;
    fs::create_dir(&out)?;
    for file in case.files() {
        fs::write(folder.join(file), "old\n")?;
    }
    let before = cases::snapshot(&folder.join("in"))?;
    let (code, stderr, took) = ran(program, folder, case)?;
    let mut found = Vec::new();
    if !matches!(code, Some(0..=2)) {
        found.push(format!("exit code {code:?} after {:.1} s: {stderr}", took.as_secs_f64()));
    }
    if stderr.contains("panicked") || stderr.contains("internal error") {
        found.push(stderr.clone());
    }
    if code != Some(0) && !stderr.contains("error: ") {
        found.push(format!("no message: {stderr}"));
    }
    if cases::snapshot(&folder.join("in"))? != before {
        found.push("inputs were changed".to_owned());
    }
    for (path, bytes) in cases::snapshot(&out)? {
        let file = case.files().any(|file| folder.join(file) == path);
        match (file, code == Some(0)) {
            (true, false) if bytes != b"old\n" => {
                found.push(format!("{} was changed by a run that failed", path.display()))
            }
            (true, false) => {}
            (true, true) if bytes == b"old\n" => found.push(format!("{} was not written", path.display())),
            _ => found.extend(cases::fault(&path, &bytes)),
        }
    }
    if fs::read_dir(folder)?.count() != 2 {
        found.push("a stray file".to_owned());
    }
    Ok((found, took, code))
}

/// Exit code, stderr and time of a run within bounds.
fn ran(program: &Path, folder: &Path, case: &Case) -> Result<(Option<i32>, String, Duration)> {
    let log = folder.with_extension("log");
    let start = Instant::now();
    let mut child = Command::new("sh")
        .args(["-c", &format!("ulimit -v {MEMORY}; exec \"$0\" \"$@\"")])
        .arg(program)
        .args(case.args())
        .args(["--threads", "2"])
        .current_dir(folder)
        .stdin(Stdio::null())
        .stdout(Stdio::null())
        .stderr(fs::File::create(&log)?)
        .spawn()
        .context("cannot start the program")?;
    let status = loop {
        if let Some(status) = child.try_wait()? {
            break status;
        }
        if start.elapsed() > TIME {
            child.kill()?;
            break child.wait()?;
        }
        sleep(Duration::from_millis(1));
    };
    let took = start.elapsed();
    let stderr = String::from_utf8_lossy(&fs::read(&log)?).into_owned();
    fs::remove_file(&log)?;
    Ok((status.code(), stderr, took))
}
