//! `cv reconstruct`: points and camera poses from two photographs.

use crate::frame::{CLOUD, Context, Explain, Failure, Outcome, Output, Run, named, two_images};
use crate::{rig, words};
use cv_core::nalgebra::Matrix3;
use cv_core::{Correspondence, PointCloud, Pose};
use cv_io::DynImage;
use cv_io::ply::PlyEncoding;
use cv_pipeline::{
    Axes, DenseOptions, DenseResult, Intrinsics, ReconstructOptions, ReconstructResult, reconstruct, reconstruct_dense,
};
use cv_report::{
    Figure, MapStyle, MatchStyle, Note, PointScene, Report, Viewpoint, camera_color, draw_epipolar_lines,
    draw_keypoints, draw_map, draw_matches, render_points,
};
use std::path::{Path, PathBuf};

/// Reconstruct a colored cloud of points and the camera's motion from two photographs.
///
/// The cloud is in the first camera's frame; its unit is the distance between the two cameras, which photographs cannot tell. Without
/// --camera and --focal, the focal length comes from the photographs' EXIF, and is estimated where one of them has none.
///
/// With --dense, the photographs are also rectified by the geometry found and matched pixel by pixel; what both confirm becomes a second, dense
/// cloud in the same frame and unit.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv reconstruct a.jpg b.jpg -o cloud.ply\n  \
    cv reconstruct a.jpg b.jpg --camera cam.yaml -o cloud.ply --report out\n  \
    cv reconstruct a.jpg b.jpg --focal 2900 -o cloud.ply --axes opengl --colmap model\n  \
    cv reconstruct a.jpg b.jpg -o sparse.ply --dense dense.ply --dense-size 2400\n\n\
    A camera file is ours, OpenCV's, ROS's or Kalibr's YAML, a line of COLMAP's cameras.txt, or a 3×3 matrix.")]
