//! Serializable registrations: the poses and intrinsics of a set of photographs, for further photographs of the same cameras.

mod pto;

pub use pto::{Pto, PtoError};

use crate::align::{AlignedPair, Alignment, CameraMotion, Unplaced, View};
use cv_core::{Camera, CameraError, Correspondence, Distortion, DistortionModel, Matrix3, Named, OptionError};
use serde::{Deserialize, Serialize};

/// Version of the serialized form.
const SCHEMA: u32 = 1;
/// Maximum side of a photograph in pixels.
const MAX_SIDE_PX: usize = 1_000_000;
/// Tolerance on the entries of `R Rᵀ − I`: allows for rotations rounded to eight digits.
const ORTHOGONALITY_TOLERANCE: f64 = 1e-6;

/// Poses and intrinsics of a set of photographs: an [`Alignment`] with the sizes and names of all photographs, registered or not.
///
/// Serializes with serde; deserialization validates. It applies to any photographs that the same cameras take from the same position, such as the frames of a rig: the same number, sizes and
/// order. Exposure and local alignment are not included; they are estimated for the photographs that are composited.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(try_from = "RegistrationFile", into = "RegistrationFile")]
pub struct Registration {
    photographs: Vec<Photograph>,
    reference: usize,
    motion: CameraMotion,
    pairs: Vec<AlignedPair>,
    rms_px: f64,
    median_px: f64,
}

#[derive(Debug, Clone, PartialEq)]
struct Photograph {
    name: String,
    size: (usize, usize),
    view: Result<View, Unplaced>,
}

/// Why a registration cannot be used.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum RegistrationError {
    /// Unknown version, or not a registration.
    #[error("a registration of version {}; version {known} is supported", found.map_or_else(|| "unknown".to_owned(), |v| v.to_string()))]
    Schema {
        /// Its version, where it has one.
        found: Option<u64>,
        /// The supported version.
        known: u32,
    },
    /// The number of photographs differs.
    #[error("{got} photographs for a registration of {registered}")]
    Count {
        /// Photographs registered.
        registered: usize,
        /// Number of photographs given.
        got: usize,
    },
    /// The size of a photograph differs.
    #[error("photograph {index} is {width}x{height}; {registered_width}x{registered_height} was registered")]
    Size {
        /// Which.
        index: usize,
        /// Its width.
        width: usize,
        /// Its height.
        height: usize,
        /// The width that was registered.
        registered_width: usize,
        /// The height that was registered.
        registered_height: usize,
    },
    /// No photograph is registered.
    #[error("none of the {photographs} photographs of the registration is registered")]
    Nothing {
        /// Photographs registered.
        photographs: usize,
    },
    /// A parameter is out of range.
    #[error("photograph {index}: {source}")]
    Value {
        /// Which photograph.
        index: usize,
        /// The parameter.
        #[source]
        source: OptionError,
    },
    /// A camera is invalid.
    #[error("photograph {index}: {source}")]
    Camera {
        /// Which photograph.
        index: usize,
        /// Why.
        #[source]
        source: CameraError,
    },
    /// The distortion model is unknown or has another number of parameters.
    #[error("photograph {index}: unknown distortion model, or {parameters} parameters do not fit it")]
    Lens {
        /// Which photograph.
        index: usize,
        /// Number of parameters found.
        parameters: usize,
    },
    /// A matrix is not a rotation, or is singular.
    #[error("the matrix of photograph {index} is not a {}", if *rotation { "rotation" } else { "homography" })]
    Matrix {
        /// Which photograph.
        index: usize,
        /// Whether a rotation was needed.
        rotation: bool,
    },
    /// The indices of a pair, or of the reference, are equal or not registered.
    #[error("photographs {a} and {b} of {photographs} are not a pair of registered photographs")]
    Pair {
        /// First of the pair, or the reference.
        a: usize,
        /// Second of the pair, or the reference.
        b: usize,
        /// Photographs registered.
        photographs: usize,
    },
}

