//! Color maps, color bars and colored maps.

use cv_core::{GrayF32, ImageView, RgbU8, quantile};

use crate::raster::{Color, Raster, colors};
use crate::report::escape;

/// A color map from numbers to colors.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Colormap {
    /// Turbo (Mikhailov 2019): low blue, high red. For depth: near blue, far red.
    #[default]
    Turbo,
    /// Turbo reversed. For disparity, so that near is blue as well.
    TurboReversed,
    /// Viridis: perceptually uniform in lightness, legible in gray print. For costs, confidences and densities.
    Viridis,
    /// Magma: dark to light. For errors.
    Magma,
    /// Black to white.
    Gray,
}

impl Colormap {
    /// Returns the color at `t`, 0 to 1; [`colors::UNKNOWN`] for NaN.
    pub fn color(self, t: f32) -> Color {
        if t.is_nan() {
            return colors::UNKNOWN;
        }
        let t = f64::from(t.clamp(0.0, 1.0));
        let gradient = match self {
            Self::Gray => return [(t * 255.0).round() as u8; 3],
            Self::Turbo => return colorous::TURBO.eval_continuous(trim_turbo_ends(t)).as_array(),
            Self::TurboReversed => return colorous::TURBO.eval_continuous(trim_turbo_ends(1.0 - t)).as_array(),
            Self::Viridis => colorous::VIRIDIS,
            Self::Magma => colorous::MAGMA,
        };
        gradient.eval_continuous(t).as_array()
    }

    /// Returns a table of 256 colors from low to high.
    fn table(self) -> Vec<Color> {
        (0..256).map(|i| self.color(i as f32 / 255.0)).collect()
    }
}

/// Maps 0 to 1 to the part of Turbo without its nearly black ends, so that no valid value looks like a hole.
fn trim_turbo_ends(t: f64) -> f64 {
    0.06 + 0.90 * t
}

/// Colors a map. Values outside `range` are clamped to it; NaN and infinity are [`colors::UNKNOWN`].
pub fn colorize(map: ImageView<'_, f32, 1>, range: (f32, f32), colormap: Colormap) -> RgbU8 {
    let table = colormap.table();
    let scale = if range.1 > range.0 { 255.0 / (range.1 - range.0) } else { 0.0 };
    let mut out = RgbU8::new(map.width(), map.height(), [0; 3]);
    for y in 0..map.height() {
        for (pixel, &v) in out.row_mut(y).as_chunks_mut::<3>().0.iter_mut().zip(map.row(y)) {
            *pixel = if v.is_finite() { table[((v - range.0) * scale + 0.5) as u8 as usize] } else { colors::UNKNOWN };
        }
    }
    out
}

/// Computes the `low` and `high` quantiles (0 to 1) of the finite values; `None` where there are none.
///
/// A color range from 0.01 to 0.99 is robust to outliers.
pub fn quantile_range(map: ImageView<'_, f32, 1>, low: f64, high: f64) -> Option<(f32, f32)> {
    let mut values: Vec<f32> = (0..map.height()).flat_map(|y| map.row(y)).copied().filter(|v| v.is_finite()).collect();
    Some((quantile(&mut values, low)?, quantile(&mut values, high)?))
}

/// Computes about `count` axis ticks within `range`, at steps of 1, 2 or 5 times a power of ten.
pub(crate) fn ticks(range: (f64, f64), count: usize) -> Vec<f64> {
    let span = range.1 - range.0;
    if !(span.is_finite() && span > 0.0) || count == 0 {
        return Vec::new();
    }
    let raw = span / count as f64;
    let power = 10f64.powf(raw.log10().floor());
    let step = power
        * match raw / power {
            r if r < 1.5 => 1.0,
            r if r < 3.5 => 2.0,
            r if r < 7.5 => 5.0,
            _ => 10.0,
        };
    let (first, last) = ((range.0 / step - 1e-9).ceil(), (range.1 / step + 1e-9).floor());
    if !(step > 0.0 && first.is_finite() && last - first < 1000.0) {
        return Vec::new();
    }
    (0..=(last - first) as i64).map(|i| (first + i as f64) * step).map(|t| if t == 0.0 { 0.0 } else { t }).collect()
}

/// Formats a tick value with as few decimals as distinguish it from its neighbors at distance `step`.
pub(crate) fn tick_label(value: f64, step: f64) -> String {
    let decimals = (-step.abs().log10() - 1e-9).ceil().clamp(0.0, 9.0) as usize;
    if value != 0.0 && (value.abs() >= 1e6 || value.abs() < 1e-4) {
        format!("{value:.1e}")
    } else {
        format!("{value:.decimals$}")
    }
}

