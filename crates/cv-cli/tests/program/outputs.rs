//! Outputs of commands: complete or not written at all, the same with any number of threads, and no other files.

use crate::support::{JOBS, cv, done, json, refused, run, snapshot, strs};
use std::{fs, process::Stdio, time::Instant};

#[test]
fn json_is_one_object_and_stdout_is_empty_without_it() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs);
        let value = json(folder.path(), &strs(&args));
        let seconds = value["seconds"].as_object().unwrap();
        let total = seconds["total"].as_f64().unwrap();
        let stages: f64 = seconds.iter().filter(|(name, _)| *name != "total").map(|(_, s)| s.as_f64().unwrap()).sum();
        // Stages are parts of the total; 1 % for the time between clock readings.
        assert!(stages <= 1.01 * total, "{}: {seconds:?}", job.name);
        let ran = done(folder.path(), &strs(&args));
        assert_eq!(ran.stdout, "", "{}", job.name);
        assert!(!ran.stderr.is_empty(), "{}: a person should hear what happened", job.name);
        let quiet = done(folder.path(), &[&strs(&args)[..], &["--quiet"]].concat());
        assert_eq!((quiet.stdout.as_str(), quiet.stderr.as_str()), ("", ""), "{}", job.name);
    }
}

#[test]
fn the_thread_count_changes_neither_files_nor_figures() {
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
            assert!(ran.code == Some(2) && ran.stderr.contains("--seed has no effect here"), "{}: {ran:?}", job.name);
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
fn inputs_are_unchanged_and_only_outputs_are_created() {
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
fn an_unwritable_output_is_reported_before_the_computation() {
    for job in JOBS {
        for output in job.files() {
            let (folder, inputs) = job.folder();
            let mut args = job.args(&inputs);
            let place = args.iter().position(|word| *word == output).unwrap();
            fs::write(folder.path().join("file"), "no folder").unwrap();
            args[place] = format!("file/in/{output}");
            let ran = refused(folder.path(), &strs(&args));
            assert!(ran.stderr.contains("file is not a folder"), "{}: {}", job.name, ran.stderr);

            args[place] = format!("folder-{output}");
            fs::create_dir(folder.path().join(&args[place])).unwrap();
            let ran = refused(folder.path(), &strs(&args));
            assert!(ran.stderr.contains("folder"), "{}: {}", job.name, ran.stderr);
        }
    }
}

/// Returns the arguments of a job with its outputs in a folder `new/deep` that does not exist.
fn in_new_folder(args: &[String], outputs: &[&str]) -> Vec<String> {
    let moved = |word: &String| match outputs.iter().any(|output| output.trim_end_matches('/') == word) {
        true => format!("new/deep/{word}"),
        false => word.clone(),
    };
    args.iter().map(moved).collect()
}

#[test]
fn output_folders_are_created_only_by_successful_runs() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let args = in_new_folder(&job.args(&inputs), job.outputs);
        fs::write(folder.path().join("cut.png"), b"\x89PNG\r\n\x1a\n").unwrap();
        let mut broken = inputs.clone();
        *broken.last_mut().unwrap() = "cut.png".to_owned();
        refused(folder.path(), &strs(&in_new_folder(&job.args(&broken), job.outputs)));
        assert!(!folder.path().join("new").exists(), "{}", job.name);
        done(folder.path(), &strs(&args));
        for output in job.outputs {
            assert!(folder.path().join("new/deep").join(output).exists(), "{}: {output}", job.name);
        }
    }
}

#[test]
fn unknown_file_extensions_are_refused_before_the_computation() {
    for job in JOBS {
        for output in job.files() {
            let (folder, inputs) = job.folder();
            let stem = output.split('.').next().unwrap();
            for name in [format!("{stem}.obj"), stem.to_owned()] {
                let mut args = job.args(&inputs);
                let place = args.iter().position(|word| *word == output).unwrap();
                args[place].clone_from(&name);
                let ran = run(folder.path(), &strs(&args));
                let format = output.rsplit('.').next().unwrap();
                let said = ran.stderr.contains(&name) && ran.stderr.contains(&format!(".{format}"));
                assert!(ran.code == Some(2) && said, "{}: {name}: {ran:?}", job.name);
                assert!(!folder.path().join(&name).exists(), "{}", job.name);
            }
        }
    }
}

