//! Breaks: parts of a seam that cut an object which parallax displaces (after Jia & Tang 2008, "Image Stitching Using Structure Deformation"). The displacement across the seam is measured on the
//! preview; local alignment then closes the break.

use crate::blend::NO_PHOTO;
use crate::seams::misalignment::{PATCH_RADIUS, PATCH_SIDE, has_contrast, luma, patch_rows, patch_template};
use crate::surface::{Piece, Preview, SeamTie, score_maximum};
use cv_core::{Cancelled, GrayF32, Image, Point2, Stage, UnionFind, Vector2};
use cv_parallel::prelude::*;

/// Correlation of the two photographs at one place above which no displacement is searched for.
const MAX_PRESENT_CORRELATION: f32 = 0.6;
/// Minimum correlation of a displaced patch, and by how much it exceeds that of the same place.
const MIN_CORRELATION: f32 = 0.7;
const MIN_GAIN: f32 = 0.3;
/// Minimum visibility of a break in gray levels, and relative to the root mean square contrast of the patch: that of independent patches of normally distributed levels is 1.1, of a correlation
/// of 0.6 still 0.7. Along a contour the patch has a high contrast and the seam is hardly visible.
const MIN_VISIBILITY: f32 = 4.0;
const MIN_RELATIVE_VISIBILITY: f32 = 0.7;
/// Visibility in gray levels below which a seam is continuous.
const MAX_CONTINUOUS: f32 = 8.0;
/// Maximum difference of the displaced patches relative to the visibility of the break.
const MAX_REMAINING: f32 = 0.6;
/// Minimum number of seam pixels of a break, the side of a patch: those of fewer have a common pixel.
const MIN_PIXELS: usize = PATCH_SIDE;
/// Difference, in preview pixels along each axis, up to which neighboring seam pixels have the same displacement.
const SAME_DISPLACEMENT: f64 = 1.0;
/// Every how many continuous seam pixels keep the photographs where they are: together they weigh less than a break.
const CONTINUOUS_STEP: usize = 3;

/// A pixel at a seam of the pieces `p` < `q`.
#[derive(Clone, Copy)]
struct Site {
    p: usize,
    q: usize,
    x: usize,
    y: usize,
}

/// What the photographs show at a site.
enum Finding {
    Unknown,
    Continuous,
    Broken(Break),
}

/// An object cut by a seam.
#[derive(Clone, Copy)]
struct Break {
    /// By how much the second photograph shows the patch of the first displaced.
    displacement: Vector2<f64>,
    /// Of the seam, without displacement, in gray levels.
    visibility: f32,
    /// Mean difference of the displaced patches in gray levels.
    remaining: f32,
    /// Root mean square contrast of the patch in gray levels.
    contrast: f32,
}

/// Finds the breaks along the seams of the preview, and where the seams are continuous. Empty without a break.
///
/// `max_displacement` is in preview pixels. O(seam pixels · patch), and O(`max_displacement`² · patch) for a seam pixel where the photographs differ.
pub(crate) fn find(
    preview: &Preview,
    labels: &Image<u16, 1>,
    photo_of: &[usize],
    max_displacement: usize,
    stage: &Stage<'_>,
) -> Result<Vec<SeamTie>, Cancelled> {
    let sites = seam_sites(labels, photo_of);
    let lumas: Vec<GrayF32> = preview.pieces.par_iter().map(luma).collect();
    let examine = |(i, site): (usize, &Site)| {
        if i % 64 == 0 {
            stage.check()?;
        }
        Ok(examine(preview, labels, &lumas, *site, max_displacement))
    };
    let findings: Vec<Finding> = sites.par_iter().enumerate().map(examine).try_collect::<_, Cancelled>()?;
    let tie = |site: &Site, displacement: Vector2<f64>| {
        // Both photographs move half of the way.
        let at = Point2::new(site.x as f64, site.y as f64) + 0.5 * displacement;
        SeamTie { p: site.p, q: site.q, at, displacement }
    };
    let mut ties: Vec<SeamTie> =
        breaks(&sites, &findings).into_iter().map(|(site, displacement)| tie(&site, displacement)).collect();
    if !ties.is_empty() {
        let continuous = sites.iter().zip(&findings).filter(|(_, finding)| matches!(finding, Finding::Continuous));
        ties.extend(continuous.step_by(CONTINUOUS_STEP).map(|(site, _)| tie(site, Vector2::zeros())));
    }
    Ok(ties)
}

