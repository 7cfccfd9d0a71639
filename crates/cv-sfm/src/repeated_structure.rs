//! Pairs of views that show different things that look alike, such as two houses of a street.

use crate::pair_scales::{Distances, LEAST_SHARED};
use crate::view_graph::{Link, PairRefusal, RefusedPair, ViewGraph};
use crate::{PairMatches, SfmInput, SfmOptions, SfmView};
use cv_core::{Camera, Cancelled, Point2, Point3, Pose, Stage, Vector3, quantile};
use rayon::prelude::*;

/// Features of a view that are asked for in others, evenly from all that count: a share of so many is known to 2 %.
const ASKED: usize = 600;
/// Fewest for a share.
const LEAST_ASKED: usize = 40;
/// Other pairs that a feature is matched in before it counts: those of one pair may be wrong matches.
const OTHER_PAIRS: u32 = 2;
/// Largest change of what is asked for, in radians and logarithms of ratios of distances (see [`Share`]): features are found again from there.
const CHANGE: f64 = 0.35;
/// Nearest to the border of a picture that a feature is asked for, in pixels.
const BORDER: f64 = 10.0;
/// Largest median change of a link that is judged by its features.
const NEAR: f64 = 0.18;
/// The ratio of the share that is found to the one expected at which a link seems neither right nor wrong, how much less it is for each unit of change, and by how much more or less is sure. Of
/// fountain-P11, sceaux and templeRing no pair is below, of a drive (kitti-2) 11 of 752, which their loops make right again. Of generated streets whose houses have a fifth of their points for
/// themselves, pairs of different houses are at 0.83 in the middle and at 0.9 to 0.93 at the 95th percentile, pairs of the same at 0.9 and above. Where a tenth is their own, nothing tells.
const RATIO: f64 = 0.93;
const SLOPE: f64 = 0.6;
const SURE: f64 = 0.1;
/// As many loops count as much as what the features of a link say.
const OWN: f64 = 3.0;
/// Rounds of votes: as many links away, what is known reaches.
const ROUNDS: usize = 10;

/// How much one view has of what another shows.
#[derive(Debug, Clone, Copy)]
struct Share {
    /// The share, and its standard deviation.
    found: f64,
    deviation: f64,
    /// How differently the two see it: the median of angles (in radians) plus logarithms of ratios of distances.
    change: f64,
}

/// How much the second view of a link has of the first, and the first of the second.
type Overlap = [Option<Share>; 2];

/// Of each keypoint of a view, the logarithm of its point's distance; NaN where it is not known.
type Depths = Vec<f64>;

/// Distances in a unit of each view: of the link with most points, and of others as those agree with it.
fn depths(graph: &ViewGraph, distances: &[Distances], input: &SfmInput<'_>) -> Vec<Depths> {
    let mut of_view: Vec<Vec<&[(u32, f64)]>> = vec![Vec::new(); graph.views];
    for l in &graph.links {
        of_view[l.a].push(&distances[l.pair][0]);
        of_view[l.b].push(&distances[l.pair][1]);
    }
    let of = |(v, lists): (usize, &mut Vec<&[(u32, f64)]>)| {
        lists.sort_by_key(|list| std::cmp::Reverse(list.len()));
        let mut depths = vec![f64::NAN; input.views[v].keypoints.len()];
        for (n, list) in lists.iter().enumerate() {
            let Some(unit) = (if n == 0 { Some(0.0) } else { unit(&depths, list) }) else { continue };
            for (keypoint, distance) in *list {
                let depth = &mut depths[*keypoint as usize];
                *depth = if depth.is_nan() { distance - unit } else { *depth };
            }
        }
        depths
    };
    of_view.par_iter_mut().enumerate().map(of).collect()
}

/// What is to be taken from a link's distances to have them in the unit of a view.
fn unit(depths: &[f64], list: &[(u32, f64)]) -> Option<f64> {
    let off = list.iter().map(|(keypoint, distance)| distance - depths[*keypoint as usize]);
    let mut known: Vec<f64> = off.filter(|d| d.is_finite()).collect();
    if known.len() < LEAST_SHARED { None } else { quantile(&mut known, 0.5) }
}

