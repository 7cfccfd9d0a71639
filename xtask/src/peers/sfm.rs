//! Structure from motion: COLMAP and OpenMVG-rs, both incremental and global, and ours on the same photographs. Writes the section “Many views” of
//! `docs/benchmarks.md`.
//!
//! The peers take ten minutes, so their models and figures are cached in `peers-sfm` of the target folder, by set, until their scripts
//! or versions change. Remove a set's folder to run them again.

use crate::checks::Check;
use crate::sfm_score::{Poses, Score, read_truth, score};
use anyhow::{Context, Result, ensure};
use cv_core::SparseModel;
use serde::Deserialize;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

const THREADS: usize = 2;
/// Files in `peers` whose contents identify the peers' results: a change invalidates the cache.
const SOURCES: [&str; 3] = ["requirements.txt", "sfm_colmap.py", "sfm_openmvgrs.py"];
const ENGINES: [&str; 2] = ["incremental", "global"];

/// Photographs with known cameras.
struct Set {
    name: &'static str,
    /// Folders and files below `sfm` of the data.
    images: &'static str,
    truth: &'static str,
    /// The calibration matrix, if it is given to all systems.
    camera: Option<&'static str>,
    /// Smallest AUC at 1° required of ours, in percent, independent of the peers.
    min_auc: Option<f64>,
}

const SETS: [Set; 5] = [
    Set {
        name: "fountain-P11, K",
        images: "fountain-P11/images",
        truth: "fountain-P11/truth.txt",
        camera: Some("fountain-P11/K.txt"),
        min_auc: Some(95.0),
    },
    Set {
        name: "fountain-P11",
        images: "fountain-P11/images",
        truth: "fountain-P11/truth.txt",
        camera: None,
        min_auc: Some(90.0),
    },
    Set {
        name: "templeRing, K",
        images: "templeRing/images",
        truth: "templeRing/truth.txt",
        camera: Some("templeRing/K.txt"),
        min_auc: Some(77.0),
    },
    Set { name: "sceaux", images: "sceaux", truth: "sceaux-reference/poses.txt", camera: None, min_auc: None },
    Set {
        name: "kitti-2, K",
        images: "kitti-2/images",
        truth: "kitti-2/truth.txt",
        camera: Some("kitti-2/K.txt"),
        min_auc: None,
    },
];

impl Set {
    /// Returns the name of its cache folder.
    fn slug(&self) -> String {
        self.name.to_lowercase().replace(", ", "-")
    }

    /// Copies only the photographs into a folder: the peers read all files there, and one of them also files beside it.
    fn copy(&self, data: &Path, into: &Path) -> Result<Vec<PathBuf>> {
        std::fs::create_dir_all(into)?;
        let folder = data.join(self.images);
        let mut photographs = Vec::new();
        for entry in std::fs::read_dir(&folder).with_context(|| folder.display().to_string())? {
            let path = entry?.path();
            let extension = path.extension().unwrap_or_default().to_ascii_lowercase();
            if let (true, Some(name)) = (extension == "jpg" || extension == "png", path.file_name()) {
                std::fs::copy(&path, into.join(name))?;
                photographs.push(into.join(name));
            }
        }
        photographs.sort();
        ensure!(photographs.len() >= 3, "{}: {} photographs", folder.display(), photographs.len());
        Ok(photographs)
    }
}

/// Cost of one stage of a job.
#[derive(Debug, Clone, Default, Deserialize)]
struct Stage {
    #[serde(default)]
    name: String,
    seconds: f64,
    /// Processor seconds of all threads.
    cpu: f64,
    /// Peak resident bytes.
    peak: u64,
}

/// Output of a peer's script.
#[derive(Debug, Deserialize)]
struct Printed {
    version: String,
    stages: Vec<Stage>,
    /// Load average before the start.
    load: f64,
}

/// Result of one system on a set.
struct Outcome {
    system: String,
    score: Score,
    stages: Vec<Stage>,
    load: f64,
}

impl Outcome {
    fn cpu(&self) -> f64 {
        self.stages.iter().map(|stage| stage.cpu).sum()
    }

