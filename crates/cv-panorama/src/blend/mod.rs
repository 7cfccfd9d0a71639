//! Blending of warped, exposure-compensated photographs along the seams.
//!
//! A blend mode is one file of this module with a [`Blender`], a variant of [`BlendMode`] with its name, and an arm of `of_mode`. A blender of another crate is
//! passed to [`render_with`](crate::render_with).

mod composite_grid;
mod feather;
mod grid_edges;
mod hard_seams;
mod multiband;
mod poisson;
mod runs;

pub(crate) use feather::MARGIN as FEATHER_MARGIN;
pub(crate) use multiband::{CoarseCanvas, CoarseLevels, coarse_margin};

use crate::bit_depth::{Channel, PhotoSample};
use crate::surface::WarpedPhoto;
use cv_core::{Cancelled, Image, Progress, named};

/// The label of canvas pixels that no photograph covers.
pub const NO_PHOTO: u16 = u16::MAX;

/// Warped photographs and a label image that selects one of them per pixel.
#[derive(Debug, Clone, Copy)]
pub struct Composition<'a, T = u8> {
    /// The photographs after exposure compensation; `None` for those without a label. Each extends beyond the pixels of its label by the margin of
    /// [`Blender::pyramid_levels`].
    pub photos: &'a [Option<WarpedPhoto<T>>],
    /// Index into `photos` per canvas pixel, [`NO_PHOTO`] where none covers it. A photograph covers every pixel of its label.
    pub labels: &'a Image<u16, 1>,
    /// Median over the photographs of the square root of their area on the canvas, in pixels.
    pub typical_side: f64,
}

/// Blends photographs along the seams between their labels. Implement it for `u8` and `u16` to support both bit depths.
pub trait Blender<T: Channel = u8>: Sync {
    /// Returns the margin by which photographs are warped beyond the pixels of their labels, as the number of pyramid levels above the base: the bounding
    /// box of a label is grown by `2 · 2^levels` pixels and rounded out to multiples of `2^levels` (clipped to the canvas). Outside a photograph its border
    /// pixels are replicated with opacity 0. Default 4: 32 pixels.
    fn pyramid_levels(&self, typical_side: f64) -> usize {
        let _ = typical_side;
        4
    }

    /// Returns the blended image, of the size of the labels; black where they are [`NO_PHOTO`]. Reports as the stage "blend", a few hundred times.
    ///
    /// # Errors
    /// [`Cancelled`] where `progress` says so.
    fn blend(&self, composition: &Composition<'_, T>, progress: &dyn Progress) -> Result<Image<T, 3>, Cancelled>;
}

/// Blending algorithm.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum BlendMode {
    /// Multi-band blending: each frequency band over a transition of its own wavelength (Burt & Adelson 1983).
    #[default]
    Multiband,
    /// Gradient-domain blending (Pérez et al. 2003) with Neumann boundary conditions: differences at the seams are spread over the whole image.
    Poisson,
    /// Feathering: a linear transition of 16 pixels.
    Feather,
    /// None: hard seams.
    None,
}

named!(BlendMode { Multiband = "multiband", Poisson = "poisson", Feather = "feather", None = "none" });

impl BlendMode {
    /// Returns the implementation.
    pub fn blender<T: PhotoSample>(self) -> &'static dyn Blender<T> {
        T::blender(self)
    }
}

/// Returns the implementation, generic over the sample type.
pub(crate) fn of_mode<T: Channel>(mode: BlendMode) -> &'static dyn Blender<T> {
    match mode {
        BlendMode::Multiband => &multiband::Multiband,
        BlendMode::Poisson => &poisson::Poisson,
        BlendMode::Feather => &feather::Feather,
        BlendMode::None => &hard_seams::HardSeams,
    }
}
