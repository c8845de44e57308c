//! Moments of points in space, which suffice to fit a quadric to the points of many arcs.
//!
//! The points of an arc lie in a scan plane, where `p = (s, t y / k, t / k)` for a row of slope y and stretch k. So each
//! of the 35 moments `sum X^a Y^b Z^c`, a + b + c <= 4, is one plane moment times a constant,
//! `(y / k)^b (1 / k)^c m[a, b + c]`: an arc joins the pool in O(1), and no point is seen again. Columns are the same
//! with x and y exchanged.

use crate::moments::shifts;
use crate::{ArcMoments, PlaneMoments, Scan, ScanPlane, Sphere, Vector3};
use nalgebra::{Matrix3, Matrix4, Vector4};

/// Number of moments of points in space, up to degree four.
const SPACE_MOMENTS: usize = 35; // [derived]

/// Number of monomials of a quadric: X2, Y2, Z2, XY, XZ, YZ, X, Y, Z, 1.
pub const QUADRIC_TERMS: usize = 10; // [derived]

/// Coefficients of a quadric, in the order X2, Y2, Z2, XY, XZ, YZ, X, Y, Z, 1.
pub type Coefficients = [f64; QUADRIC_TERMS];

/// Exponents `[a, b, c]` of each moment.
const EXPONENTS: [[usize; 3]; SPACE_MOMENTS] = exponents();

/// For each axis: pairs of moments, to the first of which a share of the second is added as the origin moves along it, in this
/// order.
const SHIFTS: [[[usize; 2]; SPACE_MOMENTS]; 3] = [shifts(&EXPONENTS, 0), shifts(&EXPONENTS, 1), shifts(&EXPONENTS, 2)];

/// For each moment of the points of a row: its powers of the slope across the scan line and of the forward component, and the
/// index of its plane moment.
const OF_ROW: [[usize; 3]; SPACE_MOMENTS] = of_arc(false);
/// For each moment of the points of a column: its powers of the slope across the scan line and of the forward component, and the
/// index of its plane moment.
const OF_COLUMN: [[usize; 3]; SPACE_MOMENTS] = of_arc(true);

/// Exponents of the quadric's monomials.
const QUADRIC: [[usize; 3]; QUADRIC_TERMS] =
    [[2, 0, 0], [0, 2, 0], [0, 0, 2], [1, 1, 0], [1, 0, 1], [0, 1, 1], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]];

/// For each pair of the quadric's monomials, the index of the moment that is their product.
const PRODUCTS: [[usize; QUADRIC_TERMS]; QUADRIC_TERMS] = products();

const fn exponents() -> [[usize; 3]; SPACE_MOMENTS] {
    let mut table = [[0; 3]; SPACE_MOMENTS];
    let (mut next, mut degree) = (0, 0);
    while degree <= 4 {
        let mut rest = 0;
        while rest <= degree {
            let mut c = 0;
            while c <= rest {
                table[next] = [degree - rest, rest - c, c];
                next += 1;
                c += 1;
            }
            rest += 1;
        }
        degree += 1;
    }
    table
}

/// Returns the index of the moment with these exponents, a + b + c <= 4.
const fn place(a: usize, b: usize, c: usize) -> usize {
    let (degree, rest) = (a + b + c, b + c);
    degree * (degree + 1) * (degree + 2) / 6 + rest * (rest + 1) / 2 + c
}

const fn products() -> [[usize; QUADRIC_TERMS]; QUADRIC_TERMS] {
    let mut table = [[0; QUADRIC_TERMS]; QUADRIC_TERMS];
    let mut pair = 0;
    while pair < QUADRIC_TERMS * QUADRIC_TERMS {
        let (i, j) = (pair / QUADRIC_TERMS, pair % QUADRIC_TERMS);
        let ([a, b, c], [d, e, f]) = (QUADRIC[i], QUADRIC[j]);
        table[i][j] = place(a + d, b + e, c + f);
        pair += 1;
    }
    table
}

