//! Where photographs were taken, and models brought to it.

use crate::Progress;
use cv_core::{Cancelled, GeodeticPoint, Point3, east_north_up};
use cv_sfm::{KnownPlaces, ModelAlignError, ModelAlignment, SfmModel, align_model};

/// Where a photograph says it was taken.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct GpsFix {
    /// The place; its altitude counts where it is told.
    pub place: GeodeticPoint,
    /// Whether the altitude is told.
    pub has_altitude: bool,
}

/// Positions of photographs in meters, by what they say themselves.
#[derive(Debug, Clone, PartialEq)]
pub struct GpsCenters {
    /// Of each photograph that counts: X east, Y north, Z up from the first of them.
    pub centers: Vec<Option<Point3<f64>>>,
    /// The place of the first.
    pub origin: GeodeticPoint,
    /// Whether heights are told; else all are in one plane.
    pub heights: bool,
}

/// Photographs that tell their height, for the others not to count.
const ENOUGH_HEIGHTS: usize = 3;

/// The positions that photographs tell in one frame; `None` where none of them tells any.
///
/// Heights are told by all that count, or by none: one that is not told is no height of 0.
pub fn gps_centers(fixes: &[Option<GpsFix>]) -> Option<GpsCenters> {
    let heights = fixes.iter().flatten().filter(|fix| fix.has_altitude).count() >= ENOUGH_HEIGHTS;
    let counts = |fix: &GpsFix| fix.has_altitude || !heights;
    let place = |fix: GpsFix| GeodeticPoint { altitude: if heights { fix.place.altitude } else { 0.0 }, ..fix.place };
    let (views, places): (Vec<usize>, Vec<GeodeticPoint>) =
        fixes.iter().enumerate().filter_map(|(i, fix)| fix.filter(counts).map(|fix| (i, place(fix)))).unzip();
    let origin = *places.first()?;
    let mut centers = vec![None; fixes.len()];
    for (i, center) in views.into_iter().zip(east_north_up(&places)) {
        centers[i] = Some(center);
    }
    Some(GpsCenters { centers, origin, heights })
}

/// How a model was brought to what is known, and what of that was left aside.
#[derive(Debug, Clone, PartialEq)]
pub struct PlacedModel {
    /// How the model was moved.
    pub alignment: ModelAlignment,
    /// Why known centers were left aside.
    pub without_centers: Option<ModelAlignError>,
    /// Why known distances were left aside.
    pub without_distances: Option<ModelAlignError>,
}

/// Brings a model to known centers of its cameras and distances between them ([`align_model`]); what contradicts it is left aside, the centers first. Where nothing holds, the model is stood
/// upright.
///
/// # Errors
/// [`ModelAlignError`] of a model that cannot even be stood upright; it stays as it is.
pub fn place_model(
    model: &mut SfmModel,
    known: &KnownPlaces<'_>,
    seed: u64,
    progress: &dyn Progress,
) -> Result<PlacedModel, ModelAlignError> {
    let (mut without_centers, mut without_distances) = (None, None);
    let alone = KnownPlaces { centers: &[], ..*known };
    let mut found = align_model(model, known, seed, progress);
    if let Err(error) = found {
        without_centers = Some(going_on(error)?);
        found = align_model(model, &alone, seed, progress);
    }
    if let Err(error) = found {
        without_distances = Some(going_on(error)?);
        found = align_model(model, &KnownPlaces::default(), seed, progress);
    }
    let alignment = found?;
    model.transform(&alignment.similarity);
    Ok(PlacedModel { alignment, without_centers, without_distances })
}

/// The error, if it is no stop.
fn going_on(error: ModelAlignError) -> Result<ModelAlignError, Cancelled> {
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
    fn heights_are_told_by_all_that_count_or_by_none() {
        let few = [fix(0.0, Some(300.0)), None, fix(1e-6, None), fix(2e-6, Some(310.0))];
        let found = gps_centers(&few).unwrap();
        assert_eq!(found.centers.iter().map(Option::is_some).collect::<Vec<_>>(), [true, false, true, true]);
        // A radian of latitude is the meridian's radius, at 46° 6,368 km on the ellipsoid: 6.4 m to a microradian. Within meters the plane lies on it to micrometers.
        let second = found.centers[2].unwrap();
        assert!(!found.heights && (second.y - 6.37).abs() < 0.01 && second.x.abs() < 1e-6 && second.z.abs() < 1e-4);
        let many = [few[0], few[2], few[3], fix(3e-6, Some(305.0))];
        let found = gps_centers(&many).unwrap();
        assert!(found.heights && found.centers[1].is_none() && (found.centers[2].unwrap().z - 10.0).abs() < 1e-3);
        assert_eq!(found.origin.altitude, 300.0);
        assert_eq!(gps_centers(&[None, None]), None);
    }
}
