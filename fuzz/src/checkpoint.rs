//! Checkpoint files of `cv sfm --resume`.

use cv_pipeline::features::DescriptorKind;
use libfuzzer_sys::Corpus;
use record::Record;
use std::hash::{DefaultHasher, Hasher};

/// The module of the program, which has no library.
#[path = "../../crates/cv-cli/src/commands/sfm/checkpoint/record.rs"]
mod record;

/// Key of the records.
const KEY: u64 = 7;

/// Returns a file with that content and a valid length and checksum, which random inputs rarely have.
fn seal_content(content: &[u8]) -> Vec<u8> {
    let mut file = b"CVSFM\0\0\x01".to_vec();
    file.extend(KEY.to_le_bytes());
    file.extend((content.len() as u64).to_le_bytes());
    file.extend(content);
    let mut hasher = DefaultHasher::new();
    hasher.write(&file);
    file.extend(hasher.finish().to_le_bytes());
    file
}

/// Fuzzes the records of a photograph's features and of image pairs.
pub fn checkpoint(bytes: &[u8]) -> Corpus {
    assert!(Record::open(bytes.to_vec(), KEY).is_none_or(|record| bytes.len() >= 32 || record.is_at_end()));
    let open = |file: &[u8]| Record::open(file.to_vec(), KEY).expect("a sealed file");
    let file = seal_content(bytes);
    let kind = DescriptorKind::ROOT_SIFT;
    if let Some(extracted) = open(&file).extracted(kind) {
        let count = extracted.photo.keypoints.len();
        assert!(extracted.photo.descriptors.len() == count && extracted.photo.colors.len() == count);
        // Round trip, compared by bytes, since NaN is not equal to itself.
        let again = Record::of_extracted(&extracted).seal(KEY);
        let read = open(&again).extracted(kind).expect("a written record");
        assert_eq!(Record::of_extracted(&read).seal(KEY), again);
    }
    let sizes = [200, 0, 3];
    if let Some(pairs) = open(&file).pairs(&sizes) {
        assert_eq!(pairs.0.len(), pairs.1.len());
        for pair in &pairs.0 {
            let inside = |m: &cv_core::DMatch| (m.query as usize) < sizes[pair.a] && (m.train as usize) < sizes[pair.b];
            assert!(pair.matches.iter().chain(pair.sample.iter().flatten()).all(inside));
        }
        let again = Record::of_pairs(&pairs).seal(KEY);
        let read = open(&again).pairs(&sizes).expect("a written record");
        assert_eq!(Record::of_pairs(&read).seal(KEY), again);
    }
    Corpus::Keep
}
