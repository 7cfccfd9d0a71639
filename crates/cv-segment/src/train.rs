//! Learning a model from photos and masks.

use crate::{
    Cleanup, ColorModel, ColorSpace, ConfusionMatrix, Mixture, MixtureOptions, Rule, SegmentError, WeightedSample,
    cleanup::largest_share,
    color_space::mean_hue,
    detection::ObjectFeatures,
    model::{LIMIT, ModelFile},
};
use cv_core::{Cancelled, ImageView, OptionError, Progress, Stage};

/// Which regions of a mask are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Regions {
    /// The largest only, where every training mask shows one region (that holds 95 % of what is marked); else all.
    #[default]
    Auto,
    /// The largest.
    Largest,
    /// All.
    All,
}

cv_core::named!(Regions {
    Auto = "auto": "the largest only, where every mask shows one region",
    Largest = "largest",
    All = "all",
});

/// Settings of [`train`].
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct TrainOptions {
    /// Color space. Default HSV.
    pub space: ColorSpace,
    /// Gaussians for the object's colors, 1 to 64. Default 5.
    pub components: usize,
    /// Gaussians for the background's, 1 to 63. Default 10: there are more colors in the background than in an object.
    pub background_components: usize,
    /// What a pixel's color is judged by. Default posterior odds with a tuned threshold.
    pub rule: Rule,
    /// The share of the background that may have any color, so that one never seen is not taken for the object only because the background's Gaussians are even
    /// farther away. 0 to below 1; default 0.01.
    pub unknown: f64,
    /// Standard deviation in pixels of the Gaussian by which scores are smoothed before they are held against the threshold: neighbors are mostly of one kind.
    /// 0 to 100; default 1.
    pub smoothing: f32,
    /// Added to each variance, in units of the variance of the samples. Default 1e-6.
    pub regularization: f64,
    /// Radius in pixels of the disc by which masks are opened. 0 to 1000; default 2.
    pub open_radius: usize,
    /// Radius in pixels of the disc by which masks are closed. 0 to 1000; default 2.
    pub close_radius: usize,
    /// Which regions are kept. Default: learned from the masks.
    pub regions: Regions,
    /// Seed of the mixtures' first means. Default 1.
    pub seed: u64,
}

impl Default for TrainOptions {
    fn default() -> Self {
        let Cleanup { open_radius, close_radius, .. } = Cleanup::default();
        Self {
            space: ColorSpace::default(),
            components: 5,
            background_components: 10,
            rule: Rule::default(),
            unknown: 0.01,
            smoothing: 1.0,
            regularization: 1e-6,
            open_radius,
            close_radius,
            regions: Regions::default(),
            seed: 1,
        }
    }
}

impl TrainOptions {
    /// Before the work: a bad option is not worth waiting for.
    fn validate(&self) -> Result<(), OptionError> {
        use OptionError as E;
        let within = |low: f64, high: f64| move |v: f64| (low..=high).contains(&v);
        E::check("components", self.components as f64, "from 1 to 64", within(1.0, 64.0))?;
        E::check("background_components", self.background_components as f64, "from 1 to 63", within(1.0, 63.0))?;
        E::check("unknown", self.unknown, "from 0 to below 1", |v| (0.0..1.0).contains(&v))?;
        E::check("smoothing", self.smoothing.into(), "from 0 to 100 px", within(0.0, 100.0))?;
        E::check("regularization", self.regularization, "from 0 to 1", within(0.0, 1.0))?;
        E::check("open_radius", self.open_radius as f64, "from 0 to 1000 px", within(0.0, 1000.0))?;
        E::check("close_radius", self.close_radius as f64, "from 0 to 1000 px", within(0.0, 1000.0))
    }
}

/// A photo and the mask of the object in it.
pub type Labeled<'a> = (ImageView<'a, u8, 3>, ImageView<'a, bool, 1>);

/// A model and what is known about its training.
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// The model.
    pub model: ColorModel,
    /// Its scores on the photos it was trained on, each by itself, after cleaning up. What it will do on others is less.
    pub scores: Vec<ConfusionMatrix>,
    /// Pixels of the object.
    pub foreground_pixels: u64,
    /// Other pixels.
    pub background_pixels: u64,
}

