//! Ground truth against formulas that are independent of the renderer.

use cv_core::{Camera, Distortion, Point2, Pose};
use cv_synth::*;
use nalgebra::{Point3, Rotation3, Vector3};

fn camera() -> Camera {
    Camera::from_focal(96, 72, 90.0)
}

fn lens() -> Camera {
    Camera { distortion: Distortion::radial_tangential4([-0.18, 0.05, 0.002, -0.001]), ..camera() }
}

fn somewhere() -> Pose {
    Pose::new(Rotation3::from_euler_angles(0.1, -0.2, 0.05), Vector3::new(0.2, -0.1, 0.3))
}

#[test]
fn depth_of_a_slanted_plane_is_that_of_the_plane_equation() {
    let mut b = SceneBuilder::new();
    let (u, v) = (Vector3::new(16.0, 0.0, 8.0), Vector3::new(0.0, 19.0, 0.0));
    b.rect(Point3::new(-7.0, -9.5, 0.5), u, v, Texture::Paint { color: [0.5; 3], seed: 1 });
    let scene = b.build(Pose::identity());
    for (camera, pose) in [(camera(), Pose::identity()), (lens(), somewhere())] {
        let view = render(&scene, &camera, &pose, &RenderOptions::ideal()).unwrap();
        // The plane n·X = d in the camera frame: n ∝ (−4, 0, 8).
        let n = pose.rotation * Vector3::new(-4.0, 0.0, 8.0);
        let d = n.dot(&pose.transform(&Point3::new(-7.0, -9.5, 0.5)).coords);
        for (x, y) in [(0, 0), (95, 71), (40, 30), (3, 60)] {
            let ray = camera.normalize(Point2::new(x as f64, y as f64));
            let z = d / n.dot(&Vector3::new(ray.x, ray.y, 1.0));
            // f32 rounding: 6e-8 of the value.
            assert!((f64::from(view.depth.at(x, y)[0]) - z).abs() < 1.2e-7 * z, "({x}, {y})");
        }
    }
}

#[test]
fn depth_and_silhouette_of_a_sphere_are_those_of_the_sphere_equation() {
    let mut b = SceneBuilder::new();
    let (center, radius) = (Point3::new(0.1, -0.05, 2.0), 0.4);
    b.object("ball").sphere(center, radius, Texture::Plain([0.5; 3]));
    let scene = b.build(Pose::identity());
    let camera = camera();
    let view = render(&scene, &camera, &Pose::identity(), &RenderOptions::ideal()).unwrap();
    let (mut hits, mut misses) = (0, 0);
    for y in 0..72 {
        for x in 0..96 {
            let n = camera.normalize(Point2::new(x as f64, y as f64));
            let dir = Vector3::new(n.x, n.y, 1.0);
            let along = dir.normalize();
            let nearest = along.dot(&center.coords);
            let miss = (center.coords - along * nearest).norm();
            if miss < radius {
                let z = (nearest - (radius * radius - miss * miss).sqrt()) * along.z;
                // At the silhouette, cancellation loses at most half the digits of f64; f32 rounding elsewhere.
                assert!((f64::from(view.depth.at(x, y)[0]) - z).abs() < 1e-6, "({x}, {y})");
                assert_eq!(view.ids.at(x, y), [1]);
                hits += 1;
            } else {
                assert!(view.depth.at(x, y)[0].is_nan() && view.ids.at(x, y) == [0]);
                misses += 1;
            }
        }
    }
    assert!(hits > 500 && misses > 500);
}

