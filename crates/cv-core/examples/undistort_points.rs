//! Converts pixels of a camera with lens distortion to rays and back, and prints the radius up to which the lens model is valid.
use cv_core::{Camera, Distortion, Point2, Point3};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let lens = Distortion::radial_tangential4([-0.30, 0.08, 0.001, -0.002]);
    let camera = Camera { distortion: lens, ..Camera::pinhole(640, 480, 500.0, 500.0, 319.5, 239.5) };
    camera.validate()?;
    for pixel in [Point2::new(319.5, 239.5), Point2::new(20.0, 30.0), Point2::new(5000.0, 0.0)] {
        // The direction of the pixel's ray is (x, y, 1); NaN where the lens model has no ray for the pixel.
        let ray = camera.normalize(pixel);
        match camera.project(&Point3::new(ray.x, ray.y, 1.0)) {
            Some(back) if ray.x.is_finite() => println!("{pixel} looks along {ray} and projects to {back:.6}"),
            _ => println!("{pixel}: the lens has no ray there"),
        }
    }
    println!("the model is valid up to a normalized radius of {:.3}", lens.max_radius());
    Ok(())
}
