//! Running sums over points of a plane, which suffice for fits of lines, circles and conics.
//!
//! `m[p, q] = sum (s - s0)^p (t - t0)^q` for p + q <= 4 about an origin `(s0, t0)`. One more point is 14 additions; two
//! sets are joined by adding their sums; moving the origin is exact polynomial algebra and needs no points.

/// Number of moments of points in a plane, up to degree four.
pub const MOMENTS: usize = 15; // [derived]

/// Exponents `[p, q]` of each moment, ordered by degree, then by falling p.
const EXPONENTS: [[usize; 2]; MOMENTS] = {
    let (mut table, mut p) = ([[0; 2]; MOMENTS], 0);
    while p <= 4 {
        let mut q = 0;
        while p + q <= 4 {
            table[PlaneMoments::place(p, q)] = [p, q];
            q += 1;
        }
        p += 1;
    }
    table
};

/// For s and t: pairs of moments, to the first of which a share of the second is added as the origin moves along that axis, in
/// this order.
const SHIFTS: [[[usize; 2]; 20]; 2] = [shifts(&EXPONENTS, 0), shifts(&EXPONENTS, 1)];

/// Returns the pairs `[to, from]` of moments, in order, such that adding a share of `from` to `to` moves the origin along an
/// axis: one pass per power adds to each power of that coordinate, the highest first, its share of the power below. The moments
/// are ordered by degree.
pub(crate) const fn shifts<const AXES: usize, const MOMENTS: usize, const SHARES: usize>(
    exponents: &[[usize; AXES]; MOMENTS],
    axis: usize,
) -> [[usize; 2]; SHARES] {
    let mut table = [[0; 2]; SHARES];
    let (mut next, mut lowest) = (0, 0);
    while lowest < MOMENTS {
        // The places of the powers 0 to 4 of this coordinate, for these powers of the others.
        let (mut places, mut powers, mut place) = ([0; 5], 0, lowest);
        while exponents[lowest][axis] == 0 && place < MOMENTS {
            if differ_along(axis, &exponents[lowest], &exponents[place]) {
                places[powers] = place;
                powers += 1;
            }
            place += 1;
        }
        let mut first = 1;
        while first < powers {
            let mut power = powers - 1;
            while power >= first {
                table[next] = [places[power], places[power - 1]];
                next += 1;
                power -= 1;
            }
            first += 1;
        }
        lowest += 1;
    }
    table
}

/// Returns whether the exponents differ only along one axis.
const fn differ_along<const AXES: usize>(axis: usize, a: &[usize; AXES], b: &[usize; AXES]) -> bool {
    let mut other = 0;
    while other < AXES {
        if other != axis && a[other] != b[other] {
            return false;
        }
        other += 1;
    }
    true
}

/// The 15 moments up to degree 4 of weighted points in a plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlaneMoments {
    origin: [f64; 2],
    sums: [f64; MOMENTS],
}

impl PlaneMoments {
    /// Returns the moments of no points, about `origin`.
    pub fn new(origin: [f64; 2]) -> Self {
        Self { origin, sums: [0.0; MOMENTS] }
    }

    /// Returns moments that were summed elsewhere, ordered by degree, then by falling p: 1, s, t, s2, st, t2, s3, s2t, st2, t3,
    /// s4, s3t, s2t2, st3, t4.
    pub fn from_sums(origin: [f64; 2], sums: [f64; MOMENTS]) -> Self {
        Self { origin, sums }
    }

    /// Returns the moments of `points` about `origin`.
    pub fn of(origin: [f64; 2], points: impl IntoIterator<Item = [f64; 2]>) -> Self {
        let mut moments = Self::new(origin);
        points.into_iter().for_each(|point| moments.add(point));
        moments
    }

    /// The point about which the sums are taken.
    pub fn origin(&self) -> [f64; 2] {
        self.origin
    }

    /// The sums, in the order of [`PlaneMoments::from_sums`].
    pub fn sums(&self) -> &[f64; MOMENTS] {
        &self.sums
    }

    /// Returns the index of the moment with the exponents p and q among the sums, p + q <= 4.
    #[inline]
    pub(crate) const fn place(p: usize, q: usize) -> usize {
        let degree = p + q;
        degree * (degree + 1) / 2 + q
    }

    /// Returns `sum (s - s0)^p (t - t0)^q`.
    ///
    /// # Panics
    /// p + q is more than 4.
    #[inline]
    pub fn get(&self, p: usize, q: usize) -> f64 {
        self.sums[Self::place(p, q)]
    }

    /// Number of points, or the sum of their weights.
    #[inline]
    pub fn count(&self) -> f64 {
        self.sums[0]
    }

    /// Adds a point.
    #[inline]
    pub fn add(&mut self, point: [f64; 2]) {
        let (s, t) = (point[0] - self.origin[0], point[1] - self.origin[1]);
        let (s2, st, t2) = (s * s, s * t, t * t);
        let monomials =
            [1.0, s, t, s2, st, t2, s2 * s, s2 * t, s * t2, t2 * t, s2 * s2, s2 * st, s2 * t2, st * t2, t2 * t2];
        for (sum, monomial) in self.sums.iter_mut().zip(monomials) {
            *sum += monomial;
        }
    }

