//! `cv panorama` as a black box: the effect of its options.

use crate::support::{done, fixture, json, refused, run, strs};
use cv_core::{Camera, RgbU8, Vector3};
use cv_synth::{Vista, VistaOptions, vista_photos, vista_response};
use std::f64::consts::PI;
use std::path::Path;

#[test]
fn alpha_is_transparent_where_no_photograph_reaches() {
    let folder = tempfile::tempdir().unwrap();
    let views: Vec<String> =
        (0..3).map(|i| fixture(&format!("panorama/view{i}.jpg")).to_str().unwrap().to_owned()).collect();
    let args = |more: &[&str]| -> Vec<String> {
        let words = ["panorama"].into_iter().chain(strs(&views)).chain(["--projection", "cylindrical"]);
        words.chain(more.iter().copied()).map(str::to_owned).collect()
    };
    done(folder.path(), &strs(&args(&["-o", "plain.png"])));
    done(folder.path(), &strs(&args(&["-o", "alpha.PNG", "--alpha"])));
    let plain = cv_io::read_rgb(folder.path().join("plain.png")).unwrap();
    let file = std::fs::File::open(folder.path().join("alpha.PNG")).unwrap();
    let mut reader = png::Decoder::new(std::io::BufReader::new(file)).read_info().unwrap();
    assert_eq!(reader.output_color_type(), (png::ColorType::Rgba, png::BitDepth::Eight));
    let mut alpha = vec![0; reader.output_buffer_size().unwrap()];
    reader.next_frame(&mut alpha).unwrap();
    assert_eq!(alpha.len(), plain.width() * plain.height() * 4);
    let mut clear = 0;
    for (p, a) in plain.pixels().zip(alpha.chunks_exact(4)) {
        assert_eq!(p, a[..3]);
        match a {
            [0, 0, 0, 0] => clear += 1,
            [_, _, _, 255] => {}
            other => panic!("neither there nor not there: {other:?}"),
        }
    }
    // A cylinder bends the upper and lower edges of photographs: some of the bounding box is empty, most is covered.
    assert!(clear > 100 && 4 * clear < plain.width() * plain.height(), "{clear}");
    assert_eq!(run(folder.path(), &strs(&args(&["-o", "pano.jpg", "--alpha"]))).code, Some(2));
    assert!(!folder.path().join("pano.jpg").exists());
}

#[test]
fn an_exr_has_the_radiance_at_the_exposure_of_the_reference() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 2, 1.0);
    let value = json(folder.path(), &["panorama", &names[0], &names[1], "-o", "light.exr", "--scale", "0.5"]);
    assert_eq!(value["bits"], 32);
    let bytes = std::fs::read(folder.path().join("light.exr")).unwrap();
    assert_eq!(bytes[..8], [0x76, 0x2f, 0x31, 0x01, 2, 0, 0, 0]);
    // The crop: from (0, 0) to the last pixel.
    let place = bytes.windows(17).position(|w| w == b"dataWindow\0box2i\0").unwrap() + 17 + 4;
    let side = |k: usize| i32::from_le_bytes(bytes[place + 4 * k..][..4].try_into().unwrap());
    let size = [0, 1].map(|i| value["size"][i].as_i64().unwrap());
    assert_eq!([0, 1, 2, 3].map(|k| i64::from(side(k))), [0, 0, size[0] - 1, size[1] - 1]);
    assert_eq!(run(folder.path(), &["panorama", &names[0], &names[1], "-o", "a.exr", "--alpha"]).code, Some(2));
    // Radiance has no tone to adapt.
    let adapted = run(folder.path(), &["panorama", &names[0], &names[1], "-o", "a.exr", "--exposure", "adapt"]);
    assert_eq!(adapted.code, Some(2));
    assert!(adapted.stderr.contains("--exposure match"), "{}", adapted.stderr);
}

#[test]
fn brackets_are_reported_and_adaptation_is_the_same_when_streamed() {
    let folder = tempfile::tempdir().unwrap();
    let (_, mut names) = landscape(folder.path(), 2, 0.0);
    // Each again with a quarter of the light.
    for i in 0..2 {
        let photo = cv_io::read_rgb(folder.path().join(&names[i])).unwrap();
        let dark = photo.map(|c| c.map(|v| (f64::from(v) * 0.25_f64.powf(1.0 / 2.2)).round() as u8));
        names.push(format!("{i}_dark.png"));
        cv_io::write_png(folder.path().join(&names[2 + i]), dark.view()).unwrap();
    }
    let made = |output: &'static str, more: &[&'static str]| {
        let args = [&["panorama"], &strs(&names)[..], &["-o", output], more].concat();
        let value = json(folder.path(), &args);
        assert_eq!(value["stacks"], serde_json::json!([[0, 2], [1, 3]]), "{output}: {value}");
        cv_io::read_rgb(folder.path().join(output)).unwrap()
    };
    let matched = made("match.png", &[]);
    let adapted = made("adapt.png", &["--exposure", "adapt"]);
    assert!(adapted == made("streamed.png", &["--exposure", "adapt", "--max-memory", "300"]) && adapted != matched);
}

