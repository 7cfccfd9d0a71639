//! Writing Deep Zoom images.

use std::fs;
use std::io;
use std::path::Path;

use cv_core::Image;
use cv_io::{FormatError, IoError, Metadata, check_deep_zoom, read_image, write_image, write_image_rows};

use crate::encode_rows::error_at;

fn decode_png(path: &Path) -> Image<u8, 4> {
    let mut reader = png::Decoder::new(io::BufReader::new(fs::File::open(path).unwrap())).read_info().unwrap();
    let mut samples = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut samples).unwrap();
    Image::from_vec(info.width as usize, info.height as usize, samples).unwrap()
}

/// Assembles a level from its PNG tiles; where tiles overlap, they must agree.
fn assemble(folder: &Path, level: usize, width: usize, height: usize) -> Image<u8, 4> {
    let mut image = Image::<u8, 4>::new(width, height, [0; 4]);
    let mut is_set = vec![false; width * height];
    let folder = folder.join(level.to_string());
    let (columns, rows) = (width.div_ceil(254), height.div_ceil(254));
    assert_eq!(fs::read_dir(&folder).unwrap().count(), columns * rows, "level {level}");
    for row in 0..rows {
        for column in 0..columns {
            let tile = decode_png(&folder.join(format!("{column}_{row}.png")));
            // One pixel of overlap where there is a neighbor.
            let (left, top) = ((254 * column).saturating_sub(1), (254 * row).saturating_sub(1));
            let end = |i: usize, all: usize| (254 * (i + 1) + 1).min(all);
            assert_eq!(tile.size(), (end(column, width) - left, end(row, height) - top));
            for y in 0..tile.height() {
                for x in 0..tile.width() {
                    let i = (top + y) * width + left + x;
                    assert!(!is_set[i] || image.at(left + x, top + y) == tile.at(x, y), "level {level}: {x}, {y}");
                    is_set[i] = true;
                    image.set(left + x, top + y, tile.at(x, y));
                }
            }
        }
    }
    assert!(is_set.iter().all(|&set| set));
    image
}

#[test]
fn tiles_of_all_levels_assemble_to_the_image_and_its_averages() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("wide.dzi");
    // One pixel; sides around one and two tiles; odd sides; each replaces the one before.
    for (width, height) in [(1, 1), (254, 255), (256, 253), (509, 508), (700, 1), (3, 511), (777, 603)] {
        let pixel =
            |x: usize, y: usize| [(x * 7 + y) as u8, (y * 5 + x / 3) as u8, (x * y / 11) as u8, 255 - (y % 2) as u8];
        let image = Image::<u8, 4>::from_fn(width, height, pixel);
        write_image(&path, image.view(), &Metadata::default()).unwrap();
        let xml = fs::read_to_string(&path).unwrap();
        assert!(xml.contains(&format!("<Size Width=\"{width}\" Height=\"{height}\"/>")), "{xml}");
        let tiles = folder.path().join("wide_files");
        let mut expected = image;
        let levels = (0..).find(|&n| 1usize << n >= width.max(height)).unwrap();
        assert_eq!(fs::read_dir(&tiles).unwrap().count(), levels + 1);
        for level in (0..=levels).rev() {
            let (w, h) = expected.size();
            assert!(assemble(&tiles, level, w, h) == expected, "level {level} of {width}×{height}");
            expected = Image::from_fn(w.div_ceil(2), h.div_ceil(2), |x, y| {
                let at = |dx: usize, dy: usize| expected.at((2 * x + dx).min(w - 1), (2 * y + dy).min(h - 1));
                std::array::from_fn(|c| {
                    let sum: f64 = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)].iter().map(|p| f64::from(p[c])).sum();
                    (sum / 4.0 + 0.5).floor() as u8
                })
            });
        }
        assert_eq!(expected.size(), (1, 1));
    }
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
}

#[test]
fn colors_have_tiles_of_jpeg() {
    let folder = tempfile::tempdir().unwrap();
    let image = Image::<u8, 3>::from_fn(300, 20, |x, _| [(x / 2) as u8, 90, 200]);
    write_image(folder.path().join("a.dzi"), image.view(), &Metadata::default()).unwrap();
    assert!(fs::read_to_string(folder.path().join("a.dzi")).unwrap().contains("Format=\"jpg\""));
    let tile = read_image(folder.path().join("a_files/9/1_0.jpg")).unwrap().into_rgb8();
    assert_eq!(tile.size(), (47, 20));
    for x in 0..47 {
        // A smooth ramp: JPEG of quality 90 is within a few levels.
        assert!(tile.at(x, 10).iter().zip(image.at(253 + x, 10)).all(|(a, b)| a.abs_diff(b) <= 4), "{x}");
    }
}

#[test]
fn other_folders_and_failed_images_are_left_alone() {
    let folder = tempfile::tempdir().unwrap();
    let (path, tiles) = (folder.path().join("a.dzi"), folder.path().join("a_files"));
    let image = Image::<u8, 3>::new(5, 4, [9; 3]);
    fs::create_dir(&tiles).unwrap();
    fs::write(tiles.join("saved by a browser"), "x").unwrap();
    assert!(check_deep_zoom(&path).is_err());
    let error = write_image(&path, image.view(), &Metadata::default()).unwrap_err().to_string();
    assert!(error.contains("a_files exists and does not belong to a Deep Zoom image"), "{error}");
    assert!(tiles.join("saved by a browser").exists() && !path.exists());
    fs::remove_dir_all(&tiles).unwrap();
    write_image(&path, image.view(), &Metadata::default()).unwrap();
    check_deep_zoom(&path).unwrap();
    let old = fs::read(&path).unwrap();
    let short = write_image_rows(&path, |rows| -> Result<(), IoError> {
        rows.set_size(5, 9);
        rows.write(image.view()).map_err(error_at(&path))
    });
    assert!(short.unwrap_err().to_string().contains("5 rows are missing"));
    assert!(fs::read(&path).unwrap() == old && tiles.join("3/0_0.jpg").exists());
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    let deep = Image::<u16, 3>::new(2, 2, [9; 3]);
    let error = write_image(&path, deep.view(), &Metadata::default()).unwrap_err();
    assert!(matches!(error.reason, FormatError::NotRepresentable { format: "Deep Zoom", .. }), "{error}");
}
