//! Alignments of exact and inexact matches of known views.

use crate::testing::{StopAt, inexact_matches, lumas, three_views};
use cv_core::{Camera, Cancelled, Correspondence, Distortion, GrayU8, Matrix3, Point2, Silent, Vector2, Vector3};
use cv_panorama::{
    AlignError, AlignOptions, Alignment, CameraMotion, Photo, Unplaced, VerifiedPair, VerifyOptions, View, align,
    refine_alignment, verify_pair,
};
use nalgebra::Rotation3;

/// Views turned by these yaws, pitches and rolls, at a focal length.
fn views(turns: &[(f64, f64, f64)], focal: f64) -> Vec<View> {
    let turned = |&(yaw, pitch, roll): &(f64, f64, f64)| View {
        camera: Camera::from_focal(600, 400, focal),
        from_world: (Rotation3::from_axis_angle(&Vector3::z_axis(), roll)
            * Rotation3::from_axis_angle(&Vector3::x_axis(), pitch)
            * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw))
        .into_inner(),
    };
    turns.iter().map(turned).collect()
}

fn sweep() -> Vec<View> {
    views(&[(-0.5, 0.02, 0.01), (0.0, -0.03, 0.0), (0.45, 0.05, -0.02), (0.9, 0.0, 0.01)], 550.0)
}

/// Exact matches of what two views both see, a pixel of the first every 40; `None` where that is little.
fn pair(a: usize, b: usize, views: &[View]) -> Option<VerifiedPair> {
    let grid = (0..10).flat_map(|y| (0..15).map(move |x| Point2::new(20.0 + 40.0 * x as f64, 20.0 + 40.0 * y as f64)));
    let seen = |p: Point2<f64>| {
        let q = views[b].project(&views[a].ray(p)?)?;
        views[b].contains(q).then_some(Correspondence { a: p, b: q })
    };
    let matches: Vec<Correspondence> = grid.filter_map(seen).collect();
    let h = views[b].camera.matrix()
        * views[b].from_world
        * views[a].from_world.try_inverse()?
        * views[a].camera.matrix().try_inverse()?;
    let inliers = (0..matches.len()).collect();
    (matches.len() > 20).then(|| VerifiedPair { a, b, homography: h / h[(2, 2)], distortion: 0.0, inliers, matches })
}

fn pairs(views: &[View]) -> Vec<VerifiedPair> {
    let all = (0..views.len()).flat_map(|a| (a + 1..views.len()).map(move |b| (a, b)));
    all.filter_map(|(a, b)| pair(a, b, views)).collect()
}

fn photos(n: usize) -> Vec<Photo> {
    vec![Photo::new(600, 400); n]
}

/// Largest angle, in radians, between relative rotations as found and as they are.
fn rotation_error(found: &Alignment, truth: &[View]) -> f64 {
    let used: Vec<(usize, &View)> = found.used().collect();
    let relative = |a: &View, b: &View| b.from_world * a.from_world.transpose();
    let errors = used.iter().flat_map(|&(i, a)| used.iter().map(move |&(j, b)| (i, a, j, b))).map(|(i, a, j, b)| {
        let off = relative(a, b) * relative(&truth[i], &truth[j]).transpose();
        // The angle from the skew part: exact for small ones.
        Vector3::new(off[(2, 1)], off[(0, 2)], off[(1, 0)]).norm()
    });
    errors.fold(0.0, f64::max)
}

#[test]
fn exact_matches_give_the_views_back_with_their_focal_length() {
    let truth = sweep();
    let pairs = pairs(&truth);
    assert!(pairs.len() >= 3);
    let found = align(&photos(4), &pairs, &AlignOptions::default(), &Silent).unwrap();
    assert_eq!((found.motion, found.pairs.len(), found.used().count()), (CameraMotion::Rotation, pairs.len(), 4));
    // The prior on the focal length (0.7 in its logarithm, against hundreds of matches of 2 px) moves it by 1e-5 or so.
    assert!(rotation_error(&found, &truth) < 1e-4, "{}", rotation_error(&found, &truth));
    for (_, view) in found.used() {
        assert!((view.camera.fx / 550.0 - 1.0).abs() < 1e-3, "{}", view.camera.fx);
    }
    assert!(found.rms_px < 0.05 && found.median_px <= found.rms_px);
    // Level: the vertical of the world is seen as vertical but for what rolls and pitches leave open.
    let up = found.used().map(|(_, v)| v.from_world.column(1).y).fold(f64::INFINITY, f64::min);
    assert!(up > 0.99, "{up}");
}

