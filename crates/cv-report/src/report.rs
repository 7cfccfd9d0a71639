//! The self-contained HTML report: text, tables, images, plots and point clouds.

use std::fmt::Write as _;

use crate::base64;
use crate::colormap::ColorScale;
use crate::plot::Plot;
use crate::viewer::PointScene;

const STYLE: &str = include_str!("assets/report.css");
const SCRIPT: &str = include_str!("assets/report.js");
const VIEWER: &str = include_str!("assets/viewer.js");

/// Escapes text for HTML and SVG, both as content and in quoted attributes.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // Control characters are not allowed in a document.
            c if c.is_control() && !matches!(c, '\n' | '\t') => out.push('\u{fffd}'),
            c => out.push(c),
        }
    }
    out
}

/// An image with caption and alternative text.
#[derive(Debug, Clone, PartialEq)]
pub struct Figure {
    bytes: Vec<u8>,
    alt: String,
    caption: String,
    scale: Option<ColorScale>,
}

impl Figure {
    /// Makes a figure of the bytes of a PNG or JPEG file. `caption` is printed below the image, and is its alternative text.
    pub fn new(bytes: Vec<u8>, caption: &str) -> Self {
        Self { bytes, alt: caption.to_owned(), caption: caption.to_owned(), scale: None }
    }

    /// Sets an alternative text other than the caption.
    #[must_use]
    pub fn alt(self, alt: &str) -> Self {
        Self { alt: alt.to_owned(), ..self }
    }

    /// Adds a color scale below the image.
    #[must_use]
    pub fn scale(self, scale: ColorScale) -> Self {
        Self { scale: Some(scale), ..self }
    }

    /// Reads width and height from the header of a PNG.
    fn png_size(&self) -> Option<(u32, u32)> {
        let header = self.bytes.get(..24)?;
        header.starts_with(b"\x89PNG").then(|| {
            let side = |at: usize| u32::from_be_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
            (side(16), side(20))
        })
    }
}

/// Kind of a highlighted note.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Note {
    /// Success.
    Good,
    /// Information.
    Info,
    /// Warning.
    Warning,
    /// Failure.
    Failure,
}

/// Builds a report from top to bottom; [`Report::to_html`] returns the file.
///
/// All inputs are text, never markup. The file needs no network and no other file.
#[derive(Debug, Clone, PartialEq)]
pub struct Report {
    title: String,
    subtitle: String,
    headline: Vec<(String, String)>,
    warnings: Vec<String>,
    sections: Vec<String>,
    body: String,
    figures: usize,
    tables: usize,
    has_viewer: bool,
}

impl Report {
    /// Makes an empty report.
    pub fn new(title: &str) -> Self {
        Self {
            title: title.to_owned(),
            subtitle: String::new(),
            headline: Vec::new(),
            warnings: Vec::new(),
            sections: Vec::new(),
            body: String::new(),
            figures: 0,
            tables: 0,
            has_viewer: false,
        }
    }

    /// Sets a line below the title, such as the names of the inputs.
    pub fn subtitle(&mut self, text: &str) -> &mut Self {
        self.subtitle = text.to_owned();
        self
    }

    /// Adds a warning at the top of the report.
    pub fn warn(&mut self, text: &str) -> &mut Self {
        let mut rest = text.chars();
        let first = rest.next().map(|c| c.to_uppercase().to_string());
        let stop = if text.ends_with('.') { "" } else { "." };
        self.warnings.push(format!("{}{}{stop}", first.unwrap_or_default(), rest.as_str()));
        self
    }

    /// Adds a key figure to the row of tiles at the top: label, and value with unit.
    pub fn headline(&mut self, label: &str, value: &str) -> &mut Self {
        self.headline.push((label.to_owned(), value.to_owned()));
        self
    }

    /// Begins a section; sections are listed in the table of contents.
    pub fn section(&mut self, title: &str) -> &mut Self {
        self.sections.push(title.to_owned());
        let _ = write!(self.body, "<h2 id=\"s{}\">{}</h2>", self.sections.len(), escape(title));
        self
    }

