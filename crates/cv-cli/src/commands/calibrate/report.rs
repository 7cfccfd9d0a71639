//! The report of a calibration.

use super::super::rectify::with_rows;
use super::Job;
use crate::frame::Failure;
use crate::pictures::{Width, map, picture};
use crate::words::calibration::{lens, note, refusal};
use cv_core::{GrayF32, Point2, RgbU8, round_to_four_digits};
use cv_pipeline::calibration::{CalibratedCamera, Trust};
use cv_pipeline::stereo::{Rectification, RectifyOptions};
use cv_report::{Colormap, Figure, MapStyle, Note, Raster, Report, colors};

/// Number of photographs shown with residuals: half of them the worst, half the best.
const SHOWN_PHOTOS: usize = 6;
/// Magnification of drawn residuals.
const RESIDUAL_SCALE: f32 = 50.0;

pub(super) fn report(job: &Job) -> Result<Report, Failure> {
    let c = &job.found.calibration;
    let mut page = Report::new("Calibration");
    let used = c.views.iter().filter(|v| v.pose.is_some()).count();
    page.headline("rms", &format!("{:.3} px", c.rms_px));
    if !c.holdout_rms_px.is_nan() {
        page.headline("rms on held-out views", &format!("{:.3} px", c.holdout_rms_px));
        page.headline("the same including outliers", &format!("{:.3} px", c.holdout_all_rms_px));
    }
    page.headline("views used", &format!("{used} of {}", c.views.len()));
    if let Some((mean, _)) = job.found.rectified_dy_px {
        page.headline("vertical disparity after rectification", &format!("{mean:.3} px"));
    }
    page.headline("trust", &c.verdict.trust.to_string());
    page.section("Assessment, and what to photograph next");
    if c.verdict.notes.is_empty() {
        page.note(Note::Good, "No deficiencies found.");
    }
    for n in &c.verdict.notes {
        let kind = if c.verdict.trust == Trust::Poor { Note::Warning } else { Note::Info };
        page.note(kind, &capital(&note(n, &job.names)));
    }
    for (i, camera) in c.cameras.iter().enumerate() {
        let title = match job.names.as_slice() {
            [_] => "Camera".to_owned(),
            names => format!("{} camera", capital(&names[i])),
        };
        page.section(&title);
        of_camera(&mut page, job, i, camera)?;
    }
    photographs(&mut page, job)?;
    if c.cameras.len() == 2 {
        pair(&mut page, job)?;
    }
    if c.target_shape.adjusted {
        board_shape(&mut page, job)?;
    }
    parameters(&mut page, job);
    page.section("Photographs");
    let rows: Vec<[String; 4]> = (0..c.views.len())
        .flat_map(|v| (0..job.names.len()).map(move |i| (v, i)))
        .filter_map(|(v, i)| {
            let path = job.path(v, i)?.display().to_string();
            let of = &c.views[v].images[i];
            let used = of.corners.iter().filter(|c| c.used).count();
            let what = job.found.refusals[v][i].as_ref().map_or_else(|| "used".to_owned(), refusal);
            Some([path, format!("{used} of {}", of.corners.len()), format!("{:.3}", of.rms_px), what])
        })
        .collect();
    page.table("Every photograph.", &["photograph", "corners used", "rms (px)", "outcome"], &rows);
    page.section("Time").times(&job.found.stages);
    Ok(page)
}

fn capital(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or(String::new(), |first| first.to_uppercase().collect::<String>() + rest.as_str())
}

fn of_camera(page: &mut Report, job: &Job, i: usize, camera: &CalibratedCamera) -> Result<(), Failure> {
    let rows: Vec<[String; 5]> = camera
        .lenses
        .iter()
        .map(|trial| {
            let number = |v: f64| if v.is_nan() { "–".to_owned() } else { format!("{v:.3}") };
            let name = trial.model.info().name.to_owned();
            [name, number(trial.rms_px), number(trial.holdout_rms_px), trial.outliers.to_string(), lens(trial)]
        })
        .collect();
    page.table(
        "Distortion models, each fitted to this camera alone: RMS reprojection error over all views, and over views held out of the fit.",
        &["lens", "rms (px)", "rms held out (px)", "outlier corners", ""],
        &rows,
    );
    let uncertainty = &camera.uncertainty;
    let values = GrayF32::from_fn(uncertainty.columns, uncertainty.rows, |x, y| {
        [uncertainty.pixels[y * uncertainty.columns + x] as f32]
    });
    let (width, height) = (camera.camera.width, camera.camera.height);
    let side = 640.0 / width as f64;
    let size = (640, ((height as f64 * side).round() as usize).max(2));
    let smooth = upsample(&values, size);
    let top = uncertainty.median().max(0.05) * 4.0;
    let style = MapStyle { label: "uncertainty (px)".to_owned(), ..MapStyle::default() }.with_range(0.0, top as f32);
    let uncertain = map(
        smooth.view(),
        &style,
        Width::Half,
        "Projection uncertainty of a distant point: the standard deviation in its worst direction, after a rotation of the camera is compensated. Gray: no viewing ray.",
    )?;
    page.figures(vec![uncertain, coverage(job, i, size)?, distortion(camera, size)?]);
    Ok(())
}

