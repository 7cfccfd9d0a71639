//! Warping of a photograph to the canvas.
//!
//! All surfaces factor as `ray = (g(y)·ax(x), b(y), g(y)·az(x) + c(y))` (see `Model`), so mapping a canvas pixel to the photograph takes three
//! multiply-adds per coordinate and one division.

use crate::align::View;
use crate::bit_depth::{Channel, Colors, Positions};
use crate::photometric::ExposureCorrection;
use crate::regions::Region;
use crate::rows::for_each_row_with;
use crate::surface::{Bounds, DisplacementField, Placement, Surface};
use cv_core::{Cancelled, DistortionModel, Image, ImageView, Matrix3, Point2, Sample, Stage};
use cv_imgproc::{Interpolation, SAMPLE_LANES, bicubic_at, bilinear_at};
use fearless_simd::{Level, Simd, dispatch};
use std::ops::Range;

/// A photograph warped to a part of the canvas.
#[derive(Debug, Clone, PartialEq)]
pub struct WarpedPhoto<T = u8> {
    /// The part of the canvas.
    pub bounds: Bounds,
    /// Red, green, blue, and opacity: the maximum value where the photograph covers the pixel, 0 where its border pixels are replicated; of the size of the bounds.
    pub pixels: Image<T, 4>,
}

impl<T: Sample> WarpedPhoto<T> {
    /// Returns whether the photograph covers a canvas pixel.
    #[inline]
    pub fn reaches(&self, x: usize, y: usize) -> bool {
        let b = self.bounds;
        b.contains(x, y) && self.pixels.row(y - b.top)[4 * (x - b.left) + 3] != T::default()
    }

    /// Returns the pixels of a canvas row within the bounds; empty above and below.
    pub(crate) fn row(&self, y: usize) -> &[[T; 4]] {
        let b = self.bounds;
        if (b.top..b.bottom).contains(&y) { self.pixels.row(y - b.top).as_chunks::<4>().0 } else { &[] }
    }

    /// Returns the opacities of a part of a canvas row; `None` if it is not within the bounds.
    pub(crate) fn opacities(&self, columns: Range<usize>, y: usize) -> Option<impl Iterator<Item = T> + Clone> {
        let left = self.bounds.left;
        let part = columns.start.checked_sub(left)?..columns.end.checked_sub(left)?;
        Some(self.row(y).get(part)?.iter().map(|pixel| pixel[3]))
    }

    /// Returns the color at a canvas pixel; `None` where the photograph does not cover it.
    #[inline]
    pub fn color(&self, x: usize, y: usize) -> Option<[T; 3]> {
        let b = self.bounds;
        if !b.contains(x, y) {
            return None;
        }
        let [r, g, b, a] = self.pixels.at(x - b.left, y - b.top);
        (a != T::default()).then_some([r, g, b])
    }
}

/// Opacity of linear radiance that is a lower bound because the photograph is clipped.
pub(crate) const CLIPPED: f32 = 0.5;

/// Settings of [`warp`].
#[derive(Clone, Copy)]
pub(crate) struct WarpSettings<'a> {
    pub(crate) displacement: Option<&'a DisplacementField>,
    pub(crate) interpolation: Interpolation,
    /// Exposure correction; `None` for none.
    pub(crate) correction: Option<ExposureCorrection<'a>>,
    /// The pixels that are sampled, where not all are; the others of a row repeat the nearest of them, with opacity 0.
    pub(crate) region: Option<&'a Region>,
}