#[test]
fn a_deep_zoom_image_has_the_size_of_the_panorama_and_the_same_tiles_when_streamed() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 2, 1.0);
    let args = |output: &'static str, more: &[&'static str]| {
        let all = ["panorama", &names[0], &names[1], "-o", output].into_iter().chain(more.iter().copied());
        json(folder.path(), &all.collect::<Vec<_>>())
    };
    let value = args("web/a.dzi", &[]);
    args("web/b.dzi", &["--max-memory", "2000"]);
    let read = |name: &str| std::fs::read(folder.path().join("web").join(name)).unwrap();
    let xml = String::from_utf8(read("a.dzi")).unwrap();
    let [width, height] = [0, 1].map(|i| value["size"][i].as_u64().unwrap());
    assert!(xml.contains(&format!("<Size Width=\"{width}\" Height=\"{height}\"/>")), "{xml}");
    assert_eq!(xml.as_bytes(), read("b.dzi"));
    let levels = width.max(height).next_power_of_two().ilog2();
    for level in 0..=levels {
        // The first tile, and that the number of tiles agrees.
        assert_eq!(read(&format!("a_files/{level}/0_0.jpg")), read(&format!("b_files/{level}/0_0.jpg")), "{level}");
        let count = |name: &str| std::fs::read_dir(folder.path().join(format!("web/{name}/{level}"))).unwrap().count();
        let side = |n: u64| n.div_ceil(1 << (levels - level)).div_ceil(254);
        assert_eq!([count("a_files"), count("b_files")], [(side(width) * side(height)) as usize; 2]);
    }
    // A folder of that name that is not ours is refused before the work.
    std::fs::create_dir(folder.path().join("web/c_files")).unwrap();
    let refused = run(folder.path(), &["panorama", &names[0], &names[1], "-o", "web/c.dzi"]);
    assert_eq!(refused.code, Some(1));
    assert!(refused.stderr.contains("c_files exists and does not belong to a Deep Zoom image"), "{}", refused.stderr);
}

#[test]
fn exif_orientation_does_not_change_the_panorama() {
    let folder = tempfile::tempdir().unwrap();
    let mut sizes = Vec::new();
    for turned in [None, Some(0), Some(1), Some(2)] {
        let mut args = vec!["panorama".to_owned()];
        for i in 0..3 {
            let photo = cv_io::read_rgb(fixture(&format!("panorama/view{i}.jpg"))).unwrap();
            let (w, h) = photo.size();
            let side = RgbU8::from_fn(h, w, |x, y| photo.at(w - 1 - y, x));
            let path = folder.path().join(format!("{i}.png"));
            cv_io::write_png(&path, if turned == Some(i) { side.view() } else { photo.view() }).unwrap();
            args.push(path.to_str().unwrap().to_owned());
        }
        args.extend(["-o", "p.png"].map(str::to_owned));
        let value = json(folder.path(), &strs(&args));
        assert!(value["images"].as_array().unwrap().iter().all(|image| image["used"] == true), "{value}");
        sizes.push([0, 1].map(|i| value["size"][i].as_f64().unwrap()));
    }
    // The features of a photograph and of its rotated copy differ a little, and so does the horizon.
    for size in &sizes[1..] {
        assert!((0..2).all(|i| (size[i] / sizes[0][i] - 1.0).abs() < 0.05), "{sizes:?}");
    }
}

#[test]
fn the_mode_is_applied_reported_and_validated() {
    let folder = tempfile::tempdir().unwrap();
    // Two crops of one planar image: a camera translated along a wall.
    let wall = cv_io::read_rgb(fixture("panorama/view1.jpg")).unwrap();
    let (w, h) = wall.size();
    let wide = 2 * w / 3;
    for (i, left) in [0, w - wide].into_iter().enumerate() {
        let part = wall.view().crop(left, 0, wide, h).unwrap();
        cv_io::write_png(folder.path().join(format!("{i}.png")), part).unwrap();
    }
    let told = |mode: &str| json(folder.path(), &["panorama", "0.png", "1.png", "-o", "p.png", "--mode", mode]);
    let value = told("plane");
    assert_eq!((value["mode"].as_str(), value["projection"].as_str()), (Some("plane"), Some("plane")));
    let size = [0, 1].map(|i| value["size"][i].as_f64().unwrap());
    // The wall again: half a percent of tolerance for matches with errors of a tenth of a pixel.
    assert!((size[0] / w as f64 - 1.0).abs() < 0.005 && (size[1] / h as f64 - 1.0).abs() < 0.005, "{size:?} {w} {h}");
    assert_eq!(told("rotation")["mode"], "rotation");
    assert_eq!(run(folder.path(), &["panorama", "0.png", "1.png", "-o", "q.png", "--mode", "flat"]).code, Some(2));
}

