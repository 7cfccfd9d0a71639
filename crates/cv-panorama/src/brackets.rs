//! Exposure brackets: photographs of one view with different exposures.
//!
//! Recognized by the alignment and the estimated exposures, as Hugin does by the overlap and EXIF. Merging needs no stage of its own: after exposure compensation the photographs of a stack are alternatives of
//! equal tone, and the seams select among them, as among neighbors (Agarwala et al. 2004, "Interactive digital photomontage"). A data term prefers the best exposed photograph of the stack, and others only
//! where it is clipped or in the noise. As the smoothness term keeps seams out of differences, and the data term has no preference where photographs differ beyond noise, what moves between exposures comes from one
//! photograph: it is whole or absent where a seam can pass around it.

use crate::align::{Alignment, View};
use crate::photometric::{Gains, mean_stops, well_exposed};
use crate::rows::for_each_row;
use crate::surface::{Piece, Preview};
use cv_core::{Cancelled, Mask, Point2, Stage, luma_u8};
use cv_imgproc::{StructuringElement, dilate, erode};
use cv_parallel::prelude::*;

/// Maximum displacement of a pixel between two photographs of a stack, relative to the longer side: a handheld burst. The overlap is at least 95 %.
const MAX_SHIFT_RATIO: f64 = 0.025;
/// Minimum range of exposures of a stack, in stops: below, photographs are repetitions, of which none shows more.
const MIN_RANGE_STOPS: f32 = 0.5;
/// Points per side of the grid at which displacements are compared.
const GRID: usize = 5;

/// Data term, in the unit of the smoothness term, of a clipped pixel that another photograph of the stack shows: more than a seam along the border of a photograph, so that single pixels are worth the seam
/// around them.
const CLIPPED_COST: f32 = 400.0;
/// Data term of a pixel near a clipped one: refined seams stay out of it.
const NEAR_CLIPPED_COST: f32 = 100.0;
/// By how many preview pixels refinement and upsampling move a seam, at most, and one for the downsampling of the preview.
const SEAM_REACH: usize = 4;
/// Luma below which noise and quantization are visible after brightening.
const DARK_LEVEL: f32 = 32.0;
/// Ratio of the levels of two photographs from which on the brighter one is less noisy: 1.3 stops.
const BRIGHTER_RATIO: f32 = 1.5;
/// Data term of a black pixel where another photograph of the stack is brighter, falling to 0 at [`DARK_LEVEL`]: with [`OTHER_COST`] it decides below three quarters of that.
const DARK_COST: f32 = 40.0;
/// Data term of photographs of a stack other than the base. More than the eccentricity term, at most 4; a region of some forty pixels is worth a seam of three levels of noise in every channel around it.
const OTHER_COST: f32 = 10.0;

/// Sum of absolute differences over channels, after exposure compensation, beyond which two photographs show different things: four times the noise of dark levels that are brightened by two stops.
const MIN_GHOST_DIFFERENCE: i32 = 90;
/// Range of luma in which photographs are compared: below it levels are noise, above it they are corrected toward white.
const COMPARED_LEVELS: std::ops::Range<u8> = 8..228;
/// Radius, in preview pixels, of misaligned edges, which are no ghosts, and by how much ghosts are grown, to their outlines.
const GHOST_RADII: [usize; 2] = [1, 4];

/// Returns the stacks: indices of the photographs, ascending, in the order of their first.
pub(crate) fn stacks(alignment: &Alignment, gains: &Gains) -> Vec<Vec<usize>> {
    let mut stacks: Vec<Vec<(usize, View)>> = Vec::new();
    for (index, view) in alignment.used() {
        // All photographs of a stack are near its first.
        match stacks.iter_mut().find(|stack| is_same_view(&stack[0].1, view)) {
            Some(stack) => stack.push((index, *view)),
            None => stacks.push(vec![(index, *view)]),
        }
    }
    let range = |stack: &[(usize, View)]| {
        let stops = || stack.iter().map(|(index, _)| mean_stops(gains, *index));
        stops().fold(f32::MIN, f32::max) - stops().fold(f32::MAX, f32::min)
    };
    stacks.retain(|stack| stack.len() > 1 && range(stack) >= MIN_RANGE_STOPS);
    stacks.iter().map(|stack| stack.iter().map(|(index, _)| *index).collect()).collect()
}

