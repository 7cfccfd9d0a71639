//! NumPy array files, `.npy` versions 1 to 3.

use std::path::Path;

use cv_core::{GrayF32, Image, ImageView};

use crate::files::{read_bytes, write_bytes};
use crate::{FormatError, IoError, ReadOptions, memory};

const NAME: &str = "npy";
const MAGIC: &[u8] = b"\x93NUMPY";
/// Maximum number of elements: the samples of the largest color image.
const MAX_ELEMENTS: u64 = 3 * crate::DEFAULT_MAX_PIXELS;
/// Maximum length of an axis of an array without values, so that loops over its rows stay short; real arrays are far below.
pub(crate) const MAX_EMPTY_SIDE: u64 = 65_535;

/// The values of an array, in C order.
#[derive(Debug, Clone, PartialEq)]
#[non_exhaustive]
#[allow(missing_docs)] // each names its own type
pub enum NpyData {
    Bool(Vec<bool>),
    U8(Vec<u8>),
    I8(Vec<i8>),
    U16(Vec<u16>),
    I16(Vec<i16>),
    U32(Vec<u32>),
    I32(Vec<i32>),
    U64(Vec<u64>),
    I64(Vec<i64>),
    F32(Vec<f32>),
    F64(Vec<f64>),
}

/// An array and its shape.
#[derive(Debug, Clone, PartialEq)]
pub struct NpyArray {
    /// Sizes of the axes, slowest first. Empty for a scalar.
    pub shape: Vec<usize>,
    /// The values, last axis fastest.
    pub data: NpyData,
}

macro_rules! each {
    ($data:expr, $v:ident => $body:expr) => {
        match $data {
            NpyData::Bool($v) => $body,
            NpyData::U8($v) => $body,
            NpyData::I8($v) => $body,
            NpyData::U16($v) => $body,
            NpyData::I16($v) => $body,
            NpyData::U32($v) => $body,
            NpyData::I32($v) => $body,
            NpyData::U64($v) => $body,
            NpyData::I64($v) => $body,
            NpyData::F32($v) => $body,
            NpyData::F64($v) => $body,
        }
    };
}

impl NpyArray {
    /// Converts an image to an array of height × width, or height × width × channels where there are several.
    pub fn from_view<const C: usize>(view: ImageView<'_, f32, C>) -> Self {
        let mut shape = vec![view.height(), view.width()];
        if C != 1 {
            shape.push(C);
        }
        let data = (0..view.height()).flat_map(|y| view.row(y)).copied().collect();
        Self { shape, data: NpyData::F32(data) }
    }

    /// Converts rows of `f64` to a two-dimensional array.
    pub fn from_rows<const N: usize>(rows: &[[f64; N]]) -> Self {
        Self { shape: vec![rows.len(), N], data: NpyData::F64(rows.as_flattened().to_vec()) }
    }

    /// Returns the number of values.
    pub fn len(&self) -> usize {
        each!(&self.data, v => v.len())
    }