/// Renders photographs of a landscape with known radiance, side by side around the forward direction, as `0.png` … in a folder with their camera `cam.yaml` of 420 × 300
/// pixels and a focal length of 360 px; `exposure`: the range of their exposures in stops.
fn landscape(folder: &Path, views: usize, exposure: f32) -> (Vista, Vec<String>) {
    let vista = Vista::new(5, 90.0);
    let camera = Camera::from_focal(420, 300, 360.0);
    let options = VistaOptions {
        views,
        exposure,
        vignetting: 0.0,
        contrast: 0.0,
        noise: 0.0,
        shake: 0.0,
        ..VistaOptions::default()
    };
    let photos = vista_photos(&vista, 3, &camera, &options).unwrap();
    let names = photos.iter().enumerate().map(|(i, photo)| {
        cv_io::write_png(folder.join(format!("{i}.png")), photo.image.view()).unwrap();
        format!("{i}.png")
    });
    let names = names.collect();
    cv_io::write_camera(folder.join("cam.yaml"), &camera, &[]).unwrap();
    (vista, names)
}

/// Returns the ideal gray levels of a direction.
fn level(vista: &Vista, ray: &Vector3<f64>) -> [f64; 3] {
    vista.radiance(ray).map(|light| 255.0 * f64::from(vista_response(light, 0.0)))
}

/// Returns the direction at a longitude to the right and a latitude above the horizon.
fn direction(longitude: f64, latitude: f64) -> Vector3<f64> {
    Vector3::new(latitude.cos() * longitude.sin(), -latitude.sin(), latitude.cos() * longitude.cos())
}

/// Computes the mean difference in gray levels between an image and the landscape; `ray` returns the direction at a position of the surface (one radian at its center is 1, y down, origin at
/// the image's center). The minimum over shifts of a pixel or two, the accuracy of the alignment.
fn difference(image: &RgbU8, vista: &Vista, ray: impl Fn(f64, f64) -> Vector3<f64>) -> f64 {
    let (w, h) = image.size();
    let at = |dx: f64, dy: f64| {
        let (mut sum, mut n) = (0.0, 0);
        for (x, y) in (3..h - 3).step_by(9).flat_map(|y| (3..w - 3).step_by(9).map(move |x| (x, y))) {
            if image.at(x, y) == [0; 3] {
                continue;
            }
            let place = |v: f64, size: usize| (v - 0.5 * (size as f64 - 1.0)) / 360.0;
            let mut truth = [0.0; 3];
            for (i, j) in [(-0.25, -0.25), (0.25, -0.25), (-0.25, 0.25), (0.25, 0.25)] {
                let light = level(vista, &ray(place(x as f64 + dx + i, w), place(y as f64 + dy + j, h)));
                (0..3).for_each(|c| truth[c] += 0.25 * light[c]);
            }
            sum += (0..3).map(|c| (f64::from(image.at(x, y)[c]) - truth[c]).abs()).sum::<f64>() / 3.0;
            n += 1;
        }
        assert!(n > 500, "{n} pixels");
        sum / f64::from(n)
    };
    let shifts = (-4..=4).flat_map(|dx| (-4..=4).map(move |dy| (0.5 * f64::from(dx), 0.5 * f64::from(dy))));
    shifts.map(|(dx, dy)| at(dx, dy)).fold(f64::INFINITY, f64::min)
}

#[test]
fn every_projection_shows_the_requested_field_of_view() {
    let folder = tempfile::tempdir().unwrap();
    let (vista, names) = landscape(folder.path(), 4, 0.0);
    let go = |more: &[&str]| -> RgbU8 {
        let args = [&["panorama"], &strs(&names)[..], &["-o", "p.png", "--camera", "cam.yaml", "--exposure", "none"]];
        done(folder.path(), &[&args.concat()[..], more].concat());
        cv_io::read_rgb(folder.path().join("p.png")).unwrap()
    };
    let panini = |x: f64, y: f64| {
        let longitude = 2.0 * (0.5 * x).atan();
        direction(longitude, -(0.5 * y * (1.0 + longitude.cos())).atan())
    };
    let mercator = |x: f64, y: f64| direction(x, 0.5 * PI - 2.0 * y.exp().atan());
    let stereographic = |x: f64, y: f64| {
        let (r, angle) = (x.hypot(y), 2.0 * (0.5 * x.hypot(y)).atan());
        if r == 0.0 { Vector3::z() } else { Vector3::new(angle.sin() * x / r, angle.sin() * y / r, angle.cos()) }
    };
    let size = |half_w: f64, half_h: f64| ((720.0 * half_w).round() as usize, (720.0 * half_h).round() as usize);
    let tan = |degrees: f64| degrees.to_radians().tan();
    // Interpolation, half-pixel shifts and seams cause an error of one or two levels on a texture of ±30; a false projection one of 15.
    const BAR: f64 = 4.0;
    let p = go(&["--projection", "panini", "--fov", "110,40"]);
    assert_eq!(p.size(), size(2.0 * tan(27.5), tan(20.0)));
    let d = difference(&p, &vista, panini);
    assert!(d < BAR && difference(&p, &vista, stereographic) > 1.5 * d, "panini: {d}");
    let p = go(&["--projection", "mercator", "--fov", "100,40"]);
    assert_eq!(p.size(), size(50_f64.to_radians(), tan(20.0).asinh()));
    let d = difference(&p, &vista, mercator);
    assert!(d < BAR, "mercator: {d}");
    let p = go(&["--projection", "stereographic", "--fov", "100,40"]);
    assert_eq!(p.size(), size(2.0 * tan(25.0), 2.0 * tan(10.0)));
    let d = difference(&p, &vista, stereographic);
    assert!(d < BAR, "stereographic: {d}");

    // To the right, up, and clockwise: the image of a rotated camera.
    let p = go(&["--projection", "plane", "--fov", "40,30", "--center", "-20,6", "--roll", "10"]);
    assert_eq!(p.size(), size(tan(20.0), tan(15.0)));
    let (yaw, pitch, roll) = (-20_f64.to_radians(), 6_f64.to_radians(), 10_f64.to_radians());
    let turned = |x: f64, y: f64| {
        // The inverse of the image's roll, then pitch, then yaw.
        let (x, y) = (roll.cos() * x + roll.sin() * y, roll.cos() * y - roll.sin() * x);
        let (y, z) = (pitch.cos() * y - pitch.sin(), pitch.sin() * y + pitch.cos());
        Vector3::new(yaw.cos() * x + yaw.sin() * z, y, yaw.cos() * z - yaw.sin() * x)
    };
    let d = difference(&p, &vista, turned);
    assert!(d < BAR, "plane: {d}");
}

