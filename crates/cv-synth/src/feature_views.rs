//! Many views as keypoints and matches, without pictures: as many as one likes, in seconds.

use crate::rng::{Rng, hash2, normal_pair, unit};
use cv_core::{Camera, DMatch, ModelImage, ModelPoint, Point2, Pose, SparseModel};
use nalgebra::{Point3, Vector3};
use rayon::prelude::*;
use std::f64::consts::{PI, TAU};

/// What [`FeatureViews`] are made of.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FeatureViewsOptions {
    /// Photographs, all by one camera; 3 and more. Default 50.
    pub views: usize,
    /// Points on the surfaces. Default 10,000.
    pub points: usize,
    /// Standard deviation in pixels of a keypoint's coordinates. Default 0.3, as SIFT's are.
    pub noise: f64,
    /// Share of points in view that are found, 0 to 1. Default 0.6.
    pub found: f64,
    /// Share of a pair's matches that are wrong, 0 to below 1. Default 0.1.
    pub wrong: f64,
    /// Identical houses along the street, both of whose fronts repeat; below 2 none repeat. Default 0.
    pub houses: usize,
    /// Share of a house's points that no other has, 0 to 1; those of the ground are all of this kind. Default 0.1.
    pub own: f64,
    /// Of all random choices. Default 0.
    pub seed: u64,
}

impl Default for FeatureViewsOptions {
    fn default() -> Self {
        Self { views: 50, points: 10_000, noise: 0.3, found: 0.6, wrong: 0.1, houses: 0, own: 0.1, seed: 0 }
    }
}

/// Photographs taken on a walk once around a round street, from the middle of the road ahead, as keypoints with their truth: points of the fronts on both sides and of the
/// ground, seen from nearer than 30 m by what does not hide behind the inner front. The last photograph overlaps the first. World in meters, Y down.
///
/// Where houses repeat ([`FeatureViewsOptions::houses`]), the points at one place of each of them are alike: a photograph's matches to one that shows another house are as many and as
/// consistent as if it were the same.
#[derive(Debug, Clone)]
pub struct FeatureViews {
    /// Of all views.
    pub camera: Camera,
    /// World to camera, by view.
    pub poses: Vec<Pose>,
    /// The points.
    pub points: Vec<Point3<f64>>,
    /// The keypoints of each view, in no order.
    pub keypoints: Vec<Vec<Point2<f64>>>,
    /// The point of each keypoint.
    pub shown: Vec<Vec<u32>>,
    /// Of each point, the first that looks like it: itself where there is no other.
    pub alike: Vec<u32>,
    /// Of each view: the looks of points ([`FeatureViews::alike`]) and their keypoints, by look.
    by_look: Vec<Vec<(u32, u32)>>,
    wrong: f64,
    seed: u64,
}

/// Meters: half the width of the road, the height of the fronts and of the eyes, how far points are found, and between views where there are many.
const HALF: f64 = 5.0;
const FRONT: f64 = 8.0;
const EYES: f64 = 1.6;
const FAR: f64 = 30.0;
const STEP: f64 = 1.5;
/// A surface seen at a flatter angle than this has no points that are found: the sine.
const FLAT: f64 = 0.2;

/// A point, where it is on the walk, and the direction its surface faces.
#[derive(Clone)]
struct Site {
    at: Point3<f64>,
    angle: f64,
    normal: Vector3<f64>,
    /// A number that sites that look alike share.
    look: u32,
}

