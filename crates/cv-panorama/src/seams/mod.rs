//! Which photograph each canvas pixel is taken from: minimal cuts through the overlaps (Kwatra et al. 2003; Agarwala et al. 2004).
//!
//! A labeling costs, between neighbors `p` and `q` taken from photographs `a` and `b`, how much the two differ at both places, in color
//! and in gradient: a seam runs where they show the same, around what moved. Alpha expansion (Boykov, Veksler & Zabih 2001) finds a labeling
//! that no single photograph can improve by taking over pixels.

mod maxflow;
mod misalignment;

use crate::seams::maxflow::GridCut;
use crate::seams::misalignment::Misalignments;
use crate::surface::Bounds;
use crate::surface::Preview;
use crate::surface::Warped;
use rayon::prelude::*;

/// How seams are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Seams {
    /// Where the middles of two photographs are equally far: straight through whatever is there.
    Middle,
    /// Where the photographs agree, by minimal cuts.
    #[default]
    GraphCut,
}

/// No photograph.
pub(crate) const NONE: u16 = u16::MAX;

/// A photograph piece with brightness evened out, for comparing.
pub(crate) struct Toned<'a> {
    warped: &'a Warped,
    /// Values after the gain, per channel, in quarters of a gray level.
    tables: [[i16; 256]; 3],
}

impl<'a> Toned<'a> {
    pub(crate) fn new(warped: &'a Warped, gain: [f32; 3]) -> Self {
        let table = |g: f32| std::array::from_fn(|v| (4.0 * g * v as f32).min(8000.0) as i16);
        Self { warped, tables: gain.map(table) }
    }

    #[inline(always)]
    fn at(&self, x: usize, y: usize) -> Option<[i32; 3]> {
        let b = self.warped.bounds;
        if x < b.left || y < b.top || x >= b.right || y >= b.bottom {
            return None;
        }
        let [r, g, b, a] = self.warped.pixels.at(x - b.left, y - b.top);
        let t = &self.tables;
        (a > 0).then(|| [t[0][usize::from(r)].into(), t[1][usize::from(g)].into(), t[2][usize::from(b)].into()])
    }
}

/// Cost of a seam through a pixel that only one of the two photographs shows, in the unit of [`difference`]: a difference of 15 gray levels
/// in every channel. Such seams follow the border of a photograph.
const BORDER: i32 = 4 * 45;
/// Cost of every step of a seam: between equals the shorter.
const STEP: i32 = 4 * 3;
/// Cost of taking a pixel at the border of its photograph instead of at its middle. A hundredth of a visible difference, so that it decides only where
/// the photographs agree.
const BORDER_PIXEL: f32 = 4.0;

/// Cost of a seam through a pixel where the photographs disagree by a canvas pixel more than one, beyond the difference of colors: 15 gray levels in
/// one channel.
const MISALIGNED: f32 = 4.0 * 15.0;
/// Canvas pixels of misalignment, beyond the first, after which nothing looks worse and the colors decide alone: then it costs as much as the border of a
/// photograph.
const FARTHEST: f32 = 3.0;

/// How much two photographs differ at a pixel: sum over channels of the absolute difference, in quarters of a gray level, and the same of the
/// gradients of brightness.
fn difference(a: &Option<Toned<'_>>, b: &Option<Toned<'_>>, x: usize, y: usize) -> i32 {
    let (Some(a), Some(b)) = (a, b) else { return BORDER };
    let (Some(p), Some(q)) = (a.at(x, y), b.at(x, y)) else { return BORDER };
    let d: [i32; 3] = std::array::from_fn(|c| p[c] - q[c]);
    let color: i32 = d.iter().map(|d| d.abs()).sum();
    let sum = |d: [i32; 3]| d[0] + d[1] + d[2];
    // The difference of gradients is the gradient of the difference.
    let gradient = |x: usize, y: usize| match (a.at(x, y), b.at(x, y)) {
        (Some(p), Some(q)) => (sum(d) - sum(std::array::from_fn(|c| p[c] - q[c]))).abs(),
        _ => 0,
    };
    color + gradient(x.wrapping_sub(1), y) + gradient(x, y.wrapping_sub(1))
}

/// A canvas-shaped map of labels (indices of pieces), row by row.
pub(crate) struct Labels {
    pub(crate) width: usize,
    pub(crate) height: usize,
    pub(crate) data: Vec<u16>,
}

impl Labels {
    #[inline]
    pub(crate) fn at(&self, x: usize, y: usize) -> u16 {
        self.data[y * self.width + x]
    }

