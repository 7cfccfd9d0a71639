//! Every command that reads images, with valid, unusual and broken files.

use crate::support::{
    JOBS, cv, done, odd_name, refused, run, snapshot, strs, write_broken, write_cmyk, write_lossless_variants,
};
use cv_core::{GrayU8, Image, RgbU8};
use std::fs;

#[test]
fn a_file_that_is_not_an_image_is_refused_by_name() {
    for job in JOBS {
        let (folder, good) = job.folder();
        let broken = write_broken(folder.path(), &job.images()[0]);
        let before = snapshot(folder.path());
        for bad in &broken {
            for place in 0..good.len() {
                let mut inputs = good.clone();
                inputs[place].clone_from(bad);
                let ran = refused(folder.path(), &strs(&job.args(&inputs)));
                assert!(ran.stderr.contains(bad.as_str()), "{}: {bad} as input {place}: {}", job.name, ran.stderr);
                assert_eq!(snapshot(folder.path()), before, "{}: {bad} as input {place} left files", job.name);
            }
        }
    }
}

#[test]
fn the_same_image_in_another_file_format_gives_the_same_bytes() {
    for job in JOBS {
        let (folder, _) = job.folder();
        let images = job.images();
        let variants: Vec<Vec<String>> = images
            .iter()
            .enumerate()
            .map(|(i, image)| write_lossless_variants(folder.path(), &format!("in{i}"), image))
            .collect();
        let mut expected = None;
        for variant in 0..variants[0].len() {
            let inputs: Vec<String> = variants.iter().map(|names| names[variant].clone()).collect();
            // A panorama has the bit depth of its photographs (`tests/metadata.rs` tests those of 16 bits).
            if job.name == "panorama" && inputs[0].contains("deep") {
                continue;
            }
            done(folder.path(), &strs(&job.args(&inputs)));
            let written = job.written(folder.path());
            // The first is the plain PNG.
            let expected = expected.get_or_insert_with(|| written.clone());
            assert!(*expected == written, "{}: {} differs from the plain PNG", job.name, inputs[0]);
        }
    }
}

#[test]
fn gray_and_cmyk_images_are_accepted() {
    for job in JOBS {
        let (folder, _) = job.folder();
        for (kind, ending) in [("gray", "png"), ("gray16", "png"), ("cmyk", "jpg")] {
            // A color model cannot distinguish a gray ball from a gray floor; the other commands use intensity.
            if job.name.starts_with("segment") && kind != "cmyk" {
                continue;
            }
            let mut inputs = Vec::new();
            for (i, image) in job.images().iter().enumerate() {
                let name = format!("{kind}{i}.{ending}");
                let path = folder.path().join(&name);
                let gray: GrayU8 =
                    image.map(|[r, g, b]| [((u32::from(r) + 2 * u32::from(g) + u32::from(b)) / 4) as u8]);
                match kind {
                    "gray" => cv_io::write_png(&path, gray.view()).unwrap(),
                    "gray16" => cv_io::write_png(&path, gray.map(|[v]| [u16::from(v) * 257]).view()).unwrap(),
                    _ => write_cmyk(&path, image),
                }
                inputs.push(name);
            }
            done(folder.path(), &strs(&job.args(&inputs)));
            job.written(folder.path());
        }
    }
}

#[test]
fn tiny_and_featureless_images_give_a_result_or_an_error() {
    let noise = |w, h| RgbU8::from_fn(w, h, |x, y| [(x * 97 + y * 57) as u8, (x * y * 31) as u8, (x * 13 + y) as u8]);
    let odd: [(&str, RgbU8); 7] = [
        ("one.png", RgbU8::new(1, 1, [90, 120, 30])),
        ("two.png", noise(2, 2)),
        ("row.png", noise(300, 1)),
        ("column.png", noise(1, 300)),
        ("small.png", noise(9, 7)),
        ("black.png", RgbU8::new(64, 48, [0; 3])),
        ("white.png", RgbU8::new(240, 180, [255; 3])),
    ];
    for job in JOBS {
        let (folder, good) = job.folder();
        for (name, image) in &odd {
            cv_io::write_png(folder.path().join(name), image.view()).unwrap();
            // One input replaced, and all of them.
            for place in 0..=good.len() {
                let mut inputs = good.clone();
                match inputs.get_mut(place) {
                    Some(input) => input.clone_from(&(*name).to_owned()),
                    // Each in its own file: the same file twice is wrong usage if each has an output.
                    None => {
                        for (i, input) in inputs.iter_mut().enumerate() {
                            *input = format!("{i}-{name}");
                            cv_io::write_png(folder.path().join(&input), image.view()).unwrap();
                        }
                    }
                }
                // `run` asserts that the program does not panic.
                let ran = run(folder.path(), &strs(&job.args(&inputs)));
                assert_ne!(ran.code, Some(2), "{}: {name} is no matter of usage: {}", job.name, ran.stderr);
                if ran.code == Some(1) {
                    assert!(ran.stderr.contains("error: "), "{}: {name}: {}", job.name, ran.stderr);
                }
            }
        }
    }
}

