//! OpenCV's matchers, Pandora and ours on every pair with truth, by group, the worst pairs first. Writes the section
//! "Stereo by group" of `docs/benchmarks.md`. No times: those are the job `stereo`'s.

use crate::checks::Check;
use crate::real::depth::{SCENES, truth};
use anyhow::{Context, Result, ensure};
use cv_core::{GrayF32, Mask, RgbU8, Silent};
use cv_pipeline::stereo::{PixelState, StereoOptions};
use cv_pipeline::{DepthOptions, depth};
use serde::Deserialize;
use std::{collections::BTreeMap, fmt::Write as _, fs, path::Path, process::Command};

/// What a peer reaches on a pair: shares of pixels off by more than 2 px.
#[derive(Debug, Clone, Deserialize)]
struct Line {
    scene: String,
    mode: String,
    seen: f64,
    all: f64,
}

/// `scene.json`.
#[derive(Debug, Deserialize)]
struct About {
    group: String,
    disparities: usize,
    min: i32,
}

/// A pair with its truth, and the pixels that both photographs see.
struct Pair {
    name: String,
    about: About,
    photos: [RgbU8; 2],
    truth: GrayF32,
    seen: Mask,
}

/// Percentages of ours.
#[derive(Debug, Clone, Copy, Default)]
struct Ours {
    half: f64,
    seen: f64,
    all: f64,
    outliers: f64,
    matched: f64,
    occluded: Share,
    outside: Share,
}

/// Wrong pixels of all.
#[derive(Debug, Clone, Copy, Default)]
struct Share {
    wrong: f64,
    of: f64,
}

impl Share {
    fn add(&mut self, wrong: bool) {
        self.wrong += f64::from(wrong);
        self.of += 1.0;
    }

