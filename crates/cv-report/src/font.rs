//! A built-in stroke font, for labels inside images.
//!
//! A glyph is a set of strokes on a grid: capitals are 14 units tall, lowercase letters 10, the baseline is at y = 14. A stroke is a string
//! of points, two characters each. The first is x, as a letter from A = 0: uppercase for a point of the stroke, lowercase for the
//! control point of a quadratic Bézier curve. The second is y, in base 36 from the top of the capitals. Strokes are separated by spaces.

use crate::raster::for_each_pixel_near_segment;

/// Height of capitals in units.
const CAP_HEIGHT: f32 = 14.0;
/// Spacing between two glyphs in units.
const LETTER_SPACING: f32 = 4.2;
/// Width of a space in units.
const SPACE_WIDTH: f32 = 5.0;

/// The strokes of ASCII 33 to 126.
const GLYPHS: [&str; 94] = [
    "A0A9 AeAe",                                       // !
    "A0A3 D0D3",                                       // "
    "D1Bd I1Gd A5K5 A9J9",                             // #
    "I4i2E2a2A5a8E8i8IbieEeaeAc E0Eg",                 // $
    "C0a0A2a4C4e4E2e0C0 IagaGcgeIekeKckaIa J1Bd",      // %
    "KeC4c0E0h0H3h5D7a8AaaeEejeK8",                    // &
    "A0A3",                                            // '
    "D0a4A8acDg",                                      // (
    "A0d4D8dcAg",                                      // )
    "D1D9 A3G7 G3A7",                                  // *
    "A8I8 E4Ec",                                       // +
    "BdBeAg",                                          // ,
    "A9F9",                                            // -
    "AeAe",                                            // .
    "G0Ag",                                            // /
    "E0a0A7aeEeieI7i0E0",                              // 0
    "B3E0Ee",                                          // 1
    "A4a0E0i0I4i8AeIe",                                // 2
    "A3a0E0h0H3h6E6i6IaieEeaeAb",                      // 3
    "GeG0AaIa",                                        // 4
    "H0B0A6c5E5i5I9ieEeaeAb",                          // 5
    "H2h0E0a0A9aeEeieI9i5E5a5A9",                      // 6
    "A0I0Ce",                                          // 7
    "E6b6B3b0E0h0H3h6E6i6IaieEeaeAaa6E6",              // 8
    "BcbeEeieI5i0E0a0A5a9E9i9I5",                      // 9
    "A6A6 AeAe",                                       // :
    "B6B6 BdBeAg",                                     // ;
    "I3A8Id",                                          // <
    "A6I6 AaIa",                                       // =
    "A3I8Ad",                                          // >
    "A3a0D0h0H3h6D8Da DeDe",                           // ?
    "J7j5G5d5D8dbGbjbJ8 J5J9jbLbnbN7n0H0a0A8agHgjgLf", // @
    "AeF0Ke C9I9",                                     // A
    "A0E0h0H3h6E6A6 E6i6IaieEeAeA0",                   // B
    "J3i0F0a0A7aeFeieJb",                              // C
    "A0E0j0J7jeEeAeA0",                                // D
    "I0A0AeIe A7G7",                                   // E
    "I0A0Ae A7G7",                                     // F
    "J3i0F0a0A7aeFejeJ8F8",                            // G
    "A0Ae J0Je A7J7",                                  // H
    "A0Ae",                                            // I
    "G0GageDeaeAb",                                    // J
    "A0Ae I0A9 D6Ie",                                  // K
    "A0AeHe",                                          // L
    "AeA0F9K0Ke",                                      // M
    "AeA0JeJ0",                                        // N
    "F0a0A7aeFekeK7k0F0",                              // O
    "AeA0E0i0I4i8E8A8",                                // P
    "F0a0A7aeFekeK7k0F0 HbKf",                         // Q
    "AeA0E0i0I4i8E8A8 E8Ie",                           // R
    "I3i0E0a0A3a7E7i7IbieEeaeAb",                      // S
    "A0K0 F0Fe",                                       // T
    "A0A9aeEeieI9I0",                                  // U
    "A0FeK0",                                          // V
    "A0DeH2LeO0",                                      // W
    "A0Ie I0Ae",                                       // X
    "A0E7I0 E7Ee",                                     // Y
    "A0I0AeIe",                                        // Z
    "D0A0AgDg",                                        // [
    "A0Gg",                                            // backslash
    "A0D0DgAg",                                        // ]
    "A4D0G4",                                          // ^
    "AgIg",                                            // _
    "A0C2",                                            // `
    "E4a4A9aeEeieI9i4E4 I4Ie",                         // a
    "A0Ae E4i4I9ieEeaeA9a4E4",                         // b
    "H6h4E4a4A9aeEeheHc",                              // c
    "I0Ie E4a4A9aeEeieI9i4E4",                         // d
    "A9I9i4E4a4A9aeEeheHc",                            // e
    "F0c0C3Ce A4F4",                                   // f
    "E4a4A9aeEeieI9i4E4 I4IeiiEiaiAg",                 // g
    "A0Ae A8a4E4i4I8Ie",                               // h
    "A4Ae A0A0",                                       // i
    "C4CfciAi C0C0",                                   // j
    "A0Ae H4Aa C8He",                                  // k
    "A0AbaeCe",                                        // l
    "A4Ae A8a4D4g4G8Ge G8g4J4m4M8Me",                  // m
    "A4Ae A8a4E4i4I8Ie",                               // n
    "E4a4A9aeEeieI9i4E4",                              // o
    "A4Ai E4i4I9ieEeaeA9a4E4",                         // p
    "I4Ii E4a4A9aeEeieI9i4E4",                         // q
    "A4Ae A9a4E4",                                     // r
    "G6g4D4a4A6a9D9g9GbgeDeaeAc",                      // s
    "C0CbceFe A4F4",                                   // t
    "A4AaaeEeieIa I4Ie",                               // u
    "A4EeI4",                                          // v
    "A4CeF6HeK4",                                      // w
    "A4He H4Ae",                                       // x
    "A4Ee I4Ci",                                       // y
    "A4H4AeHe",                                        // z
    "E0c0C5c8A8c8CbcgEg",                              // {
    "A0Ag",                                            // |
    "A0c0C5c8E8c8CbcgAg",                              // }
    "A9b6D8faG7",                                      // ~
];

