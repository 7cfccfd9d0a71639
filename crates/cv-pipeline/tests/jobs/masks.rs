//! Masks of photographs: what is removed is not matched and not shown, in every way to make a panorama.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Image, ImageView, Point2, RgbU8};
use cv_panorama::{MemoryLimit, NotWritten, PhotoMask, PhotoSource, PhotoUse, RenderError, RowSink, StreamedFrame};
use cv_pipeline::{
    PanoramaError, PanoramaOptions, PanoramaPhoto, PanoramaPrior, PanoramaResult, Silent, panorama, panorama_streamed,
    panorama_with_masks,
};
use cv_synth::{PanoramaSetOptions, PanoramaViews, RenderOptions, alignment_error, panorama_views};
use std::borrow::Cow;

const SIZE: (usize, usize) = (480, 360);

/// Whether a pixel shows what moves along with the camera, such as a bus that keeps pace: the middle 60 % of the width.
fn is_bus(x: usize, y: usize) -> bool {
    (96..384).contains(&x) && (90..330).contains(&y)
}

/// Four views of a room with the same bus in front: blocks of 6 pixels, of random levels.
fn photos() -> (PanoramaViews, Vec<RgbU8>) {
    let options = PanoramaSetOptions { views: 4, overlap: 0.6, ..PanoramaSetOptions::default() };
    let camera = Camera::from_focal(SIZE.0, SIZE.1, 390.0);
    let set = panorama_views(6, &camera, &options, &RenderOptions::draft()).unwrap();
    let block = |x: usize, y: usize| (((x / 6) * 7919 + (y / 6) * 104_729) % 251) as u8;
    let photo =
        |image: &RgbU8| {
            RgbU8::from_fn(SIZE.0, SIZE.1, |x, y| {
                if is_bus(x, y) { [block(x, y), 0, 255 - block(x, y)] } else { image.at(x, y) }
            })
        };
    let photos = set.views.iter().map(|v| photo(&v.image)).collect();
    (set, photos)
}

fn mask() -> PhotoMask {
    PhotoMask::from_fn(SIZE.0, SIZE.1, |x, y| if is_bus(x, y) { PhotoUse::Remove } else { PhotoUse::Free })
}

fn join(photos: &[RgbU8], mask: Option<&PhotoMask>) -> Result<PanoramaResult, PanoramaError> {
    let photos: Vec<_> = photos.iter().map(|p| PanoramaPhoto { mask, ..PanoramaPhoto::new(p.view()) }).collect();
    panorama(&photos, &PanoramaOptions::default(), &Silent)
}

/// Largest error of the alignment of neighbors, in pixels; infinite where a photograph is left out.
fn error(result: &PanoramaResult, set: &PanoramaViews) -> f64 {
    let views: Option<Vec<_>> = result.alignment.views.iter().map(|v| v.as_ref().ok()).collect();
    let Some(views) = views else { return f64::INFINITY };
    let pair = |i: usize| {
        let map = |p| views[i + 1].project(&views[i].ray(p)?);
        alignment_error(map, |p| set.transfer(i, i + 1, p), SIZE.0, SIZE.1).unwrap()
    };
    (0..views.len() - 1).map(pair).fold(0.0, f64::max)
}

fn features_on_the_bus(result: &PanoramaResult) -> usize {
    let positions = result.features.iter().flat_map(|features| features.keypoints.iter().map(|k| k.position));
    positions.filter(|p| is_bus(p.x.round() as usize, p.y.round() as usize)).count()
}

#[test]
fn what_is_removed_is_neither_matched_nor_shown() {
    let (set, photos) = photos();
    // Without masks the bus is matched with itself.
    if let Ok(result) = join(&photos, None) {
        println!("without masks: {} px", error(&result, &set));
        assert!(features_on_the_bus(&result) > 500 && error(&result, &set) > 20.0);
    }
    let result = join(&photos, Some(&mask())).unwrap();
    assert_eq!(features_on_the_bus(&result), 0);
    println!("with masks: {} px", error(&result, &set));
    // As without the bus; a third of the features is left, which align a view within half a pixel.
    assert!(error(&result, &set) < 0.5, "{}", error(&result, &set));
    let (w, h) = result.size;
    let mut shown = 0;
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).filter(|&(x, y)| result.mask.at(x, y)[0]) {
        let label = usize::from(result.labels.at(x, y)[0]);
        let Some(p) = result.map.source(label, Point2::new(x as f64, y as f64)) else { continue };
        shown += 1;
        // A hundredth of a pixel for the single precision of warping.
        let on = [(-0.01, 0.0), (0.01, 0.0), (0.0, -0.01), (0.0, 0.01)];
        assert!(on.iter().any(|(u, v)| !is_bus((p.x + u).round() as usize, (p.y + v).round() as usize)), "{x} {y} {p}");
    }
    assert!(shown > SIZE.0 * SIZE.1, "{shown}");
}

