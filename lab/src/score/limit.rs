//! Compares a detector with the best possible accuracy: scatter, bias and reported standard deviations of its answers about one
//! still object, over frames with different noise, beside the Cramer-Rao bounds ([`crate::bound`]).

use super::matching::{Answer, Matcher, compare, perpendicular};
use super::row::Row;
use super::truth::{RenderedTruth, TrueObject};
use crate::bound::{Bound, Bounds, Measuring, bounds};
use crate::running_stats::RunningStats;
use crate::simulator::raster::Raster;
use crate::simulator::shapes::Shape;
use anyhow::{Result, bail};
use conicflow_messages::{Header, Hinted, Object};
use nalgebra::{Matrix3, Vector3};

/// Least number of answers for a scatter, which is known to a quarter then.
const FEWEST: u64 = 10;

/// The columns of a row about a quantity.
const COLUMNS: [&str; 14] = [
    "object",
    "quantity",
    "frames",
    "found",
    "wrong",
    "bound_a",
    "bound_b",
    "scatter",
    "bias",
    "sigma",
    "efficiency_a",
    "efficiency_b",
    "bias_over_scatter",
    "sigma_over_scatter",
];

/// Returns the names of all columns that a row can have.
pub fn columns() -> impl Iterator<Item = &'static str> {
    COLUMNS.into_iter()
}

/// A quantity that is measured.
struct Quantity {
    /// Its name and unit.
    name: &'static str,
    /// Number of these units in a metre or radian.
    units: f64,
    /// The bound, if the shape has the quantity.
    bound: fn(&Bound) -> Option<f64>,
    /// The error of an answer: a number in x, or a vector.
    error: fn(&Object, &Object) -> Vector3<f64>,
    /// The variance that the answer reports, summed over all components.
    variance: fn(&Object) -> f64,
}

const MILLI: f64 = 1e3;
const DEGREES: f64 = 180.0 / std::f64::consts::PI;

const QUANTITIES: [Quantity; 4] = [
    Quantity {
        name: "radius mm",
        units: MILLI,
        bound: |bound| Some(bound.radius_m),
        error: |truth, answer| Vector3::x() * (compare(truth, answer).radius_m - truth.radius),
        variance: |answer| answer.sigma.radius.powi(2),
    },
    Quantity {
        name: "position mm",
        units: MILLI,
        bound: |bound| Some(bound.position_m),
        // the axis of a sphere is zero
        error: |truth, answer| {
            perpendicular(&(Vector3::from(answer.center) - Vector3::from(truth.center)), &Vector3::from(answer.axis))
        },
        variance: |answer| {
            let (covariance, axis) = (Matrix3::from(answer.sigma.center), Vector3::from(answer.axis));
            covariance.trace() - (covariance * axis).dot(&axis)
        },
    },
    Quantity {
        name: "axis deg",
        units: DEGREES,
        bound: |bound| bound.axis,
        error: |truth, answer| {
            let (truth, axis) = (Vector3::from(truth.axis), Vector3::from(answer.axis));
            perpendicular(&(axis * axis.dot(&truth).signum()), &truth)
        },
        variance: |answer| answer.sigma.axis.powi(2),
    },
    Quantity {
        name: "half-angle deg",
        units: DEGREES,
        bound: |bound| bound.half_angle,
        error: |truth, answer| Vector3::x() * compare(truth, answer).half_angle,
        variance: |answer| answer.sigma.half_angle.powi(2),
    },
];

/// Measures the objects of a scene in which nothing moves.
pub struct Limit {
    truth: RenderedTruth,
    dropout_angle: f64,
    edge_jitter_px: f64,
    matcher: Matcher,
    frames: u64,
    wrong: u64,
    /// All shapes of the scene, in the camera's frame.
    shapes: Vec<Shape>,
    objects: Vec<Sights>,
}

/// The answers about one object.
struct Sights {
    truth: TrueObject,
    bounds: Option<Bounds>,
    found: u64,
    sums: [Sums; QUANTITIES.len()],
}

