//! A stroke font of capitals as polylines, sharp at any scale.

use crate::noise::{edge, floor};
use crate::rng::hash2;

/// Strokes on a grid 4 wide and 6 high, origin at the top left.
const GLYPHS: [&[&[(u8, u8)]]; 26] = [
    &[&[(0, 6), (2, 0), (4, 6)], &[(1, 4), (3, 4)]],
    &[&[(0, 0), (0, 6), (3, 6), (4, 5), (4, 4), (3, 3), (0, 3)], &[(0, 0), (3, 0), (4, 1), (4, 2), (3, 3)]],
    &[&[(4, 1), (3, 0), (1, 0), (0, 1), (0, 5), (1, 6), (3, 6), (4, 5)]],
    &[&[(0, 0), (0, 6), (2, 6), (4, 4), (4, 2), (2, 0), (0, 0)]],
    &[&[(4, 0), (0, 0), (0, 6), (4, 6)], &[(0, 3), (3, 3)]],
    &[&[(4, 0), (0, 0), (0, 6)], &[(0, 3), (3, 3)]],
    &[&[(4, 1), (3, 0), (1, 0), (0, 1), (0, 5), (1, 6), (3, 6), (4, 5), (4, 3), (2, 3)]],
    &[&[(0, 0), (0, 6)], &[(4, 0), (4, 6)], &[(0, 3), (4, 3)]],
    &[&[(2, 0), (2, 6)]],
    &[&[(4, 0), (4, 5), (3, 6), (1, 6), (0, 5)]],
    &[&[(0, 0), (0, 6)], &[(4, 0), (0, 4)], &[(1, 3), (4, 6)]],
    &[&[(0, 0), (0, 6), (4, 6)]],
    &[&[(0, 6), (0, 0), (2, 3), (4, 0), (4, 6)]],
    &[&[(0, 6), (0, 0), (4, 6), (4, 0)]],
    &[&[(1, 0), (3, 0), (4, 1), (4, 5), (3, 6), (1, 6), (0, 5), (0, 1), (1, 0)]],
    &[&[(0, 6), (0, 0), (3, 0), (4, 1), (4, 2), (3, 3), (0, 3)]],
    &[&[(1, 0), (3, 0), (4, 1), (4, 5), (3, 6), (1, 6), (0, 5), (0, 1), (1, 0)], &[(2, 4), (4, 6)]],
    &[&[(0, 6), (0, 0), (3, 0), (4, 1), (4, 2), (3, 3), (0, 3)], &[(2, 3), (4, 6)]],
    &[&[(4, 1), (3, 0), (1, 0), (0, 1), (0, 2), (1, 3), (3, 3), (4, 4), (4, 5), (3, 6), (1, 6), (0, 5)]],
    &[&[(0, 0), (4, 0)], &[(2, 0), (2, 6)]],
    &[&[(0, 0), (0, 5), (1, 6), (3, 6), (4, 5), (4, 0)]],
    &[&[(0, 0), (2, 6), (4, 0)]],
    &[&[(0, 0), (1, 6), (2, 3), (3, 6), (4, 0)]],
    &[&[(0, 0), (4, 6)], &[(4, 0), (0, 6)]],
    &[&[(0, 0), (2, 3), (4, 0)], &[(2, 3), (2, 6)]],
    &[&[(0, 0), (4, 0), (0, 6), (4, 6)]],
];

/// Words printed on posters and books.
const WORDS: [&str; 64] = [
    "THE",
    "OF",
    "AND",
    "A",
    "IN",
    "TO",
    "AT",
    "ON",
    "BY",
    "FOR",
    "LIGHT",
    "RIVER",
    "NIGHT",
    "MUSIC",
    "SUMMER",
    "GARDEN",
    "CITY",
    "NORTH",
    "WINTER",
    "OPEN",
    "HOUSE",
    "JAZZ",
    "FIELD",
    "STONE",
    "PAPER",
    "HARBOUR",
    "MARKET",
    "LETTERS",
    "ISLAND",
    "MAPS",
    "TRAVEL",
    "SONGS",
    "HISTORY",
    "QUIET",
    "GLASS",
    "ORCHARD",
    "MOUNTAIN",
    "BRIDGE",
    "SEVEN",
    "DAYS",
    "WIND",
    "COLOR",
    "FORM",
    "LINE",
    "EXHIBITION",
    "THEATRE",
    "SPRING",
    "WALK",
    "KITCHEN",
    "BREAD",
    "VOYAGE",
    "CLOUDS",
    "FOX",
    "UNDER",
    "OLD",
    "NEW",
    "PARK",
    "DUST",
    "VIOLIN",
    "WHITE",
    "BLUE",
    "JOURNEY",
    "HOME",
    "AUTUMN",
];

/// Returns the distance to the strokes of a glyph, in grid units.
fn distance(glyph: usize, x: f32, y: f32) -> f32 {
    let mut best = f32::INFINITY;
    for stroke in GLYPHS[glyph % GLYPHS.len()] {
        for pair in stroke.windows(2) {
            let (ax, ay) = (f32::from(pair[0].0), f32::from(pair[0].1));
            let (bx, by) = (f32::from(pair[1].0), f32::from(pair[1].1));
            let (dx, dy) = (bx - ax, by - ay);
            let t = (((x - ax) * dx + (y - ay) * dy) / (dx * dx + dy * dy)).clamp(0.0, 1.0);
            let (ex, ey) = (x - ax - t * dx, y - ay - t * dy);
            best = best.min(ex * ex + ey * ey);
        }
    }
    best.sqrt()
}

/// Returns the ink coverage (0 to 1) at `(u, v)` meters in a block of running text with capitals `size` meters high.
///
/// Lines are `1.8 × size` apart and end raggedly before `line` meters. `weight` is half the stroke width on the 4×6
/// grid: 0.4 is regular, 0.7 bold.
pub(crate) fn text(u: f32, v: f32, size: f32, line: f32, weight: f32, seed: u32, width: f32) -> f32 {
    let unit_length = size / 6.0;
    let pitch = 5.6 * unit_length;
    let (row, column) = (floor(v / (1.8 * size)), floor(u / pitch));
    if u < 0.0 || v < 0.0 || u > line {
        return 0.0;
    }
    // The word at this column; a line ends before the first word that does not fit, but has at least one.
    let (mut start, mut count) = (0, 0);
    let letter = loop {
        let word = WORDS[hash2(count, row, seed) as usize % WORDS.len()].as_bytes();
        let end = start + word.len() as i32;
        if count > 0 && end as f32 * pitch > line {
            return 0.0;
        }
        if column < end {
            break word[(column - start) as usize];
        }
        if column == end {
            return 0.0;
        }
        (start, count) = (end + 1, count + 1);
    };
    // Text below the resolution is gray.
    if width > 2.5 * unit_length {
        return 0.35 * weight;
    }
    let x = u / unit_length - column as f32 * 5.6 - 0.8;
    let y = v / unit_length - row as f32 * 10.8 - 0.8;
    edge(weight - distance(usize::from(letter.saturating_sub(b'A')), x, y), width / unit_length)
}
