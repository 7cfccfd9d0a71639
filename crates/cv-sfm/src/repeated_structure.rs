//! Rejection of pairs of views that match different instances of repeated structure, such as two houses of a street.

use crate::pair_scales::{Distances, MIN_SHARED_POINTS};
use crate::view_graph::{Link, PairRefusal, RefusedPair, ViewGraph};
use crate::{PairMatches, SfmInput, SfmOptions, SfmView};
use cv_core::{Camera, Cancelled, Point2, Point3, Pose, Stage, Vector3, quantile};
use cv_parallel::prelude::*;

/// Maximum number of features that a view is probed with, sampled evenly: a ratio is then known to 2 %.
const MAX_PROBES: usize = 600;
/// Minimum number for a ratio.
const MIN_PROBES: usize = 40;
/// Minimum number of other pairs that match a feature, for it to be a probe: a match in one pair only may be wrong.
const MIN_OTHER_PAIRS: u32 = 2;
/// Largest viewpoint change of a probe (see [`MatchRatio`]): up to there features are matched.
const MAX_PROBE_CHANGE: f64 = 0.35;
/// Width of the image border without probes, in pixels.
const BORDER_PX: f64 = 10.0;
/// Largest median viewpoint change of a link that is scored by its features.
const MAX_SCORED_CHANGE: f64 = 0.18;
/// Ratio of the measured to the expected match ratio at which the score of a link is 0. Of fountain-P11, sceaux and
/// templeRing no pair is below, of a drive (kitti-2) 11 of 752, which their triplets correct. On generated streets where
/// a fifth of a house's points are unique, pairs of different houses have a median of 0.83 and a 95th percentile of 0.9
/// to 0.93, pairs of the same house 0.9 and above. With a tenth unique, the two cannot be separated.
const NEUTRAL_RATIO: f64 = 0.93;
/// Decrease of that ratio per unit of viewpoint change.
const NEUTRAL_RATIO_SLOPE: f64 = 0.6;
/// Distance from that ratio at which the score is ±1.
const RATIO_MARGIN: f64 = 0.1;
/// Weight of a link's own score, in triplets.
const UNARY_WEIGHT: f64 = 3.0;
/// Score below which a link is rejected: a link without a score of its own needs votes of a weight of a third at least.
const REJECTION_SCORE: f64 = -0.1;
/// Number of propagation rounds, and the distance in links that scores reach.
const PROPAGATION_ROUNDS: usize = 10;

/// Ratio of the probes of one view that are matched in another.
#[derive(Debug, Clone, Copy)]
struct MatchRatio {
    /// The ratio, and its binomial standard deviation.
    ratio: f64,
    sigma: f64,
    /// Viewpoint change: the median over the probes of the angle between the rays (in radians) plus the absolute
    /// logarithm of the ratio of the distances.
    change: f64,
}

/// Match ratio of the first view's probes in the second view, and the reverse.
type MatchRatios = [Option<MatchRatio>; 2];

/// Logarithm of the distance of each keypoint's point; NaN where it is unknown.
type LogDepths = Vec<f64>;

/// Returns the distances of each view in a common unit: that of its link with most points, to which the other links are
/// aligned.
fn log_depths(graph: &ViewGraph, distances: &[Distances], input: &SfmInput<'_>) -> Vec<LogDepths> {
    let mut of_view: Vec<Vec<&[(u32, f64)]>> = vec![Vec::new(); graph.views];
    for l in &graph.links {
        of_view[l.a].push(&distances[l.pair][0]);
        of_view[l.b].push(&distances[l.pair][1]);
    }
    let of = |(v, lists): (usize, &mut Vec<&[(u32, f64)]>)| {
        lists.sort_by_key(|list| std::cmp::Reverse(list.len()));
        let mut log_depths = vec![f64::NAN; input.views[v].keypoints.len()];
        for (n, list) in lists.iter().enumerate() {
            let Some(unit) = (if n == 0 { Some(0.0) } else { unit_offset(&log_depths, list) }) else { continue };
            for (keypoint, distance) in *list {
                let depth = &mut log_depths[*keypoint as usize];
                *depth = if depth.is_nan() { distance - unit } else { *depth };
            }
        }
        log_depths
    };
    of_view.par_iter_mut().enumerate().map(of).collect()
}

