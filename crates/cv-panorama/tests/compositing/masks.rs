//! Panoramas of photographs with masks.

use crate::testing::{StopAt, deep_photograph, photograph, sky};
use cv_core::{Camera, Cancelled, Image, ImageView, Named, Point2, Progress, RgbU8, Silent, Vector3};
use cv_panorama::{
    Alignment, BlendMode, CameraMotion, CompositingOptions, MemoryLimit, NO_PHOTO, NotWritten, Panorama, PhotoMask,
    PhotoSample, PhotoSource, PhotoUse, RenderError, RowSink, Seams, StreamedFrame, View, render, render_masked,
    render_streamed,
};
use nalgebra::Rotation3;
use std::borrow::Cow;

const SIZE: (usize, usize) = (240, 180);
const MAGENTA: [f64; 3] = [230.0, 10.0, 230.0];

/// Three photographs at these yaws, 62 by 48 degrees: the first two overlap from −0.54 to 0.14, the last two from −0.14 to 0.54.
fn alignment() -> Alignment {
    let view = |yaw: f64| {
        let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
        Ok(View { camera: Camera::from_focal(SIZE.0, SIZE.1, 200.0), from_world: turn.into_inner() })
    };
    Alignment {
        views: [-0.4, 0.0, 0.4].map(view).to_vec(),
        reference: 1,
        motion: CameraMotion::Rotation,
        pairs: Vec::new(),
        rms_px: 0.0,
        median_px: 0.0,
    }
}

fn view(i: usize) -> View {
    alignment().views[i].unwrap()
}

fn yaw(ray: &Vector3<f64>) -> f64 {
    ray.x.atan2(ray.z)
}

/// A person: from one yaw to another, and 0.15 above and below the horizon.
fn is_person(ray: &Vector3<f64>, person: (f64, f64)) -> bool {
    is_inside(ray, person, 0.0)
}

/// Whether a direction is of a person and at least this far from the outline.
fn is_inside(ray: &Vector3<f64>, (from, to): (f64, f64), margin: f64) -> bool {
    (from + margin..to - margin).contains(&yaw(ray)) && (ray.y / ray.x.hypot(ray.z)).abs() < 0.15 - margin
}

/// Gray scene, in which the person is in one photograph, in this color.
fn photos(shows: usize, person: (f64, f64), color: [f64; 3]) -> Vec<RgbU8> {
    let scene = |i: usize, ray: &Vector3<f64>| {
        if i == shows && is_person(ray, person) { color } else { [sky(ray)[0] * (1.0 - 0.1 * i as f64); 3] }
    };
    (0..3).map(|i| photograph(&view(i), |ray| scene(i, ray))).collect()
}

/// The mask of a photograph by the direction of each pixel.
fn mask(i: usize, of: impl Fn(&Vector3<f64>) -> PhotoUse) -> PhotoMask {
    PhotoMask::from_fn(SIZE.0, SIZE.1, |x, y| of(&view(i).ray(Point2::new(x as f64, y as f64)).unwrap()))
}

/// The mask that removes the person.
fn without(i: usize, person: (f64, f64)) -> PhotoMask {
    mask(i, |ray| if is_person(ray, person) { PhotoUse::Remove } else { PhotoUse::Free })
}

fn draw(photos: &[RgbU8], masks: &[Option<&PhotoMask>], options: &CompositingOptions) -> Panorama {
    let views: Vec<_> = photos.iter().map(RgbU8::view).collect();
    render_masked(&views, masks, &alignment(), options, &Silent).unwrap()
}

fn places(panorama: &Panorama) -> impl Iterator<Item = (usize, usize)> + use<> {
    let (w, h) = panorama.size;
    (0..h).flat_map(move |y| (0..w).map(move |x| (x, y)))
}

/// How much redder and bluer than green a pixel is; near 0 in the scene, which is gray.
fn magenta([r, g, b]: [u8; 3]) -> i32 {
    i32::from(r.min(b)) - i32::from(g)
}

