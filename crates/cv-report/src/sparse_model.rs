//! A model of many views on a page: its points and cameras, what each photograph has in it, and which photographs hang together.

use std::collections::{BTreeMap, BTreeSet};

use cv_core::{Point3, PointCloud, Pose, RgbU8, SparseModel, UnionFind};

use crate::colormap::Colormap;
use crate::raster::{Color, Raster, colors};
use crate::{PointScene, Report};

/// Points in common from which two photographs count as linked: what COLMAP asks of a pair by default.
const LINKED: usize = 15;

/// What a photograph has in a model.
#[derive(Debug, Clone, PartialEq)]
struct Row<'a> {
    name: &'a str,
    /// Observations of points.
    points: usize,
    /// Mean distance in pixels between the points' projections and where they were seen; NaN without any.
    error: f64,
    /// Mean number of photographs that see its points.
    track_length: f64,
    linked: usize,
}

impl PointScene {
    /// The points of a model and its cameras, colored from the first photograph, blue, to the last, red, in the order of their names. The world is turned so that down is what is down in most
    /// photographs, and ahead what the first looks at.
    pub fn of_model(model: &SparseModel) -> Self {
        let to_view = upright(model);
        let points: Vec<[f32; 3]> = model.points.values().map(|p| single(to_view.transform(&p.position))).collect();
        let colors = model.points.values().map(|p| p.color).collect();
        let mut scene = Self::new(&PointCloud::colored(points, colors));
        let ids = by_name(model);
        for (i, id) in ids.iter().enumerate() {
            let image = &model.images[id];
            let Some(camera) = model.cameras.get(&image.camera) else { continue };
            let share = i as f32 / (ids.len() - 1).max(1) as f32;
            scene.camera(camera, &image.pose.compose(&to_view.inverse()), Colormap::Turbo.color(share));
        }
        scene
    }
}

impl Report {
    /// A table of the photographs of a model: `photographs` are the names of all that were given, of which those that the model does not have are said to be missing.
    pub fn registered_photographs(&mut self, model: &SparseModel, photographs: &[&str]) -> &mut Self {
        let rows = rows(model);
        let known: BTreeMap<&str, &Row<'_>> = rows.iter().map(|row| (row.name, row)).collect();
        let mut names: Vec<&str> = photographs.to_vec();
        names.extend(known.keys().filter(|name| !photographs.contains(name)));
        let cells: Vec<[String; 5]> = names
            .iter()
            .map(|name| match known.get(name) {
                Some(row) if row.points > 0 => [
                    (*name).to_owned(),
                    row.points.to_string(),
                    format!("{:.2}", row.error),
                    format!("{:.1}", row.track_length),
                    row.linked.to_string(),
                ],
                Some(row) => [(*name).to_owned(), "0".into(), String::new(), String::new(), row.linked.to_string()],
                None => [(*name).to_owned(), "not in the model".into(), String::new(), String::new(), String::new()],
            })
            .collect();
        let caption = format!(
            "What each photograph has in the model: points, the mean distance of their projections from where they were seen, by how many photographs a point is seen on average, and how many other photographs see {LINKED} of its points or more."
        );
        self.table(&caption, &["photograph", "points", "error (px)", "seen by", "linked with"], &cells)
    }

    /// A table of the places where a model hangs together by fewest points, `most` at most: where it bends or breaks first, and where more photographs help.
    pub fn thinnest_places(&mut self, model: &SparseModel, most: usize) -> &mut Self {
        let row = |bridge: &Bridge<'_>| {
            let [a, b] = bridge.names.map(str::to_owned);
            [a, b, bridge.points.to_string(), format!("{} and {}", bridge.sizes[0], bridge.sizes[1])]
        };
        let cells: Vec<[String; 4]> = bridges(model).iter().take(most).map(row).collect();
        let caption = "Where the model hangs together by fewest points: the two photographs, one on each side, that have most in common, and how many photographs are on the sides. More photographs between the first of them help most.";
        self.table(caption, &["photograph", "and", "points in common", "photographs on the sides"], &cells)
    }
}

/// Two parts of a model that hang together by the points that one photograph of each have in common.
#[derive(Debug, Clone, PartialEq)]
struct Bridge<'a> {
    /// The photographs, one of each part.
    names: [&'a str; 2],
    points: u32,
    /// How many photographs the parts have.
    sizes: [usize; 2],
}