#[test]
fn frusta_and_boxes_satisfy_their_equations() {
    let mut b = SceneBuilder::new();
    let (base, top) = (Point3::new(-0.6, 0.5, 2.0), Point3::new(-0.4, -0.5, 2.3));
    b.object("tube").tube(base, top, (0.2, 0.1), Texture::Plain([0.5; 3]));
    let turn = Rotation3::from_euler_angles(0.3, 0.5, -0.2);
    let (middle, size) = (Point3::new(0.5, 0.0, 2.2), [0.5, 0.4, 0.3]);
    let plain = Texture::Plain([0.5; 3]);
    b.object("box").tilted_block(middle, size, turn, [&plain, &plain, &plain]);
    let scene = b.build(Pose::identity());
    let camera = camera();
    let view = render(&scene, &camera, &Pose::identity(), &RenderOptions::ideal()).unwrap();
    let mut counts = [0; 3];
    for (y, x) in (0..72).flat_map(|y| (0..96).map(move |x| (y, x))) {
        let id = view.ids.at(x, y)[0] as usize;
        counts[id] += 1;
        let Some(p) = scene.point_at(&camera, &Pose::identity(), Point2::new(x as f64, y as f64)) else { continue };
        if id == 1 {
            let axis = top - base;
            let h = (p - base).dot(&axis) / axis.norm_squared();
            let r = (p - base - axis * h).norm();
            assert!((r - (0.2 - 0.1 * h)).abs() < 1e-9 && (0.0..=1.0).contains(&h));
        } else {
            let q = turn.inverse() * (p - middle);
            let off = (0..3).map(|a| (q[a].abs() - size[a] / 2.0).abs()).fold(f64::INFINITY, f64::min);
            assert!(off < 1e-9 && (0..3).all(|a| q[a].abs() < size[a] / 2.0 + 1e-9));
            // The visible points of a convex body are on its near side.
            assert!(p.coords.norm() < middle.coords.norm() + 0.4);
        }
    }
    assert!(counts.iter().all(|&c| c > 100), "{counts:?}");
}

#[test]
fn a_box_shows_the_face_that_is_hit() {
    let colors = [[0.9, 0.1, 0.1], [0.1, 0.9, 0.1], [0.1, 0.1, 0.9]];
    let [front, side, top] = colors.map(Texture::Plain);
    for (eye, expected) in [
        (Point3::new(0.0, 0.0, -3.0), 0),
        (Point3::new(0.0, 0.0, 3.0), 0),
        (Point3::new(3.0, 0.0, 0.0), 1),
        (Point3::new(-3.0, 0.0, 0.0), 1),
        (Point3::new(0.0, -3.0, 0.001), 2),
        (Point3::new(0.0, 3.0, 0.001), 2),
    ] {
        let mut b = SceneBuilder::new();
        b.tilted_block(Point3::origin(), [1.0, 1.0, 1.0], Rotation3::identity(), [&front, &side, &top]);
        let pose = Pose::look_at(eye, Point3::origin(), Vector3::y()).unwrap();
        let view = render(&b.build(pose), &camera(), &pose, &RenderOptions::ideal()).unwrap();
        let pixel = view.linear.at(48, 36);
        let strongest = (0..3).max_by(|&a, &b| pixel[a].total_cmp(&pixel[b]));
        assert_eq!(strongest, Some(expected), "from {eye}: {pixel:?}");
    }
}

#[test]
fn unprojection_by_depth_inverts_projection() {
    let scene = Scene::room(3);
    let pose = scene.viewpoint();
    let with = |distortion| Camera { distortion, ..camera() };
    let fisheye = with(Distortion::fisheye4([0.05, -0.01, 0.0, 0.0]));
    let prism = [0.3, 0.02, 0.001, 0.002, 0.0, 0.4, 0.0, 0.0, 0.003, 0.0, -0.002, 0.0];
    for camera in [camera(), lens(), fisheye, with(Distortion::thin_prism12(prism))] {
        let view = render(&scene, &camera, &pose, &RenderOptions::ideal()).unwrap();
        for (x, y) in (0..72).step_by(7).flat_map(|y| (0..96).step_by(5).map(move |x| (x, y))) {
            let p = view.world_point(x, y).unwrap();
            let q = camera.project(&pose.transform(&p)).unwrap();
            // 6e-8 of the depth moves a point along its ray only; the rest is f64 and Newton's 1e-13.
            assert!((q - Point2::new(x as f64, y as f64)).norm() < 1e-9, "({x}, {y}) {q}");
        }
    }
}

