//! Bundle adjustment on a generated problem, Ceres (through COLMAP) and ours: 100 images, each with its own focal length and radial
//! coefficient, 20,000 points, 100,000 observations; and the scaling of our time with the problem. Writes the section “Bundle adjustment” of
//! `docs/benchmarks.md`.

use super::calibration::on_one_thread;
use crate::checks::Check;
use anyhow::{Context, Result, ensure};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustOptions, AdjustReport, Adjustment, Euclidean, Manifold, Residual, RigidMotion};
use nalgebra::{Matrix2, Matrix2x3, Rotation3, SMatrix, UnitQuaternion, Vector2, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use serde::Deserialize;
use std::{fmt::Write as _, ops::ControlFlow, path::Path, process::Command, time::Instant};

const PHOTOGRAPHS: usize = 100;
const POINTS: usize = 20_000;
/// Observations of each point.
const TRACK_LENGTH: usize = 5;
/// Cameras nearest to a point, of which [`TRACK_LENGTH`] observe it.
const CANDIDATE_CAMERAS: usize = 20;
const SIZE: [f64; 2] = [1600.0, 1200.0];
const THREADS: usize = 2;
/// Both stop at a step that lowers the cost by less than this fraction.
const TOLERANCE: f64 = 1e-8;
/// Costs with a relative difference below this are equal.
const COST_TOLERANCE: f64 = 1e-6;
/// Scale of the Cauchy loss, in pixels.
const LOSS_SCALE: f64 = 1.0;
/// Repeats; the fastest counts.
const REPEATS: usize = 3;
/// Largest ratio of our time to the fastest of Ceres.
const MAX_TIME_RATIO: f64 = 0.5;
/// Numbers of images of the scaling problems, with as many points per image as in the comparison: 10⁴ to 10⁶ observations.
const SCALING_IMAGES: [usize; 3] = [10, 100, 1000];
/// Largest ratio of the times per observation and iteration.
const MAX_SCALING_RATIO: f64 = 1.5;

/// Result of one solver run of the peer.
#[derive(Debug, Clone, Deserialize)]
struct Peer {
    loss: String,
    solver: String,
    initial_cost: f64,
    cost: f64,
    iterations: usize,
    seconds: f64,
}

pub(crate) fn run(python: &Path, _data: &Path) -> Result<Vec<Check>> {
    let scene = Scene::new(1, PHOTOGRAPHS);
    let folder = tempfile::tempdir()?;
    scene.write(folder.path())?;
    println!("peers");
    let script = crate::root().join("peers/adjust_ceres.py");
    let numbers = [THREADS.to_string(), TOLERANCE.to_string(), LOSS_SCALE.to_string()];
    let output =
        Command::new(python).arg(&script).arg(folder.path()).args(&numbers).output().context("cannot start Python")?;
    ensure!(output.status.success(), "{}: {}", script.display(), String::from_utf8_lossy(&output.stderr));
    let output = String::from_utf8(output.stdout)?;
    let versions = output.lines().find_map(|l| l.strip_prefix("{\"versions\": \"")).unwrap_or_default();
    let peers: Vec<Peer> = output
        .lines()
        .filter(|line| line.starts_with("{\"loss\""))
        .map(|line| serde_json::from_str(line).with_context(|| line.to_owned()))
        .collect::<Result<_>>()?;
    println!("ours");
    let mut text = format!(
        "Written by `cargo xtask peers adjust`; one run, {THREADS} threads each, {}, {}. {PHOTOGRAPHS} photographs with a focal length and a radial coefficient each, {POINTS} points, {} \
         observations with noise of σ = 0.5 px; the same initial values, losses and tolerance ({TOLERANCE:e} of the cost). Times: for Ceres the smaller of its own report and the duration of the \
         call, without problem construction; ours with it.\n\n| loss | solver | cost | iterations | seconds |\n|---|---|---|---|---|\n",
        super::machine(),
        versions.trim_end_matches("\"}"),
        scene.observations.len(),
    );
    let pool = rayon::ThreadPoolBuilder::new().num_threads(THREADS).build()?;
    let (mut checks, mut times) = (Vec::new(), String::new());
    for (name, loss) in [("TRIVIAL", RobustLoss::Trivial), ("CAUCHY", RobustLoss::Cauchy { scale: LOSS_SCALE })] {
        let (mut seconds, mut report) = (f64::INFINITY, None);
        for _ in 0..REPEATS {
            let start = Instant::now();
            report = Some(pool.install(|| scene.adjust(loss))?);
            seconds = seconds.min(start.elapsed().as_secs_f64());
        }
        let Some(report) = report else { continue };
        let _ = writeln!(text, "| {name} | ours | {:.6} | {} | {seconds:.3} |", report.cost, report.steps);
        let mut best = f64::INFINITY;
        for peer in peers.iter().filter(|p| p.loss == name) {
            ensure!(
                (peer.initial_cost / report.initial_cost - 1.0).abs() < COST_TOLERANCE,
                "the initial costs differ: {peer:?} {report:?}"
            );
            let _ = writeln!(
                text,
                "| {name} | Ceres, {} | {:.6} | {} | {:.3} |",
                peer.solver, peer.cost, peer.iterations, peer.seconds
            );
            // Times are compared at equal final cost only.
            let cost = format!("{name}: cost / cost of Ceres, {}, minus 1", peer.solver);
            checks.push(Check::at_most(cost, report.cost / peer.cost - 1.0, COST_TOLERANCE));
            if peer.cost <= report.cost * (1.0 + COST_TOLERANCE) {
                best = best.min(peer.seconds);
            }
        }
        // If no solver reached our cost, the ratio is NaN, which meets no target.
        let ratio = if best.is_finite() { seconds / best } else { f64::NAN };
        checks.push(Check::at_most(format!("{name}: time / fastest of Ceres at equal cost"), ratio, MAX_TIME_RATIO));
        let _ = writeln!(times, "| {name}: ours / fastest of Ceres at equal cost | {ratio:.3} | {MAX_TIME_RATIO} |");
    }
    let _ = writeln!(text, "\n| ratio of times | measured | at most |\n|---|---|---|\n{times}");
    let (scaling, check) = measure_scaling()?;
    text += &scaling;
    checks.push(check);
    print!("{text}");
    super::write_section("Bundle adjustment", &text)?;
    Ok(checks)
}

/// Measures the processor time per observation and iteration on one thread, for problems of increasing size.
fn measure_scaling() -> Result<(String, Check)> {
    let mut text = "\nScaling: the same without a robust loss, with fewer and more photographs at the same number of points per photograph, on one thread:\n\n\
         | photographs | observations | iterations | processor s | µs per observation and iteration |\n|---|---|---|---|---|\n"
        .to_owned();
    let mut unit_times = Vec::new();
    for photographs in SCALING_IMAGES {
        let scene = Scene::new(1, photographs);
        let (mut seconds, mut steps) = (f64::INFINITY, 0);
        for _ in 0..REPEATS {
            let (report, took) = on_one_thread(|| scene.adjust(RobustLoss::Trivial))?;
            (seconds, steps) = (seconds.min(took), report?.steps);
        }
        let n = scene.observations.len();
        let micro = 1e6 * seconds / (n * steps.max(1)) as f64;
        unit_times.push(micro);
        let _ = writeln!(text, "| {photographs} | {n} | {steps} | {seconds:.3} | {micro:.3} |");
    }
    let ratio = unit_times[SCALING_IMAGES.len() - 1] / unit_times[0];
    let _ = writeln!(
        text,
        "\n| time per observation and iteration | measured | at most |\n|---|---|---|\n| 10⁶ observations / 10⁴ | {ratio:.2} | {MAX_SCALING_RATIO} |"
    );
    Ok((text, Check::at_most("time per observation and iteration: 10⁶ / 10⁴", ratio, MAX_SCALING_RATIO)))
}

/// Images around a cylinder of points, with the initial values of poses, intrinsics and points.
struct Scene {
    /// Parameters of [`RigidMotion`], 12 for each image.
    poses: Vec<f64>,
    /// Focal length in pixels and radial coefficient of each image.
    intrinsics: Vec<f64>,
    points: Vec<f64>,
    /// Image index, point index and measured pixel (relative to the principal point).
    observations: Vec<(u32, u32, Vector2<f64>)>,
}

impl Scene {
    fn new(seed: u64, photographs: usize) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut u = || 2.0 * f64::from(rng.next_u32()) / 4294967296.0 - 1.0;
        let mut scene =
            Self { poses: Vec::new(), intrinsics: Vec::new(), points: Vec::new(), observations: Vec::new() };
        for i in 0..photographs {
            let angle = std::f64::consts::TAU * i as f64 / photographs as f64;
            let rotation = Rotation3::new(Vector3::new(0.05 * u(), 0.05 * u(), 0.05 * u()))
                * Rotation3::new(Vector3::new(0.0, angle, 0.0));
            scene.poses.extend(RigidMotion::store(&rotation, &Vector3::new(0.3 * u(), 0.3 * u(), 10.0 + 0.3 * u())));
            scene.intrinsics.extend([1400.0 + 30.0 * u(), -0.05 + 0.02 * u()]);
        }
        // Points on a cylinder around the origin, observed from outside by the nearest cameras.
        let candidates = CANDIDATE_CAMERAS.min(photographs / 2);
        for p in 0..POINTS / PHOTOGRAPHS * photographs {
            let angle = std::f64::consts::PI * u();
            let radius = 2.5 + 0.3 * u();
            let point = [-radius * angle.sin(), 2.0 * u(), -radius * angle.cos()];
            scene.points.extend(point);
            let nearest = (-angle / std::f64::consts::TAU * photographs as f64).round() as i64;
            let mut cameras: Vec<i64> = (0..candidates as i64).map(|k| nearest + k - candidates as i64 / 2).collect();
            for k in 0..TRACK_LENGTH {
                let other = k + ((u() + 1.0) / 2.0 * (candidates - k) as f64) as usize;
                cameras.swap(k, other.min(candidates - 1));
                let photograph = cameras[k].rem_euclid(photographs as i64) as u32;
                scene.observations.push((photograph, p as u32, Vector2::zeros()));
            }
        }
        let ideal: Vec<Vector2<f64>> = scene.observations.iter().filter_map(|s| scene.residual(s, None)).collect();
        let mut g = || {
            let v = (u() + 1.0) / 2.0;
            (-2.0 * v.max(1e-12).ln()).sqrt() * (std::f64::consts::PI * u()).cos()
        };
        for (s, pixel) in scene.observations.iter_mut().zip(ideal) {
            s.2 = pixel + Vector2::new(0.5 * g(), 0.5 * g());
        }
        for pose in scene.poses.chunks_exact_mut(12).skip(1) {
            let delta: [f64; 6] = std::array::from_fn(|k| if k < 3 { 0.005 * g() } else { 0.03 * g() });
            let before = pose.to_vec();
            RigidMotion.step(&before, &delta, pose);
        }
        scene.intrinsics.chunks_exact_mut(2).for_each(|l| (l[0], l[1]) = (l[0] * (1.0 + 0.01 * g()), 0.0));
        scene.points.iter_mut().for_each(|x| *x += 0.03 * g());
        scene
    }

    fn residual(
        &self,
        &(c, p, pixel): &(u32, u32, Vector2<f64>),
        j: Option<&mut SMatrix<f64, 2, 11>>,
    ) -> Option<Vector2<f64>> {
        let (c, p) = (c as usize, p as usize);
        project([&self.poses[12 * c..][..12], &self.intrinsics[2 * c..][..2], &self.points[3 * p..][..3]], pixel, j)
    }

    /// Writes the initial model as COLMAP text files.
    fn write(&self, folder: &Path) -> Result<()> {
        let (mut cameras, mut images, mut points) = (String::new(), String::new(), String::new());
        let mut tracks: Vec<String> = vec![String::new(); POINTS];
        for c in 0..PHOTOGRAPHS {
            let id = c + 1;
            let [f, k] = [self.intrinsics[2 * c], self.intrinsics[2 * c + 1]];
            writeln!(
                cameras,
                "{id} SIMPLE_RADIAL {} {} {f:?} {} {} {k:?}",
                SIZE[0],
                SIZE[1],
                SIZE[0] / 2.0,
                SIZE[1] / 2.0
            )?;
            let (rotation, t) = RigidMotion::load(&self.poses[12 * c..][..12]);
            let q = UnitQuaternion::from_rotation_matrix(&rotation);
            writeln!(
                images,
                "{id} {:?} {:?} {:?} {:?} {:?} {:?} {:?} {id} {id}.png",
                q.w, q.i, q.j, q.k, t.x, t.y, t.z
            )?;
            for (i, (_, p, pixel)) in self.observations.iter().filter(|s| s.0 as usize == c).enumerate() {
                write!(images, "{:?} {:?} {} ", pixel.x + SIZE[0] / 2.0, pixel.y + SIZE[1] / 2.0, p + 1)?;
                write!(tracks[*p as usize], " {id} {i}")?;
            }
            images.push('\n');
        }
        for (p, (x, track)) in self.points.chunks_exact(3).zip(&tracks).enumerate() {
            writeln!(points, "{} {:?} {:?} {:?} 0 0 0 0{track}", p + 1, x[0], x[1], x[2])?;
        }
        for (name, text) in [("cameras", cameras), ("images", images), ("points3D", points)] {
            std::fs::write(folder.join(format!("{name}.txt")), text)?;
        }
        Ok(())
    }

    fn adjust(&self, loss: RobustLoss) -> Result<AdjustReport> {
        let mut problem = Adjustment::default();
        let poses = problem.add_group("poses", RigidMotion, self.poses.clone())?;
        let intrinsics = problem.add_group("intrinsics", Euclidean(2), self.intrinsics.clone())?;
        let points = problem.add_group("points", Euclidean(3), self.points.clone())?;
        let pixels = Reprojection(self.observations.iter().map(|s| s.2).collect());
        let blocks = self.observations.iter().map(|&(c, p, _)| [c, c, p]).collect();
        problem.add_residuals("observations", pixels, [poses, intrinsics, points], blocks, loss)?;
        problem.eliminate(points)?;
        problem.fix(poses, 0)?;
        problem.fix_parameters(poses, self.poses.len() / 12 / 4, &[3])?;
        let options = AdjustOptions { cost_tolerance: TOLERANCE, gradient_tolerance: 0.0, ..AdjustOptions::default() };
        Ok(problem.solve(&options, |_| ControlFlow::Continue(()))?)
    }
}

