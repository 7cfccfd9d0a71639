//! Panoramas of photographs of a known scene.

use crate::testing::{StopAt, deep_photograph, photograph, sky};
use cv_core::{
    Camera, Cancelled, Image, ImageView, Matrix3, Named, OptionError, Point2, Progress, RgbU8, Silent, Vector3,
};
use cv_panorama::{
    Alignment, BlendMode, Blender, CameraMotion, CompositingOptions, Composition, Exposure, Framing, LayoutError,
    NO_PHOTO, Panorama, PhotoSample, Projection, RenderError, View, render, render_with,
};
use nalgebra::Rotation3;
use std::f64::consts::TAU;

/// Photographs of the sky, turned by these yaws, 240 × 180 at a focal length of 200: 62 by 48 degrees.
struct Set {
    photos: Vec<RgbU8>,
    alignment: Alignment,
}

impl Set {
    fn new(yaws: &[f64]) -> Self {
        Self::turned(&yaws.iter().map(|yaw| (*yaw, 0.0)).collect::<Vec<_>>())
    }

    /// Turned by these yaws, and up by these pitches.
    fn turned(turns: &[(f64, f64)]) -> Self {
        let views: Vec<View> = turns
            .iter()
            .map(|(yaw, pitch)| View {
                camera: Camera::from_focal(240, 180, 200.0),
                from_world: (Rotation3::from_axis_angle(&Vector3::x_axis(), -pitch)
                    * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw))
                .into_inner(),
            })
            .collect();
        let photos = views.iter().map(|v| photograph(v, sky)).collect();
        let alignment = Alignment {
            views: views.into_iter().map(Ok).collect(),
            reference: 0,
            motion: CameraMotion::Rotation,
            pairs: Vec::new(),
            rms_px: 0.0,
            median_px: 0.0,
        };
        Self { photos, alignment }
    }

    fn three() -> Self {
        Self::new(&[-0.5, 0.0, 0.45])
    }

    fn views(&self) -> Vec<ImageView<'_, u8, 3>> {
        self.photos.iter().map(RgbU8::view).collect()
    }

    fn render(&self, options: &CompositingOptions) -> Panorama {
        render(&self.views(), &self.alignment, options, &Silent).unwrap()
    }
}

/// Mean absolute difference in gray levels between a panorama and what its canvas says each pixel shows, and the number of pixels.
fn error(panorama: &Panorama) -> (f64, usize) {
    let (w, h) = panorama.image.size();
    let (mut sum, mut n) = (0.0, 0);
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).filter(|&(x, y)| panorama.mask.at(x, y)[0]) {
        let truth = sky(&panorama.canvas.ray(Point2::new(x as f64, y as f64)));
        let off = panorama.image.at(x, y).into_iter().zip(truth).map(|(a, b)| (f64::from(a) - b).abs());
        sum += off.sum::<f64>() / 3.0;
        n += 1;
    }
    (sum / n as f64, n)
}

/// Mean level of what the pixels of a panorama should show.
fn mean_of_sky(panorama: &Panorama) -> f64 {
    let (w, h) = panorama.image.size();
    let seen = (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).filter(|&(x, y)| panorama.mask.at(x, y)[0]);
    let levels: Vec<f64> = seen.flat_map(|(x, y)| sky(&panorama.canvas.ray(Point2::new(x as f64, y as f64)))).collect();
    levels.iter().sum::<f64>() / levels.len() as f64
}

/// Without exposure compensation and local alignment, of which there is nothing to do.
fn plain() -> CompositingOptions {
    CompositingOptions { exposure: Exposure::None, elastic: false, ..CompositingOptions::default() }
}

#[test]
fn on_every_surface_every_pixel_shows_what_lies_in_its_direction() {
    let set = Set::three();
    for projection in Projection::NAMES.iter().map(|(_, p)| *p).filter(|p| *p != Projection::Auto) {
        for &(_, blend) in BlendMode::NAMES {
            let panorama = set.render(&CompositingOptions { projection, blend, ..plain() });
            let (error, pixels) = error(&panorama);
            // Rounding twice leaves 0.35 levels on average; cubic interpolation of waves of 21 px and longer less than that.
            assert!(error < 0.8, "{projection:?} {blend:?}: {error}");
            assert!(pixels > 60_000, "{pixels}");
            assert_eq!(panorama.canvas.projection, projection);
        }
    }
}

