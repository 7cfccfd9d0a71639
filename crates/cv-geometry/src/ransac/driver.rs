//! The RANSAC loop.

use super::quality::Quality;
use super::{
    Consensus, Estimator, LocalOptimization, RansacData, RobustOptions, Sampler, Score, Scorer, TukeyBiweight,
};
use cv_core::{Cancelled, Progress, Stage};
use cv_numeric::parallel_map;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Samples that are judged together, by one thread.
const CHUNK: usize = 16;
/// Most samples of a batch, and those from which on it is spread over threads: below, it is done before a thread wakes up.
const MOST: usize = 256;
/// Data from which on any batch is spread over threads.
const PARALLEL_FROM: usize = 8192;
/// Minimal models kept to be searched around, should the samples run out before the confidence is reached.
const RUNNERS_UP: usize = 32;
/// Steps of a local optimization inside the loop, and at the end.
pub(super) const LOCAL_STEPS: usize = 5;
const FINAL_STEPS: usize = 20;
/// The scale of Tukey's biweight, in standard deviations, at which it is 95 % as good as least squares on Gaussian errors (Huber &
/// Ronchetti, "Robust statistics", 2009).
const BIWEIGHT: f64 = 4.685;

/// A model and how well it fits.
#[derive(Clone)]
pub(super) struct ScoredModel<M> {
    pub(super) model: M,
    pub(super) score: Score,
}

/// The best model of a chunk, and the sample it is made of.
#[derive(Clone)]
struct Winner<M> {
    found: ScoredModel<M>,
    sample: [u32; 8],
}

/// Draws samples until enough were drawn. Every minimal model that is the best so far is locally optimized on the same loss it is judged by. (Not only
/// one that beats the optimized: noise lets hardly any minimal model do that.) A model is given up as soon as its loss is too large to
/// matter, which never changes the result.
///
/// Batches grow with the number of samples drawn, and each is judged by what was known before it, so the result does not depend on how it is
/// spread over threads.
pub(super) fn search<E: Estimator, C: Scorer>(
    quality: &Quality<'_, E, C>,
    sampler: &mut dyn Sampler,
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<Option<Consensus<E::Model>>, Cancelled> {
    let n = quality.estimator.data().count();
    let mut best: Option<ScoredModel<E::Model>> = None;
    let mut minimal = f32::INFINITY;
    let mut waiting: Vec<Winner<E::Model>> = Vec::new();
    let mut samples = Vec::with_capacity(MOST);
    let mut models = Vec::new();
    let mut rng = ChaCha8Rng::seed_from_u64(!options.seed);
    let around = E::RESAMPLES > 0 && options.local_optimization == LocalOptimization::InnerRansac;
    let mut iterations = 0;
    // Of few data there are few samples: of the smallest support that counts, one is soon drawn.
    let most = options.needed(n.min(E::SAMPLE + 1), n, E::SAMPLE);
    let mut needed = most;
    while iterations < needed {
        let count = (iterations / 8).clamp(CHUNK, MOST).min(needed - iterations);
        samples.resize(count, [0u32; 8]);
        for sample in &mut samples {
            sampler.draw(&mut sample[..E::SAMPLE]);
        }
        // As far as this confidence: a better model may end it sooner.
        let stage = Samples { progress, drawn: iterations, needed };
        iterations += count;
        let limit = match waiting.get(RUNNERS_UP - 1) {
            Some(last) => last.found.score.loss,
            None if around => f32::INFINITY,
            None => minimal,
        };
        let winners: Vec<Result<Option<Winner<E::Model>>, Cancelled>> = if n < PARALLEL_FROM && count < MOST {
            samples.chunks(CHUNK).map(|chunk| best_of(quality, chunk, limit, &mut models, &stage)).collect()
        } else {
            let chunks: Vec<&[[u32; 8]]> = samples.chunks(CHUNK).collect();
            parallel_map(chunks.len(), &|i| best_of(quality, chunks[i], limit, &mut Vec::new(), &stage))
        };
        for winner in winners {
            let Some(winner) = winner? else { continue };
            if winner.found.score.loss >= minimal {
                if around {
                    let at = waiting.partition_point(|w| w.found.score.loss <= winner.found.score.loss);
                    waiting.insert(at, winner);
                    waiting.truncate(RUNNERS_UP);
                }
                continue;
            }
            minimal = winner.found.score.loss;
            let mut found = optimized(quality, winner, &mut models, &stage)?;
            if around {
                quality.inner_ransac(&mut found, &mut rng, &mut models, &stage)?;
            }
            if best.as_ref().is_none_or(|b| found.score.loss < b.score.loss) {
                needed = options.needed(found.score.inliers as usize, n, E::SAMPLE).min(most);
                best = Some(found);
            }
        }
    }
    let Some(mut best) = best else { return Ok(None) };
    let stage = Stage::new(progress, "best models", waiting.len())?;
    if iterations == most {
        let searched = |k: usize| {
            let (mut rng, mut models) = (rng.clone(), Vec::new());
            rng.set_stream(k as u64 + 1);
            let mut found = optimized(quality, waiting[k].clone(), &mut models, &stage)?;
            quality.inner_ransac(&mut found, &mut rng, &mut models, &stage)?;
            stage.add(1)?;
            Ok(found)
        };
        for found in parallel_map(waiting.len(), &searched) {
            let found: ScoredModel<E::Model> = found?;
            if found.score.loss < best.score.loss {
                best = found;
            }
        }
    }
    let model = settle(quality, best, around.then_some(&mut rng), &mut models, &stage)?;
    let score = quality.score(&model, f32::INFINITY);
    Ok(Some(Consensus { model, score, iterations, log_nfa: None }))
}

/// Samples drawn of those needed so far; whatever is done for one of them shows as that.
struct Samples<'a> {
    progress: &'a dyn Progress,
    drawn: usize,
    needed: usize,
}