#[test]
fn invalid_fields_of_view_are_refused_with_their_values() {
    let folder = tempfile::tempdir().unwrap();
    let views: Vec<String> =
        (0..3).map(|i| fixture(&format!("panorama/view{i}.jpg")).to_str().unwrap().to_owned()).collect();
    let go = |more: &[&str]| {
        let args: Vec<&str> = ["panorama"].into_iter().chain(strs(&views)).chain(["-o", "p.png"]).collect();
        run(folder.path(), &[&args[..], more].concat())
    };
    for (more, words) in [
        (&["--fov", "0"][..], "0 is not between 1 and 360"),
        (&["--fov", "60,nan"], "NaN is not between"),
        (&["--fov", "wide"], "wide is not an angle"),
        (&["--fov", "1e300"], "is not between"),
        (&["--center", "20"], "two angles are needed"),
        (&["--center", "0,-91"], "-91 is not between -90 and 90"),
        (&["--roll", "inf"], "inf is not between -180 and 180"),
        (&["--projection", "mercat0r"], "mercator, panini, stereographic"),
    ] {
        let ran = go(more);
        assert!(ran.code == Some(2) && ran.stderr.contains(words), "{more:?}: {ran:?}");
    }
    for (more, words) in [
        (&["--fov", "170", "--projection", "plane"][..], "170.0 degrees is more than the 150.0"),
        (&["--fov", "90,200", "--projection", "panini"], "200.0 degrees is more than the 150.0"),
        (&["--fov", "40,30", "--center", "180,0"], "no photograph reaches into the field of view"),
        (&["--fov", "40", "--mode", "plane"], "the scene is flat"),
    ] {
        let ran = go(more);
        assert!(ran.code == Some(1) && ran.stderr.contains(words), "{more:?}: {ran:?}");
        assert!(!folder.path().join("p.png").exists());
    }
}

#[test]
fn the_order_of_the_files_does_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 4, 0.5);
    let go = |order: &[usize], out: &str, more: &[&str]| {
        let photos: Vec<&str> = order.iter().map(|i| names[*i].as_str()).collect();
        let value = json(folder.path(), &[&["panorama"], &photos[..], &["-o", out, "--scale", "0.7"], more].concat());
        // Reports follow the order of the arguments.
        for (image, name) in value["images"].as_array().unwrap().iter().zip(&photos) {
            assert_eq!(image["path"], **name);
            assert_eq!(image["used"], true);
        }
        std::fs::read(folder.path().join(out)).unwrap()
    };
    let first = go(&[0, 1, 2, 3], "a.png", &[]);
    assert!(first == go(&[3, 1, 0, 2], "b.png", &["--save-registration", "rig.json"]));
    assert!(first == go(&[2, 0, 3, 1], "c.png", &["--threads", "1"]));
    // A registration applies to the photographs in its own order.
    assert!(first == go(&[3, 1, 0, 2], "d.png", &["--registration", "rig.json"]));
}

