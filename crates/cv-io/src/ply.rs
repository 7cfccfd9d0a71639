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
