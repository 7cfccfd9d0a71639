//! Plots as SVG, in the theme colors of the surrounding page.

use std::fmt::Write as _;

use crate::colormap::{tick_label, ticks};
use crate::report::escape;

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 300.0;
const LEFT: f64 = 62.0;
const RIGHT: f64 = 18.0;
const TOP: f64 = 34.0;
const BOTTOM: f64 = 50.0;

#[derive(Debug, Clone, PartialEq)]
enum Layer {
    Line(Vec<[f64; 2]>),
    Points(Vec<[f64; 2]>),
    /// Bar edges and heights: one more edge than heights.
    Bars(Vec<f64>, Vec<f64>),
    /// A vertical line at x.
    Mark(f64),
}

/// A plot: layers over common axes. Values that are not finite are left out.
#[derive(Debug, Clone, PartialEq)]
pub struct Plot {
    title: String,
    x_label: String,
    y_label: String,
    layers: Vec<(String, Layer)>,
}

impl Plot {
    /// Makes an empty plot. The axis labels are the quantity and its unit.
    pub fn new(title: &str, x_label: &str, y_label: &str) -> Self {
        Self { title: title.into(), x_label: x_label.into(), y_label: y_label.into(), layers: Vec::new() }
    }

    /// Adds a line through points. A non-empty `name` appears in the legend.
    #[must_use]
    pub fn line(self, name: &str, points: &[[f64; 2]]) -> Self {
        self.with(name, Layer::Line(finite(points)))
    }

    /// Adds separate points.
    #[must_use]
    pub fn points(self, name: &str, points: &[[f64; 2]]) -> Self {
        self.with(name, Layer::Points(finite(points)))
    }

    /// Adds a histogram of the finite values in `bins` equal bins over their range.
    #[must_use]
    pub fn histogram(self, name: &str, values: &[f64], bins: usize) -> Self {
        let finite = || values.iter().copied().filter(|v| v.is_finite());
        let (low, high) = (finite().fold(f64::INFINITY, f64::min), finite().fold(f64::NEG_INFINITY, f64::max));
        self.histogram_within(name, values, bins, (low, high))
    }

    /// Adds a histogram over a given range; values outside are ignored.
    #[must_use]
    pub fn histogram_within(self, name: &str, values: &[f64], bins: usize, range: (f64, f64)) -> Self {
        let bins = bins.clamp(1, 1000);
        let (low, mut high) = range;
        if !(low.is_finite() && high.is_finite()) {
            return self;
        }
        if high <= low {
            high = low + 1.0;
        }
        let mut counts = vec![0.0; bins];
        for &v in values {
            if v >= low && v <= high {
                counts[(((v - low) / (high - low) * bins as f64) as usize).min(bins - 1)] += 1.0;
            }
        }
        let edges = (0..=bins).map(|i| low + (high - low) * i as f64 / bins as f64).collect();
        self.with(name, Layer::Bars(edges, counts))
    }

    /// Adds a dashed vertical line, such as a threshold.
    #[must_use]
    pub fn mark(self, name: &str, x: f64) -> Self {
        if x.is_finite() { self.with(name, Layer::Mark(x)) } else { self }
    }

    fn with(mut self, name: &str, layer: Layer) -> Self {
        self.layers.push((name.to_owned(), layer));
        self
    }

    /// Computes the bounding box of all layers, with a margin; the y axis begins at zero where the data are near it.
    fn bounds(&self) -> ([f64; 2], [f64; 2]) {
        let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
        let mut grow = |p: [f64; 2]| {
            for i in 0..2 {
                low[i] = low[i].min(p[i]);
                high[i] = high[i].max(p[i]);
            }
        };
        for (_, layer) in &self.layers {
            match layer {
                Layer::Line(points) | Layer::Points(points) => points.iter().for_each(|p| grow(*p)),
                Layer::Bars(edges, heights) => {
                    heights.iter().zip(edges.windows(2)).for_each(|(h, e)| {
                        grow([e[0], 0.0]);
                        grow([e[1], *h]);
                    });
                }
                Layer::Mark(_) => {}
            }
        }
        // Vertical lines extend the x range only.
        for (_, layer) in &self.layers {
            if let Layer::Mark(x) = layer {
                low[0] = low[0].min(*x);
                high[0] = high[0].max(*x);
            }
        }
        for i in 0..2 {
            if low[i] > high[i] {
                (low[i], high[i]) = (0.0, 1.0);
            }
            if high[i] - low[i] <= f64::EPSILON * high[i].abs().max(low[i].abs()).max(1e-300) {
                (low[i], high[i]) = (low[i] - 0.5, high[i] + 0.5);
            }
        }
        if low[1] > 0.0 && low[1] < high[1] * 0.5 {
            low[1] = 0.0;
        }
        high[1] += 0.05 * (high[1] - low[1]);
        (low, high)
    }