    /// Returns the moments of the same points about another origin.
    #[must_use]
    pub fn about(&self, origin: [f64; 2]) -> Self {
        let (ds, dt) = (self.origin[0] - origin[0], self.origin[1] - origin[1]);
        let mut moved = Self { origin, sums: self.sums };
        if ds != 0.0 || dt != 0.0 {
            // The binomial theorem, in place along one axis after the other.
            SHIFTS[0].iter().for_each(|[to, from]| moved.sums[*to] += ds * moved.sums[*from]);
            SHIFTS[1].iter().for_each(|[to, from]| moved.sums[*to] += dt * moved.sums[*from]);
        }
        moved
    }

    /// Returns the moments of the points with all offsets from the origin multiplied by `factor`.
    #[must_use]
    pub fn scaled(&self, factor: f64) -> Self {
        let mut scaled = *self;
        for (sum, [p, q]) in scaled.sums.iter_mut().zip(EXPONENTS) {
            *sum *= factor.powi((p + q) as i32);
        }
        scaled
    }

    /// Returns the moments of the points `map * p`; `map` has the rows of the matrix.
    #[must_use]
    pub fn mapped(&self, map: [[f64; 2]; 2]) -> Self {
        let image = |[s, t]: [f64; 2]| map.map(|[a, b]| a * s + b * t);
        let mut mapped = Self::new(image(self.origin));
        for degree in 0..=4 {
            for q in 0..=degree {
                // (a s + b t)^p (c s + d t)^q is a binary form in (s, t); its coefficients weigh the old moments.
                let form = binary_form(map, degree - q, q);
                let terms = form.iter().take(degree + 1).enumerate();
                mapped.sums[Self::place(degree - q, q)] = terms.map(|(k, c)| c * self.get(degree - k, k)).sum();
            }
        }
        mapped
    }

    /// Returns the mean of the points; `None` without points.
    pub fn mean(&self) -> Option<[f64; 2]> {
        let count = self.count();
        (count > 0.0).then(|| [self.origin[0] + self.sums[1] / count, self.origin[1] + self.sums[2] / count])
    }

    /// Returns the variances and the covariance of the points `[var s, cov st, var t]`; `None` without points.
    pub fn covariance(&self) -> Option<[f64; 3]> {
        let count = self.count();
        if count <= 0.0 {
            return None;
        }
        let (s, t) = (self.sums[1] / count, self.sums[2] / count);
        Some([self.sums[3] / count - s * s, self.sums[4] / count - s * t, self.sums[5] / count - t * t])
    }

    /// Returns the points relative to their mean, in units of their spread: `(mean, spread, moments divided by the count)`.
    ///
    /// All fits of higher degree start from here (Hartley 1997: shift and scale before solving). `None` where there are
    /// no points or all of them are the same.
    pub fn normalized(&self) -> Option<([f64; 2], f64, Self)> {
        let mean = self.mean()?;
        let centred = self.about(mean);
        let spread = ((centred.sums[3] + centred.sums[5]) / centred.sums[0]).sqrt();
        // A smaller spread is a rounding error of the sums.
        let resolution = 1e-7 * (self.origin[0] - mean[0]).hypot(self.origin[1] - mean[1]); // [algorithmic]
        if !(spread.is_finite() && spread > resolution.max(f64::MIN_POSITIVE)) {
            return None;
        }
        let mut unit = centred.scaled(1.0 / spread);
        unit.sums.iter_mut().for_each(|sum| *sum /= centred.sums[0]);
        unit.origin = [0.0, 0.0];
        Some((mean, spread, unit))
    }
}

/// Returns the coefficients of `(a s + b t)^p (c s + d t)^q`, by rising power of t.
fn binary_form(map: [[f64; 2]; 2], p: usize, q: usize) -> [f64; 5] {
    let mut form = [1.0, 0.0, 0.0, 0.0, 0.0];
    for factor in 0..p + q {
        let [a, b] = if factor < p { map[0] } else { map[1] };
        for k in (1..5).rev() {
            form[k] = a * form[k] + b * form[k - 1];
        }
        form[0] *= a;
    }
    form
}

#[cfg(test)]
mod tests {
    use super::*;

    fn points() -> Vec<[f64; 2]> {
        (0..20).map(|i| f64::from(i) * 0.7).map(|a| [1.0 + 0.2 * a.cos(), 2.0 + 0.3 * (1.3 * a).sin()]).collect()
    }

    #[test]
    #[should_panic(expected = "out of bounds")]
    fn a_moment_that_is_not_kept_is_none() {
        PlaneMoments::of([0.0, 0.0], points()).get(3, 2);
    }

    fn assert_same(a: &PlaneMoments, b: &PlaneMoments) {
        assert_eq!(a.origin(), b.origin());
        for (x, y) in a.sums().iter().zip(b.sums()) {
            assert!((x - y).abs() <= 1e-12 * (1.0 + x.abs()), "{x} {y}");
        }
    }

