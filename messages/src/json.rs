//! The JSON of messages: the keys, their order, and which of them a shape has. ROS 2 messages have the same keys.

use crate::{ABSENT, Ellipse, Fields, Header, Named, Object, ToJson, Track, Value};
use serde::ser::SerializeMap;
use serde::{Serialize, Serializer};

impl<T: Named> ToJson for T {
    fn to_json(&self) -> impl Serialize {
        self.fields()
    }
}

/// A selection of its fields, without the moments.
impl ToJson for Ellipse {
    fn to_json(&self) -> impl Serialize {
        Fields(vec![
            ("scan", self.direction().name().into()),
            ("line", self.line.into()),
            ("first", self.first.into()),
            ("last", self.last.into()),
            ("points", self.points.into()),
            ("center", self.center.into()),
            ("semi_axes", self.semi_axes.into()),
            ("angle", self.angle.into()),
            ("rms", self.rms.into()),
            ("arc", self.arc.into()),
        ])
    }
}

/// One line of JSON: a message, with its content under the name of its item type.
pub struct Line<'a, C> {
    /// The header of the message.
    pub header: &'a Header,
    /// Latency in milliseconds since the source had the frame, if known.
    pub latency_ms: Option<f64>,
    /// The item type: [`Item::NAME`](crate::Item::NAME).
    pub kind: &'a str,
    /// The list, or a summary in its place: [`ToJson::message_to_json`].
    pub content: C,
}

impl<C: Serialize> Serialize for Line<'_, C> {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let header = self.header;
        let mut line = serializer.serialize_map(Some(5))?;
        line.serialize_entry("sequence", &header.sequence)?;
        line.serialize_entry("source", header.source.as_str().unwrap_or_default())?;
        line.serialize_entry("stamp_ns", &header.stamp_ns)?;
        line.serialize_entry("latency_ms", &self.latency_ms)?;
        line.serialize_entry(self.kind, &self.content)?;
        line.end()
    }
}

/// The key of the nested standard deviations.
const SIGMA: &str = "sigma";
/// Keys of a [`Line`] besides that of its content.
pub const LINE_KEYS: [&str; 4] = ["sequence", "source", "stamp_ns", "latency_ms"];

impl Named for Object {
    fn fields(&self) -> Fields<'static> {
        let (shape, sigma) = (self.shape(), &self.sigma);
        let only_if = |is_there: bool, value: f64| Value::from(if is_there { value } else { ABSENT });
        let cone = |value| only_if(shape.has_half_angle(), value);
        let elongated = |value| only_if(shape.has_axis(), value);
        let vector_if = |is_there: bool, vector: [f64; 3]| Value::from(if is_there { vector } else { [ABSENT; 3] });
        // `radius` is, for a cone, that at `center`.
        let sigma = vec![
            ("center", deviations(&sigma.center).into()),
            ("axis", elongated(sigma.axis)),
            ("half_angle", cone(sigma.half_angle)),
            ("radius", sigma.radius.into()),
            ("length", elongated(sigma.length)),
        ];
        Fields(vec![
            ("kind", shape.name().into()),
            ("apex", vector_if(shape.has_half_angle(), self.apex)),
            ("center", self.center.into()),
            ("axis", vector_if(shape.has_axis(), self.axis)),
            ("half_angle", cone(self.half_angle)),
            ("radius", only_if(!shape.has_half_angle(), self.radius)),
            ("base_radius", cone(self.base_radius)),
            ("top_radius", cone(self.top_radius)),
            ("length", elongated(self.length)),
            (SIGMA, Value::Below(Fields(sigma))),
            ("rms", self.rms.into()),
            ("points", self.points.into()),
            ("rows", self.rows.into()),
            ("arc", self.arc.into()),
            ("confidence", if self.confidence > 0.0 { self.confidence } else { ABSENT as f32 }.into()),
        ])
    }
}

/// The object, the identity and the motion of a track.
impl Named for Track {
    fn fields(&self) -> Fields<'static> {
        let Fields(mut fields) = self.object.fields();
        let sigma = fields.iter_mut().find(|(name, _)| *name == SIGMA);
        if let Some((_, Value::Below(Fields(sigma)))) = sigma {
            sigma.push(("velocity", deviations(&self.velocity_covariance).into()));
        }
        fields.extend([
            ("id", self.id.into()),
            ("velocity", self.velocity.into()),
            ("age", self.age.into()),
            ("misses", self.misses.into()),
            ("state", self.track_state().name().into()),
        ]);
        Fields(fields)
    }
}

