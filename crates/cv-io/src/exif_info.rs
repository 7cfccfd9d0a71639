//! EXIF metadata: orientation, focal length, camera model and GPS position.

use crate::sensor_width::sensor_width;
use cv_core::GeodeticPoint;
use exif::{Context, Exif, In, Tag, Value};

/// EXIF metadata of an image that are relevant to geometry.
#[derive(Debug, Clone, PartialEq)]
pub struct ExifInfo {
    /// The orientation tag, 1 to 8; 1 where there is none. Already applied to the pixels.
    pub orientation: u8,
    /// The focal length, where the tags determine it in pixels.
    pub focal: Option<ExifFocal>,
    /// Maker and model, as written.
    pub camera: Option<String>,
    /// GPS position, where both coordinates are given.
    pub gps: Option<ExifGps>,
}

/// GPS position of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExifGps {
    /// Radians, north positive (WGS 84; a tag with another datum is ignored).
    pub latitude: f64,
    /// Radians, east positive.
    pub longitude: f64,
    /// Meters above sea level, or above the ellipsoid by the reference tag of EXIF 3.0; many receivers do not specify it.
    pub altitude: Option<f64>,
    /// Dilution of precision (DOP): factor from the ranging error, some meters, to the position error.
    pub dilution: Option<f64>,
}

impl ExifGps {
    /// Returns the position; a missing altitude is 0.
    pub fn position(&self) -> GeodeticPoint {
        let Self { latitude, longitude, altitude, .. } = *self;
        GeodeticPoint { latitude, longitude, altitude: altitude.unwrap_or(0.0) }
    }
}

/// A focal length in pixels of the decoded image, and its source.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExifFocal {
    /// Focal length in pixels.
    pub pixels: f64,
    /// The tags it comes from.
    pub source: FocalSource,
}

/// The tags a focal length was computed from.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FocalSource {
    /// The focal length in millimeters and the pixels per unit of the sensor (FocalPlaneXResolution). Typically accurate to
    /// 1 %, though focusing near increases the focal length.
    SensorResolution,
    /// The 35 mm equivalent (FocalLengthIn35mmFilm), by equal diagonals (CIPA DCG-001). Rounded to a whole number
    /// of millimeters: an error up to 2 % for a wide lens.
    Equivalent35mm,
    /// The focal length in millimeters and the sensor width of the camera model, from a table. Assumes an uncropped image.
    SensorTable,
}

/// Diagonal of the 36 × 24 mm frame in millimeters.
const DIAGONAL_35MM_FORMAT: f64 = 43.266_615_305_567_87;
/// Plausible sensor widths in millimeters, from mobile phones to larger than full frame.
const SENSOR_WIDTH_RANGE_MM: std::ops::RangeInclusive<f64> = 2.0..=60.0;

impl Default for ExifInfo {
    fn default() -> Self {
        Self { orientation: 1, focal: None, camera: None, gps: None }
    }
}

impl ExifInfo {
    /// Parses the raw EXIF block (TIFF structure) of an image of `width` × `height` stored pixels.
    ///
    /// Damaged blocks are parsed as far as possible; they are never an error.
    pub(crate) fn parse(block: Vec<u8>, width: usize, height: usize) -> Self {
        let mut reader = exif::Reader::new();
        reader.continue_on_error(true);
        let parsed = match reader.read_raw(block) {
            Ok(exif) => Some(exif),
            Err(error) => error.distill_partial_result(|_| ()).ok(),
        };
        let Some(exif) = parsed else { return Self::default() };
        let camera =
            [text(&exif, Tag::Make), text(&exif, Tag::Model)].into_iter().flatten().collect::<Vec<_>>().join(" ");
        let orientation = exif.get_field(Tag::Orientation, In::PRIMARY).and_then(|field| field.value.get_uint(0));
        Self {
            orientation: orientation.filter(|tag| (1..=8).contains(tag)).map_or(1, |tag| tag as u8),
            focal: focal(&exif, width as f64, height as f64),
            camera: (!camera.is_empty()).then_some(camera),
            gps: gps(&exif),
        }
    }
}

/// Whether a TIFF's first image is a preview, as in camera raw files (NEF, ARW, DNG).
pub(crate) fn is_raw_preview(bytes: &[u8]) -> bool {
    const NEW_SUBFILE_TYPE: Tag = Tag(Context::Tiff, 254);
    const DNG_VERSION: Tag = Tag(Context::Tiff, 50706);
    let Ok((fields, _)) = exif::parse_exif(bytes) else { return false };
    let first = |tag| fields.iter().find(|f| f.ifd_num == In::PRIMARY && f.tag == tag);
    first(DNG_VERSION).is_some()
        || first(NEW_SUBFILE_TYPE).and_then(|f| f.value.get_uint(0)).is_some_and(|kind| kind & 1 == 1)
}

