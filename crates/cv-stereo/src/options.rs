//! What a caller can choose.

use crate::StereoError;
use crate::coarse_prior::PRIOR_CAP;
use cv_core::OptionError;

/// The neighborhood a pixel is described by: one bit per neighbor, set where it is darker than the center.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Census {
    /// 5×5, 24 bits: finest detail, least support in weak texture.
    Window5x5,
    /// 7×7, 48 bits.
    Window7x7,
    /// 9×7, 62 bits: steadiest under noise, rounds off thin structures.
    Window9x7,
}

cv_core::named!(Census { Window5x5 = "5": "5×5", Window7x7 = "7": "7×7", Window9x7 = "9": "9×7" });

impl Census {
    /// Width and height of the window.
    pub fn size(self) -> (usize, usize) {
        match self {
            Self::Window5x5 => (5, 5),
            Self::Window7x7 => (7, 7),
            Self::Window9x7 => (9, 7),
        }
    }

    /// Number of neighbors compared.
    pub fn bits(self) -> usize {
        let (w, h) = self.size();
        w * h - 1
    }
}

/// What is added to the number of census bits in which two pixels differ, from the two pixels alone: sharper at the
/// outlines of things than a window, but not indifferent to exposure.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum IntensityCost {
    /// Nothing.
    None,
    /// The absolute difference of their gray values (AD-Census; Mei et al., ICCV workshops 2011).
    Gray {
        /// Gray levels (of 255) that count as one bit; 1 or more.
        per_bit: u8,
        /// The most that is added.
        cap: u8,
    },
    /// The absolute difference of their horizontal gradients, which a change of exposure only scales.
    Gradient {
        /// Gray levels per pixel (of 255) that count as one bit; 1 or more.
        per_bit: u8,
        /// The most that is added.
        cap: u8,
    },
}

// Of the weights tried on rendered scenes and photographs, those that gave the fewest errors.
cv_core::named!(IntensityCost {
    None = "none",
    Gray { per_bit: 2, cap: 8 } = "gray" | "grey": "the absolute difference of gray values",
    Gradient { per_bit: 1, cap: 6 } = "gradient": "that of horizontal gradients",
});

impl IntensityCost {
    /// The most that is added.
    pub fn cap(self) -> u8 {
        match self {
            Self::None => 0,
            Self::Gray { cap, .. } | Self::Gradient { cap, .. } => cap,
        }
    }
}

/// Along how many directions costs are aggregated.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Paths {
    /// Horizontal and vertical, both ways: half the sums, 0.85 of the time, slightly streaky on slanted surfaces.
    Four,
    /// And both diagonals, both ways.
    Eight,
}

cv_core::named!(Paths { Four = "4": "0.85 of the time, slightly streaky on slanted surfaces", Eight = "8" });

/// How the disparity is placed between whole pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Subpixel {
    /// Whole pixels.
    None,
    /// Two lines of equal slope through the aggregated costs around the minimum (equiangular fit).
    VFit,
    /// The same, corrected for the shape that aggregated census costs have: they rise less than in proportion to the
    /// distance, so that the plain fit draws disparities to whole pixels. The correction was measured on rendered
    /// slanted planes, over which the fractions come out even.
    CorrectedVFit,
}

/// How disparities are smoothed along surfaces, with the left photograph as the guide.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(rename_all = "kebab-case"))]
pub enum Smoothing {
    /// Not at all.
    None,
    /// Outlines move to the edges of the photograph, and pixels of a surface are averaged over 9×9 px.
    Bilateral {
        /// Gray levels (of 255) between pixels at which they have no more to say to each other; positive. Default 24: on
        /// sixteen generated scenes of four kinds (rooms, tables, balls, posters; seeds 100 to 103, both cameras with noise,
        /// half at one stop less) 16 to 32 leave 1.64 % of errors above 1 px, 8 leaves 1.71 and 56 leaves 1.66.
        sigma: f32,
    },
    /// Weighted least squares (Min et al., TIP 2014), as in OpenCV's `DisparityWLSFilter`: reaches farther, takes longer.
    LeastSquares {
        /// How smooth; positive. OpenCV's default is 8000.
        lambda: f32,
        /// Gray levels (of 255) between neighbors at which smoothing has fallen to 1/e; positive. OpenCV's default is
        /// 1.5.
        sigma: f32,
    },
}

cv_core::named!(Smoothing {
    None = "none",
    Bilateral { sigma: 24.0 } = "bilateral": "outlines at the edges of the photograph",
    LeastSquares { lambda: 100.0, sigma: 1.5 } = "wls": "weighted least squares: reaches farther, takes longer",
});

