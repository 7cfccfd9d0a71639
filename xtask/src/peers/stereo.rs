//! OpenCV's matchers, Pandora and ours on the same pairs: ours and OpenCV's alternating (A B A B) within one run; Pandora,
//! which takes seconds, once. Writes the section "Stereo" of `docs/benchmarks.md`.

use crate::checks::Check;
use crate::real::depth::{SCENES, Scene, truth};
use anyhow::{Context, Result, ensure};
use cv_core::{GrayU8, Silent};
use cv_pipeline::stereo::{DisparityMap, Paths, PixelState, StereoMatcher, StereoOptions, evaluate_disparity};
use cv_stereo::PathSums;
use serde::Deserialize;
use std::{fmt::Write as _, path::Path, process::Command, time::Instant};

/// Result of one matcher on one pair.
#[derive(Debug, Clone, Deserialize)]
struct Line {
    scene: String,
    mode: String,
    seconds: f64,
    /// Fraction of the evaluated pixels with a disparity; for ours, with a matched, not a filled one.
    density: f64,
    bad1: f64,
    bad2: f64,
    bad2_of_valid: f64,
    #[serde(default)]
    version: String,
}

const OURS_8: &str = "ours, 8 paths";
const OURS_4: &str = "ours, 4 paths";
const ROUNDS: usize = 3;

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let folder = data.join("stereo");
    let scripts = crate::root().join("peers");
    let pool = two_threads()?;
    let load = super::machine_load();
    let mut best: Vec<Line> = Vec::new();
    for round in 0..ROUNDS {
        println!("round {} of {ROUNDS}", round + 1);
        for scene in &SCENES {
            for (mode, paths) in [(OURS_8, Paths::Eight), (OURS_4, Paths::Four)] {
                keep_fastest(&mut best, pool.install(|| run_ours(&folder, scene, mode, paths))?);
            }
        }
        for line in script(python, &scripts.join("stereo_opencv.py"), &[path_of(&folder)?])? {
            keep_fastest(&mut best, line);
        }
    }
    match script(python, &scripts.join("stereo_pandora.py"), &[path_of(&folder)?]) {
        Ok(lines) => lines.into_iter().for_each(|line| keep_fastest(&mut best, line)),
        Err(error) => println!("Pandora left out: {error:#}"),
    }
    let hh_bytes = memory_of_hh(python, &scripts, &folder)?;
    let motorcycle = &SCENES[3];
    let matcher = StereoMatcher::new(StereoOptions { disparities: motorcycle.disparities, ..Default::default() })?;
    let our_bytes = matcher.memory(741, 500) as f64;

    let seconds =
        |mode: &str| best.iter().find(|l| l.scene == "motorcycle" && l.mode == mode).map_or(f64::NAN, |l| l.seconds);
    let (eight, four) = (seconds(OURS_8), seconds(OURS_4));
    let targets = [
        ("8 paths with all checks / OpenCV 3WAY, 741×500×128", eight / seconds("3WAY"), 0.8),
        ("8 paths with all checks / OpenCV HH", eight / seconds("HH"), 0.2),
        ("4 paths with all checks / OpenCV 3WAY", four / seconds("3WAY"), 0.5),
        ("memory / OpenCV HH", our_bytes / hh_bytes, 0.6),
    ];
    let mut section = page(&best, &targets, our_bytes, hh_bytes, &load);
    pool.install(|| measure_scaling(&mut section))?;
    pool.install(|| measure_bandwidth(&mut section, &folder, motorcycle))?;
    print!("{section}");
    super::write_section("Stereo", &section)?;
    Ok(targets.map(|(name, ratio, limit)| Check::at_most(name, ratio, limit)).to_vec())
}

/// Builds a pool of two threads, the number that the peers use.
fn two_threads() -> Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new().num_threads(2).build().context("cannot start two threads")
}

fn path_of(path: &Path) -> Result<&str> {
    path.to_str().with_context(|| format!("{} is not text", path.display()))
}

