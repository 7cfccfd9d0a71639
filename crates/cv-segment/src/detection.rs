//! Detection of objects in a segmented image: region measurements (moments), scored against the statistics of the
//! training objects.

use crate::{ColorModel, SegmentError};
use cv_core::{ImageView, Mask, OptionError, Point2, Progress, Stage};
use cv_imgproc::{Components, Connectivity, connected_components};
use serde::{Deserialize, Serialize};
use std::f64::consts::{FRAC_2_SQRT_PI, PI};

/// The default of [`DetectOptions::min_score`]: a false rejection rate of one in a thousand if the features were
/// Gaussian.
pub const MIN_SCORE: f64 = 0.001;

/// Prior standard deviation of the mean color score, in nats, for illumination other than in training. Its square is
/// added to the sample variance of the training objects, which are few and often from one camera. (The next two are
/// used the same way.)
const COLOR_PRIOR_SIGMA: f64 = 1.0;
/// Prior standard deviation of the extent: a highlight or shadow that removes a tenth of a region reduces the extent by
/// up to 0.1, two standard deviations.
const EXTENT_PRIOR_SIGMA: f64 = 0.05;
/// Prior standard deviation of the axis ratio: a shadow that removes a tenth of a disc's diameter changes it by one
/// standard deviation.
const AXIS_RATIO_PRIOR_SIGMA: f64 = 0.1;
/// Regions of a training mask with less than this fraction of the area of the largest region are ignored as specks.
const MIN_AREA_RATIO: f64 = 0.05;

/// Bounding box, area and moments of a connected component.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Region {
    /// Leftmost column of the bounding box.
    pub left: usize,
    /// Topmost row of the bounding box.
    pub top: usize,
    /// Width of the bounding box in pixels.
    pub width: usize,
    /// Height of the bounding box in pixels.
    pub height: usize,
    /// Centroid in pixels; pixel centers have integer coordinates.
    pub center: Point2<f64>,
    /// Area in pixels.
    pub area: usize,
    /// Semi-axes in pixels, major and minor, of the ellipse with the region's second central moments.
    pub axes: [f64; 2],
    /// Angle in radians, above −π/2 to π/2, from the x axis (right) towards the y axis (down), of the ellipse's major axis.
    pub angle: f64,
    /// Whether the region touches the image border: the object may be truncated, so its shape is not used.
    pub truncated: bool,
}

impl Region {
    /// Returns the ratio of the ellipse's minor to major axis, above 0 to 1.
    pub fn axis_ratio(&self) -> f64 {
        self.axes[1] / self.axes[0]
    }

    /// Returns the ratio of the area to that of the ellipse: 1 for a filled ellipse, 3/π for a rectangle, less for a
    /// region with holes or notches.
    pub fn extent(&self) -> f64 {
        self.area as f64 / (PI * self.axes[0] * self.axes[1])
    }
}

/// A detected region and its score against the training objects.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
pub struct Detection {
    /// Position and shape.
    pub region: Region,
    /// Mean of [`ColorModel::score`] over the region, in nats.
    pub color: f64,
    /// p-value, 0 to 1: the probability of a training object with an equal or larger sum of squared standardized
    /// deviations of mean color score (below the mean only), extent and axis ratio, by the chi-squared distribution (3
    /// degrees of freedom). If the region is truncated or the model has no shape statistics, of the color score alone
    /// (1 degree). None if the model has no object statistics.
    pub score: Option<f64>,
    /// Whether the region is accepted: the score is at least [`DetectOptions::min_score`], or None.
    pub found: bool,
}

/// Settings of [`ColorModel::detect`].
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct DetectOptions {
    /// Minimum [`Detection::score`] of an accepted region, 0 to 1. Default [`MIN_SCORE`].
    pub min_score: f64,
}

impl Default for DetectOptions {
    fn default() -> Self {
        Self { min_score: MIN_SCORE }
    }
}

impl DetectOptions {
    /// Checks the range.
    ///
    /// # Errors
    /// [`OptionError`].
    pub fn validate(&self) -> Result<(), OptionError> {
        OptionError::check("min_score", self.min_score, "from 0 to 1", |v| (0.0..=1.0).contains(&v))
    }
}

/// Result of [`ColorModel::detect`].
#[derive(Debug, Clone, PartialEq)]
pub struct Detections {
    /// Pixels of the accepted regions.
    pub mask: Mask,
    /// All regions, accepted and rejected, by decreasing score; ties by decreasing area, then by label (top to bottom).
    pub objects: Vec<Detection>,
}

/// Mean and standard deviation of a feature of the training objects.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FeatureStatistics {
    /// Mean.
    pub mean: f64,
    /// Regularized standard deviation, above 0.
    pub deviation: f64,
}