pub(crate) struct Args {
    /// Two photographs, or a folder or quoted pattern of two.
    #[arg(required = true, value_name = "PHOTOGRAPHS")]
    photographs: Vec<PathBuf>,
    #[arg(skip)]
    first: PathBuf,
    #[arg(skip)]
    second: PathBuf,
    /// Where to write the cloud, as PLY.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Camera of both photographs.
    #[arg(long, value_name = "FILE", conflicts_with = "focal")]
    camera: Option<PathBuf>,
    /// Camera of the second photograph, where it is another one.
    #[arg(long, value_name = "FILE", requires = "camera")]
    camera2: Option<PathBuf>,
    /// Focal length of both photographs in pixels.
    #[arg(long, value_name = "PX")]
    focal: Option<f64>,
    /// Estimate the focal length even where the photographs' EXIF has one.
    #[arg(long, conflicts_with_all = ["camera", "focal"])]
    ignore_exif: bool,
    /// Largest distance of a match from its epipolar line, in pixels.
    #[arg(long, value_name = "PX", default_value_t = ReconstructOptions::default().two_view.robust.threshold)]
    threshold: f64,
    /// Largest reprojection error of a point that is kept, in pixels.
    #[arg(long, value_name = "PX", default_value_t = ReconstructOptions::default().two_view.max_reprojection)]
    max_error: f64,
    /// Smallest angle between the two rays of a point that is kept, in degrees.
    #[arg(long, value_name = "DEGREES", default_value_t = 0.1)]
    min_angle: f64,
    /// Most features in a photograph [default: 8192].
    #[arg(long, value_name = "N")]
    features: Option<usize>,
    /// Which way the axes of the cloud point.
    #[arg(long, value_name = "WHICH", value_parser = named::<Axes>(), default_value_t = Axes::Opencv)]
    axes: Axes,
    /// Where to write the cameras and points as a COLMAP text model: a folder.
    #[arg(long, value_name = "DIR")]
    colmap: Option<PathBuf>,
    /// Where to write a dense cloud, as PLY.
    #[arg(long, value_name = "FILE")]
    dense: Option<PathBuf>,
    /// Longer side to which the photographs are reduced for the dense cloud, in pixels.
    #[arg(long, value_name = "PX", default_value_t = DenseOptions::default().max_size, requires = "dense")]
    dense_size: usize,
    /// Give pixels that the other photograph does not confirm a depth from around them.
    #[arg(long, requires = "dense")]
    dense_fill: bool,
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let clouds = std::iter::once(&self.output).chain(&self.dense).map(|path| Output::File(path, CLOUD));
        clouds.chain(self.colmap.iter().map(|folder| Output::Folder(folder))).collect()
    }

    fn run(mut self, context: &Context) -> Result<Outcome, Failure> {
        [self.first, self.second] = two_images(&self.photographs)?;
        for (name, value) in [("--threshold", self.threshold), ("--max-error", self.max_error)] {
            if !(value > 0.0 && value.is_finite()) {
                return Err(Failure::usage(format!("{name} must be above 0, not {value}")));
            }
        }
        if self.focal.is_some_and(|f| !(f > 0.0 && f.is_finite())) {
            return Err(Failure::usage("--focal must be above 0"));
        }
        let photos = [cv_io::read_image(&self.first)?, cv_io::read_image(&self.second)?];
        let (intrinsics, source) = self.intrinsics(&photos, context)?;
        context.note(&source);
        let mut options = ReconstructOptions::new(intrinsics);
        options.two_view.robust.threshold = self.threshold;
        options.two_view.max_reprojection = self.max_error;
        options.two_view.min_angle = self.min_angle.to_radians();
        if let Some(n) = self.features {
            options.matching.features = options.matching.features.at_most(n);
        }
        if let Some(seed) = context.seed {
            options.two_view.robust.seed = seed;
        }
        let [a, b] = photos.map(DynImage::into_rgb8);
        let result = reconstruct(a.view(), b.view(), &options, context)
            .map_err(|error| words::no_reconstruction(&error, [&self.first, &self.second]))?;
        // Before anything is written: a dense cloud that cannot be had leaves no half of the outputs behind.
        let dense = self.dense(&a, &b, &result, context)?;
        let write = |path: &Path, mut cloud: PointCloud| {
            self.axes.turn(&mut cloud);
            let cloud = |path: &Path| cv_io::ply::write_cloud(path, &cloud, PlyEncoding::Binary);
            context.write(Output::File(path, CLOUD), cloud)
        };
        write(&self.output, result.cloud())?;
        if let (Some(path), Some(dense)) = (&self.dense, &dense) {
            write(path, dense.cloud.clone())?;
        }
        if let Some(folder) = &self.colmap {
            let name = |path: &Path| path.file_name().unwrap_or(path.as_os_str()).to_string_lossy().into_owned();
            let model = result.model([name(&self.first), name(&self.second)]);
            context.write(Output::Folder(folder), |folder| cv_io::colmap::write(folder, &model))?;
        }
        if let Some(text) = doubt(&result) {
            context.warn(format!("{text}; --focal or --camera if you know it"));
        }
        context.report(|| self.html([&a, &b], &result, dense.as_ref(), &source))?;
        Ok(self.outcome(&result, dense.as_ref()))
    }
}

/// What to think of a focal length that the photographs hardly show.
fn doubt(result: &ReconstructResult) -> Option<String> {
    let percent = 100.0 * result.scene.focal_deviation;
    result.focal_is_doubtful().then(|| {
        format!(
            "the focal length is known to ±{percent:.0} % only, and the depth of the cloud may be stretched by as much"
        )
    })
}