/// Keeps the faster of two runs of the same matcher on the same pair.
fn keep_fastest(best: &mut Vec<Line>, line: Line) {
    match best.iter_mut().find(|l| l.scene == line.scene && l.mode == line.mode) {
        Some(known) if known.seconds <= line.seconds => {}
        Some(known) => *known = line,
        None => best.push(line),
    }
}

/// Runs a script that prints a JSON object per line.
fn script(python: &Path, file: &Path, args: &[&str]) -> Result<Vec<Line>> {
    output(python, file, args)?
        .lines()
        .filter(|line| line.starts_with('{'))
        .map(|line| serde_json::from_str(line).with_context(|| line.to_owned()))
        .collect()
}

fn output(python: &Path, file: &Path, args: &[&str]) -> Result<String> {
    let output = Command::new(python).arg(file).args(args).output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}: {}", file.display(), String::from_utf8_lossy(&output.stderr));
    Ok(String::from_utf8(output.stdout)?)
}

fn memory_of_hh(python: &Path, scripts: &Path, folder: &Path) -> Result<f64> {
    #[derive(Deserialize)]
    struct Memory {
        bytes: f64,
    }
    let text = output(python, &scripts.join("stereo_opencv.py"), &[path_of(folder)?, "memory"])?;
    Ok(serde_json::from_str::<Memory>(text.trim())?.bytes)
}

/// Seconds for which a matcher is repeated on a pair to find its fastest run, and the minimum number of repeats; the scripts use
/// the same. Runs of 10 ms are disturbed too often for the fastest of three.
const SECONDS: f64 = 0.5;
const MIN_REPEATS: usize = 4;

/// Returns the seconds of the fastest run; the first run only warms up.
fn fastest_run(mut run: impl FnMut() -> Result<()>) -> Result<f64> {
    let (all, mut best) = (Instant::now(), f64::INFINITY);
    let mut repeats = 0;
    while repeats < MIN_REPEATS || all.elapsed().as_secs_f64() < SECONDS {
        let start = Instant::now();
        run()?;
        if repeats > 0 {
            best = best.min(start.elapsed().as_secs_f64());
        }
        repeats += 1;
    }
    Ok(best)
}

/// Measures our matcher with its default options.
fn run_ours(folder: &Path, scene: &Scene, mode: &str, paths: Paths) -> Result<Line> {
    let (truth, mask) = truth(folder, scene)?;
    let left = cv_io::read_rgb(folder.join(scene.left))?;
    let right = cv_io::read_rgb(folder.join(scene.right))?;
    let options = StereoOptions { disparities: scene.disparities, paths, ..Default::default() };
    let mut matcher = StereoMatcher::new(options)?;
    let mut map = DisparityMap::empty();
    let seconds = fastest_run(|| Ok(matcher.compute_into(left.view(), right.view(), &mut map, &Silent)?))?;
    let all = evaluate_disparity(map.disparity.view(), truth.view(), Some(mask.view()))?;
    let matched = cv_core::Mask::from_fn(mask.width(), mask.height(), |x, y| {
        [mask.at(x, y)[0] && map.state.at(x, y)[0] == PixelState::Matched]
    });
    let matched_only = evaluate_disparity(map.disparity.view(), truth.view(), Some(matched.view()))?;
    Ok(Line {
        scene: scene.name.to_owned(),
        mode: mode.to_owned(),
        seconds,
        density: matched_only.pixels as f64 / all.pixels as f64,
        bad1: all.bad[1],
        bad2: all.bad[2],
        bad2_of_valid: matched_only.bad[2],
        version: env!("CARGO_PKG_VERSION").to_owned(),
    })
}