/// Interpolates a grid bilinearly; its outer points are the borders of the image.
fn upsample(values: &GrayF32, (width, height): (usize, usize)) -> GrayF32 {
    GrayF32::from_fn(width, height, |x, y| {
        let along = |i: usize, n: usize, of: usize| i as f32 * (of - 1) as f32 / (n - 1).max(1) as f32;
        let (u, v) = (along(x, width, values.width()), along(y, height, values.height()));
        let (i, j) = ((u as usize).min(values.width() - 2), (v as usize).min(values.height() - 2));
        let (s, t) = (u - i as f32, v - j as f32);
        let at = |a: usize, b: usize| values.at(i + a, j + b)[0];
        [(at(0, 0) * (1.0 - s) + at(1, 0) * s) * (1.0 - t) + (at(0, 1) * (1.0 - s) + at(1, 1) * s) * t]
    })
}

/// Draws all corners of a camera, colored by residual.
fn coverage(job: &Job, i: usize, (width, height): (usize, usize)) -> Result<Figure, Failure> {
    let c = &job.found.calibration;
    let side = width as f32 / c.cameras[i].camera.width as f32;
    let mut canvas = Raster::new(width, height, [28, 28, 32]);
    let limit = (3.0 * c.noise_px) as f32;
    for (view, seen) in c.views.iter().zip(&job.found.observations.views) {
        for (corner, of) in seen[i].iter().zip(&view.images[i].corners) {
            let at = [corner.pixel.x as f32 * side, corner.pixel.y as f32 * side];
            match of.residual.filter(|_| of.used) {
                Some(r) => canvas.disc(at, 2.5, Colormap::Turbo.color((r.norm() as f32 / limit).min(1.0))),
                None => canvas.cross(at, 4.0, 1.0, colors::WHITE),
            }
        }
    }
    let caption = format!(
        "Detected corners by residual: blue 0, red {limit:.2} px or more; crosses are outliers. Regions without corners do not constrain the distortion."
    );
    picture(&canvas.into_image(), Width::Half, &caption)
}

/// Draws the distortion: from the undistorted to the distorted position of a grid of pixels.
fn distortion(camera: &CalibratedCamera, (width, height): (usize, usize)) -> Result<Figure, Failure> {
    let of = &camera.camera;
    let side = width as f64 / of.width as f64;
    let mut canvas = Raster::new(width, height, [28, 28, 32]);
    for row in 0..13 {
        for column in 0..17 {
            let pixel = Point2::new(
                (of.width as f64 - 1.0) * f64::from(column) / 16.0,
                (of.height as f64 - 1.0) * f64::from(row) / 12.0,
            );
            let ideal = of.undistort_pixel(pixel);
            let at = |p: Point2<f64>| [(p.x * side) as f32, (p.y * side) as f32];
            if ideal.x.is_finite() && ideal.y.is_finite() {
                canvas.line(at(ideal), at(pixel), 1.5, colors::CYAN);
            }
            canvas.disc(at(pixel), 2.5, colors::ORANGE);
        }
    }
    picture(
        &canvas.into_image(),
        Width::Half,
        "Distortion: from the projection by a pinhole camera (end of the line) to the projection by the lens (dot).",
    )
}

/// Adds the photographs with the largest and the smallest errors, with their residuals.
fn photographs(page: &mut Report, job: &Job) -> Result<(), Failure> {
    let c = &job.found.calibration;
    let mut all: Vec<(f64, usize, usize)> = (0..c.views.len())
        .flat_map(|v| (0..job.names.len()).map(move |i| (v, i)))
        .map(|(v, i)| (c.views[v].images[i].rms_px, v, i))
        .filter(|(rms, _, _)| rms.is_finite())
        .collect();
    all.sort_by(|a, b| b.0.total_cmp(&a.0));
    if all.len() > SHOWN_PHOTOS {
        all.drain(SHOWN_PHOTOS / 2..all.len() - SHOWN_PHOTOS / 2);
    }
    let mut figures = Vec::new();
    for (rms, v, i) in all {
        let Some(path) = job.path(v, i) else { continue };
        let photo = cv_io::read_rgb(path)?;
        let caption = format!("{}: {rms:.3} px.", path.display());
        figures.push(picture(&with_residuals(&photo, job, v, i), Width::Half, &caption)?);
    }
    page.section("Residuals");
    page.paragraph(&format!(
        "The photographs with the largest and the smallest errors. A line leads from a detected corner towards its reprojection, {RESIDUAL_SCALE:.0} times as long; orange corners are outliers."
    ));
    page.figures(figures);
    Ok(())
}

