//! Upsampling of the preview labels to full resolution.

use crate::blend::NO_PHOTO;
use crate::rows::for_each_row;
use crate::surface::WarpedPhoto;
use cv_core::{Cancelled, Image, Sample, Scaling, Stage};

/// Upsamples labels by `step` to a canvas of the given size. Bilinear votes give smooth seams; where the photograph of the winner does not cover the pixel,
/// another that does is taken.
pub(crate) fn upsample<T: Sample>(
    coarse: &Image<u16, 1>,
    step: usize,
    (w, h): (usize, usize),
    photos: &[Option<WarpedPhoto<T>>],
    stage: &Stage<'_>,
) -> Result<Image<u16, 1>, Cancelled> {
    upsample_rows(coarse, step, 0, (w, h), photos, stage)
}

/// As [`upsample`], for `h` rows from `top`; photographs are in the coordinates of these rows.
pub(crate) fn upsample_rows<T: Sample>(
    coarse: &Image<u16, 1>,
    step: usize,
    top: usize,
    (w, h): (usize, usize),
    photos: &[Option<WarpedPhoto<T>>],
    stage: &Stage<'_>,
) -> Result<Image<u16, 1>, Cancelled> {
    let reaches = |label: u16, x: usize, y: usize| {
        photos.get(usize::from(label)).and_then(Option::as_ref).is_some_and(|p| p.reaches(x, y))
    };
    // Zeros are pages that the threads touch first.
    let mut labels = Image::new(w, h, [0]);
    let (cw, ch) = coarse.size();
    // Interpolation index and weight of a canvas coordinate on the preview.
    let place = |v: usize, n: usize| {
        let t = Scaling::coordinate(v as f64, 1.0 / step as f64).max(0.0) as f32;
        let i = (t as usize).min(n - 1);
        (i, (i + 1).min(n - 1), t - i as f32)
    };
    let columns: Vec<(usize, usize, f32)> = (0..w).map(|x| place(x, cw)).collect();
    // First canvas column of each preview column.
    let starts: Vec<usize> = (0..=cw).map(|i| columns.partition_point(|column| column.0 < i)).collect();
    for_each_row(labels.as_mut_slice(), w, stage, |y, row| {
        row.fill(NO_PHOTO);
        let (y0, y1, fy) = place(top + y, ch);
        let (upper, lower) = (coarse.row(y0), coarse.row(y1));
        let vote = |x: usize| {
            let (x0, x1, fx) = columns[x];
            let near = [upper[x0], upper[x1], lower[x0], lower[x1]];
            let weights = [(1.0 - fx) * (1.0 - fy), fx * (1.0 - fy), (1.0 - fx) * fy, fx * fy];
            let mut best = (0.0, NO_PHOTO);
            for label in near {
                let weight: f32 = near.iter().zip(weights).filter(|(l, _)| **l == label).map(|(_, w)| w).sum();
                if label != NO_PHOTO && weight >= best.0 && weight > 0.0 && reaches(label, x, y) {
                    best = (weight + 1e-6, label);
                }
            }
            if best.1 == NO_PHOTO {
                let any = (0..photos.len() as u16).find(|&l| reaches(l, x, y));
                best.1 = any.unwrap_or(NO_PHOTO);
            }
            best.1
        };
        let mut first = 0;
        while first < cw {
            // A run of preview columns of one label in both rows: between them nothing else is voted for. Right of the last, there is the next column, or the border.
            let label = upper[first];
            let run = (first..cw).take_while(|i| upper[*i] == label && lower[*i] == label).count();
            let end = first + run.max(1);
            let inner = if end == cw { first + run } else { end - 1 };
            let (left, right) = (starts[first], starts[inner]);
            let photo = photos.get(usize::from(label)).and_then(Option::as_ref);
            match photo.and_then(|photo| photo.opacities(left..right, y)) {
                Some(opacities) if opacities.clone().all(|opacity| opacity != T::default()) => {
                    row[left..right].fill(label);
                }
                Some(opacities) => {
                    for ((x, out), opacity) in (left..).zip(&mut row[left..right]).zip(opacities) {
                        *out = if opacity != T::default() { label } else { vote(x) };
                    }
                }
                None if label == NO_PHOTO => cover(&mut row[left..right], left, y, photos),
                None => (left..right).for_each(|x| row[x] = vote(x)),
            }
            (right..starts[end]).for_each(|x| row[x] = vote(x));
            first = end;
        }
    })?;
    Ok(labels)
}

