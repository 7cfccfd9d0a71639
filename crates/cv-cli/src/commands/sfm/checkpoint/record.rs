//! Format of a checkpoint file: the magic `CVSFM` with a version, a key, the length of the payload, the payload (little-endian numbers), and a checksum of all.

use cv_core::{DMatch, Keypoint, Matrix3, Point2, Pose, Rotation3, Vector3};
use cv_io::ExifGps;
use cv_pipeline::SfmPhoto;
use cv_pipeline::features::{ByteDescriptors, DescriptorKind};
use cv_pipeline::many_views::{PairMatches, ViewPairModel};
use std::hash::{DefaultHasher, Hasher};

/// The features and metadata extracted from a photograph.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Extracted {
    /// Focal length by EXIF, in pixels.
    pub(crate) focal: Option<f64>,
    pub(crate) gps: Option<ExifGps>,
    /// Its features; name and camera index are those of the run that stored them.
    pub(crate) photo: SfmPhoto,
}

/// The verified pairs of photographs, and their geometry.
pub(crate) type Pairs = (Vec<PairMatches>, Vec<ViewPairModel>);

const MAGIC: [u8; 8] = *b"CVSFM\0\0\x01";
/// Bytes of the header: magic, key, length of the payload.
const HEADER_BYTES: usize = 24;
/// Bytes of the checksum at the end.
const CHECKSUM_BYTES: usize = 8;

/// The payload of a checkpoint file, and the read position.
pub(super) struct Record {
    bytes: Vec<u8>,
    /// Read position in bytes.
    at: usize,
}

fn checksum(bytes: &[u8]) -> [u8; CHECKSUM_BYTES] {
    let mut hasher = DefaultHasher::new();
    hasher.write(bytes);
    hasher.finish().to_le_bytes()
}

impl Record {
    fn new() -> Self {
        Self { bytes: Vec::new(), at: 0 }
    }

    /// Serializes the record with header and checksum.
    pub(super) fn seal(&self, key: u64) -> Vec<u8> {
        let mut file = Vec::with_capacity(HEADER_BYTES + self.bytes.len() + CHECKSUM_BYTES);
        file.extend(MAGIC);
        file.extend(key.to_le_bytes());
        file.extend((self.bytes.len() as u64).to_le_bytes());
        file.extend(&self.bytes);
        let sum = checksum(&file);
        file.extend(sum);
        file
    }

    /// Opens a complete file with that key; `None` for any other.
    pub(super) fn open(mut file: Vec<u8>, key: u64) -> Option<Self> {
        let end = file.len().checked_sub(CHECKSUM_BYTES).filter(|end| *end >= HEADER_BYTES)?;
        let length = ((end - HEADER_BYTES) as u64).to_le_bytes();
        let header = [MAGIC, key.to_le_bytes(), length].concat();
        if file[..HEADER_BYTES] != header[..] || file[end..] != checksum(&file[..end]) {
            return None;
        }
        file.truncate(end);
        Some(Self { bytes: file, at: HEADER_BYTES })
    }

    /// Whether all bytes have been read.
    pub(super) fn is_at_end(&self) -> bool {
        self.at == self.bytes.len()
    }

    fn take<const N: usize>(&mut self) -> Option<[u8; N]> {
        let taken = self.bytes.get(self.at..)?.first_chunk::<N>().copied()?;
        self.at += N;
        Some(taken)
    }

    fn slice(&mut self, length: usize) -> Option<&[u8]> {
        let end = self.at.checked_add(length)?;
        let taken = self.bytes.get(self.at..end)?;
        self.at = end;
        Some(taken)
    }

    fn put_count(&mut self, value: usize) {
        self.bytes.extend((value as u64).to_le_bytes());
    }

    /// Reads a number of elements of at least `size` bytes each; `None` if they exceed the remaining bytes, so that a corrupt count allocates no memory.
    fn count(&mut self, size: usize) -> Option<usize> {
        let count = usize::try_from(u64::from_le_bytes(self.take()?)).ok()?;
        (count.checked_mul(size)? <= self.bytes.len() - self.at).then_some(count)
    }

    fn number(&mut self) -> Option<f64> {
        self.take().map(f64::from_le_bytes)
    }

    fn single(&mut self) -> Option<f32> {
        self.take().map(f32::from_le_bytes)
    }

    fn put_maybe(&mut self, value: Option<f64>) {
        self.bytes.push(u8::from(value.is_some()));
        self.bytes.extend(value.unwrap_or(0.0).to_le_bytes());
    }

    fn maybe(&mut self) -> Option<Option<f64>> {
        let [there] = self.take()?;
        let value = self.number()?;
        Some((there == 1).then_some(value))
    }