/// Sums over the answers.
#[derive(Clone, Copy, Default)]
struct Sums {
    error: [RunningStats; 3],
    variance: RunningStats,
}

impl Limit {
    /// Creates a measurement for a sensor that loses points beyond an angle (radians) between ray and normal, and whose
    /// silhouettes scatter by `edge_jitter_px` pixels; the frames give its depth noise.
    pub fn new(truth: RenderedTruth, dropout_angle: f64, edge_jitter_px: f64) -> Self {
        let (matcher, shapes, objects) = (Matcher::default(), Vec::new(), Vec::new());
        Self { truth, dropout_angle, edge_jitter_px, matcher, frames: 0, wrong: 0, shapes, objects }
    }

    /// Adds the answers to a frame, and returns the number of missed objects.
    ///
    /// # Errors
    /// The frame shows an unknown scene, or another scene than the first frame: something moves.
    pub fn add(&mut self, header: &Header, answers: &[Answer]) -> Result<u64> {
        if self.frames == 0 {
            self.look(header)?;
        }
        self.ensure_still(header)?;
        self.frames += 1;
        let truths = self.objects.iter().map(|sights| sights.truth.clone()).collect();
        let frame = self.matcher.match_up(truths, answers);
        self.wrong += frame.wrong.len() as u64;
        for (sights, (_, answer)) in self.objects.iter_mut().zip(&frame.pairs) {
            if let Some(answer) = answer {
                sights.add(&answer.object);
            }
        }
        Ok(frame.pairs.iter().filter(|(_, answer)| answer.is_none()).count() as u64)
    }

    /// Determines the objects in the first frame, and their bounds.
    fn look(&mut self, header: &Header) -> Result<()> {
        let scene = self.truth.scene_of(header)?;
        let time_s = header.stamp_ns as f64 * 1e-9;
        self.shapes = scene.shapes_in_camera(time_s).collect();
        let raster = Raster::of(header.camera, &self.shapes);
        let (dropout_angle, edge_jitter_px) = (self.dropout_angle, self.edge_jitter_px);
        let measuring = Measuring { noise: header.noise, dropout_angle, edge_jitter_px };
        for truth in self.truth.objects(header, &scene) {
            let owner = scene.bodies.iter().position(|body| body.name == truth.name);
            let owner = owner.and_then(|index| u16::try_from(index).ok());
            let bounds = owner.and_then(|owner| bounds(&raster, owner, &truth.body, &measuring));
            self.objects.push(Sights { truth, bounds, found: 0, sums: Default::default() });
        }
        Ok(())
    }

    fn ensure_still(&self, header: &Header) -> Result<()> {
        let scene = self.truth.scene_of(header)?;
        if !scene.shapes_in_camera(header.stamp_ns as f64 * 1e-9).eq(self.shapes.iter().copied()) {
            bail!(Hinted::lasting(
                format!("something moves in the scene `{}`", header.source.as_str().unwrap_or_default().escape_debug()),
                "the scatter is that of one view of one scene: nothing may move there, neither may the camera"
            ));
        }
        Ok(())
    }

    /// Returns one row for each quantity of each object.
    pub fn rows(&self) -> Vec<Row> {
        self.objects.iter().flat_map(|sights| sights.rows(self.frames, self.wrong)).collect()
    }
}

impl Sights {
    fn add(&mut self, answer: &Object) {
        self.found += 1;
        for (quantity, sums) in QUANTITIES.iter().zip(&mut self.sums) {
            let error = (quantity.error)(&self.truth.body, answer);
            sums.error.iter_mut().zip(error.iter()).for_each(|(sum, component)| sum.add(*component));
            sums.variance.add((quantity.variance)(answer));
        }
    }

    fn rows(&self, frames: u64, wrong: u64) -> Vec<Row> {
        let quantities = QUANTITIES.iter().zip(&self.sums).filter(|(quantity, _)| self.has(quantity));
        quantities.map(|(quantity, sums)| self.row(quantity, sums, frames, wrong)).collect()
    }

