//! Point clouds as PLY, ASCII or little-endian binary.

use std::io::Write;
use std::path::Path;

use crate::{FormatError, IoError, write_atomic};

const NAME: &str = "PLY";

/// What a PLY file holds here: points, maybe coloured, maybe with normals, and line segments between them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Cloud {
    /// Positions in the unit of the scene.
    pub points: Vec<[f32; 3]>,
    /// One RGB colour per point, or empty.
    pub colors: Vec<[u8; 3]>,
    /// One unit normal per point, or empty.
    pub normals: Vec<[f32; 3]>,
    /// Line segments as pairs of indices into `points`, such as the outline of a camera.
    pub edges: Vec<[u32; 2]>,
}

/// How the numbers are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum PlyEncoding {
    /// Little-endian binary: 15 bytes a coloured point. What every viewer reads.
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

    /// Points with a colour each.
    pub fn colored(points: Vec<[f32; 3]>, colors: Vec<[u8; 3]>) -> Self {
        Self { points, colors, ..Self::default() }
    }

    /// Adds points of one colour joined by `edges`, whose indices count from the first added point. Colours and normals that
    /// the cloud lacks so far stay absent where it is empty of them and non-empty of points.
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

    fn check(&self) -> Result<(), FormatError> {
        let n = self.points.len();
        let wrong = |what: String| Err(FormatError::NotRepresentable { format: NAME, what });
        if !self.colors.is_empty() && self.colors.len() != n {
            return wrong(format!("{} colours for {n} points", self.colors.len()));
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
/// [`FormatError::NotRepresentable`] where colours or normals are not as many as points, or an edge leads nowhere.
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
