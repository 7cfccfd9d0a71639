//! Relative pose and points from two images, and the model in COLMAP's form.

use cv_core::Camera;
use cv_pipeline::{Intrinsics, ReconstructOptions, Silent, reconstruct};
use cv_synth::{RenderOptions, two_view};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera::from_focal(480, 360, 420.0);
    let views = two_view(3, &camera, 0.5, &RenderOptions::default())?;

    let options = ReconstructOptions::new(Intrinsics::Focal([420.0; 2]));
    let result = reconstruct(views.a.image.view(), views.b.image.view(), &options, &Silent)
        .map_err(|error| format!("{error}; {:?}", error.advice()))?;

    println!("{} points, {:.2} px RMS", result.scene.points.len(), result.scene.reprojection_rms);
    println!("rotated by {:.2} degrees", result.scene.pose.rotation_angle().to_degrees());
    let model = result.model(["a.png".to_owned(), "b.png".to_owned()]);
    println!("{} cameras, {} images", model.cameras.len(), model.images.len());
    Ok(())
}
