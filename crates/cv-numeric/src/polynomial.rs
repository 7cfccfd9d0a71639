//! Real roots of polynomials.

/// At most `N` real roots in ascending order.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Roots<const N: usize> {
    values: [f64; N],
    len: usize,
}

impl<const N: usize> Roots<N> {
    const NONE: Self = Self { values: [0.0; N], len: 0 };

    fn push(&mut self, root: f64) {
        if root.is_finite() && self.len < N {
            self.values[self.len] = root;
            self.len += 1;
        }
    }

    fn sorted(mut self) -> Self {
        self.values[..self.len].sort_unstable_by(f64::total_cmp);
        self
    }
}

impl<const N: usize> std::ops::Deref for Roots<N> {
    type Target = [f64];

    fn deref(&self) -> &[f64] {
        &self.values[..self.len]
    }
}

/// Evaluates `Σ c[i] x^i` and its derivative.
#[inline]
fn evaluate(c: &[f64], x: f64) -> (f64, f64) {
    let (mut p, mut d) = (0.0, 0.0);
    for &k in c.iter().rev() {
        d = d * x + p;
        p = p * x + k;
    }
    (p, d)
}

/// Refines a root by up to two Newton steps, each accepted only where it lowers the residual.
#[inline]
fn polish(c: &[f64], mut x: f64) -> f64 {
    let (mut p, mut d) = evaluate(c, x);
    for _ in 0..2 {
        let next = x - p / d;
        let (q, e) = evaluate(c, next);
        // Also false for NaN, after a division by zero.
        if q.abs() < p.abs() {
            (x, p, d) = (next, q, e);
        } else {
            break;
        }
    }
    x
}

/// Computes the real roots of `c[0] + c[1] x + c[2] x²`, without cancellation. A double root is returned twice, also where the coefficients
/// have rounding errors.
#[inline]
pub fn real_roots_quadratic(c: [f64; 3]) -> Roots<2> {
    let mut roots = Roots::NONE;
    let square = c[1] * c[1];
    let discriminant = square - 4.0 * c[2] * c[0];
    // Rounding of the coefficients and products, half an ulp each, adds up to four ulps.
    if discriminant >= -4.0 * f64::EPSILON * square {
        let q = -0.5 * (c[1] + discriminant.max(0.0).sqrt().copysign(c[1]));
        // With a vanishing leading coefficient the first root is infinite and left out.
        roots.push(q / c[2]);
        if q != 0.0 {
            roots.push(c[0] / q);
        } else {
            roots.push(0.0);
        }
    }
    roots.sorted()
}

/// A depressed cubic `y³ − 3 q y + 2 r` with `y = x + shift`.
struct Depressed {
    shift: f64,
    q: f64,
    r: f64,
}

impl Depressed {
    /// Depresses `c[0] + c[1] x + c[2] x² + c[3] x³`.
    #[inline]
    fn new(c: &[f64; 4]) -> Self {
        let scale = 1.0 / c[3];
        let (shift, a1, a0) = (c[2] * scale * (1.0 / 3.0), c[1] * scale, c[0] * scale);
        Self { shift, q: shift * shift - a1 * (1.0 / 3.0), r: shift * (shift * shift - 0.5 * a1) + 0.5 * a0 }
    }

    /// Computes the root of the depressed cubic that is farthest from the mean of all three, which is zero.
    ///
    /// Its sign is opposite to that of `r`, and its magnitude `y` is the only positive root of `y³ − 3 q y − 2 |r|`, which is convex beyond
    /// it: two Halley steps converge from a start within a few percent.
    #[inline]
    fn farthest_root(&self) -> f64 {
        let twice = 2.0 * self.r.abs();
        // A lower bound for three equal roots, so that the squares below do not underflow. NaN stays.
        let k = if twice < 1e-150 { 1e-150 } else { twice };
        // The bits of a positive float approximate its logarithm; a third of them is the cube root within 5 %.
        let cube_root = f64::from_bits(k.to_bits() / 3 + 0x2a9f_7893_0000_0000);
        let squared = cube_root * cube_root;
        // Exact where one term vanishes, and within a twelfth in between.
        let mut y = if self.q >= 0.0 {
            (squared + 3.0 * self.q).sqrt()
        } else {
            let linear = k / (-3.0 * self.q);
            linear * (squared / (squared + linear * linear)).sqrt()
        };
        // An error of 8 % becomes 5e-4 after the first step and 1e-10 after the second; the caller polishes by Newton steps.
        for _ in 0..2 {
            let (f, d) = (y * (y * y - 3.0 * self.q) - k, 3.0 * (y * y - self.q));
            y -= f * d / (d * d - 3.0 * f * y);
        }
        -y.copysign(self.r)
    }
}