const fn of_arc(is_column: bool) -> [[usize; 3]; SPACE_MOMENTS] {
    let mut table = [[0; 3]; SPACE_MOMENTS];
    let mut place = 0;
    while place < SPACE_MOMENTS {
        let [a, b, c] = EXPONENTS[place];
        let (along, beside) = if is_column { (b, a) } else { (a, b) };
        table[place] = [beside, c, PlaneMoments::place(along, beside + c)];
        place += 1;
    }
    table
}

/// The 35 moments up to degree 4 of weighted points, about the camera centre.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpaceMoments {
    sums: [f64; SPACE_MOMENTS],
}

impl Default for SpaceMoments {
    fn default() -> Self {
        Self { sums: [0.0; SPACE_MOMENTS] }
    }
}

/// The moments of a pool about its mean in units of its spread: the matrix `sum m m'` of the quadric monomials.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct QuadricMoments {
    /// The mean of the points.
    pub origin: Vector3,
    /// Standard deviation of the points in space.
    pub scale: f64,
    /// `sum m m'` over points `(p - origin) / scale`.
    pub matrix: [[f64; QUADRIC_TERMS]; QUADRIC_TERMS],
}

impl SpaceMoments {
    /// Returns the moments of the points of an arc in the plane `plane`.
    pub fn of_arc(plane: &ScanPlane, moments: &PlaneMoments) -> Self {
        let moments = moments.about([0.0, 0.0]);
        let across = powers(plane.slope() / plane.stretch());
        let forward = powers(1.0 / plane.stretch());
        let moment = |[beside, c, place]: [usize; 3]| across[beside] * forward[c] * moments.sums()[place];
        // One branch per table, so that the indices are known at compile time.
        let sums = match plane.scan() {
            Scan::Row => std::array::from_fn(|i| moment(OF_ROW[i])),
            Scan::Column => std::array::from_fn(|i| moment(OF_COLUMN[i])),
        };
        Self { sums }
    }

    /// Adds points with the weight `weight`.
    pub fn add(&mut self, other: &Self, weight: f64) {
        self.sums.iter_mut().zip(&other.sums).for_each(|(sum, term)| *sum += weight * term);
    }

    /// Returns `sum X^a Y^b Z^c`.
    fn get(&self, a: usize, b: usize, c: usize) -> f64 {
        self.sums[place(a, b, c)]
    }

    /// Sum of the weights of the points.
    pub fn weight(&self) -> f64 {
        self.sums[0]
    }

    /// Mean of the points.
    pub fn mean(&self) -> Vector3 {
        Vector3::new(self.get(1, 0, 0), self.get(0, 1, 0), self.get(0, 0, 1)) / self.weight()
    }

    /// Returns the least variance of the points along any direction: their mean square distance from a plane.
    pub fn least_variance(&self) -> f64 {
        let (n, mean) = (self.weight(), self.mean());
        let second = [[2, 0, 0], [1, 1, 0], [1, 0, 1], [0, 2, 0], [0, 1, 1], [0, 0, 2]];
        let [xx, xy, xz, yy, yz, zz] = second.map(|[a, b, c]| self.get(a, b, c) / n);
        let outer = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz) - mean * mean.transpose();
        outer.symmetric_eigenvalues().min()
    }

    /// Returns the normalised moments for fits; `None` where there are no points, or all of them are the same.
    pub fn normalized(&self) -> Option<QuadricMoments> {
        let origin = self.mean();
        let mut local = *self;
        local.shift::<0>(-origin.x);
        local.shift::<1>(-origin.y);
        local.shift::<2>(-origin.z);
        let trace = local.get(2, 0, 0) + local.get(0, 2, 0) + local.get(0, 0, 2);
        let scale = (trace / self.weight()).sqrt();
        // An extent of a nanometre counts as none. [algorithmic]
        if !(scale.is_finite() && scale > 1e-9) {
            return None;
        }
        let factors = powers(1.0 / scale);
        for (sum, [a, b, c]) in local.sums.iter_mut().zip(EXPONENTS) {
            *sum *= factors[a + b + c];
        }
        let matrix = std::array::from_fn(|i| std::array::from_fn(|j| local.sums[PRODUCTS[i][j]]));
        Some(QuadricMoments { origin, scale, matrix })
    }

    /// Shifts the points by `by` along an axis: the binomial theorem, in place.
    fn shift<const AXIS: usize>(&mut self, by: f64) {
        SHIFTS[AXIS].iter().for_each(|[to, from]| self.sums[*to] += by * self.sums[*from]);
    }
}

