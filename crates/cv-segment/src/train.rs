//! Training of a color model on images with masks.

use crate::{
    Cleanup, ColorModel, ColorSpace, ConfusionMatrix, Mixture, MixtureOptions, Rule, SegmentError, WeightedSample,
    cleanup::largest_component_fraction,
    color_space::mean_hue,
    detection::ObjectFeatures,
    model::{MAX_ABS_SCORE, ModelFile},
};
use cv_core::{Cancelled, ImageView, OptionError, Progress, Stage};

/// Which connected components of a mask are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Regions {
    /// The largest, if in every training mask the largest component has at least 95 % of the foreground; else all.
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
    /// Number of Gaussians of the object's mixture, 1 to 64. Default 5.
    pub components: usize,
    /// Number of Gaussians of the background's mixture, 1 to 63. Default 10: backgrounds have more colors than an
    /// object.
    pub background_components: usize,
    /// Decision rule. Default posterior odds with a tuned threshold.
    pub rule: Rule,
    /// Weight of a uniform component in the background mixture, for colors that do not occur in training: without it, a
    /// color far from all Gaussians could be classified as the object. 0 to below 1; default 0.01.
    pub unknown: f64,
    /// Sigma in pixels of the Gaussian filter of the scores before thresholding: neighbors mostly have the same label.
    /// 0 (none) to 100; default 1.
    pub smoothing: f32,
    /// Covariance regularization: added to each variance, relative to the variance of the samples. 0 to 1; default
    /// 1e-6.
    pub regularization: f64,
    /// Radius in pixels of the disc of the opening. 0 to 1000; default 2.
    pub open_radius: usize,
    /// Radius in pixels of the disc of the closing. 0 to 1000; default 2.
    pub close_radius: usize,
    /// Which connected components are kept. Default: determined from the masks.
    pub regions: Regions,
    /// Seed of the k-means++ initialization. Default 1.
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
    /// Checks the ranges before training starts.
    fn validate(&self) -> Result<(), OptionError> {
        use OptionError as E;
        let in_range = |low: f64, high: f64| move |v: f64| (low..=high).contains(&v);
        E::check("components", self.components as f64, "from 1 to 64", in_range(1.0, 64.0))?;
        E::check("background_components", self.background_components as f64, "from 1 to 63", in_range(1.0, 63.0))?;
        E::check("unknown", self.unknown, "from 0 to below 1", |v| (0.0..1.0).contains(&v))?;
        E::check("smoothing", self.smoothing.into(), "from 0 to 100 px", in_range(0.0, 100.0))?;
        E::check("regularization", self.regularization, "from 0 to 1", in_range(0.0, 1.0))?;
        E::check("open_radius", self.open_radius as f64, "from 0 to 1000 px", in_range(0.0, 1000.0))?;
        E::check("close_radius", self.close_radius as f64, "from 0 to 1000 px", in_range(0.0, 1000.0))
    }
}

/// A training image and the mask of the object in it.
pub type Labeled<'a> = (ImageView<'a, u8, 3>, ImageView<'a, bool, 1>);

/// Result of [`train`].
#[derive(Debug, Clone, PartialEq)]
pub struct Trained {
    /// The model.
    pub model: ColorModel,
    /// Confusion matrix of each training image, after clean-up. These scores are optimistic: they are not of held-out
    /// images.
    pub scores: Vec<ConfusionMatrix>,
    /// Number of foreground pixels of all masks.
    pub foreground_pixels: u64,
    /// Number of background pixels of all masks.
    pub background_pixels: u64,
}