#[test]
fn disparity_warps_each_view_onto_the_other() {
    let scene = Scene::tabletop(2);
    let camera = Camera::from_focal(200, 150, 170.0);
    let pair = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.07, &RenderOptions::ideal()).unwrap();
    let (mut seen, mut occluded_count, mut close) = (0, 0, 0);
    for (x, y) in (0..150).flat_map(|y| (0..200).map(move |x| (x, y))) {
        let d = f64::from(pair.disparity.at(x, y)[0]);
        if !pair.visible.at(x, y)[0] {
            occluded_count += 1;
            continue;
        }
        seen += 1;
        let to = Point2::new(x as f64 - d, y as f64);
        let there = scene.point_at(&camera, &pair.right.pose, to).unwrap();
        let here = pair.left.world_point(x, y).unwrap();
        // The same point up to the f32 disparity: 1e-7 of 40 px is 4e-6 px, 5e-8 m there. Exactly on an edge a ray may
        // miss: such pixels are counted.
        close += usize::from((there - here).norm() < 1e-5);
    }
    assert!(seen > 20_000 && occluded_count > 200, "{seen} {occluded_count}");
    assert!(close as f64 > 0.9995 * f64::from(seen), "{close} of {seen}");
    // Occluded pixels: the right view has a nearer surface, or they are out of view.
    let occluded = pair.occluded();
    for (x, y) in (0..150).step_by(3).flat_map(|y| (0..200).map(move |x| (x, y))) {
        if occluded.at(x, y)[0] {
            let to = Point2::new(x as f64 - f64::from(pair.disparity.at(x, y)[0]), y as f64);
            let here = pair.right.pose.transform(&pair.left.world_point(x, y).unwrap());
            let front = scene.point_at(&camera, &pair.right.pose, to).map(|p| pair.right.pose.transform(&p).z);
            assert!(to.x < -0.499 || front.is_some_and(|z| z < here.z - 1e-7), "({x}, {y})");
        }
    }
}

#[test]
fn homographies_map_pixels_to_the_same_point_and_color() {
    let camera = Camera::from_focal(240, 180, 210.0);
    for seed in 0..4 {
        let pair = homography_pair(seed, &camera, 0.4, &RenderOptions::ideal()).unwrap();
        let scene = Scene::poster_wall(seed);
        let (mut n, mut sum) = (0, [0.0; 3]);
        for (x, y) in (2..178).step_by(5).flat_map(|y| (2..238).step_by(5).map(move |x| (x, y))) {
            let q = pair.homography * Vector3::new(x as f64, y as f64, 1.0);
            let q = Point2::new(q.x / q.z, q.y / q.z);
            let p = scene.point_at(&camera, &pair.a.pose, Point2::new(x as f64, y as f64)).unwrap();
            let r = camera.project(&pair.b.pose.transform(&p)).unwrap();
            // Both are computed in f64.
            assert!((q - r).norm() < 1e-8, "{q} {r}");
            if q.x > 1.0 && q.y > 1.0 && q.x < 238.0 && q.y < 178.0 {
                let (i, j) = (q.x.round() as usize, q.y.round() as usize);
                let (a, b) = (pair.a.linear.at(x, y), pair.b.linear.at(i, j));
                n += 1;
                (0..3).for_each(|c| sum[c] += f64::from(a[c] - b[c]).abs());
            }
        }
        // Nearest pixels of a printed wall: a wrong homography has mean differences of 0.25.
        assert!(n > 700 && sum.iter().all(|s| s / f64::from(n) < 0.08), "{n} {sum:?}");
    }
}