#[test]
fn defaults_change_nothing_where_nothing_is_to_be_done() {
    let set = Set::three();
    let panorama = set.render(&CompositingOptions::default());
    // The canvas is brighter than every photograph, since overlaps count once; its mean is reduced to a level below that of the brightest.
    let mean =
        |image: &RgbU8| image.as_slice().iter().map(|v| f64::from(*v)).sum::<f64>() / image.as_slice().len() as f64;
    let shown = mean_of_sky(&panorama);
    let reduced = shown + 1.0 - set.photos.iter().map(mean).fold(0.0, f64::max);
    assert!((1.0..3.0).contains(&reduced), "{reduced}");
    let (error, _) = error(&panorama);
    // Otherwise gains and displacements of noise only: a part in a thousand, a tenth of a pixel on slopes of ten levels.
    assert!(error < 1.0 + reduced, "{error} {reduced}");
}

#[test]
fn labels_mask_and_map_agree() {
    let set = Set::three();
    let panorama = set.render(&plain());
    let (w, h) = panorama.image.size();
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
        let label = panorama.labels.at(x, y)[0];
        assert_eq!(panorama.mask.at(x, y)[0], label != NO_PHOTO);
        let p = Point2::new(x as f64, y as f64);
        match label {
            NO_PHOTO => {
                assert_eq!(panorama.image.at(x, y), [0; 3]);
                assert!((0..3).all(|photo| panorama.map.source(photo, p).is_none()), "{x} {y}");
            }
            label => {
                // The warp takes in the outer half of the border pixels, the map does not.
                let source = panorama.map.source(usize::from(label), p);
                let view = set.alignment.views[usize::from(label)].unwrap();
                let seen = view.project(&panorama.canvas.ray(p)).unwrap();
                assert!(source.is_none_or(|s| (s - seen).norm() < 1e-6));
                assert!(seen.x > -0.51 && seen.y > -0.51 && seen.x < 239.51 && seen.y < 179.51, "{x} {y} {seen}");
            }
        }
    }
}

#[test]
fn cropping_leaves_no_empty_pixel_and_moves_canvas_and_map_along() {
    let set = Set::three();
    let (whole, cut) = (set.render(&plain()), set.render(&CompositingOptions { crop: true, ..plain() }));
    assert!(cut.mask.as_slice().iter().all(|m| *m) && cut.image.width() > 300);
    assert!(error(&cut).0 < 0.8);
    let moved = cut.canvas.origin - whole.canvas.origin;
    let (p, q) = (Point2::new(200.0, 60.0), Point2::new(200.0, 60.0) + moved);
    assert_eq!(cut.map.source(1, p), whole.map.source(1, q));
    assert_eq!(cut.image.at(200, 60), whole.image.at(q.x as usize, q.y as usize));
}

#[test]
fn an_object_displaced_by_parallax_continues_across_the_seam() {
    let mut set = Set::turned(&[(0.0, 0.25), (0.0, -0.25)]);
    // A pole before the sky, upright through both photographs, 20 px wide; in the second the camera has moved to the side: by 7 px for the
    // pole, and on the canvas by 14, twice as far as patches are searched for before there are seams.
    let (red, blue) = (250.0, 10.0);
    for (k, view) in set.alignment.views.iter().enumerate() {
        let left = if k == 0 { -0.05 } else { -0.015 };
        set.photos[k] = photograph(&view.unwrap(), |ray| {
            let (across, up) = (ray.x.atan2(ray.z) - left, ray.y / ray.x.hypot(ray.z));
            // Texture that does not repeat.
            let mark = (130.0 * up).sin() + (77.0 * up + 50.0 * across).sin() + (201.0 * up - 90.0 * across).sin();
            if (0.0..0.1).contains(&across) { [red, 100.0 + 30.0 * mark, blue] } else { sky(ray) }
        });
    }
    // Greatest step of the contours of the pole from row to row.
    let step = |elastic: bool| {
        let panorama = set.render(&CompositingOptions { resolution: 2.0, elastic, blend: BlendMode::None, ..plain() });
        let (w, h) = panorama.image.size();
        let is_pole = |x: usize, y: usize| {
            let [r, _, b] = panorama.image.at(x, y).map(f64::from);
            r > 0.5 * (red + 210.0) && b < 0.5 * (blue + 30.0)
        };
        let contours = |y: usize| {
            let columns: Vec<usize> = (0..w).filter(|x| is_pole(*x, y)).collect();
            Some([*columns.first()?, *columns.last()?])
        };
        let rows: Vec<[usize; 2]> = (0..h).filter_map(contours).collect();
        assert!(rows.len() + 40 > h, "{} of {h}", rows.len());
        rows.windows(2).map(|two| two[0][0].abs_diff(two[1][0]).max(two[0][1].abs_diff(two[1][1]))).max().unwrap()
    };
    // Closed, the pole leans by 14 px over the photographs' overlap of 160 rows, most steeply beside the seam.
    let (broken, closed) = (step(false), step(true));
    assert!(broken >= 10 && closed <= 4, "{broken} {closed}");
}

