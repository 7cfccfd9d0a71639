//! `cargo bench --manifest-path benches/Cargo.toml --bench features`: the stages on a generated 1333×750 image, and matching on generated descriptors.

use criterion::{Criterion, criterion_group, criterion_main};
use cv_core::{GrayF32, Keypoint, Matrix3, Silent};
use cv_features::{
    BoardSize, ByteDescriptors, ChessboardOptions, DescriptorKind, Descriptors, Features, GuidedOptions, HarrisOptions,
    MatchOptions, MopsOptions, RatioTest, SiftOptions, TwoViewModel, anms, anms_square_covering, find_chessboard,
    harris, harris_response, match_byte_descriptors, match_descriptors, match_guided, mops, sift,
};

/// Generates squares of random gray levels at several sizes: corners and blobs at all scales.
fn generate_image() -> GrayF32 {
    let cell = |x: usize, y: usize, size: usize| {
        let mut v =
            ((x / size) as u32).wrapping_mul(0x9E37_79B9) ^ ((y / size + size) as u32).wrapping_mul(0x85EB_CA6B);
        v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
        v = (v ^ (v >> 12)).wrapping_mul(0x297A_2D39);
        ((v ^ (v >> 15)) >> 8) as f32 / (1 << 24) as f32
    };
    GrayF32::from_fn(1333, 750, |x, y| [[3, 7, 13, 29, 61].map(|size| cell(x, y, size)).iter().sum::<f32>() / 5.0])
}

/// Returns uniform pseudorandom numbers in [0, 1).
fn random(state: &mut u32) -> f32 {
    *state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
    (*state >> 8) as f32 / (1 << 24) as f32
}

fn detection(c: &mut Criterion) {
    let image = generate_image();
    let options = HarrisOptions::default();
    c.bench_function("harris_response 1333x750", |b| b.iter(|| harris_response(image.view(), &options)));
    c.bench_function("harris 1333x750", |b| b.iter(|| harris(image.view(), &options, &Silent)));
    let mut state = 1;
    let corners: Vec<Keypoint> = (0..20_000)
        .map(|_| Keypoint::new(1333.0 * random(&mut state), 750.0 * random(&mut state), random(&mut state).powi(3)))
        .collect();
    c.bench_function("anms 20000 to 500", |b| b.iter(|| anms(&corners, 500, 0.9)));
    c.bench_function("anms_square_covering 20000 to 500", |b| b.iter(|| anms_square_covering(&corners, 500)));
    let (sift_options, mops_options) =
        (SiftOptions { max_features: 2000, ..SiftOptions::default() }, MopsOptions::default());
    let board = GrayF32::from_fn(1333, 750, |x, y| {
        // Ten by seven squares of 80 pixels, rotated by 20°.
        let (u, v) = (x as f32 * 0.94 + y as f32 * 0.34 - 350.0, y as f32 * 0.94 - x as f32 * 0.34 + 150.0);
        let inside = (0.0..800.0).contains(&u) && (0.0..560.0).contains(&v);
        [if inside && ((u / 80.0) as u32 + (v / 80.0) as u32) % 2 == 0 { 0.1 } else { 0.8 }]
    });
    let (size, board_options) = (Some(BoardSize::new(9, 6)), ChessboardOptions::default());
    assert!(find_chessboard(board.view(), size, &board_options, &Silent).is_ok());
    c.bench_function("chessboard 9x6 in 1333x750", |b| {
        b.iter(|| find_chessboard(board.view(), size, &board_options, &Silent))
    });
    c.bench_function("no chessboard in 1333x750", |b| {
        b.iter(|| find_chessboard(image.view(), size, &board_options, &Silent))
    });
    c.bench_function("sift 2000 of 1333x750", |b| b.iter(|| sift(image.view(), &sift_options, &Silent)));
    c.bench_function("mops 2000 of 1333x750", |b| b.iter(|| mops(image.view(), &mops_options, &Silent)));
}

fn matching(c: &mut Criterion) {
    let mut state = 1;
    let options = MatchOptions { ratio: RatioTest::Off, ..MatchOptions::default() };
    for (count, kind) in [(2000, DescriptorKind::PATCH), (8192, DescriptorKind::ROOT_SIFT)] {
        let mut set = || (0..count * kind.dimension).map(|_| random(&mut state)).collect::<Vec<f32>>();
        let empty = || Descriptors::new(kind);
        let pair = [set(), set()].map(|data| Descriptors::from_vec(kind, data).unwrap_or_else(empty));
        let name = format!("two nearest neighbors {count}x{count}x{}", kind.dimension);
        c.bench_function(&name, |b| b.iter(|| match_descriptors(&pair[0], &pair[1], &options, &Silent)));
        if let [Some(x), Some(y)] = [0, 1].map(|i| ByteDescriptors::new(&pair[i])) {
            let name = format!("{name} of bytes");
            c.bench_function(&name, |b| b.iter(|| match_byte_descriptors(&x, &y, &options, &Silent)));
        }
    }
    // Sideways motion: the epipolar lines are the rows.
    let rows = TwoViewModel::Fundamental(Matrix3::new(0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0));
    let kind = DescriptorKind::ROOT_SIFT;
    let features = [0, 1].map(|_| {
        let mut features = Features::new(kind);
        for _ in 0..12_000 {
            let row: Vec<f32> = (0..kind.dimension).map(|_| 0.2 * random(&mut state)).collect();
            features.push(Keypoint::new(3072.0 * random(&mut state), 2048.0 * random(&mut state), 1.0), &row);
        }
        features
    });
    let guided_options = GuidedOptions::default();
    c.bench_function("guided 12000x12000", |b| {
        b.iter(|| match_guided(&features[0], &features[1], None, &rows, &guided_options, &Silent));
    });
}

criterion_group! {
    name = benches;
    config = Criterion::default().sample_size(15);
    targets = detection, matching
}
criterion_main!(benches);