#[test]
fn the_homographies_of_a_panorama_agree_with_its_correspondences() {
    let camera = Camera::from_focal(80, 60, 70.0);
    let options = PanoramaSetOptions { views: 3, walker: true, ..PanoramaSetOptions::default() };
    let set = panorama_views(4, &camera, &options, &RenderOptions::default()).unwrap();
    let scene = Scene::room(4);
    let h = set.homography(0, 1).unwrap();
    let pairs = scene.correspondences(&set.views[0], &set.views[1], 4);
    assert!(pairs.len() > 60, "{}", pairs.len());
    for c in pairs {
        let q = h * Vector3::new(c.a.x, c.a.y, 1.0);
        assert!((q.x / q.z - c.b.x).hypot(q.y / q.z - c.b.y) < 1e-8);
        assert!((set.transfer(0, 1, c.a).unwrap() - c.b).norm() < 1e-8);
    }
    // Points in front of one view are behind one with the opposite direction.
    let around = PanoramaSetOptions { views: 4, overlap: 0.1, ..PanoramaSetOptions::default() };
    let around = panorama_views(4, &camera, &around, &RenderOptions::default()).unwrap();
    assert!(
        around.transfer(0, 3, Point2::new(39.5, 29.5)).is_none() && around.transfer(0, 4, Point2::origin()).is_none()
    );
    // The person is visible in some view, in none wholly.
    let visible_pixels: Vec<usize> = set.walker.iter().map(|m| m.pixels().filter(|p| p[0]).count()).collect();
    assert!(
        visible_pixels.iter().sum::<usize>() > 30 && visible_pixels.iter().all(|&s| s < 2400),
        "{visible_pixels:?}"
    );
}

#[test]
fn epipolar_geometry_holds_between_two_views() {
    for camera in [camera(), lens()] {
        let pair = two_view(5, &camera, 0.5, &RenderOptions::default()).unwrap();
        let t = pair.relative.translation;
        assert!((t.norm() - 0.5).abs() < 1e-12);
        let essential = t.cross_matrix() * pair.relative.rotation.matrix();
        let matches = pair.scene.correspondences(&pair.a, &pair.b, 5);
        assert!(matches.len() > 100, "{}", matches.len());
        for c in matches {
            let (a, b) = (camera.normalize(c.a), camera.normalize(c.b));
            let e = Vector3::new(b.x, b.y, 1.0).dot(&(essential * Vector3::new(a.x, a.y, 1.0)));
            // Newton's 1e-13 and a few roundings of f64.
            assert!(e.abs() < 1e-10, "{e}");
        }
    }
}

#[test]
fn the_balls_mask_is_its_projection() {
    let camera = Camera::from_focal(120, 160, 130.0);
    let photos = ball_photos(1, 4, &camera, &RenderOptions::default()).unwrap();
    for photo in photos {
        let pixels = photo.mask.pixels().filter(|p| p[0]).count() as f64;
        // A ball of angular radius asin(r/d) covers about π (f tan)² pixels near the optical axis, more off it.
        let tan = (0.10 / photo.distance).asin().tan();
        let expected = std::f64::consts::PI * (130.0 * tan).powi(2);
        assert!(pixels > 0.6 * expected && pixels < 1.6 * expected, "{pixels} {expected} at {}", photo.distance);
        let (mut orange, mut all) = (0, 0);
        for (p, [inside]) in photo.view.image.pixels().zip(photo.mask.pixels()) {
            if inside {
                all += 1;
                orange += usize::from(p[0] > p[1] && p[1] > p[2]);
            }
        }
        assert!(orange as f64 > 0.95 * f64::from(all), "{orange} of {all}");
    }
}

#[test]
fn the_same_seed_gives_the_same_bytes_with_any_number_of_threads() {
    let camera = lens();
    let take = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let scene = Scene::tabletop(9);
            render(&scene, &camera, &scene.viewpoint(), &RenderOptions::default().with_seed(3)).unwrap()
        })
    };
    let (one, many) = (take(1), take(5));
    assert_eq!(one.image, many.image);
    assert_eq!(one.linear, many.linear);
    let bits = |v: &Rendered| v.depth.as_slice().iter().map(|d| d.to_bits()).collect::<Vec<_>>();
    assert_eq!((bits(&one), &one.ids), (bits(&many), &many.ids));
    let other = Scene::tabletop(10);
    let other = render(&other, &camera, &other.viewpoint(), &RenderOptions::default()).unwrap();
    assert_ne!(one.image, other.image);
}

