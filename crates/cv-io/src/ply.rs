//! Point clouds as PLY, ASCII or little-endian binary.

use std::io::Write;
use std::path::Path;

use cv_core::PointCloud;

use crate::{FormatError, IoError, write_atomic};

const NAME: &str = "PLY";

/// Encoding of a PLY file.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PlyEncoding {
    /// Little-endian binary: 15 bytes per colored point. Every viewer reads it.
    #[default]
    Binary,
    /// Text, about three times as large.
    Ascii,
}

/// Refuses an inconsistent cloud.
fn check(cloud: &PointCloud) -> Result<(), FormatError> {
    let n = cloud.len();
    let wrong = |what: String| Err(FormatError::NotRepresentable { format: NAME, what });
    if !cloud.colors.is_empty() && cloud.colors.len() != n {
        return wrong(format!("{} colors for {n} points", cloud.colors.len()));
    }
    if !cloud.normals.is_empty() && cloud.normals.len() != n {
        return wrong(format!("{} normals for {n} points", cloud.normals.len()));
    }
    match cloud.edges.iter().flatten().find(|&&i| i as usize >= n) {
        Some(i) => wrong(format!("an edge to point {i} of {n}")),
        None => Ok(()),
    }
}

/// Encodes a point cloud.
///
/// # Errors
/// [`FormatError::NotRepresentable`] where the number of colors or normals is not that of points, or an edge refers to a missing point.
pub fn encode(cloud: &PointCloud, encoding: PlyEncoding, sink: &mut dyn Write) -> Result<(), FormatError> {
    check(cloud)?;
    let format = match encoding {
        PlyEncoding::Binary => "binary_little_endian",
        PlyEncoding::Ascii => "ascii",
    };
    write!(sink, "ply\nformat {format} 1.0\nelement vertex {}\n", cloud.positions.len())?;
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
    for (i, point) in cloud.positions.iter().enumerate() {
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

/// Writes a point cloud; see [`encode`].
///
/// # Errors
/// As [`encode`] and [`write_atomic`].
pub fn write_cloud(path: impl AsRef<Path>, cloud: &PointCloud, encoding: PlyEncoding) -> Result<(), IoError> {
    write_atomic(path, |sink| encode(cloud, encoding, sink))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    /// Reads a file of [`encode`] by its header, which lists every property.
    fn read_back(bytes: &[u8]) -> PointCloud {
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
        let mut cloud = PointCloud::default();
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
                        cloud.positions.push(["x", "y", "z"].map(|n| get(n).unwrap() as f32));
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
        fn clouds_round_trip(points in prop::collection::vec(prop::array::uniform3(-1e6f32..1e6), 0..9), colored: bool, with_normals: bool, edge in 0u32..9) {
            let n = points.len();
            let mut cloud = PointCloud::from_positions(points);
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
    fn inconsistent_clouds_are_not_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("c.ply");
        for cloud in [
            PointCloud::colored(vec![[0.0; 3]; 2], vec![[0; 3]]),
            PointCloud { normals: vec![[0.0; 3]], ..PointCloud::default() },
            PointCloud { edges: vec![[0, 1]], ..PointCloud::from_positions(vec![[0.0; 3]]) },
        ] {
            assert!(write_cloud(&path, &cloud, PlyEncoding::Binary).is_err());
            assert!(!path.exists());
        }
    }
}
