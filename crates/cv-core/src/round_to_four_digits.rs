//! Rounding to significant digits, for messages.

/// Rounds a number to four significant digits.
pub fn round_to_four_digits(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn four_significant_digits_remain() {
        assert_eq!(
            [0.20000000000000004, -123456.7, 0.0, 9.9996e-7].map(round_to_four_digits),
            [0.2, -123500.0, 0.0, 1e-6]
        );
        assert!(round_to_four_digits(f64::NAN).is_nan() && round_to_four_digits(f64::INFINITY) == f64::INFINITY);
    }
}
