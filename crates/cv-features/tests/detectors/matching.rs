//! Matching of descriptors worked out by hand.

use cv_core::{DMatch, Silent};
use cv_features::{DescriptorKind, Descriptors, MatchError, MatchOptions, RatioMeasure, RatioTest, match_descriptors};

fn set(rows: &[&[f32]]) -> Descriptors {
    let mut data = Vec::new();
    for row in rows {
        let mut padded = [0.0; 64];
        padded[..row.len()].copy_from_slice(row);
        data.extend_from_slice(&padded);
    }
    Descriptors::from_vec(DescriptorKind::PATCH, data).unwrap()
}

#[test]
fn ratio_test_cross_check_and_one_to_one_filter() {
    let a = set(&[&[0.0, 0.0], &[10.0, 0.0], &[0.2, 0.0]]);
    let b = set(&[&[0.0, 1.0], &[0.0, 3.0], &[10.0, 1.0]]);
    let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
    let found = match_descriptors(&a, &b, &all, &Silent).unwrap();
    assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 0), (1, 2), (2, 0)]);
    assert_eq!((found[0].distance, found[0].ratio), (1.0, 1.0 / 9.0));
    let by_distance = MatchOptions { measure: RatioMeasure::Distance, ..all.clone() };
    let found = match_descriptors(&a, &b, &by_distance, &Silent).unwrap();
    assert_eq!((found[0].distance, found[0].ratio), (1.0, 1.0 / 3.0));
    let mutual = MatchOptions { mutual: true, ..all.clone() };
    let found = match_descriptors(&a, &b, &mutual, &Silent).unwrap();
    assert_eq!(found.iter().map(|m| (m.query, m.train)).collect::<Vec<_>>(), [(0, 0), (1, 2)]);
    let single = MatchOptions { one_to_one: true, ..all.clone() };
    assert_eq!(match_descriptors(&a, &b, &single, &Silent).unwrap(), found);
    let strict = MatchOptions { ratio: RatioTest::Below(0.05), ..MatchOptions::default() };
    assert_eq!(match_descriptors(&a, &b, &strict, &Silent).unwrap().len(), 1);
}

#[test]
fn duplicates_and_single_candidates_are_ambiguous() {
    let a = set(&[&[1.0]]);
    let twice = set(&[&[1.0], &[1.0]]);
    assert_eq!(match_descriptors(&a, &twice, &MatchOptions::default(), &Silent), Ok(vec![]));
    assert_eq!(match_descriptors(&a, &a, &MatchOptions::default(), &Silent), Ok(vec![]));
    let all = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
    let expected = DMatch { query: 0, train: 0, distance: 0.0, ratio: 1.0 };
    assert_eq!(match_descriptors(&a, &twice, &all, &Silent), Ok(vec![expected]));
    assert_eq!(match_descriptors(&a, &a, &all, &Silent), Ok(vec![expected]));
}

#[test]
fn empty_sets_and_invalid_options_are_rejected() {
    let (a, none) = (set(&[&[1.0]]), set(&[]));
    let options = MatchOptions::default();
    assert_eq!(match_descriptors(&none, &a, &options, &Silent), Err(MatchError::Empty { query: 0, train: 1 }));
    assert_eq!(match_descriptors(&a, &none, &options, &Silent), Err(MatchError::Empty { query: 1, train: 0 }));
    let bad = MatchOptions { ratio: RatioTest::Below(f32::NAN), ..options };
    assert!(matches!(match_descriptors(&a, &a, &bad, &Silent), Err(MatchError::Option(_))));
}