#[test]
fn a_full_circle_closes() {
    let set = Set::new(&(0..8).map(|k| f64::from(k) * TAU / 8.0).collect::<Vec<_>>());
    let panorama = set.render(&plain());
    assert!(panorama.full_circle && panorama.image.width() == (TAU * 200.0_f64).round() as usize);
    assert!(error(&panorama).0 < 0.8);
    // The columns at the two edges are neighbors.
    let row = panorama.image.height() / 2;
    let (first, last) = (panorama.image.at(0, row), panorama.image.at(panorama.image.width() - 1, row));
    assert!(first.into_iter().zip(last).all(|(a, b)| a.abs_diff(b) < 25), "{first:?} {last:?}");
}

#[test]
fn a_little_planet_shows_the_ground_in_its_middle_and_the_horizon_around_it() {
    let row = |pitch: f64| (0..8).map(move |k| (f64::from(k) * TAU / 8.0, pitch));
    let set = Set::turned(&row(0.0).chain(row(-0.7)).chain(row(-1.4)).collect::<Vec<_>>());
    let framing = Framing { center: Some([0.0, -TAU / 4.0]), ..Framing::default() };
    for elastic in [false, true] {
        let panorama = set.render(&CompositingOptions {
            projection: Projection::Stereographic,
            framing,
            elastic,
            resolution: 0.5,
            ..plain()
        });
        let down = panorama.canvas.pixel(&Vector3::y()).unwrap();
        assert!(panorama.mask.at(down.x.round() as usize, down.y.round() as usize)[0]);
        // The horizon is a circle of twice the scale around it, and what lies ahead of the middle is above it.
        for yaw in [0.0, 0.9, 2.5, -1.3_f64] {
            let p = panorama.canvas.pixel(&Vector3::new(yaw.sin(), 0.0, yaw.cos())).unwrap() - down;
            let want = nalgebra::Vector2::new(yaw.sin(), -yaw.cos()) * 200.0;
            assert!((p - want).norm() < 1e-6, "{yaw} {p} {want}");
        }
        // As for the resolution of a half: averages of two by two pixels of waves of 21 px.
        assert!(error(&panorama).0 < 3.0, "{elastic}: {}", error(&panorama).0);
        // The disk up to the upper edge of the first row: tan of half of 90° + 24° (at the middles of photographs), all of it but what the
        // box leaves.
        let pixels = error(&panorama).1 as f64;
        let most = std::f64::consts::PI * (200.0 * (0.5 * (TAU / 4.0 + 90_f64.atan2(200.0))).tan()).powi(2);
        assert!(pixels < 1.01 * most && pixels > 0.85 * most, "{pixels} {most}");
    }
}

#[test]
fn a_window_over_the_back_of_a_full_circle_shows_what_lies_there() {
    let set = Set::new(&(0..8).map(|k| f64::from(k) * TAU / 8.0).collect::<Vec<_>>());
    for (projection, elastic) in
        [(Projection::Cylindrical, false), (Projection::Mercator, true), (Projection::Panini, false)]
    {
        let framing = Framing { center: Some([3.0, 0.1]), across: Some(2.0), up: Some(0.5), ..Framing::default() };
        let panorama = set.render(&CompositingOptions { projection, framing, elastic, ..plain() });
        assert!(error(&panorama).0 < 0.9, "{projection:?} {}", error(&panorama).0);
        assert!(panorama.mask.as_slice().iter().all(|m| *m) && !panorama.full_circle);
    }
}

