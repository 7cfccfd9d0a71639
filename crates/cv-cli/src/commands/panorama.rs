//! `cv panorama`: stitches overlapping photographs.

mod masks;
mod registration;
mod report;
mod streamed;

use crate::frame::{Context, Failure, Global, Outcome, Output, Run, Step, expand_images, named, spare_inputs, steps};
use crate::{rig, words};
use cv_core::{Camera, Image, ImageView};
use cv_io::{DynImage, Metadata, Pixels, PngPixels};
use cv_parallel::prelude::*;
use cv_pipeline::panorama_types::{
    BlendMode, CameraMotion, EightBits, Exposure, Framing, PhotoMask, PhotoSample, Projection, Registration, Seams,
};
use cv_pipeline::{
    FeatureMethod, FeatureOptions, PanoramaOptions, PanoramaPhoto, PanoramaResult, panorama, panorama_with_masks,
};
use masks::MaskFiles;
use serde_json::json;
use std::collections::btree_map::{BTreeMap, Entry};
use std::path::{Path, PathBuf};

/// The extensions of the output formats.
const ENDINGS: &[&str] = &["png", "jpg", "jpeg", "tif", "tiff", "exr", "dzi"];
/// Those that have 8 bits a channel only.
const EIGHT_BIT_ENDINGS: &[&str] = &["jpg", "jpeg", "dzi"];

