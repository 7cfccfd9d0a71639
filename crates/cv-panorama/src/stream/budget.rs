//! Memory of streamed compositing, estimated before the work.

use super::StreamError;
use super::blend::Tiling;
use crate::bit_depth::PhotoSample;
use crate::blend::BlendMode;
use crate::render::CompositingOptions;
use crate::seams::{self, Seams};
use crate::surface::{Bounds, Layout, Placement};

/// Bytes that are not counted: the program, and what the allocator keeps.
const BASE_BYTES: usize = 192 << 20;
/// Bytes of the registration per photograph: features, matches, and what the allocator keeps of them. (A hundred photographs of 12 Mpx took 5 MiB each at most.)
const REGISTERED_BYTES: usize = 5 << 20;

/// Returns the name of what needs the whole canvas in memory, and the bytes per canvas pixel, measured with photographs of 8 bits that overlap by a third.
pub(super) fn needs_whole(options: &CompositingOptions) -> Option<(&'static str, usize)> {
    match options.blend {
        _ if options.radiance => Some(("radiance", 65)),
        BlendMode::Poisson => Some(("poisson blending", 30)),
        BlendMode::Multiband | BlendMode::Feather | BlendMode::None => None,
    }
}

/// Shares of the memory, in bytes.
pub(super) struct Budget {
    /// For each phase: grays in memory, windows of seams, or a tile.
    pub(super) work: usize,
    /// Photographs that are loaded at a time.
    pub(super) loads: usize,
}

impl Budget {
    pub(super) fn new<T: PhotoSample>(
        layout: &Layout,
        regions: &[Bounds],
        options: &CompositingOptions,
        levels: usize,
        allowed: usize,
    ) -> Result<Self, StreamError> {
        let (width, height) = (layout.width, layout.height);
        let samples = size_of::<T>();
        let pixels = |p: &Placement| p.view.camera.width * p.view.camera.height;
        if let Some((what, per_pixel)) = needs_whole(options) {
            let photos: usize = layout.placements.iter().map(|p| 3 * samples * pixels(p)).sum();
            let needed = BASE_BYTES + photos + width * height * samples * per_pixel;
            if needed > allowed {
                return Err(StreamError::Whole { what, width, height, needed, allowed });
            }
            return Ok(Self { work: allowed, loads: 1 });
        }
        let photo = layout.placements.iter().map(pixels).max().unwrap_or(0);
        let region = regions.iter().map(|b| b.width() * b.height()).max().unwrap_or(0);
        // Kept throughout: the coarse levels of the pyramid, the labels of the blocks of the seams, twice, and their band.
        let kept = BASE_BYTES + layout.placements.len() * REGISTERED_BYTES + width * height * 2 / 5;
        // The file, the decoder's output and the copy of 8 bits; the warped photograph, and its pyramid while it is added.
        let load = photo * (4 * samples + 1);
        let one = load + region * 4 * samples;
        let pyramid = region * (4 * samples + 2 + 8);
        let tile = Tiling::fewest_bytes::<T>(options.blend, levels, width);
        let window = if options.seams == Seams::GraphCut { seams::window_memory::<T>(region) } else { 0 };
        let needed = kept + one.max(pyramid).max(tile).max(window);
        if needed > allowed {
            return Err(StreamError::Memory { width, height, needed, allowed });
        }
        let work = allowed - kept;
        Ok(Self { work, loads: (work / 2 / load.max(1)).clamp(1, rayon::current_num_threads()) })
    }
}