#[test]
fn a_saved_registration_gives_the_same_bytes_and_renders_other_frames() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 3, 0.0);
    // An unregistered photograph is part of the set.
    let stranger = RgbU8::from_fn(200, 150, |x, y| [(x * 7 % 251) as u8, (y * 5 % 239) as u8, 90]);
    cv_io::write_png(folder.path().join("stranger.png"), stranger.view()).unwrap();
    let photos: Vec<&str> = strs(&names).into_iter().chain(["stranger.png"]).collect();
    let go = |photos: &[&str], more: &[&str]| json(folder.path(), &[&["panorama"], photos, more].concat());
    let bytes = |name: &str| std::fs::read(folder.path().join(name)).unwrap();
    let first = go(&photos, &["-o", "a.png", "--save-registration", "new/rig.json", "--scale", "0.7"]);
    let again = go(&photos, &["-o", "b.png", "--registration", "new/rig.json", "--scale", "0.7"]);
    assert_eq!(bytes("a.png"), bytes("b.png"));
    for key in ["size", "reprojection_rms_px", "projection", "mode"] {
        assert_eq!(first[key], again[key], "{key}");
    }
    assert_eq!(again["images"][3]["used"], false);
    assert_eq!(again["images"][1]["focal_px"], first["images"][1]["focal_px"]);
    assert!(again["seconds"]["match"].is_null() && first["seconds"]["match"].is_number());
    // The file states its contents.
    let saved: serde_json::Value = serde_json::from_slice(&bytes("new/rig.json")).unwrap();
    assert_eq!((saved["schema"].as_u64(), saved["mode"].as_str()), (Some(1), Some("rotation")));
    assert_eq!(
        (&saved["photographs"][0]["name"], &saved["photographs"][3]["left_out"]),
        (&"0.png".into(), &"no_overlap".into())
    );
    assert_eq!(saved["photographs"][1]["camera"]["fx"], first["images"][1]["focal_px"]);

    // The same views with other exposures: the canvas is the same, with the new gray levels.
    let dark = tempfile::tempdir_in(folder.path()).unwrap();
    let (_, darker) = landscape(dark.path(), 3, 0.5);
    let place = dark.path().file_name().unwrap().to_str().unwrap();
    let darker: Vec<String> =
        darker.iter().map(|name| format!("{place}/{name}")).chain(["stranger.png".to_owned()]).collect();
    let other = go(&strs(&darker), &["-o", "c.png", "--registration", "new/rig.json", "--scale", "0.7"]);
    assert_eq!(other["size"], first["size"]);
    assert!(other["images"][0]["gain"] != first["images"][0]["gain"] && bytes("c.png") != bytes("a.png"));
    // Another field of view from the same registration.
    let part =
        go(&photos, &["-o", "d.png", "--registration", "new/rig.json", "--projection", "panini", "--fov", "60,30"]);
    assert_eq!(part["projection"], "panini");
}

#[test]
fn registrations_of_other_photographs_and_damaged_registrations_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 3, 0.0);
    done(
        folder.path(),
        &[&["panorama"], &strs(&names)[..], &["-o", "a.png", "--save-registration", "rig.json", "--scale", "0.3"]]
            .concat(),
    );
    let small = RgbU8::new(300, 420, [9; 3]);
    cv_io::write_png(folder.path().join("small.png"), small.view()).unwrap();
    let refuse = |photos: &[&str], file: &str, words: &str| {
        let ran = refused(folder.path(), &[&["panorama"], photos, &["-o", "b.png", "--registration", file]].concat());
        assert!(ran.stderr.contains(words), "{file} {words}: {ran:?}");
        assert!(!folder.path().join("b.png").exists());
    };
    refuse(&["0.png", "1.png"], "rig.json", "2 photographs for a registration of 3");
    refuse(&["0.png", "small.png", "2.png"], "rig.json", "small.png: photograph 1 is 300x420; 420x300 was registered");
    let text = std::fs::read_to_string(folder.path().join("rig.json")).unwrap();
    let good: serde_json::Value = serde_json::from_str(&text).unwrap();
    let photos = strs(&names);
    let damaged = |name: &str, damage: &dyn Fn(&mut serde_json::Value)| {
        let mut value = good.clone();
        damage(&mut value);
        std::fs::write(folder.path().join(name), value.to_string()).unwrap();
    };
    damaged("v2.json", &|v| v["schema"] = 2.into());
    refuse(&photos, "v2.json", "a registration of version 2; version 1 is supported");
    damaged("focal.json", &|v| v["photographs"][0]["camera"]["fx"] = 1e12.into());
    refuse(&photos, "focal.json", "photograph 0: fx is 1000000000000");
    damaged("negative.json", &|v| v["photographs"][2]["camera"]["fy"] = (-3.0).into());
    refuse(&photos, "negative.json", "photograph 2: ");
    damaged("large.json", &|v| v["photographs"][0]["width"] = u64::MAX.into());
    refuse(&photos, "large.json", "photograph 0: width is");
    damaged("scaled.json", &|v| v["photographs"][1]["from_world"][0][0] = 1.5.into());
    refuse(&photos, "scaled.json", "the matrix of photograph 1 is not a rotation");
    damaged("pair.json", &|v| v["overlaps"][0]["b"] = 3.into());
    refuse(&photos, "pair.json", "of 3 are not a pair of registered photographs");
    damaged("null.json", &|v| v["rms_px"] = serde_json::Value::Null);
    refuse(&photos, "null.json", "null.json is no registration");
    for (name, text) in [
        ("cut.json", &text[..text.len() / 2]),
        ("nan.json", &text.replacen("\"rms_px\":", "\"rms_px\":NaN,\"x\":", 1)),
        ("huge.json", &text.replacen("\"rms_px\":", "\"rms_px\":1e999,\"x\":", 1)),
        ("list.json", "[1, 2]"),
        ("empty.json", ""),
    ] {
        std::fs::write(folder.path().join(name), text).unwrap();
        refuse(&photos, name, name);
    }
    refuse(&photos, "missing.json", "missing.json");
    // Options of matching are refused, and no input is overwritten.
    let ran =
        run(folder.path(), &["panorama", "0.png", "-o", "b.png", "--registration", "rig.json", "--mode", "plane"]);
    assert_eq!(ran.code, Some(2), "{ran:?}");
    let args = [&["panorama"], &photos[..], &["-o", "b.png", "--registration", "rig.json", "--seed", "1"]].concat();
    assert_eq!(run(folder.path(), &args).code, Some(2));
    let args =
        [&["panorama"], &photos[..], &["-o", "b.png", "--registration", "rig.json", "--save-registration", "rig.json"]];
    assert!(refused(folder.path(), &args.concat()).stderr.contains("would be overwritten"));
    assert_eq!(std::fs::read_to_string(folder.path().join("rig.json")).unwrap(), text);
}

