//! Damaged inputs to every command: each run ends by itself with a message, within limits of time and memory, and leaves no incomplete file.

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

/// Largest address space of a run in KiB: 2 GiB.
const MAX_ADDRESS_SPACE_KIB: u64 = 2 << 20;
const MAX_DURATION: Duration = Duration::from_secs(10);

/// Numbers of runs of a command by outcome, and the longest duration.
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
    let failing_inputs = crate::root().join("target/corrupt");
    // Only commands with inputs.
    let cases: Vec<_> = CASES.iter().filter(|case| !case.inputs.is_empty()).collect();
    let (mut tallies, mut failures): (Vec<Tally>, u64) = (cases.iter().map(|_| Tally::default()).collect(), 0);
    for case in CASES {
        let (code, stderr, _) = run_within_limits(&program, folder.path(), case)?;
        anyhow::ensure!(code == Some(0), "{} fails on intact inputs: {stderr}", case.name);
    }
    for i in 0..count {
        let which = i as usize % cases.len();
        let case = cases[which];
        let input = case.inputs[i as usize / cases.len() % case.inputs.len()];
        let path = folder.path().join("in").join(input);
        let intact = fs::read(&path).with_context(|| path.display().to_string())?;
        let seed = options.seed.wrapping_mul(1 << 32).wrapping_add(i);
        fs::write(&path, cv_synth::corrupt(&intact, seed))?;
        let (problems, duration, code) = run_and_check(&program, folder.path(), case)?;
        let tally = &mut tallies[which];
        match code {
            Some(0) => tally.done += 1,
            Some(2) => tally.usage += 1,
            _ => tally.refused += 1,
        }
        tally.slowest = tally.slowest.max(duration);
        for problem in &problems {
            failures += 1;
            println!("FAILURE: {} with {input}, run {i}: {problem}; saved to {}", case.name, failing_inputs.display());
            fs::create_dir_all(&failing_inputs)?;
            fs::copy(&path, failing_inputs.join(format!("{i}-{}", input.replace('/', "-"))))?;
        }
        fs::write(&path, intact)?;
    }
    println!("{:28} {:>8} {:>8} {:>8} {:>10}", "command", "exit 0", "exit 1", "exit 2", "slowest");
    for (case, tally) in cases.iter().zip(&tallies) {
        let Tally { done, refused, usage, slowest } = tally;
        println!("{:28} {done:8} {refused:8} {usage:8} {:8.2} s", case.name, slowest.as_secs_f64());
    }
    println!(
        "{count} runs, {failures} failures (limits of a run: {} s, {} MiB)",
        MAX_DURATION.as_secs(),
        MAX_ADDRESS_SPACE_KIB >> 10
    );
    Ok(failures == 0)
}

/// Runs a command on the current files of `in/`; returns its violations of the rules, its duration and its exit code.
fn run_and_check(program: &Path, folder: &Path, case: &Case) -> Result<(Vec<String>, Duration, Option<i32>)> {
    let out = folder.join("out");
    fs::remove_dir_all(&out)?;
    fs::create_dir(&out)?;
    for file in case.files() {
        fs::write(folder.join(file), "old\n")?;
    }
    let before = cases::snapshot(&folder.join("in"))?;
    let (code, stderr, duration) = run_within_limits(program, folder, case)?;
    let mut problems = Vec::new();
    if !matches!(code, Some(0..=2)) {
        problems.push(format!("exit code {code:?} after {:.1} s: {stderr}", duration.as_secs_f64()));
    }
    if stderr.contains("panicked") || stderr.contains("internal error") {
        problems.push(stderr.clone());
    }
    if code != Some(0) && !stderr.contains("error: ") {
        problems.push(format!("no message: {stderr}"));
    }
    if cases::snapshot(&folder.join("in"))? != before {
        problems.push("inputs were changed".to_owned());
    }
    for (path, bytes) in cases::snapshot(&out)? {
        let is_output = case.files().any(|file| folder.join(file) == path);
        match (is_output, code == Some(0)) {
            (true, false) if bytes != b"old\n" => {
                problems.push(format!("{} was changed by a failed run", path.display()))
            }
            (true, false) => {}
            (true, true) if bytes == b"old\n" => problems.push(format!("{} was not written", path.display())),
            _ => problems.extend(cases::find_problem(&path, &bytes)),
        }
    }
    if fs::read_dir(folder)?.count() != 2 {
        problems.push("an additional file".to_owned());
    }
    Ok((problems, duration, code))
}

/// Runs a command under the limits; returns exit code, stderr and duration.
fn run_within_limits(program: &Path, folder: &Path, case: &Case) -> Result<(Option<i32>, String, Duration)> {
    let log = folder.with_extension("log");
    let start = Instant::now();
    let mut child = Command::new("sh")
        .args(["-c", &format!("ulimit -v {MAX_ADDRESS_SPACE_KIB}; exec \"$0\" \"$@\"")])
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
        if start.elapsed() > MAX_DURATION {
            child.kill()?;
            break child.wait()?;
        }
        sleep(Duration::from_millis(1));
    };
    let duration = start.elapsed();
    let stderr = String::from_utf8_lossy(&fs::read(&log)?).into_owned();
    fs::remove_file(&log)?;
    Ok((status.code(), stderr, duration))
}
