//! The three models and their fits to the pooled moments of some arcs.

use super::arcs::{Arc, Residual};
use super::region::Region;
use conicflow_geometry::{
    ArcFit, Coefficients, Conical, Line, LineMoments, Prediction, QuadricMoments, SpaceMoments, Sphere, Surface,
    SurfaceFit, Vector3, across, fit_surface,
};
use conicflow_messages::ObjectKind;

/// Lower bound of the radius of a cone at an arc, relative to the radius `R` that is its parameter. Near the apex F is no
/// distance, and this bound keeps the weights finite.
const MIN_RADIUS_RATIO: f64 = 0.05; // [algorithmic]
/// Limit on the square sum of the first fit of a cone, as a multiple of the limit of its refit: the first fit weights arcs as
/// those of a cylinder.
const UNWEIGHTED: f64 = 2.0; // [algorithmic]
/// Largest slope of a cone; the fit of a steeper one has diverged.
const STEEPEST: f64 = 1.2; // [algorithmic]

/// Largest radius from which the fit of a cylinder starts, in metres.
const WIDEST: f64 = 2.0; // [algorithmic]

/// A fitted model.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Model {
    Sphere(SurfaceFit<Sphere, 4>),
    Cylinder(SurfaceFit<Conical, 5>),
    Cone(SurfaceFit<Conical, 6>),
}

/// Evaluates an expression of the fit, whatever the shape.
macro_rules! of_fit {
    ($model:expr, $fit:ident => $value:expr) => {
        match $model {
            $crate::assemble::model::Model::Sphere($fit) => $value,
            $crate::assemble::model::Model::Cylinder($fit) => $value,
            $crate::assemble::model::Model::Cone($fit) => $value,
        }
    };
}
pub(super) use of_fit;

impl Model {
    pub fn kind(&self) -> ObjectKind {
        match self {
            Self::Sphere(_) => ObjectKind::Sphere,
            Self::Cylinder(_) => ObjectKind::Cylinder,
            Self::Cone(_) => ObjectKind::Cone,
        }
    }

    pub fn coefficients(&self) -> Coefficients {
        of_fit!(self, fit => fit.surface.coefficients())
    }

    /// Axis and profile of a cylinder or cone.
    pub fn conical(&self) -> Option<Conical> {
        match self {
            Self::Sphere(_) => None,
            Self::Cylinder(SurfaceFit { surface, .. }) | Self::Cone(SurfaceFit { surface, .. }) => Some(*surface),
        }
    }

    /// Returns the origin of positions along the axis, and the direction of the axis; of a sphere its centre and zero.
    pub fn axis(&self) -> (Vector3, Vector3) {
        match self {
            Self::Sphere(fit) => (fit.surface.center, Vector3::zeros()),
            Self::Cylinder(SurfaceFit { surface, .. }) | Self::Cone(SurfaceFit { surface, .. }) => {
                (surface.point, surface.axis)
            }
        }
    }

    /// Returns the radius and its variance, as if each line had its own noise.
    pub fn radius(&self) -> (f64, f64) {
        match self {
            Self::Sphere(fit) => (fit.surface.radius, fit.inverse[(3, 3)]),
            Self::Cylinder(fit) => (fit.surface.radius, fit.inverse[(4, 4)]),
            Self::Cone(fit) => (fit.surface.radius, fit.inverse[(4, 4)]),
        }
    }

    /// Returns the radius of a sphere or cylinder, or that of a cone at `mean`.
    pub fn radius_at(&self, mean: &Vector3) -> f64 {
        match self {
            Self::Sphere(fit) => fit.surface.radius,
            Self::Cylinder(fit) => fit.surface.radius,
            Self::Cone(fit) => fit.surface.radius_at(mean),
        }
    }

    /// Returns the radius of a cone at an arc, relative to that at its point: F is too large there by this factor (see
    /// [`Conical`]). It is negative beyond the apex.
    fn radius_ratio(&self, arc: &Arc) -> f64 {
        match self {
            Self::Cone(fit) => fit.surface.radius_at(&arc.mean) / fit.surface.radius,
            _ => 1.0,
        }
    }

    /// Returns the weight of a point of an arc: one over the variance of F there.
    pub fn weight(&self, arc: &Arc) -> f64 {
        1.0 / (arc.variance * self.radius_ratio(arc).max(MIN_RADIUS_RATIO).powi(2))
    }