impl Args {
    /// What is known of the cameras, and how.
    fn intrinsics(&self, photos: &[DynImage; 2], context: &Context) -> Result<(Intrinsics, String), Failure> {
        if let Some(path) = &self.camera {
            let first = rig::camera(path, Some(photos[0].size()), context)?;
            let second = match &self.camera2 {
                Some(path) => rig::camera(path, Some(photos[1].size()), context)?,
                None => first,
            };
            return Ok((Intrinsics::Known([first, second]), format!("camera from {}", path.display())));
        }
        if let Some(focal) = self.focal {
            return Ok((Intrinsics::Focal([focal; 2]), format!("focal length {focal} px as given")));
        }
        let exif = photos.each_ref().map(|p| p.exif.focal.map(|f| f.pixels).filter(|_| !self.ignore_exif));
        let intrinsics = Intrinsics::from_focal_lengths(exif);
        let source = match intrinsics {
            Intrinsics::Focal([a, _]) => {
                format!("focal length {a:.0} px from EXIF (--focal or --camera to change it)")
            }
            _ => "focal length unknown: estimated from the matches".to_owned(),
        };
        Ok((intrinsics, source))
    }

    /// The dense cloud, where it is asked for.
    fn dense(
        &self,
        a: &cv_core::RgbU8,
        b: &cv_core::RgbU8,
        sparse: &ReconstructResult,
        context: &Context,
    ) -> Result<Option<DenseResult>, Failure> {
        if self.dense.is_none() {
            return Ok(None);
        }
        let default = DenseOptions::default();
        let options = DenseOptions {
            max_size: self.dense_size,
            fill: self.dense_fill,
            max_memory: context.max_memory.unwrap_or(default.max_memory),
            ..default
        };
        let dense = reconstruct_dense(a.view(), b.view(), sparse, &options, context);
        dense.map(Some).map_err(|error| words::no_dense_cloud(&error, [&self.first, &self.second]))
    }

    fn outcome(&self, result: &ReconstructResult, dense: Option<&DenseResult>) -> Outcome {
        let rows = |m: &Matrix3<f64>| -> [[f64; 3]; 3] { std::array::from_fn(|i| std::array::from_fn(|j| m[(i, j)])) };
        let t = result.scene.pose.translation;
        let degrees = result.scene.pose_deviation.map(f64::to_degrees);
        let mut summary = format!(
            "{} points from {} of {} matches, {:.3} px RMS; turned by {:.2} degrees, median angle {:.2} degrees",
            result.scene.points.len(),
            result.scene.inliers.len(),
            result.matching.matches.len(),
            result.scene.reprojection_rms,
            result.scene.pose.rotation_angle().to_degrees(),
            result.scene.median_angle.to_degrees(),
        );
        if result.scene.focal_deviation > 0.0 {
            let (focal, percent) = (result.scene.cameras[0].fx, 100.0 * result.scene.focal_deviation);
            summary += &format!("; focal length {focal:.0} px ± {percent:.1} %");
        }
        let mut stages = result.stages.clone();
        stages.extend(dense.iter().flat_map(|d| &d.stages).map(|(name, seconds)| (dense_stage(name), *seconds)));
        let outcome = Outcome::new(stages)
            .with("points", result.scene.points.len())
            .with("matches", result.matching.matches.len())
            .with("inliers", result.scene.inliers.len())
            .with("guided", result.scene.guided)
            .with("reprojection_rms_px", result.scene.reprojection_rms)
            .with("rotation", rows(result.scene.pose.rotation.matrix()))
            .with("translation", [t.x, t.y, t.z])
            .with("rotation_deviation_degrees", degrees[0])
            .with("translation_deviation_degrees", degrees[1])
            .with("focal_px", result.scene.cameras.map(|c| c.fx))
            .with("focal_deviation", result.scene.focal_deviation)
            .with("median_angle_degrees", result.scene.median_angle.to_degrees())
            .with("planar_share", result.scene.planar_share);
        let Some(dense) = dense else { return outcome.summary(summary) };
        let (width, height) = dense.size;
        let (first, count) = dense.disparities;
        let share = 100.0 * dense.coverage;
        summary += &format!("; {} dense points, {share:.0} % of what both photographs show", dense.cloud.len());
        outcome
            .with("dense_points", dense.cloud.len())
            .with("dense_coverage", dense.coverage)
            .with("dense_size", [width, height])
            .with("dense_disparities", [i64::from(first), i64::from(first) + count as i64 - 1])
            .summary(summary)
    }