    /// Renders the plot as an `<svg>` element of 640 × 300 units that scales with its container. Colors come from the report's style
    /// sheet; without it they fall back to dark on transparent.
    pub fn to_svg(&self) -> String {
        let (low, high) = self.bounds();
        let px = |x: f64| LEFT + (x - low[0]) / (high[0] - low[0]) * (WIDTH - LEFT - RIGHT);
        let py = |y: f64| HEIGHT - BOTTOM - (y - low[1]) / (high[1] - low[1]) * (HEIGHT - TOP - BOTTOM);
        let mut s = String::new();
        let _ = write!(
            s,
            "<svg class=\"plot\" xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" role=\"img\" \
             aria-label=\"{}\" font-family=\"system-ui,sans-serif\" font-size=\"12\">",
            escape(&self.title)
        );
        let ink = "var(--ink,#2d3038)";
        let soft = "var(--soft,#6b7080)";
        let grid = "var(--line,#d9dce3)";
        let _ =
            write!(s, "<text x=\"{LEFT}\" y=\"18\" font-weight=\"600\" fill=\"{ink}\">{}</text>", escape(&self.title));
        let axis = |range: (f64, f64), count| {
            let marks = ticks(range, count);
            let step = marks.windows(2).map(|w| w[1] - w[0]).next().unwrap_or(range.1 - range.0);
            marks.into_iter().map(move |t| (t, tick_label(t, step))).collect::<Vec<_>>()
        };
        for (t, label) in axis((low[1], high[1]), 5) {
            let y = py(t);
            let _ = write!(
                s,
                "<path d=\"M{LEFT} {y:.1}H{:.1}\" stroke=\"{grid}\"/><text x=\"{:.1}\" y=\"{:.1}\" text-anchor=\"end\" fill=\"{soft}\">{label}</text>",
                WIDTH - RIGHT,
                LEFT - 8.0,
                y + 4.0
            );
        }
        for (t, label) in axis((low[0], high[0]), 8) {
            let x = px(t);
            let bottom = HEIGHT - BOTTOM;
            let _ = write!(
                s,
                "<path d=\"M{x:.1} {bottom}v5\" stroke=\"{soft}\"/><text x=\"{x:.1}\" y=\"{}\" text-anchor=\"middle\" fill=\"{soft}\">{label}</text>",
                bottom + 19.0
            );
        }
        let _ = write!(
            s,
            "<text x=\"{:.1}\" y=\"{}\" text-anchor=\"middle\" fill=\"{ink}\">{}</text>\
             <text transform=\"translate(15 {:.1})rotate(-90)\" text-anchor=\"middle\" fill=\"{ink}\">{}</text>",
            (LEFT + WIDTH - RIGHT) / 2.0,
            HEIGHT - 10.0,
            escape(&self.x_label),
            (TOP + HEIGHT - BOTTOM) / 2.0,
            escape(&self.y_label)
        );
        for (i, (_, layer)) in self.layers.iter().enumerate() {
            let color = series_color(i);
            match layer {
                Layer::Line(points) => {
                    let mut path = String::new();
                    for (j, p) in points.iter().enumerate() {
                        let _ = write!(path, "{}{:.1} {:.1}", if j == 0 { "M" } else { "L" }, px(p[0]), py(p[1]));
                    }
                    let _ = write!(
                        s,
                        "<path d=\"{path}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"2\" stroke-linejoin=\"round\"/>"
                    );
                }
                Layer::Points(points) => {
                    let _ = write!(s, "<g fill=\"{color}\" fill-opacity=\"0.7\">");
                    for p in points {
                        let _ = write!(s, "<circle cx=\"{:.1}\" cy=\"{:.1}\" r=\"2.5\"/>", px(p[0]), py(p[1]));
                    }
                    s.push_str("</g>");
                }
                Layer::Bars(edges, heights) => {
                    let _ = write!(s, "<g fill=\"{color}\" fill-opacity=\"0.75\">");
                    let gap = if heights.len() > 80 { 0.0 } else { 0.7 };
                    for (edge, h) in edges.windows(2).zip(heights).filter(|(_, h)| **h > 0.0) {
                        let (x0, x1, top) = (px(edge[0]), px(edge[1]), py(*h));
                        let _ = write!(
                            s,
                            "<rect x=\"{x0:.2}\" y=\"{top:.1}\" width=\"{:.2}\" height=\"{:.1}\"/>",
                            (x1 - x0 - gap).max(0.3),
                            py(low[1].max(0.0)) - top
                        );
                    }
                    s.push_str("</g>");
                }
                Layer::Mark(x) => {
                    let _ = write!(
                        s,
                        "<path d=\"M{:.1} {TOP}V{}\" stroke=\"{color}\" stroke-width=\"1.5\" stroke-dasharray=\"5 4\"/>",
                        px(*x),
                        HEIGHT - BOTTOM
                    );
                }
            }
        }
        let mut x = WIDTH - RIGHT;
        for (i, (name, _)) in self.layers.iter().enumerate().rev().filter(|(_, (name, _))| !name.is_empty()) {
            x -= 7.0 * name.chars().count() as f64;
            let _ = write!(s, "<text x=\"{x:.1}\" y=\"18\" fill=\"{ink}\">{}</text>", escape(name));
            x -= 16.0;
            let _ = write!(
                s,
                "<rect x=\"{x:.1}\" y=\"8\" width=\"11\" height=\"11\" rx=\"2\" fill=\"{}\"/>",
                series_color(i)
            );
            x -= 12.0;
        }
        s.push_str("</svg>");
        s
    }
}

