//! Two-view bundle adjustment with covariances.

use cv_core::{
    Camera, Cancelled, Correspondence, Distortion, DistortionModel, Matrix3, Point2, Point3, Pose, Progress, Stage,
    Vector3,
};
use cv_numeric::RobustLoss;
use cv_numeric::adjust::{
    AdjustError, AdjustIteration, AdjustOptions, AdjustReport, Adjustment, Euclidean, GroupId, Manifold,
    RelativeMotion, Residual, RigidMotion, UnitVector,
};
use nalgebra::{DMatrix, Matrix2, Matrix2x3, SMatrix, SVector, Vector2};
use std::ops::ControlFlow;

/// Options of [`adjust_two_views`].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BundleOptions {
    /// Robust loss of the reprojection error of a point in one image, in pixels. Default Cauchy with scale 1 px, about
    /// the localization error of SIFT keypoints.
    pub loss: RobustLoss,
    /// Prior of the focal lengths, which are refined by one common factor; fixed if `None`. Default `None`.
    pub focal: Option<FocalPrior>,
    /// Whether k1 and k2 of [`DistortionModel::Radial`] are refined, by the same change in both cameras. Default false.
    pub refine_radial: bool,
    /// Maximum number of iterations. Default 200; with fixed focal lengths about ten are typical.
    pub max_iterations: usize,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self { loss: RobustLoss::Cauchy { scale: 1.0 }, focal: None, refine_radial: false, max_iterations: 200 }
    }
}

/// Prior of the focal lengths of two cameras: a log-normal distribution.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FocalPrior {
    /// Median focal length of the first camera, in pixels; the second's is scaled by the same factor.
    pub focal: f64,
    /// Relative standard deviation of the common factor; infinite for no prior.
    pub deviation: f64,
    /// Relative standard deviation of the ratio of the two. The ratio is not adjusted, but its uncertainty is included
    /// in the resulting standard deviations.
    pub ratio: f64,
}

impl FocalPrior {
    /// Relative standard deviation of the ratio for two images by the same lens, because of refocusing: that of a 50 mm
    /// lens focused at 10 m and at 7 m.
    pub const SAME_LENS_RATIO_DEVIATION: f64 = 0.002;
}

/// The parameters of a two-view bundle adjustment.
#[derive(Debug, Clone, PartialEq)]
pub struct TwoViewBundle {
    /// The cameras; changed only if focal lengths or radial distortion are refined.
    pub cameras: [Camera; 2],
    /// First camera frame to second; the translation has length one.
    pub pose: Pose,
    /// Points in the first camera's frame.
    pub points: Vec<Point3<f64>>,
}

/// Statistics and uncertainties of [`adjust_two_views`].
#[derive(Debug, Clone, PartialEq)]
pub struct BundleReport {
    /// Initial and final cost `Σ ρ(r²)` over both images, in squared pixels.
    pub cost: [f64; 2],
    /// Number of iterations.
    pub iterations: usize,
    /// Covariance of each point in squared baselines, scaled by the (robustly weighted) residual variance. The scale
    /// gauge is fixed: the baseline is exact. Of synthetic points with normal noise, 93 to 95 % lie within the 95 %
    /// ellipsoid.
    pub covariances: Vec<Matrix3<f64>>,
    /// Standard deviations in radians of the rotation (about its least certain axis) and of the direction of the
    /// translation, including the uncertainty of the intrinsics.
    pub pose_deviation: [f64; 2],
    /// The same conditional on the estimated focal lengths and radial distortion.
    pub pose_deviation_given_lens: [f64; 2],
    /// Relative standard deviation of the common factor of the focal lengths; 0 if they are fixed. If they are free,
    /// all standard deviations also include unmodeled errors: a difference of the two focal lengths
    /// ([`FocalPrior::ratio`]), and offsets of the principal points of 1 % of half the diagonal in common and 0.2 %
    /// between the images (image stabilization).
    pub focal_deviation: f64,
}

