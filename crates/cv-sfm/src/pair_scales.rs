//! Relative lengths of the baselines of pairs.

use crate::SfmInput;
use crate::view_graph::{Link, ViewGraph};
use cv_core::{Camera, Cancelled, Correspondence, Stage, quantile};
use cv_geometry::{PairEdge, PairGraph, parallax_angle, triangulate};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustIteration, AdjustOptions, Adjustment, Euclidean, Residual};
use cv_parallel::prelude::*;
use nalgebra::{SMatrix, SVector};
use std::ops::ControlFlow;

/// Minimum number of shared points to compare the baselines of two pairs.
pub(crate) const MIN_SHARED_POINTS: usize = 5;
/// Number of other pairs of each of its views that a pair is compared with, those with most points first.
const MAX_COMPARISONS: usize = 8;
/// Scale of the Huber loss, in logarithms of ratios: about 10 %.
const LOSS_SCALE: f64 = 0.1;

/// For both views of a link: keypoint indices with the logarithm of the distance to the triangulated point, in
/// baselines, sorted by keypoint.
pub(crate) type Distances = [Vec<(u32, f64)>; 2];

/// Triangulates the matches of each link and returns the distances of the points with a triangulation angle of at least
/// `min_angle`. O(matches).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn measure_distances(
    graph: &ViewGraph,
    input: &SfmInput<'_>,
    cameras: &[Camera],
    min_angle: f64,
    stage: &Stage<'_>,
) -> Result<Vec<Distances>, Cancelled> {
    let of_link = |link: &Link| {
        stage.check()?;
        let [a, b] = [link.a, link.b].map(|v| &cameras[input.views[v].camera]);
        let [one, two] = [link.a, link.b].map(|v| input.views[v].keypoints);
        let mut distances: Distances = Default::default();
        for m in &input.pairs[link.pair].matches {
            let Some(pixels) = m.correspondence(one, two) else { continue };
            let ray = Correspondence { a: a.normalize(pixels.a), b: b.normalize(pixels.b) };
            let Ok(point) = triangulate(&ray, &link.pose) else { continue };
            if ray.is_finite() && parallax_angle(&point, &link.pose) >= min_angle {
                distances[0].push((m.query, point.coords.norm().ln()));
                distances[1].push((m.train, link.pose.transform(&point).coords.norm().ln()));
            }
        }
        distances.iter_mut().for_each(|list| list.sort_unstable_by(|x, y| x.0.cmp(&y.0).then(x.1.total_cmp(&y.1))));
        Ok(distances)
    };
    graph.links.par_iter().map(of_link).try_collect()
}

/// Returns the median difference over the keypoints in both lists, and their count.
pub(crate) fn median_difference(x: &[(u32, f64)], y: &[(u32, f64)]) -> (f64, usize) {
    let (mut i, mut j) = (0, 0);
    let mut differences = Vec::new();
    while i < x.len() && j < y.len() {
        if x[i].0 == y[j].0 {
            differences.push(x[i].1 - y[j].1);
        }
        let (a, b) = (x[i].0, y[j].0);
        i += usize::from(a <= b);
        j += usize::from(b <= a);
    }
    let count = differences.len();
    (quantile(&mut differences, 0.5).unwrap_or(0.0), count)
}

/// Residuals of measured differences of two scalars.
struct DifferenceResidual(Vec<f64>);

impl Residual<1, 2, 2> for DifferenceResidual {
    const DIMS: [usize; 2] = [1, 1];

    fn evaluate(
        &self,
        item: usize,
        [a, b]: [&[f64]; 2],
        jacobian: Option<&mut SMatrix<f64, 1, 2>>,
    ) -> Option<SVector<f64, 1>> {
        if let Some(j) = jacobian {
            (j[0], j[1]) = (-1.0, 1.0);
        }
        Some(SVector::from([b[0] - a[0] - self.0[item]]))
    }
}

