//! Anti-aliased drawing on an RGB image.

use cv_core::{ImageView, RgbU8};

use crate::font;

/// An sRGB color.
pub type Color = [u8; 3];

/// Colors that are distinguishable with color blindness (after Okabe & Ito), and grays.
pub mod colors {
    use super::Color;
    /// Correct or accepted: inliers, true positives.
    pub const GREEN: Color = [40, 225, 115];
    /// Wrong or rejected: outliers, false positives.
    pub const RED: Color = [235, 60, 45];
    /// A third class, such as false negatives.
    pub const BLUE: Color = [40, 140, 255];
    /// A warning, or the second of two series.
    pub const ORANGE: Color = [240, 160, 20];
    /// Markers on images.
    pub const YELLOW: Color = [250, 225, 60];
    /// Markers on dark backgrounds.
    pub const CYAN: Color = [70, 200, 235];
    /// A further series.
    pub const MAGENTA: Color = [225, 90, 185];
    /// White background.
    pub const WHITE: Color = [255, 255, 255];
    /// Black.
    pub const BLACK: Color = [0, 0, 0];
    /// Invalid pixels of a map.
    pub const UNKNOWN: Color = [104, 104, 108];
}

/// An RGB canvas. Positions are pixels with centers at integers; drawing is clipped to the canvas.
#[derive(Debug, Clone, PartialEq)]
pub struct Raster {
    image: RgbU8,
}

impl Raster {
    /// Makes a canvas of one color.
    ///
    /// # Panics
    /// Where `width × height × 3` overflows.
    pub fn new(width: usize, height: usize, fill: Color) -> Self {
        Self { image: RgbU8::new(width, height, fill) }
    }

    /// Makes a canvas with a copy of a color image.
    pub fn from_rgb(view: ImageView<'_, u8, 3>) -> Self {
        Self { image: view.to_image() }
    }

    /// Makes a canvas with a copy of a gray image.
    pub fn from_gray(view: ImageView<'_, u8, 1>) -> Self {
        Self { image: view.to_image().map(|[v]| [v; 3]) }
    }

    /// Returns the width in pixels.
    pub fn width(&self) -> usize {
        self.image.width()
    }

    /// Returns the height in pixels.
    pub fn height(&self) -> usize {
        self.image.height()
    }

    /// Returns the image.
    pub fn image(&self) -> &RgbU8 {
        &self.image
    }

    /// Returns the image by value.
    pub fn into_image(self) -> RgbU8 {
        self.image
    }

    /// Applies `f` to every pixel in place.
    pub fn map(&mut self, f: impl Fn(Color) -> Color) {
        for pixel in self.image.as_mut_slice().as_chunks_mut::<3>().0 {
            *pixel = f(*pixel);
        }
    }

    /// Blends `color` into one pixel by `alpha`, 0 to 1.
    #[inline]
    pub fn blend(&mut self, x: i64, y: i64, color: Color, alpha: f32) {
        if x < 0 || y < 0 || x >= self.image.width() as i64 || y >= self.image.height() as i64 || alpha <= 0.0 {
            return;
        }
        let (x, y) = (x as usize, y as usize);
        let a = (alpha.min(1.0) * 256.0) as i32;
        let old = self.image.at(x, y);
        self.image.set(
            x,
            y,
            std::array::from_fn(|c| (i32::from(old[c]) + (((i32::from(color[c]) - i32::from(old[c])) * a) >> 8)) as u8),
        );
    }

    /// Draws a straight line with round caps, `width` pixels thick.
    pub fn line(&mut self, from: [f32; 2], to: [f32; 2], width: f32, color: Color) {
        let radius = width.clamp(0.1, 1000.0) / 2.0;
        let Some((a, b)) = self.clip_segment(from, to, radius + 1.0) else { return };
        // Lines thinner than a pixel are one pixel wide with lower opacity.
        let (radius, strength) = if radius < 0.5 { (0.5, radius * 2.0) } else { (radius, 1.0) };
        for_each_pixel_near_segment([a, b], radius + 1.0, |x, y, distance| {
            self.blend(x, y, color, strength * (radius + 0.5 - distance).clamp(0.0, 1.0));
        });
    }

    /// Clips a segment to the canvas extended by `margin`; `None` where nothing remains or it is not finite.
    fn clip_segment(&self, a: [f32; 2], b: [f32; 2], margin: f32) -> Option<([f32; 2], [f32; 2])> {
        if ![a[0], a[1], b[0], b[1]].iter().all(|v| v.is_finite()) {
            return None;
        }
        // Liang–Barsky, in f64 since ends may be very far away.
        let (mut t0, mut t1) = (0.0f64, 1.0f64);
        let size = [self.width() as f64, self.height() as f64];
        let margin = f64::from(margin);
        for axis in 0..2 {
            let (p, d) = (f64::from(a[axis]), f64::from(b[axis]) - f64::from(a[axis]));
            let (low, high) = (-margin - 0.5 - p, size[axis] - 0.5 + margin - p);
            if d == 0.0 {
                if low > 0.0 || high < 0.0 {
                    return None;
                }
                continue;
            }
            let (enter, leave) = if d > 0.0 { (low / d, high / d) } else { (high / d, low / d) };
            t0 = t0.max(enter);
            t1 = t1.min(leave);
        }
        let at = |t: f64| [0, 1].map(|i| (f64::from(a[i]) + t * (f64::from(b[i]) - f64::from(a[i]))) as f32);
        (t0 <= t1).then(|| (at(t0), at(t1)))
    }

