//! Descriptors in bytes.

use cv_core::{Keypoint, Silent};
use cv_features::{
    ByteDescriptors, DescriptorKind, Descriptors, MatchError, MatchOptions, RatioTest, largest_keypoints,
    match_byte_descriptors,
};

#[test]
fn the_quantization_error_is_at_most_half_a_step() {
    let sift_value = |k: usize| ((k * 7919 % 101) as f32 / 101.0) * 0.25;
    let patch_value = |k: usize| ((k * 7919 % 101) as f32 / 101.0) * 7.0 - 3.5;
    for (kind, data, step) in [
        (DescriptorKind::ROOT_SIFT, (0..128 * 9).map(sift_value).collect::<Vec<f32>>(), 1.0 / 512.0),
        (DescriptorKind::MOPS, (0..64 * 9).map(patch_value).collect(), 8.0 / 255.0),
    ] {
        let exact = Descriptors::from_vec(kind, data).unwrap();
        let bytes = ByteDescriptors::new(&exact).unwrap();
        assert_eq!((bytes.len(), bytes.kind(), bytes.is_empty()), (9, kind, false));
        for (a, b) in exact.as_slice().iter().zip(bytes.to_descriptors().as_slice()) {
            // Half a quantization step, and f32 rounding.
            assert!((a - b).abs() < 0.5 * step + 1e-6, "{a} {b}");
        }
        let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
        let found = match_byte_descriptors(&bytes, &bytes, &all, &Silent).unwrap();
        assert!(found.iter().all(|m| m.distance == 0.0) && found.len() == 9);
    }
    let foreign = Descriptors::new(DescriptorKind::foreign(3));
    assert_eq!(ByteDescriptors::from_bytes(DescriptorKind::SIFT, vec![0; 127]), None);
    assert_eq!(ByteDescriptors::from_bytes(DescriptorKind::foreign(3), vec![0; 3]), None);
    assert_eq!(ByteDescriptors::new(&foreign), None);
    let (a, b) = ([DescriptorKind::SIFT, DescriptorKind::PATCH])
        .map(|kind| ByteDescriptors::new(&Descriptors::from_vec(kind, vec![0.1; 128]).unwrap()).unwrap())
        .into();
    assert!(matches!(
        match_byte_descriptors(&a, &b, &MatchOptions::default(), &Silent),
        Err(MatchError::KindsDiffer { .. })
    ));
}

#[test]
fn the_largest_keypoints_are_selected_with_ties_by_index() {
    let keypoints: Vec<Keypoint> =
        [5.0, 1.0, 4.0, 4.0].map(|scale| Keypoint { scale, ..Keypoint::new(0.0, 0.0, 1.0) }).into();
    assert_eq!(largest_keypoints(&keypoints, 2), [0, 2]);
    assert_eq!(largest_keypoints(&keypoints, 9), [0, 1, 2, 3]);
    let data: Vec<f32> = (0..4).flat_map(|k| vec![0.1 * k as f32; DescriptorKind::SIFT.dimension]).collect();
    let bytes = ByteDescriptors::new(&Descriptors::from_vec(DescriptorKind::SIFT, data).unwrap()).unwrap();
    let some = bytes.select(&[0, 2]);
    let row = |set: &ByteDescriptors, i: usize| set.as_slice()[i * 128..(i + 1) * 128].to_vec();
    assert_eq!((some.len(), row(&some, 1)), (2, row(&bytes, 2)));
}