fn strokes(c: char) -> &'static str {
    match c {
        '!'..='~' => GLYPHS[c as usize - '!' as usize],
        '°' => "C0a0A2a4C4e4E2e0C0",
        '×' => "B5Hb H5Bb",
        '·' => "A9A9",
        '±' => "A6I6 E2Ea AeIe",
        'µ' | 'μ' => "A4Ai AaaeEeieIa I4Ie",
        'σ' => "K4E4a4A9aeEeieI9i4E4",
        '–' | '−' => "A9I9",
        '…' => "AeAe DeDe GeGe",
        // Missing glyphs are drawn as a box.
        _ => "A0I0IeAeA0",
    }
}

/// Returns the stroke width in pixels for capitals `size` pixels tall.
pub(crate) fn weight(size: f32) -> f32 {
    (size * 0.125).max(1.0)
}

/// Returns the width of `c` without letter spacing, in units. Digits are equally wide.
fn glyph_width(c: char) -> f32 {
    match c {
        ' ' => SPACE_WIDTH,
        '0'..='9' => 8.0,
        _ => strokes(c).split(' ').flat_map(points).map(|(p, _)| p[0]).fold(0.0, f32::max),
    }
}

/// Decodes the points of a stroke, and whether each is on the curve.
fn points(stroke: &str) -> impl Iterator<Item = ([f32; 2], bool)> {
    stroke.as_bytes().as_chunks::<2>().0.iter().map(|&[x, y]| {
        let y = f32::from(if y.is_ascii_digit() { y - b'0' } else { y - b'a' + 10 });
        ([f32::from(x.to_ascii_uppercase() - b'A'), y], x.is_ascii_uppercase())
    })
}

/// Returns the width of a line of text in pixels.
pub(crate) fn width(text: &str, size: f32) -> f32 {
    let units: f32 = text.chars().map(|c| glyph_width(c) + LETTER_SPACING).sum();
    (units - LETTER_SPACING).max(0.0) * size / CAP_HEIGHT
}

