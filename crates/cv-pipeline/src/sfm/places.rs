//! GPS positions of photographs, and the alignment of models to measurements.

use crate::Progress;
use cv_core::{Cancelled, GeodeticPoint, Point3, east_north_up};
use cv_sfm::{KnownPlaces, ModelAlignError, ModelAlignment, SfmModel, align_model};

/// The GPS position of a photograph.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GpsFix {
    /// The position; the altitude is valid only if `has_altitude`.
    pub place: GeodeticPoint,
    /// Whether the altitude is known.
    pub has_altitude: bool,
}

/// Camera centers from GPS positions, in a local frame in meters.
#[derive(Debug, Clone, PartialEq)]
pub struct GpsCenters {
    /// By photograph: X east, Y north, Z up, relative to the first; `None` where unused.
    pub centers: Vec<Option<Point3<f64>>>,
    /// The position of the first.
    pub origin: GeodeticPoint,
    /// Whether altitudes are used; else all centers are in a plane.
    pub has_heights: bool,
}

/// Minimum number of photographs with an altitude for altitudes to be used; photographs without one are then unused.
const MIN_ALTITUDES: usize = 3;

/// Converts GPS positions to one local frame; `None` without any.
///
/// Altitudes are used for all centers or for none: a missing altitude is not 0.
pub fn gps_centers(fixes: &[Option<GpsFix>]) -> Option<GpsCenters> {
    let has_heights = fixes.iter().flatten().filter(|fix| fix.has_altitude).count() >= MIN_ALTITUDES;
    let is_usable = |fix: &GpsFix| fix.has_altitude || !has_heights;
    let place =
        |fix: GpsFix| GeodeticPoint { altitude: if has_heights { fix.place.altitude } else { 0.0 }, ..fix.place };
    let (views, positions): (Vec<usize>, Vec<GeodeticPoint>) =
        fixes.iter().enumerate().filter_map(|(i, fix)| fix.filter(is_usable).map(|fix| (i, place(fix)))).unzip();
    let origin = *positions.first()?;
    let mut centers = vec![None; fixes.len()];
    for (i, center) in views.into_iter().zip(east_north_up(&positions)) {
        centers[i] = Some(center);
    }
    Some(GpsCenters { centers, origin, has_heights })
}

/// The alignment of a model, and the measurements that were rejected.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacedModel {
    /// The alignment.
    pub alignment: ModelAlignment,
    /// Why known centers were rejected.
    pub without_centers: Option<ModelAlignError>,
    /// Why known distances were rejected.
    pub without_distances: Option<ModelAlignError>,
}

/// Aligns a model to known camera centers and distances ([`align_model`]). Contradictory measurements are rejected, the
/// centers first; without measurements the model is made upright.
///
/// # Errors
/// [`ModelAlignError`] for a model that cannot be made upright; it is unchanged.
pub fn place_model(
    model: &mut SfmModel,
    known: &KnownPlaces<'_>,
    seed: u64,
    progress: &dyn Progress,
) -> Result<PlacedModel, ModelAlignError> {
    let (mut without_centers, mut without_distances) = (None, None);
    let distances_only = KnownPlaces { centers: &[], ..*known };
    let mut result = align_model(model, known, seed, progress);
    if let Err(error) = result {
        without_centers = Some(unless_cancelled(error)?);
        result = align_model(model, &distances_only, seed, progress);
    }
    if let Err(error) = result {
        without_distances = Some(unless_cancelled(error)?);
        result = align_model(model, &KnownPlaces::default(), seed, progress);
    }
    let alignment = result?;
    model.transform(&alignment.similarity);
    Ok(PlacedModel { alignment, without_centers, without_distances })
}

/// Returns the error, unless the job was cancelled.
fn unless_cancelled(error: ModelAlignError) -> Result<ModelAlignError, Cancelled> {
    match error {
        ModelAlignError::Cancelled(stop) => Err(stop),
        other => Ok(other),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fix(north: f64, altitude: Option<f64>) -> Option<GpsFix> {
        let place = GeodeticPoint { latitude: 0.8 + north, longitude: 0.1, altitude: altitude.unwrap_or(0.0) };
        Some(GpsFix { place, has_altitude: altitude.is_some() })
    }

    #[test]
    fn altitudes_are_used_for_all_centers_or_none() {
        let few = [fix(0.0, Some(300.0)), None, fix(1e-6, None), fix(2e-6, Some(310.0))];
        let found = gps_centers(&few).unwrap();
        assert_eq!(found.centers.iter().map(Option::is_some).collect::<Vec<_>>(), [true, false, true, true]);
        // A radian of latitude is the meridional radius of curvature, at 46° 6,368 km on the ellipsoid: 6.4 m for a
        // microradian. Within meters the tangent plane is exact to micrometers.
        let second = found.centers[2].unwrap();
        assert!(!found.has_heights && (second.y - 6.37).abs() < 0.01 && second.x.abs() < 1e-6 && second.z.abs() < 1e-4);
        let many = [few[0], few[2], few[3], fix(3e-6, Some(305.0))];
        let found = gps_centers(&many).unwrap();
        assert!(found.has_heights && found.centers[1].is_none() && (found.centers[2].unwrap().z - 10.0).abs() < 1e-3);
        assert_eq!(found.origin.altitude, 300.0);
        assert_eq!(gps_centers(&[None, None]), None);
    }
}
