//! Calibrated cameras and rigs, and their files.

use crate::arrays;
use crate::errors::{of_file, refused};
use cv_core::{Camera, Distortion, DistortionModel, Matrix3, Point2, Point3, Pose, Rotation3, StereoRig};
use cv_io::{CalibrationFormat, FormatError, IoError, RigFile};
use pyo3::exceptions::PyValueError;
use pyo3::prelude::*;
use pyo3::types::PyTuple;
use std::path::PathBuf;

/// A camera: image size, calibration matrix, distortion.
///
/// width, height: px. matrix: K, 3×3, pixel centers at integers. distortion: the coefficients in OpenCV's order. lens: the distortion model: none, simple_radial (1 coefficient), radial (2),
/// radial_tangential4, radial_tangential5, rational8, thin_prism12 or fisheye4; by default, it is selected by the number of coefficients, with 4 for OpenCV's k1, k2, p1, p2.
///
///     >>> camera = epipole.Camera(640, 480, [[500, 0, 320], [0, 500, 240], [0, 0, 1]], [-0.1, 0.01, 0, 0])
///     >>> camera
///     Camera(640×480 px, focal 500.00 500.00, center 320.00 240.00, radial_tangential4 -0.1000 0.0100 0.0000 0.0000)
///     >>> camera.project([[0.0, 0.0, 2.0]])
///     array([[320., 240.]])
#[pyclass(frozen, module = "epipole", name = "Camera")]
pub(crate) struct PyCamera {
    pub(crate) camera: Camera,
}

impl PyCamera {
    pub(crate) fn object(py: Python<'_>, camera: Camera) -> PyResult<Bound<'_, PyAny>> {
        Ok(Bound::new(py, Self { camera })?.into_any())
    }
}

#[pymethods]
impl PyCamera {
    #[new]
    #[pyo3(signature = (width, height, matrix, distortion = None, lens = None))]
    fn new(
        py: Python<'_>,
        width: usize,
        height: usize,
        matrix: &Bound<'_, PyAny>,
        distortion: Option<&Bound<'_, PyAny>>,
        lens: Option<&str>,
    ) -> PyResult<Self> {
        let m = arrays::matrix_from(matrix, "matrix")?;
        // Skew is not supported; a scaled or transposed matrix is an error.
        if m != Matrix3::new(m.m11, 0.0, m.m13, 0.0, m.m22, m.m23, 0.0, 0.0, 1.0) {
            return Err(PyValueError::new_err("matrix must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]"));
        }
        let given = distortion.map_or(Ok(Vec::new()), |given| arrays::numbers(given, "distortion"))?;
        let camera = Camera {
            distortion: distortion_from(lens, &given)?,
            ..Camera::pinhole(width, height, m.m11, m.m22, m.m13, m.m23)
        };
        Self::valid(py, camera)
    }

    /// Makes a camera with square pixels, a centered principal point and no distortion. focal: px.
    #[staticmethod]
    fn from_focal(py: Python<'_>, width: usize, height: usize, focal: f64) -> PyResult<Self> {
        Self::valid(py, Camera::from_focal(width, height, focal))
    }

    /// Reads a camera: our own YAML, OpenCV's YAML, XML or JSON, ROS's camera_info, Kalibr's camchain, COLMAP's cameras.txt, mrcal's .cameramodel, or a bare matrix. size: width and
    /// height for files without them.
    #[staticmethod]
    #[pyo3(signature = (path, *, size = None))]
    fn read(py: Python<'_>, path: PathBuf, size: Option<(usize, usize)>) -> PyResult<Self> {
        let camera = cv_io::read_camera(&path, size).map_err(|error| of_file(py, &error))?;
        Ok(Self { camera })
    }

    /// Writes the camera, by default in our YAML format; other formats are those of `cv calibration convert`.
    #[pyo3(signature = (path, *, format = "own"))]
    fn write(&self, py: Python<'_>, path: PathBuf, format: &str) -> PyResult<()> {
        write_text(py, path, format_named(format)?.camera_text(&self.camera, &[]))
    }