/// Warps a photograph to the canvas pixels `bounds`.
pub(crate) fn warp<T: Channel>(
    photo: ImageView<'_, T, 3>,
    placement: &Placement,
    surface: &Surface,
    bounds: Bounds,
    settings: WarpSettings<'_>,
    stage: &Stage<'_>,
) -> Result<WarpedPhoto<T>, Cancelled> {
    let (width, height) = (bounds.width(), bounds.height());
    let mut pixels = Image::<T, 4>::new(width, height, [T::default(); 4]);
    if photo.is_empty() || pixels.is_empty() {
        return Ok(WarpedPhoto { bounds, pixels });
    }
    let map = Map::new(placement, surface, bounds);
    let correction = settings.correction;
    // Plain loops compiled for each instruction set; without fused multiply-adds results are identical.
    let level = Level::new();
    for_each_row_with(
        pixels.as_mut_slice(),
        4 * width,
        stage,
        || Row::new(width),
        |buffer, y, row| {
            let whole = bounds.left..bounds.right;
            let span = settings.region.map_or(whole, |region| region.span(bounds.top + y));
            let (first, end) = (span.start - bounds.left, span.end - bounds.left);
            let (us, vs) = (&mut buffer.us[..end - first], &mut buffer.vs[..end - first]);
            dispatch!(level, _simd => map.row(y, first, us, vs));
            if let Some(field) = settings.displacement {
                dispatch!(level, _simd => field.add_row((bounds.top + y) as f64, span.start as f64, us, vs));
            }
            let (before, rest) = row.split_at_mut(4 * first);
            let (row, after) = rest.split_at_mut(4 * (end - first));
            let place = (span.start, bounds.top + y);
            match settings.interpolation {
                Interpolation::Nearest => {
                    dispatch!(level, simd => sample_row::<_, _, Nearest>(simd, photo, buffer, row, place, correction))
                }
                Interpolation::Bilinear => {
                    dispatch!(level, simd => sample_row::<_, _, Bilinear>(simd, photo, buffer, row, place, correction))
                }
                Interpolation::Bicubic => {
                    dispatch!(level, simd => sample_row::<_, _, Bicubic>(simd, photo, buffer, row, place, correction))
                }
            }
            let sampled = row.as_chunks::<4>().0;
            for (part, nearest) in [(before, sampled.first()), (after, sampled.last())] {
                if let Some(&[r, g, b, _]) = nearest {
                    part.as_chunks_mut::<4>().0.fill([r, g, b, T::default()]);
                }
            }
        },
    )?;
    Ok(WarpedPhoto { bounds, pixels })
}

/// Map from canvas pixels to photograph pixels, evaluated by rows.
pub(crate) struct Map {
    /// Per column, the part of `M · ray` that depends on x.
    columns: Vec<[f32; 3]>,
    /// Second and third column of M; times b(y) and c(y) they are the part that depends on y alone.
    middle: [f64; 3],
    last: [f64; 3],
    surface: Surface,
    /// Surface y of the first row.
    top: f64,
    lens: Lens,
}

enum Lens {
    /// No distortion: M maps to pixels.
    None,
    /// M maps to normalized coordinates; `limit` is the largest squared radius inside the photograph.
    Radial { k1: f32, k2: f32, f: [f32; 2], c: [f32; 2], limit: f32 },
    /// As above, with the functions of the camera model.
    Other { view: View, limit: f32 },
}

impl Map {
    pub(crate) fn new(placement: &Placement, surface: &Surface, bounds: Bounds) -> Self {
        let view = placement.view;
        let camera = view.camera;
        // Largest squared radius of the photograph's border, with a margin for the outer halves of the border pixels.
        let limit = || {
            let squared = view.border(64).into_iter().map(|p| camera.normalize(p).coords.norm_squared());
            1.05 * squared.filter(|v| v.is_finite()).fold(0.0, f64::max) as f32
        };
        // Radial distortion is vectorized here; other models use their own functions.
        let radial = camera.distortion.converted(DistortionModel::Radial);
        let (m, lens) = match radial.as_ref().map(|lens| lens.parameters()) {
            _ if camera.distortion.is_none() => (camera.matrix() * view.from_world, Lens::None),
            Some(&[k1, k2]) => {
                let lens = Lens::Radial {
                    k1: k1 as f32,
                    k2: k2 as f32,
                    f: [camera.fx as f32, camera.fy as f32],
                    c: [camera.cx as f32, camera.cy as f32],
                    limit: limit(),
                };
                (view.from_world, lens)
            }
            _ => (view.from_world, Lens::Other { view, limit: limit() }),
        };
        // The scale of M cancels; normalization keeps single precision well scaled.
        let m: Matrix3<f64> = m / m.norm();
        let columns = (bounds.left..bounds.right)
            .map(|x| {
                let (ax, az) = surface.column(x as f64 + placement.origin.x);
                std::array::from_fn(|r| (m[(r, 0)] * ax + m[(r, 2)] * az) as f32)
            })
            .collect();
        let middle = std::array::from_fn(|r| m[(r, 1)]);
        let last = std::array::from_fn(|r| m[(r, 2)]);
        Self { columns, middle, last, surface: *surface, top: bounds.top as f64 + placement.origin.y, lens }
    }

