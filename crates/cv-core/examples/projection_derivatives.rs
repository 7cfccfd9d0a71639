//! Computes the Jacobians of a projected pixel by the scene point and by the camera intrinsics, as bundle adjustment needs them.
use cv_core::{Camera, Distortion, Point3};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let lens = Distortion::fisheye4([0.02, -0.004, 0.0, 0.0]);
    let camera = Camera { distortion: lens, ..Camera::from_focal(1280, 960, 600.0) };
    let seen = camera.project_with_jacobians(&Point3::new(0.8, -0.3, 1.0)).ok_or("the point is behind the camera")?;
    println!("pixel {:.3}, Jacobian by the point {:.1}", seen.pixel, seen.point_jacobian);
    let names = ["fx", "fy", "cx", "cy"].iter().chain(lens.model().info().parameters);
    for (name, column) in names.zip(seen.intrinsics_jacobian.column_iter()) {
        println!("derivative by {name}: {:.3} {:.3}", column[0], column[1]);
    }
    // One optimizer step: change the intrinsics vector and build the camera from it.
    let mut intrinsics = camera.intrinsics();
    intrinsics[4] += 1e-3;
    println!("with another k1: {:?}", camera.with_intrinsics(&intrinsics).distortion.parameters());
    Ok(())
}
