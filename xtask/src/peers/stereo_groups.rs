//! OpenCV's matchers, Pandora and ours on every pair with ground truth, by group, the worst pairs first. Writes the section
//! "Stereo by group" of `docs/benchmarks.md`. The job `stereo` measures times.

use crate::checks::Check;
use crate::real::depth::{SCENES, truth};
use anyhow::{Context, Result, ensure};
use cv_core::{GrayF32, Mask, RgbU8, Silent};
use cv_pipeline::stereo::{PixelState, StereoOptions};
use cv_pipeline::{DepthOptions, depth};
use serde::Deserialize;
use std::{collections::BTreeMap, fmt::Write as _, fs, path::Path, process::Command, time::Instant};

/// Result of a peer on a pair: fractions of pixels with an error above 2 px.
#[derive(Debug, Clone, Deserialize)]
struct Line {
    scene: String,
    mode: String,
    visible: f64,
    all: f64,
}

/// Contents of `scene.json`.
#[derive(Debug, Deserialize)]
struct PairInfo {
    group: String,
    disparities: usize,
    min: i32,
}

/// Target of bad-2.0 in percent of the visible pixels in quality mode.
const QUALITY_TARGETS: [(&str, f64); 8] = [
    ("m3q-teddy", 2.0),
    ("m3q-jadeplant", 9.0),
    ("m3q-pipes", 4.5),
    ("m3q-playtable", 5.5),
    ("m3q-playtablep", 3.5),
    ("m3q-motorcyclee", 2.8),
    ("m3q-vintage", 12.0),
    ("m2t-midd1", 20.0),
];

/// A pair with its ground truth, and the mask of the pixels visible in both views.
struct Pair {
    name: String,
    info: PairInfo,
    photos: [RgbU8; 2],
    truth: GrayF32,
    visible: Mask,
}

/// By group: the name of each pair, and our figures in the default and in the quality mode.
type Groups = BTreeMap<String, Vec<(String, Ours, Ours)>>;

/// Our figures on a pair, in percent.
#[derive(Debug, Clone, Copy, Default)]
struct Ours {
    /// Wall time of the whole job, decoding excluded.
    seconds: f64,
    /// bad-0.5 of the visible pixels.
    bad_half: f64,
    /// bad-2.0 of the visible pixels, and of all with ground truth.
    visible: f64,
    all: f64,
    /// D1 of all.
    d1: f64,
    matched: f64,
    occluded: BadCount,
    out_of_view: BadCount,
}

/// Numbers of bad and of all pixels.
#[derive(Debug, Clone, Copy, Default)]
struct BadCount {
    bad: f64,
    total: f64,
}

impl BadCount {
    fn add(&mut self, is_bad: bool) {
        self.bad += f64::from(is_bad);
        self.total += 1.0;
    }

    fn percent(self) -> f64 {
        100.0 * self.bad / self.total.max(1.0)
    }
}

