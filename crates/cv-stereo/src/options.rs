//! Options of the stereo matcher.

use crate::StereoError;
use crate::coarse_prior::PRIOR_CAP;
use cv_core::OptionError;

/// The census window: one bit per neighbor, set if it is darker than the center.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Census {
    /// 5×5, 24 bits: finest detail, least support in low texture.
    Window5x5,
    /// 7×7, 48 bits.
    Window7x7,
    /// 9×7, 62 bits: most robust to noise, loses thin structures.
    Window9x7,
}

cv_core::named!(Census { Window5x5 = "5": "5×5", Window7x7 = "7": "7×7", Window9x7 = "9": "9×7" });

impl Census {
    /// Returns the width and height of the window.
    pub fn size(self) -> (usize, usize) {
        match self {
            Self::Window5x5 => (5, 5),
            Self::Window7x7 => (7, 7),
            Self::Window9x7 => (9, 7),
        }
    }

    /// Returns the number of neighbors compared.
    pub fn bits(self) -> usize {
        let (w, h) = self.size();
        w * h - 1
    }
}

/// A cost of the two pixels alone, added to the Hamming distance of their census bits: sharper at depth discontinuities than a window, but
/// not invariant to exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum IntensityCost {
    /// Nothing.
    None,
    /// The absolute difference of their gray levels (AD-Census; Mei et al., ICCV workshops 2011).
    Gray {
        /// Gray levels (of 255) that cost one bit; 1 or more.
        per_bit: u8,
        /// Maximum of the cost, in bits.
        cap: u8,
    },
    /// The absolute difference of their horizontal gradients, which are invariant to an intensity offset.
    Gradient {
        /// Gray levels per pixel (of 255) that cost one bit; 1 or more.
        per_bit: u8,
        /// Maximum of the cost, in bits.
        cap: u8,
    },
}

// The weights with the fewest errors on rendered scenes and public pairs.
cv_core::named!(IntensityCost {
    None = "none",
    Gray { per_bit: 2, cap: 8 } = "gray" | "grey": "the absolute difference of gray levels",
    Gradient { per_bit: 1, cap: 6 } = "gradient": "that of horizontal gradients",
});

impl IntensityCost {
    /// Returns the maximum of the cost, in bits.
    pub fn cap(self) -> u8 {
        match self {
            Self::None => 0,
            Self::Gray { cap, .. } | Self::Gradient { cap, .. } => cap,
        }
    }
}

/// Number of aggregation paths.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Paths {
    /// Horizontal and vertical, both ways: half the sums, 0.85 of the time, slight streaks on slanted surfaces.
    Four,
    /// Also both diagonals, both ways.
    Eight,
}

cv_core::named!(Paths { Four = "4": "0.85 of the time, slight streaks on slanted surfaces", Eight = "8" });

/// Which disparities of the range each pixel is compared at.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Search {
    /// Hierarchical from 2²⁸ pixels times disparities on, if the memory limit allows; full otherwise.
    Auto,
    /// The whole range.
    Full,
    /// A window of 32 disparities around those of half resolution (tSGM; Rothermel et al., "SURE", 2012), at every pyramid level but the
    /// smallest: time and memory hardly depend on the number of disparities. The range must include the disparities of the nearest
    /// objects: errors of coarser levels are not corrected by the next. There are four [`Paths`], and no strips under a memory limit.
    Hierarchical,
}

cv_core::named!(Search {
    Auto = "auto": "hierarchical for large images and ranges, full otherwise",
    Full = "full": "the whole range",
    Hierarchical = "hierarchical": "a window of 32 disparities around those of half resolution",
});

/// Sub-pixel refinement of the disparity.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Subpixel {
    /// Whole pixels.
    None,
    /// Equiangular fit: two lines of equal slope through the aggregated costs around the minimum.
    VFit,
    /// The equiangular fit corrected for pixel locking: aggregated census costs rise less than in proportion to the distance, which biases
    /// the plain fit to whole pixels. The correction was measured on rendered slanted planes, where the fractions become uniform.
    CorrectedVFit,
}

/// Edge-preserving smoothing of the disparities, guided by the left image.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Smoothing {
    /// No smoothing.
    None,
    /// Depth discontinuities move to image edges, and each surface is averaged over 9×9 px.
    Bilateral {
        /// Difference in gray levels (of 255) at which the weight of a pixel becomes 0; positive. Default 24: on sixteen generated scenes
        /// of four kinds (rooms, tables, balls, posters; seeds 100 to 103, both cameras with noise, half at one stop less) 16 to 32
        /// leave 1.64 % of errors above 1 px, 8 leaves 1.71 and 56 leaves 1.66.
        sigma: f32,
    },
    /// Weighted least squares (Min et al., TIP 2014), as in OpenCV's `DisparityWLSFilter`: larger support, slower.
    LeastSquares {
        /// Weight of the smoothness term; positive. OpenCV's default is 8000.
        lambda: f32,
        /// Difference in gray levels (of 255) of neighbors at which smoothing has decreased to 1/e; positive. OpenCV's default is 1.5.
        sigma: f32,
    },
}

