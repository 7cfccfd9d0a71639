//! Rectifies the images of a rig with rotated cameras and lens distortion.
use cv_core::{Camera, Distortion, Pose, Rotation3, Silent, StereoRig, Vector3};
use cv_stereo::{Rectification, RectifyOptions};
use cv_synth::{RenderOptions, Scene, render};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let lens = Camera { distortion: Distortion::radial(-0.1, 0.02), ..Camera::from_focal(320, 240, 280.0) };
    let motion = Pose::new(Rotation3::from_euler_angles(0.02, -0.03, 0.01), Vector3::new(-0.2, 0.004, 0.01));
    let rig = StereoRig { left: lens, right: lens, right_from_left: motion };
    let scene = Scene::room(4);
    let poses = [scene.viewpoint(), motion.compose(&scene.viewpoint())];

    let rectification = Rectification::new(&rig, &RectifyOptions::default())?;
    for (view, pose) in [&rectification.left, &rectification.right].into_iter().zip(poses) {
        let photo = render(&scene, &lens, &pose, &RenderOptions::default())?.image;
        let (image, inside) = view.apply(photo.view(), &Silent)?;
        let seen = inside.as_slice().iter().filter(|&&inside| inside).count();
        println!("{}×{} px, {seen} of them seen", image.width(), image.height());
    }
    println!("focal length {:.1} px, baseline {:.3}", rectification.geometry.focal, rectification.geometry.baseline);
    Ok(())
}
