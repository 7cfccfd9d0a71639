//! Registrations as projects of Hugin and Panorama Tools (`.pto`).
//!
//! An `i` line is a photograph: size `w h`, projection `f0` (rectilinear), horizontal field of view `v`, and roll `r` (clockwise), pitch `p` (up) and yaw `y` (right) in degrees: the world-to-camera rotation
//! is `Rz(−r) Rx(−p) Ry(−y)`. The distortion maps radii, in units of half the shorter side, by `r_photo = r (a r³ + b r² + c r + 1 − a − b − c)` with `r` that of a pinhole of field of view `v`; `d e` is the offset
//! of the principal point from the image center in pixels (<https://hugin.sourceforge.io/docs/manual/Image_positioning_model.html>, <https://hugin.sourceforge.io/docs/manual/Lens_correction_model.html>). A `c` line
//! is a match: `n x y` and `N X Y`, with pixel centers at integers as here. The `p` line is the canvas. Hugin's `nona` (2022.0) agrees to a median of 0.1 px; for equirectangular canvases of odd width it
//! is offset by half a pixel.
//!
//! `r (1 + k1 r²)` is exactly representable (`b` with another focal length). Other distortions are fitted over the photograph by least squares; [`Pto::lens_error_px`] is the maximum residual.

use super::{Photograph, Registration, RegistrationError};
use crate::align::{AlignedPair, CameraMotion, View};
use crate::surface::{Canvas, Projection};
use cv_core::{Camera, Correspondence, Distortion, DistortionModel, Matrix3, Point2, Vector3};
use nalgebra::{DMatrix, DVector, Rotation3};
use std::collections::BTreeMap;
use std::f64::consts::TAU;
use std::fmt::Write;

/// A registration converted to or from Hugin's format.
#[derive(Debug, Clone, PartialEq)]
pub struct Pto<T> {
    /// The text, or the registration.
    pub content: T,
    /// Maximum residual of the distortion model conversion over all photographs, in pixels.
    pub lens_error_px: f64,
}

/// Why a registration cannot be converted to or from Hugin's format.
#[derive(Debug, Clone, Copy, PartialEq, thiserror::Error)]
#[cfg_attr(feature = "serde", derive(serde::Serialize))]
pub enum PtoError {
    /// The alignment has homographies; the format supports rotations only.
    #[error("the scene is flat, and a .pto file has rotations only")]
    Flat,
    /// There are no photographs.
    #[error("there is no line i, of a photograph")]
    NoPhotographs,
    /// A number is missing, malformed, or an invalid reference.
    #[error("line {line} has no number {key}")]
    Number {
        /// Counted from 1.
        line: usize,
        /// The letter.
        key: &'static str,
    },
    /// An unsupported value.
    #[error("line {line} has {key} = {value}; it must be {range}")]
    Unsupported {
        /// Counted from 1.
        line: usize,
        /// The letter.
        key: &'static str,
        /// Its value.
        value: f64,
        /// Supported alternatives.
        range: &'static str,
    },
    /// The content is not a valid registration.
    #[error(transparent)]
    Registration(#[from] RegistrationError),
}

/// Intrinsics in the format's parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Lens {
    /// Focal length of the pinhole of field of view `v`, in pixels.
    focal: f64,
    a: f64,
    b: f64,
    c: f64,
    /// Offset of the principal point from the image center, in pixels.
    shift: [f64; 2],
    /// Half of the shorter side.
    unit: f64,
}

/// Grid points per side of a photograph at which distortion models are compared.
const GRID: usize = 16;

/// Returns a grid of pixels that includes the corners.
fn grid(width: usize, height: usize) -> impl Iterator<Item = Point2<f64>> {
    let at = |i: usize, size: usize| (size as f64 - 1.0) * i as f64 / GRID as f64;
    (0..=GRID).flat_map(move |y| (0..=GRID).map(move |x| Point2::new(at(x, width), at(y, height))))
}

/// Fits `Σ coefficient_k · r^powers[k]` to the samples `(r, value)` by least squares; `None` where the system is singular.
fn fitted(samples: &[(f64, f64)], powers: &[i32]) -> Option<Vec<f64>> {
    let largest = samples.iter().map(|s| s.0).fold(0.0, f64::max);
    // Radii are normalized to 1 for conditioning.
    let rows = DMatrix::from_fn(samples.len(), powers.len(), |i, k| (samples[i].0 / largest).powi(powers[k]));
    let values = DVector::from_iterator(samples.len(), samples.iter().map(|s| s.1));
    let found = (rows.transpose() * &rows).cholesky()?.solve(&(rows.transpose() * values));
    let scaled: Vec<f64> = found.iter().zip(powers).map(|(v, &power)| v / largest.powi(power)).collect();
    scaled.iter().all(|v| v.is_finite()).then_some(scaled)
}

