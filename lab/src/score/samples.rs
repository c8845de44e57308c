//! The counts of an evaluation: a sample for each object that had to be found, and for each wrong answer.

use super::matching::{Answer, Comparison, Fault, MatchedFrame, compare};
use super::sigmas::Sigmas;
use conicflow_messages::{Object, ObjectKind};
use indexmap::IndexSet;
use nalgebra::Vector3;

/// All counts of an evaluation.
#[derive(Clone, Debug, Default)]
pub struct Score {
    /// Number of judged frames.
    pub frames: u64,
    /// Names of the groups, in the order of their first frames.
    pub groups: IndexSet<String>,
    /// The true objects that had to be found, and the wrong answers.
    pub samples: Vec<Sample>,
    /// Number of right answers about objects that need not be found.
    pub extra: u64,
    /// Number of answers at something that was not measured.
    pub neither: u64,
}

/// A true object that had to be found, or a wrong answer.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Index of its group.
    pub group: usize,
    /// Its shape; of a wrong answer, the one that it claims.
    pub shape: ObjectKind,
    /// Distance of its middle from the camera, in metres.
    pub distance: f64,
    /// Its radius, in metres.
    pub radius_m: f64,
    /// Hidden share of a true object.
    pub hidden: Option<f64>,
    /// For a found object, the comparison with the right answer, and the errors in standard deviations.
    pub found: Option<(Comparison, Sigmas)>,
    /// Whether a true object was measured well enough for errors to mean anything.
    pub measured: bool,
    /// The mildest fault of a wrong answer.
    pub fault: Option<Fault>,
}

impl Sample {
    fn of(group: usize, object: &Object) -> Self {
        let (shape, distance) = (object.shape(), Vector3::from(object.center).norm());
        Self { group, shape, distance, radius_m: object.radius, hidden: None, found: None, measured: true, fault: None }
    }

    /// Returns the comparison with the right answer and its errors, if the object was measured well enough.
    pub fn errors(&self) -> Option<(Comparison, Sigmas)> {
        self.found.filter(|_| self.measured)
    }

    /// Returns the position error, in millimetres.
    pub fn position_error_mm(&self) -> Option<f64> {
        Some(1e3 * self.errors()?.0.position_m)
    }

    /// Returns the angle between the true and the found axis, in degrees, if the shape has an axis.
    pub fn axis_error_deg(&self) -> Option<f64> {
        self.errors().filter(|_| self.shape.has_axis()).map(|(comparison, _)| comparison.axis.to_degrees())
    }

    /// Returns the absolute error of the half-angle, in degrees, if the shape has one.
    pub fn half_angle_error_deg(&self) -> Option<f64> {
        let errors = self.errors().filter(|_| self.shape.has_half_angle());
        errors.map(|(comparison, _)| comparison.half_angle.abs().to_degrees())
    }
}

impl Score {
    /// Counts the results of a frame of a group.
    pub fn add(&mut self, group: &str, frame: &MatchedFrame) {
        let (group, _) = self.groups.insert_full(group.to_owned());
        self.frames += 1;
        self.neither += frame.neither.len() as u64;
        for (truth, answer) in &frame.pairs {
            if !truth.required {
                self.extra += u64::from(answer.is_some());
                continue;
            }
            let found = answer
                .as_ref()
                .map(|Answer { object, .. }| (compare(&truth.body, object), Sigmas::of(&truth.body, object)));
            let (hidden, measured) = (Some(truth.hidden), truth.measured);
            self.samples.push(Sample { hidden, found, measured, ..Sample::of(group, &truth.body) });
        }
        for (object, fault) in &frame.wrong {
            self.samples.push(Sample { fault: Some(*fault), ..Sample::of(group, object) });
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_told_of_what_was_found_and_has_a_shape_that_can_have_it() {
        let comparison = Comparison { position_m: 0.002, radius_m: 0.1, axis: 0.2, half_angle: -0.05 };
        let all = [2.0, 0.2_f64.to_degrees(), 0.05_f64.to_degrees()];
        for (shape, errors) in [(ObjectKind::Sphere, 1), (ObjectKind::Cylinder, 2), (ObjectKind::Cone, 3)] {
            let object = Object { kind: shape.code(), ..Object::default() };
            let missed = Sample::of(0, &object);
            let found = Sample { found: Some((comparison, Sigmas::default())), ..missed };
            let told =
                |sample: &Sample| [sample.position_error_mm(), sample.axis_error_deg(), sample.half_angle_error_deg()];
            assert_eq!(told(&missed), [None; 3]);
            assert_eq!(told(&Sample { measured: false, ..found }), [None; 3], "it only had to be seen");
            for (i, (error, expected)) in told(&found).into_iter().zip(all).enumerate() {
                assert_eq!(error.is_some(), i < errors, "{shape:?}");
                assert!(error.is_none_or(|error| (error - expected).abs() < 1e-9), "{shape:?}: {error:?}");
            }
        }
    }
}