    #[getter]
    fn width(&self) -> usize {
        self.camera.width
    }

    #[getter]
    fn height(&self) -> usize {
        self.camera.height
    }

    /// The calibration matrix K, 3×3.
    #[getter]
    fn matrix<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::matrix(py, &self.camera.matrix())
    }

    /// The distortion coefficients, in OpenCV's order.
    #[getter]
    fn distortion<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        let parameters = self.camera.distortion.parameters();
        arrays::shaped(py, parameters.to_vec(), &[parameters.len()])
    }

    /// The name of the distortion model.
    #[getter]
    fn lens(&self) -> &'static str {
        self.camera.distortion.model().info().name
    }

    /// Projects points (n, 3) in the camera's frame to pixels (n, 2); NaN for points behind the camera.
    fn project<'py>(&self, py: Python<'py>, points: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.each(py, &arrays::rows(points, "points")?, |camera, p: &[f64; 3]| {
            camera.project(&Point3::from(*p)).map_or([f64::NAN; 2], |pixel| pixel.coords.into())
        })
    }

    /// Converts pixels (n, 2) to normalized image coordinates: X/Z and Y/Z, without distortion.
    fn normalize<'py>(&self, py: Python<'py>, pixels: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.each(py, &arrays::rows(pixels, "pixels")?, |camera, p: &[f64; 2]| {
            camera.normalize(Point2::from(*p)).coords.into()
        })
    }

    /// Undistorts pixels (n, 2): their positions in the same camera without distortion.
    fn undistort_points<'py>(&self, py: Python<'py>, pixels: &Bound<'py, PyAny>) -> PyResult<Bound<'py, PyAny>> {
        self.each(py, &arrays::rows(pixels, "pixels")?, |camera, p: &[f64; 2]| {
            camera.undistort_pixel(Point2::from(*p)).coords.into()
        })
    }

    /// Returns the camera of resized images.
    fn resized(&self, py: Python<'_>, width: usize, height: usize) -> PyResult<Self> {
        Self::valid(py, self.camera.resized(width, height))
    }

    fn __repr__(&self) -> String {
        let Camera { width, height, fx, fy, cx, cy, .. } = self.camera;
        let parameters: Vec<String> = self.camera.distortion.parameters().iter().map(|p| format!("{p:.4}")).collect();
        let lens = match parameters.as_slice() {
            [] => "no distortion".to_owned(),
            some => format!("{} {}", self.lens(), some.join(" ")),
        };
        format!("Camera({width}×{height} px, focal {fx:.2} {fy:.2}, center {cx:.2} {cy:.2}, {lens})")
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|other| other.get().camera == self.camera)
    }

    fn __hash__(&self) -> u64 {
        let bits = self.camera.intrinsics().iter().fold(0u64, |h, v| h.rotate_left(7) ^ v.to_bits());
        bits ^ ((self.camera.width as u64) << 32 | self.camera.height as u64)
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let (py, camera) = (slf.py(), slf.get());
        let arguments =
            (camera.camera.width, camera.camera.height, camera.matrix(py)?, camera.distortion(py)?, camera.lens());
        Ok((py.get_type::<Self>().into_any(), arguments.into_pyobject(py)?))
    }
}

impl PyCamera {
    fn valid(py: Python<'_>, camera: Camera) -> PyResult<Self> {
        camera.validate().map_err(|error| refused(py, &error))?;
        Ok(Self { camera })
    }

    fn each<'py, const N: usize>(
        &self,
        py: Python<'py>,
        points: &[[f64; N]],
        one: impl Fn(&Camera, &[f64; N]) -> [f64; 2] + Send + Sync,
    ) -> PyResult<Bound<'py, PyAny>> {
        let found: Vec<[f64; 2]> = py.detach(|| points.iter().map(|p| one(&self.camera, p)).collect());
        arrays::row_array(py, &found)
    }
}