impl Registration {
    /// Creates a registration from an alignment and the sizes and names of all photographs; missing names are empty.
    ///
    /// # Errors
    /// [`RegistrationError`] where the alignment does not fit the sizes.
    pub fn new(alignment: &Alignment, sizes: &[(usize, usize)], names: &[String]) -> Result<Self, RegistrationError> {
        if alignment.views.len() != sizes.len() {
            return Err(RegistrationError::Count { registered: alignment.views.len(), got: sizes.len() });
        }
        let made = Self {
            photographs: (alignment.views.iter().zip(sizes).enumerate())
                .map(|(i, (&view, &size))| Photograph { name: names.get(i).cloned().unwrap_or_default(), size, view })
                .collect(),
            reference: alignment.reference,
            motion: alignment.motion,
            // Indices into the tentative matches are not kept.
            pairs: alignment.pairs.iter().map(|p| AlignedPair { inliers: Vec::new(), ..p.clone() }).collect(),
            rms_px: alignment.rms_px,
            median_px: alignment.median_px,
        };
        made.check()?;
        Ok(made)
    }

    /// Returns the alignment, for [`render`](crate::render).
    pub fn alignment(&self) -> Alignment {
        Alignment {
            views: self.photographs.iter().map(|p| p.view).collect(),
            reference: self.reference,
            motion: self.motion,
            pairs: self.pairs.clone(),
            rms_px: self.rms_px,
            median_px: self.median_px,
        }
    }

    /// Returns the number of photographs, registered or not.
    pub fn photographs(&self) -> usize {
        self.photographs.len()
    }

    /// Returns the name of a photograph; empty where it has none.
    pub fn name(&self, photograph: usize) -> &str {
        self.photographs.get(photograph).map_or("", |p| &p.name)
    }

    /// Checks that photographs have the registered number and sizes.
    ///
    /// # Errors
    /// [`RegistrationError::Count`], [`RegistrationError::Size`].
    pub fn check_photographs(&self, sizes: &[(usize, usize)]) -> Result<(), RegistrationError> {
        if sizes.len() != self.photographs.len() {
            return Err(RegistrationError::Count { registered: self.photographs.len(), got: sizes.len() });
        }
        for (index, (&(width, height), registered)) in sizes.iter().zip(&self.photographs).enumerate() {
            let (registered_width, registered_height) = registered.size;
            if (width, height) != registered.size {
                return Err(RegistrationError::Size { index, width, height, registered_width, registered_height });
            }
        }
        Ok(())
    }

    /// Checks the version of a serialized registration.
    ///
    /// # Errors
    /// [`RegistrationError::Schema`].
    pub fn check_schema(schema: Option<u64>) -> Result<(), RegistrationError> {
        match schema {
            Some(found) if found == u64::from(SCHEMA) => Ok(()),
            found => Err(RegistrationError::Schema { found, known: SCHEMA }),
        }
    }

    /// Validates all parameters.
    fn check(&self) -> Result<(), RegistrationError> {
        let photographs = self.photographs.len();
        if self.photographs.iter().all(|p| p.view.is_err()) {
            return Err(RegistrationError::Nothing { photographs });
        }
        for (index, photograph) in self.photographs.iter().enumerate() {
            photograph.check(index, self.motion)?;
        }
        let placed = |i: usize| self.photographs.get(i).filter(|p| p.view.is_ok());
        if placed(self.reference).is_none() {
            return Err(RegistrationError::Pair { a: self.reference, b: self.reference, photographs });
        }
        let length = |index: usize, name, value: f64| {
            OptionError::check(name, value, "from 0 to a million pixels", |v| (0.0..=1e6).contains(&v))
                .map_err(|source| RegistrationError::Value { index, source })
        };
        for pair in &self.pairs {
            let (Some(a), Some(b), true) = (placed(pair.a), placed(pair.b), pair.a != pair.b) else {
                return Err(RegistrationError::Pair { a: pair.a, b: pair.b, photographs });
            };
            length(pair.a, "rms_px", pair.rms_px)?;
            for m in &pair.matches {
                for (index, p, size) in [(pair.a, m.a, a.size), (pair.b, m.b, b.size)] {
                    for (v, side) in [(p.x, size.0), (p.y, size.1)] {
                        // Features may lie up to half a pixel outside the outer pixel centers.
                        OptionError::check("match", v, "on the photograph", |v| v >= -1.0 && v <= side as f64)
                            .map_err(|source| RegistrationError::Value { index, source })?;
                    }
                }
            }
        }
        length(self.reference, "rms_px", self.rms_px)?;
        length(self.reference, "median_px", self.median_px)
    }
}

