//! Georeferencing: known camera positions and distances, and the alignment of models to them.

use super::photographs::Photograph;
use crate::frame::{Context, Failure};
use crate::words::many_views::{self as words, PlaceSource};
use cv_core::Point3;
use cv_pipeline::many_views::{KnownPlaces, ModelAlignment, SfmModel};
use cv_pipeline::{GpsCenters, GpsFix, gps_centers, place_model};
use serde_json::{Value, json};
use std::path::PathBuf;

#[derive(Debug, clap::Args)]
#[command(next_help_heading = "Known places")]
pub(super) struct PlaceArgs {
    /// Known camera positions: a text file with a row `name x y z` for each photograph, in meters with z up. At least three, not all at one position.
    #[arg(long, value_name = "FILE")]
    known: Option<PathBuf>,
    /// Known distance of two camera centers in meters, which determines the scale. May be given several times.
    #[arg(long, num_args = 1..=3, value_names = ["A", "B", "METERS"])]
    distance: Vec<String>,
    /// Ignore the GPS positions in EXIF; by default, a model with three or more of them is georeferenced: X east, Y north, Z up, in meters.
    #[arg(long)]
    ignore_gps: bool,
}

/// Known camera positions and distances, by photograph.
#[derive(Clone)]
pub(super) struct Places {
    centers: Vec<Option<Point3<f64>>>,
    source: Option<PlaceSource>,
    distances: Vec<(usize, usize, f64)>,
}

impl PlaceArgs {
    /// Reads the positions and distances of the command line, before the computation begins.
    pub(super) fn read(&self, all: &[Photograph], context: &Context) -> Result<Places, Failure> {
        let mut places = Places { centers: vec![None; all.len()], source: None, distances: self.distances(all)? };
        let Some(path) = &self.known else { return Ok(places) };
        let mut unknown_names = Vec::new();
        for (name, place) in cv_io::read_camera_positions(path)? {
            match find(all, &name) {
                Some(i) => places.centers[i] = Some(place),
                None => unknown_names.push(name),
            }
        }
        let got = places.centers.iter().flatten().count();
        if got < 3 {
            let what = format!("{} has the positions of {got} of the photographs, three are needed", path.display());
            let advice = match unknown_names.first() {
                Some(name) => format!("use the names of the photographs' files; “{name:.60}” is none of them"),
                None => "three or more photographs from different positions; --distance determines the scale alone"
                    .to_owned(),
            };
            return Err(Failure::new(what).advice(advice));
        }
        if let Some(first) = unknown_names.first() {
            let path = path.display();
            context.warn(format!(
                "{path}: {} of its names match no photograph, such as “{first:.60}”",
                unknown_names.len()
            ));
        }
        places.source = Some(PlaceSource::File(path.clone()));
        Ok(places)
    }

    fn distances(&self, all: &[Photograph]) -> Result<Vec<(usize, usize, f64)>, Failure> {
        let usage = |what: String| Failure::usage(what).advice("--distance a.jpg b.jpg 2.5");
        let (rows, rest) = self.distance.as_chunks::<3>();
        if !rest.is_empty() {
            return Err(usage("--distance takes two photographs and their distance in meters".to_owned()));
        }
        let of = |[a, b, meters]: &[String; 3]| {
            let number = meters.parse().ok().filter(|m: &f64| *m > 0.0 && m.is_finite());
            let Some(meters) = number else {
                return Err(usage(format!("“{meters:.40}” is not a positive number of meters")));
            };
            let index = |name: &String| {
                find(all, name).ok_or_else(|| usage(format!("--distance: “{name:.60}” is none of the photographs")))
            };
            let (a, b) = (index(a)?, index(b)?);
            if a == b {
                return Err(usage(format!("--distance: {} is named twice", all[a].path.display())));
            }
            Ok((a, b, meters))
        };
        rows.iter().map(of).collect()
    }
}

/// Finds the photograph of that name, of that path, or the only one with that file name.
fn find(all: &[Photograph], name: &str) -> Option<usize> {
    let by = |is: &dyn Fn(&Photograph) -> bool| {
        let mut found = (0..all.len()).filter(|i| is(&all[*i]));
        found.next().filter(|_| found.next().is_none())
    };
    by(&|p| p.name == name)
        .or_else(|| by(&|p| p.path.as_os_str() == name))
        .or_else(|| by(&|p| p.path.file_name().is_some_and(|file| file == name)))
}

/// The frame of a model, as text and as JSON.
pub(super) struct Frame {
    pub(super) text: String,
    pub(super) json: Value,
}

