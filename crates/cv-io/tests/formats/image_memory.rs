//! Memory limits of reading images.

use cv_io::{FormatError, ReadOptions, decode_image, read_image_with};

use crate::samples::{bmp, bmp_header, hdr_of_runs, plain, ramp};

/// Returns the estimated memory for reading, from the error under a limit of one byte.
fn estimated_memory(bytes: &[u8]) -> u64 {
    match decode_image(bytes, &ReadOptions { max_memory: 1, ..ReadOptions::default() }) {
        Err(FormatError::TooMuchMemory { needed, allowed: 1, .. }) => needed,
        other => panic!("{other:?}"),
    }
}

#[test]
fn memory_is_estimated_from_the_header_in_every_format() {
    let within = |max_memory| ReadOptions { max_memory, ..ReadOptions::default() };
    for (name, bytes) in plain(640, 480) {
        let needed = estimated_memory(&bytes);
        let pixels = 640 * 480;
        // At least the file and the samples, at most three copies of float samples.
        assert!(needed >= bytes.len() as u64 + 3 * pixels, "{name}: {needed}");
        assert!(needed <= bytes.len() as u64 + 3 * 12 * pixels, "{name}: {needed}");
        assert!(decode_image(&bytes, &within(needed)).is_ok(), "{name}");
        let error = decode_image(&bytes, &within(needed - 1)).unwrap_err();
        assert!(
            matches!(error, FormatError::TooMuchMemory { allowed, size: Some((640, 480)), .. } if allowed == needed - 1),
            "{name}: {error}"
        );
    }
    // Progressive JPEGs keep all coefficients.
    let files = plain(640, 480);
    let of = |name: &str| estimated_memory(&files.iter().find(|(n, _)| *n == name).unwrap().1);
    assert!(of("progressive") > of("jpeg") + 640 * 480 * 3);
}

#[test]
fn a_small_file_with_many_pixels_is_refused_quickly() {
    let start = std::time::Instant::now();
    let bytes = hdr_of_runs(16_000, 16_000);
    let limit = ReadOptions { max_memory: 1 << 30, ..ReadOptions::default() };
    let error = decode_image(&bytes, &limit).unwrap_err();
    let FormatError::TooMuchMemory { needed, size: Some((16_000, 16_000)), .. } = error else { panic!("{error}") };
    assert!(needed > 16_000 * 16_000 * 12);
    // Missing rows are an error of the file, not of memory.
    let truncated = b"#?RADIANCE\n\n-Y 16000 +X 16000\n\x80\x40\x20\x81";
    assert!(matches!(decode_image(truncated, &limit), Err(FormatError::Corrupt { .. })));
    for w in [20_000usize, 60_000] {
        let header = bmp_header(w, 8000, 24, 0, 54);
        assert!(decode_image(&header, &limit).is_err());
        assert!(decode_image(format!("P6 {w} 8000 255\n").as_bytes(), &limit).is_err());
    }
    assert!(start.elapsed().as_secs_f64() < 1.0);
}

#[test]
fn the_file_size_counts_towards_the_memory_limit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.bmp");
    std::fs::write(&path, bmp(&ramp(100, 100))).unwrap();
    let error = read_image_with(&path, &ReadOptions { max_memory: 30_000, ..ReadOptions::default() }).unwrap_err();
    assert!(matches!(error.reason, FormatError::TooMuchMemory { size: None, .. }), "{error}");
    assert!(error.to_string().contains("allow more memory"), "{error}");
    let error = read_image_with(&path, &ReadOptions { max_memory: 60_000, ..ReadOptions::default() }).unwrap_err();
    assert!(matches!(error.reason, FormatError::TooMuchMemory { size: Some((100, 100)), .. }), "{error}");
}
