//! A panorama of overlapping photographs, in any order.

use cv_core::Camera;
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, Silent, panorama};
use cv_synth::{PanoramaSetOptions, RenderOptions, panorama_views};

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    // Three photographs of a room by a rotating camera.
    let (camera, walk) =
        (Camera::from_focal(320, 240, 300.0), PanoramaSetOptions { views: 3, ..PanoramaSetOptions::default() });
    let set = panorama_views(2, &camera, &walk, &RenderOptions::default())?;
    let photos: Vec<PanoramaPhoto<'_>> = set.views.iter().map(|v| PanoramaPhoto::new(v.image.view())).collect();

    let result = panorama(&photos, &PanoramaOptions::default(), &Silent)?;

    let (width, height) = result.image.size();
    println!("{width}×{height} px, matches agree to {:.2} px", result.reprojection_rms_px);
    for (i, photo) in result.images.iter().enumerate() {
        println!("photograph {i}: {}", if photo.used { "used" } else { "left out" });
    }
    Ok(())
}
