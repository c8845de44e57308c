//! Rooms and tables with things that are not quite round: people in clothes, cushions, bags, plants, fruit, oval bottles,
//! crumpled cloth and paper. They are no objects, but the round necks and caps of bottles are parts. Among them are at most two
//! objects, with rims and handles.

use super::super::shapes::{Crease, Lump, Shape};
use super::rooms::{bar, knob};
use super::set::Set;
use super::things::Thing;
use nalgebra::{Matrix3, Rotation3, Vector3};
use std::f64::consts::TAU;
use std::ops::RangeInclusive;

// Logarithms of the exponents of superellipsoids, across and along.
const ROUND: [u32; 2] = [1, 1];
const CUSHION: [u32; 2] = [2, 1];
const BAG: [u32; 2] = [2, 2];
const OVAL: [u32; 2] = [1, 3];
const BOXY: [u32; 2] = [3, 3];

pub fn lived_in(set: &mut Set) {
    if set.draws.chance(0.5) { living_room(set) } else { breakfast_table(set) }
}

fn living_room(set: &mut Set) {
    for _ in 0..set.draws.count(0..=2) {
        let thing = set.large_thing();
        used(set, thing, 1.1..=2.6, 0.0, 0.05);
    }
    let what: [Kind; 5] = [(0.35, person), (0.35, person), (0.5, armchair), (0.25, bag), (0.3, plant)];
    scatter(set, 2..=4, &what, (1.1..=2.8, 0.0, 0.03));
    set.enclose(2.8..=4.0, 0.5);
}

/// Adds lived-in things far away, where a camera's depths show little of the deviation from round; and heads with hair, which are
/// rounder.
pub fn hall(set: &mut Set) {
    for _ in 0..set.draws.count(0..=2) {
        let thing = set.large_thing();
        used(set, thing, 1.5..=3.5, 0.0, 0.05);
    }
    let somebody: Kind = (0.35, person_with_hair);
    scatter(
        set,
        3..=6,
        &[somebody, somebody, somebody, (0.5, armchair), (0.25, bag), (0.3, plant)],
        (1.8..=6.0, 0.0, 0.03),
    );
    set.enclose(5.0..=8.0, 0.7);
}

fn breakfast_table(set: &mut Set) {
    let top = set.table();
    for _ in 0..set.draws.count(0..=2) {
        let thing = set.small_thing();
        used(set, thing, 0.6..=1.15, top, 0.02);
    }
    let what: [Kind; 6] =
        [(0.06, oval_bottle), (0.07, carton), (0.05, fruit), (0.05, fruit), (0.16, cloth), (0.05, paper)];
    scatter(set, 3..=6, &what, (0.6..=1.15, top, 0.01));
    set.enclose(1.8..=3.5, 0.06);
}

/// A kind of thing: the radius of its place, and the function that adds it.
type Kind = (f64, fn(&mut Set, Vector3<f64>));

/// Puts a number of things, each of one of the kinds, at free places at a distance, on a level, with a gap between them.
fn scatter(
    set: &mut Set,
    count: RangeInclusive<u64>,
    kinds: &[Kind],
    (distance, level, gap): (RangeInclusive<f64>, f64, f64),
) {
    for _ in 0..set.draws.count(count) {
        let (reach, put) = kinds[set.draws.count(0..=kinds.len() as u64 - 1) as usize];
        if let Some(foot) = set.place(&distance, level, reach, gap) {
            put(set, foot);
        }
    }
}

impl Set {
    /// Adds a lump whose third axis is along a direction, with a random rotation about it, and creases with heights and lengths
    /// in metres.
    fn lump(
        &mut self,
        name: &str,
        [center, along]: [Vector3<f64>; 2],
        half: [f64; 3],
        squareness: [u32; 2],
        [height, length]: [RangeInclusive<f64>; 2],
    ) {
        let turn = self.draws.within(0.0..=TAU);
        let axes = axes(along, turn);
        let half = Vector3::from(half);
        let mean = half.mean();
        let height = self.draws.within(height) / mean;
        let mut crease = |share: f64| {
            // Waves of cloth have any direction.
            let (rise, heading) = (self.draws.within(-1.0..=1.0), self.draws.heading());
            let direction = heading * (1.0 - rise * rise).sqrt() + Vector3::z() * rise;
            let wave = direction.component_mul(&half) * (TAU / self.draws.within(length.clone()));
            Crease { wave, phase: self.draws.within(0.0..=TAU), height: share * height }
        };
        let creases = [0.5, 0.35, 0.25, 0.2].map(&mut crease);
        self.add(name, Shape::Lump(Lump { center, axes, half, squareness, creases }));
    }

