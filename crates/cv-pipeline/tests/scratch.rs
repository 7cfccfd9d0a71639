use cv_core::*;
use cv_stereo::*;
use cv_synth::*;
#[test]
fn scratch() {
    let camera = Camera::from_focal(640, 480, 520.0);
    for seed in 0..4 {
        for (name, scene, b) in [("room", Scene::room(seed), 0.2), ("tabletop", Scene::tabletop(seed), 0.06)] {
            let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), b, &RenderOptions::default()).unwrap();
            let mut m = StereoMatcher::new(StereoOptions { disparities: 96, ..Default::default() }).unwrap();
            let t = std::time::Instant::now();
            let d = m.compute(pair.left.image.view(), pair.right.image.view()).unwrap();
            let z = d.disparity.map(|[v]| [(520.0 * b as f32) / v]);
            let s = depth_score(&z, &pair.left.depth, &pair.visible, 10.0, 0.05).unwrap();
            let vis = pair.visible.as_slice().iter().filter(|v| **v).count() as f64 / 307200.0;
            let maxd = pair.disparity.as_slice().iter().cloned().fold(0.0f32, f32::max);
            println!(
                "{name} {seed}: {s:?} visible {vis:.3} maxd {maxd} matched {} {:.2}s",
                d.matched_fraction(),
                t.elapsed().as_secs_f64()
            );
            let mut out = format!("P6 640 480 255\n").into_bytes();
            for y in 0..480 {
                for x in 0..640 {
                    let (e, t) = (z.at(x, y)[0], pair.left.depth.at(x, y)[0]);
                    let g = pair.left.image.at(x, y)[1] / 2;
                    let v = pair.visible.at(x, y)[0];
                    let bad = !((e - t).abs() <= 0.05 * t);
                    out.extend(if !v {
                        [0, 0, 160]
                    } else if bad {
                        if e.is_nan() { [255, 200, 0] } else { [255, 0, 0] }
                    } else {
                        [g, g, g]
                    });
                }
            }
            std::fs::write(format!("/tmp/look/err_{name}{seed}.ppm"), out).unwrap();
        }
    }
}