cv_core::named!(Smoothing {
    None = "none",
    Bilateral { sigma: 24.0 } = "bilateral": "depth discontinuities at image edges",
    LeastSquares { lambda: 100.0, sigma: 1.5 } = "wls": "weighted least squares: larger support, slower",
});

/// Options of [`crate::StereoMatcher`]. The unit of costs is a census bit.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct StereoOptions {
    /// Smallest disparity in px; may be negative. Default 0 (points at infinity of a rectified pair).
    pub min_disparity: i32,
    /// Number of whole disparities of the search range, from `min_disparity` up; 1 to 4096. Default 128.
    pub disparities: usize,
    /// Census window. Default 5×5.
    pub census: Census,
    /// Cost added to the Hamming distance. Default none.
    pub intensity_cost: IntensityCost,
    /// Penalty for a disparity step of 1 px between neighbors. Default 4 (Pandora's for census 5×5).
    pub p1: u8,
    /// Penalty for a larger step where the image has no edge. Default 24 (Pandora: 20): on roads 9.1 % of the errors are above 2 px with 20,
    /// 8.7 % with 24; generated rooms prefer less; indoors 20 to 40 differ by 0.3 points.
    pub p2: u8,
    /// Minimum of `p2`, at strong image edges. Default 4: with `p2_gradient` 8 the fewest errors of twelve settings on generated scenes
    /// (rooms, tables, a ball and a poster wall, seeds 300 to 305, half of them at one stop less).
    pub p2_min: u8,
    /// Difference in gray levels (of 255) of neighbors at which `p2` has decreased half way to `p2_min`; 0 keeps `p2` everywhere.
    /// Default 8.
    pub p2_gradient: u8,
    /// Coarser pyramid levels, which give priors to pixels of low texture; 0 for none. Default 2. They take a quarter of the time, more for
    /// 64 and fewer disparities, and none in images without low texture.
    pub pyramid_levels: u8,
    /// Disparities that each pixel is compared at. Default [`Search::Auto`].
    pub search: Search,
    /// Aggregation paths. Default eight.
    pub paths: Paths,
    /// Uniqueness ratio: percent by which a winner must be cheaper than any disparity not next to it; 0 to 99, 0 accepts all. Default 0: the
    /// left-right check finds the same errors and rejects fewer correct pixels.
    pub uniqueness: u8,
    /// Left-right consistency: maximum difference in px of the disparities of both views; `None` skips the check. Default 1 (OpenCV's
    /// `disp12MaxDiff` in its samples).
    pub left_right: Option<u16>,
    /// Speckle filter: connected components of up to this many pixels are removed; 0 removes none. Default 100 (OpenCV's samples).
    pub speckle_size: usize,
    /// Maximum difference in px of neighbors in a component of the speckle filter. Default 2.
    pub speckle_range: f32,
    /// Sub-pixel refinement. Default [`Subpixel::CorrectedVFit`].
    pub subpixel: Subpixel,
    /// Radius in px of the median filter; 0 for none, 1 or 2. Default 1 (3×3).
    pub median: usize,
    /// Edge-preserving smoothing, the last stage. Default [`Smoothing::Bilateral`] of 24 gray levels: a tenth fewer errors above 1 px on
    /// rendered scenes and public pairs.
    pub smoothing: Smoothing,
    /// Whether rejected pixels are filled from the surrounding surfaces, as [`crate::PixelState`] says by which cause. Default true.
    pub fill: bool,
    /// Whether the black borders of rectified images are left out: regions of exactly 0 in all channels in a corner of the image
    /// (0.5 % of it or more) or along 0.4 of a side (0.1 % or more), with a smooth outline. Their pixels are [`crate::PixelState::NoData`]. Default true. Masks
    /// ([`crate::StereoMatcher::set_masks`]) take precedence.
    pub ignore_black_borders: bool,
    /// Whether a noisy pair is smoothed before it is matched (a Gaussian of σ 0.75 px): if in both images the noise, independent from pixel to pixel, is a
    /// twentieth or more of the contrast, as at night. With a noise of 8 levels of 255, errors above 2 px of two rendered scenes fall to a sixth.
    /// Default true.
    pub denoise: bool,
    /// Quality mode: local expansion moves over slanted planes (Taniai et al., PAMI 2018) after semi-global matching. Takes about forty-five times
    /// as long and leaves four fifths of the errors above 2 px (Middlebury 2014, quarter size), on roads half. Default
    /// false.
    pub quality: bool,
    /// Whether the pairs are consecutive frames: noise is averaged over time where an image does not change, so that disparities of still
    /// cameras flicker half as much. Nothing is averaged where an object moved, while the camera moves, and over a cut
    /// ([`crate::StereoMatcher::forget_frame`] starts anew). Default false.
    pub sequence: bool,
    /// Whether [`crate::StereoMatcher::confidence`] is computed: the second best match takes a tenth of the time. Default false.
    pub confidence: bool,
    /// Maximum number of bytes of the matcher; `None` sets no limit. If the whole image does not fit, costs are aggregated in strips of rows: their
    /// paths downwards are those of the whole image, their paths upwards start 64 rows below. Of 21 pairs of Middlebury 0.03 % of the pixels
    /// then differ by more than half a pixel from the result without the limit, of the worst pair 0.6 %. Default `None`. See
    /// [`crate::StereoMatcher::memory`].
    pub max_memory: Option<usize>,
}

