//! The trained model: two mixtures, a threshold, and the parameters of smoothing and clean-up.

use crate::{Cleanup, ColorSpace, Mixture, ObjectStatistics, SegmentError, log_odds::LogOdds, mixture::Whitened};
use cv_core::{Cancelled, GrayF32, ImageView, Mask, Matrix3, OptionError, Progress, Vector3};
use cv_imgproc::gaussian_blur;
use serde::{Deserialize, Serialize};

/// The version of the model's serialized form.
const SCHEMA: u32 = 1;

/// Scores in nats are clamped to ± this value before smoothing, so that a single pixel cannot dominate its
/// neighborhood. (e¹⁰ is odds of 22,000 to 1.)
pub(crate) const MAX_ABS_SCORE: f32 = 10.0;

/// Decision rule of the classification of a pixel by its color.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Rule {
    /// Posterior odds of object against background, with the threshold that maximizes F1 on the training images.
    #[default]
    Tuned,
    /// Maximum a posteriori: foreground where the posterior probability of the object exceeds ½, with the prior of the
    /// training masks.
    Posterior,
    /// Likelihood of the object's mixture alone, with the threshold that maximizes F1 on the training images. Without a
    /// background model, backgrounds absent from the training images have no influence.
    Density,
}

cv_core::named!(Rule {
    Tuned = "tuned": "posterior odds, with the threshold that is best on the training photographs",
    Posterior = "posterior": "posterior odds: marked where the object is likelier than not",
    Density = "density": "the object's density alone, with the threshold that is best on the training photographs",
});

/// A trained color model. Serializes with serde; deserialization validates all values.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(try_from = "ModelFile", into = "ModelFile")]
pub struct ColorModel {
    file: ModelFile,
    evaluator: LogOdds,
    /// Added to the log likelihood ratio: the log prior odds, or the normalization of [`Rule::Density`].
    offset: f32,
}

impl PartialEq for ColorModel {
    fn eq(&self, other: &Self) -> bool {
        self.file == other.file
    }
}

/// Serialized form of the model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct ModelFile {
    pub(crate) schema: u32,
    pub(crate) space: ColorSpace,
    /// Reference hue in radians, see [`ColorSpace::coordinates`].
    pub(crate) hue: f32,
    pub(crate) foreground: Mixture,
    /// None under [`Rule::Density`].
    pub(crate) background: Option<Mixture>,
    /// Weight of the uniform component of the background mixture.
    pub(crate) unknown: f64,
    /// Prior probability of the foreground: its fraction of all training pixels.
    pub(crate) prior: f64,
    pub(crate) rule: Rule,
    pub(crate) smoothing: f32,
    pub(crate) threshold: f32,
    pub(crate) cleanup: Cleanup,
    /// None in files of earlier versions.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub(crate) objects: Option<ObjectStatistics>,
}

impl ModelFile {
    pub(crate) fn new(space: ColorSpace, hue: f32, foreground: Mixture, background: Option<Mixture>) -> Self {
        Self {
            schema: SCHEMA,
            space,
            hue,
            foreground,
            background,
            unknown: 0.0,
            prior: 0.5,
            rule: Rule::default(),
            smoothing: 0.0,
            threshold: 0.0,
            cleanup: Cleanup::default(),
            objects: None,
        }
    }
}

impl From<ColorModel> for ModelFile {
    fn from(model: ColorModel) -> Self {
        model.file
    }
}

impl TryFrom<ModelFile> for ColorModel {
    type Error = SegmentError;

