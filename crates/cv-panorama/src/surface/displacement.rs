//! Displacement fields, and the map from panorama pixels to photograph pixels.

use crate::surface::{Bounds, Layout, Placement, Surface};
use cv_core::{Point2, Scaling, Vector2};

/// Displacement field of one photograph: a grid with bilinear interpolation over its part of the canvas.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct DisplacementField {
    /// Canvas position of the first vertex.
    left: f64,
    top: f64,
    /// Canvas pixels between vertices.
    spacing: f64,
    pub(super) columns: usize,
    pub(super) rows: usize,
    /// Displacement of the photograph's content in canvas pixels, row-major.
    pub(super) displacement: Vec<Vector2<f64>>,
    /// The same as an offset of the sampling position, in photograph pixels.
    source_shift: Vec<[f32; 2]>,
}

impl DisplacementField {
    /// Creates a zero field that covers `b`.
    pub(super) fn over(b: &Bounds, spacing: f64) -> Self {
        let columns = (b.width() as f64 / spacing).ceil() as usize + 2;
        let rows = (b.height() as f64 / spacing).ceil() as usize + 2;
        let (left, top) = (b.left as f64 - 0.5 * spacing, b.top as f64 - 0.5 * spacing);
        Self {
            left,
            top,
            spacing,
            columns,
            rows,
            displacement: vec![Vector2::zeros(); columns * rows],
            source_shift: vec![[0.0; 2]; columns * rows],
        }
    }

    /// Returns the four vertices around a canvas position and their bilinear weights; positions outside the grid are clamped.
    pub(super) fn around(&self, p: Point2<f64>) -> [(usize, f64); 4] {
        let place = |v: f64, n: usize| {
            let v = v.clamp(0.0, n as f64 - 1.0001);
            (v as usize, v - v.floor())
        };
        let (x, fx) = place((p.x - self.left) / self.spacing, self.columns);
        let (y, fy) = place((p.y - self.top) / self.spacing, self.rows);
        let i = y * self.columns + x;
        let j = i + self.columns;
        [(i, (1.0 - fx) * (1.0 - fy)), (i + 1, fx * (1.0 - fy)), (j, (1.0 - fx) * fy), (j + 1, fx * fy)]
    }

    /// Interpolates the displacement at a canvas position.
    pub(super) fn at(&self, p: Point2<f64>) -> Vector2<f64> {
        self.around(p).iter().map(|&(i, w)| self.displacement[i] * w).sum()
    }

    /// Returns the canvas position of vertex `i`.
    fn vertex(&self, i: usize) -> Point2<f64> {
        let (x, y) = (i % self.columns, i / self.columns);
        Point2::new(self.left + x as f64 * self.spacing, self.top + y as f64 * self.spacing)
    }

    /// Returns the field, on the same grid, that displaces by `before` first and then by this one.
    pub(super) fn after(mut self, before: Option<&Self>) -> Self {
        let Some(before) = before else { return self };
        for i in 0..self.displacement.len() {
            let between = self.vertex(i) - self.displacement[i];
            self.displacement[i] += before.at(between);
        }
        self
    }

    /// Returns the field for a canvas and a photograph scaled by these factors.
    pub(crate) fn scaled(&self, canvas: f64, photo: f64) -> Self {
        let place = |v: f64| Scaling::coordinate(v, canvas);
        Self {
            left: place(self.left),
            top: place(self.top),
            spacing: self.spacing * canvas,
            source_shift: self.source_shift.iter().map(|s| s.map(|v| v * photo as f32)).collect(),
            displacement: self.displacement.iter().map(|d| d * canvas).collect(),
            ..*self
        }
    }

    /// Adds the offsets to the sampling positions of one canvas row that starts at column `left`.
    #[inline(always)]
    pub(crate) fn add_row(&self, y: f64, left: f64, us: &mut [f32], vs: &mut [f32]) {
        let v = ((y - self.top) / self.spacing).clamp(0.0, self.rows as f64 - 1.0001);
        let (row, fy) = (v as usize * self.columns, v.fract() as f32);
        let vertex = |x: usize| -> [f32; 2] {
            let (a, b) = (self.source_shift[row + x], self.source_shift[row + self.columns + x]);
            [a[0] + (b[0] - a[0]) * fy, a[1] + (b[1] - a[1]) * fy]
        };
        // Exact differences of columns, so that a pixel has the same position in any part of a row.
        let whole = self.left.floor();
        let (column, fraction) = ((left - whole) as f32, (self.left - whole) as f32);
        let step = (1.0 / self.spacing) as f32;
        let last = self.columns as f32 - 1.0001;
        let position = |i: usize| ((column + i as i32 as f32 - fraction) * step).max(0.0).min(last);
        let start = (column - fraction) * step;
        let mut first = 0;
        // The pixels of a cell at a time, in a loop that is vectorized.
        while first < us.len() {
            let cell = position(first) as usize;
            // To within rounding, and beyond the last cell not at all.
            let mut end = (((cell + 1) as f32 - start) / step) as usize;
            end = end.clamp(first + 1, us.len());
            while end > first + 1 && position(end - 1) as usize != cell {
                end -= 1;
            }
            while end < us.len() && position(end) as usize == cell {
                end += 1;
            }
            let (a, b) = (vertex(cell), vertex(cell + 1));
            let slope = [b[0] - a[0], b[1] - a[1]];
            let (us, vs) = (&mut us[first..end], &mut vs[first..end]);
            for i in 0..us.len().min(vs.len()) {
                let f = position(first + i) - cell as f32;
                us[i] += a[0] + slope[0] * f;
                vs[i] += a[1] + slope[1] * f;
            }
            first = end;
        }
    }