/// Labels the pixels of row `y` from column `left`, which have no label, with the first photograph that covers them.
fn cover<T: Sample>(labels: &mut [u16], left: usize, y: usize, photos: &[Option<WarpedPhoto<T>>]) {
    for (name, photo) in photos.iter().enumerate().filter_map(|(name, photo)| Some((name, photo.as_ref()?))) {
        let (start, end) = (left.max(photo.bounds.left), (left + labels.len()).min(photo.bounds.right));
        if start >= end {
            continue;
        }
        let Some(opacities) = photo.opacities(start..end, y) else { continue };
        for (label, opacity) in labels[start - left..end - left].iter_mut().zip(opacities) {
            if *label == NO_PHOTO && opacity != T::default() {
                *label = name as u16;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Bounds;
    use crate::testing::{drawn, stage};

    #[test]
    fn a_slanted_seam_becomes_a_smooth_one_and_blocks_stay_where_they_are() {
        let step = 8;
        let coarse = Image::from_fn(12, 10, |x, y| [u16::from(x > y)]);
        let whole = Bounds { left: 0, top: 0, right: 96, bottom: 80 };
        let photos = [Some(drawn(whole, |_, _| [0; 3])), Some(drawn(whole, |_, _| [0; 3]))];
        let labels = upsample(&coarse, step, (96, 80), &photos, &stage()).unwrap();
        for (x, y) in (0..80).flat_map(|y| (0..96).map(move |x| (x, y))) {
            // The seam runs half-way between the middles of the blocks (y, y) and (y + 1, y): x = y + 4. Bilinear weights follow it to within
            // half a block.
            let off = x as f64 - (y as f64 + 4.0);
            if off.abs() > 4.0 {
                assert_eq!(labels.at(x, y)[0], u16::from(off > 0.0), "{x} {y}");
            }
        }
    }

    #[test]
    fn labels_of_two_rows_are_voted_for_in_every_column() {
        let coarse = Image::from_fn(3, 2, |_, y| [y as u16]);
        let whole = Bounds { left: 0, top: 0, right: 12, bottom: 8 };
        let photos = [Some(drawn(whole, |_, _| [0; 3])), Some(drawn(whole, |_, _| [0; 3]))];
        let labels = upsample(&coarse, 4, (12, 8), &photos, &stage()).unwrap();
        assert!((0..8).all(|y| labels.row(y).iter().all(|label| usize::from(*label) == y / 4)), "{labels:?}");
    }

    #[test]
    fn a_label_is_taken_only_where_its_photograph_reaches() {
        let coarse = Image::from_fn(4, 3, |x, _| {
            [if x < 2 {
                0
            } else if x == 2 {
                1
            } else {
                NO_PHOTO
            }]
        });
        let left = drawn(Bounds { left: 0, top: 0, right: 6, bottom: 12 }, |_, _| [0; 3]);
        let right = drawn(Bounds { left: 5, top: 2, right: 14, bottom: 12 }, |_, _| [0; 3]);
        let labels = upsample(&coarse, 4, (16, 12), &[Some(left.clone()), Some(right.clone())], &stage()).unwrap();
        for (x, y) in (0..12).flat_map(|y| (0..16).map(move |x| (x, y))) {
            match labels.at(x, y)[0] {
                0 => assert!(left.reaches(x, y)),
                1 => assert!(right.reaches(x, y)),
                _ => assert!(!left.reaches(x, y) && !right.reaches(x, y), "{x} {y}"),
            }
        }
    }
}
