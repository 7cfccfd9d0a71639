//! Manifolds of parameter blocks: rotations, rigid motions, directions.

use nalgebra::{Matrix3, Rotation3, Vector3};

/// The manifold on which the parameters of a block live.
///
/// A block is stored as [`Manifold::ambient`] numbers and updated by a tangent vector of [`Manifold::tangent`] numbers, its degrees
/// of freedom, in local coordinates at its present value (Hertzberg et al., "Integrating generic sensor fusion algorithms with sound state
/// representations through encapsulation of manifolds", Information Fusion 2013). Derivatives of residuals are by the tangent
/// coordinates at zero.
pub trait Manifold: Send + Sync {
    /// Ambient dimension: the numbers that store a block.
    fn ambient(&self) -> usize;
    /// Tangent dimension: the degrees of freedom of a block, at most 64.
    fn tangent(&self) -> usize;
    /// Writes `x ⊞ delta` (the retraction of the tangent vector `delta` at `x`) to `moved`. A zero `delta` gives `x`, up to rounding.
    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]);
}

/// Euclidean space of the given dimension.
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

/// Rotations, SO(3): nine numbers, the matrix column-major. Three degrees of freedom `ω`, in radians: `R ← exp([ω]×) R`.
///
/// The derivative of `R x` by `ω` is therefore `−[R x]×`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RotationManifold;

impl RotationManifold {
    /// Converts a rotation to its nine numbers.
    pub fn store(rotation: &Rotation3<f64>) -> [f64; 9] {
        let mut numbers = [0.0; 9];
        numbers.copy_from_slice(rotation.matrix().as_slice());
        numbers
    }

    /// Converts nine numbers to the rotation.
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
        let product = Rotation3::new(Vector3::from_column_slice(&delta[..3])).into_inner() * Self::load(x).matrix();
        // Rounding makes products of rotations drift off SO(3); one Newton step for the polar factor re-orthogonalizes.
        let orthogonal = product * (Matrix3::identity() * 3.0 - product.transpose() * product) * 0.5;
        moved[..9].copy_from_slice(orthogonal.as_slice());
    }
}

/// Rigid motions `x ↦ R x + t`, SE(3): twelve numbers, the rotation matrix column-major, then `t`. Six degrees of freedom `(ω, τ)`:
/// `R ← exp([ω]×) R`, `t ← t + τ`.
///
/// The derivative of `R x + t` by `ω` is `−[R x]×`, that by `τ` the identity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RigidMotion;

impl RigidMotion {
    /// Converts a rigid motion to its twelve numbers.
    pub fn store(rotation: &Rotation3<f64>, translation: &Vector3<f64>) -> [f64; 12] {
        let mut numbers = [0.0; 12];
        numbers[..9].copy_from_slice(rotation.matrix().as_slice());
        numbers[9..].copy_from_slice(translation.as_slice());
        numbers
    }

    /// Converts twelve numbers to rotation and translation.
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
    /// Returns an orthonormal basis of the tangent plane at `v`: the derivative of the direction by its degrees of freedom.
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

/// Relative motions of two views up to scale, `x ↦ R x + t` with `‖t‖ = 1`: numbers as for [`RigidMotion`], five degrees of freedom:
/// `ω` as there, then the two of [`UnitVector`] for `t`.
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

    /// Takes a hundred steps, and compares the first derivative with the documented one.
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
        // A few roundings: drift does not accumulate over the hundred steps.
        assert!((r.matrix().transpose() * r.matrix() - Matrix3::identity()).norm() < 1e-15);
        assert!((Vector3::from(direction).norm() - 1.0).abs() < 1e-15);
    }
}
