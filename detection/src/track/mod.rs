//! The tracker: gives the objects of successive frames an identity, a velocity and a filtered shape.
//!
//! Each object has Kalman filters of nearly constant velocity, one for each way in which it may move ([`motions`]). If the
//! camera's pose is known, filtering happens in the world and the camera may move. Positions and velocities are reported in the
//! camera frame of the present frame; the velocity is that in the world, expressed along the camera's axes. A camera without a
//! pose counts as standing still, in a world of its own ([`worlds`]); a frame that lacks a pose takes that of the frame before.
//! Each of several cameras in one world has its own pose, and only the camera that saw a target last can miss it. Each target has
//! its own time; a frame that is older is compared with the target's state at the time of that frame. Balls may fall and bounce
//! if the parameters say so ([`ballistic`]).
//!
//! The files in the order of the steps: the time of a frame ([`timeline`]) and the world of its camera ([`worlds`]); the targets
//! ([`target`]), their models of motion ([`motions`]), the Kalman filters ([`filter`]) and the fall of balls ([`ballistic`]); an
//! object as input of the filters ([`detection`]); the assignment of detections to targets ([`association`]); and the
//! confirmation and the end of tracks ([`life`]). [`Tracker::update_frame`] puts the steps together.

mod association;
mod ballistic;
mod detection;
mod filter;
mod life;
mod motions;
mod parameters;
mod target;
#[cfg(test)]
mod tests;
mod timeline;
mod worlds;

pub use ballistic::Ballistic;
pub use parameters::TrackerParameters;
pub use worlds::Worlds;

use crate::camera::isometry;
use association::Association;
use conicflow_messages::{Header, Hop, Object, ObjectKind, Text, Track, is_rotation};
use detection::Detection;
use nalgebra::IsometryMatrix3;
use target::Target;
use timeline::{Advance, Timeline};

/// A target survives a gap between two frames of up to so many times the gap before, even beyond `max_coast_s`: no frame could
/// have shown it sooner.
const USUAL_GAP: f64 = 1.5; // [tuned]

/// Tracks objects from frame to frame, for one camera or for several cameras with poses.
pub struct Tracker {
    parameters: TrackerParameters,
    timeline: Timeline,
    /// Pose of each source's camera, in the order of [`Advance::source`].
    world_from_camera: Vec<IsometryMatrix3<f64>>,
    has_pose: bool,
    next_id: u64,
    /// The targets, each in its state at the newest frame that it has taken in.
    targets: Vec<Target>,
    /// The targets, predicted to the time of the present frame.
    predicted: Vec<Target>,
    detections: Vec<Detection>,
    association: Association,
    tracks: Vec<Track>,
    newly_confirmed: Vec<ObjectKind>,
}

/// A matrix that was given as a pose but is no pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error(
    "the camera's pose has no rotation in its first three columns\n  hint: give `[R | t]` row by row, from the camera to the world"
)]
pub struct NoPose;

impl Default for Tracker {
    fn default() -> Self {
        Self::new(TrackerParameters::default())
    }
}

impl Tracker {
    /// Creates a tracker without tracks; the first one gets the identity 1. The parameters are not checked here: use
    /// [`TrackerParameters::faults`] and the ranges of their JSON schema on parameters from a file.
    pub fn new(parameters: TrackerParameters) -> Self {
        Self {
            timeline: Timeline::new(1.0 / parameters.assumed_rate_hz),
            parameters,
            world_from_camera: Vec::new(),
            has_pose: false,
            next_id: 1,
            targets: Vec::new(),
            predicted: Vec::new(),
            detections: Vec::new(),
            association: Association::default(),
            tracks: Vec::new(),
            newly_confirmed: Vec::new(),
        }
    }

    /// Updates the tracks with the objects of one frame of a camera that stands still; returns the live tracks by identity.
    /// `stamp_ns` is the time of the frame in nanoseconds; where it does not advance, frames count as coming at
    /// [`TrackerParameters::assumed_rate_hz`].
    pub fn update(&mut self, objects: &[Object], stamp_ns: u64) -> &[Track] {
        self.update_frame(&Header { stamp_ns, ..Header::default() }, objects)
    }

    /// Updates the tracks for a camera that moves, or for several that look at the same place: `camera` is its number (0 is that
    /// of [`Self::update`]), `world_from_camera` its pose, row-major `[R | t]` with a rotation R and t in metres. Positions and
    /// velocities stay in the frame of the camera. An object that only one camera sees is no miss for the others.
    ///
    /// # Errors
    /// The matrix is no pose; the tracks stay as they were.
    pub fn update_from(
        &mut self,
        camera: u32,
        objects: &[Object],
        stamp_ns: u64,
        world_from_camera: [[f64; 4]; 3],
    ) -> Result<&[Track], NoPose> {
        let is_finite = world_from_camera.as_flattened().iter().all(|number| number.is_finite());
        if !(is_finite && is_rotation(&world_from_camera)) {
            return Err(NoPose);
        }
        let mut header = Header { stamp_ns, ..Header::default() };
        header.set_pose(world_from_camera);
        if camera > 0 {
            header.add_hop(Hop { stage: Text::new(&camera.to_string()), ..Hop::default() });
        }
        Ok(self.update_frame(&header, objects))
    }