/// Reprojection residuals; the measured pixels are relative to the principal point.
struct Reprojection(Vec<Vector2<f64>>);

impl Residual<2, 3, 11> for Reprojection {
    const DIMS: [usize; 3] = [6, 2, 3];

    #[inline]
    fn evaluate(&self, item: usize, blocks: [&[f64]; 3], j: Option<&mut SMatrix<f64, 2, 11>>) -> Option<Vector2<f64>> {
        project(blocks, self.0[item], j)
    }
}

/// Computes the reprojection residual of a point and its Jacobian; `None` for points behind the camera.
#[inline]
fn project(
    [pose, lens, point]: [&[f64]; 3],
    pixel: Vector2<f64>,
    j: Option<&mut SMatrix<f64, 2, 11>>,
) -> Option<Vector2<f64>> {
    let (rotation, translation) = RigidMotion::load(pose);
    let rotated = rotation * Vector3::from_column_slice(point);
    let p = rotated + translation;
    if p.z <= 0.0 {
        return None;
    }
    let [f, k] = [lens[0], lens[1]];
    let n = Vector2::new(p.x, p.y) / p.z;
    let r2 = n.norm_squared();
    let radial = 1.0 + k * r2;
    if let Some(j) = j {
        let by_n = (Matrix2::identity() * radial + n * n.transpose() * (2.0 * k)) * f;
        let by_p = by_n * Matrix2x3::new(1.0, 0.0, -n.x, 0.0, 1.0, -n.y) / p.z;
        j.fixed_columns_mut::<3>(0).copy_from(&(-by_p * rotated.cross_matrix()));
        j.fixed_columns_mut::<3>(3).copy_from(&by_p);
        j.set_column(6, &(n * radial));
        j.set_column(7, &(n * (f * r2)));
        j.fixed_columns_mut::<3>(8).copy_from(&(by_p * rotation.matrix()));
    }
    Some(n * (f * radial) - pixel)
}
