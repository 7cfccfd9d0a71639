//! Parses a camera line of COLMAP's cameras.txt, prints it in every calibration format that can be written, and reads one back.
use cv_io::{CalibrationFormat, parse_camera, read_camera, write_camera};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = parse_camera("1 OPENCV 640 480 500 501 320 240 -0.30 0.08 0.001 -0.002", None)?;
    for format in CalibrationFormat::all().filter(|f| f.writes_cameras()) {
        println!("{}:\n{}", format.name(), format.camera_text(&camera, &["made by an example"])?);
    }
    let path = std::env::temp_dir().join("cv-io-example-camera.yaml");
    write_camera(&path, &camera, &[])?;
    assert_eq!(read_camera(&path, None)?, camera);
    std::fs::remove_file(&path)?;
    Ok(())
}
