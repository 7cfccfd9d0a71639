//! Panoramas by OpenCV's Stitcher, Hugin's command line tools and ours on the same photographs, and ours on generated photographs with ground truth. Writes the
//! section “Panoramas” of `docs/benchmarks.md`.
//!
//! Hugin takes half a minute for a set: its output is cached in `peers-panorama` of the target folder until its script changes.

use super::panorama_border;
use super::panorama_people::{self, People};
use super::panorama_truth::{self, Truth};
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_core::RgbU8;
use cv_synth::{Vista, VistaOptions, vista_photos};
use serde::{Deserialize, Serialize};
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::process::Command;

const THREADS: usize = 2;
/// Real sets below `panorama` of the data, in which OpenCV registers all photographs.
const SETS: [&str; 4] = ["weir", "umd-set1", "umd-set3", "carpark"];
/// The other real sets, on which only our result is checked.
const OTHER_SETS: [&str; 4] = ["parrington", "myself", "train", "uav"];

/// Runs of each system on a set, of which the fastest counts; of the large set there is one.
const RUNS: usize = 7;

/// Name of the share of pixels that lost what a photograph shows.
const LOST: &str = "share of pixels unclipped in some photograph that are clipped or flat";

/// Name of the generated set of large photographs.
const LARGE: &str = "generated, 8 of 12 Mpx";

/// Result and cost of one system on a set.
#[derive(Debug, Clone, Serialize, Deserialize)]
struct Outcome {
    #[serde(default)]
    version: String,
    used: usize,
    size: (usize, usize),
    /// Mean gray level of the pixels that are not black.
    mean: f64,
    #[serde(default)]
    seconds: f64,
    #[serde(default)]
    cpu: f64,
    #[serde(default)]
    peak: f64,
}

