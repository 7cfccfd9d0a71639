//! Pixels of a camera with lens distortion to rays and back, and where the lens model ends.
use cv_core::{Camera, Distortion, Point2, Point3};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let lens = Distortion::radial_tangential4([-0.30, 0.08, 0.001, -0.002]);
    let camera = Camera { distortion: lens, ..Camera::pinhole(640, 480, 500.0, 500.0, 319.5, 239.5) };
    camera.validate()?;
    for pixel in [Point2::new(319.5, 239.5), Point2::new(20.0, 30.0), Point2::new(5000.0, 0.0)] {
        // The direction of the pixel's ray is (x, y, 1); not a number where no ray of this lens ends.
        let ray = camera.normalize(pixel);
        match camera.project(&Point3::new(ray.x, ray.y, 1.0)) {
            Some(back) if ray.x.is_finite() => println!("{pixel} looks along {ray} and projects to {back:.6}"),
            _ => println!("{pixel}: the lens has no ray there"),
        }
    }
    println!("the model means something up to {:.3} from the axis", lens.max_radius());
    Ok(())
}