/// Learns the object's colors, the background's, and the threshold between them.
///
/// Colors are counted in bins of four gray levels a side, so the time of fitting depends on how many different colors there are, not on the number of
/// pixels. A photo without the object (an empty mask) is welcome: it shows what is not the object.
///
/// # Errors
/// [`SegmentError`]: no photos, a mask of another size than its photo, no or all pixels marked, an option out of range.
pub fn train(photos: &[Labeled<'_>], options: &TrainOptions, progress: &dyn Progress) -> Result<Trained, SegmentError> {
    options.validate()?;
    if photos.is_empty() {
        return Err(SegmentError::NoPhotos);
    }
    let mut colors = [Bins::new(), Bins::new()];
    let stage = Stage::new(progress, "colors", photos.len())?;
    for (index, (photo, mask)) in photos.iter().enumerate() {
        if photo.size() != mask.size() {
            return Err(SegmentError::SizeMismatch { index, photo: photo.size(), mask: mask.size() });
        }
        for y in 0..photo.height() {
            stage.check()?;
            for (&rgb, &m) in photo.row(y).as_chunks::<3>().0.iter().zip(mask.row(y)) {
                colors[usize::from(m)].add(rgb);
            }
        }
        stage.add(1)?;
    }
    let [background, foreground] = &colors;
    let counts = [foreground.total(), background.total()];
    if counts[0] == 0 {
        return Err(SegmentError::NoForeground { photos: photos.len() });
    }
    if counts[1] == 0 {
        return Err(SegmentError::NoBackground { photos: photos.len() });
    }
    let hue = if options.space == ColorSpace::Hsv { mean_hue(foreground.colors()) } else { 0.0 };
    let fit = |bins: &Bins, components| {
        let sample =
            |(rgb, weight)| WeightedSample { point: options.space.coordinates(rgb, hue).map(f64::from), weight };
        let samples: Vec<WeightedSample> = bins.colors().map(sample).collect();
        let resolution = options.space.resolution();
        let settings = MixtureOptions {
            components,
            regularization: options.regularization,
            resolution,
            seed: options.seed,
            ..Default::default()
        };
        Mixture::fit(&samples, &settings, progress)
    };
    let object = fit(foreground, options.components)?;
    let rest = if options.rule == Rule::Density { None } else { Some(fit(background, options.background_components)?) };
    let largest = match options.regions {
        Regions::Largest => true,
        Regions::All => false,
        Regions::Auto => one_region_each(photos, progress)?,
    };
    let mut file = ModelFile {
        unknown: options.unknown,
        prior: counts[0] as f64 / (counts[0] + counts[1]) as f64,
        rule: options.rule,
        smoothing: options.smoothing,
        cleanup: Cleanup { open_radius: options.open_radius, close_radius: options.close_radius, largest },
        ..ModelFile::new(options.space, hue, object, rest)
    };
    let mut model = ColorModel::try_from(file.clone())?;
    if options.rule != Rule::Posterior {
        file.threshold = best_threshold(&model, photos, progress)?;
        model = ColorModel::try_from(file.clone())?;
    }
    let stage = Stage::new(progress, "scores", photos.len())?;
    let mut scores = Vec::with_capacity(photos.len());
    let mut objects = ObjectFeatures::default();
    for (photo, mask) in photos {
        let score = model.score(*photo, &stage)?;
        let found = model.cleanup().apply(model.mark(score.view()).view(), &stage)?;
        scores.push(ConfusionMatrix::new(found.view(), *mask)?);
        objects.add(*mask, score.view());
        stage.add(1)?;
    }
    file.objects = objects.statistics();
    let model = ColorModel::try_from(file)?;
    Ok(Trained { model, scores, foreground_pixels: counts[0], background_pixels: counts[1] })
}

/// Whether each mask shows one region, but for specks.
fn one_region_each(photos: &[Labeled<'_>], progress: &dyn Progress) -> Result<bool, Cancelled> {
    let stage = Stage::new(progress, "regions", photos.len())?;
    for (_, mask) in photos {
        if largest_share(*mask) < 0.95 {
            return Ok(false);
        }
        stage.add(1)?;
    }
    Ok(true)
}

/// The threshold with the best F1 over all pixels of the photos, before cleaning up; the middle of the range around it that is within a thousandth of the best.
fn best_threshold(model: &ColorModel, photos: &[Labeled<'_>], progress: &dyn Progress) -> Result<f32, Cancelled> {
    const BINS: usize = 2000;
    let width = 2.0 * LIMIT / BINS as f32;
    let mut counts = vec![[0u64; 2]; BINS + 1];
    let stage = Stage::new(progress, "threshold", photos.len())?;
    for (photo, mask) in photos {
        let score = model.score(*photo, &stage)?;
        for y in 0..score.height() {
            for (&v, &m) in score.row(y).iter().zip(mask.row(y)) {
                counts[(((v + LIMIT) / width) as usize).min(BINS)][usize::from(m)] += 1;
            }
        }
        stage.add(1)?;
    }
    let truth: u64 = counts.iter().map(|c| c[1]).sum();
    // F1 when everything from bin i on is marked.
    let mut marked = [0u64; 2];
    let mut f1 = vec![0.0; BINS + 1];
    for (f1, count) in f1.iter_mut().zip(&counts).rev() {
        marked[0] += count[0];
        marked[1] += count[1];
        *f1 = 2.0 * marked[1] as f64 / (marked[0] + marked[1] + truth) as f64;
    }
    let best = (0..=BINS).fold(0, |best, i| if f1[i] > f1[best] { i } else { best });
    let good = |i: &usize| f1[*i] >= f1[best] - 1e-3;
    let first = (0..best).rev().take_while(good).last().unwrap_or(best);
    let last = (best..=BINS).take_while(good).last().unwrap_or(best);
    Ok(((first + last) as f32 * 0.5 * width - LIMIT).clamp(-LIMIT, LIMIT))
}

/// Counts of colors in bins of four gray levels a side, with the sums of what fell in.
struct Bins {
    bins: Vec<[u64; 4]>,
}

impl Bins {
    fn new() -> Self {
        Self { bins: vec![[0; 4]; 1 << 18] }
    }

    #[inline]
    fn add(&mut self, rgb: [u8; 3]) {
        let [r, g, b] = rgb.map(|v| usize::from(v >> 2));
        let bin = &mut self.bins[r << 12 | g << 6 | b];
        for (sum, v) in bin.iter_mut().zip([1, rgb[0], rgb[1], rgb[2]]) {
            *sum += u64::from(v);
        }
    }

    fn total(&self) -> u64 {
        self.bins.iter().map(|b| b[0]).sum()
    }

    /// The mean color of each bin that holds any, and how many it holds.
    fn colors(&self) -> impl Iterator<Item = ([u8; 3], f64)> + '_ {
        self.bins.iter().filter(|b| b[0] > 0).map(|b| {
            let mean = |sum: u64| ((sum + b[0] / 2) / b[0]) as u8;
            ([mean(b[1]), mean(b[2]), mean(b[3])], b[0] as f64)
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{Mask, RgbU8, Silent};

    /// A colored square on a gray that varies.
    fn scene(color: [u8; 3], ground: [u8; 3]) -> (RgbU8, Mask) {
        let inside = |x: usize, y: usize| (20..50).contains(&x) && (15..40).contains(&y);
        let shade = |c: [u8; 3], x: usize, y: usize| c.map(|v| v.saturating_add(((x * 7 + y * 13) % 17) as u8));
        let photo = RgbU8::from_fn(80, 60, |x, y| shade(if inside(x, y) { color } else { ground }, x, y));
        (photo, Mask::from_fn(80, 60, |x, y| [inside(x, y)]))
    }

    #[test]
    fn red_on_both_sides_of_the_hue_cut_is_one_color() {
        // Half of the square at hue 350°, half at 10°: an average that is not circular lies at 180°, cyan, which is the background here.
        let (_, mask) = scene([0; 3], [0; 3]);
        let photo = RgbU8::from_fn(80, 60, |x, y| {
            let v = 200 + ((x * 7 + y * 13) % 17) as u8;
            let other = (v / 6) + (x % 3) as u8;
            if !mask.at(x, y)[0] {
                [20, v, v]
            } else if (x + y) % 2 == 0 {
                [v, 0, other]
            } else {
                [v, other, 0]
            }
        });
        let options = TrainOptions { components: 1, background_components: 1, ..Default::default() };
        let trained = train(&[(photo.view(), mask.view())], &options, &Silent).unwrap();
        let f1 = trained.scores[0].f1();
        assert!(f1 > 0.97, "{f1}");
        assert!(trained.model.foreground().components[0].mean[0].abs() < 0.1);
    }

    #[test]
    fn every_space_and_rule_learns_a_plain_object() {
        let (photo, mask) = scene([220, 110, 30], [90, 100, 110]);
        for space in [ColorSpace::Hsv, ColorSpace::Rgb, ColorSpace::Lab] {
            for rule in [Rule::Tuned, Rule::Posterior, Rule::Density] {
                let options = TrainOptions { space, rule, ..Default::default() };
                let trained = train(&[(photo.view(), mask.view())], &options, &Silent).unwrap();
                let f1 = trained.scores[0].f1();
                // Smoothing by a pixel and rounding of corners cost a part of the 110 border pixels of 750.
                assert!(f1 > 0.95, "{space:?} {rule:?} {f1}");
                assert_eq!((trained.foreground_pixels, trained.background_pixels), (750, 4050));
                assert!(trained.model.cleanup().largest);
                assert_eq!(train(&[(photo.view(), mask.view())], &options, &Silent).unwrap(), trained);
            }
        }
    }

    #[test]
    fn what_cannot_be_trained_on_is_said() {
        let (photo, mask) = scene([220, 110, 30], [90; 3]);
        let options = TrainOptions::default();
        let with =
            |mask: &Mask, options: &TrainOptions| train(&[(photo.view(), mask.view())], options, &Silent).unwrap_err();
        assert_eq!(train(&[], &options, &Silent).unwrap_err(), SegmentError::NoPhotos);
        assert_eq!(with(&Mask::new(80, 60, [false]), &options), SegmentError::NoForeground { photos: 1 });
        assert_eq!(with(&Mask::new(80, 60, [true]), &options), SegmentError::NoBackground { photos: 1 });
        let error = SegmentError::SizeMismatch { index: 0, photo: (80, 60), mask: (60, 80) };
        assert_eq!(with(&Mask::new(60, 80, [true]), &options), error);
        for wrong in [
            TrainOptions { components: 0, ..options.clone() },
            TrainOptions { background_components: 64, ..options.clone() },
            TrainOptions { smoothing: f32::NAN, ..options.clone() },
            TrainOptions { unknown: 1.0, ..options.clone() },
            TrainOptions { regularization: -1.0, ..options.clone() },
            TrainOptions { open_radius: 1001, ..options.clone() },
        ] {
            let error = with(&mask, &wrong);
            assert!(matches!(error, SegmentError::Option(_)), "{wrong:?}: {error:?}");
        }
        let empty = (RgbU8::new(0, 0, [0; 3]), Mask::new(0, 0, [true]));
        let error = train(&[(empty.0.view(), empty.1.view())], &options, &Silent).unwrap_err();
        assert_eq!(error, SegmentError::NoForeground { photos: 1 });
    }

    #[test]
    fn one_color_everywhere_is_learned_as_that() {
        // Nothing tells object from background: the scores say so.
        let (_, mask) = scene([0; 3], [0; 3]);
        let photo = RgbU8::new(80, 60, [77; 3]);
        for rule in [Rule::Tuned, Rule::Posterior, Rule::Density] {
            let trained =
                train(&[(photo.view(), mask.view())], &TrainOptions { rule, ..Default::default() }, &Silent).unwrap();
            assert!(trained.scores[0].f1() < 0.5);
        }
    }

    #[test]
    fn several_regions_in_a_mask_keep_all() {
        let (photo, mut mask) = scene([220, 110, 30], [90; 3]);
        for y in 15..40 {
            mask.set(35, y, [false]);
        }
        assert!(
            !train(&[(photo.view(), mask.view())], &TrainOptions::default(), &Silent).unwrap().model.cleanup().largest
        );
    }
}
