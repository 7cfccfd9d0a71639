//! An option outside its range.

/// An option is outside its range.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[error("{name} is {value}; it must be {range}")]
pub struct OptionError {
    /// Name of the field.
    pub name: &'static str,
    /// Its value.
    pub value: f64,
    /// The valid range, worded to follow “it must be”.
    pub range: &'static str,
}

impl OptionError {
    /// Refuses the option `name` unless `ok(value)`.
    ///
    /// # Errors
    /// `Self` where the value is not `ok`.
    pub fn check(
        name: &'static str,
        value: f64,
        range: &'static str,
        ok: impl FnOnce(f64) -> bool,
    ) -> Result<(), Self> {
        if ok(value) { Ok(()) } else { Err(Self { name, value, range }) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_message_has_the_value_and_the_valid_range() {
        assert_eq!(OptionError::check("sigma", 1.5, "above 0", |v| v > 0.0), Ok(()));
        let error = OptionError::check("sigma", -1.5, "above 0", |v| v > 0.0).unwrap_err();
        assert_eq!(error.to_string(), "sigma is -1.5; it must be above 0");
    }
}
