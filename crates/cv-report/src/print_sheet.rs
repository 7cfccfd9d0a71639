//! A sheet of paper to print at true scale: black rectangles and lines of text, as PDF, SVG or pixels.
//!
//! PDF (ISO 32000-1) with a standard font, and SVG, are written directly, since only rectangles and text are needed. All rectangles are one
//! path, so that no seam is visible where they meet.

use crate::raster::Raster;
use cv_core::GrayU8;
use std::fmt::Write as _;

/// PDF points per millimeter.
const POINTS_PER_MM: f64 = 72.0 / 25.4;

/// A line of text: left end on the baseline, and cap height, in millimeters.
#[derive(Debug, Clone, PartialEq)]
struct Line {
    at: [f64; 2],
    capitals: f64,
    text: String,
}

/// A sheet of paper; lengths are millimeters from its top left corner, x right, y down.
#[derive(Debug, Clone, PartialEq)]
pub struct PrintSheet {
    size: (f64, f64),
    title: String,
    rectangles: Vec<[f64; 4]>,
    lines: Vec<Line>,
}

impl PrintSheet {
    /// Makes an empty sheet of the given width and height.
    pub fn new(size: (f64, f64), title: &str) -> Self {
        Self { size, title: title.to_owned(), rectangles: Vec::new(), lines: Vec::new() }
    }

    /// Returns width and height.
    pub fn size(&self) -> (f64, f64) {
        self.size
    }

    /// Adds a black rectangle: left, top, width, height.
    pub fn rectangle(&mut self, rectangle: [f64; 4]) -> &mut Self {
        self.rectangles.push(rectangle);
        self
    }

    /// Adds a line of text at its left end on the baseline, with cap height `capitals`. ASCII; other characters become `?`.
    pub fn text(&mut self, at: [f64; 2], capitals: f64, text: &str) -> &mut Self {
        let text = text.chars().map(|c| if c == ' ' || c.is_ascii_graphic() { c } else { '?' }).collect();
        self.lines.push(Line { at, capitals, text });
        self
    }

    /// Adds a ruler of `length` millimeters with its left end `at`: a tick per millimeter, longer ones every five and ten, and numbers every 50.
    pub fn ruler(&mut self, at: [f64; 2], length: usize) -> &mut Self {
        const WIDTH: f64 = 0.2;
        for i in 0..=length {
            let height = if i % 10 == 0 {
                5.0
            } else if i % 5 == 0 {
                3.5
            } else {
                2.0
            };
            self.rectangle([at[0] + i as f64 - WIDTH / 2.0, at[1] - height, WIDTH, height]);
            if i % 50 == 0 {
                let unit = if i == length { " mm" } else { "" };
                self.text([at[0] + i as f64 + 0.8, at[1] - 3.0], 2.0, &format!("{i}{unit}"));
            }
        }
        self
    }

    /// Renders a PDF of one page of exactly this size. The same sheet gives the same bytes.
    pub fn to_pdf(&self) -> Vec<u8> {
        let (w, h) = (self.size.0 * POINTS_PER_MM, self.size.1 * POINTS_PER_MM);
        let mut content = String::from("0 g\n");
        for [x, y, width, height] in &self.rectangles {
            let bottom = self.size.1 - y - height;
            let numbers = [*x, bottom, *width, *height].map(|v| v * POINTS_PER_MM);
            let _ = writeln!(content, "{:.5} {:.5} {:.5} {:.5} re", numbers[0], numbers[1], numbers[2], numbers[3]);
        }
        content.push_str("f\n");
        for line in &self.lines {
            // The cap height of Helvetica is 0.718 of the font size.
            let (size, x, y) = (
                line.capitals / 0.718 * POINTS_PER_MM,
                line.at[0] * POINTS_PER_MM,
                (self.size.1 - line.at[1]) * POINTS_PER_MM,
            );
            let _ = writeln!(content, "BT /F1 {size:.3} Tf {x:.3} {y:.3} Td ({}) Tj ET", escape_pdf(&line.text));
        }
        let objects = [
            // Disables print scaling to the printer's margins.
            "<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>".to_owned(),
            "<< /Type /Pages /Kids [3 0 R] /Count 1 >>".to_owned(),
            format!(
                "<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {w:.5} {h:.5}] /Contents 4 0 R /Resources << /Font << /F1 5 0 R >> >> >>"
            ),
            format!("<< /Length {} >>\nstream\n{content}endstream", content.len()),
            "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>".to_owned(),
            format!("<< /Title ({}) >>", escape_pdf(&self.title)),
        ];
        let mut out = String::from("%PDF-1.4\n");
        let mut offsets = Vec::new();
        for (i, object) in objects.iter().enumerate() {
            offsets.push(out.len());
            let _ = writeln!(out, "{} 0 obj\n{object}\nendobj", i + 1);
        }
        let start = out.len();
        let count = objects.len() + 1;
        let _ = writeln!(out, "xref\n0 {count}\n0000000000 65535 f ");
        for offset in offsets {
            let _ = writeln!(out, "{offset:010} 00000 n ");
        }
        let _ = writeln!(
            out,
            "trailer\n<< /Size {count} /Root 1 0 R /Info {} 0 R >>\nstartxref\n{start}\n%%EOF",
            count - 1
        );
        out.into_bytes()
    }

