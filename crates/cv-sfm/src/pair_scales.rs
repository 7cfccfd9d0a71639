//! How long the baselines of pairs are, compared with each other.

use crate::SfmInput;
use crate::view_graph::{Link, ViewGraph};
use cv_core::{Camera, Cancelled, Correspondence, Stage, quantile};
use cv_geometry::{PairEdge, PairGraph, parallax_angle, triangulate};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{AdjustIteration, AdjustOptions, Adjustment, Euclidean, Residual};
use nalgebra::{SMatrix, SVector};
use rayon::prelude::*;
use std::ops::ControlFlow;

/// Fewest points that two pairs of a view share for their baselines to be compared.
pub(crate) const LEAST_SHARED: usize = 5;
/// With how many pairs of each of its views, the firmer ones first, a pair is compared.
const COMPARED: usize = 8;
/// A difference of logarithms from which on it counts less than by its square: a tenth.
const SCALE: f64 = 0.1;

/// Of each of the two views of a link: keypoints with the logarithm of their point's distance, in baselines, by keypoint.
pub(crate) type Distances = [Vec<(u32, f64)>; 2];

/// The distances of the points of each link whose rays meet at `min_angle` and more. O(matches).
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn measure(
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
        let mut found: Distances = Default::default();
        for m in &input.pairs[link.pair].matches {
            let Some(pixels) = m.correspondence(one, two) else { continue };
            let ray = Correspondence { a: a.normalize(pixels.a), b: b.normalize(pixels.b) };
            let Ok(point) = triangulate(&ray, &link.pose) else { continue };
            if ray.is_finite() && parallax_angle(&point, &link.pose) >= min_angle {
                found[0].push((m.query, point.coords.norm().ln()));
                found[1].push((m.train, link.pose.transform(&point).coords.norm().ln()));
            }
        }
        found.iter_mut().for_each(|list| list.sort_unstable_by(|x, y| x.0.cmp(&y.0).then(x.1.total_cmp(&y.1))));
        Ok(found)
    };
    graph.links.par_iter().map(of_link).collect()
}

/// The median of the differences of the keypoints in both lists, and how many there are.
pub(crate) fn median_difference(x: &[(u32, f64)], y: &[(u32, f64)]) -> (f64, usize) {
    let (mut i, mut j) = (0, 0);
    let mut all = Vec::new();
    while i < x.len() && j < y.len() {
        if x[i].0 == y[j].0 {
            all.push(x[i].1 - y[j].1);
        }
        let (a, b) = (x[i].0, y[j].0);
        i += usize::from(a <= b);
        j += usize::from(b <= a);
    }
    let count = all.len();
    (quantile(&mut all, 0.5).unwrap_or(0.0), count)
}

/// Differences of two numbers.
struct Differences(Vec<f64>);

