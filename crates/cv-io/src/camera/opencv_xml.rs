//! OpenCV's FileStorage as XML, read and written by conversion from and to YAML.

use std::fmt::Write as _;

use super::format::Format;
use super::opencv;
use crate::FormatError;

const NAME: &str = "OpenCV XML";
/// Maximum file size in bytes; camera files take a few kilobytes.
const MAX_BYTES: usize = 4 << 20;

pub(super) const FORMAT: Format = Format {
    name: "opencv-xml",
    matches: |text| {
        let text = text.trim_start();
        text.starts_with("<?xml") || text.starts_with("<opencv_storage")
    },
    camera: |text, context| (opencv::FORMAT.camera)(&as_yaml(text)?, context),
    rig: Some(|text, context| match opencv::FORMAT.rig {
        Some(rig) => rig(&as_yaml(text)?, context),
        None => Err(FormatError::unsupported(NAME, "a rig")),
    }),
    camera_text: Some(|camera, notes| as_xml(opencv::FORMAT.camera_text.map(|write| write(camera, &[])), notes)),
    rig_text: Some(|file, notes| as_xml(opencv::FORMAT.rig_text.map(|write| write(file, &[])), notes)),
    array: None,
    array_text: None,
};

/// Parses the next element: its name, its content, and the rest. Comments and declarations are skipped; entities are never expanded.
fn element(text: &str) -> Result<Option<(&str, &str, &str)>, FormatError> {
    let broken = |what: &str| FormatError::corrupt(NAME, what.to_owned());
    let mut rest = text;
    loop {
        let Some(at) = rest.find('<') else { return Ok(None) };
        rest = &rest[at..];
        let end = if rest.starts_with("<!--") {
            rest.find("-->").map(|e| e + 3)
        } else if rest.starts_with("<?") {
            rest.find("?>").map(|e| e + 2)
        } else if rest.starts_with("<!") {
            // A document type could define entities, which calibration files do not need.
            return Err(FormatError::unsupported(NAME, "a document type"));
        } else {
            break;
        };
        rest = &rest[end.ok_or_else(|| broken("a comment or declaration does not end"))?..];
    }
    let end = rest.find('>').ok_or_else(|| broken("a tag does not end"))?;
    let tag = &rest[1..end];
    let name = tag.split(|c: char| c.is_whitespace() || c == '/').next().unwrap_or_default();
    if name.is_empty() || !name.chars().all(|c| c.is_ascii_alphanumeric() || "_-.".contains(c)) {
        return Err(broken("a tag has no name"));
    }
    let body = &rest[end + 1..];
    if tag.ends_with('/') {
        return Ok(Some((name, "", body)));
    }
    let close = format!("</{name}>");
    let at = body.find(&close).ok_or_else(|| broken("a tag is not closed"))?;
    Ok(Some((name, &body[..at], &body[at + close.len()..])))
}

/// Converts FileStorage XML to YAML.
fn as_yaml(text: &str) -> Result<String, FormatError> {
    if text.len() > MAX_BYTES {
        return Err(FormatError::TooManyBytes { bytes: text.len() as u64, limit: MAX_BYTES as u64 });
    }
    let (root, mut rest) = match element(text)? {
        Some((root, content, _)) => (root, content),
        None => return Err(FormatError::Empty),
    };
    if root != "opencv_storage" {
        return Err(FormatError::unsupported(NAME, format!("the document {root} (it is opencv_storage)")));
    }
    let mut out = String::new();
    while let Some((name, content, next)) = element(rest)? {
        rest = next;
        let list = |text: &str| text.split_whitespace().collect::<Vec<_>>().join(", ");
        let mut inner = content;
        let (mut rows, mut cols, mut data) = (None, None, None);
        while let Some((key, value, after)) = element(inner)? {
            inner = after;
            match key {
                "rows" => rows = Some(value.trim()),
                "cols" => cols = Some(value.trim()),
                "data" => data = Some(list(value)),
                _ => {}
            }
        }
        // Only plain scalars, so that content cannot inject YAML.
        let plain = |text: &str| text.chars().all(|c| c.is_ascii_alphanumeric() || "+-._, ".contains(c));
        match (rows, cols, data) {
            (Some(rows), Some(cols), Some(data)) if plain(rows) && plain(cols) && plain(&data) => {
                let _ = writeln!(out, "{name}: {{rows: {rows}, cols: {cols}, data: [{data}]}}");
            }
            (None, None, None) => {
                let text = list(content.trim().trim_matches('"'));
                if plain(&text) && !text.is_empty() && !content.contains('<') {
                    let value = if text.contains(',') { format!("[{text}]") } else { text };
                    let _ = writeln!(out, "{name}: {value}");
                }
            }
            _ => return Err(FormatError::corrupt(NAME, format!("{name} is not a matrix"))),
        }
    }
    Ok(out)
}

/// Converts the YAML of our writer, whose layout is known, to XML.
fn as_xml(yaml: Option<Result<String, FormatError>>, notes: &[&str]) -> Result<String, FormatError> {
    let yaml = yaml.ok_or_else(|| FormatError::unsupported(NAME, "writing"))??;
    let mut out = "<?xml version=\"1.0\"?>\n<opencv_storage>\n".to_owned();
    for line in notes.iter().flat_map(|n| n.lines()) {
        let safe: String = line.chars().filter(|c| !c.is_control() && !"<>&-".contains(*c)).collect();
        let _ = writeln!(out, "<!-- {safe} -->");
    }
    let mut open = "";
    for line in yaml.lines().filter(|l| !l.starts_with(['%', '-', '#'])) {
        let Some((key, value)) = line.split_once(':') else { continue };
        match (line.starts_with(' '), value.trim()) {
            (false, "!!opencv-matrix") => {
                open = key;
                let _ = writeln!(out, "<{key} type_id=\"opencv-matrix\">");
            }
            (true, value) => {
                let key = key.trim();
                let numbers = value.trim_matches(['[', ']']).replace(',', "");
                let _ = writeln!(out, "  <{key}>{numbers}</{key}>");
                if key == "data" {
                    let _ = writeln!(out, "</{open}>");
                }
            }
            (false, value) => {
                let _ = writeln!(out, "<{key}>{value}</{key}>");
            }
        }
    }
    out.push_str("</opencv_storage>\n");
    Ok(out)
}
