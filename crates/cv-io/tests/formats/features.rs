//! Files of keypoints and descriptors.

use cv_core::{Keypoint, Point2};
use cv_io::npy::{NpyArray, NpyData};
use cv_io::{
    FeatureRows, descriptors_from_npy, descriptors_to_npy, keypoints_from_npy, keypoints_to_npy, parse_colmap_features,
    read_colmap_features, write_colmap_features,
};

#[test]
fn colmap_text_round_trips_and_invalid_text_is_refused() {
    let ones = " 128".repeat(127);
    let text = format!("# made by hand\n1 128\n10.5 20.75 2.5 -1.25 255{ones}\n");
    let rows = parse_colmap_features(&text).unwrap();
    let k = rows.keypoints[0];
    assert_eq!((k.position, k.scale, k.angle), (Point2::new(10.0, 20.25), 2.5, -1.25));
    assert_eq!((rows.dimension, rows.descriptors[0], rows.descriptors[127]), (128, 255.0 / 512.0, 0.25));
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("a.txt");
    write_colmap_features(&path, &rows).unwrap();
    assert_eq!(read_colmap_features(&path).unwrap(), rows);
    for bad in ["", "2 128\n", "x 128\n", "1 64\n", "1 128\n1 2 3\n", "1 128\n1 2 3 4 5 6\n"] {
        assert!(parse_colmap_features(bad).is_err(), "{bad}");
    }
    let negative = FeatureRows { descriptors: vec![-0.1; 128], ..rows.clone() };
    assert!(write_colmap_features(&path, &negative).is_err());
    assert!(write_colmap_features(&path, &FeatureRows { dimension: 64, ..rows }).is_err());
}

#[test]
fn arrays_round_trip() {
    let k = Keypoint { position: Point2::new(1.5, 2.5), response: 9.0, scale: 3.0, angle: 0.5 };
    assert_eq!(keypoints_from_npy(&keypoints_to_npy(&[k, k])).unwrap(), [k, k]);
    let two = NpyArray { shape: vec![1, 2], data: NpyData::F64(vec![4.0, 5.0]) };
    assert_eq!(keypoints_from_npy(&two).unwrap(), [Keypoint::new(4.0, 5.0, 0.0)]);
    assert!(keypoints_from_npy(&NpyArray { shape: vec![2], data: NpyData::F64(vec![4.0, 5.0]) }).is_err());
    let array = descriptors_to_npy(3, &[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]);
    assert_eq!(descriptors_from_npy(&array).unwrap(), (3, vec![1.0, 2.0, 3.0, 4.0, 5.0, 6.0]));
}
