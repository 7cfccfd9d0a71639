//! Conversion of arrays to images and of results to arrays, without copies.

use crate::errors::of_argument;
use cv_core::{GrayF32, Image, ImageView, Mask, Sample};
use numpy::{
    Element, IxDyn, PyArray, PyArray1, PyArrayDescrMethods, PyArrayDyn, PyArrayMethods, PyReadonlyArrayDyn,
    PyUntypedArray, PyUntypedArrayMethods, dtype,
};
use pyo3::exceptions::{PyTypeError, PyValueError};
use pyo3::prelude::*;
use pyo3::sync::PyOnceLock;
use serde_json::json;

/// An image borrowed from its array, or from a contiguous copy if its pixels are not contiguous.
pub(crate) enum ImageArg<'py> {
    U8(Borrowed<'py, u8>),
    U16(Borrowed<'py, u16>),
    F32(Borrowed<'py, f32>),
}

/// A borrowed array of an image.
pub(crate) struct Borrowed<'py, T: Element> {
    array: PyReadonlyArrayDyn<'py, T>,
    width: usize,
    height: usize,
    channels: usize,
    /// Row stride in samples.
    stride: usize,
    copied: bool,
}

impl<'py, T: Element + Sample> Borrowed<'py, T> {
    /// Returns a view with `C` channels; `None` if the image has another number.
    pub(crate) fn view<const C: usize>(&self) -> Option<ImageView<'_, T, C>> {
        if self.channels != C {
            return None;
        }
        ImageView::from_slice(self.array.as_slice().ok()?, self.width, self.height, self.stride)
    }
}

/// Evaluates an expression with the views of two gray or color images, instantiated for 8 and 16 bits and floats.
#[macro_export]
macro_rules! with_views {
    ($py:expr, [$a:expr, $b:expr], |$x:ident, $y:ident| $body:expr) => {{
        use $crate::arrays::ImageArg;
        macro_rules! both {
            ($one:expr, $two:expr) => {
                match ($one.view::<1>(), $two.view::<1>(), $one.view::<3>(), $two.view::<3>()) {
                    (Some($x), Some($y), ..) => $body,
                    (.., Some($x), Some($y)) => $body,
                    _ => Err($crate::arrays::image_mismatch($py, &$a, &$b)),
                }
            };
        }
        match (&$a, &$b) {
            (ImageArg::U8(one), ImageArg::U8(two)) => both!(one, two),
            (ImageArg::U16(one), ImageArg::U16(two)) => both!(one, two),
            (ImageArg::F32(one), ImageArg::F32(two)) => both!(one, two),
            _ => Err($crate::arrays::image_mismatch($py, &$a, &$b)),
        }
    }};
}

/// As [`with_views`], for one image.
#[macro_export]
macro_rules! with_view {
    ($image:expr, |$x:ident| $body:expr) => {{
        use $crate::arrays::ImageArg;
        macro_rules! one {
            ($borrowed:expr) => {
                match ($borrowed.view::<1>(), $borrowed.view::<3>()) {
                    (Some($x), _) => $body,
                    (_, Some($x)) => $body,
                    _ => Err($crate::errors::internal("the image is neither gray nor color")),
                }
            };
        }
        match &$image {
            ImageArg::U8(borrowed) => one!(borrowed),
            ImageArg::U16(borrowed) => one!(borrowed),
            ImageArg::F32(borrowed) => one!(borrowed),
        }
    }};
}

impl<'py> ImageArg<'py> {
    /// Borrows an array of shape (height, width) or (height, width, 1 or 3), or an object with `__array__` or `__dlpack__`. `what` is its name in errors.
    pub(crate) fn new(given: &Bound<'py, PyAny>, what: &str) -> PyResult<Self> {
        let array = untyped(given, what)?;
        let kind = array.dtype();
        let py = given.py();
        if kind.is_equiv_to(&dtype::<u8>(py)) {
            Ok(Self::U8(borrow(&array, what)?))
        } else if kind.is_equiv_to(&dtype::<u16>(py)) {
            Ok(Self::U16(borrow(&array, what)?))
        } else if kind.is_equiv_to(&dtype::<f32>(py)) {
            Ok(Self::F32(borrow(&array, what)?))
        } else {
            let text = format!(
                "{what}: dtype {kind} is none of uint8, uint16, float32; convert it, as in image.astype(np.uint8)"
            );
            Err(PyTypeError::new_err(text))
        }
    }

    /// Returns width, height and channels.
    pub(crate) fn shape(&self) -> (usize, usize, usize) {
        match self {
            Self::U8(b) => (b.width, b.height, b.channels),
            Self::U16(b) => (b.width, b.height, b.channels),
            Self::F32(b) => (b.width, b.height, b.channels),
        }
    }