    /// The box around all pixels of each label.
    pub(crate) fn bounds(&self, labels: usize) -> Vec<Option<Bounds>> {
        let mut bounds: Vec<Option<Bounds>> = vec![None; labels];
        for y in 0..self.height {
            for x in 0..self.width {
                let Some(b) = bounds.get_mut(usize::from(self.at(x, y))) else { continue };
                *b = Some(match *b {
                    None => Bounds { left: x, top: y, right: x + 1, bottom: y + 1 },
                    Some(b) => Bounds { left: b.left.min(x), top: b.top, right: b.right.max(x + 1), bottom: y + 1 },
                });
            }
        }
        bounds
    }
}

/// Preview pixels on either side of the seams of the halved preview among which the preview's own are found: a cut over the whole preview takes
/// several times as long for seams that are hardly cheaper.
const NEAR: usize = 4;

/// Labels on the preview: seams through it all at half its size, then near those.
pub(crate) fn on_preview(preview: &Preview, gains: &[[f32; 3]], photo_of: &[usize], seams: Seams) -> Labels {
    let mut labels = nearest_middle(preview);
    if seams == Seams::Middle {
        return labels;
    }
    let found = Misalignments::find(preview, photo_of);
    let pieces: Vec<Option<Toned<'_>>> =
        preview.pieces.iter().zip(gains).map(|(p, g)| Some(Toned::new(&p.warped, *g))).collect();
    let differ = |a: usize, b: usize, x: usize, y: usize| {
        let off = preview.step as f32 * found.at(a, b, x, y) - 1.0;
        difference(&pieces[a], &pieces[b], x, y) + (MISALIGNED * off.clamp(0.0, FARTHEST)) as i32
    };
    let half = preview.halved();
    let mut coarse = nearest_middle(&half);
    // The worst of four pixels: their mean colors would hide a pole that the seam cuts in two.
    let worst = |a: usize, b: usize, x: usize, y: usize| {
        let four = [(0, 0), (1, 0), (0, 1), (1, 1)];
        four.into_iter().map(|(i, j)| differ(a, b, 2 * x + i, 2 * y + j)).fold(0, i32::max)
    };
    // A pixel stands for four, a step of a seam for two.
    let pixel =
        |label: usize, x: usize, y: usize| (2.0 * BORDER_PIXEL * eccentricity(&half.pieces[label], x, y)) as i32;
    let reach: Vec<_> = half.pieces.iter().map(|p| Some(&p.warped)).collect();
    // The first round does nearly all: a third here and a second below leave the misfits at the seams of every set met so far as they are.
    expand(&mut coarse, &reach, pixel, worst, |_, _| true, 2);

    let width = preview.width;
    for (i, label) in labels.data.iter_mut().enumerate() {
        let (x, y) = (i % width, i / width);
        if x / 2 < coarse.width && y / 2 < coarse.height {
            let found = coarse.at(x / 2, y / 2);
            if found != NONE && preview.pieces[usize::from(found)].at(x, y).is_some() {
                *label = found;
            }
        }
    }
    let near = near_seams(&labels, NEAR);
    let pixel = |label: usize, x: usize, y: usize| (BORDER_PIXEL * eccentricity(&preview.pieces[label], x, y)) as i32;
    let reach: Vec<_> = preview.pieces.iter().map(|p| Some(&p.warped)).collect();
    expand(&mut labels, &reach, pixel, differ, |x, y| near[y * width + x], 1);
    labels
}

/// Every pixel from the photograph whose middle is nearest.
fn nearest_middle(preview: &Preview) -> Labels {
    let (width, height) = (preview.width, preview.height);
    let mut labels = Labels { width, height, data: vec![NONE; width * height] };
    for y in 0..height {
        for x in 0..width {
            let nearest = preview
                .pieces
                .iter()
                .enumerate()
                .filter(|(_, p)| p.at(x, y).is_some())
                .map(|(i, p)| (eccentricity(p, x, y), i))
                .min_by(|a, b| a.0.total_cmp(&b.0));
            if let Some((_, i)) = nearest {
                labels.data[y * width + x] = i as u16;
            }
        }
    }
    labels
}

fn eccentricity(piece: &crate::surface::Piece, x: usize, y: usize) -> f32 {
    let b = piece.warped.bounds;
    piece.eccentricity[(y - b.top) * b.width() + x - b.left]
}

