//! Geodetic positions, and their conversion to a local east-north-up frame.

use nalgebra::{Point3, Rotation3, Vector3};

/// Semi-major axis of WGS 84 in meters, and its flattening (NIMA TR 8350.2, table 3.1).
const SEMI_MAJOR_AXIS: f64 = 6_378_137.0;
const FLATTENING: f64 = 1.0 / 298.257_223_563;

/// A geodetic position on the WGS 84 ellipsoid, as GPS receivers report it.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct GeodeticPoint {
    /// Radians, −π/2 to π/2, north positive.
    pub latitude: f64,
    /// Radians, −π to π, east positive.
    pub longitude: f64,
    /// Meters above the ellipsoid. Altitudes above sea level, which differ by up to 100 m, serve as well within a scene.
    pub altitude: f64,
}

impl GeodeticPoint {
    /// Computes Earth-centered, Earth-fixed (ECEF) coordinates in meters: X to latitude and longitude 0, Z to the north pole.
    pub fn earth_centered(&self) -> Point3<f64> {
        let (sin_lat, cos_lat) = self.latitude.sin_cos();
        let (sin_lon, cos_lon) = self.longitude.sin_cos();
        let eccentricity2 = FLATTENING * (2.0 - FLATTENING);
        // Radius of curvature in the prime vertical.
        let prime_vertical = SEMI_MAJOR_AXIS / (1.0 - eccentricity2 * sin_lat * sin_lat).sqrt();
        let radius = (prime_vertical + self.altitude) * cos_lat;
        Point3::new(
            radius * cos_lon,
            radius * sin_lon,
            (prime_vertical * (1.0 - eccentricity2) + self.altitude) * sin_lat,
        )
    }
}

/// Converts positions to meters in the local tangent frame at the first, which is the origin: X east, Y north, Z up
/// (Hofmann-Wellenhof et al., “GNSS”, section 8.2). A NaN altitude makes its own position NaN; a NaN altitude of the first makes all NaN.
pub fn east_north_up(positions: &[GeodeticPoint]) -> Vec<Point3<f64>> {
    let Some(first) = positions.first() else { return Vec::new() };
    let origin = first.earth_centered();
    let (sin_lat, cos_lat) = first.latitude.sin_cos();
    let (sin_lon, cos_lon) = first.longitude.sin_cos();
    let east = Vector3::new(-sin_lon, cos_lon, 0.0);
    let up = Vector3::new(cos_lat * cos_lon, cos_lat * sin_lon, sin_lat);
    let to_local = Rotation3::from_basis_unchecked(&[east, up.cross(&east), up]).inverse();
    positions.iter().map(|position| Point3::from(to_local * (position.earth_centered() - origin))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(latitude: f64, longitude: f64, altitude: f64) -> GeodeticPoint {
        GeodeticPoint { latitude: latitude.to_radians(), longitude: longitude.to_radians(), altitude }
    }

    #[test]
    fn earth_centered_coordinates_on_the_axes_of_the_ellipsoid() {
        // Semi-minor axis of WGS 84: 6356752.3142 m.
        let near =
            |p: GeodeticPoint, x, y, z| assert!((p.earth_centered() - Point3::new(x, y, z)).norm() < 1e-4, "{p:?}");
        near(at(0.0, 0.0, 10.0), 6_378_147.0, 0.0, 0.0);
        near(at(0.0, 90.0, 0.0), 0.0, 6_378_137.0, 0.0);
        near(at(90.0, 33.0, 0.0), 0.0, 0.0, 6_356_752.314_2);
        near(at(-90.0, 0.0, -5.0), 0.0, 0.0, -6_356_747.314_2);
    }

    #[test]
    fn lengths_of_a_degree_match_published_tables() {
        // Kilometers per degree of latitude and of longitude on WGS 84, from published tables, to their last digit.
        for (latitude, north, east) in [(0.0, 110.574, 111.320), (30.0, 110.852, 96.486), (60.0, 111.412, 55.800)] {
            for sign in [1.0, -1.0] {
                let step = 1e-3;
                let points = [
                    at(sign * latitude, 170.0, 5.0),
                    at(sign * latitude + step, 170.0, 5.0),
                    at(sign * latitude, 170.0 + step, 5.0),
                ];
                let local = east_north_up(&points);
                assert_eq!(local[0], Point3::origin());
                // At 5 m of altitude a degree is 0.1 m longer.
                assert!((local[1].y / step - 1e3 * north).abs() < 0.7 && local[1].x.abs() < 1e-6, "{local:?}");
                assert!((local[2].x / step - 1e3 * east).abs() < 0.7, "{local:?}");
            }
        }
    }

    #[test]
    fn up_is_altitude_and_distant_points_drop_by_the_earths_curvature() {
        let points = [at(47.0, 8.0, 400.0), at(47.0, 8.0, 425.5), at(47.01, 8.0, 400.0)];
        let local = east_north_up(&points);
        // Earth-centered meters have 1e-9 of rounding.
        assert!((local[1] - Point3::new(0.0, 0.0, 25.5)).norm() < 1e-7);
        // The drop is d² / 2R, R between 6.33e6 and 6.4e6.
        let (d, drop) = (local[2].y, -local[2].z);
        assert!((1111.0..1113.0).contains(&d) && (d * d / 12.8e6..d * d / 12.66e6).contains(&drop), "{d} {drop}");
        assert!(east_north_up(&[]).is_empty());
    }

    #[test]
    fn positions_across_the_date_line_are_near() {
        let local = east_north_up(&[at(10.0, 179.9995, 0.0), at(10.0, -179.9995, 0.0)]);
        assert!((109.0..110.0).contains(&local[1].x), "{local:?}");
    }
}