/// Draws a vertical color bar with its scale, `height` pixels tall: low at the bottom, `label` (such as “depth (m)”) on top.
pub fn color_bar(height: usize, range: (f32, f32), colormap: Colormap, label: &str) -> RgbU8 {
    // The text size is proportional to the height, within limits.
    let size = (height as f32 / 40.0).clamp(8.0, 22.0);
    let bar = (size * 1.6).round();
    let (top, bottom) = ((size * 3.4).round(), (size * 1.1).round());
    let length = (height as f32 - top - bottom).max(1.0);
    let range64 = (f64::from(range.0), f64::from(range.1));
    let marks = ticks(range64, ((length / (size * 3.2)) as usize).clamp(2, 10));
    let step = marks.windows(2).map(|w| w[1] - w[0]).next().unwrap_or(range64.1 - range64.0);
    let labels: Vec<_> = marks.iter().map(|&t| tick_label(t, step)).collect();
    let widest = labels.iter().map(|l| Raster::text_width(l, size)).fold(0.0, f32::max);
    let width = (size + bar + size * 0.9 + widest + size).max(Raster::text_width(label, size) + 2.0 * size);
    let mut raster = Raster::new(width.ceil() as usize, height, colors::WHITE);
    let table = colormap.table();
    for row in 0..length as usize {
        let t = 1.0 - (row as f32 + 0.5) / length;
        let color = table[(t * 255.0).round() as usize];
        raster.fill_rect(size as i64, top as i64 + row as i64, bar as usize, 1, color);
    }
    const INK: Color = [45, 48, 56];
    for (mark, label) in marks.iter().zip(&labels) {
        let t = ((mark - range64.0) / (range64.1 - range64.0)) as f32;
        let y = top + (1.0 - t) * (length - 1.0);
        let x = size + bar;
        raster.line([x + size * 0.15, y], [x + size * 0.5, y], 1.0, INK);
        raster.text(x + size * 0.9, y - size / 2.0, label, size, INK);
    }
    raster.text(size, size * 0.8, label, size, INK);
    raster.into_image()
}

/// How a map is colored.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct MapStyle {
    /// Values of the two ends of the color map; `None` (default): the 1 % and 99 % quantiles.
    pub range: Option<(f32, f32)>,
    /// The color map. Default [`Colormap::Turbo`].
    pub colormap: Colormap,
    /// The quantity and its unit. Default empty.
    pub label: String,
}

impl MapStyle {
    /// Returns the style for depth: near blue, far red. `unit` may be empty.
    pub fn depth(unit: &str) -> Self {
        let label = if unit.is_empty() { "depth".to_owned() } else { format!("depth ({unit})") };
        Self { label, ..Self::default() }
    }

    /// Returns the style for disparity: near (large) blue, far (small) red.
    pub fn disparity() -> Self {
        Self { colormap: Colormap::TurboReversed, label: "disparity (px)".to_owned(), ..Self::default() }
    }

    /// Computes the values of the two ends of the color map for a map.
    fn value_range(&self, map: ImageView<'_, f32, 1>) -> (f32, f32) {
        let range = self.range.or_else(|| quantile_range(map, 0.01, 0.99)).unwrap_or((0.0, 1.0));
        // A constant map gets a range around its value.
        if range.1 > range.0 { range } else { (range.0 - 0.5, range.0 + 0.5) }
    }

    /// Colors a map, and returns its color scale for a page.
    pub fn colored(&self, map: ImageView<'_, f32, 1>) -> (RgbU8, ColorScale) {
        let range = self.value_range(map);
        let scale = ColorScale { range, colormap: self.colormap, label: self.label.clone() };
        (colorize(map, range, self.colormap), scale)
    }

    /// Returns the style with a fixed range.
    #[must_use]
    pub fn with_range(self, low: f32, high: f32) -> Self {
        Self { range: Some((low, high)), ..self }
    }
}

/// A color scale for a page, which follows the page's light or dark theme.
#[derive(Debug, Clone, PartialEq)]
pub struct ColorScale {
    range: (f32, f32),
    colormap: Colormap,
    label: String,
}

