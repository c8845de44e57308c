//! The random scenes of a run, one per frame.

use super::random_scene::{MAX_ROLL_DEG, SceneGroup, rolled_scene};
use super::scene::Scene;
use conicflow_messages::ConfigFault;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Another random scene in each frame: for each seed in turn, one of every group.
#[derive(Clone, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RandomScenes {
    /// Groups of scenes: `standing`, `tilted`, `occluded`, `tabletop`, `lying`, `composed`, `clutter`, `bowls`, `empty`;
    /// and `flat_tins`, `furnished`, `kitchen`, `lived_in` and `hall`, only where they are named.
    pub groups: Vec<SceneGroup>,
    /// First and last seed.
    pub seeds: [u64; 2],
    /// Roll of the camera to its right, in degrees, in addition to a random one of up to 6 degrees to either side.
    #[schemars(range(min = -MAX_ROLL_DEG, max = MAX_ROLL_DEG))]
    pub roll_deg: f64,
}

impl Default for RandomScenes {
    fn default() -> Self {
        Self { groups: SceneGroup::USUAL.into(), seeds: [0, 9], roll_deg: 0.0 }
    }
}

impl RandomScenes {
    /// Number of frames.
    pub fn frames(&self) -> u64 {
        let [first, last] = self.seeds;
        last.saturating_sub(first).saturating_add(1).saturating_mul(self.groups.len() as u64)
    }

    /// Returns the group and the seed of frame `number`.
    pub fn choice(&self, number: u64) -> (SceneGroup, u64) {
        let groups = self.groups.len().max(1) as u64;
        let group = self.groups.get((number % groups) as usize).copied().unwrap_or(SceneGroup::Empty);
        (group, self.seeds[0].saturating_add(number / groups))
    }

    /// Returns the scene of frame `number`, and the number for its noise, which does not depend on the other groups.
    pub fn scene(&self, number: u64) -> (Scene, u64) {
        let (group, seed) = self.choice(number);
        let groups = SceneGroup::USUAL.len() as u64;
        (rolled_scene(group, seed, self.roll_deg), seed.wrapping_mul(groups).wrapping_add(group as u64))
    }

    /// Returns what is wrong with the parameters, if anything.
    pub fn fault(&self) -> Option<ConfigFault> {
        let [first, last] = self.seeds;
        if self.groups.is_empty() {
            return Some(ConfigFault::new("scenes", "has no `groups`", "leave the key out for all of them"));
        }
        if first > last {
            let what = format!("has the seeds {first} to {last}, which is none");
            return Some(ConfigFault::new("scenes", what, "seeds = [first, last]"));
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_seed_shows_each_group_once() {
        let scenes = RandomScenes {
            groups: vec![SceneGroup::Lying, SceneGroup::Empty],
            seeds: [5, 7],
            ..RandomScenes::default()
        };
        let names: Vec<_> = (0..scenes.frames()).map(|number| scenes.scene(number).0.name).collect();
        assert_eq!(names, ["lying/5", "empty/5", "lying/6", "empty/6", "lying/7", "empty/7"]);
    }

    #[test]
    fn the_noise_of_a_scene_does_not_depend_on_what_else_is_shown() {
        let alone = RandomScenes { groups: vec![SceneGroup::Lying], seeds: [3, 3], ..RandomScenes::default() };
        let among_all = RandomScenes { seeds: [0, 9], ..RandomScenes::default() };
        let number = (0..among_all.frames()).find(|number| among_all.choice(*number) == (SceneGroup::Lying, 3));
        assert_eq!(among_all.scene(number.unwrap()).1, alone.scene(0).1);
    }

    #[test]
    fn what_shows_nothing_is_refused() {
        assert_eq!(RandomScenes::default().fault(), None);
        assert!(RandomScenes { groups: Vec::new(), ..RandomScenes::default() }.fault().is_some());
        assert!(RandomScenes { seeds: [9, 0], ..RandomScenes::default() }.fault().unwrap().what.contains("9 to 0"));
    }
}
