//! Options and results as JSON, with the feature `serde`: `cargo test -p cv-pipeline --features serde --test jobs serde`.
#![cfg(feature = "serde")]
#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Correspondence, Distortion, Keypoint, Point2, Pose, Rotation3, StereoRig, Vector3};
use cv_pipeline::segmentation::TrainOptions;
use cv_pipeline::stereo::{RectifyOptions, StereoOptions};
use cv_pipeline::{
    DenseOptions, DepthOptions, FeatureOptions, MatchingOptions, ModelKind, ReconstructOptions, RobustOptions, Silent,
    estimate,
};
use serde::{Serialize, de::DeserializeOwned};
use std::fmt::Debug;

fn returns<T: Serialize + DeserializeOwned + PartialEq + Debug>(value: &T) {
    let text = serde_json::to_string(value).unwrap();
    assert_eq!(&serde_json::from_str::<T>(&text).unwrap(), value, "{text}");
}

/// Checks the round trip of options, and that missing fields have their defaults.
fn options<T: Serialize + DeserializeOwned + PartialEq + Debug + Default>() {
    returns(&T::default());
    assert_eq!(serde_json::from_str::<T>("{}").unwrap(), T::default());
}

#[test]
fn options_round_trip_and_missing_fields_have_their_defaults() {
    options::<MatchingOptions>();
    options::<ReconstructOptions>();
    options::<DenseOptions>();
    options::<DepthOptions>();
    options::<StereoOptions>();
    options::<RectifyOptions>();
    options::<RobustOptions>();
    options::<TrainOptions>();
    let some: MatchingOptions =
        serde_json::from_str(r#"{ "features": { "sift": { "max_features": 300, "layers": 2 } } }"#).unwrap();
    let FeatureOptions::Sift(sift) = &some.features else { panic!("{some:?}") };
    assert_eq!((sift.max_features, sift.layers, some.mutual), (300, 2, true));
    let far: DepthOptions = serde_json::from_str(r#"{ "range": [0.5, null] }"#).unwrap();
    assert_eq!(far.range, (0.5, f32::INFINITY));
}

#[test]
fn a_rig_with_distortion_and_a_keypoint_round_trip() {
    let left = Camera { distortion: Distortion::radial(-0.2, 0.05), ..Camera::from_focal(640, 480, 500.0) };
    let motion = Pose::new(Rotation3::from_euler_angles(0.01, 0.02, -0.03), Vector3::new(-0.1, 0.002, 0.0));
    returns(&StereoRig { left, right: Camera::from_focal(640, 480, 510.0), right_from_left: motion });
    returns(&Keypoint::new(1.5, 2.25, 0.5));
    let text = serde_json::to_string(&left).unwrap();
    assert!(serde_json::from_str::<Camera>(&text.replace("0.05]", "0.05,1.0]")).is_err(), "{text}");
    assert!(serde_json::from_str::<Camera>(&text.replace("radial", "no such lens")).is_err(), "{text}");
}

#[test]
fn a_result_has_its_model_and_stages() {
    let move_by = |i: usize| {
        let a = Point2::new((i * 37 % 101) as f64, (i * 53 % 89) as f64);
        Correspondence { a, b: a + cv_core::Vector2::new(5.0, -2.0) }
    };
    let pairs: Vec<Correspondence> = (0..30).map(move_by).collect();
    let found = estimate(&pairs, ModelKind::Homography, &RobustOptions::homography(), &Silent).unwrap();
    let json = serde_json::to_value(&found).unwrap();
    assert_eq!(json["robust"]["inliers"].as_array().unwrap().len(), 30);
    assert_eq!(json["stages"][0][0], "estimate");
}