/// The thinnest first: what the maximum spanning tree of the photographs is made of, weighted by points in common.
fn bridges(model: &SparseModel) -> Vec<Bridge<'_>> {
    let ids = by_name(model);
    let shared = shared_points(model, &ids);
    let mut links: Vec<(u32, usize, usize)> = (0..ids.len())
        .flat_map(|a| (a + 1..ids.len()).map(move |b| (a, b)))
        .map(|(a, b)| (shared[a][b], a, b))
        .collect();
    links.sort_by_key(|&(points, a, b)| (std::cmp::Reverse(points), a, b));
    let mut parts = UnionFind::new(ids.len());
    let mut sizes = vec![1; ids.len()];
    let mut bridges = Vec::new();
    for (points, a, b) in links.into_iter().filter(|link| link.0 > 0) {
        let roots = [a, b].map(|i| parts.find(i as u32) as usize);
        if parts.union(a as u32, b as u32) {
            bridges.push(Bridge {
                names: [a, b].map(|i| &*model.images[&ids[i]].name),
                points,
                sizes: roots.map(|r| sizes[r]),
            });
            sizes[parts.find(a as u32) as usize] = sizes[roots[0]] + sizes[roots[1]];
        }
    }
    bridges.reverse();
    bridges
}

/// Which photographs of a model see the same points: a square for each pair, the lighter the more points in common (on a logarithmic scale), gray for none. Rows and
/// columns are in the order of names. About `side` pixels wide; a model of more photographs than that gets a wider picture.
pub fn draw_view_graph(model: &SparseModel, side: usize) -> RgbU8 {
    const INK: Color = [45, 48, 56];
    const NONE: Color = [228, 230, 234];
    let ids = by_name(model);
    let count = ids.len();
    let shared = shared_points(model, &ids);
    let text = (side as f32 / 75.0).clamp(8.0, 14.0);
    let names: Vec<String> = ids.iter().map(|id| short(&model.images[id].name)).collect();
    let left = names.iter().map(|name| Raster::text_width(name, text)).fold(0.0, f32::max) + 2.0 * text;
    let (left, top) = (left.ceil() as usize, (3.5 * text) as usize);
    let cell = (side.saturating_sub(left) / count.max(1)).clamp(1, 40);
    let square = cell * count;
    let mut raster =
        Raster::new(left + square.max(side / 2) + text as usize, top + square + text as usize, colors::WHITE);
    let most = shared.iter().enumerate().flat_map(|(i, row)| row[i + 1..].iter()).copied().max().unwrap_or(0);
    let color = |n: u32| match n {
        0 => NONE,
        n => Colormap::Viridis.color(0.08 + 0.92 * (f64::from(n).ln() / f64::from(most.max(2)).ln()) as f32),
    };
    let gap = usize::from(cell >= 6);
    for (y, row) in shared.iter().enumerate() {
        for (x, &n) in row.iter().enumerate() {
            let color = if x == y { INK } else { color(n) };
            raster.fill_rect((left + x * cell) as i64, (top + y * cell) as i64, cell - gap, cell - gap, color);
        }
    }
    // As many names as there is room for.
    let every = (1.3 * text / cell as f32).ceil().max(1.0) as usize;
    for (y, name) in names.iter().enumerate().step_by(every) {
        let at = top as f32 + (y as f32 + 0.5) * cell as f32 - text / 2.0;
        raster.text(left as f32 - text * 0.6 - Raster::text_width(name, text), at, name, text, INK);
    }
    // The scale: a few numbers of points with their colors.
    let mut x = left as f32;
    let steps = [1.0, f64::from(most).powf(1.0 / 3.0), f64::from(most).powf(2.0 / 3.0), f64::from(most)];
    let mut steps: Vec<u32> = std::iter::once(0).chain(steps.map(|s| s.round() as u32)).collect();
    steps.dedup();
    for (i, n) in steps.iter().enumerate() {
        let label = if i + 1 == steps.len() { format!("{n} points in common") } else { n.to_string() };
        raster.fill_rect(x as i64, (0.9 * text) as i64, text as usize, text as usize, color(*n));
        raster.text(x + 1.4 * text, 0.9 * text, &label, text, INK);
        x += 3.0 * text + Raster::text_width(&label, text);
    }
    raster.into_image()
}