/// Returns the median offset of a link's log distances from those of the view; `None` with too few shared points.
fn unit_offset(log_depths: &[f64], list: &[(u32, f64)]) -> Option<f64> {
    let offsets = list.iter().map(|(keypoint, distance)| distance - log_depths[*keypoint as usize]);
    let mut finite: Vec<f64> = offsets.filter(|d| d.is_finite()).collect();
    if finite.len() < MIN_SHARED_POINTS { None } else { quantile(&mut finite, 0.5) }
}

/// A feature of a view that should be matched in nearby views.
struct Probe {
    keypoint: u32,
    /// Number of pairs that match it.
    degree: u32,
    /// Unit vector.
    ray: Vector3<f64>,
    /// Logarithm of the distance of its point, in the unit of its view; `None` where it is unknown.
    distance: Option<f64>,
}

/// Rejects links by missing correspondences (Zach, Irschara & Bischof, "What can missing correspondences tell us about
/// 3D structure and motion?", CVPR 2008; Jiang, Tan & Cheong, "Seamless structure from motion", CVPR 2012). Features of
/// one view that other pairs confirm should be matched in a nearby view at least as often as in views farther away. If
/// they are not, the two views show different instances of repeated structure. Triplets with consistent rotations
/// propagate the scores to links with a wide baseline, and correct scores that are wrong by chance. `distances` are
/// those of each pair's points. Without a negative score nothing is rejected. O(links · probes + triplets).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn reject_repeated_structure(
    graph: &mut ViewGraph,
    distances: &[Distances],
    input: &SfmInput<'_>,
    cameras: &[Camera],
    options: &SfmOptions,
    stage: &Stage<'_>,
) -> Result<Vec<RefusedPair>, Cancelled> {
    let mut degree: Vec<Vec<u32>> = input.views.iter().map(|v| vec![0; v.keypoints.len()]).collect();
    for link in &graph.links {
        let pair = &input.pairs[link.pair];
        for m in pair.sample() {
            let both = [(pair.a, m.query), (pair.b, m.train)];
            both.iter().for_each(|(v, k)| degree[*v].get_mut(*k as usize).into_iter().for_each(|d| *d += 1));
        }
    }
    let log_depths: Vec<LogDepths> = log_depths(graph, distances, input);
    let of_view = |v| probes_of_view(input, cameras, v, &degree[v], &log_depths[v]);
    let probes: Vec<Vec<Probe>> = (0..graph.views).into_par_iter().map(of_view).collect();
    let ratios_of = |l: &Link| {
        let views = [l.a, l.b].map(|v| (&probes[v][..], &log_depths[v][..], &cameras[input.views[v].camera]));
        stage.check()?;
        Ok(match_ratios(l, &input.pairs[l.pair], &distances[l.pair], views, input, options))
    };
    let ratios: Vec<MatchRatios> = graph.links.par_iter().map(ratios_of).try_collect()?;
    let mut of_view: Vec<Vec<(usize, usize)>> = vec![Vec::new(); graph.views];
    for (i, l) in graph.links.iter().enumerate() {
        of_view[l.b].push((i, 0));
        of_view[l.a].push((i, 1));
    }
    // Largest match ratio of a view (less one standard deviation) over its links with at least this viewpoint change.
    let max_ratio = |i: usize, side: usize, change: f64| {
        let view = [graph.links[i].b, graph.links[i].a][side];
        let all = of_view[view].iter().filter_map(|(j, side)| ratios[*j][*side]);
        let farther = all.filter(|s| s.change >= change);
        farther.map(|s| s.ratio - s.sigma).fold(0.0, f64::max)
    };
    let score_link = |i: usize| {
        let side = |side: usize| {
            let measured = ratios[i][side]?;
            Some(LinkScore::new(measured, max_ratio(i, side, measured.change), max_ratio(i, side, 0.0)))
        };
        let (one, two) = (side(0)?, side(1)?);
        Some(if one.score >= two.score { one } else { two })
    };
    let unary: Vec<Option<LinkScore>> = (0..ratios.len()).map(score_link).collect();
    if !unary.iter().flatten().any(|v| v.score < 0.0) {
        return Ok(Vec::new());
    }
    let triplets: Vec<[usize; 3]> = graph.consistent_triplets();
    let match_count = |l: &Link| match input.pairs[l.pair].sample() {
        [] => l.matches,
        sample => sample.len(),
    };
    let matches: Vec<usize> = graph.links.iter().map(match_count).collect();
    let scores = propagate_scores(&unary, &triplets, &matches);
    let mut counts = vec![(0, 0); graph.links.len()];
    for (i, p, q) in triplets.iter().flat_map(link_with_others) {
        match (scores[p] >= REJECTION_SCORE, scores[q] >= REJECTION_SCORE) {
            (true, true) => counts[i].1 += 1,
            (false, false) => {}
            _ => counts[i].0 += 1,
        }
    }
    let reason = |i: usize| match unary[i].filter(|v| v.score < 0.0) {
        Some(v) => PairRefusal::Repeated { found: v.found, expected: v.expected },
        None => PairRefusal::RepeatedLoops { against: counts[i].0, of: counts[i].0 + counts[i].1 },
    };
    let rejected = (0..graph.links.len()).filter(|i| scores[*i] < REJECTION_SCORE);
    let refused: Vec<RefusedPair> =
        rejected.map(|i| RefusedPair { pair: graph.links[i].pair, reason: reason(i) }).collect();
    let mut index = 0..;
    graph.links.retain(|_| index.next().is_none_or(|i: usize| scores[i] >= REJECTION_SCORE));
    Ok(refused)
}