    fn try_from(file: ModelFile) -> Result<Self, SegmentError> {
        Self::check_schema(Some(file.schema.into()))?;
        use OptionError as E;
        E::check("hue", file.hue.into(), "an angle between −7 and 7 radians", |v| v.abs() <= 7.0)?;
        E::check("prior", file.prior, "between 0 and 1", |v| v > 0.0 && v < 1.0)?;
        E::check("unknown", file.unknown, "from 0 to below 1", |v| (0.0..1.0).contains(&v))?;
        E::check("smoothing", file.smoothing.into(), "from 0 to 100 px", |v| (0.0..=100.0).contains(&v))?;
        E::check("threshold", file.threshold.into(), "between −10 and 10", |v| v.abs() <= f64::from(MAX_ABS_SCORE))?;
        for (name, radius) in [("open_radius", file.cleanup.open_radius), ("close_radius", file.cleanup.close_radius)] {
            E::check(name, radius as f64, "from 0 to 1000 px", |v| v <= 1000.0)?;
        }
        if let Some(objects) = &file.objects {
            objects.validate()?;
        }
        let foreground = file.foreground.whitened()?;
        let mut background = Vec::new();
        let offset = match &file.background {
            Some(mixture) => {
                background = mixture.whitened()?;
                for component in &mut background {
                    component.constant += (1.0 - file.unknown).ln();
                }
                if file.unknown > 0.0 {
                    // The uniform component: constant density over the gamut.
                    let constant = (file.unknown / file.space.volume()).ln();
                    background.push(Whitened { constant, a: Matrix3::zeros(), b: Vector3::zeros() });
                }
                (file.prior / (1.0 - file.prior)).ln() as f32
            }
            // Normalized so that the highest peak has the maximum score.
            None => MAX_ABS_SCORE - foreground.iter().map(|c| c.constant).fold(f64::NEG_INFINITY, f64::max) as f32,
        };
        let evaluator = LogOdds::new(file.space, file.hue, &foreground, &background);
        Ok(Self { file, evaluator, offset })
    }
}

impl ColorModel {
    /// Checks that a serialized model with this `schema` can be read by this version.
    ///
    /// # Errors
    /// [`SegmentError::Schema`].
    pub fn check_schema(schema: Option<u64>) -> Result<(), SegmentError> {
        match schema {
            Some(found) if found == u64::from(SCHEMA) => Ok(()),
            found => Err(SegmentError::Schema { found, known: SCHEMA }),
        }
    }

