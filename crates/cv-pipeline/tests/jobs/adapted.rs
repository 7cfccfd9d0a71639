//! Local adaptation of panoramas ([`Exposure::Adapt`]) on photographs of known exposure and registration.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Point2, RgbU8, Rotation3, Silent, Vector3};
use cv_panorama::{Alignment, BlendMode, CameraMotion, CompositingOptions, Exposure, Panorama, Seams, View, render};
use cv_synth::{Vista, VistaOptions, VistaPhoto, vista_photos, vista_response};

fn alignment(views: Vec<View>) -> Alignment {
    let reference = views.len() / 2;
    let views = views.into_iter().map(Ok).collect();
    let pairs = Vec::new();
    Alignment { views, reference, motion: CameraMotion::Rotation, pairs, rms_px: 0.0, median_px: 0.0 }
}

fn draw(photos: &[RgbU8], alignment: &Alignment, options: &CompositingOptions) -> Panorama {
    let photos: Vec<_> = photos.iter().map(RgbU8::view).collect();
    render(&photos, alignment, options, &Silent).unwrap()
}

/// Photographs of a landscape whose exposures span twice `exposure` stops.
fn landscape(exposure: f32) -> (Vec<VistaPhoto>, Alignment) {
    let camera = Camera::from_focal(420, 300, 360.0);
    let options = VistaOptions { views: 5, exposure, ..VistaOptions::default() };
    let photos = vista_photos(&Vista::new(5, 90.0), 3, &camera, &options).unwrap();
    let view = |p: &VistaPhoto| View { camera: p.camera, from_world: p.from_world.into_inner() };
    let views = photos.iter().map(view).collect();
    (photos, alignment(views))
}

fn images(photos: &[VistaPhoto]) -> Vec<RgbU8> {
    photos.iter().map(|p| p.image.clone()).collect()
}

fn of(exposure: Exposure) -> CompositingOptions {
    CompositingOptions { exposure, elastic: false, ..CompositingOptions::default() }
}

fn mean(color: [u8; 3]) -> f64 {
    color.iter().map(|v| f64::from(*v)).sum::<f64>() / 3.0
}

/// Calls `visit` with the place of every second canvas pixel that lies in the inner half of the photograph, and the photograph's color there.
fn inner(panorama: &Panorama, index: usize, photo: &RgbU8, mut visit: impl FnMut(usize, usize, [u8; 3])) {
    let (w, h) = panorama.size;
    for (x, y) in (0..h).step_by(2).flat_map(|y| (0..w).step_by(2).map(move |x| (x, y))) {
        let Some(p) = panorama.map.source(index, Point2::new(x as f64, y as f64)) else { continue };
        let (u, v) = (p.x / photo.width() as f64, p.y / photo.height() as f64);
        if (0.25..0.75).contains(&u) && (0.25..0.75).contains(&v) {
            visit(x, y, photo.at(p.x.round() as usize, p.y.round() as usize));
        }
    }
}

#[test]
fn every_part_has_the_mean_level_of_its_photograph() {
    let (photos, alignment) = landscape(2.0);
    let images = images(&photos);
    let [matched, adapted] = [Exposure::Match, Exposure::Adapt].map(|e| draw(&images, &alignment, &of(e)));
    assert_eq!((matched.size, &matched.gains), (adapted.size, &adapted.gains));
    let mut farthest: f64 = 0.0;
    for (index, photo) in images.iter().enumerate() {
        let alone = |x: usize, y: usize| {
            let place = Point2::new(x as f64, y as f64);
            (0..images.len()).filter(|&k| k != index).all(|k| adapted.map.source(k, place).is_none())
        };
        // Of all, and of what no other photograph shows: its own mean level, matched and adapted, and the number of pixels.
        let mut sums = [[0.0; 4]; 2];
        inner(&adapted, index, photo, |x, y, own| {
            // What it clipped and others show is taken from them, at another level.
            let is_alone = alone(x, y);
            if !is_alone && own.iter().any(|v| *v >= 250) {
                return;
            }
            let all = [own, matched.image.at(x, y), adapted.image.at(x, y)].map(mean);
            for sum in sums.iter_mut().take(if is_alone { 2 } else { 1 }) {
                (0..3).for_each(|k| sum[k] += all[k]);
                sum[3] += 1.0;
            }
        });
        let [[own, before, after], alone] = sums.map(|s| [s[0] / s[3], s[1] / s[3], s[2] / s[3]]);
        let off = |level: f64| (level - own).abs();
        farthest = farthest.max(off(before));
        // Nearer, unless the common exposure happens to be that of the photograph: the inner half reaches to the middle of overlaps with photographs of up to four stops more.
        assert!(off(after) < 0.6 * off(before) || off(after) < 6.0, "{index}: {own:.1}, {before:.1}, {after:.1}");
        // Vignetting, which is corrected, is 3 % of the light on average there: two levels. The transitions to its neighbors do the rest, and the compression of highlights, by up to ten levels
        // in the photograph that is nearly white (a mean of 235).
        assert!(sums[1][3] > 500.0 && (alone[2] - alone[0]).abs() < 12.0, "{index}: {alone:.1?}");
    }
    assert!(farthest > 40.0, "{farthest}: the set shows no need");
}

