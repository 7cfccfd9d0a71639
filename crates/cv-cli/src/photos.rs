//! Reading photographs: pairs at the bit depth of their files, and one while another is processed.

use crate::frame::Failure;
use cv_io::{DynImage, IoError};
use std::path::{Path, PathBuf};

/// Reads two files in parallel; of two errors, the first one's is returned.
pub(crate) fn read_both<'a, T: Send>(
    [first, second]: [&'a Path; 2],
    read: impl Fn(&'a Path) -> Result<T, IoError> + Sync,
) -> Result<[T; 2], IoError> {
    let (first, second) = rayon::join(|| read(first), || read(second));
    Ok([first?, second?])
}

/// Photographs that are processed one after the other: the next one is read meanwhile.
#[derive(Default)]
pub(crate) struct ReadAhead {
    next: Option<(PathBuf, Result<DynImage, IoError>)>,
}

impl ReadAhead {
    /// Returns a photograph: that which was read ahead, if it is the same.
    pub(crate) fn take(&mut self, path: &Path) -> Result<DynImage, IoError> {
        match self.next.take() {
            Some((ahead, image)) if ahead == path => image,
            _ => cv_io::read_image(path),
        }
    }

    /// Does `work` and reads the `next` photograph in parallel.
    pub(crate) fn during<T: Send>(&mut self, next: Option<&Path>, work: impl FnOnce() -> T + Send) -> T {
        let (done, next) = rayon::join(work, || next.map(|path| (path.to_owned(), cv_io::read_image(path))));
        self.next = next;
        done
    }
}

/// A left and a right photograph.
pub(crate) struct Photos {
    pub(crate) left: DynImage,
    pub(crate) right: DynImage,
}

impl Photos {
    pub(crate) fn read(left: &Path, right: &Path) -> Result<Self, Failure> {
        let [left, right] = read_both([left, right], cv_io::read_image)?;
        Ok(Self { left, right })
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
