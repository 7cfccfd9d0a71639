//! Dictionaries of square markers, and reading a marker's number with some of its bits wrong.
//!
//! Sources: S. Garrido-Jurado et al., "Automatic generation and detection of highly reliable fiducial markers under occlusion", Pattern Recognition 47, 2014 (ArUco);
//! E. Olson, "AprilTag: a robust and flexible visual fiducial system", ICRA 2011.

use super::dictionary_bits::{APRILTAG_36H11, ARUCO_4X4, ARUCO_5X5, ARUCO_6X6};

/// A set of square markers that are told apart by their inner squares.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Dictionary {
    /// ArUco, 4×4 inner squares, 50 markers.
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
    /// The first of ArUco: 5×5, 1024 markers, each row one of four words.
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
    /// Inner squares along a side of a marker. Around them lies a black frame one square wide.
    pub fn side(self) -> usize {
        match self {
            Self::Aruco4x4x50 | Self::Aruco4x4x100 | Self::Aruco4x4x250 => 4,
            Self::Aruco5x5x50 | Self::Aruco5x5x100 | Self::Aruco5x5x250 | Self::ArucoOriginal => 5,
            Self::Aruco6x6x50 | Self::Aruco6x6x100 | Self::Aruco6x6x250 | Self::AprilTag36h11 => 6,
        }
    }

    /// Number of markers.
    pub fn markers(self) -> usize {
        match self {
            Self::Aruco4x4x50 | Self::Aruco5x5x50 | Self::Aruco6x6x50 => 50,
            Self::Aruco4x4x100 | Self::Aruco5x5x100 | Self::Aruco6x6x100 => 100,
            Self::Aruco4x4x250 | Self::Aruco5x5x250 | Self::Aruco6x6x250 => 250,
            Self::ArucoOriginal => 1024,
            Self::AprilTag36h11 => 587,
        }
    }

    /// The inner squares of a marker row by row from the top left, the first in the highest of `side()²` bits; 1 is white. `None` beyond the last marker.
    pub fn bits(self, id: usize) -> Option<u64> {
        if id >= self.markers() {
            return None;
        }
        match self {
            Self::Aruco4x4x50 | Self::Aruco4x4x100 | Self::Aruco4x4x250 => ARUCO_4X4.get(id).copied(),
            Self::Aruco5x5x50 | Self::Aruco5x5x100 | Self::Aruco5x5x250 => ARUCO_5X5.get(id).copied(),
            Self::Aruco6x6x50 | Self::Aruco6x6x100 | Self::Aruco6x6x250 => halves(&ARUCO_6X6, id),
            Self::AprilTag36h11 => halves(&APRILTAG_36H11, id),
            Self::ArucoOriginal => {
                // Two bits of the number choose the word of a row, the highest two that of the first.
                const WORDS: [u64; 4] = [0b10000, 0b10111, 0b01001, 0b01110];
                Some((0..5).fold(0, |bits, row| (bits << 5) | WORDS[(id >> (2 * (4 - row))) & 3]))
            }
        }
    }

    /// Wrong bits that are put right: fewer than half of those in which the two most alike markers (in any turn) differ, and never more than a tenth of all: beyond, walls become markers.
    pub fn correctable(self) -> u32 {
        match self {
            // Of 16 bits. Markers of the larger sets differ in 3.
            Self::Aruco4x4x50 | Self::Aruco4x4x100 | Self::Aruco4x4x250 => 1,
            Self::ArucoOriginal => 0,
            Self::Aruco5x5x50 | Self::Aruco5x5x100 | Self::Aruco5x5x250 => 2,
            Self::Aruco6x6x50 | Self::Aruco6x6x100 | Self::Aruco6x6x250 | Self::AprilTag36h11 => 3,
        }
    }

    /// The marker among the first `markers` that `bits` show, and by how many quarter turns clockwise it is turned against them; with at most [`Dictionary::correctable`] bits wrong. Time: markers.
    pub fn read(self, bits: u64, markers: usize) -> Option<(usize, usize)> {
        let mut turned = bits;
        let mut best: Option<(u32, usize, usize)> = None;
        for turns in 0..4 {
            for id in 0..markers.min(self.markers()) {
                let wrong = (self.bits(id)? ^ turned).count_ones();
                if wrong <= self.correctable() && best.is_none_or(|b| wrong < b.0) {
                    best = Some((wrong, id, turns));
                }
            }
            turned = turn(turned, self.side());
        }
        best.map(|(_, id, turns)| (id, turns))
    }
}

impl Dictionary {
    /// Whether `bits` are those of a marker in one of its turns, all of them right.
    pub(super) fn read_exactly(self, bits: u64) -> bool {
        let turns = std::iter::successors(Some(bits), |bits| Some(turn(*bits, self.side())));
        turns.take(4).any(|bits| (0..self.markers()).any(|id| self.bits(id) == Some(bits)))
    }
}

/// Bits that are stored as two halves of 18.
fn halves(stored: &[u32], id: usize) -> Option<u64> {
    let (high, low) = (stored.get(2 * id)?, stored.get(2 * id + 1)?);
    Some((u64::from(*high) << 18) | u64::from(*low))
}

/// The inner squares as they look after a quarter turn counterclockwise, which undoes one clockwise.
fn turn(bits: u64, side: usize) -> u64 {
    let at = |row: usize, column: usize| (bits >> (side * side - 1 - (row * side + column))) & 1;
    (0..side * side).fold(0, |turned, i| (turned << 1) | at(i % side, side - 1 - i / side))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Named;

    #[test]
    fn markers_are_read_in_every_turn_with_wrong_bits() {
        for (_, dictionary) in Dictionary::NAMES {
            let (n, markers) = (dictionary.side() * dictionary.side(), dictionary.markers());
            assert_eq!(dictionary.bits(markers), None);
            // (The last of the original ones looks the same upside down.)
            for id in [0, 7, 31, markers - 2] {
                let mut bits = dictionary.bits(id).unwrap();
                assert!(bits >> n == 0);
                // Three turns counterclockwise are one clockwise.
                for turns in 0..4 {
                    let wrong = (0..dictionary.correctable()).fold(bits, |b, k| b ^ (1 << (5 * k)));
                    assert_eq!(dictionary.read(wrong, markers), Some((id, turns)), "{dictionary} {id}");
                    bits = (0..3).fold(bits, |b, _| turn(b, dictionary.side()));
                }
            }
        }
    }

    #[test]
    fn no_two_markers_are_taken_for_each_other() {
        for (_, dictionary) in Dictionary::NAMES {
            let markers = dictionary.markers();
            // The numbers of the original have no distance to speak of but that of their words.
            if *dictionary == Dictionary::ArucoOriginal {
                continue;
            }
            let turned: Vec<[u64; 4]> = (0..markers)
                .map(|id| {
                    let mut bits = dictionary.bits(id).unwrap();
                    std::array::from_fn(|_| {
                        let now = bits;
                        bits = turn(bits, dictionary.side());
                        now
                    })
                })
                .collect();
            for i in 0..markers {
                for j in 0..=i {
                    for k in usize::from(i == j)..4 {
                        let differ = (turned[i][0] ^ turned[j][k]).count_ones();
                        assert!(differ > 2 * dictionary.correctable(), "{dictionary} {i} {j}: {differ}");
                    }
                }
            }
        }
    }
}
