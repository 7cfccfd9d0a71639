//! Finds the pixels of a photograph where it is brightest to darkest: the strongest hundredth of its gradients.
use cv_core::{Camera, Mask};
use cv_imgproc::{gaussian_blur, rgb_to_gray_f32, sobel};
use cv_synth::{RenderOptions, Scene, render};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let (scene, camera) = (Scene::room(1), Camera::from_focal(160, 120, 140.0));
    let photo = render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default())?.image;

    let smooth = gaussian_blur(rgb_to_gray_f32(photo.view()).view(), 1.0);
    let (dx, dy) = sobel(smooth.view());
    let strength = |x: usize, y: usize| dx.at(x, y)[0].hypot(dy.at(x, y)[0]);
    let mut all: Vec<f32> = (0..160 * 120).map(|i| strength(i % 160, i / 160)).collect();
    let limit = cv_core::quantile(&mut all, 0.99).ok_or("no pixels")?;
    let edges = Mask::from_fn(160, 120, |x, y| [strength(x, y) >= limit]);

    println!("{} edge pixels", edges.as_slice().iter().filter(|&&edge| edge).count());
    Ok(())
}
