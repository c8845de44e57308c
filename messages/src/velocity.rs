//! Velocity commands: how a robot or a camera is to move from now on.

use crate::{Fields, Header, Item, Malformed, Named, coded::coded, item::check_each, item::finite};
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// The coordinate frame of a velocity.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Frame {
    /// The camera's: x right, y down, z forward.
    Camera,
    /// The world, in which [`Header::pose`] gives the camera's pose.
    World,
}

coded!(Frame: Camera = 0 "camera", World = 1 "world");

/// The commanded velocity. A message has one item; an empty message means: stand still.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Velocity {
    /// Along the axes, in metres per second.
    pub linear: [f64; 3],
    /// Around the axes, right-handed, in radians per second.
    pub angular: [f64; 3],
    /// [`Frame::code`].
    pub frame: u32,
    /// Zero; fills the padding.
    pub reserved: u32,
}

impl Velocity {
    /// Its coordinate frame; [`Item::check`] has refused unknown codes.
    pub fn frame(&self) -> Frame {
        Frame::from_code(self.frame).unwrap_or(Frame::Camera)
    }
}

impl Item for Velocity {
    const NAME: &'static str = "velocities";
    const TYPE_NAME: &'static str = "conicflow.Velocity.v1";

    fn check(_: &Header, items: &[Self]) -> Result<(), Malformed> {
        check_each(items, |velocity| match Frame::from_code(velocity.frame) {
            None => Some("is in no known frame"),
            Some(_) if finite(&velocity.linear) && finite(&velocity.angular) => None,
            Some(_) => Some("has a number that is not finite"),
        })
    }
}

impl Named for Velocity {
    fn fields(&self) -> Fields<'static> {
        Fields(vec![
            ("linear", self.linear.into()),
            ("angular", self.angular.into()),
            ("frame", self.frame().name().into()),
        ])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ToJson;

    #[test]
    fn the_codes_of_frames_are_decoded_to_the_same_frames() {
        for frame in Frame::ALL {
            assert_eq!(Frame::from_code(frame.code()), Some(frame));
        }
        assert_eq!(Frame::from_code(2), None);
    }

    #[test]
    fn a_velocity_in_an_unknown_frame_or_an_infinite_one_is_refused() {
        let good = Velocity { linear: [0.0, 0.0, 0.8], ..Velocity::default() };
        let check =
            |velocity| Velocity::check(&Header::default(), &[good, velocity]).map_err(|error| error.to_string());
        assert_eq!(check(Velocity { frame: Frame::World.code(), ..good }), Ok(()));
        let result = check(Velocity { frame: 7, ..good });
        assert_eq!(result, Err("malformed velocities: item 1 is in no known frame".into()));
        for spoilt in
            [Velocity { linear: [0.0, f64::NAN, 0.0], ..good }, Velocity { angular: [f64::INFINITY, 0.0, 0.0], ..good }]
        {
            assert_eq!(check(spoilt), Err("malformed velocities: item 1 has a number that is not finite".into()));
        }
    }

    #[test]
    fn in_json_the_frame_is_a_word() {
        let velocity = Velocity { linear: [0.5, 0.0, 1.0], ..Velocity::default() };
        let text = serde_json::to_string(&velocity.to_json()).unwrap();
        assert_eq!(text, r#"{"linear":[0.5,0.0,1.0],"angular":[0.0,0.0,0.0],"frame":"camera"}"#);
    }
}
