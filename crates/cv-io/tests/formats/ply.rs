//! PLY.

use cv_core::PointCloud;
use cv_io::ply::{PlyEncoding, encode, write_cloud};
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
    fn clouds_round_trip(
        points in prop::collection::vec(prop::array::uniform3(-1e6f32..1e6), 0..9),
        colored: bool,
        with_normals: bool,
        edge in 0u32..9,
    ) {
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
