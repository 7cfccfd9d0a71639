//! Standard deviation of filled disparities.

use crate::PixelState;

/// How far the surface of a cell was extrapolated.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Extrapolation {
    /// Geodesic distance from the surface in units of [`crate::surface_filling`]; 0 for cells of the surface.
    pub(crate) distance: f32,
    /// Largest difference in px between the surface and others of the neighboring cells.
    pub(crate) ambiguity: f32,
}

/// Standard deviation in px of pixels in cells of the surface itself.
const INTERPOLATED_SIGMA: f32 = 1.2;
/// Standard deviation in px of extrapolated pixels at distance 0, and its increase per unit of distance.
const SIGMA_AT_SURFACE: f32 = 0.4;
const SIGMA_PER_DISTANCE: f32 = 0.27;
/// Distance from which on it is constant for pixels in view: low-texture surfaces that are extrapolated so far are large.
const MAX_DISTANCE: f32 = 12.0;
/// Standard deviation per px of ambiguity, for occluded pixels and for others, and the distance at which it is fully applied.
const AMBIGUITY_WEIGHTS: (f32, f32) = (0.1, 0.6);
const AMBIGUOUS_DISTANCE: f32 = 10.0;

impl Extrapolation {
    /// Returns the standard deviation in px of a filled pixel.
    ///
    /// Fitted to the 68 % quantile of the errors of 23 public pairs (Middlebury, DrivingStereo, US3D), by state, distance and ambiguity. The
    /// tails are heavy: where the surface is the wrong one, errors are as large as the depth discontinuity.
    pub(crate) fn sigma(&self, state: PixelState) -> f32 {
        if self.distance == 0.0 {
            return INTERPOLATED_SIGMA;
        }
        let is_in_view = state == PixelState::Mismatched;
        let distance = if is_in_view { self.distance.min(MAX_DISTANCE) } else { self.distance };
        let weight = if state == PixelState::Occluded { AMBIGUITY_WEIGHTS.0 } else { AMBIGUITY_WEIGHTS.1 };
        let ambiguity = weight * self.ambiguity * (self.distance / AMBIGUOUS_DISTANCE).min(1.0);
        (SIGMA_AT_SURFACE + SIGMA_PER_DISTANCE * distance).max(ambiguity)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_deviation_grows_with_distance_and_ambiguity() {
        let near = Extrapolation { distance: 1.0, ambiguity: 0.0 };
        let far = Extrapolation { distance: 20.0, ..near };
        let ambiguous = Extrapolation { ambiguity: 40.0, ..far };
        for state in [PixelState::Occluded, PixelState::Mismatched, PixelState::OutOfView] {
            assert!(near.sigma(state) < far.sigma(state) && far.sigma(state) <= ambiguous.sigma(state), "{state:?}");
        }
        assert_eq!(Extrapolation::default().sigma(PixelState::Mismatched), INTERPOLATED_SIGMA);
    }
}
