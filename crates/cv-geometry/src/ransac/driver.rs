//! The RANSAC driver.

use super::quality::Quality;
use super::{
    Consensus, Estimator, LocalOptimization, RansacData, RobustOptions, Sampler, Score, Scorer, Scoring, TukeyBiweight,
};
use cv_core::{Cancelled, Progress, Stage};
use cv_parallel::prelude::*;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;

/// Samples per task of one thread.
const CHUNK: usize = 16;
/// Maximum number of samples of a batch, and the number from which it is evaluated in parallel: smaller ones are done
/// before a thread wakes up.
const MAX_BATCH: usize = 256;
/// Number of data from which every batch is evaluated in parallel.
const MIN_PARALLEL_DATA: usize = 8192;
/// Number of runner-up minimal models that are locally optimized if the maximum number of samples is reached before the
/// confidence.
const MAX_RUNNERS_UP: usize = 32;
/// Maximum refinement steps of a local optimization inside the loop, and at the end.
pub(super) const LOCAL_STEPS: usize = 5;
const FINAL_STEPS: usize = 20;
/// Tuning constant of Tukey's biweight in standard deviations, for 95 % efficiency on Gaussian errors (Huber &
/// Ronchetti, "Robust statistics", 2009).
const BIWEIGHT_SCALE: f64 = 4.685;

/// A model and its score.
#[derive(Clone)]
pub(super) struct ScoredModel<M> {
    pub(super) model: M,
    pub(super) score: Score,
}

/// The best model of a chunk, and its minimal sample.
#[derive(Clone)]
struct Candidate<M> {
    scored: ScoredModel<M>,
    sample: [u32; 8],
}

/// Runs the sampling loop until the termination criterion holds. Every minimal model that is better than all minimal
/// models so far is locally optimized on the scoring loss. (Comparing with the best optimized model instead would skip
/// nearly all of them, because of noise.) Scoring stops early when the loss exceeds that of the best, which never
/// changes the result.
///
/// Batches grow with the number of samples drawn. The bounds used in a batch are those from before it, so the result
/// does not depend on its distribution over threads.
pub(super) fn search<E: Estimator>(
    quality: &Quality<'_, E>,
    sampler: &mut dyn Sampler,
    options: &RobustOptions,
    progress: &dyn Progress,
) -> Result<Option<Consensus<E::Model>>, Cancelled> {
    let n = quality.estimator.data().count();
    let mut best: Option<ScoredModel<E::Model>> = None;
    let mut best_minimal_loss = f32::INFINITY;
    let mut runners_up: Vec<Candidate<E::Model>> = Vec::new();
    let mut samples = Vec::with_capacity(MAX_BATCH);
    let mut models = Vec::new();
    let mut rng = ChaCha8Rng::seed_from_u64(!options.seed);
    let inner_ransac = E::INNER_SAMPLES > 0 && options.local_optimization == LocalOptimization::InnerRansac;
    let mut iterations = 0;
    // Few data have few distinct samples: this is enough for the smallest support that counts.
    let max_samples = options.samples_needed(n.min(E::SAMPLE_SIZE + 1), n, E::SAMPLE_SIZE);
    let mut needed = max_samples;
    while iterations < needed {
        let count = (iterations / 8).clamp(CHUNK, MAX_BATCH).min(needed - iterations);
        samples.resize(count, [0u32; 8]);
        for sample in &mut samples {
            sampler.draw(&mut sample[..E::SAMPLE_SIZE]);
        }
        // Progress relative to the current number needed, which a better model may reduce.
        let stage = Samples { progress, drawn: iterations, needed };
        iterations += count;
        let limit = match runners_up.get(MAX_RUNNERS_UP - 1) {
            Some(last) => last.scored.score.loss,
            None if inner_ransac => f32::INFINITY,
            None => best_minimal_loss,
        };
        let candidates: Vec<Result<Option<Candidate<E::Model>>, Cancelled>> = if n < MIN_PARALLEL_DATA
            && count < MAX_BATCH
        {
            samples.chunks(CHUNK).map(|chunk| best_of_samples(quality, chunk, limit, &mut models, &stage)).collect()
        } else {
            let chunks = samples.par_chunks(CHUNK);
            chunks.map_init(Vec::new, |models, chunk| best_of_samples(quality, chunk, limit, models, &stage)).collect()
        };
        for candidate in candidates {
            let Some(candidate) = candidate? else { continue };
            if candidate.scored.score.loss >= best_minimal_loss {
                if inner_ransac {
                    let at = runners_up.partition_point(|r| r.scored.score.loss <= candidate.scored.score.loss);
                    runners_up.insert(at, candidate);
                    runners_up.truncate(MAX_RUNNERS_UP);
                }
                continue;
            }
            best_minimal_loss = candidate.scored.score.loss;
            let mut optimized = optimize_locally(quality, candidate, &mut models, &stage)?;
            if inner_ransac {
                quality.inner_ransac(&mut optimized, &mut rng, &mut models, &stage)?;
            }
            if best.as_ref().is_none_or(|b| optimized.score.loss < b.score.loss) {
                needed = options.samples_needed(optimized.score.inliers as usize, n, E::SAMPLE_SIZE).min(max_samples);
                best = Some(optimized);
            }
        }
    }
    let Some(mut best) = best else { return Ok(None) };
    let stage = Stage::new(progress, "best models", runners_up.len())?;
    if iterations == max_samples {
        let optimize = |k: usize| {
            let (mut rng, mut models) = (rng.clone(), Vec::new());
            rng.set_stream(k as u64 + 1);
            let mut optimized = optimize_locally(quality, runners_up[k].clone(), &mut models, &stage)?;
            quality.inner_ransac(&mut optimized, &mut rng, &mut models, &stage)?;
            stage.add(1)?;
            Ok(optimized)
        };
        for optimized in (0..runners_up.len()).into_par_iter().map(optimize).collect() {
            let optimized: ScoredModel<E::Model> = optimized?;
            if optimized.score.loss < best.score.loss {
                best = optimized;
            }
        }
    }
    let model = refine_with_estimated_noise(quality, best, inner_ransac.then_some(&mut rng), &mut models, &stage)?;
    let score = quality.score(&model, f32::INFINITY);
    Ok(Some(Consensus { model, score, iterations, log_nfa: None }))
}

