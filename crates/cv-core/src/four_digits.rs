//! Measured numbers as people read them.

/// A number to four significant digits: without those that nobody measured.
pub fn four_digits(value: f64) -> f64 {
    format!("{value:.3e}").parse().unwrap_or(value)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_that_nobody_measured_are_left_out() {
        assert_eq!([0.20000000000000004, -123456.7, 0.0, 9.9996e-7].map(four_digits), [0.2, -123500.0, 0.0, 1e-6]);
        assert!(four_digits(f64::NAN).is_nan() && four_digits(f64::INFINITY) == f64::INFINITY);
    }
}