/// Pixels in which the person's color is visible: beyond a few levels of interpolation and gains per channel.
fn visible(panorama: &Panorama) -> usize {
    panorama.image.pixels().filter(|p| magenta([p[0], p[1], p[2]]) > 6).count()
}

/// Every blend mode with every seam.
fn modes() -> impl Iterator<Item = CompositingOptions> {
    let all = BlendMode::NAMES.iter().flat_map(|blend| Seams::NAMES.iter().map(move |seams| (blend.1, seams.1)));
    all.map(|(blend, seams)| CompositingOptions { blend, seams, ..CompositingOptions::default() })
}

#[test]
fn a_removed_person_is_nowhere_and_nothing_of_it_has_an_effect() {
    let person = (-0.22, -0.02);
    let (shown, other) = (photos(1, person, MAGENTA), photos(1, person, [0.0, 255.0, 90.0]));
    let mask = without(1, person);
    for options in modes() {
        let options = CompositingOptions { radiance: true, ..options };
        let before = draw(&shown, &[], &options);
        // 0.2 by 0.3 radians of 200 pixels each, less what a seam cuts off.
        assert!(visible(&before) > 1000, "{options:?}: {}", visible(&before));
        let after = draw(&shown, &[None, Some(&mask)], &options);
        assert_eq!(visible(&after), 0, "{options:?}");
        // The first photograph shows all of the place.
        assert_eq!(after.mask, before.mask, "{options:?}");
        let is_hidden =
            |(x, y): &(usize, usize)| is_inside(&after.canvas.ray(Point2::new(*x as f64, *y as f64)), person, 0.01);
        let hidden: Vec<_> = places(&after).filter(is_hidden).collect();
        assert!(hidden.len() > 1500 && hidden.iter().all(|&(x, y)| after.labels.at(x, y)[0] != 1), "{options:?}");
        // Whatever the person looks like.
        let again = draw(&other, &[None, Some(&mask)], &options);
        assert!(again.image == after.image && again.labels == after.labels, "{options:?}");
        assert!(again.gains == after.gains && again.radiance == after.radiance, "{options:?}");
    }
}

#[test]
fn a_kept_person_is_whole() {
    // Nearer to the center of the first photograph.
    let person = (-0.38, -0.22);
    let shown = photos(1, person, MAGENTA);
    // Painted generously, as by hand: 16 pixels around.
    let around = |ray: &Vector3<f64>| is_inside(ray, person, -0.08);
    let mask = mask(1, |ray| if around(ray) { PhotoUse::Keep } else { PhotoUse::Free });
    for options in modes() {
        let before = draw(&shown, &[], &options);
        let after = draw(&shown, &[None, Some(&mask)], &options);
        assert_eq!((after.size, &after.mask), (before.size, &before.mask));
        let (mut pixels, mut missing) = (0, 0);
        for (x, y) in places(&after) {
            let ray = after.canvas.ray(Point2::new(x as f64, y as f64));
            // The outline is smoothed by interpolation and by the bands.
            if is_inside(&ray, person, 0.015) {
                pixels += 1;
                missing += usize::from(before.labels.at(x, y)[0] != 1);
                // 220 levels in the photograph, fewer after gains and the bands of a seam 16 pixels off.
                let shows = magenta(after.image.at(x, y));
                assert!(after.labels.at(x, y)[0] == 1 && shows > 150, "{options:?} {x} {y}: {shows}");
            }
        }
        assert!(pixels > 1200, "{pixels}");
        assert!(options.seams != Seams::Voronoi || missing > 800, "{options:?}: {missing}");
    }
}

