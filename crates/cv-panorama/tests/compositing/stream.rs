//! Panoramas made in strips of rows are those made in memory.

use crate::testing::{StopAt, deep_photograph, photograph, sky};
use cv_core::{Camera, Cancelled, Image, ImageView, Progress, Vector3};
use cv_panorama::{
    Alignment, BlendMode, CameraMotion, CompositingOptions, Exposure, Layer, MemoryLimit, NO_PHOTO, NotWritten,
    PhotoSample, PhotoSource, RenderError, RowSink, ScratchFile, Seams, StreamError, StreamedFrame, View, render,
    render_streamed,
};
use nalgebra::Rotation3;
use std::borrow::Cow;

/// Photographs of the sky with different exposures, 240 × 180 at a focal length of 200, in two rows.
fn alignment() -> Alignment {
    let turns = [(-0.5, 0.1), (0.0, -0.1), (0.45, 0.0), (-0.1, 0.45), (0.5, 0.5)];
    let views = turns.map(|(yaw, pitch)| {
        let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), -pitch)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
        Ok(View { camera: Camera::from_focal(240, 180, 200.0), from_world: turn.into_inner() })
    });
    Alignment {
        views: views.to_vec(),
        reference: 1,
        motion: CameraMotion::Rotation,
        pairs: Vec::new(),
        rms_px: 0.0,
        median_px: 0.0,
    }
}

fn scene(i: usize) -> impl Fn(&Vector3<f64>) -> [f64; 3] {
    // A bar that each photograph sees elsewhere, so that seams have something to avoid.
    move |ray| {
        let bar = (ray.x / ray.z - 0.02 * i as f64).abs() < 0.01;
        sky(ray).map(|v| if bar { 250.0 } else { v * (1.0 - 0.05 * i as f64) })
    }
}

struct Loaded<T>(Vec<Image<T, 3>>);

impl<T: PhotoSample> PhotoSource<T> for Loaded<T> {
    fn size(&self, index: usize) -> (usize, usize) {
        self.0.get(index).map_or((0, 0), Image::size)
    }

    fn load(&self, index: usize) -> Option<Cow<'_, Image<T, 3>>> {
        self.0.get(index).map(Cow::Borrowed)
    }
}

/// Collects the rows, or fails at a row.
struct Collected<T> {
    size: (usize, usize),
    colors: Vec<T>,
    labels: Vec<u16>,
    strips: usize,
    fails_at: usize,
    layers: Option<Vec<Layer<T>>>,
}

impl<T> Collected<T> {
    fn failing_at(row: usize) -> Self {
        Self { size: (0, 0), colors: Vec::new(), labels: Vec::new(), strips: 0, fails_at: row, layers: None }
    }
}

impl<T: PhotoSample> RowSink<T> for Collected<T> {
    fn begin(&mut self, frame: &StreamedFrame) -> Result<(), NotWritten> {
        assert_eq!((frame.reference, &frame.photos[..]), (1, &[0, 1, 2, 3, 4][..]));
        self.size = frame.size;
        Ok(())
    }

    fn wants_layers(&self) -> bool {
        self.layers.is_some()
    }

    fn layer(&mut self, layer: Layer<T>) -> Result<(), NotWritten> {
        self.layers.get_or_insert_default().push(layer);
        Ok(())
    }

    fn rows(&mut self, colors: ImageView<'_, T, 3>, labels: ImageView<'_, u16, 1>) -> Result<(), NotWritten> {
        for y in 0..colors.height() {
            self.colors.extend_from_slice(colors.row(y));
            self.labels.extend_from_slice(labels.row(y));
        }
        self.strips += 1;
        if self.labels.len() > self.fails_at.saturating_mul(self.size.0) { Err(NotWritten) } else { Ok(()) }
    }
}

fn scratch() -> Box<dyn ScratchFile> {
    Box::new(std::io::Cursor::new(Vec::new()))
}

/// The smallest limit with which the panorama is made.
fn smallest<T: PhotoSample>(photos: &Loaded<T>, options: &CompositingOptions) -> usize {
    let limit = MemoryLimit { bytes: 1, scratch: scratch() };
    let mut rows = Collected::failing_at(usize::MAX);
    match render_streamed(photos, &alignment(), options, limit, &mut rows, &cv_core::Silent).map(|made| made.size) {
        Err(RenderError::Stream(StreamError::Memory { needed, allowed: 1, .. })) => needed,
        other => panic!("{other:?}"),
    }
}