impl FeatureViews {
    /// The views of `options`; the same options give the same.
    pub fn new(options: &FeatureViewsOptions) -> Self {
        let views = options.views.max(3);
        let camera = Camera::from_focal(1600, 1200, 1200.0);
        // Narrower, a photograph would show nothing but the bend.
        let radius = (STEP * views as f64 / TAU).max(15.0);
        let mut rng = Rng::new(options.seed, 11);
        let poses: Vec<Pose> = (0..views)
            .map(|i| {
                let angle = TAU * i as f64 / views as f64;
                let mut sway = |by: f64| rng.range(-by, by);
                let eye = around(angle, radius + sway(0.4), -EYES + sway(0.1));
                let ahead = Vector3::new(angle.cos() + sway(0.1), sway(0.05), -angle.sin() + sway(0.1));
                Pose::look_at(eye, eye + ahead, Vector3::y()).unwrap_or_else(Pose::identity)
            })
            .collect();
        let mut sites: Vec<Site> = Vec::with_capacity(options.points);
        while sites.len() < options.points {
            let one = site(radius, sites.len() as u32, &mut rng);
            // Of the ground nothing repeats.
            let repeats = options.houses > 1 && one.normal.y == 0.0 && rng.range(0.0, 1.0) >= options.own;
            let copies = if repeats { options.houses } else { 1 };
            // One of as many, so that there are as many points in each place as without.
            if copies > 1 && rng.index(copies) > 0 {
                continue;
            }
            for copy in (0..copies).take(options.points - sites.len()) {
                sites.push(one.turned(TAU * copy as f64 / copies as f64));
            }
        }
        // A photograph's candidates then follow each other.
        sites.sort_by(|a, b| a.angle.total_cmp(&b.angle));
        // Of the nearest a point can be on the inner side.
        let reach = (FAR / (radius - HALF)).min(PI);
        let seen: Vec<Vec<(u32, Point2<f64>)>> = (0..views)
            .into_par_iter()
            .map(|i| {
                let angle = TAU * i as f64 / views as f64;
                let mut seen = Vec::new();
                for turn in [-TAU, 0.0, TAU] {
                    let first = sites.partition_point(|s| s.angle < angle + turn - reach);
                    let end = sites.partition_point(|s| s.angle < angle + turn + reach);
                    seen.extend((first..end).filter_map(|p| {
                        let pixel = view(&camera, &poses[i], &sites[p], radius - HALF)?;
                        let found = f64::from(unit(hash2(p as i32, i as i32, options.seed as u32))) < options.found;
                        let (dx, dy) = normal_pair(options.seed ^ 0x6E6F_6973, ((i as u64) << 32) | p as u64);
                        let noise = nalgebra::Vector2::new(f64::from(dx), f64::from(dy)) * options.noise;
                        found.then_some((p as u32, pixel + noise))
                    }));
                }
                let mut rng = Rng::new(options.seed ^ i as u64, 12);
                for last in (1..seen.len()).rev() {
                    seen.swap(last, rng.index(last + 1));
                }
                seen
            })
            .collect();
        // By order on the walk, the first of each look.
        let mut first = vec![u32::MAX; sites.len()];
        for (site, p) in sites.iter().zip(0..) {
            first[site.look as usize] = first[site.look as usize].min(p);
        }
        let alike: Vec<u32> = sites.iter().map(|site| first[site.look as usize]).collect();
        let by_look = seen.iter().map(|seen| {
            let mut all: Vec<(u32, u32)> =
                seen.iter().zip(0..).map(|(&(point, _), k)| (alike[point as usize], k)).collect();
            all.sort_unstable();
            all
        });
        Self {
            camera,
            by_look: by_look.collect(),
            alike,
            points: sites.iter().map(|site| site.at).collect(),
            keypoints: seen.iter().map(|seen| seen.iter().map(|&(_, pixel)| pixel).collect()).collect(),
            shown: seen.iter().map(|seen| seen.iter().map(|&(point, _)| point).collect()).collect(),
            poses,
            wrong: options.wrong.clamp(0.0, 0.99),
            seed: options.seed,
        }
    }

    /// Keypoints of all views.
    pub fn observations(&self) -> usize {
        self.keypoints.iter().map(Vec::len).sum()
    }

    /// The pairs of views, the earlier first, that show at least `least` points that look alike, and how many; by view. Without houses that repeat, those are the points in common.
    pub fn pairs(&self, least: usize) -> Vec<(usize, usize, usize)> {
        let mut views: Vec<Vec<u32>> = vec![Vec::new(); self.points.len()];
        for (looks, view) in self.by_look.iter().zip(0..) {
            for look in distinct(looks) {
                views[look as usize].push(view);
            }
        }
        let mut pairs = Vec::new();
        let mut shared = vec![0; self.poses.len()];
        for (a, looks) in self.by_look.iter().enumerate() {
            shared.fill(0);
            for b in distinct(looks).flat_map(|look| &views[look as usize]) {
                shared[*b as usize] += 1;
            }
            let enough = |b: &usize| shared[*b] >= least.max(1);
            pairs.extend((a + 1..shared.len()).filter(enough).map(|b| (a, b, shared[b])));
        }
        pairs
    }