/// Stitch overlapping photographs.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  \
    cv panorama IMG_*.jpg -o pano.png\n  \
    cv panorama holiday/ -o pano.jpg --projection spherical --crop\n  \
    cv panorama a.jpg b.jpg c.jpg -o pano.png --blend poisson --report out/\n  \
    cv panorama a.jpg b.jpg c.jpg -o pano.png --alpha\n  \
    cv panorama raw16/*.tif -o pano.tif\n  \
    cv panorama raw16/*.tif -o pano.tif --layers layers/\n  \
    cv panorama square/ -o empty.png --clean\n  \
    cv panorama square/ -o pano.png --remove IMG_3_mask.png --keep group/\n  \
    cv panorama gigapixel/ -o huge.tif --max-memory 4096\n  \
    cv panorama gigapixel/ -o web/huge.dzi --max-memory 4096\n  \
    cv panorama window/*.jpg -o light.exr\n  \
    cv panorama sunset/*.jpg -o pano.png --exposure adapt\n  \
    cv panorama wide/ -o pano.png --camera cam.yaml\n  \
    cv panorama wall/ -o plan.tif --mode plane\n  \
    cv panorama street/ -o wide.png --projection panini --fov 150,80\n  \
    cv panorama around/ -o planet.png --projection stereographic --center 0,-90\n  \
    cv panorama aslant/ -o level.png --fov 100,60 --center -20,5 --roll 1.5\n  \
    cv panorama rig/frame1/ -o first.png --save-registration rig.json\n  \
    cv panorama rig/frame2/ -o second.png --registration rig.json\n  \
    cv panorama holiday/ -o pano.png --save-registration holiday.pto")]
pub(crate) struct Args {
    /// Photographs in any order, or folders of them. Those that cannot be registered are left out.
    #[arg(required = true, value_name = "IMAGES")]
    images: Vec<PathBuf>,
    /// Where to write the panorama: .png, .tif or .jpg; the first two have 16 bits a channel if a photograph has. Or .exr: scene-referred linear radiance as 32-bit floats, with the
    /// camera response, exposures and vignetting inverted, and samples clipped in one photograph taken from another. A radiance of 1 is white at the center of the reference photograph;
    /// brighter radiance is above 1. Or .dzi: a Deep Zoom image for viewers in browsers such as OpenSeadragon, with its tiles in a folder NAME_files beside it.
    #[arg(short, long, value_name = "FILE")]
    output: PathBuf,
    /// Camera motion: rotation about the camera center, or arbitrary motion in front of a planar scene such as a map, a wall or the ground (plane), drawn as a
    /// metric plan without shear; auto: rotation, unless plane fits the matches far better.
    #[arg(long, value_name = "WHAT", value_parser = named::<CameraMotion>(), default_value_t = PanoramaOptions::default().align.motion)]
    mode: CameraMotion,
    /// Projection surface; auto: a plane up to 90 degrees of horizontal field of view, then a cylinder, or a sphere if the vertical field of view is large too. Mercator is conformal (up
    /// to 85 degrees from the horizon), panini keeps verticals straight over a wide view (up to 240 degrees across), stereographic is conformal up to 150 degrees from its center (a
    /// little planet with --center 0,-90). Directions beyond are not drawn.
    #[arg(long, value_name = "SURFACE", value_parser = named::<Projection>(), default_value_t = PanoramaOptions::default().render.projection)]
    projection: Projection,
    /// Field of view of the panorama in degrees: horizontal and, after a comma, vertical; empty where no photograph reaches [default: that of all photographs].
    #[arg(long, value_name = "ACROSS[,UP]", value_parser = field_of_view)]
    fov: Option<(f64, Option<f64>)>,
    /// Viewing direction of the center of the panorama, in degrees: yaw to the right of the center of the photographs, pitch above the horizon. The surface is rotated
    /// there: the horizon is straight only for pitch 0 [default: their center].
    #[arg(long, value_name = "YAW,PITCH", value_parser = center, allow_hyphen_values = true)]
    center: Option<(f64, f64)>,
    /// Rotate the panorama clockwise, in degrees, to level the horizon.
    #[arg(long, value_name = "DEGREES", value_parser = roll, allow_hyphen_values = true, default_value_t = 0.0)]
    roll: f64,
    /// Blending at the seams.
    #[arg(long, value_name = "MODE", value_parser = named::<BlendMode>(), default_value_t = PanoramaOptions::default().render.blend)]
    blend: BlendMode,
    /// Seam placement: graph cut along small differences, or the Voronoi diagram of the image centers.
    #[arg(long, value_name = "WHERE", value_parser = named::<Seams>(), default_value_t = PanoramaOptions::default().render.seams)]
    seams: Seams,
    /// Remove what moves: where three or more photographs show a place, prefer those near their median, so that people who walk through vanish.
    #[arg(long)]
    clean: bool,
    /// Masks of what must not be in the panorama, such as a person, a car or a tripod: images of the size of their photograph, white there, or folders of them. The mask of IMG_1.jpg is named
    /// IMG_1_mask.png or IMG_1.png. Another photograph is used there; where none reaches, the panorama is empty. Features there are not matched.
    #[arg(long, value_name = "DIR|FILES", num_args = 1..)]
    remove: Vec<PathBuf>,
    /// Masks of what must be in the panorama, such as a person whom a seam cuts: their photograph is used there. Named as those of --remove, which is stronger where a photograph has both. Where two
    /// photographs are kept, the one whose center is nearer is used.
    #[arg(long, value_name = "DIR|FILES", num_args = 1..)]
    keep: Vec<PathBuf>,
    /// Exposure compensation: none; match: exposures and white balances, with the camera response and vignetting, estimated jointly in linear intensity; or adapt: as match, then every place in the
    /// exposure of the photographs that show it, by a smooth local gain, for exposures that span more than about 1.5 stops.
    #[arg(long, value_name = "WHAT", value_parser = named::<Exposure>(), default_value_t = PanoramaOptions::default().render.exposure)]
    exposure: Exposure,
    /// Crop the result to the largest rectangle without empty pixels.
    #[arg(long)]
    crop: bool,
    /// Write each warped, exposure-compensated photograph as a TIFF with its seam mask as alpha, for retouching: at its position on the canvas
    /// (XPosition, YPosition), as GIMP, Photoshop scripts and Hugin read them.
    #[arg(long, value_name = "DIR")]
    layers: Option<PathBuf>,
    /// Add an alpha channel, transparent where no photograph reaches; for .png and .tif.
    #[arg(long)]
    alpha: bool,
    /// Resolution of the panorama relative to the photographs.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    scale: f64,
    /// Feature method: sift for any photographs, harris for speed if all have the same orientation and scale.
    #[arg(long, value_name = "KIND", value_parser = named::<FeatureMethod>(), default_value_t)]
    features: FeatureMethod,
    /// Calibration of the camera of all photographs (our, OpenCV's, ROS's or Kalibr's YAML, COLMAP's cameras.txt): its focal length is kept fixed and its distortion
    /// corrected. By default, the focal length is estimated, initialized from EXIF.
    #[arg(long, value_name = "FILE")]
    camera: Option<PathBuf>,
    /// Write the registration (camera and rotation or homography of each photograph): .json for --registration, or .pto, a project for Hugin with the registered photographs.
    #[arg(long, value_name = "FILE")]
    save_registration: Option<PathBuf>,
    /// Use the registration of a --save-registration file or of a Hugin project (.pto) instead of matching: for further frames of a rig, or the same views under other illumination. Needs the
    /// same number of photographs, of the same sizes, in the same order.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["mode", "features", "camera"])]
    registration: Option<PathBuf>,
}

/// Parses an angle in degrees within a range.
fn degrees(text: &str, range: std::ops::RangeInclusive<f64>) -> Result<f64, String> {
    let value = text.trim().parse().map_err(|_| format!("{text} is not an angle in degrees"))?;
    let (low, high) = (range.start(), range.end());
    if range.contains(&value) { Ok(value) } else { Err(format!("{value} is not between {low} and {high} degrees")) }
}

fn field_of_view(text: &str) -> Result<(f64, Option<f64>), String> {
    // Less than a degree is probably a factor, or radians, by mistake.
    let angle = |text| degrees(text, 1.0..=360.0);
    match text.split_once(',') {
        Some((across, up)) => Ok((angle(across)?, Some(angle(up)?))),
        None => Ok((angle(text)?, None)),
    }
}

fn center(text: &str) -> Result<(f64, f64), String> {
    let (yaw, pitch) = text.split_once(',').ok_or("two angles are needed, such as 20,-5")?;
    Ok((degrees(yaw, -360.0..=360.0)?, degrees(pitch, -90.0..=90.0)?))
}

fn roll(text: &str) -> Result<f64, String> {
    degrees(text, -180.0..=180.0)
}

impl Args {
    fn options(&self, context: &Context) -> PanoramaOptions {
        let mut options = PanoramaOptions::default();
        options.align.motion = self.mode;
        options.render.projection = self.projection;
        options.render.framing = Framing {
            center: self.center.map(|(yaw, pitch)| [yaw.to_radians(), pitch.to_radians()]),
            roll: self.roll.to_radians(),
            across: self.fov.map(|(across, _)| across.to_radians()),
            up: self.fov.and_then(|(_, up)| up).map(f64::to_radians),
        };
        options.render.blend = self.blend;
        options.render.seams = self.seams;
        options.render.removes_transients = self.clean;
        options.render.exposure = self.exposure;
        options.render.crop = self.crop;
        options.render.radiance = self.ends_in(&["exr"]);
        options.render.resolution = self.scale;
        options.matching.features = PanoramaOptions::features(FeatureOptions::from(self.features));
        if let Some(seed) = context.seed {
            options.verify.seed = seed;
        }
        options
    }
}

impl Run for Args {
    fn outputs(&self) -> Vec<Output<'_>> {
        let registration = self.save_registration.as_deref().map(|path| Output::File(path, registration::ENDINGS));
        let layers = self.layers.as_deref().map(Output::Folder);
        [Output::File(&self.output, ENDINGS)].into_iter().chain(registration).chain(layers).collect()
    }

    fn has_no_use_for(&self) -> &'static [Global] {
        if self.registration.is_some() { &[Global::Seed] } else { &[] }
    }

    fn steps(&self) -> Vec<Step> {
        let registration: &[Step] =
            if self.registration.is_some() { &[] } else { &[steps::FEATURES, steps::MATCH, steps::ALIGN] };
        registration.iter().copied().chain([steps::EXPOSURE, steps::SEAMS, steps::WARP, steps::BLEND]).collect()
    }

    fn run(self, context: &Context) -> Result<Outcome, Failure> {
        if !(self.scale > 0.0 && self.scale <= 10.0) {
            return Err(Failure::usage(format!("--scale must be above 0 and at most 10, not {}", self.scale)));
        }
        if self.ends_in(&["dzi"]) {
            cv_io::check_deep_zoom(&self.output)?;
        }
        if self.alpha && self.ends_in(&["jpg", "jpeg"]) {
            return Err(Failure::usage("--alpha needs a .png or .tif: JPEG has no transparency"));
        }
        if self.alpha && self.ends_in(&["exr"]) {
            return Err(Failure::usage("--alpha needs a .png or .tif: OpenEXR is written without an alpha channel"));
        }
        if self.clean && self.seams == Seams::Voronoi {
            return Err(Failure::usage("--clean has no effect with --seams voronoi, which ignores the content")
                .advice("--seams graphcut"));
        }
        if self.exposure == Exposure::Adapt && self.ends_in(&["exr"]) {
            return Err(Failure::usage("--exposure adapt has no effect on .exr outputs: radiance is not toned")
                .advice("--exposure match, or an output as .tif"));
        }
        if self.layers.is_some() && (self.blend == BlendMode::Poisson || self.ends_in(&["exr"])) {
            return Err(Failure::usage("--layers cannot be combined with --blend poisson and .exr outputs")
                .advice("--blend multiband, and an output as .tif"));
        }
        let registration = self.registration.as_deref().map(|path| registration::read(path, context)).transpose()?;
        let mut paths = expand_images(&self.images)?;
        let masks = MaskFiles::find(&self.keep, &self.remove, &mut paths)?;
        let results: Vec<PathBuf> = [&self.output].into_iter().chain(&self.save_registration).cloned().collect();
        let inputs: Vec<&Path> =
            paths.iter().chain(&self.registration).chain(masks.paths()).map(PathBuf::as_path).collect();
        spare_inputs(&results, &inputs)?;
        let masks = masks.read(&paths, context)?;
        // Streamed panoramas have the same pixels, and layers at hand.
        if let Some(bytes) = context.max_memory.or_else(|| self.layers.as_ref().map(|_| usize::MAX / 4)) {
            return self.stitch_streamed(&paths, &masks, registration.as_ref(), bytes, context);
        }
        let pictures = paths.par_iter().map(cv_io::read_image).try_collect()?;
        let known: Vec<_> =
            pictures.iter().map(|p| (p.exif.focal.as_ref().map(|focal| focal.pixels), p.metadata.clone())).collect();
        let is_deep = |picture: &DynImage| matches!(picture.pixels, Pixels::Gray16(_) | Pixels::Rgb16(_));
        if !self.ends_in(EIGHT_BIT_ENDINGS) && pictures.iter().any(is_deep) {
            let images: Vec<_> = pictures.into_par_iter().map(DynImage::into_rgb16).collect();
            self.stitch(&paths, &images, &known, &masks, registration.as_ref(), context)
        } else {
            let images: Vec<_> = pictures.into_par_iter().map(DynImage::into_rgb8).collect();
            self.stitch(&paths, &images, &known, &masks, registration.as_ref(), context)
        }
    }
}

impl Args {
    /// Whether the output has one of these extensions.
    fn ends_in(&self, endings: &[&str]) -> bool {
        let own = self.output.extension().unwrap_or_default();
        endings.iter().any(|ending| own.eq_ignore_ascii_case(ending))
    }

    /// Reads the camera file, once for each size of photographs; empty without one.
    fn cameras(
        &self,
        sizes: impl Iterator<Item = (usize, usize)>,
        context: &Context,
    ) -> Result<BTreeMap<(usize, usize), Camera>, Failure> {
        let mut cameras = BTreeMap::new();
        let Some(path) = &self.camera else { return Ok(cameras) };
        for size in sizes {
            if let Entry::Vacant(place) = cameras.entry(size) {
                place.insert(rig::camera(path, Some(size), context)?);
            }
        }
        Ok(cameras)
    }

    /// Stitches images at their bit depth and writes the results. `known` has the focal lengths by EXIF and the metadata.
    fn stitch<T>(
        &self,
        paths: &[PathBuf],
        images: &[Image<T, 3>],
        known: &[(Option<f64>, Metadata)],
        masks: &[Option<PhotoMask>],
        registration: Option<&Registration>,
        context: &Context,
    ) -> Result<Outcome, Failure>
    where
        T: PhotoSample,
        for<'a> ImageView<'a, T, 3>: PngPixels,
        for<'a> ImageView<'a, T, 4>: PngPixels,
    {
        let cameras = self.cameras(images.iter().map(Image::size), context)?;
        let photos: Vec<PanoramaPhoto<'_, T>> = images
            .iter()
            .zip(known)
            .zip(masks)
            .map(|((image, (focal, _)), mask)| PanoramaPhoto {
                image: image.view(),
                focal: *focal,
                camera: cameras.get(&image.size()).copied(),
                mask: mask.as_ref(),
            })
            .collect();
        let options = self.options(context);
        let result = match registration {
            Some(registration) => {
                let (photos, masks): (Vec<_>, Vec<_>) = photos.iter().map(|photo| (photo.image, photo.mask)).unzip();
                panorama_with_masks(registration, &photos, &masks, &options.render, context)
            }
            None => panorama(&photos, &options, context),
        };
        let result = result.map_err(|error| words::no_panorama(error, paths))?;
        let files: Vec<&Metadata> = known.iter().map(|(_, metadata)| metadata).collect();
        let used = (0..files.len()).filter(|&index| result.images[index].used);
        let metadata = metadata(&files, result.alignment.reference, used);
        context.write(Output::File(&self.output, ENDINGS), |path| {
            if let Some(radiance) = &result.radiance {
                cv_io::write_exr(path, radiance.view())
            } else if self.alpha {
                cv_io::write_image(path, with_alpha(&result).view(), &metadata)
            } else {
                cv_io::write_image(path, result.image.view(), &metadata)
            }
        })?;
        self.conclude(paths, &result, context)?;
        context.report(|| {
            let photos: Vec<_> = images.iter().chain([&result.image]).map(Image::view).collect();
            let photos = EightBits::new(&photos, "report", context)?;
            report::report(paths, &photos.views(), result.labels.view(), &result)
        })?;
        Ok(outcome(paths, &result))
    }
}

impl Args {
    /// Writes the registration, and warns of what is wrong with a panorama.
    fn conclude<T: PhotoSample>(
        &self,
        paths: &[PathBuf],
        result: &PanoramaResult<T>,
        context: &Context,
    ) -> Result<(), Failure> {
        if let Some(path) = &self.save_registration {
            registration::write(path, result, paths, context)?;
        }
        for (path, image) in paths.iter().zip(&result.images) {
            if let Some(reason) = &image.reason {
                context.warn(format!("{} is not in the panorama: {}", path.display(), words::left_out(reason, paths)));
            }
        }
        if result.shows_parallax() {
            let rms = result.reprojection_rms_px;
            context.warn(format!(
                "the registration residual is {rms:.1} px RMS: the photographs have parallax (different camera centers), and near objects may be misaligned at the seams"
            ));
        }
        if result.reaches_beyond {
            let projection = result.canvas.projection;
            let [across, up] = projection.widest_field().map(f64::to_degrees);
            context.warn(format!(
                "the photographs reach beyond the {across:.0} by {up:.0} degrees of the {projection} projection and are cut off; --projection spherical draws all of them"
            ));
        }
        Ok(())
    }
}

/// Returns the metadata of the reference photograph; its color profile only if all registered photographs share it.
fn metadata(files: &[&Metadata], reference: usize, used: impl IntoIterator<Item = usize>) -> Metadata {
    let Some(reference) = files.get(reference) else { return Metadata::default() };
    let mut used = used.into_iter().filter_map(|index| files.get(index));
    let icc = reference.icc.clone().filter(|_| used.all(|file| file.icc == reference.icc));
    Metadata { exif: reference.exif.clone(), icc }
}

/// Adds an alpha channel: opaque where a photograph reaches, transparent elsewhere.
fn with_alpha<T: PhotoSample>(result: &PanoramaResult<T>) -> Image<T, 4> {
    let (w, h) = result.image.size();
    Image::from_fn(w, h, |x, y| {
        let [r, g, b] = result.image.at(x, y);
        [r, g, b, if result.mask.at(x, y)[0] { T::WHITE } else { T::default() }]
    })
}

fn outcome<T: PhotoSample>(paths: &[PathBuf], result: &PanoramaResult<T>) -> Outcome {
    let images: Vec<_> = paths
        .iter()
        .zip(&result.images)
        .map(|(path, image)| {
            let reason = image.reason.as_ref().map(|r| words::left_out(r, paths));
            json!({ "path": path, "used": image.used, "reason": reason, "focal_px": image.focal, "gain": image.gain })
        })
        .collect();
    let used = result.images.iter().filter(|i| i.used).count();
    let (w, h) = result.size;
    Outcome::new(result.stages.clone())
        .with("images", images)
        .with("size", [w, h])
        .with("reprojection_rms_px", result.reprojection_rms_px)
        .with("stacks", result.stacks.clone())
        .with("projection", result.canvas.projection.to_string())
        .with("mode", result.alignment.motion.to_string())
        .with("bits", if result.radiance.is_some() { 32 } else { 8 * size_of::<T>() })
        .summary(format!(
            "{used} of {} photographs, {w} x {h} pixels, {}, residual of matches {:.2} px (RMS)",
            paths.len(),
            result.canvas.projection,
            result.reprojection_rms_px
        ))
}
