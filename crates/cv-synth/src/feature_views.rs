//! Synthetic views as keypoints and matches, without images: any number of them, in seconds.

use crate::rng::{Rng, hash2, normal_pair, unit};
use cv_core::{Camera, DMatch, ModelImage, ModelPoint, Point2, Pose, SparseModel};
use cv_parallel::prelude::*;
use nalgebra::{Point3, Vector3};
use std::f64::consts::{PI, TAU};

/// Options of [`FeatureViews`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeatureViewsOptions {
    /// Number of views, all by one camera; 3 or more. Default 50.
    pub views: usize,
    /// Number of points on the surfaces. Default 10,000.
    pub points: usize,
    /// Standard deviation of a keypoint coordinate in pixels. Default 0.3, as of SIFT.
    pub noise: f64,
    /// Fraction of the visible points that are detected, 0 to 1. Default 0.6.
    pub detection_ratio: f64,
    /// Outlier ratio of a pair's matches, 0 to below 1. Default 0.1.
    pub outlier_ratio: f64,
    /// Number of identical houses along the street, with repeated fronts on both sides; below 2 there is no repetition.
    /// Default 0.
    pub houses: usize,
    /// Fraction of a house's points that are unique, 0 to 1; those of the ground are all unique. Default 0.1.
    pub unique_ratio: f64,
    /// Seed of all random choices. Default 0.
    pub seed: u64,
}

impl Default for FeatureViewsOptions {
    fn default() -> Self {
        Self {
            views: 50,
            points: 10_000,
            noise: 0.3,
            detection_ratio: 0.6,
            outlier_ratio: 0.1,
            houses: 0,
            unique_ratio: 0.1,
            seed: 0,
        }
    }
}

/// Views on a closed walk along a circular street, from the middle of the road in the direction of travel, as keypoints
/// with their ground truth. The points are on the fronts on both sides and on the ground, visible up to 30 m and not
/// occluded by the inner front. The last view overlaps the first. World in meters, Y down.
///
/// With repeated houses ([`FeatureViewsOptions::houses`]), corresponding points of different houses have the same
/// descriptor: matches to another house are as many and as consistent as those to the same house.
#[derive(Debug, Clone)]
pub struct FeatureViews {
    /// The camera of all views.
    pub camera: Camera,
    /// Poses by view, world to camera.
    pub poses: Vec<Pose>,
    /// The points.
    pub points: Vec<Point3<f64>>,
    /// The keypoints of each view, in random order.
    pub keypoints: Vec<Vec<Point2<f64>>>,
    /// The index of the point of each keypoint.
    pub point_indices: Vec<Vec<u32>>,
    /// For each point, the first point with the same descriptor: itself if it is unique.
    pub first_alike: Vec<u32>,
    /// For each view: descriptors (the indices of [`FeatureViews::first_alike`]) and keypoints, sorted by descriptor.
    by_descriptor: Vec<Vec<(u32, u32)>>,
    outlier_ratio: f64,
    seed: u64,
}

/// Half the width of the road, in meters.
const HALF_WIDTH: f64 = 5.0;
/// Height of the fronts, in meters.
const FRONT_HEIGHT: f64 = 8.0;
/// Eye height, in meters.
const EYE_HEIGHT: f64 = 1.6;
/// Largest distance of a detected point, in meters.
const MAX_DISTANCE: f64 = 30.0;
/// Distance between views of long walks, in meters.
const VIEW_SPACING: f64 = 1.5;
/// Smallest sine of the angle between a surface and the viewing ray of a detected point.
const MIN_SURFACE_SINE: f64 = 0.2;

/// A point, its angle on the walk, and the normal of its surface.
#[derive(Clone)]
struct SurfacePoint {
    position: Point3<f64>,
    angle: f64,
    normal: Vector3<f64>,
    /// Descriptor: equal for points that look the same.
    descriptor: u32,
}

