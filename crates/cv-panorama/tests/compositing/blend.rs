//! All blend modes on a composition of photographs of one picture.

use crate::testing::{StopAt, drawn};
use cv_core::{Cancelled, Image, Named, Silent};
use cv_panorama::{BlendMode, Bounds, Composition, NO_PHOTO};

/// Photographs of one picture, their labels on either side of a slanted line, a corner that none reaches.
fn with_composition(test: impl Fn(&Composition<'_>, &dyn Fn(usize, usize) -> [u8; 3])) {
    let (w, h) = (700, 500);
    let scene =
        |x: usize, y: usize| [(x * 3 % 200) as u8 + 20, (y * 2 % 180) as u8 + 30, ((x / 9 + y / 7) % 5 * 40) as u8];
    let whole = Bounds { left: 0, top: 0, right: w, bottom: h };
    let photos = [Some(drawn(whole, scene)), Some(drawn(whole, scene)), None];
    let labels = Image::from_fn(w, h, |x, y| [if x + y < 60 { NO_PHOTO } else { u16::from(x > 200 + y / 3) }]);
    test(&Composition { photos: &photos, labels: &labels, typical_side: 500.0 }, &scene);
}

#[test]
fn every_mode_gives_one_picture_back_and_leaves_the_rest_black() {
    with_composition(|composition, scene| {
        for &(_, mode) in BlendMode::NAMES {
            let image = mode.blender().blend(composition, &Silent).unwrap();
            for (y, x) in (0..500).flat_map(|y| (0..700).map(move |x| (y, x))) {
                let label = composition.labels.at(x, y)[0];
                let expected = if label == NO_PHOTO { [0; 3] } else { scene(x, y) };
                // Taken apart and put together in f32: exact but for the rounding of halves.
                let off = image.at(x, y).into_iter().zip(expected).map(|(a, b)| a.abs_diff(b)).max();
                assert!(off <= Some(u8::from(mode == BlendMode::Poisson)), "{mode:?} {x} {y}: {off:?}");
            }
        }
    });
}

#[test]
fn every_mode_stops_wherever_it_is_told_to() {
    with_composition(|composition, _| {
        for &(_, mode) in BlendMode::NAMES {
            let watched = StopAt::never();
            mode.blender().blend(composition, &watched).unwrap();
            for at in 1..=watched.reports() {
                let stop = StopAt::report(at);
                assert_eq!(mode.blender().blend(composition, &stop), Err(Cancelled), "{mode:?} {at}");
                assert!(stop.reports() <= at + rayon::current_num_threads(), "{mode:?} {at}");
            }
        }
    });
}