#[test]
fn one_output_may_be_stdout() {
    for job in JOBS {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs);
        done(folder.path(), &strs(&args));
        let written = job.files().into_iter().map(|name| (name, fs::read(folder.path().join(name)).unwrap()));
        for (output, expected) in written.collect::<Vec<_>>() {
            let mut args = args.clone();
            let place = args.iter().position(|word| *word == output).unwrap();
            args[place] = "-".to_owned();
            let ran = cv(folder.path()).args(&args).output().unwrap();
            let stderr = String::from_utf8_lossy(&ran.stderr);
            assert!(ran.status.success() && ran.stdout == expected, "{}: {output}: {stderr}", job.name);
            assert!(!folder.path().join("-").exists(), "{}", job.name);
            let ran = run(folder.path(), &[&strs(&args)[..], &["--json"]].concat());
            assert!(ran.code == Some(2) && ran.stdout.is_empty(), "{}: {ran:?}", job.name);
            if let Some(other) = args.iter().position(|word| word != output && job.files().contains(&&word[..])) {
                args[other] = "-".to_owned();
                let ran = run(folder.path(), &strs(&args));
                assert!(ran.code == Some(2) && ran.stderr.contains("two outputs"), "{}: {ran:?}", job.name);
            }
        }
    }
    let (folder, inputs) = JOBS[2].folder();
    for option in [["--report", "-"], ["--save-features", "-"]] {
        let ran = run(folder.path(), &[&strs(&JOBS[2].args(&inputs))[..], &option].concat());
        assert!(ran.code == Some(2) && ran.stderr.contains("stdout"), "{option:?}: {ran:?}");
    }
}

#[cfg(unix)]
#[test]
fn outputs_may_be_devices() {
    for (job, outputs) in [(&JOBS[0], ["d.pfm", "cloud.ply"]), (&JOBS[3], ["cloud.ply", "cloud.ply"])] {
        let (folder, inputs) = job.folder();
        let args = job.args(&inputs).into_iter();
        let args: Vec<String> =
            args.map(|word| if outputs.contains(&&word[..]) { "/dev/null".to_owned() } else { word }).collect();
        // Two outputs of one name are refused, also for devices.
        let code = if outputs[0] == outputs[1] { 0 } else { 2 };
        assert_eq!(run(folder.path(), &strs(&args)).code, Some(code), "{}", job.name);
    }
    assert!(fs::metadata("/dev/null").is_ok_and(|data| !data.is_file()));
}

#[cfg(unix)]
#[test]
fn a_read_only_folder_is_refused_and_stays_unchanged() {
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
fn a_failed_run_keeps_the_outputs_of_the_previous_one() {
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

/// Kills runs at times spread over their whole duration.
#[test]
fn a_killed_run_leaves_no_incomplete_output() {
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
            // The run may have ended before.
            let _ = child.kill();
            child.wait().unwrap();
            for (written, new) in job.written(folder.path()).iter().zip(&new) {
                assert!(written == b"old" || written == new, "{} after {:?}", job.name, whole * moment / MOMENTS);
            }
        }
        // A later run removes the temporary files of killed ones.
        done(folder.path(), &strs(&args));
        let left = fs::read_dir(folder.path()).unwrap().flatten();
        assert_eq!(left.filter(|e| e.file_name().to_string_lossy().starts_with(".cv-")).count(), 0, "{}", job.name);
    }
}

#[test]
fn the_report_is_a_single_file_without_external_references() {
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
        assert!(html.contains("data:image/") || html.contains("<svg"), "{}: no images", job.name);
    }
}

#[test]
fn two_photographs_with_the_same_output_name_are_wrong_usage() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a/same.png", "b/same.jpg"] {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        // The file is never read: the names are checked first.
        fs::write(path, "").unwrap();
    }
    for command in [&["undistort", "--camera", "none.yaml"][..], &["segment", "predict", "--model", "none.json"]] {
        let ran = run(folder.path(), &[command, &["a/same.png", "b/same.jpg", "-o", "out"]].concat());
        assert_eq!(ran.code, Some(2), "{ran:?}");
        assert!(ran.stderr.contains("a/same.png and b/same.jpg would both be written to out/same"), "{ran:?}");
    }
    assert!(!folder.path().join("out").exists());
}