    /// Adds a lump from one point to another.
    fn limb(&mut self, name: &str, [from, to]: [Vector3<f64>; 2], [one, other]: [f64; 2], folds: RangeInclusive<f64>) {
        let along = to - from;
        let half = [one, other, 0.5 * along.norm() + 0.3 * one];
        self.lump(name, [(from + to) * 0.5, along], half, [1, 2], [folds, 0.05..=0.2]);
    }
}

/// Returns axes of which the third is along a direction, rotated about it by `turn`.
fn axes(along: Vector3<f64>, turn: f64) -> Matrix3<f64> {
    let third = along.normalize();
    let first = third.cross(&if third.z.abs() < 0.9 { Vector3::z() } else { Vector3::x() }).normalize();
    let turned = Rotation3::from_axis_angle(&nalgebra::Unit::new_unchecked(third), turn) * first;
    Matrix3::from_columns(&[turned, third.cross(&turned), third])
}

/// Puts a thing upright at a free place on a level, if there is one, with details of used things: rims, a band, a lid, a handle.
fn used(set: &mut Set, thing: Thing, distance: RangeInclusive<f64>, level: f64, gap: f64) {
    let Some(foot) = set.stand(thing, distance, level, gap) else { return };
    let Thing::Round { base_radius, top_radius, length, open, .. } = thing else { return };
    let radius = |share: f64| base_radius + (top_radius - base_radius) * share;
    let mean = radius(0.5);
    let ring = |set: &mut Set, name: &str, ends: [f64; 2], thickness: f64| {
        let [from, to] = ends.map(|end| foot + Vector3::z() * (end * length));
        bar(set, name, [from, to], ends.map(|end| radius(end) + thickness));
    };
    if set.draws.chance(0.5) {
        let (height, thickness) = (set.draws.within(0.02..=0.06), set.draws.within(0.01..=0.05) * mean);
        ring(set, "rim", [0.0, height], thickness);
        if !open {
            ring(set, "rim", [1.0 - height, 1.0], thickness);
        }
    }
    if set.draws.chance(0.4) {
        let (from, height) = (set.draws.within(0.1..=0.5), set.draws.within(0.1..=0.4));
        let thickness = set.draws.within(0.003..=0.015) * mean;
        ring(set, "band", [from, from + height], thickness);
    }
    if !open && top_radius > 0.5 * base_radius && set.draws.chance(0.4) {
        let (height, wider) = (set.draws.within(0.05..=0.15), set.draws.within(-0.1..=0.05) * mean);
        ring(set, "lid", [1.0, 1.0 + height], wider);
    }
    if set.draws.chance(0.4) {
        let heading = set.draws.heading();
        let (thick, reach) = (set.draws.within(0.05..=0.15) * mean, set.draws.within(0.3..=0.8) * mean);
        let at = |out: f64, share: f64| foot + heading * (radius(share) + out) + Vector3::z() * (share * length);
        let bends = [at(0.0, 0.85), at(reach, 0.75), at(reach, 0.4), at(0.0, 0.3)];
        bends.windows(2).for_each(|ends| bar(set, "handle", [ends[0], ends[1]], [thick; 2]));
    }
}

/// Puts up a standing person in clothes.
fn person(set: &mut Set, foot: Vector3<f64>) {
    somebody(set, foot);
}

/// Puts up a standing person with hair or a cap.
fn person_with_hair(set: &mut Set, foot: Vector3<f64>) {
    let (center, height) = somebody(set, foot);
    let mut half = |least: f64, most: f64| set.draws.within(least..=most) * height;
    let half = [half(0.05, 0.062), half(0.055, 0.065), half(0.055, 0.07)];
    set.lump("hair", [center, Vector3::z()], half, ROUND, [0.002..=0.012, 0.04..=0.15]);
}