/// Returns the center coordinate of a side.
fn middle(side: usize) -> f64 {
    0.5 * (side as f64 - 1.0)
}

impl Lens {
    fn of(camera: &Camera) -> Self {
        let unit = 0.5 * camera.width.min(camera.height) as f64;
        let shift = [camera.cx - middle(camera.width), camera.cy - middle(camera.height)];
        let plain = Self { focal: camera.fx, a: 0.0, b: 0.0, c: 0.0, shift, unit };
        // r_photo = e1 ρ + e2 ρ² + e3 ρ³ + e4 ρ⁴, where ρ is the radius in a pinhole image of focal length 1.
        let radial = camera.distortion.converted(DistortionModel::SimpleRadial);
        let coefficients = match radial.as_ref().map(Distortion::parameters) {
            _ if camera.distortion.is_none() => return plain,
            Some(&[k1]) => Some(vec![camera.fx, 0.0, camera.fx * k1, 0.0]),
            _ => {
                let c = Point2::new(camera.cx, camera.cy);
                let sample = |p: Point2<f64>| (camera.normalize(p).coords.norm(), (p - c).norm());
                let samples: Vec<_> = grid(camera.width, camera.height).map(sample).collect();
                fitted(&samples, &[1, 2, 3, 4])
            }
        };
        let Some(&[e1, e2, e3, e4]) = coefficients.as_deref() else { return plain };
        // The unit radius is a fixed point of the format's polynomial, which determines the focal length. Bisection of a monotonic function.
        let photo = |rho: f64| rho * (e1 + rho * (e2 + rho * (e3 + rho * e4)));
        let (mut low, mut high) = (0.0, 4.0 * unit / camera.fx);
        if photo(high) < unit && photo(0.5 * high) < unit {
            return plain;
        }
        if photo(high) < unit {
            high *= 0.5;
        }
        for _ in 0..200 {
            let rho = 0.5 * (low + high);
            if photo(rho) < unit { low = rho } else { high = rho }
        }
        let focal = unit / (0.5 * (low + high));
        let (a, b, c) =
            (e4 * unit.powi(3) / focal.powi(4), e3 * unit.powi(2) / focal.powi(3), e2 * unit / focal.powi(2));
        Self { focal, a, b, c, ..plain }
    }

    /// Distorts a radius of normalized coordinates to pixels.
    fn radius(&self, rho: f64) -> f64 {
        let r = self.focal * rho / self.unit;
        self.unit * r * (1.0 - self.a - self.b - self.c + r * (self.c + r * (self.b + r * self.a)))
    }

    /// Converts to a [`Camera`].
    fn camera(&self, width: usize, height: usize) -> Option<Camera> {
        let pinhole = |focal: f64| {
            let [dx, dy] = self.shift;
            Camera::pinhole(width, height, focal, focal, middle(width) + dx, middle(height) + dy)
        };
        let Self { focal, a, b, c, unit, .. } = *self;
        if (a, b, c) == (0.0, 0.0, 0.0) {
            return Some(pinhole(focal));
        }
        let ratio = focal / unit;
        if a == 0.0 && c == 0.0 {
            let k1 = b * ratio * ratio / (1.0 - b);
            return Some(Camera { distortion: Distortion::simple_radial(k1), ..pinhole(focal * (1.0 - b)) });
        }
        // Over the photograph: up to its corner, or less where the polynomial is not monotonic up to there.
        let corner = 0.5 * (width as f64).hypot(height as f64) + self.shift[0].hypot(self.shift[1]);
        let rho = |i: usize| corner / focal * i as f64 / 64.0;
        let samples: Vec<_> = (1..=64).map(|i| (rho(i), self.radius(rho(i)))).collect();
        let [e1, e3, e5] = fitted(&samples, &[1, 3, 5])?.try_into().ok()?;
        let distortion = Distortion::new(DistortionModel::Radial, &[e3 / e1, e5 / e1]).ok()?;
        Some(Camera { distortion, ..pinhole(e1) })
    }

    /// Computes the maximum distance of the two projections in pixels.
    fn error(&self, camera: &Camera) -> f64 {
        let principal = Point2::new(middle(camera.width) + self.shift[0], middle(camera.height) + self.shift[1]);
        let off = |p: Point2<f64>| {
            let ideal = camera.normalize(p).coords;
            let rho = ideal.norm();
            let there = if rho > 0.0 { principal + ideal * (self.radius(rho) / rho) } else { principal };
            (there - p).norm()
        };
        grid(camera.width, camera.height).map(off).fold(0.0, f64::max)
    }
}