    fn html(
        &self,
        [a, b]: [&cv_core::RgbU8; 2],
        result: &ReconstructResult,
        dense: Option<&DenseResult>,
        source: &str,
    ) -> Result<String, Failure> {
        let png = |image: &cv_core::RgbU8| cv_io::encode_jpeg(image.view(), 88).during("cannot encode a picture");
        let mut report = Report::new("Two-view reconstruction");
        report.subtitle(&format!("{} and {}", self.first.display(), self.second.display()));
        report
            .headline("points", &result.scene.points.len().to_string())
            .headline(
                "matches that agree",
                &format!("{} of {}", result.scene.inliers.len(), result.matching.matches.len()),
            )
            .headline("reprojection", &format!("{:.2} px", result.scene.reprojection_rms))
            .headline("median angle", &format!("{:.2}°", result.scene.median_angle.to_degrees()));

        report.section("The cloud");
        report.paragraph(
            "Each point was seen in both photographs. The unit is the distance between the two cameras, which are drawn as pyramids. \
             Drag to turn, scroll to come nearer.",
        );
        let mut scene = PointScene::new(&result.cloud());
        scene.camera(&result.scene.cameras[0], &Pose::identity(), camera_color(0));
        scene.camera(&result.scene.cameras[1], &result.scene.pose, camera_color(1));
        report.points(
            &scene,
            Some(png(&render_points(&scene, Viewpoint::Camera, 1200, 800))?),
            "The points and the two cameras.",
        );
        let top = Figure::new(png(&render_points(&scene, Viewpoint::Top, 900, 700))?, "From above: a map.");
        let side = Figure::new(png(&render_points(&scene, Viewpoint::Side, 900, 700))?, "From the side.");
        report.figures(vec![top, side]);
        if let Some(dense) = dense {
            dense_section(&mut report, dense, result)?;
        }

        report.section("The motion");
        let angle = result.scene.pose.rotation_angle();
        let axis =
            result.scene.pose.rotation.axis().map_or([0.0; 3], |axis| [axis.x, axis.y, axis.z].map(|v| v * angle));
        let t = result.scene.pose.translation;
        let degrees = |v: f64| format!("{:.3}°", v.to_degrees());
        let deviation = match result.scene.focal_deviation {
            0.0 => String::new(),
            share => format!(" ± {:.1} %", 100.0 * share),
        };
        report.facts(&[
            ("rotation", format!("{} about ({:.3}, {:.3}, {:.3})", degrees(angle), axis[0], axis[1], axis[2])),
            ("direction of the translation", format!("({:.4}, {:.4}, {:.4})", t.x, t.y, t.z)),
            ("standard deviation of the rotation", degrees(result.scene.pose_deviation[0])),
            ("standard deviation of the direction", degrees(result.scene.pose_deviation[1])),
            ("matches along epipolar lines", result.scene.guided.to_string()),
            (
                "focal lengths",
                format!(
                    "{:.1} and {:.1} px{deviation} ({source})",
                    result.scene.cameras[0].fx, result.scene.cameras[1].fx
                ),
            ),
            ("explained by one plane", format!("{:.0} % of the matches that agree", 100.0 * result.scene.planar_share)),
        ]);
        if let Some(text) = doubt(result) {
            report.note(Note::Warning, &format!("{}{}.", text[..1].to_uppercase(), &text[1..]));
        }
        if result.scene.planar_share > 0.8 {
            report.note(
                Note::Warning,
                "Most of the scene is nearly one plane: the motion is less certain than the deviations say.",
            );
        }

        report.section("Features and matches");
        let [fa, fb] = result.matching.features.each_ref().map(|f| &f.keypoints);
        let shown = |k: &[cv_core::Keypoint]| k.iter().step_by((k.len() / 2000).max(1)).copied().collect::<Vec<_>>();
        let green = [0, 158, 115];
        report.figures(vec![
            Figure::new(
                png(&draw_keypoints(a.view(), &shown(fa), green))?,
                &format!("{} features of the first photograph (at most 2000 drawn).", fa.len()),
            ),
            Figure::new(png(&draw_keypoints(b.view(), &shown(fb), green))?, &format!("{} of the second.", fb.len())),
        ]);
        let pairs = &result.matching.pairs();
        let mut mask = vec![false; pairs.len()];
        result.scene.inliers.iter().for_each(|&i| mask[i] = true);
        let style = MatchStyle::default();
        let before = draw_matches(a.view(), b.view(), pairs, None, &style);
        let after = draw_matches(a.view(), b.view(), pairs, Some(&mask), &style);
        report.figure(Figure::new(png(&before)?, "Tentative matches, each in a color of its own."));
        report.figure(Figure::new(
            png(&after)?,
            "The same after the search for a motion: matches that agree green, others red.",
        ));
        let chosen: Vec<Correspondence> = result.scene.inliers.iter().map(|&i| pairs[i]).collect();
        let lines = draw_epipolar_lines(a.view(), b.view(), &result.scene.fundamental(), &chosen, 24);
        report.figure(Figure::new(png(&lines)?, "Points and their epipolar lines: each point of one photograph lies on its line in the other (up to the lens distortion, which bends lines)."));

        report.section("Quality");
        let errors: Vec<f32> = result.scene.points.iter().map(|p| p.reprojection as f32).collect();
        let angles: Vec<f32> = result.scene.points.iter().map(|p| p.angle.to_degrees() as f32).collect();
        let plot = |title: &str, unit: &str, values: &[f32]| {
            cv_report::Plot::new(title, unit, "points").histogram(
                "",
                &values.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(),
                30,
            )
        };
        report.plots(&[
            (&plot("Reprojection error", "px", &errors), "How far the points are from where they were seen."),
            (&plot("Angle between the rays", "degrees", &angles), "Small angles make uncertain depths."),
        ]);
        report.facts(&result.stages.iter().map(|(name, s)| (*name, format!("{s:.3} s"))).collect::<Vec<_>>());
        Ok(report.to_html())
    }
}