/// Solves a cubic whose leading coefficient is below `1e-14` of the largest as a quadratic: the third root is then beyond `1e14`
/// times the others' scale. `None` for a true cubic.
#[inline]
fn degenerate_cubic_roots(c: &[f64; 4]) -> Option<Roots<2>> {
    let negligible = 1e-14 * c.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    if c[3].abs() > negligible {
        return None;
    }
    let constant = c[2].abs() <= negligible && c[1].abs() <= negligible;
    Some(if constant { Roots::NONE } else { real_roots_quadratic([c[0], c[1], c[2]]) })
}

/// Computes the real roots of `c[0] + c[1] x + c[2] x² + c[3] x³`; of a lower degree where leading coefficients vanish.
///
/// The root farthest from the others by Halley's method, the others by deflation to a quadratic, then Newton steps on the original
/// coefficients. A double root may be returned twice or not at all, depending on rounding.
#[inline]
pub fn real_roots_cubic(c: [f64; 4]) -> Roots<3> {
    let mut roots = Roots::NONE;
    if let Some(lower) = degenerate_cubic_roots(&c) {
        for &r in lower.iter() {
            roots.push(r);
        }
        return roots;
    }
    let depressed = Depressed::new(&c);
    let root = polish(&c, depressed.farthest_root() - depressed.shift);
    roots.push(root);
    // Deflate by the polished root: for a large one, deflation cancels.
    let first = root + depressed.shift;
    // x² + first x + (first² − 3 q) = 0.
    let discriminant = 3.0 * (4.0 * depressed.q - first * first);
    if discriminant >= 0.0 {
        let half = 0.5 * discriminant.sqrt();
        for other in [-0.5 * first - half, -0.5 * first + half] {
            roots.push(polish(&c, other - depressed.shift));
        }
    }
    roots.sorted()
}

/// Computes the real root of `c[0] + c[1] x + c[2] x² + c[3] x³` that is farthest from the mean of the three, and so the best conditioned;
/// for a lower degree one of its real roots, `None` where there is none.
///
/// Takes less than half the time of [`real_roots_cubic`].
#[inline]
pub fn farthest_root_cubic(c: [f64; 4]) -> Option<f64> {
    if let Some(lower) = degenerate_cubic_roots(&c) {
        return lower.first().copied();
    }
    let depressed = Depressed::new(&c);
    Some(polish(&c, depressed.farthest_root() - depressed.shift)).filter(|x| x.is_finite())
}

