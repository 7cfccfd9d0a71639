//! Libraries are independent of the program: their string literals name none of its options (`--name`) or commands.

/// Returns the lines, counted from 1, of string literals that name an option or a command of the program. Text after `#[cfg(test)]`
/// is not checked.
pub(super) fn lines(source: &str) -> Vec<usize> {
    let end = source.find("#[cfg(test)]").unwrap_or(source.len());
    let mut found = Vec::new();
    for (start, literal) in string_literals(&source[..end]) {
        if names_an_option(literal) || literal.contains("`cv ") {
            found.push(source[..start].matches('\n').count() + 1);
        }
    }
    found
}

/// Returns whether the text has `--` and a lowercase letter, except in CSS variables such as `var(--ink)`.
fn names_an_option(text: &str) -> bool {
    text.match_indices("--").any(|(at, dashes)| {
        let letter = text[at + dashes.len()..].starts_with(|c: char| c.is_ascii_lowercase());
        let before = text[..at].trim_end_matches('(');
        letter && !before.ends_with("var") && !before.ends_with('-')
    })
}

/// Returns the string literals of Rust source, plain and raw, with their byte offsets. Comments are skipped.
fn string_literals(source: &str) -> Vec<(usize, &str)> {
    let mut found = Vec::new();
    let mut at = 0;
    while let Some(rest) = source.get(at..).filter(|rest| !rest.is_empty()) {
        let step = rest.chars().next().map_or(1, char::len_utf8);
        if rest.starts_with("//") {
            at += rest.find('\n').unwrap_or(rest.len());
        } else if let Some(raw) = rest.strip_prefix('r').filter(|raw| raw.trim_start_matches('#').starts_with('"')) {
            let hashes = raw.len() - raw.trim_start_matches('#').len();
            let body = at + hashes + 2;
            let close = format!("\"{}", "#".repeat(hashes));
            let length = source[body..].find(&close).unwrap_or(source.len() - body);
            found.push((at, &source[body..body + length]));
            at = body + length + close.len();
        } else if let Some(body) = rest.strip_prefix('"') {
            let mut escaped = false;
            let closes = |c: char| {
                let closes = c == '"' && !escaped;
                escaped = c == '\\' && !escaped;
                closes
            };
            let length = body.find(closes).unwrap_or(body.len());
            found.push((at, &body[..length]));
            at += length + 2;
        } else if rest.starts_with("'\"'") || rest.starts_with("'\\\"'") {
            // A quote in a character literal.
            at += rest[1..].find('\'').map_or(1, |end| end + 2);
        } else {
            at += step;
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_and_commands_in_strings_are_found() {
        let source = "// --fine in a comment\nlet a = \"give --focal\";\nlet b = r#\"use `cv match`\"#;\nlet c = \"(--rig) \\\" \";\n";
        assert_eq!(lines(source), [2, 3, 4]);
        let across = "let a = \"two \\\n    lines --here\";\n";
        assert_eq!(lines(across), [1]);
    }

    #[test]
    fn dashes_other_than_options_are_ignored() {
        let source = "let a = \"var(--ink,#222) a -- b ---- --\"; let q = '\"'; let b = '\\\"'; let n = a--b; // \"--x\"\n\
                      let r#type = 1;\n#[cfg(test)]\nlet a = \"--tested\";\n";
        assert_eq!(lines(source), [0; 0]);
    }
}
