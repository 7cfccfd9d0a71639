//! Ctrl-C as a black box: the time until the program ends, its message, and the remaining files.

#![cfg(target_os = "linux")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use cv_core::Mask;
use std::{
    fs,
    path::Path,
    process::{Child, Command, Output, Stdio},
    sync::LazyLock,
    thread::sleep,
    time::{Duration, Instant},
};
use support::{cv, snapshot};

/// The target is 200 ms on an idle machine; tests run beside others, up to ten per core.
const SOON: Duration = Duration::from_secs(2);

/// Width and height of [`TEXTURE`].
const TEXTURE_SIZE: (usize, usize) = (2400, 1800);

/// A gray texture without repetition. Computed once, and repeated by rows in larger images: the tests of the program are not optimized.
static TEXTURE: LazyLock<Vec<u8>> = LazyLock::new(|| {
    let cell = |x: usize, y: usize, size: usize| {
        let mut v =
            ((x / size) as u32).wrapping_mul(0x9E37_79B9) ^ ((y / size + size) as u32).wrapping_mul(0x85EB_CA6B);
        v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
        ((v ^ (v >> 12)) >> 24) as u8
    };
    let (width, height) = TEXTURE_SIZE;
    let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
    pixels.map(|(x, y)| cell(x, y, 3) / 3 + cell(x, y, 7) / 3 + cell(x, y, 17) / 3).collect()
});

/// Returns the interleaved colors of an image whose rows are those of the texture from column `shift` on and around its end.
fn repeat_texture((width, height): (usize, usize), shift: usize, color: impl Fn(u8) -> [u8; 3]) -> Vec<u8> {
    let (columns, rows) = TEXTURE_SIZE;
    let texture: Vec<Vec<u8>> = (TEXTURE.chunks(columns).take(height))
        .map(|row| {
            let mut row: Vec<u8> = row.iter().flat_map(|v| color(*v)).collect();
            row.rotate_left(3 * shift);
            row
        })
        .collect();
    let mut values = Vec::with_capacity(3 * width * height);
    for y in 0..height {
        while values.len() < 3 * width * (y + 1) {
            values.extend_from_slice(&texture[y % rows]);
        }
        values.truncate(3 * width * (y + 1));
    }
    values
}

/// Two images of a textured wall, shifted by `shift` pixels. The contrast is divided by `faintness`.
fn write_inputs(folder: &Path, size: (usize, usize), shift: usize, faintness: u8) {
    let (width, height) = size;
    for (name, shift) in [("left.ppm", 0), ("right.ppm", shift)] {
        let mut ppm = format!("P6\n{width} {height}\n255\n").into_bytes();
        ppm.extend(repeat_texture(size, shift, |v| [v / faintness, 255 - v / faintness, 90]));
        fs::write(folder.join(name), ppm).unwrap();
    }
}

/// A mask of the brighter pixels of the left image.
fn write_mask(folder: &Path, (width, height): (usize, usize)) {
    fs::create_dir(folder.join("masks")).unwrap();
    let mask = Mask::from_fn(width, height, |x, y| [TEXTURE[y * TEXTURE_SIZE.0 + x] > 150]);
    cv_io::write_png(folder.join("masks/left.png"), mask.view()).unwrap();
}

const RIG: &str = "schema: cv-rig/1\nunit: m\n\
    left: {width: 2400, height: 1800, fx: 2400, fy: 2400, cx: 1199.5, cy: 899.5}\n\
    right: {width: 2400, height: 1800, fx: 2400, fy: 2400, cx: 1199.5, cy: 899.5}\n\
    rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]\ntranslation: [-0.12, 0, 0]\n";

