//! Features of kornia-rs and imageproc. usage: rust-peers IMAGE STAGE
//!
//! Prints a JSON line, the fastest of some warm runs with two threads.

use imageproc::{binary_descriptors::brief::brief, corners::oriented_fast, point::Point};
use kornia_image::{Image, ImageSize};
use kornia_imgproc::features::{
    FirstOctave, HarrisResponse, OrbDetector, SiftConfig, SiftWorkspace, gftt_response, match_descriptors_f32,
    sift_detect_and_compute,
};
use std::{error::Error, hint::black_box, time::Instant};

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let (Some(path), Some(stage)) = (arguments.next(), arguments.next()) else {
        return Err("usage: rust-peers IMAGE STAGE".into());
    };
    rayon::ThreadPoolBuilder::new().num_threads(2).build_global()?;
    let gray = image::open(path)?.to_luma8();
    let (width, height) = (gray.width() as usize, gray.height() as usize);
    let size = ImageSize { width, height };
    let bytes = Image::<u8, 1>::from_size_slice(size, gray.as_raw())?;
    // The time includes the conversion from bytes where a stage takes floats, into a reused buffer, as for ours.
    let mut float = Image::<f32, 1>::from_size_val(size, 0.0)?;
    let convert = |float: &mut Image<f32, 1>| {
        float.as_slice_mut().iter_mut().zip(gray.as_raw()).for_each(|(f, b)| *f = f32::from(*b) * (1.0 / 255.0));
    };
    let mut response = Image::<f32, 1>::from_size_val(size, 0.0)?;
    let seconds = match stage.as_str() {
        "kornia Harris" => {
            let mut harris = HarrisResponse::new(size);
            fastest(20, || harris.compute_u8(&bytes, &mut response))?
        }
        "kornia Shi-Tomasi" => fastest(10, || {
            convert(&mut float);
            gftt_response(&float, &mut response, 3, 3, true)
        })?,
        "kornia SIFT" => {
            let mut workspace = SiftWorkspace::new();
            let config = SiftConfig { n_features: 2000, ..SiftConfig::default() };
            fastest(5, || {
                // It expects gray levels from 0 to 255 as floats.
                float.as_slice_mut().iter_mut().zip(gray.as_raw()).for_each(|(f, b)| *f = f32::from(*b));
                let all = usize::MAX;
                let pixels = float.as_slice();
                let found = sift_detect_and_compute(
                    &mut workspace,
                    pixels,
                    width,
                    height,
                    &config,
                    FirstOctave::Double,
                    all,
                    false,
                );
                found.map(black_box)
            })?
        }
        "kornia ORB" => {
            let orb = OrbDetector { n_keypoints: 2000, ..OrbDetector::new() };
            fastest(10, || orb.detect_and_extract_u8(&bytes).map(black_box))?
        }
        "kornia nearest 2000" => {
            let sets = [descriptors::<64>(2000, 1), descriptors::<64>(2000, 2)];
            fastest(8, || {
                Ok::<_, String>(black_box(match_descriptors_f32(&sets[0], &sets[1], None, false, Some(0.8))))
            })?
        }
        "imageproc FAST and BRIEF" => fastest(3, || {
            let corners = oriented_fast(&gray, None, 2000, 17, Some(1));
            let points: Vec<Point<u32>> = corners.iter().map(|c| Point::new(c.corner.x, c.corner.y)).collect();
            brief(&gray, &points, 256, None).map(black_box)
        })?,
        _ => return Err(format!("there is no stage {stage:?}").into()),
    };
    println!("{{\"stage\": \"{stage}\", \"seconds\": {seconds}}}");
    Ok(())
}

/// Returns the seconds of the fastest of `repeats` runs after one warm-up run.
fn fastest<T, E>(repeats: usize, mut call: impl FnMut() -> Result<T, E>) -> Result<f64, E> {
    call()?;
    let mut best = f64::INFINITY;
    for _ in 0..repeats {
        let start = Instant::now();
        black_box(call()?);
        best = best.min(start.elapsed().as_secs_f64());
    }
    Ok(best)
}

/// Generates unit vectors from a linear congruential generator.
fn descriptors<const D: usize>(count: usize, seed: u64) -> Vec<[f32; D]> {
    let mut state = seed;
    (0..count)
        .map(|_| {
            let row: [f32; D] = std::array::from_fn(|_| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 40) as f32 / (1u64 << 24) as f32
            });
            let norm = row.iter().map(|v| v * v).sum::<f32>().sqrt();
            row.map(|v| v / norm)
        })
        .collect()
}