/// The stage names of the dense cloud, told from those of the sparse one.
fn dense_stage(name: &str) -> &'static str {
    match name {
        "rectify" => "dense_rectify",
        "match" => "dense_match",
        _ => "dense_cloud",
    }
}

/// Depth and cloud of the dense matching.
fn dense_section(report: &mut Report, dense: &DenseResult, result: &ReconstructResult) -> Result<(), Failure> {
    let png = |image: &cv_core::RgbU8| cv_io::encode_jpeg(image.view(), 88).during("cannot encode a picture");
    report.section("The dense cloud");
    let (width, height) = dense.size;
    report.paragraph(&format!(
        "The photographs were rectified to {width}×{height} px and matched at {} disparities. {} points, {:.0} % of what both show, were confirmed \
         from both.",
        dense.disparities.1,
        dense.cloud.len(),
        100.0 * dense.coverage,
    ));
    let depth = draw_map(dense.depth.view(), &MapStyle::depth("distances between the cameras"));
    report.figure(Figure::new(png(&depth)?, "Depth of the first photograph: near blue, far red, unknown gray."));
    let mut scene = PointScene::new(&dense.cloud);
    scene.camera(&result.scene.cameras[0], &Pose::identity(), camera_color(0));
    scene.camera(&result.scene.cameras[1], &result.scene.pose, camera_color(1));
    let caption = match scene.left_out() {
        0 => "The dense cloud.".to_owned(),
        n => format!("The dense cloud, thinned by {n} points; the file has all of them."),
    };
    report.points(&scene, Some(png(&render_points(&scene, Viewpoint::Camera, 1200, 800))?), &caption);
    let top = Figure::new(png(&render_points(&scene, Viewpoint::Top, 900, 700))?, "From above: a map.");
    let side = Figure::new(png(&render_points(&scene, Viewpoint::Side, 900, 700))?, "From the side.");
    report.figures(vec![top, side]);
    Ok(())
}
