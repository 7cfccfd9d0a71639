//! Arguments whose values are those of a library's enum.

use clap::builder::{PossibleValue, PossibleValuesParser, TypedValueParser};
use cv_core::Named;

/// Parses a value by its name in the library's own table of names, and shows that table in the help.
pub(crate) fn named<T: Named>() -> impl TypedValueParser<Value = T> {
    let values = T::NAMES.iter().map(|(name, value)| {
        let aliases = T::ALIASES.iter().filter(|(_, listed)| listed == name).map(|(alias, _)| *alias);
        let shown = PossibleValue::new(*name).aliases(aliases);
        if value.about().is_empty() { shown } else { shown.help(value.about()) }
    });
    PossibleValuesParser::new(values.collect::<Vec<_>>()).try_map(|name| T::from_name(&name))
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_pipeline::features::{CornerMeasure, Suppression};
    use cv_pipeline::panorama_types::{BlendMode, Exposure, Projection, Seams};
    use cv_pipeline::segmentation::{ColorSpace, Regions, Rule};
    use cv_pipeline::stereo::{Census, IntensityCost, Paths, Smoothing};
    use cv_pipeline::{AffineSimulation, Axes, FeatureMethod, ModelKind};

    /// What the command line makes of every name, and of every other spelling.
    fn goes_there_and_back<T: Named>() {
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
    fn every_choice_of_the_libraries_goes_there_and_back() {
        goes_there_and_back::<FeatureMethod>();
        goes_there_and_back::<Suppression>();
        goes_there_and_back::<AffineSimulation>();
        goes_there_and_back::<ModelKind>();
        goes_there_and_back::<CornerMeasure>();
        goes_there_and_back::<ColorSpace>();
        goes_there_and_back::<Rule>();
        goes_there_and_back::<Regions>();
        goes_there_and_back::<Census>();
        goes_there_and_back::<Paths>();
        goes_there_and_back::<IntensityCost>();
        goes_there_and_back::<Smoothing>();
        goes_there_and_back::<Projection>();
        goes_there_and_back::<BlendMode>();
        goes_there_and_back::<Seams>();
        goes_there_and_back::<Exposure>();
        goes_there_and_back::<Axes>();
    }
}
