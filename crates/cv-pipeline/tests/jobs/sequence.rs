//! Depth of consecutive frames with noise: a still room in which a near object moves.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, GrayF32, RgbU8, Silent};
use cv_pipeline::{DepthOptions, FrameDepth};
use cv_stereo::{DisparityMap, StereoMatcher, StereoOptions};
use cv_synth::{RenderOptions, Scene, stereo_pair};

const SIZE: (usize, usize) = (320, 240);
const FRAMES: usize = 6;
/// Disparity, size, rows and step of the object in px, and its first column.
const OBJECT: i64 = 36;
const OBJECT_SIZE: usize = 56;
const FIRST_ROW: usize = 90;
const STEP: usize = 9;
const FIRST_COLUMN: usize = 60;

struct Frame {
    images: [RgbU8; 2],
    truth: GrayF32,
    /// Visible in both images.
    visible: Vec<bool>,
}

fn object_columns(frame: usize) -> std::ops::Range<usize> {
    FIRST_COLUMN + STEP * frame..FIRST_COLUMN + STEP * frame + OBJECT_SIZE
}

/// Renders the frames, one stop underexposed, with noise of their own.
fn frames(seed: u64) -> Vec<Frame> {
    let scene = Scene::room(seed);
    let camera = Camera::from_focal(SIZE.0, SIZE.1, 260.0);
    let bright = stereo_pair(&scene, &camera, &scene.viewpoint(), 0.2, &RenderOptions::draft()).unwrap();
    let frame = |t: usize| {
        let noise = RenderOptions { full_well: 3000.0, seed: 500 + t as u64, ..RenderOptions::draft() };
        let pair = bright.retake(-1.0, &noise);
        let (mut left, mut right, mut truth) = (pair.left.image, pair.right.image, pair.disparity.clone());
        let mut visible = pair.visible.as_slice().to_vec();
        let hash = |x: usize, y: usize| ((x * 7919 + y * 104_729) as u32).wrapping_mul(2_654_435_761).rotate_left(9);
        let columns = object_columns(t);
        let hidden = columns.start as f32 - OBJECT as f32 - 1.0..(columns.end as i64 - OBJECT) as f32 + 1.0;
        for y in FIRST_ROW..FIRST_ROW + OBJECT_SIZE {
            for x in 0..SIZE.0 {
                visible[y * SIZE.0 + x] &= !hidden.contains(&(x as f32 - pair.disparity.at(x, y)[0]));
            }
            for (i, x) in columns.clone().enumerate() {
                let value = 50 + hash(i / 3, y / 3) % 97;
                let noisy = |salt: usize| [(value + hash(x + 977 * t, 3 * y + salt) % 5) as u8; 3];
                left.set(x, y, noisy(0));
                right.set((x as i64 - OBJECT) as usize, y, noisy(1));
                truth.set(x, y, [OBJECT as f32]);
                visible[y * SIZE.0 + x] = true;
            }
        }
        Frame { images: [left, right], truth, visible }
    };
    (0..FRAMES).map(frame).collect()
}

fn maps(frames: &[Frame], sequence: bool) -> Vec<DisparityMap> {
    // Not smoothed: that leaves less noise to average.
    let options = StereoOptions { disparities: 48, sequence, denoise: false, ..Default::default() };
    let mut matcher = StereoMatcher::new(options).unwrap();
    frames.iter().map(|f| matcher.compute(f.images[0].view(), f.images[1].view(), &Silent).unwrap()).collect()
}

/// Returns the percentage of the visible pixels of `is_in` that are off by more than 2 px.
fn bad(map: &DisparityMap, frame: &Frame, is_in: impl Fn(usize, usize) -> bool) -> f64 {
    let pixels: Vec<usize> =
        (0..SIZE.0 * SIZE.1).filter(|&i| frame.visible[i] && is_in(i % SIZE.0, i / SIZE.0)).collect();
    let is_right = |i: usize| (map.disparity.as_slice()[i] - frame.truth.as_slice()[i]).abs() <= 2.0;
    100.0 * (1.0 - pixels.iter().filter(|&&i| is_right(i)).count() as f64 / pixels.len() as f64)
}