    /// Weighted sum of the squared distances.
    pub fn square_sum(&self) -> f64 {
        of_fit!(self, fit => fit.square_sum)
    }

    /// Weighted sum of the squared distances of the contour.
    pub fn contour_sum(&self) -> f64 {
        of_fit!(self, fit => fit.contour_sum)
    }

    /// Weighted sum of the squared distances of points and contour.
    pub fn cost(&self) -> f64 {
        self.square_sum() + self.contour_sum()
    }

    /// Returns the residuals of an arc from the model, whose coefficients are `q`; `None` near and beyond the apex of a cone.
    pub fn residual(&self, q: &Coefficients, arc: &Arc) -> Option<Residual> {
        let ratio = self.radius_ratio(arc);
        let Residual { square, mean } = arc.residual(q);
        (ratio > MIN_RADIUS_RATIO).then(|| Residual { square: square / (ratio * ratio), mean: mean / ratio })
    }
}

/// Predicts the variance of a model's surface.
#[derive(Clone, Copy, Debug)]
pub(super) enum Predictor {
    Sphere(Prediction<4>),
    Cylinder(Prediction<5>),
    Cone(Prediction<6>),
}

impl Predictor {
    pub fn new(model: &Model) -> Self {
        match model {
            Model::Sphere(fit) => Self::Sphere(Prediction::new(fit)),
            Model::Cylinder(fit) => Self::Cylinder(Prediction::new(fit)),
            Model::Cone(fit) => Self::Cone(Prediction::new(fit)),
        }
    }

    /// Variance of the distance of a point from the surface.
    pub fn variance(&self, point: &Vector3) -> f64 {
        match self {
            Self::Sphere(prediction) => prediction.variance(point),
            Self::Cylinder(prediction) => prediction.variance(point),
            Self::Cone(prediction) => prediction.variance(point),
        }
    }
}

/// Pools the moments of arcs, each with its weight.
fn pool<'a>(arcs: impl Iterator<Item = &'a Arc>, weight: impl Fn(&Arc) -> f64) -> SpaceMoments {
    let mut pool = SpaceMoments::default();
    arcs.for_each(|arc| pool.add(arc.space(), weight(arc)));
    pool
}

/// Returns the weight of a point by its noise alone.
fn precision(arc: &Arc) -> f64 {
    1.0 / arc.variance
}

/// Pools the arcs of a region with the weights of its model, without the points outside its outline or within `edge_px` pixels of
/// it.
pub(super) fn pool_within(region: &Region, edge_px: f64) -> SpaceMoments {
    let (model, q) = (&region.model, region.model.coefficients());
    let (mut pool, mut left_out) = (SpaceMoments::default(), 0);
    for arc in region.arcs() {
        if edge_px > 0.0 && arc.grazes(&q, edge_px) {
            left_out += 1;
            continue;
        }
        let weight = model.weight(arc);
        pool.add(arc.space(), weight);
        arc.outside(&q, edge_px).for_each(|point| pool.add(&point, -weight));
    }
    // If most lines lie at the edge, the object shows nothing better: they are not left out.
    if 2 * left_out > region.members.len() { pool_within(region, 0.0) } else { pool }
}

/// Fits a model of a kind; starts from `last` if that is of the same kind. Gives up where the weighted sum of squares will not
/// fall below `most`.
pub(super) fn fit<'a>(
    kind: ObjectKind,
    arcs: &(impl Iterator<Item = &'a Arc> + Clone),
    last: Option<&Model>,
    most: f64,
) -> Option<Model> {
    match kind {
        ObjectKind::Sphere => fit_sphere(arcs, last, most),
        ObjectKind::Cylinder => fit_cylinder(arcs, last, most),
        ObjectKind::Cone => fit_cone(arcs, last, most),
    }
}

fn fit_sphere<'a>(arcs: &(impl Iterator<Item = &'a Arc> + Clone), last: Option<&Model>, most: f64) -> Option<Model> {
    let moments = pool(arcs.clone(), precision).normalized()?;
    let start = match last {
        Some(Model::Sphere(fit)) => fit.surface,
        _ => moments.sphere()?,
    };
    fit_surface(&moments, &start, most).map(Model::Sphere)
}

