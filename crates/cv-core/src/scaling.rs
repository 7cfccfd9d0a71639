//! Pixel coordinates under image resizing.

use nalgebra::Point2;

/// Maps pixel coordinates from an image to its resized version.
///
/// Image edges are aligned, not the centers of the corner pixels: with pixel centers at integers, an image of width `w` covers
/// −½ … w − ½, so `x` becomes `(x + ½) s − ½`. This type is the only place of this formula; [`crate::Camera::scaled`] and
/// [`crate::Camera::resized`] use it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Scaling {
    /// Width of the result over that of the original.
    pub x: f64,
    /// Height of the result over that of the original.
    pub y: f64,
}

impl Scaling {
    /// Makes a scaling by the same factor in both directions.
    pub const fn uniform(factor: f64) -> Self {
        Self { x: factor, y: factor }
    }

    /// Makes the scaling from images of size `from` (width, height) to size `to`. Not finite where `from` is empty.
    pub fn between(from: (usize, usize), to: (usize, usize)) -> Self {
        Self { x: to.0 as f64 / from.0 as f64, y: to.1 as f64 / from.1 as f64 }
    }

    /// Returns the inverse, from the resized image to the original.
    pub fn inverse(&self) -> Self {
        Self { x: 1.0 / self.x, y: 1.0 / self.y }
    }

    /// Returns the factor for lengths without a direction: the geometric mean of both factors.
    pub fn length(&self) -> f64 {
        (self.x * self.y).sqrt()
    }

    /// Maps one coordinate by `factor`.
    #[inline(always)]
    pub fn coordinate(v: f64, factor: f64) -> f64 {
        (v + 0.5) * factor - 0.5
    }

    /// Maps a position in the original image to the resized image.
    #[inline(always)]
    pub fn point(&self, p: Point2<f64>) -> Point2<f64> {
        Point2::new(Self::coordinate(p.x, self.x), Self::coordinate(p.y, self.y))
    }

    /// As [`Self::point`], for positions in single precision.
    #[inline(always)]
    pub fn point_f32(&self, p: Point2<f32>) -> Point2<f32> {
        self.point(p.cast()).cast()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn image_edges_are_aligned_and_half_resolution_pixels_are_centered_between_four() {
        let halved = Scaling::between((640, 480), (320, 240));
        assert_eq!(halved, Scaling::uniform(0.5));
        for edge in [-0.5, 639.5] {
            assert_eq!(halved.point(Point2::new(edge, -0.5)).x, if edge < 0.0 { -0.5 } else { 319.5 });
        }
        // The pixels 0 and 1 become pixel 0: its center is between theirs.
        assert_eq!(halved.point(Point2::new(0.5, 1.0)), Point2::new(0.0, 0.25));
        assert_eq!(halved.point_f32(Point2::new(0.5, 1.0)), Point2::new(0.0, 0.25));
    }

    #[test]
    fn the_inverse_leads_back() {
        let scaling = Scaling::between((641, 479), (100, 75));
        let p = Point2::new(17.25, 401.0);
        // Six roundings of numbers below a thousand.
        assert!((scaling.inverse().point(scaling.point(p)) - p).norm() < 1e-12);
    }
}
