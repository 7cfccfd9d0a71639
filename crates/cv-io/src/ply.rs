//! Point clouds as PLY, ASCII or little-endian binary.

use std::io::Write;
use std::path::Path;

use cv_core::{Camera, Point3, Pose};

use crate::{FormatError, IoError, write_atomic};

const NAME: &str = "PLY";

/// What a PLY file holds here: points, maybe colored, maybe with normals, and line segments between them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Cloud {
    /// Positions in the unit of the scene.
    pub points: Vec<[f32; 3]>,
    /// One RGB color per point, or empty.
    pub colors: Vec<[u8; 3]>,
    /// One unit normal per point, or empty.
    pub normals: Vec<[f32; 3]>,
    /// Line segments as pairs of indices into `points`, such as the outline of a camera.
    pub edges: Vec<[u32; 2]>,
}

/// How the numbers are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PlyEncoding {
    /// Little-endian binary: 15 bytes a colored point. What every viewer reads.
    #[default]
    Binary,
    /// Text, about 3 times as large.
    Ascii,
}

impl Cloud {
    /// Points without more.
    pub fn from_points(points: Vec<[f32; 3]>) -> Self {
        Self { points, ..Self::default() }
    }

    /// Points with a color each.
    pub fn colored(points: Vec<[f32; 3]>, colors: Vec<[u8; 3]>) -> Self {
        Self { points, colors, ..Self::default() }
    }

    /// Adds points of one color joined by `edges`, whose indices count from the first added point.
    ///
    /// A cloud of points without colors stays without; normals, where there are some, are zero for the added points.
    pub fn add_wireframe(&mut self, corners: &[[f32; 3]], edges: &[[u32; 2]], color: [u8; 3]) {
        let first = self.points.len() as u32;
        let colored = self.points.is_empty() || !self.colors.is_empty();
        let with_normals = !self.normals.is_empty();
        self.points.extend_from_slice(corners);
        if colored {
            self.colors.extend(std::iter::repeat_n(color, corners.len()));
        }
        if with_normals {
            self.normals.extend(std::iter::repeat_n([0.0; 3], corners.len()));
        }
        self.edges.extend(edges.iter().map(|e| e.map(|i| i + first)));
    }

    /// Adds a camera's outline: its center, and the corners of its picture `depth` in front of it.
    pub fn add_camera(&mut self, camera: &Camera, pose: &Pose, depth: f64, color: [u8; 3]) {
        let (right, bottom) = (camera.width as f64 - 0.5, camera.height as f64 - 0.5);
        let to_world = pose.inverse();
        let corner = |x: f64, y: f64| {
            // Without the lens: an outline has straight edges.
            let ray = Point3::new((x - camera.cx) / camera.fx * depth, (y - camera.cy) / camera.fy * depth, depth);
            to_world.transform(&ray)
        };
        let corners =
            [pose.center(), corner(-0.5, -0.5), corner(right, -0.5), corner(right, bottom), corner(-0.5, bottom)];
        let corners = corners.map(|p| [p.x as f32, p.y as f32, p.z as f32]);
        self.add_wireframe(&corners, &[[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]], color);
    }

    fn check(&self) -> Result<(), FormatError> {
        let n = self.points.len();
        let wrong = |what: String| Err(FormatError::NotRepresentable { format: NAME, what });
        if !self.colors.is_empty() && self.colors.len() != n {
            return wrong(format!("{} colors for {n} points", self.colors.len()));
        }
        if !self.normals.is_empty() && self.normals.len() != n {
            return wrong(format!("{} normals for {n} points", self.normals.len()));
        }
        match self.edges.iter().flatten().find(|&&i| i as usize >= n) {
            Some(i) => wrong(format!("an edge to point {i} of {n}")),
            None => Ok(()),
        }
    }
}