fn fit_cylinder<'a>(arcs: &(impl Iterator<Item = &'a Arc> + Clone), last: Option<&Model>, most: f64) -> Option<Model> {
    let moments = pool(arcs.clone(), precision).normalized()?;
    let start = match last {
        Some(Model::Cylinder(fit)) => fit.surface,
        _ => start(arcs.clone(), &moments)?,
    };
    fit_surface(&moments, &start, most).map(Model::Cylinder)
}

fn fit_cone<'a>(arcs: &(impl Iterator<Item = &'a Arc> + Clone), last: Option<&Model>, most: f64) -> Option<Model> {
    let first = match last {
        Some(Model::Cone(fit)) => *fit,
        _ => {
            let moments = pool(arcs.clone(), precision).normalized()?;
            let start = match last {
                Some(Model::Cylinder(fit)) => fit.surface,
                _ => start(arcs.clone(), &moments)?,
            };
            let fit = fit_surface(&moments, &start, UNWEIGHTED * most)?;
            (fit.surface.slope.abs() <= STEEPEST).then_some(fit)?
        }
    };
    let moments = pool(arcs.clone(), |arc| Model::Cone(first).weight(arc)).normalized()?;
    fit_surface(&moments, &first.surface, most).map(|fit| Model::Cone(pointing_from_apex(fit)))
}

/// Returns the same cone with its axis pointing away from the apex.
pub(super) fn pointing_from_apex(fit: SurfaceFit<Conical, 6>) -> SurfaceFit<Conical, 6> {
    if fit.surface.slope >= 0.0 {
        return fit;
    }
    let mut flipped = fit;
    let before = fit.surface;
    flipped.surface = Conical { axis: -before.axis, slope: -before.slope, ..before };
    // Parameters: tilts, shifts, radius, slope. The directions across turn with the axis.
    let (old, new) = (before.across(), flipped.surface.across());
    let turn = |i: usize| new[i].dot(&old[i]);
    let signs = [-turn(0), -turn(1), turn(0), turn(1), 1.0, -1.0];
    for i in 0..6 {
        for j in 0..6 {
            flipped.inverse[(i, j)] *= signs[i] * signs[j];
            flipped.contour[(i, j)] *= signs[i] * signs[j];
        }
    }
    flipped
}

/// Returns a starting value, from the circle in which `moments`, the pooled points, appear along an axis: of several axes the one
/// along which the points lie best on one circle.
fn start<'a>(arcs: impl Iterator<Item = &'a Arc> + Clone, moments: &QuadricMoments) -> Option<Conical> {
    let first = arcs.clone().next()?;
    let (mut centers, mut means) = (LineMoments::new(first.center), LineMoments::new(first.mean));
    arcs.for_each(|arc| {
        centers.add(&arc.center);
        means.add(&arc.mean);
    });
    let along = |line: Option<Line>| line.map(|line| line.direction);
    let axes = [Some(first.plane.normal()), along(centers.fit()), along(means.fit())];
    let guesses = axes.into_iter().flatten().filter_map(|axis| round_about(moments, &axis));
    guesses.min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, guess)| guess)
}

/// Fits a circle to all points as seen along an axis; returns the mean square distance from it, and the cylinder.
fn round_about(moments: &QuadricMoments, axis: &Vector3) -> Option<(f64, Conical)> {
    let [u, v] = across(axis);
    let ArcFit { circle, circle_square, .. } = moments.seen_along(&u, &v).fit();
    let [x, y] = circle.center.map(|offset| offset * moments.scale);
    let radius = (circle.radius * moments.scale).min(WIDEST);
    let point = moments.origin + u * x + v * y;
    radius.is_finite().then_some((circle_square, Conical { point, axis: *axis, radius, slope: 0.0 }))
}

#[cfg(test)]
mod tests {
    use super::super::arcs::Arcs;
    use super::super::contours::ContourCalibration;
    use super::super::tests::{arcs_by, arcs_of, rows_of, wall};
    use super::*;
    use conicflow_geometry::fit_with_contour;
    use conicflow_lab::rendered::{KINECT_HALF, frustum};
    use conicflow_messages::NoiseModel;

    /// A leaning cone at a distance of two metres.
    fn cone() -> Conical {
        let axis = Vector3::new(0.1, 0.9, 0.2).normalize();
        Conical { point: Vector3::new(0.05, 0.0, 2.0), axis, radius: 0.2, slope: 0.3 }
    }