/// A keypoint of a view that is asked for elsewhere.
struct Asked {
    keypoint: u32,
    /// How many pairs match it.
    degree: u32,
    /// Of length one.
    ray: Vector3<f64>,
    /// Logarithm of the distance of its point, in a unit of its view; where it is known.
    distance: Option<f64>,
}

/// Refuses links by missing correspondences (Zach, Irschara & Bischof, "What can missing correspondences tell us about 3D structure and motion?", CVPR 2008; Jiang, Tan & Cheong, "Seamless
/// structure from motion", CVPR 2012): what a view shows, and other pairs confirm, should be found in a view from nearly the same place as often as in views from farther away. Where it is not,
/// both views show things that look alike, each with something of its own. Loops that close carry this on to links that are too wide to be judged by their features, and set right what chance
/// has misjudged. `distances` are those of each pair's points. Nothing is refused where no link seems wrong. O(links · features asked for + loops).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn refuse_repeated(
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
    let depths: Vec<Depths> = depths(graph, distances, input);
    let of_view = |v| asked(input, cameras, v, &degree[v], &depths[v]);
    let asked: Vec<Vec<Asked>> = (0..graph.views).into_par_iter().map(of_view).collect();
    let overlap_of = |l: &Link| {
        let views = [l.a, l.b].map(|v| (&asked[v][..], &depths[v][..], &cameras[input.views[v].camera]));
        stage.check()?;
        Ok(overlap(l, &input.pairs[l.pair], &distances[l.pair], views, input, options))
    };
    let overlaps: Vec<Overlap> = graph.links.par_iter().map(overlap_of).collect::<Result<_, _>>()?;
    let mut of_view: Vec<Vec<(usize, usize)>> = vec![Vec::new(); graph.views];
    for (i, l) in graph.links.iter().enumerate() {
        of_view[l.b].push((i, 0));
        of_view[l.a].push((i, 1));
    }
    // Of a link and the view that is asked: the largest share that it has of a view, and of one from as far away or farther.
    let most = |i: usize, side: usize, change: f64| {
        let view = [graph.links[i].b, graph.links[i].a][side];
        let all = of_view[view].iter().filter_map(|(j, side)| overlaps[*j][*side]);
        let farther = all.filter(|s| s.change >= change);
        farther.map(|s| s.found - s.deviation).fold(0.0, f64::max)
    };
    let judge = |i: usize| {
        let side = |side: usize| {
            let own = overlaps[i][side]?;
            Some(Verdict::new(own, most(i, side, own.change), most(i, side, 0.0)))
        };
        let (one, two) = (side(0)?, side(1)?);
        Some(if one.score >= two.score { one } else { two })
    };
    let judged: Vec<Option<Verdict>> = (0..overlaps.len()).map(judge).collect();
    if !judged.iter().flatten().any(|v| v.score < 0.0) {
        return Ok(Vec::new());
    }
    let loops: Vec<[usize; 3]> = graph.closed_triplets();
    let scores = propagate(&judged, &loops);
    let mut counts = vec![(0, 0); graph.links.len()];
    for (i, p, q) in loops.iter().flat_map(each) {
        match (scores[p] >= 0.0, scores[q] >= 0.0) {
            (true, true) => counts[i].1 += 1,
            (false, false) => {}
            _ => counts[i].0 += 1,
        }
    }
    let reason = |i: usize| match judged[i].filter(|v| v.score < 0.0) {
        Some(v) => PairRefusal::Repeated { found: v.found, expected: v.expected },
        None => PairRefusal::RepeatedLoops { against: counts[i].0, of: counts[i].0 + counts[i].1 },
    };
    let wrong = (0..graph.links.len()).filter(|i| scores[*i] < 0.0);
    let refused: Vec<RefusedPair> =
        wrong.map(|i| RefusedPair { pair: graph.links[i].pair, reason: reason(i) }).collect();
    let mut index = 0..;
    graph.links.retain(|_| index.next().is_none_or(|i: usize| scores[i] >= 0.0));
    Ok(refused)
}

/// What the features of a link's views say of it.
#[derive(Debug, Clone, Copy)]
struct Verdict {
    /// The share that is found and the one expected, of the side on which they are nearer to each other.
    found: f64,
    expected: f64,
    /// From −1, surely wrong, to 1, surely right.
    score: f64,
}