/// Results of all systems on a set.
struct Compared {
    name: &'static str,
    photographs: usize,
    /// Smallest and largest mean gray level of a photograph.
    means: (f64, f64),
    /// Share of the pixels unclipped in some photograph that are clipped or flat in our panorama.
    lost: f64,
    systems: Vec<(&'static str, Outcome)>,
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let program = super::release_program()?;
    let cache = crate::target_dir()?.join("peers-panorama");
    let load = super::machine_load();
    let mut sets = Vec::new();
    for name in SETS {
        println!("{name}");
        let photographs = photographs_of(data, name)?;
        sets.push(compare(name, &photographs, python, &program, &cache)?);
    }
    let mut others = Vec::new();
    for name in OTHER_SETS {
        println!("{name}");
        let images = read_all(&photographs_of(data, name)?)?;
        let (result, lost) = panorama_truth::panorama_with_lost_share(&images)?;
        let used = result.images.iter().filter(|image| image.used).count() as f64;
        others.push(Check::at_least(format!("{name}: photographs used"), used, images.len() as f64));
        others.extend(mean_checks(name, mean_level(result.image.pixels()), range_of_means(&images)));
        others.push(Check::at_most(format!("{name}: {LOST}"), lost, 0.005));
        if panorama_border::is_full_circle(&result) {
            let step = panorama_border::relative_step(&result.image, &result.mask);
            let figure = "step at the border of 360° / largest between columns within 40 px of it";
            others.push(Check::at_most(format!("{name}: {figure}"), step, 1.0));
        }
    }
    let poisson = poisson_ratio(data, python, &program, &cache)?;
    println!("{LARGE}");
    let photographs = render_large_set(&cache)?;
    sets.push(compare(LARGE, &photographs, python, &program, &cache)?);
    let truths: Vec<(&str, Truth)> = panorama_truth::SETS
        .iter()
        .map(|(name, options)| {
            println!("{name}");
            Ok((*name, panorama_truth::measure(options)?))
        })
        .collect::<Result<_>>()?;
    println!("{} sets with people", panorama_people::SETS);
    let people = panorama_people::measure()?;
    let mut checks = checks(&sets, &truths, &people);
    checks.extend(others);
    checks.push(Check::at_most("Poisson blending, s per Mpx / seamlessClone's", poisson, 0.1));
    let text = page(&sets, &truths, &checks, &load);
    print!("{text}");
    super::write_section("Panoramas", &text)?;
    Ok(checks)
}

/// Returns the files of a set, sorted.
fn photographs_of(data: &Path, name: &str) -> Result<Vec<PathBuf>> {
    let folder = std::fs::read_dir(data.join("panorama").join(name)).with_context(|| name.to_owned())?;
    let mut photographs: Vec<PathBuf> = folder.map(|entry| Ok(entry?.path())).collect::<Result<_>>()?;
    photographs.sort();
    Ok(photographs)
}

fn read_all(photographs: &[PathBuf]) -> Result<Vec<RgbU8>> {
    photographs.iter().map(|path| Ok(cv_io::read_rgb(path)?)).collect()
}

/// Returns the smallest and the largest mean gray level.
fn range_of_means(images: &[RgbU8]) -> (f64, f64) {
    let means = images.iter().map(|image| mean_level(image.pixels()));
    means.fold((f64::MAX, 0.0), |(low, high), mean| (low.min(mean), high.max(mean)))
}

/// Returns the seconds per megapixel of our Poisson blending, over all sets, relative to OpenCV's `seamlessClone`; the fastest of three runs each.
fn poisson_ratio(data: &Path, python: &Path, program: &Path, cache: &Path) -> Result<f64> {
    let (mut seconds, mut megapixels) = (0.0, 0.0);
    for name in SETS {
        let mut fastest = f64::INFINITY;
        let mut size = [0.0; 2];
        for _ in 0..3 {
            let output = Command::new(program)
                .args(["panorama", "--json", "--quiet", "--blend", "poisson", "--threads", &THREADS.to_string(), "-o"])
                .arg(cache.join("poisson.png"))
                .args(photographs_of(data, name)?)
                .output()?;
            ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            let value: serde_json::Value = serde_json::from_slice(&output.stdout)?;
            fastest = value["seconds"]["blend"].as_f64().context("no time of blending")?.min(fastest);
            size = [0, 1].map(|i| value["size"][i].as_f64().unwrap_or(0.0));
        }
        seconds += fastest;
        megapixels += size[0] * size[1] / 1e6;
    }
    let photographs = photographs_of(data, SETS[0])?;
    let output = Command::new(python)
        .arg(crate::root().join("peers/poisson_opencv.py"))
        .arg(THREADS.to_string())
        .args(&photographs[..2])
        .output()
        .context("cannot start Python")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let opencv: f64 = String::from_utf8(output.stdout)?.trim().parse()?;
    Ok(seconds / megapixels / opencv)
}

/// Renders eight photographs of 12 megapixels, unless their files exist.
fn render_large_set(cache: &Path) -> Result<Vec<PathBuf>> {
    let folder = cache.join("large-70");
    let paths: Vec<PathBuf> = (0..8).map(|i| folder.join(format!("{i}.jpg"))).collect();
    if paths.iter().all(|path| path.exists()) {
        return Ok(paths);
    }
    std::fs::create_dir_all(&folder)?;
    // At an overlap of 45 % or with a wide angle OpenCV's ORB features connect two to five of the eight photographs.
    let camera = cv_core::Camera::from_focal(4000, 3000, 6000.0);
    let options = VistaOptions { samples: 1, overlap: 0.7, ..VistaOptions::default() };
    for (path, photo) in paths.iter().zip(vista_photos(&Vista::new(5, 800.0), 5, &camera, &options)?) {
        cv_io::write_jpeg(path, photo.image.view())?;
    }
    Ok(paths)
}

fn compare(
    name: &'static str,
    photographs: &[PathBuf],
    python: &Path,
    program: &Path,
    cache: &Path,
) -> Result<Compared> {
    let folder = cache.join(name.replace([' ', ','], "-"));
    std::fs::create_dir_all(&folder)?;
    let scripts = crate::root().join("peers");
    let images = read_all(photographs)?;
    let (_, lost) = panorama_truth::panorama_with_lost_share(&images)?;
    let means = range_of_means(&images);
    drop(images);
    let run_opencv = |mode: &str| -> Result<Outcome> {
        let output = Command::new(python)
            .arg(scripts.join("panorama_opencv.py"))
            .args([mode, &THREADS.to_string()])
            .arg(folder.join(format!("opencv-{mode}.png")))
            .args(photographs)
            .output()
            .context("cannot start Python")?;
        ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        Ok(serde_json::from_slice(&output.stdout)?)
    };
    let mut opencv = run_opencv("panorama")?;
    // With the projection and the number of pixels of OpenCV's panorama.
    let first = run_ours(python, program, &folder, photographs, 1.0)?;
    let pixels = |size: (usize, usize)| (size.0 * size.1) as f64;
    let scale = match opencv.used == photographs.len() {
        true => (pixels(opencv.size) / pixels(first.size)).sqrt().clamp(0.5, 2.0),
        false => 1.0,
    };
    let mut ours = run_ours(python, program, &folder, photographs, scale)?;
    let mut scans = run_opencv("scans")?;
    // In turns, since the load of the machine varies.
    for _ in 1..if name == LARGE { 1 } else { RUNS } {
        keep_fastest(&mut opencv, run_opencv("panorama")?);
        keep_fastest(&mut ours, run_ours(python, program, &folder, photographs, scale)?);
        keep_fastest(&mut scans, run_opencv("scans")?);
    }
    let ours = Outcome { mean: first.mean, ..ours };
    let mut systems = vec![("ours", ours), ("OpenCV", opencv), ("OpenCV, scans", scans)];
    // Not on the large set, which would take minutes and serves only the comparison of times.
    if name != LARGE
        && let Some(outcome) = run_hugin(python, &folder, photographs)?
    {
        systems.push(("Hugin", outcome));
    }
    Ok(Compared { name, photographs: photographs.len(), means, lost, systems })
}

/// Replaces a run by the next if that took less processor time.
fn keep_fastest(fastest: &mut Outcome, next: Outcome) {
    if next.cpu < fastest.cpu {
        *fastest = next;
    }
}

/// Runs Hugin or reads its cached result; `None` if it is not installed.
fn run_hugin(python: &Path, folder: &Path, photographs: &[PathBuf]) -> Result<Option<Outcome>> {
    let script = crate::root().join("peers/panorama_hugin.py");
    let (printed, stamp) = (folder.join("hugin.json"), folder.join("hugin.stamp"));
    let text = std::fs::read_to_string(&script)?;
    if std::fs::read_to_string(&stamp).is_ok_and(|cached| cached == text) {
        return Ok(serde_json::from_str(&std::fs::read_to_string(&printed)?).ok());
    }
    let out = folder.join("hugin.tif");
    let output =
        Command::new(python).arg(&script).arg(&out).args(photographs).output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let Ok(mut outcome) = serde_json::from_slice::<Outcome>(&output.stdout) else {
        println!("  Hugin is not installed: left out");
        return Ok(None);
    };
    if outcome.used > 0 {
        let image = cv_io::read_rgb(&out)?;
        (outcome.size, outcome.mean) = (image.size(), mean_level(image.pixels()));
    }
    std::fs::write(printed, serde_json::to_string(&outcome)?)?;
    std::fs::write(stamp, text)?;
    Ok(Some(outcome))
}

/// Runs our program from input files to output file, with the option `--scale`.
fn run_ours(python: &Path, program: &Path, folder: &Path, photographs: &[PathBuf], scale: f64) -> Result<Outcome> {
    #[derive(Deserialize)]
    struct Cost {
        seconds: f64,
        cpu: f64,
        peak: f64,
    }
    let (out, printed) = (folder.join("ours.png"), folder.join("ours.json"));
    let output = Command::new(python)
        .arg(crate::root().join("peers/measure.py"))
        .arg(&printed)
        .arg(program)
        .args(["panorama", "--json", "--quiet", "--projection", "spherical"])
        .args(["--threads", &THREADS.to_string(), "--scale", &format!("{scale:.4}"), "-o"])
        .arg(&out)
        .args(photographs)
        .output()
        .context("cannot start Python")?;
    ensure!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let cost: Cost = serde_json::from_slice(&output.stdout)?;
    let value: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(printed)?)?;
    let used = value["images"].as_array().map_or(0, |all| all.iter().filter(|image| image["used"] == true).count());
    let image = cv_io::read_rgb(&out)?;
    Ok(Outcome {
        version: String::new(),
        used,
        size: image.size(),
        mean: mean_level(image.pixels()),
        seconds: cost.seconds,
        cpu: cost.cpu,
        peak: cost.peak,
    })
}