fn page(lines: &[Line], targets: &[(&str, f64, f64)], our_bytes: f64, hh_bytes: f64, load: &str) -> String {
    let mut text =
        String::from("Written by `cargo xtask peers stereo`; every figure comes from one run on one machine.\n\n");
    let version = |mode: &str| lines.iter().find(|l| l.mode == mode).map_or("", |l| l.version.as_str());
    // `fmt::Write` on a String cannot fail.
    let _ = writeln!(
        text,
        "{}, load {load} before the run (times are lower on an idle machine; compare them as ratios). Two threads, ours and OpenCV {} \
         alternating, the fastest warm run of {ROUNDS} × {SECONDS} s; Pandora as a whole run, once.\n",
        super::machine(),
        version("3WAY"),
    );
    text.push_str(
        "A pixel without a disparity counts as bad. Evaluated pixels: those visible in both views if the right view has ground truth (cones, cloth3), \
         else all with ground truth.\nFor ours, density and “bad-2.0 of valid” are over matched pixels; bad-1.0 and bad-2.0 include \
         filled pixels.\n\n| scene | matcher | bad-1.0 | bad-2.0 | density | bad-2.0 of valid | time |\n|---|---|---|---|---|---|---|\n",
    );
    for scene in &SCENES {
        for line in lines.iter().filter(|l| l.scene == scene.name) {
            let _ = writeln!(
                text,
                "| {} | {} | {:.2} % | {:.2} % | {:.1} % | {:.2} % | {:.1} ms |",
                line.scene,
                line.mode,
                100.0 * line.bad1,
                100.0 * line.bad2,
                100.0 * line.density,
                100.0 * line.bad2_of_valid,
                1e3 * line.seconds
            );
        }
    }
    let _ = writeln!(
        text,
        "\nWorking set at 741×500×128: ours {:.0} MiB, OpenCV HH {:.0} MiB (rise of the peak resident size).\n\n| ratio | measured | target |\n|---|---|---|",
        our_bytes / 1048576.0,
        hh_bytes / 1048576.0
    );
    for (name, ratio, limit) in targets {
        let _ = writeln!(text, "| {name} | {ratio:.2} | {limit} |");
    }
    text
}

/// Measures the time per pixel and disparity from 0.1 to 8 megapixels, with allocated buffers. The sizes alternate, so that a
/// disturbance of the machine does not affect one size alone.
fn measure_scaling(text: &mut String) -> Result<()> {
    const SIZES: [(usize, usize); 6] = [(366, 274), (742, 500), (1156, 866), (1634, 1224), (2312, 1730), (3264, 2450)];
    const PATHS: [Paths; 2] = [Paths::Eight, Paths::Four];
    let noise = |x: usize, y: usize| (x * 7919 + y * 104_729 + x * y % 97 * 31).wrapping_mul(2_654_435_761) >> 13;
    let mut figures = [[f64::INFINITY; PATHS.len()]; SIZES.len()];
    for _ in 0..ROUNDS {
        for (&(width, height), figures) in SIZES.iter().zip(&mut figures) {
            let pair = [0, 20].map(|by| GrayU8::from_fn(width, height, |x, y| [noise((x + by) / 3, y / 3) as u8]));
            for (paths, figure) in PATHS.into_iter().zip(figures) {
                let mut matcher = StereoMatcher::new(StereoOptions { paths, ..Default::default() })?;
                let mut map = DisparityMap::empty();
                let seconds =
                    fastest_run(|| Ok(matcher.compute_into(pair[0].view(), pair[1].view(), &mut map, &Silent)?))?;
                *figure = figure.min(1e9 * seconds / (width * height * matcher.options().disparities) as f64);
            }
        }
    }
    text.push_str("\n| megapixels | 8 paths, ns per pixel and disparity | 4 paths |\n|---|---|---|\n");
    for ((width, height), [eight, four]) in SIZES.iter().zip(figures) {
        let _ = writeln!(text, "| {:.2} | {eight:.3} | {four:.3} |", (width * height) as f64 / 1e6);
    }
    let [a, b] = [0, 1].map(|i| {
        let of = |pick: fn(f64, f64) -> f64, start| figures.iter().map(|f| f[i]).fold(start, pick);
        100.0 * (of(f64::max, 0.0) / of(f64::min, f64::INFINITY) - 1.0)
    });
    let _ = writeln!(
        text,
        "\nThe fastest warm run of {ROUNDS} × {SECONDS} s at each size, the sizes alternating. The slowest size is {a:.0} % (4 paths \
         {b:.0} %) above the fastest; the target is at most 15 %."
    );
    Ok(())
}