/// Returns the median of the standard deviations over time of the pixels that no object covers, from the third frame on.
fn flicker(maps: &[DisparityMap]) -> f64 {
    let path = object_columns(0).start - OBJECT as usize..object_columns(FRAMES).end;
    let rows = FIRST_ROW - 8..FIRST_ROW + OBJECT_SIZE + 8;
    let still = (0..SIZE.0 * SIZE.1).filter(|i| !(path.contains(&(i % SIZE.0)) && rows.contains(&(i / SIZE.0))));
    let mut deviations: Vec<f64> = still
        .map(|i| {
            let values: Vec<f64> = maps[2..].iter().map(|map| f64::from(map.disparity.as_slice()[i])).collect();
            let mean = values.iter().sum::<f64>() / values.len() as f64;
            (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / (values.len() - 1) as f64).sqrt()
        })
        .collect();
    let middle = deviations.len() / 2;
    *deviations.select_nth_unstable_by(middle, f64::total_cmp).1
}

#[test]
fn a_sequence_flickers_half_as_much_and_moving_objects_leave_no_trail() {
    let (mut all, mut trail) = ([0.0; 2], [0.0; 2]);
    for seed in 0..2 {
        let frames = frames(seed);
        let (alone, filtered) = (maps(&frames, false), maps(&frames, true));
        assert_eq!(alone[0], filtered[0]);
        let (before, after) = (flicker(&alone), flicker(&filtered));
        println!("seed {seed}: flicker {before:.4} px, {after:.4} px as a sequence");
        assert!(after < 0.65 * before, "{after} {before}");
        for t in 1..FRAMES {
            // The object, and where it was in the previous frame.
            let (from, to) = (object_columns(t - 1).start, object_columns(t).end);
            let is_object =
                |x: usize, y: usize| (from..to).contains(&x) && (FIRST_ROW..FIRST_ROW + OBJECT_SIZE).contains(&y);
            for (i, maps) in [&alone, &filtered].into_iter().enumerate() {
                all[i] += bad(&maps[t], &frames[t], |_, _| true) / 10.0;
                trail[i] += bad(&maps[t], &frames[t], is_object) / 10.0;
            }
            let [single, joint] = [&alone, &filtered].map(|maps| bad(&maps[t], &frames[t], |_, _| true));
            // A tenth of a percent is within the spread of the noise.
            assert!(joint < single + 0.15, "frame {t}: {joint} {single}");
        }
    }
    println!(
        "errors {:.2} %, {:.2} % as a sequence; at the object {:.2} %, {:.2} %",
        all[0], all[1], trail[0], trail[1]
    );
    assert!(all[1] < all[0], "{all:?}");
    assert!(trail[1] < trail[0] + 0.3, "{trail:?}");
}

#[test]
fn a_cut_starts_anew_with_the_same_bytes_on_any_number_of_threads() {
    let (mut frames, other) = (frames(0), self::frames(1));
    frames.truncate(2);
    frames.extend(other.into_iter().take(2));
    let expected = maps(&frames, true);
    // The first frame after the cut is as alone, the second is not.
    let alone = maps(&frames, false);
    assert!(expected[2] == alone[2] && expected[3] != alone[3] && expected[1] != alone[1]);
    let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert!(pool.install(|| maps(&frames, true)) == expected);
    // The first frame is as alone with a correction of its vertical disparity, too.
    let stereo = StereoOptions { disparities: 48, sequence: true, ..Default::default() };
    let mut job = FrameDepth::new(DepthOptions { stereo, ..Default::default() }, None).unwrap();
    let down = |image: &RgbU8| RgbU8::from_fn(SIZE.0, SIZE.1, |x, y| image.at(x, y.saturating_sub(1)));
    let shifted = down(&frames[0].images[1]);
    let map = job.next(frames[0].images[0].view(), shifted.view(), &Silent).unwrap().clone();
    let options = StereoOptions { disparities: 48, ..Default::default() };
    let mut plain = FrameDepth::new(DepthOptions { stereo: options, ..Default::default() }, None).unwrap();
    assert!(*plain.next(frames[0].images[0].view(), shifted.view(), &Silent).unwrap() == map);
    assert!(job.vertical_offset().is_some());
}