impl Verdict {
    /// Of the share that a view has of another, the largest it has from as far away or farther, and the largest of all.
    fn new(own: Share, expected: f64, best: f64) -> Self {
        let limit = RATIO - SLOPE * own.change;
        // One where nothing is found and nothing expected.
        let ratio = |of: f64| (own.found + f64::EPSILON) / (of + f64::EPSILON);
        let seems = if own.change <= NEAR { ((ratio(expected) - limit) / SURE).clamp(-1.0, 1.0) } else { 0.0 };
        // Of nothing a view has more than of the same.
        let is = ((ratio(best) - (1.0 - SURE)) / SURE).clamp(0.0, 1.0);
        Self { found: own.found, expected, score: if seems == 0.0 { is } else { seems } }
    }
}

/// Each link of a loop with the two others.
fn each(&[a, b, c]: &[usize; 3]) -> [(usize, usize, usize); 3] {
    [(a, b, c), (b, c, a), (c, a, b)]
}

/// Scores of all links, of those that say something of themselves and of loops that close: of three such links none is wrong alone. Two right links make the third right, a right and a wrong one
/// make it wrong, two wrong ones say nothing.
fn propagate(judged: &[Option<Verdict>], loops: &[[usize; 3]]) -> Vec<f64> {
    let own: Vec<f64> = judged.iter().map(|v| v.map_or(0.0, |v| v.score)).collect();
    let mut scores = own.clone();
    for _ in 0..ROUNDS {
        // Of each link the sum of votes and of their weights.
        let mut votes = vec![(0.0, 0.0); scores.len()];
        for (i, p, q) in loops.iter().flat_map(each) {
            let vote: f64 = if scores[p] < 0.0 && scores[q] < 0.0 { 0.0 } else { scores[p] * scores[q] };
            votes[i].0 += vote;
            votes[i].1 += vote.abs();
        }
        scores = (0..own.len()).map(|i| (OWN * own[i] + votes[i].0) / (OWN + votes[i].1)).collect();
    }
    scores
}

/// The keypoints of a view that count, evenly from all of them.
fn asked(input: &SfmInput<'_>, cameras: &[Camera], view: usize, degree: &[u32], depths: &[f64]) -> Vec<Asked> {
    let SfmView { camera, keypoints } = input.views[view];
    let all: Vec<usize> = (0..keypoints.len()).filter(|k| degree[*k] >= OTHER_PAIRS).collect();
    let some = all.iter().step_by(all.len().div_ceil(ASKED).max(1));
    some.filter_map(|&k| {
        let ray = cameras[camera].normalize(keypoints[k].position.cast());
        let distance = Some(depths[k]).filter(|d| d.is_finite());
        let ray = ray.x.is_finite().then(|| ray.to_homogeneous().normalize())?;
        Some(Asked { keypoint: k as u32, degree: degree[k], ray, distance })
    })
    .collect()
}

