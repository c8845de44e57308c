//! A random scene under construction: its bodies, the occupied places, and the camera.

use super::super::scene::{Body, Role, Scene};
use super::super::shapes::Shape;
use super::draws::Draws;
use nalgebra::Vector3;
use std::ops::RangeInclusive;

/// A scene under construction; z is up, the floor is at 0, and the camera looks along y from above the origin.
pub struct Set {
    pub draws: Draws,
    bodies: Vec<Body>,
    /// Middle and radius of the occupied places.
    pub taken: Vec<(Vector3<f64>, f64)>,
    pub camera: Vector3<f64>,
    look_at: Vector3<f64>,
    pub roll_deg: f64,
}

impl Set {
    /// Creates an empty scene with a camera of random height and roll.
    pub fn new(group: u64, seed: u64) -> Self {
        let mut draws = Draws::new(seed, group);
        let camera = Vector3::new(0.0, 0.0, draws.within(0.5..=1.5));
        let roll_deg = draws.within(-6.0..=6.0);
        let look_at = Vector3::new(0.0, 2.0, 0.4);
        Self { draws, bodies: Vec::new(), taken: Vec::new(), camera, look_at, roll_deg }
    }

    /// Adds an object.
    pub fn add(&mut self, name: &str, shape: Shape) {
        self.add_as(Role::Object, name, shape);
    }

    /// Adds a body in a role.
    pub fn add_as(&mut self, role: Role, name: &str, shape: Shape) {
        let name = format!("{name} {}", self.bodies.len());
        self.bodies.push(Body::still(name, shape).as_a(role));
    }

    /// Returns a free place for something of a radius on a level, within the view; `None` if it is too crowded.
    pub fn place(&mut self, distance: &RangeInclusive<f64>, level: f64, radius: f64, gap: f64) -> Option<Vector3<f64>> {
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

    /// Turns the camera roughly to the middle of the occupied places, at a height above them; in every fourth scene so far aside
    /// that the image's border may cut things off.
    pub fn look_at_things(&mut self, height: f64) {
        let count = self.taken.len().max(1) as f64;
        let middle = self.taken.iter().map(|(place, _)| place).sum::<Vector3<f64>>() / count;
        let reach = if self.draws.chance(0.25) { 0.4 } else { 0.08 };
        let mut shake = || self.draws.within(-reach..=reach) * middle.y;
        self.look_at = middle + Vector3::new(shake(), shake(), height + shake());
    }

    /// Returns the scene, with this name.
    pub fn scene(self, name: String) -> Scene {
        let camera_up = Vector3::new(libm::tan(self.roll_deg.to_radians()), 0.0, 1.0);
        Scene::still(name, self.bodies, self.camera, self.look_at, camera_up)
    }
}
