//! Fuzzes models and options as JSON, and the program's configuration as TOML.

use crate::structured::Input;
use cv_core::RgbU8;
use cv_pipeline::{Silent, segment, segmentation::ColorModel};
use libfuzzer_sys::Corpus;

/// Fuzzes a color model as JSON, and segmentation with it.
pub fn model(bytes: &[u8]) -> Corpus {
    let Ok(value) = serde_json::from_slice::<serde_json::Value>(bytes) else { return Corpus::Reject };
    if ColorModel::check_schema(value["schema"].as_u64()).is_err() {
        return Corpus::Keep;
    }
    if let Ok(model) = serde_json::from_value::<ColorModel>(value) {
        let photo = RgbU8::from_fn(9, 7, |x, y| [(x * 30) as u8, (y * 40) as u8, 99]);
        let found = segment(photo.view(), &model, &Silent).expect("there is no cancellation");
        assert!((0.0..=1.0).contains(&found.fraction));
        let text = serde_json::to_string(&model).expect("a parsed model can be serialized");
        let again: Result<ColorModel, _> = serde_json::from_str(&text);
        assert!(again.is_ok(), "{again:?}: {text}");
    }
    Corpus::Keep
}

/// Fuzzes serialized options.
pub fn options(bytes: &[u8]) -> Corpus {
    let Input { pairs, .. } = Input::of(&mut arbitrary::Unstructured::new(bytes));
    let Ok(options) = serde_json::from_slice::<cv_pipeline::RobustOptions>(bytes) else { return Corpus::Reject };
    if options.max_iterations <= 1000 && options.min_iterations <= 1000 {
        let _ = cv_pipeline::estimate(&pairs, cv_pipeline::ModelKind::Homography, &options, &Silent);
    }
    Corpus::Keep
}

/// Fuzzes the configuration file `cv.toml`.
pub fn toml(bytes: &[u8]) -> Corpus {
    let Ok(table) = basic_toml::from_slice::<serde_json::Map<String, serde_json::Value>>(bytes) else {
        return Corpus::Reject;
    };
    let text = basic_toml::to_string(&table);
    if let Ok(text) = text {
        let again: Result<serde_json::Map<String, serde_json::Value>, _> = basic_toml::from_str(&text);
        assert!(again.is_ok_and(|again| again.len() == table.len()), "{text}");
    }
    Corpus::Keep
}