/// Puts up a person, and returns the middle of the head and the height.
fn somebody(set: &mut Set, foot: Vector3<f64>) -> (Vector3<f64>, f64) {
    let heading = set.draws.heading();
    let across = Vector3::z().cross(&heading);
    let height = set.draws.within(1.5..=1.9);
    let at = |along: f64, aside: f64, up: f64| foot + (heading * along + across * aside + Vector3::z() * up) * height;
    let stout = set.draws.within(0.9..=1.25);
    let wide = |part: f64| part * stout * height;
    for side in [-1.0, 1.0] {
        let stride = side * set.draws.within(-0.06..=0.06);
        let [ankle, knee, hip] = [(stride, 0.06, 0.02), (0.5 * stride, 0.06, 0.28), (0.0, 0.05, 0.5)]
            .map(|(along, aside, up)| at(along, aside * side, up));
        set.limb("trouser leg", [ankle, knee], [wide(0.04), wide(0.034)], 0.004..=0.012);
        set.limb("thigh", [knee, hip], [wide(0.05), wide(0.042)], 0.004..=0.012);
        let (swing, out) = (set.draws.within(-0.1..=0.2), set.draws.within(0.0..=0.1));
        let (shoulder, elbow) = (at(0.0, 0.125 * side, 0.79), at(0.3 * swing, (0.13 + out) * side, 0.62));
        let hand = at(swing, (0.12 + out) * side, 0.47 + 0.5 * swing.abs());
        set.limb("sleeve", [elbow, shoulder], [wide(0.034), wide(0.028)], 0.003..=0.01);
        set.limb("sleeve", [hand, elbow], [wide(0.029), wide(0.023)], 0.003..=0.01);
        set.lump("hand", [hand, Vector3::z()], [0.05, 0.022, 0.08], ROUND, [0.0..=0.006, 0.03..=0.05]);
    }
    let trunk = [at(0.0, 0.0, 0.65), Vector3::z()];
    set.lump("shirt", trunk, [wide(0.07), wide(0.12), 0.19 * height], [1, 2], [0.005..=0.02, 0.1..=0.3]);
    set.limb("shoulders", [at(0.0, -0.1, 0.79), at(0.0, 0.1, 0.79)], [wide(0.035), wide(0.045)], 0.003..=0.01);
    bar(set, "neck", [at(0.0, 0.0, 0.8), at(0.01, 0.0, 0.87)], [0.033 * height, 0.03 * height]);
    let head = [at(0.015, 0.0, 0.93), Vector3::z()];
    set.lump("head", head, [0.045 * height, 0.056 * height, 0.068 * height], ROUND, [0.002..=0.01, 0.04..=0.12]);
    (head[0], height)
}

/// Puts up an armchair: a seat, a back and two arms with rounded edges, and a cushion.
fn armchair(set: &mut Set, foot: Vector3<f64>) {
    let heading = set.draws.heading();
    let across = Vector3::z().cross(&heading);
    let at = |along: f64, aside: f64, up: f64| foot + heading * along + across * aside + Vector3::z() * up;
    let round = set.draws.count(1..=3) as u32;
    let mut part = |name: &str, center: Vector3<f64>, [length, width, height]: [f64; 3]| {
        let axes = Matrix3::from_columns(&[Vector3::z(), heading, across]);
        let half = Vector3::new(0.5 * height, 0.5 * length, 0.5 * width);
        let creases = Default::default();
        set.add(name, Shape::Lump(Lump { center, axes, half, squareness: [round, 3], creases }));
    };
    part("seat", at(0.0, 0.0, 0.25), [0.6, 0.6, 0.36]);
    part("chair back", at(-0.32, 0.0, 0.5), [0.22, 0.7, 0.75]);
    for side in [-1.0, 1.0] {
        part("chair arm", at(0.0, 0.36 * side, 0.35), [0.62, 0.17, 0.5]);
    }
    if set.draws.chance(0.6) {
        let leaning = heading + Vector3::z() * set.draws.within(0.2..=0.8);
        let cushion = [at(-0.1, set.draws.within(-0.1..=0.1), 0.58), leaning];
        set.lump("cushion", cushion, [0.2, 0.2, 0.08], CUSHION, [0.003..=0.015, 0.1..=0.3]);
    }
}