    /// Matches between two views, in no order: every point both show, and wrong ones by [`FeatureViewsOptions::wrong`]. Of points that look alike, those that are seen most alike match: from
    /// about the same side and distance, be they the same or not. A keypoint has one match at the most.
    pub fn matches(&self, a: usize, b: usize) -> Vec<DMatch> {
        let (first, second) = (&self.by_look[a], &self.by_look[b]);
        let mut matches: Vec<(u32, u32)> = Vec::new();
        let (mut free_a, mut free_b) = (Vec::new(), Vec::new());
        let (mut i, mut j) = (0, 0);
        while let (Some(x), Some(y)) = (first.get(i), second.get(j)) {
            match x.0.cmp(&y.0) {
                std::cmp::Ordering::Equal => {
                    let [m, n] = [&first[i..], &second[j..]].map(|l| l.iter().take_while(|k| k.0 == x.0).count());
                    self.match_alike([a, b], [&first[i..i + m], &second[j..j + n]], &mut matches);
                    (i, j) = (i + m, j + n);
                    continue;
                }
                std::cmp::Ordering::Less => free_a.push(x.1),
                std::cmp::Ordering::Greater => free_b.push(y.1),
            }
            i += usize::from(x.0 <= y.0);
            j += usize::from(y.0 <= x.0);
        }
        free_a.extend(first[i..].iter().map(|x| x.1));
        free_b.extend(second[j..].iter().map(|y| y.1));
        let mut rng = Rng::new(self.seed ^ ((a as u64) << 32) ^ b as u64, 13);
        let wrong = (self.wrong / (1.0 - self.wrong) * matches.len() as f64).round() as usize;
        for _ in 0..wrong.min(free_a.len()).min(free_b.len()) {
            let (x, y) = (free_a.swap_remove(rng.index(free_a.len())), free_b.swap_remove(rng.index(free_b.len())));
            matches.push((x, y));
        }
        for last in (1..matches.len()).rev() {
            matches.swap(last, rng.index(last + 1));
        }
        matches.into_iter().map(|(query, train)| DMatch { query, train, distance: 0.0, ratio: 0.0 }).collect()
    }

    /// Matches keypoints of one look in two views: those that are each other's most alike.
    fn match_alike(&self, views: [usize; 2], lists: [&[(u32, u32)]; 2], matches: &mut Vec<(u32, u32)>) {
        if let [[one], [other]] = lists {
            matches.push((one.1, other.1));
            return;
        }
        // From the eye to the point, turned with its house, and the logarithm of the distance.
        let seen = |side: usize| {
            let eye = self.poses[views[side]].center();
            let of = move |&(_, keypoint): &(u32, u32)| {
                let point = self.points[self.shown[views[side]][keypoint as usize] as usize];
                let to = point - eye;
                let upright = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), -point.x.atan2(point.z));
                (upright * to.normalize(), to.norm().ln())
            };
            lists[side].iter().map(of).collect::<Vec<_>>()
        };
        let (one, other) = (seen(0), seen(1));
        let unlike = |i: usize, j: usize| one[i].0.angle(&other[j].0) + (one[i].1 - other[j].1).abs();
        let nearest = |n: usize, cost: &dyn Fn(usize) -> f64| (0..n).min_by(|x, y| cost(*x).total_cmp(&cost(*y)));
        for i in 0..one.len() {
            let Some(j) = nearest(other.len(), &|j| unlike(i, j)) else { continue };
            if nearest(one.len(), &|k| unlike(k, j)) == Some(i) {
                matches.push((lists[0][i].1, lists[1][j].1));
            }
        }
    }

    /// The truth as a model: pictures `0000.png` and on by the number of their view, points by index where two views at least show them; keypoints with their noise.
    pub fn model(&self) -> SparseModel {
        let mut tracks: Vec<Vec<(u32, u32)>> = vec![Vec::new(); self.points.len()];
        for (shown, view) in self.shown.iter().zip(0..) {
            shown.iter().zip(0..).for_each(|(&point, k)| tracks[point as usize].push((view, k)));
        }
        let number = |point: &u32| (tracks[*point as usize].len() >= 2).then_some(u64::from(*point));
        let images =
            self.poses.iter().zip(&self.keypoints).zip(&self.shown).zip(0..).map(|(((pose, pixels), shown), i)| {
                let points = pixels.iter().copied().zip(shown.iter().map(number)).collect();
                (i, ModelImage { name: format!("{i:04}.png"), camera: 1, pose: *pose, points })
            });
        let images = images.collect();
        let points = self.points.iter().zip(tracks).zip(0..).filter(|((_, track), _)| track.len() >= 2);
        let points = points.map(|((position, track), id)| {
            (id, ModelPoint { position: *position, color: [160; 3], error: f64::NAN, track })
        });
        SparseModel { cameras: [(1, self.camera)].into(), images, points: points.collect() }
    }
}

