//! How a pixel moves with the point it shows and with the camera's parameters: what an adjustment needs.
use cv_core::{Camera, Distortion, Point3};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let lens = Distortion::fisheye4([0.02, -0.004, 0.0, 0.0]);
    let camera = Camera { distortion: lens, ..Camera::from_focal(1280, 960, 600.0) };
    let seen = camera.project_with_jacobians(&Point3::new(0.8, -0.3, 1.0)).ok_or("the point is behind the camera")?;
    println!("pixel {:.3}, by the point {:.1}", seen.pixel, seen.by_point);
    let names = ["fx", "fy", "cx", "cy"].iter().chain(lens.model().info().parameters);
    for (name, column) in names.zip(seen.by_intrinsics.column_iter()) {
        println!("by {name}: {:.3} {:.3}", column[0], column[1]);
    }
    // One step of an adjustment: change the vector, make the camera of it.
    let mut intrinsics = camera.intrinsics();
    intrinsics[4] += 1e-3;
    println!("with another k1: {:?}", camera.with_intrinsics(&intrinsics).distortion.parameters());
    Ok(())
}