#[test]
fn a_hugin_project_has_the_views_and_is_read_as_a_registration() {
    let folder = tempfile::tempdir().unwrap();
    let (vista, names) = landscape(folder.path(), 3, 0.0);
    let photos = strs(&names);
    let go = |photos: &[&str], more: &[&str]| json(folder.path(), &[&["panorama"], photos, more].concat());
    let field = ["--projection", "panini", "--fov", "90,35", "--exposure", "none"];
    let first =
        go(&photos, &[&["-o", "a.png", "--camera", "cam.yaml", "--save-registration", "p.pto"], &field[..]].concat());
    let text = std::fs::read_to_string(folder.path().join("p.pto")).unwrap();
    assert!(text.lines().filter(|line| line.starts_with("c n")).count() > 50);
    let images: Vec<&str> = text.lines().filter(|line| line.starts_with("i ")).collect();
    let value = |line: &str, key: &str| -> f64 {
        line.split(' ').find_map(|word| word.strip_prefix(key)?.parse().ok()).unwrap()
    };
    for (i, line) in images.iter().enumerate() {
        assert!(line.ends_with(&format!("n\"{i}.png\"")), "{line}");
        // The camera: 420 px at a focal length of 360 px are 60.5°. The views: spaced by 55 % of that at the height of the horizon.
        let across = 2.0 * (210.0_f64 / 360.0).atan();
        assert!((value(line, "v") - across.to_degrees()).abs() < 1e-9, "{line}");
        let yaw = (i as f64 - 1.0) * 0.55 * across.to_degrees();
        // Two pixels of alignment error.
        assert!((value(line, "y") - yaw).abs() < 0.32 && value(line, "r").abs() < 0.5, "{line}");
    }
    assert_eq!(images.len(), 3);
    let p = text.lines().find(|line| line.starts_with("p ")).unwrap();
    assert!(p.starts_with("p f19 ") && p.contains(" P\"100 0 0\" "), "{p}");

    // Read back it renders the same scene, up to rounding of the world frame.
    let again = go(&photos, &[&["-o", "b.png", "--registration", "p.pto"], &field[..]].concat());
    assert_eq!(again["size"], first["size"]);
    let panini = |x: f64, y: f64| {
        let longitude = 2.0 * (0.5 * x).atan();
        direction(longitude, -(0.5 * y * (1.0 + longitude.cos())).atan())
    };
    let image = cv_io::read_rgb(folder.path().join("b.png")).unwrap();
    let d = difference(&image, &vista, panini);
    assert!(d < 4.0, "{d}");

    std::fs::write(folder.path().join("fish.pto"), text.replace(" f0 ", " f3 ")).unwrap();
    let args = [&["panorama"], &photos[..], &["-o", "c.png", "--registration", "fish.pto"]].concat();
    assert!(refused(folder.path(), &args).stderr.contains("f = 3; it must be 0"));
    let args =
        [&["panorama"], &photos[..], &["-o", "c.png", "--mode", "plane", "--save-registration", "flat.pto"]].concat();
    let ran = run(folder.path(), &args);
    assert!(ran.code == Some(1) && ran.stderr.contains("has rotations only"), "{ran:?}");
    assert_eq!(
        run(folder.path(), &[&["panorama"], &photos[..], &["-o", "c.png", "--save-registration", "x.txt"]].concat())
            .code,
        Some(2)
    );
}

