//! Panoramas under `--max-memory`: photographs are read when they are needed, and the panorama is written row by row.

use super::{Args, EIGHT_BIT_ENDINGS, ENDINGS, metadata, outcome, report};
use crate::frame::{Context, Explain, Failure, Outcome, Output};
use crate::words;
use cv_core::{Image, ImageView, RgbU8};
use cv_io::{DynImage, ImageHeader, IoError, Metadata, PngPixels, RowWriter};
use cv_pipeline::panorama_types::{
    EightBits, Layer, MemoryLimit, NO_PHOTO, NotWritten, PhotoMask, PhotoSample, PhotoSource, Registration,
    RenderError, RowSink, StreamError, StreamedFrame,
};
use cv_pipeline::{PanoramaError, PanoramaPrior, PanoramaResult, panorama_streamed};
use cv_report::shrink_to_fit;
use std::borrow::Cow;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// Longer side of the photographs and of the panorama in a report, in pixels, at least where they are larger.
const REPORT_SIDE: usize = 1600;

/// Rows of a layer that are encoded at a time.
const LAYER_ROWS: usize = 256;

/// Files that are read when they are needed.
struct Files<'a, T> {
    paths: &'a [PathBuf],
    headers: &'a [ImageHeader],
    masks: &'a [Option<PhotoMask>],
    convert: fn(DynImage) -> Image<T, 3>,
    /// The first error.
    failure: Mutex<Option<IoError>>,
}

impl<T: PhotoSample> PhotoSource<T> for Files<'_, T> {
    fn size(&self, index: usize) -> (usize, usize) {
        self.headers.get(index).map_or((0, 0), |header| header.size)
    }

    fn load(&self, index: usize) -> Option<Cow<'_, Image<T, 3>>> {
        match cv_io::read_image(self.paths.get(index)?) {
            Ok(image) => Some(Cow::Owned((self.convert)(image))),
            Err(error) => {
                self.failure.lock().unwrap_or_else(PoisonError::into_inner).get_or_insert(error);
                None
            }
        }
    }

    fn mask(&self, index: usize) -> Option<&PhotoMask> {
        self.masks.get(index)?.as_ref()
    }
}

/// Writes the rows, and keeps some of them for the report.
struct Rows<'a, 'b, T> {
    /// `None` where the panorama is not written by rows.
    writer: Option<&'a mut RowWriter<'b>>,
    headers: &'a [ImageHeader],
    has_alpha: bool,
    /// Folder of the layers, which exists.
    layers: Option<&'a Path>,
    paths: &'a [PathBuf],
    /// Number of layers of each photograph so far.
    written: Vec<usize>,
    size: (usize, usize),
    failure: Option<IoError>,
    /// The panorama's path.
    path: &'a Path,
    thumbnail: Option<Thumbnail<T>>,
}

/// A panorama sampled at every `step`-th pixel, and its labels.
struct Thumbnail<T> {
    step: usize,
    width: usize,
    /// The row that comes next.
    y: usize,
    colors: Vec<T>,
    labels: Vec<u16>,
}

impl<T: PhotoSample> Thumbnail<T> {
    fn add(&mut self, colors: ImageView<'_, T, 3>, labels: ImageView<'_, u16, 1>) {
        for row in 0..colors.height() {
            if self.y.is_multiple_of(self.step) {
                let pixels = colors.row(row).as_chunks::<3>().0.iter().step_by(self.step);
                self.colors.extend(pixels.flatten());
                self.labels.extend(labels.row(row).iter().step_by(self.step));
            }
            self.y += 1;
        }
    }

    fn images(self) -> Option<(Image<T, 3>, Image<u16, 1>)> {
        let height = self.y.div_ceil(self.step);
        let colors = Image::from_vec(self.width, height, self.colors).ok()?;
        Some((colors, Image::from_vec(self.width, height, self.labels).ok()?))
    }
}

