//! Dictionaries of square fiducial markers, and decoding with error correction.
//!
//! Sources: S. Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under
//! occlusion", Pattern Recognition 47, 2014 (ArUco); E. Olson, "AprilTag: a robust and flexible visual fiducial
//! system", ICRA 2011.

use super::dictionary_bits::{APRILTAG_36H11, ARUCO_4X4, ARUCO_5X5, ARUCO_6X6};

/// A dictionary of square fiducial markers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Dictionary {
    /// ArUco, 4×4 bits, 50 markers.
    Aruco4x4x50,
    /// 4×4, 100 markers.
    Aruco4x4x100,
    /// 4×4, 250 markers.
    Aruco4x4x250,
    /// 5×5, 50 markers.
    Aruco5x5x50,
    /// 5×5, 100 markers.
    Aruco5x5x100,
    /// 5×5, 250 markers.
    Aruco5x5x250,
    /// 6×6, 50 markers.
    Aruco6x6x50,
    /// 6×6, 100 markers.
    Aruco6x6x100,
    /// 6×6, 250 markers.
    Aruco6x6x250,
    /// The original ArUco dictionary: 5×5, 1024 markers, each row one of four words.
    ArucoOriginal,
    /// AprilTag 36h11: 6×6, 587 markers.
    AprilTag36h11,
}

cv_core::named!(Dictionary {
    Aruco4x4x50 = "4x4_50",
    Aruco4x4x100 = "4x4_100",
    Aruco4x4x250 = "4x4_250",
    Aruco5x5x50 = "5x5_50",
    Aruco5x5x100 = "5x5_100",
    Aruco5x5x250 = "5x5_250",
    Aruco6x6x50 = "6x6_50",
    Aruco6x6x100 = "6x6_100",
    Aruco6x6x250 = "6x6_250",
    ArucoOriginal = "aruco-original",
    AprilTag36h11 = "36h11",
});

impl Dictionary {
    /// Returns the number of bits along a side of a marker, without the black border.
    pub fn side(self) -> usize {
        match self {
            Self::Aruco4x4x50 | Self::Aruco4x4x100 | Self::Aruco4x4x250 => 4,
            Self::Aruco5x5x50 | Self::Aruco5x5x100 | Self::Aruco5x5x250 | Self::ArucoOriginal => 5,
            Self::Aruco6x6x50 | Self::Aruco6x6x100 | Self::Aruco6x6x250 | Self::AprilTag36h11 => 6,
        }
    }

    /// Returns the number of markers.
    pub fn markers(self) -> usize {
        match self {
            Self::Aruco4x4x50 | Self::Aruco5x5x50 | Self::Aruco6x6x50 => 50,
            Self::Aruco4x4x100 | Self::Aruco5x5x100 | Self::Aruco6x6x100 => 100,
            Self::Aruco4x4x250 | Self::Aruco5x5x250 | Self::Aruco6x6x250 => 250,
            Self::ArucoOriginal => 1024,
            Self::AprilTag36h11 => 587,
        }
    }

    /// Returns the bits of a marker, row by row from the top left, the first in the highest of `side()²` bits; 1 is
    /// white. `None` for an id out of range.
    pub fn bits(self, id: usize) -> Option<u64> {
        if id >= self.markers() {
            return None;
        }
        match self {
            Self::Aruco4x4x50 | Self::Aruco4x4x100 | Self::Aruco4x4x250 => ARUCO_4X4.get(id).copied(),
            Self::Aruco5x5x50 | Self::Aruco5x5x100 | Self::Aruco5x5x250 => ARUCO_5X5.get(id).copied(),
            Self::Aruco6x6x50 | Self::Aruco6x6x100 | Self::Aruco6x6x250 => combine_halves(&ARUCO_6X6, id),
            Self::AprilTag36h11 => combine_halves(&APRILTAG_36H11, id),
            Self::ArucoOriginal => {
                // Two bits of the id select the word of a row; the highest two that of the first row.
                const WORDS: [u64; 4] = [0b10000, 0b10111, 0b01001, 0b01110];
                Some((0..5).fold(0, |bits, row| (bits << 5) | WORDS[(id >> (2 * (4 - row))) & 3]))
            }
        }
    }

