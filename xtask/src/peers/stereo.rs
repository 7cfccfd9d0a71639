//! OpenCV's matchers, Pandora and ours on the same pairs: ours and OpenCV's in turns (A B A B) within one run, Pandora,
//! which takes seconds, once. Writes the section "Stereo" of `docs/benchmarks.md`.

use crate::checks::Check;
use crate::real::depth::{SCENES, Scene, truth};
use anyhow::{Context, Result, ensure};
use cv_core::{GrayU8, Silent};
use cv_pipeline::stereo::{DisparityMap, Paths, PixelState, StereoMatcher, StereoOptions, evaluate_disparity};
use cv_stereo::PathSums;
use serde::Deserialize;
use std::{fmt::Write as _, path::Path, process::Command, time::Instant};

/// What a matcher reaches on a pair.
#[derive(Debug, Clone, Deserialize)]
struct Line {
    scene: String,
    mode: String,
    seconds: f64,
    /// Share of the counted pixels with a disparity; for ours, with one that is matched and not filled.
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
                keep(&mut best, pool.install(|| ours(&folder, scene, mode, paths))?);
            }
        }
        for line in script(python, &scripts.join("stereo_opencv.py"), &[path_of(&folder)?])? {
            keep(&mut best, line);
        }
    }
    match script(python, &scripts.join("stereo_pandora.py"), &[path_of(&folder)?]) {
        Ok(lines) => lines.into_iter().for_each(|line| keep(&mut best, line)),
        Err(error) => println!("Pandora left out: {error:#}"),
    }
    let hh_bytes = memory_of_hh(python, &scripts, &folder)?;
    let motorcycle = &SCENES[3];
    let matcher = StereoMatcher::new(StereoOptions { disparities: motorcycle.disparities, ..Default::default() })?;
    let our_bytes = matcher.memory(741, 500) as f64;

    let seconds =
        |mode: &str| best.iter().find(|l| l.scene == "motorcycle" && l.mode == mode).map_or(f64::NAN, |l| l.seconds);
    let (eight, four) = (seconds(OURS_8), seconds(OURS_4));
    let bars = [
        ("8 paths with all checks / OpenCV 3WAY, 741×500×128", eight / seconds("3WAY"), 0.8),
        ("8 paths with all checks / OpenCV HH", eight / seconds("HH"), 0.2),
        ("4 paths with all checks / OpenCV 3WAY", four / seconds("3WAY"), 0.5),
        ("memory / OpenCV HH", our_bytes / hh_bytes, 0.6),
    ];
    let mut section = page(&best, &bars, our_bytes, hh_bytes, &load);
    pool.install(|| scaling(&mut section))?;
    pool.install(|| bandwidth(&mut section, &folder, motorcycle))?;
    print!("{section}");
    super::write_section("Stereo", &section)?;
    Ok(bars.map(|(name, ratio, bar)| Check::at_most(name, ratio, bar)).to_vec())
}

/// Two threads, as the peers have.
fn two_threads() -> Result<rayon::ThreadPool> {
    rayon::ThreadPoolBuilder::new().num_threads(2).build().context("cannot start two threads")
}

fn path_of(path: &Path) -> Result<&str> {
    path.to_str().with_context(|| format!("{} is not text", path.display()))
}