fn text(exif: &Exif, tag: Tag) -> Option<String> {
    match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Ascii(lines) => lines.first().map(|line| String::from_utf8_lossy(line).trim().to_owned()),
        _ => None,
    }
}

fn positive_number(exif: &Exif, tag: Tag) -> Option<f64> {
    let value = match &exif.get_field(tag, In::PRIMARY)?.value {
        Value::Rational(v) => v.first()?.to_f64(),
        Value::SRational(v) => v.first()?.to_f64(),
        other => f64::from(other.get_uint(0)?),
    };
    (value.is_finite() && value > 0.0).then_some(value)
}

fn gps(exif: &Exif) -> Option<ExifGps> {
    let altitude = || {
        let Value::Rational(v) = &exif.get_field(Tag::GPSAltitude, In::PRIMARY)?.value else { return None };
        // 1: below sea level, 3: below the ellipsoid (EXIF 3.0).
        let reference = match &exif.get_field(Tag::GPSAltitudeRef, In::PRIMARY).map(|field| &field.value) {
            Some(Value::Byte(bytes)) => bytes.first().copied().unwrap_or(0),
            _ => 0,
        };
        let meters = v.first()?.to_f64() * if matches!(reference, 1 | 3) { -1.0 } else { 1.0 };
        meters.is_finite().then_some(meters)
    };
    Some(ExifGps {
        latitude: coordinate(exif, Tag::GPSLatitude, Tag::GPSLatitudeRef, ["N", "S"], 90.0)?,
        longitude: coordinate(exif, Tag::GPSLongitude, Tag::GPSLongitudeRef, ["E", "W"], 180.0)?,
        altitude: altitude(),
        dilution: positive_number(exif, Tag::GPSDOP),
    })
}

/// Reads degrees, minutes and seconds as radians, signed by the hemisphere tag `reference`; `None` where that is missing, or beyond `max_degrees`.
fn coordinate(exif: &Exif, tag: Tag, reference: Tag, [plus, minus]: [&str; 2], max_degrees: f64) -> Option<f64> {
    let Value::Rational(parts) = &exif.get_field(tag, In::PRIMARY)?.value else { return None };
    let reference = text(exif, reference)?;
    let sign = if reference.eq_ignore_ascii_case(plus) {
        1.0
    } else if reference.eq_ignore_ascii_case(minus) {
        -1.0
    } else {
        return None;
    };
    // Cameras omit seconds, or write 0/0 (NaN) without a fix, which fails the comparison below.
    let [degrees, rest @ ..] = &parts[..] else { return None };
    let degrees =
        rest.iter().take(2).zip([60.0, 3600.0]).fold(degrees.to_f64(), |sum, (v, unit)| sum + v.to_f64() / unit);
    (degrees <= max_degrees).then(|| (sign * degrees).to_radians())
}

fn focal(exif: &Exif, width: f64, height: f64) -> Option<ExifFocal> {
    if width < 1.0 || height < 1.0 {
        return None;
    }
    let by_diagonal =
        positive_number(exif, Tag::FocalLengthIn35mmFilm).map(|mm| mm * width.hypot(height) / DIAGONAL_35MM_FORMAT);
    let by_sensor = sensor_focal(exif, width);
    // Where the two disagree by far more than the rounding of the equivalent, the resolution tag is wrong: some cameras write that of
    // another image.
    match (by_sensor, by_diagonal) {
        (Some(sensor), Some(diagonal)) if (sensor / diagonal).ln().abs() > 0.15 => {
            Some(ExifFocal { pixels: diagonal, source: FocalSource::Equivalent35mm })
        }
        (Some(pixels), _) => Some(ExifFocal { pixels, source: FocalSource::SensorResolution }),
        (None, Some(pixels)) => Some(ExifFocal { pixels, source: FocalSource::Equivalent35mm }),
        (None, None) => {
            let pixels =
                positive_number(exif, Tag::FocalLength)? / sensor_width(&text(exif, Tag::Model)?)? * width.max(height);
            Some(ExifFocal { pixels, source: FocalSource::SensorTable })
        }
    }
}

fn sensor_focal(exif: &Exif, width: f64) -> Option<f64> {
    let mm = positive_number(exif, Tag::FocalLength)?;
    let resolution = positive_number(exif, Tag::FocalPlaneXResolution)?;
    let unit_mm = match exif.get_field(Tag::FocalPlaneResolutionUnit, In::PRIMARY).and_then(|f| f.value.get_uint(0)) {
        Some(3) => 10.0,
        Some(4) => 1.0,
        Some(5) => 0.001,
        // Inches, which is also the tag's default.
        _ => 25.4,
    };
    let per_mm = resolution / unit_mm;
    // The resolution is that of the original image, which may have been resized since.
    let original_width = positive_number(exif, Tag::PixelXDimension).unwrap_or(width);
    SENSOR_WIDTH_RANGE_MM.contains(&(original_width / per_mm)).then_some(mm * per_mm * width / original_width)
}
