//! Real roots of polynomials.

use cv_numeric::{farthest_root_cubic, real_roots, real_roots_cubic, real_roots_quadratic, real_roots_quartic};
use proptest::prelude::*;

/// Coefficients of `lead · Π (x − r)`, times `Π (x² + p)` for complex pairs.
fn expand<const N: usize>(real: &[f64], complex: &[f64], lead: f64) -> [f64; N] {
    let mut c = vec![lead];
    let times = |c: &[f64], factor: &[f64]| {
        let mut out = vec![0.0; c.len() + factor.len() - 1];
        for (i, a) in c.iter().enumerate() {
            for (j, b) in factor.iter().enumerate() {
                out[i + j] += a * b;
            }
        }
        out
    };
    for r in real {
        c = times(&c, &[-r, 1.0]);
    }
    for p in complex {
        c = times(&c, &[*p, 0.3, 1.0]);
    }
    c.resize(N, 0.0);
    c.try_into().unwrap()
}

/// Well-separated roots, ascending.
fn separated(counts: &'static [usize]) -> impl Strategy<Value = Vec<f64>> {
    (-3.0..-1.0f64, proptest::sample::select(counts))
        .prop_flat_map(|(start, n)| (Just(start), proptest::collection::vec(0.2..1.5f64, n)))
        .prop_map(|(start, gaps)| {
            let next = |at: &mut f64, gap: &f64| {
                *at += gap;
                Some(*at)
            };
            gaps.iter().scan(start, next).collect()
        })
}

fn close(found: &[f64], expected: &[f64], tolerance: f64) -> bool {
    found.len() == expected.len()
        && found.iter().zip(expected).all(|(a, b)| (a - b).abs() <= tolerance * (1.0 + b.abs()))
}

proptest! {
    // Tolerances: the condition number of a root is its size over the product of the gaps, here at most 1e5 for degree ten and
    // 1e3 for degree four.
    #[test]
    fn quadratics(roots in separated(&[0, 2]), lead in 0.01..100.0f64) {
        let complex: &[f64] = if roots.is_empty() { &[1.0] } else { &[] };
        prop_assert!(close(&real_roots_quadratic(expand(&roots, complex, -lead)), &roots, 1e-12));
    }

    #[test]
    fn cubics(roots in separated(&[1, 3]), lead in 0.01..100.0f64) {
        let complex: &[f64] = if roots.len() == 1 { &[0.7] } else { &[] };
        let found = real_roots_cubic(expand(&roots, complex, lead));
        prop_assert!(close(&found, &roots, 1e-11), "{found:?} {roots:?}");
    }

    #[test]
    fn farthest_root_of_cubics(roots in separated(&[1, 3]), lead in 0.01..100.0f64) {
        // The complex pair has real part -0.15, above all single roots.
        let complex: &[f64] = if roots.len() == 1 { &[0.7] } else { &[] };
        let mean = roots.iter().sum::<f64>() / roots.len() as f64;
        let expected = roots.iter().copied().fold(f64::NAN, |best, r| if (best - mean).abs() > (r - mean).abs() { best } else { r });
        let found = farthest_root_cubic(expand(&roots, complex, lead)).unwrap();
        // A tie where two roots are equally far from the middle one.
        let tie = roots.len() == 3 && (roots[1] - mean).abs() < 1e-9;
        prop_assert!(tie || close(&[found], &[expected], 1e-11), "{found} {roots:?}");
    }

    #[test]
    fn quartics(roots in separated(&[0, 2, 4]), lead in 0.01..100.0f64) {
        let complex = &[0.7, 2.5][..(4 - roots.len()) / 2];
        let found = real_roots_quartic(expand(&roots, complex, lead));
        prop_assert!(close(&found, &roots, 1e-10), "{found:?} {roots:?}");
    }

    #[test]
    fn degree_ten(roots in separated(&[0, 2, 4, 6, 8]), lead in 0.01..100.0f64) {
        let complex = &[0.7, 2.5, 0.1, 5.0, 1.3][..(10 - roots.len()) / 2];
        let found = real_roots::<11>(&expand(&roots, complex, lead));
        prop_assert!(close(&found, &roots, 1e-7), "{found:?} {roots:?}");
    }

    #[test]
    fn polynomials_of_lower_degree(roots in separated(&[1, 2, 3, 4])) {
        prop_assert!(close(&real_roots::<11>(&expand(&roots, &[], 1.0)), &roots, 1e-10));
    }
}

#[test]
fn symmetric_polynomials_have_irregular_chains() {
    // x¹⁰ − 1: the derivative divides all but the last term.
    let mut c = [0.0; 11];
    (c[0], c[10]) = (-1.0, 1.0);
    assert!(close(&real_roots(&c), &[-1.0, 1.0], 1e-14));
    // (x² − 1)(x² − 4), a quadratic in x².
    assert!(close(&real_roots_quartic([4.0, 0.0, -5.0, 0.0, 1.0]), &[-2.0, -1.0, 1.0, 2.0], 1e-14));
    assert!(close(&real_roots(&[4.0, 0.0, -5.0, 0.0, 1.0]), &[-2.0, -1.0, 1.0, 2.0], 1e-14));
    assert!(close(&real_roots_cubic([0.0, -1.0, 0.0, 1.0]), &[-1.0, 0.0, 1.0], 1e-14));
    assert!(close(&real_roots_cubic([-8.0, 0.0, 0.0, 1.0]), &[2.0], 1e-14));
    // Three equal roots: rounding of the coefficients perturbs them by its cube root.
    assert_eq!(farthest_root_cubic([0.0, 0.0, 0.0, 1.0]).map(|x| x.abs() < 1e-45), Some(true));
    assert!((farthest_root_cubic([-0.001, 0.03, -0.3, 1.0]).unwrap() - 0.1).abs() < 1e-5);
}

#[test]
fn a_large_root_does_not_degrade_the_others() {
    let roots = [0.62, 1.41, 38675.0];
    assert!(close(&real_roots_cubic(expand(&roots, &[], -6e-7)), &roots, 1e-10));
}

#[test]
fn a_double_root_survives_rounding() {
    // 0.3 (x − a)² with rounded coefficients: for one a in four the discriminant is negative.
    for i in 1..200 {
        let a = 1.0 + f64::from(i) / 97.0;
        let roots = real_roots_quadratic([0.3 * a * a, -0.6 * a, 0.3]);
        assert!(close(&roots, &[a, a], 1e-7), "{a} {roots:?}");
    }
    assert!(real_roots_quadratic([1.0 + 1e-14, -2.0, 1.0]).is_empty());
}

#[test]
fn constant_and_non_finite_polynomials_have_no_roots() {
    assert!(real_roots(&[0.0; 11]).is_empty() && real_roots(&[3.0, 0.0, 0.0]).is_empty());
    assert!(real_roots(&[f64::NAN; 5]).is_empty() && real_roots_quartic([f64::NAN; 5]).is_empty());
    assert!(real_roots_cubic([1.0, 0.0, 0.0, 0.0]).is_empty() && farthest_root_cubic([1.0, 0.0, 0.0, 0.0]).is_none());
    assert!(farthest_root_cubic([f64::NAN; 4]).is_none() && farthest_root_cubic([f64::NAN, 0.0, 0.0, 1.0]).is_none());
    assert!(farthest_root_cubic([1.0, 0.0, 1.0, 0.0]).is_none() && farthest_root_cubic([1e308; 4]).is_some());
}
