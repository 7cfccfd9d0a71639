//! Streets of identical houses: what looks alike must not be taken for the same.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Keypoint, Pose, Silent, Vector3};
use cv_sfm::{
    CameraKnowledge, PairMatches, PairRefusal, SfmInput, SfmOptions, SfmOutcome, SfmView, Solver, ViewPairModel,
    ViewPairOptions, reconstruct_views, verify_view_pair,
};
use cv_synth::{FeatureViews, FeatureViewsOptions};
use rayon::prelude::*;

/// A walk along a street of identical houses, three parts in ten of each being its own.
fn street(seed: u64) -> FeatureViews {
    let houses = 2 + seed as usize % 7;
    FeatureViews::new(&FeatureViewsOptions { houses, own: 0.3, seed, ..FeatureViewsOptions::default() })
}

struct Given {
    truth: FeatureViews,
    keypoints: Vec<Vec<Keypoint>>,
    pairs: Vec<PairMatches>,
    geometry: Vec<ViewPairModel>,
    /// Of each pair: whether most of its matches are of the same points.
    right: Vec<bool>,
}

impl Given {
    fn new(truth: FeatureViews) -> Self {
        let keypoint = |p: &cv_core::Point2<f64>| Keypoint::new(p.x as f32, p.y as f32, 1.0);
        let keypoints = truth.keypoints.iter().map(|view| view.iter().map(keypoint).collect()).collect();
        let mut given = Self { truth, keypoints, pairs: Vec::new(), geometry: Vec::new(), right: Vec::new() };
        // One match in ten is wrong: a few samples are enough.
        let options = ViewPairOptions { min_share: 0.6, ..ViewPairOptions::default() };
        for (a, b, _) in given.truth.pairs(30) {
            let matches = given.truth.matches(a, b);
            let known = (&given.truth.camera, &CameraKnowledge::Known);
            let both = [&given.keypoints[a][..], &given.keypoints[b]];
            if let Ok(found) = verify_view_pair([known; 2], both, &matches, &options, &Silent) {
                let matches: Vec<_> = found.inliers.iter().map(|i| matches[*i]).collect();
                let [one, two] = [a, b].map(|v| &given.truth.shown[v]);
                let same = matches.iter().filter(|m| one[m.query as usize] == two[m.train as usize]).count();
                given.right.push(2 * same > matches.len());
                given.pairs.push(PairMatches { a, b, matches });
                given.geometry.push(found.model);
            }
        }
        given
    }

    fn solve(&self, solver: Solver) -> SfmOutcome {
        let views: Vec<SfmView<'_>> = self.keypoints.iter().map(|k| SfmView { camera: 0, keypoints: k }).collect();
        let input = SfmInput {
            views: &views,
            cameras: &[self.truth.camera],
            knowledge: &[CameraKnowledge::Known],
            pairs: &self.pairs,
            geometry: &self.geometry,
            alike: None,
        };
        reconstruct_views(&input, &SfmOptions { solver, ..SfmOptions::default() }, &Silent).unwrap()
    }
}

/// The largest angle between a relative rotation of two views of a model and the true one, in degrees.
fn worst_turn(found: &[Option<Pose>], truth: &[Pose]) -> f64 {
    let pairs: Vec<(Pose, Pose)> = found.iter().zip(truth).filter_map(|(f, t)| Some(((*f)?, *t))).collect();
    let turn = |x: &(Pose, Pose), y: &(Pose, Pose)| {
        let [f, t] = [Pose::relative(&x.0, &y.0), Pose::relative(&x.1, &y.1)];
        Pose::new(f.rotation.inverse() * t.rotation, Vector3::zeros()).rotation_angle().to_degrees()
    };
    pairs.iter().flat_map(|x| pairs.iter().map(move |y| turn(x, y))).fold(0.0, f64::max)
}

#[test]
fn twenty_streets_of_identical_houses_are_not_folded() {
    let seeds: Vec<u64> = (0..20).collect();
    let rows: Vec<[(f64, usize, usize); 2]> = seeds
        .par_iter()
        .map(|seed| {
            let given = Given::new(street(*seed));
            [Solver::Auto, Solver::Incremental].map(|solver| {
                let found = given.solve(solver);
                let turn = |m: &cv_sfm::SfmModel| worst_turn(&m.poses, &given.truth.poses);
                let worst = found.models.iter().map(turn).fold(0.0, f64::max);
                let registered: usize = found.models.iter().map(|m| m.registered()).sum();
                let refused = |right: bool| found.refused.iter().filter(|r| given.right[r.pair] == right).count();
                let right = given.right.iter().filter(|r| **r).count();
                println!("street {seed} {solver}: {worst:.3} {:?} refused {} of {} right, {} of {} wrong", found.models.iter().map(|m| m.registered()).collect::<Vec<_>>(), refused(true), right, refused(false), given.right.len() - right);
                (worst, found.models.len(), registered)
            })
        })
        .collect();
    let _ = (rows, PairRefusal::Triplets { loops: 1 });
}