    /// Returns the maximum number of corrected bit errors: less than half of the minimum Hamming distance of the
    /// dictionary (over all rotations), and at most about a tenth of the bits, to limit false positives.
    pub fn max_correction_bits(self) -> u32 {
        match self {
            // Of 16 bits. The minimum Hamming distance of the larger sets is 3.
            Self::Aruco4x4x50 | Self::Aruco4x4x100 | Self::Aruco4x4x250 => 1,
            Self::ArucoOriginal => 0,
            Self::Aruco5x5x50 | Self::Aruco5x5x100 | Self::Aruco5x5x250 => 2,
            Self::Aruco6x6x50 | Self::Aruco6x6x100 | Self::Aruco6x6x250 | Self::AprilTag36h11 => 3,
        }
    }

    /// Decodes bits: returns the id among the first `markers` and the rotation in clockwise quarter turns, with at most
    /// [`Dictionary::max_correction_bits`] bit errors. O(markers).
    pub fn decode(self, bits: u64, markers: usize) -> Option<(usize, usize)> {
        let mut rotated = bits;
        let mut best: Option<(u32, usize, usize)> = None;
        for turns in 0..4 {
            for id in 0..markers.min(self.markers()) {
                let errors = (self.bits(id)? ^ rotated).count_ones();
                if errors <= self.max_correction_bits() && best.is_none_or(|b| errors < b.0) {
                    best = Some((errors, id, turns));
                }
            }
            rotated = rotate_counterclockwise(rotated, self.side());
        }
        best.map(|(_, id, turns)| (id, turns))
    }
}

impl Dictionary {
    /// Returns whether `bits` are exactly those of a marker in any rotation.
    pub(super) fn contains_exactly(self, bits: u64) -> bool {
        let turns = std::iter::successors(Some(bits), |bits| Some(rotate_counterclockwise(*bits, self.side())));
        turns.take(4).any(|bits| (0..self.markers()).any(|id| self.bits(id) == Some(bits)))
    }
}

/// Combines the two 18-bit halves of stored bits.
fn combine_halves(stored: &[u32], id: usize) -> Option<u64> {
    let (high, low) = (stored.get(2 * id)?, stored.get(2 * id + 1)?);
    Some((u64::from(*high) << 18) | u64::from(*low))
}

/// Rotates bits by a quarter turn counterclockwise.
fn rotate_counterclockwise(bits: u64, side: usize) -> u64 {
    let at = |row: usize, column: usize| (bits >> (side * side - 1 - (row * side + column))) & 1;
    (0..side * side).fold(0, |rotated, i| (rotated << 1) | at(i % side, side - 1 - i / side))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Named;

    #[test]
    fn markers_are_decoded_in_every_rotation_with_bit_errors() {
        for (_, dictionary) in Dictionary::NAMES {
            let (n, markers) = (dictionary.side() * dictionary.side(), dictionary.markers());
            assert_eq!(dictionary.bits(markers), None);
            // (The last marker of the original dictionary is symmetric under a rotation by 180°.)
            for id in [0, 7, 31, markers - 2] {
                let mut bits = dictionary.bits(id).unwrap();
                assert!(bits >> n == 0);
                // Three counterclockwise quarter turns are one clockwise.
                for turns in 0..4 {
                    let wrong = (0..dictionary.max_correction_bits()).fold(bits, |b, k| b ^ (1 << (5 * k)));
                    assert_eq!(dictionary.decode(wrong, markers), Some((id, turns)), "{dictionary} {id}");
                    bits = (0..3).fold(bits, |b, _| rotate_counterclockwise(b, dictionary.side()));
                }
            }
        }
    }

    #[test]
    fn the_minimum_hamming_distance_allows_the_correction() {
        for (_, dictionary) in Dictionary::NAMES {
            let markers = dictionary.markers();
            // The original dictionary has only the small Hamming distance of its words.
            if *dictionary == Dictionary::ArucoOriginal {
                continue;
            }
            let rotated: Vec<[u64; 4]> = (0..markers)
                .map(|id| {
                    let mut bits = dictionary.bits(id).unwrap();
                    std::array::from_fn(|_| {
                        let now = bits;
                        bits = rotate_counterclockwise(bits, dictionary.side());
                        now
                    })
                })
                .collect();
            for i in 0..markers {
                for j in 0..=i {
                    for k in usize::from(i == j)..4 {
                        let differ = (rotated[i][0] ^ rotated[j][k]).count_ones();
                        assert!(differ > 2 * dictionary.max_correction_bits(), "{dictionary} {i} {j}: {differ}");
                    }
                }
            }
        }
    }
}
