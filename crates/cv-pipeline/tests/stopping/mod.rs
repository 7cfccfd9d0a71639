//! All jobs on generated inputs, for the tests of cancellation.

#![allow(dead_code, reason = "each test file uses its part")]
#![allow(clippy::unwrap_used, clippy::panic, reason = "a test that cannot go on has failed")]

use cv_core::{Camera, Correspondence, Mask, Pose, Progress, RgbU8, Rotation3, StereoRig, Vector3};
use cv_pipeline::segmentation::TrainOptions;
use cv_pipeline::stereo::{Smoothing, StereoOptions};
use cv_pipeline::{
    AffineSimulation, DenseOptions, DepthError, DepthOptions, EstimateError, FeatureMethod, FeatureOptions, Intrinsics,
    MatchingError, MatchingOptions, ModelKind, ReconstructError, ReconstructOptions, TwoViewOptions, depth, estimate,
    match_photos, reconstruct, reconstruct_dense, rectify, segment, train_segment,
};
use cv_synth::{RenderOptions, two_view};

/// How a job ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum End {
    Done,
    Stopped,
}

/// Returns `Stopped` for the error variant `Cancelled`; any other error fails the test.
macro_rules! end {
    ($result:expr, $stopped:pat) => {
        match $result {
            Ok(_) => End::Done,
            Err($stopped) => End::Stopped,
            Err(error) => panic!("{error}"),
        }
    };
}