    /// Adds a paragraph.
    pub fn paragraph(&mut self, text: &str) -> &mut Self {
        let _ = write!(self.body, "<p>{}</p>", escape(text));
        self
    }

    /// Adds a highlighted paragraph.
    pub fn note(&mut self, kind: Note, text: &str) -> &mut Self {
        self.body.push_str(&note_html(kind, text));
        self
    }

    /// Adds the content of `build` as a collapsed block under `summary`, for details.
    pub fn folded(&mut self, summary: &str, build: impl FnOnce(&mut Self)) -> &mut Self {
        let _ = write!(self.body, "<details><summary>{}</summary>", escape(summary));
        build(self);
        self.body.push_str("</details>");
        self
    }

    /// Adds a table of the seconds of each stage.
    pub fn times(&mut self, stages: &[(&str, f64)]) -> &mut Self {
        let rows: Vec<[String; 2]> = stages.iter().map(|(name, s)| [(*name).to_owned(), format!("{s:.3} s")]).collect();
        self.table("Processing time by stage.", &["stage", "time"], &rows)
    }

    /// Adds a table of names and values.
    pub fn facts<K: AsRef<str>, V: AsRef<str>>(&mut self, caption: &str, rows: &[(K, V)]) -> &mut Self {
        self.begin_table(caption);
        self.body.push_str("<tbody>");
        for (key, value) in rows {
            let _ = write!(
                self.body,
                "<tr><th scope=\"row\">{}</th><td{}>{}</td></tr>",
                escape(key.as_ref()),
                long_word_class(value.as_ref()),
                escape(value.as_ref())
            );
        }
        self.body.push_str("</tbody></table></div>");
        self
    }

    fn begin_table(&mut self, caption: &str) {
        self.tables += 1;
        let _ = write!(
            self.body,
            "<p class=\"caption\" id=\"t{0}\"><b>Table {0}.</b> {1}</p><div class=\"scroll\"><table aria-labelledby=\"t{0}\">",
            self.tables,
            escape(caption)
        );
    }

    /// Adds a table with a header row. Numeric columns are right-aligned.
    pub fn table<R: AsRef<[S]>, S: AsRef<str>>(&mut self, caption: &str, head: &[&str], rows: &[R]) -> &mut Self {
        let cell = |row: &R, column: usize| row.as_ref().get(column).map_or(String::new(), |c| c.as_ref().to_owned());
        let numeric = |column: usize| {
            rows.iter().all(|r| is_numeric(&cell(r, column))) && rows.iter().any(|r| !cell(r, column).is_empty())
        };
        let numeric: Vec<bool> = (0..head.len()).map(numeric).collect();
        let class = |column: usize| if numeric.get(column) == Some(&true) { " class=\"n\"" } else { "" };
        self.begin_table(caption);
        self.body.push_str("<thead><tr>");
        for (i, cell) in head.iter().enumerate() {
            let _ = write!(self.body, "<th scope=\"col\"{}>{}</th>", class(i), escape(cell));
        }
        self.body.push_str("</tr></thead><tbody>");
        for row in rows {
            self.body.push_str("<tr>");
            for (i, cell) in row.as_ref().iter().enumerate() {
                let class = if numeric.get(i) == Some(&true) { class(i) } else { long_word_class(cell.as_ref()) };
                let _ = write!(self.body, "<td{class}>{}</td>", escape(cell.as_ref()));
            }
            self.body.push_str("</tr>");
        }
        self.body.push_str("</tbody></table></div>");
        self
    }

    /// Adds an image over the full width.
    pub fn figure(&mut self, figure: Figure) -> &mut Self {
        self.push_figure(&figure);
        self
    }

    /// Adds images in a grid, as many per row as fit.
    pub fn figures(&mut self, figures: Vec<Figure>) -> &mut Self {
        // Two or four images are arranged in rows of two.
        let pairs = if matches!(figures.len(), 2 | 4) { " pairs" } else { "" };
        let _ = write!(self.body, "<div class=\"grid{pairs}\">");
        figures.iter().for_each(|f| self.push_figure(f));
        self.body.push_str("</div>");
        self
    }