/// Number of shared intrinsic parameters: the common factor of the focal lengths (updated by its logarithm), and the
/// changes of k1 and k2.
const LENS: usize = 3;
/// Number of consider parameters, which are not estimated but contribute to the covariance: log ratio of the focal
/// lengths, common offset of the principal points, and offset of the second.
const CONSIDERED: usize = 5;
/// Prior standard deviations of the corner displacements by k1 and k2, relative to half the diagonal. Strong barrel
/// distortion has 0.1.
const RADIAL_PRIOR: [f64; 2] = [0.1, 0.1];
/// Prior standard deviations of the principal points, in common and of the second relative to the first, relative to
/// half the diagonal.
const CENTER_PRIOR: [f64; 2] = [0.01, 0.002];
/// Variance of SIFT keypoint localization in squared pixels, by which the priors are weighted against the residuals.
const NOISE_VARIANCE: f64 = 0.25;

/// The manifold of the shared intrinsic parameters ([`LENS`]).
struct CommonLens;

impl Manifold for CommonLens {
    fn ambient(&self) -> usize {
        LENS
    }

    fn tangent(&self) -> usize {
        LENS
    }

    fn step(&self, x: &[f64], delta: &[f64], moved: &mut [f64]) {
        moved.copy_from_slice(&[x[0] * delta[0].exp(), x[1] + delta[1], x[2] + delta[2]]);
    }
}

/// Prior residuals of the shared intrinsic parameters: mean and weight of the log factor of the focal lengths and of
/// the changes of k1 and k2.
struct LensPrior([(f64, f64); LENS]);

impl Residual<LENS, 1, LENS> for LensPrior {
    const DIMS: [usize; 1] = [LENS];

    #[inline]
    fn evaluate(
        &self,
        _: usize,
        [x]: [&[f64]; 1],
        jacobian: Option<&mut SMatrix<f64, LENS, LENS>>,
    ) -> Option<SVector<f64, LENS>> {
        if let Some(j) = jacobian {
            (0..LENS).for_each(|i| j[(i, i)] = self.0[i].1);
        }
        let value = [x[0].ln(), x[1], x[2]];
        Some(SVector::from_fn(|i, _| (value[i] - self.0[i].0) * self.0[i].1))
    }
}

/// A view: its initial camera and its observations.
struct View {
    camera: Camera,
    pixels: Vec<Point2<f64>>,
    /// Whether k1 and k2 are refined.
    is_radial: bool,
    /// Exponent of the focal length ratio in this view's focal length: −½ in the first view, ½ in the second.
    ratio_exponent: f64,
}

/// Jacobians of a pixel by the point in the camera frame, the shared intrinsics, and the consider parameters.
type Derivatives = (Matrix2x3<f64>, SMatrix<f64, 2, LENS>, SMatrix<f64, 2, CONSIDERED>);

impl View {
    /// Returns the distortion with the shared change applied.
    #[inline]
    fn distortion(&self, lens: &[f64]) -> Distortion {
        let mut distortion = self.camera.distortion;
        if self.is_radial {
            distortion.parameters_mut().iter_mut().zip(&lens[1..]).for_each(|(k, change)| *k += change);
        }
        distortion
    }

    #[inline]
    fn residual(&self, item: usize, lens: &[f64], p: &Vector3<f64>) -> Option<Vector2<f64>> {
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let c = &self.camera;
        let d = self.distortion(lens).distort(Point2::new(p.x / p.z, p.y / p.z));
        Some(Point2::new(c.fx * lens[0] * d.x + c.cx, c.fy * lens[0] * d.y + c.cy) - self.pixels[item])
    }

