//! Folders of models of COLMAP.

use cv_core::{Camera, Distortion, ModelImage, ModelPoint, Point2, Point3, Pose, Rotation3, SparseModel, Vector3};
use cv_io::DEFAULT_MAX_PIXELS;
use cv_io::colmap::{ModelFormat, parse_cameras, read, replace, write, write_binary};
use proptest::prelude::*;

proptest! {
    // Files are synced, which takes milliseconds: a model has eight images, for an eighth of the cases.
    #![proptest_config(ProptestConfig::with_cases(ProptestConfig::default().cases / 8))]

    #[test]
    fn models_round_trip(views in prop::collection::vec(
        (
            prop::array::uniform3(-3.0..3.0f64),
            prop::array::uniform3(-1e3..1e3f64),
            prop::array::uniform2(0.0..4000.0f64),
            -0.5..0.5f64,
        ),
        8,
    )) {
        let mut model = SparseModel::default();
        for (i, (r, t, xy, k)) in views.into_iter().enumerate() {
            let camera = Camera {
                distortion: Distortion::radial_tangential5([k, 0.1, 0.0, 0.01, k]),
                ..Camera::pinhole(4000, 3000, 2500.0, 2501.0, xy[0], xy[1])
            };
            let pose = Pose::new(Rotation3::from_euler_angles(r[0], r[1], r[2]), Vector3::from(t));
            let (camera_id, image_id, point_id) = (7 + i as u32, 3 + i as u32, 9 + i as u64);
            let points = vec![(Point2::new(xy[0], xy[1]), Some(point_id)), (Point2::new(1.0, 2.0), None)];
            model.cameras.insert(camera_id, camera);
            model.images.insert(image_id, ModelImage { name: "a b.jpg".into(), camera: camera_id, pose, points });
            let track = vec![(image_id, 0)];
            let point = ModelPoint { position: Point3::from(t), color: [1, 2, 3], error: 0.5, track };
            model.points.insert(point_id, point);
        }
        for binary in [false, true] {
            let folder = tempfile::tempdir().unwrap();
            if binary { write_binary(folder.path(), &model) } else { write(folder.path(), &model) }.unwrap();
            let back = read(folder.path()).unwrap();
            prop_assert_eq!(&back.points, &model.points);
            prop_assert!(back.images.keys().eq(model.images.keys()) && back.cameras.keys().eq(model.cameras.keys()));
            for (b, image) in back.images.values().zip(model.images.values()) {
                prop_assert_eq!((&b.name, b.camera, b.points[1]), (&image.name, image.camera, image.points[1]));
                // Half a pixel added and taken away costs the last bits of a number up to 4000; a rotation through a quaternion likewise.
                prop_assert!((b.points[0].0 - image.points[0].0).norm() < 1e-11);
                prop_assert!((b.pose.rotation.matrix() - image.pose.rotation.matrix()).norm() < 1e-13);
                prop_assert_eq!(b.pose.translation, image.pose.translation);
            }
            for (c, camera) in back.cameras.values().zip(model.cameras.values()) {
                prop_assert!((c.cx - camera.cx).abs() < 1e-11 && c.fx == camera.fx);
                prop_assert_eq!(c.distortion.simplified(), camera.distortion.simplified());
            }
        }
    }
}

#[test]
fn models_with_dangling_references_are_not_written() {
    let folder = tempfile::tempdir().unwrap();
    let image = ModelImage { name: "a".into(), camera: 1, pose: Pose::identity(), points: vec![] };
    let mut model = SparseModel { images: [(1, image)].into(), ..SparseModel::default() };
    assert!(write(folder.path(), &model).is_err());
    model.cameras.insert(1, Camera::from_focal(4, 4, 4.0));
    assert!(write(folder.path(), &model).is_ok());
    let point = ModelPoint { position: Point3::origin(), color: [0; 3], error: f64::NAN, track: vec![(1, 0)] };
    model.points.insert(1, point);
    assert!(write(folder.path(), &model).unwrap_err().to_string().contains("point 1"));
}

#[test]
fn the_binary_model_is_preferred() {
    let folder = tempfile::tempdir().unwrap();
    let model =
        |focal| SparseModel { cameras: [(1, Camera::from_focal(4, 4, focal))].into(), ..SparseModel::default() };
    let focal = || read(folder.path()).unwrap().cameras[&1].fx;
    write(folder.path(), &model(5.0)).unwrap();
    assert_eq!(focal(), 5.0);
    write_binary(folder.path(), &model(6.0)).unwrap();
    assert_eq!(focal(), 6.0);
    // An incomplete binary model is ignored.
    std::fs::remove_file(folder.path().join("images.bin")).unwrap();
    assert_eq!(focal(), 5.0);
    std::fs::remove_file(folder.path().join("images.txt")).unwrap();
    assert!(read(folder.path()).unwrap_err().to_string().contains("images.txt"));
}

#[test]
fn a_model_replaces_one_of_the_other_format() {
    let folder = tempfile::tempdir().unwrap();
    let model =
        |focal| SparseModel { cameras: [(1, Camera::from_focal(4, 4, focal))].into(), ..SparseModel::default() };
    let focal = || read(folder.path()).unwrap().cameras[&1].fx;
    let names = || {
        let files = std::fs::read_dir(folder.path()).unwrap();
        let mut names: Vec<_> = files.map(|f| f.unwrap().file_name().into_string().unwrap()).collect();
        names.sort();
        names
    };
    for name in ["notes.txt", "frames.bin"] {
        std::fs::write(folder.path().join(name), "x").unwrap();
    }
    for (focal_px, format, ending, replaced) in [
        (5.0, ModelFormat::Binary, "bin", true),
        (6.0, ModelFormat::Text, "txt", true),
        (7.0, ModelFormat::Text, "txt", false),
        (8.0, ModelFormat::Binary, "bin", true),
    ] {
        assert_eq!(replace(folder.path(), &model(focal_px), format).unwrap(), replaced);
        assert_eq!(focal(), focal_px);
        let mut wanted = ["cameras", "images", "points3D"].map(|stem| format!("{stem}.{ending}")).to_vec();
        wanted.push("notes.txt".to_owned());
        wanted.sort();
        assert_eq!(names(), wanted);
    }
    // A failed write leaves the existing model.
    let image = ModelImage { name: "a".into(), camera: 9, pose: Pose::identity(), points: vec![] };
    let wrong = SparseModel { images: [(1, image)].into(), ..SparseModel::default() };
    assert!(replace(folder.path(), &wrong, ModelFormat::Text).is_err());
    assert_eq!(focal(), 8.0);
}

#[test]
fn a_camera_with_too_many_pixels_is_refused() {
    let text = format!("1 PINHOLE {} 2 1 1 1 1\n", DEFAULT_MAX_PIXELS);
    assert!(parse_cameras(&text).unwrap_err().to_string().contains("pixels"));
    assert!(parse_cameras(&text.replace(" 2 ", " 1 ")).is_ok());
}