/// Options of [`crate::StereoMatcher`]. Costs count census bits.
#[derive(Debug, Clone, PartialEq)]
#[cfg_attr(feature = "serde", derive(serde::Serialize, serde::Deserialize))]
#[cfg_attr(feature = "serde", serde(default))]
pub struct StereoOptions {
    /// Smallest disparity in px; may be negative. Default 0 (points at infinity of a rectified pair).
    pub min_disparity: i32,
    /// Number of whole disparities tried, from `min_disparity` up; 1 to 4096, any number. Default 128.
    pub disparities: usize,
    /// Matching window. Default 5×5.
    pub census: Census,
    /// What is added to the differing bits. Default nothing.
    pub intensity_cost: IntensityCost,
    /// Penalty for a disparity step of one pixel between neighbors. Default 4 (Pandora's default for census 5×5).
    pub p1: u8,
    /// Penalty for a larger step where the image is smooth. Default 24, where Pandora has 20: on roads more is a little better (9.1 % of the pixels
    /// wrong by more than 2 px with 20, 8.7 with 24), on generated rooms less; indoors 20 to 40 differ by 0.3 points.
    pub p2: u8,
    /// What `p2` falls to across a strong edge of the image. Default 4: that and
    /// `p2_gradient` left the fewest errors of twelve settings on generated scenes (rooms, tables, a ball and a poster wall, seeds
    /// 300 to 305, half of them at one stop less).
    pub p2_min: u8,
    /// Gray levels (of 255) between neighbors at which `p2` has fallen half way to `p2_min`; 0 keeps `p2` everywhere.
    /// Default 8.
    pub p2_gradient: u8,
    /// Levels of half the size each that guide pixels in flat surroundings; 0 for none. Default 2. Together they take a quarter of the
    /// time, more where there are 64 disparities and fewer, and none where hardly anything is flat.
    pub pyramid_levels: u8,
    /// Directions of aggregation. Default eight.
    pub paths: Paths,
    /// A winner must be at least this many percent cheaper than any disparity not next to it; 0 to 99, 0 accepts all.
    /// Default 0: the left-right check finds the same errors and loses fewer good pixels.
    pub uniqueness: u8,
    /// Largest difference in px between the disparities seen from left and from right; `None` skips the check.
    /// Default 1 (OpenCV's `disp12MaxDiff` in its samples).
    pub left_right: Option<u16>,
    /// Connected patches of up to this many pixels are removed; 0 removes none. Default 100 (OpenCV's samples).
    pub speckle_size: usize,
    /// Neighbors that differ by no more than this many px belong to one patch. Default 2.
    pub speckle_range: f32,
    /// Sub-pixel placement. Default [`Subpixel::CorrectedVFit`].
    pub subpixel: Subpixel,
    /// Radius in px of the median filter; 0 for none, 1 or 2. Default 1 (3×3).
    pub median: usize,
    /// Edge-preserving smoothing, last of all. Default [`Smoothing::Bilateral`] of 24 gray levels: on rendered scenes and
    /// on photographs, errors above 1 px fall by a tenth.
    pub smoothing: Smoothing,
    /// Whether rejected pixels get a disparity from their surroundings (background side where occluded, the plane of
    /// what is around a large hole where that lies on one). They are told apart by [`crate::PixelState`]. Default true.
    pub fill: bool,
    /// Quality mode: the map is improved by local expansion moves over slanted planes (Taniai et al., PAMI 2018), which takes about fifty times as long (8 to 14 µs of
    /// one core a pixel) and leaves two thirds of the errors above 2 px (Middlebury 2014, quarter size), on roads half. Default false.
    pub quality: bool,
    /// Whether [`crate::StereoMatcher::confidence`] is wanted: finding the second best match takes a tenth of the time.
    /// Default false.
    pub confidence: bool,
    /// Most bytes the matcher may hold; `None` sets no limit. Where the whole image does not fit, costs are aggregated in
    /// strips of rows that overlap by 32: at most 0.1 % of the pixels then differ by more than half a pixel from what
    /// they are without the limit. Default `None`. See [`crate::StereoMatcher::memory`].
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
            paths: Paths::Eight,
            uniqueness: 0,
            left_right: Some(1),
            speckle_size: 100,
            speckle_range: 2.0,
            subpixel: Subpixel::CorrectedVFit,
            median: 1,
            smoothing: Smoothing::Bilateral { sigma: 24.0 },
            fill: true,
            quality: false,
            confidence: false,
            max_memory: None,
        }
    }
}

/// More disparities than any rectified pair of photographs shows; keeps indices in 16 bits with room to spare.
pub(crate) const MAX_DISPARITIES: usize = 4096;

impl StereoOptions {
    /// These penalties, with what `p2` falls to at edges brought between them.
    pub fn with_penalties(self, p1: u8, p2: u8) -> Self {
        Self { p1, p2, p2_min: self.p2_min.clamp(p1, p2.max(p1)), ..self }
    }

    /// Checks the options by themselves, without an image.
    ///
    /// # Errors
    /// [`StereoError::Range`] or [`StereoError::Option`] with the first value that is out of range.
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
