//! Matches along epipolar lines, once the geometry is known.

use crate::PhotoFeatures;
use cv_core::{Camera, DMatch, Matrix3, Point2};
use rayon::prelude::*;

/// How [`match_along_lines`] chooses.
pub(crate) struct GuidedOptions {
    /// Largest Sampson distance in pixels.
    pub(crate) threshold: f32,
    /// Largest ratio of the SSD of the best candidate on the line to that of the second. Looser than without a line: there are far fewer
    /// candidates, so far fewer chances to be wrong.
    pub(crate) ratio: f32,
    /// Largest SSD of two unit descriptors; 0.49 is COLMAP's distance of 0.7.
    pub(crate) max_ssd: f32,
    /// A second candidate nearer than this to the best one is the same point, in pixels.
    pub(crate) same: f32,
}

impl Default for GuidedOptions {
    fn default() -> Self {
        Self { threshold: 2.0, ratio: 0.8, max_ssd: 0.49, same: 2.0 }
    }
}

/// Best and second-best candidate of a feature.
#[derive(Clone, Copy)]
struct Best {
    index: u32,
    ssd: f32,
    second: f32,
}

/// Matches between features whose distance from the epipolar geometry `f` (of undistorted pixels) is small, each the best of both.
///
/// In order of the first photograph's features. O(features² ) line distances, few descriptor distances.
pub(crate) fn match_along_lines(
    a: &PhotoFeatures,
    b: &PhotoFeatures,
    cameras: &[Camera; 2],
    f: &Matrix3<f64>,
    options: &GuidedOptions,
) -> Vec<DMatch> {
    let straight = |features: &PhotoFeatures, camera: &Camera| -> Vec<Point2<f32>> {
        let points = features.described.keypoints.par_iter();
        points.map(|k| camera.undistort_pixel(k.position.cast::<f64>()).cast::<f32>()).collect()
    };
    let (pa, pb) = (straight(a, &cameras[0]), straight(b, &cameras[1]));
    let forth = one_way((a, &pa), (b, &pb), f, options);
    let back = one_way((b, &pb), (a, &pa), &f.transpose(), options);
    let mutual = |(i, best): (usize, &Option<Best>)| {
        let best = (*best)?;
        let other = back[best.index as usize]?;
        let sure = best.ssd <= options.ratio * best.second && best.ssd <= options.max_ssd;
        (other.index as usize == i && sure).then(|| DMatch {
            query: i as u32,
            train: best.index,
            distance: best.ssd,
            ratio: best.ssd / best.second.max(f32::MIN_POSITIVE),
        })
    };
    forth.iter().enumerate().filter_map(mutual).collect()
}

fn one_way(
    (a, pa): (&PhotoFeatures, &[Point2<f32>]),
    (b, pb): (&PhotoFeatures, &[Point2<f32>]),
    f: &Matrix3<f64>,
    options: &GuidedOptions,
) -> Vec<Option<Best>> {
    let (da, db) = (&a.described.descriptors, &b.described.descriptors);
    let kb = &b.described.keypoints;
    let scale = (1.0 / f.norm()) as f32;
    let m: Matrix3<f32> = f.cast::<f32>() * scale;
    // The part of the Sampson denominator that belongs to the second point, for every one of them.
    let other: Vec<f32> = pb
        .iter()
        .map(|q| {
            let x = m[(0, 0)] * q.x + m[(1, 0)] * q.y + m[(2, 0)];
            let y = m[(0, 1)] * q.x + m[(1, 1)] * q.y + m[(2, 1)];
            x * x + y * y
        })
        .collect();
    let limit = options.threshold * options.threshold;
    let one = |i: usize| {
        let p = pa[i];
        let l = m * nalgebra::Vector3::new(p.x, p.y, 1.0);
        let own = l.x * l.x + l.y * l.y;
        let mut near: Vec<(u32, f32)> = Vec::new();
        for (j, (q, o)) in pb.iter().zip(&other).enumerate() {
            let c = l.x * q.x + l.y * q.y + l.z;
            if c * c < limit * (own + o) {
                let ssd = da.row(i).iter().zip(db.row(j)).map(|(x, y)| (x - y) * (x - y)).sum();
                near.push((j as u32, ssd));
            }
        }
        let &(index, ssd) = near.iter().min_by(|x, y| x.1.total_cmp(&y.1))?;
        let at = kb[index as usize].position;
        let elsewhere = |&&(j, _): &&(u32, f32)| (kb[j as usize].position - at).norm() > options.same;
        // A lone candidate on its line has to be good by itself.
        let second = near.iter().filter(elsewhere).map(|n| n.1).fold(options.max_ssd, f32::min);
        Some(Best { index, ssd, second })
    };
    (0..pa.len()).into_par_iter().map(one).collect()
}
