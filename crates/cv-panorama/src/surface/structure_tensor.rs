//! The structure tensor of a patch: corners, edges and low texture.

use cv_core::Vector2;

/// Eigenvalues of the mean structure tensor of a patch (Shi & Tomasi 1994).
pub(super) struct StructureTensor {
    /// The larger and the smaller eigenvalue.
    pub(super) strengths: [f32; 2],
    /// Unit eigenvector of the larger.
    pub(super) normal: Vector2<f64>,
}

/// Minimum larger eigenvalue of an edge: gradients of 6 gray levels per pixel.
const MIN_EDGE_STRENGTH: f32 = 36.0;
/// Minimum ratio of the eigenvalues of an edge. Texture such as grass around a painted line leaves little more.
const MIN_EDGE_RATIO: f32 = 1.5;

impl StructureTensor {
    /// Returns whether there is one direction only, or little more.
    pub(super) fn is_edge(&self) -> bool {
        self.strengths[0] >= MIN_EDGE_STRENGTH && self.strengths[0] >= MIN_EDGE_RATIO * self.strengths[1]
    }

    /// Computes the tensor of a square patch, row-major.
    pub(super) fn of(patch: &[f32]) -> Self {
        let side = patch.len().isqrt();
        let (mut xx, mut xy, mut yy) = (0.0, 0.0, 0.0);
        for r in 1..side - 1 {
            for c in 1..side - 1 {
                let i = r * side + c;
                let (gx, gy) = (0.5 * (patch[i + 1] - patch[i - 1]), 0.5 * (patch[i + side] - patch[i - side]));
                xx += gx * gx;
                xy += gx * gy;
                yy += gy * gy;
            }
        }
        let n = ((side - 2) * (side - 2)) as f32;
        let (mean, half) = (0.5 * (xx + yy), (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt());
        let angle = 0.5 * f64::from(2.0 * xy).atan2(f64::from(xx - yy));
        StructureTensor {
            strengths: [(mean + half) / n, (mean - half) / n],
            normal: Vector2::new(angle.cos(), angle.sin()),
        }
    }
}
