//! Test utilities: photographs of a scene at infinity, and a progress callback that cancels.

use crate::align::View;
use crate::surface::{Bounds, WarpedPhoto};
use cv_core::{Cancelled, Image, Point2, Progress, RgbU8, Stage, Vector3};
use std::sync::atomic::{AtomicUsize, Ordering};

/// Counts reports and cancels at one of them.
pub(crate) struct StopAt {
    at: usize,
    stage: Option<&'static str>,
    reports: AtomicUsize,
}

impl StopAt {
    pub(crate) fn never() -> Self {
        Self::report(usize::MAX)
    }

    /// Cancels at the report of this number, counted from 1, and at all later ones.
    pub(crate) fn report(at: usize) -> Self {
        Self { at, stage: None, reports: AtomicUsize::new(0) }
    }

    /// Counts reports of one stage only.
    pub(crate) fn of_stage(stage: &'static str, at: usize) -> Self {
        Self { stage: Some(stage), ..Self::report(at) }
    }

    pub(crate) fn reports(&self) -> usize {
        self.reports.load(Ordering::Relaxed)
    }
}

impl Progress for StopAt {
    fn report(&self, stage: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        let counts = self.stage.is_none_or(|s| s == stage);
        let count = self.reports.fetch_add(usize::from(counts), Ordering::Relaxed) + usize::from(counts);
        if count >= self.at { Err(Cancelled) } else { Ok(()) }
    }
}

/// A stage that is never cancelled.
pub(crate) fn stage() -> Stage<'static> {
    Stage::new(&cv_core::Silent, "test", 1).unwrap()
}

/// Color of a smooth scene at infinity: waves of a tenth of a radian and longer.
pub(crate) fn sky(ray: &Vector3<f64>) -> [f64; 3] {
    let r = ray.normalize();
    let wave = |a: f64, b: f64, c: f64| (60.0 * r.x * a + 0.7).sin() * (60.0 * r.y * b).cos() + (20.0 * r.z * c).sin();
    [120.0 + 45.0 * wave(1.0, 0.8, 0.5), 120.0 + 45.0 * wave(0.6, 1.1, 0.3), 110.0 + 40.0 * wave(0.9, 0.5, 0.9)]
}

/// Renders a scene at infinity.
pub(crate) fn photograph(view: &View, scene: impl Fn(&Vector3<f64>) -> [f64; 3]) -> RgbU8 {
    RgbU8::from_fn(view.camera.width, view.camera.height, |x, y| {
        let ray = view.ray(Point2::new(x as f64, y as f64)).unwrap();
        scene(&ray).map(|v| v.round() as u8)
    })
}

/// The same of 16 bits a channel; `scene` is in levels of 8 bits.
pub(crate) fn deep_photograph(view: &View, scene: impl Fn(&Vector3<f64>) -> [f64; 3]) -> Image<u16, 3> {
    Image::from_fn(view.camera.width, view.camera.height, |x, y| {
        let ray = view.ray(Point2::new(x as f64, y as f64)).unwrap();
        scene(&ray).map(|v| (257.0 * v).round() as u16)
    })
}

/// A photograph that was drawn on these bounds of a canvas, reaching everywhere.
pub(crate) fn drawn(bounds: Bounds, color: impl Fn(usize, usize) -> [u8; 3]) -> WarpedPhoto {
    let pixels = Image::from_fn(bounds.width(), bounds.height(), |x, y| {
        let [r, g, b] = color(bounds.left + x, bounds.top + y);
        [r, g, b, 255]
    });
    WarpedPhoto { bounds, pixels }
}