impl FeatureStatistics {
    /// Computes mean and standard deviation, with `prior_sigma`² added to the sample variance; None without values.
    fn of(values: &[f64], prior_sigma: f64) -> Option<Self> {
        if values.is_empty() {
            return None;
        }
        let mean = values.iter().sum::<f64>() / values.len() as f64;
        let squares: f64 = values.iter().map(|v| (v - mean).powi(2)).sum();
        let variance = squares / (values.len() - 1).max(1) as f64;
        Some(Self { mean, deviation: (variance + prior_sigma * prior_sigma).sqrt() })
    }

    /// Returns the z-score of a value.
    fn standardized(&self, value: f64) -> f64 {
        (value - self.mean) / self.deviation
    }

    fn validate(&self, name: &'static str) -> Result<(), OptionError> {
        OptionError::check(name, self.mean, "a number", f64::is_finite)?;
        OptionError::check(name, self.deviation, "a deviation above 0", |v| v.is_finite() && v > 0.0)
    }
}

/// Shape statistics of the training objects that are not truncated by the image border.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ShapeStatistics {
    /// Of [`Region::extent`].
    pub extent: FeatureStatistics,
    /// Of [`Region::axis_ratio`].
    pub axis_ratio: FeatureStatistics,
}

/// Color and shape statistics of the objects of the training masks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ObjectStatistics {
    /// Of the mean of [`ColorModel::score`] over an object, in nats.
    pub color: FeatureStatistics,
    /// Shape, if some object is not truncated.
    pub shape: Option<ShapeStatistics>,
}

impl ObjectStatistics {
    pub(crate) fn validate(&self) -> Result<(), OptionError> {
        self.color.validate("color")?;
        if let Some(shape) = &self.shape {
            shape.extent.validate("extent")?;
            shape.axis_ratio.validate("axis_ratio")?;
        }
        Ok(())
    }

    /// Computes [`Detection::score`].
    fn score(&self, region: &Region, color: f64) -> f64 {
        let mut squared = self.color.standardized(color).min(0.0).powi(2);
        match &self.shape {
            Some(shape) if !region.truncated => {
                squared += shape.extent.standardized(region.extent()).powi(2);
                squared += shape.axis_ratio.standardized(region.axis_ratio()).powi(2);
                chi_squared_survival::<3>(squared)
            }
            _ => chi_squared_survival::<1>(squared),
        }
    }
}

/// Accumulator of the features of the training objects.
#[derive(Debug, Default)]
pub(crate) struct ObjectFeatures {
    color: Vec<f64>,
    extent: Vec<f64>,
    axis_ratio: Vec<f64>,
}

impl ObjectFeatures {
    /// Adds the regions of a training mask, except specks.
    pub(crate) fn add(&mut self, mask: ImageView<'_, bool, 1>, score: ImageView<'_, f32, 1>) {
        let measured = measure(&connected_components(mask, Connectivity::Eight), score);
        let largest = measured.iter().map(|(region, _)| region.area).max().unwrap_or(0);
        for (region, color) in measured {
            if (region.area as f64) < MIN_AREA_RATIO * largest as f64 {
                continue;
            }
            self.color.push(color);
            if !region.truncated {
                self.extent.push(region.extent());
                self.axis_ratio.push(region.axis_ratio());
            }
        }
    }

    /// Returns the statistics; None without objects.
    pub(crate) fn statistics(&self) -> Option<ObjectStatistics> {
        let color = FeatureStatistics::of(&self.color, COLOR_PRIOR_SIGMA)?;
        let extent = FeatureStatistics::of(&self.extent, EXTENT_PRIOR_SIGMA);
        let axis_ratio = FeatureStatistics::of(&self.axis_ratio, AXIS_RATIO_PRIOR_SIGMA);
        let shape = extent.zip(axis_ratio).map(|(extent, axis_ratio)| ShapeStatistics { extent, axis_ratio });
        Some(ObjectStatistics { color, shape })
    }
}

