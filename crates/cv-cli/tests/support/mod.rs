//! Common parts of the black-box tests: running the program, and writing valid and broken files.

#![allow(dead_code, reason = "each test file uses its part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Image, RgbU8};
use std::{
    fs,
    path::{Path, PathBuf},
    process::{Command, Output, Stdio},
};

/// Returns the program's command in a folder, without arguments.
pub(crate) fn cv(folder: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cv"));
    command.current_dir(folder).stdin(Stdio::null());
    command
}

/// Result of a run.
#[derive(Debug)]
pub(crate) struct Ran {
    pub(crate) code: Option<i32>,
    pub(crate) stdout: String,
    pub(crate) stderr: String,
}

/// Runs the program with arguments in a folder; asserts that it does not panic.
pub(crate) fn run(folder: &Path, args: &[&str]) -> Ran {
    let Output { status, stdout, stderr } = cv(folder).args(args).output().unwrap();
    let ran = Ran {
        code: status.code(),
        stdout: String::from_utf8(stdout).unwrap(),
        stderr: String::from_utf8(stderr).unwrap(),
    };
    assert!(matches!(ran.code, Some(0..=2)), "cv {args:?}: {ran:?}");
    assert!(!ran.stderr.contains("panicked") && !ran.stderr.contains("internal error"), "cv {args:?}: {ran:?}");
    ran
}

/// Runs the program; asserts that it succeeds.
pub(crate) fn done(folder: &Path, args: &[&str]) -> Ran {
    let ran = run(folder, args);
    assert_eq!(ran.code, Some(0), "cv {args:?}: {ran:?}");
    ran
}

/// Runs the program; asserts that it fails with exit code 1 and one line of error.
pub(crate) fn refused(folder: &Path, args: &[&str]) -> Ran {
    let ran = run(folder, args);
    assert_eq!(ran.code, Some(1), "cv {args:?}: {ran:?}");
    assert_eq!(ran.stdout, "", "cv {args:?}");
    let errors: Vec<&str> = ran.stderr.lines().filter(|line| line.starts_with("error: ")).collect();
    assert_eq!(errors.len(), 1, "cv {args:?}: {ran:?}");
    ran
}

/// Runs the program; asserts that it succeeds and prints one JSON object with the common keys.
pub(crate) fn json(folder: &Path, args: &[&str]) -> serde_json::Value {
    let ran = done(folder, &[args, &["--json"]].concat());
    let value: serde_json::Value = serde_json::from_str(&ran.stdout).unwrap_or_else(|e| panic!("{e}: {ran:?}"));
    assert!(value["seconds"]["total"].as_f64().unwrap() > 0.0, "{value}");
    assert!(value["threads"].as_u64().unwrap() > 0, "{value}");
    assert_eq!(value["version"], env!("CARGO_PKG_VERSION"));
    value
}

/// Returns paths and bytes of all files below a folder, sorted.
pub(crate) fn snapshot(folder: &Path) -> Vec<(PathBuf, Vec<u8>)> {
    let mut files = Vec::new();
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            files.extend(snapshot(&path));
        } else {
            files.push((path.clone(), fs::read(&path).unwrap()));
        }
    }
    files.sort();
    files
}

/// Writes files with image names and invalid contents. Each must be refused.
pub(crate) fn write_broken(folder: &Path, good: &RgbU8) -> Vec<String> {
    let png = cv_io::encode_png(good.view()).unwrap();
    let jpeg = cv_io::encode_jpeg(good.view(), 90).unwrap();
    // 100,000 × 100,000 pixels in the header, no data: must be refused before allocation.
    let mut bomb = png[..33].to_vec();
    bomb[16..24].copy_from_slice(&[0, 1, 0x86, 0xa0, 0, 1, 0x86, 0xa0]);
    let files: [(&str, &[u8]); 8] = [
        ("empty.png", b""),
        ("empty.jpg", b""),
        ("cut.png", &png[..png.len() / 2]),
        ("head.png", &png[..20]),
        ("head.jpg", &jpeg[..20]),
        ("text.png", b"this is not an image\n"),
        ("zeros.jpg", &[0; 4096]),
        ("bomb.png", &bomb),
    ];
    for (name, bytes) in files {
        fs::write(folder.join(name), bytes).unwrap();
    }
    fs::create_dir(folder.join("folder.png")).unwrap();
    files.iter().map(|(name, _)| (*name).to_owned()).chain(["missing.png".into(), "folder.png".into()]).collect()
}