/// Draws a line of text: calls `blend(x, y, alpha)` for its pixels, at most once per pixel of a glyph.
pub(crate) fn draw(text: &str, at: [f32; 2], size: f32, weight: f32, mut blend: impl FnMut(i64, i64, f32)) {
    let in_range = |v: f32| v.abs() < 1e6;
    if !(in_range(at[0]) && in_range(at[1]) && size > 0.0 && size < 2000.0) {
        return;
    }
    let unit = size / CAP_HEIGHT;
    let radius = (weight / 2.0).max(0.5);
    let mut left = at[0];
    for c in text.chars() {
        let width = glyph_width(c);
        if c != ' ' {
            draw_glyph(strokes(c), [left, at[1]], unit, width, radius, &mut blend);
        }
        left += (width + LETTER_SPACING) * unit;
    }
}

fn draw_glyph(strokes: &str, at: [f32; 2], unit: f32, width: f32, radius: f32, blend: &mut impl FnMut(i64, i64, f32)) {
    let margin = radius + 1.5;
    let (x0, y0) = ((at[0] - margin).floor() as i64, (at[1] - margin).floor() as i64);
    let w = (width * unit + 2.0 * margin).ceil() as usize + 2;
    let h = (18.0 * unit + 2.0 * margin).ceil() as usize + 2;
    // Maximum coverage of all strokes, so that crossings are not darker.
    let mut coverage = vec![0.0f32; w * h];
    let mut segment = |a: [f32; 2], b: [f32; 2]| {
        let to_pixels = |p: [f32; 2]| [at[0] + p[0] * unit - x0 as f32, at[1] + p[1] * unit - y0 as f32];
        for_each_pixel_near_segment([to_pixels(a), to_pixels(b)], radius + 0.5, |x, y, distance| {
            if (0..w as i64).contains(&x) && (0..h as i64).contains(&y) {
                let cell = &mut coverage[y as usize * w + x as usize];
                *cell = cell.max((radius + 0.5 - distance).clamp(0.0, 1.0));
            }
        });
    };
    for stroke in strokes.split(' ') {
        let mut last = None;
        let mut control: Option<[f32; 2]> = None;
        for (p, on_curve) in points(stroke) {
            match (last, on_curve) {
                (_, false) => control = Some(p),
                (None, true) => last = Some(p),
                (Some(from), true) => {
                    match control.take() {
                        None => segment(from, p),
                        Some(c) => {
                            const STEPS: u32 = 8;
                            let mut previous = from;
                            for i in 1..=STEPS {
                                let t = i as f32 / STEPS as f32;
                                let q = [0, 1].map(|k| {
                                    (1.0 - t) * (1.0 - t) * from[k] + 2.0 * t * (1.0 - t) * c[k] + t * t * p[k]
                                });
                                segment(previous, q);
                                previous = q;
                            }
                        }
                    }
                    last = Some(p);
                }
            }
        }
    }
    for (i, &alpha) in coverage.iter().enumerate().filter(|(_, a)| **a > 0.0) {
        blend(x0 + (i % w) as i64, y0 + (i / w) as i64, alpha);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_glyph_is_well_formed_and_unique() {
        let mut seen = std::collections::BTreeMap::new();
        for c in ('!'..='~').chain("°×·±µσ–…".chars()) {
            for stroke in strokes(c).split(' ') {
                assert!(stroke.is_ascii() && stroke.len() >= 4 && stroke.len() % 2 == 0, "{c}: {stroke}");
                let list: Vec<_> = points(stroke).collect();
                assert!(list[0].1 && list[list.len() - 1].1, "{c}: a stroke begins and ends on the curve");
                assert!(list.windows(2).all(|p| p[0].1 || p[1].1), "{c}: two control points in a row");
                assert!(list.iter().all(|(p, _)| p[0] <= 14.0 && p[1] <= 18.0), "{c}: outside the grid");
            }
            assert_eq!(seen.insert(strokes(c), c), None, "{c} looks like another glyph");
        }
    }

    #[test]
    fn drawn_text_has_the_computed_width() {
        for text in ["W", "Hello, world", "0123456789"] {
            let (mut left, mut right) = (i64::MAX, i64::MIN);
            draw(text, [10.0, 10.0], 28.0, 2.0, |x, _, alpha| {
                if alpha > 0.5 {
                    left = left.min(x);
                    right = right.max(x);
                }
            });
            // Half a stroke on either side, and a narrow last digit has the full digit width.
            assert!((left as f32 - 9.5).abs() <= 2.0, "{text}: {left}");
            assert!((right as f32 - 10.0 - width(text, 28.0)).abs() <= 3.0, "{text}: {right}");
        }
    }
}
