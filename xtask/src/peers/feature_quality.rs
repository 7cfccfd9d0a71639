//! Repeatability and matching score under a known homography, at equal feature counts: ours and OpenCV's.
//!
//! Two features of two images correspond if the homography maps one to within 2.5 px of the other (times the local magnification if that is above one) and
//! their scales agree within a factor of √2. Repeatability: one-to-one correspondences over the smaller number of features in the common area.
//! Matching score: mutual nearest neighbors with corresponding positions, over the same number.

use super::features::Random;
use anyhow::{Context, Result, ensure};
use cv_core::{DMatch, GrayU8, ImageView, Keypoint, Matrix3, Point2, Silent, Vector3};
use cv_features::{
    DescriptorKind, Descriptors, FeatureError, MatchOptions, MopsOptions, RatioTest, SiftOptions, match_descriptors,
    sift,
};
use cv_imgproc::{Interpolation, RemapOptions};
use cv_parallel::prelude::*;
use std::{
    path::{Path, PathBuf},
    process::Command,
};

/// Features requested for each image.
const COUNT: usize = 1000;
/// Longer side in pixels to which photographs are reduced for the warps, which enlarge them up to four times.
const BASE_SIDE: f64 = 640.0;
const METHODS: [&str; 4] = ["SIFT, ours", "SIFT, OpenCV", "MOPS, ours", "ORB, OpenCV"];

/// Two images, the homography from the first to the second, and the kind of change between them.
struct Case {
    kind: &'static str,
    first: PathBuf,
    second: PathBuf,
    homography: Matrix3<f64>,
}

/// Mean scores of all methods, by kind of change.
pub(super) struct Quality {
    kinds: Vec<&'static str>,
    /// Repeatability and matching score, indexed by method and kind.
    scores: Vec<Vec<[f64; 2]>>,
}

impl Quality {
    fn mean(&self, method: usize, score: usize, is_photographs: bool) -> f64 {
        let of: Vec<f64> = self
            .kinds
            .iter()
            .zip(&self.scores[method])
            .filter(|(kind, _)| (**kind == PHOTOGRAPHS) == is_photographs)
            .map(|(_, s)| s[score])
            .collect();
        of.iter().sum::<f64>() / of.len() as f64
    }

    /// Returns name, our figure and OpenCV's figure of each comparison.
    pub(super) fn comparisons(&self) -> Vec<(String, f64, f64)> {
        let mut comparisons = Vec::new();
        for (ours, theirs, name) in [(0, 1, "SIFT"), (2, 3, "MOPS and ORB")] {
            for (score, what) in [(0, "repeatability"), (1, "matching score")] {
                for (photographs, on) in [(true, "homography pairs"), (false, "warps")] {
                    let figure = |method| self.mean(method, score, photographs);
                    comparisons.push((format!("{name}, {what}, {on}"), figure(ours), figure(theirs)));
                }
            }
        }
        comparisons
    }

    pub(super) fn text(&self) -> String {
        let mut text = format!(
            "Repeatability / matching score in percent, {COUNT} features requested and equal numbers compared within each pair of methods, on the eight \
             homography pairs and on warps of their sixteen photographs:\n\n| method | {} | mean of the warps |\n|---|{}---|\n",
            self.kinds.join(" | "),
            "---|".repeat(self.kinds.len())
        );
        for (m, (method, scores)) in METHODS.iter().zip(&self.scores).enumerate() {
            let cells: Vec<String> =
                scores.iter().map(|[r, s]| format!("{:.1} / {:.1}", 100.0 * r, 100.0 * s)).collect();
            let (r, s) = (self.mean(m, 0, false), self.mean(m, 1, false));
            text.push_str(&format!("| {method} | {} | {:.1} / {:.1} |\n", cells.join(" | "), 100.0 * r, 100.0 * s));
        }
        text
    }
}

/// Kind of the cases that are no warps.
const PHOTOGRAPHS: &str = "homography pairs";

