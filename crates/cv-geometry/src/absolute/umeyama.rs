//! The similarity between two clouds of points.

use crate::error::{Degeneracy, EstimateError};
use cv_core::{Matrix3, Point3, Rotation3, Vector3};
use cv_numeric::svd3;

/// `b = scale · R a + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Similarity {
    /// Above 0.
    pub scale: f64,
    /// First frame to second.
    pub rotation: Rotation3<f64>,
    /// In the second frame.
    pub translation: Vector3<f64>,
}

impl Similarity {
    /// The point in the second frame.
    pub fn transform(&self, p: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.rotation * p.coords * self.scale + self.translation)
    }
}

/// What of a similarity is to be found.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SimilarityFreedom {
    /// The scale, which else is 1.
    pub scale: bool,
    /// Any rotation; else one about Z, where both frames have Z up.
    pub tilt: bool,
}

/// The similarity (or, without `with_scale`, the rigid motion) that brings the points `a` nearest to the points `b` in the sense of least
/// squares (absolute orientation: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", 1991). One
/// solution.
///
/// # Errors
/// [`EstimateError`]: fewer than three pairs (the shorter list counts), a coordinate that is not finite, or points on a line.
pub fn align_points(a: &[Point3<f64>], b: &[Point3<f64>], with_scale: bool) -> Result<Similarity, EstimateError> {
    let weights = vec![1.0; a.len().min(b.len())];
    align_points_weighted(a, b, &weights, SimilarityFreedom { scale: with_scale, tilt: true })
}

/// [`align_points`] with a weight of 0 or more for each pair. Without `tilt`, points on a line that is not vertical will do.
pub(crate) fn align_points_weighted(
    a: &[Point3<f64>],
    b: &[Point3<f64>],
    weights: &[f64],
    freedom: SimilarityFreedom,
) -> Result<Similarity, EstimateError> {
    let n = a.len().min(b.len()).min(weights.len());
    if n < 3 {
        return Err(EstimateError::NotEnoughMatches { got: n, needed: 3 });
    }
    let usable = |p: &Point3<f64>| p.iter().all(|v| v.abs() <= 1e12);
    if let Some(index) = (0..n).find(|&i| !usable(&a[i]) || !usable(&b[i])) {
        return Err(EstimateError::NotFinite { index });
    }
    let coincident = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let total: f64 = weights[..n].iter().sum();
    if total <= 0.0 {
        return Err(coincident);
    }
    let mean = |p: &[Point3<f64>]| p.iter().zip(weights).map(|(p, w)| p.coords * *w).sum::<Vector3<f64>>() / total;
    let (ma, mb) = (mean(&a[..n]), mean(&b[..n]));
    let mut covariance = Matrix3::zeros();
    let mut spread = 0.0;
    for ((p, q), w) in a.iter().zip(b).zip(weights) {
        let (p, q) = (p.coords - ma, q.coords - mb);
        covariance += q * p.transpose() * *w;
        spread += p.norm_squared() * w;
    }
    let (rotation, trace) = if freedom.tilt { turn(&covariance)? } else { turn_about_z(&covariance, spread)? };
    let scale = if freedom.scale { trace / spread } else { 1.0 };
    // Turned about Z, what is higher in one may be lower in the other.
    if scale <= 0.0 || scale.is_nan() {
        return Err(coincident);
    }
    Ok(Similarity { scale, rotation, translation: mb - rotation * ma * scale })
}

/// The rotation of largest `tr(Rᵀ Σ)`, and that.
fn turn(covariance: &Matrix3<f64>) -> Result<(Rotation3<f64>, f64), EstimateError> {
    let coincident = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let svd = svd3(covariance).map_err(|_| coincident)?;
    if svd.s[0] <= 1e-24 {
        return Err(coincident);
    }
    // The second largest spread, as a product of two: 1e-12 is 1e-6 of the length.
    if svd.s[1] <= 1e-12 * svd.s[0] {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Collinear });
    }
    // U and V are proper rotations: the last singular value carries the sign.
    Ok((svd.nearest_rotation(), svd.s.sum()))
}

/// The same among rotations about Z.
fn turn_about_z(covariance: &Matrix3<f64>, spread: f64) -> Result<(Rotation3<f64>, f64), EstimateError> {
    let cos = covariance.m11 + covariance.m22;
    let sin = covariance.m21 - covariance.m12;
    let level = cos.hypot(sin);
    if spread <= 1e-24 || level <= 1e-12 * spread {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Coincident });
    }
    let (cos, sin) = (cos / level, sin / level);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0));
    Ok((rotation, level + covariance.m33))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::{gauss, uniform};
    use rand_chacha::ChaCha8Rng;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn exact_points_give_every_entry_also_on_a_plane() {
        for seed in 0..50 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let truth = Similarity {
                scale: 0.2 + 3.0 * uniform(&mut rng),
                rotation: Rotation3::new(Vector3::from_fn(|_, _| gauss(&mut rng))),
                translation: Vector3::from_fn(|_, _| 10.0 * gauss(&mut rng)),
            };
            // Three points are always on a plane; every other cloud is flat.
            let n = 3 + seed as usize % 5;
            let flat = if seed % 2 == 0 { 0.0 } else { 1.0 };
            let a: Vec<_> =
                (0..n).map(|_| Point3::new(gauss(&mut rng), gauss(&mut rng), 5.0 + flat * gauss(&mut rng))).collect();
            let b: Vec<_> = a.iter().map(|p| truth.transform(p)).collect();
            let found = align_points(&a, &b, true).unwrap();
            assert!((found.scale / truth.scale - 1.0).abs() < 1e-9);
            assert!((found.rotation.matrix() - truth.rotation.matrix()).norm() < 1e-6);
            assert!((found.translation - truth.translation).norm() < 1e-6);
            let b: Vec<_> = a.iter().map(|p| Point3::from(truth.rotation * p.coords + truth.translation)).collect();
            let rigid = align_points(&a, &b, false).unwrap();
            assert!(rigid.scale == 1.0 && (rigid.translation - truth.translation).norm() < 1e-6);
        }
    }

    #[test]
    fn a_mirrored_cloud_still_gives_a_rotation() {
        let a = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0], [0.0, 0.0, 0.1]].map(Point3::from);
        let b = a.map(|p| Point3::new(-p.x, p.y, p.z));
        assert!((align_points(&a, &b, true).unwrap().rotation.matrix().determinant() - 1.0).abs() < 1e-12);
    }

    #[test]
    fn bad_input_gets_a_typed_answer() {
        let line: Vec<_> = (0..5).map(|i| Point3::new(f64::from(i), 2.0 * f64::from(i), 1.0)).collect();
        let kind = |a: &[Point3<f64>]| align_points(a, a, true).unwrap_err();
        assert_eq!(kind(&line), EstimateError::Degenerate { kind: Degeneracy::Collinear });
        assert_eq!(kind(&[line[1]; 4]), EstimateError::Degenerate { kind: Degeneracy::Coincident });
        assert_eq!(kind(&line[..2]), EstimateError::NotEnoughMatches { got: 2, needed: 3 });
        assert_eq!(kind(&[Point3::new(f64::NAN, 0.0, 0.0); 3]), EstimateError::NotFinite { index: 0 });
    }
}