    /// Computes the photograph coordinates of row `y` of the bounds, from column `left` of them. Rays behind the camera map far outside the photograph.
    #[inline(always)]
    pub(crate) fn row(&self, y: usize, left: usize, us: &mut [f32], vs: &mut [f32]) {
        let (g, b, c) = self.surface.row(self.top + y as f64);
        let g = g as f32;
        let b: [f32; 3] = std::array::from_fn(|r| (self.middle[r] * b + self.last[r] * c) as f32);
        for ((c, u), v) in self.columns[left..].iter().zip(us.iter_mut()).zip(vs.iter_mut()) {
            // Rays at and behind the principal plane map far outside.
            let z = (g * c[2] + b[2]).max(1e-9);
            let inverse = 1.0 / z;
            *u = (g * c[0] + b[0]) * inverse;
            *v = (g * c[1] + b[1]) * inverse;
        }
        match &self.lens {
            Lens::None => {}
            Lens::Radial { k1, k2, f, c, limit } => {
                for (u, v) in us.iter_mut().zip(vs.iter_mut()) {
                    let r2 = (*u * *u + *v * *v).max(1e-30);
                    // Outside the photograph the polynomial may not be monotonic: the radius is clamped.
                    let r2_held = r2.min(*limit);
                    let factor = (1.0 + r2_held * (k1 + k2 * r2_held)) * (r2_held / r2).sqrt();
                    // Clamped points map outside the photograph.
                    let out = if r2 > *limit { 1e6 } else { 0.0 };
                    *u = f[0] * factor * *u * (1.0 + out) + c[0];
                    *v = f[1] * factor * *v * (1.0 + out) + c[1];
                }
            }
            Lens::Other { view, limit } => {
                for (u, v) in us.iter_mut().zip(vs.iter_mut()) {
                    let r2 = *u * *u + *v * *v;
                    if r2 <= *limit {
                        let p = view.camera.denormalize(Point2::new(f64::from(*u), f64::from(*v)));
                        (*u, *v) = (p.x as f32, p.y as f32);
                    } else {
                        (*u, *v) = (*u * 1e9, *v * 1e9);
                    }
                }
            }
        }
    }
}

/// Scratch buffers of a canvas row.
struct Row {
    /// Photograph coordinates.
    us: Vec<f32>,
    vs: Vec<f32>,
    opacities: Vec<f32>,
    colors: [Vec<f32>; 3],
    /// Vignetting correction in stops.
    lifts: Vec<f32>,
    clipped: Vec<f32>,
}

impl Row {
    fn new(width: usize) -> Self {
        let line = || vec![0.0; width];
        Self {
            us: line(),
            vs: line(),
            opacities: line(),
            colors: [line(), line(), line()],
            lifts: line(),
            clipped: line(),
        }
    }
}