#[test]
fn a_place_that_no_other_photograph_reaches_is_empty() {
    let person = (0.65, 0.8);
    let shown = photos(2, person, MAGENTA);
    let mask = without(2, person);
    for options in modes() {
        let after = draw(&shown, &[None, None, Some(&mask)], &options);
        let mut empty = 0;
        for (x, y) in places(&after) {
            let ray = after.canvas.ray(Point2::new(x as f64, y as f64));
            // Half a pixel of 1/200 at the border of the mask.
            if is_inside(&ray, person, 0.005) {
                empty += 1;
                assert_eq!((after.labels.at(x, y), after.mask.at(x, y)), ([NO_PHOTO], [false]), "{options:?} {x} {y}");
                assert_eq!(after.image.at(x, y), [0; 3]);
            }
        }
        assert!(empty > 1000, "{empty}");
        assert_eq!(visible(&after), 0);
    }
}

#[test]
fn where_two_photographs_are_kept_the_nearer_center_wins() {
    let shown = photos(1, (-0.38, -0.22), MAGENTA);
    let all = mask(0, |_| PhotoUse::Keep);
    for options in modes() {
        let options = CompositingOptions { elastic: false, ..options };
        let after = draw(&shown, &[Some(&all), Some(&all)], &options);
        let mut decided = [0; 3];
        for (x, y) in places(&after).filter(|&(x, y)| after.mask.at(x, y)[0]) {
            let ray = after.canvas.ray(Point2::new(x as f64, y as f64));
            // Distance from the center, 1 at the border.
            let far = [0, 1].map(|i| {
                view(i).project(&ray).map_or(9.0, |p| ((p.x - 119.5) / 120.0).abs().max(((p.y - 89.5) / 90.0).abs()))
            });
            let label = usize::from(after.labels.at(x, y)[0]);
            decided[label] += 1;
            // Positions are in single precision; at the borders of photographs by half a pixel of 90.
            if far[0].min(far[1]) < 0.99 && (far[0] - far[1]).abs() > 1e-3 {
                assert_eq!(label, usize::from(far[1] < far[0]), "{options:?} {x} {y} {far:?}");
            } else if far[0].min(far[1]) > 1.01 {
                assert_eq!(label, 2, "{options:?} {x} {y} {far:?}");
            }
        }
        assert!(decided.iter().all(|n| *n > 5000), "{decided:?}");
    }
}

#[test]
fn local_alignment_bends_nothing_beside_what_is_removed() {
    // Steps of 12 pixels, drawn a little fainter in each photograph.
    let steps = |i: usize, ray: &Vector3<f64>| {
        let up = ray.y / ray.x.hypot(ray.z);
        [(120.0 + 60.0 * (up * 200.0 * std::f64::consts::TAU / 12.0).sin()) * (1.0 - 0.1 * i as f64); 3]
    };
    let shown: Vec<_> = (0..3).map(|i| photograph(&view(i), |ray| steps(i, ray))).collect();
    let (first, second) = (without(0, (-0.3, -0.2)), without(1, (-0.18, -0.06)));
    let after = draw(&shown, &[Some(&first), Some(&second)], &CompositingOptions::default());
    let mut worst = 0.0_f64;
    for (x, y) in places(&after).filter(|&(x, y)| after.mask.at(x, y)[0]) {
        let (p, label) = (Point2::new(x as f64, y as f64), usize::from(after.labels.at(x, y)[0]));
        let truth = view(label).project(&after.canvas.ray(p)).unwrap();
        worst = worst.max(after.map.source(label, p).map_or(0.0, |source| (source - truth).norm()));
    }
    // The views are exact, and of noiseless waves patches are registered within some hundredths. Those that mix steps and the fill were 0.6 px off.
    assert!(worst < 0.05, "{worst}");
}

#[test]
fn masks_that_say_nothing_change_nothing() {
    let shown = photos(1, (-0.22, -0.02), MAGENTA);
    let views: Vec<_> = shown.iter().map(RgbU8::view).collect();
    let free = mask(0, |_| PhotoUse::Free);
    for options in modes() {
        let plain = render(&views, &alignment(), &options, &Silent).unwrap();
        let masked = draw(&shown, &[Some(&free), None, Some(&free)], &options);
        assert!(plain.image == masked.image && plain.labels == masked.labels && plain.gains == masked.gains);
    }
}