/// Progress in samples: reports of any stage are forwarded as the number of samples drawn of those needed.
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

/// Returns the locally optimized minimal model, or its best locally optimized alternative if that is better.
fn optimize_locally<E: Estimator>(
    quality: &Quality<'_, E>,
    candidate: Candidate<E::Model>,
    models: &mut Vec<E::Model>,
    progress: &dyn Progress,
) -> Result<ScoredModel<E::Model>, Cancelled> {
    let Candidate { scored: mut best, sample } = candidate;
    progress.report("local optimization", 0, 1)?;
    models.clear();
    quality.estimator.alternatives(&best.model, &sample[..E::SAMPLE_SIZE], quality.threshold, models);
    quality.refine_best(&mut best, LOCAL_STEPS);
    let mut other: Option<ScoredModel<E::Model>> = None;
    for model in models.drain(..) {
        let score = quality.score(&model, other.as_ref().map_or(f32::INFINITY, |o| o.score.loss));
        if other.as_ref().is_none_or(|o| score.loss < o.score.loss) {
            other = Some(ScoredModel { model, score });
        }
    }
    if let Some(mut other) = other {
        quality.refine_best(&mut other, LOCAL_STEPS);
        if other.score.loss < best.score.loss {
            best = other;
        }
    }
    Ok(best)
}

/// Refines the model (with inner RANSAC if `rng` is given) with a loss scaled to the estimated noise instead of the
/// threshold: a threshold too large for the noise admits outliers and other minima, one too small loses inliers. Two
/// rounds: a third changes the model by less than a tenth of its standard deviation.
fn refine_with_estimated_noise<E: Estimator>(
    quality: &Quality<'_, E>,
    mut best: ScoredModel<E::Model>,
    mut rng: Option<&mut ChaCha8Rng>,
    models: &mut Vec<E::Model>,
    progress: &dyn Progress,
) -> Result<E::Model, Cancelled> {
    // Only the last round needs to converge.
    for steps in [LOCAL_STEPS, FINAL_STEPS] {
        progress.report("local optimization", 0, 1)?;
        let Some(sigma) = quality.noise(&best.model) else {
            // Too few inliers to estimate the noise.
            best.score = quality.score(&best.model, f32::INFINITY);
            quality.refine_best(&mut best, FINAL_STEPS);
            break;
        };
        let threshold = BIWEIGHT_SCALE * sigma * quality.threshold / TukeyBiweight.cutoff().sqrt();
        let rescaled = Quality::new(quality.estimator, Scoring::TukeyBiweight, threshold);
        best.score = rescaled.score(&best.model, f32::INFINITY);
        rescaled.refine_best(&mut best, steps);
        if let Some(rng) = &mut rng {
            rescaled.inner_ransac(&mut best, rng, models, progress)?;
            rescaled.refine_best(&mut best, steps);
        }
    }
    Ok(best.model)
}

/// Returns the model of minimum loss below `limit` of all samples; the earliest on ties.
fn best_of_samples<E: Estimator>(
    quality: &Quality<'_, E>,
    samples: &[[u32; 8]],
    mut limit: f32,
    models: &mut Vec<E::Model>,
    progress: &dyn Progress,
) -> Result<Option<Candidate<E::Model>>, Cancelled> {
    // Samples between checks for cancellation.
    let check_interval = if quality.estimator.data().count() < MIN_PARALLEL_DATA { CHUNK } else { 1 };
    let mut best = None;
    for (i, sample) in samples.iter().enumerate() {
        if i.is_multiple_of(check_interval) {
            progress.report("samples", 0, 0)?;
        }
        models.clear();
        quality.estimator.solve(&sample[..E::SAMPLE_SIZE], models);
        for model in models.drain(..) {
            let score = quality.score(&model, limit);
            if score.loss < limit {
                limit = score.loss;
                best = Some(Candidate { scored: ScoredModel { model, score }, sample: *sample });
            }
        }
    }
    Ok(best)
}
