//! Quantiles and medians.

use std::cmp::Ordering;

/// A floating-point number with a total order, positive NaN above infinity.
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

/// Returns the quantile of `values` at `fraction` (clamped to 0 to 1): the order statistic of index `fraction · (n − 1)` (from 0),
/// rounded with halves up. No interpolation (NumPy's `nearest`, but for its rounding of halves). `None` for no values.
///
/// Reorders the values; expected linear time.
pub fn quantile<T: TotalOrder>(values: &mut [T], fraction: f64) -> Option<T> {
    let last = values.len().checked_sub(1)?;
    // NaN becomes 0.
    let index = ((fraction.clamp(0.0, 1.0) * last as f64).round() as usize).min(last);
    Some(*values.select_nth_unstable_by(index, T::total_order).1)
}

/// Returns the upper median ([`quantile`] at ½): of an even number of values the upper of the two middle ones.
pub fn median<T: TotalOrder>(values: &mut [T]) -> Option<T> {
    quantile(values, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn the_quantile_is_the_value_at_its_rank(values in prop::collection::vec(-1e3f64..1e3, 1..40), fraction in 0.0f64..=1.0) {
            let mut sorted = values.clone();
            sorted.sort_by(f64::total_cmp);
            let n = values.len();
            let rank = (fraction * (n - 1) as f64).round() as usize;
            prop_assert_eq!(quantile(&mut values.clone(), fraction), Some(sorted[rank]));
            prop_assert_eq!(median(&mut values.clone()), Some(sorted[n / 2]));
            let single: Vec<f32> = values.iter().map(|v| *v as f32).collect();
            prop_assert_eq!(median(&mut single.clone()), Some(sorted[n / 2] as f32));
        }
    }

    #[test]
    fn empty_and_non_finite_inputs() {
        assert_eq!(median::<f64>(&mut []), None);
        assert_eq!(quantile(&mut [1.0, f64::NAN, 0.0], 7.0).map(f64::is_nan), Some(true));
        assert_eq!(quantile(&mut [1.0, 2.0], f64::NAN), Some(1.0));
    }
}