/// Makes a distortion of a named model, or of the model with that number of coefficients.
fn distortion_from(lens: Option<&str>, given: &[f64]) -> PyResult<Distortion> {
    let model = match (lens, given.len()) {
        (Some(name), _) => DistortionModel::from_name(&name.replace('-', "_")).ok_or_else(|| {
            let names: Vec<&str> = DistortionModel::ALL.iter().map(|model| model.info().name).collect();
            PyValueError::new_err(format!("lens: “{name}” is none of {}", names.join(", ")))
        })?,
        (None, 0) => DistortionModel::None,
        (None, 1) => DistortionModel::SimpleRadial,
        (None, 2) => DistortionModel::Radial,
        (None, 4) => DistortionModel::RadialTangential4,
        (None, 5) => DistortionModel::RadialTangential5,
        (None, 8) => DistortionModel::Rational8,
        (None, 12) => DistortionModel::ThinPrism12,
        (None, n) => {
            return Err(PyValueError::new_err(format!(
                "distortion has {n} coefficients, and no model has that number"
            )));
        }
    };
    Distortion::new(model, given).map_err(|error| PyValueError::new_err(error.to_string()))
}

/// Writes a calibration, unless the format cannot represent it.
fn write_text(py: Python<'_>, path: PathBuf, text: Result<String, FormatError>) -> PyResult<()> {
    let written = match text {
        Ok(text) => cv_io::write_bytes(&path, text.as_bytes()),
        Err(reason) => Err(IoError { path, writing: true, reason }),
    };
    written.map_err(|error| of_file(py, &error))
}

fn format_named(name: &str) -> PyResult<CalibrationFormat> {
    CalibrationFormat::from_name(name).ok_or_else(|| {
        let names: Vec<&str> = CalibrationFormat::all().map(CalibrationFormat::name).collect();
        PyValueError::new_err(format!("format: “{name}” is none of {}", names.join(", ")))
    })
}

/// A stereo rig: two rigidly mounted cameras.
///
/// rotation, translation: from the left camera's frame to the right one's, as in OpenCV's stereoCalibrate. unit: unit of the translation and of depths.
#[pyclass(frozen, module = "epipole", name = "Rig")]
pub(crate) struct PyRig {
    pub(crate) rig: StereoRig,
    unit: String,
}

impl PyRig {
    pub(crate) fn object(py: Python<'_>, rig: StereoRig, unit: String) -> PyResult<Bound<'_, PyAny>> {
        Ok(Bound::new(py, Self { rig, unit })?.into_any())
    }
}

#[pymethods]
impl PyRig {
    #[new]
    #[pyo3(signature = (left, right, rotation, translation, unit = ""))]
    fn new(
        left: &Bound<'_, PyCamera>,
        right: &Bound<'_, PyCamera>,
        rotation: &Bound<'_, PyAny>,
        translation: &Bound<'_, PyAny>,
        unit: &str,
    ) -> PyResult<Self> {
        let pose = pose_from(rotation, translation)?;
        let rig = StereoRig { left: left.get().camera, right: right.get().camera, right_from_left: pose };
        if !(rig.baseline() > 0.0 && rig.baseline().is_finite()) {
            return Err(PyValueError::new_err("translation must not be zero"));
        }
        Ok(Self { rig, unit: unit.to_owned() })
    }

    /// Reads a rig: our own YAML, OpenCV's in one file or in two, or the first two cameras of Kalibr's camchain. path: the file, or OpenCV's two. size: width and height for files
    /// without them.
    #[staticmethod]
    #[pyo3(signature = (path, *, size = None))]
    fn read(py: Python<'_>, path: &Bound<'_, PyAny>, size: Option<(usize, usize)>) -> PyResult<Self> {
        let paths: Vec<PathBuf> = match path.extract::<PathBuf>() {
            Ok(one) => vec![one],
            Err(_) => path.extract()?,
        };
        let (file, _) = cv_io::read_rig_with_notes(&paths, size).map_err(|error| of_file(py, &error))?;
        Ok(Self { rig: file.rig, unit: file.unit })
    }