pub(crate) fn run(python: &Path, data: &Path) -> Result<Vec<Check>> {
    let script = crate::root().join("peers/stereo_groups.py");
    let output = Command::new(python).arg(&script).arg(data).output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}: {}", script.display(), String::from_utf8_lossy(&output.stderr));
    let peers: Vec<Line> = String::from_utf8(output.stdout)?
        .lines()
        .filter(|line| line.starts_with('{'))
        .map(|line| serde_json::from_str(line).with_context(|| line.to_owned()))
        .collect::<Result<_>>()?;
    let mut groups: Groups = BTreeMap::new();
    for pair in read_pairs(data)? {
        let ours = score(&pair, false)?;
        let quality = score(&pair, true)?;
        println!(
            "{:22} {:5.2} % of the pixels visible in both views, {:5.2} % of all; in quality mode {:5.2} %",
            pair.name, ours.visible, ours.all, quality.visible
        );
        groups.entry(pair.info.group).or_default().push((pair.name, ours, quality));
    }
    let best = |scene: &str, opencv: bool, figure: fn(&Line) -> f64| {
        let lines = peers.iter().filter(|line| line.scene == scene && (line.mode == "Pandora") != opencv);
        lines.map(figure).reduce(f64::min).map(|fraction| 100.0 * fraction)
    };
    let mut text = String::from(
        "Written by `cargo xtask peers stereo-groups`. bad-2.0 in percent (error above 2 px or no disparity): of the pixels visible in both \
         views, and of all with ground truth. OpenCV: the best of SGBM, HH, 3WAY and HH4 on the pair. `bad-0.5`, `D1` (error above 3 px \
         and 5 % of the disparity, of all), `matched` (percent of the visible pixels that passed every check) and bad-2.0 of the occluded \
         pixels and of those out of the right view are ours.\n\n\
         | pair | ours, visible (all) | OpenCV's best | Pandora | bad-0.5 | D1 | matched | bad-2.0, occluded | bad-2.0, out of view |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    let mut checks = Vec::new();
    for (group, scenes) in &mut groups {
        scenes.sort_by(|a, b| b.1.visible.total_cmp(&a.1.visible));
        let cell = |percent: Option<f64>| percent.map_or_else(String::new, |percent| format!("{percent:.1}"));
        let mut sum = Ours::default();
        for (name, ours, _) in &*scenes {
            let peer = |opencv| {
                let (visible, all) = (best(name, opencv, |l| l.visible), best(name, opencv, |l| l.all));
                (visible, format!("{} ({})", cell(visible), cell(all)))
            };
            let ((opencv, opencv_cell), (pandora, pandora_cell)) = (peer(true), peer(false));
            row(&mut text, name, ours, &opencv_cell, &pandora_cell);
            for (who, percent) in [("OpenCV's best", opencv), ("Pandora", pandora)] {
                if let Some(percent) = percent {
                    checks.push(Check::at_most(format!("{name} bad-2.0 %, {who}"), ours.visible, percent));
                }
            }
            let n = scenes.len() as f64;
            let mean = |sum: &mut f64, value: f64| *sum += value / n;
            mean(&mut sum.bad_half, ours.bad_half);
            mean(&mut sum.visible, ours.visible);
            mean(&mut sum.all, ours.all);
            mean(&mut sum.d1, ours.d1);
            mean(&mut sum.matched, ours.matched);
            sum.occluded.bad += ours.occluded.bad;
            sum.occluded.total += ours.occluded.total;
            sum.out_of_view.bad += ours.out_of_view.bad;
            sum.out_of_view.total += ours.out_of_view.total;
        }
        row(&mut text, &format!("**{group}**, mean"), &sum, "", "");
    }
    checks.extend(write_quality_mode(&groups, &mut text));
    print!("{text}");
    super::write_section("Stereo by group", &text)?;
    Ok(checks)
}

/// Appends the table of the quality mode; returns the checks of its targets.
fn write_quality_mode(groups: &Groups, text: &mut String) -> Vec<Check> {
    text.push_str(
        "\nThe quality mode (`--quality`), bad-2.0 of the visible pixels and of all, and the other figures as above; the target is that of the visible pixels.\n\n\
         | pair | visible (all) | target | bad-0.5 | D1 |\n|---|---|---|---|---|\n",
    );
    let mut checks = Vec::new();
    for (name, _, ours) in groups.values().flatten() {
        let target = QUALITY_TARGETS.iter().find(|(pair, _)| pair == name).map(|target| target.1);
        checks.extend(
            target.map(|target| Check::at_most(format!("quality mode, {name} bad-2.0 %"), ours.visible, target)),
        );
        let target = target.map_or_else(String::new, |target| format!("{target:.1}"));
        // `fmt::Write` on a String cannot fail.
        let _ = writeln!(
            text,
            "| {name} | {:.2} ({:.1}) | {target} | {:.1} | {:.1} |",
            ours.visible, ours.all, ours.bad_half, ours.d1
        );
    }
    let mean = |group: &str, figure: fn(&Ours) -> f64| {
        let pairs = groups.get(group).map_or(&[][..], Vec::as_slice);
        pairs.iter().map(|pair| figure(&pair.2)).sum::<f64>() / pairs.len() as f64
    };
    let seconds = |of: fn(&(String, Ours, Ours)) -> f64| groups.values().flatten().map(of).sum::<f64>();
    text.push_str("\n| figure | measured | target |\n|---|---|---|\n");
    for (figure, measured, target) in [
        ("midd3q, mean bad-0.5 %", mean("midd3q", |ours| ours.bad_half), 14.0),
        ("drivingstereo, mean bad-2.0 %", mean("drivingstereo", |ours| ours.visible), 4.5),
        ("drivingstereo, mean D1 %", mean("drivingstereo", |ours| ours.d1), 2.0),
        (
            "wall time of all pairs / default mode",
            seconds(|pair| pair.2.seconds) / seconds(|pair| pair.1.seconds),
            80.0,
        ),
    ] {
        let _ = writeln!(text, "| {figure} | {measured:.2} | {target:.1} |");
        checks.push(Check::at_most(format!("quality mode, {figure}"), measured, target));
    }
    checks
}