/// Returns whether two photographs show the same, up to a small displacement everywhere.
fn is_same_view(a: &View, b: &View) -> bool {
    let size = (a.camera.width, a.camera.height);
    if size != (b.camera.width, b.camera.height) {
        return false;
    }
    let limit = MAX_SHIFT_RATIO * size.0.max(size.1) as f64;
    let at = |k: usize, n: usize| k as f64 / (GRID - 1) as f64 * (n as f64 - 1.0);
    (0..GRID * GRID).all(|k| {
        let p = Point2::new(at(k % GRID, size.0), at(k / GRID, size.1));
        a.ray(p).and_then(|ray| b.project(&ray)).is_some_and(|q| (q - p).norm() <= limit)
    })
}

/// Returns the luma of the pieces of stacks, for [`set_costs`], before their exposure is corrected; nothing for other pieces.
pub(crate) fn lumas(preview: &Preview, stacks: &[Vec<usize>], photo_of: &[usize]) -> Vec<Vec<u8>> {
    let luma = |(piece, photo): (&Piece, &usize)| -> Vec<u8> {
        let is_member = stacks.iter().any(|stack| stack.contains(photo));
        let pixels = piece.warped.pixels.pixels().filter(|_| is_member);
        pixels.map(|[r, g, b, _]| luma_u8([r, g, b])).collect()
    };
    preview.pieces.iter().zip(photo_of).map(luma).collect()
}

/// Sets the data terms of the pieces of stacks, after their exposure is corrected.
///
/// Where photographs of a stack differ beyond noise, something moved: there only clipped pixels have a cost, so that preferences do not cut it.
pub(crate) fn set_costs(
    preview: &mut Preview,
    stacks: &[Vec<usize>],
    photo_of: &[usize],
    lumas: &[Vec<u8>],
    stage: &Stage<'_>,
) -> Result<(), Cancelled> {
    for stack in stacks {
        let members: Vec<usize> = (0..photo_of.len()).filter(|&k| stack.contains(&photo_of[k])).collect();
        let stack = Stack { preview, lumas, photo_of, members: &members };
        let base = stack.base();
        let ghosts = stack.ghosts(stage)?;
        let costs: Vec<Vec<f32>> = members
            .par_iter()
            .map(|&k| {
                stage.check()?;
                Ok(stack.costs(k, base, &ghosts))
            })
            .try_collect::<_, Cancelled>()?;
        for (&k, costs) in members.iter().zip(costs) {
            preview.pieces[k].cost = costs;
        }
    }
    Ok(())
}

/// The pieces of a stack.
struct Stack<'a> {
    preview: &'a Preview,
    /// By piece, before exposure compensation.
    lumas: &'a [Vec<u8>],
    photo_of: &'a [usize],
    members: &'a [usize],
}