impl QuadricMoments {
    /// Returns the sphere of least algebraic distance `sum (|p|^2 + b.p + c)^2`, in the camera frame: a start for better fits.
    pub fn sphere(&self) -> Option<Sphere> {
        let m = &self.matrix;
        let normal = Matrix4::from_fn(|i, j| m[6 + i][6 + j]);
        let right = Vector4::from_fn(|i, _| -(m[0][6 + i] + m[1][6 + i] + m[2][6 + i]));
        let [x, y, z, c] = normal.cholesky()?.solve(&right).into();
        let center = Vector3::new(x, y, z) * -0.5;
        let square = center.norm_squared() - c;
        (square > 0.0).then(|| Sphere { center: self.origin + center * self.scale, radius: square.sqrt() * self.scale })
    }

    /// Returns the moments of the points `(u.p, v.p)` for two perpendicular unit vectors, in the frame of the fits.
    pub fn seen_along(&self, u: &Vector3, v: &Vector3) -> ArcMoments {
        let linear = |a: &Vector3| [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, a.x, a.y, a.z, 0.0];
        let square = |i: usize, j: usize| u[i] * u[j] + v[i] * v[j];
        let round =
            [square(0, 0), square(1, 1), square(2, 2), 2.0 * square(0, 1), 2.0 * square(0, 2), 2.0 * square(1, 2)];
        let (x, y) = (linear(u), linear(v));
        let q = std::array::from_fn(|i| round.get(i).copied().unwrap_or_default());
        let (count, [mx, my, mq]) = (self.matrix[9][9], [x, y, q].map(|a| self.times(&a)));
        let mean = |m: &Coefficients, a: &Coefficients| dot(m, a) / count;
        let squares = [mean(&mx, &x), mean(&mx, &y), mean(&my, &y)];
        let cubes = [mean(&mx, &q), mean(&my, &q)];
        ArcMoments::from_means(count, [mx[9] / count, my[9] / count], squares, cubes, mean(&mq, &q))
    }

    /// Returns `q' (sum m m')`; its product with the coefficients of another quadric is the sum of the products of both over the
    /// points.
    pub fn times(&self, q: &Coefficients) -> Coefficients {
        let mut product = [0.0; QUADRIC_TERMS];
        // Most derivatives have zeros in half of their coefficients.
        for (row, factor) in self.matrix.iter().zip(q).filter(|(_, factor)| **factor != 0.0) {
            product.iter_mut().zip(row).for_each(|(sum, entry)| *sum += factor * entry);
        }
        product
    }
}

/// Returns the sum of the products.
#[inline]
pub(crate) fn dot(a: &Coefficients, b: &Coefficients) -> f64 {
    let two = std::array::from_fn(|i| {
        a[i] * b[i] + a[i + 2] * b[i + 2] + a[i + 4] * b[i + 4] + a[i + 6] * b[i + 6] + a[i + 8] * b[i + 8]
    });
    let [even, odd]: [f64; 2] = two;
    even + odd
}

/// Returns the monomials of a quadric at a point.
pub(crate) fn monomials(p: &Vector3) -> Coefficients {
    [p.x * p.x, p.y * p.y, p.z * p.z, p.x * p.y, p.x * p.z, p.y * p.z, p.x, p.y, p.z, 1.0]
}

