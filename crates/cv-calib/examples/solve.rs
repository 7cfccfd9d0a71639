use cv_calib::*;
use cv_core::{Named, Point2, Silent};
fn main() {
    let a: Vec<String> = std::env::args().collect();
    let text = std::fs::read_to_string(&a[1]).unwrap();
    let lens = LensChoice::from_name(&a[2]).unwrap();
    let only: Option<usize> = a.get(3).and_then(|s| s.parse().ok());
    let flat = a.get(4).is_some_and(|s| s == "flat");
    let mut target = TargetPoints::grid(9, 6, 1.0).unwrap();
    let (mut sizes, mut views): (Vec<(usize, usize)>, Vec<Vec<Vec<TargetCorner>>>) = (vec![], vec![]);
    let (mut v, mut c) = (0, 0);
    for line in text.lines() {
        let f: Vec<&str> = line.split_whitespace().collect();
        match f[0] {
            "board" => target = TargetPoints::grid(f[1].parse().unwrap(), f[2].parse().unwrap(), 1.0).unwrap(),
            "camera" => sizes.push((f[1].parse().unwrap(), f[2].parse().unwrap())),
            "view" => {
                (v, c) = (f[1].parse().unwrap(), f[2].parse().unwrap());
                while views.len() <= v {
                    views.push(vec![vec![]; sizes.len()]);
                }
            }
            _ => {
                let l = &mut views[v][c];
                let point = l.len();
                l.push(TargetCorner { point, pixel: Point2::new(f[0].parse().unwrap(), f[1].parse().unwrap()) });
            }
        }
    }
    let mut data = Sightings { target, sizes, views };
    if let Some(c) = only {
        data = data.of_camera(c).0;
    }
    let options =
        CalibrateOptions { lens, board_shape: !flat, holdout: !a.iter().any(|s| s == "fast"), ..Default::default() };
    let t = std::time::Instant::now();
    let found = calibrate(&data, &options, &Silent);
    println!("seconds {:.3}", t.elapsed().as_secs_f64());
    let found = match found {
        Ok(f) => f,
        Err(e) => {
            println!("{e}");
            return;
        }
    };
    println!("rms {:.4} holdout {:.4} noise {:.4}", found.rms_px, found.holdout_rms_px, found.noise_px);
    for c in &found.cameras {
        println!(
            "camera rms {:.4} holdout {:.4} uncertainty median {:.3} worst {:?}",
            c.rms_px,
            c.holdout_rms_px,
            c.uncertainty.median(),
            c.uncertainty.worst()
        );
        for l in &c.lenses {
            println!("  {:?}", l);
        }
    }
    for p in &found.parameters {
        println!("  {:?} {} {:.6} ± {:.6}", p.camera, p.name, p.value, p.deviation);
    }
    println!("  {:?} {:?}", found.target_shape, found.verdict);
    for (i, v) in found.views.iter().enumerate() {
        for p in &v.pictures {
            println!("{i} {:?} {:.3}", p.outcome, p.rms_px);
        }
    }
}
