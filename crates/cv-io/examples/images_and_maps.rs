//! Writes an image and a disparity map, and reads them back.
use cv_core::{GrayF32, RgbU8};
use cv_io::{pfm, read_map, read_rgb, write_png};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = std::env::temp_dir().join("cv-io-example");
    std::fs::create_dir_all(&folder)?;
    let image = RgbU8::from_fn(64, 48, |x, y| [4 * x as u8, 5 * y as u8, 128]);
    write_png(folder.join("image.png"), image.view())?;
    assert_eq!(read_rgb(folder.join("image.png"))?, image);
    // Invalid disparity is NaN in memory, and the format's own marker in the file.
    let disparity = GrayF32::from_fn(64, 48, |x, _| [if x < 8 { f32::NAN } else { x as f32 }]);
    pfm::write(folder.join("disparity.pfm"), disparity.view())?;
    let back = read_map(folder.join("disparity.pfm"), None)?;
    println!("{} of {} pixels are valid", back.as_slice().iter().filter(|v| v.is_finite()).count(), 64 * 48);
    // Errors have the path, the reason and a remedy.
    println!("{}", read_rgb(folder.join("absent.png")).err().map_or_else(String::new, |e| e.to_string()));
    std::fs::remove_dir_all(&folder)?;
    Ok(())
}
