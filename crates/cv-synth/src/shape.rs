//! Shapes and ray intersections.

use nalgebra::{Point3, Vector3};

/// A surface. Lengths in meters, directions of unit length.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Shape {
    /// `corner + u·eu + v·ev`, `0 ≤ u ≤ size.0`, `0 ≤ v ≤ size.1`; from the front, u points right and v down, so that
    /// it faces along `ev × eu`. `round`: the inscribed ellipse.
    Rect {
        corner: Point3<f64>,
        eu: Vector3<f64>,
        ev: Vector3<f64>,
        /// `eu × ev`, away from the front.
        normal: Vector3<f64>,
        size: (f64, f64),
        round: bool,
    },
    Sphere {
        center: Point3<f64>,
        radius: f64,
    },
    /// The lateral surface of a frustum: radius `radii.0` at `base`, `radii.1` at `base + length·axis`.
    Frustum {
        base: Point3<f64>,
        axis: Vector3<f64>,
        length: f64,
        radii: (f64, f64),
    },
}

/// A ray from `origin` along `dir`, which is not normalized: `t` is in units of its length.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Ray {
    pub(crate) origin: Point3<f64>,
    pub(crate) dir: Vector3<f64>,
}

/// Surface properties at a hit.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Surface {
    pub(crate) point: Point3<f64>,
    /// Unit normal, outward (towards the front of a rectangle).
    pub(crate) normal: Vector3<f64>,
    /// Surface coordinates from 0 to 1.
    pub(crate) s: f32,
    pub(crate) t: f32,
}

/// Returns two unit vectors that form a right-handed basis with `axis`.
pub(crate) fn complete_basis(axis: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let helper = if axis.y.abs() < 0.8 { Vector3::y() } else { Vector3::x() };
    let a = axis.cross(&helper).normalize();
    (a, axis.cross(&a))
}

impl Shape {
    /// Creates the rectangle with orthogonal edges `u` and `v`, or the inscribed ellipse.
    pub(crate) fn rect(corner: Point3<f64>, u: Vector3<f64>, v: Vector3<f64>, round: bool) -> Self {
        let size = (u.norm(), v.norm());
        let (eu, ev) = (u / size.0, v / size.1);
        Self::Rect { corner, eu, ev, normal: eu.cross(&ev), size, round }
    }

    /// Returns the first hit in `(near, far)`.
    #[inline]
    pub(crate) fn intersect(&self, ray: &Ray, near: f64, far: f64) -> Option<f64> {
        let is_within = |t: f64| t > near && t < far;
        match self {
            Self::Rect { corner, eu, ev, normal, size, round } => {
                let denominator = ray.dir.dot(normal);
                let t = (corner - ray.origin).dot(normal) / denominator;
                // Also false for the NaN of a ray in the plane.
                if !is_within(t) {
                    return None;
                }
                let d = ray.origin + ray.dir * t - corner;
                let (u, v) = (d.dot(eu), d.dot(ev));
                if !(u >= 0.0 && u <= size.0 && v >= 0.0 && v <= size.1) {
                    return None;
                }
                if *round {
                    let (x, y) = (2.0 * u / size.0 - 1.0, 2.0 * v / size.1 - 1.0);
                    if x * x + y * y > 1.0 {
                        return None;
                    }
                }
                Some(t)
            }
            Self::Sphere { center, radius } => {
                let oc = ray.origin - center;
                let a = ray.dir.norm_squared();
                let b = oc.dot(&ray.dir);
                let c = oc.norm_squared() - radius * radius;
                roots(a, b, c).into_iter().find(|&t| is_within(t))
            }
            Self::Frustum { base, axis, length, radii } => {
                let slope = (radii.1 - radii.0) / length;
                let oc = ray.origin - base;
                let (dz, oz) = (ray.dir.dot(axis), oc.dot(axis));
                let (d, o) = (ray.dir - axis * dz, oc - axis * oz);
                let (dr, or) = (slope * dz, radii.0 + slope * oz);
                let a = d.norm_squared() - dr * dr;
                let b = d.dot(&o) - dr * or;
                let c = o.norm_squared() - or * or;
                roots(a, b, c).into_iter().find(|&t| {
                    let z = oz + t * dz;
                    is_within(t) && z >= 0.0 && z <= *length
                })
            }
        }
    }

