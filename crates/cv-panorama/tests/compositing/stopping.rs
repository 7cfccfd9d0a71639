//! A panorama stops within 200 ms of a cancellation request, in its longest stages too.

use cv_core::{Camera, Cancelled, ImageView, Named, Progress, RgbU8, Vector3};
use cv_panorama::{AlignedPair, Alignment, BlendMode, CameraMotion, CompositingOptions, RenderError, View, render};
use nalgebra::Rotation3;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Mutex, OnceLock};
use std::time::{Duration, Instant};

/// Records the time and stage of each poll; cancels at a given number of polls.
struct Asked {
    stop_at: usize,
    count: AtomicUsize,
    times: Mutex<Vec<(&'static str, Duration)>>,
}

/// Processor time of this thread, to exclude other load; wall time if the system does not report it.
fn worked() -> Duration {
    static START: OnceLock<Instant> = OnceLock::new();
    // Linux: the first number is the nanoseconds on a processor.
    let told = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let nanoseconds = told.as_deref().and_then(|text| text.split(' ').next()?.parse().ok());
    nanoseconds.map_or_else(|| START.get_or_init(Instant::now).elapsed(), Duration::from_nanos)
}

impl Asked {
    fn new(stop_at: usize) -> Self {
        Self { stop_at, count: AtomicUsize::new(0), times: Mutex::new(vec![("begin", worked())]) }
    }

    /// Time between one question and the next, with the stage of the next, and from the last until now.
    fn gaps(self) -> Vec<(&'static str, Duration)> {
        let mut times = self.times.into_inner().unwrap();
        times.push(("end", worked()));
        times.windows(2).map(|w| (w[1].0, w[1].1.saturating_sub(w[0].1))).collect()
    }
}

impl Progress for Asked {
    fn report(&self, stage: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        self.times.lock().unwrap().push((stage, worked()));
        if self.count.fetch_add(1, Ordering::Relaxed) + 1 >= self.stop_at { Err(Cancelled) } else { Ok(()) }
    }
}

/// Photographs of a given width with a field of view of 50°, spaced by 30°, all with the same texture: the mismatch at the seams makes the graph
/// cuts slow.
struct Set {
    photo: RgbU8,
    count: usize,
    alignment: Alignment,
}

impl Set {
    fn new(count: usize, width: usize) -> Self {
        let height = width * 3 / 4;
        let photo = RgbU8::from_fn(width, height, |x, y| {
            let coarse = ((x / 37) * 7919 + (y / 29) * 104_729) % 97;
            let fine = ((x * 31) ^ (y * 17)) % 23;
            [(60 + coarse + fine) as u8, (90 + coarse / 2 + fine) as u8, (40 + 2 * fine + coarse) as u8]
        });
        let camera = Camera::from_focal(width, height, width as f64 / (2.0 * 25_f64.to_radians().tan()));
        let turn = |i: usize| Rotation3::from_axis_angle(&Vector3::y_axis(), -(i as f64) * 30_f64.to_radians());
        let views = (0..count).map(|i| Ok(View { camera, from_world: turn(i).into_inner() })).collect();
        let pairs = (1..count)
            .map(|b| AlignedPair { a: b - 1, b, inliers: Vec::new(), matches: Vec::new(), rms_px: 0.0 })
            .collect();
        let motion = CameraMotion::Rotation;
        let alignment = Alignment { views, reference: 0, motion, pairs, rms_px: 0.0, median_px: 0.0 };
        Self { photo, count, alignment }
    }

    fn render(&self, blend: BlendMode, progress: &dyn Progress) -> Result<(), RenderError> {
        let options = CompositingOptions { blend, crop: true, ..CompositingOptions::default() };
        let photos: Vec<ImageView<'_, u8, 3>> = (0..self.count).map(|_| self.photo.view()).collect();
        render(&photos, &self.alignment, &options, progress).map(|panorama| assert!(!panorama.image.is_empty()))
    }

    /// The longest time between two questions of one thread that does all the work, by stage: with more threads, each asks as often and
    /// works at less.
    fn longest_gap(&self, blend: BlendMode) -> (&'static str, Duration) {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
        let gaps = pool.install(|| {
            let asked = Asked::new(usize::MAX);
            self.render(blend, &asked).unwrap();
            asked.gaps()
        });
        gaps.into_iter().max_by_key(|(_, gap)| *gap).unwrap()
    }
}

/// The limit on an idle machine. Rows between two polls do not grow with the photographs; stages that do (the preview's averages, gray
/// conversion) take some ten nanoseconds per pixel.
const BOUND: Duration = Duration::from_millis(200);

#[test]
fn every_stage_checks_for_cancellation_regularly() {
    let set = Set::new(8, 1000);
    for &(_, blend) in BlendMode::NAMES {
        let (stage, gap) = set.longest_gap(blend);
        println!("{blend:?}: {} ms before a question of {stage}", gap.as_millis());
        assert!(gap < BOUND / 2, "{blend:?}: {gap:?} before {stage}");
    }
}

#[test]
#[ignore = "8 photographs of 12 megapixels: a minute and 4 GB"]
fn every_stage_of_large_photographs_checks_for_cancellation_regularly() {
    let set = Set::new(8, 4000);
    for &(_, blend) in BlendMode::NAMES {
        let (stage, gap) = set.longest_gap(blend);
        println!("{blend:?}: {} ms before a question of {stage}", gap.as_millis());
        assert!(gap < BOUND, "{blend:?}: {gap:?} before {stage}");
    }
}

#[test]
fn every_thread_stops_after_cancellation() {
    let set = Set::new(4, 500);
    let whole = Asked::new(usize::MAX);
    set.render(BlendMode::Multiband, &whole).unwrap();
    let asked = whole.count.into_inner();
    for share in 1..20 {
        let progress = Asked::new((asked * share / 20).max(1));
        assert_eq!(set.render(BlendMode::Multiband, &progress), Err(RenderError::Cancelled(Cancelled)));
        let count = progress.count.load(Ordering::Relaxed);
        // A thread that waits for others may begin another piece of work: it asks, and ends that too.
        assert!(count <= progress.stop_at + 4 * rayon::current_num_threads(), "{count} after {}", progress.stop_at);
    }
}