/// Trains a color model: fits the mixtures of object and background and tunes the threshold.
///
/// Colors are quantized to a histogram with bins of four gray levels per channel, so the time of fitting depends on the
/// number of distinct colors, not of pixels. Images without the object (an empty mask) are valid: they contribute to
/// the background.
///
/// # Errors
/// [`SegmentError`]: no images, a mask of another size than its image, no or only foreground pixels, an option out of
/// range.
pub fn train(images: &[Labeled<'_>], options: &TrainOptions, progress: &dyn Progress) -> Result<Trained, SegmentError> {
    options.validate()?;
    if images.is_empty() {
        return Err(SegmentError::NoPhotos);
    }
    let mut histograms = [ColorHistogram::new(), ColorHistogram::new()];
    let stage = Stage::new(progress, "colors", images.len())?;
    for (index, (image, mask)) in images.iter().enumerate() {
        if image.size() != mask.size() {
            return Err(SegmentError::SizeMismatch { index, photo: image.size(), mask: mask.size() });
        }
        for y in 0..image.height() {
            stage.check()?;
            for (&rgb, &m) in image.row(y).as_chunks::<3>().0.iter().zip(mask.row(y)) {
                histograms[usize::from(m)].add(rgb);
            }
        }
        stage.add(1)?;
    }
    let [background, foreground] = &histograms;
    let counts = [foreground.total(), background.total()];
    if counts[0] == 0 {
        return Err(SegmentError::NoForeground { photos: images.len() });
    }
    if counts[1] == 0 {
        return Err(SegmentError::NoBackground { photos: images.len() });
    }
    let hue = if options.space == ColorSpace::Hsv { mean_hue(foreground.colors()) } else { 0.0 };
    let fit = |histogram: &ColorHistogram, components| {
        let sample =
            |(rgb, weight)| WeightedSample { point: options.space.coordinates(rgb, hue).map(f64::from), weight };
        let samples: Vec<WeightedSample> = histogram.colors().map(sample).collect();
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
    let foreground_mixture = fit(foreground, options.components)?;
    let background_mixture =
        if options.rule == Rule::Density { None } else { Some(fit(background, options.background_components)?) };
    let largest = match options.regions {
        Regions::Largest => true,
        Regions::All => false,
        Regions::Auto => has_one_region_each(images, progress)?,
    };
    let mut file = ModelFile {
        unknown: options.unknown,
        prior: counts[0] as f64 / (counts[0] + counts[1]) as f64,
        rule: options.rule,
        smoothing: options.smoothing,
        cleanup: Cleanup { open_radius: options.open_radius, close_radius: options.close_radius, largest },
        ..ModelFile::new(options.space, hue, foreground_mixture, background_mixture)
    };
    let mut model = ColorModel::try_from(file.clone())?;
    if options.rule != Rule::Posterior {
        file.threshold = best_threshold(&model, images, progress)?;
        model = ColorModel::try_from(file.clone())?;
    }
    let stage = Stage::new(progress, "scores", images.len())?;
    let mut scores = Vec::with_capacity(images.len());
    let mut objects = ObjectFeatures::default();
    for (image, mask) in images {
        let score = model.score(*image, &stage)?;
        let predicted = model.cleanup().apply(model.binarize(score.view()).view(), &stage)?;
        scores.push(ConfusionMatrix::new(predicted.view(), *mask)?);
        objects.add(*mask, score.view());
        stage.add(1)?;
    }
    file.objects = objects.statistics();
    let model = ColorModel::try_from(file)?;
    Ok(Trained { model, scores, foreground_pixels: counts[0], background_pixels: counts[1] })
}

/// Returns whether in every mask the largest component has at least 95 % of the foreground.
fn has_one_region_each(images: &[Labeled<'_>], progress: &dyn Progress) -> Result<bool, Cancelled> {
    let stage = Stage::new(progress, "regions", images.len())?;
    for (_, mask) in images {
        if largest_component_fraction(*mask) < 0.95 {
            return Ok(false);
        }
        stage.add(1)?;
    }
    Ok(true)
}

/// Finds the threshold that maximizes F1 over all pixels of the images, before clean-up: the midpoint of the interval
/// around the maximum in which F1 is within 0.001 of it.
fn best_threshold(model: &ColorModel, images: &[Labeled<'_>], progress: &dyn Progress) -> Result<f32, Cancelled> {
    const BINS: usize = 2000;
    let width = 2.0 * MAX_ABS_SCORE / BINS as f32;
    let mut counts = vec![[0u64; 2]; BINS + 1];
    let stage = Stage::new(progress, "threshold", images.len())?;
    for (image, mask) in images {
        let score = model.score(*image, &stage)?;
        for y in 0..score.height() {
            for (&v, &m) in score.row(y).iter().zip(mask.row(y)) {
                counts[(((v + MAX_ABS_SCORE) / width) as usize).min(BINS)][usize::from(m)] += 1;
            }
        }
        stage.add(1)?;
    }
    let truth: u64 = counts.iter().map(|c| c[1]).sum();
    // F1 with the threshold at the lower edge of bin i.
    let mut above = [0u64; 2];
    let mut f1 = vec![0.0; BINS + 1];
    for (f1, count) in f1.iter_mut().zip(&counts).rev() {
        above[0] += count[0];
        above[1] += count[1];
        *f1 = 2.0 * above[1] as f64 / (above[0] + above[1] + truth) as f64;
    }
    let best = (0..=BINS).fold(0, |best, i| if f1[i] > f1[best] { i } else { best });
    let is_near_best = |i: &usize| f1[*i] >= f1[best] - 1e-3;
    let first = (0..best).rev().take_while(is_near_best).last().unwrap_or(best);
    let last = (best..=BINS).take_while(is_near_best).last().unwrap_or(best);
    Ok(((first + last) as f32 * 0.5 * width - MAX_ABS_SCORE).clamp(-MAX_ABS_SCORE, MAX_ABS_SCORE))
}

/// RGB histogram with bins of four gray levels per channel.
struct ColorHistogram {
    /// Count, and the sums of red, green and blue, of each bin.
    bins: Vec<[u64; 4]>,
}

impl ColorHistogram {
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

    /// Returns the mean color and the count of each nonempty bin.
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

    /// A colored square on a background, both with a small texture.
    fn scene(color: [u8; 3], ground: [u8; 3]) -> (RgbU8, Mask) {
        let inside = |x: usize, y: usize| (20..50).contains(&x) && (15..40).contains(&y);
        let shade = |c: [u8; 3], x: usize, y: usize| c.map(|v| v.saturating_add(((x * 7 + y * 13) % 17) as u8));
        let image = RgbU8::from_fn(80, 60, |x, y| shade(if inside(x, y) { color } else { ground }, x, y));
        (image, Mask::from_fn(80, 60, |x, y| [inside(x, y)]))
    }

    #[test]
    fn hues_on_both_sides_of_zero_form_one_component() {
        // Half of the square has hue 350°, half 10°: a linear average would be 180°, cyan, the hue of the background.
        let (_, mask) = scene([0; 3], [0; 3]);
        let image = RgbU8::from_fn(80, 60, |x, y| {
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
        let trained = train(&[(image.view(), mask.view())], &options, &Silent).unwrap();
        let f1 = trained.scores[0].f1();
        assert!(f1 > 0.97, "{f1}");
        assert!(trained.model.foreground().components[0].mean[0].abs() < 0.1);
    }

    #[test]
    fn every_space_and_rule_segments_a_uniform_object() {
        let (image, mask) = scene([220, 110, 30], [90, 100, 110]);
        for space in [ColorSpace::Hsv, ColorSpace::Rgb, ColorSpace::Lab] {
            for rule in [Rule::Tuned, Rule::Posterior, Rule::Density] {
                let options = TrainOptions { space, rule, ..Default::default() };
                let trained = train(&[(image.view(), mask.view())], &options, &Silent).unwrap();
                let f1 = trained.scores[0].f1();
                // Smoothing and rounding of corners misclassify some of the 110 border pixels of 750.
                assert!(f1 > 0.95, "{space:?} {rule:?} {f1}");
                assert_eq!((trained.foreground_pixels, trained.background_pixels), (750, 4050));
                assert!(trained.model.cleanup().largest);
                assert_eq!(train(&[(image.view(), mask.view())], &options, &Silent).unwrap(), trained);
            }
        }
    }

    #[test]
    fn invalid_training_input_is_an_error() {
        let (image, mask) = scene([220, 110, 30], [90; 3]);
        let options = TrainOptions::default();
        let with =
            |mask: &Mask, options: &TrainOptions| train(&[(image.view(), mask.view())], options, &Silent).unwrap_err();
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
    fn indistinguishable_object_and_background_score_low() {
        let (_, mask) = scene([0; 3], [0; 3]);
        let image = RgbU8::new(80, 60, [77; 3]);
        for rule in [Rule::Tuned, Rule::Posterior, Rule::Density] {
            let trained =
                train(&[(image.view(), mask.view())], &TrainOptions { rule, ..Default::default() }, &Silent).unwrap();
            assert!(trained.scores[0].f1() < 0.5);
        }
    }

    #[test]
    fn masks_with_several_regions_disable_the_largest_component_selection() {
        let (image, mut mask) = scene([220, 110, 30], [90; 3]);
        for y in 15..40 {
            mask.set(35, y, [false]);
        }
        assert!(
            !train(&[(image.view(), mask.view())], &TrainOptions::default(), &Silent).unwrap().model.cleanup().largest
        );
    }
}
