//! Time of a calibration from 200 views of a board of 11 × 8 corners.

use criterion::{Criterion, criterion_group, criterion_main};
use cv_calib::{CalibrateOptions, LensChoice, TargetCorner, TargetObservations, TargetPoints, calibrate};
use cv_core::{Camera, Distortion, Pose, Rotation3, Silent, Vector3};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{Rng, SeedableRng};
use std::time::Duration;

fn generate_observations(views: usize) -> TargetObservations {
    let target = TargetPoints::grid(11, 8, 30.0).unwrap();
    let distortion = Distortion::radial_tangential5([-0.35, 0.14, 1e-3, -5e-4, -0.02]);
    let camera = Camera { distortion, ..Camera::pinhole(1280, 960, 900.0, 902.0, 650.0, 470.0) };
    let mut rng = ChaCha8Rng::seed_from_u64(1);
    let mut u = move || f64::from(rng.next_u32()) / 4294967296.0;
    let mut all = Vec::new();
    while all.len() < views {
        let rotation = Rotation3::new(Vector3::new(1.2 * u() - 0.6, 1.2 * u() - 0.6, 0.6 * u() - 0.3));
        let z = 350.0 + 350.0 * u();
        let center = Vector3::new((0.7 * u() - 0.35) * z, (0.5 * u() - 0.25) * z, z);
        let pose = Pose::new(rotation, center - rotation * Vector3::new(150.0, 105.0, 0.0));
        let corner = |point| {
            let p = camera.project(&pose.transform(&target.bent(point, [1.0, 0.0])))?;
            let inside = (5.0..1275.0).contains(&p.x) && (5.0..955.0).contains(&p.y);
            inside.then_some(TargetCorner { point, pixel: p })
        };
        let Some(mut corners) = (0..88).map(corner).collect::<Option<Vec<_>>>() else { continue };
        for c in &mut corners {
            // The sum of twelve uniform numbers is approximately normal.
            let mut noise = || 0.1 * ((0..12).map(|_| u()).sum::<f64>() - 6.0);
            (c.pixel.x, c.pixel.y) = (c.pixel.x + noise(), c.pixel.y + noise());
        }
        all.push(vec![corners]);
    }
    TargetObservations { target, sizes: vec![(1280, 960)], views: all }
}

fn solve(c: &mut Criterion) {
    let data = generate_observations(200);
    for lens in [LensChoice::RadialTangential5, LensChoice::Rational8] {
        let options = CalibrateOptions { lens, holdout: false, ..CalibrateOptions::default() };
        // Correctness: the estimated noise is that of the data.
        let found = calibrate(&data, &options, &Silent).unwrap();
        println!("{lens}: noise {:.4} px (true 0.1), fx {:.2} (true 900)", found.noise_px, found.cameras[0].camera.fx);
        c.bench_function(&format!("calibrate 200 views, {lens}"), |b| {
            b.iter(|| calibrate(&data, &options, &Silent).unwrap())
        });
    }
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(10).measurement_time(Duration::from_secs(8));
    targets = solve
}
criterion_main!(benches);