/// Returns roll, pitch and yaw, in degrees, of a world-to-camera rotation.
fn angles(from_world: &Matrix3<f64>) -> [f64; 3] {
    let ahead = from_world.row(2).transpose();
    let (yaw, pitch) = (ahead.x.atan2(ahead.z), (-ahead.y).atan2(ahead.x.hypot(ahead.z)));
    let rest = from_world * rotation(0.0, pitch, yaw).transpose();
    [-rest[(1, 0)].atan2(rest[(0, 0)]), pitch, yaw].map(f64::to_degrees)
}

/// Returns the world-to-camera rotation of roll, pitch and yaw.
fn rotation(roll: f64, pitch: f64, yaw: f64) -> Matrix3<f64> {
    let turned = Rotation3::from_axis_angle(&Vector3::z_axis(), -roll)
        * Rotation3::from_axis_angle(&Vector3::x_axis(), -pitch)
        * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
    turned.into_inner()
}

/// Writes the canvas as a `p` line: symmetric around the surface center, cropped to ours.
fn canvas_line(canvas: &Canvas, (width, height): (usize, usize)) -> String {
    let number = match canvas.projection {
        Projection::Auto | Projection::Plane => "f0",
        Projection::Cylindrical => "f1",
        Projection::Spherical => "f2",
        Projection::Stereographic => "f4",
        Projection::Mercator => "f5",
        Projection::Panini => "f19",
    };
    // `panini_general` at a compression of 100 is d = 1; `panini` (12) has other heights.
    let more = if canvas.projection == Projection::Panini { " P\"100 0 0\"" } else { "" };
    // Pixel i of a side of n has coordinate i − (n − 1) / 2: the parity of n is chosen so that ours are at integers.
    let side = |origin: f64, size: usize| {
        let reach = (origin - 0.5).abs().max((origin + size as f64 - 0.5).abs());
        let n = (2.0 * reach - 1e-6).ceil();
        let off = (origin + 0.5 * (n - 1.0)).fract().abs();
        if off > 0.25 && off < 0.75 { n + 1.0 } else { n }
    };
    let (w, h) = (side(canvas.origin.x, width), side(canvas.origin.y, height));
    let half = 0.5 * w / canvas.scale;
    let angle = match canvas.projection {
        Projection::Auto | Projection::Plane => 2.0 * half.atan(),
        Projection::Cylindrical | Projection::Spherical | Projection::Mercator => (2.0 * half).min(TAU),
        Projection::Stereographic | Projection::Panini => 4.0 * (0.5 * half).atan(),
    };
    let (left, top) = ((canvas.origin.x + 0.5 * (w - 1.0)).round(), (canvas.origin.y + 0.5 * (h - 1.0)).round());
    let (right, bottom) = (left + width as f64, top + height as f64);
    let v = angle.to_degrees();
    format!("p {number} w{w} h{h} v{v}{more} E0 R0 S{left},{right},{top},{bottom} n\"TIFF_m c:LZW r:CROP\"")
}

impl Registration {
    /// Converts the registered photographs to a Hugin project with the given canvas.
    ///
    /// Photographs that are not registered are omitted, as are photometric parameters. Quotation marks and line ends in names become `_`.
    ///
    /// # Errors
    /// [`PtoError::Flat`].
    pub fn to_pto(&self, canvas: &Canvas, size: (usize, usize)) -> Result<Pto<String>, PtoError> {
        if self.motion == CameraMotion::Homography {
            return Err(PtoError::Flat);
        }
        let mut lens_error_px: f64 = 0.0;
        let mut numbers = vec![None; self.photographs.len()];
        let mut text = format!(
            "# hugin project file\n#hugin_ptoversion 2\n{}\nm i2\n\n# image lines\n",
            canvas_line(canvas, size)
        );
        let used = self.photographs.iter().enumerate().filter_map(|(i, p)| Some((i, p, p.view.ok()?)));
        for (number, (i, photograph, view)) in used.enumerate() {
            numbers[i] = Some(number);
            let lens = Lens::of(&view.camera);
            lens_error_px = lens_error_px.max(lens.error(&view.camera));
            let (w, h) = photograph.size;
            let v = 2.0 * (0.5 * w as f64 / lens.focal).atan().to_degrees();
            let [r, p, y] = angles(&(view.from_world * canvas.frame.transpose()));
            let Lens { a, b, c, shift: [d, e], .. } = lens;
            let name: String =
                photograph.name.chars().map(|c| if c == '"' || c.is_control() { '_' } else { c }).collect();
            let _ = writeln!(
                text,
                "i w{w} h{h} f0 v{v} Ra0 Rb0 Rc0 Rd0 Re0 Eev0 Er1 Eb1 r{r} p{p} y{y} TrX0 TrY0 TrZ0 j0 a{a} b{b} c{c} d{d} e{e} g0 t0 Va1 Vb0 Vc0 Vd0 Vx0 Vy0 Vm5 n\"{name}\""
            );
        }
        // No variables to be optimized.
        text.push_str("\nv\n\n# control points\n");
        for pair in &self.pairs {
            let (Some(n), Some(m)) = (numbers[pair.a], numbers[pair.b]) else { continue };
            for Correspondence { a, b } in &pair.matches {
                let _ = writeln!(text, "c n{n} N{m} x{} y{} X{} Y{} t0", a.x, a.y, b.x, b.y);
            }
        }
        Ok(Pto { content: text, lens_error_px })
    }

