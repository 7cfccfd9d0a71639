//! Matching once the geometry of two views is known: only candidates near where a feature must be.

use crate::matching::{MatchError, same_kind};
use crate::nearest_neighbors::ssd;
use crate::{Descriptors, Features};
use cv_core::{Cancelled, DMatch, Keypoint, OptionError, Progress, Stage};
use nalgebra::{Matrix3, Point2, Vector3};
use rayon::prelude::*;

/// The geometry of two views, in pixels.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum TwoViewModel {
    /// `b ~ H a`. The distance is that from `H a` to `b`.
    Homography(Matrix3<f64>),
    /// `bᵀ F a = 0`. The distance is Sampson's.
    Fundamental(Matrix3<f64>),
}

/// Settings of [`match_guided`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct GuidedOptions {
    /// Largest distance from the geometry, in pixels. Above 0; default 2.
    pub threshold: f32,
    /// Largest ratio of the SSD of the best candidate to that of the second. 0 to 1; default 0.8, looser than without a geometry: there are far fewer candidates, so far
    /// fewer chances to be wrong.
    pub ratio: f32,
    /// Largest SSD, in the descriptors' unit. Default `None`: [`DescriptorKind::max_ssd`](crate::DescriptorKind::max_ssd).
    pub max_ssd: Option<f32>,
    /// A second candidate nearer than this to the best one is the same point, in pixels. Default 2.
    pub same: f32,
}

impl Default for GuidedOptions {
    fn default() -> Self {
        Self { threshold: 2.0, ratio: 0.8, max_ssd: None, same: 2.0 }
    }
}

/// Matches between features that agree with a known geometry, each the best of both, in order of the first set.
///
/// `positions` are those of the features in the pixels of the geometry (undistorted, say); `None` takes the keypoints' own. O(n·m) distances from the geometry, few between
/// descriptors.
///
/// # Errors
/// [`MatchError`] for sets of different kinds, empty sets, or positions that are not as many as the features.
pub fn match_guided(
    a: &Features,
    b: &Features,
    positions: Option<[&[Point2<f32>]; 2]>,
    model: &TwoViewModel,
    options: &GuidedOptions,
    progress: &dyn Progress,
) -> Result<Vec<DMatch>, MatchError> {
    let (da, db) = (&a.descriptors, &b.descriptors);
    same_kind(da, db)?;
    if da.is_empty() || db.is_empty() {
        return Err(MatchError::Empty { query: da.len(), train: db.len() });
    }
    OptionError::check("ratio", options.ratio.into(), "from 0 to 1", |v| (0.0..=1.0).contains(&v))?;
    let own = [a, b].map(|d| d.keypoints.iter().map(|k: &Keypoint| k.position).collect::<Vec<_>>());
    let [pa, pb] = positions.unwrap_or([&own[0], &own[1]]);
    if pa.len() != da.len() || pb.len() != db.len() {
        return Err(MatchError::Empty { query: pa.len(), train: pb.len() });
    }
    let turned = match model {
        TwoViewModel::Fundamental(f) => TwoViewModel::Fundamental(f.transpose()),
        TwoViewModel::Homography(h) => match h.try_inverse() {
            Some(inverse) => TwoViewModel::Homography(inverse),
            None => return Ok(Vec::new()),
        },
    };
    let stage = Stage::new(progress, "guided", pa.len() + pb.len())?;
    let forth = one_way((da, pa), (db, pb), model, options, &stage)?;
    let back = one_way((db, pb), (da, pa), &turned, options, &stage)?;
    let max_ssd = options.max_ssd.unwrap_or(da.kind().max_ssd);
    let mutual = |(i, best): (usize, &Option<Best>)| {
        let best = (*best)?;
        let other = back[best.index as usize]?;
        let sure = best.ssd <= options.ratio * best.second && best.ssd <= max_ssd;
        (other.index as usize == i && sure).then(|| DMatch {
            query: i as u32,
            train: best.index,
            distance: best.ssd,
            ratio: best.ssd / best.second.max(f32::MIN_POSITIVE),
        })
    };
    Ok(forth.iter().enumerate().filter_map(mutual).collect())
}

/// Best and second-best candidate of a feature.
#[derive(Clone, Copy)]
struct Best {
    index: u32,
    ssd: f32,
    second: f32,
}