pub(super) fn run(python: &Path, script: &Path, data: &Path) -> Result<Quality> {
    let folder = crate::root().join("target/peers-features");
    std::fs::create_dir_all(&folder)?;
    println!("rendering warps");
    let cases = build_cases(&data.join("homography"), &folder)?;
    let mut images: Vec<PathBuf> = cases.iter().flat_map(|c| [c.first.clone(), c.second.clone()]).collect();
    images.sort();
    images.dedup();
    // OpenCV's features are cached beside their image.
    let missing: Vec<&PathBuf> = images.iter().filter(|p| !features_path(p, "orb").exists()).collect();
    println!("OpenCV on {} images", missing.len());
    for chunk in missing.chunks(40) {
        let status = Command::new(python).arg(script).args(["extract", &COUNT.to_string()]).args(chunk).status()?;
        ensure!(status.success(), "OpenCV failed: {status}");
    }
    println!("scores");
    let mut features = std::collections::BTreeMap::new();
    for path in images {
        let image = cv_io::read_gray_u8(&path)?;
        let float = cv_imgproc::gray_to_f32(image.view());
        let our_sift = sift(float.view(), &SiftOptions { max_features: COUNT, ..SiftOptions::default() }, &Silent)?;
        let sets = vec![
            FeatureSet { keypoints: our_sift.keypoints, descriptors: DescriptorRows::Floats(our_sift.descriptors) },
            read_features(&features_path(&path, "sift"), false)?,
            mops(float.view(), COUNT)?,
            read_features(&features_path(&path, "orb"), true)?,
        ];
        features.insert(path, (image.size(), sets));
    }
    let scores: Vec<[[f64; 2]; 4]> = cases
        .par_iter()
        .map(|case| {
            let ((size_a, a), (size_b, b)) = (&features[&case.first], &features[&case.second]);
            let mut scores = [[0.0; 2]; 4];
            for pair in [[0, 1], [2, 3]] {
                let common_count =
                    |sets: &[FeatureSet]| pair.iter().map(|&m| sets[m].keypoints.len()).min().unwrap_or(0);
                let (na, nb) = (common_count(a), common_count(b));
                for m in pair {
                    scores[m] = score(&a[m].first(na), &b[m].first(nb), &case.homography, *size_a, *size_b);
                }
            }
            scores
        })
        .collect();
    let mut kinds: Vec<&'static str> = Vec::new();
    for case in &cases {
        if !kinds.contains(&case.kind) {
            kinds.push(case.kind);
        }
    }
    let mean = |method: usize, kind: &str| {
        let of: Vec<[f64; 2]> =
            cases.iter().zip(&scores).filter(|(c, _)| c.kind == kind).map(|(_, s)| s[method]).collect();
        [0, 1].map(|i| of.iter().map(|s| s[i]).sum::<f64>() / of.len() as f64)
    };
    let scores = (0..METHODS.len()).map(|m| kinds.iter().map(|kind| mean(m, kind)).collect()).collect();
    Ok(Quality { kinds, scores })
}

fn features_path(image: &Path, name: &str) -> PathBuf {
    let mut path = image.as_os_str().to_owned();
    path.push(format!(".{name}.npy"));
    path.into()
}

/// Detects MOPS features, our counterpart of ORB.
pub(super) fn mops(image: ImageView<'_, f32, 1>, count: usize) -> Result<FeatureSet, FeatureError> {
    let found = cv_features::mops(image, &MopsOptions { max_features: count, ..MopsOptions::default() }, &Silent)?;
    Ok(FeatureSet { keypoints: found.keypoints, descriptors: DescriptorRows::Floats(found.descriptors) })
}

/// Keypoints and descriptors of one image, by decreasing response.
pub(super) struct FeatureSet {
    keypoints: Vec<Keypoint>,
    descriptors: DescriptorRows,
}

enum DescriptorRows {
    Floats(Descriptors),
    Bits(Vec<[u64; 4]>),
}

impl FeatureSet {
    fn first(&self, n: usize) -> Self {
        let descriptors = match &self.descriptors {
            DescriptorRows::Floats(d) => {
                let data = d.as_slice()[..n * d.dimension()].to_vec();
                DescriptorRows::Floats(Descriptors::from_vec(d.kind(), data).unwrap_or(Descriptors::new(d.kind())))
            }
            DescriptorRows::Bits(bits) => DescriptorRows::Bits(bits[..n].to_vec()),
        };
        Self { keypoints: self.keypoints[..n].to_vec(), descriptors }
    }

    fn filter(&self, keep: impl Fn(&Keypoint) -> bool) -> Self {
        let indices: Vec<usize> = (0..self.keypoints.len()).filter(|&i| keep(&self.keypoints[i])).collect();
        let descriptors = match &self.descriptors {
            DescriptorRows::Floats(d) => {
                let data = indices.iter().flat_map(|&i| d.row(i)).copied().collect();
                DescriptorRows::Floats(Descriptors::from_vec(d.kind(), data).unwrap_or(Descriptors::new(d.kind())))
            }
            DescriptorRows::Bits(bits) => DescriptorRows::Bits(indices.iter().map(|&i| bits[i]).collect()),
        };
        Self { keypoints: indices.iter().map(|&i| self.keypoints[i]).collect(), descriptors }
    }
}