/// Photographs of 16 bits too; at once and in strips, in every format that is written row by row.
#[test]
fn a_limit_of_memory_changes_no_pixel() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 3, 0.5);
    let deep = cv_io::read_rgb(folder.path().join(&names[0])).unwrap().map(|p| p.map(|v| 257 * u16::from(v)));
    cv_io::write_png(folder.path().join("deep.png"), deep.view()).unwrap();
    let set = [&names[0], &names[1], &names[2]].map(String::as_str);
    let with_deep = ["deep.png", set[1], set[2]];
    let made = |photos: &[&str], output: &str, more: &[&str]| {
        let args: Vec<&str> = ["panorama"].iter().chain(photos).chain(&["-o", output]).chain(more).copied().collect();
        let value = json(folder.path(), &args);
        (cv_io::read_image(folder.path().join(output)).unwrap(), value)
    };
    for (output, photos, more) in [
        ("a.tif", &set, &["--projection", "cylindrical"][..]),
        ("b.png", &set, &["--alpha", "--blend", "feather"][..]),
        ("c.jpg", &set, &["--crop", "--blend", "none", "--seams", "voronoi"][..]),
        ("d.tif", &with_deep, &["--scale", "1.7"][..]),
        ("e.png", &with_deep, &["--alpha", "--blend", "poisson"][..]),
    ] {
        let (whole, told) = made(photos, output, more);
        let (limited, also) = made(photos, output, &[more, &["--max-memory", "300"]].concat());
        assert!(whole.pixels == limited.pixels, "{output}");
        for key in ["size", "bits", "images", "stacks", "projection", "reprojection_rms_px"] {
            assert_eq!(told[key], also[key], "{output} {key}");
        }
    }
    // Alpha is dropped when read.
    let bytes = std::fs::read(folder.path().join("b.png")).unwrap();
    let reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    assert_eq!(reader.output_color_type(), (png::ColorType::Rgba, png::BitDepth::Eight));
    // The report is drawn from thumbnails, and nothing is left beside the outputs.
    let more = ["--max-memory", "300", "--report", "report"];
    made(&set, "f.tif", &more);
    assert!(std::fs::read_to_string(folder.path().join("report/report.html")).unwrap().contains("<img"));
    let left = std::fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name());
    assert!(left.into_iter().all(|name| !name.to_string_lossy().starts_with('.')));
}

#[test]
fn a_panorama_that_does_not_fit_is_refused_with_numbers_and_a_remedy() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 2, 0.0);
    let args = |more: &[&'static str]| [&["panorama", &names[0], &names[1], "-o", "p.png"][..], more].concat();
    let ran = run(folder.path(), &args(&["--max-memory", "100"]));
    assert!(ran.code == Some(1) && ran.stderr.contains("100 MiB are allowed"), "{ran:?}");
    assert!(ran.stderr.contains("try: --max-memory") && ran.stderr.contains("a smaller --scale"), "{ran:?}");
    let ran = run(folder.path(), &args(&["--max-memory", "100", "--blend", "poisson"]));
    assert!(ran.code == Some(1) && ran.stderr.contains("try: --blend multiband, --max-memory"), "{ran:?}");
    assert!(!folder.path().join("p.png").exists());
}

/// Size and pixels of a PNG with alpha.
fn with_alpha(bytes: &[u8]) -> (usize, usize, Vec<u8>) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut pixels).unwrap();
    (info.width as usize, info.height as usize, pixels)
}

#[test]
fn layers_put_together_are_the_panorama_without_blending() {
    let folder = tempfile::tempdir().unwrap();
    let (_, names) = landscape(folder.path(), 3, 0.5);
    let args = ["panorama", &names[0], &names[1], &names[2], "-o", "p.png", "--blend", "none", "--alpha"];
    done(folder.path(), &[&args[..], &["--layers", "layers"]].concat());
    let whole = with_alpha(&std::fs::read(folder.path().join("p.png")).unwrap());
    let (width, height, expected) = whole;
    let mut composite = vec![0_u8; expected.len()];
    for (i, name) in names.iter().enumerate() {
        let stem = Path::new(name).file_stem().unwrap().to_str().unwrap();
        let bytes = std::fs::read(folder.path().join(format!("layers/{i:03}-{stem}.tif"))).unwrap();
        let mut decoder = tiff::decoder::Decoder::new(std::io::Cursor::new(&bytes)).unwrap();
        // In inches, at 150 pixels per inch.
        let [left, top] = [286, 287].map(|tag| match decoder.get_tag(tiff::tags::Tag::Unknown(tag)).unwrap() {
            tiff::decoder::ifd::Value::Rational(pixels, 150) => pixels,
            other => panic!("{other:?}"),
        });
        let canvas = [33300, 33301].map(|tag| decoder.get_tag_u32(tiff::tags::Tag::Unknown(tag)).unwrap());
        assert_eq!(canvas, [width as u32, height as u32]);
        let (w, h) = decoder.dimensions().unwrap();
        let tiff::decoder::DecodingResult::U8(pixels) = decoder.read_image().unwrap() else { panic!("not bytes") };
        for (j, pixel) in pixels.chunks_exact(4).enumerate().filter(|(_, pixel)| pixel[3] > 0) {
            let (x, y) = (left as usize + j % w as usize, top as usize + j / w as usize);
            assert!(x < width && y < height && h > 0);
            let place = &mut composite[4 * (y * width + x)..][..4];
            assert_eq!((pixel[3], place[3]), (255, 0), "masks overlap");
            place.copy_from_slice(pixel);
        }
    }
    assert!(composite == expected);
    let usage = [&args[..6], &["--layers", "layers", "--blend", "poisson"]].concat();
    assert_eq!(run(folder.path(), &usage).code, Some(2));
}

