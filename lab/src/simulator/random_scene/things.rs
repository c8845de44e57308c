//! Objects: cans, cones, buckets, balls, mugs, cups and tins of random sizes; and bowls, which are no objects.

use super::super::shapes::{Bowl, Frustum, Shape, Sphere};
use super::set::Set;
use nalgebra::Vector3;
use std::ops::RangeInclusive;

/// A thing without a place: its name and its dimensions.
#[derive(Clone, Copy)]
pub enum Thing {
    /// Radii of both ends, length, and whether the upper end is open.
    Round { name: &'static str, base_radius: f64, top_radius: f64, length: f64, open: bool },
    /// Radius.
    Ball { name: &'static str, radius: f64 },
}

impl Thing {
    /// Distance from its axis to its widest part.
    pub fn reach(self) -> f64 {
        match self {
            Self::Round { base_radius, top_radius, .. } => base_radius.max(top_radius),
            Self::Ball { radius, .. } => radius,
        }
    }

    pub fn height(self) -> f64 {
        match self {
            Self::Round { length, .. } => length,
            Self::Ball { radius, .. } => 2.0 * radius,
        }
    }
}

impl Set {
    /// Puts a thing upright on a place.
    pub fn put(&mut self, thing: Thing, foot: Vector3<f64>) {
        self.put_along(thing, foot, Vector3::z());
    }

    /// Puts a thing upright at a free place on a level, and returns the place, if there is one.
    pub fn stand(&mut self, thing: Thing, distance: RangeInclusive<f64>, level: f64, gap: f64) -> Option<Vector3<f64>> {
        let foot = self.place(&distance, level, thing.reach(), gap)?;
        self.put(thing, foot);
        Some(foot)
    }

    /// Puts a thing so that its axis, from the middle of its first end, points along a unit vector.
    pub fn put_along(&mut self, thing: Thing, foot: Vector3<f64>, axis: Vector3<f64>) {
        match thing {
            Thing::Round { name, base_radius, top_radius, length, open } => {
                let frustum = Frustum { base: foot, axis, length, base_radius, top_radius, open };
                self.add(name, Shape::Frustum(frustum));
            }
            Thing::Ball { name, radius } => {
                self.add(name, Shape::Sphere(Sphere { center: foot + axis * radius, radius }));
            }
        }
    }

    /// Draws a thing that stands on floors.
    pub fn large_thing(&mut self) -> Thing {
        match self.draws.count(0..=7) {
            0..=2 => self.can(),
            3 | 4 => self.cone(),
            5 | 6 => self.ball(),
            _ => self.bucket(),
        }
    }

    /// A trash can or a drum.
    pub fn can(&mut self) -> Thing {
        let (radius, length) = (self.draws.within(0.1..=0.22), self.draws.within(0.3..=0.8));
        Thing::Round { name: "can", base_radius: radius, top_radius: radius, length, open: self.draws.chance(0.3) }
    }

    /// A parking cone, whose half-angle is 10 to 22 degrees.
    pub fn cone(&mut self) -> Thing {
        let (top_radius, length) = (self.draws.within(0.0..=0.04), self.draws.within(0.3..=0.7));
        let slope = libm::tan(self.draws.within(10.0..=22.0_f64).to_radians());
        let base_radius = top_radius + slope * length;
        Thing::Round { name: "cone", base_radius, top_radius, length, open: false }
    }

    /// A bucket: a cone with its wide end up, open or with a lid.
    pub fn bucket(&mut self) -> Thing {
        let (base_radius, length) = (self.draws.within(0.08..=0.16), self.draws.within(0.25..=0.4));
        let slope = libm::tan(self.draws.within(6.0..=12.0_f64).to_radians());
        let top_radius = base_radius + slope * length;
        Thing::Round { name: "bucket", base_radius, top_radius, length, open: self.draws.chance(0.5) }
    }

    /// A ball to play with.
    pub fn ball(&mut self) -> Thing {
        Thing::Ball { name: "ball", radius: self.draws.within(0.09..=0.22) }
    }

    /// Draws a thing that stands on tables.
    pub fn small_thing(&mut self) -> Thing {
        match self.draws.count(0..=6) {
            0 => self.mug(),
            1 | 2 => self.cup(),
            3 | 4 => self.tin(),
            _ => self.small_ball(),
        }
    }

    /// A mug without a handle.
    pub fn mug(&mut self) -> Thing {
        let (radius, length) = (self.draws.within(0.036..=0.046), self.draws.within(0.08..=0.12));
        Thing::Round { name: "mug", base_radius: radius, top_radius: radius, length, open: true }
    }

    /// A cup with a taper of 3 to 8 degrees, its wide end up.
    pub fn cup(&mut self) -> Thing {
        let (base_radius, length) = (self.draws.within(0.026..=0.036), self.draws.within(0.08..=0.13));
        let slope = libm::tan(self.draws.within(3.0..=8.0_f64).to_radians());
        let top_radius = base_radius + slope * length;
        Thing::Round { name: "cup", base_radius, top_radius, length, open: true }
    }

    /// A tin or a tube with a lid.
    pub fn tin(&mut self) -> Thing {
        let (radius, length) = (self.draws.within(0.03..=0.055), self.draws.within(0.09..=0.22));
        Thing::Round { name: "tin", base_radius: radius, top_radius: radius, length, open: false }
    }

    /// A tin for biscuits or fish, half to one radius high.
    pub fn flat_tin(&mut self) -> Thing {
        let radius = self.draws.within(0.05..=0.11);
        let length = radius * self.draws.within(0.5..=1.0);
        Thing::Round { name: "flat tin", base_radius: radius, top_radius: radius, length, open: false }
    }

    /// A tennis ball, or one somewhat larger.
    pub fn small_ball(&mut self) -> Thing {
        let radius = if self.draws.chance(0.5) { 0.0335 } else { self.draws.within(0.034..=0.06) };
        Thing::Ball { name: "tennis ball", radius }
    }

    /// A bowl on a level: upright, or upturned.
    pub fn bowl(&mut self, foot: Vector3<f64>, radius: f64) {
        let upturned = self.draws.chance(0.4);
        let depth = radius * self.draws.within(0.6..=1.0);
        let (axis, lift) = if upturned { (-Vector3::z(), depth - radius) } else { (Vector3::z(), radius) };
        let sphere = Sphere { center: foot + Vector3::z() * lift, radius };
        self.add("bowl", Shape::Bowl(Bowl { sphere, axis, depth }));
    }
}