#[test]
fn photographs_that_overlap_with_none_or_few_say_so() {
    // Two that overlap each other far away from three others, and one alone.
    let turns = [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.4, 0.0, 0.0), (-1.6, 0.0, 0.0), (0.8, 0.0, 0.0), (3.3, 0.0, 0.0)];
    let truth = views(&turns, 550.0);
    let found = align(&photos(6), &pairs(&truth), &AlignOptions::default(), &Silent).unwrap();
    let used: Vec<usize> = found.used().map(|(i, _)| i).collect();
    assert_eq!(used, [0, 2, 4]);
    assert_eq!(found.reference, 2);
    assert_eq!(found.views[1], Err(Unplaced::OtherComponent { size: 2 }));
    assert_eq!(found.views[5], Err(Unplaced::OtherComponent { size: 2 }));
    assert_eq!(found.views[3], Err(Unplaced::NoOverlap));
}

#[test]
fn a_false_pair_is_rejected_and_the_others_are_kept() {
    let truth = sweep();
    let mut pairs = pairs(&truth);
    // The first and the last, which show nothing in common, "match" like two neighbors: repeated windows.
    let mut wrong = pair(0, 1, &truth).unwrap();
    (wrong.a, wrong.b) = (0, 3);
    wrong.matches.truncate(30);
    let count = pairs.len();
    pairs.push(wrong);
    let found = align(&photos(4), &pairs, &AlignOptions::default(), &Silent).unwrap();
    assert_eq!((found.pairs.len(), found.used().count()), (count, 4));
    assert!(rotation_error(&found, &truth) < 1e-3, "{}", rotation_error(&found, &truth));
}

#[test]
fn a_false_weak_pair_does_not_close_a_circle() {
    // Eight photographs over 270 degrees, and nine false matches between the first and the last, which would overlap at half of the focal length.
    let turns: Vec<(f64, f64, f64)> = (0..8).map(|i| (0.55 * f64::from(i) - 1.925, 0.0, 0.0)).collect();
    let truth = views(&turns, 600.0);
    let mut pairs: Vec<VerifiedPair> = (1..8).filter_map(|i| pair(i - 1, i, &truth)).collect();
    let near = views(&[(0.0, 0.0, 0.0), (0.55, 0.0, 0.0)], 600.0);
    let mut closing = pair(0, 1, &near).unwrap();
    (closing.a, closing.b) = (7, 0);
    closing.matches.truncate(9);
    closing.inliers.truncate(9);
    pairs.push(closing);
    let found = align(&photos(8), &pairs, &AlignOptions::default(), &Silent).unwrap();
    assert_eq!(found.pairs.len(), 7);
    assert!(rotation_error(&found, &truth) < 1e-3, "{}", rotation_error(&found, &truth));
    assert!((found.views[3].as_ref().unwrap().camera.fx - 600.0).abs() < 1.0);
}

#[test]
fn a_planar_scene_is_distinguished_from_a_rotating_camera() {
    // A wall seen from three places: homographies that no rotation explains.
    let pose = |x: f64, skew: f64| Matrix3::new(1.0, 0.02, x, 0.01, 1.0, 0.0, skew, 0.0, 1.0);
    let truth: Vec<View> = [pose(0.0, 0.0), pose(-0.35, 0.15), pose(-0.7, -0.12)]
        .iter()
        .map(|m| View { camera: Camera::from_focal(600, 400, 550.0), from_world: *m })
        .collect();
    let pairs = pairs(&truth);
    assert!(pairs.len() >= 2);
    let found = align(&photos(3), &pairs, &AlignOptions::default(), &Silent).unwrap();
    assert_eq!(found.motion, CameraMotion::Homography);
    // Exact matches of exact homographies.
    assert!(found.rms_px < 0.01, "{}", found.rms_px);
    let forced = AlignOptions { motion: CameraMotion::Rotation, ..AlignOptions::default() };
    // (At several pixels a pair may also be left out as inconsistent.)
    let turned = align(&photos(3), &pairs, &forced, &Silent).unwrap();
    assert!(turned.rms_px > 1.0 || turned.used().count() < 3, "{}", turned.rms_px);
}