/// Reads the features that the script wrote.
fn read_features(path: &Path, is_binary: bool) -> Result<FeatureSet> {
    let array = cv_io::npy::read(path)?;
    let [count, columns] = array.shape[..] else { anyhow::bail!("{} is not a 2D array", path.display()) };
    let values: Vec<f32> = array.to_f64().into_iter().map(|v| v as f32).collect();
    let rows = || values.chunks_exact(columns).take(count);
    let keypoints = rows()
        .map(|r| Keypoint { position: Point2::new(r[0], r[1]), scale: r[2], angle: r[3], response: r[4] })
        .collect();
    let descriptors = if is_binary {
        let word = |w: &[f32]| w.iter().fold(0u64, |word, &byte| word << 8 | byte as u64);
        DescriptorRows::Bits(rows().map(|r| [0, 1, 2, 3].map(|i| word(&r[5 + 8 * i..13 + 8 * i]))).collect())
    } else {
        let data = rows().flat_map(|r| &r[5..]).copied().collect();
        DescriptorRows::Floats(Descriptors::from_vec(DescriptorKind::SIFT, data).context("descriptors")?)
    };
    Ok(FeatureSet { keypoints, descriptors })
}

fn project(h: &Matrix3<f64>, p: Point2<f32>) -> Point2<f64> {
    let q = h * Vector3::new(f64::from(p.x), f64::from(p.y), 1.0);
    Point2::new(q.x / q.z, q.y / q.z)
}

/// Computes repeatability and matching score; `h` maps pixels of `a` to pixels of `b`.
fn score(a: &FeatureSet, b: &FeatureSet, h: &Matrix3<f64>, size_a: (usize, usize), size_b: (usize, usize)) -> [f64; 2] {
    let Some(inverse) = h.try_inverse() else { return [0.0; 2] };
    let inside = |p: Point2<f64>, (w, h): (usize, usize)| {
        p.x >= 0.0 && p.y >= 0.0 && p.x <= w as f64 - 1.0 && p.y <= h as f64 - 1.0
    };
    let a = a.filter(|k| inside(project(h, k.position), size_b));
    let b = b.filter(|k| inside(project(&inverse, k.position), size_a));
    let common = a.keypoints.len().min(b.keypoints.len());
    if common == 0 {
        return [0.0; 2];
    }
    // Projection of each keypoint of `a` and the local magnification there.
    let projections: Vec<(Point2<f64>, f64)> = a
        .keypoints
        .iter()
        .map(|k| {
            let p = k.position;
            let at = project(h, p);
            let (right, down) =
                (project(h, Point2::new(p.x + 0.5, p.y)) - at, project(h, Point2::new(p.x, p.y + 0.5)) - at);
            (at, 2.0 * (right.x * down.y - right.y * down.x).abs().sqrt())
        })
        .collect();
    let distance = |i: usize, j: usize| (b.keypoints[j].position.cast::<f64>() - projections[i].0).norm();
    let near = |i: usize, j: usize| distance(i, j) < 2.5 * projections[i].1.max(1.0);
    let mut pairs = Vec::new();
    for (i, (_, magnification)) in projections.iter().enumerate() {
        for j in 0..b.keypoints.len() {
            let scale = f64::from(a.keypoints[i].scale) * magnification / f64::from(b.keypoints[j].scale);
            if near(i, j) && scale.log2().abs() < 0.5 {
                pairs.push((distance(i, j), i, j));
            }
        }
    }
    pairs.sort_by(|x, y| x.0.total_cmp(&y.0));
    let (mut is_used_a, mut is_used_b) = (vec![false; a.keypoints.len()], vec![false; b.keypoints.len()]);
    let mut repeated = 0;
    for (_, i, j) in pairs {
        if !is_used_a[i] && !is_used_b[j] {
            (is_used_a[i], is_used_b[j]) = (true, true);
            repeated += 1;
        }
    }
    let correct = mutual_matches(&a.descriptors, &b.descriptors).into_iter().filter(|&(i, j)| near(i, j)).count();
    [repeated as f64 / common as f64, correct as f64 / common as f64]
}

