//! The file that tells how well cameras and points are known.

use cv_core::Matrix3;
use cv_pipeline::many_views::ModelCovariance;
use serde_json::{Value, json};

/// Standard deviations, as an object: of each photograph's center in the model's unit and of its turns about the camera's axes in degrees, and of the points that have a number. `names` are those of the views.
pub(super) fn deviations(of: &ModelCovariance, names: &[&str], unit: &Value) -> Value {
    let roots = |m: &Matrix3<f64>, unit: f64| [0, 1, 2].map(|i| m[(i, i)].max(0.0).sqrt() * unit);
    let images = names.iter().zip(&of.poses).filter_map(|(name, pose)| {
        let pose = pose.as_ref()?;
        let (center, turn) = (roots(&pose.center, 1.0), roots(&pose.rotation, 1f64.to_degrees()));
        Some(json!({ "name": name, "center": center, "rotation_deg": turn }))
    });
    // A model's points are numbered from 1.
    let points = of.points.iter().zip(1u64..).map(|(point, id)| {
        let deviation = point.as_ref().map(|point| roots(point, 1.0));
        json!({ "id": id, "position": deviation })
    });
    let [exact, distance] = of.reference.map(|view| names.get(view).copied());
    json!({
        "what": "standard deviations",
        "unit": unit,
        "exact": { "pose_of": exact, "distance_from_it_of": distance },
        "keypoint_px": of.noise,
        "images": images.collect::<Vec<_>>(),
        "points": points.collect::<Vec<_>>(),
    })
}