impl Photograph {
    fn check(&self, index: usize, motion: CameraMotion) -> Result<(), RegistrationError> {
        let number = |name, value: f64, range, ok: &dyn Fn(f64) -> bool| {
            OptionError::check(name, value, range, ok).map_err(|source| RegistrationError::Value { index, source })
        };
        let (width, height) = self.size;
        for (name, side) in [("width", width), ("height", height)] {
            number(name, side as f64, "from 1 to a million", &|_| (1..=MAX_SIDE_PX).contains(&side))?;
        }
        let Ok(View { camera, from_world }) = &self.view else { return Ok(()) };
        if (camera.width, camera.height) != self.size {
            let (width, height) = (camera.width, camera.height);
            let (registered_width, registered_height) = self.size;
            return Err(RegistrationError::Size { index, width, height, registered_width, registered_height });
        }
        camera.validate().map_err(|source| RegistrationError::Camera { index, source })?;
        let side = width.max(height) as f64;
        for (name, focal) in [("fx", camera.fx), ("fy", camera.fy)] {
            // Fields of view of 179° to 3 arc seconds.
            number(name, focal, "from 0.005 to 100,000 times the longer side", &|f| {
                f >= 0.005 * side && f <= 1e5 * side
            })?;
        }
        for (name, c) in [("cx", camera.cx), ("cy", camera.cy)] {
            number(name, c, "within ten times the longer side", &|c| c.abs() <= 10.0 * side)?;
        }
        for value in camera.distortion.parameters() {
            number("distortion", *value, "within 1000", &|v| v.abs() <= 1000.0)?;
        }
        let rotation = motion == CameraMotion::Rotation;
        let off = (from_world * from_world.transpose() - Matrix3::identity()).amax();
        let fits = if rotation {
            off <= ORTHOGONALITY_TOLERANCE && from_world.determinant() > 0.0
        } else {
            let size = from_world.amax();
            size > 1e-9 && size < 1e9 && (from_world / size).determinant().abs() > 1e-12
        };
        if fits && from_world.iter().all(|v| v.is_finite()) {
            Ok(())
        } else {
            Err(RegistrationError::Matrix { index, rotation })
        }
    }
}

/// Serialized form of a registration.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RegistrationFile {
    schema: u32,
    /// A [`CameraMotion`] by its name: `rotation` or `plane`.
    mode: String,
    /// Index of the reference photograph.
    reference: usize,
    rms_px: f64,
    median_px: f64,
    photographs: Vec<PhotographFile>,
    overlaps: Vec<OverlapFile>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PhotographFile {
    name: String,
    width: usize,
    height: usize,
    /// Missing where the photograph is not registered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    camera: Option<CameraFile>,
    /// World rays to camera rays: the rows of a rotation, or of a homography where the mode is `plane`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    from_world: Option<[[f64; 3]; 3]>,
    /// Why it is not registered.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    left_out: Option<LeftOutFile>,
}

/// In pixels of the photograph.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraFile {
    fx: f64,
    fy: f64,
    cx: f64,
    cy: f64,
    lens: String,
    distortion: Vec<f64>,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
enum LeftOutFile {
    NoOverlap,
    OtherComponent { size: usize },
    Inconsistent,
}

#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OverlapFile {
    a: usize,
    b: usize,
    rms_px: f64,
    /// `x y` in the first photograph and in the second.
    matches: Vec<[f64; 4]>,
}

impl From<Registration> for RegistrationFile {
    fn from(registration: Registration) -> Self {
        let photograph = |p: Photograph| {
            let view = p.view.ok();
            PhotographFile {
                name: p.name,
                width: p.size.0,
                height: p.size.1,
                camera: view.map(|View { camera: c, .. }| CameraFile {
                    fx: c.fx,
                    fy: c.fy,
                    cx: c.cx,
                    cy: c.cy,
                    lens: c.distortion.model().info().name.to_owned(),
                    distortion: c.distortion.parameters().to_vec(),
                }),
                from_world: view.map(|v| v.from_world.transpose().into()),
                left_out: p.view.err().map(|why| match why {
                    Unplaced::NoOverlap => LeftOutFile::NoOverlap,
                    Unplaced::OtherComponent { size } => LeftOutFile::OtherComponent { size },
                    Unplaced::Inconsistent => LeftOutFile::Inconsistent,
                }),
            }
        };
        let overlap = |p: AlignedPair| OverlapFile {
            a: p.a,
            b: p.b,
            rms_px: p.rms_px,
            matches: p.matches.iter().map(|m| [m.a.x, m.a.y, m.b.x, m.b.y]).collect(),
        };
        Self {
            schema: SCHEMA,
            mode: registration.motion.name().to_owned(),
            reference: registration.reference,
            rms_px: registration.rms_px,
            median_px: registration.median_px,
            photographs: registration.photographs.into_iter().map(photograph).collect(),
            overlaps: registration.pairs.into_iter().map(overlap).collect(),
        }
    }
}