struct Loaded<'a>(&'a [RgbU8], &'a [Option<&'a PhotoMask>]);

impl PhotoSource<u8> for Loaded<'_> {
    fn size(&self, index: usize) -> (usize, usize) {
        self.0.get(index).map_or((0, 0), Image::size)
    }

    fn load(&self, index: usize) -> Option<Cow<'_, RgbU8>> {
        self.0.get(index).map(Cow::Borrowed)
    }

    fn mask(&self, index: usize) -> Option<&PhotoMask> {
        self.1.get(index).copied().flatten()
    }
}

struct Rows(Vec<u8>, Vec<u16>);

impl RowSink<u8> for Rows {
    fn begin(&mut self, _: &StreamedFrame) -> Result<(), NotWritten> {
        Ok(())
    }

    fn rows(&mut self, colors: ImageView<'_, u8, 3>, labels: ImageView<'_, u16, 1>) -> Result<(), NotWritten> {
        self.0.extend_from_slice(colors.to_image().as_slice());
        self.1.extend_from_slice(labels.to_image().as_slice());
        Ok(())
    }
}

#[test]
fn every_order_a_registration_and_a_stream_give_the_same_bytes() {
    let (_, photos) = photos();
    let mask = mask();
    let keep = PhotoMask::from_fn(SIZE.0, SIZE.1, |_, y| if y < 80 { PhotoUse::Keep } else { PhotoUse::Free });
    let masks = [Some(&mask), Some(&mask), Some(&keep), Some(&mask)];
    let options = PanoramaOptions::default();
    let joined = |order: [usize; 4]| {
        let photos: Vec<_> =
            order.iter().map(|&i| PanoramaPhoto { mask: masks[i], ..PanoramaPhoto::new(photos[i].view()) }).collect();
        panorama(&photos, &options, &Silent).unwrap()
    };
    let (first, other) = (joined([0, 1, 2, 3]), joined([3, 1, 0, 2]));
    assert!(first.image == other.image);
    let names = [3, 1, 0, 2];
    let renamed = other.labels.map(|[l]| [names.get(usize::from(l)).map_or(l, |i| *i)]);
    assert!(first.labels == renamed);

    let views: Vec<_> = photos.iter().map(RgbU8::view).collect();
    let registration = first.registration(&[]).unwrap();
    let again = panorama_with_masks(&registration, &views, &masks, &options.render, &Silent).unwrap();
    assert!(first.image == again.image && first.labels == again.labels);

    let source = Loaded(&photos, &masks);
    for registration in [None, Some(&registration)] {
        let mut rows = Rows(Vec::new(), Vec::new());
        let limit = MemoryLimit { bytes: 1 << 40, scratch: Box::new(std::io::Cursor::new(Vec::new())) };
        let priors = [PanoramaPrior::default(); 4];
        panorama_streamed(&source, &priors, registration, &options, limit, &mut rows, &Silent).unwrap();
        assert!(rows.0 == first.image.as_slice() && rows.1 == first.labels.as_slice());
    }
}

#[test]
fn a_mask_of_another_size_is_refused_by_the_number_of_its_photograph() {
    let (_, photos) = photos();
    let wrong = PhotoMask::from_fn(360, 480, |_, _| PhotoUse::Free);
    let given: Vec<_> = photos
        .iter()
        .enumerate()
        .map(|(i, p)| PanoramaPhoto { mask: (i == 3).then_some(&wrong), ..PanoramaPhoto::new(p.view()) })
        .collect();
    let expected = PanoramaError::Render(RenderError::WrongMask {
        index: 3,
        width: 360,
        height: 480,
        expected_width: 480,
        expected_height: 360,
    });
    assert_eq!(panorama(&given, &PanoramaOptions::default(), &Silent).err(), Some(expected));
}