    pub(crate) fn kind(&self) -> &'static str {
        match self {
            Self::U8(_) => "uint8",
            Self::U16(_) => "uint16",
            Self::F32(_) => "float32",
        }
    }
}

/// A color image (8 bits by default): borrowed, or converted from gray.
pub(crate) enum Rgb<'py, T: Element = u8> {
    Borrowed(Borrowed<'py, T>),
    Made(Image<T, 3>),
}

impl<'py> Rgb<'py> {
    /// Borrows an 8-bit array, converting gray to color. Other types are refused: the caller must scale them.
    pub(crate) fn new(given: &Bound<'py, PyAny>, what: &str) -> PyResult<Self> {
        match ImageArg::new(given, what)? {
            ImageArg::U8(borrowed) => Self::of(given.py(), borrowed),
            other => {
                let text = format!(
                    "{what}: dtype {} where uint8 is needed; scale it to 0 to 255 and use .astype(np.uint8)",
                    other.kind()
                );
                Err(PyTypeError::new_err(text))
            }
        }
    }
}

impl<'py, T: Element + Sample> Rgb<'py, T> {
    /// Converts a borrowed image to color if it is gray.
    pub(crate) fn of(py: Python<'py>, borrowed: Borrowed<'py, T>) -> PyResult<Self> {
        let Some(gray) = borrowed.view::<1>() else { return Ok(Self::Borrowed(borrowed)) };
        let made = Image::from_fn(gray.width(), gray.height(), |x, y| [gray.at(x, y)[0]; 3]);
        // Converting a list of large images may take long.
        py.check_signals()?;
        Ok(Self::Made(made))
    }

    pub(crate) fn view(&self) -> PyResult<ImageView<'_, T, 3>> {
        match self {
            Self::Made(image) => Ok(image.view()),
            Self::Borrowed(borrowed) => {
                borrowed.view().ok_or_else(|| PyValueError::new_err("the image changed its shape"))
            }
        }
    }
}

/// Makes the error of two images of different type or channels.
pub(crate) fn image_mismatch(py: Python<'_>, a: &ImageArg<'_>, b: &ImageArg<'_>) -> PyErr {
    let describe = |image: &ImageArg<'_>| {
        let (width, height, channels) = image.shape();
        (json!([height, width, channels]), format!("{} of shape ({height}, {width}, {channels})", image.kind()))
    };
    let ((left, one), (right, two)) = (describe(a), describe(b));
    of_argument(
        py,
        "ImageMismatch",
        &[("left", left), ("right", right)],
        &format!("one image is {one}, the other {two}"),
    )
}

/// Returns the array of an object.
fn untyped<'py>(given: &Bound<'py, PyAny>, what: &str) -> PyResult<Bound<'py, PyUntypedArray>> {
    if let Ok(array) = given.cast::<PyUntypedArray>() {
        return Ok(array.clone());
    }
    let py = given.py();
    let made = if given.hasattr("__array__")? {
        py.import("numpy")?.call_method1("asarray", (given,))?
    } else if given.hasattr("__dlpack__")? {
        py.import("numpy")?.call_method1("from_dlpack", (given,))?
    } else {
        let kind = given.get_type();
        return Err(PyTypeError::new_err(format!("{what} must be a NumPy array, not {}", kind.name()?)));
    };
    Ok(made.cast_into::<PyUntypedArray>()?)
}

/// Borrows an array as an image.
fn borrow<'py, T: Element + Sample>(array: &Bound<'py, PyUntypedArray>, what: &str) -> PyResult<Borrowed<'py, T>> {
    let shape = array.shape();
    let (height, width, channels) = match *shape {
        [height, width] => (height, width, 1),
        [height, width, channels @ (1 | 3)] => (height, width, channels),
        [_, _, 4] => {
            let text = format!("{what} has 4 channels; drop the alpha channel, as in image[..., :3]");
            return Err(of_shape(array.py(), shape, &text));
        }
        _ => {
            let text = format!("{what} has shape {shape:?}; an image has (height, width) or (height, width, 3)");
            return Err(of_shape(array.py(), shape, &text));
        }
    };
    if width == 0 || height == 0 {
        return Err(of_shape(array.py(), shape, &format!("{what} has no pixels: its shape is {shape:?}")));
    }
    let typed = array.cast::<PyArrayDyn<T>>()?;
    let size = size_of::<T>() as isize;
    let strides = array.strides();
    let row = strides[0];
    let dense = (channels == 1 || strides.get(2).is_none_or(|s| *s == size))
        && (width == 1 || strides[1] == size * channels as isize)
        && row % size == 0
        && row >= size * (width * channels) as isize;
    if typed.is_c_contiguous() {
        return readonly(typed, (width, height, channels), width * channels, false);
    }
    if dense {
        // The span from the first to the last sample belongs to the same array.
        let stride = (row / size) as usize;
        let length = (height - 1) * stride + width * channels;
        let whole = as_strided(array.py())?.call1((typed, (length,), (size,)))?;
        return readonly(whole.cast::<PyArrayDyn<T>>()?, (width, height, channels), stride, false);
    }
    let copy = array.py().import("numpy")?.call_method1("ascontiguousarray", (typed,))?;
    readonly(copy.cast::<PyArrayDyn<T>>()?, (width, height, channels), width * channels, true)
}