    fn push_figure(&mut self, figure: &Figure) {
        self.figures += 1;
        let kind = if figure.bytes.starts_with(&[0xff, 0xd8]) { "jpeg" } else { "png" };
        let size = match figure.png_size() {
            Some((w, h)) => format!(" width=\"{w}\" height=\"{h}\""),
            None => String::new(),
        };
        // Small images such as tiles are enlarged without interpolation.
        let class = if figure.png_size().is_some_and(|(w, _)| w < 320) { " class=\"small\"" } else { "" };
        let _ = write!(
            self.body,
            "<figure{class}><img alt=\"{}\"{size} src=\"data:image/{kind};base64,{}\">",
            escape(&figure.alt),
            base64::encode(&figure.bytes)
        );
        self.body.extend(figure.scale.as_ref().map(ColorScale::to_html));
        self.push_caption(&figure.caption);
        self.body.push_str("</figure>");
    }

    fn push_caption(&mut self, caption: &str) {
        let _ = write!(self.body, "<figcaption><b>Figure {}.</b> {}</figcaption>", self.figures, escape(caption));
    }

    /// Adds a plot.
    pub fn plot(&mut self, plot: &Plot, caption: &str) -> &mut Self {
        self.plots(&[(plot, caption)])
    }

    /// Adds plots in a grid.
    pub fn plots(&mut self, plots: &[(&Plot, &str)]) -> &mut Self {
        self.body.push_str("<div class=\"grid\">");
        for (plot, caption) in plots {
            self.figures += 1;
            let _ = write!(self.body, "<figure>{}", plot.to_svg());
            self.push_caption(caption);
            self.body.push_str("</figure>");
        }
        self.body.push_str("</div>");
        self
    }

    /// Adds an interactive viewer of a point cloud with cameras. `fallback` is a still image (PNG or JPEG bytes) for print and for
    /// browsers without WebGL 2.
    pub fn points(&mut self, scene: &PointScene, fallback: Option<Vec<u8>>, caption: &str) -> &mut Self {
        self.figures += 1;
        self.has_viewer = true;
        let _ = write!(self.body, "<figure class=\"cloud\" data-scene=\"{}\">", escape(&scene.to_json()));
        if let Some(bytes) = fallback {
            let figure = Figure::new(bytes, caption);
            let kind = if figure.bytes.starts_with(&[0xff, 0xd8]) { "jpeg" } else { "png" };
            let _ = write!(
                self.body,
                "<img class=\"still\" alt=\"{}\" src=\"data:image/{kind};base64,{}\">",
                escape(caption),
                base64::encode(&figure.bytes)
            );
        }
        self.push_caption(caption);
        self.body.push_str("</figure>");
        self
    }

    /// Renders the HTML file.
    pub fn to_html(&self) -> String {
        let mut html = String::with_capacity(self.body.len() + STYLE.len() + VIEWER.len() + 4096);
        let _ = write!(
            html,
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\">\
             <meta name=\"viewport\" content=\"width=device-width,initial-scale=1\">\
             <meta name=\"color-scheme\" content=\"light dark\"><title>{0}</title>\
             <link rel=\"icon\" href=\"data:,\"><style>{STYLE}</style></head>\n<body><header><h1>{0}</h1>",
            escape(&self.title)
        );
        if !self.subtitle.is_empty() {
            let _ = write!(html, "<p class=\"subtitle\">{}</p>", escape(&self.subtitle));
        }
        if !self.headline.is_empty() {
            html.push_str("<dl class=\"headline\">");
            for (label, value) in &self.headline {
                let _ = write!(html, "<div><dt>{}</dt><dd>{}</dd></div>", escape(label), escape(value));
            }
            html.push_str("</dl>");
        }
        self.warnings.iter().for_each(|text| html.push_str(&note_html(Note::Warning, text)));
        html.push_str("</header>\n");
        if self.sections.len() > 2 {
            html.push_str("<nav aria-label=\"Contents\"><ol>");
            for (i, title) in self.sections.iter().enumerate() {
                let _ = write!(html, "<li><a href=\"#s{}\">{}</a></li>", i + 1, escape(title));
            }
            html.push_str("</ol></nav>\n");
        }
        let _ = writeln!(html, "<main>{}</main>", self.body);
        let _ = write!(html, "<script>{SCRIPT}</script>");
        if self.has_viewer {
            let _ = write!(html, "<script>{VIEWER}</script>");
        }
        html.push_str("</body></html>\n");
        html
    }
}