    #[test]
    fn sums_stand_in_the_order_of_the_message() {
        let moments = PlaneMoments::of([0.0, 0.0], [[2.0, 3.0]]);
        let expected = [1.0, 2.0, 3.0, 4.0, 6.0, 9.0, 8.0, 12.0, 18.0, 27.0, 16.0, 24.0, 36.0, 54.0, 81.0];
        assert_eq!(moments.sums(), &expected);
        for p in 0..5 {
            for q in 0..5 - p {
                assert_eq!(moments.get(p, q), 2.0_f64.powi(p as i32) * 3.0_f64.powi(q as i32));
            }
        }
    }

    #[test]
    fn scaling_multiplies_offsets() {
        let far = points().into_iter().map(|[s, t]| [1.0 + 3.0 * (s - 1.0), 2.0 + 3.0 * (t - 2.0)]);
        assert_same(&PlaneMoments::of([1.0, 2.0], points()).scaled(3.0), &PlaneMoments::of([1.0, 2.0], far));
    }

    #[test]
    fn a_linear_map_of_the_moments_is_one_of_the_points() {
        let map = [[0.8, -0.3], [0.5, 1.7]];
        let image = |[s, t]: [f64; 2]| [0.8 * s - 0.3 * t, 0.5 * s + 1.7 * t];
        let mapped = PlaneMoments::of([0.9, 1.8], points()).mapped(map);
        assert_same(&mapped, &PlaneMoments::of(image([0.9, 1.8]), points().into_iter().map(image)));
    }

    #[test]
    fn equal_points_and_no_points_have_no_normal_form() {
        assert!(PlaneMoments::new([0.0, 0.0]).normalized().is_none());
        assert!(PlaneMoments::of([1.0, 1.0], [[5.0, 7.1]; 9]).normalized().is_none());
        assert!(PlaneMoments::new([0.0, 0.0]).mean().is_none());
    }

    #[test]
    fn a_normal_form_has_mean_zero_and_spread_one() {
        let (_, spread, unit) = PlaneMoments::of([1.0, 2.0], points()).normalized().unwrap();
        assert!(spread > 0.1 && (unit.count() - 1.0).abs() < 1e-12);
        assert!(unit.get(1, 0).abs() < 1e-12 && unit.get(0, 1).abs() < 1e-12);
        assert!((unit.get(2, 0) + unit.get(0, 2) - 1.0).abs() < 1e-12);
    }

    #[test]
    fn a_moved_origin_gives_what_summing_about_it_gives_also_along_one_axis_alone() {
        for origin in [[1.1, 1.7], [1.1, 0.4], [-0.5, 1.7], [-0.5, 0.4]] {
            assert_same(&PlaneMoments::of([-0.5, 0.4], points()).about(origin), &PlaneMoments::of(origin, points()));
        }
    }

    #[test]
    fn variances_are_about_the_mean_wherever_the_origin_is() {
        // The means are 3 and 5.
        let points = [[1.0, 2.0], [2.0, 4.0], [6.0, 9.0]];
        let expected = [(4.0 + 1.0 + 9.0) / 3.0, (6.0 + 1.0 + 12.0) / 3.0, (9.0 + 1.0 + 16.0) / 3.0];
        for origin in [[3.0, 5.0], [0.0, 0.0], [-2.0, 7.0]] {
            let found = PlaneMoments::of(origin, points).covariance().unwrap();
            assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{found:?} about {origin:?}");
        }
        assert_eq!(PlaneMoments::new([1.0, 2.0]).covariance(), None);
    }

    #[test]
    fn points_are_told_apart_by_how_near_they_are_to_the_origin_of_their_sums() {
        let corners = |[s, t]: [f64; 2], side: f64| [[s, t], [s + side, t], [s, t + side], [s + side, t + side]];
        let spread = |origin, points: &[[f64; 2]]| {
            PlaneMoments::of(origin, points.iter().copied()).normalized().map(|(_, spread, _)| spread)
        };
        for place in [[1e6, 0.0], [0.0, 1e6], [0.0, 0.0]] {
            let near = spread(place, &corners(place, 0.25)).unwrap();
            assert!((near - 0.25 / 2.0_f64.sqrt()).abs() < 1e-6, "{near} at {place:?}");
            let middle = place.map(|x| x + 0.125);
            let about_the_middle = spread(middle, &corners(place, 0.25)).unwrap();
            assert!((about_the_middle - 0.25 / 2.0_f64.sqrt()).abs() < 1e-12);
            assert_eq!(spread(place, &[place; 4]), None, "equal points");
        }
        for i in 0..20 {
            let far = 1e6 + f64::from(i) / 7.0;
            for place in [[far, 0.0], [0.0, far], [far, -far]] {
                assert_eq!(spread([0.0, 0.0], &[place; 7]), None, "what rounding left of equal points is no spread");
            }
        }
    }
}