    /// Whether the shape has the quantity.
    fn has(&self, quantity: &Quantity) -> bool {
        match quantity.name {
            "axis deg" => self.truth.body.shape().has_axis(),
            "half-angle deg" => self.truth.body.shape().has_half_angle(),
            _ => true,
        }
    }

    fn row(&self, quantity: &Quantity, sums: &Sums, frames: u64, wrong: u64) -> Row {
        let bound = |of: fn(&Bounds) -> &Bound| {
            let bound = self.bounds.as_ref().and_then(|bounds| (quantity.bound)(of(bounds)));
            bound.map_or(f64::NAN, |bound| bound * quantity.units)
        };
        let (depths, contour) = (bound(|bounds| &bounds.depths), bound(|bounds| &bounds.contour));
        let enough = if self.found < FEWEST { f64::NAN } else { quantity.units };
        let scatter = sums.error.iter().map(RunningStats::variance).sum::<f64>().sqrt() * enough;
        let mean = Vector3::from(sums.error.map(|sum| sum.mean())) * enough;
        // the bias of a vector has no sign
        let bias = if mean.yz() == nalgebra::Vector2::zeros() { mean.x } else { mean.norm() };
        let sigma = sums.variance.mean().sqrt() * enough;
        let [found, wrong] = [self.found, wrong].map(|count| count as f64 / frames as f64);
        let ratios = [depths / scatter, contour / scatter, bias.abs() / scatter, sigma / scatter];
        let mut row = Row::default();
        row.text("object", &self.truth.name);
        row.text("quantity", quantity.name);
        let numbers = [frames as f64, found, wrong, depths, contour, scatter, bias, sigma].into_iter().chain(ratios);
        COLUMNS[2..].iter().zip(numbers).for_each(|(column, number)| row.number(column, number));
        row
    }
}

#[cfg(test)]
mod tests {
    use super::super::matching::Claim;
    use super::*;
    use crate::random::CounterRng;
    use crate::simulator::scene_values::SceneTemplate;
    use conicflow_messages::{Camera, NoiseModel, ObjectSigma, Text};

    const SCENE: &str = r#"
        name = "mug"
        [camera]
        position  = [0, 0, 0]
        direction = [0, 1, 0]
        [[cone]]
        name        = "mug"
        base        = [0.02, 1.0, -0.1]
        base_radius = 0.05
        top_radius  = 0.07
        length      = 0.2
        [[plane]]
        name   = "wall"
        point  = [0, 3, 0]
        normal = [0, -1, 0]
    "#;

    const BALL: &str = r#"
        [[sphere]]
        name   = "ball"
        center = [-0.15, 1.0, 0.0]
        radius = 0.06
    "#;

    const TIN: &str = r#"
        [[cylinder]]
        name   = "tin"
        base   = [0.15, 1.0, -0.1]
        radius = 0.05
        length = 0.2
    "#;