    /// Recomputes `source_shift` from `displacement`.
    pub(super) fn update_source_shift(&mut self, placement: &Placement, surface: &Surface) {
        for i in 0..self.displacement.len() {
            let p = self.vertex(i);
            let project = |p: Point2<f64>| placement.view.project(&surface.inverse(p + placement.origin.coords));
            self.source_shift[i] = match (project(p), project(p - self.displacement[i])) {
                (Some(a), Some(b)) => [(b.x - a.x) as f32, (b.y - a.y) as f32],
                _ => [0.0; 2],
            };
        }
    }
}

/// Map from panorama pixels to photograph pixels, displacement fields included.
#[derive(Debug, Clone)]
pub struct PhotoMap {
    surface: Surface,
    /// Canvas position of panorama pixel (0, 0).
    corner: Vector2<f64>,
    pieces: Vec<(Placement, Option<DisplacementField>)>,
}

impl PhotoMap {
    pub(crate) fn new(layout: &Layout, fields: Vec<Option<DisplacementField>>) -> Self {
        let pieces = layout.placements.iter().copied().zip(fields).collect();
        Self { surface: layout.surface, corner: Vector2::zeros(), pieces }
    }

    pub(crate) fn crop(&mut self, left: usize, top: usize) {
        self.corner += Vector2::new(left as f64, top as f64);
    }

    /// Renumbers the photographs: `k` becomes `to[k]`.
    pub fn renumber(&mut self, to: &[usize]) {
        for (placement, _) in &mut self.pieces {
            placement.photo = to.get(placement.photo).copied().unwrap_or(placement.photo);
        }
    }