/// Samples one row of canvas pixels from `place`; coordinates outside the photograph are clamped to its border and get opacity 0. One loop per step, so that all but the lookups are
/// vectorized.
#[inline(always)]
fn sample_row<S: Simd, T: Channel, I: Sampler>(
    simd: S,
    photo: ImageView<'_, T, 3>,
    buffer: &mut Row,
    row: &mut [T],
    place: (usize, usize),
    correction: Option<ExposureCorrection<'_>>,
) {
    let n = row.len() / 4;
    let [us, vs, lifts, clipped] =
        [&mut buffer.us, &mut buffer.vs, &mut buffer.lifts, &mut buffer.clipped].map(|line| &mut line[..n]);
    let opacities = &mut buffer.opacities[..n];
    let [reds, greens, blues] = buffer.colors.each_mut().map(|line| &mut line[..n]);
    let (right, bottom) = ((photo.width() - 1) as f32, (photo.height() - 1) as f32);
    let corner = 4.0 / ((right + 1.0).powi(2) + (bottom + 1.0).powi(2));
    for ((opacity, u), v) in opacities.iter_mut().zip(us.iter_mut()).zip(vs.iter_mut()) {
        let inside = (*u >= -0.5) & (*v >= -0.5) & (*u <= right + 0.5) & (*v <= bottom + 0.5);
        *opacity = if inside { T::OPAQUE.to_f32() } else { 0.0 };
        // `max` first: it replaces NaN.
        (*u, *v) = (u.max(0.0).min(right), v.max(0.0).min(bottom));
    }
    let mut start = 0;
    while start < n {
        if let (Some(u), Some(v)) = (us[start..].first_chunk(), vs[start..].first_chunk())
            && let Some([r, g, b]) = I::lanes(simd, photo, u, v)
        {
            let end = start + SAMPLE_LANES;
            reds[start..end].copy_from_slice(&r);
            greens[start..end].copy_from_slice(&g);
            blues[start..end].copy_from_slice(&b);
            start = end;
            continue;
        }
        let end = n.min(start + SAMPLE_LANES);
        for i in start..end {
            // Outside the border the nearest pixel suffices.
            [reds[i], greens[i], blues[i]] =
                if opacities[i] != 0.0 { I::sample(photo, us[i], vs[i]) } else { Nearest::sample(photo, us[i], vs[i]) };
        }
        start = end;
    }
    if let Some(correction) = &correction {
        for ((lift, &u), &v) in lifts.iter_mut().zip(us.iter()).zip(vs.iter()) {
            let (x, y) = (u - 0.5 * right, v - 0.5 * bottom);
            *lift = correction.vignetting_stops(corner * (x * x + y * y));
        }
        scale([&mut *reds, &mut *greens, &mut *blues], 1.0 / T::PER_LEVEL);
        if T::LINEAR {
            let factors = correction.gain.map(f32::exp2);
            for ((((opacity, r), g), b), lift) in
                opacities.iter_mut().zip(reds.iter_mut()).zip(greens.iter_mut()).zip(blues.iter_mut()).zip(lifts.iter())
            {
                if *opacity != 0.0 && r.max(*g).max(*b) >= correction.clipped {
                    *opacity = CLIPPED;
                }
                let lift = lift.exp2();
                // The bicubic kernel overshoots at edges.
                (*r, *g, *b) =
                    (r.max(0.0) * factors[0] * lift, g.max(0.0) * factors[1] * lift, b.max(0.0) * factors[2] * lift);
            }
        } else if T::PARTS == 1 {
            correction.add_adaptation::<false>(place, [&*reds, &*greens, &*blues], clipped, lifts);
            correction.row_of_levels::<false>([&mut reds[..], &mut greens[..], &mut blues[..]], lifts, clipped);
        } else {
            correction.add_adaptation::<true>(place, [&*reds, &*greens, &*blues], clipped, lifts);
            correction.row_of_levels::<true>([&mut reds[..], &mut greens[..], &mut blues[..]], lifts, clipped);
        }
        scale([&mut *reds, &mut *greens, &mut *blues], T::PER_LEVEL);
    }
    let colors = reds.iter().zip(greens.iter()).zip(blues.iter());
    for ((pixel, ((&r, &g), &b)), &opacity) in row.as_chunks_mut::<4>().0.iter_mut().zip(colors).zip(opacities.iter()) {
        *pixel = [r, g, b, opacity].map(T::from_f32);
    }
}