fn with_residuals(photo: &RgbU8, job: &Job, v: usize, i: usize) -> RgbU8 {
    let mut canvas = Raster::from_rgb(photo.view());
    let unit = (canvas.width() as f32 / 640.0).max(0.5);
    let of = &job.found.calibration.views[v].images[i];
    for (corner, of) in job.found.observations.views[v][i].iter().zip(&of.corners) {
        let at = [corner.pixel.x as f32, corner.pixel.y as f32];
        let color = if of.used { colors::GREEN } else { colors::ORANGE };
        canvas.circle(at, 3.0 * unit, unit, color);
        if let Some(r) = of.residual {
            let r = [r.x as f32, r.y as f32];
            let length = RESIDUAL_SCALE * unit;
            canvas.line(at, [at[0] + length * r[0], at[1] + length * r[1]], 1.5 * unit, colors::MAGENTA);
        }
    }
    canvas.into_image()
}

/// Adds the first pair that is used by both cameras, rectified.
fn pair(page: &mut Report, job: &Job) -> Result<(), Failure> {
    let c = &job.found.calibration;
    let rig = c.stereo().and_then(|rig| Rectification::new(&rig, &RectifyOptions::default()).ok());
    let paths = c.complete_views().find_map(|v| job.path(v, 0).zip(job.path(v, 1)));
    let (Some(rectification), Some((left, right))) = (rig, paths) else { return Ok(()) };
    let (left, right) = (cv_io::read_rgb(left)?, cv_io::read_rgb(right)?);
    let left = rectification.left.apply(left.view(), &cv_pipeline::Silent)?.0;
    let right = rectification.right.apply(right.view(), &cv_pipeline::Silent)?.0;
    page.section("Rectified pair").figure(picture(
        &with_rows(&[left, right]),
        Width::Full,
        "Both images with common scanlines: corresponding points lie on the same line.",
    )?);
    Ok(())
}

/// Adds a map of the estimated deflection of the board.
fn board_shape(page: &mut Report, job: &Job) -> Result<(), Failure> {
    let [kx, ky] = job.found.calibration.target_shape.deflection;
    let size = job.found.observations.target.size();
    let side = 480.0 / size.max();
    let [width, height] = [size.x, size.y].map(|s| ((s * side).round() as usize).clamp(16, 480));
    // The model of the calibration: a parabola along each side, zero at the ends.
    let share = |i: usize, n: usize| 1.0 - (2.0 * i as f64 / (n - 1) as f64 - 1.0).powi(2);
    let bent = GrayF32::from_fn(width, height, |x, y| [(kx * share(x, width) + ky * share(y, height)) as f32]);
    let (low, high) = bent.as_slice().iter().fold((0.0f32, 0.0f32), |(low, high), z| (low.min(*z), high.max(*z)));
    let label = format!("deflection away from the camera ({})", job.unit);
    let style = MapStyle { label, ..MapStyle::default() }.with_range(low, high);
    let caption = format!(
        "Deflection of the board relative to its corners: at its center {1:.3} % of its length along x and {2:.3} % along y, of {3} and {4} {0}.",
        job.unit,
        100.0 * kx / size.x,
        100.0 * ky / size.y,
        round_to_four_digits(size.x),
        round_to_four_digits(size.y)
    );
    page.section("The board's shape");
    page.figures(vec![map(bent.view(), &style, Width::Half, &caption)?]);
    Ok(())
}

fn parameters(page: &mut Report, job: &Job) {
    let c = &job.found.calibration;
    page.section("Parameters");
    let whose = |camera: Option<usize>| camera.map_or_else(|| "board".to_owned(), |i| job.names[i].clone());
    let rows: Vec<[String; 4]> = c
        .parameters
        .iter()
        .map(|p| [whose(p.camera), p.name.to_owned(), format!("{:.6}", p.value), format!("{:.2e}", p.deviation)])
        .collect();
    page.table(
        &format!("Estimates with their standard deviations. Lengths in {}, angles in radians.", job.unit),
        &["of", "parameter", "value", "standard deviation"],
        &rows,
    );
    let mut pairs: Vec<(f64, usize, usize)> = (0..c.parameters.len())
        .flat_map(|a| (0..a).map(move |b| (b, a)))
        .map(|(a, b)| (c.correlation(a, b), a, b))
        .filter(|(r, _, _)| r.abs() > 0.8)
        .collect();
    pairs.sort_by(|a, b| b.0.abs().total_cmp(&a.0.abs()));
    pairs.truncate(30);
    if pairs.is_empty() {
        return;
    }
    let name = |i: usize| format!("{} {}", whose(c.parameters[i].camera), c.parameters[i].name);
    let rows: Vec<[String; 3]> = pairs.iter().map(|(r, a, b)| [name(*a), name(*b), format!("{r:.3}")]).collect();
    page.folded("Correlated parameters", |page| {
        page.table(
            "Correlation coefficients above 0.8 in magnitude, the thirty largest.",
            &["parameter", "and", "correlation"],
            &rows,
        );
    });
}