#[test]
fn what_is_clipped_in_every_photograph_stays_white() {
    let (photos, alignment) = landscape(2.0);
    let images = images(&photos);
    let adapted = draw(&images, &alignment, &of(Exposure::Adapt));
    let (w, h) = adapted.size;
    let (mut white, mut dark) = (0, 0);
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
        let place = Point2::new(x as f64, y as f64);
        // With its neighbors, which the interpolation sees.
        let is_clipped = |index: usize, photo: &RgbU8| {
            adapted.map.source(index, place).map(|p| {
                let around = |v: f64, n: usize| (v as usize).saturating_sub(2)..(v as usize + 4).min(n);
                let places = around(p.y, photo.height()).flat_map(|v| around(p.x, photo.width()).map(move |u| (u, v)));
                places.into_iter().all(|(u, v)| photo.at(u, v).iter().all(|v| *v >= 250))
            })
        };
        let seen: Vec<bool> = images.iter().enumerate().filter_map(|(i, photo)| is_clipped(i, photo)).collect();
        if !seen.is_empty() && seen.iter().all(|clipped| *clipped) {
            white += 1;
            dark += usize::from(adapted.image.at(x, y).iter().any(|v| *v < 245));
        }
    }
    // Level 250 counts as clipped to 98 %, and noise is as large. Bands of other wavelengths reach across the borders of the clipped region.
    assert!(white > 2000 && dark * 100 < white, "{dark} of {white}");
}

#[test]
fn seams_have_no_steps() {
    let (photos, alignment) = landscape(2.0);
    let images = images(&photos);
    // Straight seams through everything, not blended.
    let excess = |exposure: Exposure| {
        let options = CompositingOptions { blend: BlendMode::None, seams: Seams::Voronoi, ..of(exposure) };
        let p = draw(&images, &alignment, &options);
        let (w, h) = p.size;
        let level = |x: usize, y: usize| mean(p.image.at(x, y));
        let (mut across, mut beside, mut n) = (0.0, 0.0, 0.0);
        for (x, y) in (0..h).flat_map(|y| (4..w - 4).map(move |x| (x, y))) {
            let one = |x: usize| p.labels.at(x, y) == p.labels.at(x - 1, y);
            let is_covered = (x - 4..x + 4).all(|x| p.mask.at(x, y)[0]);
            // What one of the two photographs cannot show is no error of the tone: where it is clipped in a channel, or in the noise.
            let place = Point2::new(x as f64, y as f64);
            let is_tonal = [p.labels.at(x, y)[0], p.labels.at(x - 1, y)[0]].iter().all(|label| {
                let photo = images.get(usize::from(*label));
                let source = photo.and_then(|photo| Some((photo, p.map.source(usize::from(*label), place)?)));
                source.is_some_and(|(photo, p)| {
                    photo.at(p.x.round() as usize, p.y.round() as usize).iter().all(|v| (12..235).contains(v))
                })
            });
            if is_covered && is_tonal && !one(x) && one(x - 2) && one(x + 2) {
                across += (level(x, y) - level(x - 1, y)).abs();
                beside +=
                    0.5 * (level(x - 2, y) - level(x - 3, y)).abs() + 0.5 * (level(x + 2, y) - level(x + 1, y)).abs();
                n += 1.0;
            }
        }
        assert!(n > 300.0, "{n}");
        (across - beside) / n
    };
    let [matched, adapted] = [Exposure::Match, Exposure::Adapt].map(excess);
    // All photographs share the lift: a seam's step is that of the photometric model, magnified where the lift brightens, at most as much as noise beside it is.
    assert!(adapted < matched + 1.0, "{matched} {adapted}");
}