/// The name of a job, and the job.
pub(crate) type Job = (&'static str, Box<dyn Fn(&dyn Progress) -> End + Sync>);

/// Returns a gray level: random blocks of four sizes.
fn texture(x: usize, y: usize) -> u8 {
    let cell = |size: usize| {
        let (i, j) = ((x / size) as u32, (y / size) as u32);
        let mut v = i.wrapping_mul(0x9E37_79B9) ^ (j + size as u32).wrapping_mul(0x85EB_CA6B);
        v = (v ^ (v >> 15)).wrapping_mul(0x2C1B_3C6D);
        v = (v ^ (v >> 12)).wrapping_mul(0x297A_2D39);
        (v >> 24) as u8
    };
    [2, 5, 11, 29].map(|size| cell(size) / 4).iter().sum()
}

/// Creates a textured wall, and the same one moved by `shift` pixels to the left.
fn walls(width: usize, height: usize, shift: usize) -> [RgbU8; 2] {
    [0, shift].map(|shift| RgbU8::from_fn(width, height, |x, y| [texture(x + shift, y); 3]))
}

/// Returns all jobs on images with about the given number of pixels.
pub(crate) fn jobs(pixels: usize) -> Vec<Job> {
    let width = ((pixels as f64 * 4.0 / 3.0).sqrt() as usize).next_multiple_of(4);
    let height = width * 3 / 4;
    let mut jobs: Vec<Job> = Vec::new();
    for (name, method, views) in [
        ("match sift", FeatureMethod::Sift, AffineSimulation::Never),
        ("match mops", FeatureMethod::Mops, AffineSimulation::Never),
        ("match harris", FeatureMethod::Harris, AffineSimulation::Never),
        ("match affine views", FeatureMethod::Sift, AffineSimulation::Always),
    ] {
        // More than thirty simulated affine views of each image: on small ones.
        let part = if views == AffineSimulation::Always { 3 } else { 1 };
        let [a, b] = walls(width / part, height / part, 40);
        let features = FeatureOptions::from(method);
        let features = if views == AffineSimulation::Always { features.at_most(500) } else { features };
        let guided = (method == FeatureMethod::Harris).then_some(ModelKind::Homography);
        let options = MatchingOptions { features, affine_simulation: views, guided, ..MatchingOptions::default() };
        jobs.push((
            name,
            Box::new(move |progress| {
                end!(match_photos(a.view(), b.view(), &options, progress), MatchingError::Cancelled(_))
            }),
        ));
    }
    // One match in five is correct: thousands of samples.
    let outlier = |i: usize, salt: usize| ((i * 7919 + salt * 104_729) % 4001) as f64;
    let pairs: Vec<Correspondence> = (0..20_000)
        .map(|i| match i % 5 {
            0 => Correspondence::new(outlier(i, 1), outlier(i, 2), outlier(i, 1) + 25.0, outlier(i, 2) - 10.0),
            _ => Correspondence::new(outlier(i, 1), outlier(i, 2), outlier(i, 3), outlier(i, 4)),
        })
        .collect();
    jobs.push((
        "estimate",
        Box::new(move |progress| {
            let kind = ModelKind::Homography;
            end!(estimate(&pairs, kind, &kind.options(), progress), EstimateError::Cancelled(_))
        }),
    ));
    for (name, smoothing, strips) in [
        ("depth", StereoOptions::default().smoothing, false),
        ("depth least squares", Smoothing::LeastSquares { lambda: 100.0, sigma: 1.5 }, true),
    ] {
        let [left, right] = walls(width, height, 23);
        let mut stereo = StereoOptions { smoothing, confidence: true, ..StereoOptions::default() };
        if strips {
            // Less memory than for the whole cost volume: it is processed in strips.
            stereo.search = cv_pipeline::stereo::Search::Full;
            let matcher = cv_pipeline::stereo::StereoMatcher::new(stereo.clone()).unwrap();
            stereo.max_memory = Some(matcher.memory(width, height) * 3 / 4);
        }
        let options = DepthOptions { stereo, ..DepthOptions::default() };
        jobs.push((
            name,
            Box::new(move |progress| {
                end!(depth(left.view(), right.view(), None, &options, progress), DepthError::Cancelled(_))
            }),
        ));
    }
    let camera = Camera::from_focal(width, height, width as f64);
    let pose = Pose::new(Rotation3::from_euler_angles(0.01, 0.02, -0.01), Vector3::new(-0.2, 0.0, 0.0));
    let rig = StereoRig { left: camera, right: camera, right_from_left: pose };
    let [left, right] = walls(width, height, 23);
    jobs.push((
        "rectify",
        Box::new(move |progress| {
            use cv_pipeline::stereo::RectifyError;
            let result = rectify(left.view(), right.view(), &rig, &Default::default(), progress);
            end!(result, RectifyError::Cancelled(_))
        }),
    ));
    let [photo, _] = walls(width, height, 0);
    let mask = Mask::from_fn(width, height, |x, y| [(x / 64 + y / 64) % 5 == 0]);
    let photo = RgbU8::from_fn(width, height, |x, y| {
        let [v, ..] = photo.at(x, y);
        if mask.at(x, y)[0] { [v, 200, 90] } else { [130, v, 60] }
    });
    jobs.push((
        "segment",
        Box::new(move |progress| {
            use cv_pipeline::segmentation::SegmentError;
            let training = train_segment(&[(photo.view(), mask.view())], &TrainOptions::default(), progress);
            let model = match training {
                Ok(training) => training.trained.model,
                Err(SegmentError::Cancelled(_)) => return End::Stopped,
                Err(error) => panic!("{error}"),
            };
            match segment(photo.view(), &model, progress) {
                Ok(_) => End::Done,
                Err(cv_core::Cancelled) => End::Stopped,
            }
        }),
    ));
    // A room as a photograph shows it, larger.
    let small = Camera::from_focal(480, 360, 400.0);
    let views = two_view(3, &small, 0.3, &RenderOptions::draft()).unwrap();
    let large =
        |image: &RgbU8| cv_imgproc::resize(image.view(), width, height, cv_imgproc::Interpolation::Bilinear).unwrap();
    let photos = [large(&views.a.image), large(&views.b.image)];
    let two_view =
        TwoViewOptions { intrinsics: Intrinsics::Focal([400.0 * width as f64 / 480.0; 2]), ..Default::default() };
    let options = ReconstructOptions { two_view, max_size: width, ..ReconstructOptions::default() };
    jobs.push((
        "reconstruct",
        Box::new(move |progress| {
            let [a, b] = [0, 1].map(|i: usize| photos[i].view());
            let sparse = match reconstruct(a, b, &options, progress) {
                Ok(sparse) => sparse,
                Err(ReconstructError::Cancelled(_)) => return End::Stopped,
                Err(error) => panic!("{error}"),
            };
            let dense = DenseOptions { max_size: width, ..DenseOptions::default() };
            end!(reconstruct_dense(a, b, &sparse, &dense, progress), cv_pipeline::DenseError::Cancelled(_))
        }),
    ));
    jobs
}
