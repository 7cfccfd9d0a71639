//! Images of reports, downscaled to screen size and compressed.

use crate::frame::Failure;
use cv_core::{ImageView, RgbU8};
use cv_report::{Figure, MapStyle, PointScene, Report, Viewpoint, render_points, shrink_to_fit};

/// The width of an image on the page; the value is its longer side in pixels, about that of a high-density screen.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Width {
    /// The full width of the page.
    Full = 1600,
    /// A column of two.
    Half = 1000,
}

/// Encodes an image as JPEG, downscaled to the width on the page.
pub(crate) fn picture(image: &RgbU8, width: Width, caption: &str) -> Result<Figure, Failure> {
    Ok(Figure::new(encoded(&shrink_to_fit(image.view(), width as usize))?, caption))
}

/// Renders a color-mapped array of floats with its scale.
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

/// Adds an interactive cloud, and below it views from above and from the side.
pub(crate) fn cloud(page: &mut Report, scene: &PointScene, caption: &str) -> Result<(), Failure> {
    interactive_cloud(page, scene, caption)?;
    let still = |viewpoint, caption| Ok(Figure::new(encoded(&render_points(scene, viewpoint, 800, 600))?, caption));
    let views: Result<_, Failure> = [(Viewpoint::Top, "From above: a map."), (Viewpoint::Side, "From the side.")]
        .into_iter()
        .map(|(viewpoint, caption)| still(viewpoint, caption))
        .collect();
    page.figures(views?);
    Ok(())
}

/// Renders a still image of a cloud, for print.
pub(crate) fn still(scene: &PointScene) -> Result<Vec<u8>, Failure> {
    encoded(&render_points(scene, Viewpoint::Camera, 960, 600))
}

/// Adds an interactive cloud.
pub(crate) fn interactive_cloud(page: &mut Report, scene: &PointScene, caption: &str) -> Result<(), Failure> {
    let still = still(scene)?;
    let thinned = match scene.left_out() {
        0 => String::new(),
        n => format!(" {n} more points are not drawn."),
    };
    page.points(scene, Some(still), &format!("{caption}{thinned}"));
    Ok(())
}