impl TryFrom<RegistrationFile> for Registration {
    type Error = RegistrationError;

    fn try_from(file: RegistrationFile) -> Result<Self, RegistrationError> {
        Self::check_schema(Some(file.schema.into()))?;
        let motion = match CameraMotion::from_name(&file.mode) {
            Ok(CameraMotion::Homography) => CameraMotion::Homography,
            // Invalid rotations are reported for the matrices.
            _ => CameraMotion::Rotation,
        };
        let photograph = |(index, p): (usize, PhotographFile)| {
            let view = match (p.camera, p.from_world, p.left_out) {
                (Some(c), Some(rows), None) => {
                    let parameters = c.distortion.len();
                    let lens = DistortionModel::from_name(&c.lens)
                        .and_then(|model| Distortion::new(model, &c.distortion).ok())
                        .ok_or(RegistrationError::Lens { index, parameters })?;
                    let camera =
                        Camera { distortion: lens, ..Camera::pinhole(p.width, p.height, c.fx, c.fy, c.cx, c.cy) };
                    Ok(View { camera, from_world: Matrix3::from(rows).transpose() })
                }
                (_, _, Some(LeftOutFile::OtherComponent { size })) => Err(Unplaced::OtherComponent { size }),
                (_, _, Some(LeftOutFile::Inconsistent)) => Err(Unplaced::Inconsistent),
                _ => Err(Unplaced::NoOverlap),
            };
            Ok(Photograph { name: p.name, size: (p.width, p.height), view })
        };
        let pair = |o: OverlapFile| AlignedPair {
            a: o.a,
            b: o.b,
            inliers: Vec::new(),
            matches: o.matches.iter().map(|m| Correspondence::new(m[0], m[1], m[2], m[3])).collect(),
            rms_px: o.rms_px,
        };
        let made = Self {
            photographs: file.photographs.into_iter().enumerate().map(photograph).collect::<Result<_, _>>()?,
            reference: file.reference,
            motion,
            pairs: file.overlaps.into_iter().map(pair).collect(),
            rms_px: file.rms_px,
            median_px: file.median_px,
        };
        made.check()?;
        Ok(made)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Point2, Vector3};
    use nalgebra::Rotation3;

