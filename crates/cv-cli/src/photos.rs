//! A pair of photographs at the bit depth of their files.

use crate::frame::Failure;
use cv_io::DynImage;
use std::path::Path;

/// A left and a right photograph.
pub(crate) struct Photos {
    pub(crate) left: DynImage,
    pub(crate) right: DynImage,
}

impl Photos {
    pub(crate) fn read(left: &Path, right: &Path) -> Result<Self, Failure> {
        Ok(Self { left: cv_io::read_image(left)?, right: cv_io::read_image(right)? })
    }

    /// Width and height of each.
    pub(crate) fn sizes(&self) -> [(usize, usize); 2] {
        [self.left.size(), self.right.size()]
    }
}

/// Evaluates an expression with views of both photographs at their bit depth; as 8-bit RGB if their formats differ or are linear floats.
macro_rules! at_own_depth {
    ($photos:expr, |$a:ident, $b:ident| $work:expr) => {
        match (&$photos.left.pixels, &$photos.right.pixels) {
            (cv_io::Pixels::Gray8(left), cv_io::Pixels::Gray8(right)) => at_own_depth!(left, right, $a, $b, $work),
            (cv_io::Pixels::Gray16(left), cv_io::Pixels::Gray16(right)) => at_own_depth!(left, right, $a, $b, $work),
            (cv_io::Pixels::Rgb8(left), cv_io::Pixels::Rgb8(right)) => at_own_depth!(left, right, $a, $b, $work),
            (cv_io::Pixels::Rgb16(left), cv_io::Pixels::Rgb16(right)) => at_own_depth!(left, right, $a, $b, $work),
            _ => {
                let (left, right) = ($photos.left.clone().into_rgb8(), $photos.right.clone().into_rgb8());
                at_own_depth!(left, right, $a, $b, $work)
            }
        }
    };
    ($left:ident, $right:ident, $a:ident, $b:ident, $work:expr) => {{
        let ($a, $b) = ($left.view(), $right.view());
        $work
    }};
}
pub(crate) use at_own_depth;