    /// Reads the photographs and matches of a project of Hugin or Panorama Tools.
    ///
    /// Supports rectilinear photographs (`f0`) without translation or shear; crops, photometric parameters, masks and the canvas are ignored.
    ///
    /// # Errors
    /// [`PtoError`].
    pub fn from_pto(text: &str) -> Result<Pto<Self>, PtoError> {
        let lines: Vec<Line<'_>> = text.lines().enumerate().filter_map(|(i, line)| Line::new(i + 1, line)).collect();
        let photographs: Vec<&Line<'_>> = lines.iter().filter(|line| line.kind == "i").collect();
        let mut lens_error_px: f64 = 0.0;
        let mut made = Self {
            photographs: Vec::with_capacity(photographs.len()),
            reference: 0,
            motion: CameraMotion::Rotation,
            pairs: Vec::new(),
            rms_px: 0.0,
            median_px: 0.0,
        };
        for line in &photographs {
            let (photograph, error) = line.photograph(&photographs)?;
            lens_error_px = lens_error_px.max(error);
            made.photographs.push(photograph);
        }
        if made.photographs.is_empty() {
            return Err(PtoError::NoPhotographs);
        }
        let mut pairs = BTreeMap::new();
        for line in lines.iter().filter(|line| line.kind == "c" && line.value("t").is_none_or(|t| t == "0")) {
            made.add_match(line, &mut pairs)?;
        }
        made.measure();
        made.check()?;
        Ok(Pto { content: made, lens_error_px })
    }

    /// Adds a match to its pair; `pairs` maps photographs to the index of the pair.
    fn add_match(&mut self, line: &Line<'_>, pairs: &mut BTreeMap<(usize, usize), usize>) -> Result<(), PtoError> {
        let number = |key| line.number(key, &[]);
        let index = |key| match number(key)? {
            v if v >= 0.0 && v < self.photographs.len() as f64 && v.fract() == 0.0 => Ok(v as usize),
            value => Err(PtoError::Unsupported { line: line.number, key, value, range: "the number of a photograph" }),
        };
        let (mut a, mut b) = (index("n")?, index("N")?);
        let mut m = Correspondence::new(number("x")?, number("y")?, number("X")?, number("Y")?);
        if a > b {
            (a, b, m) = (b, a, Correspondence { a: m.b, b: m.a });
        }
        // Lines within one photograph (horizontal and vertical guides) are not matches.
        if a != b {
            let place = *pairs.entry((a, b)).or_insert_with(|| {
                self.pairs.push(AlignedPair { a, b, inliers: Vec::new(), matches: Vec::new(), rms_px: 0.0 });
                self.pairs.len() - 1
            });
            self.pairs[place].matches.push(m);
        }
        Ok(())
    }

    /// Computes the transfer errors of the matches in both directions.
    fn measure(&mut self) {
        let views: Vec<Option<View>> = self.photographs.iter().map(|p| p.view.ok()).collect();
        let rms = |errors: &[f64]| (errors.iter().map(|e| e * e).sum::<f64>() / errors.len().max(1) as f64).sqrt();
        let mut all = Vec::new();
        for pair in &mut self.pairs {
            let (Some(a), Some(b)) = (views[pair.a], views[pair.b]) else { continue };
            let off = |from: &View, to: &View, p, q: Point2<f64>| Some((to.project(&from.ray(p)?)? - q).norm());
            let both = |m: &Correspondence| Some(0.5 * (off(&a, &b, m.a, m.b)? + off(&b, &a, m.b, m.a)?));
            let errors: Vec<f64> = pair.matches.iter().filter_map(both).filter(|e| *e <= 1e6).collect();
            pair.rms_px = rms(&errors);
            all.extend(errors);
        }
        all.sort_by(f64::total_cmp);
        self.rms_px = rms(&all);
        self.median_px = all.get(all.len() / 2).copied().unwrap_or(0.0);
    }
}

/// A line of the file: its first word, and the other words.
struct Line<'a> {
    number: usize,
    kind: &'a str,
    words: Vec<&'a str>,
}