#[test]
fn a_flat_map_of_twelve_views_is_a_plan_of_it() {
    // A map seen from a grid of 4 × 3 places at heights of 0.85 to 1.15, the camera tilted by up to ten degrees.
    let camera = Camera { distortion: Distortion::radial(-0.08, 0.01), ..Camera::from_focal(600, 400, 550.0) };
    let tilt = |k: usize, m: usize| 0.18 * (((k * m) % 7) as f64 / 3.0 - 1.0);
    let truth: Vec<View> = (0..12)
        .map(|k| {
            let r = Rotation3::from_euler_angles(tilt(k, 3), tilt(k, 5), 0.5 * tilt(k, 2)).into_inner();
            let from = Vector3::new(0.5 * (k % 4) as f64, 0.4 * (k / 4) as f64, -1.0 - 0.8 * tilt(k, 4));
            let to_camera = Matrix3::from_columns(&[r.column(0).into(), r.column(1).into(), -(r * from)]);
            View { camera, from_world: to_camera }
        })
        .collect();
    // Places of features on plain pictures are good to a tenth of a pixel: ±0.15.
    let mut state = 7_u32;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        0.3 * (f64::from(state >> 8) / f64::from(1 << 24) - 0.5)
    };
    let mut matched = pairs(&truth);
    for m in matched.iter_mut().flat_map(|p| &mut p.matches) {
        for p in [&mut m.a, &mut m.b] {
            (p.x, p.y) = (p.x + noise(), p.y + noise());
        }
    }
    let known = vec![Photo { camera: Some(camera), ..Photo::new(600, 400) }; 12];
    for motion in [CameraMotion::Auto, CameraMotion::Homography] {
        let options = AlignOptions { motion, ..AlignOptions::default() };
        let found = align(&known, &matched, &options, &Silent).unwrap();
        assert_eq!((found.motion, found.used().count()), (CameraMotion::Homography, 12));
        // Corners of all photographs on the plan and on the map, in pixels.
        let on_plane = |view: &View, corner: Point2<f64>| {
            let ray = view.ray(corner).unwrap();
            Vector2::new(ray.x / ray.z, ray.y / ray.z) * 550.0
        };
        let of_photo = [(0.0, 0.0), (599.0, 0.0), (599.0, 399.0), (0.0, 399.0)].map(|(x, y)| Point2::new(x, y));
        let corners: Vec<(Vector2<f64>, Vector2<f64>)> = found
            .used()
            .flat_map(|(i, view)| of_photo.map(|p| (i, *view, p)))
            .map(|(i, view, p)| (on_plane(&view, p), on_plane(&truth[i], p)))
            .collect();
        // The similarity that fits best, as complex numbers.
        let n = corners.len() as f64;
        let mean = corners.iter().fold((Vector2::zeros(), Vector2::zeros()), |m, c| (m.0 + c.0 / n, m.1 + c.1 / n));
        let (mut product, mut square) = (Vector2::zeros(), 0.0);
        for (a, b) in corners.iter().map(|c| (c.0 - mean.0, c.1 - mean.1)) {
            product += Vector2::new(a.dot(&b), a.x * b.y - a.y * b.x);
            square += a.norm_squared();
        }
        let turn = product / square;
        let drift = corners
            .iter()
            .map(|c| (c.0 - mean.0, c.1 - mean.1))
            .map(|(a, b)| (Vector2::new(turn.x * a.x - turn.y * a.y, turn.y * a.x + turn.x * a.y) - b).norm());
        let worst = drift.fold(0.0, f64::max);
        // The bar of panoramas of plans, in pixels of the photographs.
        assert!(worst < 1.0, "{motion:?}: {worst}");
        // As upright and as large as the photographs are.
        assert!((turn.norm() - 1.0).abs() < 0.1 && turn.y.abs() < 0.1, "{turn}");
    }
}

#[test]
fn a_calibrated_camera_stays_constant_and_a_wrong_prior_is_corrected() {
    let truth = sweep();
    let pairs = pairs(&truth);
    let camera = truth[0].camera;
    let known: Vec<Photo> = photos(4).into_iter().map(|p| Photo { camera: Some(camera), ..p }).collect();
    let found = align(&known, &pairs, &AlignOptions::default(), &Silent).unwrap();
    assert!(found.used().all(|(_, v)| v.camera == camera));
    assert!(rotation_error(&found, &truth) < 1e-6);
    // A hint off by a third: hundreds of exact matches weigh more than a prior of 0.2.
    let hinted: Vec<Photo> = photos(4).into_iter().map(|p| Photo { focal: Some(750.0), ..p }).collect();
    let found = align(&hinted, &pairs, &AlignOptions::default(), &Silent).unwrap();
    assert!(found.used().all(|(_, v)| (v.camera.fx / 550.0 - 1.0).abs() < 0.01));
}

#[test]
fn the_order_of_the_pairs_and_which_photograph_comes_first_in_them_change_nothing() {
    let truth = sweep();
    let one = pairs(&truth);
    let mut two = one.clone();
    two.reverse();
    let first = align(&photos(4), &one, &AlignOptions::default(), &Silent).unwrap();
    let second = align(&photos(4), &two, &AlignOptions::default(), &Silent).unwrap();
    assert_eq!(first.views, second.views);
}