impl FeatureViews {
    /// Creates the views. The same options give the same views.
    pub fn new(options: &FeatureViewsOptions) -> Self {
        let views = options.views.max(3);
        let camera = Camera::from_focal(1600, 1200, 1200.0);
        // With a smaller radius a view would show nothing but the bend.
        let radius = (VIEW_SPACING * views as f64 / TAU).max(15.0);
        let mut rng = Rng::new(options.seed, 11);
        let poses: Vec<Pose> = (0..views)
            .map(|i| {
                let angle = TAU * i as f64 / views as f64;
                let mut random_offset = |range: f64| rng.range(-range, range);
                let eye = on_circle(angle, radius + random_offset(0.4), -EYE_HEIGHT + random_offset(0.1));
                let ahead = Vector3::new(
                    angle.cos() + random_offset(0.1),
                    random_offset(0.05),
                    -angle.sin() + random_offset(0.1),
                );
                Pose::look_at(eye, eye + ahead, Vector3::y()).unwrap_or_else(Pose::identity)
            })
            .collect();
        let mut surface_points: Vec<SurfacePoint> = Vec::with_capacity(options.points);
        while surface_points.len() < options.points {
            let one = random_point(radius, surface_points.len() as u32, &mut rng);
            // Ground points are unique.
            let is_repeated = options.houses > 1 && one.normal.y == 0.0 && rng.range(0.0, 1.0) >= options.unique_ratio;
            let copies = if is_repeated { options.houses } else { 1 };
            // One of as many, so that the density of points does not depend on the repetition.
            if copies > 1 && rng.index(copies) > 0 {
                continue;
            }
            for copy in (0..copies).take(options.points - surface_points.len()) {
                surface_points.push(one.rotated(TAU * copy as f64 / copies as f64));
            }
        }
        // The candidates of a view are then adjacent.
        surface_points.sort_by(|a, b| a.angle.total_cmp(&b.angle));
        // The largest angle to a visible point, on the inner side.
        let max_angle = (MAX_DISTANCE / (radius - HALF_WIDTH)).min(PI);
        let observed: Vec<Vec<(u32, Point2<f64>)>> = (0..views)
            .into_par_iter()
            .map(|i| {
                let angle = TAU * i as f64 / views as f64;
                let mut observed = Vec::new();
                for revolution in [-TAU, 0.0, TAU] {
                    let first = surface_points.partition_point(|s| s.angle < angle + revolution - max_angle);
                    let end = surface_points.partition_point(|s| s.angle < angle + revolution + max_angle);
                    observed.extend((first..end).filter_map(|p| {
                        let pixel = project_if_visible(&camera, &poses[i], &surface_points[p], radius - HALF_WIDTH)?;
                        let is_detected =
                            f64::from(unit(hash2(p as i32, i as i32, options.seed as u32))) < options.detection_ratio;
                        let (dx, dy) = normal_pair(options.seed ^ 0x6E6F_6973, ((i as u64) << 32) | p as u64);
                        let noise = nalgebra::Vector2::new(f64::from(dx), f64::from(dy)) * options.noise;
                        is_detected.then_some((p as u32, pixel + noise))
                    }));
                }
                let mut rng = Rng::new(options.seed ^ i as u64, 12);
                for last in (1..observed.len()).rev() {
                    observed.swap(last, rng.index(last + 1));
                }
                observed
            })
            .collect();
        // The first point of each descriptor, in the order of the walk.
        let mut first = vec![u32::MAX; surface_points.len()];
        for (point, p) in surface_points.iter().zip(0..) {
            first[point.descriptor as usize] = first[point.descriptor as usize].min(p);
        }
        let first_alike: Vec<u32> = surface_points.iter().map(|point| first[point.descriptor as usize]).collect();
        let by_descriptor = observed.iter().map(|observed| {
            let mut all: Vec<(u32, u32)> =
                observed.iter().zip(0..).map(|(&(point, _), k)| (first_alike[point as usize], k)).collect();
            all.sort_unstable();
            all
        });
        Self {
            camera,
            by_descriptor: by_descriptor.collect(),
            first_alike,
            points: surface_points.iter().map(|point| point.position).collect(),
            keypoints: observed.iter().map(|observed| observed.iter().map(|&(_, pixel)| pixel).collect()).collect(),
            point_indices: observed.iter().map(|observed| observed.iter().map(|&(point, _)| point).collect()).collect(),
            poses,
            outlier_ratio: options.outlier_ratio.clamp(0.0, 0.99),
            seed: options.seed,
        }
    }

