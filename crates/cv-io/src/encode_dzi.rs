//! Writing Deep Zoom images: an XML file and a folder of tiles, from the whole image down to one pixel by factors of 2, of which viewers such as
//! OpenSeadragon load what is visible. (Microsoft, "Deep Zoom File Format Overview".)

use crate::encode::encode_png_parts;
use crate::encode_jpeg::encode_jpeg_parts;
use crate::pending_writes::{PREFIX, PendingWrite, SUFFIX};
use crate::{FormatError, IoError, Metadata};
use png::{BitDepth, ColorType};
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// Side of a tile without overlap: files of 256 px inside the image, as other writers of the format.
const TILE_SIZE: usize = 254;
/// Columns and rows of the neighboring tiles on each side of a tile, for interpolation across its border.
const OVERLAP: usize = 1;
/// JPEG quality of tiles: a quarter smaller than that of photographs, since a viewer loads tens of them at a time.
const TILE_QUALITY: u8 = 90;

/// One level of the pyramid: the rows that incomplete tiles still need.
struct Level {
    width: usize,
    height: usize,
    /// Rows received so far.
    received: usize,
    /// Index of the first row in `rows`.
    top: usize,
    rows: Vec<u8>,
    /// Tile rows written so far.
    tile_rows: usize,
}

impl Level {
    /// Returns the range of pixels of tile `i` along an axis of `length` pixels.
    fn extent(i: usize, length: usize) -> std::ops::Range<usize> {
        (i * TILE_SIZE).saturating_sub(OVERLAP)..((i + 1) * TILE_SIZE + OVERLAP).min(length)
    }
}

/// Writes a Deep Zoom image row by row.
pub(crate) struct DziWriter {
    /// The folder of tiles at the end.
    folder: PathBuf,
    /// The XML file, whose existence shows that a folder of tiles is part of a Deep Zoom image.
    path: PathBuf,
    pending: PendingWrite,
    temporary: TempDir,
    color: ColorType,
    /// From the whole image to one pixel.
    levels: Vec<Level>,
}

impl DziWriter {
    /// Starts writing an image whose XML file will be at `path`.
    ///
    /// # Errors
    /// [`FormatError::NotRepresentable`] for an empty image and for 16 bits; [`FormatError::Os`] where the folder of tiles cannot be written, or
    /// something else is there.
    pub(crate) fn new(
        path: &Path,
        (width, height): (usize, usize),
        (color, depth): (ColorType, BitDepth),
    ) -> Result<Self, FormatError> {
        let refused = |what: String| FormatError::NotRepresentable { format: "Deep Zoom", what };
        if width == 0 || height == 0 {
            return Err(refused(format!("an image of {width}×{height}")));
        }
        if depth != BitDepth::Eight {
            return Err(refused("samples of 16 bits".to_owned()));
        }
        let (path, folder) = resolve(path)?;
        check_replaceable(&folder, &path)?;
        let parent = folder.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
        let make = || tempfile::Builder::new().prefix(PREFIX).suffix(SUFFIX).tempdir_in(parent);
        let (pending, temporary) = PendingWrite::make(make, |made| made.path())?;
        let mut sizes = vec![(width, height)];
        while let Some(&(w, h)) = sizes.last().filter(|size| **size != (1, 1)) {
            sizes.push((w.div_ceil(2), h.div_ceil(2)));
        }
        let level = |&(width, height): &(usize, usize)| Level {
            width,
            height,
            received: 0,
            top: 0,
            rows: Vec::new(),
            tile_rows: 0,
        };
        let levels: Vec<Level> = sizes.iter().map(level).collect();
        for i in 0..levels.len() {
            // By the umask, unlike the temporary folder itself.
            fs::create_dir_all(temporary.path().join("files").join(i.to_string()))?;
        }
        Ok(Self { folder, path, pending, temporary, color, levels })
    }

    /// Writes the next rows: samples without padding.
    ///
    /// # Errors
    /// [`FormatError::Os`].
    pub(crate) fn write(&mut self, rows: &[u8]) -> Result<(), FormatError> {
        let stride = self.levels[0].width * self.color.samples();
        rows.chunks_exact(stride).try_for_each(|row| self.push(0, row))
    }

    /// Adds a row to level `i`, counted from the whole image, and to smaller levels what follows from it.
    fn push(&mut self, i: usize, row: &[u8]) -> Result<(), FormatError> {
        let channels = self.color.samples();
        let count = self.levels.len();
        let level = &mut self.levels[i];
        level.rows.extend_from_slice(row);
        level.received += 1;
        let (received, height) = (level.received, level.height);
        if i + 1 < count && (received.is_multiple_of(2) || received == height) {
            // The row above is still there, since rows are kept from the overlap of the next tile on. An odd last row is averaged with itself.
            let above = received - if received.is_multiple_of(2) { 2 } else { 1 };
            let start = (above - level.top) * row.len();
            let half = half_resolution(&level.rows[start..start + row.len()], row, channels);
            self.push(i + 1, &half)?;
        }
        while self.levels[i].tile_rows * TILE_SIZE < height {
            let tile_row = self.levels[i].tile_rows;
            let extent = Level::extent(tile_row, height);
            if received < extent.end {
                break;
            }
            self.write_tiles(i, tile_row, extent)?;
            let level = &mut self.levels[i];
            level.tile_rows += 1;
            // The last row, if even in number, is still to be averaged with the next one.
            let keep = Level::extent(level.tile_rows, height).start.min(received - received % 2);
            level.rows.drain(..(keep - level.top) * row.len());
            level.top = keep;
        }
        Ok(())
    }

