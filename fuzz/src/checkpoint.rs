//! What `cv sfm --resume` finds in its folder.

use cv_pipeline::features::DescriptorKind;
use libfuzzer_sys::Corpus;
use record::Record;
use std::hash::{DefaultHasher, Hasher};

/// That of the program, which is no library.
#[path = "../../crates/cv-cli/src/commands/sfm/checkpoint/record.rs"]
mod record;

/// What the records below are made of.
const KEY: u64 = 7;

/// A file with that content, whose length and checksum are right: few inputs would pass those by chance.
fn sealed(content: &[u8]) -> Vec<u8> {
    let mut file = b"CVSFM\0\0\x01".to_vec();
    file.extend(KEY.to_le_bytes());
    file.extend((content.len() as u64).to_le_bytes());
    file.extend(content);
    let mut hasher = DefaultHasher::new();
    hasher.write(&file);
    file.extend(hasher.finish().to_le_bytes());
    file
}

/// The features of a photograph, and pairs of photographs.
pub fn checkpoint(bytes: &[u8]) -> Corpus {
    assert!(Record::open(bytes.to_vec(), KEY).is_none_or(|record| bytes.len() >= 32 || record.is_at_end()));
    let open = |file: &[u8]| Record::open(file.to_vec(), KEY).expect("it was sealed");
    let file = sealed(bytes);
    let kind = DescriptorKind::ROOT_SIFT;
    if let Some(seen) = open(&file).seen(kind) {
        let count = seen.photo.keypoints.len();
        assert!(seen.photo.descriptors.len() == count && seen.photo.colors.len() == count);
        // What was read is written and read as the same; by bytes, since NaN is not equal to itself.
        let again = Record::of_seen(&seen).seal(KEY);
        let read = open(&again).seen(kind).expect("it was written");
        assert_eq!(Record::of_seen(&read).seal(KEY), again);
    }
    let sizes = [200, 0, 3];
    if let Some(pairs) = open(&file).pairs(&sizes) {
        assert_eq!(pairs.0.len(), pairs.1.len());
        for pair in &pairs.0 {
            let inside = |m: &cv_core::DMatch| (m.query as usize) < sizes[pair.a] && (m.train as usize) < sizes[pair.b];
            assert!(pair.matches.iter().chain(pair.sample.iter().flatten()).all(inside));
        }
        let again = Record::of_pairs(&pairs).seal(KEY);
        let read = open(&again).pairs(&sizes).expect("it was written");
        assert_eq!(Record::of_pairs(&read).seal(KEY), again);
    }
    Corpus::Keep
}