impl<T> RowSink<T> for Rows<'_, '_, T>
where
    T: PhotoSample,
    for<'v> ImageView<'v, T, 3>: PngPixels,
    for<'v> ImageView<'v, T, 4>: PngPixels,
{
    fn begin(&mut self, frame: &StreamedFrame) -> Result<(), NotWritten> {
        let (width, height) = frame.size;
        self.size = frame.size;
        let files: Vec<_> = self.headers.iter().map(|header| &header.metadata).collect();
        if let Some(writer) = &mut self.writer {
            writer.set_metadata(metadata(&files, frame.reference, frame.photos.iter().copied()));
            writer.set_size(width, height);
        }
        if let Some(thumbnail) = &mut self.thumbnail {
            thumbnail.step = (width.max(height) / REPORT_SIDE).max(1);
            thumbnail.width = width.div_ceil(thumbnail.step);
        }
        Ok(())
    }

    fn wants_layers(&self) -> bool {
        self.layers.is_some()
    }

    fn layer(&mut self, layer: Layer<T>) -> Result<(), NotWritten> {
        let Some(folder) = self.layers else { return Ok(()) };
        let path = folder.join(layer_name(&self.paths[layer.photo], layer.photo, self.written[layer.photo]));
        self.written[layer.photo] += 1;
        let icc = self.headers[layer.photo].metadata.icc.clone();
        let (width, height) = layer.pixels.size();
        let written = cv_io::write_image_rows(&path, |rows| -> Result<(), IoError> {
            rows.set_metadata(Metadata { exif: None, icc });
            rows.set_size(width, height);
            rows.set_position((layer.bounds.left, layer.bounds.top), self.size);
            for top in (0..height).step_by(LAYER_ROWS) {
                if let Some(part) = layer.pixels.view().crop(0, top, width, LAYER_ROWS.min(height - top)) {
                    rows.write(part).map_err(|reason| IoError { path: path.clone(), writing: true, reason })?;
                }
            }
            Ok(())
        });
        written.map_err(|error| {
            self.failure = Some(error);
            NotWritten
        })
    }

    fn rows(&mut self, colors: ImageView<'_, T, 3>, labels: ImageView<'_, u16, 1>) -> Result<(), NotWritten> {
        if let Some(thumbnail) = &mut self.thumbnail {
            thumbnail.add(colors, labels);
        }
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let written = if self.has_alpha {
            let (width, height) = colors.size();
            let with_alpha = Image::<T, 4>::from_fn(width, height, |x, y| {
                let [r, g, b] = colors.at(x, y);
                [r, g, b, if labels.at(x, y) == [NO_PHOTO] { T::default() } else { T::WHITE }]
            });
            writer.write(with_alpha.view())
        } else {
            writer.write(colors)
        };
        written.map_err(|reason| {
            self.failure = Some(IoError { path: self.path.to_owned(), writing: true, reason });
            NotWritten
        })
    }
}

/// Returns the file name of a layer: the index and the name of the photograph; `earlier` layers of it are written.
fn layer_name(photo: &Path, index: usize, earlier: usize) -> String {
    let stem = photo.file_stem().unwrap_or_default().to_string_lossy();
    let again = if earlier == 0 { String::new() } else { format!("-{}", earlier + 1) };
    format!("{index:03}-{stem}{again}.tif")
}

impl Args {
    /// Stitches files within `max_memory` bytes.
    pub(super) fn stitch_streamed(
        &self,
        paths: &[PathBuf],
        masks: &[Option<PhotoMask>],
        registration: Option<&Registration>,
        max_memory: usize,
        context: &Context,
    ) -> Result<Outcome, Failure> {
        let headers = paths.iter().map(cv_io::read_image_header).collect::<Result<Vec<_>, _>>()?;
        if !self.ends_in(EIGHT_BIT_ENDINGS) && headers.iter().any(|header| header.depth == 2) {
            let files =
                Files { paths, headers: &headers, masks, convert: DynImage::into_rgb16, failure: Mutex::default() };
            self.stitch_files(&files, registration, max_memory, context)
        } else {
            let files =
                Files { paths, headers: &headers, masks, convert: DynImage::into_rgb8, failure: Mutex::default() };
            self.stitch_files(&files, registration, max_memory, context)
        }
    }

