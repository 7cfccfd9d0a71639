//! A blend mode of one's own: photographs averaged wherever they overlap.

use cv_core::{Camera, Cancelled, Matrix3, Progress, RgbU8, Silent};
use cv_panorama::{Alignment, Blender, CameraMotion, CompositingOptions, Composition, View, render_with};

struct Average;

impl Blender for Average {
    fn blend(&self, composition: &Composition<'_>, progress: &dyn Progress) -> Result<RgbU8, Cancelled> {
        progress.report("blend", 0, 1)?;
        let (width, height) = composition.labels.size();
        Ok(RgbU8::from_fn(width, height, |x, y| {
            let seen: Vec<_> = composition.photos.iter().flatten().filter_map(|p| p.color(x, y)).collect();
            [0, 1, 2].map(|c| (seen.iter().map(|s| usize::from(s[c])).sum::<usize>() / seen.len().max(1)) as u8)
        }))
    }
}

pub(crate) fn main() -> Result<(), Box<dyn std::error::Error>> {
    let photos = [RgbU8::new(200, 150, [200, 40, 40]), RgbU8::new(200, 150, [40, 40, 200])];
    let view = View { camera: Camera::from_focal(200, 150, 180.0), from_world: Matrix3::identity() };
    let (views, motion) = (vec![Ok(view); 2], CameraMotion::Rotation);
    let alignment = Alignment { views, reference: 0, motion, pairs: vec![], rms_px: 0.0, median_px: 0.0 };
    let options = CompositingOptions { exposure: cv_panorama::Exposure::None, ..CompositingOptions::default() };
    let panorama = render_with(&[photos[0].view(), photos[1].view()], &alignment, &options, &Average, &Silent)?;
    println!("the middle is {:?}", panorama.image.at(100, 75));
    Ok(())
}
