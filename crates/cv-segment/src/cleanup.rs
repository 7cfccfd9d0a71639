//! Morphological clean-up of masks.

use cv_core::{Cancelled, ImageView, Mask, Progress, Stage};
use cv_imgproc::{Connectivity, StructuringElement, close, connected_components, largest_component, open};
use serde::{Deserialize, Serialize};

/// Parameters of the clean-up of a mask: opening, closing, and selection of the largest connected component.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Cleanup {
    /// Radius in pixels of the disc (structuring element) of the opening, which removes narrower structures. 0 (no
    /// opening) to 1000; default 2, a 5×5 disc.
    pub open_radius: usize,
    /// Radius in pixels of the disc (structuring element) of the closing, which fills narrower gaps. 0 (no closing) to
    /// 1000; default 2.
    pub close_radius: usize,
    /// Keep only the largest connected component. Default false; training sets it where each mask has one region.
    pub largest: bool,
}

impl Default for Cleanup {
    fn default() -> Self {
        Self { open_radius: 2, close_radius: 2, largest: false }
    }
}

impl Cleanup {
    /// Opens, then closes a mask, then selects its largest 8-connected component if requested.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn apply(&self, mask: ImageView<'_, bool, 1>, progress: &dyn Progress) -> Result<Mask, Cancelled> {
        let stage = Stage::new(progress, "clean up", 3)?;
        let opened = if self.open_radius > 0 {
            open(mask, &StructuringElement::disc(self.open_radius))
        } else {
            mask.to_image()
        };
        stage.add(1)?;
        let closed = if self.close_radius > 0 {
            close(opened.view(), &StructuringElement::disc(self.close_radius))
        } else {
            opened
        };
        stage.add(1)?;
        Ok(if self.largest { largest_component(closed.view(), Connectivity::Eight) } else { closed })
    }
}

/// Computes the fraction of a mask's foreground pixels that lie in its largest connected component; 1 for an empty
/// mask.
pub(crate) fn largest_component_fraction(mask: ImageView<'_, bool, 1>) -> f64 {
    let areas: Vec<usize> = connected_components(mask, Connectivity::Eight).stats.iter().map(|s| s.area).collect();
    let largest = areas.iter().copied().max().unwrap_or(0);
    let total: usize = areas.iter().sum();
    if total == 0 { 1.0 } else { largest as f64 / total as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::Silent;

    #[test]
    fn opening_removes_specks_closing_fills_holes_and_the_largest_component_is_selected() {
        // A disc of radius 8 with a hole of one pixel, a disc of radius 5, and a speck.
        let disc = |x: usize, y: usize, cx: f64, cy: f64, r: f64| (x as f64 - cx).hypot(y as f64 - cy) <= r;
        let mask = Mask::from_fn(60, 30, |x, y| {
            [(disc(x, y, 15.0, 15.0, 8.0) && (x, y) != (15, 15)) || disc(x, y, 45.0, 15.0, 5.0) || (x, y) == (30, 3)]
        });
        // Opening first would widen the hole.
        let cleaned = Cleanup { open_radius: 0, ..Default::default() }.apply(mask.view(), &Silent).unwrap();
        assert!(cleaned.at(15, 15)[0] && cleaned.at(45, 15)[0] && cleaned.at(30, 3)[0]);
        let cleaned = Cleanup { largest: true, ..Default::default() }.apply(mask.view(), &Silent).unwrap();
        assert!(cleaned.at(15, 12)[0] && !cleaned.at(45, 15)[0] && !cleaned.at(30, 3)[0]);
        let none = Cleanup { open_radius: 0, close_radius: 0, largest: false };
        assert_eq!(none.apply(mask.view(), &Silent).unwrap(), mask);
        // The first disc has about 316 of 398 pixels.
        let fraction = largest_component_fraction(mask.view());
        assert!(fraction > 0.6 && fraction < 0.8);
        assert_eq!(largest_component_fraction(Mask::new(3, 3, [false]).view()), 1.0);
    }

    #[test]
    fn empty_and_full_masks_of_degenerate_sizes_are_unchanged() {
        for size in [(0, 0), (1, 1), (0, 9)] {
            let mask = Mask::new(size.0, size.1, [true]);
            assert_eq!(Cleanup { largest: true, ..Default::default() }.apply(mask.view(), &Silent).unwrap(), mask);
        }
    }
}