/// Keeps the faster of two runs of the same matcher on the same pair.
fn keep(best: &mut Vec<Line>, line: Line) {
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

/// How long a matcher is repeated on a pair for its fastest run, and how often at the least; the scripts do the same. Runs
/// of 10 ms are disturbed too often for three of them to tell.
const SECONDS: f64 = 0.5;
const LEAST_REPEATS: usize = 4;

/// The fastest of some runs, the first of which only warms up.
fn fastest(mut run: impl FnMut() -> Result<()>) -> Result<f64> {
    let (all, mut best) = (Instant::now(), f64::INFINITY);
    let mut repeats = 0;
    while repeats < LEAST_REPEATS || all.elapsed().as_secs_f64() < SECONDS {
        let start = Instant::now();
        run()?;
        if repeats > 0 {
            best = best.min(start.elapsed().as_secs_f64());
        }
        repeats += 1;
    }
    Ok(best)
}

/// Our matcher with its default options.
fn ours(folder: &Path, scene: &Scene, mode: &str, paths: Paths) -> Result<Line> {
    let (truth, mask) = truth(folder, scene)?;
    let left = cv_io::read_rgb(folder.join(scene.left))?;
    let right = cv_io::read_rgb(folder.join(scene.right))?;
    let options = StereoOptions { disparities: scene.disparities, paths, ..Default::default() };
    let mut matcher = StereoMatcher::new(options)?;
    let mut map = DisparityMap::empty();
    let seconds = fastest(|| Ok(matcher.compute_into(left.view(), right.view(), &mut map, &Silent)?))?;
    let all = evaluate_disparity(map.disparity.view(), truth.view(), Some(mask.view()))?;
    let matched = cv_core::Mask::from_fn(mask.width(), mask.height(), |x, y| {
        [mask.at(x, y)[0] && map.state.at(x, y)[0] == PixelState::Matched]
    });
    let sure = evaluate_disparity(map.disparity.view(), truth.view(), Some(matched.view()))?;
    Ok(Line {
        scene: scene.name.to_owned(),
        mode: mode.to_owned(),
        seconds,
        density: sure.pixels as f64 / all.pixels as f64,
        bad1: all.bad[1],
        bad2: all.bad[2],
        bad2_of_valid: sure.bad[2],
        version: env!("CARGO_PKG_VERSION").to_owned(),
    })
}

fn page(lines: &[Line], bars: &[(&str, f64, f64)], our_bytes: f64, hh_bytes: f64, load: &str) -> String {
    let mut text =
        String::from("Written by `cargo xtask peers stereo`; every figure comes from one run on one machine.\n\n");
    let version = |mode: &str| lines.iter().find(|l| l.mode == mode).map_or("", |l| l.version.as_str());
    // `fmt::Write` on a String cannot fail.
    let _ = writeln!(
        text,
        "{}, load {load} before the run (times are lower on an idle machine; compare them as ratios). Two threads, ours and OpenCV {} in \
         turns, the fastest warm run of {ROUNDS} × {SECONDS} s; Pandora as a whole run, once.\n",
        super::machine(),
        version("3WAY"),
    );
    text.push_str(
        "A pixel without a disparity counts as bad. Pixels: those both views see where the right truth is known (cones, cloth3), \
         else all with truth.\nFor ours, density and “bad of those” are over matched pixels; bad-1.0 and bad-2.0 include the \
         filled ones.\n\n| scene | matcher | bad-1.0 | bad-2.0 | density | bad-2.0 of those | time |\n|---|---|---|---|---|---|---|\n",
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
        "\nWorking set at 741×500×128: ours {:.0} MiB, OpenCV HH {:.0} MiB (rise of the peak resident size).\n\n| ratio | measured | bar |\n|---|---|---|",
        our_bytes / 1048576.0,
        hh_bytes / 1048576.0
    );
    for (name, ratio, bar) in bars {
        let _ = writeln!(text, "| {name} | {ratio:.2} | {bar} |");
    }
    text
}

/// Time per pixel and disparity from a tenth of a megapixel to eight, all with the matcher's buffers at hand. The sizes take
/// turns, so that what disturbs the machine for a while does not meet one of them alone.
fn scaling(text: &mut String) -> Result<()> {
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
                    fastest(|| Ok(matcher.compute_into(pair[0].view(), pair[1].view(), &mut map, &Silent)?))?;
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
        "\nThe fastest warm run of {ROUNDS} × {SECONDS} s at each size, the sizes in turns. The slowest size is {a:.0} % (4 paths \
         {b:.0} %) above the fastest; the bar is 15 %."
    );
    Ok(())
}

/// What aggregation takes against the time to stream its memory traffic: with costs and winners, and alone.
fn bandwidth(text: &mut String, folder: &Path, scene: &Scene) -> Result<()> {
    // Copies on both cores, as aggregation writes the sums once and reads them once.
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
        "\nCopying on both cores reaches {:.1} GB/s.\n\nThe stage `aggregate` makes the costs, twice, extends the paths, sums \
         them up and picks the winners of both views. At 741×500×128 its sums are written once and read once, {:.0} MB, {:.1} ms at \
         that rate.",
        rate / 1e9,
        traffic / 1e6,
        1e3 * traffic / rate,
    );
    for (name, paths) in [("8", Paths::Eight), ("4", Paths::Four)] {
        let mut matcher =
            StereoMatcher::new(StereoOptions { disparities: scene.disparities, paths, ..Default::default() })?;
        let mut map = DisparityMap::empty();
        let mut best: Option<Vec<(&str, f64)>> = None;
        for _ in 0..12 {
            matcher.compute_into(left.view(), right.view(), &mut map, &Silent)?;
            let stages = matcher.stages().to_vec();
            if best.as_ref().is_none_or(|b| stages[2].1 < b[2].1) {
                best = Some(stages);
            }
        }
        let stages = best.unwrap_or_default();
        let list: Vec<String> = stages.iter().map(|(stage, s)| format!("{stage} {:.1} ms", 1e3 * s)).collect();
        let ratio = stages.get(2).map_or(f64::NAN, |s| s.1 * rate / traffic);
        let _ = writeln!(text, "{name} paths: {}; the whole stage is {ratio:.1} times the streaming.", list.join(", "));
    }
    let gray = cv_imgproc::rgb_to_gray(left.view());
    text.push_str(
        "\nAggregation alone: costs are given, and nobody picks winners. Each of the two sweeps reads the costs of all pixels, \
         extends its half of the paths and writes their sums.\n",
    );
    for (name, paths) in [("8", Paths::Eight), ("4", Paths::Four)] {
        let options = StereoOptions { disparities: scene.disparities, paths, ..Default::default() };
        // As many values as census bits have; no time depends on them.
        let mut sums =
            PathSums::new(options, gray.view(), |x, y, k| ((x * 7919 + y * 104_729 + k * 31) % 97 % 25) as u8)?;
        let seconds = fastest(|| {
            sums.run(&Silent)?;
            Ok(())
        })?;
        let (traffic, ratio) = (sums.traffic() as f64, seconds * rate / sums.traffic() as f64);
        let _ = writeln!(
            text,
            "{name} paths: {:.1} ms; {:.0} MB take {:.1} ms to stream; {ratio:.1} times the streaming (the bar is 2).",
            1e3 * seconds,
            traffic / 1e6,
            1e3 * traffic / rate,
        );
    }
    Ok(())
}