    /// Writes the rig, by default in our YAML format; other formats are those of `cv calibration convert`.
    #[pyo3(signature = (path, *, format = "own"))]
    fn write(&self, py: Python<'_>, path: PathBuf, format: &str) -> PyResult<()> {
        let file = RigFile { rig: self.rig, unit: self.unit.clone() };
        write_text(py, path, format_named(format)?.rig_text(&file, &[]))
    }

    #[getter]
    fn left(&self) -> PyCamera {
        PyCamera { camera: self.rig.left }
    }

    #[getter]
    fn right(&self) -> PyCamera {
        PyCamera { camera: self.rig.right }
    }

    /// R in x_right = R x_left + t, 3×3.
    #[getter]
    fn rotation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::matrix(py, self.rig.right_from_left.rotation.matrix())
    }

    /// t in x_right = R x_left + t.
    #[getter]
    fn translation<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyAny>> {
        arrays::vector(py, &self.rig.right_from_left.translation)
    }

    /// Distance between the cameras, in the rig's unit.
    #[getter]
    fn baseline(&self) -> f64 {
        self.rig.baseline()
    }

    /// Unit of the translation: m, mm, squares; empty if unknown.
    #[getter]
    fn unit(&self) -> &str {
        &self.unit
    }

    /// Returns the rig with its cameras exchanged.
    fn exchanged(&self) -> Self {
        Self { rig: self.rig.exchanged(), unit: self.unit.clone() }
    }

    fn __repr__(&self) -> String {
        let (l, r) = (&self.rig.left, &self.rig.right);
        let (baseline, unit) = (self.rig.baseline(), &self.unit);
        format!(
            "Rig({}×{} px, {}×{} px, baseline {baseline:.6}{}{unit})",
            l.width,
            l.height,
            r.width,
            r.height,
            if unit.is_empty() { "" } else { " " }
        )
    }

    fn __eq__(&self, other: &Bound<'_, PyAny>) -> bool {
        other.cast::<Self>().is_ok_and(|other| other.get().rig == self.rig && other.get().unit == self.unit)
    }

    fn __reduce__<'py>(slf: &Bound<'py, Self>) -> PyResult<(Bound<'py, PyAny>, Bound<'py, PyTuple>)> {
        let (py, rig) = (slf.py(), slf.get());
        let arguments = (rig.left(), rig.right(), rig.rotation(py)?, rig.translation(py)?, rig.unit.clone());
        Ok((py.get_type::<Self>().into_any(), arguments.into_pyobject(py)?))
    }
}

/// Makes a pose from a rotation matrix and a translation.
pub(crate) fn pose_from(rotation: &Bound<'_, PyAny>, translation: &Bound<'_, PyAny>) -> PyResult<Pose> {
    let r = arrays::matrix_from(rotation, "rotation")?;
    let t = arrays::numbers(translation, "translation")?;
    let [x, y, z] = t[..] else {
        return Err(PyValueError::new_err(format!("translation has {} numbers, not 3", t.len())));
    };
    // The tolerance of calibration files; with six digits, a rotation is orthogonal to 1e-5.
    let off = (r * r.transpose() - Matrix3::identity()).abs().max();
    if off.is_nan() || off > 1e-3 || r.determinant() < 0.0 || ![x, y, z].iter().all(|v| v.is_finite()) {
        return Err(PyValueError::new_err(format!(
            "rotation is not a rotation matrix: R Rᵀ differs from the identity by {off:.1e}"
        )));
    }
    Ok(Pose::new(Rotation3::from_matrix_unchecked(r), cv_core::Vector3::new(x, y, z)))
}