/// Returns the pixels left of and above seams between different photographs.
fn seam_sites(labels: &Image<u16, 1>, photo_of: &[usize]) -> Vec<Site> {
    let mut sites = Vec::new();
    for y in 0..labels.height() {
        let below = labels.row((y + 1).min(labels.height() - 1));
        let row = labels.row(y);
        for (x, own) in row.iter().enumerate() {
            let right = row[(x + 1).min(row.len() - 1)];
            let others = [right, below[x]];
            for (i, other) in others.into_iter().enumerate() {
                let is_seam = other != *own && other != NO_PHOTO && *own != NO_PHOTO && !others[..i].contains(&other);
                let (p, q) = (usize::from(other.min(*own)), usize::from(other.max(*own)));
                if is_seam && photo_of[p] != photo_of[q] {
                    sites.push(Site { p, q, x, y });
                }
            }
        }
    }
    sites
}

/// Compares the two photographs at a site.
fn examine(
    preview: &Preview,
    labels: &Image<u16, 1>,
    lumas: &[GrayF32],
    site: Site,
    max_displacement: usize,
) -> Finding {
    let pieces = [&preview.pieces[site.p], &preview.pieces[site.q]];
    let Some(visibility) = visibility(pieces, labels, site) else { return Finding::Unknown };
    if let Some((displacement, contrast)) = displacement(pieces, lumas, site, max_displacement)
        && let Some(remaining) = remaining(pieces, site, displacement)
    {
        return Finding::Broken(Break { displacement, visibility, remaining, contrast });
    }
    if visibility < MAX_CONTINUOUS { Finding::Continuous } else { Finding::Unknown }
}

/// Returns the mean difference of two colors in gray levels.
fn color_difference(a: [u8; 3], b: [u8; 3]) -> f32 {
    (0..3).map(|c| f32::from(a[c].abs_diff(b[c]))).sum::<f32>() / 3.0
}

/// Returns the pixels of the patch around a position; beyond the left and upper border none.
fn patch(x: usize, y: usize) -> impl Iterator<Item = (usize, usize)> {
    let range = |v: usize| v.saturating_sub(PATCH_RADIUS)..v + PATCH_RADIUS + 1;
    range(y).flat_map(move |y| range(x).map(move |x| (x, y)))
}

/// Returns the visibility of a seam: the mean difference of the photographs on that side of it where they differ less. Where it is low, the panorama looks there like one of the photographs:
/// such a seam may follow the contour of an object, but does not cut it. `None` without pixels on both sides.
fn visibility(pieces: [&Piece; 2], labels: &Image<u16, 1>, site: Site) -> Option<f32> {
    let mut sides = [(0.0_f32, 0_u16); 2];
    for (x, y) in patch(site.x, site.y) {
        let Some([label]) = labels.get(x, y) else { continue };
        let side = match usize::from(label) {
            label if label == site.p => &mut sides[0],
            label if label == site.q => &mut sides[1],
            _ => continue,
        };
        if let (Some(a), Some(b)) = (pieces[0].warped.color(x, y), pieces[1].warped.color(x, y)) {
            *side = (side.0 + color_difference(a, b), side.1 + 1);
        }
    }
    let [first, second] = sides.map(|(sum, count)| (count > 0).then(|| sum / f32::from(count)));
    Some(first?.min(second?))
}

/// Returns by how much the patch of the first photograph is displaced in the second, and its root mean square contrast in gray levels; `None` where it is not, for low texture, and for a low or ambiguous correlation.
fn displacement(
    pieces: [&Piece; 2],
    lumas: &[GrayF32],
    site: Site,
    max_displacement: usize,
) -> Option<(Vector2<f64>, f32)> {
    let position = |k: usize, (dx, dy): (isize, isize)| {
        let b = pieces[k].warped.bounds;
        (site.x as isize - b.left as isize + dx, site.y as isize - b.top as isize + dy)
    };
    let template = patch_template(&lumas[site.p], position(0, (0, 0)))?;
    if !has_contrast(&template) {
        return None;
    }
    let theirs = &lumas[site.q];
    let present = template.score(patch_rows(theirs, position(1, (0, 0)))?);
    // NaN where a photograph does not cover the patch.
    if present.is_nan() || present > MAX_PRESENT_CORRELATION {
        return None;
    }
    let reach = max_displacement as isize;
    let score = |dx: isize, dy: isize| {
        let score = patch_rows(theirs, position(1, (dx, dy))).map_or(-1.0, |rows| template.score(rows));
        if score.is_nan() { -1.0 } else { score }
    };
    let scores: Vec<f32> = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| score(dx, dy))).collect();
    let displacement = score_maximum(&scores, 2 * max_displacement + 1, MIN_CORRELATION.max(present + MIN_GAIN))?;
    Some((displacement, (template.energy() / (PATCH_SIDE * PATCH_SIDE) as f32).sqrt()))
}

