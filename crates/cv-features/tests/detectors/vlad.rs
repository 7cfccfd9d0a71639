//! Similarity of images by their descriptors.

use cv_core::Silent;
use cv_features::{ByteDescriptors, DescriptorKind, Descriptors, Vocabulary, most_similar};

/// Pseudo-random numbers from 0 to 1.
fn random(seed: u64) -> impl Iterator<Item = f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    std::iter::repeat_with(move || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1 << 24) as f32
    })
    .skip(8)
}

/// The noisy descriptors of an image with these landmarks, each with a distinct descriptor.
fn image_descriptors(landmarks: &[usize], noise: u64) -> ByteDescriptors {
    let mut data = Vec::new();
    for &landmark in landmarks {
        let values = random(landmark as u64 + 1).take(128).map(|v| if v > 0.7 { 0.16 } else { 0.0 });
        data.extend(values.zip(random(noise << 32 | landmark as u64)).map(|(value, noise)| value + 0.01 * noise));
    }
    ByteDescriptors::new(&Descriptors::from_vec(DescriptorKind::ROOT_SIFT, data).unwrap()).unwrap()
}

#[test]
fn images_of_the_same_place_are_most_similar() {
    // Two images of each of twelve places; each has 40 of the 50 landmarks of its place.
    let landmarks = |place: usize, from: usize| (from..from + 40).map(|s| place * 50 + s).collect::<Vec<_>>();
    let images: Vec<ByteDescriptors> =
        (0..24).map(|i| image_descriptors(&landmarks(i / 2, 10 * (i % 2)), i as u64 + 1)).collect();
    let all: Vec<usize> = (0..12).flat_map(|place| landmarks(place, 5)).collect();
    let words = Vocabulary::learn(&image_descriptors(&all, 99), 16, &Silent).unwrap().unwrap();
    let described: Vec<Vec<f32>> = images.iter().map(|p| words.describe(p, &Silent).unwrap().unwrap()).collect();
    let similar = most_similar(&described, 1, |_, _| true, &Silent).unwrap();
    for (i, found) in similar.iter().enumerate() {
        assert_eq!(found, &[i ^ 1], "photograph {i}");
    }
    let others = most_similar(&described, 30, |a, b| a.abs_diff(b) > 1, &Silent).unwrap();
    assert!(others.iter().enumerate().all(|(i, o)| o.len() == 24 - if i == 0 || i == 23 { 2 } else { 3 }));
}

#[test]
fn empty_sets_and_other_kinds() {
    let none = ByteDescriptors::new(&Descriptors::new(DescriptorKind::ROOT_SIFT)).unwrap();
    assert_eq!(Vocabulary::learn(&none, 16, &Silent), Ok(None));
    let words = Vocabulary::learn(&image_descriptors(&[1, 2, 3], 1), 16, &Silent).unwrap().unwrap();
    let described = words.describe(&none, &Silent).unwrap().unwrap();
    assert!(described.len() == 3 * 128 && described.iter().all(|v| *v == 0.0));
    let other = ByteDescriptors::new(&Descriptors::new(DescriptorKind::SIFT)).unwrap();
    assert_eq!(words.describe(&other, &Silent), Ok(None));
}
