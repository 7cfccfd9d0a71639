//! Reports of a structure-from-motion model: points and cameras, statistics per image, and the view graph.

use std::collections::{BTreeMap, BTreeSet};

use cv_core::{Point3, PointCloud, Pose, RgbU8, SparseModel, UnionFind};

use crate::colormap::Colormap;
use crate::raster::{Color, Raster, colors};
use crate::{PointScene, Report};

/// Minimum number of shared points for two images to count as linked: COLMAP's default minimum of inliers of a pair.
const MIN_SHARED_POINTS: usize = 15;

/// Statistics of an image in a model.
#[derive(Debug, Clone, PartialEq)]
struct ImageStatistics<'a> {
    name: &'a str,
    /// Number of observations.
    points: usize,
    /// Mean reprojection error in pixels; NaN without observations.
    error: f64,
    /// Mean track length of its points.
    track_length: f64,
    /// Number of linked images.
    linked: usize,
}

impl PointScene {
    /// Makes a scene of the points and cameras of a model, cameras colored from blue (first) to red (last) in the order of image names. The world
    /// is rotated to the upright frame of the first camera ([`cv_core::upright_frame`]).
    pub fn of_model(model: &SparseModel) -> Self {
        let to_view = model_to_upright(model);
        let points: Vec<[f32; 3]> = model.points.values().map(|p| to_f32(to_view.transform(&p.position))).collect();
        let colors = model.points.values().map(|p| p.color).collect();
        let mut scene = Self::new(&PointCloud::colored(points, colors));
        let ids = ids_by_name(model);
        for (i, id) in ids.iter().enumerate() {
            let image = &model.images[id];
            let Some(camera) = model.cameras.get(&image.camera) else { continue };
            let fraction = i as f32 / (ids.len() - 1).max(1) as f32;
            scene.add_camera(camera, &image.pose.compose(&to_view.inverse()), Colormap::Turbo.color(fraction));
        }
        scene
    }
}

impl Report {
    /// Adds a table of the registered images of a model. `photographs` are the names of all input images; those that are not registered are
    /// listed as missing.
    pub fn registered_photographs(&mut self, model: &SparseModel, photographs: &[&str]) -> &mut Self {
        let rows = image_statistics(model);
        let known: BTreeMap<&str, &ImageStatistics<'_>> = rows.iter().map(|row| (row.name, row)).collect();
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
            "Registration of each photograph: observed points, mean reprojection error, mean track length of its points, and number of other photographs with at least {MIN_SHARED_POINTS} points in common."
        );
        self.table(&caption, &["photograph", "points", "error (px)", "track length", "linked photographs"], &cells)
    }

    /// Adds a table of at most `most` weakest connections of a model: the edges of the maximum spanning tree of the view graph with the fewest
    /// shared points. There the model drifts or breaks first, and more photographs help most.
    pub fn weakest_connections(&mut self, model: &SparseModel, most: usize) -> &mut Self {
        let row = |connection: &Connection<'_>| {
            let [a, b] = connection.names.map(str::to_owned);
            [a, b, connection.points.to_string(), format!("{} and {}", connection.sizes[0], connection.sizes[1])]
        };
        let cells: Vec<[String; 4]> = connections(model).iter().take(most).map(row).collect();
        let caption = "Weakest connections of the model: the two photographs, one of each part, with the most points in common, and the number of photographs in the parts. More photographs between the first pair help most.";
        self.table(caption, &["photograph", "and", "points in common", "photographs in the parts"], &cells)
    }
}

/// An edge of the maximum spanning tree of the view graph, which connects two parts of a model.
#[derive(Debug, Clone, PartialEq)]
struct Connection<'a> {
    /// The images, one of each part.
    names: [&'a str; 2],
    /// Number of shared points.
    points: u32,
    /// Number of images of the parts when the tree (Kruskal's algorithm) joined them.
    sizes: [usize; 2],
}

