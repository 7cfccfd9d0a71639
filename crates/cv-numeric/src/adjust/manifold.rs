//! Parameters that are not vectors: how a block moves.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// The space that the parameters of a block live in.
///
/// A block is stored as [`Manifold::ambient`] numbers and moved by [`Manifold::tangent`] ones, its degrees of freedom, in
/// coordinates around the point where it is (Hertzberg et al., "Integrating generic sensor fusion algorithms with sound state
/// representations through encapsulation of manifolds", Information Fusion 2013). Derivatives of residuals are by the tangent
/// coordinates at zero.
pub trait Manifold: Send + Sync {
    /// Numbers that store a block.
    fn ambient(&self) -> usize;
    /// Degrees of freedom of a block, at most 64.
    fn tangent(&self) -> usize;
    /// Writes `x` moved by `delta` to `moved`. Moving by zero gives `x`, up to rounding.
    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]);
}

/// Vectors of so many numbers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Euclidean(pub usize);

impl Manifold for Euclidean {
    fn ambient(&self) -> usize {
        self.0
    }

    fn tangent(&self) -> usize {
        self.0
    }

    #[inline]
    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        for ((m, x), d) in moved.iter_mut().zip(x).zip(delta) {
            *m = x + d;
        }
    }
}

/// Rotations, SO(3): nine numbers, the matrix by columns. Three degrees of freedom `ω`, in radians: `R ← exp([ω]×) R`.
///
/// The derivative of `R x` by `ω` is therefore `−[R x]×`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RotationManifold;

impl RotationManifold {
    /// The numbers of a rotation.
    pub fn store(rotation: &Rotation3<f64>) -> [f64; 9] {
        let mut numbers = [0.0; 9];
        numbers.copy_from_slice(rotation.matrix().as_slice());
        numbers
    }

    /// The rotation that nine numbers store.
    #[inline]
    pub fn load(x: &[f64]) -> Rotation3<f64> {
        Rotation3::from_matrix_unchecked(Matrix3::from_column_slice(&x[..9]))
    }
}

impl Manifold for RotationManifold {
    fn ambient(&self) -> usize {
        9
    }

    fn tangent(&self) -> usize {
        3
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        let turned = Rotation3::new(Vector3::from_column_slice(&delta[..3])).into_inner() * Self::load(x).matrix();
        // Products of rotations drift off the group by rounding; one step of Newton's iteration for the polar factor undoes it.
        let back = turned * (Matrix3::identity() * 3.0 - turned.transpose() * turned) * 0.5;
        moved[..9].copy_from_slice(back.as_slice());
    }
}

/// Rigid motions `x ↦ R x + t`, SE(3): twelve numbers, the rotation's matrix by columns, then `t`. Six degrees of freedom `(ω, τ)`:
/// `R ← exp([ω]×) R`, `t ← t + τ`.
///
/// The derivative of `R x + t` by `ω` is `−[R x]×`, that by `τ` the identity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RigidMotion;

impl RigidMotion {
    /// The numbers of a motion.
    pub fn store(rotation: &Rotation3<f64>, translation: &Vector3<f64>) -> [f64; 12] {
        let mut numbers = [0.0; 12];
        numbers[..9].copy_from_slice(rotation.matrix().as_slice());
        numbers[9..].copy_from_slice(translation.as_slice());
        numbers
    }

    /// Rotation and translation that twelve numbers store.
    #[inline]
    pub fn load(x: &[f64]) -> (Rotation3<f64>, Vector3<f64>) {
        (RotationManifold::load(x), Vector3::from_column_slice(&x[9..12]))
    }
}

impl Manifold for RigidMotion {
    fn ambient(&self) -> usize {
        12
    }

    fn tangent(&self) -> usize {
        6
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        RotationManifold.step(x, delta, moved);
        for k in 0..3 {
            moved[9 + k] = x[9 + k] + delta[3 + k];
        }
    }
}

/// Directions in space, the unit sphere: three numbers of length one, two degrees of freedom along [`UnitVector::basis`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UnitVector;

impl UnitVector {
    /// Two unit vectors at right angles to `v` and to each other: the derivative of the direction by its degrees of freedom.
    #[inline]
    pub fn basis(v: &Vector3<f64>) -> [Vector3<f64>; 2] {
        let axis = if v.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
        let u = v.cross(&axis).normalize();
        [u, v.cross(&u)]
    }
}

impl Manifold for UnitVector {
    fn ambient(&self) -> usize {
        3
    }

    fn tangent(&self) -> usize {
        2
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        let v = Vector3::from_column_slice(&x[..3]);
        let [a, b] = Self::basis(&v);
        moved[..3].copy_from_slice((v + a * delta[0] + b * delta[1]).normalize().as_slice());
    }
}

/// Motions between two views, `x ↦ R x + t` with a `t` of length one, as nothing tells how long it is: numbers as of [`RigidMotion`], five degrees of freedom: `ω` as there,
/// then the two of [`UnitVector`] that turn `t`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RelativeMotion;

impl Manifold for RelativeMotion {
    fn ambient(&self) -> usize {
        12
    }

    fn tangent(&self) -> usize {
        5
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        RotationManifold.step(x, delta, moved);
        UnitVector.step(&x[9..], &delta[3..], &mut moved[9..]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Moves a hundred times, and compares the first derivative with the one in the docstring.
    #[test]
    fn steps_stay_on_the_manifold_and_have_the_documented_derivatives() {
        let r = Rotation3::new(Vector3::new(0.4, -0.9, 1.3));
        let x = RigidMotion::store(&r, &Vector3::new(1.0, 2.0, 3.0));
        let point = Vector3::new(0.3, -0.7, 2.0);
        let at = |delta: [f64; 6]| {
            let mut moved = [0.0; 12];
            RigidMotion.step(&x, &delta, &mut moved);
            let (r, t) = RigidMotion::load(&moved);
            r * point + t
        };
        for k in 0..6 {
            let (mut plus, mut minus) = ([0.0; 6], [0.0; 6]);
            (plus[k], minus[k]) = (1e-5, -1e-5);
            let numeric = (at(plus) - at(minus)) / 2e-5;
            let exact = if k < 3 { Vector3::ith(k, 1.0).cross(&(r * point)) } else { Vector3::ith(k - 3, 1.0) };
            // Central differences: h² of truncation and 1e-16/h of rounding.
            assert!((numeric - exact).norm() < 1e-9, "{k}: {numeric} {exact}");
        }
        let mut state = x;
        let mut direction = [0.6, 0.0, 0.8];
        for i in 0..100 {
            let mut moved = [0.0; 12];
            RigidMotion.step(&state, &[0.3, 0.1 * f64::from(i % 7), -0.2, 0.0, 0.0, 0.0], &mut moved);
            state = moved;
            let mut next = [0.0; 3];
            UnitVector.step(&direction, &[0.5, -0.3], &mut next);
            direction = next;
        }
        let (r, _) = RigidMotion::load(&state);
        // A few roundings, not a hundred steps of them.
        assert!((r.matrix().transpose() * r.matrix() - Matrix3::identity()).norm() < 1e-15);
        assert!((Vector3::from(direction).norm() - 1.0).abs() < 1e-15);
    }
}