#[test]
fn the_resolution_scales_the_canvas() {
    let set = Set::three();
    let full = set.render(&plain());
    for resolution in [0.3, 0.5, 1.5] {
        let panorama = set.render(&CompositingOptions { resolution, ..plain() });
        let ratio = panorama.image.width() as f64 / full.image.width() as f64;
        assert!((ratio / resolution - 1.0).abs() < 0.02, "{ratio} {resolution}");
        // Averages over pixels three times as large soften waves of 21 px by a few levels.
        assert!(error(&panorama).0 < 5.0, "{resolution}: {}", error(&panorama).0);
    }
}

#[test]
fn gains_even_out_what_exposure_made_different() {
    let mut set = Set::three();
    // Half the light: sRGB is a power of 1 / 2.4 to within the levels' rounding.
    for v in set.photos[1].as_mut_slice() {
        *v = ((f32::from(*v) + 14.0) * 0.5_f32.powf(1.0 / 2.4) - 14.0).round().max(0.0) as u8;
    }
    let panorama = set.render(&CompositingOptions { exposure: Exposure::Match, blend: BlendMode::None, ..plain() });
    let gain = |i: usize| panorama.gains.gains[i][1];
    // Rounding of dark bytes, averaged over thousands of samples; a common power of all light is left to the prior of the response: 5 % of a stop.
    assert!(
        (gain(1) / gain(0) * 0.5 - 1.0).abs() < 0.05 && (gain(2) / gain(0) - 1.0).abs() < 0.02,
        "{:?}",
        panorama.gains
    );
}

#[test]
fn exposures_far_apart_neither_darken_the_panorama_nor_gray_its_whites() {
    let mut set = Set::three();
    for (photo, factor) in set.photos.iter_mut().zip([2.2_f32, 1.0, 0.45]) {
        for v in photo.as_mut_slice() {
            *v = (f32::from(*v) * factor).round() as u8;
        }
    }
    let panorama = set.render(&CompositingOptions { exposure: Exposure::Match, blend: BlendMode::None, ..plain() });
    let mean = |sum: f64, n: usize| sum / n as f64;
    let level = |p: [u8; 3]| p.into_iter().map(f64::from).sum::<f64>() / 3.0;
    let photos = set
        .photos
        .iter()
        .map(|photo| mean(photo.as_slice().iter().map(|v| f64::from(*v)).sum(), photo.as_slice().len()));
    let darkest = photos.fold(f64::INFINITY, f64::min);
    let (mut sum, mut n, mut white) = (0.0, 0, 0);
    let (w, h) = panorama.image.size();
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).filter(|&(x, y)| panorama.mask.at(x, y)[0]) {
        sum += level(panorama.image.at(x, y));
        n += 1;
        let truth = sky(&panorama.canvas.ray(Point2::new(x as f64, y as f64)));
        // Where the first photograph is clipped in all channels, by more than interpolation rings.
        if panorama.labels.at(x, y)[0] == 0 && truth.iter().all(|v| 2.2 * v > 262.0) {
            white += 1;
            assert!(panorama.image.at(x, y).iter().all(|v| *v >= 250), "{x} {y} {:?}", panorama.image.at(x, y));
        }
    }
    assert!(mean(sum, n) >= darkest && white > 100, "{} {darkest} {white}", mean(sum, n));
}

/// As a mean over neighbors in a row, how far what is drawn is from lying half-way between its neighbors, in levels of 8 bits: rounding,
/// where the scene is smooth.
fn roughness<T: PhotoSample>(panorama: &Panorama<T>) -> f64 {
    let (w, h) = panorama.image.size();
    let (mut sum, mut n) = (0.0, 0.0);
    for (x, y) in (2..h - 2).flat_map(|y| (2..w - 2).map(move |x| (x, y))) {
        let near = [x - 2, x - 1, x, x + 1, x + 2].map(|x| panorama.labels.at(x, y)[0]);
        if near.iter().all(|label| *label == near[0] && *label != NO_PHOTO) {
            let at = |x: usize| f64::from(panorama.image.at(x, y)[1].to_f32() / T::PER_LEVEL);
            sum += (at(x) - 0.5 * (at(x - 1) + at(x + 1))).abs();
            n += 1.0;
        }
    }
    sum / n
}