/// Score of a link by the features of its two views.
#[derive(Debug, Clone, Copy)]
struct LinkScore {
    /// Measured and expected match ratio, of the direction with the higher score.
    found: f64,
    expected: f64,
    /// From −1, certainly wrong, to 1, certainly right.
    score: f64,
}

impl LinkScore {
    /// Scores a match ratio, given the largest ratio at the same or a larger viewpoint change and the largest ratio of
    /// all.
    fn new(measured: MatchRatio, expected: f64, best: f64) -> Self {
        let neutral = NEUTRAL_RATIO - NEUTRAL_RATIO_SLOPE * measured.change;
        // One for 0/0.
        let relative = |of: f64| (measured.ratio + f64::EPSILON) / (of + f64::EPSILON);
        let nearby_score = if measured.change <= MAX_SCORED_CHANGE {
            ((relative(expected) - neutral) / RATIO_MARGIN).clamp(-1.0, 1.0)
        } else {
            0.0
        };
        // A view has the largest match ratio with views of the same instance.
        let best_score = ((relative(best) - (1.0 - RATIO_MARGIN)) / RATIO_MARGIN).clamp(0.0, 1.0);
        Self { found: measured.ratio, expected, score: if nearby_score == 0.0 { best_score } else { nearby_score } }
    }
}

/// Returns each link of a triplet with the two others.
fn link_with_others(&[a, b, c]: &[usize; 3]) -> [(usize, usize, usize); 3] {
    [(a, b, c), (b, c, a), (c, a, b)]
}

/// Propagates link scores over triplets with consistent rotations, in which one link alone cannot be wrong: two right
/// links make the third right, a right and a wrong link make it wrong, two wrong links say nothing. `unary` are the
/// scores by features.
///
/// The vote of a triplet counts in proportion to the matches of its weaker other link, up to one: where all views look
/// the same way, rotations are consistent by chance, and a few accidental matches must not outvote a thousand.
fn propagate_scores(unary: &[Option<LinkScore>], triplets: &[[usize; 3]], matches: &[usize]) -> Vec<f64> {
    let unary_scores: Vec<f64> = unary.iter().map(|v| v.map_or(0.0, |v| v.score)).collect();
    let mut scores = unary_scores.clone();
    for _ in 0..PROPAGATION_ROUNDS {
        // Sum of votes and of their weights, by link.
        let mut votes = vec![(0.0, 0.0); scores.len()];
        for (i, p, q) in triplets.iter().flat_map(link_with_others) {
            let weight = (matches[p].min(matches[q]) as f64 / matches[i].max(1) as f64).min(1.0);
            let vote = if scores[p] < 0.0 && scores[q] < 0.0 { 0.0 } else { weight * scores[p] * scores[q] };
            votes[i].0 += vote;
            votes[i].1 += vote.abs();
        }
        scores = (0..unary_scores.len())
            .map(|i| (UNARY_WEIGHT * unary_scores[i] + votes[i].0) / (UNARY_WEIGHT + votes[i].1))
            .collect();
    }
    scores
}

