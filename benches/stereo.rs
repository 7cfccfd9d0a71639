//! Time of the stereo matcher for numbers of paths, census windows and image sizes: `cargo bench --manifest-path benches/Cargo.toml --bench stereo`.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot go on has failed")]

use criterion::{BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use cv_core::{GrayU8, Silent};
use cv_stereo::{Census, DisparityMap, Paths, Smoothing, StereoMatcher, StereoOptions};
use std::hint::black_box;

/// Generates a pair of a noise texture with a constant disparity of 20 px.
fn pair(width: usize, height: usize) -> [GrayU8; 2] {
    let noise = |x: usize, y: usize| (x * 7919 + y * 104_729 + x * y % 97 * 31).wrapping_mul(2_654_435_761) >> 13;
    [0, 20].map(|shift| GrayU8::from_fn(width, height, |x, y| [noise((x + shift) / 3, y / 3) as u8]))
}

fn bench(c: &mut Criterion) {
    let mut group = c.benchmark_group("match");
    let default = StereoOptions::default;
    let cases = [
        ("8 paths", default()),
        ("4 paths", StereoOptions { paths: Paths::Four, ..default() }),
        ("census 9x7", StereoOptions { census: Census::Window9x7, ..default() }),
        ("unsmoothed", StereoOptions { smoothing: Smoothing::None, ..default() }),
    ];
    for (width, height) in [(366, 274), (742, 500), (1634, 1224)] {
        let [left, right] = pair(width, height);
        group.throughput(Throughput::Elements((width * height * default().disparities) as u64));
        for (name, options) in &cases {
            let mut matcher = StereoMatcher::new(options.clone()).unwrap();
            let mut map = DisparityMap::empty();
            matcher.compute_into(left.view(), right.view(), &mut map, &Silent).unwrap();
            let correct = map.disparity.as_slice().iter().filter(|d| (**d - 20.0).abs() < 0.5).count();
            assert!(correct * 10 > 9 * width * height, "{name}: {correct} of {}", width * height);
            group.bench_function(BenchmarkId::new(*name, format!("{width}x{height}")), |b| {
                b.iter(|| {
                    matcher.compute_into(black_box(left.view()), black_box(right.view()), &mut map, &Silent).unwrap();
                });
            });
        }
    }
    group.finish();
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10);
    targets = bench
}
criterion_main!(benches);