/// Starts the program and waits until it handles signals.
fn start(folder: &Path, args: &[&str]) -> Child {
    let mut command = cv(folder);
    command.args(args).args(["--threads", "1"]).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let status = format!("/proc/{}/status", child.id());
    // SIGINT is signal 2: the second bit of the mask of caught signals.
    let listens = |status: &str| {
        let caught = status.lines().find_map(|line| line.strip_prefix("SigCgt:"));
        caught.is_some_and(|mask| u64::from_str_radix(mask.trim(), 16).unwrap() & 2 != 0)
    };
    while !listens(&fs::read_to_string(&status).unwrap_or_default()) {
        assert!(child.try_wait().unwrap().is_none(), "cv {args:?} ended");
        sleep(Duration::from_millis(1));
    }
    child
}

fn signal(child: &Child, name: &str) {
    let sent = Command::new("sh").args(["-c", &format!("kill -{name} {}", child.id())]).status().unwrap();
    assert!(sent.success());
}

/// Waits for the end after a signal.
fn stopped(child: Child, what: &str) {
    let since = Instant::now();
    was_stopped(child.wait_with_output().unwrap(), since.elapsed(), what);
}

fn was_stopped(Output { status, stdout, stderr }: Output, took: Duration, what: &str) {
    let stderr = String::from_utf8(stderr).unwrap();
    assert_eq!(status.code(), Some(130), "{what}: {stderr}");
    assert_eq!(stderr.lines().last(), Some("stopped"), "{what}: {stderr}");
    assert!(!stderr.contains("error"), "{what}: {stderr}");
    assert!(stdout.is_empty(), "{what}");
    assert!(took < SOON, "{what}: {took:?}");
}

#[test]
fn a_stopped_command_leaves_all_files_unchanged() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    write_inputs(folder, (2400, 1800), 30, 1);
    write_mask(folder, (2400, 1800));
    fs::write(folder.join("rig.yaml"), RIG).unwrap();
    for name in ["d.pfm", "c.png", "m.txt", "model.json"] {
        fs::write(folder.join(name), "old").unwrap();
    }
    // With times in milliseconds at which each still runs on a fast machine: they take a second or more, training a third of it.
    let commands: [(&[&str], [u64; 3]); 4] = [
        (&["depth", "left.ppm", "right.ppm", "-o", "d.pfm", "--confidence", "c.png"], [0, 150, 400]),
        (&["match", "left.ppm", "right.ppm", "-o", "m.txt", "--save-features", "features"], [0, 150, 400]),
        (&["rectify", "left.ppm", "right.ppm", "--rig", "rig.yaml", "--out", "rectified"], [0, 150, 400]),
        (&["segment", "train", "--images", "left.ppm", "--masks", "masks", "--model", "model.json"], [0, 40, 80]),
    ];
    let before = snapshot(folder);
    for (args, moments) in commands {
        for (wait, name) in moments.into_iter().zip(["INT", "TERM", "INT"]) {
            let child = start(folder, args);
            sleep(Duration::from_millis(wait));
            signal(&child, name);
            let what = format!("cv {args:?} after {wait} ms");
            stopped(child, &what);
            assert!(snapshot(folder) == before, "{what}");
        }
    }
}

/// Returns the names of all entries of a folder.
fn names(folder: &Path) -> Vec<String> {
    let mut names: Vec<String> =
        fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    names
}

#[test]
fn an_output_in_progress_is_removed() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    // Large enough that writing takes longer than the program waits for a job to stop by itself, and too faint for features, whose
    // detection comes before.
    write_inputs(folder, (4800, 3600), 30, 64);
    let sizes = [("2400", "4800"), ("1800", "3600"), ("1199.5", "2399.5"), ("899.5", "1799.5")];
    let rig = sizes.iter().fold(RIG.to_owned(), |rig, (from, to)| rig.replace(from, to));
    fs::write(folder.join("rig.yaml"), rig).unwrap();
    let out = folder.join("rectified");
    let args = ["rectify", "left.ppm", "right.ppm", "--rig", "rig.yaml", "--out", "rectified"];
    for twice in [false, true] {
        // On a busy machine the signal may arrive after all is written, before the program ends: then it is repeated.
        let caught = (0..20).find_map(|_| {
            fs::remove_dir_all(&out).ok();
            fs::create_dir(&out).unwrap();
            fs::write(out.join("left.png"), "old").unwrap();
            let mut child = start(folder, &args);
            // While images of 17 megapixels are encoded, no callback runs.
            while names(&out).len() < 2 && child.try_wait().unwrap().is_none() {
                sleep(Duration::from_millis(1));
            }
            signal(&child, "INT");
            if twice {
                signal(&child, "INT");
            }
            let since = Instant::now();
            let output = child.wait_with_output().unwrap();
            (!out.join("q.txt").exists()).then(|| (output, since.elapsed()))
        });
        let (output, took) = caught.expect("all is written each time before the signal comes");
        was_stopped(output, took, "cv rectify while it writes");
        assert_eq!(names(&out), ["left.png"]);
        assert_eq!(fs::read(out.join("left.png")).unwrap(), b"old");
    }
}