impl Stack<'_> {
    /// Returns luma before exposure compensation, and whether a channel is clipped, of a piece at a preview pixel that it covers.
    fn at(&self, k: usize, x: usize, y: usize) -> Option<(u8, bool)> {
        let piece = &self.preview.pieces[k];
        piece.warped.reaches(x, y).then(|| {
            let i = piece.warped.bounds.index(x, y);
            (self.lumas[k][i], piece.clipped[i])
        })
    }

    /// Returns the best exposed photograph, by the mean weight of its pixels; the first of equals.
    fn base(&self) -> usize {
        let score = |k: usize| {
            let piece = &self.preview.pieces[k];
            let (mut sum, mut n) = (0.0, 0.0_f64);
            for ((color, luma), is_clipped) in piece.warped.pixels.pixels().zip(&self.lumas[k]).zip(&piece.clipped) {
                if color[3] > 0 {
                    sum += f64::from(well_exposed(f32::from(*luma) / 255.0, *is_clipped));
                    n += 1.0;
                }
            }
            sum / n.max(1.0)
        };
        let scored = self.members.iter().map(|&k| (score(k), self.photo_of[k]));
        scored.reduce(|a, b| if b.0 > a.0 { b } else { a }).map_or(0, |(_, photo)| photo)
    }

    /// Returns the preview pixels where photographs differ beyond noise.
    fn ghosts(&self, stage: &Stage<'_>) -> Result<Mask, Cancelled> {
        let mut ghosts = Mask::new(self.preview.width, self.preview.height, [false]);
        for_each_row(ghosts.as_mut_slice(), self.preview.width, stage, |y, row| {
            let mut shown: Vec<[u8; 3]> = Vec::new();
            for (x, ghost) in row.iter_mut().enumerate() {
                shown.clear();
                for &k in self.members {
                    let measured =
                        self.at(k, x, y).filter(|(luma, clipped)| COMPARED_LEVELS.contains(luma) && !clipped);
                    let is_measured = measured.is_some();
                    shown.extend(self.preview.pieces[k].warped.color(x, y).filter(|_| is_measured));
                }
                let differ = |a: &[u8; 3], b: &[u8; 3]| {
                    let off = a.iter().zip(b).map(|(a, b)| i32::from(a.abs_diff(*b))).sum::<i32>();
                    off > MIN_GHOST_DIFFERENCE
                };
                *ghost = shown.iter().enumerate().any(|(i, a)| shown[i + 1..].iter().any(|b| differ(a, b)));
            }
        })?;
        let [edges, grown] = GHOST_RADII;
        let core = erode(ghosts.view(), &StructuringElement::square(edges));
        Ok(dilate(core.view(), &StructuringElement::square(edges + grown)))
    }

    /// Returns the data term of each pixel of a piece.
    fn costs(&self, k: usize, base: usize, ghosts: &Mask) -> Vec<f32> {
        let piece = &self.preview.pieces[k];
        let b = piece.warped.bounds;
        let (width, height) = (b.width(), b.height());
        let clipped = Mask::from_fn(width, height, |x, y| [piece.clipped[y * width + x]]);
        let near = dilate(clipped.view(), &StructuringElement::square(SEAM_REACH));
        // The luma of the brightest of the others that is not clipped at a pixel.
        let brightest = |x: usize, y: usize| {
            let others = self.members.iter().filter(|&&m| self.photo_of[m] != self.photo_of[k]);
            others.filter_map(|&m| self.at(m, x, y)).filter(|(_, clipped)| !clipped).map(|(luma, _)| luma).max()
        };
        let preference = if self.photo_of[k] == base { 0.0 } else { OTHER_COST };
        let cost = |i: usize| {
            let (x, y) = (b.left + i % width, b.top + i / width);
            let is_ghost = ghosts.at(x, y)[0];
            let own = if is_ghost { 0.0 } else { preference };
            let (Some((luma, is_clipped)), Some(other)) = (self.at(k, x, y), brightest(x, y)) else { return own };
            let (luma, other) = (f32::from(luma), f32::from(other));
            if is_clipped {
                own + CLIPPED_COST
            } else if is_ghost {
                0.0
            } else if near.at(i % width, i / width)[0] || luma >= f32::from(COMPARED_LEVELS.end) {
                own + NEAR_CLIPPED_COST
            } else if other >= BRIGHTER_RATIO * luma {
                own + DARK_COST * (1.0 - luma / DARK_LEVEL).max(0.0)
            } else {
                own
            }
        };
        (0..width * height).map(cost).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::CameraMotion;
    use crate::seams::{Seams, on_preview};
    use crate::surface::Bounds;
    use crate::testing::{drawn, stage};
    use cv_core::{Camera, Silent, Vector3};
    use nalgebra::Rotation3;

    /// Photographs of 400 × 300 pixels and a focal length of 400, turned to the right by these angles.
    fn alignment(yaws: &[f64]) -> Alignment {
        let view = |yaw: &f64| {
            let turn = Rotation3::from_axis_angle(&Vector3::y_axis(), -yaw);
            Ok(View { camera: Camera::from_focal(400, 300, 400.0), from_world: turn.into_inner() })
        };
        let (views, pairs) = (yaws.iter().map(view).collect(), Vec::new());
        Alignment { views, reference: 0, motion: CameraMotion::Rotation, pairs, rms_px: 0.0, median_px: 0.0 }
    }

    fn gains(stops: &[f32]) -> Gains {
        Gains { gains: stops.iter().map(|s| [s.exp2(); 3]).collect(), ..Gains::none(stops.len()) }
    }

    #[test]
    fn stacks_are_photographs_of_one_view_with_different_exposures() {
        // 4 px apart at the center, 5 at the border; then half a photograph.
        let set = alignment(&[0.0, 0.5, 0.01, 0.51, -0.01]);
        let stops = [0.0, 0.0, 2.0, -2.0, -2.0];
        assert_eq!(stacks(&set, &gains(&stops)), [vec![0, 2, 4], vec![1, 3]]);
        // Repetitions, and a scatter of a third of a stop.
        assert_eq!(stacks(&set, &gains(&[0.0, 0.0, 0.3, 2.0, 0.1])), [vec![1, 3]]);
        // 2.5 % of 400 px is 10: 12 at the center is a pan.
        assert!(stacks(&alignment(&[0.0, 0.03]), &gains(&[0.0, 2.0])).is_empty());
        // Another size.
        let mut other = alignment(&[0.0, 0.0]);
        if let Ok(view) = &mut other.views[1] {
            view.camera = Camera::from_focal(300, 400, 400.0);
        }
        assert!(stacks(&other, &gains(&[0.0, 2.0])).is_empty());
    }

    const SIZE: (usize, usize) = (160, 100);

    /// Three exposures of one view, 0.25, 1 and 4 times the light: a sky that the middle one clips, a wall, a shadow that it shows in the noise. With a person in the middle one, who stands before sky and wall.
    fn bracket() -> (Preview, Gains) {
        let bounds = Bounds { left: 0, top: 0, right: SIZE.0, bottom: SIZE.1 };
        let piece = |k: usize| {
            let light = |x: usize, y: usize| match (x, y) {
                (60..72, 5..95) if k == 1 => 0.1,
                (_, 0..15) => 1.5 + 0.5 * (x as f32 * 0.3).sin(),
                (_, 15..65) => 0.3 + 0.1 * (x as f32 * 0.5).sin(),
                _ => 0.001,
            };
            let level = |x: usize, y: usize| {
                (255.0 * (light(x, y) * 4.0_f32.powi(k as i32 - 1)).min(1.0).powf(1.0 / 2.2)).round()
            };
            let warped = drawn(bounds, |x, y| [level(x, y) as u8; 3]);
            let n = SIZE.0 * SIZE.1;
            Piece::new(warped, vec![0.3; n], vec![0.0; n], 100.0)
        };
        let pieces = (0..3).map(piece).collect();
        (Preview { step: 1, width: SIZE.0, height: SIZE.1, full_circle: false, pieces }, gains(&[2.0, 0.0, -2.0]))
    }

    #[test]
    fn the_best_exposed_is_the_base_and_others_are_taken_where_it_is_clipped_or_dark() {
        let (mut preview, gains) = bracket();
        let photo_of = [0, 1, 2];
        let lumas = lumas(&preview, &[vec![0, 1, 2]], &photo_of);
        let stack = Stack { preview: &preview, lumas: &lumas, photo_of: &photo_of, members: &photo_of };
        assert_eq!(stack.base(), 1);
        preview.correct(&gains, None, &photo_of);
        let stack = Stack { preview: &preview, lumas: &lumas, photo_of: &photo_of, members: &photo_of };
        let ghosts = stack.ghosts(&stage()).unwrap();
        for (x, y) in (0..SIZE.1).flat_map(|y| (0..SIZE.0).map(move |x| (x, y))) {
            // Four pixels around the person.
            assert!(!ghosts.at(x, y)[0] || (56..76).contains(&x) && (1..99).contains(&y), "{x} {y}");
            assert!(ghosts.at(x, y)[0] || !(60..72).contains(&x) || !(5..95).contains(&y), "{x} {y}");
        }
        set_costs(&mut preview, &[vec![0, 1, 2]], &photo_of, &lumas, &stage()).unwrap();
        let labels = on_preview(&preview, &[0, 1, 2], Seams::GraphCut, false, false, &Silent).unwrap();
        let at = |x: usize, y: usize| labels.at(x, y)[0];
        for x in (5..50).chain(85..155) {
            assert!((1..13).all(|y| at(x, y) == 0), "sky {x}");
            assert!((24..60).all(|y| at(x, y) == 1), "wall {x}");
            assert!((72..98).all(|y| at(x, y) == 2), "shadow {x}");
        }
        // The person is whole or absent.
        let places = || (6..94).flat_map(|y| (61..71).map(move |x| (x, y)));
        let own = places().filter(|&(x, y)| at(x, y) == 1).count();
        assert!(own == 0 || own == places().count(), "{own} of {}", places().count());
    }

    #[test]
    fn photographs_that_are_no_bracket_have_no_costs() {
        let (mut preview, _) = bracket();
        set_costs(&mut preview, &[], &[0, 1, 2], &[], &stage()).unwrap();
        assert!(preview.pieces.iter().all(|piece| piece.cost.is_empty()));
        // Of a bracket clipped everywhere, none is better than another.
        preview.pieces.iter_mut().for_each(|piece| piece.clipped.fill(true));
        let lumas = lumas(&preview, &[vec![0, 1]], &[0, 1, 2]);
        set_costs(&mut preview, &[vec![0, 1]], &[0, 1, 2], &lumas, &stage()).unwrap();
        let kinds = preview.pieces[..2].iter().flat_map(|piece| &piece.cost).filter(|c| **c > OTHER_COST).count();
        assert_eq!((kinds, preview.pieces[2].cost.len()), (0, 0));
    }
}
