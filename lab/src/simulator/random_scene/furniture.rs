//! Things without round surfaces: floors, walls, tables, boxes, steps and boards.

use super::super::shapes::{Block, Plane, Shape};
use super::set::Set;
use nalgebra::{Matrix3, Vector3};
use std::ops::RangeInclusive;

impl Set {
    /// Adds an infinite plane.
    pub fn plane(&mut self, name: &str, point: Vector3<f64>, normal: Vector3<f64>) {
        let sides = [Vector3::x(), Vector3::y()];
        let normal = normal.normalize();
        self.add(name, Shape::Plane(Plane { point, normal, sides, half: [f64::INFINITY; 2] }));
    }

    /// Adds a floor, a wall across the view at about a distance, and sometimes one at the side.
    pub fn room(&mut self, wall_distance: f64) {
        self.plane("floor", Vector3::zeros(), Vector3::z());
        let turn = self.draws.within(-0.4..=0.4);
        self.plane("wall", Vector3::new(0.0, wall_distance, 0.0), Vector3::new(turn, -1.0, 0.0));
        if self.draws.chance(0.3) {
            let side = self.draws.sign();
            let place = Vector3::new(side * self.draws.within(1.4..=2.2), 0.0, 0.0);
            let turn = self.draws.within(-0.2..=0.2);
            self.plane("side wall", place, Vector3::new(-side, turn, 0.0));
        }
    }

    /// Adds a room with its wall at a distance in a range, and turns the camera to a height above the things in it.
    pub fn enclose(&mut self, wall: RangeInclusive<f64>, height: f64) {
        let wall = self.draws.within(wall);
        self.room(wall);
        self.look_at_things(height);
    }

    /// Adds a box that stands on a level, rotated about the vertical so that its first side points along `heading`.
    pub fn block(&mut self, name: &str, foot: Vector3<f64>, heading: Vector3<f64>, size: Vector3<f64>) {
        let axes = Matrix3::from_columns(&[heading, Vector3::z().cross(&heading), Vector3::z()]);
        let center = foot + Vector3::z() * (0.5 * size.z);
        self.add(name, Shape::Block(Block { center, axes, half: size * 0.5 }));
    }

    /// Adds a box of random size (longest side `most`) and heading at a free place; returns its foot and height.
    pub fn random_block(&mut self, near: f64, far: f64, level: f64, most: f64) -> Option<(Vector3<f64>, f64)> {
        let mut side = || self.draws.within(0.25 * most..=most);
        let size = Vector3::new(side(), side(), side());
        let heading = self.draws.heading();
        let foot = self.place(&(near..=far), level, 0.5 * size.xy().norm(), 0.0)?;
        self.block("box", foot, heading, size);
        Some((foot, size.z))
    }

    /// Adds a staircase that rises away from the camera.
    pub fn steps(&mut self, distance: f64) {
        let (rise, tread) = (self.draws.within(0.12..=0.2), self.draws.within(0.22..=0.35));
        let (width, turn) = (self.draws.within(0.6..=1.6), self.draws.within(-0.4..=0.4));
        let heading = Vector3::new(1.0, turn, 0.0).normalize();
        let away = Vector3::z().cross(&heading);
        let offset = self.draws.within(-0.5..=0.5);
        for step in 0..self.draws.count(2..=4) {
            let step = step as f64;
            let foot = Vector3::new(offset, distance, 0.0) + away * (tread * step);
            self.block("step", foot, heading, Vector3::new(width, tread, rise * (step + 1.0)));
        }
        self.taken.push((Vector3::new(offset, distance + tread, 0.0), 0.5 * width));
    }

    /// Adds a board that leans in any direction.
    pub fn board(&mut self, center: Vector3<f64>) {
        let tilt = self.draws.heading() * self.draws.within(0.0..=0.8);
        let normal = (Vector3::new(0.0, -1.0, 0.3) + tilt).normalize();
        let side = normal.cross(&Vector3::z()).normalize();
        let half = [self.draws.within(0.1..=0.4), self.draws.within(0.1..=0.3)];
        self.add("board", Shape::Plane(Plane { point: center, normal, sides: [side, normal.cross(&side)], half }));
    }

    /// Adds a table, and moves the camera as if held by someone at its edge; returns the height of its top.
    pub fn table(&mut self) -> f64 {
        let top = self.draws.within(0.65..=0.8);
        let size = Vector3::new(self.draws.within(1.2..=2.0), self.draws.within(0.7..=1.0), 0.04);
        let middle = Vector3::new(self.draws.within(-0.2..=0.2), self.draws.within(0.85..=1.05), top - size.z);
        let turn = self.draws.within(-0.2..=0.2);
        self.block("table", middle, Vector3::new(1.0, turn, 0.0).normalize(), size);
        self.camera.z = top + self.draws.within(0.25..=0.7);
        top
    }
}