fn one_way(
    (da, pa): (&Descriptors, &[Point2<f32>]),
    (db, pb): (&Descriptors, &[Point2<f32>]),
    model: &TwoViewModel,
    options: &GuidedOptions,
    stage: &Stage<'_>,
) -> Result<Vec<Option<Best>>, Cancelled> {
    let limit = options.threshold * options.threshold;
    let max_ssd = options.max_ssd.unwrap_or(da.kind().max_ssd);
    let (TwoViewModel::Homography(m) | TwoViewModel::Fundamental(m)) = model;
    let m: Matrix3<f32> = m.cast::<f32>() * (1.0 / m.norm()) as f32;
    // The part of Sampson's denominator that belongs to the second point, for every one of them.
    let other: Vec<f32> = pb
        .iter()
        .map(|q| {
            let x = m[(0, 0)] * q.x + m[(1, 0)] * q.y + m[(2, 0)];
            let y = m[(0, 1)] * q.x + m[(1, 1)] * q.y + m[(2, 1)];
            x * x + y * y
        })
        .collect();
    let one = |i: usize| {
        let l = m * Vector3::new(pa[i].x, pa[i].y, 1.0);
        let mut near: Vec<(u32, f32)> = Vec::new();
        let mut ask = |j: usize, is_near: bool| {
            if is_near {
                near.push((j as u32, ssd(da.row(i), db.row(j))));
            }
        };
        match model {
            TwoViewModel::Fundamental(_) => {
                let own = l.x * l.x + l.y * l.y;
                for (j, (q, o)) in pb.iter().zip(&other).enumerate() {
                    let c = l.x * q.x + l.y * q.y + l.z;
                    ask(j, c * c < limit * (own + o));
                }
            }
            TwoViewModel::Homography(_) => {
                let (x, y) = (l.x / l.z, l.y / l.z);
                for (j, q) in pb.iter().enumerate() {
                    ask(j, (q.x - x) * (q.x - x) + (q.y - y) * (q.y - y) < limit);
                }
            }
        }
        let &(index, best) = near.iter().min_by(|x, y| x.1.total_cmp(&y.1))?;
        let at = pb[index as usize];
        let elsewhere = |&&(j, _): &&(u32, f32)| (pb[j as usize] - at).norm() > options.same;
        // A lone candidate has to be good by itself.
        let second = near.iter().filter(elsewhere).map(|n| n.1).fold(max_ssd, f32::min);
        Some(Best { index, ssd: best, second })
    };
    let asked = |i: usize| {
        stage.add(1)?;
        Ok(one(i))
    };
    (0..pa.len()).into_par_iter().map(asked).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DescriptorKind;
    use cv_core::Silent;

    fn described(points: &[(f32, f32)], values: &[f32]) -> Features {
        let data = values.iter().flat_map(|&v| std::iter::once(v).chain(std::iter::repeat_n(0.0, 63))).collect();
        Features {
            keypoints: points.iter().map(|&(x, y)| Keypoint::new(x, y, 1.0)).collect(),
            descriptors: Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap(),
            ..Features::new(DescriptorKind::PATCH)
        }
    }

    #[test]
    fn only_candidates_on_the_line_or_at_the_place_count() {
        // Pure sideways motion: epipolar lines are rows.
        let f = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
        let a = described(&[(10.0, 20.0), (50.0, 40.0)], &[0.5, 0.1]);
        // The best descriptor for the first is on another row; on its own row are two.
        let b = described(&[(90.0, 60.0), (15.0, 20.5), (70.0, 21.0), (5.0, 40.0)], &[0.5, 0.45, 0.0, 0.12]);
        let options = GuidedOptions::default();
        let found = match_guided(&a, &b, None, &TwoViewModel::Fundamental(f), &options, &Silent).unwrap();
        assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 1), (1, 3)]);
        // The same through a shift of 5 px: the second goes elsewhere.
        let h = Matrix3::new(1.0, 0.0, 5.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
        let found = match_guided(&a, &b, None, &TwoViewModel::Homography(h), &options, &Silent).unwrap();
        assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 1)]);
        let strange = Features { descriptors: Descriptors::new(DescriptorKind::MOPS), ..a.clone() };
        let error = match_guided(&strange, &b, None, &TwoViewModel::Homography(h), &options, &Silent);
        assert!(matches!(error, Err(MatchError::KindsDiffer { .. })));
        let nothing = match_guided(&a, &b, None, &TwoViewModel::Homography(Matrix3::zeros()), &options, &Silent);
        assert_eq!(nothing, Ok(vec![]));
    }
}