#[test]
fn a_distorted_image_is_the_undistorted_one_warped() {
    let scene = Scene::poster_wall(6);
    let ideal = Camera::from_focal(240, 180, 210.0);
    let lens = Camera { distortion: Distortion::radial(-0.2, 0.03), ..ideal };
    let options = RenderOptions { blur: 1.0, ..RenderOptions::ideal() };
    let a = render(&scene, &ideal, &scene.viewpoint(), &options).unwrap();
    let b = render(&scene, &lens, &scene.viewpoint(), &options).unwrap();
    let (mut moved, mut stayed, mut n) = (0.0, 0.0, 0.0);
    for (x, y) in (10..170).flat_map(|y| (10..230).map(move |x| (x, y))) {
        let q = lens.denormalize(ideal.normalize(Point2::new(x as f64, y as f64)));
        let (i, j) = (q.x.round() as usize, q.y.round() as usize);
        moved += f64::from((a.linear.at(x, y)[1] - b.linear.at(i, j)[1]).abs());
        stayed += f64::from((a.linear.at(x, y)[1] - b.linear.at(x, y)[1]).abs());
        n += 1.0;
    }
    // Only the rounding to the nearest pixel remains.
    assert!(moved < 0.35 * stayed, "{} {}", moved / n, stayed / n);
}

#[test]
fn invalid_input_is_an_error() {
    let scene = Scene::poster_wall(1);
    let bad = Camera::from_focal(10, 10, f64::NAN);
    let options = RenderOptions::default();
    let pose = Pose::identity();
    assert!(matches!(render(&scene, &bad, &pose, &options), Err(SynthError::Camera(_))));
    let empty = Camera::from_focal(0, 10, 10.0);
    assert!(matches!(render(&scene, &empty, &pose, &options), Err(SynthError::Size { width: 0, height: 10 })));
    let lost = Pose::new(Rotation3::identity(), Vector3::new(f64::NAN, 0.0, 0.0));
    assert!(matches!(render(&scene, &camera(), &lost, &options), Err(SynthError::Pose)));
    assert!(matches!(stereo_pair(&scene, &lens(), &pose, 0.1, &options), Err(SynthError::Stereo { .. })));
    assert!(matches!(stereo_pair(&scene, &camera(), &pose, -0.1, &options), Err(SynthError::Stereo { .. })));
    let one = render(&scene, &Camera::from_focal(1, 1, 1.0), &pose, &options).unwrap();
    assert_eq!(one.image.size(), (1, 1));
}

#[test]
fn an_image_does_not_depend_on_earlier_images() {
    // Irradiance is computed on demand.
    let side = |scene: &Scene| {
        let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), 0.7);
        Pose::new(turn * scene.viewpoint().rotation, turn * scene.viewpoint().translation)
    };
    let taken = |scene: &Scene, pose: &Pose| render(scene, &camera(), pose, &RenderOptions::default()).unwrap();
    let (first, second) = (Scene::tabletop(4), Scene::tabletop(4));
    let before = (taken(&first, &first.viewpoint()), taken(&first, &side(&first)));
    let after = (taken(&second, &side(&second)), taken(&second, &second.viewpoint()));
    for (a, b) in [(before.0, after.1), (before.1, after.0)] {
        assert_eq!((a.image.as_slice(), a.linear.as_slice()), (b.image.as_slice(), b.linear.as_slice()));
    }
}

#[test]
fn a_retaken_pair_is_the_one_rendered_at_that_exposure() {
    let (scene, options) = (Scene::room(2), RenderOptions::default());
    let pair = stereo_pair(&scene, &camera(), &scene.viewpoint(), 0.2, &options).unwrap();
    // Powers of two: gains are exact.
    let other = RenderOptions { exposure: -1.0, seed: 7, full_well: 3000.0, ..options };
    let (again, expected) =
        (pair.retake(-1.0, &other), stereo_pair(&scene, &camera(), &scene.viewpoint(), 0.2, &other).unwrap());
    assert!(again.left.image == expected.left.image && again.right.image == expected.right.image);
    assert!(again.left.linear == expected.left.linear && again.left.image != pair.left.image);
}
