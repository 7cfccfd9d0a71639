//! Models of COLMAP in binary.

use cv_core::{Point2, Point3, SparseModel};
use cv_io::FormatError;
use cv_io::colmap::{parse_cameras_binary, parse_images_binary, parse_points_binary, write_binary};

/// A file by the format's definition (COLMAP's manual, “Output format”), field by field.
macro_rules! file {
    ($($value:expr),* $(,)?) => {{
        let mut bytes = Vec::<u8>::new();
        $(bytes.extend($value.to_le_bytes());)*
        bytes
    }};
}

fn cameras() -> Vec<u8> {
    // SIMPLE_RADIAL is number 2: f, cx, cy, k.
    file![1u64, 7u32, 2i32, 3072u64, 2304u64, 2559.81f64, 1536.0f64, 1152.0f64, -0.0218531f64]
}

fn images() -> Vec<u8> {
    let mut bytes = file![2u64, 3u32, 0.6f64, 0.8f64, 0.0f64, 0.0f64, 1.0f64, -2.0f64, 3.5f64, 7u32];
    bytes.extend(b"a b.jpg\0");
    bytes.extend(file![2u64, 2362.5f64, 248.25f64, 9u64, 1.5f64, 2.5f64, u64::MAX]);
    bytes.extend(file![4u32, 1.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64, 0.0f64, 7u32]);
    bytes.extend(b"c\0");
    bytes.extend(file![0u64]);
    bytes
}

fn points() -> Vec<u8> {
    file![1u64, 9u64, 1.5f64, -0.25f64, 4.0f64, 115u8, 121u8, 122u8, 1.25f64, 2u64, 3u32, 0u32, 4u32, 5u32]
}

#[test]
fn fields_are_parsed_by_the_definition() {
    let camera = &parse_cameras_binary(&cameras()).unwrap()[&7];
    assert_eq!((camera.width, camera.height, camera.fx, camera.fy), (3072, 2304, 2559.81, 2559.81));
    assert_eq!((camera.cx, camera.cy, camera.distortion.parameters()), (1535.5, 1151.5, &[-0.0218531][..]));
    let all = parse_images_binary(&images()).unwrap();
    let first = &all[&3];
    assert_eq!((all.len(), &first.name[..], first.camera, &all[&4].name[..]), (2, "a b.jpg", 7, "c"));
    assert_eq!(first.points, [(Point2::new(2362.0, 247.75), Some(9)), (Point2::new(1.0, 2.0), None)]);
    assert_eq!(first.pose.translation.as_slice(), [1.0, -2.0, 3.5]);
    // A rotation about x by twice the angle whose cosine is 0.6: its sine is 0.96 and its cosine -0.28.
    let r = first.pose.rotation.matrix();
    assert!((r[(2, 1)] - 0.96).abs() < 1e-15 && (r[(1, 1)] + 0.28).abs() < 1e-15 && r[(0, 0)] == 1.0, "{r}");
    let point = &parse_points_binary(&points()).unwrap()[&9];
    assert_eq!((point.position, point.color, point.error), (Point3::new(1.5, -0.25, 4.0), [115, 121, 122], 1.25));
    assert_eq!(point.track, [(3, 0), (4, 5)]);
}

#[test]
fn files_round_trip_to_the_same_bytes() {
    let written = |model: &SparseModel, name: &str| {
        let folder = tempfile::tempdir().unwrap();
        write_binary(folder.path(), model).unwrap();
        std::fs::read(folder.path().join(name)).unwrap()
    };
    let mut model = SparseModel {
        cameras: parse_cameras_binary(&cameras()).unwrap(),
        images: parse_images_binary(&images()).unwrap(),
        ..SparseModel::default()
    };
    assert_eq!(written(&model, "cameras.bin"), cameras());
    // All but the first quaternion, which a rotation matrix rounds.
    let images_bin = written(&model, "images.bin");
    assert_eq!((&images_bin[..12], &images_bin[44..]), (&images()[..12], &images()[44..]));
    // The track's second image needs the six points that `images` leaves out.
    model.points = parse_points_binary(&points()).unwrap();
    model.images.get_mut(&4).unwrap().points = vec![(Point2::origin(), None); 6];
    assert_eq!(written(&model, "points3D.bin"), points());
}

#[test]
fn truncated_files_and_trailing_bytes_are_refused() {
    fn held<T: std::fmt::Debug>(whole: &[u8], parse: impl Fn(&[u8]) -> Result<T, FormatError>) {
        for end in 0..whole.len() {
            let error = parse(&whole[..end]).unwrap_err();
            assert!(matches!(error, FormatError::Truncated { .. } | FormatError::Corrupt { .. }), "{end}: {error}");
        }
        let mut longer = whole.to_vec();
        longer.push(0);
        let error = parse(&longer).unwrap_err();
        assert!(error.to_string().contains("1 bytes follow"), "{error}");
    }
    held(&cameras(), parse_cameras_binary);
    held(&images(), parse_images_binary);
    held(&points(), parse_points_binary);
}

#[test]
fn impossible_counts_are_refused_before_allocation() {
    fn refused<T: std::fmt::Debug>(mut bytes: Vec<u8>, at: usize, parse: impl Fn(&[u8]) -> Result<T, FormatError>) {
        // The last would need more than 2^63 bytes.
        for count in [1u64 << 20, 1 << 60, u64::MAX] {
            bytes[at..at + 8].copy_from_slice(&count.to_le_bytes());
            let error = parse(&bytes).unwrap_err();
            assert!(error.to_string().contains(&format!("{count} ")), "{error}");
        }
    }
    refused(cameras(), 0, parse_cameras_binary);
    refused(images(), 0, parse_images_binary);
    // After id, pose, camera and the name of eight bytes.
    refused(images(), 8 + 4 + 56 + 4 + 8, parse_images_binary);
    refused(points(), 0, parse_points_binary);
    refused(points(), 8 + 8 + 24 + 3 + 8, parse_points_binary);
}

#[test]
fn invalid_cameras_and_poses_are_refused() {
    let reason = |bytes: Vec<u8>| parse_cameras_binary(&bytes).unwrap_err().to_string();
    // FOV, which is not supported.
    assert!(reason(file![1u64, 7u32, 7i32, 4u64, 4u64, 1.0f64, 2.0f64, 2.0f64]).contains("number 7"));
    let twice =
        file![2u64, 7u32, 0i32, 4u64, 4u64, 1.0f64, 2.0f64, 2.0f64, 7u32, 0i32, 4u64, 4u64, 1.0f64, 2.0f64, 2.0f64];
    assert!(reason(twice).contains("twice"));
    assert!(reason(file![1u64, 7u32, 0i32, u64::MAX, 4u64, 1.0f64, 2.0f64, 2.0f64]).contains("camera 7"));
    assert!(reason(file![1u64, 7u32, 0i32, 4u64, 4u64, f64::NAN, 2.0f64, 2.0f64]).contains("camera 7"));
    let mut zero = images();
    zero[12..44].fill(0);
    assert!(parse_images_binary(&zero).unwrap_err().to_string().contains("quaternion"));
}
