//! What commands write: whole or not at all, the same on any number of threads, and nothing besides.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use std::{
    fs,
    process::Stdio,
    time::{Duration, Instant},
};
use support::{JOBS, cv, done, json, refused, run, snapshot, strs};

#[test]
fn json_is_one_object_and_stdout_is_empty_without_it() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs);
        let value = json(folder.path(), &strs(&args));
        let seconds = value["seconds"].as_object().unwrap();
        let total = seconds["total"].as_f64().unwrap();
        let stages: f64 = seconds.iter().filter(|(name, _)| *name != "total").map(|(_, s)| s.as_f64().unwrap()).sum();
        // Stages are parts of the whole; 1 % for the clock being read at slightly different moments.
        assert!(stages <= 1.01 * total, "{}: {seconds:?}", job.name);
        let ran = done(folder.path(), &strs(&args));
        assert_eq!(ran.stdout, "", "{}", job.name);
        assert!(!ran.stderr.is_empty(), "{}: a person should hear what happened", job.name);
        let quiet = done(folder.path(), &[&strs(&args)[..], &["--quiet"]].concat());
        assert_eq!((quiet.stdout.as_str(), quiet.stderr.as_str()), ("", ""), "{}", job.name);
    }
}

#[test]
fn threads_change_neither_the_files_nor_the_figures() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let results = ["1", "2", "3"].map(|threads| {
            let args = job.args(&inputs);
            let args = [&strs(&args)[..], &["--threads", threads]].concat();
            let mut value = json(folder.path(), &args);
            for key in ["seconds", "threads"] {
                value.as_object_mut().unwrap().remove(key);
            }
            (job.written(folder.path()), value)
        });
        assert!(results[0] == results[1] && results[0] == results[2], "{}", job.name);
    }
}

#[test]
fn the_same_seed_gives_the_same_files() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs);
        let args = [&strs(&args)[..], &["--seed", "12345"]].concat();
        if !job.random {
            let ran = run(folder.path(), &args);
            assert!(ran.code == Some(2) && ran.stderr.contains("--seed means nothing here"), "{}: {ran:?}", job.name);
            continue;
        }
        let results = [0, 1].map(|_| {
            done(folder.path(), &args);
            job.written(folder.path())
        });
        assert!(results[0] == results[1], "{}", job.name);
    }
}

#[test]
fn inputs_stay_as_they_are_and_only_outputs_appear() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let before = snapshot(folder.path());
        done(folder.path(), &strs(&job.args(&inputs)));
        let outputs: Vec<_> = job.outputs.iter().map(|name| folder.path().join(name)).collect();
        let is_output = |path: &std::path::Path| outputs.iter().any(|output| path.starts_with(output));
        let mut after = snapshot(folder.path());
        after.retain(|(path, _)| !is_output(path));
        let before: Vec<_> = before.into_iter().filter(|(path, _)| !is_output(path)).collect();
        assert!(before == after, "{}", job.name);
    }
}

#[test]
fn an_output_that_cannot_be_written_is_told_before_the_work() {
    for job in JOBS {
        for output in job.files() {
            let (folder, inputs) = job.folder();
            let mut args = job.args(&inputs);
            let place = args.iter().position(|word| *word == output).unwrap();
            args[place] = format!("no/such/folder/{output}");
            let ran = refused(folder.path(), &strs(&args));
            assert!(ran.stderr.contains("no/such/folder"), "{}: {}", job.name, ran.stderr);
            assert!(!folder.path().join("no").exists(), "{}", job.name);

            args[place] = format!("folder-{output}");
            fs::create_dir(folder.path().join(&args[place])).unwrap();
            let ran = refused(folder.path(), &strs(&args));
            assert!(ran.stderr.contains("folder"), "{}: {}", job.name, ran.stderr);
        }
    }
}

#[cfg(unix)]
#[test]
fn a_read_only_folder_is_refused_and_nothing_appears_in_it() {
    use std::os::unix::fs::PermissionsExt;
    for job in JOBS {
        for output in job.files() {
            let (folder, inputs) = job.folder();
            let closed = folder.path().join("closed");
            fs::create_dir(&closed).unwrap();
            fs::set_permissions(&closed, fs::Permissions::from_mode(0o555)).unwrap();
            let mut args = job.args(&inputs);
            let place = args.iter().position(|word| *word == output).unwrap();
            args[place] = format!("closed/{output}");
            refused(folder.path(), &strs(&args));
            assert_eq!(fs::read_dir(&closed).unwrap().count(), 0, "{}", job.name);
        }
    }
}

#[test]
fn a_failure_keeps_the_outputs_of_the_run_before() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        done(folder.path(), &strs(&job.args(&inputs)));
        fs::write(folder.path().join("cut.png"), b"\x89PNG\r\n\x1a\n").unwrap();
        let before = snapshot(folder.path());
        let mut broken = inputs.clone();
        *broken.last_mut().unwrap() = "cut.png".to_owned();
        refused(folder.path(), &strs(&job.args(&broken)));
        assert!(snapshot(folder.path()) == before, "{}", job.name);
    }
}

/// Kills runs at moments spread over their whole duration.
#[test]
fn a_killed_run_leaves_old_or_new_outputs_and_never_half_of_one() {
    const MOMENTS: u32 = 8;
    for job in JOBS.iter().filter(|job| !job.files().is_empty()) {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs);
        let start = Instant::now();
        done(folder.path(), &strs(&args));
        let whole = start.elapsed();
        let new = job.written(folder.path());
        for moment in 0..MOMENTS {
            for output in job.outputs {
                fs::write(folder.path().join(output), b"old").unwrap();
            }
            let mut child = cv(folder.path()).args(&args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
            std::thread::sleep(whole * moment / (MOMENTS - 2));
            // It may have ended by itself.
            let _ = child.kill();
            child.wait().unwrap();
            for (written, new) in job.written(folder.path()).iter().zip(&new) {
                assert!(written == b"old" || written == new, "{} after {:?}", job.name, whole * moment / MOMENTS);
            }
        }
        // A later run sweeps up what the killed ones may have left, once it is old.
        for entry in fs::read_dir(folder.path()).unwrap().flatten() {
            if entry.file_name().to_string_lossy().starts_with(".cv-") {
                let file = fs::File::options().write(true).open(entry.path()).unwrap();
                file.set_modified(std::time::SystemTime::now() - Duration::from_secs(7200)).unwrap();
            }
        }
        done(folder.path(), &strs(&args));
        let left = fs::read_dir(folder.path()).unwrap().flatten();
        assert_eq!(left.filter(|e| e.file_name().to_string_lossy().starts_with(".cv-")).count(), 0, "{}", job.name);
    }
}

#[test]
fn the_report_is_one_file_that_needs_no_network() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs);
        done(folder.path(), &[&strs(&args)[..], &["--report", "new/report"]].concat());
        let files = snapshot(&folder.path().join("new"));
        assert_eq!(files.len(), 1, "{}", job.name);
        let html = String::from_utf8(files[0].1.clone()).unwrap();
        assert!(files[0].0.ends_with("report.html") && html.starts_with("<!doctype html>"), "{}", job.name);
        for outside in ["src=\"http", "href=\"http", "@import", "src=\"//"] {
            assert!(!html.contains(outside), "{}: {outside}", job.name);
        }
        assert!(html.contains("data:image/") || html.contains("<svg"), "{}: no pictures", job.name);
    }
}