impl Residual<1, 2, 2> for Differences {
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

/// The length of each link's baseline in a common unit; `None` where it cannot be told: nothing moved enough, or no other pair shares its points. Two pairs of one view see the same points from
/// there, whose distances in baselines compare the baselines; the logarithms of all such ratios are made to agree.
/// `measured` are the distances of each link. O(matches) for each time that a pair is compared.
///
/// # Errors
/// [`Cancelled`].
pub(crate) fn baselines(
    graph: &ViewGraph,
    measured: &[&Distances],
    stage: &Stage<'_>,
) -> Result<Vec<Option<f64>>, Cancelled> {
    let links = &graph.links;
    // Of each view its links, those with most points first.
    let mut of_view: Vec<Vec<(usize, usize)>> = vec![Vec::new(); graph.views];
    for (i, l) in links.iter().enumerate().filter(|(i, _)| measured[*i][0].len() >= LEAST_SHARED) {
        of_view[l.a].push((i, 0));
        of_view[l.b].push((i, 1));
    }
    let mut candidates = Vec::new();
    for list in &mut of_view {
        list.sort_by(|x, y| measured[y.0][0].len().cmp(&measured[x.0][0].len()).then(x.0.cmp(&y.0)));
        for n in 1..list.len() {
            // The firmest, which most share points with, and those next to it.
            let near = n.saturating_sub(COMPARED / 2).max(COMPARED / 2)..n;
            candidates.extend((0..n.min(COMPARED / 2)).chain(near).map(|m| (list[m], list[n])));
        }
    }
    let compare = |&(x, y): &((usize, usize), (usize, usize))| {
        // A point at d_x baselines of one and d_y of the other: b_x d_x = b_y d_y.
        let (ratio, shared) = median_difference(&measured[x.0][x.1], &measured[y.0][y.1]);
        (shared >= LEAST_SHARED).then_some((PairEdge { a: x.0, b: y.0, weight: shared as f64 }, ratio))
    };
    let (edges, ratios): (Vec<PairEdge>, Vec<f64>) =
        candidates.par_iter().map(compare).collect::<Vec<_>>().into_iter().flatten().unzip();
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
    let mut number = vec![0u32; links.len()];
    nodes.iter().zip(0..).for_each(|(i, n)| number[*i] = n);
    let inside = |e: &PairEdge| logarithms[e.a].is_some();
    let (blocks, differences): (Vec<[u32; 2]>, Vec<f64>) = comparisons
        .edges()
        .iter()
        .zip(&ratios)
        .filter(|(e, _)| inside(e))
        .map(|(e, ratio)| ([number[e.a], number[e.b]], *ratio))
        .unzip();
    let start: Vec<f64> = nodes.iter().filter_map(|i| logarithms[*i]).collect();
    let solved = (|| {
        let mut problem = Adjustment::default();
        let group = problem.add_group("logarithms of baselines", Euclidean(1), start)?;
        problem.fix(group, number[root] as usize)?;
        let loss = RobustLoss::Huber { scale: SCALE };
        problem.add_residuals("ratios", Differences(differences), [group, group], blocks, loss)?;
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
    fn baselines_are_compared_by_the_points_that_pairs_share() {
        // Eight views along a bent path, each pair up to three apart, of points on a lattice around it.
        let center = |v: usize| Point3::new(v as f64, 0.1 * (v * v) as f64, 0.3 * (v % 2) as f64);
        let point = |k: u32| Point3::new(f64::from(k % 9), f64::from(k / 9 % 5), 4.0 + f64::from(k % 7));
        let pairs = (0..8).flat_map(|a| (a + 1..8.min(a + 4)).map(move |b| (a, b)));
        let link = |(pair, (a, b))| Link { pair, a, b, pose: Pose::identity(), matches: 40 };
        let graph = ViewGraph { views: 8, links: pairs.enumerate().map(link).collect() };
        let baseline = |l: &Link| (center(l.a) - center(l.b)).norm();
        let list = |l: &Link, v: usize| -> Vec<(u32, f64)> {
            // Each pair has two thirds of the points, and one in eight of its distances is wrong.
            let own = (0..90).filter(|k| !(*k as usize + l.pair).is_multiple_of(3));
            let wrong = |k: u32| if (k as usize / 3 + l.pair).is_multiple_of(8) { 2.0 } else { 1.0 };
            own.map(|k| (k, (wrong(k) * (point(k) - center(v)).norm() / baseline(l)).ln())).collect()
        };
        let measured: Vec<Distances> = graph.links.iter().map(|l| [list(l, l.a), list(l, l.b)]).collect();
        let stage = Stage::new(&Silent, "test", 1).unwrap();
        let found = baselines(&graph, &measured.iter().collect::<Vec<_>>(), &stage).unwrap();
        let unit = found[0].unwrap() / baseline(&graph.links[0]);
        for (l, length) in graph.links.iter().zip(&found) {
            // The median of exact ratios, fewer than half of which are wrong, is exact; the adjuster stops within 1e-4 of the cost.
            let ratio = length.unwrap() / unit / baseline(l);
            assert!((ratio - 1.0).abs() < 1e-6, "{} {}: {ratio}", l.a, l.b);
        }
        // A pair that shares no point with another cannot be compared.
        let mut alone = measured.clone();
        alone[5].iter_mut().flatten().for_each(|d| d.0 += 1000);
        let found = baselines(&graph, &alone.iter().collect::<Vec<_>>(), &stage).unwrap();
        assert!(found[5].is_none() && found.iter().flatten().count() == graph.links.len() - 1);
    }
}
