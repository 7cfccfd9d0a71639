//! Test utilities: photographs of a scene at infinity, and a progress callback that cancels.
//!
//! For the unit tests and, compiled once more, for `tests/compositing`: of the crate only what is public at its root.

#![allow(dead_code, reason = "the unit tests and tests/compositing each use a part")]

use crate::{Bounds, View, WarpedPhoto};
use cv_core::{Camera, Cancelled, Correspondence, GrayU8, Image, Point2, Progress, RgbU8, Stage, Vector2, Vector3};
use nalgebra::Rotation3;
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

/// Three views of 320 × 240 pixels that overlap.
pub(crate) fn three_views() -> Vec<View> {
    let turn = |yaw: f64, roll: f64| {
        Rotation3::from_axis_angle(&Vector3::z_axis(), roll) * Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw)
    };
    [(-0.45, 0.02), (0.0, -0.01), (0.4, 0.03)]
        .map(|(yaw, roll)| View {
            camera: Camera::from_focal(320, 240, 300.0),
            from_world: turn(yaw, roll).into_inner(),
        })
        .to_vec()
}

/// Luma of what the views show; the second is exposed differently.
pub(crate) fn lumas(views: &[View]) -> Vec<GrayU8> {
    let image = |(i, view): (usize, &View)| {
        let gain = if i == 1 { 0.7 } else { 1.0 };
        cv_imgproc::rgb_to_gray(photograph(view, |ray| sky(ray).map(|v| gain * v + 5.0)).view())
    };
    views.iter().enumerate().map(image).collect()
}

/// Matches of what two views both show, each off by up to `error` pixels in either direction.
pub(crate) fn inexact_matches(from: &View, to: &View, error: f64) -> Vec<Correspondence> {
    let mut state = 5_u32;
    let mut noise = || {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        error * (2.0 * f64::from(state >> 8) / f64::from(1 << 24) - 1.0)
    };
    let grid =
        (0..18).flat_map(|y| (0..24).map(move |x| Point2::new(12.0 + 12.7 * f64::from(x), 12.0 + 12.7 * f64::from(y))));
    let mut shown = |a: Point2<f64>| {
        let b = to.project(&from.ray(a)?).filter(|b| to.contains(*b))?;
        Some(Correspondence { a: a + Vector2::new(noise(), noise()), b: b + Vector2::new(noise(), noise()) })
    };
    grid.filter_map(&mut shown).collect()
}

/// A photograph that was drawn on these bounds of a canvas, reaching everywhere.
pub(crate) fn drawn(bounds: Bounds, color: impl Fn(usize, usize) -> [u8; 3]) -> WarpedPhoto {
    let pixels = Image::from_fn(bounds.width(), bounds.height(), |x, y| {
        let [r, g, b] = color(bounds.left + x, bounds.top + y);
        [r, g, b, 255]
    });
    WarpedPhoto { bounds, pixels }
}