/// Encodes a cloud.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where colors or normals are not as many as points, or an edge leads nowhere.
pub fn encode(cloud: &Cloud, encoding: PlyEncoding, sink: &mut dyn Write) -> Result<(), FormatError> {
    cloud.check()?;
    let format = match encoding {
        PlyEncoding::Binary => "binary_little_endian",
        PlyEncoding::Ascii => "ascii",
    };
    write!(sink, "ply\nformat {format} 1.0\nelement vertex {}\n", cloud.points.len())?;
    write!(sink, "property float x\nproperty float y\nproperty float z\n")?;
    if !cloud.normals.is_empty() {
        write!(sink, "property float nx\nproperty float ny\nproperty float nz\n")?;
    }
    if !cloud.colors.is_empty() {
        write!(sink, "property uchar red\nproperty uchar green\nproperty uchar blue\n")?;
    }
    if !cloud.edges.is_empty() {
        write!(sink, "element edge {}\nproperty int vertex1\nproperty int vertex2\n", cloud.edges.len())?;
    }
    writeln!(sink, "end_header")?;
    for (i, point) in cloud.points.iter().enumerate() {
        let normal = cloud.normals.get(i);
        let color = cloud.colors.get(i);
        match encoding {
            PlyEncoding::Binary => {
                let mut row = [0u8; 27];
                let mut len = 0;
                for v in point.iter().chain(normal.into_iter().flatten()) {
                    row[len..len + 4].copy_from_slice(&v.to_le_bytes());
                    len += 4;
                }
                if let Some(color) = color {
                    row[len..len + 3].copy_from_slice(color);
                    len += 3;
                }
                sink.write_all(&row[..len])?;
            }
            PlyEncoding::Ascii => {
                write!(sink, "{} {} {}", point[0], point[1], point[2])?;
                if let Some(n) = normal {
                    write!(sink, " {} {} {}", n[0], n[1], n[2])?;
                }
                if let Some(c) = color {
                    write!(sink, " {} {} {}", c[0], c[1], c[2])?;
                }
                writeln!(sink)?;
            }
        }
    }
    for &[a, b] in &cloud.edges {
        match encoding {
            PlyEncoding::Binary => {
                sink.write_all(&a.to_le_bytes())?;
                sink.write_all(&b.to_le_bytes())?;
            }
            PlyEncoding::Ascii => writeln!(sink, "{a} {b}")?,
        }
    }
    Ok(())
}