/// Computes the mean gray level of the pixels that are not black.
fn mean_level(pixels: impl Iterator<Item = [u8; 3]>) -> f64 {
    let (mut sum, mut n) = (0_u64, 0_u64);
    for p in pixels.filter(|p| *p != [0; 3]) {
        sum += p.iter().map(|v| u64::from(*v)).sum::<u64>();
        n += 3;
    }
    sum as f64 / n.max(1) as f64
}

/// Checks that the mean level of a panorama lies in the range of its photographs' means, with half a gray level of tolerance for rounding.
fn mean_checks(name: &str, mean: f64, (darkest, brightest): (f64, f64)) -> [Check; 2] {
    [
        Check::at_least(format!("{name}: mean level, at least the darkest photograph's"), mean, darkest - 0.5),
        Check::at_most(format!("{name}: mean level, at most the brightest photograph's"), mean, brightest + 0.5),
    ]
}

fn checks(sets: &[Compared], truths: &[(&str, Truth)], people: &People) -> Vec<Check> {
    let mut checks = Vec::new();
    for set in sets {
        let (name, count) = (set.name, set.photographs as f64);
        let find = |system: &str| set.systems.iter().find(|(s, _)| *s == system).map(|(_, outcome)| outcome);
        let (Some(ours), Some(opencv)) = (find("ours"), find("OpenCV")) else { continue };
        checks.push(Check::at_least(format!("{name}: photographs used"), ours.used as f64, count));
        checks.extend(mean_checks(name, ours.mean, set.means));
        checks.push(Check::at_most(format!("{name}: {LOST}"), set.lost, 0.005));
        // Costs are compared only if both use all photographs.
        if opencv.used == set.photographs {
            checks.push(Check::at_most(format!("{name}: processor s / OpenCV's"), ours.cpu / opencv.cpu, 0.6));
            checks.push(Check::at_most(format!("{name}: peak memory / OpenCV's"), ours.peak / opencv.peak, 1.0));
        }
    }
    for (name, t) in truths {
        checks.push(Check::at_least(format!("{name}: photographs used"), t.used, t.photographs));
        checks.push(Check::at_most(format!("{name}: drift of 48 px blocks, median, px"), t.drift.0, 0.3));
        checks.push(Check::at_most(format!("{name}: drift of 48 px blocks, 95th percentile, px"), t.drift.1, 1.0));
        checks.push(Check::at_least(format!("{name}: PSNR after a gain per channel, dB"), t.psnr, t.min_psnr));
        checks.push(Check::at_most(
            format!("{name}: step at seams in smooth regions, 95th percentile, gray levels"),
            t.step,
            1.5,
        ));
        checks.push(Check::at_most(format!("{name}: {LOST}"), t.lost, 0.005));
    }
    checks.push(Check::at_least(
        format!(
            "sets with every person whole or absent ({} whole, {} absent, {} cut)",
            people.whole, people.absent, people.cut
        ),
        people.sets as f64,
        panorama_people::SETS as f64,
    ));
    checks
}