/// Moves the seams of full-size labels to where the photographs agree in full detail, by up to `reach` pixels.
pub(crate) fn refine(labels: &mut Labels, pieces: &[Option<Toned<'_>>], reach: usize) {
    let near = near_seams(labels, reach);
    let width = labels.width;
    let differ = |a: usize, c: usize, x: usize, y: usize| difference(&pieces[a], &pieces[c], x, y);
    let reach: Vec<_> = pieces.iter().map(|p| p.as_ref().map(|p| p.warped)).collect();
    expand(labels, &reach, |_, _, _| 0, differ, |x, y| near[y * width + x], 1);
}

/// True within `reach` pixels (in x and y) of a border between two labels.
fn near_seams(labels: &Labels, reach: usize) -> Vec<bool> {
    let (w, h) = (labels.width, labels.height);
    let mut seam = vec![false; w * h];
    for y in 0..h {
        for x in 0..w {
            let own = labels.at(x, y);
            let differs = |other: u16| own != NONE && other != NONE && own != other;
            seam[y * w + x] = x + 1 < w && differs(labels.at(x + 1, y)) || y + 1 < h && differs(labels.at(x, y + 1));
        }
    }
    // Along rows, then along columns: the pixels since the last seam and until the next.
    let spread = |n: usize, step: usize, start: usize, data: &[bool], out: &mut [bool]| {
        let mut last = usize::MAX;
        for i in 0..n {
            if data[start + i * step] {
                last = 0;
            } else {
                last = last.saturating_add(1);
            }
            out[start + i * step] |= last <= reach;
        }
        last = usize::MAX;
        for i in (0..n).rev() {
            if data[start + i * step] {
                last = 0;
            } else {
                last = last.saturating_add(1);
            }
            out[start + i * step] |= last <= reach;
        }
    };
    let mut rows = vec![false; w * h];
    for y in 0..h {
        spread(w, 1, y * w, &seam, &mut rows);
    }
    let mut all = vec![false; w * h];
    for x in 0..w {
        spread(h, w, x, &rows, &mut all);
    }
    all
}

/// Lets every label in turn take over the pixels that lower the total cost, until none gains or `rounds` are over. Pixels that are not `free` keep
/// their label.
fn expand(
    labels: &mut Labels,
    pieces: &[Option<&Warped>],
    unary: impl Fn(usize, usize, usize) -> i32 + Sync,
    differ: impl Fn(usize, usize, usize, usize) -> i32 + Sync,
    free: impl Fn(usize, usize) -> bool + Sync,
    rounds: usize,
) {
    let groups = apart(pieces);
    // A label need not be tried again unless something changed since.
    let mut stale = vec![true; pieces.len()];
    for _ in 0..rounds {
        for group in &groups {
            let turn: Vec<usize> = group.iter().copied().filter(|&k| std::mem::replace(&mut stale[k], false)).collect();
            let snapshot = &*labels;
            let changes: Vec<Vec<usize>> =
                turn.par_iter().map(|&alpha| expand_one(snapshot, pieces, alpha, &unary, &differ, &free)).collect();
            for (&alpha, changed) in turn.iter().zip(&changes).filter(|(_, changed)| !changed.is_empty()) {
                changed.iter().for_each(|&i| labels.data[i] = alpha as u16);
                for (other, s) in stale.iter_mut().enumerate() {
                    *s |= other != alpha && touch(pieces, other, alpha);
                }
            }
        }
        if !stale.contains(&true) {
            break;
        }
    }
}

/// Whether two pieces reach a common pixel or neighboring ones, going by their bounds.
fn touch(pieces: &[Option<&Warped>], a: usize, b: usize) -> bool {
    let (Some(a), Some(b)) = (pieces[a], pieces[b]) else { return false };
    a.bounds.grown(1, usize::MAX, usize::MAX).intersection(&b.bounds).is_some()
}

/// The pieces in groups that do not touch each other: in a group, what one takes over changes nothing for the others, so that they may all be tried at once.
fn apart(pieces: &[Option<&Warped>]) -> Vec<Vec<usize>> {
    let mut groups: Vec<Vec<usize>> = Vec::new();
    for k in 0..pieces.len() {
        match groups.iter_mut().find(|group| group.iter().all(|&other| !touch(pieces, k, other))) {
            Some(group) => group.push(k),
            None => groups.push(vec![k]),
        }
    }
    groups
}

/// Capacity that no cut can afford.
const NEVER: i32 = 1 << 28;

/// The pixels that `alpha` should take over, by index.
fn expand_one(
    labels: &Labels,
    pieces: &[Option<&Warped>],
    alpha: usize,
    unary: impl Fn(usize, usize, usize) -> i32 + Sync,
    differ: impl Fn(usize, usize, usize, usize) -> i32 + Sync,
    free: impl Fn(usize, usize) -> bool + Sync,
) -> Vec<usize> {
    let Some(own) = pieces[alpha] else { return Vec::new() };
    let Some(b) = own.bounds.intersection(&Bounds { left: 0, top: 0, right: labels.width, bottom: labels.height })
    else {
        return Vec::new();
    };
    // A pixel may switch where it is free, alpha reaches it, and it shows something else.
    let may = |x: usize, y: usize| {
        let label = labels.at(x, y);
        label != NONE && usize::from(label) != alpha && free(x, y) && own.reaches(x, y)
    };
    let mut any: Option<Bounds> = None;
    for y in b.top..b.bottom {
        for x in b.left..b.right {
            if may(x, y) {
                let a = any.get_or_insert(Bounds { left: x, top: y, right: x + 1, bottom: y + 1 });
                (a.left, a.right, a.bottom) = (a.left.min(x), a.right.max(x + 1), y + 1);
            }
        }
    }
    let Some(b) = any else { return Vec::new() };
    let (w, h) = (b.width(), b.height());
    // How alpha and what is shown differ at each pixel: most edges run between pixels of one label and need just this.
    let mut shown = vec![0; w * h];
    shown.par_chunks_mut(w).enumerate().for_each(|(row, out)| {
        let y = b.top + row;
        for (x, out) in (b.left..).zip(out) {
            let label = labels.at(x, y);
            if label != NONE && usize::from(label) != alpha {
                *out = differ(alpha, usize::from(label), x, y);
            }
        }
    });
    let from_alpha = |c: usize, x: usize, y: usize| {
        let inside = x >= b.left && y >= b.top && x < b.right && y < b.bottom;
        if inside && usize::from(labels.at(x, y)) == c {
            shown[(y - b.top) * w + x - b.left]
        } else {
            differ(alpha, c, x, y)
        }
    };
    let mut cut = GridCut::new(w, h);
    // Source side: keeps its label. Sink side: becomes alpha.
    for y in b.top..b.bottom {
        for x in b.left..b.right {
            let mine = may(x, y);
            let label = labels.at(x, y);
            let (i, j) = (x - b.left, y - b.top);
            if mine {
                cut.add_terminal(i, j, unary(alpha, x, y), unary(usize::from(label), x, y));
            }
            for (nx, ny) in [(x + 1, y), (x, y + 1)] {
                if nx >= labels.width || ny >= labels.height {
                    continue;
                }
                let other = labels.at(nx, ny);
                if label == NONE || other == NONE {
                    continue;
                }
                let inside = nx < b.right && ny < b.bottom;
                let theirs = inside && may(nx, ny);
                if !mine && !theirs {
                    continue;
                }
                let (p, q) = (usize::from(label), usize::from(other));
                let keep = if p == q { 0 } else { STEP + differ(p, q, x, y) + differ(p, q, nx, ny) };
                let pay = |c: usize| if c == alpha { 0 } else { STEP + from_alpha(c, x, y) + from_alpha(c, nx, ny) };
                // Cost where only the first, or only the second, becomes alpha.
                let (first, second) = (pay(q), pay(p));
                match (mine, theirs) {
                    (true, true) => {
                        // E(keep, keep) ≤ E(alpha, keep) + E(keep, alpha) holds for differences; at borders it is made to.
                        let (first, second) =
                            if keep > first + second { (first, keep - first) } else { (first, second) };
                        // E = keep·[both keep] + first·[first only] + second·[second only], as terminals and one arc:
                        // first's switching costs (first − keep), second's then costs −first, and splitting pays the rest.
                        add_signed(&mut cut, i, j, first - keep);
                        add_signed(&mut cut, nx - b.left, ny - b.top, -first);
                        let arc = first + second - keep;
                        // Paid where the first keeps (source) and the second switches (sink).
                        if ny == y { cut.add_right(i, j, arc, 0) } else { cut.add_down(i, j, arc, 0) }
                    }
                    // A fixed neighbor is a cost of the free one alone.
                    (true, false) => add_signed(&mut cut, i, j, first - keep),
                    (false, _) => add_signed(&mut cut, nx - b.left, ny - b.top, second - keep),
                }
            }
        }
    }
    // Neighbors to the left of and above the box are fixed too.
    for (x, y, nx, ny) in (b.top..b.bottom)
        .filter(|_| b.left > 0)
        .map(|y| (b.left, y, b.left - 1, y))
        .chain((b.left..b.right).filter(|_| b.top > 0).map(|x| (x, b.top, x, b.top - 1)))
    {
        let (label, other) = (labels.at(x, y), labels.at(nx, ny));
        if !may(x, y) || other == NONE {
            continue;
        }
        let pay = |a: usize, c: usize| {
            if a == c { 0 } else { STEP + differ(a, c, x, y) + differ(a, c, nx, ny) }
        };
        add_signed(
            &mut cut,
            x - b.left,
            y - b.top,
            pay(alpha, usize::from(other)) - pay(usize::from(label), usize::from(other)),
        );
    }
    cut.solve();
    let mut changed = Vec::new();
    for y in b.top..b.bottom {
        for x in b.left..b.right {
            if may(x, y) && cut.on_sink_side(x - b.left, y - b.top) {
                changed.push(y * labels.width + x);
            }
        }
    }
    changed
}

/// A cost (of either sign) of switching to alpha, that is, of being on the sink's side.
fn add_signed(cut: &mut GridCut, x: usize, y: usize, cost: i32) {
    cut.add_terminal(x, y, cost.clamp(0, NEVER), (-cost).clamp(0, NEVER));
}
