//! Quantiles of numbers.

use std::cmp::Ordering;

/// A number with a total order: `f32` and `f64`, NaN above infinity.
pub trait TotalOrder: Copy {
    /// As [`f64::total_cmp`].
    fn total_order(&self, other: &Self) -> Ordering;
}

impl TotalOrder for f32 {
    #[inline]
    fn total_order(&self, other: &Self) -> Ordering {
        self.total_cmp(other)
    }
}

impl TotalOrder for f64 {
    #[inline]
    fn total_order(&self, other: &Self) -> Ordering {
        self.total_cmp(other)
    }
}

/// The quantile of `values` at `share` (clamped to 0 to 1): of the ascending values the one whose index, counted from 0, is `share · (n − 1)` rounded,
/// halves upwards. One of the values, not a mean of two (NumPy's `nearest`, but for its rounding of halves). `None` of nothing.
///
/// Reorders the values; linear in their number.
pub fn quantile<T: TotalOrder>(values: &mut [T], share: f64) -> Option<T> {
    let last = values.len().checked_sub(1)?;
    // NaN becomes 0.
    let index = ((share.clamp(0.0, 1.0) * last as f64).round() as usize).min(last);
    Some(*values.select_nth_unstable_by(index, T::total_order).1)
}

/// The upper median: [`quantile`] at ½, of an even number of values the upper of the two in the middle.
pub fn median<T: TotalOrder>(values: &mut [T]) -> Option<T> {
    quantile(values, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_quantile_is_the_value_at_its_rank(values in prop::collection::vec(-1e3f64..1e3, 1..40), share in 0.0f64..=1.0) {
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            let n = values.len();
            let rank = (share * (n - 1) as f64).round() as usize;
            prop_assert_eq!(quantile(&mut values.clone(), share), Some(sorted[rank]));
            prop_assert_eq!(median(&mut values.clone()), Some(sorted[n / 2]));
            let single: Vec<f32> = values.iter().map(|v| *v as f32).collect();
            prop_assert_eq!(median(&mut single.clone()), Some(sorted[n / 2] as f32));
        }
    }

    #[test]
    fn odd_inputs_have_an_answer() {
        assert_eq!(median::<f64>(&mut []), None);
        assert_eq!(quantile(&mut [1.0, f64::NAN, 0.0], 7.0).map(f64::is_nan), Some(true));
        assert_eq!(quantile(&mut [1.0, 2.0], f64::NAN), Some(1.0));
    }
}
