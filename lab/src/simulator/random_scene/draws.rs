//! Random numbers for a scene, in sequence.

use crate::random::CounterRng;
use nalgebra::Vector3;
use std::ops::RangeInclusive;

pub struct Draws {
    dice: CounterRng,
    next: u64,
}

impl Draws {
    pub fn new(seed: u64, group: u64) -> Self {
        const SCENES: u64 = 0x5ce7e; // apart from the numbers of the sensor's noise
        Self { dice: CounterRng::new(seed ^ SCENES, group), next: 0 }
    }

    fn uniform(&mut self) -> f64 {
        self.next += 1;
        self.dice.uniform(self.next)
    }

    /// Uniform in a range.
    pub fn within(&mut self, range: RangeInclusive<f64>) -> f64 {
        range.start() + (range.end() - range.start()) * self.uniform()
    }

    /// Uniform in a range of whole numbers.
    pub fn count(&mut self, range: RangeInclusive<u64>) -> u64 {
        let choices = range.end() - range.start() + 1;
        range.start() + (self.uniform() * choices as f64) as u64
    }

    /// True with a probability.
    pub fn chance(&mut self, probability: f64) -> bool {
        self.uniform() < probability
    }

    /// One of two signs.
    pub fn sign(&mut self) -> f64 {
        if self.chance(0.5) { 1.0 } else { -1.0 }
    }

    /// A random horizontal direction.
    pub fn heading(&mut self) -> Vector3<f64> {
        let angle = self.within(0.0..=std::f64::consts::TAU);
        Vector3::new(libm::cos(angle), libm::sin(angle), 0.0)
    }
}