impl ColorScale {
    /// Renders a horizontal bar from low to high with its tick labels below.
    pub(crate) fn to_html(&self) -> String {
        let (low, high) = (f64::from(self.range.0), f64::from(self.range.1));
        let stops: Vec<String> = (0..=16)
            .map(|i| {
                let [r, g, b] = self.colormap.color(i as f32 / 16.0);
                format!("#{r:02x}{g:02x}{b:02x}")
            })
            .collect();
        let marks = ticks((low, high), 5);
        let step = marks.windows(2).map(|w| w[1] - w[0]).next().unwrap_or(high - low);
        let marks: String = marks
            .iter()
            .map(|t| format!("<i style=\"left:{:.1}%\">{}</i>", 100.0 * (t - low) / (high - low), tick_label(*t, step)))
            .collect();
        let (label, stops) = (escape(&self.label), stops.join(","));
        format!(
            "<div class=\"scale\"><span>{label}</span><div><b style=\"background:linear-gradient(90deg,{stops})\"></b>{marks}</div></div>"
        )
    }
}

/// Draws a colored map with a color bar on its right.
pub fn draw_map(map: ImageView<'_, f32, 1>, style: &MapStyle) -> RgbU8 {
    let range = style.value_range(map);
    let colored = colorize(map, range, style.colormap);
    let bar = color_bar(colored.height().max(160), range, style.colormap, &style.label);
    let mut raster = Raster::new(colored.width() + bar.width(), colored.height().max(bar.height()), colors::WHITE);
    raster.paste(colored.view(), 0, 0);
    raster.paste(bar.view(), colored.width() as i64, 0);
    raster.into_image()
}

/// Computes the absolute difference of two maps; NaN where either is unknown.
pub fn absolute_difference(a: ImageView<'_, f32, 1>, b: ImageView<'_, f32, 1>) -> GrayF32 {
    GrayF32::from_fn(a.width().min(b.width()), a.height().min(b.height()), |x, y| {
        [(a.at(x, y)[0] - b.at(x, y)[0]).abs()]
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn near_is_blue_and_far_is_red() {
        let depth = GrayF32::from_vec(4, 1, vec![1.0, 9.0, f32::NAN, f32::INFINITY]).unwrap();
        let drawn = colorize(depth.view(), (1.0, 9.0), Colormap::Turbo);
        let ([r, _, b], [far_r, _, far_b]) = (drawn.at(0, 0), drawn.at(1, 0));
        assert!(b > r && far_r > far_b, "{:?} {:?}", drawn.at(0, 0), drawn.at(1, 0));
        assert_eq!((drawn.at(2, 0), drawn.at(3, 0)), (colors::UNKNOWN, colors::UNKNOWN));
        let disparity = colorize(depth.view(), (1.0, 9.0), Colormap::TurboReversed);
        assert_eq!((disparity.at(1, 0), disparity.at(0, 0)), (drawn.at(0, 0), drawn.at(1, 0)));
    }

    #[test]
    fn quantile_ranges_ignore_non_finite_values() {
        let mut values: Vec<f32> = (0..=100).map(|i| i as f32).rev().collect();
        values.extend([f32::NAN, f32::INFINITY]);
        let map = GrayF32::from_vec(103, 1, values).unwrap();
        assert_eq!(quantile_range(map.view(), 0.01, 0.99), Some((1.0, 99.0)));
        assert_eq!(quantile_range(GrayF32::new(3, 3, [f32::NAN]).view(), 0.0, 1.0), None);
        assert_eq!(quantile_range(GrayF32::new(0, 0, [0.0]).view(), 0.0, 1.0), None);
    }

    #[test]
    fn ticks_are_round_numbers_with_minimal_digits() {
        assert_eq!(ticks((0.0, 10.0), 5), [0.0, 2.0, 4.0, 6.0, 8.0, 10.0]);
        assert_eq!(ticks((-0.31, 0.29), 6), [-0.3, -0.2, -0.1, 0.0, 0.1, 0.2].map(|v: f64| (v * 10.0).round() * 0.1));
        assert!(ticks((3.0, 3.0), 5).is_empty() && ticks((0.0, f64::NAN), 5).is_empty());
        assert_eq!(tick_label(0.25, 0.05), "0.25");
        assert_eq!(tick_label(20.0, 10.0), "20");
        assert_eq!(tick_label(-0.5, 0.5), "-0.5");
    }

    proptest! {
        #[test]
        fn any_map_can_be_drawn(w in 0usize..6, h in 0usize..6, values in prop::collection::vec(prop::num::f32::ANY, 36)) {
            let map = GrayF32::from_fn(w, h, |x, y| [values[y * 6 + x]]);
            let drawn = draw_map(map.view(), &MapStyle::depth("m"));
            prop_assert!(drawn.width() > w && drawn.height() >= h);
        }
    }
}
