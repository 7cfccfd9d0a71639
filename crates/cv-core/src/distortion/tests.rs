use super::*;
use nalgebra::Vector2;
use proptest::prelude::*;

/// Lenses of every model with parameters of realistic size: the test points stay within their valid range.
pub(crate) fn examples() -> impl Strategy<Value = Distortion> {
    let unit = || -1.0..1.0f64;
    (0..DistortionModel::ALL.len(), prop::array::uniform12(unit())).prop_map(|(i, u)| {
        let model = DistortionModel::ALL[i];
        let fisheye = model.info().projection == LensProjection::Fisheye;
        let largest = |name: &str| match name {
            "k1" if fisheye => 0.05,
            "k2" | "k3" | "k4" if fisheye => 0.01,
            "k1" | "k4" => 0.15,
            "k2" | "k5" => 0.05,
            "k3" | "k6" | "p1" | "p2" | "s1" | "s3" => 0.01,
            "s2" | "s4" => 0.005,
            _ => panic!("how large is {name} of {model:?}?"),
        };
        let parameters: Vec<f64> = model.info().parameters.iter().zip(u).map(|(name, u)| u * largest(name)).collect();
        Distortion::new(model, &parameters).unwrap()
    })
}

/// Lenses with far stronger distortion than commercial ones, of either sign.
fn strong() -> impl Strategy<Value = Distortion> {
    (0..DistortionModel::ALL.len(), prop::array::uniform12(-1.0..1.0f64)).prop_map(|(i, u)| {
        let model = DistortionModel::ALL[i];
        // The tests below are about the radial part.
        let size = |name: &&str| if name.starts_with('k') { 1.0 } else { 0.0 };
        let parameters: Vec<f64> = model.info().parameters.iter().zip(u).map(|(name, u)| u * size(name)).collect();
        Distortion::new(model, &parameters).unwrap()
    })
}

proptest! {
    #[test]
    fn undistort_inverts_distort(lens in examples(), x in -0.7..0.7f64, y in -0.6..0.6f64) {
        let p = Point2::new(x, y);
        let back = lens.undistort(lens.distort(p));
        // Newton stops at 1e-13; the lens's derivative here is between 0.4 and 2.
        prop_assert!((back - p).norm() < 1e-12, "{back} for {p}");
        prop_assert_eq!(lens.distort_in_range(p), Some(lens.distort(p)));
    }

    #[test]
    fn a_strong_distortion_is_inverted_up_to_the_limit_of_its_range(lens in strong(), angle in 0.0..6.3f64, fraction in 0.0..0.999f64) {
        let direction = Vector2::new(angle.cos(), angle.sin());
        let end = lens.max_radius().min(20.0);
        let p = Point2::from(direction * (end * fraction));
        let q = lens.distort(p);
        let back = lens.undistort(q);
        // At fraction 0.999 the radial derivative is a few thousandths of that at the axis (for a fisheye at radius 20 also 1/400): a
        // Newton residual of 1e-13 becomes 1e-10, and flat spots on the way make ten times that.
        prop_assert!((lens.distort(back) - q).norm() < 1e-9 * (1.0 + q.coords.norm()), "{lens:?} {p} {back}");
        prop_assert!(back.coords.norm() < end * (1.0 + 1e-9));
        let (_, j) = lens.distort_with_jacobian(p);
        let slope = (j * direction).dot(&direction);
        prop_assert!((back - p).norm() < 1e-9 * (1.0 + end) / slope.min(1.0), "{lens:?} {p} {back}");
    }

    #[test]
    fn the_range_ends_at_the_turning_point_that_a_scan_finds(lens in strong()) {
        let end = lens.max_radius();
        let fisheye = lens.model().info().projection == LensProjection::Fisheye;
        // Along the angle for a fisheye, up to 90°.
        let ideal = |u: f64| if fisheye { u.tan() } else { u };
        let radius = |u: f64| lens.distort(Point2::new(ideal(u), 0.0)).x;
        let (step, last) = (1e-4, if fisheye { 1.57 } else { 6.0 });
        let mut before = 0.0;
        let mut turned = None;
        for i in 1..(last / step) as usize {
            let r = radius(i as f64 * step);
            // Beyond a pole the distorted radius is negative or decreasing.
            if r <= before {
                turned = Some(i as f64 * step);
                break;
            }
            before = r;
        }
        match turned {
            // The turning point is in one of the last two steps, or an earlier one too short for the scan.
            Some(u) => prop_assert!(end <= ideal(u) + 1e-9, "{end} {}", ideal(u)),
            None => prop_assert!(end > ideal(last - 2.0 * step) || flat(&lens, end), "{end}"),
        }
        if let Some(u) = turned {
            prop_assert!(end >= ideal(u - 2.0 * step) - 1e-9 || flat(&lens, end), "{end} {}", ideal(u));
        }
        // Points beyond are refused, whatever the polynomial does there.
        if end < 5.0 {
            prop_assert_eq!(lens.distort_in_range(Point2::new(end * 1.001 + 1e-6, 0.0)), None);
            prop_assert!(lens.distort_in_range(Point2::new(0.0, end * 0.999 - 1e-6)).is_some());
            let beyond = lens.distort(Point2::new(0.0, end * 1.05));
            let back = lens.undistort(beyond);
            prop_assert!(back.x.is_nan() || back.coords.norm() <= end * (1.0 + 1e-9), "{back}");
        }
    }

    #[test]
    fn the_jacobians_are_the_derivatives(lens in examples(), x in -0.7..0.7f64, y in -0.6..0.6f64) {
        let (h, p) = (1e-6, Point2::new(x, y));
        let (q, j, parameter_jacobian) = lens.distort_with_jacobians(p);
        prop_assert_eq!((q, j), lens.distort_with_jacobian(p));
        for (column, d) in [Vector2::new(h, 0.0), Vector2::new(0.0, h)].into_iter().enumerate() {
            let numeric = (lens.distort(p + d) - lens.distort(p - d)) / (2.0 * h);
            // Central differences: h² truncation plus 1e-16/h rounding.
            prop_assert!((numeric - j.column(column)).norm() < 1e-8);
        }
        for i in 0..MAX_PARAMETERS {
            let moved = |d: f64| {
                let mut lens = lens;
                lens.parameters_mut().get_mut(i).into_iter().for_each(|v| *v += d);
                lens.distort(p)
            };
            let numeric = (moved(h) - moved(-h)) / (2.0 * h);
            prop_assert!((numeric - parameter_jacobian.column(i)).norm() < 1e-8, "{i}");
        }
    }

    #[test]
    fn a_simplified_model_distorts_identically(lens in examples(), keep in 0usize..12, x in -0.7..0.7f64, y in -0.6..0.6f64) {
        let mut lens = lens;
        lens.parameters_mut().iter_mut().skip(keep).for_each(|v| *v = 0.0);
        let simple = lens.simplified();
        prop_assert!(simple.parameters().len() <= lens.parameters().len());
        // The same sums in another order, and a division by one.
        prop_assert!((simple.distort(Point2::new(x, y)) - lens.distort(Point2::new(x, y))).norm() < 1e-15);
        prop_assert_eq!(simple.converted(lens.model()), Some(lens));
    }
}

