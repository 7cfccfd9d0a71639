//! Input photographs as files, folders and patterns, in every command.

use crate::support::{JOBS, done, fixture, run, strs};
use std::fs;

#[test]
fn every_command_expands_folders_and_patterns() {
    // `depth` takes two folders of a rig's frames and writes a map of each pair.
    for job in JOBS.iter().filter(|job| job.name != "depth") {
        let (folder, inputs) = job.folder();
        done(folder.path(), &strs(&job.args(&inputs)));
        let expected = job.written(folder.path());
        fs::create_dir(folder.path().join("photos")).unwrap();
        for input in &inputs {
            fs::copy(folder.path().join(input), folder.path().join("photos").join(input)).unwrap();
        }
        fs::write(folder.path().join("photos/notes.txt"), "no photograph").unwrap();
        for many in
            ["photos", "photos/in*", "photos/in?.jpg", "photo[s]/in[0-9].jpg", "photos/in%d.jpg", "photos/in%01d.*"]
        {
            let words = job.args(&[many.to_owned()]);
            let args: Vec<&str> = words.iter().map(String::as_str).filter(|word| !word.starts_with('{')).collect();
            done(folder.path(), &args);
            assert!(job.written(folder.path()) == expected, "{}: {many}", job.name);
        }
        for nothing in ["photos/x*", "photos/in%04d.jpg", "no/such/*.png"] {
            let words = job.args(&[nothing.to_owned()]);
            let args: Vec<&str> = words.iter().map(String::as_str).filter(|word| !word.starts_with('{')).collect();
            let ran = run(folder.path(), &args);
            assert!(ran.code == Some(1) && ran.stderr.contains(nothing), "{}: {nothing}: {ran:?}", job.name);
        }
    }
}

#[test]
fn too_many_photographs_are_refused_with_a_remedy() {
    let folder = tempfile::tempdir().unwrap();
    for name in ["a.jpg", "b.jpg", "c.jpg"] {
        fs::copy(fixture("two-view/a.jpg"), folder.path().join(name)).unwrap();
    }
    let three = ["a.jpg", "b.jpg", "c.jpg"];
    let cases: [(&[&str], &[&str], &str); 5] = [
        (&["match"], &[], "two photographs are needed, got 3"),
        (&["reconstruct"], &["-o", "cloud.ply"], "two photographs are needed, got 3"),
        (&["rectify"], &["--rig", "rig.yaml", "-o", "out"], "two photographs are needed, got 3"),
        (&["depth"], &["-o", "d.pfm"], "two folders, or two patterns in quotes"),
        (&["estimate", "homography"], &[], "cv match A B -o matches.txt"),
    ];
    for (command, more, said) in cases {
        let ran = run(folder.path(), &[command, &three, more].concat());
        assert!(
            ran.code == Some(2) && ran.stderr.contains(said) && ran.stderr.contains("try: "),
            "{command:?}: {ran:?}"
        );
    }
    for (command, more, _) in &cases[..3] {
        let ran = run(folder.path(), &[command, &["."][..], more].concat());
        assert!(ran.code == Some(2) && ran.stderr.contains("cv panorama"), "{command:?}: {ran:?}");
        let ran = run(folder.path(), &[command, &["a.jpg"][..], more].concat());
        assert!(ran.code == Some(2) && ran.stderr.contains("only a.jpg is given"), "{command:?}: {ran:?}");
    }
}

#[test]
fn every_command_names_its_output_by_the_same_option() {
    let folder = tempfile::tempdir().unwrap();
    let commands: [&[&str]; 10] = [
        &["demo"],
        &["segment", "train"],
        &["segment", "predict"],
        &["panorama"],
        &["match"],
        &["reconstruct"],
        &["depth"],
        &["rectify"],
        &["eval", "disparity"],
        &["man"],
    ];
    for command in commands {
        // An unknown option is wrong usage, also with --help.
        let unknown = run(folder.path(), &[command, &["--outptu", "x", "--help"][..]].concat());
        assert_eq!(unknown.code, Some(2), "{command:?}: {unknown:?}");
        for option in ["-o", "--output"] {
            done(folder.path(), &[command, &[option, "x", "--help"]].concat());
        }
    }
    for command in [&["demo"][..], &["segment", "predict"], &["rectify"], &["man"]] {
        done(folder.path(), &[command, &["--out", "x", "--help"]].concat());
    }
}
