//! Robust losses and their derivatives.

use cv_numeric::RobustLoss;
use proptest::prelude::*;

fn losses(scale: f64) -> [RobustLoss; 6] {
    [
        RobustLoss::Trivial,
        RobustLoss::Huber { scale },
        RobustLoss::Cauchy { scale },
        RobustLoss::Tukey { scale },
        RobustLoss::Truncated { scale },
        RobustLoss::GemanMcClure { scale },
    ]
}

proptest! {
    #[test]
    fn the_weight_is_the_derivative(scale in 0.1..10.0f64, ratio in 0.0..3.0f64) {
        // Away from the corner of the truncated loss, which has no derivative.
        prop_assume!((ratio - 1.0).abs() > 1e-3);
        let s = ratio * scale * scale;
        let h = 1e-6 * scale * scale;
        for loss in losses(scale) {
            let numeric = (loss.value(s + h) - loss.value((s - h).max(0.0))) / (s + h - (s - h).max(0.0));
            // A one-sided difference at s = 0 is off by h/2 times a second derivative of order 1/scale².
            prop_assert!((numeric - loss.weight(s)).abs() < 1e-5, "{loss:?} at {s}");
        }
    }

    #[test]
    fn the_curvature_is_the_second_derivative_along_the_residual(scale in 0.1..10.0f64, ratio in 0.05..3.0f64) {
        prop_assume!((ratio - 1.0).abs() > 1e-3);
        let r = ratio * scale;
        let h = 1e-4 * scale;
        for loss in losses(scale) {
            let value = |r: f64| loss.value(r * r);
            // Half the second derivative of ρ(r²).
            let numeric = (value(r + h) - 2.0 * value(r) + value(r - h)) / (2.0 * h * h);
            let exact = loss.weight(r * r) * loss.curvature(r * r);
            // Rounding of ρ over h² and h² of fourth derivatives of some tens over scale².
            prop_assert!((numeric - exact).abs() < 1e-5, "{loss:?} at {r}: {numeric} {exact}");
        }
    }
}

#[test]
fn every_loss_is_the_squared_residual_near_zero() {
    for loss in losses(2.0) {
        // ρ''(0)·s/2 is at most s/scale² relative.
        assert!((loss.value(1e-8) / 1e-8 - 1.0).abs() < 1e-7 && (loss.weight(0.0) - 1.0).abs() < 1e-12);
    }
}