    /// Draws lines from point to point.
    pub fn polyline(&mut self, points: &[[f32; 2]], width: f32, color: Color) {
        for pair in points.windows(2) {
            self.line(pair[0], pair[1], width, color);
        }
    }

    /// Draws a circle with a line of `width` pixels.
    pub fn circle(&mut self, center: [f32; 2], radius: f32, width: f32, color: Color) {
        let half = (width / 2.0).max(0.5);
        self.blend_radial(center, radius + half, |distance| half + 0.5 - (distance - radius).abs(), color);
    }

    /// Draws a filled disc.
    pub fn disc(&mut self, center: [f32; 2], radius: f32, color: Color) {
        self.blend_radial(center, radius, |distance| radius + 0.5 - distance, color);
    }

    /// Blends `color` by an opacity that depends on the distance from `center`, up to distance `reach`.
    fn blend_radial(&mut self, center: [f32; 2], reach: f32, alpha: impl Fn(f32) -> f32, color: Color) {
        let [cx, cy] = center;
        if !(cx.is_finite() && cy.is_finite() && reach.is_finite()) {
            return;
        }
        let reach = reach + 1.0;
        let span =
            |c: f32, size: usize| ((c - reach).floor().max(0.0) as i64, (c + reach).ceil().min(size as f32) as i64);
        let ((x0, x1), (y0, y1)) = (span(cx, self.width()), span(cy, self.height()));
        for y in y0..=y1 {
            for x in x0..=x1 {
                self.blend(x, y, color, alpha((x as f32 - cx).hypot(y as f32 - cy)).clamp(0.0, 1.0));
            }
        }
    }

    /// Draws a cross with horizontal and vertical arms of `radius` pixels.
    pub fn cross(&mut self, center: [f32; 2], radius: f32, width: f32, color: Color) {
        let [x, y] = center;
        self.line([x - radius, y], [x + radius, y], width, color);
        self.line([x, y - radius], [x, y + radius], width, color);
    }

    /// Draws a filled rectangle with its top-left pixel at `(x, y)`.
    pub fn fill_rect(&mut self, x: i64, y: i64, width: usize, height: usize, color: Color) {
        let span = |start: i64, len: usize, size: usize| {
            let end = start.saturating_add(len as i64).clamp(0, size as i64) as usize;
            (start.clamp(0, size as i64) as usize, end)
        };
        let ((x0, x1), (y0, y1)) = (span(x, width, self.width()), span(y, height, self.height()));
        for y in y0..y1 {
            for pixel in self.image.row_mut(y)[3 * x0..3 * x1].as_chunks_mut::<3>().0 {
                *pixel = color;
            }
        }
    }

    /// Draws the outline of a rectangle, one pixel wide.
    pub fn rect(&mut self, x: i64, y: i64, width: usize, height: usize, color: Color) {
        let (w, h) = (width as i64, height as i64);
        self.fill_rect(x, y, width, 1, color);
        self.fill_rect(x, y + h - 1, width, 1, color);
        self.fill_rect(x, y, 1, height, color);
        self.fill_rect(x + w - 1, y, 1, height, color);
    }

    /// Copies an image with its top-left pixel to `(x, y)`.
    pub fn paste(&mut self, view: ImageView<'_, u8, 3>, x: i64, y: i64) {
        let left = x.clamp(0, self.width() as i64);
        let right = x.saturating_add(view.width() as i64).clamp(left, self.width() as i64);
        if left == right {
            return;
        }
        for row in 0..view.height() {
            let to = y.saturating_add(row as i64);
            if to < 0 || to >= self.height() as i64 {
                continue;
            }
            let from = (left - x) as usize;
            let source = &view.row(row)[3 * from..3 * (from + (right - left) as usize)];
            self.image.row_mut(to as usize)[3 * left as usize..3 * right as usize].copy_from_slice(source);
        }
    }

    /// Draws a line of text with a cap height of `size` pixels; `(x, y)` is the top left of the capitals.
    pub fn text(&mut self, x: f32, y: f32, text: &str, size: f32, color: Color) {
        font::draw(text, [x, y], size, font::weight(size), |x, y, alpha| self.blend(x, y, color, alpha));
    }

    /// Draws text with an outline of another color, readable on any background.
    pub fn text_on_picture(&mut self, x: f32, y: f32, text: &str, size: f32, color: Color, rim: Color) {
        let weight = font::weight(size);
        font::draw(text, [x, y], size, weight * 2.2 + 1.5, |x, y, alpha| self.blend(x, y, rim, alpha * 0.75));
        font::draw(text, [x, y], size, weight, |x, y, alpha| self.blend(x, y, color, alpha));
    }