impl ColorModel {
    /// Measures the 8-connected components of a cleaned-up mask ([`ColorModel::predict`]) and scores them against the
    /// training objects. `score` is the result of [`ColorModel::score`], of the mask's size. Rejected regions are
    /// removed from the mask.
    ///
    /// # Errors
    /// [`SegmentError::Option`], [`SegmentError::SizeMismatch`] (with index 0), [`SegmentError::Cancelled`].
    pub fn detect(
        &self,
        mask: ImageView<'_, bool, 1>,
        score: ImageView<'_, f32, 1>,
        options: &DetectOptions,
        progress: &dyn Progress,
    ) -> Result<Detections, SegmentError> {
        options.validate()?;
        if mask.size() != score.size() {
            return Err(SegmentError::SizeMismatch { index: 0, photo: score.size(), mask: mask.size() });
        }
        let stage = Stage::new(progress, "detect", 2)?;
        let components = connected_components(mask, Connectivity::Eight);
        stage.add(1)?;
        let score_region = |(region, color): (Region, f64)| {
            let score = self.statistics().map(|statistics| statistics.score(&region, color));
            Detection { region, color, score, found: score.is_none_or(|score| score >= options.min_score) }
        };
        let mut objects: Vec<Detection> = measure(&components, score).into_iter().map(score_region).collect();
        // Indexed by label, before sorting.
        let is_accepted: Vec<bool> = objects.iter().map(|object| object.found).collect();
        let mask = components.labels.map(|[label]| [label > 0 && is_accepted[label as usize - 1]]);
        objects.sort_by(|a, b| {
            let rank = |d: &Detection| d.score.unwrap_or(1.0);
            rank(b).total_cmp(&rank(a)).then(b.region.area.cmp(&a.region.area))
        });
        stage.add(1)?;
        Ok(Detections { mask, objects })
    }
}

/// Computes each component's region and mean score, in the order of the labels.
fn measure(components: &Components, score: ImageView<'_, f32, 1>) -> Vec<(Region, f64)> {
    let (width, height) = components.labels.size();
    // Sums of dx², dy², dx dy and score.
    let mut sums = vec![[0.0f64; 4]; components.stats.len()];
    for y in 0..height {
        for (x, (&label, &value)) in components.labels.row(y).iter().zip(score.row(y)).enumerate() {
            if label == 0 {
                continue;
            }
            let i = label as usize - 1;
            let center = components.stats[i].centroid;
            let (dx, dy) = (x as f64 - center.x, y as f64 - center.y);
            for (sum, term) in sums[i].iter_mut().zip([dx * dx, dy * dy, dx * dy, f64::from(value)]) {
                *sum += term;
            }
        }
    }
    let region = |(stats, sums): (&cv_imgproc::ComponentStats, &[f64; 4])| {
        let [xx, yy, xy, color] = sums.map(|sum| sum / stats.area as f64);
        // The variance of a unit square (a pixel) along each axis is 1/12.
        let (xx, yy) = (xx + 1.0 / 12.0, yy + 1.0 / 12.0);
        // The eigenvalues of the covariance are mean ± radius.
        let (mean, radius) = (0.5 * (xx + yy), (0.5 * (xx - yy)).hypot(xy));
        let region = Region {
            left: stats.left,
            top: stats.top,
            width: stats.width,
            height: stats.height,
            center: stats.centroid,
            area: stats.area,
            // A filled ellipse's semi-axis is twice the standard deviation along it; the minor one is at least that of
            // a pixel.
            axes: [mean + radius, (mean - radius).max(1.0 / 12.0)].map(|variance| 2.0 * variance.sqrt()),
            angle: 0.5 * (2.0 * xy).atan2(xx - yy),
            truncated: stats.left == 0
                || stats.top == 0
                || stats.left + stats.width == width
                || stats.top + stats.height == height,
        };
        (region, color)
    };
    components.stats.iter().zip(&sums).map(region).collect()
}

