//! Writing TIFF.

use std::fs::File;

use cv_core::Image;
use cv_io::{IoError, write_image_rows};
use tiff::decoder::{Decoder, DecodingResult};

use crate::encode_rows::error_at;

#[test]
#[ignore = "4.6 GB on disk, minutes"]
fn strips_beyond_four_gigabytes_are_found() {
    let (width, height) = (20_000, 38_000);
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("big.tif");
    // Noise, which Deflate does not shrink.
    let mut state = 1_u64;
    let mut row = Image::<u16, 3>::new(width, 1, [0; 3]);
    write_image_rows(&path, |rows| -> Result<(), IoError> {
        rows.set_size(width, height);
        for _ in 0..height {
            row.as_mut_slice().fill_with(|| {
                state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
                (state >> 33) as u16
            });
            rows.write(row.view()).map_err(error_at(&path))?;
        }
        Ok(())
    })
    .unwrap();
    let mut file = File::open(&path).unwrap();
    assert!(file.metadata().unwrap().len() > 1 << 32);
    let mut decoder = Decoder::new(&mut file).unwrap();
    let last = decoder.strip_count().unwrap() - 1;
    let DecodingResult::U16(strip) = decoder.read_chunk(last).unwrap() else { panic!("not 16 bits") };
    assert!(strip[strip.len() - 3 * width..] == *row.as_slice());
}