/// Square roots of a covariance's diagonal.
fn deviations(covariance: &[[f64; 3]; 3]) -> [f64; 3] {
    std::array::from_fn(|i| covariance[i][i].max(0.0).sqrt())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Message, ObjectKind, ObjectSigma, Text, TrackState};

    fn object(kind: ObjectKind) -> Object {
        Object {
            kind: kind.code(),
            points: 900,
            rows: 40,
            center: [0.1, -0.2, 1.5],
            axis: [0.0, 1.0, 0.0],
            radius: 0.05,
            length: 0.25,
            half_angle: 0.125,
            base_radius: 0.0625,
            top_radius: 0.03125,
            apex: [0.1, -0.7, 1.5],
            sigma: ObjectSigma {
                center: [[0.25, 9.0, 9.0], [9.0, 4.0, 9.0], [9.0, 9.0, 1.0]],
                axis: 0.01,
                radius: 0.001,
                length: 0.002,
                half_angle: 0.003,
            },
            rms: 0.0005,
            arc: 2.5,
            confidence: 0.75,
        }
    }

    fn json<T: ToJson>(items: &[T]) -> String {
        let header =
            Header { sequence: 12, stamp_ns: 7, source: Text::new("frame-000012.depth.png"), ..Header::default() };
        let message = Message { header: &header, items };
        let content = T::message_to_json(&message);
        serde_json::to_string(&Line { header: &header, latency_ms: Some(1.4), kind: T::NAME, content }).unwrap()
    }

    const HEAD: &str = r#"{"sequence":12,"source":"frame-000012.depth.png","stamp_ns":7,"latency_ms":1.4,"#;
    const TAIL: &str = r#""rms":0.0005,"points":900,"rows":40,"arc":2.5,"confidence":0.75"#;

    #[test]
    fn a_sphere_has_no_axis() {
        let expected = format!(
            "{HEAD}\"objects\":[{}{TAIL}}}]}}",
            r#"{"kind":"sphere","center":[0.1,-0.2,1.5],"radius":0.05,"sigma":{"center":[0.5,2.0,1.0],"radius":0.001},"#
        );
        assert_eq!(json(&[object(ObjectKind::Sphere)]), expected);
    }

    #[test]
    fn a_cylinder_has_an_axis_and_a_length() {
        let expected = format!(
            "{HEAD}\"objects\":[{}{}{TAIL}}}]}}",
            r#"{"kind":"cylinder","center":[0.1,-0.2,1.5],"axis":[0.0,1.0,0.0],"radius":0.05,"length":0.25,"#,
            r#""sigma":{"center":[0.5,2.0,1.0],"axis":0.01,"radius":0.001,"length":0.002},"#
        );
        assert_eq!(json(&[object(ObjectKind::Cylinder)]), expected);
    }

    #[test]
    fn a_cone_has_an_apex_and_two_radii() {
        let expected = format!(
            "{HEAD}\"objects\":[{}{}{}{TAIL}}}]}}",
            r#"{"kind":"cone","apex":[0.1,-0.7,1.5],"center":[0.1,-0.2,1.5],"axis":[0.0,1.0,0.0],"#,
            r#""half_angle":0.125,"base_radius":0.0625,"top_radius":0.03125,"length":0.25,"#,
            r#""sigma":{"center":[0.5,2.0,1.0],"axis":0.01,"half_angle":0.003,"radius":0.001,"length":0.002},"#
        );
        assert_eq!(json(&[object(ObjectKind::Cone)]), expected);
    }

    #[test]
    fn a_frame_with_nothing_in_it_has_an_empty_list() {
        assert_eq!(json::<Object>(&[]), format!("{HEAD}\"objects\":[]}}"));
        assert_eq!(json::<Track>(&[]), format!("{HEAD}\"tracks\":[]}}"));
        assert_eq!(json::<Ellipse>(&[]), format!("{HEAD}\"ellipses\":[]}}"));
    }

    #[test]
    fn a_track_adds_identity_and_motion() {
        let track = Track {
            id: 3,
            state: TrackState::Coasting.code(),
            age: 20,
            misses: 2,
            object: object(ObjectKind::Sphere),
            velocity: [0.5, 0.0, -1.0],
            velocity_covariance: [[0.25, 0.0, 0.0], [0.0, 0.25, 0.0], [0.0, 0.0, 1.0]],
            ..Track::default()
        };
        let text = json(&[track]);
        assert!(text.starts_with(&format!("{HEAD}\"tracks\":[{{\"kind\":\"sphere\",\"center\":")), "{text}");
        let tail = r#","id":3,"velocity":[0.5,0.0,-1.0],"age":20,"misses":2,"state":"coasting"}]}"#;
        assert!(text.ends_with(&format!("{TAIL}{tail}")), "{text}");
        assert!(text.contains(r#""radius":0.001,"velocity":[0.5,0.5,1.0]}"#), "{text}");
    }

    #[test]
    fn an_ellipse_is_written_without_its_moments() {
        let ellipse = Ellipse { scan: 1, line: 4, first: 5, last: 9, points: 5, arc: 1.5, ..Ellipse::default() };
        let expected = format!(
            "{HEAD}\"ellipses\":[{}{}]}}",
            r#"{"scan":"column","line":4,"first":5,"last":9,"points":5,"center":[0.0,0.0,0.0],"#,
            r#""semi_axes":[0.0,0.0],"angle":0.0,"rms":0.0,"arc":1.5}"#
        );
        assert_eq!(json(&[ellipse]), expected);
    }

    #[test]
    fn a_covariance_spoilt_by_rounding_gives_zero() {
        assert_eq!(deviations(&[[-1e-20, 0.0, 0.0], [0.0, 4.0, 0.0], [0.0, 0.0, 0.0]]), [0.0, 2.0, 0.0]);
    }
}
