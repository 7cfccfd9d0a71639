//! Files to read.

use super::{Explain, Failure};
use std::{cmp::Ordering, fs, path::PathBuf};

/// The image files among the arguments: a file stands for itself, a folder for the images in it, by name
/// (`img2` before `img10`).
pub(crate) fn expand_images(paths: &[PathBuf]) -> Result<Vec<PathBuf>, Failure> {
    const ENDINGS: [&str; 16] = [
        "png", "jpg", "jpeg", "jpe", "tif", "tiff", "bmp", "pnm", "ppm", "pgm", "pbm", "pam", "exr", "hdr", "pic",
        "jfif",
    ];
    let mut images = Vec::new();
    for path in paths {
        if !path.is_dir() {
            images.push(path.clone());
            continue;
        }
        let mut found = Vec::new();
        for entry in fs::read_dir(path).during(format!("cannot list {}", path.display()))? {
            let file = entry.during(format!("cannot list {}", path.display()))?.path();
            let ending = file.extension().unwrap_or_default().to_string_lossy().to_lowercase();
            let hidden = file.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
            if ENDINGS.contains(&ending.as_str()) && !hidden && file.is_file() {
                found.push(file);
            }
        }
        if found.is_empty() {
            return Err(Failure::new(format!("there are no images in {}", path.display()))
                .advice(format!("a folder with files that end in {}", ENDINGS[..3].join(", "))));
        }
        found.sort_by(|a, b| natural_order(&a.to_string_lossy(), &b.to_string_lossy()));
        images.append(&mut found);
    }
    Ok(images)
}

/// Compares names with their runs of digits as numbers.
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

/// The digits at the start, without leading zeros, and what follows.
fn split_digits(text: &str) -> (&str, &str) {
    let end = text.find(|c: char| !c.is_ascii_digit()).unwrap_or(text.len());
    (text[..end].trim_start_matches('0'), &text[end..])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_sort_as_people_number_them() {
        let mut names = ["img10.png", "img2.png", "img1.png", "img02.png", "a.png", "img2b.png", "img.png"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["a.png", "img.png", "img1.png", "img02.png", "img2.png", "img2b.png", "img10.png"]);
    }
}