/// Returns the mutual nearest neighbors as index pairs.
fn mutual_matches(a: &DescriptorRows, b: &DescriptorRows) -> Vec<(usize, usize)> {
    match (a, b) {
        (DescriptorRows::Floats(a), DescriptorRows::Floats(b)) => {
            let options = MatchOptions { ratio: RatioTest::Off, mutual: true, ..MatchOptions::default() };
            let matches: Vec<DMatch> = match_descriptors(a, b, &options, &Silent).unwrap_or_default();
            matches.into_iter().map(|m| (m.query as usize, m.train as usize)).collect()
        }
        (DescriptorRows::Bits(a), DescriptorRows::Bits(b)) => {
            let hamming = |x: &[u64; 4], y: &[u64; 4]| x.iter().zip(y).map(|(x, y)| (x ^ y).count_ones()).sum::<u32>();
            let nearest = |x: &[u64; 4], set: &[[u64; 4]]| (0..set.len()).min_by_key(|&j| hamming(x, &set[j]));
            let back: Vec<Option<usize>> = b.iter().map(|y| nearest(y, a)).collect();
            (0..a.len()).filter_map(|i| nearest(&a[i], b).filter(|&j| back[j] == Some(i)).map(|j| (i, j))).collect()
        }
        _ => Vec::new(),
    }
}

/// Returns the homography pairs and warps of their photographs; writes the images to `folder`.
fn build_cases(photographs: &Path, folder: &Path) -> Result<Vec<Case>> {
    let mut files: Vec<PathBuf> = Vec::new();
    for entry in std::fs::read_dir(photographs).with_context(|| photographs.display().to_string())? {
        let path = entry?.path();
        if path.extension().is_some_and(|e| e == "png" || e == "jpg") {
            files.push(path);
        }
    }
    files.sort();
    let mut cases = Vec::new();
    for pair in files.chunks_exact(2) {
        let stem = pair[0].file_stem().and_then(|s| s.to_str()).and_then(|s| s.strip_suffix('A'));
        let name = stem.with_context(|| format!("{} is not the first of a pair", pair[0].display()))?;
        let mut stored = Vec::new();
        for path in pair {
            let file = folder.join(path.file_stem().context("a name")?).with_extension("png");
            store(&file, &cv_io::read_gray_u8(path)?)?;
            stored.push(file);
        }
        let text = std::fs::read_to_string(photographs.join(format!("{name}_model.txt")))?;
        let v: Vec<f64> = text.split_whitespace().filter_map(|w| w.parse().ok()).collect();
        ensure!(v.len() >= 9, "{name}_model.txt has no 3×3 matrix");
        // The file's homography maps the second photograph to the first.
        let homography = Matrix3::from_row_slice(&v[..9]).try_inverse().context("a homography without inverse")?;
        cases.push(Case { kind: PHOTOGRAPHS, first: stored[0].clone(), second: stored[1].clone(), homography });
    }
    let warped: Vec<Result<Vec<Case>>> = files.par_iter().map(|path| warps(path, folder)).collect();
    for warps in warped {
        cases.extend(warps?);
    }
    ensure!(cases.len() > 100, "no photographs in {}", photographs.display());
    Ok(cases)
}

/// Writes an image unless the file has the same pixels, and removes its cached features.
fn store(path: &Path, image: &GrayU8) -> Result<()> {
    if !path.exists() || cv_io::read_gray_u8(path)? != *image {
        cv_io::write_png(path, image.view())?;
        for name in ["sift", "orb"] {
            std::fs::remove_file(features_path(path, name)).ok();
        }
    }
    Ok(())
}