/// Returns the color of the i-th layer, from a palette safe for color blindness.
fn series_color(i: usize) -> &'static str {
    ["#2f7fd6", "#e08a1e", "#1f9e77", "#cf4f9b", "#7a63c7", "#c9432f"][i % 6]
}

fn finite(points: &[[f64; 2]]) -> Vec<[f64; 2]> {
    points.iter().copied().filter(|p| p[0].is_finite() && p[1].is_finite()).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_histogram_counts_each_value_once() {
        let plot = Plot::new("t", "x", "y").histogram("", &[0.0, 0.1, 0.5, 1.0, f64::NAN, f64::INFINITY], 2);
        let (_, Layer::Bars(edges, counts)) = &plot.layers[0] else { panic!("bars") };
        assert_eq!((&edges[..], &counts[..]), (&[0.0, 0.5, 1.0][..], &[2.0, 2.0][..]));
    }

    #[test]
    fn empty_and_non_finite_layers_give_a_valid_plot() {
        let empty = Plot::new("a < b & c", "x", "y").to_svg();
        assert!(empty.contains("a &lt; b &amp; c") && empty.ends_with("</svg>"));
        let odd = Plot::new("", "", "")
            .line("l", &[[f64::NAN, 1.0]])
            .points("p", &[[3.0, 3.0]])
            .histogram("h", &[], 0)
            .mark("m", f64::INFINITY)
            .to_svg();
        assert!(!odd.contains("NaN") && !odd.contains("inf"), "{odd}");
    }

    #[test]
    fn points_are_drawn_at_their_axis_coordinates() {
        let svg = Plot::new("", "", "").points("", &[[0.0, 0.0], [10.0, 100.0]]).to_svg();
        // The lowest point is the left bottom corner of the frame; the highest is 5 % below its top.
        assert!(svg.contains(&format!("cx=\"{LEFT:.1}\" cy=\"{:.1}\"", HEIGHT - BOTTOM)), "{svg}");
        let top = TOP + (HEIGHT - TOP - BOTTOM) * (1.0 - 1.0 / 1.05);
        assert!(svg.contains(&format!("cx=\"{:.1}\" cy=\"{top:.1}\"", WIDTH - RIGHT)), "{svg}");
    }
}