/// Whether the radial derivative nearly vanishes at a radius: the scan may miss a turning point there.
fn flat(lens: &Distortion, radius: f64) -> bool {
    lens.distort_with_jacobian(Point2::new(radius, 0.0)).1[(0, 0)].abs() < 1e-6
}

#[test]
fn a_point_without_a_ray_undistorts_to_nan() {
    // x(1 − 0.5 x²) peaks at 0.544 for x = 0.816: nothing maps to 0.7.
    let lens = Distortion::radial(-0.5, 0.0);
    assert!((lens.max_radius() - (2.0f64 / 3.0).sqrt()).abs() < 1e-14);
    assert!(lens.undistort(Point2::new(0.7, 0.0)).x.is_nan());
    assert!((lens.undistort(Point2::new(0.54, 0.0)).x - 0.7).abs() < 0.1);
    // x(1 − 2x² + 1.5x⁴) has turning points where 1 − 6x² + 7.5x⁴ = 0; beyond the second it rises again, outside the valid range.
    let lens = Distortion::radial(-2.0, 1.5);
    assert!((lens.max_radius() - ((6.0 - 6.0f64.sqrt()) / 15.0).sqrt()).abs() < 1e-14);
    assert!(lens.undistort(lens.distort(Point2::new(1.5, 0.0))).x.is_nan());
    assert_eq!(lens.distort_in_range(Point2::new(1.5, 0.0)), None);
    for non_finite in [f64::NAN, f64::INFINITY] {
        assert!(lens.undistort(Point2::new(non_finite, 0.0)).x.is_nan());
        assert_eq!(lens.distort_in_range(Point2::new(non_finite, 0.0)), None);
    }
}

#[test]
fn a_rational_lens_ends_at_its_pole() {
    // x / (1 − x²) has a pole at 1 and is negative beyond.
    let lens = Distortion::rational8([0.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 0.0]);
    assert!((lens.max_radius() - 1.0).abs() < 1e-14);
    assert_eq!(lens.distort_in_range(Point2::new(1.1, 0.0)), None);
    // x / (1 − x²) = 100 for x = (√(1 + 4·100²) − 1) / 200.
    let x = ((1.0 + 4e4f64).sqrt() - 1.0) / 200.0;
    // Newton's residual is 1e-13 of 100, and the derivative there 2·10⁴.
    assert!((lens.undistort(Point2::new(0.0, 100.0)).y - x).abs() < 1e-14);
}