    fn alignment() -> Alignment {
        let view = |yaw: f64| View {
            camera: Camera { distortion: Distortion::simple_radial(-0.05), ..Camera::from_focal(300, 200, 250.0) },
            from_world: Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw).into_inner(),
        };
        let matches = vec![Correspondence { a: Point2::new(250.1, 100.0), b: Point2::new(50.7, 1.0 / 3.0) }];
        Alignment {
            views: vec![Ok(view(0.0)), Err(Unplaced::OtherComponent { size: 2 }), Ok(view(0.7))],
            reference: 2,
            motion: CameraMotion::Rotation,
            pairs: vec![AlignedPair { a: 0, b: 2, inliers: vec![4], matches, rms_px: 0.3 }],
            rms_px: 0.3,
            median_px: 0.2,
        }
    }

    const SIZES: [(usize, usize); 3] = [(300, 200), (640, 480), (300, 200)];

    fn registration() -> Registration {
        Registration::new(&alignment(), &SIZES, &["a.png".to_owned()]).unwrap()
    }

    #[test]
    fn registrations_round_trip() {
        let made = registration();
        let back = Registration::try_from(RegistrationFile::from(made.clone())).unwrap();
        assert_eq!(back, made);
        assert_eq!((back.name(0), back.name(2), back.photographs()), ("a.png", "", 3));
        let (got, want) = (back.alignment(), alignment());
        assert_eq!((got.views, got.reference, got.rms_px), (want.views, want.reference, want.rms_px));
        assert_eq!(got.pairs[0].matches, want.pairs[0].matches);
        // The same of something flat.
        let mut flat = alignment();
        flat.motion = CameraMotion::Homography;
        flat.views[0].as_mut().unwrap().from_world[(0, 1)] = 0.3;
        let made = Registration::new(&flat, &SIZES, &[]).unwrap();
        assert_eq!(Registration::try_from(RegistrationFile::from(made.clone())), Ok(made));
    }

    #[test]
    fn a_registration_of_other_photographs_is_refused_with_the_numbers() {
        let made = registration();
        assert_eq!(made.check_photographs(&SIZES), Ok(()));
        let error = made.check_photographs(&SIZES[..2]).unwrap_err();
        assert_eq!(error, RegistrationError::Count { registered: 3, got: 2 });
        let error = made.check_photographs(&[SIZES[0], SIZES[1], (200, 300)]).unwrap_err();
        assert_eq!(error.to_string(), "photograph 2 is 200x300; 300x200 was registered");
    }

    #[test]
    fn damaged_files_are_refused() {
        let refused = |damage: &dyn Fn(&mut RegistrationFile)| {
            let mut file = RegistrationFile::from(registration());
            damage(&mut file);
            Registration::try_from(file).unwrap_err()
        };
        let camera = |f: &mut RegistrationFile, change: fn(&mut CameraFile)| {
            change(f.photographs[0].camera.as_mut().unwrap());
        };
        let of_value = |name: &'static str, error: RegistrationError| {
            assert!(
                matches!(error, RegistrationError::Value { source, .. } if source.name == name),
                "{name}: {error:?}"
            );
        };
        assert_eq!(refused(&|f| f.schema = 7), RegistrationError::Schema { found: Some(7), known: 1 });
        of_value("width", refused(&|f| f.photographs[1].width = 0));
        of_value("height", refused(&|f| f.photographs[1].height = usize::MAX));
        of_value("fx", refused(&|f| camera(f, |c| c.fx = 1e-9)));
        of_value("fy", refused(&|f| camera(f, |c| c.fy = 1e300)));
        of_value("cx", refused(&|f| camera(f, |c| c.cx = -1e9)));
        of_value("distortion", refused(&|f| camera(f, |c| c.distortion[0] = 1e30)));
        of_value("match", refused(&|f| f.overlaps[0].matches[0][2] = 301.0));
        of_value("match", refused(&|f| f.overlaps[0].matches[0][1] = f64::NAN));
        of_value("rms_px", refused(&|f| f.overlaps[0].rms_px = -1.0));
        of_value("median_px", refused(&|f| f.median_px = f64::INFINITY));
        let nan = refused(&|f| camera(f, |c| c.fx = f64::NAN));
        assert!(matches!(nan, RegistrationError::Camera { index: 0, .. }), "{nan:?}");
        assert_eq!(
            refused(&|f| camera(f, |c| c.lens = "glass".to_owned())),
            RegistrationError::Lens { index: 0, parameters: 1 }
        );
        assert_eq!(
            refused(&|f| camera(f, |c| c.distortion.push(0.0))),
            RegistrationError::Lens { index: 0, parameters: 2 }
        );
        let matrix = RegistrationError::Matrix { index: 2, rotation: true };
        assert_eq!(refused(&|f| f.photographs[2].from_world.as_mut().unwrap()[0][0] = 2.0), matrix);
        assert_eq!(refused(&|f| f.photographs[2].from_world.as_mut().unwrap()[0][0] = f64::NAN), matrix);
        let flat = refused(&|f| {
            f.mode = "plane".to_owned();
            f.photographs[0].from_world = Some([[1.0; 3]; 3]);
        });
        assert_eq!(flat, RegistrationError::Matrix { index: 0, rotation: false });
        for (a, b) in [(0, 0), (0, 1), (0, 3), (usize::MAX, 0)] {
            let error = refused(&|f| (f.overlaps[0].a, f.overlaps[0].b) = (a, b));
            assert_eq!(error, RegistrationError::Pair { a, b, photographs: 3 });
        }
        assert_eq!(refused(&|f| f.reference = 1), RegistrationError::Pair { a: 1, b: 1, photographs: 3 });
        let nothing = refused(&|f| f.photographs.iter_mut().for_each(|p| p.camera = None));
        assert_eq!(nothing, RegistrationError::Nothing { photographs: 3 });
        assert_eq!(refused(&|f| f.photographs.clear()), RegistrationError::Nothing { photographs: 0 });
    }
}
