//! Files of camera positions.

use cv_core::Point3;
use cv_io::{FormatError, parse_camera_positions};

#[test]
fn rows_with_any_separator_are_parsed() {
    let expected = vec![("a.jpg".to_owned(), Point3::new(1.0, -2.5, 3e2)), ("b.jpg".into(), Point3::origin())];
    for text in [
        "a.jpg 1 -2.5 300\nb.jpg 0 0 0\n",
        "# comment\nname,x,y,z\na.jpg, 1, -2.5, 3e2\n\n\"b.jpg\",0,0,0 # last",
        "\u{feff}photo\teast\tnorth\tup\r\na.jpg\t1\t-2.5\t300\r\nb.jpg\t0\t0\t0\r\n",
    ] {
        assert_eq!(parse_camera_positions(text).unwrap(), expected, "{text}");
    }
    assert_eq!(parse_camera_positions("in the yard.jpg;1;2;3").unwrap()[0].0, "in the yard.jpg");
}

#[test]
fn invalid_rows_are_reported_with_their_line() {
    for (text, line) in [
        ("a 1 2 3\nb 1 2", 2),
        ("a 1 2 3 4", 1),
        ("name x y z\nb 1 2 inf", 2),
        ("a 1 2 3\na 1 2 3", 2),
        ("a 1 x 3", 1),
        ("only", 1),
    ] {
        match parse_camera_positions(text) {
            Err(FormatError::Line { line: at, .. }) => assert_eq!(at, line, "{text}"),
            other => assert!(other.is_err(), "{text}: {other:?}"),
        }
    }
    assert!(matches!(parse_camera_positions("# nothing\nname x y z"), Err(FormatError::Empty)));
}
