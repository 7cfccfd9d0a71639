//! `cv panorama`: overlapping photographs to one picture.

mod report;

use crate::frame::{Context, Failure, Outcome, Run, expand_images, picture_name};
use cv_core::Image;
use cv_pipeline::panorama_types::{Blend, Exposure, Projection, Seams};
use cv_pipeline::{FeatureMethod, PanoramaError, PanoramaOptions, PanoramaPhoto, PanoramaResult, panorama};
use rayon::prelude::*;
use serde_json::json;
use std::collections::btree_map::{BTreeMap, Entry};
use std::path::{Path, PathBuf};

/// Join overlapping photographs to one picture.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv panorama IMG_*.jpg -o pano.png\n  \
    cv panorama holiday/ -o pano.jpg --projection spherical --crop\n  \
    cv panorama a.jpg b.jpg c.jpg -o pano.png --blend poisson --report out/\n  \
    cv panorama a.jpg b.jpg c.jpg -o pano.png --alpha\n  \
    cv panorama wide/ -o pano.png --camera cam.yaml")]
pub(crate) struct Args {
    /// Photographs in any order, or folders of them. Those that do not belong are left out.
    #[arg(required = true, value_name = "IMAGES")]
    images: Vec<PathBuf>,
    /// Where to write the panorama: .png or .jpg.
    #[arg(short, long, value_name = "FILE", value_parser = picture_name)]
    output: PathBuf,
    /// The surface to draw on; auto: a plane up to 90 degrees across, then a cylinder, a sphere where it is also high.
    #[arg(long, value_enum, default_value_t = ProjectionArg::Auto)]
    projection: ProjectionArg,
    /// How to join photographs at the seams.
    #[arg(long, value_enum, default_value_t = BlendArg::Multiband)]
    blend: BlendArg,
    /// Where seams run: where the photographs agree, or half-way between their middles.
    #[arg(long, value_enum, default_value_t = SeamsArg::Graphcut)]
    seams: SeamsArg,
    /// What to even out between photographs.
    #[arg(long, value_enum, default_value_t = ExposureArg::Gain)]
    exposure: ExposureArg,
    /// Cut the result to the largest rectangle without empty pixels.
    #[arg(long)]
    crop: bool,
    /// Transparent instead of black where no photograph reaches; for .png.
    #[arg(long)]
    alpha: bool,
    /// Size relative to the photographs.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    scale: f64,
    /// Features to match: sift for any photographs, harris for speed where they are all upright and of one size.
    #[arg(long, value_enum, default_value_t = FeaturesArg::Sift)]
    features: FeaturesArg,
    /// The calibrated camera that took all of them (ours, OpenCV's or ROS's YAML, COLMAP's cameras.txt): its focal length is believed and its distortion
    /// taken out. Without, the focal length is estimated, from EXIF on.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum ProjectionArg {
    Auto,
    Plane,
    Cylindrical,
    Spherical,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum BlendArg {
    Multiband,
    Poisson,
    Feather,
    None,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum SeamsArg {
    Graphcut,
    Middle,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum ExposureArg {
    None,
    Gain,
    Vignetting,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum FeaturesArg {
    Sift,
    Harris,
}

impl Args {
    fn options(&self, context: &Context) -> PanoramaOptions {
        let mut options = PanoramaOptions::default();
        options.render.projection = match self.projection {
            ProjectionArg::Auto => Projection::Auto,
            ProjectionArg::Plane => Projection::Plane,
            ProjectionArg::Cylindrical => Projection::Cylindrical,
            ProjectionArg::Spherical => Projection::Spherical,
        };
        options.render.blend = match self.blend {
            BlendArg::Multiband => Blend::Multiband,
            BlendArg::Poisson => Blend::Poisson,
            BlendArg::Feather => Blend::Feather,
            BlendArg::None => Blend::None,
        };
        options.render.seams = match self.seams {
            SeamsArg::Graphcut => Seams::GraphCut,
            SeamsArg::Middle => Seams::Middle,
        };
        options.render.exposure = match self.exposure {
            ExposureArg::None => Exposure::None,
            ExposureArg::Gain => Exposure::Gain,
            ExposureArg::Vignetting => Exposure::GainAndVignetting,
        };
        options.render.crop = self.crop;
        options.render.resolution = self.scale;
        options.matching.method = match self.features {
            FeaturesArg::Sift => FeatureMethod::Sift,
            FeaturesArg::Harris => FeatureMethod::Harris,
        };
        if let Some(seed) = context.seed {
            options.verify.seed = seed;
        }
        options
    }
}

/// Share of a photograph's side by which matches disagree when the camera clearly moved: 5 px of 1,000.
const MUCH: f64 = 0.005;

impl Run for Args {
    fn outputs(&self) -> Vec<&Path> {
        vec![&self.output]
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        if !(self.scale > 0.0 && self.scale <= 10.0) {
            return Err(Failure::usage(format!("--scale {} is not between 0 and 10", self.scale)));
        }
        if self.alpha && !self.output.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("png")) {
            return Err(Failure::usage("--alpha needs a .png: JPEG has no transparency"));
        }
        let paths = expand_images(&self.images)?;
        let pictures = paths
            .par_iter()
            .map(|path| {
                let picture = cv_io::read_image(path)?;
                Ok((picture.exif.focal.as_ref().map(|focal| focal.pixels), picture.into_rgb8()))
            })
            .collect::<Result<Vec<_>, cv_io::IoError>>()?;
        // Of photographs of one size the camera is read once.
        let mut cameras = BTreeMap::new();
        if let Some(path) = &self.camera {
            for (_, image) in &pictures {
                if let Entry::Vacant(place) = cameras.entry(image.size()) {
                    place.insert(cv_io::read_camera(path, Some(image.size()))?);
                }
            }
        }
        let photos: Vec<PanoramaPhoto<'_>> = pictures
            .iter()
            .map(|(focal, image)| PanoramaPhoto {
                image: image.view(),
                focal: *focal,
                camera: cameras.get(&image.size()).copied(),
            })
            .collect();
        let result = panorama(&photos, &self.options(context), context).map_err(|error| failure(error, &paths))?;
        if self.alpha {
            cv_io::write_png(&self.output, transparent(&result).view())?;
        } else {
            cv_io::write_image(&self.output, result.image.view())?;
        }
        for (path, image) in paths.iter().zip(&result.images) {
            if let Some(reason) = &image.reason {
                context.warn(format!("{} is not in the panorama: {reason}", path.display()));
            }
        }
        // Features are good to a pixel or two; parallax is what is left.
        let (rms, long) = (result.reprojection_rms_px, pictures.iter().map(|(_, p)| p.width().max(p.height())).max());
        if rms > MUCH * long.unwrap_or(0) as f64 {
            context.warn(format!(
                "the photographs agree only to {rms:.1} px: they were taken from different places, and what is near may be cut in two at the seams"
            ));
        }
        context.report(|| {
            let photos: Vec<_> = pictures.into_iter().map(|(_, image)| image).collect();
            report::report(&paths, &photos, &result)
        })?;
        Ok(outcome(&paths, &result))
    }
}

/// The picture with an opacity of 255 where a photograph reaches and 0 elsewhere.
fn transparent(result: &PanoramaResult) -> Image<u8, 4> {
    let (w, h) = result.image.size();
    Image::from_fn(w, h, |x, y| {
        let [r, g, b] = result.image.at(x, y);
        [r, g, b, if result.mask.at(x, y)[0] { 255 } else { 0 }]
    })
}

fn failure(error: PanoramaError, paths: &[PathBuf]) -> Failure {
    match error {
        PanoramaError::Align { source, images } => {
            let reasons: Vec<String> = paths
                .iter()
                .zip(&images)
                .filter_map(|(path, image)| image.reason.as_ref().map(|r| format!("{}: {r}", path.display())))
                .collect();
            Failure::new(format!("{source} ({})", reasons.join("; ")))
                .advice("photographs that share a third of their view with their neighbors, taken from one place")
        }
        PanoramaError::Render(source) => Failure::new(source).advice("--projection auto, or a smaller --scale"),
        PanoramaError::Cancelled(stop) => stop.into(),
    }
}

fn outcome(paths: &[PathBuf], result: &PanoramaResult) -> Outcome {
    let images: Vec<_> = paths
        .iter()
        .zip(&result.images)
        .map(|(path, image)| {
            json!({ "path": path, "used": image.used, "reason": image.reason, "focal_px": image.focal, "gain": image.gain })
        })
        .collect();
    let used = result.images.iter().filter(|i| i.used).count();
    let (w, h) = result.image.size();
    Outcome::new(result.stages.clone())
        .with("images", images)
        .with("size", [w, h])
        .with("reprojection_rms_px", result.reprojection_rms_px)
        .with("projection", result.canvas.projection.name())
        .summary(format!(
            "{used} of {} photographs, {w} x {h} pixels, {}, matches agree to {:.2} px (RMS)",
            paths.len(),
            result.canvas.projection.name(),
            result.reprojection_rms_px
        ))
}