    /// Renders an SVG of this size, in millimeters.
    pub fn to_svg(&self) -> String {
        let (w, h) = self.size;
        let mut out = format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{w}mm\" height=\"{h}mm\" viewBox=\"0 0 {w} {h}\">\n<title>{}</title>\n<rect width=\"{w}\" height=\"{h}\" fill=\"#fff\"/>\n<path d=\"",
            escape_xml(&self.title)
        );
        for [x, y, width, height] in &self.rectangles {
            let _ = write!(out, "M{x:.5} {y:.5}h{width:.5}v{height:.5}h{:.5}z", -width);
        }
        out.push_str("\"/>\n");
        for line in &self.lines {
            let (size, [x, y]) = (line.capitals / 0.718, line.at);
            let _ = writeln!(
                out,
                "<text x=\"{x:.3}\" y=\"{y:.3}\" font-size=\"{size:.3}\" font-family=\"Helvetica, Arial, sans-serif\">{}</text>",
                escape_xml(&line.text)
            );
        }
        out.push_str("</svg>\n");
        out
    }

    /// Rasterizes the sheet: white 255, black 0, edges anti-aliased by pixel coverage. A pixel's side is `25.4 / dpi` mm, and the corner of the
    /// sheet is the corner of the first pixel. Sides are rounded to whole pixels.
    pub fn to_pixels(&self, dpi: f64) -> GrayU8 {
        let scale = dpi / 25.4;
        let pixels = |v: f64| (v * scale).round().clamp(1.0, 65_535.0) as usize;
        let (w, h) = (pixels(self.size.0), pixels(self.size.1));
        let mut raster = Raster::new(w, h, [255; 3]);
        for line in &self.lines {
            let size = (line.capitals * scale) as f32;
            let at = line.at.map(|v| (v * scale) as f32);
            raster.text(at[0], at[1] - size, &line.text, size, [0; 3]);
        }
        let image = raster.into_image();
        let mut paper: Vec<f32> = image.as_slice().chunks_exact(3).map(|p| f32::from(p[0])).collect();
        for rectangle in &self.rectangles {
            let [x, y, width, height] = rectangle.map(|v| v * scale);
            let (right, below) = (x + width, y + height);
            let covered = |i: usize, from: f64, to: f64| ((i as f64 + 1.0).min(to) - (i as f64).max(from)).max(0.0);
            let range = |from: f64, to: f64, n: usize| from.max(0.0) as usize..(to.ceil().max(0.0) as usize).min(n);
            for j in range(y, below, h) {
                let down = covered(j, y, below);
                for i in range(x, right, w) {
                    paper[j * w + i] -= (255.0 * down * covered(i, x, right)) as f32;
                }
            }
        }
        GrayU8::from_fn(w, h, |x, y| [paper[y * w + x].round().clamp(0.0, 255.0) as u8])
    }
}

/// Escapes text for a PDF string literal.
fn escape_pdf(text: &str) -> String {
    text.chars().flat_map(|c| ['(', ')', '\\'].contains(&c).then_some('\\').into_iter().chain([c])).collect()
}

/// Escapes text for an SVG element.
fn escape_xml(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;")
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sheet() -> PrintSheet {
        let mut sheet = PrintSheet::new((100.0, 50.0), "a (b) <c>");
        sheet.rectangle([10.0, 20.0, 5.0, 2.5]).text([10.0, 45.0], 2.5, "a (b) <c> é");
        sheet
    }

    #[test]
    fn lengths_are_true_to_scale_in_every_format() {
        // 25.4 dpi: a pixel is a millimeter. The lower edge is in the middle of a pixel row.
        let image = sheet().to_pixels(25.4);
        assert_eq!(image.size(), (100, 50));
        let column: Vec<u8> = (19..24).map(|y| image.at(12, y)[0]).collect();
        assert_eq!(column, [255, 0, 0, 128, 255]);
        assert_eq!([9, 10, 14, 15].map(|x| image.at(x, 20)[0]), [255, 0, 0, 255]);
        let svg = sheet().to_svg();
        assert!(svg.contains("width=\"100mm\" height=\"50mm\" viewBox=\"0 0 100 50\""), "{svg}");
        assert!(
            svg.contains("M10.00000 20.00000h5.00000v2.50000h-5.00000z") && svg.contains("a (b) &lt;c&gt; ?"),
            "{svg}"
        );
        // From below, in points: (50 − 22.5) · 72 / 25.4.
        let pdf = String::from_utf8(sheet().to_pdf()).unwrap();
        assert!(pdf.contains("28.34646 77.95276 14.17323 7.08661 re") && pdf.contains("(a \\(b\\) <c> ?) Tj"), "{pdf}");
        assert!(pdf.contains("/MediaBox [0 0 283.46457 141.73228]"), "{pdf}");
    }

    #[test]
    fn the_cross_reference_table_of_the_pdf_has_the_object_offsets() {
        let pdf = String::from_utf8(sheet().to_pdf()).unwrap();
        let start: usize = pdf.lines().rev().nth(1).unwrap().parse().unwrap();
        assert!(pdf[start..].starts_with("xref\n0 7\n"));
        for (i, row) in pdf[start..].lines().skip(3).take(6).enumerate() {
            let offset: usize = row.split(' ').next().unwrap().parse().unwrap();
            assert!(pdf[offset..].starts_with(&format!("{} 0 obj\n", i + 1)), "{row}");
        }
        let length: usize = pdf.split("/Length ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
        let stream = pdf.split("\nstream\n").nth(1).unwrap().split("endstream").next().unwrap();
        assert_eq!(stream.len(), length);
    }

    #[test]
    fn a_ruler_has_a_tick_for_each_millimeter() {
        let mut sheet = PrintSheet::new((120.0, 20.0), "ruler");
        sheet.ruler([5.0, 10.0], 100);
        assert_eq!(sheet.rectangles.len(), 101);
        // The ruler extends between the centers of its first and last tick.
        let center = |r: &[f64; 4]| r[0] + r[2] / 2.0;
        assert!((center(&sheet.rectangles[100]) - center(&sheet.rectangles[0]) - 100.0).abs() < 1e-9);
    }
}
