//! Time of the rejection of degenerate matches, until the typed error. Target: 50 ms each.
//! `cargo bench --manifest-path benches/Cargo.toml --bench degenerate`.

use criterion::{Criterion, criterion_group, criterion_main};
use cv_core::{Camera, Correspondence, Silent};
use cv_geometry::{
    EstimateError, RobustOptions, estimate_fundamental, estimate_homography, estimate_relative_pose, normalize_matches,
};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::hint::black_box;

const MATCHES: usize = 300;

/// Returns names and matches of the degenerate inputs.
fn inputs() -> Vec<(&'static str, Vec<Correspondence>)> {
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut random = |high: f64| high * f64::from(rng.next_u32()) / 4294967296.0;
    let mut random_matches = |n: usize, size: f64, from: f64| -> Vec<Correspondence> {
        let mut at = || from + random(size);
        (0..n).map(|_| Correspondence::new(at(), at(), at(), at())).collect()
    };
    let outliers = random_matches(MATCHES, 900.0, 0.0);
    let mut infinite = outliers.clone();
    infinite[MATCHES - 1].b.y = f64::INFINITY;
    let mut nan = outliers.clone();
    nan[MATCHES - 1].a.x = f64::NAN;
    let line = |m: &Correspondence| Correspondence::new(m.a.x, 0.5 * m.a.x, m.b.x, 100.0 - 0.3 * m.b.x);
    let plane = |m: &Correspondence| {
        let w = 1.0 + 1e-4 * m.a.x;
        Correspondence::new(m.a.x, m.a.y, (0.9 * m.a.x + 30.0) / w, (m.a.y - 20.0) / w)
    };
    vec![
        ("7 points", random_matches(7, 900.0, 0.0)),
        ("repeated points", (0..MATCHES).map(|i| outliers[i % 3]).collect()),
        ("collinear", outliers.iter().map(line).collect()),
        ("one plane", outliers.iter().map(plane).collect()),
        ("NaN", nan),
        ("infinite", infinite),
        ("up to 1e9 px", random_matches(MATCHES, 2e9, -1e9)),
        ("beyond 1e9 px", random_matches(MATCHES, 900.0, 1e9)),
        ("random", outliers),
        ("5000 random", random_matches(5000, 900.0, 0.0)),
    ]
}

fn bench(c: &mut Criterion) {
    let mut group = c.benchmark_group("degenerate");
    group.sample_size(10);
    let camera = Camera::from_focal(900, 900, 1000.0);
    let essential = |m: &[Correspondence]| -> Result<usize, EstimateError> {
        let (m, unit) = normalize_matches(m, &camera, &camera);
        let options = RobustOptions { threshold: unit, ..RobustOptions::essential() };
        estimate_relative_pose(&m, &options, &Silent).map(|found| found.inliers.len())
    };
    let homography = |m: &[Correspondence]| estimate_homography(m, &RobustOptions::homography(), &Silent);
    let fundamental = |m: &[Correspondence]| estimate_fundamental(m, &RobustOptions::fundamental(), &Silent);
    for (name, m) in inputs() {
        group.bench_function(format!("homography, {name}"), |b| b.iter(|| homography(black_box(&m)).is_ok()));
        group.bench_function(format!("fundamental, {name}"), |b| b.iter(|| fundamental(black_box(&m)).is_ok()));
        group.bench_function(format!("essential, {name}"), |b| b.iter(|| essential(black_box(&m)).is_ok()));
    }
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