    fn seconds(&self) -> f64 {
        self.stages.iter().map(|stage| stage.seconds).sum()
    }

    fn peak(&self) -> f64 {
        self.stages.iter().map(|stage| stage.peak).max().unwrap_or(0) as f64 / f64::from(1 << 20)
    }

    fn line(&self, set: &Set, photographs: usize) -> String {
        let Score { registered, correct, auc, centers, points, track_length, reprojection } = &self.score;
        let parts: Vec<String> = self.stages.iter().map(|stage| format!("{} {:.1}", stage.name, stage.cpu)).collect();
        format!(
            "| {} | {} | {registered} ({}) of {photographs} | {:.1} / {:.1} / {:.1} | {:.3} % | {points} | {track_length:.2} | {reprojection:.3} | {:.1} ({}) | {:.1} | {:.0} | {:.1} |\n",
            set.name,
            self.system,
            correct.len(),
            auc[0],
            auc[1],
            auc[2],
            100.0 * centers,
            self.cpu(),
            parts.join(", "),
            self.seconds(),
            self.peak(),
            self.load,
        )
    }
}

/// Results of all systems on a set; ours is `None` if it failed.
struct Compared {
    set: &'static Set,
    photographs: usize,
    peers: Vec<Outcome>,
    /// Whether the peers' results are from an earlier run.
    is_cached: bool,
    ours: Option<Outcome>,
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let program = super::release_program()?;
    let cache = crate::target_dir()?.join("peers-sfm");
    let mut versions = Vec::new();
    let mut sets = Vec::new();
    for set in &SETS {
        println!("{}", set.name);
        sets.push(compare(set, python, &program, &data.join("sfm"), &cache, &mut versions)?);
    }
    let checks = checks(&sets);
    let mut text = format!(
        "Written by `cargo xtask peers sfm`; one run, {THREADS} threads each, {}, {}. The same photographs for all, from the files to the model. Where a set's name ends in K, the calibration matrix was given \
         and fixed; else the focal length is initialized from EXIF or a default and refined together with one or more distortion coefficients. Registered: images in the model (in parentheses: correctly, \
         with a median relative pose error below 5°). AUC: area under the recall curve up to 1°, 3° and 5° of the larger of the relative rotation error and the relative translation direction error, over all pairs with ground truth. Centers: RMS \
         error of the camera centers after a similarity alignment, in percent of their RMS spread. Reprojection: mean error over all observations in pixels, computed here for all systems. Ground truth: surveyed (fountain), a robot arm (templeRing), GPS and inertial (kitti-2); for sceaux COLMAP's \
         own poses. Processor time and peak memory are of the whole job; COLMAP's two mappers share its first stages.\n\n",
        super::machine(),
        versions.join(", "),
    );
    if sets.iter().any(|s| s.is_cached) {
        text.push_str("The peers' figures are of an earlier run on this machine.\n\n");
    }
    text.push_str("| set | system | registered | AUC 1/3/5 | centers | points | track length | reprojection | processor s | wall s | peak MiB | load |\n|---|---|---|---|---|---|---|---|---|---|---|---|\n");
    for s in &sets {
        for outcome in s.ours.iter().chain(&s.peers) {
            text.push_str(&outcome.line(s.set, s.photographs));
        }
    }
    text.push_str("\n| figure | measured | target | |\n|---|---|---|---|\n");
    for c in &checks {
        let verdict = if c.ok { "met" } else { "**not met**" };
        let target = c.target.replace("<=", "≤").replace(">=", "≥");
        let _ = writeln!(text, "| {} | {:.4} | {target} | {verdict} |", c.name, c.figure);
    }
    print!("{text}");
    if sets.iter().all(|s| s.ours.is_some()) {
        super::write_section("Many views", &text)?;
    }
    Ok(checks)
}