    /// Returns the number of keypoints of all views.
    pub fn observations(&self) -> usize {
        self.keypoints.iter().map(Vec::len).sum()
    }

    /// Returns the pairs of views (smaller index first) with at least `min_shared` common descriptors, and their
    /// number. Without repeated houses these are the common points.
    pub fn pairs(&self, min_shared: usize) -> Vec<(usize, usize, usize)> {
        let mut views: Vec<Vec<u32>> = vec![Vec::new(); self.points.len()];
        for (descriptors, view) in self.by_descriptor.iter().zip(0..) {
            for descriptor in distinct(descriptors) {
                views[descriptor as usize].push(view);
            }
        }
        let mut pairs = Vec::new();
        let mut shared = vec![0; self.poses.len()];
        for (a, descriptors) in self.by_descriptor.iter().enumerate() {
            shared.fill(0);
            for b in distinct(descriptors).flat_map(|descriptor| &views[descriptor as usize]) {
                shared[*b as usize] += 1;
            }
            let is_pair = |b: &usize| shared[*b] >= min_shared.max(1);
            pairs.extend((a + 1..shared.len()).filter(is_pair).map(|b| (a, b, shared[b])));
        }
        pairs
    }

    /// Returns matches between two views, in random order: all common points, and outliers by
    /// [`FeatureViewsOptions::outlier_ratio`]. Among points with the same descriptor, those with the most similar
    /// viewpoint (direction and distance) match, correct or not. A keypoint has at most one match.
    pub fn matches(&self, a: usize, b: usize) -> Vec<DMatch> {
        let (first, second) = (&self.by_descriptor[a], &self.by_descriptor[b]);
        let mut matches: Vec<(u32, u32)> = Vec::new();
        let (mut unmatched_a, mut unmatched_b) = (Vec::new(), Vec::new());
        let (mut i, mut j) = (0, 0);
        while let (Some(x), Some(y)) = (first.get(i), second.get(j)) {
            match x.0.cmp(&y.0) {
                std::cmp::Ordering::Equal => {
                    let [m, n] = [&first[i..], &second[j..]].map(|l| l.iter().take_while(|k| k.0 == x.0).count());
                    self.match_descriptor([a, b], [&first[i..i + m], &second[j..j + n]], &mut matches);
                    (i, j) = (i + m, j + n);
                    continue;
                }
                std::cmp::Ordering::Less => unmatched_a.push(x.1),
                std::cmp::Ordering::Greater => unmatched_b.push(y.1),
            }
            i += usize::from(x.0 <= y.0);
            j += usize::from(y.0 <= x.0);
        }
        unmatched_a.extend(first[i..].iter().map(|x| x.1));
        unmatched_b.extend(second[j..].iter().map(|y| y.1));
        let mut rng = Rng::new(self.seed ^ ((a as u64) << 32) ^ b as u64, 13);
        let outliers = (self.outlier_ratio / (1.0 - self.outlier_ratio) * matches.len() as f64).round() as usize;
        for _ in 0..outliers.min(unmatched_a.len()).min(unmatched_b.len()) {
            let (x, y) = (
                unmatched_a.swap_remove(rng.index(unmatched_a.len())),
                unmatched_b.swap_remove(rng.index(unmatched_b.len())),
            );
            matches.push((x, y));
        }
        for last in (1..matches.len()).rev() {
            matches.swap(last, rng.index(last + 1));
        }
        matches.into_iter().map(|(query, train)| DMatch { query, train, distance: 0.0, ratio: 0.0 }).collect()
    }