/// The looks of a list by look, each once.
fn distinct(looks: &[(u32, u32)]) -> impl Iterator<Item = u32> + '_ {
    looks.chunk_by(|x, y| x.0 == y.0).filter_map(|run| run.first()).map(|x| x.0)
}

impl Site {
    /// The same around the middle of the walk.
    fn turned(&self, by: f64) -> Self {
        let turn = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), by);
        Self { at: turn * self.at, angle: (self.angle + by).rem_euclid(TAU), normal: turn * self.normal, ..*self }
    }
}

/// A place by its angle on the walk, which begins at +Z.
fn around(angle: f64, radius: f64, y: f64) -> Point3<f64> {
    Point3::new(radius * angle.sin(), y, radius * angle.cos())
}

fn site(radius: f64, look: u32, rng: &mut Rng) -> Site {
    let angle = rng.range(0.0, TAU);
    let outward = around(angle, 1.0, 0.0).coords;
    // A third on each side: areas of fronts and road are much the same.
    let kind = rng.index(3);
    if kind == 2 {
        let at = around(angle, radius + rng.range(-HALF, HALF), rng.range(-0.1, 0.0));
        return Site { at, angle, normal: -Vector3::y(), look };
    }
    let sign = if kind == 0 { -1.0 } else { 1.0 };
    // Up to half a meter stands out from a front.
    let at = around(angle, radius + sign * rng.range(HALF - 0.5, HALF), -rng.range(0.0, FRONT));
    Site { at, angle, normal: outward * -sign, look }
}