/// Writes an image in every lossless format. Each must give the same result as the plain PNG.
pub(crate) fn write_lossless_variants(folder: &Path, stem: &str, image: &RgbU8) -> Vec<String> {
    let name = |ending: &str| format!("{stem}-{ending}");
    let png = cv_io::encode_png(image.view()).unwrap();
    let deep = image.map(|p| p.map(|v| u16::from(v) * 257));
    let alpha: Image<u8, 4> = image.map(|[r, g, b]| [r, g, b, 255]);
    fs::write(folder.join(name("plain.png")), &png).unwrap();
    fs::write(folder.join(name("misnamed.jpg")), &png).unwrap();
    fs::write(folder.join(name("nameless")), &png).unwrap();
    cv_io::write_png(folder.join(name("deep.png")), deep.view()).unwrap();
    cv_io::write_png(folder.join(name("alpha.png")), alpha.view()).unwrap();
    let mut ppm = format!("P6\n{} {}\n255\n", image.width(), image.height()).into_bytes();
    ppm.extend_from_slice(image.as_slice());
    fs::write(folder.join(name("plain.ppm")), ppm).unwrap();
    ["plain.png", "misnamed.jpg", "nameless", "deep.png", "alpha.png", "plain.ppm"].map(name).to_vec()
}

/// Writes an image as a CMYK JPEG with inverted inks (Adobe's convention).
pub(crate) fn write_cmyk(path: &Path, image: &RgbU8) {
    let inks: Vec<u8> = image.pixels().flat_map(|[r, g, b]| [255 - r, 255 - g, 255 - b, 0]).collect();
    let mut bytes = Vec::new();
    let (width, height) = (image.width() as u16, image.height() as u16);
    jpeg_encoder::Encoder::new(&mut bytes, 95).encode(&inks, width, height, jpeg_encoder::ColorType::Cmyk).unwrap();
    fs::write(path, bytes).unwrap();
}

/// A command that reads images: its arguments and outputs.
pub(crate) struct Job {
    /// Name in messages.
    pub(crate) name: &'static str,
    /// Its fixtures, in order.
    pub(crate) inputs: &'static [&'static str],
    /// Arguments; `{0}` is replaced by the first input and so on. Paths are relative to the working folder.
    pub(crate) args: &'static str,
    /// Whether it makes random choices, and so has a seed.
    pub(crate) random: bool,
    /// Output files.
    pub(crate) outputs: &'static [&'static str],
}

impl Job {
    /// Returns the arguments for these input files.
    pub(crate) fn args(&self, inputs: &[String]) -> Vec<String> {
        let fill = |word: &str| {
            inputs.iter().enumerate().fold(word.to_owned(), |text, (i, input)| text.replace(&format!("{{{i}}}"), input))
        };
        self.args.split_whitespace().map(fill).collect()
    }

    /// Reads the input images.
    pub(crate) fn images(&self) -> Vec<RgbU8> {
        self.inputs.iter().map(|name| cv_io::read_rgb(fixture(name)).unwrap()).collect()
    }

    /// Creates a folder in which the job can run; also returns the names of its inputs.
    pub(crate) fn folder(&self) -> (tempfile::TempDir, Vec<String>) {
        let folder = tempfile::tempdir().unwrap();
        let names = self.inputs.iter().enumerate().map(|(i, name)| {
            let copy = format!("in{i}.{}", name.rsplit('.').next().unwrap());
            fs::copy(fixture(name), folder.path().join(&copy)).unwrap();
            copy
        });
        let names = names.collect();
        self.prepare(folder.path());
        (folder, names)
    }