/// The same pixels, labels and geometry as in memory, in several strips.
fn compare<T: PhotoSample>(photos: Loaded<T>, options: &CompositingOptions, strips: usize) {
    let alignment = alignment();
    let views: Vec<_> = photos.0.iter().map(Image::view).collect();
    let whole = render(&views, &alignment, options, &cv_core::Silent).unwrap();
    for bytes in [smallest(&photos, options), usize::MAX >> 8] {
        let mut rows = Collected::failing_at(usize::MAX);
        let limit = MemoryLimit { bytes, scratch: scratch() };
        let streamed = render_streamed(&photos, &alignment, options, limit, &mut rows, &cv_core::Silent).unwrap();
        assert_eq!((rows.size, streamed.size), (whole.size, whole.size), "{options:?}");
        assert!(rows.labels == whole.labels.as_slice(), "{options:?} {bytes}");
        assert!(rows.colors == whole.image.as_slice(), "{options:?} {bytes}");
        assert_eq!((streamed.canvas, streamed.gains), (whole.canvas, whole.gains.clone()));
        assert!(bytes > 1 << 40 || rows.strips >= strips, "{} strips", rows.strips);
    }
}

fn photos() -> Loaded<u8> {
    let views = alignment().views.into_iter().map(Result::unwrap);
    Loaded(views.enumerate().map(|(i, view)| photograph(&view, scene(i))).collect())
}

#[test]
fn strips_are_the_same_as_the_whole() {
    for blend in [BlendMode::Multiband, BlendMode::Feather, BlendMode::None] {
        for (crop, seams) in [(true, Seams::GraphCut), (false, Seams::Voronoi)] {
            let options = CompositingOptions { blend, crop, seams, resolution: 4.0, ..CompositingOptions::default() };
            compare(photos(), &options, 2);
        }
    }
}

#[test]
fn sixteen_bits_and_reduced_resolution_are_the_same_as_the_whole() {
    let views = alignment().views.into_iter().map(Result::unwrap);
    let deep: Vec<_> = views.enumerate().map(|(i, view)| deep_photograph(&view, scene(i))).collect();
    let options = CompositingOptions { resolution: 3.0, ..CompositingOptions::default() };
    compare(Loaded(deep.clone()), &options, 2);
    compare(Loaded(deep), &CompositingOptions { resolution: 0.4, ..options }, 1);
}

#[test]
fn locally_adapted_panoramas_are_the_same_as_the_whole() {
    // Levels by 0.7 from one to the next: about a stop.
    let dark = |i: usize| move |ray: &Vector3<f64>| scene(i)(ray).map(|v| v * 0.7_f64.powi(i as i32));
    let views: Vec<View> = alignment().views.into_iter().map(Result::unwrap).collect();
    let bytes: Vec<_> = views.iter().enumerate().map(|(i, view)| photograph(view, dark(i))).collect();
    let deep: Vec<_> = views.iter().enumerate().map(|(i, view)| deep_photograph(view, dark(i))).collect();
    for resolution in [3.0, 0.4] {
        let options = CompositingOptions { resolution, exposure: Exposure::Adapt, ..CompositingOptions::default() };
        let strips = if resolution > 1.0 { 2 } else { 1 };
        compare(Loaded(bytes.clone()), &options, strips);
        compare(Loaded(deep.clone()), &options, strips);
        // It is not the other method's.
        let photos: Vec<_> = bytes.iter().map(Image::view).collect();
        let matched = CompositingOptions { exposure: Exposure::Match, ..options };
        let [a, b] = [options, matched].map(|o| render(&photos, &alignment(), &o, &cv_core::Silent).unwrap().image);
        assert!(a != b);
    }
}

/// A preview pixel is more than four canvas pixels there: seams are refined by blocks first.
#[test]
fn seams_of_large_canvases_are_the_same_as_the_whole() {
    let options = CompositingOptions {
        resolution: 11.0,
        blend: BlendMode::None,
        exposure: Exposure::None,
        ..CompositingOptions::default()
    };
    compare(photos(), &options, 2);
}

#[test]
fn what_needs_the_whole_canvas_says_so_or_is_made_whole() {
    let (photos, alignment) = (photos(), alignment());
    for (options, expected) in [
        (CompositingOptions { blend: BlendMode::Poisson, ..CompositingOptions::default() }, "poisson blending"),
        (CompositingOptions { radiance: true, ..CompositingOptions::default() }, "radiance"),
    ] {
        let go = |bytes: usize| {
            let mut rows = Collected::failing_at(usize::MAX);
            let limit = MemoryLimit { bytes, scratch: scratch() };
            render_streamed(&photos, &alignment, &options, limit, &mut rows, &cv_core::Silent).map(|p| (p, rows))
        };
        let needed = match go(1 << 20).map(|(panorama, _)| panorama.size) {
            Err(RenderError::Stream(StreamError::Whole { what, needed, .. })) if what == expected => needed,
            other => panic!("{other:?}"),
        };
        let (panorama, rows) = go(needed).unwrap();
        let views: Vec<_> = photos.0.iter().map(Image::view).collect();
        let whole = render(&views, &alignment, &options, &cv_core::Silent).unwrap();
        assert!(rows.colors == whole.image.as_slice() && panorama.radiance == whole.radiance, "{expected}");
    }
}