/// Where a point is seen, if it is.
fn view(camera: &Camera, pose: &Pose, site: &Site, inner: f64) -> Option<Point2<f64>> {
    let eye = pose.center();
    let to = site.at - eye;
    let distance = to.norm();
    if distance > FAR || -to.dot(&site.normal) < FLAT * distance {
        return None;
    }
    let pixel = camera.project(&pose.transform(&site.at))?;
    let inside = |v: f64, n: usize| v >= -0.5 && v <= n as f64 - 0.5;
    if !(inside(pixel.x, camera.width) && inside(pixel.y, camera.height)) {
        return None;
    }
    // The inner front is round: nearest to its middle on the way there.
    let s = -(eye.x * to.x + eye.z * to.z) / (to.x * to.x + to.z * to.z);
    let (x, z) = (eye.x + s * to.x, eye.z + s * to.z);
    let hidden = s > 0.0 && s < 1.0 && x.hypot(z) < inner - 0.01;
    (!hidden).then_some(pixel)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn keypoints_are_where_their_points_are_but_for_the_noise_and_nothing_stands_between() {
        let views = FeatureViews::new(&FeatureViewsOptions { views: 12, points: 10_000, ..Default::default() });
        let (mut sum, mut count) = (0.0, 0.0);
        for (i, pose) in views.poses.iter().enumerate() {
            assert_eq!(views.keypoints[i].len(), views.shown[i].len());
            let distinct: BTreeSet<u32> = views.shown[i].iter().copied().collect();
            assert_eq!(distinct.len(), views.shown[i].len());
            for (pixel, &point) in views.keypoints[i].iter().zip(&views.shown[i]) {
                let point = views.points[point as usize];
                let off = views.camera.project(&pose.transform(&point)).unwrap() - pixel;
                sum += off.norm_squared();
                count += 2.0;
                // A plain walk along the line of sight: radius 15 m of the road's middle less 5 m.
                let eye = pose.center();
                let inside = |k: i32| {
                    let p = eye + (point - eye) * (f64::from(k) / 200.0);
                    p.x.hypot(p.z) < 10.0 - 0.02
                };
                assert!(!(0..200).any(inside) && (point - eye).norm() <= FAR);
            }
        }
        // Of more than 5000 numbers a standard deviation is known to 1 %: five times that.
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
        assert!(views.keypoints == again.keypoints && views.shown == again.shown && views.poses == again.poses);
        let model = views.model();
        assert_eq!((model.images.len(), model.cameras.len()), (1000, 1));
        let (id, point) = model.points.iter().nth(1000).unwrap();
        assert!(
            point.track.len() >= 2
                && point.track.iter().all(|(i, k)| model.images[i].points[*k as usize].1 == Some(*id))
        );
    }

    #[test]
    fn the_walk_is_closed_and_its_pairs_are_counted() {
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
            let sets = [a, b].map(|v| views.shown[v].iter().copied().collect::<BTreeSet<u32>>());
            assert_eq!(sets[0].intersection(&sets[1]).count(), shared);
            // What is beyond sight is in no pair.
            assert!(!views.pairs(1).iter().any(|p| count == 200 && (p.0, p.1) == (0, 100)));
        }
    }

    #[test]
    fn of_the_matches_as_many_are_wrong_as_asked_for() {
        let options = FeatureViewsOptions { points: 20_000, wrong: 0.3, ..Default::default() };
        let views = FeatureViews::new(&options);
        let (a, b, shared) = *views.pairs(100).iter().max_by_key(|p| p.2).unwrap();
        let matches = views.matches(a, b);
        let right = matches.iter().filter(|m| views.shown[a][m.query as usize] == views.shown[b][m.train as usize]);
        let right = right.count();
        assert_eq!(right, shared);
        // To the rounding of a count of some hundreds.
        let wrong = (matches.len() - right) as f64 / matches.len() as f64;
        assert!((wrong - 0.3).abs() < 0.01, "{wrong}");
        let queries: BTreeSet<u32> = matches.iter().map(|m| m.query).collect();
        let trains: BTreeSet<u32> = matches.iter().map(|m| m.train).collect();
        assert_eq!((queries.len(), trains.len()), (matches.len(), matches.len()));
        let none = FeatureViews::new(&FeatureViewsOptions { wrong: 0.0, ..options });
        assert_eq!(none.matches(a, b).len(), shared);
    }

    #[test]
    fn houses_repeat_and_match_as_if_they_were_the_same() {
        let options = FeatureViewsOptions { houses: 5, own: 0.25, ..Default::default() };
        let views = FeatureViews::new(&options);
        assert_eq!(views.points.len(), options.points);
        let turn = TAU / 5.0;
        let (mut fronts, mut repeated) = (0, 0);
        for (point, first) in views.points.iter().zip(&views.alike) {
            let first = &views.points[*first as usize];
            let on = (point.x.atan2(point.z) - first.x.atan2(first.z)) / turn;
            // Some house on, as far from the middle and as high, to the rounding of f64.
            assert!((on - on.round()).abs() < 1e-9, "{on}");
            assert!((point.x.hypot(point.z) - first.x.hypot(first.z)).abs() < 1e-9 && (point.y - first.y).abs() < 1e-9);
            fronts += usize::from(point.y < -0.1);
            repeated += usize::from(point.y < -0.1 && (point - first).norm() > 1.0);
        }
        // Of five alike one is the first; a hundred groups and more leave a few hundredths to chance.
        let share = repeated as f64 / fronts as f64;
        assert!((share - 0.75 * 0.8).abs() < 0.05, "{share}");
        // A photograph and the one at the same place before the next house have nearly as many matches as neighbors, but for what is each house's own and the ground, and all to that house.
        let same = |a: usize, b: usize| {
            let matches = views.matches(a, b);
            let right = matches.iter().filter(|m| views.shown[a][m.query as usize] == views.shown[b][m.train as usize]);
            (right.count(), matches.len())
        };
        for i in 0..10 {
            let (right, of) = same(i, i + 10);
            assert!(10 * right < of && 3 * of > same(i, i + 1).1, "{i}: {right} of {of}");
            assert!(views.pairs(30).iter().any(|p| (p.0, p.1) == (i, i + 10)));
        }
    }
}