    /// Writes the job's other inputs.
    fn prepare(&self, folder: &Path) {
        if self.args.contains("--masks") {
            // A mask for each name under which a test may store the image.
            fs::create_dir(folder.join("masks")).unwrap();
            for i in 0..self.inputs.len() {
                let variants = ["", "-plain", "-misnamed", "-nameless", "-deep", "-alpha"].map(|d| format!("in{i}{d}"));
                let broken = ["empty", "cut", "head", "text", "zeros", "bomb", "missing", "folder"].map(str::to_owned);
                let others = [format!("cmyk{i}"), odd_name(&format!("in{i}"))];
                for stem in variants.into_iter().chain(broken).chain(others) {
                    let mask = fixture(&format!("oracle/ball-masks/ball{i}_mask.png"));
                    fs::copy(mask, folder.join(format!("masks/{stem}_mask.png"))).unwrap();
                }
            }
        }
        if self.args.contains("--model ball.json") {
            let (images, masks) = (fixture("ball"), fixture("oracle/ball-masks"));
            let [images, masks] = [images, masks].map(|path| path.to_str().unwrap().to_owned());
            done(folder, &["segment", "train", "--images", &images, "--masks", &masks, "--model", "ball.json"]);
        }
    }

    /// Returns the outputs that are single files.
    pub(crate) fn files(&self) -> Vec<&'static str> {
        self.outputs.iter().copied().filter(|name| !name.ends_with('/')).collect()
    }

    /// Returns the bytes of all outputs. Folders are removed: the next run may use other file names.
    pub(crate) fn written(&self, folder: &Path) -> Vec<Vec<u8>> {
        let mut bytes = Vec::new();
        for name in self.outputs {
            let path = folder.join(name);
            if name.ends_with('/') {
                bytes.extend(snapshot(&path).into_iter().map(|(_, bytes)| bytes));
                fs::remove_dir_all(&path).unwrap();
            } else {
                bytes.push(fs::read(&path).unwrap_or_else(|e| panic!("{}: {name}: {e}", self.name)));
            }
        }
        bytes
    }
}

/// Returns a name with spaces and letters of several scripts.
pub(crate) fn odd_name(name: &str) -> String {
    format!("Überfahrt № 1 – {name}")
}

/// Returns the path of a file under `fixtures/` at the root of the workspace.
pub(crate) fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures").join(name)
}

/// Borrows the arguments.
pub(crate) fn strs(args: &[String]) -> Vec<&str> {
    args.iter().map(String::as_str).collect()
}

/// The commands that read images.
pub(crate) const JOBS: &[Job] = &[
    Job {
        name: "depth",
        inputs: &["stereo/left.jpg", "stereo/right.jpg"],
        args: "depth {0} {1} -o d.pfm --disparities 64 --focal 380 --baseline 0.12 --depth depth.pfm --cloud cloud.ply",
        random: false,
        outputs: &["d.pfm", "depth.pfm", "cloud.ply"],
    },
    Job {
        name: "panorama",
        inputs: &["panorama/view0.jpg", "panorama/view1.jpg", "panorama/view2.jpg"],
        args: "panorama {0} {1} {2} -o pano.png",
        random: true,
        outputs: &["pano.png"],
    },
    Job {
        name: "match",
        inputs: &["plane/a.jpg", "plane/b.jpg"],
        args: "match {0} {1} -o matches.txt",
        random: true,
        outputs: &["matches.txt"],
    },
    Job {
        name: "reconstruct",
        inputs: &["two-view/a.jpg", "two-view/b.jpg"],
        args: "reconstruct {0} {1} --focal 440 -o cloud.ply",
        random: true,
        outputs: &["cloud.ply"],
    },
    Job {
        name: "segment train",
        inputs: &["ball/ball0.jpg", "ball/ball1.jpg"],
        args: "segment train --images {0} {1} --masks masks --model trained.json",
        random: true,
        outputs: &["trained.json"],
    },
    Job {
        name: "segment predict",
        inputs: &["ball/ball2.jpg", "ball/ball3.jpg"],
        args: "segment predict --model ball.json {0} {1} --out found",
        random: false,
        outputs: &["found/"],
    },
];
