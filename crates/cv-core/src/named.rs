//! Enums whose values are chosen by name.

/// An enum whose values are chosen by name on a command line, in a script or in a file. [`named!`](crate::named) implements it.
pub trait Named: Clone + Send + Sync + Sized + 'static {
    /// Each value with its name, in the order of listings. Variants with fields have their defaults.
    const NAMES: &'static [(&'static str, Self)];

    /// Aliases and the names they stand for; accepted but not listed.
    const ALIASES: &'static [(&'static str, &'static str)];

    /// Returns the name of the variant, whatever its fields.
    fn name(&self) -> &'static str;

    /// Describes the value in a few words; empty where its name is enough.
    fn about(&self) -> &'static str;

    /// Returns the value of a name or alias.
    ///
    /// # Errors
    /// [`UnknownName`] where no value has it.
    fn from_name(name: &str) -> Result<Self, UnknownName> {
        let name = Self::ALIASES.iter().find(|(alias, _)| *alias == name).map_or(name, |(_, listed)| listed);
        let found = Self::NAMES.iter().find(|(listed, _)| *listed == name);
        match found {
            Some((_, value)) => Ok(value.clone()),
            None => Err(UnknownName::new(name, &mut Self::NAMES.iter().map(|(listed, _)| *listed))),
        }
    }
}

/// No value has this name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
#[error("“{name}” is none of {known}")]
pub struct UnknownName {
    /// The name.
    pub name: String,
    /// The names there are, joined by commas.
    pub known: String,
}

impl UnknownName {
    /// Not generic: every [`Named`] enum has it.
    fn new(name: &str, known: &mut dyn Iterator<Item = &'static str>) -> Self {
        Self { name: name.to_owned(), known: known.collect::<Vec<_>>().join(", ") }
    }
}

/// Names every variant of an enum: implements [`Named`](crate::Named), `Display` and `FromStr` for it. A variant without a
/// name does not compile.
///
/// ```
/// use cv_core::{Named, named};
///
/// #[derive(Debug, Clone, PartialEq)]
/// enum Edges {
///     Keep,
///     Smooth { sigma: f32 },
/// }
///
/// named!(Edges {
///     Keep = "keep",
///     // The fields' defaults, another spelling, and what it is for.
///     Smooth { sigma: 1.5 } = "smooth" | "blur": "where there is noise",
/// });
///
/// assert_eq!("blur".parse(), Ok(Edges::Smooth { sigma: 1.5 }));
/// assert_eq!(Edges::Smooth { sigma: 9.0 }.to_string(), "smooth");
/// assert_eq!(Edges::from_name("cut").unwrap_err().to_string(), "“cut” is none of keep, smooth");
/// ```
#[macro_export]
macro_rules! named {
    ($type:ident {
        $($variant:ident $({ $($field:ident: $value:expr),+ $(,)? })? = $name:literal $(| $alias:literal)* $(: $about:literal)?),+ $(,)?
    }) => {
        impl $crate::Named for $type {
            const NAMES: &'static [(&'static str, Self)] =
                &[$(($name, Self::$variant $({ $($field: $value),+ })?)),+];
            const ALIASES: &'static [(&'static str, &'static str)] = &[$($(($alias, $name),)*)+];

            fn name(&self) -> &'static str {
                match self {
                    $(Self::$variant { .. } => $name),+
                }
            }

            fn about(&self) -> &'static str {
                match self {
                    $(Self::$variant { .. } => concat!($($about)?)),+
                }
            }
        }

        impl ::std::fmt::Display for $type {
            fn fmt(&self, f: &mut ::std::fmt::Formatter<'_>) -> ::std::fmt::Result {
                f.pad($crate::Named::name(self))
            }
        }

        impl ::std::str::FromStr for $type {
            type Err = $crate::UnknownName;

            fn from_str(name: &str) -> Result<Self, Self::Err> {
                $crate::Named::from_name(name)
            }
        }
    };
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Clone, Copy, PartialEq)]
    enum Blend {
        None,
        Gray { per_bit: u8 },
    }

    named!(Blend { None = "none", Gray { per_bit: 2 } = "gray" | "grey": "sharper outlines" });

    #[test]
    fn names_round_trip() {
        for (name, value) in Blend::NAMES {
            assert_eq!((value.name(), value.to_string().as_str(), name.parse()), (*name, *name, Ok(*value)));
        }
        assert_eq!(Blend::NAMES.len(), 2);
        assert_eq!((Blend::None.about(), Blend::Gray { per_bit: 9 }.about()), ("", "sharper outlines"));
    }

    #[test]
    fn aliases_are_parsed_and_not_listed() {
        assert_eq!("grey".parse(), Ok(Blend::Gray { per_bit: 2 }));
        assert!(Blend::NAMES.iter().all(|(name, _)| *name != "grey"));
        // The width of a column is kept.
        assert_eq!(format!("{:>6}", Blend::None), "  none");
        assert_eq!("Gray".parse::<Blend>().unwrap_err().to_string(), "“Gray” is none of none, gray");
    }
}
