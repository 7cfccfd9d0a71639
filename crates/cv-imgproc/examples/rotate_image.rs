//! Rotates an image by 30 degrees about its center.
use cv_core::{Camera, Matrix3};
use cv_imgproc::{Interpolation, RemapOptions, warp_perspective};
use cv_synth::{RenderOptions, Scene, render};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (scene, camera) = (Scene::room(1), Camera::from_focal(160, 120, 140.0));
    let photo = render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default())?.image;

    let (sin, cos) = 30f64.to_radians().sin_cos();
    let rotation = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
    // Conjugate by the calibration matrix, so that the rotation is about the principal point.
    let k = camera.matrix();
    let h = k * rotation * camera.inverse_matrix();
    let options = RemapOptions { interpolation: Interpolation::Bicubic, ..RemapOptions::default() };
    let (rotated, inside) = warp_perspective(photo.view(), &h, photo.size(), &options)?;

    let fraction = inside.as_slice().iter().filter(|&&inside| inside).count() as f64 / (160.0 * 120.0);
    println!("{}×{} pixels, {:.0} % map inside the source", rotated.width(), rotated.height(), 100.0 * fraction);
    Ok(())
}