/// Photographs with masks, and the rows of a panorama.
struct Loaded<'a, T>(&'a [Image<T, 3>], &'a [Option<PhotoMask>]);

impl<T: PhotoSample> PhotoSource<T> for Loaded<'_, T> {
    fn size(&self, index: usize) -> (usize, usize) {
        self.0.get(index).map_or((0, 0), Image::size)
    }

    fn load(&self, index: usize) -> Option<Cow<'_, Image<T, 3>>> {
        self.0.get(index).map(Cow::Borrowed)
    }

    fn mask(&self, index: usize) -> Option<&PhotoMask> {
        self.1.get(index)?.as_ref()
    }
}

struct Rows<T>(Vec<T>, Vec<u16>);

impl<T: PhotoSample> RowSink<T> for Rows<T> {
    fn begin(&mut self, _: &StreamedFrame) -> Result<(), NotWritten> {
        Ok(())
    }

    fn rows(&mut self, colors: ImageView<'_, T, 3>, labels: ImageView<'_, u16, 1>) -> Result<(), NotWritten> {
        self.0.extend_from_slice(colors.to_image().as_slice());
        self.1.extend_from_slice(labels.to_image().as_slice());
        Ok(())
    }
}

fn streamed<T: PhotoSample>(
    photos: &Loaded<'_, T>,
    options: &CompositingOptions,
    progress: &dyn Progress,
) -> Result<Rows<T>, RenderError> {
    let mut rows = Rows(Vec::new(), Vec::new());
    let limit = MemoryLimit { bytes: 1 << 40, scratch: Box::new(std::io::Cursor::new(Vec::new())) };
    render_streamed(photos, &alignment(), options, limit, &mut rows, progress)?;
    Ok(rows)
}

/// The person removed from the second photograph, and something of the first and the third kept.
fn masks() -> Vec<Option<PhotoMask>> {
    let keep = |i: usize, from: f64, to: f64| {
        mask(i, move |ray| if is_person(ray, (from, to)) { PhotoUse::Keep } else { PhotoUse::Free })
    };
    vec![Some(keep(0, -0.1, 0.05)), Some(without(1, (-0.22, -0.02))), Some(keep(2, -0.1, 0.1))]
}

#[test]
fn streamed_panoramas_have_the_same_bytes() {
    fn compare<T: PhotoSample>(photos: &[Image<T, 3>], options: &CompositingOptions) {
        let masks = masks();
        let views: Vec<_> = photos.iter().map(Image::view).collect();
        let given: Vec<_> = masks.iter().map(Option::as_ref).collect();
        let whole = render_masked(&views, &given, &alignment(), options, &Silent).unwrap();
        let rows = streamed(&Loaded(photos, &masks), options, &Silent).unwrap();
        assert!(rows.1 == whole.labels.as_slice(), "{options:?}");
        assert!(rows.0 == whole.image.as_slice(), "{options:?}");
    }
    let shown = photos(1, (-0.22, -0.02), MAGENTA);
    for options in modes() {
        compare(&shown, &options);
        // A preview pixel is some canvas pixels there, and photographs are resized.
        compare(&shown, &CompositingOptions { resolution: 3.0, crop: true, ..options });
        compare(&shown, &CompositingOptions { resolution: 0.4, ..options });
    }
    let deep: Vec<_> = (0..3).map(|i| deep_photograph(&view(i), sky)).collect();
    compare(&deep, &CompositingOptions { resolution: 2.0, ..CompositingOptions::default() });
}

