//! `cv panorama` from outside: what its options change in the file.

#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

mod support;

use support::{done, fixture, run, strs};

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
    // A cylinder bends the upper and lower edges of photographs: some of the box around them is empty, most is not.
    assert!(clear > 100 && 4 * clear < plain.width() * plain.height(), "{clear}");
    assert_eq!(run(folder.path(), &strs(&args(&["-o", "pano.jpg", "--alpha"]))).code, Some(2));
    assert!(!folder.path().join("pano.jpg").exists());
}