fn compare(
    set: &'static Set,
    python: &Path,
    program: &Path,
    data: &Path,
    cache: &Path,
    versions: &mut Vec<String>,
) -> Result<Compared> {
    let truth = read_truth(&data.join(set.truth))?;
    let folder = cache.join(set.slug());
    let temporary = tempfile::tempdir()?;
    let images = temporary.path().join("photographs");
    let photographs = set.copy(data, &images)?;
    let camera = set.camera.map(|camera| data.join(camera));
    let is_cached = run_peers(python, &folder, &images, camera.as_deref())?;
    let mut peers = Vec::new();
    for (script, system) in [("colmap", "COLMAP"), ("openmvg", "OpenMVG-rs")] {
        for engine in ENGINES {
            let file = folder.join(if script == "colmap" {
                "colmap.json".to_owned()
            } else {
                format!("{script}-{engine}.json")
            });
            let printed = std::fs::read_to_string(&file).with_context(|| file.display().to_string())?;
            let printed: Printed = serde_json::from_str(&printed).with_context(|| file.display().to_string())?;
            if !versions.contains(&printed.version) {
                versions.push(printed.version);
            }
            // Stages of the other mapper only.
            let others: &[&str] = if engine == "global" { &["incremental"] } else { &["calibrate", "global"] };
            let stages = printed.stages.into_iter().filter(|stage| !others.contains(&&stage.name[..])).collect();
            let score = score_folder(&folder.join(script).join(engine), &truth)?;
            peers.push(Outcome { system: format!("{system} {engine}"), score, stages, load: printed.load });
        }
    }
    let ours = match run_ours(python, program, &folder.join("ours"), &photographs, camera.as_deref()) {
        Ok((stage, load)) => {
            let score = score_folder(&folder.join("ours/model"), &truth)?;
            Some(Outcome { system: "ours".to_owned(), score, stages: vec![stage], load })
        }
        Err(error) => {
            println!("ours failed on {}: {error:#}", set.name);
            None
        }
    };
    Ok(Compared { set, photographs: photographs.len(), peers, is_cached, ours })
}

/// Runs the peers on a set unless their results are cached; returns whether they were.
fn run_peers(python: &Path, folder: &Path, images: &Path, camera: Option<&Path>) -> Result<bool> {
    let scripts = crate::root().join("peers");
    let mut stamp = format!("{THREADS} threads\n");
    for source in SOURCES {
        stamp.push_str(&std::fs::read_to_string(scripts.join(source)).with_context(|| source.to_owned())?);
    }
    let stamp_file = folder.join("stamp");
    if std::fs::read_to_string(&stamp_file).is_ok_and(|cached| cached == stamp) {
        return Ok(true);
    }
    if folder.exists() {
        std::fs::remove_dir_all(folder)?;
    }
    std::fs::create_dir_all(folder)?;
    let call = |script: &str, out: &str, engine: Option<&str>, printed: String| {
        println!("  {}", printed.trim_end_matches(".json"));
        let mut command = Command::new(python);
        command.arg(scripts.join(script)).arg(images).arg(folder.join(out)).arg(THREADS.to_string());
        command.args(engine).args(camera);
        let output = command.output().context("cannot start Python")?;
        ensure!(output.status.success(), "{script}: {}", String::from_utf8_lossy(&output.stderr));
        std::fs::write(folder.join(printed), output.stdout)?;
        Ok(())
    };
    call("sfm_colmap.py", "colmap", None, "colmap.json".to_owned())?;
    for engine in ENGINES {
        call("sfm_openmvgrs.py", "openmvg", Some(engine), format!("openmvg-{engine}.json"))?;
    }
    std::fs::write(stamp_file, stamp)?;
    Ok(false)
}

/// Runs our program on the photographs and writes its model to `model` in `folder`; returns its cost and the load average before it.
fn run_ours(
    python: &Path,
    program: &Path,
    folder: &Path,
    photographs: &[PathBuf],
    camera: Option<&Path>,
) -> Result<(Stage, f64)> {
    if folder.exists() {
        std::fs::remove_dir_all(folder)?;
    }
    std::fs::create_dir_all(folder)?;
    let load = super::machine_load().parse().unwrap_or(f64::NAN);
    let mut command = Command::new(python);
    command.arg(crate::root().join("peers/measure.py")).arg(folder.join("printed.json")).arg(program);
    command.arg("sfm").args(photographs).arg("-o").arg(folder.join("model"));
    command.args(["--json", "--quiet", "--threads", &THREADS.to_string()]);
    if let Some(camera) = camera {
        // Without distortion, as for the peers.
        command.arg("--camera").arg(camera).arg("--undistorted");
    }
    let output = command.output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr).trim());
    let stage: Stage = serde_json::from_slice(&output.stdout)?;
    Ok((Stage { name: "all".to_owned(), ..stage }, load))
}