/// Computes the survival function of the chi-squared distribution with `FREEDOM` (1 or 3) degrees of freedom at `x ≥
/// 0`: 1 minus the series of the regularized lower incomplete gamma function.
fn chi_squared_survival<const FREEDOM: usize>(x: f64) -> f64 {
    let (a, z) = (0.5 * FREEDOM as f64, 0.5 * x);
    // The result is below 1e-15, the rounding error of the difference.
    if z.is_nan() || z > 40.0 {
        return 0.0;
    }
    // 1 / Γ(a + 1), of Γ(3/2) = √π / 2, then Γ(5/2) = 3/2 Γ(3/2).
    let mut term = FRAC_2_SQRT_PI / if FREEDOM == 3 { 1.5 } else { 1.0 };
    let mut sum = term;
    let mut n = a;
    // Terms grow until n exceeds z, then decrease faster than geometrically: 200 suffice for z = 40.
    for _ in 0..200 {
        n += 1.0;
        term *= z / n;
        sum += term;
    }
    (1.0 - z.powf(a) * (-z).exp() * sum).clamp(0.0, 1.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::GrayF32;

    /// The only region of a mask, with a score of 3 everywhere.
    fn only(width: usize, height: usize, inside: impl Fn(f64, f64) -> bool) -> (Region, f64) {
        let mask = Mask::from_fn(width, height, |x, y| [inside(x as f64, y as f64)]);
        let score = GrayF32::new(width, height, [3.0]);
        let measured = measure(&connected_components(mask.view(), Connectivity::Eight), score.view());
        assert_eq!(measured.len(), 1);
        measured[0]
    }

    #[test]
    fn axes_angle_and_centroid_of_an_ellipse_are_measured() {
        let (a, b) = (30.0, 12.0);
        for degrees in [0.0f64, 20.0, 45.0, 80.0, -30.0, -70.0] {
            let (sin, cos) = degrees.to_radians().sin_cos();
            let (region, color) = only(100, 90, |x, y| {
                let (dx, dy) = (x - 50.3, y - 44.6);
                ((dx * cos + dy * sin) / a).powi(2) + ((dy * cos - dx * sin) / b).powi(2) <= 1.0
            });
            // Discretization of the border's about 140 pixels: an error of a hundredth of the area, and less of the
            // axes.
            assert!((region.axes[0] - a).abs() < 0.2 && (region.axes[1] - b).abs() < 0.2, "{degrees}: {region:?}");
            assert!((region.angle - degrees.to_radians()).abs() < 0.01, "{degrees}: {region:?}");
            assert!((region.center - Point2::new(50.3, 44.6)).norm() < 0.1, "{degrees}: {region:?}");
            assert!((region.extent() - 1.0).abs() < 0.01 && !region.truncated);
            assert!((region.area as f64 - PI * a * b).abs() < 0.01 * PI * a * b);
            assert_eq!(color, 3.0);
        }
    }

    #[test]
    fn moments_of_a_rectangle_equal_the_closed_form() {
        let (region, _) = only(40, 20, |x, y| (10.0..30.0).contains(&x) && (5.0..13.0).contains(&y));
        assert_eq!((region.left, region.top, region.width, region.height, region.area), (10, 5, 20, 8, 160));
        assert_eq!(region.center, Point2::new(19.5, 8.5));
        // A side of s has the variance s² / 12.
        for (axis, side) in region.axes.into_iter().zip([20.0f64, 8.0]) {
            assert!((axis - side / 3.0f64.sqrt()).abs() < 1e-9);
        }
        assert!((region.extent() - 3.0 / PI).abs() < 1e-12 && (region.axis_ratio() - 0.4).abs() < 1e-12);
        let (pixel, _) = only(9, 1, |x, _| x == 4.0);
        assert!(pixel.truncated && pixel.axis_ratio() == 1.0);
    }

    #[test]
    fn chi_squared_survival_agrees_with_tables() {
        for (x, p) in [(7.815, 0.05), (11.345, 0.01), (16.266, 0.001)] {
            // Tables give three decimals of the quantile.
            assert!((chi_squared_survival::<3>(x) / p - 1.0).abs() < 1e-3, "{x}");
        }
        for (x, p) in [(3.841, 0.05), (6.635, 0.01), (10.828, 0.001)] {
            assert!((chi_squared_survival::<1>(x) / p - 1.0).abs() < 1e-3, "{x}");
        }
        assert_eq!((chi_squared_survival::<3>(0.0), chi_squared_survival::<1>(1e300)), (1.0, 0.0));
        assert!(chi_squared_survival::<3>(79.9) < 1e-13);
    }

    #[test]
    fn scores_separate_discs_from_bars() {
        let disc = |r: f64| move |x: f64, y: f64| (x - 50.0).hypot(y - 50.0) <= r;
        let bar = |l: f64| move |x: f64, y: f64| (x - 50.0).abs() <= l && (y - 50.0).abs() <= l / 5.0;
        let learned = |shapes: [(Region, f64); 3]| {
            let mut features = ObjectFeatures::default();
            for (region, color) in shapes {
                features.color.push(color);
                features.extent.push(region.extent());
                features.axis_ratio.push(region.axis_ratio());
            }
            features.statistics().unwrap()
        };
        let discs = learned([10.0, 15.0, 20.0].map(|r| only(101, 101, disc(r))));
        let bars = learned([20.0, 25.0, 30.0].map(|l| only(101, 101, bar(l))));
        let ((disc, color), (bar, _)) = (only(101, 101, disc(12.0)), only(101, 101, bar(28.0)));
        assert!(discs.score(&disc, color) > 0.9 && discs.score(&bar, color) < MIN_SCORE);
        assert!(bars.score(&bar, color) > 0.9 && bars.score(&disc, color) < MIN_SCORE);
        // A color score five nats below the mean is rejected; one above the mean is not penalized.
        assert!(discs.score(&disc, color - 5.0) < MIN_SCORE && discs.score(&disc, color + 5.0) > 0.9);
        // The shape of a truncated region is not used.
        assert!(discs.score(&Region { truncated: true, ..bar }, color) > 0.9);
        assert!(ObjectFeatures::default().statistics().is_none());
    }
}
