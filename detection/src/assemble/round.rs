//! Estimates whether an object is round or oval: how other quadrics near a fitted shape explain its points and its contour.

use super::contours::edge_px;
use super::model::{Model, pool_within};
use super::region::Region;
use conicflow_geometry::{Conical, Contour, QuadricMoments, Sphere, departure};
use nalgebra::{SMatrix, SVector};

/// Standard deviation of the departure (see [`conicflow_geometry::Sphere::departures`]) of round objects: neither objects nor
/// sensors are exact. The ball of the recordings departs by 0.05 to 0.15.
const ROUND: f64 = 0.05; // [tuned]
/// Standard deviation of the departure (see [`conicflow_geometry::Sphere::departures`]) of objects that are not round.
const OVAL: f64 = 0.15; // [tuned]

/// Returns the logarithm of the Bayes factor of a round surface over any quadric near it, from the points and the contour of a
/// fitted region (Kass and Raftery, "Bayes factors", 1995); 0 where they do not determine it.
pub(super) fn roundness(region: &Region, contour: &Contour) -> f64 {
    let shared = region.shared_lines();
    let log_ratio = |points: QuadricMoments| match &region.model {
        Model::Sphere(fit) => log_ratio(departure::<_, 4, 5, 9>(&points, contour, fit, Sphere::departures)?, shared),
        Model::Cylinder(fit) => log_ratio(departure::<_, 5, 2, 7>(&points, contour, fit, Conical::departures)?, shared),
        Model::Cone(fit) => log_ratio(departure::<_, 6, 2, 8>(&points, contour, fit, Conical::departures)?, shared),
    };
    pool_within(region, edge_px(contour)).normalized().and_then(log_ratio).unwrap_or(0.0)
}

/// Returns the logarithm of the ratio of the probability densities of a departure among round objects and among others. The
/// covariance is multiplied by the number of lines that share their noise.
fn log_ratio<const K: usize>(
    (departure, covariance): (SVector<f64, K>, SMatrix<f64, K, K>),
    shared_lines: f64,
) -> Option<f64> {
    let log_density = |scatter: f64| {
        let root = (covariance * shared_lines + SMatrix::identity() * (scatter * scatter)).cholesky()?;
        let spread: f64 = root.l_dirty().diagonal().iter().map(|x| x.ln()).sum();
        Some(-0.5 * departure.dot(&root.solve(&departure)) - spread)
    };
    Some(log_density(ROUND)? - log_density(OVAL)?)
}

#[cfg(test)]
mod tests {
    use super::super::arcs::Arc;
    use super::super::contours::ContourCalibration;
    use super::super::model;
    use super::super::tests::{arcs_of, wall};
    use super::*;
    use conicflow_geometry::{Scan, Vector3};
    use conicflow_lab::simulator::shapes::{Lump, Shape};
    use conicflow_messages::ObjectKind;
    use nalgebra::Matrix3;

    /// An ellipsoid, or a cylinder with an oval section, at this distance; `half` has half its width, depth and height.
    fn lump(distance: f64, half: [f64; 3], squareness: u32) -> Shape {
        let axes = Matrix3::from_columns(&[Vector3::x(), Vector3::z(), Vector3::y()]);
        let (center, half) = (Vector3::new(0.0, 0.0, distance), Vector3::from(half));
        Shape::Lump(Lump { center, axes, half, squareness: [1, squareness], creases: Default::default() })
    }

    fn oval(distance: f64, half_width: f64, half_depth: f64) -> Shape {
        lump(distance, [half_width, half_depth, 0.3], 4)
    }

    /// The roundness of a body, from the rows of its middle.
    fn of(kind: ObjectKind, body: Shape, shared_lines: f64) -> f64 {
        let (mut arcs, center) = (arcs_of(&[body, wall(6.0)]), body.anchor());
        arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = shared_lines);
        let is_of_it = |arc: &Arc| arc.scan == Scan::Row && (arc.mean - center).norm() < 0.25;
        let members: Vec<_> = (0..arcs.arcs.len()).filter(|&index| is_of_it(&arcs.arcs[index])).collect();
        let model = model::fit(kind, &arcs.of(&members), None, f64::INFINITY).unwrap();
        let mut region = Region { arcs: &arcs, model, members: &members };
        let mut contours = ContourCalibration::default();
        let (fitted, contour) = contours.fit(&region).unwrap();
        region.model = fitted;
        roundness(&region, contour)
    }

    #[test]
    fn what_is_round_is_so_and_what_is_oval_is_not_and_far_away_neither_is_told() {
        for kind in [ObjectKind::Cylinder, ObjectKind::Cone] {
            let round = of(kind, oval(1.5, 0.1, 0.1), 1.0);
            let [wide, deep] =
                [[0.12, 0.08], [0.08, 0.12]].map(|[width, depth]| of(kind, oval(1.5, width, depth), 1.0));
            let far_off = of(kind, oval(4.5, 0.12, 0.08), 40.0);
            println!("{kind:?}: {round:.1} {wide:.1} {deep:.1} {far_off:.1}");
            assert!(round > 1.5 && round < 2.0 * (OVAL / ROUND).ln() + 0.1, "{round}");
            assert!(wide < -4.0 && deep < -4.0, "{wide} {deep}");
            assert!(far_off.abs() < 1.0, "{far_off}");
        }
    }

    #[test]
    fn a_ball_is_round_and_an_ellipsoid_is_not() {
        let of = |half: [f64; 3]| of(ObjectKind::Sphere, lump(1.5, half, 1), 1.0);
        let (round, flat, long) = (of([0.12; 3]), of([0.12, 0.12, 0.09]), of([0.14, 0.11, 0.11]));
        println!("{round:.1} {flat:.1} {long:.1}");
        assert!(round > 2.0 && flat < -4.0 && long < -4.0, "{round} {flat} {long}");
    }
}