/// Returns the mean difference of the patches, in gray levels, at a displacement.
fn remaining(pieces: [&Piece; 2], site: Site, displacement: Vector2<f64>) -> Option<f32> {
    let (mut sum, mut count) = (0.0_f32, 0_u16);
    let moved = |v: usize, by: f64| usize::try_from(v as i64 + by.round() as i64).ok();
    for (x, y) in patch(site.x, site.y) {
        let other = moved(x, displacement.x).zip(moved(y, displacement.y));
        if let (Some(a), Some(b)) =
            (pieces[0].warped.color(x, y), other.and_then(|(x, y)| pieces[1].warped.color(x, y)))
        {
            (sum, count) = (sum + color_difference(a, b), count + 1);
        }
    }
    (count > 0).then(|| sum / f32::from(count))
}

/// Returns the sites of breaks with their displacements: groups of neighbors with the same displacement that removes most of the difference.
fn breaks(sites: &[Site], findings: &[Finding]) -> Vec<(Site, Vector2<f64>)> {
    let broken: Vec<(Site, Break)> = sites
        .iter()
        .zip(findings)
        .filter_map(|(site, finding)| match finding {
            Finding::Broken(found) => Some((*site, *found)),
            _ => None,
        })
        .collect();
    let mut groups = UnionFind::new(broken.len());
    for (i, (site, found)) in broken.iter().enumerate() {
        // In the order of rows: the sites at most two patch radii above.
        let near =
            broken[..i].iter().enumerate().rev().take_while(|(_, (other, _))| site.y - other.y <= 2 * PATCH_RADIUS);
        for (j, (other, other_found)) in near {
            let is_same = (other.p, other.q) == (site.p, site.q)
                && other.x.abs_diff(site.x) <= 2 * PATCH_RADIUS
                && (found.displacement - other_found.displacement).amax() <= SAME_DISPLACEMENT;
            if is_same {
                groups.union(i as u32, j as u32);
            }
        }
    }
    let roots = groups.into_roots();
    // Sums over the sites of each group.
    let mut sums = vec![(0, 0.0, 0.0, 0.0); broken.len()];
    for (root, (_, found)) in roots.iter().zip(&broken) {
        let (count, visibility, remaining, contrast) = &mut sums[*root as usize];
        *count += 1;
        *visibility += found.visibility;
        *remaining += found.remaining;
        *contrast += found.contrast;
    }
    let is_break = |root: u32| {
        let (count, visibility, remaining, contrast) = sums[root as usize];
        count >= MIN_PIXELS
            && visibility >= MIN_VISIBILITY * count as f32
            && visibility >= MIN_RELATIVE_VISIBILITY * contrast
            && remaining <= MAX_REMAINING * visibility
    };
    roots
        .iter()
        .zip(&broken)
        .filter(|(root, _)| is_break(**root))
        .map(|(_, (site, found))| (*site, found.displacement))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::surface::Bounds;
    use crate::testing::{StopAt, drawn, stage};

    const SIZE: (usize, usize) = (120, 80);
    /// Columns of the pole in the first photograph.
    const POLE: std::ops::Range<usize> = 50..66;

    /// Random levels around a mean.
    fn noise(x: usize, y: usize, mean: u8) -> [u8; 3] {
        let h = (x as u32).wrapping_mul(0x9E37_79B1) ^ (y as u32).wrapping_mul(0x85EB_CA77);
        let h = (h ^ (h >> 15)).wrapping_mul(0x2C1B_3C6D);
        [mean + (h >> 27) as u8, mean + (h >> 26) as u8, mean]
    }

    /// Two photographs of a scene, with a pole in each whose columns and texture are moved by `(dx, dy)`, or none.
    fn preview(poles: [Option<(usize, usize)>; 2], texture: impl Fn(usize, usize) -> [u8; 3]) -> Preview {
        let bounds = Bounds { left: 0, top: 0, right: SIZE.0, bottom: SIZE.1 };
        let piece = |pole: Option<(usize, usize)>| {
            let color = |x: usize, y: usize| match pole {
                Some((dx, dy)) if (POLE.start + dx..POLE.end + dx).contains(&x) => texture(x - dx, y + 20 - dy),
                _ => noise(x, y, 30),
            };
            let zero = vec![0.0; SIZE.0 * SIZE.1];
            Piece::new(drawn(bounds, color), zero.clone(), zero, 0.0)
        };
        Preview { step: 1, width: SIZE.0, height: SIZE.1, full_circle: false, pieces: poles.map(piece).into() }
    }

    fn labels(is_second: impl Fn(usize, usize) -> bool) -> Image<u16, 1> {
        Image::from_fn(SIZE.0, SIZE.1, |x, y| [u16::from(is_second(x, y))])
    }

    fn ties(preview: &Preview, labels: &Image<u16, 1>) -> Vec<SeamTie> {
        find(preview, labels, &[0, 1], 9, &stage()).unwrap()
    }

    #[test]
    fn the_displacement_of_a_cut_object_is_found_and_the_rest_of_the_seam_is_continuous() {
        let preview = preview([Some((0, 0)), Some((6, 2))], |x, y| noise(x, y, 150));
        let across = labels(|_, y| y >= 40);
        let found = ties(&preview, &across);
        let (broken, continuous): (Vec<&SeamTie>, Vec<&SeamTie>) =
            found.iter().partition(|tie| tie.displacement != Vector2::zeros());
        // The patches that lie on the pole in the first photograph.
        assert!(
            broken.len() >= POLE.len() - 2 * PATCH_RADIUS && continuous.len() > 20,
            "{} {}",
            broken.len(),
            continuous.len()
        );
        for tie in broken {
            assert!((tie.displacement - Vector2::new(6.0, 2.0)).norm() < 0.5, "{}", tie.displacement);
            assert!((tie.at.y - 40.0).abs() < 1.1 && (tie.p, tie.q) == (0, 1), "{}", tie.at);
            assert!(tie.at.x > POLE.start as f64 && tie.at.x < POLE.end as f64 + 6.0, "{}", tie.at);
        }
        for tie in continuous {
            assert!(tie.at.x < POLE.start as f64 || tie.at.x > POLE.end as f64, "{}", tie.at);
        }
        // With the photographs exchanged, the reverse.
        let exchanged = Preview { pieces: preview.pieces.into_iter().rev().collect(), ..preview };
        let reverse = ties(&exchanged, &labels(|_, y| y < 40));
        let is_reverse = |tie: &SeamTie| (tie.displacement + Vector2::new(6.0, 2.0)).norm() < 0.5;
        assert!(reverse.iter().any(|tie| tie.displacement.norm() > 0.0));
        assert!(reverse.iter().all(|tie| tie.displacement == Vector2::zeros() || is_reverse(tie)));
    }

    #[test]
    fn a_seam_along_the_contour_of_an_object_does_not_cut_it() {
        // Right of the pole of the first photograph, the second shows what is behind it.
        let preview = preview([Some((8, 0)), Some((0, 0))], |x, y| noise(x, y, 150));
        let beside = labels(|x, _| x >= POLE.end + 8 + 2);
        assert!(ties(&preview, &beside).is_empty());
        // Through the pole it does.
        assert!(!ties(&preview, &labels(|x, _| x >= POLE.end + 2)).is_empty());
    }

    #[test]
    fn what_only_one_photograph_shows_and_repeated_texture_are_left() {
        let across = labels(|_, y| y >= 40);
        assert!(ties(&preview([Some((0, 0)), None], |x, y| noise(x, y, 150)), &across).is_empty());
        // Every displacement along the stripes, and by their period, is the same.
        let striped = preview([Some((0, 0)), Some((6, 2))], |_, y| if y % 4 < 2 { [150; 3] } else { [220; 3] });
        assert!(ties(&striped, &across).is_empty());
        // Photographs that agree, and two placements of one photograph.
        let equal = preview([Some((0, 0)); 2], |x, y| noise(x, y, 150));
        assert!(ties(&equal, &across).is_empty());
        let moved = preview([Some((0, 0)), Some((6, 2))], |x, y| noise(x, y, 150));
        assert!(find(&moved, &across, &[0, 0], 9, &stage()).unwrap().is_empty());
    }

    #[test]
    fn the_search_is_stopped() {
        let preview = preview([Some((0, 0)), Some((6, 2))], |x, y| noise(x, y, 150));
        let stop = StopAt::report(2);
        let stage = Stage::new(&stop, "seams", 1).unwrap();
        assert!(find(&preview, &labels(|_, y| y >= 40), &[0, 1], 9, &stage).is_err());
    }
}
