//! A scratch file for what does not fit in memory: gray images and warped photographs.

use super::{ScratchFile, StreamError};
use crate::bit_depth::Internals;
use crate::surface::{Bounds, WarpedPhoto};
use cv_core::{GrayU8, Image};
use std::io::{self, SeekFrom};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// A file to which images are appended, and from which parts are read, from any thread.
pub(crate) struct Scratch(Mutex<(Box<dyn ScratchFile>, u64)>);

fn failed(error: &io::Error) -> StreamError {
    StreamError::Scratch { os_error: error.raw_os_error() }
}

impl Scratch {
    pub(crate) fn new(file: Box<dyn ScratchFile>) -> Self {
        Self(Mutex::new((file, 0)))
    }

    fn lock(&self) -> MutexGuard<'_, (Box<dyn ScratchFile>, u64)> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Appends bytes; returns their position.
    pub(crate) fn append(&self, bytes: &[u8]) -> Result<u64, StreamError> {
        let mut locked = self.lock();
        let (file, end) = &mut *locked;
        let at = *end;
        let written = file.seek(SeekFrom::Start(at)).and_then(|_| file.write_all(bytes));
        written.map_err(|error| failed(&error))?;
        *end += bytes.len() as u64;
        Ok(at)
    }

    /// Fills `out` with rows of `row` bytes that begin `stride` bytes apart, from position `at`.
    fn read_rows(&self, at: u64, stride: usize, row: usize, out: &mut [u8]) -> Result<(), StreamError> {
        let mut locked = self.lock();
        let file = &mut locked.0;
        let mut read = || -> io::Result<()> {
            if stride == row {
                file.seek(SeekFrom::Start(at))?;
                return file.read_exact(out);
            }
            for (y, out) in out.chunks_exact_mut(row.max(1)).enumerate() {
                file.seek(SeekFrom::Start(at + (y * stride) as u64))?;
                file.read_exact(out)?;
            }
            Ok(())
        };
        read().map_err(|error| failed(&error))
    }

    /// Discards what was appended.
    pub(crate) fn clear(&self) {
        self.lock().1 = 0;
    }
}

/// Gray images in a scratch file; the last used ones are kept in memory.
pub(crate) struct GrayStore<'a> {
    scratch: &'a Scratch,
    /// Size and position of each.
    places: Vec<Option<((usize, usize), u64)>>,
    /// The images in memory, the last used ones last.
    recent: Mutex<Vec<(usize, Arc<GrayU8>)>>,
    capacity: usize,
}

impl<'a> GrayStore<'a> {
    /// `capacity`: images to keep in memory.
    pub(crate) fn new(scratch: &'a Scratch, places: Vec<Option<((usize, usize), u64)>>, capacity: usize) -> Self {
        Self { scratch, places, recent: Mutex::default(), capacity: capacity.max(1) }
    }

    pub(crate) fn get(&self, index: usize) -> Result<Arc<GrayU8>, StreamError> {
        let recent = || self.recent.lock().unwrap_or_else(PoisonError::into_inner);
        {
            let mut recent = recent();
            if let Some(k) = recent.iter().position(|(i, _)| *i == index) {
                let entry = recent.remove(k);
                let image = Arc::clone(&entry.1);
                recent.push(entry);
                return Ok(image);
            }
        }
        let ((width, height), at) =
            self.places.get(index).copied().flatten().ok_or(StreamError::Photograph { index })?;
        let mut image = GrayU8::new(width, height, [0]);
        self.scratch.read_rows(at, width, width, image.as_mut_slice())?;
        let image = Arc::new(image);
        let mut recent = recent();
        if recent.len() >= self.capacity {
            recent.remove(0);
        }
        recent.push((index, Arc::clone(&image)));
        Ok(image)
    }
}

/// Warped photographs in a scratch file.
pub(crate) struct WarpedStore<'a, T> {
    scratch: &'a Scratch,
    /// Bounds and position of each placement.
    places: Vec<Option<(Bounds, u64)>>,
    sample: std::marker::PhantomData<fn() -> T>,
}

impl<'a, T: Internals> WarpedStore<'a, T> {
    pub(crate) fn new(scratch: &'a Scratch) -> Self {
        Self { scratch, places: Vec::new(), sample: std::marker::PhantomData }
    }

    /// Appends the next photograph.
    pub(crate) fn push(&mut self, photo: Option<&WarpedPhoto<T>>) -> Result<(), StreamError> {
        let place = match photo {
            Some(photo) => Some((photo.bounds, self.scratch.append(&T::bytes_of(photo.pixels.as_slice()))?)),
            None => None,
        };
        self.places.push(place);
        Ok(())
    }

    /// Returns the bounds of each photograph.
    pub(crate) fn bounds(&self) -> Vec<Option<Bounds>> {
        self.places.iter().map(|place| place.map(|(bounds, _)| bounds)).collect()
    }

    /// Reads the part of a photograph inside `window`, in the coordinates of the window; `None` where there is none.
    pub(crate) fn crop(&self, index: usize, window: Bounds) -> Result<Option<WarpedPhoto<T>>, StreamError> {
        let Some(Some((bounds, at))) = self.places.get(index).copied() else { return Ok(None) };
        let Some(part) = bounds.intersection(&window) else { return Ok(None) };
        let pixel = 4 * size_of::<T>();
        let (stride, row) = (bounds.width() * pixel, part.width() * pixel);
        let at = at + ((part.top - bounds.top) * stride + (part.left - bounds.left) * pixel) as u64;
        let mut pixels = Image::<T, 4>::new(part.width(), part.height(), [T::default(); 4]);
        T::fill_from_bytes(pixels.as_mut_slice(), |bytes| self.scratch.read_rows(at, stride, row, bytes))?;
        Ok(Some(WarpedPhoto { bounds: part.relative_to(&window), pixels }))
    }

    /// Reads the parts of all photographs inside `window`, as [`Self::crop`].
    pub(crate) fn crops(&self, window: Bounds) -> Result<Vec<Option<WarpedPhoto<T>>>, StreamError> {
        (0..self.places.len()).map(|index| self.crop(index, window)).collect()
    }
}