    #[inline]
    fn derivatives(&self, item: usize, lens: &[f64], p: &Vector3<f64>) -> Option<(Vector2<f64>, Derivatives)> {
        if p.z <= 0.0 || p.z.is_nan() {
            return None;
        }
        let i = 1.0 / p.z;
        let ideal = Point2::new(p.x * i, p.y * i);
        let scale = Matrix2::from_diagonal(&Vector2::new(self.camera.fx * lens[0], self.camera.fy * lens[0]));
        let (d, j, k) = if self.is_radial {
            let (d, j, k) = self.distortion(lens).distort_with_jacobians(ideal);
            (d, j, scale * k.fixed_columns::<2>(0))
        } else {
            let (d, j) = self.camera.distortion.distort_with_jacobian(ideal);
            (d, j, Matrix2::zeros())
        };
        let focal = scale * d.coords;
        let j_point = scale * j * Matrix2x3::new(i, 0.0, -ideal.x * i, 0.0, i, -ideal.y * i);
        let second = if self.ratio_exponent > 0.0 { 1.0 } else { 0.0 };
        let (x, y) = (Vector2::x(), Vector2::y());
        let j_lens = SMatrix::from_columns(&[focal, k.column(0).into_owned(), k.column(1).into_owned()]);
        let j_considered = SMatrix::from_columns(&[focal * self.ratio_exponent, x, y, x * second, y * second]);
        let center = Vector2::new(self.camera.cx, self.camera.cy);
        Some((focal + center - self.pixels[item].coords, (j_point, j_lens, j_considered)))
    }
}

/// Residuals of the first view, in whose frame the points are: parameter blocks lens, considered, point.
struct First(View);

impl Residual<2, 3, { LENS + CONSIDERED + 3 }> for First {
    const DIMS: [usize; 3] = [LENS, CONSIDERED, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [lens, _, point]: [&[f64]; 3],
        jacobian: Option<&mut SMatrix<f64, 2, { LENS + CONSIDERED + 3 }>>,
    ) -> Option<Vector2<f64>> {
        let p = Vector3::from_column_slice(point);
        let Some(j) = jacobian else { return self.0.residual(item, lens, &p) };
        let (residual, (j_point, j_lens, j_considered)) = self.0.derivatives(item, lens, &p)?;
        j.fixed_columns_mut::<LENS>(0).copy_from(&j_lens);
        j.fixed_columns_mut::<CONSIDERED>(LENS).copy_from(&j_considered);
        j.fixed_columns_mut::<3>(LENS + CONSIDERED).copy_from(&j_point);
        Some(residual)
    }
}

/// Residuals of the second view: parameter blocks pose, lens, considered, point.
struct Second(View);

impl Residual<2, 4, { 5 + LENS + CONSIDERED + 3 }> for Second {
    const DIMS: [usize; 4] = [5, LENS, CONSIDERED, 3];

    #[inline]
    fn evaluate(
        &self,
        item: usize,
        [pose, lens, _, point]: [&[f64]; 4],
        jacobian: Option<&mut SMatrix<f64, 2, { 5 + LENS + CONSIDERED + 3 }>>,
    ) -> Option<Vector2<f64>> {
        let (rotation, translation) = RigidMotion::load(pose);
        let rotated = rotation * Vector3::from_column_slice(point);
        let p = rotated + translation;
        let Some(j) = jacobian else { return self.0.residual(item, lens, &p) };
        let (residual, (j_point, j_lens, j_considered)) = self.0.derivatives(item, lens, &p)?;
        let [u, v] = UnitVector::basis(&translation);
        j.fixed_columns_mut::<3>(0).copy_from(&(-j_point * rotated.cross_matrix()));
        j.set_column(3, &(j_point * u));
        j.set_column(4, &(j_point * v));
        j.fixed_columns_mut::<LENS>(5).copy_from(&j_lens);
        j.fixed_columns_mut::<CONSIDERED>(5 + LENS).copy_from(&j_considered);
        j.fixed_columns_mut::<3>(5 + LENS + CONSIDERED).copy_from(&(j_point * rotation.matrix()));
        Some(residual)
    }
}

/// The adjustment problem of a bundle and its parameter groups.
struct Problem<'a> {
    adjustment: Adjustment<'a>,
    pose: GroupId,
    lens: GroupId,
    points: GroupId,
    /// Whether k1 and k2 are refined.
    is_radial: bool,
}

