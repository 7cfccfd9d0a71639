//! Segmentation and detection of balls.

use cv_core::{Camera, Mask, RgbU8, Silent};
use cv_pipeline::{detect, segment, train_segment};
use cv_segment::{ColorSpace, ConfusionMatrix, DetectOptions, Labeled, SegmentError, TrainOptions};
use cv_synth::{RenderOptions, ball_photos};

#[test]
fn a_ball_is_segmented_in_images_outside_the_training_set() {
    let camera = Camera::from_focal(240, 180, 220.0);
    for seed in [3, 4] {
        let photos = ball_photos(seed, 8, &camera, &RenderOptions::draft()).unwrap();
        let labeled: Vec<Labeled<'_>> = photos.iter().map(|p| (p.view.image.view(), p.mask.view())).collect();
        let half = |odd: usize| -> Vec<Labeled<'_>> { labeled.iter().copied().skip(odd).step_by(2).collect() };
        for space in [ColorSpace::Hsv, ColorSpace::Rgb, ColorSpace::Lab] {
            let options = TrainOptions { space, ..TrainOptions::default() };
            let model = train_segment(&half(0), &options, &Silent).unwrap().trained.model;
            let scores: ConfusionMatrix = half(1)
                .iter()
                .map(|(photo, mask)| {
                    ConfusionMatrix::new(segment(*photo, &model, &Silent).unwrap().mask.view(), *mask).unwrap()
                })
                .sum();
            // The requirement for generated scenes.
            assert!(scores.f1() >= 0.97, "seed {seed}, {space:?}: {} {scores:?}", scores.f1());
        }
    }
}

#[test]
fn an_object_of_the_same_color_and_another_shape_is_not_detected() {
    let camera = Camera::from_focal(240, 180, 220.0);
    let photos = ball_photos(5, 10, &camera, &RenderOptions::draft()).unwrap();
    let labeled: Vec<Labeled<'_>> = photos.iter().map(|p| (p.view.image.view(), p.mask.view())).collect();
    let half = |odd: usize| -> Vec<Labeled<'_>> { labeled.iter().copied().skip(odd).step_by(2).collect() };
    let model = train_segment(&half(0), &TrainOptions::default(), &Silent).unwrap().trained.model;
    for (photo, mask) in half(1) {
        let ball = detect(photo, &model, &DetectOptions::default(), &Silent).unwrap();
        let best = ball.objects[0];
        println!("ball {:?} {:?}", best.score, best.region);
        assert!(best.found, "{best:?}");
        assert_eq!(ball.mask, segment(photo, &model, &Silent).unwrap().mask);
        // The centroid of the true mask.
        let (mut sum, mut count) = ([0.0; 2], 0.0);
        for y in 0..mask.height() {
            for x in (0..mask.width()).filter(|&x| mask.row(y)[x]) {
                sum = [sum[0] + x as f64, sum[1] + y as f64];
                count += 1.0;
            }
        }
        let center = best.region.center;
        // A missing border of one pixel on one side moves the centroid by less than a pixel.
        assert!((center.x - sum[0] / count).hypot(center.y - sum[1] / count) < 1.0, "{best:?}");
        assert!((best.region.area as f64 / count - 1.0).abs() < 0.15, "{best:?}");
        // A bar with the ball's pixels on gray: the same colors, another shape.
        let colors: Vec<[u8; 3]> = (0..mask.height())
            .flat_map(|y| (0..mask.width()).map(move |x| (x, y)))
            .filter(|&(x, y)| mask.row(y)[x])
            .map(|(x, y)| photo.row(y).as_chunks::<3>().0[x])
            .collect();
        let bar_height = ((colors.len() as f64 / 5.0).sqrt() as usize).max(6);
        let bar_width = 5 * bar_height;
        let bar = RgbU8::from_fn(bar_width + 40, bar_height + 40, |x, y| {
            let inside = (20..20 + bar_width).contains(&x) && (20..20 + bar_height).contains(&y);
            if inside { colors[((y - 20) * bar_width + x - 20) % colors.len()] } else { [120, 118, 116] }
        });
        assert!(segment(bar.view(), &model, &Silent).unwrap().fraction > 0.0);
        let result = detect(bar.view(), &model, &DetectOptions::default(), &Silent).unwrap();
        println!("bar {:?} {:?}", result.objects[0].score, result.objects[0].region);
        assert!(!result.objects.is_empty() && result.objects.iter().all(|o| !o.found), "{:?}", result.objects);
        assert!(result.fraction == 0.0 && result.mask.as_slice().iter().all(|&m| !m));
        // With a minimum score of zero, all regions are detected.
        let all = detect(bar.view(), &model, &DetectOptions { min_score: 0.0 }, &Silent).unwrap();
        assert_eq!(all.mask, segment(bar.view(), &model, &Silent).unwrap().mask);
    }
    let wrong = detect(labeled[0].0, &model, &DetectOptions { min_score: f64::NAN }, &Silent);
    assert!(matches!(wrong, Err(SegmentError::Option(e)) if e.name == "min_score"));
}

#[test]
fn an_empty_image_has_an_empty_mask() {
    let photo = RgbU8::from_fn(8, 8, |x, _| if x < 4 { [200, 90, 20] } else { [40, 90, 200] });
    let mask = Mask::from_fn(8, 8, |x, _| [x < 4]);
    let model = train_segment(&[(photo.view(), mask.view())], &TrainOptions::default(), &Silent).unwrap().trained.model;
    let result = segment(RgbU8::new(0, 0, [0; 3]).view(), &model, &Silent).unwrap();
    assert!(result.mask.is_empty() && result.fraction == 0.0);
    let none = detect(RgbU8::new(0, 0, [0; 3]).view(), &model, &DetectOptions::default(), &Silent).unwrap();
    assert!(none.mask.is_empty() && none.fraction == 0.0 && none.objects.is_empty());
    let one = segment(RgbU8::new(1, 1, [200, 90, 20]).view(), &model, &Silent).unwrap();
    assert_eq!((one.mask.at(0, 0), one.fraction), ([true], 1.0));
}