/// How much each view of a link has of what the other shows: keypoints of the one, put where their points are by the relative pose, that are in the picture of the other and seen there from about
/// the same side and distance.
fn overlap(
    link: &Link,
    pair: &PairMatches,
    distances: &Distances,
    views: [(&[Asked], &[f64], &Camera); 2],
    input: &SfmInput<'_>,
    options: &SfmOptions,
) -> Overlap {
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
    // As if from one place.
    let still = quantile(&mut angles, 0.5).is_some_and(|a| a < options.min_angle);
    let side = |side: usize, pose: &Pose| {
        let (asked, depths, _) = views[side];
        let to = views[1 - side].2;
        let unit = unit(depths, &distances[side]);
        if unit.is_none() && !still {
            return None;
        }
        let mut matched: Vec<u32> = pair.sample().iter().map(|m| if side == 0 { m.query } else { m.train }).collect();
        matched.sort_unstable();
        let (mut found, mut changes) = (0, Vec::new());
        for one in asked {
            let has = matched.binary_search(&one.keypoint).is_ok();
            if one.degree - u32::from(has) < OTHER_PAIRS {
                continue;
            }
            let there = match (unit, one.distance) {
                (Some(unit), Some(distance)) => {
                    let distance = (distance + unit).exp();
                    let point = pose.transform(&Point3::from(one.ray * distance)).coords;
                    let turned = pose.rotation * one.ray;
                    let angle = turned.cross(&point).norm().atan2(turned.dot(&point));
                    let change = angle + (distance / point.norm()).ln().abs();
                    Some((point, change)).filter(|_| change <= CHANGE)
                }
                (None, _) => Some((pose.rotation * one.ray, 0.0)),
                _ => None,
            };
            let Some((point, change)) = there.filter(|t| t.0.z > 0.0) else { continue };
            let at = to.denormalize(Point2::new(point.x / point.z, point.y / point.z));
            let inside = |v: f64, n: usize| v >= BORDER && v <= n as f64 - 1.0 - BORDER;
            if inside(at.x, to.width) && inside(at.y, to.height) {
                changes.push(change);
                found += usize::from(has);
            }
        }
        if changes.len() < LEAST_ASKED {
            return None;
        }
        let (found, count) = (found as f64 / changes.len() as f64, changes.len() as f64);
        let change = quantile(&mut changes, 0.5).unwrap_or(0.0);
        Some(Share { found, deviation: (found * (1.0 - found) / count).sqrt(), change })
    };
    [side(0, &link.pose), side(1, &link.pose.inverse())]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Links between all of twelve views, four of each of three houses that look alike: views of the same number within a house look the same.
    fn houses() -> (Vec<(usize, usize)>, Vec<[usize; 3]>) {
        let links: Vec<(usize, usize)> = (0..12).flat_map(|a| (a + 1..12).map(move |b| (a, b))).collect();
        let at = |a: usize, b: usize| links.iter().position(|l| *l == (a, b));
        let all = (0..12).flat_map(|a| (a + 1..12).flat_map(move |b| (b + 1..12).map(move |c| (a, b, c))));
        let loops = all.filter_map(|(a, b, c)| Some([at(a, b)?, at(b, c)?, at(a, c)?])).collect();
        (links, loops)
    }

    #[test]
    fn loops_carry_on_what_near_views_tell() {
        let (links, loops) = houses();
        let verdict = |score: f64| Some(Verdict { found: 0.5, expected: 0.5, score });
        // Only neighbors of a house, and the same view of two houses, are near enough to be judged; of the latter one in three is misjudged.
        let judged: Vec<Option<Verdict>> = links
            .iter()
            .map(|&(a, b)| match (a / 4 == b / 4, b - a) {
                (true, 1) => verdict(0.9),
                (false, 4) if a % 3 == 0 => verdict(0.2),
                (false, 4 | 8) => verdict(-0.8),
                _ => None,
            })
            .collect();
        for ((a, b), score) in links.iter().zip(propagate(&judged, &loops)) {
            assert!((a / 4 == b / 4) == (score > 0.0) && score != 0.0, "{a} {b}: {score}");
        }
    }

    #[test]
    fn a_right_pair_that_chance_misjudged_is_set_right_by_its_loops() {
        let (links, loops) = houses();
        let verdict = |score: f64| Some(Verdict { found: 0.5, expected: 0.5, score });
        // One scene: all are right, one in eleven seems wrong.
        let judged: Vec<Option<Verdict>> =
            (0..links.len()).map(|i| verdict(if i % 11 == 5 { -0.7 } else { 0.8 })).collect();
        assert!(propagate(&judged, &loops).iter().all(|s| *s > 0.0));
    }

    #[test]
    fn a_view_from_as_near_that_has_less_is_another() {
        let own = |found: f64, change: f64| Share { found, deviation: 0.02, change };
        let score = |found, change, expected, best| Verdict::new(own(found, change), expected, best).score;
        // Half of what farther views share, from the same place; then as much.
        assert!(score(0.3, 0.02, 0.6, 0.6) == -1.0 && score(0.6, 0.02, 0.6, 0.6) > 0.5);
        // From far away little is shared, which says nothing.
        assert!(score(0.3, 0.3, 0.3, 0.6) == 0.0 && score(0.0, 0.3, 0.0, 0.0) >= 0.0);
    }
}
