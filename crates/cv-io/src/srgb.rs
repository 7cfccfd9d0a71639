//! Linear light to sRGB (IEC 61966-2-1): bytes by a table, 16 bits by the formula.

use std::sync::LazyLock;

/// Bits of a float that its place in the table leaves out. Values that agree in the others differ by less than 2⁻⁸ of their size, which
/// is at most 0.44 of a byte: a place holds one step at most.
const WITHIN: u32 = 15;

/// For every place the byte at its beginning, and the value from which it is one more.
static TABLE: LazyLock<Vec<(u8, f32)>> = LazyLock::new(|| {
    let places = 0..=1f32.to_bits() >> WITHIN;
    places
        .map(|place| {
            let (mut below, mut above) = (place << WITHIN, ((place + 1) << WITHIN) - 1);
            let low = formula(f32::from_bits(below));
            if formula(f32::from_bits(above)) == low {
                return (low, f32::INFINITY);
            }
            while below + 1 < above {
                let middle = below.midpoint(above);
                if formula(f32::from_bits(middle)) == low { below = middle } else { above = middle }
            }
            (low, f32::from_bits(above))
        })
        .collect()
});

/// The byte of a value; 1 is white. What is outside 0 to 1 is clipped, NaN is black.
pub(crate) fn byte(v: f32) -> u8 {
    let v = v.clamp(0.0, 1.0);
    TABLE.get((v.to_bits() >> WITHIN) as usize).map_or(0, |&(low, next)| low + u8::from(v >= next))
}

/// The same in 16 bits, 65535 for white.
pub(crate) fn word(v: f32) -> u16 {
    // NaN compares false.
    let v = if v > 0.0 { v.min(1.0) } else { 0.0 };
    (encoded(v) * 65535.0).round() as u16
}

fn formula(v: f32) -> u8 {
    (encoded(v) * 255.0).round() as u8
}

fn encoded(v: f32) -> f32 {
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    encoded.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_is_the_formula() {
        // A prime step visits every place many times; about each step of the bytes, every float is tried.
        let scattered = (0..1f32.to_bits()).step_by(251);
        let steps = TABLE.iter().filter(|(_, next)| next.is_finite()).map(|(_, next)| next.to_bits());
        let near = steps.flat_map(|bits| bits - 8..bits + 8);
        for v in scattered.chain(near).map(f32::from_bits) {
            assert_eq!(byte(v), formula(v), "{v}");
        }
        let outside = [f32::NAN, -0.0, -1.0, f32::NEG_INFINITY, 1.0, 2.0, f32::INFINITY].map(byte);
        assert_eq!(outside, [0, 0, 0, 0, 255, 255, 255]);
        assert_eq!([f32::NAN, -1.0, 1.0, 2.0].map(word), [0, 0, 65535, 65535]);
        // IEC 61966-2-1: half the light is level 0.735357.
        assert_eq!(word(0.5), 48192);
    }
}