/// Estimates the length of each link's baseline in a common unit; `None` with too little parallax or without a shared
/// point. Two pairs with a common view triangulate the same points from there; the ratio of the distances is that of
/// the baselines. Minimizes the Huber loss of the logarithms of all such ratios. `measured` are the distances of each
/// link. O(matches) for each comparison.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn estimate_baselines(
    graph: &ViewGraph,
    measured: &[&Distances],
    stage: &Stage<'_>,
) -> Result<Vec<Option<f64>>, Cancelled> {
    let links = &graph.links;
    // The links of each view, those with most points first.
    let mut of_view: Vec<Vec<(usize, usize)>> = vec![Vec::new(); graph.views];
    for (i, l) in links.iter().enumerate().filter(|(i, _)| measured[*i][0].len() >= MIN_SHARED_POINTS) {
        of_view[l.a].push((i, 0));
        of_view[l.b].push((i, 1));
    }
    let mut candidates = Vec::new();
    for list in &mut of_view {
        list.sort_by(|x, y| measured[y.0][0].len().cmp(&measured[x.0][0].len()).then(x.0.cmp(&y.0)));
        for n in 1..list.len() {
            // The first links of the list, and the preceding ones.
            let preceding = n.saturating_sub(MAX_COMPARISONS / 2).max(MAX_COMPARISONS / 2)..n;
            candidates.extend((0..n.min(MAX_COMPARISONS / 2)).chain(preceding).map(|m| (list[m], list[n])));
        }
    }
    let compare = |&(x, y): &((usize, usize), (usize, usize))| {
        // A point is d_x baselines away in one pair and d_y in the other: b_x d_x = b_y d_y.
        let (ratio, shared) = median_difference(&measured[x.0][x.1], &measured[y.0][y.1]);
        (shared >= MIN_SHARED_POINTS).then_some((PairEdge { a: x.0, b: y.0, weight: shared as f64 }, ratio))
    };
    let (edges, ratios): (Vec<PairEdge>, Vec<f64>) =
        candidates.par_iter().map(compare).collect().into_iter().flatten().unzip();
    stage.check()?;
    let mut logarithms: Vec<Option<f64>> = vec![None; links.len()];
    let Ok(comparisons) = PairGraph::new(links.len(), edges) else { return Ok(logarithms) };
    let tree = comparisons.maximum_spanning_forest();
    let component = comparisons.connected_components().into_iter().next().filter(|c| c.len() > 1);
    let Some(root) = component.and_then(|c| c.first().copied()) else { return Ok(logarithms) };
    logarithms[root] = Some(0.0);
    for step in comparisons.breadth_first(&tree, root) {
        let ratio = ratios[step.edge];
        let forward = if comparisons.edges()[step.edge].a == step.parent { ratio } else { -ratio };
        logarithms[step.node] = logarithms[step.parent].map(|parent| parent + forward);
    }
    let nodes: Vec<usize> = (0..links.len()).filter(|i| logarithms[*i].is_some()).collect();
    let mut block_of = vec![0u32; links.len()];
    nodes.iter().zip(0..).for_each(|(i, n)| block_of[*i] = n);
    let inside = |e: &PairEdge| logarithms[e.a].is_some();
    let (blocks, differences): (Vec<[u32; 2]>, Vec<f64>) = comparisons
        .edges()
        .iter()
        .zip(&ratios)
        .filter(|(e, _)| inside(e))
        .map(|(e, ratio)| ([block_of[e.a], block_of[e.b]], *ratio))
        .unzip();
    let start: Vec<f64> = nodes.iter().filter_map(|i| logarithms[*i]).collect();
    let solved = (|| {
        let mut problem = Adjustment::default();
        let group = problem.add_group("logarithms of baselines", Euclidean(1), start)?;
        problem.fix(group, block_of[root] as usize)?;
        let loss = RobustLoss::Huber { scale: LOSS_SCALE };
        problem.add_residuals("ratios", DifferenceResidual(differences), [group, group], blocks, loss)?;
        let settings = AdjustOptions { max_iterations: 30, cost_tolerance: 1e-4, ..AdjustOptions::default() };
        problem.solve(&settings, |_: &AdjustIteration| match stage.check() {
            Ok(()) => ControlFlow::Continue(()),
            Err(Cancelled) => ControlFlow::Break(()),
        })?;
        Ok::<_, cv_numeric::adjust::AdjustError>(problem.values(group).to_vec())
    })();
    stage.check()?;
    for (i, value) in nodes.iter().zip(solved.iter().flatten()) {
        logarithms[*i] = Some(*value);
    }
    Ok(logarithms.into_iter().map(|l| l.map(f64::exp).filter(|b| b.is_finite() && *b > 0.0)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Point3, Pose, Silent};

    #[test]
    fn baseline_ratios_follow_from_shared_points() {
        // Eight views along a curved path, pairs up to three views apart, points on a lattice around it.
        let center = |v: usize| Point3::new(v as f64, 0.1 * (v * v) as f64, 0.3 * (v % 2) as f64);
        let point = |k: u32| Point3::new(f64::from(k % 9), f64::from(k / 9 % 5), 4.0 + f64::from(k % 7));
        let pairs = (0..8).flat_map(|a| (a + 1..8.min(a + 4)).map(move |b| (a, b)));
        let link = |(pair, (a, b))| Link { pair, a, b, pose: Pose::identity(), matches: 40 };
        let graph = ViewGraph { views: 8, links: pairs.enumerate().map(link).collect() };
        let baseline = |l: &Link| (center(l.a) - center(l.b)).norm();
        let list = |l: &Link, v: usize| -> Vec<(u32, f64)> {
            // Each pair has two thirds of the points, and one in eight of its distances is an outlier.
            let visible = (0..90).filter(|k| !(*k as usize + l.pair).is_multiple_of(3));
            let factor = |k: u32| if (k as usize / 3 + l.pair).is_multiple_of(8) { 2.0 } else { 1.0 };
            visible.map(|k| (k, (factor(k) * (point(k) - center(v)).norm() / baseline(l)).ln())).collect()
        };
        let measured: Vec<Distances> = graph.links.iter().map(|l| [list(l, l.a), list(l, l.b)]).collect();
        let stage = Stage::new(&Silent, "test", 1).unwrap();
        let lengths = estimate_baselines(&graph, &measured.iter().collect::<Vec<_>>(), &stage).unwrap();
        let unit = lengths[0].unwrap() / baseline(&graph.links[0]);
        for (l, length) in graph.links.iter().zip(&lengths) {
            // The median of exact ratios with fewer than half outliers is exact; the adjustment stops at a relative
            // cost change of 1e-4.
            let ratio = length.unwrap() / unit / baseline(l);
            assert!((ratio - 1.0).abs() < 1e-6, "{} {}: {ratio}", l.a, l.b);
        }
        // A pair that shares no point with another has no length.
        let mut isolated = measured.clone();
        isolated[5].iter_mut().flatten().for_each(|d| d.0 += 1000);
        let lengths = estimate_baselines(&graph, &isolated.iter().collect::<Vec<_>>(), &stage).unwrap();
        assert!(lengths[5].is_none() && lengths.iter().flatten().count() == graph.links.len() - 1);
    }
}
