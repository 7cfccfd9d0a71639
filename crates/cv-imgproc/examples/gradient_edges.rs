//! Detects edges by gradient magnitude: the strongest 1 % of the Sobel gradients of a rendered image.
use cv_core::{Camera, Mask};
use cv_imgproc::{gaussian_blur, rgb_to_gray_f32, sobel};
use cv_synth::{RenderOptions, Scene, render};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (scene, camera) = (Scene::room(1), Camera::from_focal(160, 120, 140.0));
    let photo = render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default())?.image;

    let smooth = gaussian_blur(rgb_to_gray_f32(photo.view()).view(), 1.0);
    let (dx, dy) = sobel(smooth.view());
    let magnitude = |x: usize, y: usize| dx.at(x, y)[0].hypot(dy.at(x, y)[0]);
    let mut magnitudes: Vec<f32> = (0..160 * 120).map(|i| magnitude(i % 160, i / 160)).collect();
    let threshold = cv_core::quantile(&mut magnitudes, 0.99).ok_or("no pixels")?;
    let edges = Mask::from_fn(160, 120, |x, y| [magnitude(x, y) >= threshold]);

    println!("{} edge pixels", edges.as_slice().iter().filter(|&&edge| edge).count());
    Ok(())
}
