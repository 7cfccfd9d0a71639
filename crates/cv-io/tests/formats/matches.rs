//! Files of matches.

use cv_core::Correspondence;
use cv_io::{FormatError, Matches, parse_matches, read_matches, write_matches};
use proptest::prelude::*;

#[test]
fn comments_blank_lines_and_separators() {
    let read = parse_matches("# a header\r\n\r\n1 2 3 4 # tail\n5,6;7\t8\r\n").unwrap();
    assert_eq!(read.pairs, [Correspondence::new(1.0, 2.0, 3.0, 4.0), Correspondence::new(5.0, 6.0, 7.0, 8.0)]);
    assert_eq!(read.scores, None);
    assert_eq!(parse_matches("1 2 3 4 0.5").unwrap().scores, Some(vec![0.5]));
    assert_eq!(parse_matches("").unwrap(), Matches::default());
}

#[test]
fn invalid_rows_are_reported_with_their_line() {
    for (text, line, word) in [
        ("1 2 3 4\n1 2 3\n", 2, "3 column"),
        ("\n\n1 2 x 4", 3, "“x”"),
        ("1 2 3 4 5 6", 1, "more than five"),
        ("1 2 3 4\n1 2 3 4 5", 2, "some rows"),
        ("1 2 3 4 5\n1 2 3 4", 2, "some rows"),
    ] {
        match parse_matches(text).unwrap_err() {
            FormatError::Line { line: l, reason } => {
                assert!(l == line && reason.contains(word), "{text:?}: {l} {reason}")
            }
            other => panic!("{other}"),
        }
    }
}

proptest! {
    #[test]
    fn files_round_trip(
        rows in prop::collection::vec(prop::array::uniform5(prop::num::f64::NORMAL | prop::num::f64::ZERO), 0..20),
        scored in any::<bool>(),
    ) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("m.txt");
        let pairs: Vec<_> = rows.iter().map(|r| Correspondence::new(r[0], r[1], r[2], r[3])).collect();
        let scores: Vec<_> = rows.iter().map(|r| r[4]).collect();
        write_matches(&path, &pairs, scored.then_some(&scores)).unwrap();
        let back = read_matches(&path).unwrap();
        prop_assert_eq!(back.pairs, pairs);
        prop_assert_eq!(back.scores, (scored && !scores.is_empty()).then_some(scores));
    }
}