impl Places {
    /// Adds the GPS positions of EXIF, if no positions are given.
    pub(super) fn with_gps(&self, args: &PlaceArgs, all: &[Photograph]) -> Self {
        let mut places = self.clone();
        if args.ignore_gps || self.source.is_some() {
            return places;
        }
        let fix = |one: &Photograph| {
            one.gps.map(|gps| GpsFix { place: gps.position(), has_altitude: gps.altitude.is_some() })
        };
        let fixes: Vec<Option<GpsFix>> = all.iter().map(fix).collect();
        if let Some(GpsCenters { centers, origin, has_heights: heights }) = gps_centers(&fixes) {
            places.centers = centers;
            places.source = Some(PlaceSource::Gps { origin, heights });
        }
        places
    }

    /// Whether positions or distances are given.
    pub(super) fn is_given(&self) -> bool {
        self.source.is_some() || !self.distances.is_empty()
    }

    /// Aligns a model to the known positions and distances; `used` are the photographs of its views. Outliers are reported and ignored.
    pub(super) fn align(
        &self,
        model: &mut SfmModel,
        all: &[Photograph],
        used: &[usize],
        context: &Context,
    ) -> Result<Frame, Failure> {
        let view = |at: usize| used.iter().position(|u| *u == at);
        let inside = |v: &usize| model.poses.get(*v).is_some_and(Option::is_some);
        let mut distances = Vec::new();
        for &(a, b, meters) in &self.distances {
            match (view(a).filter(inside), view(b).filter(inside)) {
                (Some(a), Some(b)) => distances.push((a, b, meters)),
                (first, _) => {
                    let missing = &all[if first.is_none() { a } else { b }];
                    context.warn(format!("--distance is ignored: {} is not in the model", missing.path.display()));
                }
            }
        }
        let centers: Vec<Option<Point3<f64>>> = used.iter().map(|at| self.centers[*at]).collect();
        let seed = context.seed.unwrap_or(0);
        let known = KnownPlaces { centers: &centers, distances: &distances };
        let placed = place_model(model, &known, seed, context)?;
        if let (Some(error), Some(source)) = (&placed.without_centers, &self.source)
            && let Some(text) = source.refusal(error)
        {
            context.warn(format!("the model is not aligned to {}: {text}", source.name()));
        }
        if let Some(error) = &placed.without_distances {
            context.warn(format!("--distance is ignored: {error}"));
        }
        let found = placed.alignment;
        self.warn_of_contradictions(&found, model, all, used, context);
        Ok(self.frame(&found, all, used))
    }

    /// Warns of contradicting distances, scales and positions.
    fn warn_of_contradictions(
        &self,
        found: &ModelAlignment,
        model: &SfmModel,
        all: &[Photograph],
        used: &[usize],
        context: &Context,
    ) {
        if let Some(error) = found.distance_error.filter(|error| *error > words::MAX_DISTANCE_RESIDUAL) {
            context.warn(words::distances_differ(error));
        }
        let (Some(fit), Some(source)) = (&found.centers, &self.source) else { return };
        if let Some(ratio) = fit.scale_ratio.filter(|ratio| (ratio - 1.0).abs() > words::MAX_SCALE_DIFFERENCE) {
            context.warn(format!(
                "lengths by {} are {:.1} % {} than by --distance, which is used",
                source.name(),
                100.0 * (ratio - 1.0).abs(),
                if ratio > 1.0 { "longer" } else { "shorter" }
            ));
        }
        let off = |v: &usize| {
            let pose = model.poses.get(*v).copied().flatten()?;
            let known = self.centers[used[*v]]?;
            Some((&*all[used[*v]].path, (pose.center() - known).norm()))
        };
        let differ: Vec<_> = fit.outliers.iter().filter_map(off).collect();
        if !differ.is_empty() {
            context.warn(words::places_differ(source, &differ, fit.rms));
        }
    }

    fn frame(&self, found: &ModelAlignment, all: &[Photograph], used: &[usize]) -> Frame {
        let names = |views: &[usize]| views.iter().map(|v| all[used[*v]].name.clone()).collect::<Vec<_>>();
        let (text, by) = match (&found.centers, &self.source) {
            (Some(fit), Some(source)) => (words::aligned(source, fit), source.key()),
            _ if found.metric => ("in meters by --distance; upright, Z up".to_owned(), "distance"),
            _ => (
                "upright, Z up; its scale is arbitrary (no positions or distances are known)".to_owned(),
                "photographs",
            ),
        };
        let mut json = json!({ "by": by, "unit": if found.metric { "m" } else { "arbitrary" } });
        if let Some(fit) = &found.centers {
            json["agree"] = json!(names(&fit.inliers));
            json["differ"] = json!(names(&fit.outliers));
            json["rms_m"] = json!(fit.rms);
            json["tilt_known"] = json!(fit.tilt);
            if let Some(PlaceSource::Gps { origin, heights }) = &self.source {
                json["origin"] = json!({
                    "latitude": origin.latitude.to_degrees(),
                    "longitude": origin.longitude.to_degrees(),
                    "altitude_m": heights.then_some(origin.altitude),
                });
            }
        }
        Frame { text, json }
    }
}