/// Returns the powers 0 to 4.
fn powers(x: f64) -> [f64; 5] {
    [1.0, x, x * x, x * x * x, x * x * x * x]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pinhole;

    const CAMERA: Pinhole = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

    #[test]
    fn pooled_arcs_give_the_matrix_of_their_points() {
        let mut pool = SpaceMoments::default();
        let mut points = Vec::new();
        for (scan, line) in [(Scan::Row, 30.0), (Scan::Row, 200.0), (Scan::Column, 250.0)] {
            let plane = CAMERA.plane(scan, line);
            let arc: Vec<_> = (0..20).map(|i| [0.1 + 0.02 * f64::from(i), 1.5 + 0.3 * f64::from(i * i % 7)]).collect();
            pool.add(&SpaceMoments::of_arc(&plane, &PlaneMoments::of([0.2, 1.6], arc.iter().copied())), 1.0);
            points.extend(arc.into_iter().map(|point| plane.to_camera(point)));
        }
        let normal = pool.normalized().unwrap();
        let mean = points.iter().sum::<Vector3>() / points.len() as f64;
        assert!((normal.origin - mean).norm() < 1e-12);
        let mut expected = [[0.0; QUADRIC_TERMS]; QUADRIC_TERMS];
        for point in &points {
            let m = monomials(&((point - normal.origin) / normal.scale));
            (0..100).for_each(|ij| expected[ij / 10][ij % 10] += m[ij / 10] * m[ij % 10]);
        }
        for (row, expected) in normal.matrix.iter().zip(&expected) {
            row.iter().zip(expected).for_each(|(x, y)| assert!((x - y).abs() < 1e-8, "{x} {y}"));
        }
    }

    #[test]
    fn seen_along_two_directions_they_are_points_of_a_plane() {
        let plane = CAMERA.plane(Scan::Row, 30.0);
        let arc: Vec<_> = (0..20).map(|i| [0.1 + 0.02 * f64::from(i), 1.5 + 0.3 * f64::from(i * i % 7)]).collect();
        let pool = SpaceMoments::of_arc(&plane, &PlaneMoments::of([0.2, 1.6], arc.iter().copied()));
        let normal = pool.normalized().unwrap();
        let u = Vector3::new(0.9, 0.2, -0.3).normalize();
        let v = u.cross(&Vector3::new(0.1, 0.5, 0.8)).normalize();
        let seen = arc.into_iter().map(|point| (plane.to_camera(point) - normal.origin) / normal.scale);
        let expected = ArcMoments::of(&PlaneMoments::of([0.0, 0.0], seen.map(|p| [u.dot(&p), v.dot(&p)]))).unwrap();
        for (a, b) in normal.seen_along(&u, &v).numbers().into_iter().zip(expected.numbers()) {
            assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn no_points_and_equal_points_have_no_normal_form() {
        assert_eq!(SpaceMoments::default().normalized(), None);
        let plane = CAMERA.plane(Scan::Row, 0.0);
        let same = SpaceMoments::of_arc(&plane, &PlaneMoments::of([0.0, 1.0], [[0.0, 1.0]; 5]));
        assert_eq!(same.normalized(), None);
    }

    #[test]
    fn the_least_variance_is_the_mean_square_distance_from_the_best_plane() {
        let normal = Vector3::new(0.2, -0.3, -1.0).normalize();
        let mut pool = SpaceMoments::default();
        for row in [60.0, 90.0, 150.0] {
            let plane = CAMERA.plane(Scan::Row, row);
            // Points on the rays, alternately before and behind the plane at 1.5 m by the same distance.
            let points = (0..40).map(|i| 0.01 * f64::from(i / 2)).zip([0.02, -0.02].into_iter().cycle());
            let on = |x: f64, off: f64| {
                let ray = plane.to_camera([x, plane.stretch()]);
                let depth = (-1.5 + off) / normal.dot(&ray);
                [x * depth, plane.stretch() * depth]
            };
            let arc = PlaneMoments::of([0.1, 1.5], points.map(|(x, off)| on(x, off)));
            pool.add(&SpaceMoments::of_arc(&plane, &arc), 2.5);
        }
        let variance = pool.least_variance();
        assert!((variance / 0.0004 - 1.0).abs() < 0.02, "{variance}");
    }

    #[test]
    fn equal_points_without_a_rounding_error_have_no_normal_form_either() {
        let same = PlaneMoments::of([0.0, 1.0], [[0.0, 1.0]; 4]);
        assert_eq!(SpaceMoments::of_arc(&CAMERA.plane(Scan::Row, CAMERA.cy), &same).normalized(), None);
    }
}