/// At the scales of the previous test too, and with many canvas pixels to a pixel of the preview, where seams are refined by blocks.
#[test]
fn removed_and_kept_parts_are_exact_at_any_resolution() {
    let shown = photos(1, (-0.22, -0.02), MAGENTA);
    let masks = masks();
    let given: Vec<_> = masks.iter().map(Option::as_ref).collect();
    for resolution in [0.4, 3.0, 9.0] {
        for seams in [Seams::GraphCut, Seams::Voronoi] {
            let options =
                CompositingOptions { resolution, seams, blend: BlendMode::None, ..CompositingOptions::default() };
            let after = draw(&shown, &given, &options);
            assert_eq!(visible(&after), 0, "{resolution} {seams:?}");
            let pixel = 0.01 / resolution;
            for (x, y) in places(&after) {
                let ray = after.canvas.ray(Point2::new(x as f64, y as f64));
                let label = after.labels.at(x, y)[0];
                assert!(label != 1 || !is_inside(&ray, (-0.22, -0.02), pixel), "{resolution} {seams:?} {x} {y}");
                // The first and the third photograph are kept there.
                let is_kept = is_inside(&ray, (-0.1, 0.1), pixel);
                assert!(!is_kept || label == 0 || label == 2, "{resolution} {seams:?} {x} {y} {label}");
            }
        }
    }
}

#[test]
fn masks_of_other_sizes_are_refused() {
    let shown = photos(1, (-0.22, -0.02), MAGENTA);
    let views: Vec<_> = shown.iter().map(RgbU8::view).collect();
    let small = PhotoMask::from_fn(180, 240, |_, _| PhotoUse::Free);
    let go = |masks: &[Option<&PhotoMask>]| {
        render_masked(&views, masks, &alignment(), &CompositingOptions::default(), &Silent).unwrap_err()
    };
    let expected = |index: usize, expected_width: usize, expected_height: usize| RenderError::WrongMask {
        index,
        width: 180,
        height: 240,
        expected_width,
        expected_height,
    };
    assert_eq!(go(&[None, Some(&small)]), expected(1, 240, 180));
    assert_eq!(go(&[None, None, None, Some(&small)]), expected(3, 0, 0));
    let masks = [None, None, Some(small.clone())];
    let error = streamed(&Loaded(&shown, &masks), &CompositingOptions::default(), &Silent).err();
    assert_eq!(error, Some(expected(2, 240, 180)));
}

#[test]
fn a_photograph_that_is_removed_altogether_leaves_the_others() {
    let shown = photos(1, (-0.22, -0.02), MAGENTA);
    let none = mask(1, |_| PhotoUse::Remove);
    for options in modes() {
        let after = draw(&shown, &[None, Some(&none)], &options);
        assert!(after.labels.as_slice().iter().all(|label| *label != 1) && visible(&after) == 0, "{options:?}");
        let all = draw(&shown, &[Some(&none), Some(&none), Some(&none)], &options);
        assert!(all.mask.as_slice().iter().all(|inside| !inside) && all.image.as_slice().iter().all(|v| *v == 0));
    }
}

#[test]
fn threads_change_nothing_and_every_stage_can_be_stopped() {
    let shown = photos(1, (-0.22, -0.02), MAGENTA);
    let views: Vec<_> = shown.iter().map(RgbU8::view).collect();
    let masks = masks();
    let given: Vec<_> = masks.iter().map(Option::as_ref).collect();
    let options = CompositingOptions::default();
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| draw(&shown, &given, &options))
    };
    let (one, three) = (with(1), with(3));
    assert!(one.image == three.image && one.labels == three.labels);
    for stage in ["elastic", "preview", "warp"] {
        let watched = StopAt::of_stage(stage, usize::MAX);
        render_masked(&views, &given, &alignment(), &options, &watched).unwrap();
        for at in [1, 2, watched.reports() / 2, watched.reports()] {
            let stop = StopAt::of_stage(stage, at);
            let stopped = render_masked(&views, &given, &alignment(), &options, &stop);
            assert_eq!(stopped.err(), Some(RenderError::Cancelled(Cancelled)), "{stage} {at}");
        }
    }
}
