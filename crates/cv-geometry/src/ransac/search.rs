//! The loop.

use super::judge::Judge;
use super::{Consensus, Estimator, Marginal, RobustOptions, Sampler, Score, Scorer};
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::SeedableRng;
use rayon::prelude::*;

/// Samples of one batch. A batch is judged as a whole, so the result does not depend on how it is spread over threads.
const BATCH: usize = 16;
/// Data from which on a batch is spread over threads: below, a batch is done before a thread wakes up.
const PARALLEL_FROM: usize = 8192;
/// Steps of a local optimisation inside the loop, and at the end.
pub(super) const LOCAL_STEPS: usize = 5;
const FINAL_STEPS: usize = 20;
/// The scale of Tukey's biweight, in standard deviations, at which it is 95 % as good as least squares on Gaussian errors (Huber &
/// Ronchetti, "Robust statistics", 2009).
const BIWEIGHT: f64 = 4.685;
/// Rounds of noise and refinement at the end; a third changes the model by less than a tenth of its deviation.
const POLISH: usize = 2;

/// A model and how well it fits.
pub(super) struct Found<M> {
    pub(super) model: M,
    pub(super) score: Score,
}

/// The best model of a batch, and the sample it is made of.
struct Winner<M> {
    found: Found<M>,
    sample: [u32; 8],
}

/// Draws samples until enough were drawn. Every minimal model that is the best so far is locally optimised on the same loss it is judged by. (Not only
/// one that beats the optimised: noise lets hardly any minimal model do that.) A model is given up as soon as its loss exceeds that of the best
/// minimal one, which never changes the result.
pub(super) fn search<E: Estimator, C: Scorer, S: Sampler>(
    judge: &Judge<'_, E, C>,
    sampler: &mut S,
    options: &RobustOptions,
) -> Option<Consensus<E::Model>> {
    let estimator = judge.estimator;
    let n = estimator.count();
    let mut best: Option<Found<E::Model>> = None;
    let mut minimal = f32::INFINITY;
    let mut samples = vec![[0u32; 8]; BATCH];
    let mut models = Vec::new();
    let mut rng = ChaCha8Rng::seed_from_u64(!options.seed);
    let mut iterations = 0;
    let mut needed = options.max_iterations;
    while iterations < needed {
        let count = BATCH.min(needed - iterations);
        for sample in &mut samples[..count] {
            sampler.draw(&mut sample[..E::SAMPLE]);
        }
        iterations += count;
        let winner = if n < PARALLEL_FROM {
            best_of(judge, &samples[..count], minimal, &mut models)
        } else {
            let each = samples[..count].par_iter();
            each.map(|sample| best_of(judge, std::slice::from_ref(sample), minimal, &mut Vec::new()))
                .reduce(|| None, earlier_of_equals)
        };
        let Some(Winner { mut found, sample }) = winner else { continue };
        minimal = found.score.loss;
        models.clear();
        estimator.alternatives(&found.model, &sample[..E::SAMPLE], judge.threshold, &mut models);
        // The best alternative is optimised before it is compared: the model is too.
        let other = models.drain(..).fold(None, |best: Option<Found<E::Model>>, model| {
            let score = judge.score(&model, best.as_ref().map_or(f32::INFINITY, |b| b.score.loss));
            if best.as_ref().is_none_or(|b| score.loss < b.score.loss) { Some(Found { model, score }) } else { best }
        });
        judge.improve(&mut found, LOCAL_STEPS);
        if let Some(mut other) = other {
            judge.improve(&mut other, LOCAL_STEPS);
            if other.score.loss < found.score.loss {
                found = other;
            }
        }
        judge.explore(&mut found, &mut rng, &mut models);
        if best.as_ref().is_none_or(|b| found.score.loss < b.score.loss) {
            needed = options.needed(found.score.inliers as usize, n, E::SAMPLE);
            best = Some(found);
        }
    }
    let mut best = best?;
    judge.improve(&mut best, FINAL_STEPS);
    let model = settle(judge, best.model, &mut rng, &mut models);
    let score = judge.score(&model, f32::INFINITY);
    Some(Consensus { model, score, iterations })
}

/// Searches on, near the model, with the noise that the data show instead of the threshold they were searched with: small noise leaves room for
/// wrong data that happen to fit and for other minima, large noise loses right data.
fn settle<E: Estimator, C: Scorer>(
    judge: &Judge<'_, E, C>,
    mut model: E::Model,
    rng: &mut ChaCha8Rng,
    models: &mut Vec<E::Model>,
) -> E::Model {
    for _ in 0..POLISH {
        let Some(sigma) = judge.noise(&model) else { break };
        let threshold = BIWEIGHT * sigma * judge.threshold / Marginal.cutoff().sqrt();
        let fine = Judge::new(judge.estimator, &Marginal, threshold);
        let score = fine.score(&model, f32::INFINITY);
        let mut found = Found { model, score };
        fine.improve(&mut found, FINAL_STEPS);
        fine.explore(&mut found, rng, models);
        fine.improve(&mut found, FINAL_STEPS);
        model = found.model;
    }
    model
}

/// The model of least loss below `limit` of all samples; the earliest of equals.
fn best_of<E: Estimator, C: Scorer>(
    judge: &Judge<'_, E, C>,
    samples: &[[u32; 8]],
    mut limit: f32,
    models: &mut Vec<E::Model>,
) -> Option<Winner<E::Model>> {
    let mut best = None;
    for sample in samples {
        models.clear();
        judge.estimator.solve(&sample[..E::SAMPLE], models);
        for model in models.drain(..) {
            let score = judge.score(&model, limit);
            if score.loss < limit {
                limit = score.loss;
                best = Some(Winner { found: Found { model, score }, sample: *sample });
            }
        }
    }
    best
}

/// The better of two winners; of equals the earlier, as in one thread.
fn earlier_of_equals<M>(a: Option<Winner<M>>, b: Option<Winner<M>>) -> Option<Winner<M>> {
    match (&a, &b) {
        (Some(x), Some(y)) if y.found.score.loss < x.found.score.loss => b,
        (None, _) => b,
        _ => a,
    }
}