/// Computes the real roots of `Σ c[i] x^i` of degree four; of a lower degree where leading coefficients vanish.
///
/// Ferrari's resolvent with the root that gives the largest square, then Newton steps. O(1).
pub fn real_roots_quartic(c: [f64; 5]) -> Roots<4> {
    let mut roots = Roots::NONE;
    let largest = c.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    if c[4].abs() <= 1e-14 * largest {
        for &r in real_roots_cubic([c[0], c[1], c[2], c[3]]).iter() {
            roots.push(r);
        }
        return roots;
    }
    let (b, e, d, f) = (c[3] / c[4], c[2] / c[4], c[1] / c[4], c[0] / c[4]);
    // Depressed: y⁴ + p y² + q y + r with x = y − b/4.
    let b2 = b * b;
    let p = e - 0.375 * b2;
    let q = d - 0.5 * b * e + 0.125 * b2 * b;
    let r = f - 0.25 * b * d + 0.0625 * b2 * e - 0.01171875 * b2 * b2;
    let shift = -0.25 * b;
    // (y² + p/2 + m)² = 2m y² − q y + (m² + m p + p²/4 − r), a square for a root m of the resolvent.
    let resolvent = [-q * q, 2.0 * p * p - 8.0 * r, 8.0 * p, 8.0];
    let m = real_roots_cubic(resolvent).last().copied().unwrap_or(0.0);
    if m > 1e-14 * (p.abs() + r.abs().sqrt()) {
        let s = (2.0 * m).sqrt();
        let t = q / (2.0 * s);
        for sign in [1.0, -1.0] {
            // y² ∓ s y + p/2 + m ± t = 0.
            for &y in real_roots_quadratic([0.5 * p + m + sign * t, -sign * s, 1.0]).iter() {
                roots.push(polish(&c, y + shift));
            }
        }
    } else {
        // q vanishes: a quadratic in y².
        for &y2 in real_roots_quadratic([r, p, 1.0]).iter().filter(|y2| **y2 >= 0.0) {
            roots.push(polish(&c, y2.sqrt() + shift));
            roots.push(polish(&c, -y2.sqrt() + shift));
        }
    }
    roots.sorted()
}

/// A Sturm chain of a polynomial of degree below `N` (coefficients ascending).
struct Sturm<const N: usize> {
    /// `chain[0]` and `chain[1]` are the polynomial and its derivative, each scaled; then negated remainders.
    chain: [[f64; N]; N],
    degrees: [usize; N],
    len: usize,
    /// For a regular chain, where every remainder has one degree less: `chain[i] = (a x + b) chain[i+1] − s chain[i+2]`.
    quotients: Option<[[f64; 3]; N]>,
}

impl<const N: usize> Sturm<N> {
    fn new(c: &[f64; N], degree: usize) -> Self {
        let mut s = Self { chain: [[0.0; N]; N], degrees: [0; N], len: 2, quotients: None };
        let mut quotients = [[0.0; 3]; N];
        let mut regular = true;
        for i in 0..=degree {
            s.chain[0][i] = c[i] / c[degree].abs();
        }
        for i in 1..=degree {
            s.chain[1][i - 1] = s.chain[0][i] * i as f64 / degree as f64;
        }
        s.degrees[0] = degree;
        s.degrees[1] = degree - 1;
        while s.degrees[s.len - 1] > 0 && s.len < N {
            let (high, low) = (s.degrees[s.len - 2], s.degrees[s.len - 1]);
            let divisor = s.chain[s.len - 1];
            let mut rest = s.chain[s.len - 2];
            let mut quotient = [0.0; 2];
            for k in (0..=high - low).rev() {
                let factor = rest[k + low] / divisor[low];
                if k < 2 {
                    quotient[k] = factor;
                }
                for i in 0..low {
                    rest[k + i] -= factor * divisor[i];
                }
            }
            // Coefficients below this are rounding errors: then the remainder is zero and there are multiple roots.
            let size = divisor[..=low].iter().fold(0.0f64, |m, v| m.max(v.abs()));
            let mut next = low;
            while next > 0 && rest[next - 1].abs() <= 1e-15 * size {
                next -= 1;
            }
            if next == 0 {
                break;
            }
            let lead = rest[next - 1].abs();
            regular &= high == low + 1 && next == low;
            quotients[s.len - 2] = [quotient[1], quotient[0], lead];
            for (to, from) in s.chain[s.len].iter_mut().zip(&rest[..next]) {
                *to = -from / lead;
            }
            s.degrees[s.len] = next - 1;
            s.len += 1;
        }
        s.quotients = regular.then_some(quotients);
        s
    }

