//! Turns a photograph by 30 degrees about its middle.
use cv_core::{Camera, Matrix3};
use cv_imgproc::{Interpolation, RemapOptions, warp_perspective};
use cv_synth::{RenderOptions, Scene, render};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (scene, camera) = (Scene::room(1), Camera::from_focal(160, 120, 140.0));
    let photo = render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default())?.image;

    let (sin, cos) = 30f64.to_radians().sin_cos();
    let turn = Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0);
    // From the middle of the photograph and back to it.
    let k = camera.matrix();
    let h = k * turn * camera.inverse_matrix();
    let options = RemapOptions { interpolation: Interpolation::Bicubic, ..RemapOptions::default() };
    let (turned, inside) = warp_perspective(photo.view(), &h, photo.size(), &options)?;

    let share = inside.as_slice().iter().filter(|&&inside| inside).count() as f64 / (160.0 * 120.0);
    println!("{}×{} pixels, {:.0} % of them show the photograph", turned.width(), turned.height(), 100.0 * share);
    Ok(())
}