    /// The method: updates the tracks with the objects of a frame, which are in the camera frame; returns the live tracks by
    /// identity.
    pub fn update_frame(&mut self, header: &Header, objects: &[Object]) -> &[Track] {
        // T1. Time and world: when the frame was taken, and how long after the last one (`timeline.rs`); each world has a tracker
        //     of its own (`worlds.rs`). Targets of a source that began a new run, and those unseen for too long, are removed.
        let time = self.timeline.advance(header);
        if time.new_run {
            self.targets.retain(|target| target.seen_by != time.source);
        }
        let patience_s = self.parameters.max_coast_s.max(USUAL_GAP * time.usual_s);
        self.targets.retain(|target| target.life.unseen_s + time.elapsed_s <= patience_s);

        // T2. Prediction: each target moves by its models of motion (`motions.rs`, `filter.rs`, `ballistic.rs`) to the time of
        //     the frame; a target that has taken in a newer frame moves back (`target.rs`).
        let world_from_camera = self.pose(header, time.source);
        self.predict(&time);

        // T3. Association: the cheapest assignment of detections to targets within the gate (`detection.rs`,
        //     `association.rs`).
        self.take_detections(objects, &world_from_camera);
        self.associate(&time);

        // T4. Update: a detection corrects its target; a target without a detection is missed (`motions.rs`, `target.rs`).
        // T5. Life: hits and misses confirm or end a track; detections without a target begin tracks (`life.rs`).
        let camera_from_world = world_from_camera.inverse();
        self.tracks.clear();
        self.update_targets(&time, &camera_from_world);
        self.give_birth(&time, &camera_from_world);
        &self.tracks
    }

    /// Returns the shapes of the tracks that the last frame confirmed.
    pub fn newly_confirmed(&self) -> &[ObjectKind] {
        &self.newly_confirmed
    }

    /// Returns the live tracks as of the last frame, by identity.
    pub fn tracks(&self) -> &[Track] {
        &self.tracks
    }

    /// Returns the pose of a source's camera: that of the header, else the last one.
    fn pose(&mut self, header: &Header, source: usize) -> IsometryMatrix3<f64> {
        if source >= self.world_from_camera.len() {
            self.world_from_camera.resize(source + 1, IsometryMatrix3::identity());
        }
        if let Some(pose) = header.pose() {
            self.world_from_camera[source] = isometry(pose);
            self.has_pose = true;
        }
        self.world_from_camera[source]
    }

    fn predict(&mut self, time: &Advance) {
        let Self { targets, predicted, has_pose, parameters, .. } = self;
        predicted.clear();
        predicted.extend(targets.iter().map(|target| target.at(time, *has_pose, parameters)));
    }

    fn take_detections(&mut self, objects: &[Object], world_from_camera: &IsometryMatrix3<f64>) {
        self.detections.clear();
        let detection = |object| Detection::new(object, world_from_camera, &self.parameters);
        self.detections.extend(objects.iter().map(detection));
    }

    /// Assigns detections first to undisturbed targets, then to those that may have been pushed.
    fn associate(&mut self, time: &Advance) {
        let Self { association, predicted, detections, parameters, .. } = self;
        association.reset(predicted.len(), detections.len());
        association.assign(|target, detection| predicted[target].cost(&detections[detection], parameters));
        association
            .assign(|target, detection| predicted[target].cost_of_manoeuvre(&detections[detection], time, parameters));
    }

    fn update_targets(&mut self, time: &Advance, camera_from_world: &IsometryMatrix3<f64>) {
        self.newly_confirmed.clear();
        let pairs = self.targets.iter_mut().zip(&mut self.predicted).zip(self.association.detections());
        for ((target, predicted), detection) in pairs {
            let seen = detection.map(|detection| &self.detections[detection]);
            match seen {
                Some(seen) => predicted.see(seen, time, &self.parameters),
                None => predicted.miss(time),
            }
            if predicted.is_confirmed() && !target.is_confirmed() {
                self.newly_confirmed.push(predicted.kind);
            }
            target.commit(predicted, seen, time, &self.parameters);
            if !predicted.life.is_lost(&self.parameters) {
                self.tracks.push(predicted.track(camera_from_world));
            }
        }
        self.targets.retain(|target| !target.life.is_lost(&self.parameters));
    }

    fn give_birth(&mut self, time: &Advance, camera_from_world: &IsometryMatrix3<f64>) {
        for index in self.association.unclaimed() {
            let target = Target::born(self.next_id, &self.detections[index], time, &self.parameters);
            self.next_id += 1;
            if target.is_confirmed() {
                self.newly_confirmed.push(target.kind);
            }
            self.tracks.push(target.track(camera_from_world));
            self.targets.push(target);
        }
    }
}
