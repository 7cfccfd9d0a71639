//! Writing images by rows.

use std::path::Path;

use cv_core::{Image, ImageView, Sample};
use cv_io::{FormatError, IoError, Metadata, PngPixels, read_image, write_image, write_image_rows};

/// Returns a function that makes the error of writing `path`.
pub(crate) fn error_at(path: impl AsRef<Path>) -> impl FnOnce(FormatError) -> IoError {
    move |reason| IoError { path: path.as_ref().to_owned(), writing: true, reason }
}

/// Writes an image whose rows arrive `at_once`.
pub(crate) fn write_in_rows<T: Sample, const C: usize>(
    path: &Path,
    image: &Image<T, C>,
    at_once: usize,
) -> Result<(), IoError>
where
    for<'a> ImageView<'a, T, C>: PngPixels,
{
    write_image_rows(path, |rows| -> Result<(), IoError> {
        let (w, h) = image.size();
        rows.set_size(w, h);
        for top in (0..h).step_by(at_once) {
            let part = image.view().crop(0, top, w, at_once.min(h - top)).unwrap();
            rows.write(part).map_err(error_at(path))?;
        }
        Ok(())
    })
}

#[test]
fn files_are_those_of_the_whole_image_and_absent_after_a_failure() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let colors = Image::<u8, 3>::from_fn(701, 333, |x, y| [(x % 251) as u8, (y % 241) as u8, (x * y % 239) as u8]);
    let deep = colors.map(|p| p.map(|v| 257 * u16::from(v) + 3));
    let alpha = colors.map(|[r, g, b]| [r, g, b, r / 128 * 255]);
    macro_rules! compare {
        ($ending:expr, $image:expr) => {
            // Strips of any height.
            write_in_rows(&path(concat!("rows.", $ending)), &$image, 50).unwrap();
            write_image(path(concat!("whole.", $ending)), $image.view(), &Metadata::default()).unwrap();
            let (a, b) = (path(concat!("rows.", $ending)), path(concat!("whole.", $ending)));
            assert_eq!(read_image(&a).unwrap().pixels, read_image(&b).unwrap().pixels, $ending);
            // PNG is compressed in another way.
            assert!($ending == "png" || std::fs::read(a).unwrap() == std::fs::read(b).unwrap(), $ending);
        };
    }
    compare!("png", colors);
    compare!("tif", colors);
    compare!("jpg", colors);
    compare!("png", deep);
    compare!("tif", deep);
    compare!("tif", alpha);
    let tiny = Image::<u8, 3>::new(1, 1, [7, 8, 9]);
    compare!("tif", tiny);
    compare!("png", tiny);
    let error = write_in_rows(&path("deep.jpg"), &deep, 50).unwrap_err();
    assert!(matches!(error.reason, FormatError::NotRepresentable { format: "JPEG", .. }), "{error}");
    let short = write_image_rows(path("short.png"), |rows| -> Result<(), IoError> {
        rows.set_size(701, 334);
        rows.write(colors.view()).map_err(error_at("short.png"))
    });
    assert!(short.unwrap_err().to_string().contains("1 rows are missing"));
    for (size, rows) in [((700, 333), "width"), ((701, 300), "height")] {
        let wrong = write_image_rows(path("wrong.tif"), |writer| -> Result<(), IoError> {
            writer.set_size(size.0, size.1);
            writer.write(colors.view()).map_err(error_at("wrong.tif"))
        });
        assert!(matches!(wrong.unwrap_err().reason, FormatError::Corrupt { .. }), "{rows}");
    }
    assert!(["deep.jpg", "short.png", "wrong.tif"].iter().all(|name| !path(name).exists()));
}
