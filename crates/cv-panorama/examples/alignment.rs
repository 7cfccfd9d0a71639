//! Where photographs look, from matches alone: no pixels.

use cv_core::{Camera, Correspondence, Point2, Silent, Vector3};
use cv_panorama::{AlignOptions, Photo, VerifyOptions, View, align, verify_pair};
use nalgebra::Rotation3;

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // A camera with a focal length of 900 px, rotated by 25 degrees to the right.
    let camera = Camera::from_focal(1200, 800, 900.0);
    let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), -25_f64.to_radians());
    let [a, b] = [Rotation3::identity(), turn].map(|r| View { camera, from_world: r.into_inner() });
    let grid = (0..200).map(|i| Point2::new(f64::from(i % 20) * 60.0, f64::from(i / 20) * 80.0));
    let seen = |p: Point2<f64>| Some(Correspondence { a: p, b: b.project(&a.ray(p)?).filter(|q| b.contains(*q))? });
    let matches: Vec<_> = grid.filter_map(seen).collect();

    let pair = verify_pair((0, (1200, 800)), (1, (1200, 800)), &matches, &VerifyOptions::default())?;
    let alignment = align(&[Photo::new(1200, 800); 2], &[pair], &AlignOptions::default(), &Silent)?;
    for (index, view) in alignment.used() {
        let ahead = view.from_world.row(2);
        let yaw = ahead[0].atan2(ahead[2]).to_degrees();
        println!("photograph {index}: focal length {:.1} px, looks {yaw:.2} degrees to the right", view.camera.fx);
    }
    Ok(())
}