/// Compares the time of aggregation, with and without cost computation and winner-takes-all, with the time to copy as many bytes.
fn measure_bandwidth(text: &mut String, folder: &Path, scene: &Scene) -> Result<()> {
    // A copy on both cores: aggregation writes the sums once and reads them once.
    let from = vec![1u8; 256 << 20];
    let mut to = vec![0u8; from.len()];
    let mut seconds = f64::INFINITY;
    for _ in 0..5 {
        let start = Instant::now();
        let chunk = from.len() / 2;
        let (a, b) = to.split_at_mut(chunk);
        rayon::join(|| a.copy_from_slice(&from[..chunk]), || b.copy_from_slice(&from[chunk..]));
        seconds = seconds.min(start.elapsed().as_secs_f64());
    }
    let rate = 2.0 * from.len() as f64 / seconds;
    let left = cv_io::read_rgb(folder.join(scene.left))?;
    let right = cv_io::read_rgb(folder.join(scene.right))?;
    let traffic = 2.0 * (left.width() * left.height() * scene.disparities) as f64;
    let _ = writeln!(
        text,
        "\nCopying memory on both cores reaches {:.1} GB/s.\n\nThe stage `aggregate` computes the matching costs (twice), aggregates them along the paths, sums \
         the path costs and selects the winners of both views. At 741×500×128 the sums are written once and read once: {:.0} MB, {:.1} ms at \
         that rate.",
        rate / 1e9,
        traffic / 1e6,
        1e3 * traffic / rate,
    );
    for (name, paths) in [("8", Paths::Eight), ("4", Paths::Four)] {
        let mut matcher =
            StereoMatcher::new(StereoOptions { disparities: scene.disparities, paths, ..Default::default() })?;
        let mut map = DisparityMap::empty();
        let mut stages: Vec<(&str, f64)> = Vec::new();
        for _ in 0..12 {
            matcher.compute_into(left.view(), right.view(), &mut map, &Silent)?;
            if stages.is_empty() {
                stages = matcher.stages().to_vec();
            }
            for (best, now) in stages.iter_mut().zip(matcher.stages()) {
                best.1 = best.1.min(now.1);
            }
        }
        let list: Vec<String> = stages.iter().map(|(stage, s)| format!("{stage} {:.1} ms", 1e3 * s)).collect();
        let aggregate = stages.iter().find(|(stage, _)| *stage == "aggregate");
        let ratio = aggregate.map_or(f64::NAN, |(_, s)| s * rate / traffic);
        let _ = writeln!(text, "{name} paths: {}; `aggregate` takes {ratio:.1} times the copy time.", list.join(", "));
    }
    let gray = cv_imgproc::rgb_to_gray(left.view());
    text.push_str(
        "\nAggregation alone, from precomputed costs and without winner-takes-all: each of the two passes reads the costs of all pixels, \
         aggregates along half of the paths and writes the sums.\n",
    );
    for (name, paths) in [("8", Paths::Eight), ("4", Paths::Four)] {
        let options = StereoOptions { disparities: scene.disparities, paths, ..Default::default() };
        // Costs in the range of the census distance; the time does not depend on them.
        let mut sums =
            PathSums::new(options, gray.view(), |x, y, k| ((x * 7919 + y * 104_729 + k * 31) % 97 % 25) as u8)?;
        let seconds = fastest_run(|| {
            sums.run(&Silent)?;
            Ok(())
        })?;
        let (traffic, ratio) = (sums.traffic() as f64, seconds * rate / sums.traffic() as f64);
        let _ = writeln!(
            text,
            "{name} paths: {:.1} ms; copying {:.0} MB takes {:.1} ms; ratio {ratio:.1} (target: at most 2).",
            1e3 * seconds,
            traffic / 1e6,
            1e3 * traffic / rate,
        );
    }
    Ok(())
}
