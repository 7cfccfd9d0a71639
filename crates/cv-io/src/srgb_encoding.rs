//! Encoding linear intensity as sRGB (IEC 61966-2-1): 8 bits by a table, 16 bits by the formula.

use std::sync::LazyLock;

/// Low bits of a float that the table index drops. Values of one index differ by less than 2⁻⁸ relative, which is at most 0.44 levels: an index
/// spans at most one level step.
const DROPPED_BITS: u32 = 15;

/// For every index the level at its beginning, and the value from which the level is one higher.
static STEP_TABLE: LazyLock<Vec<(u8, f32)>> = LazyLock::new(|| {
    let places = 0..=1f32.to_bits() >> DROPPED_BITS;
    places
        .map(|place| {
            let (mut below, mut above) = (place << DROPPED_BITS, ((place + 1) << DROPPED_BITS) - 1);
            let low = encode_u8_exact(f32::from_bits(below));
            if encode_u8_exact(f32::from_bits(above)) == low {
                return (low, f32::INFINITY);
            }
            while below + 1 < above {
                let middle = below.midpoint(above);
                if encode_u8_exact(f32::from_bits(middle)) == low { below = middle } else { above = middle }
            }
            (low, f32::from_bits(above))
        })
        .collect()
});

/// Encodes a linear intensity, 1 for white, as an 8-bit level. Values outside 0 to 1 are clipped, NaN is black.
pub(crate) fn encode_u8(v: f32) -> u8 {
    let v = v.clamp(0.0, 1.0);
    STEP_TABLE.get((v.to_bits() >> DROPPED_BITS) as usize).map_or(0, |&(low, next)| low + u8::from(v >= next))
}

/// As [`encode_u8`] in 16 bits, 65535 for white.
pub(crate) fn encode_u16(v: f32) -> u16 {
    // NaN compares false.
    let v = if v > 0.0 { v.min(1.0) } else { 0.0 };
    (encode(v) * 65535.0).round() as u16
}

fn encode_u8_exact(v: f32) -> u8 {
    (encode(v) * 255.0).round() as u8
}

fn encode(v: f32) -> f32 {
    let encoded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    encoded.min(1.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_table_equals_the_formula() {
        // A prime stride visits every index many times; around each level step, every float is tested.
        let scattered = (0..1f32.to_bits()).step_by(251);
        let steps = STEP_TABLE.iter().filter(|(_, next)| next.is_finite()).map(|(_, next)| next.to_bits());
        let near = steps.flat_map(|bits| bits - 8..bits + 8);
        for v in scattered.chain(near).map(f32::from_bits) {
            assert_eq!(encode_u8(v), encode_u8_exact(v), "{v}");
        }
        let outside = [f32::NAN, -0.0, -1.0, f32::NEG_INFINITY, 1.0, 2.0, f32::INFINITY].map(encode_u8);
        assert_eq!(outside, [0, 0, 0, 0, 255, 255, 255]);
        assert_eq!([f32::NAN, -1.0, 1.0, 2.0].map(encode_u16), [0, 0, 65535, 65535]);
        // IEC 61966-2-1: linear intensity 0.5 is encoded as 0.735357.
        assert_eq!(encode_u16(0.5), 48192);
    }
}