/// Scales rows between sample units and gray levels.
#[inline(always)]
fn scale(rows: [&mut [f32]; 3], factor: f32) {
    if factor != 1.0 {
        rows.into_iter().flatten().for_each(|v| *v *= factor);
    }
}

/// Splits a position inside the photograph into the base pixel and the fractional offsets.
#[inline(always)]
fn split(u: f32, v: f32) -> (usize, usize, f32, f32) {
    let (x, y) = (u as i32, v as i32);
    (x as usize, y as usize, u - x as f32, v - y as f32)
}

/// An interpolation kernel. (A type instead of a function pointer, so that it is inlined and compiled for each instruction set.)
trait Sampler {
    fn sample<T: Channel>(photo: ImageView<'_, T, 3>, u: f32, v: f32) -> [f32; 3];

    /// Samples eight positions at once, with the same result; `None` where that is not possible.
    #[inline(always)]
    fn lanes<S: Simd, T: Channel>(
        _: S,
        _: ImageView<'_, T, 3>,
        _us: Positions<'_>,
        _vs: Positions<'_>,
    ) -> Option<Colors> {
        None
    }
}

struct Nearest;

impl Sampler for Nearest {
    #[inline(always)]
    fn sample<T: Channel>(photo: ImageView<'_, T, 3>, u: f32, v: f32) -> [f32; 3] {
        photo.at((u + 0.5) as usize, (v + 0.5) as usize).map(T::to_f32)
    }
}

struct Bilinear;

impl Sampler for Bilinear {
    #[inline(always)]
    fn sample<T: Channel>(photo: ImageView<'_, T, 3>, u: f32, v: f32) -> [f32; 3] {
        let (x, y, fx, fy) = split(u, v);
        bilinear_at(photo, x, y, fx, fy)
    }
}

struct Bicubic;

impl Sampler for Bicubic {
    #[inline(always)]
    fn sample<T: Channel>(photo: ImageView<'_, T, 3>, u: f32, v: f32) -> [f32; 3] {
        let (x, y, fx, fy) = split(u, v);
        bicubic_at(photo, x, y, fx, fy)
    }

