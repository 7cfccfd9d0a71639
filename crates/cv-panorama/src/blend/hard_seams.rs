//! Compositing without blending: every pixel is copied from the photograph of its label.

use crate::bit_depth::Channel;
use crate::blend::{Blender, Composition};
use crate::rows::for_each_row;
use cv_core::{Cancelled, Image, Progress, Stage};

/// No blending.
pub(crate) struct HardSeams;

impl<T: Channel> Blender<T> for HardSeams {
    fn blend(&self, composition: &Composition<'_, T>, progress: &dyn Progress) -> Result<Image<T, 3>, Cancelled> {
        let stage = Stage::new(progress, "blend", 1)?;
        let image = copy(composition, &stage)?;
        stage.add(1)?;
        Ok(image)
    }
}

/// Composites the image with hard seams.
pub(crate) fn copy<T: Channel>(composition: &Composition<'_, T>, stage: &Stage<'_>) -> Result<Image<T, 3>, Cancelled> {
    let (w, h) = composition.labels.size();
    let mut image = Image::new(w, h, [T::default(); 3]);
    for_each_row(image.as_mut_slice(), 3 * w, stage, |y, row| {
        for ((x, out), label) in row.as_chunks_mut::<3>().0.iter_mut().enumerate().zip(composition.labels.row(y)) {
            if let Some(Some(p)) = composition.photos.get(usize::from(*label)) {
                let [r, g, b, _] = p.pixels.at(x - p.bounds.left, y - p.bounds.top);
                *out = [r, g, b];
            }
        }
    })?;
    Ok(image)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::blend::NO_PHOTO;
    use crate::surface::Bounds;
    use crate::testing::drawn;
    use cv_core::Silent;

    #[test]
    fn each_pixel_is_that_of_its_photograph() {
        let left = drawn(Bounds { left: 0, top: 0, right: 4, bottom: 3 }, |x, y| [x as u8, y as u8, 1]);
        let right = drawn(Bounds { left: 3, top: 1, right: 6, bottom: 3 }, |x, y| [x as u8, y as u8, 2]);
        let labels = Image::from_fn(6, 3, |x, y| {
            [if x < 4 {
                0
            } else if y > 0 {
                2
            } else {
                NO_PHOTO
            }]
        });
        let photos = [Some(left), None, Some(right)];
        let composition = Composition { photos: &photos, labels: &labels, typical_side: 3.0 };
        let image = HardSeams.blend(&composition, &Silent).unwrap();
        for (x, y) in (0..3).flat_map(|y| (0..6).map(move |x| (x, y))) {
            let expected = match labels.at(x, y)[0] {
                NO_PHOTO => [0; 3],
                label => [x as u8, y as u8, if label == 0 { 1 } else { 2 }],
            };
            assert_eq!(image.at(x, y), expected, "{x} {y}");
        }
    }
}
