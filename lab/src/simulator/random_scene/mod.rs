//! Random scenes for scoring detectors: each depends only on its group and its seed.
//!
//! A group is a kind of difficulty: objects that stand, are tilted, hidden, small, lying, on top of one another, or among boxes;
//! bowls, whose insides are no objects; and rooms without objects. The camera is that of a robot or hand-held: height, pitch and
//! roll vary, and it looks roughly at the middle of the things.

mod arrangements;
mod draws;
mod furniture;
mod lived_in;
mod rooms;
mod set;
mod things;

use super::scene::Scene;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use set::Set;

/// A kind of random scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SceneGroup {
    /// Trash cans, parking cones, balls and buckets on a floor before a wall, 1 to 3 m ahead, now and then one on a plinth.
    Standing,
    /// Cylinders and cones that lean by 10 to 60 degrees to any side, also towards the camera and away from it.
    Tilted,
    /// One or two standing objects, each behind a box, a board or a post that hides 10 to 70 % of it.
    Occluded,
    /// Mugs, cups with a taper of 3 to 8 degrees, tins and balls on a table, 0.65 to 1.15 m ahead, often beside a box.
    Tabletop,
    /// Pipes, cans and cones that lie on the floor, or tins that lie on a table.
    Lying,
    /// A ball, a cone or a narrower can on a can, a bucket or a crate.
    Composed,
    /// Boxes, steps and boards, and at most two objects among them.
    Clutter,
    /// Bowls on a table, upright and upturned, and often a mug, a cup, a tin or a ball beside them.
    Bowls,
    /// Walls, floors, boxes, boards, steps and tables: nothing to be found.
    Empty,
    /// Tins that are half to one radius high, on a table that the camera looks down at by 25 to 45 degrees.
    FlatTins,
    /// A room with chairs, a cupboard with handles, rounded posts, people and curved walls, and at most two objects in it.
    Furnished,
    /// A table with cups that have handles and a dark inside, bottles whose glass gives no depth, bowls, tins and boxes.
    Kitchen,
    /// A room with people in clothes, armchairs, bags and plants, or a table with fruit, oval bottles, cartons, crumpled cloth and
    /// paper: what is nearly round, and at most two objects.
    LivedIn,
    /// A hall with people, armchairs, bags and plants up to 6 m away, and at most two objects beside the pots of the plants.
    Hall,
}

impl SceneGroup {
    /// The default groups, to which the figures of the documentation refer.
    pub const USUAL: [Self; 9] = [
        Self::Standing,
        Self::Tilted,
        Self::Occluded,
        Self::Tabletop,
        Self::Lying,
        Self::Composed,
        Self::Clutter,
        Self::Bowls,
        Self::Empty,
    ];

    /// Returns all groups.
    pub fn all() -> impl Iterator<Item = Self> {
        GROUPS.into_iter().map(|(group, ..)| group)
    }

    /// Returns the group's word in a pipeline file.
    pub fn name(self) -> &'static str {
        GROUPS[self as usize].1
    }
}

/// A group, its word, and the function that arranges its scenes.
type Arranged = (SceneGroup, &'static str, fn(&mut Set));

/// All groups, in their order.
const GROUPS: [Arranged; 14] = [
    (SceneGroup::Standing, "standing", arrangements::standing),
    (SceneGroup::Tilted, "tilted", arrangements::tilted),
    (SceneGroup::Occluded, "occluded", arrangements::occluded),
    (SceneGroup::Tabletop, "tabletop", arrangements::tabletop),
    (SceneGroup::Lying, "lying", arrangements::lying),
    (SceneGroup::Composed, "composed", arrangements::composed),
    (SceneGroup::Clutter, "clutter", arrangements::clutter),
    (SceneGroup::Bowls, "bowls", arrangements::bowls),
    (SceneGroup::Empty, "empty", arrangements::empty),
    (SceneGroup::FlatTins, "flat_tins", arrangements::flat_tins),
    (SceneGroup::Furnished, "furnished", rooms::furnished),
    (SceneGroup::Kitchen, "kitchen", rooms::kitchen),
    (SceneGroup::LivedIn, "lived_in", lived_in::lived_in),
    (SceneGroup::Hall, "hall", lived_in::hall),
];

/// Largest configured roll of the camera to either side, in degrees, beside the random 6: the camera stays upright.
pub const MAX_ROLL_DEG: f64 = 75.0; // [algorithmic]

/// Returns a scene of a group, with the name `group/seed`.
pub fn random_scene(group: SceneGroup, seed: u64) -> Scene {
    rolled_scene(group, seed, 0.0)
}

/// Returns the scene with the camera rolled further, with the name `group/seed/degrees`.
pub fn rolled_scene(group: SceneGroup, seed: u64, roll_deg: f64) -> Scene {
    let mut set = Set::new(group as u64, seed);
    let (_, name, arrange) = GROUPS[group as usize];
    arrange(&mut set);
    set.roll_deg += roll_deg;
    let rolled = if roll_deg == 0.0 { String::new() } else { format!("/{roll_deg}") };
    let mut scene = set.scene(format!("{name}/{seed}{rolled}"));
    scene.group = Some(name);
    scene
}

/// Returns the scene of this name.
pub fn scene_named(name: &str) -> Option<Scene> {
    let mut parts = name.split('/');
    let (group, seed) = (parts.next()?, parts.next()?.parse().ok()?);
    let roll_deg = parts.next().map_or(Some(0.0), |roll| roll.parse().ok())?;
    let group = SceneGroup::all().find(|known| known.name() == group)?;
    let is_known = parts.next().is_none() && (-MAX_ROLL_DEG..=MAX_ROLL_DEG).contains(&roll_deg);
    is_known.then(|| rolled_scene(group, seed, roll_deg))
}

#[cfg(test)]
mod tests;