#[test]
fn failures_of_source_and_sink_end_the_work() {
    struct Unreadable(Loaded<u8>);
    impl PhotoSource<u8> for Unreadable {
        fn size(&self, index: usize) -> (usize, usize) {
            self.0.size(index)
        }
        fn load(&self, index: usize) -> Option<Cow<'_, Image<u8, 3>>> {
            self.0.load(index).filter(|_| index != 3)
        }
    }
    let options = CompositingOptions::default();
    let go = |photos: &dyn PhotoSource<u8>, row: usize, progress: &dyn Progress| {
        let limit = MemoryLimit { bytes: 1 << 40, scratch: scratch() };
        let mut rows = Collected::failing_at(row);
        render_streamed(photos, &alignment(), &options, limit, &mut rows, progress).map(|panorama| panorama.size)
    };
    let error = go(&Unreadable(photos()), usize::MAX, &cv_core::Silent);
    assert_eq!(error, Err(StreamError::Photograph { index: 3 }.into()));
    assert_eq!(go(&photos(), 10, &cv_core::Silent), Err(StreamError::NotWritten.into()));
    for stage in ["elastic", "preview", "exposure", "seams", "warp", "blend"] {
        let watched = StopAt::of_stage(stage, usize::MAX);
        go(&photos(), usize::MAX, &watched).unwrap();
        assert!(watched.reports() >= 3, "{stage}: {}", watched.reports());
        for at in [1, watched.reports() / 2, watched.reports()] {
            let stop = StopAt::of_stage(stage, at);
            assert_eq!(go(&photos(), usize::MAX, &stop), Err(RenderError::Cancelled(Cancelled)), "{stage} {at}");
        }
    }
}

#[test]
fn layers_put_together_by_their_masks_are_the_panorama_without_blending() {
    let photos = photos();
    for crop in [false, true] {
        let options = CompositingOptions { blend: BlendMode::None, crop, ..CompositingOptions::default() };
        let limit = MemoryLimit { bytes: 1 << 40, scratch: scratch() };
        let mut rows = Collected { layers: Some(Vec::new()), ..Collected::failing_at(usize::MAX) };
        render_streamed(&photos, &alignment(), &options, limit, &mut rows, &cv_core::Silent).unwrap();
        let mut colors = vec![0; rows.colors.len()];
        let mut labels = vec![NO_PHOTO; rows.labels.len()];
        for layer in rows.layers.iter().flatten() {
            let b = layer.bounds;
            for (x, y) in (b.top..b.bottom).flat_map(|y| (b.left..b.right).map(move |x| (x, y))) {
                let [r, g, b, mask] = layer.pixels.at(x - b.left, y - b.top);
                if mask > 0 {
                    let i = y * rows.size.0 + x;
                    // No two masks overlap.
                    assert_eq!((mask, labels[i]), (255, NO_PHOTO));
                    labels[i] = layer.photo as u16;
                    colors[3 * i..][..3].copy_from_slice(&[r, g, b]);
                }
            }
        }
        assert!(labels == rows.labels && colors == rows.colors, "{crop}");
    }
}

#[test]
fn a_layer_has_the_colors_of_the_whole_photograph() {
    let options = CompositingOptions { resolution: 2.0, elastic: false, ..CompositingOptions::default() };
    let limit = MemoryLimit { bytes: 1 << 40, scratch: scratch() };
    let mut rows = Collected { layers: Some(Vec::new()), ..Collected::failing_at(usize::MAX) };
    let made = render_streamed(&photos(), &alignment(), &options, limit, &mut rows, &cv_core::Silent).unwrap();
    let layers = rows.layers.unwrap();
    assert_eq!(layers.iter().map(|layer| layer.photo).collect::<Vec<_>>(), [0, 1, 2, 3, 4]);
    let pixels = (0..rows.size.1).flat_map(|y| (0..rows.size.0).map(move |x| (x, y)));
    for ((x, y), layer) in pixels.flat_map(|pixel| layers.iter().map(move |layer| (pixel, layer))) {
        let b = layer.bounds;
        let shows = b.contains(x, y) && layer.pixels.at(x - b.left, y - b.top)[..3] != [0; 3];
        let source =
            |dx: f64, dy: f64| made.map.source(layer.photo, cv_core::Point2::new(x as f64 + dx, y as f64 + dy));
        // The scene is black nowhere. Half a pixel of the photograph beyond the centers of its outer pixels is covered, too: about one of
        // the panorama.
        let is_inside = source(0.0, 0.0).is_some();
        let is_near = || [-2.0, 0.0, 2.0].iter().any(|dy| [-2.0, 0.0, 2.0].iter().any(|dx| source(*dx, *dy).is_some()));
        assert!(if is_inside { shows } else { !shows || is_near() }, "{x} {y} of {}", layer.photo);
    }
}
