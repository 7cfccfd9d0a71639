//! `depth` on Middlebury pairs, with the scores of `peers/stereo_opencv.py` and `peers/stereo_pandora.py`.

use super::Check;
use anyhow::{Result, ensure};
use cv_core::{GrayF32, Mask};
use cv_pipeline::stereo::{PixelState, StereoOptions, evaluate_disparity, non_occluded};
use cv_pipeline::{DepthOptions, Silent, depth, disparity_range};
use std::path::Path;

/// A pair, its ground truth, and the scores of peers on it.
pub(crate) struct Scene {
    pub(crate) name: &'static str,
    pub(crate) left: &'static str,
    pub(crate) right: &'static str,
    pub(crate) truth: &'static str,
    pub(crate) truth_right: Option<&'static str>,
    /// Divisor of the stored disparities; `None` for arrays.
    pub(crate) scale: Option<f64>,
    pub(crate) disparities: usize,
    /// bad-1.0 and bad-2.0 of Pandora in percent.
    pub(crate) pandora: (f64, f64),
    /// bad-2.0 of the best of OpenCV's matchers in percent.
    pub(crate) opencv: f64,
    /// Density and bad-2.0 of the valid pixels, in percent, of 3WAY, the densest of OpenCV's matchers.
    pub(crate) opencv_valid: (f64, f64),
}

/// The pairs.
pub(crate) const SCENES: [Scene; 4] = [
    Scene {
        name: "cones",
        left: "cones/im2.png",
        right: "cones/im6.png",
        truth: "cones/disp2.png",
        truth_right: Some("cones/disp6.png"),
        scale: Some(4.0),
        disparities: 64,
        pandora: (4.67, 3.95),
        opencv: 11.7,
        opencv_valid: (90.93, 2.89),
    },
    Scene {
        name: "teddy",
        left: "teddy/im2.png",
        right: "teddy/im6.png",
        truth: "teddy/disp2.png",
        truth_right: None,
        scale: Some(4.0),
        disparities: 64,
        pandora: (15.51, 10.44),
        opencv: 24.3,
        opencv_valid: (81.79, 7.46),
    },
    Scene {
        name: "cloth3",
        left: "cloth3/view1.png",
        right: "cloth3/view5.png",
        truth: "cloth3/disp1.png",
        truth_right: Some("cloth3/disp5.png"),
        scale: Some(2.0),
        disparities: 128,
        pandora: (2.60, 2.06),
        opencv: 12.8,
        opencv_valid: (88.28, 1.17),
    },
    Scene {
        name: "motorcycle",
        left: "motorcycle/motorcycle_left.png",
        right: "motorcycle/motorcycle_right.png",
        truth: "motorcycle/motorcycle_disp.npz",
        truth_right: None,
        scale: None,
        disparities: 128,
        pandora: (12.05, 8.88),
        opencv: 25.1,
        opencv_valid: (79.93, 6.43),
    },
];

/// Scores of one pair.
pub(crate) struct Scores {
    /// bad-1.0 and bad-2.0 in percent, over non-occluded pixels if the right view has ground truth, else all.
    pub(crate) bad: (f64, f64),
    /// Percentage of the same pixels that are matched, not filled, and bad-2.0 of those.
    pub(crate) matched: (f64, f64),
}

/// Reads the ground truth and the mask of the evaluated pixels.
pub(crate) fn truth(folder: &Path, scene: &Scene) -> Result<(GrayF32, Mask)> {
    let read = |name: &str| -> Result<GrayF32> {
        let path = folder.join(name);
        Ok(match scene.scale {
            Some(scale) => cv_io::scaled::read(path, scale)?,
            None => {
                let arrays = cv_io::npz::read(&path)?;
                ensure!(arrays.len() == 1, "{} has {} arrays", path.display(), arrays.len());
                arrays[0].1.to_gray()?
            }
        })
    };
    let left = read(scene.truth)?;
    let mask = match scene.truth_right {
        Some(right) => non_occluded(left.view(), read(right)?.view())?,
        None => Mask::new(left.width(), left.height(), [true]),
    };
    Ok((left, mask))
}

