//! The file of the standard deviations of camera poses and points.

use cv_core::Matrix3;
use cv_pipeline::many_views::ModelCovariance;
use serde_json::{Value, json};

/// Returns the standard deviations as JSON: of each camera center in the model's unit, of its rotation about the camera's axes in degrees, and of the points. `names` are those of the views.
pub(super) fn deviations(covariance: &ModelCovariance, names: &[&str], unit: &Value) -> Value {
    let roots = |m: &Matrix3<f64>, unit: f64| [0, 1, 2].map(|i| m[(i, i)].max(0.0).sqrt() * unit);
    let images = names.iter().zip(&covariance.poses).filter_map(|(name, pose)| {
        let pose = pose.as_ref()?;
        let (center, rotation) = (roots(&pose.center, 1.0), roots(&pose.rotation, 1f64.to_degrees()));
        Some(json!({ "name": name, "center": center, "rotation_degrees": rotation }))
    });
    // The ids of a model's points start at 1.
    let points = covariance.points.iter().zip(1u64..).map(|(point, id)| {
        let deviation = point.as_ref().map(|point| roots(point, 1.0));
        json!({ "id": id, "position": deviation })
    });
    let [exact, distance] = covariance.reference.map(|view| names.get(view).copied());
    json!({
        "what": "standard deviations",
        "unit": unit,
        "exact": { "pose_of": exact, "distance_from_it_of": distance },
        "keypoint_px": covariance.noise,
        "images": images.collect::<Vec<_>>(),
        "points": points.collect::<Vec<_>>(),
    })
}