/// Computes the edges of the maximum spanning tree of the view graph, weighted by shared points, weakest first.
fn connections(model: &SparseModel) -> Vec<Connection<'_>> {
    let ids = ids_by_name(model);
    let shared = shared_points(model, &ids);
    let mut links: Vec<(u32, usize, usize)> = (0..ids.len())
        .flat_map(|a| (a + 1..ids.len()).map(move |b| (a, b)))
        .map(|(a, b)| (shared[a][b], a, b))
        .collect();
    links.sort_by_key(|&(points, a, b)| (std::cmp::Reverse(points), a, b));
    let mut parts = UnionFind::new(ids.len());
    let mut sizes = vec![1; ids.len()];
    let mut connections = Vec::new();
    for (points, a, b) in links.into_iter().filter(|link| link.0 > 0) {
        let roots = [a, b].map(|i| parts.find(i as u32) as usize);
        if parts.union(a as u32, b as u32) {
            connections.push(Connection {
                names: [a, b].map(|i| &*model.images[&ids[i]].name),
                points,
                sizes: roots.map(|r| sizes[r]),
            });
            sizes[parts.find(a as u32) as usize] = sizes[roots[0]] + sizes[roots[1]];
        }
    }
    connections.reverse();
    connections
}

/// Draws the view graph of a model as a matrix: a cell for each pair of images, the lighter the more shared points (logarithmic scale), gray for
/// none. Rows and columns are in the order of names. About `side` pixels wide, wider for models of more images.
pub fn draw_view_graph(model: &SparseModel, side: usize) -> RgbU8 {
    const INK: Color = [45, 48, 56];
    const NONE: Color = [228, 230, 234];
    let ids = ids_by_name(model);
    let count = ids.len();
    let shared = shared_points(model, &ids);
    let text = (side as f32 / 75.0).clamp(8.0, 14.0);
    let names: Vec<String> = ids.iter().map(|id| short_name(&model.images[id].name)).collect();
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
    // Label as many rows as there is room for.
    let every = (1.3 * text / cell as f32).ceil().max(1.0) as usize;
    for (y, name) in names.iter().enumerate().step_by(every) {
        let at = top as f32 + (y as f32 + 0.5) * cell as f32 - text / 2.0;
        raster.text(left as f32 - text * 0.6 - Raster::text_width(name, text), at, name, text, INK);
    }
    // Legend: some numbers of points with their colors.
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

/// Returns the image ids in the order of their names.
fn ids_by_name(model: &SparseModel) -> Vec<u32> {
    let mut ids: Vec<u32> = model.images.keys().copied().collect();
    ids.sort_by(|a, b| model.images[a].name.cmp(&model.images[b].name));
    ids
}

/// Returns a file name without its folder, truncated to its last 16 characters.
fn short_name(name: &str) -> String {
    let name = name.rsplit(['/', '\\']).next().unwrap_or(name);
    let count = name.chars().count();
    if count <= 16 { name.to_owned() } else { name.chars().skip(count - 16).collect() }
}

fn to_f32(p: Point3<f64>) -> [f32; 3] {
    [p.x as f32, p.y as f32, p.z as f32]
}

/// Computes the motion from the model's world to the upright frame of the first camera by name.
fn model_to_upright(model: &SparseModel) -> Pose {
    let poses: Vec<Pose> = ids_by_name(model).iter().map(|id| model.images[id].pose).collect();
    cv_core::upright_frame(&poses)
}

/// Counts the shared points of each pair of images, by index in `ids`; the diagonal has the points of each image.
fn shared_points(model: &SparseModel, ids: &[u32]) -> Vec<Vec<u32>> {
    let index_of: BTreeMap<u32, usize> = ids.iter().enumerate().map(|(i, id)| (*id, i)).collect();
    let mut shared = vec![vec![0; ids.len()]; ids.len()];
    for point in model.points.values() {
        // An image may observe a point twice.
        let images: BTreeSet<usize> =
            point.track.iter().filter_map(|(image, _)| index_of.get(image).copied()).collect();
        for &a in &images {
            for &b in &images {
                shared[a][b] += 1;
            }
        }
    }
    shared
}

fn image_statistics(model: &SparseModel) -> Vec<ImageStatistics<'_>> {
    let ids = ids_by_name(model);
    let shared = shared_points(model, &ids);
    // Per image: number of observations, number of those with an error, sum of errors, sum of track lengths.
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
        let (points, with_error, errors, lengths) = sums.get(id).copied().unwrap_or_default();
        ImageStatistics {
            name: &model.images[id].name,
            points,
            error: errors / with_error as f64,
            track_length: lengths as f64 / points as f64,
            linked: shared[i].iter().enumerate().filter(|&(j, &n)| j != i && n as usize >= MIN_SHARED_POINTS).count(),
        }
    };
    ids.iter().enumerate().map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Camera, ModelImage, ModelPoint, Point2, Vector3};

    /// Three cameras side by side that look along the world's X, down is −Z. The first two observe 20 points, the last 5 of them, one twice.
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
                // Observed with an error of three pixels to the right.
                let at = camera.project(&image.pose.transform(&position)).unwrap() + cv_core::Vector2::new(3.0, 0.0);
                track.push((*id, image.points.len() as u32));
                image.points.push((at, Some(k)));
            }
            model.points.insert(k, ModelPoint { position, color: [k as u8, 0, 0], error: 0.0, track });
        }
        model
    }

    #[test]
    fn image_statistics_have_points_error_track_length_and_links() {
        let model = model();
        let rows = image_statistics(&model);
        assert_eq!(rows.iter().map(|r| r.name).collect::<Vec<_>>(), ["b.jpg", "c.jpg", "in/a.jpg"]);
        assert_eq!(rows.iter().map(|r| r.points).collect::<Vec<_>>(), [20, 20, 6]);
        // The first two share twenty points and are linked; five shared with the last are too few.
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
    fn the_weakest_connections_are_edges_of_the_spanning_tree() {
        let model = model();
        // b and c share twenty points, each of them five with a: the first of the two by name is the edge.
        let b = |names, points, sizes| Connection { names, points, sizes };
        assert_eq!(connections(&model), [b(["b.jpg", "in/a.jpg"], 5, [2, 1]), b(["b.jpg", "c.jpg"], 20, [1, 1])]);
        let mut page = Report::new("t");
        let html = page.weakest_connections(&model, 1).to_html();
        assert!(html.contains(">2 and 1<") && !html.contains("c.jpg"), "{html}");
        assert_eq!(connections(&SparseModel::default()), []);
    }

    #[test]
    fn the_scene_is_in_the_upright_frame_of_the_first_camera() {
        let model = model();
        let to_view = model_to_upright(&model);
        // Half a meter ahead of the first camera, and below it.
        let p = to_view.transform(&Point3::new(3.5, 1.0, 0.8));
        assert!((p - Point3::new(0.0, 0.2, 0.5)).norm() < 1e-12, "{p}");
        assert_eq!(model_to_upright(&SparseModel::default()), Pose::identity());
        let scene = PointScene::of_model(&model);
        assert_eq!(scene.left_out(), 0);
        // An image whose camera id is missing is left out, and nothing else.
        let mut alone = model;
        alone.cameras.clear();
        assert!(PointScene::of_model(&alone) != scene);
    }

    #[test]
    fn cells_are_lighter_for_more_shared_points() {
        let drawn = draw_view_graph(&model(), 300);
        let light = |[r, g, b]: Color| u32::from(r) + u32::from(g) + u32::from(b);
        let is_cell = |c: Color| c == Colormap::Viridis.color(1.0);
        // The pair with twenty shared points, in both triangles.
        let bright: Vec<(usize, usize)> = (0..drawn.height())
            .flat_map(|y| (0..drawn.width()).map(move |x| (x, y)))
            .filter(|&(x, y)| is_cell(drawn.at(x, y)) && y > 20)
            .collect();
        assert_eq!(bright.len(), 2 * 39 * 39);
        let (x, y) = bright[0];
        // Its neighbor to the right is the pair with the last photograph.
        let five = drawn.at(x + 40, y);
        assert!(light(five) < light(drawn.at(x, y)) && five != [228, 230, 234]);
        assert_eq!(drawn.at(x - 1 - 20, y), [45, 48, 56]);
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