#[test]
fn equal_exposures_are_not_changed() {
    for exposure in [0.0, 0.2] {
        let (photos, alignment) = landscape(exposure);
        let images = images(&photos);
        let [matched, adapted] = [Exposure::Match, Exposure::Adapt].map(|e| draw(&images, &alignment, &of(e)));
        assert!(matched.image == adapted.image, "{exposure}");
    }
}

/// Radiance of a roof against the sky: a straight edge, plain on both sides.
fn roof_and_sky(ray: &Vector3<f64>) -> f32 {
    if ray.y < 0.1 * ray.z.hypot(ray.x) { 0.7 } else { 0.025 }
}

#[test]
fn a_roof_against_the_sky_has_no_halo() {
    let camera = Camera::from_focal(420, 300, 360.0);
    let exposures = [-2.0_f32, 0.0, 2.0];
    let views: Vec<View> = (0..3)
        .map(|k| Rotation3::from_axis_angle(&Vector3::y_axis(), 0.55 * (1.0 - f64::from(k))))
        .map(|turn| View { camera, from_world: turn.into_inner() })
        .collect();
    let photo = |(view, exposure): (&View, f32)| {
        RgbU8::from_fn(camera.width, camera.height, |x, y| {
            // Four samples for each pixel.
            let light = |k: usize| {
                let p = Point2::new(x as f64 + 0.5 * (k % 2) as f64 - 0.25, y as f64 + 0.5 * (k / 2) as f64 - 0.25);
                roof_and_sky(&view.ray(p).unwrap())
            };
            let light = (0..4).map(light).sum::<f32>() / 4.0 * exposure.exp2();
            [(255.0 * vista_response(light, 0.0)).round() as u8; 3]
        })
    };
    let photos: Vec<RgbU8> = views.iter().zip(exposures).map(photo).collect();
    let alignment = alignment(views);
    // The greatest difference in levels, from what is plain on both sides 60 px away, of places nearer to the edge: brighter sky, or darker roof.
    let overshoot = |exposure: Exposure, blend: BlendMode| {
        let p = draw(&photos, &alignment, &CompositingOptions { blend, ..of(exposure) });
        let (w, h) = p.size;
        let (mut overshoot, mut columns): (f64, usize) = (0.0, 0);
        for x in (2..w - 2).step_by(3) {
            let level = |y: usize| mean(p.image.at(x, y));
            let is_sky = |y: usize| roof_and_sky(&p.canvas.ray(Point2::new(x as f64, y as f64))) > 0.1;
            let Some(edge) = (1..h).find(|y| is_sky(y - 1) && !is_sky(*y)) else { continue };
            if edge < 70 || edge + 70 > h || !(edge - 65..edge + 65).all(|y| p.mask.at(x, y)[0]) {
                continue;
            }
            columns += 1;
            for d in 4..60 {
                overshoot = overshoot.max(level(edge - d) - level(edge - 60));
                overshoot = overshoot.max(level(edge + 60) - level(edge + d - 1));
            }
        }
        assert!(columns > 150, "{columns}");
        overshoot
    };
    for blend in [BlendMode::None, BlendMode::Multiband] {
        let [matched, adapted] = [Exposure::Match, Exposure::Adapt].map(|exposure| overshoot(exposure, blend));
        // Four levels over a fifth of a photograph are less than what is just visible in a plain sky (a contrast of 2 % at an edge). Blending adds by what the photographs differ after correction: the rounding of
        // a roof of 40 levels, lifted by two stops.
        assert!(adapted <= matched + 4.0, "{blend:?}: {matched} {adapted}");
    }
}