#[test]
fn sixteen_bits_are_drawn_without_rounding_to_eight() {
    let set = Set::three();
    // Waves of 300 px, of which neighbors differ from a straight line by 80 · 0.02² / 2 levels.
    let scene = |ray: &Vector3<f64>| [120.0 + 80.0 * (4.0 * ray.normalize().x).sin(); 3];
    // The middle one with a quarter of the light (IEC 61966-2-1).
    let darker =
        |level: f64| 255.0 * (1.055 * (((level / 255.0 + 0.055) / 1.055).powf(2.4) / 4.0).powf(1.0 / 2.4) - 0.055);
    let views: Vec<View> = set.alignment.views.iter().map(|v| v.unwrap()).collect();
    let light = |i: usize, ray: &Vector3<f64>| if i == 1 { scene(ray).map(darker) } else { scene(ray) };
    let deep: Vec<_> = views.iter().enumerate().map(|(i, v)| deep_photograph(v, |ray| light(i, ray))).collect();
    let bytes: Vec<_> = views.iter().enumerate().map(|(i, v)| photograph(v, |ray| light(i, ray))).collect();
    let deep: Vec<_> = deep.iter().map(Image::view).collect();
    let bytes: Vec<_> = bytes.iter().map(RgbU8::view).collect();
    for &(_, blend) in BlendMode::NAMES {
        let options = CompositingOptions { blend, elastic: false, ..CompositingOptions::default() };
        let drawn = render(&deep, &set.alignment, &options, &Silent).unwrap();
        let rounded = render(&bytes, &set.alignment, &options, &Silent).unwrap();
        // The gain of four amplifies rounding to bytes, and the blended ones are rounded again.
        let (fine, coarse) = (roughness(&drawn), roughness(&rounded));
        assert!(fine < 0.03 && coarse > 0.2, "{blend:?}: {fine} {coarse}");
        assert_eq!(drawn.gains, rounded.gains);
    }
}

#[test]
fn sixteen_bits_of_the_same_photographs_are_the_same_panorama() {
    let set = Set::three();
    let deep: Vec<Image<u16, 3>> = set.photos.iter().map(|p| p.map(|c| c.map(|v| 257 * u16::from(v)))).collect();
    let views: Vec<_> = deep.iter().map(Image::view).collect();
    for resolution in [1.0, 0.4] {
        for &(_, blend) in BlendMode::NAMES {
            let options = CompositingOptions { blend, crop: true, resolution, ..CompositingOptions::default() };
            let (eight, sixteen) = (set.render(&options), render(&views, &set.alignment, &options, &Silent).unwrap());
            assert_eq!((eight.image.size(), &eight.gains), (sixteen.image.size(), &sixteen.gains));
            let pixels = eight.image.as_slice().iter().zip(sixteen.image.as_slice());
            let off = pixels.map(|(a, b)| (f64::from(*a) - f64::from(*b) / 257.0).abs());
            // Rounding to bytes of what is averaged, drawn and blended, half a level each: more only where a seam runs elsewhere for it.
            let far = off.filter(|off| *off > 1.5).count();
            assert!(far * 1000 < eight.image.as_slice().len(), "{blend:?} {resolution}: {far}");
        }
    }
}

