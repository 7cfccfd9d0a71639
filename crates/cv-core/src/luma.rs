//! Rec. 601 luma of one pixel: `0.299 R + 0.587 G + 0.114 B` of gamma-encoded values (ITU-R BT.601, 2.5.1).
//!
//! Not luminance, which weights linear RGB by the primaries (Rec. 709 for sRGB).

/// Computes luma of 8-bit RGB in OpenCV's 15-bit fixed point (`cvtColor`, `RGB2GRAY`), with identical results.
#[inline(always)]
pub fn luma_u8([r, g, b]: [u8; 3]) -> u8 {
    ((9798 * u32::from(r) + 19235 * u32::from(g) + 3735 * u32::from(b) + (1 << 14)) >> 15) as u8
}

/// Computes luma of 16-bit RGB. The weights add up to 2¹⁶, so that gray keeps its value.
#[inline(always)]
pub fn luma_u16([r, g, b]: [u16; 3]) -> u16 {
    ((19595 * u32::from(r) + 38470 * u32::from(g) + 7471 * u32::from(b) + (1 << 15)) >> 16) as u16
}

/// Computes luma of floating-point RGB, in the unit of the input.
#[inline(always)]
pub fn luma_f32([r, g, b]: [f32; 3]) -> f32 {
    0.299 * r + 0.587 * g + 0.114 * b
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn fixed_point_luma_is_the_exact_luma_rounded(rgb in any::<[u16; 3]>()) {
            let exact = |[r, g, b]: [f64; 3]| 0.299 * r + 0.587 * g + 0.114 * b;
            // Half a step of rounding; weights rounded at 2⁻¹⁷ or 2⁻¹⁶ of the largest value, three of them.
            let wide = f64::from(luma_u16(rgb)) - exact(rgb.map(f64::from));
            prop_assert!(wide.abs() <= 0.5 + 3.0 * 0.5, "{wide}");
            let bytes = rgb.map(|v| (v >> 8) as u8);
            let narrow = f64::from(luma_u8(bytes)) - exact(bytes.map(f64::from));
            prop_assert!(narrow.abs() <= 0.5 + 3.0 * 255.0 / 65536.0, "{narrow}");
            // Three products and two sums of numbers up to 65535, in 24 bits.
            let real = f64::from(luma_f32(rgb.map(f32::from))) - exact(rgb.map(f64::from));
            prop_assert!(real.abs() <= 5.0 * 65536.0 / f64::from(1 << 24), "{real}");
        }

        #[test]
        fn gray_keeps_its_value(v: u16) {
            prop_assert_eq!(luma_u16([v; 3]), v);
            prop_assert_eq!(luma_u8([v as u8; 3]), v as u8);
        }
    }

    #[test]
    fn luma_of_bytes_matches_opencv() {
        for (rgb, gray) in [([255, 0, 0], 76), ([0, 255, 0], 150), ([0, 0, 255], 29), ([255; 3], 255), ([1; 3], 1)] {
            assert_eq!(luma_u8(rgb), gray);
        }
    }
}