    pub(super) fn of_extracted(extracted: &Extracted) -> Self {
        let mut record = Self::new();
        let Extracted { focal, gps, photo } = extracted;
        record.put_count(photo.size.0);
        record.put_count(photo.size.1);
        record.put_maybe(*focal);
        let gps_numbers = gps.map(|gps| (gps.latitude, gps.longitude, gps.altitude, gps.dilution));
        record.put_maybe(gps_numbers.map(|g| g.0));
        record.put_maybe(gps_numbers.map(|g| g.1));
        record.put_maybe(gps_numbers.and_then(|g| g.2));
        record.put_maybe(gps_numbers.and_then(|g| g.3));
        record.put_count(photo.keypoints.len());
        for k in &photo.keypoints {
            for v in [k.position.x, k.position.y, k.response, k.scale, k.angle] {
                record.bytes.extend(v.to_le_bytes());
            }
        }
        record.bytes.extend(photo.descriptors.as_slice());
        record.bytes.extend(photo.colors.as_flattened());
        record
    }

    pub(super) fn extracted(&mut self, kind: DescriptorKind) -> Option<Extracted> {
        // Nothing is allocated by the image size.
        let size = (self.count(0)?, self.count(0)?);
        let focal = self.maybe()?;
        let [latitude, longitude, altitude, dilution] = [self.maybe()?, self.maybe()?, self.maybe()?, self.maybe()?];
        let gps =
            latitude.zip(longitude).map(|(latitude, longitude)| ExifGps { latitude, longitude, altitude, dilution });
        let count = self.count(20 + kind.dimension + 3)?;
        let mut keypoints = Vec::with_capacity(count);
        for _ in 0..count {
            let position = Point2::new(self.single()?, self.single()?);
            let (response, scale, angle) = (self.single()?, self.single()?, self.single()?);
            keypoints.push(Keypoint { position, response, scale, angle });
        }
        let descriptors = ByteDescriptors::from_bytes(kind, self.slice(count * kind.dimension)?.to_vec())?;
        let colors = self.slice(3 * count)?.as_chunks().0.to_vec();
        Some(Extracted {
            focal,
            gps,
            photo: SfmPhoto { name: String::new(), size, camera: 0, keypoints, descriptors, colors },
        })
    }

    pub(super) fn of_pairs((pairs, geometry): &Pairs) -> Self {
        let mut record = Self::new();
        record.put_count(pairs.len());
        for (pair, model) in pairs.iter().zip(geometry) {
            record.put_count(pair.a);
            record.put_count(pair.b);
            let (kind, matrix, shift) = match model {
                ViewPairModel::Pose(pose) => (0u8, *pose.rotation.matrix(), pose.translation),
                ViewPairModel::Fundamental(f) => (1, *f, Vector3::zeros()),
                ViewPairModel::Homography(h) => (2, *h, Vector3::zeros()),
            };
            record.bytes.push(kind);
            matrix.iter().chain(&shift).for_each(|v| record.bytes.extend(v.to_le_bytes()));
            record.put_matches(&pair.matches);
            record.bytes.push(pair.sample.is_some().into());
            pair.sample.iter().for_each(|sample| record.put_matches(sample));
        }
        record
    }

    /// Reads the pairs of photographs; `sizes` are their numbers of keypoints, which bound the indices.
    pub(super) fn pairs(&mut self, sizes: &[usize]) -> Option<Pairs> {
        let count = self.count(8 + 8 + 1 + 12 * 8 + 8)?;
        let (mut pairs, mut geometry) = (Vec::with_capacity(count), Vec::with_capacity(count));
        for _ in 0..count {
            let (a, b) = (self.count(0)?, self.count(0)?);
            let (of_a, of_b) = (*sizes.get(a)?, *sizes.get(b)?);
            let [kind] = self.take()?;
            let mut numbers = [0.0; 12];
            for v in &mut numbers {
                *v = self.number()?;
            }
            let matrix = Matrix3::from_column_slice(&numbers[..9]);
            geometry.push(match kind {
                0 => ViewPairModel::Pose(Pose::new(
                    Rotation3::from_matrix_unchecked(matrix),
                    Vector3::from_column_slice(&numbers[9..]),
                )),
                1 => ViewPairModel::Fundamental(matrix),
                2 => ViewPairModel::Homography(matrix),
                _ => return None,
            });
            let matches = self.matches(of_a, of_b)?;
            let sample = match self.take()? {
                [0] => None,
                _ => Some(self.matches(of_a, of_b)?),
            };
            pairs.push(PairMatches { a, b, matches, sample });
        }
        Some((pairs, geometry))
    }

    fn put_matches(&mut self, matches: &[DMatch]) {
        self.put_count(matches.len());
        for m in matches {
            self.bytes.extend(m.query.to_le_bytes());
            self.bytes.extend(m.train.to_le_bytes());
            self.bytes.extend(m.distance.to_le_bytes());
            self.bytes.extend(m.ratio.to_le_bytes());
        }
    }