#[test]
fn radiance_is_exact_where_a_photograph_is_not_clipped() {
    let set = Set::three();
    // Light from a 30th to four times white, in waves of 100 px, as the middle one sees it; the outer two have a fifth of the exposure, and
    // sRGB's curve (IEC 61966-2-1).
    let light = |ray: &Vector3<f64>| {
        let r = ray.normalize();
        [(-1.5 + 3.5 * (12.0 * r.x + 1.0).sin() * (9.0 * r.y).cos()).exp2(); 3]
    };
    let level = |light: f64| {
        let v = light.min(1.0);
        255.0 * if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 }
    };
    let exposure = |i: usize| if i == 1 { 1.0 } else { 0.2 };
    let views: Vec<View> = set.alignment.views.iter().map(|v| v.unwrap()).collect();
    let deep: Vec<_> = views
        .iter()
        .enumerate()
        .map(|(i, v)| deep_photograph(v, |ray| light(ray).map(|l| level(l * exposure(i)))))
        .collect();
    let deep: Vec<_> = deep.iter().map(Image::view).collect();
    let alignment = Alignment { reference: 1, ..set.alignment.clone() };
    for &(_, blend) in BlendMode::NAMES {
        let options = CompositingOptions { blend, radiance: true, crop: true, ..CompositingOptions::default() };
        let drawn = render(&deep, &alignment, &options, &Silent).unwrap();
        let radiance = drawn.radiance.as_ref().unwrap();
        assert_eq!(radiance.size(), drawn.image.size());
        let (w, h) = radiance.size();
        let (mut off, mut bright) = (Vec::new(), 0);
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
            let ray = drawn.canvas.ray(Point2::new(x as f64, y as f64));
            let truth = light(&ray)[1];
            // Seen by the outer ones, which do not clip 4 · 0.2; or not clipped by the middle one.
            let outer = [0, 2].iter().any(|&i| views[i].project(&ray).is_some_and(|p| views[i].contains(p)));
            if outer || truth < 0.9 {
                off.push((f64::from(radiance.at(x, y)[1]) / truth).log2().abs());
                bright += usize::from(truth > 1.5);
            }
        }
        off.sort_by(f64::total_cmp);
        let (median, most) = (off[off.len() / 2], off[off.len() * 98 / 100]);
        // The preview's 8 bits tell exposures to a hundredth of a stop; the kernel, in light, and the bands where it is steepest add as much.
        assert!(median < 0.015 && most < 0.04 && bright > 5000, "{blend:?}: {median} {most} {bright}");
    }
}

#[test]
fn the_bytes_are_the_same_at_any_number_of_threads() {
    let set = Set::three();
    for &(_, blend) in BlendMode::NAMES {
        let options = CompositingOptions { blend, ..CompositingOptions::default() };
        let with = |threads: usize| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| set.render(&options))
        };
        let (one, three) = (with(1), with(3));
        assert!(one.image == three.image && one.labels == three.labels, "{blend:?}");
    }
    let fading: Vec<RgbU8> = (0..3).map(|i| set.photos[i].map(|c| c.map(|v| v >> i))).collect();
    let fading: Vec<_> = fading.iter().map(RgbU8::view).collect();
    let options = CompositingOptions { exposure: Exposure::Adapt, ..CompositingOptions::default() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| render(&fading, &set.alignment, &options, &Silent).unwrap().image)
    };
    assert!(with(1) == with(3));
    let deep: Vec<Image<u16, 3>> = set.photos.iter().map(|p| p.map(|c| c.map(|v| 250 * u16::from(v)))).collect();
    let views: Vec<_> = deep.iter().map(Image::view).collect();
    let options = CompositingOptions { radiance: true, ..CompositingOptions::default() };
    let with = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let drawn = pool.install(|| render(&views, &set.alignment, &options, &Silent).unwrap());
        (drawn.image, drawn.radiance)
    };
    assert!(with(1) == with(3));
}

/// Each pixel the complement of its photograph's.
struct Negative;

impl Blender for Negative {
    fn blend(&self, composition: &Composition<'_>, progress: &dyn Progress) -> Result<RgbU8, Cancelled> {
        progress.report("blend", 0, 1)?;
        let (w, h) = composition.labels.size();
        Ok(RgbU8::from_fn(w, h, |x, y| {
            let label = usize::from(composition.labels.at(x, y)[0]);
            let photo = composition.photos.get(label).and_then(Option::as_ref);
            photo.and_then(|p| p.color(x, y)).map_or([0; 3], |c| c.map(|v| 255 - v))
        }))
    }
}

/// Half the canvas is missing.
struct Half;

impl Blender for Half {
    fn blend(&self, composition: &Composition<'_>, _: &dyn Progress) -> Result<RgbU8, Cancelled> {
        let (w, h) = composition.labels.size();
        Ok(RgbU8::new(w / 2, h, [0; 3]))
    }
}