    /// Matches the keypoints of one descriptor in two views: mutual nearest neighbors in viewpoint.
    fn match_descriptor(&self, views: [usize; 2], lists: [&[(u32, u32)]; 2], matches: &mut Vec<(u32, u32)>) {
        if let [[one], [other]] = lists {
            matches.push((one.1, other.1));
            return;
        }
        // Unit direction from the camera to the point, in the frame of its house, and the logarithm of the distance.
        let viewpoints = |side: usize| {
            let eye = self.poses[views[side]].center();
            let viewpoint = move |&(_, keypoint): &(u32, u32)| {
                let point = self.points[self.point_indices[views[side]][keypoint as usize] as usize];
                let to = point - eye;
                let upright = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), -point.x.atan2(point.z));
                (upright * to.normalize(), to.norm().ln())
            };
            lists[side].iter().map(viewpoint).collect::<Vec<_>>()
        };
        let (one, other) = (viewpoints(0), viewpoints(1));
        let difference = |i: usize, j: usize| one[i].0.angle(&other[j].0) + (one[i].1 - other[j].1).abs();
        let nearest = |n: usize, cost: &dyn Fn(usize) -> f64| (0..n).min_by(|x, y| cost(*x).total_cmp(&cost(*y)));
        for i in 0..one.len() {
            let Some(j) = nearest(other.len(), &|j| difference(i, j)) else { continue };
            if nearest(one.len(), &|k| difference(k, j)) == Some(i) {
                matches.push((lists[0][i].1, lists[1][j].1));
            }
        }
    }

    /// Returns the ground truth as a model: images `0000.png` and so on by view index, points by index that at least
    /// two views observe; keypoints with their noise.
    pub fn model(&self) -> SparseModel {
        let mut tracks: Vec<Vec<(u32, u32)>> = vec![Vec::new(); self.points.len()];
        for (points, view) in self.point_indices.iter().zip(0..) {
            points.iter().zip(0..).for_each(|(&point, k)| tracks[point as usize].push((view, k)));
        }
        let id = |point: &u32| (tracks[*point as usize].len() >= 2).then_some(u64::from(*point));
        let images = self.poses.iter().zip(&self.keypoints).zip(&self.point_indices).zip(0..).map(
            |(((pose, pixels), indices), i)| {
                let points = pixels.iter().copied().zip(indices.iter().map(id)).collect();
                (i, ModelImage { name: format!("{i:04}.png"), camera: 1, pose: *pose, points })
            },
        );
        let images = images.collect();
        let points = self.points.iter().zip(tracks).zip(0..).filter(|((_, track), _)| track.len() >= 2);
        let points = points.map(|((position, track), id)| {
            (id, ModelPoint { position: *position, color: [160; 3], error: f64::NAN, track })
        });
        SparseModel { cameras: [(1, self.camera)].into(), images, points: points.collect() }
    }
}

/// Returns the distinct descriptors of a sorted list.
fn distinct(descriptors: &[(u32, u32)]) -> impl Iterator<Item = u32> + '_ {
    descriptors.chunk_by(|x, y| x.0 == y.0).filter_map(|run| run.first()).map(|x| x.0)
}

impl SurfacePoint {
    /// Returns the point rotated about the center of the walk.
    fn rotated(&self, angle: f64) -> Self {
        let rotation = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), angle);
        Self {
            position: rotation * self.position,
            angle: (self.angle + angle).rem_euclid(TAU),
            normal: rotation * self.normal,
            ..*self
        }
    }
}

/// Returns the position at an angle on a circle, which starts at +Z.
fn on_circle(angle: f64, radius: f64, y: f64) -> Point3<f64> {
    Point3::new(radius * angle.sin(), y, radius * angle.cos())
}

/// Creates a random point on the fronts or the ground.
fn random_point(radius: f64, descriptor: u32, rng: &mut Rng) -> SurfacePoint {
    let angle = rng.range(0.0, TAU);
    let outward = on_circle(angle, 1.0, 0.0).coords;
    // A third for each: the areas of the two fronts and the road are similar.
    let kind = rng.index(3);
    if kind == 2 {
        let position = on_circle(angle, radius + rng.range(-HALF_WIDTH, HALF_WIDTH), rng.range(-0.1, 0.0));
        return SurfacePoint { position, angle, normal: -Vector3::y(), descriptor };
    }
    let sign = if kind == 0 { -1.0 } else { 1.0 };
    // Up to half a meter in front of the facade.
    let position =
        on_circle(angle, radius + sign * rng.range(HALF_WIDTH - 0.5, HALF_WIDTH), -rng.range(0.0, FRONT_HEIGHT));
    SurfacePoint { position, angle, normal: outward * -sign, descriptor }
}