impl Problem<'_> {
    /// Builds the problem; `noise` is the variance of the observations in squared pixels, see [`NOISE_VARIANCE`].
    fn new(
        bundle: &TwoViewBundle,
        matches: &[Correspondence],
        options: &BundleOptions,
        noise: f64,
    ) -> Result<Self, AdjustError> {
        let [first, second] = bundle.cameras;
        let is_radial =
            options.refine_radial && bundle.cameras.iter().all(|c| c.distortion.model() == DistortionModel::Radial);
        let half_diagonal = 0.5 * (first.width as f64).hypot(first.height as f64);
        let corner2 = (half_diagonal / first.fx).powi(2);

        let observed = bundle.points.iter().zip(matches);
        let n = observed.len() as u32;
        let mut adjustment = Adjustment::default();
        let motion = RigidMotion::store(&bundle.pose.rotation, &bundle.pose.translation);
        let pose = adjustment.add_group("pose", RelativeMotion, motion.to_vec())?;
        let lens = adjustment.add_group("lens", CommonLens, vec![1.0, 0.0, 0.0])?;
        let considered = adjustment.add_group("held", Euclidean(CONSIDERED), vec![0.0; CONSIDERED])?;
        let coordinates = observed.flat_map(|(x, _)| [x.x, x.y, x.z]).collect();
        let points = adjustment.add_group("points", Euclidean(3), coordinates)?;
        adjustment.eliminate(points)?;
        let pixels = |of: fn(&Correspondence) -> Point2<f64>| matches.iter().take(n as usize).map(of).collect();
        let first_view = First(View { camera: first, pixels: pixels(|m| m.a), is_radial, ratio_exponent: -0.5 });
        let second_view = Second(View { camera: second, pixels: pixels(|m| m.b), is_radial, ratio_exponent: 0.5 });
        let blocks = (0..n).map(|i| [0, 0, i]).collect();
        adjustment.add_residuals("first view", first_view, [lens, considered, points], blocks, options.loss)?;
        let blocks = (0..n).map(|i| [0, 0, 0, i]).collect();
        adjustment.add_residuals("second view", second_view, [pose, lens, considered, points], blocks, options.loss)?;
        // The weight of a prior with this standard deviation.
        let weight = |deviation: f64| noise.sqrt() / deviation;
        let mut prior = [(0.0, 0.0); LENS];
        if let Some(FocalPrior { focal, deviation, ratio }) = options.focal {
            prior[0] = ((focal / first.fx).ln(), weight(deviation));
            let [common, relative] = CENTER_PRIOR.map(|fraction| fraction * half_diagonal);
            adjustment.consider(considered, 0, &[ratio, common, common, relative, relative])?;
        } else {
            adjustment.fix_parameters(lens, 0, &[0])?;
            adjustment.fix(considered, 0)?;
        }
        if is_radial {
            let k = first.distortion.parameters();
            prior[1] = (-k[0], weight(RADIAL_PRIOR[0] / corner2));
            prior[2] = (-k[1], weight(RADIAL_PRIOR[1] / (corner2 * corner2)));
        } else {
            adjustment.fix_parameters(lens, 0, &[1, 2])?;
        }
        if is_radial || options.focal.is_some() {
            adjustment.add_residuals("prior", LensPrior(prior), [lens], vec![[0]], RobustLoss::Trivial)?;
        }
        Ok(Self { adjustment, pose, lens, points, is_radial })
    }

    /// Writes the adjusted cameras, pose and points to the bundle.
    fn write(&self, bundle: &mut TwoViewBundle) {
        let lens = self.adjustment.values(self.lens);
        for camera in &mut bundle.cameras {
            let view = View { camera: *camera, pixels: Vec::new(), is_radial: self.is_radial, ratio_exponent: 0.0 };
            camera.distortion = view.distortion(lens);
            (camera.fx, camera.fy) = (camera.fx * lens[0], camera.fy * lens[0]);
        }
        let (rotation, translation) = RigidMotion::load(self.adjustment.values(self.pose));
        bundle.pose = Pose::new(rotation, translation);
        for (x, adjusted) in bundle.points.iter_mut().zip(self.adjustment.values(self.points).chunks_exact(3)) {
            *x = Point3::new(adjusted[0], adjusted[1], adjusted[2]);
        }
    }

    /// Computes the uncertainties at the minimum.
    fn report(
        &self,
        variance: f64,
        options: &BundleOptions,
        solved: &AdjustReport,
    ) -> Result<BundleReport, AdjustError> {
        let covariance = self.adjustment.covariance(variance)?;
        let points = covariance.of_group(self.points).into_iter();
        let pose = covariance.of(self.pose, 0)?;
        let max_deviation = |m: DMatrix<f64>| m.symmetric_eigenvalues().max().max(0.0).sqrt();
        let deviations = |pose: &DMatrix<f64>| {
            [
                max_deviation(pose.view((0, 0), (3, 3)).into_owned()),
                max_deviation(pose.view((3, 3), (2, 2)).into_owned()),
            ]
        };
        // The covariance of the pose conditional on the lens, by the Schur complement. The lens covariance is singular
        // if some of its parameters are fixed.
        let lens = covariance.of(self.lens, 0)?;
        let cross = covariance.between((self.pose, 0), (self.lens, 0))?;
        let scale = DMatrix::from_diagonal(&lens.diagonal().map(|v| if v > 0.0 { 1.0 / v.sqrt() } else { 0.0 }));
        let given_lens = (&scale * &lens * &scale)
            .pseudo_inverse(1e-12)
            .map_or_else(|_| pose.clone(), |inverse| &pose - &cross * &scale * inverse * &scale * cross.transpose());
        Ok(BundleReport {
            cost: [solved.initial_cost, solved.cost],
            iterations: solved.iterations,
            covariances: points
                .map(|c| c.map(|c| Matrix3::from_column_slice(c.as_slice())))
                .collect::<Result<_, _>>()?,
            pose_deviation: deviations(&pose),
            pose_deviation_given_lens: deviations(&given_lens),
            focal_deviation: if options.focal.is_some() { lens[(0, 0)].max(0.0).sqrt() } else { 0.0 },
        })
    }
}