#[test]
fn completed_frames_are_kept() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    write_inputs(folder, (640, 480), 20, 1);
    for side in ["left", "right"] {
        fs::create_dir(folder.join(side)).unwrap();
        for i in 0..200 {
            fs::copy(folder.join(format!("{side}.ppm")), folder.join(format!("{side}/{i}.ppm"))).unwrap();
        }
    }
    let mut child = start(folder, &["depth", "left", "right", "-o", "out"]);
    let out = folder.join("out");
    while !out.join("1.pfm").exists() {
        assert!(child.try_wait().unwrap().is_none());
        sleep(Duration::from_millis(1));
    }
    signal(&child, "INT");
    stopped(child, "cv depth on frames");
    let names = names(&out);
    assert!(names.len() < 200, "{names:?}");
    for name in names {
        assert_eq!(cv_io::read_map(out.join(&name), None).unwrap().size(), (640, 480), "{name}");
    }
}

#[test]
fn the_demo_stops_within_a_job() {
    let folder = tempfile::tempdir().unwrap();
    for wait in [50, 700] {
        let child = start(folder.path(), &["demo"]);
        sleep(Duration::from_millis(wait));
        signal(&child, "INT");
        stopped(child, "cv demo");
        let out = folder.path().join("cv-demo");
        let names = if out.exists() { names(&out) } else { Vec::new() };
        assert!(names.iter().all(|name| name.ends_with(".png") && !name.starts_with('.')), "{names:?}");
    }
}

/// A pipe without a writer blocks a command outside all callbacks; the program still ends.
#[test]
fn a_command_that_waits_for_input_stops() {
    let folder = tempfile::tempdir().unwrap();
    let folder = folder.path();
    write_inputs(folder, (64, 48), 3, 1);
    write_mask(folder, (64, 48));
    fs::write(folder.join("left_mask.png"), "mask").unwrap();
    let made = Command::new("mkfifo").arg(folder.join("pipe.png")).arg(folder.join("pipe_mask.png")).status().unwrap();
    assert!(made.success());
    fs::write(folder.join("d.pfm"), "old").unwrap();
    let commands = [
        "depth left.ppm pipe.png -o d.pfm",
        "match pipe.png left.ppm -o m.txt",
        "panorama left.ppm pipe.png -o p.png",
        "reconstruct pipe.png left.ppm -o c.ply",
        "rectify left.ppm right.ppm --rig pipe.png -o r",
        "segment train --images pipe.png --masks masks -o m.json",
        "segment predict --model pipe.png left.ppm -o found",
        "segment eval --model pipe.png --images left.ppm --masks masks",
        "estimate homography --matches pipe.png",
        "eval disparity --estimate pipe.png --truth pipe.png",
    ];
    fs::copy(folder.join("masks/left.png"), folder.join("masks/pipe.png")).unwrap();
    let names_before = names(folder);
    let children: Vec<Child> =
        commands.iter().map(|args| start(folder, &args.split(' ').collect::<Vec<_>>())).collect();
    children.iter().for_each(|child| signal(child, "INT"));
    for (child, args) in children.into_iter().zip(commands) {
        stopped(child, args);
    }
    assert_eq!(names(folder), names_before);
    assert_eq!(fs::read(folder.join("d.pfm")).unwrap(), b"old");
}