fn row(text: &mut String, name: &str, ours: &Ours, opencv: &str, pandora: &str) {
    // `fmt::Write` on a String cannot fail.
    let percent = |count: BadCount| if count.total > 0.0 { format!("{:.0}", count.percent()) } else { String::new() };
    let _ = writeln!(
        text,
        "| {name} | {:.2} ({:.1}) | {opencv} | {pandora} | {:.1} | {:.1} | {:.0} | {} | {} |",
        ours.visible,
        ours.all,
        ours.bad_half,
        ours.d1,
        ours.matched,
        percent(ours.occluded),
        percent(ours.out_of_view)
    );
}

/// Reads every pair with ground truth.
fn read_pairs(data: &Path) -> Result<Vec<Pair>> {
    let mut pairs = Vec::new();
    let folder = data.join("stereo");
    for scene in &SCENES {
        let (truth, visible) = truth(&folder, scene)?;
        let info = PairInfo { group: "stereo".to_owned(), disparities: scene.disparities, min: 0 };
        let photos = [cv_io::read_rgb(folder.join(scene.left))?, cv_io::read_rgb(folder.join(scene.right))?];
        pairs.push(Pair { name: scene.name.to_owned(), info, photos, truth, visible });
    }
    let mut folders: Vec<_> = fs::read_dir(data.join("stereo-more"))?.map(|f| Ok(f?.path())).collect::<Result<_>>()?;
    folders.sort();
    for folder in folders.iter().filter(|folder| folder.join("scene.json").exists()) {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let info = serde_json::from_str(&fs::read_to_string(folder.join("scene.json"))?)?;
        let photos = [cv_io::read_rgb(folder.join("left.png"))?, cv_io::read_rgb(folder.join("right.png"))?];
        let truth = match folder.join("truth.png") {
            path if path.exists() => cv_io::scaled::read(path, 256.0)?,
            _ => cv_io::read_map(folder.join("truth.npz"), None)?,
        };
        let visible = match folder.join("mask.png") {
            path if path.exists() => cv_io::read_mask(path)?,
            _ => Mask::new(truth.width(), truth.height(), [true]),
        };
        pairs.push(Pair { name, info, photos, truth, visible });
    }
    Ok(pairs)
}

/// Scores our `depth` on a pair, with default options but for the disparity range and the mode.
fn score(pair: &Pair, quality: bool) -> Result<Ours> {
    let PairInfo { disparities, min, .. } = pair.info;
    let stereo = StereoOptions { disparities, min_disparity: min, quality, ..Default::default() };
    let options = DepthOptions { stereo, ..Default::default() };
    let start = Instant::now();
    let map = depth(pair.photos[0].view(), pair.photos[1].view(), None, &options, &Silent)?.map;
    let seconds = start.elapsed().as_secs_f64();
    let [mut bad_half, mut visible, mut all, mut d1, mut matched, mut occluded, mut out_of_view] =
        [BadCount::default(); 7];
    for y in 0..pair.truth.height() {
        for x in 0..pair.truth.width() {
            let truth = pair.truth.at(x, y)[0];
            if !truth.is_finite() {
                continue;
            }
            let error = (map.disparity.at(x, y)[0] - truth).abs();
            // A pixel without a disparity counts as bad.
            let error = if error.is_nan() { f32::INFINITY } else { error };
            all.add(error > 2.0);
            d1.add(error > 3.0 && error > 0.05 * truth.abs());
            if pair.visible.at(x, y)[0] {
                bad_half.add(error > 0.5);
                visible.add(error > 2.0);
                matched.add(map.state.at(x, y)[0] == PixelState::Matched);
            }
            if (x as f32) < truth - 0.5 {
                out_of_view.add(error > 2.0);
            } else if !pair.visible.at(x, y)[0] {
                occluded.add(error > 2.0);
            }
        }
    }
    let [bad_half, visible, all, d1, matched] = [bad_half, visible, all, d1, matched].map(BadCount::percent);
    Ok(Ours { seconds, bad_half, visible, all, d1, matched, occluded, out_of_view })
}