/// Refines a relative pose and its points (optionally also a common factor of the focal lengths and the radial
/// distortion) by minimizing the robust reprojection error in both images, including distortion (Triggs et al., "Bundle
/// adjustment — a modern synthesis", 2000).
///
/// `matches` are in distorted pixels, one for each point of the bundle; surplus ones of either are ignored. Uses
/// [`cv_numeric::adjust`] with the points eliminated (Schur complement), O(points) per iteration. The cost never
/// increases. `None` if a point is initially behind a camera or a residual is not finite.
///
/// # Errors
/// [`Cancelled`]; the bundle then has the parameters of the last iteration.
pub fn adjust_two_views(
    bundle: &mut TwoViewBundle,
    matches: &[Correspondence],
    options: &BundleOptions,
    progress: &dyn Progress,
) -> Result<Option<BundleReport>, Cancelled> {
    let stage = Stage::new(progress, "adjust", options.max_iterations)?;
    let Ok(mut problem) = Problem::new(bundle, matches, options, NOISE_VARIANCE) else { return Ok(None) };
    let settings = AdjustOptions {
        max_iterations: options.max_iterations,
        // Focal length, distortion and motion are strongly correlated: convergence may be slow, with many small steps.
        cost_tolerance: 1e-9,
        ..AdjustOptions::default()
    };
    let next = |_: &AdjustIteration| match stage.add(1) {
        Ok(()) => ControlFlow::Continue(()),
        Err(Cancelled) => ControlFlow::Break(()),
    };
    let Ok(solved) = problem.adjustment.solve(&settings, next) else { return Ok(None) };
    problem.write(bundle);
    stage.check()?;
    let Ok(sums) = problem.adjustment.residual_sums() else { return Ok(None) };
    let (squares, weights) = sums.iter().take(2).fold((0.0, 0.0), |s, k| (s.0 + k.weighted_squares, s.1 + k.weights));
    // Degrees of freedom: four residuals per point minus three parameters per point, minus five of the pose.
    let n = bundle.points.len().min(matches.len()) as f64;
    let variance = squares / (weights * (n - 5.0) / (4.0 * n)).max(1.0);
    let report = Problem::new(bundle, matches, options, variance).and_then(|p| p.report(variance, options, &solved));
    stage.check()?;
    Ok(report.ok())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::TwoViews;
    use cv_core::Rotation3;

    #[test]
    fn analytic_jacobians_equal_the_numeric_ones() {
        for seed in 0..20 {
            let mut views = TwoViews::random(seed);
            views.camera.distortion = Distortion::radial(-0.1, 0.01);
            let start =
                TwoViewBundle { cameras: [views.camera; 2], pose: views.pose, points: vec![views.point(None).0] };
            let origin = vec![Point2::origin()];
            let view = |k: usize| View {
                camera: start.cameras[k],
                pixels: origin.clone(),
                is_radial: true,
                ratio_exponent: k as f64 - 0.5,
            };
            let pose = RigidMotion::store(&start.pose.rotation, &start.pose.translation);
            let (lens, considered, x) = ([1.0, 0.0, 0.0], [0.0; CONSIDERED], start.points[0]);
            let (mut j1, mut j2) = (SMatrix::zeros(), SMatrix::zeros());
            First(view(0)).evaluate(0, [&lens, &considered, x.coords.as_slice()], Some(&mut j1)).unwrap();
            Second(view(1)).evaluate(0, [&pose, &lens, &considered, x.coords.as_slice()], Some(&mut j2)).unwrap();
            // Both pixels after a change of one degree of freedom: pose, lens, considered, point.
            let perturbed = |i: usize, h: f64| {
                let mut b = start.clone();
                match i {
                    0..3 => b.pose.rotation = Rotation3::new(Vector3::ith(i, h)) * b.pose.rotation,
                    3 | 4 => b.pose.translation += UnitVector::basis(&start.pose.translation)[i - 3] * h,
                    5 => b.cameras.iter_mut().for_each(|c| (c.fx, c.fy) = (c.fx * h.exp(), c.fy * h.exp())),
                    6 | 7 => b.cameras.iter_mut().for_each(|c| c.distortion.parameters_mut()[i - 6] += h),
                    8 => {
                        for (camera, sign) in b.cameras.iter_mut().zip([-0.5, 0.5]) {
                            (camera.fx, camera.fy) = (camera.fx * (sign * h).exp(), camera.fy * (sign * h).exp());
                        }
                    }
                    9 => b.cameras.iter_mut().for_each(|c| c.cx += h),
                    10 => b.cameras.iter_mut().for_each(|c| c.cy += h),
                    11 => b.cameras[1].cx += h,
                    12 => b.cameras[1].cy += h,
                    _ => b.points[0][i - 13] += h,
                }
                let projected =
                    [b.cameras[0].project(&b.points[0]), b.cameras[1].project(&b.pose.transform(&b.points[0]))];
                projected.map(|p| p.unwrap().coords)
            };
            for i in 0..16 {
                let (plus, minus) = (perturbed(i, 1e-6), perturbed(i, -1e-6));
                let numeric = [0, 1].map(|k| (plus[k] - minus[k]) / 2e-6);
                let exact =
                    [if i < 5 { Vector2::zeros() } else { j1.column(i - 5).into_owned() }, j2.column(i).into_owned()];
                for (numeric, exact) in numeric.iter().zip(&exact) {
                    // For pixels of some hundreds, a rounding of 1e-13 divided by 1e-6, and a truncation of h² times
                    // derivatives of some thousands.
                    assert!((numeric - exact).norm() < 1e-6 + 1e-6 * exact.norm(), "{i}: {numeric} {exact}");
                }
            }
        }
    }
}
