//! Selected corners against the definition.

use cv_core::Keypoint;
use cv_features::{anms, suppression_radii};
use proptest::prelude::*;

fn is_finite(c: &Keypoint) -> bool {
    c.position.x.is_finite() && c.position.y.is_finite() && c.response.is_finite()
}

/// The definition, O(n²).
fn plain(corners: &[Keypoint], n: usize, robust: f32) -> Vec<usize> {
    let radius = |i: usize| {
        let c = &corners[i];
        corners
            .iter()
            .filter(|o| is_finite(o) && c.response < robust * o.response)
            .map(|o| {
                let d = o.position - c.position;
                d.x * d.x + d.y * d.y
            })
            .fold(f32::INFINITY, f32::min)
    };
    let mut all: Vec<(f32, usize)> =
        (0..corners.len()).filter(|&i| is_finite(&corners[i])).map(|i| (radius(i), i)).collect();
    all.sort_by(|a, b| {
        b.0.total_cmp(&a.0).then(corners[b.1].response.total_cmp(&corners[a.1].response)).then(a.1.cmp(&b.1))
    });
    all.into_iter().take(n).map(|(_, i)| i).collect()
}

/// Positions on a coarse grid and few distinct responses, so that coincident corners and ties of distances and
/// responses occur.
fn coarse() -> impl Strategy<Value = Vec<Keypoint>> {
    prop::collection::vec((0i32..40, 0i32..9, -2i32..12), 0..300)
        .prop_map(|v| v.into_iter().map(|(x, y, r)| Keypoint::new(x as f32, y as f32, r as f32 * 0.1)).collect())
}

fn fine() -> impl Strategy<Value = Vec<Keypoint>> {
    prop::collection::vec((0.0f32..1000.0, 0.0f32..700.0, 0.0f32..1.0), 0..600)
        .prop_map(|v| v.into_iter().map(|(x, y, r)| Keypoint::new(x, y, r * r)).collect())
}

proptest! {
    #[test]
    fn equals_the_definition(corners in prop_oneof![coarse(), fine()], n in 0usize..400, robust in prop_oneof![Just(0.9f32), 0.1f32..1.0]) {
        prop_assert_eq!(anms(&corners, n, robust), plain(&corners, n, robust));
    }
}

#[test]
fn corners_that_are_not_finite_are_ignored() {
    let corners = [
        Keypoint::new(f32::NAN, 1.0, 9.0),
        Keypoint::new(1.0, 1.0, f32::INFINITY),
        Keypoint::new(5.0, 5.0, 1.0),
        Keypoint::new(5.0, 8.0, 0.5),
    ];
    assert_eq!(anms(&corners, 10, 0.9), [2, 3]);
    assert_eq!(suppression_radii(&corners, 0.9)[2..], [f32::INFINITY, 9.0]);
    assert_eq!(anms(&[], 10, 0.9), [0usize; 0]);
}
