//! People in panoramas of generated photographs: each is whole or absent.

use super::panorama_truth::true_ray;
use anyhow::Result;
use cv_core::Camera;
use cv_pipeline::{PanoramaOptions, PanoramaPhoto, PanoramaResult, Silent, panorama};
use cv_synth::{Vista, VistaOptions, VistaPhoto, vista_photos};

/// Number of generated sets of eight photographs of ±1 EV with a person at another place in every one.
pub(super) const SETS: u64 = 50;
/// Minimum share of a person's pixels of a whole one, and of the pixels without it of an absent one: what is left are the pixels of a transition at the outline.
const MIN_SHARE: f64 = 0.95;
/// Minimum number of pixels of a person that is counted: a part of the others is where another person stands.
const MIN_PIXELS: usize = 200;

/// Results over all sets.
#[derive(Debug, Default, Clone, Copy)]
pub(super) struct People {
    /// Sets in which every person is whole or absent.
    pub(super) sets: usize,
    pub(super) whole: usize,
    pub(super) absent: usize,
    pub(super) cut: usize,
}

pub(super) fn measure() -> Result<People> {
    let mut people = People::default();
    for seed in 1..=SETS {
        let camera = Camera::from_focal(640, 480, 600.0);
        let options = VistaOptions { walker: true, samples: 1, ..VistaOptions::default() };
        let photos = vista_photos(&Vista::new(seed, 150.0), seed, &camera, &options)?;
        let inputs: Vec<PanoramaPhoto<'_>> = photos.iter().map(|p| PanoramaPhoto::new(p.image.view())).collect();
        let result = panorama(&inputs, &PanoramaOptions::default(), &Silent)?;
        let mut is_right = result.images.iter().all(|image| image.used);
        for (person, shown) in shown_shares(&photos, &result).into_iter().enumerate() {
            match shown {
                Some(share) if share >= MIN_SHARE => people.whole += 1,
                Some(share) if share <= 1.0 - MIN_SHARE => people.absent += 1,
                Some(share) => {
                    println!("  seed {seed}: {share:.2} of the person of photograph {person} is shown");
                    people.cut += 1;
                    is_right = false;
                }
                None => {}
            }
        }
        people.sets += usize::from(is_right);
    }
    Ok(people)
}

/// Computes for the person of each photograph the share of its pixels in the panorama that show it; without those at its outline and those where another
/// photograph shows another person. `None` for fewer than [`MIN_PIXELS`].
fn shown_shares(photos: &[VistaPhoto], result: &PanoramaResult) -> Vec<Option<f64>> {
    let mut counts = vec![(0_usize, 0_usize); photos.len()];
    let (w, h) = result.image.size();
    for (x, y) in (0..h).flat_map(|y| (0..w).map(move |x| (x, y))) {
        let Some(ray) = true_ray(photos, result, x as f64, y as f64) else { continue };
        // How many of the nine pixels around its place in each photograph show the person.
        let seen = photos.iter().map(|p| {
            let point = p.from_world * ray;
            let Some(pixel) = p.camera.project(&point.into()).filter(|_| point.z > 0.0) else { return 0 };
            let (u, v) = (pixel.x.round() as i64, pixel.y.round() as i64);
            let around = (-2..=2).step_by(2).flat_map(|dy| (-2..=2).step_by(2).map(move |dx| (u + dx, v + dy)));
            let inside = around.filter(|(u, v)| *u >= 0 && *v >= 0);
            inside.filter(|(u, v)| p.walker.get(*u as usize, *v as usize) == Some([true])).count()
        });
        let seen: Vec<usize> = seen.collect();
        if let Some(person) = seen.iter().position(|n| *n == 9)
            && seen.iter().filter(|n| **n > 0).count() == 1
        {
            let [r, g, b] = result.image.at(x, y).map(u32::from);
            counts[person].0 += 1;
            // The person is the only thing in the landscape that is this red.
            counts[person].1 += usize::from(2 * r > 3 * g.max(b));
        }
    }
    counts.into_iter().map(|(all, shown)| (all >= MIN_PIXELS).then(|| shown as f64 / all as f64)).collect()
}
