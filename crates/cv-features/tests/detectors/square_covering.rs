//! Corners selected by squares and by tiles.

use cv_core::Keypoint;
use cv_features::{anms_square_covering, anms_tiled};

fn random(count: usize) -> Vec<Keypoint> {
    let mut state = 3u32;
    let mut next = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 8) as f32 / (1 << 24) as f32
    };
    // A quarter of the corners is in a tenth of the width.
    (0..count)
        .map(|i| Keypoint::new(if i % 4 == 0 { 80.0 * next() } else { 800.0 * next() }, 600.0 * next(), next()))
        .collect()
}

#[test]
fn selected_corners_are_strong_and_separated() {
    let corners = random(5000);
    let selected = anms_square_covering(&corners, 300);
    assert_eq!(selected.len(), 300);
    let strongest = (0..5000).max_by(|&a, &b| corners[a].response.total_cmp(&corners[b].response)).unwrap();
    assert_eq!(selected[0], strongest);
    let mut nearest = f32::INFINITY;
    for (i, &a) in selected.iter().enumerate() {
        assert!(i == 0 || corners[selected[i - 1]].response >= corners[a].response);
        for &b in &selected[..i] {
            let d = corners[a].position - corners[b].position;
            nearest = nearest.min(d.x.abs().max(d.y.abs()));
        }
    }
    // 330 squares with at most half overlap cover 800 × 600 px at a side of 38 px; random packing reaches about
    // half the density: 27 px. The minimum separation is two cells of half a side, minus the position within a
    // cell.
    assert!(nearest > 19.0, "{nearest}");
    assert_eq!(anms_square_covering(&corners[..10], 300).len(), 10);
    assert_eq!(anms_square_covering(&[corners[0]; 50], 3).len(), 3);
    assert!(anms_square_covering(&[], 3).is_empty() && anms_square_covering(&corners, 0).is_empty());
}

#[test]
fn tiles_have_equal_counts() {
    let corners = random(5000);
    let selected = anms_tiled(&corners, 96, (4, 3));
    let mut counts = [0; 12];
    for i in selected {
        let p = corners[i].position;
        counts[(p.y / 200.0) as usize * 4 + (p.x / 200.0) as usize] += 1;
    }
    // The tiles divide the bounding box of the corners, slightly less than 800 × 600: a corner near a tile's edge
    // may count for the neighboring tile.
    assert!(counts.iter().all(|c| (7..=9).contains(c)), "{counts:?}");
    assert_eq!(anms_tiled(&corners, 9999, (4, 3)).len(), 5000);
    assert!(anms_tiled(&[], 9, (0, 0)).is_empty());
    let bad = [Keypoint::new(f32::NAN, 0.0, 1.0), Keypoint::new(0.0, 0.0, 1.0)];
    assert_eq!((anms_tiled(&bad, 9, (2, 2)), anms_square_covering(&bad, 9)), (vec![1], vec![1]));
}
