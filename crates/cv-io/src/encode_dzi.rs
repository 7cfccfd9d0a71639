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
            let parts = (xs.len(), ys.len(), self.color, BitDepth::Eight, tile);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::IoError;
    use crate::{read_image, write_image, write_image_rows};
    use cv_core::Image;

    fn decode_png(path: &Path) -> Image<u8, 4> {
        let mut reader = png::Decoder::new(io::BufReader::new(fs::File::open(path).unwrap())).read_info().unwrap();
        let mut samples = vec![0; reader.output_buffer_size().unwrap()];
        let info = reader.next_frame(&mut samples).unwrap();
        Image::from_vec(info.width as usize, info.height as usize, samples).unwrap()
    }

    /// Assembles a level from its PNG tiles; where tiles overlap, they must agree.
    fn assemble(folder: &Path, level: usize, width: usize, height: usize) -> Image<u8, 4> {
        let mut image = Image::<u8, 4>::new(width, height, [0; 4]);
        let mut is_set = vec![false; width * height];
        let folder = folder.join(level.to_string());
        let (columns, rows) = (width.div_ceil(254), height.div_ceil(254));
        assert_eq!(fs::read_dir(&folder).unwrap().count(), columns * rows, "level {level}");
        for row in 0..rows {
            for column in 0..columns {
                let tile = decode_png(&folder.join(format!("{column}_{row}.png")));
                // One pixel of overlap where there is a neighbor.
                let (left, top) = ((254 * column).saturating_sub(1), (254 * row).saturating_sub(1));
                let end = |i: usize, all: usize| (254 * (i + 1) + 1).min(all);
                assert_eq!(tile.size(), (end(column, width) - left, end(row, height) - top));
                for y in 0..tile.height() {
                    for x in 0..tile.width() {
                        let i = (top + y) * width + left + x;
                        assert!(!is_set[i] || image.at(left + x, top + y) == tile.at(x, y), "level {level}: {x}, {y}");
                        is_set[i] = true;
                        image.set(left + x, top + y, tile.at(x, y));
                    }
                }
            }
        }
        assert!(is_set.iter().all(|&set| set));
        image
    }

    #[test]
    fn tiles_of_all_levels_assemble_to_the_image_and_its_averages() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("wide.dzi");
        // One pixel; sides around one and two tiles; odd sides; each replaces the one before.
        for (width, height) in [(1, 1), (254, 255), (256, 253), (509, 508), (700, 1), (3, 511), (777, 603)] {
            let pixel = |x: usize, y: usize| {
                [(x * 7 + y) as u8, (y * 5 + x / 3) as u8, (x * y / 11) as u8, 255 - (y % 2) as u8]
            };
            let image = Image::<u8, 4>::from_fn(width, height, pixel);
            write_image(&path, image.view(), &Metadata::default()).unwrap();
            let xml = fs::read_to_string(&path).unwrap();
            assert!(xml.contains(&format!("<Size Width=\"{width}\" Height=\"{height}\"/>")), "{xml}");
            let tiles = folder.path().join("wide_files");
            let mut expected = image;
            let levels = (0..).find(|&n| 1usize << n >= width.max(height)).unwrap();
            assert_eq!(fs::read_dir(&tiles).unwrap().count(), levels + 1);
            for level in (0..=levels).rev() {
                let (w, h) = expected.size();
                assert!(assemble(&tiles, level, w, h) == expected, "level {level} of {width}×{height}");
                expected = Image::from_fn(w.div_ceil(2), h.div_ceil(2), |x, y| {
                    let at = |dx: usize, dy: usize| expected.at((2 * x + dx).min(w - 1), (2 * y + dy).min(h - 1));
                    std::array::from_fn(|c| {
                        let sum: f64 = [at(0, 0), at(1, 0), at(0, 1), at(1, 1)].iter().map(|p| f64::from(p[c])).sum();
                        (sum / 4.0 + 0.5).floor() as u8
                    })
                });
            }
            assert_eq!(expected.size(), (1, 1));
        }
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
    }

    #[test]
    fn colors_have_tiles_of_jpeg() {
        let folder = tempfile::tempdir().unwrap();
        let image = Image::<u8, 3>::from_fn(300, 20, |x, _| [(x / 2) as u8, 90, 200]);
        write_image(folder.path().join("a.dzi"), image.view(), &Metadata::default()).unwrap();
        assert!(fs::read_to_string(folder.path().join("a.dzi")).unwrap().contains("Format=\"jpg\""));
        let tile = read_image(folder.path().join("a_files/9/1_0.jpg")).unwrap().into_rgb8();
        assert_eq!(tile.size(), (47, 20));
        for x in 0..47 {
            // A smooth ramp: JPEG of quality 90 is within a few levels.
            assert!(tile.at(x, 10).iter().zip(image.at(253 + x, 10)).all(|(a, b)| a.abs_diff(b) <= 4), "{x}");
        }
    }

    #[test]
    fn other_folders_and_failed_images_are_left_alone() {
        let folder = tempfile::tempdir().unwrap();
        let (path, tiles) = (folder.path().join("a.dzi"), folder.path().join("a_files"));
        let image = Image::<u8, 3>::new(5, 4, [9; 3]);
        fs::create_dir(&tiles).unwrap();
        fs::write(tiles.join("saved by a browser"), "x").unwrap();
        assert!(check_deep_zoom(&path).is_err());
        let error = write_image(&path, image.view(), &Metadata::default()).unwrap_err().to_string();
        assert!(error.contains("a_files exists and does not belong to a Deep Zoom image"), "{error}");
        assert!(tiles.join("saved by a browser").exists() && !path.exists());
        fs::remove_dir_all(&tiles).unwrap();
        write_image(&path, image.view(), &Metadata::default()).unwrap();
        check_deep_zoom(&path).unwrap();
        let old = fs::read(&path).unwrap();
        let short = write_image_rows(&path, |rows| -> Result<(), IoError> {
            rows.set_size(5, 9);
            rows.write(image.view()).map_err(|reason| IoError::writing(&path, reason))
        });
        assert!(short.unwrap_err().to_string().contains("5 rows are missing"));
        assert!(fs::read(&path).unwrap() == old && tiles.join("3/0_0.jpg").exists());
        assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 2);
        let deep = Image::<u16, 3>::new(2, 2, [9; 3]);
        let error = write_image(&path, deep.view(), &Metadata::default()).unwrap_err();
        assert!(matches!(error.reason, FormatError::NotRepresentable { format: "Deep Zoom", .. }), "{error}");
    }
}