    /// Computes the score of each pixel in nats, clamped to ±10 and smoothed: with a background model the log posterior
    /// odds of object against background under the prior of the training masks; without, the object's log density
    /// relative to its peak, plus 10. Scores above [`ColorModel::threshold`] are foreground.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn score(&self, image: ImageView<'_, u8, 3>, progress: &dyn Progress) -> Result<GrayF32, Cancelled> {
        let mut score = self.evaluator.log_odds(image, progress)?;
        for v in score.as_mut_slice() {
            *v = (*v + self.offset).clamp(-MAX_ABS_SCORE, MAX_ABS_SCORE);
        }
        progress.report("smooth", 0, 1)?;
        Ok(if self.file.smoothing > 0.0 { gaussian_blur(score.view(), self.file.smoothing) } else { score })
    }

    /// Classifies each pixel: the thresholded scores, before clean-up.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn classify(&self, image: ImageView<'_, u8, 3>, progress: &dyn Progress) -> Result<Mask, Cancelled> {
        Ok(self.binarize(self.score(image, progress)?.view()))
    }

    /// Thresholds a score image ([`ColorModel::score`]) at [`ColorModel::threshold`].
    pub fn binarize(&self, score: ImageView<'_, f32, 1>) -> Mask {
        let threshold = self.file.threshold;
        let mut mask = Mask::new(score.width(), score.height(), [false]);
        for y in 0..score.height() {
            for (is_foreground, &v) in mask.row_mut(y).iter_mut().zip(score.row(y)) {
                *is_foreground = v > threshold;
            }
        }
        mask
    }

    /// Segments the object: classification and clean-up.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn predict(&self, image: ImageView<'_, u8, 3>, progress: &dyn Progress) -> Result<Mask, Cancelled> {
        self.file.cleanup.apply(self.classify(image, progress)?.view(), progress)
    }

    /// Returns the color space.
    pub fn space(&self) -> ColorSpace {
        self.file.space
    }

    /// Returns the color mixture of the object.
    pub fn foreground(&self) -> &Mixture {
        &self.file.foreground
    }

    /// Returns the color mixture of the background; None under [`Rule::Density`].
    pub fn background(&self) -> Option<&Mixture> {
        self.file.background.as_ref()
    }

    /// Returns the threshold in nats; higher scores are foreground.
    pub fn threshold(&self) -> f32 {
        self.file.threshold
    }

    /// Returns the decision rule.
    pub fn rule(&self) -> Rule {
        self.file.rule
    }

    /// Returns color and shape statistics of the training objects; None in models of earlier versions.
    pub fn statistics(&self) -> Option<&ObjectStatistics> {
        self.file.objects.as_ref()
    }

    /// Returns the parameters of the clean-up.
    pub fn cleanup(&self) -> Cleanup {
        self.file.cleanup
    }

    /// Replaces the parameters of the clean-up.
    pub fn with_cleanup(mut self, cleanup: Cleanup) -> Self {
        self.file.cleanup = cleanup;
        self
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Component;
    use cv_core::Silent;

    fn file() -> ModelFile {
        let at = |mean| Mixture {
            components: vec![Component {
                weight: 1.0,
                mean,
                covariance: [[0.01, 0.0, 0.0], [0.0, 0.01, 0.0], [0.0, 0.0, 0.01]],
            }],
        };
        ModelFile::new(ColorSpace::Rgb, 0.0, at([0.8, 0.4, 0.1]), Some(at([0.4, 0.4, 0.4])))
    }

    #[test]
    fn serialization_round_trips() {
        let model = ColorModel::try_from(file()).unwrap();
        let text = serde_json::to_string(&model).unwrap();
        // The form of earlier versions, without object statistics.
        assert!(!text.contains("objects"));
        assert_eq!(serde_json::from_str::<ColorModel>(&text).unwrap(), model);
        let color = crate::FeatureStatistics { mean: 3.0, deviation: 1.5 };
        let objects = Some(ObjectStatistics { color, shape: None });
        let model = ColorModel::try_from(ModelFile { objects, ..file() }).unwrap();
        let text = serde_json::to_string(&model).unwrap();
        assert_eq!(serde_json::from_str::<ColorModel>(&text).unwrap().statistics(), objects.as_ref());
    }

    #[test]
    fn invalid_model_files_are_rejected() {
        let rejection = |change: &dyn Fn(&mut ModelFile)| {
            let mut invalid = file();
            change(&mut invalid);
            ColorModel::try_from(invalid).unwrap_err()
        };
        assert_eq!(rejection(&|f| f.schema = 2), SegmentError::Schema { found: Some(2), known: 1 });
        for (name, error) in [
            ("prior", rejection(&|f| f.prior = 1.0)),
            ("prior", rejection(&|f| f.prior = f64::NAN)),
            ("unknown", rejection(&|f| f.unknown = 1.0)),
            ("threshold", rejection(&|f| f.threshold = f32::NAN)),
            ("smoothing", rejection(&|f| f.smoothing = -1.0)),
            ("hue", rejection(&|f| f.hue = f32::INFINITY)),
            (
                "color",
                rejection(&|f| {
                    let color = crate::FeatureStatistics { mean: 3.0, deviation: 0.0 };
                    f.objects = Some(ObjectStatistics { color, shape: None });
                }),
            ),
            ("close_radius", rejection(&|f| f.cleanup.close_radius = 1001)),
        ] {
            assert!(matches!(error, SegmentError::Option(e) if e.name == name), "{error:?}");
        }
        let error = rejection(&|f| f.foreground.components[0].covariance[0][0] = -1.0);
        assert!(matches!(error, SegmentError::Mixture(_)), "{error:?}");
        assert!(ColorModel::check_schema(None).is_err());
    }

    #[test]
    fn the_score_is_the_posterior_odds() {
        let model = ColorModel::try_from(ModelFile { prior: 0.2, ..file() }).unwrap();
        let image = cv_core::RgbU8::new(1, 1, [153, 102, 64]);
        let x = [0.6, 0.4, 64.0 / 255.0];
        let odds = file().foreground.log_density(x) - file().background.unwrap().log_density(x) + (0.2f64 / 0.8).ln();
        // Squares of up to 4 in f32.
        assert!((f64::from(model.score(image.view(), &Silent).unwrap().at(0, 0)[0]) - odds).abs() < 1e-5);
    }
}