    /// Returns the pixel of `photo` that maps to a pixel of the panorama; `None` where the photograph does not cover it.
    pub fn source(&self, photo: usize, pixel: Point2<f64>) -> Option<Point2<f64>> {
        let p = pixel + self.corner;
        self.pieces.iter().filter(|(placement, _)| placement.photo == photo).find_map(|(placement, field)| {
            let displacement = field.as_ref().map_or_else(Vector2::zeros, |f| f.at(p));
            let ray = self.surface.inverse(p - displacement + placement.origin.coords);
            placement.view.project(&ray).filter(|q| placement.view.contains(*q))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::View;
    use crate::surface::Projection;
    use cv_core::Camera;
    use nalgebra::Rotation3;
    use proptest::prelude::*;

    const BOUNDS: Bounds = Bounds { left: 10, top: 20, right: 110, bottom: 80 };

    /// A field with an affine displacement, which interpolation reproduces exactly on the grid.
    fn affine(spacing: f64) -> DisplacementField {
        let mut field = DisplacementField::over(&BOUNDS, spacing);
        for i in 0..field.displacement.len() {
            let (x, y) = ((i % field.columns) as f64, (i / field.columns) as f64);
            let p = Point2::new(field.left + x * field.spacing, field.top + y * field.spacing);
            field.displacement[i] = displacement(p);
            field.source_shift[i] = [displacement(p).y as f32, displacement(p).x as f32];
        }
        field
    }

    fn displacement(p: Point2<f64>) -> Vector2<f64> {
        Vector2::new(1.0 + 0.02 * p.x - 0.01 * p.y, -2.0 + 0.005 * p.x + 0.03 * p.y)
    }

    proptest! {
        #[test]
        fn between_vertices_a_field_is_bilinear(x in 10.0..109.0_f64, y in 20.0..79.0_f64, spacing in 8.0..30.0_f64) {
            let field = affine(spacing);
            let p = Point2::new(x, y);
            let around = field.around(p);
            prop_assert!((around.iter().map(|a| a.1).sum::<f64>() - 1.0).abs() < 1e-12);
            // Affine functions are bilinear: rounding only.
            prop_assert!((field.at(p) - displacement(p)).norm() < 1e-9);
        }

        #[test]
        fn displacements_of_a_row_equal_those_of_single_pixels(y in 20..79_usize, left in 10..60_usize, spacing in 8.0..30.0_f64) {
            let (mut us, mut vs) = (vec![5.0; 50], vec![-3.0; 50]);
            affine(spacing).add_row(y as f64, left as f64, &mut us, &mut vs);
            for (i, (u, v)) in us.iter().zip(&vs).enumerate() {
                let want = displacement(Point2::new((left + i) as f64, y as f64));
                // Single-precision rounding of numbers up to ten.
                prop_assert!((f64::from(*u) - 5.0 - want.y).abs() < 1e-4 && (f64::from(*v) + 3.0 - want.x).abs() < 1e-4);
            }
        }

        #[test]
        fn a_pixel_has_the_same_displacement_in_any_part_of_a_row(y in 20..79_usize, split in 1..99_usize, spacing in 8.0..30.0_f64) {
            let field = affine(spacing);
            let (mut us, mut vs) = (vec![5.0; 100], vec![-3.0; 100]);
            let (mut parts_u, mut parts_v) = (us.clone(), vs.clone());
            field.add_row(y as f64, 10.0, &mut us, &mut vs);
            field.add_row(y as f64, 10.0, &mut parts_u[..split], &mut parts_v[..split]);
            field.add_row(y as f64, 10.0 + split as f64, &mut parts_u[split..], &mut parts_v[split..]);
            prop_assert!(us == parts_u && vs == parts_v);
        }

        #[test]
        fn a_scaled_field_is_the_same_field_on_a_scaled_canvas(x in 10.0..109.0_f64, y in 20.0..79.0_f64, factor in 0.1..3.0_f64) {
            let (field, p) = (affine(12.0), Point2::new(x, y));
            let there = Point2::new((x + 0.5) * factor - 0.5, (y + 0.5) * factor - 0.5);
            prop_assert!((field.scaled(factor, 1.0).at(there) - field.at(p) * factor).norm() < 1e-9);
        }
    }

    #[test]
    fn one_field_after_another_displaces_by_both() {
        let (first, mut second) = (affine(12.0), affine(7.0));
        second.displacement.iter_mut().for_each(|d| *d *= -0.5);
        let own = second.clone();
        let both = second.after(Some(&first));
        for i in 0..both.displacement.len() {
            // What the second shows at the vertex, the first shows where that came from.
            let between = own.vertex(i) - own.displacement[i];
            let source = between - first.at(between);
            assert!((own.vertex(i) - both.displacement[i] - source).norm() < 1e-9, "{i}");
        }
        assert_eq!(own.clone().after(None), own);
    }

    #[test]
    fn the_field_is_extended_by_the_nearest_position() {
        let field = affine(10.0);
        let far = field.at(Point2::new(-1000.0, 50.0));
        assert!((far - field.at(Point2::new(field.left, 50.0))).norm() < 1e-9);
        assert!(field.at(Point2::new(1e9, -1e9)).norm().is_finite());
    }

    #[test]
    fn the_source_displacement_inverts_the_field() {
        let surface = Surface { projection: Projection::Cylindrical, scale: 90.0 };
        let view = View {
            camera: Camera::from_focal(200, 150, 100.0),
            from_world: Rotation3::from_euler_angles(0.05, -0.1, 0.02).into_inner(),
        };
        let placement = Placement { photo: 0, view, bounds: BOUNDS, origin: Point2::new(-60.0, -50.0) };
        let mut field = affine(10.0);
        field.update_source_shift(&placement, &surface);
        let project = |p: Point2<f64>| view.project(&surface.inverse(p + placement.origin.coords)).unwrap();
        // At a vertex, the shifted pixel equals the source of the undisplaced position.
        for (column, row) in [(1, 1), (4, 3), (8, 5)] {
            let p = Point2::new(field.left + 10.0 * column as f64, field.top + 10.0 * row as f64);
            let (mut u, mut v) = ([project(p).x as f32], [project(p).y as f32]);
            field.add_row(p.y, p.x, &mut u, &mut v);
            let want = project(p - displacement(p));
            assert!((f64::from(u[0]) - want.x).abs() < 1e-3 && (f64::from(v[0]) - want.y).abs() < 1e-3, "{p}");
        }
        // The map agrees, where the photograph covers the canvas.
        let map = PhotoMap { surface, corner: Vector2::zeros(), pieces: vec![(placement, Some(field))] };
        let p = Point2::new(60.0, 50.0);
        assert!((map.source(0, p).unwrap() - project(p - displacement(p))).norm() < 1e-9);
        assert_eq!(map.source(1, p), None);
        let mut cropped = map.clone();
        cropped.crop(7, 3);
        assert_eq!(cropped.source(0, p - Vector2::new(7.0, 3.0)), map.source(0, p));
    }
}