/// The numbers of the photographs in the order of their names.
fn by_name(model: &SparseModel) -> Vec<u32> {
    let mut ids: Vec<u32> = model.images.keys().copied().collect();
    ids.sort_by(|a, b| model.images[a].name.cmp(&model.images[b].name));
    ids
}

/// A file's name without its folder, its end where it is long.
fn short(name: &str) -> String {
    let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let count = name.chars().count();
    if count <= 16 { name.to_owned() } else { name.chars().skip(count - 16).collect() }
}

fn single(p: Point3<f64>) -> [f32; 3] {
    [p.x as f32, p.y as f32, p.z as f32]
}

/// From the model's world to one with its origin at the first camera by name, Y down.
fn upright(model: &SparseModel) -> Pose {
    let poses: Vec<Pose> = by_name(model).iter().map(|id| model.images[id].pose).collect();
    cv_core::upright(&poses)
}

/// Points that each two photographs, by their place in `ids`, have in common; of one with itself all of its points.
fn shared_points(model: &SparseModel, ids: &[u32]) -> Vec<Vec<u32>> {
    let place: BTreeMap<u32, usize> = ids.iter().enumerate().map(|(i, id)| (*id, i)).collect();
    let mut shared = vec![vec![0; ids.len()]; ids.len()];
    for point in model.points.values() {
        // A photograph may see a point twice.
        let seen: BTreeSet<usize> = point.track.iter().filter_map(|(image, _)| place.get(image).copied()).collect();
        for &a in &seen {
            for &b in &seen {
                shared[a][b] += 1;
            }
        }
    }
    shared
}

