//! Tracks: objects with an identity and a velocity, followed from frame to frame.

use crate::{Header, Item, Malformed, Object, coded::coded, item::check_each, item::finite};
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// The state of a track in its life cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TrackState {
    /// Seen too few times to be certain.
    Tentative,
    /// Seen often enough, and in the last frame of the camera that last saw it.
    Confirmed,
    /// Confirmed before, but not seen in that frame; its state is a prediction.
    Coasting,
}

coded!(TrackState: Tentative = 0 "tentative", Confirmed = 1 "confirmed", Coasting = 2 "coasting");

/// One tracked object.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Track {
    /// Identity: constant during the life of the track, never reused.
    pub id: u64,
    /// [`TrackState::code`].
    pub state: u32,
    /// Frames since it was first seen; those of other cameras count only if they saw it.
    pub age: u32,
    /// Frames since it was last seen, of the camera that last saw it.
    pub misses: u32,
    /// Zero; fills the padding.
    pub reserved: u32,
    /// The filtered shape, with standard deviations.
    pub object: Object,
    /// Velocity of the centre in metres per second.
    pub velocity: [f64; 3],
    /// Covariance of the velocity, row-major.
    pub velocity_covariance: [[f64; 3]; 3],
}

impl Track {
    /// Its state; [`Item::check`] has refused unknown codes.
    pub fn track_state(&self) -> TrackState {
        TrackState::from_code(self.state).unwrap_or(TrackState::Tentative)
    }

    fn fault(&self) -> Option<&'static str> {
        let numbers = finite(&self.velocity) && self.velocity_covariance.iter().all(|row| finite(row));
        if TrackState::from_code(self.state).is_none() {
            Some("is in no known state")
        } else if !numbers {
            Some("has a velocity that is not finite")
        } else {
            self.object.fault()
        }
    }
}

impl Item for Track {
    const NAME: &'static str = "tracks";
    const TYPE_NAME: &'static str = "conicflow.Track.v2";
    const IS_COUNTED: bool = true;

    fn check(_: &Header, items: &[Self]) -> Result<(), Malformed> {
        check_each(items, Self::fault)
    }

    fn label(&self) -> Option<&'static str> {
        (self.track_state() != TrackState::Tentative).then(|| self.object.shape().name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_track_is_in_a_known_state_with_a_finite_velocity_and_its_object_is_sound() {
        let good = Track { state: TrackState::Confirmed.code(), ..Track::default() };
        let mut covariance = good.velocity_covariance;
        covariance[1][2] = f64::NAN;
        let negative = Object { radius: -1.0, ..good.object };
        for (track, fault) in [
            (good, None),
            (Track { state: 7, ..good }, Some("is in no known state")),
            (Track { velocity: [0.0, f64::INFINITY, 0.0], ..good }, Some("has a velocity that is not finite")),
            (Track { velocity_covariance: covariance, ..good }, Some("has a velocity that is not finite")),
            (Track { object: negative, ..good }, Some("has a negative size")),
        ] {
            let expected = fault.map_or(Ok(()), |fault| Err(format!("malformed tracks: item 0 {fault}")));
            assert_eq!(Track::check(&Header::default(), &[track]).map_err(|error| error.to_string()), expected);
        }
    }

    #[test]
    fn a_tentative_track_has_no_label() {
        let label = |state: TrackState| Track { state: state.code(), ..Track::default() }.label();
        let all = TrackState::ALL;
        assert_eq!(all.map(label), [None, Some("sphere"), Some("sphere")]);
        assert_eq!(all.map(|state| Track { state: state.code(), ..Track::default() }.track_state()), all);
    }
}
