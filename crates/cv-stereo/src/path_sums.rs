//! Aggregation of given costs, without computing costs or selecting winners, for benchmarks.

use crate::aligned_buffer::AlignedBuffer;
use crate::border_mask::PairMasks;
use crate::cost::{Frame, Penalties};
use crate::kernel::{Output, Sweep};
use crate::layout::{Layout, place};
use crate::sgm::sweep;
use crate::{Paths, StereoError, StereoOptions};
use cv_core::{Cancelled, ImageView, Progress, Stage};
use fearless_simd::Level;

/// Semi-global path sums of given costs, for benchmarks: both sweeps over the whole image, each of which reads the costs and writes the
/// sums of its half of the paths.
#[derive(Debug)]
pub struct PathSums {
    options: StereoOptions,
    level: Level,
    layout: Layout,
    p2: Penalties,
    width: usize,
    height: usize,
    gray: Vec<u8>,
    costs: AlignedBuffer<u8>,
    sums: [AlignedBuffer<u8>; 2],
    sweeps: [Sweep; 2],
}

impl PathSums {
    /// Creates the sums of `cost(x, y, k)`, at index `k` of [`StereoOptions::disparities`], with penalties by `gray`. Costs may be as large
    /// as the number of bits of [`StereoOptions::census`].
    ///
    /// # Errors
    /// [`StereoError`] for options out of range.
    pub fn new(
        options: StereoOptions,
        gray: ImageView<'_, u8, 1>,
        cost: impl Fn(usize, usize, usize) -> u8,
    ) -> Result<Self, StereoError> {
        Self::at_level(Level::new(), options, gray, cost)
    }

    fn at_level(
        level: Level,
        options: StereoOptions,
        gray: ImageView<'_, u8, 1>,
        cost: impl Fn(usize, usize, usize) -> u8,
    ) -> Result<Self, StereoError> {
        options.validate()?;
        let (width, height) = gray.size();
        let layout = Layout::new(level, options.disparities);
        let volume = || {
            let mut volume = AlignedBuffer::default();
            volume.resize(width * height * layout.depth, u8::MAX);
            volume
        };
        let mut costs = volume();
        for (i, costs) in costs.as_mut_slice().chunks_exact_mut(layout.depth).enumerate() {
            for k in 0..options.disparities {
                costs[place(k, layout.group, layout.lanes)] = cost(i % width, i / width, k);
            }
        }
        let gray = (0..height).flat_map(|y| (0..width).map(move |x| gray.at(x, y)[0])).collect();
        let p2 = Penalties::new(&options);
        Ok(Self {
            options,
            level,
            layout,
            p2,
            width,
            height,
            gray,
            costs,
            sums: [volume(), volume()],
            sweeps: Default::default(),
        })
    }

    /// Computes the sums of all paths.
    ///
    /// # Errors
    /// [`Cancelled`].
    pub fn run(&mut self, progress: &dyn Progress) -> Result<(), Cancelled> {
        let stage = Stage::new(progress, "path sums", 2 * self.height)?;
        let frame = Frame {
            width: self.width,
            height: self.height,
            min_disparity: 0,
            disparities: self.options.disparities,
            layout: self.layout,
            planes: 0,
            left: &[],
            right: &[],
            priors: &[],
            masks: PairMasks::default(),
            given: Some(self.costs.as_mut_slice()),
            intensity_cap: None,
            gray: &self.gray,
            above: None,
            p1: self.options.p1,
            p2: &self.p2,
            second: false,
        };
        let eight = self.options.paths == Paths::Eight;
        let run = |state: &mut Sweep, sums: &mut AlignedBuffer<u8>, mirrored| {
            state.start(&frame, mirrored);
            sweep(self.level, &frame, state, 0..frame.height, Output::Store(sums.as_mut_slice()), eight, &stage)
        };
        let ([down, up], [down_sums, up_sums]) = (&mut self.sweeps, &mut self.sums);
        let (one, other) = rayon::join(|| run(down, down_sums, false), || run(up, up_sums, true));
        one.and(other)
    }

    /// Returns the sum of all paths at a pixel and index.
    pub fn at(&mut self, x: usize, y: usize, k: usize) -> u16 {
        let at = (y * self.width + x) * self.layout.depth + place(k, self.layout.group, self.layout.lanes);
        self.sums.iter_mut().map(|sums| u16::from(sums.as_mut_slice()[at])).sum()
    }

    /// Returns the bytes that [`PathSums::run`] reads and writes: the costs twice, and twice as many sums.
    pub fn traffic(&self) -> usize {
        4 * self.width * self.height * self.layout.depth
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use cv_core::{GrayU8, Silent};
    use cv_synth::instruction_sets;

    /// Computes path sums by definition, with one P2.
    fn sums_plain(size: (i64, i64), n: usize, cost: impl Fn(usize, usize, usize) -> u8, p1: u16, p2: u16) -> Vec<u16> {
        let (width, height) = size;
        let mut sums = vec![0; width as usize * height as usize * n];
        for (dx, dy) in [(-1, 0), (-1, -1), (0, -1), (1, -1), (1, 0), (1, 1), (0, 1), (-1, 1)] {
            for y in 0..height {
                for x in 0..width {
                    // The path that ends here, from where it enters the image.
                    let mut back = 0;
                    let inside = |s: i64| (0..width).contains(&(x + s * dx)) && (0..height).contains(&(y + s * dy));
                    while inside(back + 1) {
                        back += 1;
                    }
                    let mut path = vec![0; n];
                    for s in (0..=back).rev() {
                        let least = path.iter().copied().min().unwrap_or(0);
                        let step = |k: usize| {
                            let near = [k.checked_sub(1), Some(k + 1)];
                            let near = near.into_iter().flatten().filter_map(|k| path.get(k)).map(|v| v + p1);
                            let best = near.chain([path[k], least + p2]).min().unwrap_or(0);
                            u16::from(cost((x + s * dx) as usize, (y + s * dy) as usize, k)) + best - least
                        };
                        path = (0..n).map(step).collect();
                    }
                    for (sum, value) in sums[(y * width + x) as usize * n..].iter_mut().zip(path) {
                        *sum += value;
                    }
                }
            }
        }
        sums
    }

    #[test]
    fn path_sums_of_given_costs_are_those_by_definition_on_every_instruction_set() {
        let (width, height) = (37, 11);
        let cost = |x: usize, y: usize, k: usize| ((x * 7919 + y * 104_729 + k * 31 + x * k) % 97 % 25) as u8;
        let gray = GrayU8::from_fn(width, height, |_, _| [100]);
        // One group, with and without padding, and two.
        for disparities in [50, 128, 256] {
            let options = StereoOptions { disparities, ..Default::default() };
            let (p1, p2) = (u16::from(options.p1), u16::from(options.p2));
            let expected = sums_plain((width as i64, height as i64), disparities, cost, p1, p2);
            for level in instruction_sets() {
                let mut sums = PathSums::at_level(level, options.clone(), gray.view(), cost).unwrap();
                // Twice, so that state left by a run would show.
                for _ in 0..2 {
                    sums.run(&Silent).unwrap();
                }
                for (i, &expected) in expected.iter().enumerate() {
                    let (x, y, k) = (i / disparities % width, i / disparities / width, i % disparities);
                    assert_eq!(sums.at(x, y, k), expected, "{level:?}, {x} {y} {k}");
                }
            }
        }
    }
}