impl Default for StereoOptions {
    fn default() -> Self {
        Self {
            min_disparity: 0,
            disparities: 128,
            census: Census::Window5x5,
            intensity_cost: IntensityCost::None,
            p1: 4,
            p2: 24,
            p2_min: 4,
            p2_gradient: 8,
            pyramid_levels: 2,
            search: Search::Auto,
            paths: Paths::Eight,
            uniqueness: 0,
            left_right: Some(1),
            speckle_size: 100,
            speckle_range: 2.0,
            subpixel: Subpixel::CorrectedVFit,
            median: 1,
            smoothing: Smoothing::Bilateral { sigma: 24.0 },
            fill: true,
            ignore_black_borders: true,
            denoise: true,
            quality: false,
            sequence: false,
            confidence: false,
            max_memory: None,
        }
    }
}

/// Maximum number of disparities: more than any rectified pair needs, and indices fit 16 bits.
pub(crate) const MAX_DISPARITIES: usize = 4096;

impl StereoOptions {
    /// Sets the penalties, and clamps `p2_min` to their range.
    pub fn with_penalties(self, p1: u8, p2: u8) -> Self {
        Self { p1, p2, p2_min: self.p2_min.clamp(p1, p2.max(p1)), ..self }
    }

    /// Checks the ranges of the options.
    ///
    /// # Errors
    /// [`StereoError::Range`] or [`StereoError::Option`] with the first value out of range.
    pub fn validate(&self) -> Result<(), StereoError> {
        if self.disparities == 0 || self.disparities > MAX_DISPARITIES {
            return Err(StereoError::Range { disparities: self.disparities, max: MAX_DISPARITIES });
        }
        use OptionError as E;
        let positive = |v: f64| v > 0.0 && v.is_finite();
        E::check("p2_min", self.p2_min.into(), "at least p1", |_| self.p2_min >= self.p1)?;
        E::check("p2", self.p2.into(), "at least p2_min", |_| self.p2 >= self.p2_min)?;
        let room = (self.census.bits() + usize::from(self.intensity_cost.cap()) + usize::from(PRIOR_CAP)) as f64;
        let limit = "at most 251 less the bits of the census window and the cap of the intensity_cost";
        E::check("p2", self.p2.into(), limit, |v| v + room <= 254.0)?;
        if let IntensityCost::Gray { per_bit, .. } | IntensityCost::Gradient { per_bit, .. } = self.intensity_cost {
            E::check("per_bit", per_bit.into(), "1 or more", |v| v >= 1.0)?;
        }
        E::check("uniqueness", self.uniqueness.into(), "from 0 to 99", |v| v <= 99.0)?;
        E::check("speckle_range", self.speckle_range.into(), "a finite number, 0 or more", |v| {
            v >= 0.0 && v.is_finite()
        })?;
        if let Smoothing::Bilateral { sigma } | Smoothing::LeastSquares { sigma, .. } = self.smoothing {
            E::check("sigma", sigma.into(), "positive", positive)?;
        }
        if let Smoothing::LeastSquares { lambda, .. } = self.smoothing {
            E::check("lambda", lambda.into(), "positive", positive)?;
        }
        Ok(E::check("median", self.median as f64, "0, 1 or 2", |v| v <= 2.0)?)
    }
}
