//! The life cycle of a track: born at the first detection, confirmed by enough detections, coasting while unseen, finally lost.

use super::parameters::TrackerParameters;
use conicflow_messages::TrackState;

/// The record of a track's hits and misses.
#[derive(Clone, Debug)]
pub struct Life {
    /// Frames since the first detection; those of other cameras count only if they had a detection.
    pub age: u32,
    /// Frames without a detection since the last detection, of the camera that had it.
    pub misses: u32,
    /// Time from the last detection to the last frame, in seconds.
    pub unseen_s: f64,
    /// Time since the last frame of the camera that saw it last, in seconds, while other cameras went on.
    pub unwatched_s: f64,
    /// Detections that are still needed for its confirmation; 0: it is confirmed. The window starts with the first detection and
    /// never moves: at its last frame the track is confirmed or lost.
    hits_needed: u32,
}

impl Life {
    /// Creates the record of a track at its first detection.
    pub fn born(parameters: &TrackerParameters) -> Self {
        let hits_needed = parameters.confirm_hits.saturating_sub(1);
        Self { age: 0, misses: 0, unseen_s: 0.0, unwatched_s: 0.0, hits_needed }
    }

    /// Records a frame with a detection.
    pub fn seen(&mut self) {
        self.age = self.age.saturating_add(1);
        (self.misses, self.unseen_s, self.unwatched_s) = (0, 0.0, 0.0);
        self.hits_needed = self.hits_needed.saturating_sub(1);
    }

    /// Records a frame without a detection, `elapsed_s` seconds later.
    pub fn missed(&mut self, elapsed_s: f64) {
        self.age = self.age.saturating_add(1);
        self.misses = self.misses.saturating_add(1);
        self.unseen_s += elapsed_s;
        self.unwatched_s = 0.0;
    }

    /// Records a frame, `elapsed_s` seconds later, of a camera that was not expected to see the object.
    pub fn not_observed(&mut self, elapsed_s: f64) {
        self.unseen_s += elapsed_s;
        self.unwatched_s += elapsed_s;
    }

    /// Returns minus twice the logarithm of the probability of a detection after `m` misses in a row, relative to that after
    /// none: by Laplace's rule of succession `1 / (m + 2)` to `1 / 2`.
    pub fn cost_of_return(&self) -> f64 {
        2.0 * (f64::from(self.misses) / 2.0).ln_1p()
    }

    /// Returns whether the track is lost: unseen for too long, or no longer able to be confirmed, or no longer watched by its
    /// camera.
    pub fn is_lost(&self, parameters: &TrackerParameters) -> bool {
        let TrackerParameters { confirm_window, max_coast_s, .. } = *parameters;
        if self.hits_needed == 0 {
            return self.unseen_s > max_coast_s;
        }
        let left = confirm_window.saturating_sub(self.age.saturating_add(1));
        self.hits_needed > left || self.unwatched_s > max_coast_s
    }

    /// Returns the state of the track.
    pub fn state(&self) -> TrackState {
        match (self.hits_needed, self.misses) {
            (1.., _) => TrackState::Tentative,
            (0, 0) => TrackState::Confirmed,
            (0, _) => TrackState::Coasting,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Parameters with a window of frames, and the number of hits in it that confirm a track.
    fn rules(confirm_hits: u32, confirm_window: u32) -> TrackerParameters {
        TrackerParameters { confirm_hits, confirm_window, max_coast_s: 0.25, ..TrackerParameters::default() }
    }

    /// The state after each frame of `sights` that follows the first; `None` once the track is lost. Frames are 0.1 s apart.
    fn live(sights: &str) -> Vec<Option<TrackState>> {
        let rules = rules(3, 5);
        let mut life = Life::born(&rules);
        let step = |sight: char| {
            match sight {
                'x' => life.seen(),
                _ => life.missed(0.1),
            }
            (!life.is_lost(&rules)).then(|| life.state())
        };
        sights.chars().map(step).collect()
    }

    #[test]
    fn three_sights_of_five_confirm() {
        use TrackState::{Coasting, Confirmed, Tentative};
        assert_eq!(live("xx"), [Some(Tentative), Some(Confirmed)]);
        assert_eq!(live("--xx"), [Some(Tentative), Some(Tentative), Some(Tentative), Some(Confirmed)]);
        assert_eq!(live("xx-x"), [Some(Tentative), Some(Confirmed), Some(Coasting), Some(Confirmed)]);
    }

    #[test]
    fn three_misses_of_five_end_a_tentative_track() {
        assert_eq!(live("---"), [Some(TrackState::Tentative), Some(TrackState::Tentative), None]);
        assert_eq!(live("-x--").last(), Some(&None));
    }

    /// The test checks all short histories against the rule in its plain form: the newest frames of the whole history are counted
    /// again at each frame.
    #[test]
    fn a_track_is_confirmed_by_enough_sights_of_any_window_and_lost_when_none_can_have_them() {
        for (window, hits) in (1..=6).flat_map(|window| (1..=window).map(move |hits| (window, hits))) {
            let rules = TrackerParameters { max_coast_s: f64::INFINITY, ..rules(hits, window) };
            for frames in 0..1 << 9_u32 {
                let (mut life, mut history, mut was_confirmed) = (Life::born(&rules), vec![true], hits == 1);
                for is_seen in (0..9).map(|frame| frames >> frame & 1 == 1) {
                    history.push(is_seen);
                    if is_seen {
                        life.seen();
                    } else {
                        life.missed(0.1);
                    }
                    let newest = &history[history.len().saturating_sub(window as usize)..];
                    let seen = newest.iter().filter(|seen| **seen).count();
                    was_confirmed |= seen >= hits as usize;
                    let is_lost = !was_confirmed && newest.len() - seen > (window - hits) as usize;
                    let told = (life.state() != TrackState::Tentative, life.is_lost(&rules));
                    assert_eq!(told, (was_confirmed, is_lost), "{hits} of {window}: {history:?}");
                    if is_lost {
                        break;
                    }
                }
            }
        }
    }

    #[test]
    fn a_confirmed_track_coasts_for_its_time() {
        let states = live("xx---");
        assert_eq!(states[2..], [Some(TrackState::Coasting), Some(TrackState::Coasting), None]);
    }

    #[test]
    fn frames_of_other_cameras_are_no_misses_but_take_time() {
        for (hits, state) in [(1, TrackState::Confirmed), (3, TrackState::Tentative)] {
            let rules = rules(hits, 5);
            let mut life = Life::born(&rules);
            (0..2).for_each(|_| life.not_observed(0.125));
            assert_eq!((life.misses, life.state(), life.is_lost(&rules)), (0, state, false));
            life.not_observed(0.01);
            assert!(life.is_lost(&rules), "its camera is gone");
            life.seen();
            assert!(!life.is_lost(&rules));
        }
    }

    #[test]
    fn a_window_of_32_frames_and_one_of_one_frame_work() {
        let wide = rules(3, 32);
        let mut life = Life::born(&wide);
        assert!((0..100).all(|_| {
            life.seen();
            !life.is_lost(&wide)
        }));
        assert_eq!(Life::born(&rules(1, 1)).state(), TrackState::Confirmed);
    }
}