#[test]
fn a_fisheye_has_rays_up_to_90_degrees() {
    let lens = Distortion::fisheye4([0.0; 4]);
    assert_eq!(lens.max_radius(), f64::INFINITY);
    for degrees in [1.0f64, 45.0, 80.0, 89.0, 89.9] {
        let angle = degrees.to_radians();
        let p = lens.undistort(Point2::new(angle, 0.0));
        // Newton's residual is an angle.
        assert!((p.x.atan() - angle).abs() < 1e-12, "{degrees}: {p}");
    }
    assert!(lens.undistort(Point2::new(1.6, 0.0)).x.is_nan());
    // θ(1 − 0.3 θ²) has its turning point at θ = 1/√0.9, which is 60.4°.
    let lens = Distortion::fisheye4([-0.3, 0.0, 0.0, 0.0]);
    assert!((lens.max_radius() - (1.0 / 0.9f64.sqrt()).tan()).abs() < 1e-13);
    assert!(lens.undistort(Point2::new(0.71, 0.0)).x.is_nan() && !lens.undistort(Point2::new(0.70, 0.0)).x.is_nan());
}

/// Computed by hand from the formulas in OpenCV's calib3d documentation at (0.3, −0.2), r² = 0.13.
#[test]
fn distortion_terms_match_opencv() {
    let (x, y, r2) = (0.3, -0.2, 0.13f64);
    let at = |lens: Distortion, qx: f64, qy: f64| {
        let q = lens.distort(Point2::new(x, y));
        // The same arithmetic in another order.
        assert!((q.x - qx).abs() < 1e-15 && (q.y - qy).abs() < 1e-15, "{lens:?}: {q}");
    };
    let numerator = 1.0 + 0.1 * 0.13 + 0.2 * 0.0169 + 0.3 * 0.002197;
    let denominator = 1.0 + 0.4 * 0.13 + 0.5 * 0.0169 + 0.6 * 0.002197;
    let tangential =
        [2.0 * 0.01 * 0.3 * -0.2 + 0.02 * (0.13 + 2.0 * 0.09), 0.01 * (0.13 + 2.0 * 0.04) + 2.0 * 0.02 * 0.3 * -0.2];
    let four = 1.0 + 0.1 * 0.13 + 0.2 * 0.0169;
    at(Distortion::simple_radial(0.1), 0.3 * 1.013, -0.2 * 1.013);
    at(Distortion::radial(0.1, 0.2), 0.3 * four, -0.2 * four);
    let lens = Distortion::radial_tangential4([0.1, 0.2, 0.01, 0.02]);
    at(lens, 0.3 * four + tangential[0], -0.2 * four + tangential[1]);
    let lens = Distortion::radial_tangential5([0.1, 0.2, 0.01, 0.02, 0.3]);
    at(lens, 0.3 * numerator + tangential[0], -0.2 * numerator + tangential[1]);
    let factor = numerator / denominator;
    let lens = Distortion::rational8([0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6]);
    at(lens, 0.3 * factor + tangential[0], -0.2 * factor + tangential[1]);
    let prism = [0.01 * r2 + 0.02 * r2 * r2, 0.03 * r2 + 0.04 * r2 * r2];
    let lens = Distortion::thin_prism12([0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6, 0.01, 0.02, 0.03, 0.04]);
    at(lens, 0.3 * factor + tangential[0] + prism[0], -0.2 * factor + tangential[1] + prism[1]);
    // cv::fisheye: θ_d = θ (1 + k1 θ² + …), x' = (θ_d / r) x.
    let theta = r2.sqrt().atan();
    let theta_d = theta + 0.1 * theta.powi(3) + 0.2 * theta.powi(5) + 0.3 * theta.powi(7) + 0.4 * theta.powi(9);
    at(Distortion::fisheye4([0.1, 0.2, 0.3, 0.4]), 0.3 * theta_d / r2.sqrt(), -0.2 * theta_d / r2.sqrt());
}

#[test]
fn model_names_are_unique_and_parameter_counts_checked() {
    let mut own: Vec<&str> = Vec::new();
    let mut colmap: Vec<&str> = Vec::new();
    for model in DistortionModel::ALL {
        let info = model.info();
        assert_eq!(DistortionModel::from_name(info.name), Some(*model));
        own.extend(std::iter::once(info.name).chain(info.former_names.iter().copied()));
        colmap.extend(info.colmap.iter().map(|c| c.name));
        assert!(
            info.parameters.len() <= MAX_PARAMETERS
                && info.colmap.iter().all(|c| c.parameters <= info.parameters.len())
        );
        let wrong = vec![0.0; info.parameters.len() + 1];
        assert_eq!(Distortion::new(*model, &wrong).unwrap_err().needed, info.parameters.len());
        assert_eq!(
            Distortion::new(*model, &wrong[1..]).unwrap().simplified().model().info().projection,
            info.projection
        );
    }
    for mut names in [own, colmap] {
        let count = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), count);
    }
    assert_eq!(Distortion::default(), Distortion::NONE);
    let fisheye = Distortion::fisheye4([0.0; 4]);
    assert_eq!(fisheye.converted(DistortionModel::None), None);
    assert_eq!(Distortion::radial_tangential5([0.1, 0.0, 0.0, 0.0, 0.0]).simplified(), Distortion::simple_radial(0.1));
}