#[test]
fn resizing_keeps_directions_and_scales_errors() {
    let truth = sweep();
    let small = align(&photos(4), &pairs(&truth), &AlignOptions::default(), &Silent).unwrap();
    let large = small.resized(&[(2.5, (1500, 1000)); 4]);
    for ((_, a), (_, b)) in small.used().zip(large.used()) {
        assert_eq!((b.camera.width, b.camera.height), (1500, 1000));
        // Pixel centers at integers: (x + ½) scales.
        let (p, q) = (Point2::new(100.0, 300.0), Point2::new(100.5 * 2.5 - 0.5, 300.5 * 2.5 - 0.5));
        assert!((a.ray(p).unwrap() - b.ray(q).unwrap()).norm() < 1e-12);
    }
    assert!((large.rms_px - 2.5 * small.rms_px).abs() < 1e-12);
    assert!((large.pairs[0].matches[0].a.x - ((small.pairs[0].matches[0].a.x + 0.5) * 2.5 - 0.5)).abs() < 1e-9);
}

#[test]
fn invalid_input_gives_typed_errors() {
    let truth = sweep();
    let pairs = pairs(&truth);
    let go =
        |photos: &[Photo], pairs: &[VerifiedPair]| align(photos, pairs, &AlignOptions::default(), &Silent).unwrap_err();
    assert_eq!(go(&photos(1), &[]), AlignError::TooFewPhotos { got: 1 });
    assert_eq!(go(&photos(3), &[]), AlignError::NoOverlap { photos: 3 });
    assert_eq!(go(&photos(2), &pairs), AlignError::BadPair { a: 1, b: 2, photos: 2 });
    let itself = VerifiedPair { b: 0, ..pairs[0].clone() };
    assert_eq!(go(&photos(4), &[itself]), AlignError::BadPair { a: 0, b: 0, photos: 4 });
    let mut empty = photos(4);
    empty[2].width = 0;
    assert_eq!(go(&empty, &pairs), AlignError::BadPhoto { index: 2 });
    let mut other = photos(4);
    other[1].camera = Some(Camera::from_focal(601, 400, 500.0));
    assert_eq!(go(&other, &pairs), AlignError::BadPhoto { index: 1 });
}

#[test]
fn alignment_is_cancelled_at_any_report() {
    let truth = sweep();
    let pairs = pairs(&truth);
    let watched = StopAt::never();
    align(&photos(4), &pairs, &AlignOptions::default(), &watched).unwrap();
    assert!(watched.reports() >= 6);
    for at in 1..=watched.reports() {
        let stopped = align(&photos(4), &pairs, &AlignOptions::default(), &StopAt::report(at));
        assert_eq!(stopped.unwrap_err(), AlignError::Cancelled(Cancelled), "{at}");
    }
}

#[test]
fn an_alignment_of_inexact_matches_is_refined() {
    let truth = three_views();
    let images = lumas(&truth);
    let size = (320, 240);
    let pairs: Vec<VerifiedPair> = [(0, 1), (1, 2)]
        .map(|(i, j)| {
            verify_pair((i, size), (j, size), &inexact_matches(&truth[i], &truth[j], 0.7), &VerifyOptions::default())
                .unwrap()
        })
        .to_vec();
    let photos = vec![Photo::new(320, 240); 3];
    let options = AlignOptions { motion: CameraMotion::Rotation, ..AlignOptions::default() };
    let rough = align(&photos, &pairs, &options, &Silent).unwrap();
    let refined = refine_alignment(&images, &photos, &pairs, rough.clone(), &options, &Silent).unwrap();
    // Angle of the relative rotation of the outer two, and the focal length, against the truth.
    let error = |found: &Alignment| {
        let [a, b] = [0, 2].map(|i| found.views[i].unwrap());
        let off: Matrix3<f64> = b.from_world
            * a.from_world.transpose()
            * (truth[2].from_world * truth[0].from_world.transpose()).transpose();
        (Vector3::new(off[(2, 1)], off[(0, 2)], off[(1, 0)]).norm() * 300.0, (a.camera.fx - 300.0).abs())
    };
    let (before, after) = (error(&rough), error(&refined));
    // Errors of up to 0.1 px in place of ±0.7 (0.4 of standard deviation) along each axis, of as many matches.
    assert!(after.0 < 0.25 * before.0.max(0.5) && after.1 < 0.25 * before.1.max(0.5), "{before:?} {after:?}");
    assert_eq!(refined.pairs.len(), rough.pairs.len());
    assert_eq!(refined.pairs[0].matches, rough.pairs[0].matches);
    // Without pixels nothing changes.
    let blank = vec![GrayU8::new(320, 240, [9]); 3];
    let same = refine_alignment(&blank, &photos, &pairs, rough.clone(), &options, &Silent).unwrap();
    assert!((same.rms_px - rough.rms_px).abs() < 1e-3);
    let stopped = refine_alignment(&images, &photos, &pairs, rough, &options, &StopAt::report(3));
    assert_eq!(stopped.unwrap_err(), Cancelled);
}