/// Returns the probes of a view, sampled evenly from the features with enough matches.
fn probes_of_view(
    input: &SfmInput<'_>,
    cameras: &[Camera],
    view: usize,
    degree: &[u32],
    log_depths: &[f64],
) -> Vec<Probe> {
    let SfmView { camera, keypoints } = input.views[view];
    let all: Vec<usize> = (0..keypoints.len()).filter(|k| degree[*k] >= MIN_OTHER_PAIRS).collect();
    let sampled = all.iter().step_by(all.len().div_ceil(MAX_PROBES).max(1));
    sampled
        .filter_map(|&k| {
            let ray = cameras[camera].normalize(keypoints[k].position.cast());
            let distance = Some(log_depths[k]).filter(|d| d.is_finite());
            let ray = ray.x.is_finite().then(|| ray.to_homogeneous().normalize())?;
            Some(Probe { keypoint: k as u32, degree: degree[k], ray, distance })
        })
        .collect()
}

/// Computes the match ratios of a link in both directions. A probe counts if its point, transferred by the relative
/// pose, projects into the other image with a small viewpoint change.
fn match_ratios(
    link: &Link,
    pair: &PairMatches,
    distances: &Distances,
    views: [(&[Probe], &[f64], &Camera); 2],
    input: &SfmInput<'_>,
    options: &SfmOptions,
) -> MatchRatios {
    if pair.sample().is_empty() {
        return [None, None];
    }
    let rotation = link.pose.rotation;
    let [one, two] = [link.a, link.b].map(|v| input.views[v].keypoints);
    let angle = |m: &cv_core::DMatch| {
        let pixels = m.correspondence(one, two)?;
        let x = rotation * views[0].2.normalize(pixels.a).to_homogeneous();
        let y = views[1].2.normalize(pixels.b).to_homogeneous();
        Some(x.cross(&y).norm().atan2(x.dot(&y))).filter(|angle| angle.is_finite())
    };
    let mut angles: Vec<f64> = pair.sample().iter().filter_map(angle).collect();
    // No parallax: the transfer is a rotation.
    let is_rotation = quantile(&mut angles, 0.5).is_some_and(|a| a < options.min_angle);
    let side = |side: usize, pose: &Pose| {
        let (probes, log_depths, _) = views[side];
        let to = views[1 - side].2;
        let unit = unit_offset(log_depths, &distances[side]);
        if unit.is_none() && !is_rotation {
            return None;
        }
        let mut matched: Vec<u32> = pair.sample().iter().map(|m| if side == 0 { m.query } else { m.train }).collect();
        matched.sort_unstable();
        let (mut matched_probes, mut changes) = (0, Vec::new());
        for probe in probes {
            let is_matched = matched.binary_search(&probe.keypoint).is_ok();
            if probe.degree - u32::from(is_matched) < MIN_OTHER_PAIRS {
                continue;
            }
            let transferred = match (unit, probe.distance) {
                (Some(unit), Some(distance)) => {
                    let distance = (distance + unit).exp();
                    let point = pose.transform(&Point3::from(probe.ray * distance)).coords;
                    let rotated = pose.rotation * probe.ray;
                    let angle = rotated.cross(&point).norm().atan2(rotated.dot(&point));
                    let change = angle + (distance / point.norm()).ln().abs();
                    Some((point, change)).filter(|_| change <= MAX_PROBE_CHANGE)
                }
                (None, _) => Some((pose.rotation * probe.ray, 0.0)),
                _ => None,
            };
            let Some((point, change)) = transferred.filter(|t| t.0.z > 0.0) else { continue };
            let pixel = to.denormalize(Point2::new(point.x / point.z, point.y / point.z));
            let is_inside = |v: f64, n: usize| v >= BORDER_PX && v <= n as f64 - 1.0 - BORDER_PX;
            if is_inside(pixel.x, to.width) && is_inside(pixel.y, to.height) {
                changes.push(change);
                matched_probes += usize::from(is_matched);
            }
        }
        if changes.len() < MIN_PROBES {
            return None;
        }
        let (ratio, count) = (matched_probes as f64 / changes.len() as f64, changes.len() as f64);
        let change = quantile(&mut changes, 0.5).unwrap_or(0.0);
        Some(MatchRatio { ratio, sigma: (ratio * (1.0 - ratio) / count).sqrt(), change })
    };
    [side(0, &link.pose), side(1, &link.pose.inverse())]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Links between all pairs of twelve views, four of each of three identical houses: views with the same number
    /// within a house look the same.
    fn houses() -> (Vec<(usize, usize)>, Vec<[usize; 3]>) {
        let links: Vec<(usize, usize)> = (0..12).flat_map(|a| (a + 1..12).map(move |b| (a, b))).collect();
        let at = |a: usize, b: usize| links.iter().position(|l| *l == (a, b));
        let all = (0..12).flat_map(|a| (a + 1..12).flat_map(move |b| (b + 1..12).map(move |c| (a, b, c))));
        let triplets = all.filter_map(|(a, b, c)| Some([at(a, b)?, at(b, c)?, at(a, c)?])).collect();
        (links, triplets)
    }

    #[test]
    fn triplets_propagate_the_scores_of_nearby_views() {
        let (links, triplets) = houses();
        let score_of = |score: f64| Some(LinkScore { found: 0.5, expected: 0.5, score });
        // Only neighbors at a house, and the same view of two houses, are near enough to be scored; one in three of the
        // latter is scored wrongly.
        let unary: Vec<Option<LinkScore>> = links
            .iter()
            .map(|&(a, b)| match (a / 4 == b / 4, b - a) {
                (true, 1) => score_of(0.9),
                (false, 4) if a % 3 == 0 => score_of(0.2),
                (false, 4 | 8) => score_of(-0.8),
                _ => None,
            })
            .collect();
        for ((a, b), score) in links.iter().zip(propagate_scores(&unary, &triplets, &vec![100; links.len()])) {
            assert!((a / 4 == b / 4) == (score > 0.0) && score != 0.0, "{a} {b}: {score}");
        }
    }

    #[test]
    fn few_matches_do_not_outvote_many() {
        let score_of = |score: f64| Some(LinkScore { found: 0.5, expected: 0.5, score });
        // Link 0 has no score of its own, and two triplets of a right and a wrong link against it.
        let unary = [None, score_of(0.9), score_of(-0.9), score_of(0.9), score_of(-0.9)];
        let triplets = [[0, 1, 2], [0, 3, 4]];
        let score = |few: usize| propagate_scores(&unary, &triplets, &[1000, 900, few, 900, few])[0];
        assert!(score(20) > REJECTION_SCORE && score(900) < REJECTION_SCORE, "{} {}", score(20), score(900));
    }

    #[test]
    fn triplets_correct_right_links_with_a_wrong_score() {
        let (links, triplets) = houses();
        let score_of = |score: f64| Some(LinkScore { found: 0.5, expected: 0.5, score });
        // One scene: all links are right, one in eleven has a negative score.
        let unary: Vec<Option<LinkScore>> =
            (0..links.len()).map(|i| score_of(if i % 11 == 5 { -0.7 } else { 0.8 })).collect();
        assert!(propagate_scores(&unary, &triplets, &vec![100; links.len()]).iter().all(|s| *s > 0.0));
    }

    #[test]
    fn a_nearby_view_with_a_low_match_ratio_is_rejected() {
        let measured = |ratio: f64, change: f64| MatchRatio { ratio, sigma: 0.02, change };
        let score = |ratio, change, expected, best| LinkScore::new(measured(ratio, change), expected, best).score;
        // Half of the match ratio of farther views, from the same viewpoint; then the same ratio.
        assert!(score(0.3, 0.02, 0.6, 0.6) == -1.0 && score(0.6, 0.02, 0.6, 0.6) > 0.5);
        // A large viewpoint change is no evidence.
        assert!(score(0.3, 0.3, 0.3, 0.6) == 0.0 && score(0.0, 0.3, 0.0, 0.0) >= 0.0);
    }
}