    /// Reads matches between photographs with `of_a` and `of_b` keypoints.
    fn matches(&mut self, of_a: usize, of_b: usize) -> Option<Vec<DMatch>> {
        let count = self.count(16)?;
        let mut matches = Vec::with_capacity(count);
        for _ in 0..count {
            let (query, train) = (u32::from_le_bytes(self.take()?), u32::from_le_bytes(self.take()?));
            let (distance, ratio) = (self.single()?, self.single()?);
            if query as usize >= of_a || train as usize >= of_b {
                return None;
            }
            matches.push(DMatch { query, train, distance, ratio });
        }
        Some(matches)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn extracted() -> Extracted {
        let kind = DescriptorKind::ROOT_SIFT;
        let keypoint = |i: u32| Keypoint {
            response: 0.1 * i as f32,
            scale: 1.5,
            angle: -0.0,
            ..Keypoint::new(i as f32, 7.25, 0.0)
        };
        let bytes: Vec<u8> = (0..5 * kind.dimension).map(|i| i as u8).collect();
        let photo = SfmPhoto {
            name: String::new(),
            size: (640, 480),
            camera: 0,
            keypoints: (0..5).map(keypoint).collect(),
            descriptors: ByteDescriptors::from_bytes(kind, bytes).unwrap(),
            colors: (0..5).map(|i| [i, 2 * i, 255]).collect(),
        };
        let gps = ExifGps { latitude: 0.8, longitude: -0.1, altitude: None, dilution: Some(2.1) };
        Extracted { focal: Some(512.3), gps: Some(gps), photo }
    }

    fn pairs() -> Pairs {
        let matches = vec![DMatch { query: 3, train: 1, distance: 0.25, ratio: 0.5 }; 3];
        let pose = Pose::new(Rotation3::from_euler_angles(0.1, 0.2, 0.3), Vector3::new(1.0, 2.0, 3.0));
        let models = [
            ViewPairModel::Pose(pose),
            ViewPairModel::Fundamental(Matrix3::new(1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0)),
            ViewPairModel::Homography(Matrix3::identity()),
        ];
        let pair = |(a, b)| PairMatches {
            sample: (a == 0).then(|| matches.clone()),
            ..PairMatches::new(a, b, matches.clone())
        };
        ([(0, 1), (0, 2), (1, 2)].map(pair).to_vec(), models.to_vec())
    }

    #[test]
    fn records_round_trip() {
        let mut record = Record::open(Record::of_extracted(&extracted()).seal(7), 7).unwrap();
        assert_eq!(record.extracted(DescriptorKind::ROOT_SIFT), Some(extracted()));
        assert!(record.is_at_end());
        let bare = Extracted { focal: None, gps: None, ..extracted() };
        assert_eq!(
            Record::open(Record::of_extracted(&bare).seal(7), 7).unwrap().extracted(DescriptorKind::ROOT_SIFT),
            Some(bare)
        );
        let mut record = Record::open(Record::of_pairs(&pairs()).seal(8), 8).unwrap();
        assert_eq!(record.pairs(&[5, 5, 5]), Some(pairs()));
        assert!(record.is_at_end());
        // Indices out of range: fewer keypoints, or fewer photographs.
        for sizes in [&[5, 1, 5][..], &[5, 5]] {
            assert_eq!(Record::open(Record::of_pairs(&pairs()).seal(8), 8).unwrap().pairs(sizes), None);
        }
    }

    #[test]
    fn corruption_is_detected_and_corrupt_counts_allocate_no_memory() {
        let file = Record::of_pairs(&pairs()).seal(8);
        assert!(Record::open(file.clone(), 9).is_none(), "another key");
        for i in (0..file.len()).step_by(7) {
            assert!(Record::open(file[..i].to_vec(), 8).is_none(), "cut to {i}");
            let mut other = file.clone();
            other[i] ^= 0x10;
            assert!(Record::open(other, 8).is_none(), "byte {i}");
        }
        // A valid checksum over corrupt numbers.
        for at in (HEADER_BYTES..file.len() - CHECKSUM_BYTES).step_by(5) {
            let mut corrupt = Record { bytes: file[HEADER_BYTES..file.len() - CHECKSUM_BYTES].to_vec(), at: 0 };
            corrupt.bytes[at - HEADER_BYTES] = 0xFF;
            let _ = Record::open(corrupt.seal(8), 8).unwrap().pairs(&[5, 5, 5]);
            let _ = Record::open(corrupt.seal(8), 8).unwrap().extracted(DescriptorKind::ROOT_SIFT);
        }
    }
}