/// A bag of cloth or leather, or a sack.
fn bag(set: &mut Set, foot: Vector3<f64>) {
    let half = [set.draws.within(0.15..=0.22), set.draws.within(0.08..=0.14), set.draws.within(0.12..=0.24)];
    let leaning = Vector3::z() + set.draws.heading() * set.draws.within(0.0..=0.3);
    let square = if set.draws.chance(0.5) { BAG } else { CUSHION };
    set.lump("bag", [foot + Vector3::z() * half[2], leaning], half, square, [0.008..=0.03, 0.08..=0.3]);
}

/// Leaves above a pot.
fn plant(set: &mut Set, foot: Vector3<f64>) {
    let pot = set.bucket();
    set.put(pot, foot);
    let top = foot + Vector3::z() * pot.height();
    for _ in 0..set.draws.count(10..=25) {
        let (reach, rise) = (set.draws.within(0.02..=0.25), set.draws.within(0.05..=0.6));
        let center = top + set.draws.heading() * reach + Vector3::z() * rise;
        let along = set.draws.heading() + Vector3::z() * set.draws.within(-0.5..=1.0);
        let half = [set.draws.within(0.02..=0.05), 0.004, set.draws.within(0.04..=0.11)];
        set.lump("leaf", [center, along], half, ROUND, [0.0..=0.001, 0.05..=0.1]);
    }
}

/// A bottle for soap or sauce: its body is oval, its neck and cap are round.
fn oval_bottle(set: &mut Set, foot: Vector3<f64>) {
    let (wide, height) = (set.draws.within(0.035..=0.055), set.draws.within(0.16..=0.28));
    let half = [wide, wide * set.draws.within(0.5..=0.8), 0.4 * height];
    set.lump("oval bottle", [foot + Vector3::z() * half[2], Vector3::z()], half, OVAL, [0.0..=0.001, 0.1..=0.2]);
    let cap = [0.78, 1.0].map(|share| foot + Vector3::z() * (share * height));
    bar(set, "cap", cap, [0.3 * wide, 0.27 * wide]);
}

/// A carton or a canister of milk: a box with rounded edges.
fn carton(set: &mut Set, foot: Vector3<f64>) {
    let half = [set.draws.within(0.03..=0.05), set.draws.within(0.03..=0.07), set.draws.within(0.08..=0.14)];
    let square = if set.draws.chance(0.5) { BOXY } else { [2, 3] };
    set.lump("carton", [foot + Vector3::z() * half[2], Vector3::z()], half, square, [0.0..=0.002, 0.05..=0.2]);
    if set.draws.chance(0.4) {
        knob(set, "cap", foot + Vector3::z() * (2.0 * half[2]), 0.016);
    }
}

/// A pear, a potato, an egg: elongated, or flattened.
fn fruit(set: &mut Set, foot: Vector3<f64>) {
    let wide = set.draws.within(0.025..=0.05);
    let long = if set.draws.chance(0.7) { set.draws.within(1.2..=1.7) } else { set.draws.within(0.65..=0.85) };
    let half = [wide, wide * set.draws.within(0.85..=1.0), wide * long];
    let along = set.draws.heading() + Vector3::z() * set.draws.within(0.0..=1.5);
    set.lump("fruit", [foot + Vector3::z() * wide, along], half, ROUND, [0.0..=0.003, 0.03..=0.1]);
}

/// A towel or a jacket, thrown down.
fn cloth(set: &mut Set, foot: Vector3<f64>) {
    let half = [set.draws.within(0.08..=0.16), set.draws.within(0.06..=0.12), set.draws.within(0.02..=0.06)];
    let square = if set.draws.chance(0.5) { ROUND } else { CUSHION };
    set.lump("cloth", [foot + Vector3::z() * (0.8 * half[2]), Vector3::z()], half, square, [0.008..=0.03, 0.05..=0.15]);
}

/// Paper crumpled into a ball.
fn paper(set: &mut Set, foot: Vector3<f64>) {
    let size = set.draws.within(0.025..=0.05);
    let half = [size, size * set.draws.within(0.75..=1.0), size * set.draws.within(0.75..=1.0)];
    set.lump("paper", [foot + Vector3::z() * (0.9 * size), Vector3::z()], half, ROUND, [0.006..=0.014, 0.025..=0.07]);
}
