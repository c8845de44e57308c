//! Assigns cameras to worlds. Cameras that send their pose share one world; each other camera has its own world, with its own
//! clock, because its place is unknown.

use super::{Tracker, TrackerParameters};
use conicflow_messages::{Header, Object, Text};

/// One tracker for each world; identities are unique among all of them.
pub struct Worlds {
    config: TrackerParameters,
    next_id: u64,
    worlds: Vec<World>,
}

/// The cameras of one world.
struct World {
    has_poses: bool,
    sources: Vec<Text<32>>,
    tracker: Tracker,
}

impl Worlds {
    /// Starts without worlds; the first track gets the identity `first_id`.
    pub fn with_first_id(config: TrackerParameters, first_id: u64) -> Self {
        Self { config, next_id: first_id, worlds: Vec::new() }
    }

    /// Updates the tracker of the frame's world with its objects; returns this tracker.
    pub fn update(&mut self, header: &Header, objects: &[Object]) -> &Tracker {
        let index = self.of(&header.origin(), header.pose().is_some());
        let tracker = &mut self.worlds[index].tracker;
        tracker.next_id = self.next_id;
        tracker.update_frame(header, objects);
        self.next_id = tracker.next_id;
        tracker
    }

    /// Returns the index of a source's world. A source stays in the world with poses even if a frame lacks one.
    fn of(&mut self, source: &Text<32>, has_pose: bool) -> usize {
        let own = |world: &World| world.sources.contains(source) && (world.has_poses || !has_pose);
        if let Some(index) = self.worlds.iter().position(own) {
            return index;
        }
        self.worlds.iter_mut().for_each(|world| world.sources.retain(|known| known != source));
        self.worlds.retain(|world| !world.sources.is_empty());
        match self.worlds.iter().position(|world| has_pose && world.has_poses) {
            Some(index) => {
                self.worlds[index].sources.push(*source);
                index
            }
            None => {
                let tracker = Tracker::new(self.config.clone());
                self.worlds.push(World { has_poses: has_pose, sources: vec![*source], tracker });
                self.worlds.len() - 1
            }
        }
    }
}