/// Renders a highlighted paragraph.
fn note_html(kind: Note, text: &str) -> String {
    let (class, word) = match kind {
        Note::Good => ("good", "Good"),
        Note::Info => ("info", "Note"),
        Note::Warning => ("warning", "Warning"),
        Note::Failure => ("failure", "Failed"),
    };
    format!("<p class=\"note {class}\"><strong>{word}.</strong> {}</p>", escape(text))
}

/// Returns the class of a cell with words too long for a column, such as paths: they may break anywhere.
fn long_word_class(cell: &str) -> &'static str {
    if cell.split_whitespace().any(|word| word.chars().count() > 18) { " class=\"long\"" } else { "" }
}

/// Whether a cell is a number, optionally after a sign such as ≤ and before a unit, or a dash for a missing value.
fn is_numeric(cell: &str) -> bool {
    let bare = cell.trim_start_matches(['≤', '≥', '<', '>', '±', '~', ' ']);
    let first = bare.split([' ', '%']).next().unwrap_or("");
    let digits = first.replace([',', '\u{2009}', '×'], "").replace('−', "-");
    matches!(cell, "" | "–" | "-" | "—") || digits.parse::<f64>().is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_never_markup() {
        let mut report = Report::new("<script>alert(1)</script>");
        report
            .subtitle("a & b")
            .headline("<b>", "\"1\"")
            .section("s' <i>")
            .paragraph("x < y\u{0}")
            .note(Note::Warning, "<u>")
            .facts("f<", &[("k<", "v>")])
            .table("c<", &["h<"], &[vec!["d<"]])
            .figure(Figure::new(vec![1, 2, 3], "\" onload=\"alert(2)"))
            .warn("<hr>")
            .folded("<em>", |page| {
                page.paragraph("<tt>");
            });
        let html = report.to_html();
        let body = &html[html.find("<body>").unwrap()..html.find("<script>").unwrap()];
        for bad in ["alert(1)<", "<i>", "<u>", "\" onload", "<hr>", "<em>", "<tt>", "x < y", "\u{0}"] {
            assert!(!body.contains(bad), "{bad}");
        }
        assert!(body.contains("x &lt; y") && body.contains("&quot; onload"));
    }

    #[test]
    fn the_file_has_no_external_references() {
        let mut report = Report::new("t");
        report.section("a").figure(Figure::new(b"\xff\xd8\xff".to_vec(), "c")).plot(&Plot::new("p", "x", "y"), "c");
        let html = report.to_html();
        // The SVG namespace is an identifier, not a reference.
        let html = html.replace("http://www.w3.org/2000/svg", "");
        for outside in ["http://", "https://", "url(", "@import", "src=\"/", "<link rel=\"stylesheet"] {
            assert!(!html.contains(outside), "{outside}");
        }
        assert!(html.contains("data:image/jpeg;base64,/9j/"));
    }

    #[test]
    fn warnings_are_above_all_sections() {
        let mut report = Report::new("t");
        report.section("first").warn("mind the gap");
        let html = report.to_html();
        assert!(html.find("Mind the gap.").unwrap() < html.find("<main>").unwrap());
    }

    #[test]
    fn figures_and_tables_are_numbered_in_order() {
        let mut report = Report::new("t");
        report.figures(vec![Figure::new(vec![0], "one"), Figure::new(vec![0], "two")]);
        report.plot(&Plot::new("p", "x", "y"), "three");
        report.table("first", &["a", "b"], &[["x", "≤ 1.5 px"], ["y", "–"]]).facts("second", &[("a", "b")]);
        let html = report.to_html();
        for text in [
            "Figure 1.</b> one",
            "Figure 2.</b> two",
            "Figure 3.</b> three",
            "Table 1.</b> first",
            "Table 2.</b> second",
        ] {
            assert!(html.contains(text), "{text}");
        }
        assert!(html.contains("<td class=\"n\">≤ 1.5 px</td>") && html.contains("<td>x</td>"));
    }
}