#[test]
fn an_image_with_trailing_bytes_is_read() {
    for job in JOBS {
        let (folder, good) = job.folder();
        done(folder.path(), &strs(&job.args(&good)));
        let expected = job.written(folder.path());
        for name in &good {
            let path = folder.path().join(name);
            let mut bytes = fs::read(&path).unwrap();
            bytes.extend_from_slice(b"rubbish after the end");
            fs::write(&path, bytes).unwrap();
        }
        done(folder.path(), &strs(&job.args(&good)));
        assert!(job.written(folder.path()) == expected, "{}", job.name);
    }
}

#[test]
fn names_with_spaces_and_other_scripts_work() {
    for job in JOBS {
        let (folder, good) = job.folder();
        let mut inputs = Vec::new();
        for name in &good {
            let odd = odd_name(name);
            fs::rename(folder.path().join(name), folder.path().join(&odd)).unwrap();
            inputs.push(odd);
        }
        done(folder.path(), &strs(&job.args(&inputs)));
    }
}

#[test]
fn webp_is_read_losslessly_and_truncated_files_are_refused() {
    let job = JOBS.iter().find(|job| job.name == "match").unwrap();
    let (folder, good) = job.folder();
    let mut inputs = Vec::new();
    for (i, image) in job.images().iter().enumerate() {
        // A lossless copy of the same image.
        cv_io::write_png(folder.path().join(&good[i]), image.view()).unwrap();
        let (mut bytes, size) = (Vec::new(), (image.width() as u32, image.height() as u32));
        let encoder = image_webp::WebPEncoder::new(&mut bytes);
        encoder.encode(image.as_slice(), size.0, size.1, image_webp::ColorType::Rgb8).unwrap();
        inputs.push(format!("in{i}.webp"));
        fs::write(folder.path().join(&inputs[i]), &bytes).unwrap();
        fs::write(folder.path().join("cut.webp"), &bytes[..bytes.len() / 2]).unwrap();
        fs::write(folder.path().join("head.webp"), &bytes[..24]).unwrap();
    }
    done(folder.path(), &strs(&job.args(&good)));
    let expected = job.written(folder.path());
    done(folder.path(), &strs(&job.args(&inputs)));
    assert!(job.written(folder.path()) == expected);
    for broken in ["cut.webp", "head.webp"] {
        let ran = refused(folder.path(), &strs(&job.args(&[good[0].clone(), broken.to_owned()])));
        assert!(ran.stderr.contains(broken) && ran.stderr.contains("WebP"), "{ran:?}");
    }
}

#[test]
fn a_fully_transparent_image_is_read_by_its_colors() {
    let clear: Image<u8, 4> = Image::new(32, 32, [10, 20, 30, 0]);
    for job in JOBS {
        let (folder, good) = job.folder();
        cv_io::write_png(folder.path().join("clear.png"), clear.view()).unwrap();
        let mut inputs = good.clone();
        inputs[0] = "clear.png".to_owned();
        run(folder.path(), &strs(&job.args(&inputs)));
    }
}

/// Each photograph is read once: a pipe cannot be read a second time.
#[cfg(unix)]
#[test]
fn photographs_are_read_once() {
    use std::process::{Command, Stdio};
    use std::time::{Duration, Instant};
    for job in JOBS {
        let (folder, inputs) = job.folder();
        for input in &inputs {
            let path = folder.path().join(input);
            let bytes = fs::read(&path).unwrap();
            fs::remove_file(&path).unwrap();
            assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
            // The thread ends when all has been read; a second open of the pipe would block forever.
            std::thread::spawn(move || fs::write(path, bytes));
        }
        let mut command = cv(folder.path());
        let mut child = command.args(job.args(&inputs)).stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let start = Instant::now();
        // Far longer than a job on small images takes on a busy machine.
        while child.try_wait().unwrap().is_none() && start.elapsed() < Duration::from_secs(240) {
            std::thread::sleep(Duration::from_millis(20));
        }
        let ended = child.try_wait().unwrap();
        let _ = child.kill();
        assert!(ended.is_some_and(|status| status.success()), "{}: {ended:?}", job.name);
    }
}