fn readonly<'py, T: Element>(
    array: &Bound<'py, PyArrayDyn<T>>,
    (width, height, channels): (usize, usize, usize),
    stride: usize,
    copied: bool,
) -> PyResult<Borrowed<'py, T>> {
    let array = array.try_readonly().map_err(busy)?;
    Ok(Borrowed { array, width, height, channels, stride, copied })
}

fn as_strided(py: Python<'_>) -> PyResult<&Bound<'_, PyAny>> {
    static FUNCTION: PyOnceLock<Py<PyAny>> = PyOnceLock::new();
    FUNCTION.import(py, "numpy.lib.stride_tricks", "as_strided")
}

fn of_shape(py: Python<'_>, shape: &[usize], words: &str) -> PyErr {
    of_argument(py, "Shape", &[("shape", json!(shape))], words)
}

/// Whether an image is used without a copy; otherwise each call copies it. Arrays with contiguous rows are borrowed, including crops and every n-th row; flipped
/// arrays and BGR views of RGB arrays are copied.
///
///     >>> image = np.zeros((60, 80, 3), np.uint8)
///     >>> epipole.is_borrowed(image[10:50, 20:]), epipole.is_borrowed(image[:, ::-1])
///     (True, False)
#[pyfunction]
pub(crate) fn is_borrowed(image: &Bound<'_, PyAny>) -> PyResult<bool> {
    Ok(match ImageArg::new(image, "image")? {
        ImageArg::U8(b) => !b.copied,
        ImageArg::U16(b) => !b.copied,
        ImageArg::F32(b) => !b.copied,
    })
}

/// Converts a mask of bool, or of uint8 with 0 for false.
pub(crate) fn mask(given: &Bound<'_, PyAny>, what: &str) -> PyResult<Mask> {
    let array = untyped(given, what)?;
    let (width, height) = flat_size(&array, what, "a mask")?;
    let values: Vec<bool> = if let Ok(flags) = array.cast::<PyArrayDyn<bool>>() {
        flags.try_readonly().map_err(busy)?.as_array().iter().copied().collect()
    } else if let Ok(bytes) = array.cast::<PyArrayDyn<u8>>() {
        bytes.try_readonly().map_err(busy)?.as_array().iter().map(|v| *v != 0).collect()
    } else {
        return Err(PyTypeError::new_err(format!("{what}: dtype {} is neither bool nor uint8", array.dtype())));
    };
    Mask::from_vec(width, height, values).map_err(|e| PyValueError::new_err(e.to_string()))
}

/// Returns width and height of a two-dimensional array.
fn flat_size(array: &Bound<'_, PyUntypedArray>, what: &str, kind: &str) -> PyResult<(usize, usize)> {
    match *array.shape() {
        [height, width] => Ok((width, height)),
        ref shape => {
            let text = format!("{what} has shape {shape:?}; {kind} has (height, width)");
            Err(of_shape(array.py(), shape, &text))
        }
    }
}

fn busy(_: numpy::BorrowError) -> PyErr {
    PyValueError::new_err("the array is being written to")
}

/// Converts a float32 map, such as a disparity map.
pub(crate) fn map(given: &Bound<'_, PyAny>, what: &str) -> PyResult<GrayF32> {
    let array = untyped(given, what)?;
    let (width, height) = flat_size(&array, what, "a map")?;
    let Ok(floats) = array.cast::<PyArrayDyn<f32>>() else {
        return Err(PyTypeError::new_err(format!("{what}: dtype {} where float32 is needed", array.dtype())));
    };
    let values = floats.try_readonly().map_err(busy)?.as_array().iter().copied().collect();
    GrayF32::from_vec(width, height, values).map_err(|e| PyValueError::new_err(e.to_string()))
}

/// Converts an array-like object of shape (n, N) to rows of floats.
pub(crate) fn rows<const N: usize>(given: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<[f64; N]>> {
    let py = given.py();
    let made = py.import("numpy")?.call_method1("ascontiguousarray", (given, dtype::<f64>(py)))?;
    let array = made.cast::<PyArrayDyn<f64>>()?;
    let shape = array.shape();
    // An empty array may have any width.
    let fits = matches!(*shape, [_, width] if width == N) || array.len() == 0;
    if !fits {
        let text = format!("{what} has shape {shape:?}; it must be (n, {N})");
        return Err(of_shape(py, shape, &text));
    }
    let values = array.try_readonly().map_err(busy)?;
    let slice = values.as_slice().map_err(|_| PyValueError::new_err("the array is not contiguous"))?;
    Ok(slice.as_chunks::<N>().0.to_vec())
}

/// Converts a two-dimensional array-like object to floats, and returns its number of columns.
pub(crate) fn table(given: &Bound<'_, PyAny>, what: &str) -> PyResult<(Vec<f32>, usize)> {
    let py = given.py();
    let made = py.import("numpy")?.call_method1("ascontiguousarray", (given, dtype::<f32>(py)))?;
    let array = made.cast::<PyArrayDyn<f32>>()?;
    let [_, columns] = *array.shape() else {
        let shape = array.shape();
        return Err(of_shape(py, shape, &format!("{what} has shape {shape:?}; it must be (n, columns)")));
    };
    Ok((array.try_readonly().map_err(busy)?.as_array().iter().copied().collect(), columns))
}

/// Converts an array-like object to a flat list of finite floats.
pub(crate) fn numbers(given: &Bound<'_, PyAny>, what: &str) -> PyResult<Vec<f64>> {
    let py = given.py();
    let made = py.import("numpy")?.call_method1("ascontiguousarray", (given, dtype::<f64>(py)))?;
    let array = made.cast::<PyArrayDyn<f64>>()?;
    let values: Vec<f64> = array.try_readonly().map_err(busy)?.as_array().iter().copied().collect();
    match values.iter().position(|v| !v.is_finite()) {
        Some(at) => Err(PyValueError::new_err(format!("{what}: number {at} is not finite"))),
        None => Ok(values),
    }
}

/// Converts an image to an array of shape (height, width) or (height, width, C), without a copy.
pub(crate) fn array<'py, T: Element + Sample, const C: usize>(
    py: Python<'py>,
    image: Image<T, C>,
) -> PyResult<Bound<'py, PyAny>> {
    let (width, height) = image.size();
    let shape: Vec<usize> = if C == 1 { vec![height, width] } else { vec![height, width, C] };
    shaped(py, image.into_vec(), &shape)
}