/// Scores the model in a folder; a missing model counts as empty.
fn score_folder(folder: &Path, truth: &Poses) -> Result<Score> {
    let model = if folder.join("images.txt").exists() { cv_io::colmap::read(folder)? } else { SparseModel::default() };
    Ok(score(&model, truth))
}

fn checks(sets: &[Compared]) -> Vec<Check> {
    let mut checks = Vec::new();
    let (mut auc_differences, mut cpu, mut colmap_cpu, mut openmvg_cpu) = (Vec::new(), 0.0, 0.0, 0.0);
    for Compared { set, peers, ours, .. } in sets {
        let name = set.name;
        let failed = Outcome { system: String::new(), score: Score::default(), stages: Vec::new(), load: f64::NAN };
        let has_run = ours.is_some();
        let ours = ours.as_ref().unwrap_or(&failed);
        // A failed run has no cost: NaN meets no target.
        let cost = |figure: f64| if has_run { figure } else { f64::NAN };
        let is = |peer: &&Outcome, system: &str| peer.system == system;
        let Some(colmap) = peers.iter().find(|peer| is(peer, "COLMAP incremental")) else { continue };

        let mut missed: Vec<&String> = peers.iter().flat_map(|peer| &peer.score.correct).collect();
        missed.sort();
        missed.dedup();
        missed.retain(|name| !ours.score.correct.contains(name));
        checks.push(Check::at_most(
            format!("{name}: photographs that a peer registers correctly and ours does not"),
            missed.len() as f64,
            0.0,
        ));
        let best = peers.iter().map(|peer| peer.score.auc[0]).fold(0.0, f64::max);
        auc_differences.push(ours.score.auc[0] - best);
        checks.push(Check::at_least(format!("{name}: AUC at 1°, ours − best peer"), ours.score.auc[0] - best, -0.3));
        if let Some(min_auc) = set.min_auc {
            checks.push(Check::at_least(format!("{name}: AUC at 1°"), ours.score.auc[0], min_auc));
        }
        let (a, b) = (&ours.score, &colmap.score);
        checks.push(Check::at_least(
            format!("{name}: points / COLMAP incremental's"),
            a.points as f64 / b.points as f64,
            1.0,
        ));
        checks.push(Check::at_least(
            format!("{name}: mean track length / COLMAP incremental's"),
            a.track_length / b.track_length,
            1.0,
        ));
        checks.push(Check::at_most(
            format!("{name}: reprojection / COLMAP incremental's"),
            cost(a.reprojection / b.reprojection),
            1.0,
        ));
        checks.push(Check::at_most(format!("{name}: peak memory / COLMAP's"), cost(ours.peak() / colmap.peak()), 1.0));
        if name == "fountain-P11, K" {
            checks.push(Check::at_most(
                format!("{name}: processor s / COLMAP incremental's"),
                cost(ours.cpu() / colmap.cpu()),
                0.09,
            ));
        }
        cpu += cost(ours.cpu());
        colmap_cpu += colmap.cpu();
        // The cheaper of its two mappers that produced a model.
        let openmvg = peers.iter().filter(|peer| peer.system.starts_with("OpenMVG") && peer.score.registered > 0);
        openmvg_cpu += openmvg.map(Outcome::cpu).fold(f64::INFINITY, f64::min);
    }
    let mean = auc_differences.iter().sum::<f64>() / auc_differences.len() as f64;
    checks.push(Check::at_least("mean over the sets: AUC at 1°, ours − best peer", mean, 0.0));
    checks.push(Check::at_most("sum over the sets: processor s / COLMAP incremental's", cpu / colmap_cpu, 0.1));
    checks.push(Check::at_most("sum over the sets: processor s / OpenMVG-rs's cheaper mapper", cpu / openmvg_cpu, 0.6));
    checks
}