    fn stitch_files<T>(
        &self,
        files: &Files<'_, T>,
        registration: Option<&Registration>,
        max_memory: usize,
        context: &Context,
    ) -> Result<Outcome, Failure>
    where
        T: PhotoSample,
        for<'v> ImageView<'v, T, 3>: PngPixels,
        for<'v> ImageView<'v, T, 4>: PngPixels,
    {
        let Files { paths, headers, .. } = *files;
        let cameras = self.cameras(headers.iter().map(|header| header.size), context)?;
        let prior = |header: &ImageHeader| PanoramaPrior {
            focal: header.exif.focal.as_ref().map(|focal| focal.pixels),
            camera: cameras.get(&header.size).copied(),
        };
        let priors: Vec<PanoramaPrior> = headers.iter().map(prior).collect();
        let mut options = self.options(context);
        // Memory limits the canvas, and the formats do.
        options.render.max_pixels = usize::MAX;
        let has_thumbnail = context.wants_report();
        let stitch = |path: &Path, writer: Option<&mut RowWriter<'_>>| {
            let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
            let scratch = tempfile::tempfile_in(folder)
                .during(format!("cannot create a scratch file in {}", folder.display()))?;
            let limit = MemoryLimit { bytes: max_memory, scratch: Box::new(scratch) };
            let thumbnail =
                has_thumbnail.then(|| Thumbnail { step: 1, width: 0, y: 0, colors: Vec::new(), labels: Vec::new() });
            let mut rows = Rows {
                writer,
                headers,
                has_alpha: self.alpha,
                layers: self.layers.as_deref(),
                paths,
                written: vec![0; paths.len()],
                size: (0, 0),
                failure: None,
                path,
                thumbnail,
            };
            let result = panorama_streamed(files, &priors, registration, &options, limit, &mut rows, context);
            match result {
                Ok(result) => Ok((result, rows.thumbnail)),
                Err(error) => Err(explained(error, files, rows.failure)),
            }
        };
        let output = Output::File(&self.output, ENDINGS);
        let write = |path: &Path| {
            if !options.render.radiance {
                return cv_io::write_image_rows(path, |writer| stitch(path, Some(writer)));
            }
            let made = stitch(path, None)?;
            if let Some(radiance) = &made.0.radiance {
                cv_io::write_exr(path, radiance.view())?;
            }
            Ok(made)
        };
        let (result, thumbnail): (PanoramaResult<T>, _) = match &self.layers {
            Some(folder) => context.write(Output::Folder(folder), |_| context.write(output, write))?,
            None => context.write(output, write)?,
        };
        self.conclude(paths, &result, context)?;
        context.report(|| {
            let none = || (Image::new(1, 1, [T::default(); 3]), Image::new(1, 1, [NO_PHOTO]));
            let (image, labels) = thumbnail.and_then(Thumbnail::images).unwrap_or_else(none);
            let small = |path| Ok(shrink_to_fit(cv_io::read_rgb(path)?.view(), REPORT_SIDE));
            let mut pictures = paths.iter().map(small).collect::<Result<Vec<_>, IoError>>()?;
            pictures
                .extend(EightBits::new(&[image.view()], "report", context)?.views().iter().map(ImageView::to_image));
            let views: Vec<_> = pictures.iter().map(RgbU8::view).collect();
            report::report(paths, &views, labels.view(), &result)
        })?;
        Ok(outcome(paths, &result))
    }
}

/// Words an error with its cause in the files.
fn explained<T>(error: PanoramaError, files: &Files<'_, T>, not_written: Option<IoError>) -> Failure {
    if let PanoramaError::Render(RenderError::Stream(reason)) = &error {
        let unread = files.failure.lock().unwrap_or_else(PoisonError::into_inner).take();
        match (reason, unread, not_written) {
            (StreamError::Photograph { .. }, Some(error), _) | (StreamError::NotWritten, _, Some(error)) => {
                return error.into();
            }
            _ => {}
        }
    }
    words::no_panorama(error, files.paths)
}