/// Matches a pair with default options except the disparity range, and scores it.
pub(crate) fn score(folder: &Path, scene: &Scene) -> Result<Scores> {
    let (truth, mask) = truth(folder, scene)?;
    let left = cv_io::read_rgb(folder.join(scene.left))?;
    let right = cv_io::read_rgb(folder.join(scene.right))?;
    let stereo = StereoOptions { disparities: scene.disparities, ..Default::default() };
    let options = DepthOptions { stereo, ..Default::default() };
    let map = depth(left.view(), right.view(), None, &options, &Silent)?.map;
    let all = evaluate_disparity(map.disparity.view(), truth.view(), Some(mask.view()))?;
    let matched = Mask::from_fn(mask.width(), mask.height(), |x, y| {
        [mask.at(x, y)[0] && map.state.at(x, y)[0] == PixelState::Matched]
    });
    let matched_only = evaluate_disparity(map.disparity.view(), truth.view(), Some(matched.view()))?;
    Ok(Scores {
        bad: (100.0 * all.bad[1], 100.0 * all.bad[2]),
        matched: (100.0 * matched_only.pixels as f64 / all.pixels as f64, 100.0 * matched_only.bad[2]),
    })
}

pub(crate) fn run(data: &Path) -> Result<Vec<Check>> {
    let folder = data.join("stereo");
    let mut checks = Vec::new();
    let mut sums = [0.0; 4];
    for scene in &SCENES {
        let Scores { bad, matched } = score(&folder, scene)?;
        println!(
            "{:11} bad-1.0 {:5.2} %  bad-2.0 {:5.2} %  matched {:.1} %, bad-2.0 of those {:.2} %",
            scene.name, bad.0, bad.1, matched.0, matched.1
        );
        let upper_limits = [
            ("bad-2.0 %, 0.6 of OpenCV's", bad.1, 0.6 * scene.opencv),
            ("bad-2.0 %, Pandora's", bad.1, scene.pandora.1),
            ("bad-1.0 %, Pandora's", bad.0, scene.pandora.0),
            ("bad-2.0 % of matched, OpenCV's", matched.1, scene.opencv_valid.1),
        ];
        checks.extend(
            upper_limits.map(|(name, figure, limit)| Check::at_most(format!("{} {name}", scene.name), figure, limit)),
        );
        checks.push(Check::at_least(format!("{} matched %, OpenCV's", scene.name), matched.0, scene.opencv_valid.0));
        for (sum, value) in sums.iter_mut().zip([bad.0, scene.pandora.0, bad.1, scene.pandora.1]) {
            *sum += value / SCENES.len() as f64;
        }
    }
    checks.push(Check::at_most("mean bad-1.0 %, 0.9 of Pandora's", sums[0], 0.9 * sums[1]));
    checks.push(Check::at_most("mean bad-2.0 %, 0.9 of Pandora's", sums[2], 0.9 * sums[3]));
    checks.push(outside_estimated_range(&data.join("stereo-more"))?);
    Ok(checks)
}

/// Estimates the range of disparities of every pair with a ground truth: the largest fraction of the truth that lies outside.
fn outside_estimated_range(folder: &Path) -> Result<Check> {
    let mut folders: Vec<_> = std::fs::read_dir(folder)?.map(|f| Ok(f?.path())).collect::<Result<_>>()?;
    folders.sort();
    let mut worst: f64 = 0.0;
    for folder in folders.iter().filter(|folder| folder.join("truth.png").exists()) {
        let [left, right] = ["left.png", "right.png"].map(|name| cv_io::read_rgb(folder.join(name)));
        let (first, count) = disparity_range(left?.view(), right?.view(), &Silent)?;
        let last = first + count as i32 - 1;
        let truth = cv_io::scaled::read(folder.join("truth.png"), 256.0)?;
        let known: Vec<f32> = truth.as_slice().iter().copied().filter(|d| d.is_finite()).collect();
        // Half a pixel: disparities are refined beyond the last one that is searched.
        let is_outside = |d: &&f32| **d < first as f32 - 0.5 || **d > last as f32 + 0.5;
        let percent = 100.0 * known.iter().filter(is_outside).count() as f64 / known.len().max(1) as f64;
        let name = folder.file_name().unwrap_or_default().to_string_lossy();
        println!("{name}: range {first} to {last}, {percent:.2} % outside");
        worst = worst.max(percent);
    }
    // What is seen by the left camera only may be nearer than all that is matched.
    Ok(Check::at_most("ground truth outside the estimated range of disparities, worst pair, %", worst, 1.0))
}