    fn percent(self) -> f64 {
        100.0 * self.wrong / self.of.max(1.0)
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
    let mut groups: BTreeMap<String, Vec<(String, Ours)>> = BTreeMap::new();
    for pair in pairs(data)? {
        let ours = score(&pair)?;
        println!("{:22} {:5.2} % of what both see, {:5.2} % of all", pair.name, ours.seen, ours.all);
        groups.entry(pair.about.group).or_default().push((pair.name, ours));
    }
    let best = |scene: &str, opencv: bool, of: fn(&Line) -> f64| {
        let lines = peers.iter().filter(|line| line.scene == scene && (line.mode == "Pandora") != opencv);
        lines.map(of).reduce(f64::min).map(|share| 100.0 * share)
    };
    let mut text = String::from(
        "Written by `cargo xtask peers stereo-groups`. Percent of pixels that are off by more than 2 px or have no disparity: of those that both \
         photographs see, and of all with truth. OpenCV: the best of SGBM, HH, 3WAY and HH4 on the pair. `bad-0.5` and `D1` (more than 3 px \
         and 5 % of the disparity, of all) are ours; so are `matched`, the share that passed every check, and what is wrong of the occluded \
         pixels and of those outside the right photograph.\n\n\
         | pair | ours, seen (all) | OpenCV's best | Pandora | bad-0.5 | D1 | matched | occluded wrong | outside wrong |\n|---|---|---|---|---|---|---|---|---|\n",
    );
    let mut checks = Vec::new();
    for (group, scenes) in &mut groups {
        scenes.sort_by(|a, b| b.1.seen.total_cmp(&a.1.seen));
        let cell = |share: Option<f64>| share.map_or_else(String::new, |share| format!("{share:.1}"));
        let mut sum = Ours::default();
        for (name, ours) in &*scenes {
            let peer = |opencv| {
                let (seen, all) = (best(name, opencv, |l| l.seen), best(name, opencv, |l| l.all));
                (seen, format!("{} ({})", cell(seen), cell(all)))
            };
            let ((opencv, opencv_cell), (pandora, pandora_cell)) = (peer(true), peer(false));
            row(&mut text, name, ours, &opencv_cell, &pandora_cell);
            for (who, share) in [("OpenCV's best", opencv), ("Pandora", pandora)] {
                if let Some(share) = share {
                    checks.push(Check::at_most(format!("{name} bad-2.0 %, {who}"), ours.seen, share));
                }
            }
            let n = scenes.len() as f64;
            let mean = |sum: &mut f64, value: f64| *sum += value / n;
            mean(&mut sum.half, ours.half);
            mean(&mut sum.seen, ours.seen);
            mean(&mut sum.all, ours.all);
            mean(&mut sum.outliers, ours.outliers);
            mean(&mut sum.matched, ours.matched);
            sum.occluded.wrong += ours.occluded.wrong;
            sum.occluded.of += ours.occluded.of;
            sum.outside.wrong += ours.outside.wrong;
            sum.outside.of += ours.outside.of;
        }
        row(&mut text, &format!("**{group}**, mean"), &sum, "", "");
    }
    print!("{text}");
    super::write_section("Stereo by group", &text)?;
    Ok(checks)
}

fn row(text: &mut String, name: &str, ours: &Ours, opencv: &str, pandora: &str) {
    // `fmt::Write` on a String cannot fail.
    let share = |share: Share| if share.of > 0.0 { format!("{:.0}", share.percent()) } else { String::new() };
    let _ = writeln!(
        text,
        "| {name} | {:.2} ({:.1}) | {opencv} | {pandora} | {:.1} | {:.1} | {:.0} | {} | {} |",
        ours.seen,
        ours.all,
        ours.half,
        ours.outliers,
        ours.matched,
        share(ours.occluded),
        share(ours.outside)
    );
}

/// Every pair with truth.
fn pairs(data: &Path) -> Result<Vec<Pair>> {
    let mut pairs = Vec::new();
    let folder = data.join("stereo");
    for scene in &SCENES {
        let (truth, seen) = truth(&folder, scene)?;
        let about = About { group: "stereo".to_owned(), disparities: scene.disparities, min: 0 };
        let photos = [cv_io::read_rgb(folder.join(scene.left))?, cv_io::read_rgb(folder.join(scene.right))?];
        pairs.push(Pair { name: scene.name.to_owned(), about, photos, truth, seen });
    }
    let mut folders: Vec<_> = fs::read_dir(data.join("stereo-more"))?.map(|f| Ok(f?.path())).collect::<Result<_>>()?;
    folders.sort();
    for folder in folders.iter().filter(|folder| folder.join("scene.json").exists()) {
        let name = folder.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let about = serde_json::from_str(&fs::read_to_string(folder.join("scene.json"))?)?;
        let photos = [cv_io::read_rgb(folder.join("left.png"))?, cv_io::read_rgb(folder.join("right.png"))?];
        let truth = match folder.join("truth.png") {
            path if path.exists() => cv_io::scaled::read(path, 256.0)?,
            _ => cv_io::read_map(folder.join("truth.npz"), None)?,
        };
        let seen = match folder.join("mask.png") {
            path if path.exists() => cv_io::read_mask(path)?,
            _ => Mask::new(truth.width(), truth.height(), [true]),
        };
        pairs.push(Pair { name, about, photos, truth, seen });
    }
    Ok(pairs)
}

/// Ours as `cv depth` has it, with default options but for the range: rows aligned.
fn score(pair: &Pair) -> Result<Ours> {
    let About { disparities, min, .. } = pair.about;
    let stereo = StereoOptions { disparities, min_disparity: min, ..Default::default() };
    let options = DepthOptions { stereo, ..Default::default() };
    let map = depth(pair.photos[0].view(), pair.photos[1].view(), None, &options, &Silent)?.map;
    let [mut half, mut seen, mut all, mut outliers, mut matched, mut occluded, mut outside] = [Share::default(); 7];
    for y in 0..pair.truth.height() {
        for x in 0..pair.truth.width() {
            let truth = pair.truth.at(x, y)[0];
            if !truth.is_finite() {
                continue;
            }
            let off = (map.disparity.at(x, y)[0] - truth).abs();
            // Without a disparity: infinitely far.
            let off = if off.is_nan() { f32::INFINITY } else { off };
            all.add(off > 2.0);
            outliers.add(off > 3.0 && off > 0.05 * truth.abs());
            if pair.seen.at(x, y)[0] {
                half.add(off > 0.5);
                seen.add(off > 2.0);
                matched.add(map.state.at(x, y)[0] == PixelState::Matched);
            }
            if (x as f32) < truth - 0.5 {
                outside.add(off > 2.0);
            } else if !pair.seen.at(x, y)[0] {
                occluded.add(off > 2.0);
            }
        }
    }
    let [half, seen, all, outliers, matched] = [half, seen, all, outliers, matched].map(Share::percent);
    Ok(Ours { half, seen, all, outliers, matched, occluded, outside })
}
