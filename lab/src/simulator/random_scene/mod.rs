//! Random scenes for the scoring of detectors: each is a function of its group and its seed alone.
//!
//! A group is a kind of difficulty: things that stand, that are tilted, hidden, small, lying, put on one another, among
//! boxes; bowls, whose insides are no objects; and rooms with nothing to be found. The camera stands as that of a robot
//! or in a hand: its height, pitch and roll vary, and it looks about at the middle of things.

mod arrangements;
mod draws;
mod furniture;
mod rooms;
mod things;

use super::scene::{Body, Role, Scene};
use super::shapes::Shape;
use draws::Draws;
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;

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
}

impl SceneGroup {
    /// Those that are shown where none are named, and that the figures are of.
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

    /// The others.
    pub const FURTHER: [Self; 3] = [Self::FlatTins, Self::Furnished, Self::Kitchen];

    /// All groups.
    pub fn all() -> impl Iterator<Item = Self> {
        Self::USUAL.into_iter().chain(Self::FURTHER)
    }

    /// The word for it, as it stands in a pipeline file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Standing => "standing",
            Self::Tilted => "tilted",
            Self::Occluded => "occluded",
            Self::Tabletop => "tabletop",
            Self::Lying => "lying",
            Self::Composed => "composed",
            Self::Clutter => "clutter",
            Self::Bowls => "bowls",
            Self::Empty => "empty",
            Self::FlatTins => "flat_tins",
            Self::Furnished => "furnished",
            Self::Kitchen => "kitchen",
        }
    }
}

/// A scene of a group; named `group/seed`.
pub fn random_scene(group: SceneGroup, seed: u64) -> Scene {
    let mut set = Set::new(group, seed);
    match group {
        SceneGroup::Standing => arrangements::standing(&mut set),
        SceneGroup::Tilted => arrangements::tilted(&mut set),
        SceneGroup::Occluded => arrangements::occluded(&mut set),
        SceneGroup::Tabletop => arrangements::tabletop(&mut set),
        SceneGroup::Lying => arrangements::lying(&mut set),
        SceneGroup::Composed => arrangements::composed(&mut set),
        SceneGroup::Clutter => arrangements::clutter(&mut set),
        SceneGroup::Bowls => arrangements::bowls(&mut set),
        SceneGroup::Empty => arrangements::empty(&mut set),
        SceneGroup::FlatTins => arrangements::flat_tins(&mut set),
        SceneGroup::Furnished => rooms::furnished(&mut set),
        SceneGroup::Kitchen => rooms::kitchen(&mut set),
    }
    set.scene(group, seed)
}

/// The group and seed of a scene, from its name.
pub fn parse_name(name: &str) -> Option<(SceneGroup, u64)> {
    let (group, seed) = name.split_once('/')?;
    let group = SceneGroup::all().find(|known| known.name() == group)?;
    Some((group, seed.parse().ok()?))
}

/// A scene in the making; z is up, the floor lies at 0, and the camera looks along y from above the origin.
struct Set {
    draws: Draws,
    bodies: Vec<Body>,
    /// Middle and radius of the places that are taken.
    taken: Vec<(Vector3<f64>, f64)>,
    camera: Vector3<f64>,
    look_at: Vector3<f64>,
    roll_deg: f64,
}

impl Set {
    fn new(group: SceneGroup, seed: u64) -> Self {
        let mut draws = Draws::new(seed, group as u64);
        let camera = Vector3::new(0.0, 0.0, draws.within(0.5..=1.5));
        let roll_deg = draws.within(-6.0..=6.0);
        let look_at = Vector3::new(0.0, 2.0, 0.4);
        Self { draws, bodies: Vec::new(), taken: Vec::new(), camera, look_at, roll_deg }
    }

    fn add(&mut self, name: &str, shape: Shape) {
        let name = format!("{name} {}", self.bodies.len());
        self.bodies.push(Body::still(name, shape));
    }

    fn add_as(&mut self, role: Role, name: &str, shape: Shape) {
        let name = format!("{name} {}", self.bodies.len());
        self.bodies.push(Body::still(name, shape).as_a(role));
    }

    /// A free place for something of a radius on a level, within the view; `None` where it is too crowded.
    fn place(&mut self, distance: &RangeInclusive<f64>, level: f64, radius: f64, gap: f64) -> Option<Vector3<f64>> {
        const TRIES: usize = 20;
        for _ in 0..TRIES {
            let y = self.draws.within(distance.clone());
            let x = y * self.draws.within(-0.42..=0.42);
            let place = Vector3::new(x, y, level);
            let free = |(other, reach): &(Vector3<f64>, f64)| (place - other).xy().norm() > radius + reach + gap;
            if self.taken.iter().all(free) {
                self.taken.push((place, radius));
                return Some(place);
            }
        }
        None
    }

    /// Turns the camera to the middle of the places that are taken, at a height above them, give or take; in each fourth
    /// scene so far aside that the image's border may cut things off.
    fn look_at_things(&mut self, height: f64) {
        let count = self.taken.len().max(1) as f64;
        let middle = self.taken.iter().map(|(place, _)| place).sum::<Vector3<f64>>() / count;
        let reach = if self.draws.chance(0.25) { 0.4 } else { 0.08 };
        let mut shake = || self.draws.within(-reach..=reach) * middle.y;
        self.look_at = middle + Vector3::new(shake(), shake(), height + shake());
    }

    fn scene(self, group: SceneGroup, seed: u64) -> Scene {
        let name = format!("{}/{seed}", group.name());
        let camera_up = Vector3::new(libm::tan(self.roll_deg.to_radians()), 0.0, 1.0);
        let mut scene = Scene::still(name, self.bodies, self.camera, self.look_at, camera_up);
        scene.group = Some(group.name());
        scene
    }
}

#[cfg(test)]
mod tests;