    #[inline(always)]
    fn lanes<S: Simd, T: Channel>(
        simd: S,
        photo: ImageView<'_, T, 3>,
        us: Positions<'_>,
        vs: Positions<'_>,
    ) -> Option<Colors> {
        T::bicubic_lanes(simd, photo, us, vs)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::photometric::Gains;
    use crate::surface::Projection;
    use crate::testing::stage;
    use cv_core::{Camera, Distortion, RgbU8, Vector3};
    use nalgebra::Rotation3;

    const PLAIN: WarpSettings<'_> =
        WarpSettings { displacement: None, interpolation: Interpolation::Bicubic, correction: None, region: None };

    fn placement(camera: Camera, r: Rotation3<f64>, bounds: Bounds) -> Placement {
        Placement {
            photo: 0,
            view: View { camera, from_world: r.into_inner() },
            bounds,
            origin: Point2::new(-60.0, -45.0),
        }
    }

    /// A smooth image with an analytic value at each point: interpolation errors are below one gray level.
    fn wave(u: f64, v: f64) -> [f64; 3] {
        [128.0 + 90.0 * (u * 0.05).sin(), 128.0 + 90.0 * (v * 0.06).cos(), 128.0 + 60.0 * ((u + v) * 0.03).sin()]
    }

    #[test]
    fn every_surface_and_lens_agrees_with_the_exact_projection() {
        let photo = RgbU8::from_fn(121, 91, |x, y| wave(x as f64, y as f64).map(|v| v.round() as u8));
        let bounds = Bounds { left: 3, top: 5, right: 118, bottom: 88 };
        for distortion in [
            Distortion::NONE,
            Distortion::radial(-0.1, 0.02),
            Distortion::radial_tangential4([0.05, 0.0, 0.002, -0.001]),
            Distortion::rational8([0.3, 0.02, 0.002, -0.001, 0.0, 0.25, 0.0, 0.0]),
        ] {
            let camera = Camera { distortion, ..Camera::from_focal(121, 91, 110.0) };
            for projection in [Projection::Plane, Projection::Cylindrical, Projection::Spherical] {
                let surface = Surface { projection, scale: 110.0 };
                let p = placement(camera, Rotation3::from_euler_angles(0.1, -0.15, 0.05), bounds);
                for interpolation in [Interpolation::Bilinear, Interpolation::Bicubic] {
                    let settings = WarpSettings { interpolation, ..PLAIN };
                    let warped = warp(photo.view(), &p, &surface, bounds, settings, &stage()).unwrap();
                    let mut seen = 0;
                    for y in bounds.top..bounds.bottom {
                        for x in bounds.left..bounds.right {
                            let ray = surface.inverse(Point2::new(x as f64 + p.origin.x, y as f64 + p.origin.y));
                            let q = p.view.project(&ray);
                            let [r, g, b, a] = warped.pixels.at(x - bounds.left, y - bounds.top);
                            let inside = q.is_some_and(|q| p.view.contains(q));
                            // Single precision may tip a pixel within a thousandth of the outer edge, which is half a pixel away.
                            if !inside {
                                continue;
                            }
                            seen += 1;
                            assert_eq!(a, 255);
                            let q = q.unwrap();
                            for (got, want) in [r, g, b].into_iter().zip(wave(q.x, q.y)) {
                                // Half a level of rounding in the photograph, half in the result, and an interpolation error
                                // of 90·0.06²/8 = 0.04 from the curvature.
                                assert!(
                                    (f64::from(got) - want).abs() < 1.6,
                                    "{projection:?} {distortion:?} {x} {y}: {got} {want}"
                                );
                            }
                        }
                    }
                    assert!(seen > 5000, "{seen}");
                }
            }
        }
    }

    #[test]
    fn pixels_outside_the_photograph_repeat_its_edge_and_are_not_covered() {
        let photo = RgbU8::new(20, 10, [9, 80, 200]);
        let surface = Surface { projection: Projection::Spherical, scale: 20.0 };
        let bounds = Bounds { left: 0, top: 0, right: 126, bottom: 90 };
        for distortion in [Distortion::NONE, Distortion::simple_radial(-0.3), Distortion::fisheye4([0.0; 4])] {
            let camera = Camera { distortion, ..Camera::from_focal(20, 10, 20.0) };
            let p = placement(camera, Rotation3::identity(), bounds);
            let warped = warp(photo.view(), &p, &surface, bounds, PLAIN, &stage()).unwrap();
            let mut reached = 0;
            for y in 0..90 {
                for x in 0..126 {
                    let [r, g, b, a] = warped.pixels.at(x, y);
                    assert_eq!([r, g, b], [9, 80, 200]);
                    let ray: Vector3<f64> = surface.inverse(Point2::new(x as f64 - 60.0, y as f64 - 45.0));
                    if a > 0 {
                        reached += 1;
                        assert!(ray.z > 0.5, "{distortion:?} {x} {y} {ray}");
                    }
                }
            }
            // The sphere's pixels are as large as the photograph's at the center, and larger at its sides.
            assert!((150..=230).contains(&reached), "{distortion:?} {reached}");
        }
    }

    /// Samples per pixel by the definition: Keys' cubic convolution with a = −0.5 over all sixteen neighbors, edges repeated, then the correction of exposure.
    fn plain(photo: &RgbU8, q: Point2<f64>, correction: ExposureCorrection<'_>) -> [f64; 3] {
        let (w, h) = (photo.width() as f64 - 1.0, photo.height() as f64 - 1.0);
        let kernel = |t: f64| match t.abs() {
            t if t < 1.0 => 1.5 * t.powi(3) - 2.5 * t.powi(2) + 1.0,
            t if t < 2.0 => -0.5 * t.powi(3) + 2.5 * t.powi(2) - 4.0 * t + 2.0,
            _ => 0.0,
        };
        let r2 = ((q.x - 0.5 * w).powi(2) + (q.y - 0.5 * h).powi(2)) * 4.0 / ((w + 1.0).powi(2) + (h + 1.0).powi(2));
        let color: [f64; 3] = std::array::from_fn(|c| {
            let mut sum = 0.0;
            for y in (q.y.floor() as i64 - 1)..=(q.y.floor() as i64 + 2) {
                for x in (q.x.floor() as i64 - 1)..=(q.x.floor() as i64 + 2) {
                    let near = photo.at(x.clamp(0, w as i64) as usize, y.clamp(0, h as i64) as usize);
                    sum += kernel(q.x - x as f64) * kernel(q.y - y as f64) * f64::from(near[c]);
                }
            }
            sum
        });
        let levels = correction.levels(color.map(|v| v as f32), correction.vignetting_stops(r2 as f32));
        levels.map(|v| f64::from(v).clamp(0.0, 255.0))
    }

    #[test]
    fn every_pixel_is_the_corrected_sample_at_the_displaced_position() {
        let photo = RgbU8::from_fn(97, 73, |x, y| {
            let noise = |k: usize| ((x * 7919 + y * 104_729 + k * 1299) % 251) as u8;
            [noise(0), noise(1) / 2 + 60, noise(2) / 4 + 90]
        });
        let bounds = Bounds { left: 10, top: 12, right: 100, bottom: 80 };
        let p = placement(Camera::from_focal(97, 73, 95.0), Rotation3::from_euler_angles(0.03, 0.05, -0.08), bounds);
        let surface = Surface { projection: Projection::Spherical, scale: 95.0 };
        let mut field = DisplacementField::over(&bounds, 16.0);
        for (i, d) in field.displacement.iter_mut().enumerate() {
            *d = cv_core::Vector2::new(0.7 * (i as f64 * 0.9).sin(), 0.6 * (i as f64 * 1.7).cos());
        }
        field.update_source_shift(&p, &surface);
        let gains = Gains { gains: vec![[0.8, 1.2, 1.5]], vignetting: [0.2, 0.1], response: [0.3, -0.2, 0.1] };
        let tone = gains.tone(1);
        let correction = ExposureCorrection::new(&tone, &gains, 0);
        let settings = WarpSettings { displacement: Some(&field), correction: Some(correction), ..PLAIN };
        let warped = warp(photo.view(), &p, &surface, bounds, settings, &stage()).unwrap();
        let mut seen = 0;
        for (x, y) in (bounds.top..bounds.bottom).flat_map(|y| (bounds.left..bounds.right).map(move |x| (x, y))) {
            let ray = surface.inverse(Point2::new(x as f64 + p.origin.x, y as f64 + p.origin.y));
            let (mut u, mut v) = ([p.view.project(&ray).unwrap().x as f32], [p.view.project(&ray).unwrap().y as f32]);
            field.add_row(y as f64, x as f64, &mut u, &mut v);
            let q = Point2::new(f64::from(u[0]), f64::from(v[0]));
            let Some(color) = warped.color(x, y).filter(|_| p.view.contains(q)) else { continue };
            seen += 1;
            for (got, want) in color.into_iter().zip(plain(&photo, q, correction)) {
                // Half a level of rounding; positions in single precision, 1e-4 px on slopes of up to 255 levels times 1.5 · e^0.3; and a sixteenth of a level of
                // the photograph, which the two sums of samples may be rounded to differently, times the same.
                assert!((f64::from(got) - want).abs() < 0.75, "{x} {y}: {got} {want}");
            }
        }
        assert!(seen > 3000, "{seen}");
    }
}
