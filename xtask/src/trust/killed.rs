//! Runs that are killed at random moments: what was there before stays whole, and the next run leaves nothing stray behind.

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
    let (mut finds, mut alive, mut left) = (0, 0, 0);
    for (i, case) in writing.iter().enumerate() {
        let kills = count / writing.len() as u64 + u64::from((i as u64) < count % writing.len() as u64);
        let start = Instant::now();
        ensure!(command(case).status()?.success(), "{} fails", case.name);
        let whole = start.elapsed();
        let new = cases::snapshot(&out)?;
        for _ in 0..kills {
            for file in case.files() {
                fs::write(folder.path().join(file), "old\n")?;
            }
            let mut child = command(case).spawn()?;
            // As likely near the end, where files are written, as anywhere.
            let share = f64::from(rng.next_u32()) / f64::from(u32::MAX);
            let share = if rng.next_u32().is_multiple_of(2) { share } else { 1.0 - 0.2 * share };
            sleep(whole.mul_f64(share));
            // It may have ended by itself.
            let _ = child.kill();
            alive += u64::from(child.wait()?.code().is_none());
            for (path, bytes) in cases::snapshot(&out)? {
                if cases::is_temporary(&path) {
                    left += 1;
                    continue;
                }
                let html = path.extension().is_some_and(|ending| ending == "html");
                let known = new.iter().any(|(other, new)| *other == path && (*new == bytes || html));
                if let Some(what) =
                    (bytes != b"old\n" && !known).then(|| format!("{} is neither old nor new", path.display()))
                {
                    finds += 1;
                    println!("FOUND: {}: {what}", case.name);
                }
            }
        }
        ensure!(command(case).status()?.success(), "{} fails", case.name);
        for (path, bytes) in cases::snapshot(&out)? {
            if let Some(what) = cases::fault(&path, &bytes) {
                finds += 1;
                println!("FOUND: {}, after the run that followed: {what}", case.name);
            }
        }
        fs::remove_dir_all(&out)?;
        fs::create_dir(&out)?;
    }
    println!(
        "{count} kills, {alive} while the run was at work; {left} temporary files were left and swept up by the next run; {finds} finds"
    );
    Ok(finds == 0)
}
