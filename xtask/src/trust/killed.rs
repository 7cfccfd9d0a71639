//! Kills runs at random times: existing outputs stay complete, and the next run removes all temporary files.

use super::{Options, cases, program};
use anyhow::{Result, ensure};
use rand_chacha::{
    ChaCha8Rng,
    rand_core::{Rng, SeedableRng},
};
use std::{
    fs,
    process::{Command, Stdio},
    thread::sleep,
    time::Instant,
};

pub(super) fn run(options: &Options) -> Result<bool> {
    let count = options.count.unwrap_or(200);
    let program = program()?;
    let folder = tempfile::tempdir()?;
    cases::prepare(folder.path(), &program)?;
    let mut rng = ChaCha8Rng::seed_from_u64(options.seed);
    let out = folder.path().join("out");
    let writing: Vec<_> = cases::CASES.iter().filter(|case| case.args.contains("out")).collect();
    let command = |case: &cases::Case| {
        let mut command = Command::new(&program);
        command.current_dir(folder.path()).args(case.args()).stdout(Stdio::null()).stderr(Stdio::null());
        command
    };
    let (mut failures, mut running, mut temporary) = (0, 0, 0);
    for (i, case) in writing.iter().enumerate() {
        let kills = count / writing.len() as u64 + u64::from((i as u64) < count % writing.len() as u64);
        let start = Instant::now();
        ensure!(command(case).status()?.success(), "{} fails", case.name);
        let duration = start.elapsed();
        let new_files = cases::snapshot(&out)?;
        for _ in 0..kills {
            for file in case.files() {
                fs::write(folder.path().join(file), "old\n")?;
            }
            let mut child = command(case).spawn()?;
            // Half of the kills are in the last fifth of the duration, where files are written.
            let fraction = f64::from(rng.next_u32()) / f64::from(u32::MAX);
            let fraction = if rng.next_u32().is_multiple_of(2) { fraction } else { 1.0 - 0.2 * fraction };
            sleep(duration.mul_f64(fraction));
            // The run may have ended before.
            let _ = child.kill();
            running += u64::from(child.wait()?.code().is_none());
            for (path, bytes) in cases::snapshot(&out)? {
                if cases::is_temporary(&path) {
                    temporary += 1;
                    continue;
                }
                let is_html = path.extension().is_some_and(|extension| extension == "html");
                let is_complete = new_files.iter().any(|(other, new)| *other == path && (*new == bytes || is_html));
                if let Some(problem) = (bytes != b"old\n" && !is_complete)
                    .then(|| format!("{} is neither the old nor the new file", path.display()))
                {
                    failures += 1;
                    println!("FAILURE: {}: {problem}", case.name);
                }
            }
        }
        ensure!(command(case).status()?.success(), "{} fails", case.name);
        for (path, bytes) in cases::snapshot(&out)? {
            if let Some(problem) = cases::find_problem(&path, &bytes) {
                failures += 1;
                println!("FAILURE: {}, after the next run: {problem}", case.name);
            }
        }
        fs::remove_dir_all(&out)?;
        fs::create_dir(&out)?;
    }
    println!(
        "{count} kills, {running} during a run; {temporary} temporary files were left and removed by the next run; {failures} failures"
    );
    Ok(failures == 0)
}