impl Progress for Samples<'_> {
    fn report(&self, _: &'static str, _: usize, _: usize) -> Result<(), Cancelled> {
        self.progress.report("samples", self.drawn, self.needed)
    }
}

/// The minimal model or the best of its alternatives, both locally optimized.
fn optimized<E: Estimator, C: Scorer>(
    quality: &Quality<'_, E, C>,
    winner: Winner<E::Model>,
    models: &mut Vec<E::Model>,
    progress: &dyn Progress,
) -> Result<ScoredModel<E::Model>, Cancelled> {
    let Winner { mut found, sample } = winner;
    progress.report("local optimization", 0, 1)?;
    models.clear();
    quality.estimator.alternatives(&found.model, &sample[..E::SAMPLE], quality.threshold, models);
    quality.refine_best(&mut found, LOCAL_STEPS);
    let mut other: Option<ScoredModel<E::Model>> = None;
    for model in models.drain(..) {
        let score = quality.score(&model, other.as_ref().map_or(f32::INFINITY, |o| o.score.loss));
        if other.as_ref().is_none_or(|o| score.loss < o.score.loss) {
            other = Some(ScoredModel { model, score });
        }
    }
    if let Some(mut other) = other {
        quality.refine_best(&mut other, LOCAL_STEPS);
        if other.score.loss < found.score.loss {
            found = other;
        }
    }
    Ok(found)
}

/// Refines, and searches `around` the model, with the noise that the data show instead of the threshold they were searched with: small noise leaves room for
/// wrong data that happen to fit and for other minima, large noise loses right data. Twice: a third round changes the model by less than a
/// tenth of its deviation.
fn settle<E: Estimator, C: Scorer>(
    quality: &Quality<'_, E, C>,
    mut best: ScoredModel<E::Model>,
    mut around: Option<&mut ChaCha8Rng>,
    models: &mut Vec<E::Model>,
    progress: &dyn Progress,
) -> Result<E::Model, Cancelled> {
    // The scale of the last round is the one to converge at.
    for steps in [LOCAL_STEPS, FINAL_STEPS] {
        progress.report("local optimization", 0, 1)?;
        let Some(sigma) = quality.noise(&best.model) else {
            // Too few data for a noise of their own.
            best.score = quality.score(&best.model, f32::INFINITY);
            quality.refine_best(&mut best, FINAL_STEPS);
            break;
        };
        let threshold = BIWEIGHT * sigma * quality.threshold / TukeyBiweight.cutoff().sqrt();
        let fine = Quality::new(quality.estimator, &TukeyBiweight, threshold);
        best.score = fine.score(&best.model, f32::INFINITY);
        fine.refine_best(&mut best, steps);
        if let Some(rng) = &mut around {
            fine.inner_ransac(&mut best, rng, models, progress)?;
            fine.refine_best(&mut best, steps);
        }
    }
    Ok(best.model)
}

/// The model of least loss below `limit` of all samples; the earliest of equals.
fn best_of<E: Estimator, C: Scorer>(
    quality: &Quality<'_, E, C>,
    samples: &[[u32; 8]],
    mut limit: f32,
    models: &mut Vec<E::Model>,
    progress: &dyn Progress,
) -> Result<Option<Winner<E::Model>>, Cancelled> {
    // Of much data, each sample takes its time.
    let every = if quality.estimator.data().count() < PARALLEL_FROM { CHUNK } else { 1 };
    let mut best = None;
    for (i, sample) in samples.iter().enumerate() {
        if i.is_multiple_of(every) {
            progress.report("samples", 0, 0)?;
        }
        models.clear();
        quality.estimator.solve(&sample[..E::SAMPLE], models);
        for model in models.drain(..) {
            let score = quality.score(&model, limit);
            if score.loss < limit {
                limit = score.loss;
                best = Some(Winner { found: ScoredModel { model, score }, sample: *sample });
            }
        }
    }
    Ok(best)
}
