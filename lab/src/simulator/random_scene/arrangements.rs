//! Arranges the things of each group.

use super::set::Set;
use super::things::Thing;
use nalgebra::Vector3;

const FLOOR: f64 = 0.0;

pub fn standing(set: &mut Set) {
    for _ in 0..set.draws.count(1..=4) {
        let thing = set.large_thing();
        let Some(foot) = set.place(&(1.0..=3.0), FLOOR, thing.reach(), 0.05) else { continue };
        let lift = if set.draws.chance(0.15) { plinth(set, foot, thing.reach()) } else { 0.0 };
        set.put(thing, foot + Vector3::z() * lift);
    }
    set.enclose(3.2..=4.2, 0.3);
}

/// Puts a flat box under a thing, and returns its height.
fn plinth(set: &mut Set, foot: Vector3<f64>, reach: f64) -> f64 {
    let (side, height) = (reach * set.draws.within(2.1..=2.6), set.draws.within(0.02..=0.3));
    let heading = set.draws.heading();
    set.block("plinth", foot, heading, Vector3::new(side, side, height));
    height
}

pub fn tilted(set: &mut Set) {
    for _ in 0..set.draws.count(1..=2) {
        let thing = if set.draws.chance(0.5) { set.can() } else { set.cone() };
        let half = 0.5 * thing.height();
        let level = set.draws.within(0.5..=1.0);
        let Some(middle) = set.place(&(1.1..=3.0), level, half, 0.1) else { continue };
        let axis = leaning(set);
        set.put_along(thing, middle - axis * half, axis);
    }
    let wall = set.draws.within(3.6..=4.4);
    set.room(wall);
    set.camera.z = set.draws.within(0.5..=1.2);
    set.look_at_things(0.0);
}

/// Draws an upright direction that leans by 10 to 60 degrees: to a side, towards the camera, away from it, or in any direction.
fn leaning(set: &mut Set) -> Vector3<f64> {
    let tilt = set.draws.within(10.0..=60.0_f64).to_radians();
    let level = match set.draws.count(0..=3) {
        0 => Vector3::x() * set.draws.sign(),
        1 => -Vector3::y(),
        2 => Vector3::y(),
        _ => set.draws.heading(),
    };
    Vector3::z() * libm::cos(tilt) + level * libm::sin(tilt)
}

pub fn occluded(set: &mut Set) {
    for _ in 0..set.draws.count(1..=2) {
        let thing = set.large_thing();
        let Some(foot) = set.place(&(1.2..=3.0), FLOOR, thing.reach() + 0.15, 0.1) else { continue };
        set.put(thing, foot);
        hide(set, thing, foot);
    }
    set.enclose(3.4..=4.2, 0.3);
}

/// Hides 10 to 70 % of a thing: from the left or right by a box or a board, from below by a box; or up to 40 % along its middle
/// by a post.
fn hide(set: &mut Set, thing: Thing, foot: Vector3<f64>) {
    let share = set.draws.within(0.1..=0.7);
    let nearness = set.draws.within(0.55..=0.85); // of the way from the camera to the thing
    let flat = Vector3::new(foot.x, foot.y, 0.0).normalize();
    let across = Vector3::new(flat.y, -flat.x, 0.0);
    let thickness = if set.draws.chance(0.5) { 0.01 } else { set.draws.within(0.05..=0.25) };
    match set.draws.count(0..=5) {
        0 | 1 => {
            // the ray over the box's edge meets the thing at this height
            let height = share * thing.height();
            let edge = set.camera + (foot + Vector3::z() * height - set.camera) * nearness;
            let size = Vector3::new(4.0 * thing.reach(), thickness, edge.z.max(0.02));
            set.block("low box", Vector3::new(edge.x, edge.y, 0.0), across, size);
        }
        2 => {
            let width = nearness * 2.0 * thing.reach() * share.min(0.4);
            let place = foot * nearness + across * (set.draws.within(-0.5..=0.5) * thing.reach() * nearness);
            set.block("post", place, across, Vector3::new(width, width, 2.0));
        }
        _ => {
            let side = set.draws.sign();
            let edge = foot * nearness + across * (side * nearness * thing.reach() * (1.0 - 2.0 * share));
            let width = set.draws.within(0.2..=0.5);
            let height = nearness * thing.height() + set.camera.z;
            let center = edge + across * (side * 0.5 * width);
            set.block("screen", center, across, Vector3::new(width, thickness, height));
        }
    }
}