impl<'a> Line<'a> {
    fn new(number: usize, text: &'a str) -> Option<Self> {
        let mut words = Vec::new();
        let mut rest = text.trim();
        while !rest.is_empty() {
            // Quoted words may contain blanks.
            let mut quoted = false;
            let end = rest.find(|c: char| {
                quoted ^= c == '"';
                c.is_whitespace() && !quoted
            });
            let (word, more) = rest.split_at(end.unwrap_or(rest.len()));
            words.push(word);
            rest = more.trim_start();
        }
        let kind = *words.first()?;
        words.remove(0);
        Some(Self { number, kind, words })
    }

    /// Returns the value of a key.
    fn value(&self, key: &str) -> Option<&'a str> {
        let is_value = |rest: &&str| rest.starts_with(|c: char| c.is_ascii_digit() || "+-.=\"".contains(c));
        self.words.iter().find_map(|word| word.strip_prefix(key).filter(is_value))
    }

    /// Returns the number of a key; `=3` refers to that of photograph 3.
    fn number(&self, key: &'static str, photographs: &[&Self]) -> Result<f64, PtoError> {
        let missing = || PtoError::Number { line: self.number, key };
        let mut value = self.value(key).ok_or_else(missing)?;
        if let Some(other) = value.strip_prefix('=') {
            let other = other.parse::<usize>().ok().and_then(|i| photographs.get(i));
            value = other.and_then(|line| line.value(key)).ok_or_else(missing)?;
        }
        value.parse().ok().filter(|v: &f64| v.is_finite()).ok_or_else(missing)
    }

    /// Parses an `i` line; also returns the residual of the distortion model conversion in pixels.
    fn photograph(&self, photographs: &[&Self]) -> Result<(Photograph, f64), PtoError> {
        let number = |key| self.number(key, photographs);
        let or_zero = |key| if self.value(key).is_some() { number(key) } else { Ok(0.0) };
        let within = |key, value: f64, range, ok: bool| match ok {
            true => Ok(value),
            false => Err(PtoError::Unsupported { line: self.number, key, value, range }),
        };
        let side = |key| {
            let v = number(key)?;
            within(key, v, "a whole number from 1 to a million", v.fract() == 0.0 && (1.0..=1e6).contains(&v))
        };
        let (w, h) = (side("w")?, side("h")?);
        let f = number("f")?;
        within("f", f, "0, a rectilinear lens", f == 0.0)?;
        for key in ["g", "t", "TrX", "TrY", "TrZ"] {
            let v = or_zero(key)?;
            within(key, v, "0: no shear, one place", v == 0.0)?;
        }
        let v = number("v")?;
        within("v", v, "above 0 and below 179 degrees", v > 0.0 && v < 179.0)?;
        let [roll, pitch, yaw] = [or_zero("r")?, or_zero("p")?, or_zero("y")?].map(|v| (v % 360.0).to_radians());
        let coefficient = |key| {
            let v = or_zero(key)?;
            within(key, v, "within 1", v.abs() < 1.0)
        };
        let focal = 0.5 * w / (0.5 * v.to_radians()).tan();
        let lens = Lens {
            focal,
            a: coefficient("a")?,
            b: coefficient("b")?,
            c: coefficient("c")?,
            shift: [or_zero("d")?, or_zero("e")?],
            unit: 0.5 * w.min(h),
        };
        let size = (w as usize, h as usize);
        let camera = lens.camera(size.0, size.1);
        let camera = camera.ok_or(PtoError::Number { line: self.number, key: "a b c" })?;
        let name = self.value("n").unwrap_or_default().trim_matches('"').to_owned();
        let view = Ok(View { camera, from_world: rotation(roll, pitch, yaw) });
        Ok((Photograph { name, size, view }, lens.error(&camera)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::{Alignment, Unplaced};
    use proptest::prelude::*;

    const WIDTH: usize = 640;
    const HEIGHT: usize = 480;

    fn view(roll: f64, pitch: f64, yaw: f64, distortion: Distortion) -> View {
        let camera = Camera { distortion, ..Camera::pinhole(WIDTH, HEIGHT, 500.0, 500.0, 322.0, 236.5) };
        View { camera, from_world: rotation(roll, pitch, yaw) }
    }

    fn registration(distortion: Distortion) -> Registration {
        let (a, b) = (view(0.1, -0.2, -0.3, distortion), view(-0.05, 0.1, 0.3, distortion));
        let matches = (0..20).filter_map(|i| {
            let p = Point2::new(350.0 + 14.0 * f64::from(i), 30.0 + 21.0 * f64::from(i));
            let q = b.project(&a.ray(p)?)?;
            b.contains(q).then_some(Correspondence { a: p, b: q })
        });
        let pair = AlignedPair { a: 0, b: 2, inliers: Vec::new(), matches: matches.collect(), rms_px: 0.0 };
        assert!(pair.matches.len() > 5);
        let alignment = Alignment {
            views: vec![Ok(a), Err(Unplaced::NoOverlap), Ok(b)],
            reference: 0,
            motion: CameraMotion::Rotation,
            pairs: vec![pair],
            rms_px: 0.0,
            median_px: 0.0,
        };
        let names = ["left one.jpg", "stranger.jpg", "a \"b\".jpg"].map(str::to_owned);
        Registration::new(&alignment, &[(WIDTH, HEIGHT), (100, 80), (WIDTH, HEIGHT)], &names).unwrap()
    }

    fn canvas(projection: Projection) -> Canvas {
        Canvas { projection, scale: 500.0, origin: Point2::new(-400.0, -250.5), frame: Matrix3::identity() }
    }

    #[test]
    fn a_project_has_the_angles_of_panorama_tools() {
        // A camera rotated to the right has directions on the right at its center; one rolled clockwise has them at the lower right.
        let ahead = |r: f64, p: f64, y: f64, ray: Vector3<f64>| rotation(r, p, y) * ray;
        assert!((ahead(0.0, 0.0, 0.3, Vector3::new(0.3_f64.sin(), 0.0, 0.3_f64.cos())) - Vector3::z()).norm() < 1e-12);
        // Pitch is up, and Y points down.
        assert!((ahead(0.0, 0.3, 0.0, Vector3::new(0.0, -0.3_f64.sin(), 0.3_f64.cos())) - Vector3::z()).norm() < 1e-12);
        let right = ahead(0.3, 0.0, 0.0, Vector3::new(0.1, 0.0, 1.0));
        assert!(right.x > 0.0 && right.y < 0.0, "{right}");
        let pto = registration(Distortion::NONE).to_pto(&canvas(Projection::Panini), (801, 502)).unwrap();
        let lines: Vec<&str> = pto.content.lines().collect();
        let p = lines.iter().find(|line| line.starts_with("p ")).unwrap();
        // The canvas reaches 400.5 px to either side and 251 up and down: 4 atan(400.5 / 1000) across.
        let v = (4.0 * 0.4005_f64.atan()).to_degrees();
        assert_eq!(*p, format!("p f19 w801 h502 v{v} P\"100 0 0\" E0 R0 S0,801,0,502 n\"TIFF_m c:LZW r:CROP\""));
        let images: Vec<&&str> = lines.iter().filter(|line| line.starts_with("i ")).collect();
        assert_eq!(images.len(), 2);
        let line = Line::new(1, images[0]).unwrap();
        for (key, want) in [
            ("w", 640.0),
            ("f", 0.0),
            ("v", 2.0 * (320.0_f64 / 500.0).atan().to_degrees()),
            ("r", 0.1_f64.to_degrees()),
            ("p", -0.2_f64.to_degrees()),
            ("y", -0.3_f64.to_degrees()),
            ("d", 322.0 - 319.5),
            ("e", 236.5 - 239.5),
            ("b", 0.0),
        ] {
            assert!((line.number(key, &[]).unwrap() - want).abs() < 1e-9, "{key}: {}", images[0]);
        }
        assert_eq!(line.value("n"), Some("\"left one.jpg\""));
        assert!(images[1].ends_with("n\"a _b_.jpg\""));
        assert!(lines.iter().filter(|line| line.starts_with("c n0 N1 x")).count() > 5);
    }

    proptest! {
        #[test]
        fn projects_round_trip(k1 in -0.2..0.2_f64, roll in -3.1..3.1_f64, pitch in -1.5..1.5_f64, yaw in -3.1..3.1_f64) {
            let lens = Distortion::simple_radial(k1);
            let alignment = Alignment {
                views: vec![Ok(view(roll, pitch, yaw, lens))],
                ..registration(lens).alignment()
            };
            let alignment = Alignment { pairs: Vec::new(), ..alignment };
            let made = Registration::new(&alignment, &[(WIDTH, HEIGHT)], &[]).unwrap();
            let written = made.to_pto(&canvas(Projection::Spherical), (800, 500)).unwrap();
            let read = Registration::from_pto(&written.content).unwrap();
            let (a, b) = (alignment.views[0].unwrap(), read.content.alignment().views[0].unwrap());
            prop_assert!((a.from_world - b.from_world).amax() < 1e-9);
            // Rounding, and undistortion to 1e-10 of normalized coordinates.
            prop_assert!(written.lens_error_px < 1e-5 && read.lens_error_px < 1e-5, "{} {}", written.lens_error_px, read.lens_error_px);
            for p in grid(WIDTH, HEIGHT) {
                let q = b.project(&a.ray(p).unwrap()).unwrap();
                prop_assert!((p - q).norm() < 1e-5, "{p} {q}");
            }
        }
    }

    #[test]
    fn unsupported_lens_models_are_fitted_and_the_error_is_reported() {
        // Barrel distortion of a tenth at the corners: even powers of one polynomial by all powers of another. Tangential distortion is not written: an error of 1.5 px.
        for (lens, most) in [
            (Distortion::new(DistortionModel::Radial, &[-0.25, 0.08]).unwrap(), 0.3),
            (Distortion::new(DistortionModel::RadialTangential5, &[-0.2, 0.05, 0.001, -0.001, 0.01]).unwrap(), 3.0),
        ] {
            let made = registration(lens);
            let pto = made.to_pto(&canvas(Projection::Plane), (800, 500)).unwrap();
            assert!(pto.lens_error_px < most && pto.lens_error_px > 1e-6, "{}", pto.lens_error_px);
            // The lens in the file has the reported error, evaluated by the definition of the manual.
            let line = pto.content.lines().find(|line| line.starts_with("i ")).unwrap();
            let line = Line::new(1, line).unwrap();
            let [a, b, c, v] = ["a", "b", "c", "v"].map(|key| line.number(key, &[]).unwrap());
            let camera = made.alignment().views[0].unwrap().camera;
            let mut largest: f64 = 0.0;
            for p in grid(WIDTH, HEIGHT) {
                let ideal = camera.normalize(p).coords;
                let r = ideal.norm() * 320.0 / (0.5 * v.to_radians()).tan() / 240.0;
                let photo = 240.0 * (a * r.powi(4) + b * r.powi(3) + c * r.powi(2) + (1.0 - a - b - c) * r);
                let there = Point2::new(322.0, 236.5) + ideal.normalize() * photo;
                largest = largest.max((there - p).norm());
            }
            assert!((largest - pto.lens_error_px).abs() < 1e-6, "{largest} {}", pto.lens_error_px);
            // And back: the radial part as far as two coefficients go.
            let read = Registration::from_pto(&pto.content).unwrap();
            assert!(read.lens_error_px < 0.5, "{}", read.lens_error_px);
            assert!(read.content.alignment().rms_px < 0.5 + most);
        }
    }

    #[test]
    fn projects_of_hugin_are_read_with_links_between_photographs() {
        let text = "# hugin project file\r\n#hugin_ptoversion 2\np f2 w3000 h1500 v360  E0 R0 n\"TIFF_m c:LZW\"\nm i0\n\n\
            #-hugin  cropFactor=1\n\
            i w3000 h2000 f0 v60 Ra0 Eev10.2 Er1 Eb1 r0 p0 y-10 TrX0 TrY0 TrZ0 j0 a0 b-0.02 c0 d0 e0 g0 t0 Va1 Vx0 Vm5 S0,2999,0,1999 n\"/a b/1.jpg\"\n\
            i w3000 h2000 f0 v=0 Ra=0 Eev10.2 Er1 Eb1 r90 p+5 y1.5e1 TrX0 TrY0 TrZ0 j0 a=0 b=0 c=0 d=0 e=0 g=0 t=0 Va=0 Vm5 n\"2.jpg\"\n\
            v r1\nv\nc n1 N0 x10 y20 X1000 Y1100 t0\nc n0 N0 x1 y1 X1 Y900 t1\n#hugin_optimizeReferenceImage 0\n";
        let read = Registration::from_pto(text).unwrap();
        let (alignment, made) = (read.content.alignment(), read.content);
        assert_eq!((made.photographs(), made.name(0), made.name(1)), (2, "/a b/1.jpg", "2.jpg"));
        let views = [0, 1].map(|i| alignment.views[i].unwrap());
        let focal = 1500.0 / 30_f64.to_radians().tan();
        for view in views {
            assert!((view.camera.fx - 1.02 * focal).abs() < 1e-9 && (view.camera.cx - 1499.5).abs() < 1e-9);
            // b r³ in halves of the shorter side.
            let k1 = -0.02 * (focal / 1000.0).powi(2) / 1.02;
            assert!((view.camera.distortion.parameters()[0] - k1).abs() < 1e-12);
        }
        let ahead = views[1].ray(Point2::new(1499.5, 999.5)).unwrap();
        let (yaw, pitch) = (15_f64.to_radians(), 5_f64.to_radians());
        let want = Vector3::new(pitch.cos() * yaw.sin(), -pitch.sin(), pitch.cos() * yaw.cos());
        assert!((ahead - want).norm() < 1e-9, "{ahead}");
        // A roll of 90° clockwise: a pixel slightly above the photograph's center has a direction to the right.
        let top = views[1].ray(Point2::new(1499.5, 899.5)).unwrap();
        assert!(top.x.atan2(top.z) > yaw + 0.02, "{top}");
        assert_eq!(alignment.pairs.len(), 1);
        assert_eq!((alignment.pairs[0].a, alignment.pairs[0].b, alignment.pairs[0].matches.len()), (0, 1, 1));
        assert_eq!(alignment.pairs[0].matches[0], Correspondence::new(1000.0, 1100.0, 10.0, 20.0));
    }

    #[test]
    fn unsupported_entries_are_refused_with_their_line() {
        let go = |line: &str| Registration::from_pto(&format!("# hugin\n{line}\n")).unwrap_err();
        assert_eq!(Registration::from_pto("").unwrap_err(), PtoError::NoPhotographs);
        assert_eq!(go("i w3000 h2000 f0"), PtoError::Number { line: 2, key: "v" });
        assert_eq!(go("i w3000 h2000 f0 v=7"), PtoError::Number { line: 2, key: "v" });
        assert_eq!(go("i w3000 h2000 f0 v=0"), PtoError::Number { line: 2, key: "v" });
        assert_eq!(go("i wx h2000 f0 v50"), PtoError::Number { line: 2, key: "w" });
        assert_eq!(go("i w3000 h2000 f0 v1e999"), PtoError::Number { line: 2, key: "v" });
        for (line, key, value) in [
            ("i w3000 h2000 f3 v50", "f", 3.0),
            ("i w0 h2000 f0 v50", "w", 0.0),
            ("i w3000 h2e9 f0 v50", "h", 2e9),
            ("i w3000 h2000 f0 v180", "v", 180.0),
            ("i w3000 h2000 f0 v50 b7", "b", 7.0),
            ("i w3000 h2000 f0 v50 TrX1", "TrX", 1.0),
            ("i w3000 h2000 f0 v50 g0.1", "g", 0.1),
            ("i w30 h20 f0 v50\nc n0 N4 x1 y1 X1 Y1 t0", "N", 4.0),
        ] {
            match go(line) {
                PtoError::Unsupported { key: told, value: got, .. } => assert_eq!((told, got), (key, value)),
                other => panic!("{line}: {other:?}"),
            }
        }
        assert!(matches!(go("i w30 h20 f0 v50 d1e9"), PtoError::Registration(RegistrationError::Value { .. })));
        assert!(matches!(
            go("i w30 h20 f0 v50\ni w30 h20 f0 v50\nc n0 N1 x99 y1 X1 Y1 t0"),
            PtoError::Registration(RegistrationError::Value { .. })
        ));
        let mut flat = registration(Distortion::NONE);
        flat.motion = CameraMotion::Homography;
        assert_eq!(flat.to_pto(&canvas(Projection::Plane), (10, 10)), Err(PtoError::Flat));
    }

    proptest! {
        #[test]
        fn any_text_gives_a_registration_or_an_error(words in proptest::collection::vec("[icvp] ?[wfvhrpyabcdenNxXYtg]?=?[-0-9.e\" ]{0,6}\n?", 0..30)) {
            let _ = Registration::from_pto(&words.concat());
        }
    }

    #[test]
    fn the_canvas_of_a_project_has_the_same_pixels() {
        for (x, y, w, h) in
            [(-400.0, -250.5, 801, 502), (-17.0, 33.0, 400, 10), (12.5, -90.5, 7, 60), (-99.5, -1.0, 120, 90)]
        {
            let canvas = Canvas { origin: Point2::new(x, y), ..canvas(Projection::Plane) };
            let line = canvas_line(&canvas, (w, h));
            let words = Line::new(1, &line).unwrap();
            let [pw, ph, v] = ["w", "h", "v"].map(|key| words.number(key, &[]).unwrap());
            let cut: Vec<f64> = words.value("S").unwrap().split(',').map(|v| v.parse().unwrap()).collect();
            // The canvas has the same size, positions and scale.
            assert!(cut[0] >= 0.0 && cut[1] <= pw && cut[2] >= 0.0 && cut[3] <= ph, "{line}");
            assert_eq!((cut[1] - cut[0], cut[3] - cut[2]), (w as f64, h as f64), "{line}");
            assert_eq!((cut[0] - 0.5 * (pw - 1.0), cut[2] - 0.5 * (ph - 1.0)), (x, y), "{line}");
            assert!((0.5 * pw / (0.5 * v.to_radians()).tan() - 500.0).abs() < 1e-9, "{line}");
        }
    }

    #[test]
    fn the_width_of_a_full_circle_is_one_period() {
        let line = canvas_line(
            &Canvas { origin: Point2::new(-1570.0, -100.0), ..canvas(Projection::Cylindrical) },
            (3142, 200),
        );
        let v: f64 = Line::new(1, &line).unwrap().number("v", &[]).unwrap();
        assert!(v <= 360.0 && v > 359.9, "{line}");
    }
}
