//! Absolute orientation: the least-squares similarity between two point sets.

use crate::error::{Degeneracy, EstimateError};
use cv_core::{Matrix3, Point3, Rotation3, Vector3};
use cv_numeric::svd3;

/// A similarity transformation `b = scale · R a + t`.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Similarity {
    /// Scale factor, above 0.
    pub scale: f64,
    /// First frame to second.
    pub rotation: Rotation3<f64>,
    /// Translation in the second frame.
    pub translation: Vector3<f64>,
}

impl Similarity {
    /// Transforms a point to the second frame.
    pub fn transform(&self, p: &Point3<f64>) -> Point3<f64> {
        Point3::from(self.rotation * p.coords * self.scale + self.translation)
    }
}

/// The degrees of freedom of a similarity that are estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SimilarityFreedom {
    /// Whether the scale is estimated; otherwise it is 1.
    pub scale: bool,
    /// Whether any rotation is allowed; otherwise only rotations about Z (both frames have Z up).
    pub tilt: bool,
}

/// Estimates the least-squares similarity (or, without `with_scale`, rigid motion) from points `a` to points `b`
/// (absolute orientation: Umeyama, "Least-squares estimation of transformation parameters between two point patterns",
/// 1991).
///
/// # Errors
/// [`EstimateError`]: fewer than three pairs (by the shorter list), a coordinate that is not finite, or coincident or
/// collinear points.
pub fn align_points(a: &[Point3<f64>], b: &[Point3<f64>], with_scale: bool) -> Result<Similarity, EstimateError> {
    let weights = vec![1.0; a.len().min(b.len())];
    align_points_weighted(a, b, &weights, SimilarityFreedom { scale: with_scale, tilt: true })
}

/// Estimates a similarity as [`align_points`], with a nonnegative weight for each pair. Without `tilt`, collinear
/// points are sufficient if their line is not vertical.
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
    let is_valid = |p: &Point3<f64>| p.iter().all(|v| v.abs() <= 1e12);
    if let Some(index) = (0..n).find(|&i| !is_valid(&a[i]) || !is_valid(&b[i])) {
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
    let mut variance = 0.0;
    for ((p, q), w) in a.iter().zip(b).zip(weights) {
        let (p, q) = (p.coords - ma, q.coords - mb);
        covariance += q * p.transpose() * *w;
        variance += p.norm_squared() * w;
    }
    let (rotation, trace) =
        if freedom.tilt { optimal_rotation(&covariance)? } else { optimal_rotation_about_z(&covariance, variance)? };
    let scale = if freedom.scale { trace / variance } else { 1.0 };
    // With rotations about Z only, the heights may be anticorrelated.
    if scale <= 0.0 || scale.is_nan() {
        return Err(coincident);
    }
    Ok(Similarity { scale, rotation, translation: mb - rotation * ma * scale })
}

/// Computes the rotation that maximizes `tr(Rᵀ Σ)`, and the maximum.
fn optimal_rotation(covariance: &Matrix3<f64>) -> Result<(Rotation3<f64>, f64), EstimateError> {
    let coincident = EstimateError::Degenerate { kind: Degeneracy::Coincident };
    let svd = svd3(covariance).map_err(|_| coincident)?;
    if svd.s[0] <= 1e-24 {
        return Err(coincident);
    }
    // A product of two extents: 1e-12 corresponds to 1e-6 of the length.
    if svd.s[1] <= 1e-12 * svd.s[0] {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Collinear });
    }
    // U and V are proper rotations: the last singular value carries the sign.
    Ok((svd.nearest_rotation(), svd.s.sum()))
}

/// Computes the same among rotations about Z.
fn optimal_rotation_about_z(covariance: &Matrix3<f64>, variance: f64) -> Result<(Rotation3<f64>, f64), EstimateError> {
    let cos = covariance.m11 + covariance.m22;
    let sin = covariance.m21 - covariance.m12;
    let norm = cos.hypot(sin);
    if variance <= 1e-24 || norm <= 1e-12 * variance {
        return Err(EstimateError::Degenerate { kind: Degeneracy::Coincident });
    }
    let (cos, sin) = (cos / norm, sin / norm);
    let rotation = Rotation3::from_matrix_unchecked(Matrix3::new(cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0));
    Ok((rotation, norm + covariance.m33))
}