    /// Returns the width in pixels of [`Raster::text`].
    pub fn text_width(text: &str, size: f32) -> f32 {
        font::width(text, size)
    }
}

/// Calls `f(x, y, distance)` once for every pixel within distance `reach` of a segment.
pub(crate) fn for_each_pixel_near_segment([a, b]: [[f32; 2]; 2], reach: f32, mut f: impl FnMut(i64, i64, f32)) {
    let d = [b[0] - a[0], b[1] - a[1]];
    let squared = d[0] * d[0] + d[1] * d[1];
    // Iterate along the major axis; on the minor axis, only over the pixels that can be within reach.
    let (major, minor) = if d[0].abs() >= d[1].abs() { (0, 1) } else { (1, 0) };
    let slope = if d[major] == 0.0 { 0.0 } else { d[minor] / d[major] };
    let across = reach * (1.0 + slope * slope).sqrt();
    let (low, high) = (a[major].min(b[major]), a[major].max(b[major]));
    for m in (low - reach).ceil() as i64..=(high + reach).floor() as i64 {
        let along = (m as f32).clamp(low, high);
        // Beyond an end, the center is that of the end point.
        let middle = a[minor] + slope * (along - a[major]);
        for n in (middle - across).ceil() as i64..=(middle + across).floor() as i64 {
            let (x, y) = if major == 0 { (m, n) } else { (n, m) };
            let p = [x as f32 - a[0], y as f32 - a[1]];
            let t = if squared > 0.0 { ((p[0] * d[0] + p[1] * d[1]) / squared).clamp(0.0, 1.0) } else { 0.0 };
            let distance = (p[0] - t * d[0]).hypot(p[1] - t * d[1]);
            if distance <= reach {
                f(x, y, distance);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn a_line_covers_only_its_pixels() {
        let mut raster = Raster::new(20, 9, colors::BLACK);
        raster.line([3.0, 4.0], [15.0, 4.0], 1.0, colors::WHITE);
        for x in 4..15 {
            assert!(raster.image().at(x, 4)[0] >= 254, "{x}");
            assert_eq!((raster.image().at(x, 2), raster.image().at(x, 6)), ([0; 3], [0; 3]));
        }
        assert_eq!(raster.image().at(1, 4), [0; 3]);
        assert_eq!(raster.image().at(18, 4), [0; 3]);
    }

    #[test]
    fn a_disc_has_the_area_of_its_radius() {
        let mut raster = Raster::new(64, 64, colors::BLACK);
        raster.disc([31.3, 32.7], 20.0, colors::WHITE);
        let sum: f64 = raster.image().pixels().map(|p| f64::from(p[0]) / 255.0).sum();
        let area = std::f64::consts::PI * 400.0;
        // The boundary is 126 pixels long; a linear ramp is off by far less than a tenth of a pixel on average.
        assert!((sum - area).abs() < 12.6, "{sum} {area}");
    }

    #[test]
    fn pasting_and_filling_are_clipped_at_the_border() {
        let stamp = RgbU8::new(4, 4, [9, 8, 7]);
        for (x, y) in [(-2, -2), (8, 8), (-100, 3), (i64::MAX, i64::MAX), (i64::MIN, 0), (3, 3)] {
            let mut raster = Raster::new(10, 10, colors::BLACK);
            raster.paste(stamp.view(), x, y);
            let inside = |c: i64| (0..4).filter(|i| (0..10).contains(&c.saturating_add(*i))).count();
            let count = raster.image().pixels().filter(|p| *p == [9, 8, 7]).count();
            assert_eq!(count, inside(x) * inside(y), "{x} {y}");
            let mut raster = Raster::new(10, 10, colors::BLACK);
            raster.fill_rect(x, y, 4, 4, [9, 8, 7]);
            assert_eq!(raster.image().pixels().filter(|p| *p == [9, 8, 7]).count(), count, "{x} {y}");
        }
    }

    proptest! {
        #[test]
        fn drawing_with_extreme_coordinates_is_clipped(
            a in prop::array::uniform2(prop::num::f32::ANY), b in prop::array::uniform2(-50.0..50.0f32), r in 0.0..30.0f32,
            w in 0usize..12, h in 0usize..12,
        ) {
            // Any coordinates, including NaN and infinity: no panic, and no endless loop.
            let mut raster = Raster::new(w, h, colors::BLACK);
            raster.line(a, b, 2.0, colors::WHITE);
            raster.line(b, [b[1], b[0]], r, colors::WHITE);
            raster.circle(b, r, 2.0, colors::RED);
            raster.circle(a, r, 2.0, colors::RED);
            raster.disc(b, r, colors::RED);
            raster.cross(a, r, 1.0, colors::RED);
            raster.text(b[0], b[1], "Ag", r, colors::WHITE);
            raster.text(a[0], a[1], "Ag", 10.0, colors::WHITE);
        }
    }
}