    /// Returns normal and surface coordinates at `t`.
    pub(crate) fn surface(&self, ray: &Ray, t: f64) -> Surface {
        let point = ray.origin + ray.dir * t;
        match self {
            Self::Rect { corner, eu, ev, size, .. } => {
                let d = point - corner;
                let (s, t) = (d.dot(eu) / size.0, d.dot(ev) / size.1);
                Surface { point, normal: ev.cross(eu), s: s as f32, t: t as f32 }
            }
            Self::Sphere { center, radius } => {
                let n = (point - center) / *radius;
                let s = 0.5 + n.z.atan2(n.x) / std::f64::consts::TAU;
                let t = n.y.clamp(-1.0, 1.0).acos() / std::f64::consts::PI;
                Surface { point, normal: n, s: s as f32, t: t as f32 }
            }
            Self::Frustum { base, axis, length, radii } => {
                let d = point - base;
                let z = d.dot(axis);
                let (a, b) = complete_basis(axis);
                let (x, y) = (d.dot(&a), d.dot(&b));
                let r = (x * x + y * y).sqrt().max(1e-12);
                let slope = (radii.1 - radii.0) / length;
                let normal = ((a * x + b * y) / r - axis * slope).normalize();
                let s = 0.5 + y.atan2(x) / std::f64::consts::TAU;
                Surface { point, normal, s: s as f32, t: (z / length) as f32 }
            }
        }
    }

    /// Returns point and normal at surface coordinates.
    pub(crate) fn at(&self, s: f64, t: f64) -> (Point3<f64>, Vector3<f64>) {
        match self {
            Self::Rect { corner, eu, ev, size, .. } => (corner + eu * (s * size.0) + ev * (t * size.1), ev.cross(eu)),
            Self::Sphere { center, radius } => {
                let (phi, theta) = ((s - 0.5) * std::f64::consts::TAU, t * std::f64::consts::PI);
                let n = Vector3::new(theta.sin() * phi.cos(), theta.cos(), theta.sin() * phi.sin());
                (center + n * *radius, n)
            }
            Self::Frustum { base, axis, length, radii } => {
                let (a, b) = complete_basis(axis);
                let phi = (s - 0.5) * std::f64::consts::TAU;
                let out = a * phi.cos() + b * phi.sin();
                let r = radii.0 + t * (radii.1 - radii.0);
                let normal = (out - axis * ((radii.1 - radii.0) / length)).normalize();
                (base + axis * (t * length) + out * r, normal)
            }
        }
    }

    /// Returns the size of the surface in meters along its two coordinates.
    pub(crate) fn extent(&self) -> (f64, f64) {
        match self {
            Self::Rect { size, .. } => *size,
            Self::Sphere { radius, .. } => (std::f64::consts::TAU * radius, std::f64::consts::PI * radius),
            Self::Frustum { length, radii, .. } => (std::f64::consts::PI * (radii.0 + radii.1), *length),
        }
    }

    /// Returns whether the first coordinate is periodic.
    pub(crate) fn is_periodic(&self) -> bool {
        !matches!(self, Self::Rect { .. })
    }

    pub(crate) fn center(&self) -> Point3<f64> {
        match self {
            Self::Rect { corner, eu, ev, size, .. } => corner + eu * (0.5 * size.0) + ev * (0.5 * size.1),
            Self::Sphere { center, .. } => *center,
            Self::Frustum { base, axis, length, .. } => base + axis * (0.5 * length),
        }
    }

    /// Returns the corners of the bounding box, slightly enlarged.
    pub(crate) fn bounds(&self) -> (Point3<f64>, Point3<f64>) {
        let (mut low, mut high) = (Point3::from([f64::INFINITY; 3]), Point3::from([f64::NEG_INFINITY; 3]));
        let mut extend = |p: Point3<f64>, r: Vector3<f64>| {
            low = low.inf(&(p - r));
            high = high.sup(&(p + r));
        };
        match self {
            Self::Rect { corner, eu, ev, size, .. } => {
                for (u, v) in [(0.0, 0.0), (size.0, 0.0), (0.0, size.1), (size.0, size.1)] {
                    extend(corner + eu * u + ev * v, Vector3::zeros());
                }
            }
            Self::Sphere { center, radius } => extend(*center, Vector3::repeat(*radius)),
            Self::Frustum { base, axis, length, radii } => {
                let side = axis.map(|c| (1.0 - c * c).max(0.0).sqrt());
                extend(*base, side * radii.0);
                extend(base + axis * *length, side * radii.1);
            }
        }
        (low - Vector3::repeat(1e-6), high + Vector3::repeat(1e-6))
    }
}

/// Returns the real roots of `a t² + 2 b t + c` in ascending order, infinite where there are none.
fn roots(a: f64, b: f64, c: f64) -> [f64; 2] {
    const NONE: f64 = f64::INFINITY;
    let disc = b * b - a * c;
    if disc < 0.0 {
        return [NONE; 2];
    }
    // The sum has no cancellation; the other root is from the product.
    let q = -(b + disc.sqrt().copysign(b));
    let (t0, t1) = (if a == 0.0 { NONE } else { q / a }, if q == 0.0 { NONE } else { c / q });
    if t0 < t1 { [t0, t1] } else { [t1, t0] }
}
