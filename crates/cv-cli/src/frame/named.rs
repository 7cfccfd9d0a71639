//! Arguments whose values are a library's enum.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use cv_core::Named;

/// Parses a value by its name in the library's table of names, and lists that table in the help.
pub(crate) fn named<T: Named>() -> impl TypedValueParser<Value = T> {
    possible_values(&mut T::NAMES.iter().map(|(name, value)| (*name, value.about())), T::ALIASES)
        .try_map(|name| T::from_name(&name))
}

/// Lists values by name and description. Not generic: there are dozens of enums.
fn possible_values(
    values: &mut dyn Iterator<Item = (&'static str, &'static str)>,
    aliases: &'static [(&'static str, &'static str)],
) -> PossibleValuesParser {
    let shown = values.map(|(name, about)| {
        let of_name = aliases.iter().filter(|(_, listed)| *listed == name).map(|(alias, _)| *alias);
        let shown = PossibleValue::new(name).aliases(of_name);
        if about.is_empty() { shown } else { shown.help(about) }
    });
    PossibleValuesParser::new(shown.collect::<Vec<_>>())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_pipeline::features::{CornerMeasure, Suppression};
    use cv_pipeline::panorama_types::{BlendMode, Exposure, Projection, Seams};
    use cv_pipeline::segmentation::{ColorSpace, Regions, Rule};
    use cv_pipeline::stereo::{Census, IntensityCost, Paths, Search, Smoothing};
    use cv_pipeline::{AffineSimulation, Axes, FeatureMethod, ModelKind};

    /// Checks that every name and alias is parsed to its value.
    fn round_trips<T: Named>() {
        let command = clap::Command::new("cv").arg(clap::Arg::new("value").value_parser(named::<T>()));
        let parse =
            |text: &str| command.clone().try_get_matches_from(["cv", text]).map(|m| m.get_one::<T>("value").cloned());
        for (name, _) in T::NAMES {
            let parsed = parse(name).unwrap().unwrap();
            assert_eq!((parsed.name(), T::from_name(name).unwrap().name()), (*name, *name));
        }
        for (alias, name) in T::ALIASES {
            assert_eq!(parse(alias).unwrap().unwrap().name(), *name);
        }
        assert!(parse("no such value").is_err());
    }

    #[test]
    fn the_names_of_all_library_enums_round_trip() {
        round_trips::<FeatureMethod>();
        round_trips::<Suppression>();
        round_trips::<AffineSimulation>();
        round_trips::<ModelKind>();
        round_trips::<CornerMeasure>();
        round_trips::<ColorSpace>();
        round_trips::<Rule>();
        round_trips::<Regions>();
        round_trips::<Census>();
        round_trips::<Paths>();
        round_trips::<Search>();
        round_trips::<IntensityCost>();
        round_trips::<Smoothing>();
        round_trips::<Projection>();
        round_trips::<BlendMode>();
        round_trips::<Seams>();
        round_trips::<Exposure>();
        round_trips::<Axes>();
    }
}