/// Writes a cloud; see [`encode`].
///
/// # Errors
/// As [`encode`] and [`write_atomic`].
pub fn write_cloud(path: impl AsRef<Path>, cloud: &Cloud, encoding: PlyEncoding) -> Result<(), IoError> {
    write_atomic(path, |sink| encode(cloud, encoding, sink))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Reads what [`encode`] writes, by the format's own description: a header that names every property, then the rows.
    fn read_back(bytes: &[u8]) -> Cloud {
        let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
        let header = std::str::from_utf8(&bytes[..end]).unwrap();
        let binary = header.contains("format binary_little_endian 1.0");
        let mut body = &bytes[end..];
        let mut next = |kind: &str| -> f64 {
            if binary {
                let len = if kind == "uchar" { 1 } else { 4 };
                let (cell, rest) = body.split_at(len);
                body = rest;
                match kind {
                    "uchar" => f64::from(cell[0]),
                    "float" => f64::from(f32::from_le_bytes(cell.try_into().unwrap())),
                    "int" => f64::from(i32::from_le_bytes(cell.try_into().unwrap())),
                    other => panic!("{other}"),
                }
            } else {
                let start = body.iter().position(|b| !b.is_ascii_whitespace()).unwrap();
                let len = body[start..].iter().position(u8::is_ascii_whitespace).unwrap();
                let word = std::str::from_utf8(&body[start..start + len]).unwrap();
                body = &body[start + len..];
                word.parse().unwrap()
            }
        };
        let mut cloud = Cloud::default();
        let mut lines = header.lines().peekable();
        while let Some(line) = lines.next() {
            let Some(element) = line.strip_prefix("element ") else { continue };
            let (element, count) = element.split_once(' ').unwrap();
            let mut properties = Vec::new();
            while let Some(p) = lines.peek().and_then(|l| l.strip_prefix("property ")) {
                properties.push(p.split_once(' ').unwrap());
                lines.next();
            }
            for _ in 0..count.parse::<usize>().unwrap() {
                let row: Vec<(&str, f64)> = properties.iter().map(|(kind, name)| (*name, next(kind))).collect();
                let get = |name: &str| row.iter().find(|(n, _)| *n == name).map(|(_, v)| *v);
                match element {
                    "vertex" => {
                        cloud.points.push(["x", "y", "z"].map(|n| get(n).unwrap() as f32));
                        if get("red").is_some() {
                            cloud.colors.push(["red", "green", "blue"].map(|n| get(n).unwrap() as u8));
                        }
                        if get("nx").is_some() {
                            cloud.normals.push(["nx", "ny", "nz"].map(|n| get(n).unwrap() as f32));
                        }
                    }
                    "edge" => cloud.edges.push(["vertex1", "vertex2"].map(|n| get(n).unwrap() as u32)),
                    other => panic!("{other}"),
                }
            }
        }
        assert!(body.iter().all(u8::is_ascii_whitespace) || !binary && body.is_empty(), "bytes are left over");
        cloud
    }

    proptest! {
        #[test]
        fn clouds_read_back(points in prop::collection::vec(prop::array::uniform3(-1e6f32..1e6), 0..9), colored: bool, with_normals: bool, edge in 0u32..9) {
            let n = points.len();
            let mut cloud = Cloud::from_points(points);
            if colored {
                cloud.colors = (0..n).map(|i| [i as u8, 200, 255]).collect();
            }
            if with_normals {
                cloud.normals = (0..n).map(|i| [0.6, -0.8, i as f32]).collect();
            }
            if (edge as usize) < n {
                cloud.edges.push([edge, 0]);
            }
            for encoding in [PlyEncoding::Binary, PlyEncoding::Ascii] {
                let mut bytes = Vec::new();
                encode(&cloud, encoding, &mut bytes).unwrap();
                prop_assert_eq!(read_back(&bytes), cloud.clone());
            }
        }
    }

    #[test]
    fn wireframes_keep_the_cloud_consistent() {
        let corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]];
        for mut cloud in [
            Cloud::default(),
            Cloud::from_points(vec![[5.0; 3]]),
            Cloud::colored(vec![[5.0; 3]], vec![[1, 2, 3]]),
            Cloud { normals: vec![[0.0, 0.0, 1.0]], ..Cloud::from_points(vec![[5.0; 3]]) },
        ] {
            let first = cloud.points.len() as u32;
            cloud.add_wireframe(&corners, &[[0, 1]], [255, 0, 0]);
            assert_eq!(cloud.edges, [[first, first + 1]]);
            encode(&cloud, PlyEncoding::Binary, &mut Vec::new()).unwrap();
        }
    }

    #[test]
    fn a_cameras_outline_is_what_it_sees() {
        let camera = Camera::pinhole(200, 100, 100.0, 100.0, 99.5, 49.5);
        let pose =
            Pose::look_at(Point3::new(1.0, 2.0, 3.0), Point3::new(4.0, 2.0, 3.0), cv_core::Vector3::y()).unwrap();
        let mut cloud = Cloud::default();
        cloud.add_camera(&camera, &pose, 2.0, [9, 9, 9]);
        assert_eq!(cloud.points[0], [1.0, 2.0, 3.0]);
        let seen: Vec<_> = cloud.points[1..]
            .iter()
            .map(|p| {
                camera
                    .project(&pose.transform(&Point3::new(f64::from(p[0]), f64::from(p[1]), f64::from(p[2]))))
                    .unwrap()
            })
            .collect();
        let corners = [(-0.5, -0.5), (199.5, -0.5), (199.5, 99.5), (-0.5, 99.5)];
        // The points are stored as f32, with seven digits.
        assert!(seen.iter().zip(corners).all(|(p, (x, y))| (p.x - x).hypot(p.y - y) < 1e-3), "{seen:?}");
        assert_eq!((cloud.edges.len(), cloud.colors.len()), (8, 5));
    }

    #[test]
    fn clouds_that_contradict_themselves_are_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.ply");
        for cloud in [
            Cloud::colored(vec![[0.0; 3]; 2], vec![[0; 3]]),
            Cloud { normals: vec![[0.0; 3]], ..Cloud::default() },
            Cloud { edges: vec![[0, 1]], ..Cloud::from_points(vec![[0.0; 3]]) },
        ] {
            assert!(write_cloud(&path, &cloud, PlyEncoding::Binary).is_err());
            assert!(!path.exists());
        }
    }
}