fn page(sets: &[Compared], truths: &[(&str, Truth)], checks: &[Check], load: &str) -> String {
    let mut versions: Vec<&str> =
        sets.iter().flat_map(|s| &s.systems).map(|(_, o)| &o.version[..]).filter(|v| !v.is_empty()).collect();
    versions.sort_unstable();
    versions.dedup();
    let mut text = format!(
        "Written by `cargo xtask peers panorama`; one run, ours and OpenCV alternating, the fastest of {RUNS} for the small sets, {THREADS} threads each, {}, {}. The same photographs for all, from the input files to the panorama's file, reading and writing \
         included; ours on OpenCV's projection surface with the same number of pixels. OpenCV's time excludes the startup of Python; the load was {load} at the start of the run; Hugin runs the steps of its assistant, its figures are of an earlier run on this machine. \
         Level: mean gray level of the pixels that are not black; in parentheses the range of the photographs' means.\n\n\
         | set | system | used | size | level | processor s | wall s | peak MiB |\n|---|---|---|---|---|---|---|---|\n",
        super::machine(),
        versions.join(", "),
    );
    for set in sets {
        for (system, o) in &set.systems {
            let (name, all, (low, high)) = (set.name, set.photographs, set.means);
            if o.used == 0 {
                let _ = writeln!(text, "| {name} | {system} | 0 of {all} | | | {:.1} | {:.1} | |", o.cpu, o.seconds);
                continue;
            }
            let _ = writeln!(
                text,
                "| {name} | {system} | {} of {all} | {} × {} | {:.0} ({low:.0} to {high:.0}) | {:.2} | {:.2} | {:.0} |",
                o.used,
                o.size.0,
                o.size.1,
                o.mean,
                o.cpu,
                o.seconds,
                o.peak / 1024.0 / 1024.0
            );
        }
    }
    text.push_str(
        "\nGenerated landscapes with known radiance and geometry: a camera response of sRGB with an S-shaped tone curve, vignetting by a third in the corners, radial distortion, white balance errors up to \
         4 %. Drift: displacement of blocks of 48 px after alignment by one rotation. PSNR: over pixels that are clipped in no photograph, after one gain per channel.\n\n\
         | set | used | drift, median | drift, 95th percentile | PSNR | step at seams, 95th percentile |\n|---|---|---|---|---|---|\n",
    );
    for (name, t) in truths {
        let _ = writeln!(
            text,
            "| {name} | {} of {} | {:.2} px | {:.2} px | {:.1} dB | {:.1} |",
            t.used, t.photographs, t.drift.0, t.drift.1, t.psnr, t.step
        );
    }
    text.push_str("\n| figure | measured | target | |\n|---|---|---|---|\n");
    for c in checks {
        let verdict = if c.ok { "met" } else { "**not met**" };
        let target = c.target.replace("<=", "≤").replace(">=", "≥");
        let _ = writeln!(text, "| {} | {:.3} | {target} | {verdict} |", c.name, c.figure);
    }
    text
}