fn rows(model: &SparseModel) -> Vec<Row<'_>> {
    let ids = by_name(model);
    let shared = shared_points(model, &ids);
    // Observations, those with an error, the errors' sum and that of the lengths of tracks.
    let mut sums: BTreeMap<u32, (usize, usize, f64, usize)> = BTreeMap::new();
    for point in model.points.values() {
        for (id, index) in &point.track {
            let Some(image) = model.images.get(id) else { continue };
            let sum = sums.entry(*id).or_default();
            sum.0 += 1;
            sum.3 += point.track.len();
            let camera = model.cameras.get(&image.camera);
            let pixel = camera.and_then(|camera| camera.project(&image.pose.transform(&point.position)));
            if let (Some(pixel), Some((at, _))) = (pixel, image.points.get(*index as usize)) {
                sum.1 += 1;
                sum.2 += (pixel - at).norm();
            }
        }
    }
    let row = |(i, id): (usize, &u32)| {
        let (points, judged, errors, lengths) = sums.get(id).copied().unwrap_or_default();
        Row {
            name: &model.images[id].name,
            points,
            error: errors / judged as f64,
            track_length: lengths as f64 / points as f64,
            linked: shared[i].iter().enumerate().filter(|&(j, &n)| j != i && n as usize >= LINKED).count(),
        }
    };
    ids.iter().enumerate().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Camera, ModelImage, ModelPoint, Point2, Vector3};

    /// Three photographs side by side that look along the world's X, whose down is −Z. The first two see 20 points, the last two 5 of them and one twice.
    fn model() -> SparseModel {
        let camera = Camera::from_focal(100, 80, 90.0);
        let mut model = SparseModel { cameras: [(4, camera)].into(), ..SparseModel::default() };
        for (id, name) in [(1, "b.jpg"), (2, "c.jpg"), (7, "in/a.jpg")] {
            let eye = Point3::new(3.0, f64::from(id), 1.0);
            let pose = Pose::look_at(eye, eye + Vector3::x(), -Vector3::z()).unwrap();
            model.images.insert(id, ModelImage { name: name.into(), camera: 4, pose, points: Vec::new() });
        }
        for k in 0..20u64 {
            let position = Point3::new(20.0 + 0.1 * k as f64, 1.0 + 0.1 * k as f64, 1.0);
            let mut track = Vec::new();
            let last = match k {
                0 => &[7, 7][..],
                1..5 => &[7],
                _ => &[],
            };
            for id in [1, 2].iter().chain(last) {
                let image = model.images.get_mut(id).unwrap();
                // Found three pixels to the right of where it is.
                let at = camera.project(&image.pose.transform(&position)).unwrap() + cv_core::Vector2::new(3.0, 0.0);
                track.push((*id, image.points.len() as u32));
                image.points.push((at, Some(k)));
            }
            model.points.insert(k, ModelPoint { position, color: [k as u8, 0, 0], error: 0.0, track });
        }
        model
    }

    #[test]
    fn a_photograph_is_told_its_points_their_error_and_whom_it_is_linked_with() {
        let model = model();
        let rows = rows(&model);
        assert_eq!(rows.iter().map(|r| r.name).collect::<Vec<_>>(), ["b.jpg", "c.jpg", "in/a.jpg"]);
        assert_eq!(rows.iter().map(|r| r.points).collect::<Vec<_>>(), [20, 20, 6]);
        // The first two share twenty points, which is enough; five with the last are not.
        assert_eq!(rows.iter().map(|r| r.linked).collect::<Vec<_>>(), [1, 1, 0]);
        assert!(rows.iter().all(|r| (r.error - 3.0).abs() < 1e-9));
        // Fifteen tracks of two, four of three, one of four.
        assert_eq!(rows[0].track_length, 46.0 / 20.0);
        assert_eq!(shared_points(&model, &[1, 2, 7]), [[20, 20, 5], [20, 20, 5], [5, 5, 5]]);
        let mut page = Report::new("t");
        page.registered_photographs(&model, &["b.jpg", "x.jpg"]);
        let html = page.to_html();
        assert!(html.contains(">3.00<") && html.contains(">2.3<") && html.contains("not in the model"), "{html}");
        assert!(html.find("x.jpg") < html.find("c.jpg"));
    }

    #[test]
    fn the_thinnest_places_are_those_of_the_spanning_tree() {
        let model = model();
        // b and c share twenty points, each of them five with a: the first of the two by name is the bridge.
        let b = |names, points, sizes| Bridge { names, points, sizes };
        assert_eq!(bridges(&model), [b(["b.jpg", "in/a.jpg"], 5, [2, 1]), b(["b.jpg", "c.jpg"], 20, [1, 1])]);
        let mut page = Report::new("t");
        let html = page.thinnest_places(&model, 1).to_html();
        assert!(html.contains(">2 and 1<") && !html.contains("c.jpg"), "{html}");
        assert_eq!(bridges(&SparseModel::default()), []);
    }

    #[test]
    fn down_is_what_is_down_in_the_photographs() {
        let model = model();
        let to_view = upright(&model);
        // Half a meter ahead of the first camera, and below it.
        let p = to_view.transform(&Point3::new(3.5, 1.0, 0.8));
        assert!((p - Point3::new(0.0, 0.2, 0.5)).norm() < 1e-12, "{p}");
        assert_eq!(upright(&SparseModel::default()), Pose::identity());
        let scene = PointScene::of_model(&model);
        assert_eq!(scene.left_out(), 0);
        // A camera whose lens's number is not there is left out, and nothing else.
        let mut alone = model;
        alone.cameras.clear();
        assert!(PointScene::of_model(&alone) != scene);
    }

    #[test]
    fn squares_are_the_lighter_the_more_points_two_photographs_share() {
        let picture = draw_view_graph(&model(), 300);
        let light = |[r, g, b]: Color| u32::from(r) + u32::from(g) + u32::from(b);
        let is_cell = |c: Color| c == Colormap::Viridis.color(1.0);
        // The pair of twenty, both ways.
        let bright: Vec<(usize, usize)> = (0..picture.height())
            .flat_map(|y| (0..picture.width()).map(move |x| (x, y)))
            .filter(|&(x, y)| is_cell(picture.at(x, y)) && y > 20)
            .collect();
        assert_eq!(bright.len(), 2 * 39 * 39);
        let (x, y) = bright[0];
        // Its neighbor to the right is the pair with the last photograph.
        let five = picture.at(x + 40, y);
        assert!(light(five) < light(picture.at(x, y)) && five != [228, 230, 234]);
        assert_eq!(picture.at(x - 1 - 20, y), [45, 48, 56]);
        for empty in [SparseModel::default(), SparseModel { points: model().points, ..SparseModel::default() }] {
            assert!(draw_view_graph(&empty, 0).width() > 0 && draw_view_graph(&empty, 300).width() > 0);
        }
        let unseen =
            ModelImage { name: "x".into(), camera: 0, pose: Pose::identity(), points: vec![(Point2::origin(), None)] };
        assert!(
            draw_view_graph(&SparseModel { images: [(1, unseen)].into(), ..SparseModel::default() }, 300).width() > 0
        );
    }
}
