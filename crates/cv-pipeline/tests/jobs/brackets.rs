//! Exposure brackets in panoramas: three views of a landscape with three exposures each, and a person who stands elsewhere in every one.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Point2, RgbU8, Rotation3, Silent, Vector3};
use cv_panorama::{Alignment, BlendMode, CameraMotion, CompositingOptions, Panorama, View, render};
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, panorama};
use cv_synth::{Vista, vista_response};

const STOPS: [f32; 3] = [-2.2, 1.2, 3.3];
/// Yaw of the views, in radians.
const YAWS: [f64; 3] = [-0.5, 0.0, 0.5];
/// Azimuth of the persons relative to their views: none hides another, and some stand before the sky.
const PLACES: [[f64; 3]; 3] = [[-0.3, -0.15, 0.05], [-0.1, 0.0, 0.12], [-0.02, 0.15, 0.3]];

struct Set {
    photos: Vec<RgbU8>,
    views: Vec<View>,
    /// Azimuths of the persons.
    persons: Vec<f64>,
}

/// Returns whether a ray meets a person: a body and a head, who reaches above the horizon.
fn is_person(azimuth: f64, ray: &Vector3<f64>, margin: f64) -> bool {
    let (az, el) = (ray.x.atan2(ray.z) - azimuth, (-ray.y).atan2(ray.x.hypot(ray.z)));
    let inside =
        |w: f64, h: f64, middle: f64| (az / (w - margin)).powi(2) + ((el - middle) / (h - margin)).powi(2) < 1.0;
    inside(0.032, 0.14, -0.04) || inside(0.018, 0.025, 0.12)
}

fn set(yaws: &[f64]) -> Set {
    let (vista, camera) = (Vista::new(5, 90.0), Camera::from_focal(420, 300, 360.0));
    let mut set = Set { photos: Vec::new(), views: Vec::new(), persons: Vec::new() };
    for (v, yaw) in yaws.iter().enumerate() {
        for (e, stops) in STOPS.into_iter().enumerate() {
            // Down to the meadow, by a hand that moves by a pixel or two.
            let turn = Rotation3::from_axis_angle(&Vector3::x_axis(), 0.2 - 0.003 * e as f64)
                * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw - 0.004 * e as f64);
            let view = View { camera, from_world: turn.into_inner() };
            let person = yaw + PLACES[v][e];
            set.photos.push(RgbU8::from_fn(420, 300, |x, y| {
                let mut sum = [0.0; 3];
                for k in 0..4 {
                    let p =
                        Point2::new(x as f64 + 0.5 * f64::from(k % 2) - 0.25, y as f64 + 0.5 * f64::from(k / 2) - 0.25);
                    let ray = view.ray(p).unwrap();
                    let light = if is_person(person, &ray, 0.0) { [0.25, 0.04, 0.05] } else { vista.radiance(&ray) };
                    (0..3).for_each(|c| sum[c] += 0.25 * light[c] * stops.exp2());
                }
                sum.map(|light| (255.0 * vista_response(light, 0.0)).round() as u8)
            }));
            set.views.push(view);
            set.persons.push(person);
        }
    }
    set
}

fn draw(set: &Set, options: &CompositingOptions) -> Panorama {
    let photos: Vec<_> = set.photos.iter().map(RgbU8::view).collect();
    let alignment = Alignment {
        views: set.views.iter().copied().map(Ok).collect(),
        reference: 4,
        motion: CameraMotion::Rotation,
        pairs: Vec::new(),
        rms_px: 0.0,
        median_px: 0.0,
    };
    render(&photos, &alignment, options, &Silent).unwrap()
}

/// Returns the color of a photograph at a ray, at the nearest pixel.
fn seen(set: &Set, index: usize, ray: &Vector3<f64>) -> Option<[u8; 3]> {
    let view = &set.views[index];
    let p = view.project(ray).filter(|p| view.contains(*p))?;
    Some(set.photos[index].at(p.x.round() as usize, p.y.round() as usize))
}

#[test]
fn brackets_are_stacks_of_which_nothing_is_clipped_or_cut() {
    let set = set(&YAWS);
    for blend in [BlendMode::Multiband, BlendMode::None] {
        let p = draw(&set, &CompositingOptions { blend, elastic: false, ..CompositingOptions::default() });
        assert_eq!(p.stacks, [[0, 1, 2], [3, 4, 5], [6, 7, 8]]);
        let (w, h) = p.size;
        let (mut shown, mut lost, mut white, mut own) = (0, 0, 0, 0);
        let mut parts = vec![(0, 0); set.photos.len()];
        let is_clipped = |color: [u8; 3]| color.iter().any(|v| *v >= 250);
        for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))).filter(|&(x, y)| p.mask.at(x, y)[0]) {
            let ray = p.canvas.ray(Point2::new(x as f64, y as f64));
            let label = usize::from(p.labels.at(x, y)[0]);
            own += usize::from(label % 3 == 1);
            let colors: Vec<_> = (0..set.photos.len()).filter_map(|k| seen(&set, k, &ray)).collect();
            if colors.iter().any(|c| !is_clipped(*c)) {
                shown += 1;
                lost += usize::from(seen(&set, label, &ray).is_some_and(is_clipped));
                white += usize::from(p.image.at(x, y) == [255; 3]);
            }
            // Half a degree within the outline.
            for (person, part) in set.persons.iter().zip(&mut parts).enumerate().map(|(k, (a, part))| ((k, *a), part)) {
                if is_person(person.1, &ray, 0.004) && seen(&set, person.0, &ray).is_some() {
                    part.0 += 1;
                    part.1 += usize::from(label == person.0);
                }
            }
        }
        // What some photograph saw unclipped: 99.5 %.
        assert!(lost * 200 <= shown && white * 200 <= shown, "{blend:?}: {lost} and {white} of {shown}");
        // The middle exposures clip the sky and show most of the rest.
        assert!(own * 4 > shown, "{blend:?}: {own} of {shown}");
        for (k, (all, part)) in parts.iter().enumerate() {
            // A seam along an outline passes within its pixels, of which there are some 3 %.
            let share = *part as f64 / *all as f64;
            assert!(*all > 500 && !(0.03..=0.97).contains(&share), "{blend:?}: person {k} {share} of {all}");
        }
    }
}

#[test]
fn the_job_reports_stacks_by_the_order_of_the_photographs() {
    let set = set(&YAWS[..2]);
    // Interleaved: the darkest of both, and so on.
    let order = [0, 3, 1, 4, 2, 5];
    let photos: Vec<_> = order.iter().map(|&k| PanoramaPhoto::new(set.photos[k].view())).collect();
    let result = panorama(&photos, &PanoramaOptions::default(), &Silent).unwrap();
    assert!(result.images.iter().all(|image| image.used), "{:?}", result.images);
    assert_eq!(result.stacks, [[0, 2, 4], [1, 3, 5]]);
    // Without exposures, nothing tells a bracket from a repetition.
    let mut options = PanoramaOptions::default();
    options.render.exposure = cv_panorama::Exposure::None;
    assert!(panorama(&photos, &options, &Silent).unwrap().stacks.is_empty());
}
