//! Input photographs: files, folders and patterns.

use super::{Explain, Failure};
use std::{cmp::Ordering, fs, path::Path, path::PathBuf};

/// Extensions of image files in a folder.
const EXTENSIONS: [&str; 17] = [
    "png", "jpg", "jpeg", "jpe", "tif", "tiff", "bmp", "pnm", "ppm", "pgm", "pbm", "pam", "exr", "hdr", "pic", "jfif",
    "webp",
];

/// Maximum number of digits matched by `%d`.
const MAX_DIGITS: usize = 12;

/// Expands arguments to image files: a folder to the images in it, a pattern (`*`, `?`, `[a-z]`, `%04d`) to the files that match it, in natural order
/// (`img2` before `img10`).
pub(crate) fn expand_images(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    let mut images = Vec::new();
    for path in paths {
        if !stands_for_many(path) {
            images.push(path.clone());
            continue;
        }
        let mut found = if path.is_dir() { in_folder(path)? } else { matching_pattern(path)? };
        sort_by_name(&mut found);
        images.append(&mut found);
    }
    Ok(images)
}

/// Sorts paths in natural order: runs of digits compare as numbers.
pub(crate) fn sort_by_name(paths: &mut [PathBuf]) {
    paths.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
}

/// Expands arguments to exactly two photographs.
pub(crate) fn two_images(paths: &[PathBuf]) -> Result<[PathBuf; 2], Failure> {
    <[PathBuf; 2]>::try_from(expand_images(paths)?).map_err(|images| match &images[..] {
        [one] => Failure::usage(format!("two photographs are needed, only {} is given", one.display()))
            .advice("name a second one"),
        more => Failure::usage(format!("two photographs are needed, got {}", more.len()))
            .advice("run it on one pair at a time; `cv panorama` stitches many photographs from one place, `cv sfm` reconstructs many views"),
    })
}

/// Whether an argument is a folder or a pattern.
pub(crate) fn stands_for_many(path: &Path) -> bool {
    let text = path.to_string_lossy();
    path.is_dir() || (!path.exists() && (text.contains(['*', '?', '[']) || numbering(&text).is_some()))
}

/// Lists the images in a folder.
fn in_folder(path: &Path) -> Result<Vec<PathBuf>, Failure> {
    let mut found = Vec::new();
    for entry in fs::read_dir(path).during(format!("cannot list {}", path.display()))? {
        let file = entry.during(format!("cannot list {}", path.display()))?.path();
        let hidden = file.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
        if is_named_as_image(&file) && !hidden && file.is_file() {
            found.push(file);
        }
    }
    if found.is_empty() {
        return Err(Failure::new(format!("there are no images in {}", path.display()))
            .advice(format!("a folder with files of the extensions {}", EXTENSIONS[..3].join(", "))));
    }
    Ok(found)
}

fn is_named_as_image(file: &Path) -> bool {
    let ending = file.extension().unwrap_or_default().to_string_lossy().to_lowercase();
    EXTENSIONS.contains(&ending.as_str())
}

/// Lists the files that match a pattern: those with an image extension, or all if none has one.
fn matching_pattern(path: &Path) -> Result<Vec<PathBuf>, Failure> {
    let text = path.to_string_lossy();
    let patterns = match numbering(&text) {
        None => vec![text.to_string()],
        Some((head, width, rest)) => {
            (width..=width.max(MAX_DIGITS)).map(|n| format!("{head}{}{rest}", "[0-9]".repeat(n))).collect()
        }
    };
    let options = glob::MatchOptions { require_literal_leading_dot: true, ..glob::MatchOptions::new() };
    let mut found = Vec::new();
    for pattern in patterns {
        let files = glob::glob_with(&pattern, options).map_err(Failure::usage).during(path.display())?;
        // Unreadable entries are skipped.
        found.extend(files.flatten().filter(|file| file.is_file()));
    }
    if found.iter().any(|file| is_named_as_image(file)) {
        found.retain(|file| is_named_as_image(file));
    }
    match found.is_empty() {
        true => Err(Failure::new(format!("there are no images like {}", path.display())).advice("check the pattern")),
        false => Ok(found),
    }
}