/// A landscape in three photographs; in the second, a red post that the first does not show.
fn with_post(folder: &Path) -> Vec<String> {
    let (_, names) = landscape(folder, 3, 0.0);
    let photo = cv_io::read_rgb(folder.join(&names[1])).unwrap();
    let is_post = |x: usize, y: usize| (100..140).contains(&x) && (120..260).contains(&y);
    let painted = RgbU8::from_fn(420, 300, |x, y| if is_post(x, y) { [255, 0, 0] } else { photo.at(x, y) });
    cv_io::write_png(folder.join(&names[1]), painted.view()).unwrap();
    let mask = RgbU8::from_fn(420, 300, |x, y| [if is_post(x, y) { 255 } else { 0 }; 3]);
    cv_io::write_png(folder.join("1_mask.png"), mask.view()).unwrap();
    names
}

fn red_pixels(image: &RgbU8) -> usize {
    image.pixels().filter(|p| p[0] > 180 && p[1] < 60 && p[2] < 60).count()
}

#[test]
fn masks_are_found_by_name_and_remove_or_keep() {
    let folder = tempfile::tempdir().unwrap();
    let names = with_post(folder.path());
    let made = |images: &[&str], more: &[&str]| {
        let args: Vec<&str> = ["panorama"].iter().chain(images).chain(&["-o", "p.png"]).chain(more).copied().collect();
        let value = json(folder.path(), &args);
        assert_eq!(value["images"].as_array().unwrap().len(), 3, "{value}");
        cv_io::read_rgb(folder.path().join("p.png")).unwrap()
    };
    let set: Vec<&str> = strs(&names);
    let removed = made(&set, &["--remove", "1_mask.png"]);
    let kept = made(&set, &["--keep", "1_mask.png"]);
    // 40 by 140 pixels, most of them unblended red.
    assert!(red_pixels(&removed) == 0 && red_pixels(&kept) > 4000, "{} {}", red_pixels(&removed), red_pixels(&kept));
    // A folder of masks, which may have the name of the photograph itself, and a limit of memory.
    std::fs::create_dir(folder.path().join("masks")).unwrap();
    std::fs::copy(folder.path().join("1_mask.png"), folder.path().join("masks/1.png")).unwrap();
    assert!(made(&set, &["--remove", "masks", "--max-memory", "2000"]) == removed);
    // A folder with photographs and their masks is both; the second option is stronger.
    std::fs::create_dir(folder.path().join("all")).unwrap();
    for name in set.iter().chain(&["1_mask.png"]) {
        std::fs::copy(folder.path().join(name), folder.path().join("all").join(name)).unwrap();
    }
    assert!(made(&["all"], &["--keep", "masks/1.png", "--remove", "all"]) == removed);
    // With a registration too.
    done(folder.path(), &[&["panorama"], &set[..], &["-o", "q.png", "--save-registration", "r.json"]].concat());
    let frame = made(&set, &["--registration", "r.json", "--remove", "masks"]);
    assert_eq!(red_pixels(&frame), 0);
}

#[test]
fn masks_that_fit_no_photograph_are_refused_by_name_and_size() {
    let folder = tempfile::tempdir().unwrap();
    let names = with_post(folder.path());
    let mask = cv_io::read_rgb(folder.path().join("1_mask.png")).unwrap();
    cv_io::write_png(folder.path().join("2_mask.png"), mask.view().crop(0, 0, 300, 300).unwrap()).unwrap();
    for copy in ["7_mask.png", "more/1.png", "other/9.png"] {
        std::fs::create_dir_all(folder.path().join(copy).parent().unwrap()).unwrap();
        cv_io::write_png(folder.path().join(copy), mask.view()).unwrap();
    }
    let told = |more: &[&str]| {
        let args: Vec<&str> =
            ["panorama"].into_iter().chain(strs(&names)).chain(["-o", "p.png"]).chain(more.iter().copied()).collect();
        let ran = refused(folder.path(), &args);
        assert!(!folder.path().join("p.png").exists());
        ran.stderr
    };
    let text = told(&["--remove", "2_mask.png"]);
    assert!(text.contains("2.png has 420×300 pixels, its mask 2_mask.png has 300×300"), "{text}");
    let text = told(&["--keep", "7_mask.png"]);
    assert!(text.contains("7_mask.png is named as the mask of none of the photographs"), "{text}");
    let text = told(&["--remove", "1_mask.png", "more"]);
    assert!(text.contains("1_mask.png and more/1.png are both masks of 1.png"), "{text}");
    let text = told(&["--remove", "other"]);
    assert!(text.contains("no file in other is named as the mask of a photograph"), "{text}");
    let text = told(&["--remove", "nowhere.png"]);
    assert!(text.contains("nowhere.png"), "{text}");
    // A mask is an input, which is not overwritten.
    let args = [&["panorama"], &strs(&names)[..], &["-o", "1_mask.png", "--remove", "1_mask.png"]].concat();
    assert!(refused(folder.path(), &args).stderr.contains("1_mask.png is an input"));
}