    fn limit_of(scene: &str) -> (Limit, Header) {
        let scene = Some(SceneTemplate::new(scene.into(), "test".into()));
        let truth = RenderedTruth { scene, ..RenderedTruth::default() };
        let camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };
        let noise = NoiseModel::KINECT_V1;
        let header = Header { camera, noise, depth_scale: 0.001, source: Text::new("mug"), ..Header::default() };
        (Limit::new(truth, 70_f64.to_radians(), 0.5), header)
    }

    /// Answers that scatter by 2 mm in radius, 1 mm in each direction and 0.02 in each tilt about errors of 3 mm and 0.01, and
    /// that report twice the scatter.
    #[test]
    fn scatter_bias_and_sigma_are_those_of_the_answers() {
        let (mut limit, header) = limit_of(SCENE);
        limit.look(&header).unwrap();
        let truth = limit.objects.remove(0).truth.body;
        assert!(limit.objects.is_empty(), "a wall is no object");
        let across = [Vector3::x(), Vector3::from(truth.axis).cross(&Vector3::x())];
        let dice = CounterRng::new(1, 2);
        for number in 0..4000 {
            let [a, b, c, d, e, f] = std::array::from_fn(|k| dice.gaussian(6 * number + k as u64));
            let axis = (Vector3::from(truth.axis) + across[0] * (0.02 * a) + across[1] * (0.02 * b)).normalize();
            let center = Vector3::from(truth.center) + across[0] * (0.001 * c) + across[1] * (0.001 * d);
            let sigma = ObjectSigma {
                radius: 0.004,
                center: [[4e-6, 0.0, 0.0], [0.0, 4e-6, 0.0], [0.0, 0.0, 4e-6]],
                axis: 2.0 * 0.02 * 2_f64.sqrt(),
                half_angle: 0.02,
                ..ObjectSigma::default()
            };
            let (radius, half_angle) = (truth.radius + 0.003 + 0.002 * e, truth.half_angle + 0.01 + 0.01 * f);
            let answer = Object { center: center.into(), axis: axis.into(), radius, half_angle, sigma, ..truth };
            let ghost = Object { center: [2.0, 0.0, 2.0], ..answer };
            let answers = [answer, ghost].map(|object| object.answer().unwrap());
            let answers = if number % 4 == 0 { &answers[1..] } else { &answers[..] };
            assert_eq!(limit.add(&header, answers).unwrap(), u64::from(number % 4 == 0));
        }
        let rows = limit.rows();
        let names: Vec<_> = rows.iter().map(|row| row.get("quantity").cloned()).collect();
        assert_eq!(names, QUANTITIES.map(|quantity| Some(super::super::Figure::Text(quantity.name.into()))));
        let near = |row: usize, column: &str, expected: f64, off: f64| {
            let number = rows[row].number_of(column).unwrap();
            assert!((number - expected).abs() <= off, "{column} of row {row}: {number}, expected {expected}");
        };
        for (index, row) in rows.iter().enumerate() {
            near(index, "found", 0.75, 1e-12);
            near(index, "wrong", 1.0, 1e-12);
            near(index, "sigma_over_scatter", 2.0, 0.1);
            let [a, b, scatter] = ["bound_a", "bound_b", "scatter"].map(|column| row.number_of(column).unwrap());
            assert!(0.0 < b && b < a, "the contour tells something: {a} {b}");
            near(index, "efficiency_a", a / scatter, 1e-12);
            near(index, "efficiency_b", b / scatter, 1e-12);
        }
        near(0, "scatter", 2.0, 0.1);
        near(0, "bias", 3.0, 0.15);
        near(0, "bias_over_scatter", 1.5, 0.1);
        near(1, "scatter", 2_f64.sqrt(), 0.05);
        near(1, "bias", 0.0, 0.1);
        near(2, "scatter", (0.02 * 2_f64.sqrt()).to_degrees(), 0.05);
        near(3, "bias", 0.01_f64.to_degrees(), 0.03);
        assert!(rows.iter().all(|row| row.0.iter().all(|(column, _)| columns().any(|known| known == column))));
    }

    /// Ten answers whose radii are 3 mm too small on average, with a scatter of 1 mm, and whose centres are 5 mm off.
    #[test]
    fn each_object_has_what_its_shape_has_and_a_number_that_is_too_small_has_a_negative_bias() {
        let (head, wall) = SCENE.split_once("[[cone]]").unwrap();
        let wall = wall.split_once("[[plane]]").map(|(_, wall)| format!("[[plane]]{wall}")).unwrap();
        let (mut limit, header) = limit_of(&[head, BALL, TIN, &wall].concat());
        let truths = {
            let (mut other, header) = limit_of(&[head, BALL, TIN, &wall].concat());
            other.look(&header).unwrap();
            other.objects.iter().map(|sights| sights.truth.body).collect::<Vec<_>>()
        };
        for number in 0..FEWEST {
            let off = |truth: &Object| {
                let center = (Vector3::from(truth.center) + Vector3::new(0.003, 0.0, 0.004)).into();
                let radius = truth.radius - 0.003 + if number % 2 == 0 { 0.001 } else { -0.001 };
                Object { center, radius, ..*truth }.answer().unwrap()
            };
            assert_eq!(limit.add(&header, &truths.iter().map(off).collect::<Vec<_>>()).unwrap(), 0);
        }
        let rows = limit.rows();
        let text = |row: &Row, column: &str| match row.get(column) {
            Some(super::super::Figure::Text(text)) => text.clone(),
            other => panic!("{other:?}"),
        };
        let told: Vec<_> = rows.iter().map(|row| text(row, "object") + " " + &text(row, "quantity")).collect();
        assert_eq!(told, ["ball radius mm", "ball position mm", "tin radius mm", "tin position mm", "tin axis deg"]);
        for (row, bias) in [(0, -3.0), (1, 5.0), (2, -3.0), (3, 5.0)] {
            let number = rows[row].number_of("bias").unwrap();
            assert!((number - bias).abs() < 1e-9, "{}: {number}", told[row]);
        }
        let over_scatter = rows[0].number_of("bias_over_scatter").unwrap();
        assert!((2.0..4.0).contains(&over_scatter), "{over_scatter}");
        let (mut alone, header) = limit_of(&[head, BALL, &wall].concat());
        alone.add(&header, &[]).unwrap();
        let bound = |rows: &[Row]| rows[0].number_of("bound_a");
        assert!(bound(&rows).is_some() && bound(&rows) == bound(&alone.rows()), "the tin hides nothing of the ball");
        let in_metres = |of: fn(&Bound) -> f64| alone.objects[0].bounds.as_ref().map(|bounds| of(&bounds.depths));
        assert_eq!(bound(&rows), in_metres(|bound| bound.radius_m).map(|bound| 1e3 * bound));
    }

    #[test]
    fn too_few_answers_tell_no_scatter() {
        let (mut limit, header) = limit_of(SCENE);
        limit.look(&header).unwrap();
        let truth = limit.objects.remove(0).truth.body.answer().unwrap();
        for number in 0..FEWEST {
            limit.add(&header, if number > 0 { std::slice::from_ref(&truth) } else { &[] }).unwrap();
        }
        let row = &limit.rows()[0];
        assert_eq!((row.number_of("found"), row.get("scatter"), row.get("efficiency_a")), (Some(0.9), None, None));
        assert!(row.number_of("bound_a").is_some());
    }

    /// A ball that moves has the same bound as one that stands where it is at the time of the frame.
    #[test]
    fn the_bounds_are_those_of_the_time_of_the_frame() {
        let (head, _) = SCENE.split_once("[[cone]]").unwrap();
        let moving = "motion.path = { points = [{ t_s = 0, offset = [-2, 0, 0] }, { t_s = 4, offset = [2, 0, 0] }] }\n";
        let bound = |ball: &str, stamp_ns: u64| {
            let (mut limit, header) = limit_of(&[head, ball].concat());
            limit.add(&Header { stamp_ns, ..header }, &[]).unwrap();
            limit.rows()[0].number_of("bound_a")
        };
        let still = bound(BALL, 0).unwrap();
        let moved = bound(&(BALL.to_owned() + moving), 2_000_000_000).unwrap();
        assert!((moved / still - 1.0).abs() < 1e-6, "{moved} {still}");
    }

    #[test]
    fn a_scene_in_which_something_moves_is_refused() {
        let (head, _) = SCENE.split_once("[[cone]]").unwrap();
        let moving = "motion.linear = { velocity = [0.1, 0, 0] }\n";
        let (mut limit, header) = limit_of(&[head, BALL, moving].concat());
        limit.add(&header, &[]).unwrap();
        let error = limit.add(&Header { stamp_ns: 33_000_000, ..header }, &[]).unwrap_err().to_string();
        assert!(error.contains("something moves in the scene `mug`\n  hint: "), "{error}");
        let (mut limit, header) = limit_of(SCENE);
        for stamp_ns in [0, 33_000_000] {
            limit.add(&Header { stamp_ns, ..header }, &[]).unwrap();
        }
    }
}