    /// Whether there are no values.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Converts all values to `f64`; 64-bit integers beyond 2⁵³ are rounded.
    pub fn to_f64(&self) -> Vec<f64> {
        match &self.data {
            NpyData::Bool(v) => v.iter().map(|&b| f64::from(u8::from(b))).collect(),
            NpyData::U8(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::I8(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::U16(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::I16(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::U32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::I32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::U64(v) => v.iter().map(|&x| x as f64).collect(),
            NpyData::I64(v) => v.iter().map(|&x| x as f64).collect(),
            NpyData::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            NpyData::F64(v) => v.clone(),
        }
    }

    /// Converts the array to an image of one channel: height × width, or height × width × 1.
    ///
    /// # Errors
    /// [`FormatError::Unsupported`] for another shape.
    pub fn to_gray(&self) -> Result<GrayF32, FormatError> {
        let (width, height) = self.gray_size()?;
        let data = match &self.data {
            NpyData::F32(v) => v.clone(),
            _ => each!(&self.data, v => v.iter().map(|&v| v.to_f32()).collect()),
        };
        Image::from_vec(width, height, data).map_err(|e| FormatError::corrupt(NAME, e.to_string()))
    }

    /// As [`NpyArray::to_gray`], without a copy for `f32`.
    ///
    /// # Errors
    /// As [`NpyArray::to_gray`].
    pub fn into_gray(self) -> Result<GrayF32, FormatError> {
        let (width, height) = self.gray_size()?;
        let data = match self.data {
            NpyData::F32(v) => v,
            other => each!(&other, v => v.iter().map(|&v| v.to_f32()).collect()),
        };
        Image::from_vec(width, height, data).map_err(|e| FormatError::corrupt(NAME, e.to_string()))
    }

    /// Returns width and height of the array as one channel.
    fn gray_size(&self) -> Result<(usize, usize), FormatError> {
        match self.shape[..] {
            [height, width] | [height, width, 1] => Ok((width, height)),
            _ => {
                let what = format!("an array of shape {:?} as one channel", self.shape);
                Err(FormatError::unsupported(NAME, what))
            }
        }
    }
}

/// Conversion to `f32` via `f64`.
trait ToF32: Copy {
    fn to_f32(self) -> f32;
}

macro_rules! to_f32 {
    ($($type:ty),*) => {
        $(impl ToF32 for $type {
            fn to_f32(self) -> f32 {
                self as f64 as f32
            }
        })*
    };
}
to_f32!(u8, i8, u16, i16, u32, i32, u64, i64, f32, f64);

impl ToF32 for bool {
    fn to_f32(self) -> f32 {
        f32::from(u8::from(self))
    }
}

/// Decodes the bytes of an `.npy` file.
///
/// # Errors
/// [`FormatError`]: not an `.npy` file, a dtype that is not a plain number, or a byte count that does not match the shape.
pub fn decode(bytes: &[u8]) -> Result<NpyArray, FormatError> {
    decode_with(bytes, &ReadOptions::default())
}

/// As [`decode`], with options.
///
/// # Errors
/// As [`decode`], and [`FormatError::TooMuchMemory`].
pub fn decode_with(bytes: &[u8], options: &ReadOptions) -> Result<NpyArray, FormatError> {
    let corrupt = |reason: &str| FormatError::corrupt(NAME, reason);
    let (Header { dtype, fortran, shape }, body) = header(bytes)?;
    let cut = || FormatError::Truncated { format: NAME };
    let count =
        shape.iter().try_fold(1u64, |n, &s| n.checked_mul(s as u64)).filter(|&n| n <= MAX_ELEMENTS).ok_or_else(
            || FormatError::corrupt(NAME, format!("a shape of {shape:?} is more than {MAX_ELEMENTS} values")),
        )? as usize;
    if count == 0 && shape.iter().any(|&side| side as u64 > MAX_EMPTY_SIDE) {
        return Err(FormatError::corrupt(NAME, format!("a shape of {shape:?} has no values")));
    }
    let size = dtype.get(2..).and_then(|size| size.parse::<u64>().ok()).unwrap_or(1);
    // Reordering and conversion need a second copy.
    let copies = if fortran || dtype.ends_with("b1") { 2 } else { 1 };
    let values = memory::saturating_product(&[count as u64, size, copies]);
    memory::check_limit(values.saturating_add(bytes.len() as u64), options.max_memory, None)?;
    let (big_endian, kind) = match dtype.split_at_checked(1) {
        Some(("<" | "|" | "=", kind)) => (false, kind),
        Some((">", kind)) => (true, kind),
        _ => return Err(FormatError::unsupported(NAME, format!("the dtype {dtype}"))),
    };
    macro_rules! values {
        ($variant:ident, $type:ty) => {{
            const SIZE: usize = size_of::<$type>();
            if body.len() < count * SIZE {
                return Err(cut());
            }
            if body.len() > count * SIZE {
                return Err(corrupt("there are more bytes than the shape needs"));
            }
            let cells = body.as_chunks::<SIZE>().0.iter();
            let data: Vec<$type> = if big_endian {
                cells.map(|&b| <$type>::from_be_bytes(b)).collect()
            } else {
                cells.map(|&b| <$type>::from_le_bytes(b)).collect()
            };
            NpyData::$variant(if fortran { to_c_order(&data, &shape) } else { data })
        }};
    }
    let data = match kind {
        "b1" => match values!(U8, u8) {
            NpyData::U8(v) => NpyData::Bool(v.into_iter().map(|b| b != 0).collect()),
            other => other,
        },
        "u1" => values!(U8, u8),
        "i1" => values!(I8, i8),
        "u2" => values!(U16, u16),
        "i2" => values!(I16, i16),
        "u4" => values!(U32, u32),
        "i4" => values!(I32, i32),
        "u8" => values!(U64, u64),
        "i8" => values!(I64, i64),
        "f4" => values!(F32, f32),
        "f8" => values!(F64, f64),
        _ => return Err(FormatError::unsupported(NAME, format!("the dtype {dtype}"))),
    };
    Ok(NpyArray { shape, data })
}

/// Parses the header of a file, and returns the remaining bytes.
fn header(bytes: &[u8]) -> Result<(Header, &[u8]), FormatError> {
    let corrupt = |reason: &str| FormatError::corrupt(NAME, reason);
    let cut = || FormatError::Truncated { format: NAME };
    if !bytes.starts_with(MAGIC) {
        return Err(FormatError::UnknownFormat { expected: "a NumPy array (.npy)" });
    }
    let (start, len) = match *bytes.get(6..12).ok_or_else(cut)? {
        [1, _, a, b, _, _] => (10, usize::from(u16::from_le_bytes([a, b]))),
        [2 | 3, _, a, b, c, d] => (12, u32::from_le_bytes([a, b, c, d]) as usize),
        [major, minor, ..] => return Err(FormatError::unsupported(NAME, format!("version {major}.{minor}"))),
        _ => return Err(cut()),
    };
    let header = bytes.get(start..).and_then(|b| b.get(..len)).ok_or_else(cut)?;
    let header = std::str::from_utf8(header).map_err(|_| corrupt("the header is not text"))?;
    let header = parse_header(header).ok_or_else(|| corrupt("the header does not parse"))?;
    Ok((header, &bytes[start + len..]))
}

/// Parses the shape from a prefix of a file that contains the whole header.
pub(crate) fn shape_of(bytes: &[u8]) -> Result<Vec<usize>, FormatError> {
    header(bytes).map(|(header, _)| header.shape)
}

/// Reorders from Fortran order (first axis fastest) to C order (last axis fastest).
fn to_c_order<T: Copy>(data: &[T], shape: &[usize]) -> Vec<T> {
    let mut strides = Vec::with_capacity(shape.len());
    let mut stride = 1;
    for &size in shape {
        strides.push(stride);
        stride *= size;
    }
    let mut index = vec![0usize; shape.len()];
    let mut at = 0;
    let mut out = Vec::with_capacity(data.len());
    while out.len() < data.len() {
        out.push(data[at]);
        for axis in (0..shape.len()).rev() {
            index[axis] += 1;
            at += strides[axis];
            if index[axis] < shape[axis] {
                break;
            }
            at -= strides[axis] * shape[axis];
            index[axis] = 0;
        }
    }
    out
}

struct Header {
    dtype: String,
    fortran: bool,
    shape: Vec<usize>,
}

/// Parses `{'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), }`, keys in any order.
fn parse_header(text: &str) -> Option<Header> {
    let inner = text.trim().strip_prefix('{')?.trim_end().strip_suffix('}')?;
    let after = |key: &str| {
        let at = inner.find(&format!("'{key}'")).or_else(|| inner.find(&format!("\"{key}\"")))?;
        Some(inner[at + key.len() + 2..].trim_start().strip_prefix(':')?.trim_start())
    };
    let descr = after("descr")?;
    let quote = descr.chars().next().filter(|c| matches!(c, '\'' | '"'))?;
    let dtype = descr[1..].split(quote).next()?.to_owned();
    let fortran = match after("fortran_order")? {
        rest if rest.starts_with("True") => true,
        rest if rest.starts_with("False") => false,
        _ => return None,
    };
    let list = after("shape")?.strip_prefix('(')?.split(')').next()?;
    let mut shape = Vec::new();
    for word in list.split(',').map(str::trim).filter(|w| !w.is_empty()) {
        // Python 2 wrote long integers as 3L.
        shape.push(word.trim_end_matches('L').parse().ok()?);
    }
    (shape.len() <= 32).then_some(Header { dtype, fortran, shape })
}

/// Encodes an array, version 1.0, little-endian, C order.
///
/// # Errors
/// [`FormatError::NotRepresentable`] if the number of values is not that of the shape.
pub fn encode(array: &NpyArray) -> Result<Vec<u8>, FormatError> {
    let count = array.shape.iter().try_fold(1usize, |n, &s| n.checked_mul(s));
    if count != Some(array.len()) || array.shape.len() > 32 {
        let what = format!("{} values in the shape {:?}", array.len(), array.shape);
        return Err(FormatError::NotRepresentable { format: NAME, what });
    }
    let descr = match &array.data {
        NpyData::Bool(_) => "|b1",
        NpyData::U8(_) => "|u1",
        NpyData::I8(_) => "|i1",
        NpyData::U16(_) => "<u2",
        NpyData::I16(_) => "<i2",
        NpyData::U32(_) => "<u4",
        NpyData::I32(_) => "<i4",
        NpyData::U64(_) => "<u8",
        NpyData::I64(_) => "<i8",
        NpyData::F32(_) => "<f4",
        NpyData::F64(_) => "<f8",
    };
    let mut shape = String::new();
    for size in &array.shape {
        shape.push_str(&format!("{size}, "));
    }
    // A tuple of one element needs its trailing comma.
    let shape = if array.shape.len() == 1 { shape.trim_end() } else { shape.trim_end_matches(", ") };
    let mut header = format!("{{'descr': '{descr}', 'fortran_order': False, 'shape': ({shape}), }}");
    // The header ends with a newline and is padded so that values begin at a multiple of 64 bytes.
    let padding = (64 - (10 + header.len() + 1) % 64) % 64;
    header.extend(std::iter::repeat_n(' ', padding));
    header.push('\n');
    let mut bytes = Vec::with_capacity(10 + header.len() + array.len() * 8);
    bytes.extend_from_slice(MAGIC);
    bytes.extend_from_slice(&[1, 0]);
    bytes.extend_from_slice(&(header.len() as u16).to_le_bytes());
    bytes.extend_from_slice(header.as_bytes());
    match &array.data {
        NpyData::Bool(v) => bytes.extend(v.iter().map(|&b| u8::from(b))),
        NpyData::U8(v) => bytes.extend_from_slice(v),
        NpyData::I8(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::U16(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::I16(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::U32(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::I32(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::U64(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::I64(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::F32(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
        NpyData::F64(v) => bytes.extend(v.iter().flat_map(|x| x.to_le_bytes())),
    }
    Ok(bytes)
}

/// Reads an `.npy` file.
///
/// # Errors
/// [`IoError`]: cannot be opened, or as [`decode`].
pub fn read(path: impl AsRef<Path>) -> Result<NpyArray, IoError> {
    let path = path.as_ref();
    decode(&read_bytes(path)?).map_err(|reason| IoError::reading(path, reason))
}

/// Writes an `.npy` file.
///
/// # Errors
/// As [`encode`] and [`crate::write_atomic`].
pub fn write(path: impl AsRef<Path>, array: &NpyArray) -> Result<(), IoError> {
    let path = path.as_ref();
    write_bytes(path, &encode(array).map_err(|reason| IoError::writing(path, reason))?)
}
