//! Matching guided by a two-view model, against exhaustive search.

use cv_core::{Keypoint, Matrix3, Point2, Silent, Vector3};
use cv_features::{
    ByteDescriptors, DescriptorKind, Descriptors, Features, GuidedOptions, MatchError, TwoViewModel, match_guided,
};

fn described(points: &[(f32, f32)], values: &[f32]) -> Features {
    let data = values.iter().flat_map(|&v| std::iter::once(v).chain(std::iter::repeat_n(0.0, 63))).collect();
    Features {
        keypoints: points.iter().map(|&(x, y)| Keypoint::new(x, y, 1.0)).collect(),
        descriptors: Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap(),
        ..Features::new(DescriptorKind::PATCH)
    }
}

#[test]
fn only_candidates_consistent_with_the_geometry_are_matched() {
    // A lateral translation: epipolar lines are rows.
    let f = Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0);
    let a = described(&[(10.0, 20.0), (50.0, 40.0)], &[0.5, 0.1]);
    // The nearest descriptor for the first is on another row; two candidates are on its row.
    let b = described(&[(90.0, 60.0), (15.0, 20.5), (70.0, 21.0), (5.0, 40.0)], &[0.5, 0.45, 0.0, 0.12]);
    let options = GuidedOptions::default();
    let found = match_guided(&a, &b, None, &TwoViewModel::Fundamental(f), &options, &Silent).unwrap();
    assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 1), (1, 3)]);
    // A shift by 5 px: the second has no candidate.
    let h = Matrix3::new(1.0, 0.0, 5.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0);
    let found = match_guided(&a, &b, None, &TwoViewModel::Homography(h), &options, &Silent).unwrap();
    assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 1)]);
    let other_kind = Features { descriptors: Descriptors::new(DescriptorKind::MOPS), ..a.clone() };
    let error = match_guided(&other_kind, &b, None, &TwoViewModel::Homography(h), &options, &Silent);
    assert!(matches!(error, Err(MatchError::KindsDiffer { .. })));
    let nothing = match_guided(&a, &b, None, &TwoViewModel::Homography(Matrix3::zeros()), &options, &Silent);
    assert_eq!(nothing, Ok(vec![]));
}

/// Pseudo-random numbers from 0 to 1.
fn random(state: &mut u32) -> f32 {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    (*state >> 8) as f32 / (1 << 24) as f32
}

/// Reference: exhaustive search.
fn plain(a: &Features, b: &Features, model: &TwoViewModel, options: &GuidedOptions) -> Vec<(u32, u32)> {
    let at = |f: &Features, i: usize| f.keypoints[i].position.cast::<f64>();
    let is_near = |i: usize, j: usize, model: &TwoViewModel, (a, b): (&Features, &Features)| {
        let (p, q) = (at(a, i), at(b, j));
        let (p, q) = (Vector3::new(p.x, p.y, 1.0), Vector3::new(q.x, q.y, 1.0));
        let limit = f64::from(options.threshold).powi(2);
        match model {
            TwoViewModel::Homography(h) => ((h * p) / (h * p).z - q).norm_squared() < limit,
            TwoViewModel::Fundamental(f) => {
                let (l, m) = (f * p, f.transpose() * q);
                q.dot(&l).powi(2) < limit * (l.xy().norm_squared() + m.xy().norm_squared())
            }
        }
    };
    let best = |i: usize, model: &TwoViewModel, (a, b): (&Features, &Features)| {
        let bytes = |f: &Features| ByteDescriptors::new(&f.descriptors).unwrap();
        let (da, db) = (bytes(a), bytes(b));
        let mut all: Vec<(f32, usize)> =
            (0..b.keypoints.len()).filter(|&j| is_near(i, j, model, (a, b))).map(|j| (da.ssd(i, &db, j), j)).collect();
        all.sort_by(|x, y| x.0.total_cmp(&y.0).then(x.1.cmp(&y.1)));
        let &(ssd, j) = all.first()?;
        let is_separate = |k: usize| (at(b, k) - at(b, j)).norm() > f64::from(options.duplicate_radius);
        let second = all.iter().find(|s| is_separate(s.1)).map_or(f32::INFINITY, |s| s.0);
        Some((j, ssd, second.min(a.descriptors.kind().max_ssd)))
    };
    let reversed = match model {
        TwoViewModel::Homography(h) => TwoViewModel::Homography(h.try_inverse().unwrap()),
        TwoViewModel::Fundamental(f) => TwoViewModel::Fundamental(f.transpose()),
    };
    let one = |i: usize| {
        let (j, ssd, second) = best(i, model, (a, b))?;
        let backward = best(j, &reversed, (b, a))?.0;
        let is_distinctive = ssd <= options.ratio * second && ssd <= a.descriptors.kind().max_ssd;
        (backward == i && is_distinctive).then_some((i as u32, j as u32))
    };
    (0..a.keypoints.len()).filter_map(one).collect()
}