pub fn tabletop(set: &mut Set) {
    let top = set.table();
    for _ in 0..set.draws.count(2..=5) {
        let thing = set.small_thing();
        let Some(foot) = set.stand(thing, 0.65..=1.15, top, 0.01) else { continue };
        if matches!(thing, Thing::Round { name: "mug", .. }) && set.draws.chance(0.6) {
            handle(set, thing, foot);
        }
    }
    if set.draws.chance(0.6) {
        set.random_block(0.7, 1.2, top, 0.2);
    }
    set.enclose(1.8..=3.5, 0.04);
}

/// A flat handle at the side of a mug.
fn handle(set: &mut Set, mug: Thing, foot: Vector3<f64>) {
    let heading = set.draws.heading();
    let size = Vector3::new(0.03, 0.012, 0.6 * mug.height());
    let lift = Vector3::z() * (0.2 * mug.height());
    set.block("handle", foot + heading * (mug.reach() + 0.5 * size.x) + lift, heading, size);
}

pub fn lying(set: &mut Set) {
    let on_table = set.draws.chance(0.4);
    let level = if on_table { set.table() } else { FLOOR };
    for _ in 0..set.draws.count(1..=3) {
        let thing = if on_table { set.tin() } else { lying_thing(set) };
        let near = if on_table { 0.7..=1.1 } else { 1.2..=2.8 };
        let Some(middle) = set.place(&near, level, 0.5 * thing.height(), 0.05) else { continue };
        lay(set, thing, middle);
    }
    set.enclose(3.2..=4.2, 0.1);
}

fn lying_thing(set: &mut Set) -> Thing {
    match set.draws.count(0..=4) {
        0 => set.cone(),
        1 | 2 => set.can(),
        _ => {
            let (radius, length) = (set.draws.within(0.04..=0.12), set.draws.within(0.5..=1.2));
            Thing::Round { name: "pipe", base_radius: radius, top_radius: radius, length, open: false }
        }
    }
}

/// Lays a thing on its side, with any heading: the lowest line of its side touches the ground.
fn lay(set: &mut Set, thing: Thing, middle: Vector3<f64>) {
    let heading = set.draws.heading();
    let Thing::Round { base_radius, top_radius, length, .. } = thing else { return };
    let droop = libm::atan((base_radius - top_radius) / length);
    let axis = heading * libm::cos(droop) - Vector3::z() * libm::sin(droop);
    let base = middle - heading * (0.5 * length) + Vector3::z() * (base_radius * libm::cos(droop));
    set.put_along(thing, base, axis);
}

pub fn composed(set: &mut Set) {
    for _ in 0..set.draws.count(1..=2) {
        let lower = match set.draws.count(0..=3) {
            0 | 1 => Some(set.can()),
            2 => Some(set.bucket()),
            _ => None,
        };
        let reach = lower.map_or(0.25, Thing::reach);
        let Some(foot) = set.place(&(1.1..=2.8), FLOOR, reach, 0.1) else { continue };
        let height = match lower {
            Some(lower) => {
                set.put(closed(lower), foot);
                lower.height()
            }
            None => crate_under(set, foot),
        };
        let upper = upper_thing(set, reach);
        set.put(upper, foot + Vector3::z() * height);
    }
    set.enclose(3.2..=4.2, 0.45);
}

/// Returns the thing with a lid, so that something can stand on it.
fn closed(thing: Thing) -> Thing {
    match thing {
        Thing::Round { name, base_radius, top_radius, length, .. } => {
            Thing::Round { name, base_radius, top_radius, length, open: false }
        }
        ball @ Thing::Ball { .. } => ball,
    }
}

