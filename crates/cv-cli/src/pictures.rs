//! Pictures of reports: of the size that a screen shows, as small files.

use crate::frame::Failure;
use cv_core::{ImageView, RgbU8};
use cv_report::{Figure, MapStyle, PointScene, Report, Viewpoint, render_points, shrink_to_fit};

/// How much of the page a picture takes; its longer side in pixels is that of a screen of twice the density, or not much less.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Width {
    /// All of it.
    Full = 1600,
    /// A column: there is another picture beside it.
    Half = 1000,
}

/// A picture as JPEG, reduced to what the page shows of it.
pub(crate) fn picture(image: &RgbU8, width: Width, caption: &str) -> Result<Figure, Failure> {
    Ok(Figure::new(encoded(&shrink_to_fit(image.view(), width as usize))?, caption))
}

/// A map of numbers in colors, with its scale.
pub(crate) fn map(
    values: ImageView<'_, f32, 1>,
    style: &MapStyle,
    width: Width,
    caption: &str,
) -> Result<Figure, Failure> {
    let (colors, scale) = style.colored(values);
    Ok(picture(&colors, width, caption)?.scale(scale))
}

fn encoded(image: &RgbU8) -> Result<Vec<u8>, Failure> {
    Ok(cv_io::encode_jpeg(image.view(), 84)?)
}

/// A cloud that can be turned, and below it the cloud from above and from the side.
pub(crate) fn cloud(page: &mut Report, scene: &PointScene, caption: &str) -> Result<(), Failure> {
    turning(page, scene, caption)?;
    let still = |viewpoint, caption| Ok(Figure::new(encoded(&render_points(scene, viewpoint, 800, 600))?, caption));
    let views: Result<_, Failure> = [(Viewpoint::Top, "From above: a map."), (Viewpoint::Side, "From the side.")]
        .into_iter()
        .map(|(viewpoint, caption)| still(viewpoint, caption))
        .collect();
    page.figures(views?);
    Ok(())
}

/// What stands for a cloud where nothing can be turned: on paper, say.
pub(crate) fn still(scene: &PointScene) -> Result<Vec<u8>, Failure> {
    encoded(&render_points(scene, Viewpoint::Camera, 960, 600))
}

/// A cloud that can be turned.
pub(crate) fn turning(page: &mut Report, scene: &PointScene, caption: &str) -> Result<(), Failure> {
    let still = still(scene)?;
    let thinned = match scene.left_out() {
        0 => String::new(),
        n => format!(" {n} more points are not drawn."),
    };
    page.points(scene, Some(still), &format!("{caption}{thinned}"));
    Ok(())
}
