//! Time of the minimal and linear solvers: `cargo bench --manifest-path benches/Cargo.toml --bench solvers`.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot go on has failed")]

use criterion::{Criterion, criterion_group, criterion_main};
use cv_core::{Correspondence, Point2, Point3, Pose, Rotation3, Vector3};
use cv_geometry::{
    WorldMatch, essential_five_point, fundamental_eight_point, fundamental_seven_point, homography_four_point,
    pose_three_points,
};
use std::hint::black_box;

/// Returns eight points and their projections in two cameras, in normalized coordinates.
fn scene() -> (Vec<Point3<f64>>, Vec<Correspondence>) {
    let pose = Pose::new(Rotation3::new(Vector3::new(0.05, -0.1, 0.02)), Vector3::new(-0.9, 0.1, 0.3));
    let points: Vec<Point3<f64>> = (0..8)
        .map(|i| {
            let t = f64::from(i);
            Point3::new((1.7 * t).sin() * 1.5, (2.9 * t).cos() * 1.2, 6.0 + (4.1 * t).sin() * 2.0)
        })
        .collect();
    let project = |p: &Point3<f64>| Point2::new(p.x / p.z, p.y / p.z);
    let matches = points.iter().map(|p| Correspondence { a: project(p), b: project(&pose.transform(p)) }).collect();
    (points, matches)
}

fn bench(c: &mut Criterion) {
    let mut group = c.benchmark_group("solvers");
    let (points, m) = scene();
    let (a5, b5) = (std::array::from_fn(|i| m[i].a), std::array::from_fn(|i| m[i].b));
    group.bench_function("essential, 5 points", |b| {
        b.iter(|| {
            essential_five_point(black_box(&a5), black_box(&b5), |e| {
                black_box(e);
            })
        })
    });
    let (a7, b7) = (std::array::from_fn(|i| m[i].a), std::array::from_fn(|i| m[i].b));
    group.bench_function("fundamental, 7 points", |b| {
        b.iter(|| {
            fundamental_seven_point(black_box(&a7), black_box(&b7), |f| {
                black_box(f);
            })
        })
    });
    group.bench_function("fundamental, 8 points", |b| b.iter(|| fundamental_eight_point(black_box(&m)).unwrap()));
    // Coplanar points: projections of four general points rarely have a consistent orientation, and the solver would return early.
    let a4 = [Point2::new(-0.3, -0.2), Point2::new(0.35, -0.25), Point2::new(0.3, 0.3), Point2::new(-0.25, 0.2)];
    let b4 = a4.map(|p| {
        Point2::new((1.1 * p.x + 0.1 * p.y + 0.05) / (1.0 + 0.1 * p.x), (0.9 * p.y - 0.1 * p.x) / (1.0 + 0.1 * p.x))
    });
    assert!(homography_four_point(&a4, &b4).is_some());
    group.bench_function("homography, 4 points", |b| b.iter(|| homography_four_point(black_box(&a4), black_box(&b4))));
    let three: [WorldMatch; 3] = std::array::from_fn(|i| WorldMatch { world: points[i], image: m[i].b });
    group.bench_function("pose, 3 points", |b| {
        b.iter(|| {
            pose_three_points(black_box(&three), |pose| {
                black_box(pose);
            })
        })
    });
    group.finish();
}

criterion_group!(benches, bench);
criterion_main!(benches);