/// Returns the pixel of a point, if it is visible.
fn project_if_visible(camera: &Camera, pose: &Pose, surface_point: &SurfacePoint, inner: f64) -> Option<Point2<f64>> {
    let eye = pose.center();
    let to = surface_point.position - eye;
    let distance = to.norm();
    if distance > MAX_DISTANCE || -to.dot(&surface_point.normal) < MIN_SURFACE_SINE * distance {
        return None;
    }
    let pixel = camera.project(&pose.transform(&surface_point.position))?;
    let is_inside = |v: f64, n: usize| v >= -0.5 && v <= n as f64 - 0.5;
    if !(is_inside(pixel.x, camera.width) && is_inside(pixel.y, camera.height)) {
        return None;
    }
    // The inner front is a cylinder: the closest approach of the ray to its axis.
    let s = -(eye.x * to.x + eye.z * to.z) / (to.x * to.x + to.z * to.z);
    let (x, z) = (eye.x + s * to.x, eye.z + s * to.z);
    let is_occluded = s > 0.0 && s < 1.0 && x.hypot(z) < inner - 0.01;
    (!is_occluded).then_some(pixel)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn keypoints_are_noisy_projections_of_visible_points() {
        let views = FeatureViews::new(&FeatureViewsOptions { views: 12, points: 10_000, ..Default::default() });
        let (mut sum, mut count) = (0.0, 0.0);
        for (i, pose) in views.poses.iter().enumerate() {
            assert_eq!(views.keypoints[i].len(), views.point_indices[i].len());
            let distinct: BTreeSet<u32> = views.point_indices[i].iter().copied().collect();
            assert_eq!(distinct.len(), views.point_indices[i].len());
            for (pixel, &point) in views.keypoints[i].iter().zip(&views.point_indices[i]) {
                let point = views.points[point as usize];
                let off = views.camera.project(&pose.transform(&point)).unwrap() - pixel;
                sum += off.norm_squared();
                count += 2.0;
                // Samples of the line of sight, against the inner front: radius 15 m of the road less 5 m.
                let eye = pose.center();
                let inside = |k: i32| {
                    let p = eye + (point - eye) * (f64::from(k) / 200.0);
                    p.x.hypot(p.z) < 10.0 - 0.02
                };
                assert!(!(0..200).any(inside) && (point - eye).norm() <= MAX_DISTANCE);
            }
        }
        // More than 5000 coordinates determine a standard deviation to 1 %: five times that.
        assert!(count > 5000.0 && ((sum / count).sqrt() / 0.3 - 1.0).abs() < 0.05, "{count} {}", (sum / count).sqrt());
    }

    #[test]
    fn a_thousand_views_and_a_million_keypoints() {
        let options = FeatureViewsOptions { views: 1000, points: 200_000, ..Default::default() };
        let views = FeatureViews::new(&options);
        let observations = views.observations();
        assert!((700_000..2_000_000).contains(&observations), "{observations}");
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let again = pool.install(|| FeatureViews::new(&options));
        assert!(
            views.keypoints == again.keypoints
                && views.point_indices == again.point_indices
                && views.poses == again.poses
        );
        let model = views.model();
        assert_eq!((model.images.len(), model.cameras.len()), (1000, 1));
        let (id, point) = model.points.iter().nth(1000).unwrap();
        assert!(
            point.track.len() >= 2
                && point.track.iter().all(|(i, k)| model.images[i].points[*k as usize].1 == Some(*id))
        );
    }

    #[test]
    fn the_walk_is_closed_and_shared_points_are_counted() {
        for count in [12, 50, 200] {
            let views = FeatureViews::new(&FeatureViewsOptions {
                views: count,
                points: (100 * count).max(6000),
                ..Default::default()
            });
            let pairs = views.pairs(30);
            for i in 0..count {
                let (a, b) = ((i + 1) % count, i);
                let pair = pairs.iter().find(|p| (p.0, p.1) == (a.min(b), a.max(b)));
                assert!(pair.is_some(), "{count} {i}");
            }
            let &(a, b, shared) = &pairs[pairs.len() / 2];
            let sets = [a, b].map(|v| views.point_indices[v].iter().copied().collect::<BTreeSet<u32>>());
            assert_eq!(sets[0].intersection(&sets[1]).count(), shared);
            // Views without common points are no pair.
            assert!(!views.pairs(1).iter().any(|p| count == 200 && (p.0, p.1) == (0, 100)));
        }
    }

    #[test]
    fn the_outlier_ratio_of_matches_is_that_of_the_options() {
        let options = FeatureViewsOptions { points: 20_000, outlier_ratio: 0.3, ..Default::default() };
        let views = FeatureViews::new(&options);
        let (a, b, shared) = *views.pairs(100).iter().max_by_key(|p| p.2).unwrap();
        let matches = views.matches(a, b);
        let correct = matches
            .iter()
            .filter(|m| views.point_indices[a][m.query as usize] == views.point_indices[b][m.train as usize]);
        let correct = correct.count();
        assert_eq!(correct, shared);
        // Up to the rounding of a count of some hundreds.
        let outlier_ratio = (matches.len() - correct) as f64 / matches.len() as f64;
        assert!((outlier_ratio - 0.3).abs() < 0.01, "{outlier_ratio}");
        let queries: BTreeSet<u32> = matches.iter().map(|m| m.query).collect();
        let trains: BTreeSet<u32> = matches.iter().map(|m| m.train).collect();
        assert_eq!((queries.len(), trains.len()), (matches.len(), matches.len()));
        let none = FeatureViews::new(&FeatureViewsOptions { outlier_ratio: 0.0, ..options });
        assert_eq!(none.matches(a, b).len(), shared);
    }

    #[test]
    fn repeated_houses_match_each_other() {
        let options = FeatureViewsOptions { houses: 5, unique_ratio: 0.25, ..Default::default() };
        let views = FeatureViews::new(&options);
        assert_eq!(views.points.len(), options.points);
        let turn = TAU / 5.0;
        let (mut fronts, mut repeated) = (0, 0);
        for (point, first) in views.points.iter().zip(&views.first_alike) {
            let first = &views.points[*first as usize];
            let on = (point.x.atan2(point.z) - first.x.atan2(first.z)) / turn;
            // At another house, at the same radius and height, up to the rounding of f64.
            assert!((on - on.round()).abs() < 1e-9, "{on}");
            assert!((point.x.hypot(point.z) - first.x.hypot(first.z)).abs() < 1e-9 && (point.y - first.y).abs() < 1e-9);
            fronts += usize::from(point.y < -0.1);
            repeated += usize::from(point.y < -0.1 && (point - first).norm() > 1.0);
        }
        // One of five is the first; with a hundred groups and more the deviation is a few per cent.
        let repeated_fraction = repeated as f64 / fronts as f64;
        assert!((repeated_fraction - 0.75 * 0.8).abs() < 0.05, "{repeated_fraction}");
        // A view and the one at the same position of the next house have nearly as many matches as neighbors, except
        // for unique points and the ground, and all matches are to that house.
        let same = |a: usize, b: usize| {
            let matches = views.matches(a, b);
            let correct = matches
                .iter()
                .filter(|m| views.point_indices[a][m.query as usize] == views.point_indices[b][m.train as usize]);
            (correct.count(), matches.len())
        };
        for i in 0..10 {
            let (correct, of) = same(i, i + 10);
            assert!(10 * correct < of && 3 * of > same(i, i + 1).1, "{i}: {correct} of {of}");
            assert!(views.pairs(30).iter().any(|p| (p.0, p.1) == (i, i + 10)));
        }
    }
}