    /// Writes the tiles of a tile row, which has the pixel rows `ys`.
    fn write_tiles(&self, i: usize, tile_row: usize, ys: std::ops::Range<usize>) -> Result<(), FormatError> {
        let channels = self.color.samples();
        let Level { width, top, ref rows, .. } = self.levels[i];
        let folder = self.temporary.path().join("files").join((self.levels.len() - 1 - i).to_string());
        for column in 0..width.div_ceil(TILE_SIZE) {
            let xs = Level::extent(column, width);
            let mut tile = Vec::with_capacity(xs.len() * ys.len() * channels);
            for y in ys.clone() {
                let row = &rows[(y - top) * width * channels..][..width * channels];
                tile.extend_from_slice(&row[xs.start * channels..xs.end * channels]);
            }
            let parts = (xs.len(), ys.len(), self.color, BitDepth::Eight, tile.into());
            let bytes = if self.color == ColorType::Rgba {
                encode_png_parts(parts, &Metadata::default(), None)?
            } else {
                encode_jpeg_parts(parts, TILE_QUALITY, &Metadata::default())?
            };
            fs::write(folder.join(format!("{column}_{tile_row}.{}", self.format())), bytes)?;
        }
        Ok(())
    }

    /// File format of the tiles: JPEG has no alpha.
    fn format(&self) -> &'static str {
        if self.color == ColorType::Rgba { "png" } else { "jpg" }
    }

    /// Moves the folder of tiles to its place and returns the XML file.
    ///
    /// # Errors
    /// [`FormatError::Os`].
    pub(crate) fn finish(self) -> Result<String, FormatError> {
        let [width, height] = [self.levels[0].width, self.levels[0].height];
        let xml = format!(
            "<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<Image xmlns=\"http://schemas.microsoft.com/deepzoom/2008\" Format=\"{}\" Overlap=\"{OVERLAP}\" \
             TileSize=\"{TILE_SIZE}\">\n  <Size Width=\"{width}\" Height=\"{height}\"/>\n</Image>\n",
            self.format()
        );
        let Self { folder, path, pending, temporary, .. } = self;
        pending.finish(|| -> io::Result<()> {
            // Again: much time may have passed.
            check_replaceable(&folder, &path)?;
            if folder.exists() {
                fs::rename(&folder, temporary.path().join("replaced"))?;
            }
            fs::rename(temporary.path().join("files"), &folder)?;
            temporary.close()
        })?;
        Ok(xml)
    }
}

/// Returns the path of the XML file, by following a symbolic link, and that of the folder of tiles.
fn resolve(path: &Path) -> io::Result<(PathBuf, PathBuf)> {
    let path = if path.is_symlink() { fs::canonicalize(path)? } else { path.to_owned() };
    let folder = path.with_file_name(format!("{}_files", path.file_stem().unwrap_or_default().to_string_lossy()));
    Ok((path, folder))
}

/// Checks that a Deep Zoom image can be written to `path`, before the work: a folder with the name of its tiles must belong to an image there.
///
/// # Errors
/// [`IoError`] with [`FormatError::Os`].
pub fn check_deep_zoom(path: impl AsRef<Path>) -> Result<(), IoError> {
    let path = path.as_ref();
    let check = resolve(path).and_then(|(path, folder)| check_replaceable(&folder, &path));
    check.map_err(|error| IoError::writing(path, FormatError::Os(error)))
}

/// Only a folder of tiles of the Deep Zoom image of the same name is replaced: web browsers save pages to folders named alike.
fn check_replaceable(folder: &Path, path: &Path) -> io::Result<()> {
    if folder.symlink_metadata().is_ok() && !(folder.is_dir() && path.is_file()) {
        let text = format!("{} exists and does not belong to a Deep Zoom image", folder.display());
        return Err(io::Error::new(io::ErrorKind::AlreadyExists, text));
    }
    Ok(())
}

/// Averages blocks of 2×2 pixels of two rows; an odd last column is averaged with itself.
fn half_resolution(above: &[u8], below: &[u8], channels: usize) -> Vec<u8> {
    let pixels = above.chunks(2 * channels).zip(below.chunks(2 * channels));
    let average = |(a, b): (&[u8], &[u8])| -> Vec<u8> {
        let right = a.len() - channels;
        (0..channels)
            .map(|c| {
                let sum: u16 = [a[c], a[right + c], b[c], b[right + c]].into_iter().map(u16::from).sum();
                ((sum + 2) / 4) as u8
            })
            .collect()
    };
    pixels.flat_map(average).collect()
}