    fn body(cone: &Conical) -> conicflow_lab::simulator::shapes::Shape {
        frustum(cone.point, cone.axis, cone.radius, cone.slope, 0.6)
    }

    fn fitted(arcs: &Arcs, rows: &[usize]) -> SurfaceFit<Conical, 6> {
        match fit(ObjectKind::Cone, &arcs.of(rows), None, f64::INFINITY) {
            Some(Model::Cone(fit)) => fit,
            other => panic!("{other:?}"),
        }
    }

    /// F is larger than the distance by the ratio of the radius to that in the middle.
    #[test]
    fn the_points_of_a_cone_are_off_by_their_distance_wherever_they_are() {
        let cone = cone();
        let arcs = arcs_by(KINECT_HALF, NoiseModel::IDEAL, &[body(&cone)]);
        let (rows, depth) = (rows_of(&arcs, |arc| cone.radius_at(&arc.mean) > 0.14), 0.004);
        let mut fit = fitted(&arcs, &rows);
        // The surface is moved in by `depth` everywhere, measured across it.
        fit.surface = Conical { radius: cone.radius - depth / cone.half_angle().cos(), ..cone };
        let model = Model::Cone(fit);
        let ratios: Vec<_> = arcs.of(&rows).map(|arc| model.radius_ratio(arc)).collect();
        assert!(ratios.iter().any(|ratio| *ratio < 0.8) && ratios.iter().any(|ratio| *ratio > 1.3));
        for arc in arcs.of(&rows) {
            let Residual { square, mean } = model.residual(&model.coefficients(), arc).unwrap();
            assert!((mean / depth - 1.0).abs() < 0.1, "{mean} m, where it is {} m wide", cone.radius_at(&arc.mean));
            assert!((square / (depth * depth) - 1.0).abs() < 0.2, "{square}, {} m wide", cone.radius_at(&arc.mean));
        }
    }

    #[test]
    fn a_cone_is_as_sure_of_its_surface_and_of_its_contour_whichever_way_its_axis_points() {
        let cone = cone();
        let arcs = arcs_of(&[body(&cone), wall(4.0)]);
        let rows = rows_of(&arcs, |arc| arc.mean.z < 2.5);
        let (fit, mut contours) = (fitted(&arcs, &rows), ContourCalibration::default());
        let region = Region { arcs: &arcs, model: Model::Cone(fit), members: &rows };
        let (_, contour) = contours.fit(&region).unwrap();
        let points = pool_within(&region, 0.0).normalized().unwrap();
        let before = fit.surface;
        let start = Conical { axis: -before.axis, slope: -before.slope, ..before };
        let downwards = fit_with_contour(&points, contour, &start).unwrap();
        let upwards = pointing_from_apex(downwards);
        let (up, down) = (upwards.surface, downwards.surface);
        assert!(
            down.slope < -0.2 && up.slope == -down.slope && up.axis == -down.axis && up.axis.dot(&cone.axis) > 0.99
        );
        let of = |fit: &SurfaceFit<Conical, 6>, point: &Vector3| {
            let contour = SurfaceFit { inverse: fit.contour, ..*fit };
            [fit, &contour].map(|fit| Prediction::new(fit).variance(point))
        };
        for arc in arcs.of(&rows) {
            for (found, expected) in of(&upwards, &arc.mean).into_iter().zip(of(&downwards, &arc.mean)) {
                assert!((found / expected - 1.0).abs() < 1e-6 && expected > 0.0, "{found} {expected}");
            }
        }
    }

    #[test]
    fn a_model_costs_what_it_leaves_of_the_points_and_of_the_contour() {
        let arcs = arcs_of(&[body(&cone()), wall(4.0)]);
        let rows = rows_of(&arcs, |arc| arc.mean.z < 2.5);
        for kind in [ObjectKind::Cylinder, ObjectKind::Cone] {
            let model = fit(kind, &arcs.of(&rows), None, f64::INFINITY).unwrap();
            let mut contours = ContourCalibration::default();
            let (model, _) = contours.fit(&Region { arcs: &arcs, model, members: &rows }).unwrap();
            let (square_sum, contour_sum) = of_fit!(&model, fit => (fit.square_sum, fit.contour_sum));
            assert!(model.cost() == square_sum + contour_sum && contour_sum > 1.0, "{kind:?}: {contour_sum}");
        }
    }
}
