//! Planes by which surfaces are extrapolated: fitted to the surroundings of a cell at the border of its surface.
//!
//! Few objects are planes. One plane for all of an object is off at its border by some pixels; one fitted to the cells at the border
//! continues it without a step and with the slope it has there. Between two parts of a surface the plane of all of it is the more accurate
//! one, above all in low texture. So each cell at a border becomes a surface of its own with two planes: that of its surface for pixels that
//! are visible in both images, and the local one for those that are not.

use crate::surfaces::{NONE, Plane, Surfaces, center, neighbors};
use cv_parallel::prelude::*;

/// Radius of the surroundings in cells, textured and textureless: disparities in low texture have errors that only a large area averages.
/// (Radii of 1 to 3 and of 6 to 12 differ by up to 0.3 points of the errors above 2 px on 20 public pairs: Middlebury, DrivingStereo, US3D.)
const RADIUS: usize = 2;
const LOW_TEXTURE_RADIUS: usize = 8;
/// Spacing of the cells of the larger surroundings.
const SPACING: usize = 2;
/// Minimum number of cells of a task.
const MIN_TASK: usize = 32;

impl Surfaces {
    /// Sets [`Surfaces::local_planes`]. Each cell with a neighbor without a surface becomes a surface of its own.
    pub(crate) fn add_local_planes(&mut self) {
        let columns = self.columns;
        let rows = self.cells.len() / columns;
        let is_open = |c: &usize| self.labels[*c] == NONE;
        let is_border = |c: &usize| !is_open(c) && neighbors(*c, columns, rows).iter().flatten().any(is_open);
        let borders: Vec<usize> = (0..self.cells.len()).filter(is_border).collect();
        let planes: Vec<Plane> = borders.par_iter().with_min_len(MIN_TASK).map(|&c| self.local_plane(c)).collect();
        self.local_planes.clone_from(&self.planes);
        for (c, plane) in borders.into_iter().zip(planes) {
            let surface = self.labels[c] as usize;
            self.labels[c] = self.planes.len() as u32;
            self.planes.push(self.planes[surface]);
            self.sizes.push(self.sizes[surface]);
            self.local_planes.push(plane);
        }
    }

    /// Fits a plane to the surroundings of a cell of a surface.
    fn local_plane(&self, c: usize) -> Plane {
        let (near, texturelessness) = self.moments_around(c, RADIUS, 1);
        let mut coefficients = near.fit();
        if texturelessness > 0.0 {
            let (far, _) = self.moments_around(c, LOW_TEXTURE_RADIUS, SPACING);
            for (near, far) in coefficients.iter_mut().zip(far.fit()) {
                *near += texturelessness * (far - *near);
            }
        }
        Plane { origin: center(c, self.columns), coefficients, range: self.planes[self.labels[c] as usize].range }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surfaces::CELL;
    use fearless_simd::Level;

    const WIDTH: usize = 160;
    const HEIGHT: usize = 96;

    /// Segments a map that is known from column 48 on, in an image of steps of `contrast` gray levels.
    fn segmented(d: impl Fn(f64, f64) -> f64, contrast: u8) -> Surfaces {
        let at = |i: usize| ((i % WIDTH) as f64, (i / WIDTH) as f64);
        let disparity = |i: usize| if i % WIDTH < 48 { f32::NAN } else { d(at(i).0, at(i).1) as f32 };
        let disparity: Vec<f32> = (0..WIDTH * HEIGHT).map(disparity).collect();
        let gray: Vec<u8> = (0..WIDTH * HEIGHT).map(|i| 90 + (i % 2) as u8 * contrast).collect();
        let mut surfaces = Surfaces::default();
        surfaces.measure_cells(Level::new(), &disparity, &gray, WIDTH);
        surfaces.segment(0.0);
        surfaces.add_local_planes();
        surfaces
    }

    #[test]
    fn a_curved_surface_is_continued_with_the_slope_of_its_border() {
        // A cylinder, whose slope is 0.13 at column 48 and 0 at the other end.
        let d = |x: f64, _: f64| 30.0 - 6e-4 * (x - 160.0).powi(2);
        let surfaces = segmented(d, 40);
        let columns = surfaces.columns;
        for y in 1..HEIGHT / CELL - 1 {
            let label = surfaces.labels[y * columns + 6] as usize;
            let (x, y) = (44.0, center(y * columns, columns).1);
            let [local, all] =
                [&surfaces.local_planes, &surfaces.planes].map(|planes| f64::from(planes[label].at(x, y)));
            // The plane is fitted to columns 48 to 71: off by 6e-4 · 24² / 6 at its end, and 4 px of a slope that changes by 0.02.
            assert!((local - d(x, y)).abs() < 0.2, "{local} for {}", d(x, y));
            assert!((all - d(x, y)).abs() > (local - d(x, y)).abs(), "{all}");
        }
    }

    #[test]
    fn cells_inside_keep_the_plane_of_their_surface() {
        let surfaces = segmented(|x, y| 10.0 + 0.05 * x + 0.02 * y, 40);
        assert_eq!(surfaces.planes.len(), surfaces.local_planes.len());
        assert_eq!(surfaces.planes.len(), surfaces.sizes.len());
        let columns = surfaces.columns;
        for (c, &label) in surfaces.labels.iter().enumerate() {
            match c % columns {
                0..6 => assert_eq!(label, NONE),
                6 => assert!(label > 0),
                _ => assert_eq!(label, 0),
            }
        }
    }

    #[test]
    fn steps_of_low_texture_are_averaged_over_a_larger_area() {
        // Whole pixels, as matches in low texture.
        let truth = |x: f64| 10.0 + 0.04 * x;
        let worst = |contrast: u8| {
            let surfaces = segmented(|x, _| truth(x).round(), contrast);
            let label = surfaces.labels[5 * surfaces.columns + 6] as usize;
            // At the border of the image.
            (f64::from(surfaces.local_planes[label].at(0.0, 44.0)) - truth(0.0)).abs()
        };
        let (textureless, textured) = (worst(0), worst(40));
        assert!(textureless < 0.3 && textureless < 0.5 * textured, "{textureless} {textured}");
    }
}
