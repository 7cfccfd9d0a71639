//! Two views of a room and their ground truth: the depth of a pixel, and its correspondence in the other view.
use cv_core::{Camera, Point2};
use cv_synth::{RenderOptions, two_view};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let camera = Camera::from_focal(160, 120, 140.0);
    let views = two_view(7, &camera, 0.3, &RenderOptions { exposure: -0.5, ..RenderOptions::default() })?;
    let scene = &views.scene;

    let pixel = Point2::new(80.0, 70.0);
    let point = scene.point_at(&camera, &views.a.pose, pixel).ok_or("the ray leaves the room")?;
    println!("{:.3} m away", views.a.depth.at(80, 70)[0]);
    match scene.pixel_of(&camera, &views.b.pose, &point) {
        Some(other) => println!("{pixel} of the first image is {other} of the second"),
        None => println!("it is not visible in the second image"),
    }
    Ok(())
}