fn warps(path: &Path, folder: &Path) -> Result<Vec<Case>> {
    let stem = path.file_stem().and_then(|s| s.to_str()).context("a name")?;
    let whole = cv_io::read_gray_u8(path)?;
    let (w, h) = whole.size();
    let shrink = (BASE_SIDE / w.max(h) as f64).min(1.0);
    let size = ((w as f64 * shrink).round() as usize, (h as f64 * shrink).round() as usize);
    let base = if shrink < 1.0 { cv_imgproc::resize_area(whole.view(), size.0, size.1)? } else { whole };
    let first = folder.join(format!("{stem}-base.png"));
    store(&first, &base)?;
    let mut cases = Vec::new();
    let mut add = |kind: &'static str, image: GrayU8, homography: Matrix3<f64>| -> Result<()> {
        let second = folder.join(format!("{stem}-{}.png", cases.len()));
        store(&second, &image)?;
        cases.push(Case { kind, first: first.clone(), second, homography });
        Ok(())
    };
    let similarity = |scale: f64, degrees: f64| {
        let (sin, cos) = degrees.to_radians().sin_cos();
        Matrix3::new(scale * cos, -scale * sin, 0.0, scale * sin, scale * cos, 0.0, 0.0, 0.0, 1.0)
    };
    for degrees in [10.0, 30.0, 45.0, 60.0, 90.0, 135.0, 180.0] {
        let (image, m) = warp(&base, &similarity(1.0, degrees))?;
        add("rotation 10–180°", image, m)?;
    }
    for (kind, scales) in [("scale 0.25–0.7", [0.25, 0.35, 0.5, 0.7]), ("scale 1.4–4", [1.4, 2.0, 2.8, 4.0])] {
        for scale in scales {
            let (image, m) = warp(&base, &similarity(scale, 0.0))?;
            add(kind, image, m)?;
        }
    }
    for (scale, degrees) in [(0.6, 25.0), (1.5, 70.0)] {
        let (image, m) = warp(&base, &similarity(scale, degrees))?;
        add("scale and rotation", image, m)?;
    }
    for tilt in [0.5, 0.65] {
        let (image, m) = warp(&base, &Matrix3::new(tilt, 0.1, 0.0, 0.0, 1.0, 0.0, 2e-4, 0.0, 1.0))?;
        add("viewpoint", image, m)?;
    }
    let bytes = |f: &mut dyn FnMut(f32) -> f32| base.map(|[v]| [f(f32::from(v)).round().clamp(0.0, 255.0) as u8]);
    for stops in [-2.0f32, -1.0, 1.0, 2.0] {
        add("exposure ±2 EV", bytes(&mut |v| v * stops.exp2()), Matrix3::identity())?;
    }
    let float = cv_imgproc::gray_to_f32(base.view());
    for sigma in [1.0, 2.0, 4.0] {
        let smooth = cv_imgproc::gaussian_blur(float.view(), sigma);
        add("blur 1–4 px", cv_imgproc::f32_to_u8(smooth.view()), Matrix3::identity())?;
    }
    let mut random = Random(7);
    for sigma in [5.0f32, 10.0, 20.0] {
        // The sum of twelve uniform numbers is approximately normal.
        let noisy = bytes(&mut |v| v + sigma * ((0..12).map(|_| random.next()).sum::<f32>() - 6.0));
        add("noise 5–20", noisy, Matrix3::identity())?;
    }
    Ok(cases)
}

/// Warps an image by `m` about its center onto a canvas that contains all of it; returns the result and the homography to it.
fn warp(base: &GrayU8, m: &Matrix3<f64>) -> Result<(GrayU8, Matrix3<f64>)> {
    let (w, h) = base.size();
    let (right, bottom) = (w as f64 - 1.0, h as f64 - 1.0);
    let m = m * Matrix3::new(1.0, 0.0, -right / 2.0, 0.0, 1.0, -bottom / 2.0, 0.0, 0.0, 1.0);
    let corners = [(0.0, 0.0), (right, 0.0), (0.0, bottom), (right, bottom)].map(|(x, y)| {
        let q = m * Vector3::new(x, y, 1.0);
        (q.x / q.z, q.y / q.z)
    });
    let low = corners.iter().fold((f64::INFINITY, f64::INFINITY), |l, c| (l.0.min(c.0), l.1.min(c.1)));
    let high = corners.iter().fold((f64::NEG_INFINITY, f64::NEG_INFINITY), |l, c| (l.0.max(c.0), l.1.max(c.1)));
    let size = ((high.0 - low.0).ceil() as usize + 1, (high.1 - low.1).ceil() as usize + 1);
    let m = Matrix3::new(1.0, 0.0, -low.0, 0.0, 1.0, -low.1, 0.0, 0.0, 1.0) * m;
    let float = cv_imgproc::gray_to_f32(base.view());
    let scale = m.fixed_view::<2, 2>(0, 0).determinant().abs().sqrt();
    // Anti-aliasing: a blur of σ = 0.5 px before and after the reduction.
    let smooth = if scale < 1.0 {
        cv_imgproc::gaussian_blur(float.view(), (0.5 * (1.0 / (scale * scale) - 1.0).sqrt()) as f32)
    } else {
        float
    };
    let options = RemapOptions { interpolation: Interpolation::Bicubic, ..RemapOptions::default() };
    let (image, _) = cv_imgproc::warp_perspective(smooth.view(), &m, size, &options)?;
    Ok((cv_imgproc::f32_to_u8(image.view()), m))
}
