//! Failures of the environment: a full disk, unwritable folders, two concurrent runs. Old outputs stay complete, and no temporary file
//! remains. (Killed runs: `outputs.rs`, and 200 of them in `cargo xtask trust killed`.)

#![cfg(target_os = "linux")]
use crate::support::{Ran, cv, done, fixture, refused, snapshot, strs};
use cv_core::{GrayU8, RgbU8};
use std::{
    fs,
    os::unix::fs::symlink,
    path::Path,
    process::{Command, Stdio},
};

/// Commands that take some ten milliseconds: arguments and outputs.
type Job = (&'static str, &'static [&'static str]);

const JOBS: &[Job] = &[
    (
        "depth left.png right.png -o d.pfm --disparities 32 --focal 100 --baseline 0.1 --depth z.npy --cloud c.ply",
        &["d.pfm", "z.npy", "c.ply"],
    ),
    (
        "match left.png right.png -o m.txt --features mops --save-features features",
        &["m.txt", "features/left.keypoints.npy"],
    ),
    ("segment train --images left.png --masks masks -o m.json --components 2 --background-components 3", &["m.json"]),
    ("rectify left.png right.png --rig rig.yaml -o r", &["r/left.png", "r/right.png", "r/rig.yaml", "r/q.txt"]),
    ("eval disparity --estimate e.png --truth e.png --report page", &["page/report.html"]),
];

const RIG: &str = "schema: cv-rig/1\nunit: m\n\
    left: {width: 130, height: 90, fx: 120, fy: 120, cx: 64.5, cy: 44.5}\n\
    right: {width: 130, height: 90, fx: 121, fy: 120, cx: 64, cy: 45}\n\
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation: [-0.12, 0, 0]\n";

/// Creates a folder with a crop of a pair, a mask, a rig and a disparity map.
fn inputs(folder: &Path) {
    fs::create_dir(folder.join("masks")).unwrap();
    for side in ["left", "right"] {
        let photo = cv_io::read_rgb(fixture(&format!("stereo/{side}.jpg"))).unwrap();
        let part = RgbU8::from_fn(130, 90, |x, y| photo.at(2 * x + 100, 2 * y + 60));
        cv_io::write_png(folder.join(format!("{side}.png")), part.view()).unwrap();
        let mask = GrayU8::from_fn(130, 90, |x, y| [if part.at(x, y)[0] > 128 { 255 } else { 0 }]);
        cv_io::write_png(folder.join(format!("masks/{side}.png")), mask.view()).unwrap();
    }
    let map = cv_core::Image::<u16, 1>::from_fn(60, 50, |x, y| [(256 + x * 30 + y * 7) as u16]);
    cv_io::write_png(folder.join("e.png"), map.view()).unwrap();
    fs::write(folder.join("rig.yaml"), RIG).unwrap();
}

fn words(args: &str) -> Vec<&str> {
    args.split(' ').collect()
}

/// Runs a command under a limit set by the shell.
fn limited(folder: &Path, limit: &str, args: &str) -> Ran {
    let output = Command::new("sh")
        .args(["-c", &format!("{limit}; exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_cv")])
        .args(words(args))
        .current_dir(folder)
        .output()
        .unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    Ran { code: output.status.code(), stdout: text(output.stdout), stderr: text(output.stderr) }
}

/// Fills every output with the contents of an older run.
fn write_old(folder: &Path, outputs: &[&str]) {
    for output in outputs {
        fs::create_dir_all(folder.join(output).parent().unwrap()).unwrap();
        fs::write(folder.join(output), "old").unwrap();
    }
}

#[test]
fn a_full_disk_is_reported_and_leaves_old_outputs_unchanged() {
    for (args, outputs) in JOBS {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        inputs(folder);
        write_old(folder, outputs);
        let before = snapshot(folder);
        // File size limit of half a kilobyte: the write fails in the middle of the first output.
        let ran = limited(folder, "trap '' XFSZ; ulimit -f 1", args);
        assert_eq!(ran.code, Some(1), "{args}: {ran:?}");
        assert!(ran.stderr.contains("error: ") && ran.stderr.contains("too large"), "{args}: {ran:?}");
        assert!(snapshot(folder) == before, "{args}");
        // The same, but the signal kills the program. The next run removes its temporary files.
        let ran = limited(folder, "ulimit -c 0; ulimit -f 1", args);
        assert_eq!(ran.code, None, "{args}: {ran:?}");
        for output in *outputs {
            assert_eq!(fs::read(folder.join(output)).unwrap(), b"old", "{args}: {output}");
        }
        done(folder, &words(args));
        let names = snapshot(folder).into_iter().map(|(path, _)| path);
        let stray: Vec<_> = names.filter(|path| path.to_string_lossy().contains("/.cv-")).collect();
        assert!(stray.is_empty(), "{args}: {stray:?}");
        for output in *outputs {
            assert_ne!(fs::read(folder.join(output)).unwrap(), b"old", "{args}: {output}");
        }
    }
}

#[test]
fn a_full_device_is_reported_as_an_error() {
    for (args, outputs) in &JOBS[..3] {
        let folder = tempfile::tempdir().unwrap();
        inputs(folder.path());
        symlink("/dev/full", folder.path().join(outputs[0])).unwrap();
        let ran = refused(folder.path(), &words(args));
        assert!(ran.stderr.contains(outputs[0]) && ran.stderr.contains("No space left"), "{args}: {ran:?}");
    }
    let folder = tempfile::tempdir().unwrap();
    inputs(folder.path());
    // Stdout redirected to a file on a full disk.
    let full = || Stdio::from(fs::File::options().write(true).open("/dev/full").unwrap());
    for args in
        ["eval disparity --estimate e.png --truth e.png --json", "eval disparity --estimate e.png --truth e.png -o -"]
    {
        let ran = cv(folder.path()).args(words(args)).stdout(full()).output().unwrap();
        let stderr = String::from_utf8_lossy(&ran.stderr);
        assert!(
            ran.status.code() == Some(1) && stderr.contains("stdout") && stderr.contains("No space"),
            "{args}: {stderr}"
        );
    }
}

/// Folders of the kernel in which not even root can create a file.
#[test]
fn an_unwritable_folder_is_refused_before_the_computation() {
    for (args, outputs) in JOBS {
        for place in ["/proc", "/sys/kernel", "/proc/self/fd"] {
            let folder = tempfile::tempdir().unwrap();
            inputs(folder.path());
            let before = snapshot(folder.path());
            let first = outputs[0].split('/').next().unwrap();
            let moved: Vec<String> = words(args)
                .into_iter()
                .map(|word| if word == first { format!("{place}/cv-test/{word}") } else { word.to_owned() })
                .collect();
            let ran = refused(folder.path(), &strs(&moved));
            assert!(ran.stderr.contains(place), "{moved:?}: {ran:?}");
            assert!(snapshot(folder.path()) == before, "{moved:?}");
        }
    }
}

/// A file that opens and then fails to read: the unmapped first page of a process's memory.
#[test]
fn an_input_with_a_read_error_is_named() {
    let folder = tempfile::tempdir().unwrap();
    inputs(folder.path());
    symlink("/proc/self/mem", folder.path().join("broken.png")).unwrap();
    for args in [
        "depth broken.png right.png -o d.pfm --disparities 32",
        "estimate homography --matches broken.png",
        "segment predict --model broken.png left.png -o found",
        "rectify left.png right.png --rig broken.png -o r",
        "match left.png right.png -o m.txt --config broken.png",
    ] {
        let ran = refused(folder.path(), &words(args));
        assert!(ran.stderr.contains("broken.png"), "{args}: {ran:?}");
    }
}

/// Each of two concurrent runs writes complete files; the last one remains.
#[test]
fn concurrent_runs_leave_the_complete_output_of_one() {
    for (args, outputs) in &JOBS[..4] {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path();
        inputs(folder);
        // The other run has other input files.
        let swapped: Vec<&str> = match words(args) {
            mut all if all.contains(&"right.png") => {
                let at = all.iter().position(|word| *word == "left.png").unwrap();
                all[at + 1] = "left.png";
                all
            }
            all => all.into_iter().map(|word| if word == "left.png" { "right.png" } else { word }).collect(),
        };
        let written = |args: &[&str]| {
            let ran = cv(folder).args(args).output().unwrap();
            outputs.iter().map(|output| ran.status.success().then(|| fs::read(folder.join(output)).unwrap())).collect()
        };
        let one: Vec<Option<Vec<u8>>> = written(&words(args));
        let other: Vec<Option<Vec<u8>>> = written(&swapped);
        assert!(one.iter().all(Option::is_some), "{args}");
        for _ in 0..4 {
            let start =
                |args: &[&str]| cv(folder).args(args).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
            let mut runs = [start(&words(args)), start(&swapped)];
            for (run, expected) in runs.iter_mut().zip([&one, &other]) {
                assert_eq!(run.wait().unwrap().success(), expected[0].is_some(), "{args}");
            }
            for (i, output) in outputs.iter().enumerate() {
                let now = Some(fs::read(folder.join(output)).unwrap());
                assert!(now == one[i] || now == other[i], "{args}: {output}");
            }
        }
        let names = snapshot(folder).into_iter().map(|(path, _)| path);
        assert_eq!(names.filter(|path| path.to_string_lossy().contains("/.cv-")).count(), 0, "{args}");
    }
}