/// Finds the first C-style number (`%d`, `%04d`) in a pattern: the text before it, its minimum number of digits, and the
/// text after it.
fn numbering(pattern: &str) -> Option<(&str, usize, &str)> {
    pattern.match_indices('%').find_map(|(at, _)| {
        let rest = &pattern[at + 1..];
        let width = rest.find('d')?;
        let digits = &rest[..width];
        let width = if digits.is_empty() { 1 } else { digits.parse().ok().filter(|_| digits.starts_with('0'))? };
        (width <= MAX_DIGITS).then(|| (&pattern[..at], width, &rest[digits.len() + 1..]))
    })
}

/// Compares names with runs of digits as numbers.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut rest_a, mut rest_b) = (a, b);
    loop {
        let (Some(first_a), Some(first_b)) = (rest_a.chars().next(), rest_b.chars().next()) else {
            // One is a prefix of the other, or they differ in leading zeros only.
            return rest_a.len().cmp(&rest_b.len()).then_with(|| a.cmp(b));
        };
        let order = if first_a.is_ascii_digit() && first_b.is_ascii_digit() {
            let (number_a, number_b);
            (number_a, rest_a) = split_digits(rest_a);
            (number_b, rest_b) = split_digits(rest_b);
            number_a.len().cmp(&number_b.len()).then_with(|| number_a.cmp(number_b))
        } else {
            rest_a = &rest_a[first_a.len_utf8()..];
            rest_b = &rest_b[first_b.len_utf8()..];
            first_a.cmp(&first_b)
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

/// Splits off the digits at the start, without leading zeros.
fn split_digits(text: &str) -> (&str, &str) {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    (text[..end].trim_start_matches('0'), &text[end..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_in_natural_order() {
        let mut names = ["img10.png", "img2.png", "img1.png", "img02.png", "a.png", "img2b.png", "img.png"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["a.png", "img.png", "img1.png", "img02.png", "img2.png", "img2b.png", "img10.png"]);
    }

    #[test]
    fn shell_and_printf_patterns_match() {
        let folder = tempfile::tempdir().unwrap();
        let make = |names: &[&str]| {
            for name in names {
                fs::write(folder.path().join(name), "x").unwrap();
            }
        };
        let fits = |pattern: &str| -> Vec<String> {
            let found = expand_images(&[folder.path().join(pattern)]).unwrap_or_default();
            found.iter().map(|path| path.strip_prefix(folder.path()).unwrap().display().to_string()).collect()
        };
        make(&["f1.png", "f.png", "g1.png", "f1.txt", ".f2.png", "x1.raw", "x2.raw"]);
        assert_eq!(fits("f*"), ["f.png", "f1.png"]);
        assert_eq!(fits("[fg]?.png"), ["f1.png", "g1.png"]);
        assert_eq!(fits("x*"), ["x1.raw", "x2.raw"]);
        make(&["frame_12345.png", "frame_0001.png", "frame_001.png", "frame_00x1.png", "frame_0001.png.bak"]);
        assert_eq!(fits("frame_%04d.png"), ["frame_0001.png", "frame_12345.png"]);
        make(&["f7_left.png", "a_07.png", "a_7.png"]);
        assert_eq!(fits("f%d*.png"), ["f1.png", "f7_left.png"]);
        assert_eq!(fits("a*_%02d.png"), ["a_07.png"]);
        fs::create_dir(folder.path().join("sub")).unwrap();
        make(&["sub/c1.png", "sub/c[1].png"]);
        assert_eq!(fits("s*/c%d.png"), ["sub/c1.png"]);
        // Existing files whose names look like patterns, and invalid numbers.
        assert_eq!(fits("sub/c[1].png"), ["sub/c[1].png"]);
        assert!(!stands_for_many(Path::new("100%.png")) && !stands_for_many(Path::new("50%4d.png")));
        assert!(stands_for_many(Path::new("nowhere/frame_%04d.png")));
        assert!(expand_images(&[folder.path().join("no*.png")]).unwrap_err().text().contains("no*.png"));
    }
}