/// Converts values to an array of a shape, without a copy.
pub(crate) fn shaped<'py, T: Element>(py: Python<'py>, values: Vec<T>, shape: &[usize]) -> PyResult<Bound<'py, PyAny>> {
    let flat: Bound<'py, PyArray1<T>> = PyArray::from_vec(py, values);
    Ok(flat.reshape(IxDyn(shape))?.into_any())
}

/// Converts rows to an array of shape (n, N).
pub(crate) fn row_array<'py, T: Element + Copy, const N: usize>(
    py: Python<'py>,
    rows: &[[T; N]],
) -> PyResult<Bound<'py, PyAny>> {
    shaped(py, rows.as_flattened().to_vec(), &[rows.len(), N])
}

/// Converts a matrix to an array of shape (3, 3).
pub(crate) fn matrix<'py>(py: Python<'py>, m: &cv_core::Matrix3<f64>) -> PyResult<Bound<'py, PyAny>> {
    shaped(py, m.transpose().as_slice().to_vec(), &[3, 3])
}

/// Converts a vector to an array of shape (3,).
pub(crate) fn vector<'py>(py: Python<'py>, v: &cv_core::Vector3<f64>) -> PyResult<Bound<'py, PyAny>> {
    shaped(py, v.as_slice().to_vec(), &[3])
}

/// Converts an array-like object to a 3×3 matrix.
pub(crate) fn matrix_from(given: &Bound<'_, PyAny>, what: &str) -> PyResult<cv_core::Matrix3<f64>> {
    let rows: Vec<[f64; 3]> = rows(given, what)?;
    if rows.len() != 3 {
        return Err(of_shape(given.py(), &[rows.len(), 3], &format!("{what} must be a 3×3 matrix")));
    }
    Ok(cv_core::Matrix3::from_row_slice(rows.as_flattened()))
}
