//! Models of COLMAP as text.

use cv_core::{Camera, Distortion, Point2};
use cv_io::FormatError;
use cv_io::colmap::{parse_cameras, parse_images, parse_points};

const CAMERAS: &str = "# Camera list\n# Number of cameras: 2\n1 SIMPLE_RADIAL 3072 2304 2559.81 1536 1152 -0.0218531\n2 PINHOLE 3072 2304 2560.56 2560.56 1536 1152\n";
const IMAGES: &str = "# Image list\n1 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 1 P1180141.JPG\n2362.39 248.498 58396 1784.7 268.254 59027 1784.7 268.254 -1\n2 0.851773 0.0165051 0.503764 -0.142941 -0.737434 1.02973 3.74354 2 my photo.JPG\n\n";
const POINTS: &str = "# 3D points\n58396 1.67241 0.292931 0.609726 115 121 122 1.33927 1 0\n";

#[test]
fn the_examples_of_the_manual() {
    let cameras = parse_cameras(CAMERAS).unwrap();
    let expected = Camera {
        distortion: Distortion::simple_radial(-0.0218531),
        ..Camera::pinhole(3072, 2304, 2559.81, 2559.81, 1535.5, 1151.5)
    };
    assert_eq!(cameras[&1], expected);
    let images = parse_images(IMAGES).unwrap();
    assert_eq!((images.len(), &images[&2].name[..], images[&2].points.len()), (2, "my photo.JPG", 0));
    let first = &images[&1];
    assert_eq!(first.points[0], (Point2::new(2361.89, 247.998), Some(58396)));
    assert_eq!(first.points[2].1, None);
    // R of a quaternion by its definition: the first entry is 1 − 2(y² + z²), normalized.
    let n = 0.851773f64.powi(2) + 0.0165051f64.powi(2) + 0.503764f64.powi(2) + 0.142941f64.powi(2);
    let r00 = 1.0 - 2.0 * (0.503764f64.powi(2) + 0.142941f64.powi(2)) / n;
    assert!((first.pose.rotation.matrix()[(0, 0)] - r00).abs() < 1e-12);
    let points = parse_points(POINTS).unwrap();
    assert_eq!((points[&58396].color, &points[&58396].track[..]), ([115, 121, 122], &[(1, 0)][..]));
}

#[test]
fn an_image_without_second_line_and_final_newline() {
    let text = IMAGES.trim_end();
    assert_eq!(parse_images(text).unwrap().len(), 2);
}

#[test]
fn invalid_lines_are_reported_with_their_number() {
    for (text, line) in
        [("1 1 0 0 0 0 0 0 1 a.jpg\n1 2\n", 2), ("# c\n1 0 0 0 0 0 0 0 1 a.jpg\n", 2), ("1 1 0 0 0 0 0 0 1\n", 1)]
    {
        assert!(matches!(parse_images(text), Err(FormatError::Line { line: l, .. }) if l == line), "{text}");
    }
    assert!(parse_points("1 0 0 0 1 1 256 0\n").is_err());
    assert!(parse_points("1 0 0 0 1 1 1 0 5\n").is_err());
    assert!(parse_cameras("1 PINHOLE 3 4 1 1 1\n").is_err());
    assert!(parse_cameras("1 PINHOLE 3 4 1 1 1 1\n1 PINHOLE 3 4 1 1 1 1\n").is_err());
}