/// Puts a box under something, and returns its height.
fn crate_under(set: &mut Set, foot: Vector3<f64>) -> f64 {
    let size = Vector3::new(0.4, set.draws.within(0.25..=0.5), set.draws.within(0.2..=0.6));
    let heading = set.draws.heading();
    set.block("crate", foot, heading, size);
    size.z
}

/// Draws a thing that stands on another one of this radius: a ball, a cone or a narrower can.
fn upper_thing(set: &mut Set, reach: f64) -> Thing {
    let radius = reach * set.draws.within(0.5..=1.0);
    match set.draws.count(0..=3) {
        0 | 1 => Thing::Ball { name: "ball on top", radius },
        2 => {
            let length = radius * set.draws.within(2.0..=3.0);
            Thing::Round { name: "cone on top", base_radius: radius, top_radius: 0.1 * radius, length, open: false }
        }
        _ => {
            let (radius, length) = (0.7 * radius, set.draws.within(0.2..=0.4));
            Thing::Round { name: "can on top", base_radius: radius, top_radius: radius, length, open: false }
        }
    }
}

pub fn clutter(set: &mut Set) {
    if set.draws.chance(0.5) {
        let distance = set.draws.within(1.6..=2.6);
        set.steps(distance);
    }
    for _ in 0..set.draws.count(0..=2) {
        let thing = set.large_thing();
        set.stand(thing, 1.1..=2.8, FLOOR, 0.02);
    }
    boxes(set);
    set.enclose(3.0..=4.2, 0.2);
}

/// Puts up boxes, some with another one on top, and boards.
fn boxes(set: &mut Set) {
    for _ in 0..set.draws.count(2..=5) {
        let Some((foot, height)) = set.random_block(1.1, 3.0, FLOOR, 0.6) else { continue };
        if set.draws.chance(0.3) {
            let heading = set.draws.heading();
            let size = Vector3::new(0.15, set.draws.within(0.1..=0.3), 0.12);
            set.block("box on top", foot + Vector3::z() * height, heading, size);
        }
    }
    for _ in 0..set.draws.count(0..=2) {
        let (y, z) = (set.draws.within(1.2..=2.8), set.draws.within(0.2..=1.0));
        let x = set.draws.within(-0.4..=0.4) * y;
        set.board(Vector3::new(x, y, z));
    }
}

pub fn bowls(set: &mut Set) {
    let top = set.table();
    for _ in 0..set.draws.count(1..=2) {
        let radius = set.draws.within(0.06..=0.13);
        let Some(foot) = set.place(&(0.7..=1.1), top, radius, 0.02) else { continue };
        set.bowl(foot, radius);
    }
    if set.draws.chance(0.7) {
        let thing = set.small_thing();
        set.stand(thing, 0.7..=1.1, top, 0.02);
    }
    set.enclose(1.8..=3.5, 0.04);
}

pub fn empty(set: &mut Set) {
    match set.draws.count(0..=3) {
        0 => {}
        1 => {
            let distance = set.draws.within(1.2..=2.4);
            set.steps(distance);
        }
        2 => boxes(set),
        _ => {
            let top = set.table();
            for _ in 0..set.draws.count(1..=5) {
                set.random_block(0.7, 1.2, top, 0.25);
            }
        }
    }
    set.enclose(1.2..=4.5, 0.2);
}

pub fn flat_tins(set: &mut Set) {
    let top = set.table();
    let (near, far) = (0.5, 0.95);
    let slope = libm::tan(set.draws.within(25.0..=45.0_f64).to_radians());
    set.camera.z = top + 0.5 * (near + far) * slope;
    for _ in 0..set.draws.count(1..=3) {
        let tin = set.flat_tin();
        set.stand(tin, near..=far, top, 0.02);
    }
    set.enclose(1.8..=3.5, 0.03);
}