#[test]
fn a_callers_blender_gives_the_picture() {
    let set = Set::three();
    let hard = set.render(&CompositingOptions { blend: BlendMode::None, ..plain() });
    let negative = render_with(&set.views(), &set.alignment, &plain(), &Negative, &Silent).unwrap();
    assert_eq!(negative.labels, hard.labels);
    for (a, (b, inside)) in negative.image.pixels().zip(hard.image.pixels().zip(hard.mask.pixels())) {
        assert_eq!(a, if inside[0] { b.map(|v| 255 - v) } else { [0; 3] });
    }
    let (width, height) = hard.image.size();
    let error = render_with(&set.views(), &set.alignment, &plain(), &Half, &Silent).unwrap_err();
    let expected = RenderError::WrongBlend { width: width / 2, height, expected_width: width, expected_height: height };
    assert_eq!(error, expected);
}

#[test]
fn what_cannot_be_drawn_says_why() {
    let set = Set::three();
    let go = |views: &[ImageView<'_, u8, 3>], options: &CompositingOptions| {
        render(views, &set.alignment, options, &Silent).unwrap_err()
    };
    for resolution in [0.0, -1.0, f64::NAN, f64::INFINITY] {
        let error = go(&set.views(), &CompositingOptions { resolution, ..plain() });
        assert!(matches!(error, RenderError::Option(OptionError { name: "resolution", .. })), "{error:?}");
    }
    let framing = Framing { across: Some(f64::NAN), ..Framing::default() };
    let error = go(&set.views(), &CompositingOptions { framing, ..plain() });
    assert!(matches!(error, RenderError::Option(OptionError { name: "across", .. })), "{error:?}");
    let small = RgbU8::new(100, 180, [0; 3]);
    let views = [set.views()[0], small.view(), set.views()[2]];
    let expected =
        RenderError::WrongPhoto { index: 1, width: 100, height: 180, expected_width: 240, expected_height: 180 };
    assert_eq!(go(&views, &plain()), expected);
    let expected = RenderError::WrongPhoto { index: 2, width: 0, height: 0, expected_width: 240, expected_height: 180 };
    assert_eq!(go(&set.views()[..2], &plain()), expected);
    let error = go(&set.views(), &CompositingOptions { max_pixels: 1000, ..plain() });
    assert!(matches!(error, RenderError::Layout(LayoutError::TooLarge { max_pixels: 1000, .. })));
}

#[test]
fn every_stage_can_be_stopped_at_any_of_its_reports() {
    let set = Set::three();
    let options = CompositingOptions { crop: true, radiance: true, ..CompositingOptions::default() };
    for stage in ["elastic", "preview", "exposure", "seams", "warp", "blend", "radiance", "crop"] {
        let watched = StopAt::of_stage(stage, usize::MAX);
        render(&set.views(), &set.alignment, &options, &watched).unwrap();
        assert!(watched.reports() >= 3, "{stage}: {}", watched.reports());
        for at in [1, watched.reports() / 2, watched.reports()] {
            let stop = StopAt::of_stage(stage, at);
            let result = render(&set.views(), &set.alignment, &options, &stop);
            assert_eq!(result.unwrap_err(), RenderError::Cancelled(Cancelled), "{stage} {at}");
            // A thread that waits for others may begin another piece of work: it asks, and ends that too.
            assert!(stop.reports() <= at + 4 * rayon::current_num_threads(), "{stage} {at}: {}", stop.reports());
        }
    }
}

#[test]
fn a_view_of_a_world_frame_turned_anyhow_is_drawn_the_same() {
    let mut set = Set::three();
    let first = set.render(&plain());
    let turn: Matrix3<f64> = Rotation3::from_axis_angle(&Vector3::y_axis(), 1.3).into_inner();
    for view in set.alignment.views.iter_mut().flatten() {
        view.from_world *= turn;
    }
    let second = set.render(&plain());
    // The middle is found anew: to a rounding of the turn.
    assert_eq!(first.image.size(), second.image.size());
    let off = first.image.as_slice().iter().zip(second.image.as_slice()).map(|(a, b)| a.abs_diff(*b)).max();
    assert!(off <= Some(1), "{off:?}");
}