    /// Counts the sign changes of the chain at `x`.
    #[inline]
    fn changes(&self, x: f64) -> usize {
        let mut count = 0;
        let last = self.len - 1;
        match &self.quotients {
            Some(q) => {
                let d = self.degrees[last];
                let (mut below, mut here) = (0.0, evaluate(&self.chain[last][..=d], x).0);
                for i in (0..last).rev() {
                    // The last pair has no remainder; where the chain was cut short, the remainder is rounding.
                    let up = if i + 1 == last {
                        evaluate(&self.chain[i][..=self.degrees[i]], x).0
                    } else {
                        (q[i][0] * x + q[i][1]) * here - q[i][2] * below
                    };
                    count += usize::from((up < 0.0) != (here < 0.0));
                    (below, here) = (here, up);
                }
            }
            None => {
                let mut before = evaluate(&self.chain[0][..=self.degrees[0]], x).0;
                for i in 1..=last {
                    let here = evaluate(&self.chain[i][..=self.degrees[i]], x).0;
                    count += usize::from((here < 0.0) != (before < 0.0));
                    before = here;
                }
            }
        }
        count
    }
}

/// Computes the real roots of `Σ c[i] x^i`, of degree `N − 1` or lower where leading coefficients vanish.
///
/// Isolates the roots by Sturm's theorem and refines them by bracketed Newton steps (as in Nistér's five-point solver, 2004, §3.2.4).
/// Roots closer than `1e-9` of their size may be returned as one, roots of even multiplicity as one or none.
pub fn real_roots<const N: usize>(c: &[f64; N]) -> Roots<N> {
    let mut roots = Roots::NONE;
    let largest = c.iter().fold(0.0f64, |m, v| m.max(v.abs()));
    let Some(degree) = c.iter().rposition(|v| v.abs() > 1e-15 * largest) else { return roots };
    if degree == 0 || !largest.is_finite() {
        return roots;
    }
    // Fujiwara's bound.
    let mut bound = 0.0f64;
    for (i, v) in c[..degree].iter().enumerate() {
        bound = bound.max((v / c[degree]).abs().powf(1.0 / (degree - i) as f64));
    }
    let bound = 2.0 * bound + 1e-12;
    if degree == 1 {
        roots.push(-c[0] / c[1]);
        return roots;
    }
    let sturm = Sturm::new(c, degree);
    // Intervals with the sign changes at their ends; bisected until each has one root.
    let mut stack = [(0.0, 0.0, 0usize, 0usize); 64];
    stack[0] = (-bound, bound, sturm.changes(-bound), sturm.changes(bound));
    let mut open = 1;
    while open > 0 {
        open -= 1;
        let (low, high, at_low, at_high) = stack[open];
        let count = at_low.saturating_sub(at_high);
        if count == 0 {
            continue;
        }
        let (p, q) = (evaluate(&c[..=degree], low).0, evaluate(&c[..=degree], high).0);
        if count == 1 && (p < 0.0) != (q < 0.0) {
            roots.push(bracketed_newton(&c[..=degree], low, high, p < 0.0));
            continue;
        }
        let middle = 0.5 * (low + high);
        if high - low <= 1e-9 * (1.0 + middle.abs()) || open + 2 > stack.len() {
            roots.push(polish(&c[..=degree], middle));
            continue;
        }
        let at_middle = sturm.changes(middle);
        stack[open] = (middle, high, at_middle, at_high);
        stack[open + 1] = (low, middle, at_low, at_middle);
        open += 2;
    }
    roots.sorted()
}

/// Computes the root between `low` and `high`, where the polynomial changes its sign, by Newton steps with bisection as the fallback.
fn bracketed_newton(c: &[f64], mut low: f64, mut high: f64, rising: bool) -> f64 {
    let mut x = 0.5 * (low + high);
    let mut last = high - low;
    for _ in 0..200 {
        let (p, d) = evaluate(c, x);
        if p == 0.0 {
            break;
        }
        if (p < 0.0) == rising {
            low = x;
        } else {
            high = x;
        }
        let newton = x - p / d;
        // Accept the Newton step where it stays inside and at least halves the step length.
        let inside = newton > low && newton < high && 2.0 * (newton - x).abs() <= last;
        let next = if inside { newton } else { 0.5 * (low + high) };
        last = (next - x).abs();
        x = next;
        // The error after a Newton step is of the order of the step squared; after a bisection, of the step.
        if last <= (if inside { 1e-9 } else { 1e-15 }) * x.abs() {
            break;
        }
    }
    x
}