#[test]
fn the_spatial_index_equals_exhaustive_search() {
    let mut state = 7u32;
    // Epipoles at infinity along rows and columns, inside the image, and far outside; a homography with rotation
    // and scale.
    let cross = |x: f64, y: f64, z: f64| Matrix3::new(0.0, -z, y, z, 0.0, -x, -y, x, 0.0);
    let homography = Matrix3::new(0.9, -0.3, 120.0, 0.3, 0.9, -60.0, 1e-5, -2e-5, 1.0);
    let models = [
        TwoViewModel::Fundamental(cross(1.0, 0.0, 0.0)),
        TwoViewModel::Fundamental(cross(0.0, 1.0, 0.0)),
        TwoViewModel::Fundamental(cross(400.0, 300.0, 1.0)),
        TwoViewModel::Fundamental(cross(5000.0, -900.0, 1.0) * homography),
        TwoViewModel::Homography(homography),
    ];
    for model in models {
        let mut set = |n: usize| {
            let points: Vec<(f32, f32)> =
                (0..n).map(|_| (800.0 * random(&mut state), 600.0 * random(&mut state))).collect();
            let values: Vec<f32> = (0..n).map(|_| 2.0 * random(&mut state)).collect();
            described(&points, &values)
        };
        let (a, mut b) = (set(600), set(700));
        // A third of the first set has a correspondence that satisfies the geometry.
        for i in 0..200 {
            let p = a.keypoints[i].position.cast::<f64>();
            let q = match model {
                TwoViewModel::Homography(h) => {
                    (h * Vector3::new(p.x, p.y, 1.0)).xy() / (h * Vector3::new(p.x, p.y, 1.0)).z
                }
                TwoViewModel::Fundamental(f) => {
                    let l = f * Vector3::new(p.x, p.y, 1.0);
                    let q = b.keypoints[i].position.cast::<f64>().coords;
                    q - l.xy() * ((l.x * q.x + l.y * q.y + l.z) / l.xy().norm_squared())
                }
            };
            b.keypoints[i].position = Point2::from(q).cast::<f32>();
            let row = a.descriptors.row(i).to_vec();
            let mut data = b.descriptors.as_slice().to_vec();
            data[i * 64..(i + 1) * 64].copy_from_slice(&row);
            b.descriptors = Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap();
        }
        // A position that is not finite has no candidates.
        b.keypoints[699].position.x = f32::NAN;
        let options = GuidedOptions { max_ssd: None, ..GuidedOptions::default() };
        let found = match_guided(&a, &b, None, &model, &options, &Silent).unwrap();
        let got: Vec<(u32, u32)> = found.iter().map(|m| (m.query, m.train)).collect();
        assert!(got.len() > 20, "{model:?}: {}", got.len());
        assert_eq!(got, plain(&a, &b, &model, &options), "{model:?}");
    }
}
