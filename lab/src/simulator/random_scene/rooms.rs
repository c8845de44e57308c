//! Realistic rooms: furniture of slats and bars, people of nearly round parts, cups with handles, bottles of glass, curved walls.
//! Round things that belong to something else are parts, which need not be found.

use super::super::scene::Role;
use super::super::shapes::{Frustum, Shape, Sphere};
use super::set::Set;
use super::things::Thing;
use nalgebra::Vector3;

pub fn furnished(set: &mut Set) {
    for _ in 0..set.draws.count(0..=2) {
        let thing = set.large_thing();
        set.stand(thing, 1.1..=2.6, 0.0, 0.05);
    }
    for _ in 0..set.draws.count(1..=2) {
        if let Some(foot) = set.place(&(1.2..=2.8), 0.0, 0.32, 0.05) {
            chair(set, foot);
        }
    }
    if set.draws.chance(0.5)
        && let Some(foot) = set.place(&(1.8..=3.2), 0.0, 0.35, 0.05)
    {
        person(set, foot);
    }
    if set.draws.chance(0.5)
        && let Some(foot) = set.place(&(1.0..=2.8), 0.0, 0.1, 0.05)
    {
        let (side, height) = (set.draws.within(0.06..=0.14), set.draws.within(0.5..=2.0));
        let heading = set.draws.heading();
        let rounding = set.draws.within(0.1..=0.35);
        rounded_post(set, foot, heading, [side, side, height], rounding * side);
    }
    let wall = set.draws.within(3.2..=4.2);
    if set.draws.chance(0.6) {
        cupboard(set, wall - 0.1);
    }
    set.room(wall);
    if set.draws.chance(0.3) {
        curved_wall(set, wall);
    }
    set.look_at_things(0.4);
}

/// Adds a bar as a part of something.
pub fn bar(set: &mut Set, name: &str, [from, to]: [Vector3<f64>; 2], radii: [f64; 2]) {
    let length = (to - from).norm();
    let [base_radius, top_radius] = radii;
    let axis = (to - from) / length;
    let shape = Frustum { base: from, axis, length, base_radius, top_radius, open: false };
    set.add_as(Role::Part, name, Shape::Frustum(shape));
}

pub fn knob(set: &mut Set, name: &str, center: Vector3<f64>, radius: f64) {
    set.add_as(Role::Part, name, Shape::Sphere(Sphere { center, radius }));
}

/// Adds a chair: a seat on four legs, square or round, with a back of slats between two posts.
fn chair(set: &mut Set, foot: Vector3<f64>) {
    let heading = set.draws.heading();
    let across = Vector3::z().cross(&heading);
    let (half, seat) = (set.draws.within(0.17..=0.22), set.draws.within(0.4..=0.48));
    let (radius, round) = (set.draws.within(0.011..=0.02), set.draws.chance(0.5));
    let back = seat + set.draws.within(0.35..=0.5);
    for (i, j) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let place = foot + heading * (i * (half - radius)) + across * (j * (half - radius));
        let top = if i < 0.0 { back } else { seat };
        if round {
            bar(set, "chair leg", [place, place + Vector3::z() * top], [radius; 2]);
        } else {
            set.block("chair leg", place, heading, Vector3::new(2.0 * radius, 2.0 * radius, top));
        }
    }
    set.block("seat", foot + Vector3::z() * (seat - 0.03), heading, Vector3::new(2.0 * half, 2.0 * half, 0.03));
    let slats = set.draws.count(2..=5);
    let width = 0.7 * (back - seat) / slats as f64;
    for slat in 0..slats {
        let height = seat + (slat as f64 + 0.3) * (back - seat) / slats as f64;
        let place = foot - heading * (half - radius) + Vector3::z() * height;
        set.block("slat", place, heading, Vector3::new(0.015, 2.0 * half, width));
    }
}

/// Adds a cupboard at the wall: doors and drawers with bars as handles.
fn cupboard(set: &mut Set, distance: f64) {
    let (width, height, depth) = (set.draws.within(0.8..=1.8), set.draws.within(0.7..=2.0), 0.4);
    let x = set.draws.within(-0.8..=0.8);
    let foot = Vector3::new(x, distance - 0.5 * depth, 0.0);
    set.block("cupboard", foot, Vector3::x(), Vector3::new(width, depth, height));
    let (columns, rows) = (set.draws.count(1..=3), set.draws.count(1..=4));
    let radius = set.draws.within(0.005..=0.012);
    for (i, j) in (0..columns).flat_map(|i| (0..rows).map(move |j| (i, j))) {
        let across = ((i as f64 + 0.5) / columns as f64 - 0.5) * width;
        let level = (j as f64 + 0.6) / rows as f64 * height;
        let middle = Vector3::new(x + across, distance - depth - 0.035, level);
        let reach = Vector3::x() * (0.25 * width / columns as f64).min(0.09);
        bar(set, "handle", [middle - reach, middle + reach], [radius; 2]);
        for side in [-0.8, 0.8] {
            let end = middle + reach * side;
            bar(set, "handle", [end, end + Vector3::y() * 0.035], [radius; 2]);
        }
    }
}

/// Adds a box with rounded vertical edges.
fn rounded_post(set: &mut Set, foot: Vector3<f64>, heading: Vector3<f64>, size: [f64; 3], rounding: f64) {
    let across = Vector3::z().cross(&heading);
    let [length, width, height] = size;
    set.block("post", foot, heading, Vector3::new(length - 2.0 * rounding, width, height));
    set.block("post", foot, heading, Vector3::new(length, width - 2.0 * rounding, height));
    for (i, j) in [(-1.0, -1.0), (-1.0, 1.0), (1.0, -1.0), (1.0, 1.0)] {
        let place = foot + heading * (i * (0.5 * length - rounding)) + across * (j * (0.5 * width - rounding));
        bar(set, "post edge", [place, place + Vector3::z() * height], [rounding; 2]);
    }
}

/// Adds a standing person: legs and arms of tapered bars, a trunk with rounded edges, a head.
fn person(set: &mut Set, foot: Vector3<f64>) {
    let heading = set.draws.heading();
    let across = Vector3::z().cross(&heading);
    let height = set.draws.within(1.5..=1.9);
    let at = |along: f64, aside: f64, up: f64| foot + (heading * along + across * aside + Vector3::z() * up) * height;
    for side in [-1.0, 1.0] {
        let stride = side * set.draws.within(-0.06..=0.06);
        let (ankle, knee, hip) =
            (at(stride, 0.06 * side, 0.0), at(0.5 * stride, 0.06 * side, 0.28), at(0.0, 0.05 * side, 0.5));
        bar(set, "calf", [ankle, knee], [0.026 * height, 0.033 * height]);
        bar(set, "thigh", [knee, hip], [0.035 * height, 0.047 * height]);
        let (swing, out) = (set.draws.within(-0.1..=0.2), set.draws.within(0.0..=0.1));
        let shoulder = at(0.0, 0.125 * side, 0.79);
        let elbow = at(0.3 * swing, (0.13 + out) * side, 0.62);
        let hand = at(swing, (0.12 + out) * side, 0.47 + 0.5 * swing.abs());
        bar(set, "upper arm", [elbow, shoulder], [0.024 * height, 0.029 * height]);
        bar(set, "forearm", [hand, elbow], [0.017 * height, 0.024 * height]);
    }
    let trunk = [0.12 * height, 0.22 * height, 0.33 * height];
    rounded_post(set, at(0.0, 0.0, 0.48), heading, trunk, 0.05 * height);
    bar(set, "neck", [at(0.0, 0.0, 0.8), at(0.0, 0.0, 0.87)], [0.03 * height; 2]);
    knob(set, "head", at(0.01, 0.0, 0.93), 0.058 * height);
}

/// Adds a concave or convex wall, about as far away as the flat one.
fn curved_wall(set: &mut Set, distance: f64) {
    let radius = set.draws.within(1.5..=3.0);
    let bulges = set.draws.chance(0.5);
    let nearest = distance - set.draws.within(0.1..=0.4);
    let y = if bulges { nearest + radius } else { nearest.max(radius + 0.2) - radius };
    let base = Vector3::new(set.draws.within(-1.5..=1.5), y, -0.1);
    let shape = Frustum { base, axis: Vector3::z(), length: 5.0, base_radius: radius, top_radius: radius, open: false };
    set.add_as(Role::Part, "curved wall", Shape::Frustum(shape));
}

pub fn kitchen(set: &mut Set) {
    let top = set.table();
    for _ in 0..set.draws.count(2..=5) {
        match set.draws.count(0..=5) {
            0 | 1 => cup_with_handle(set, top),
            2 => bottle(set, top),
            3 => bowl(set, top),
            4 => {
                let tin = set.tin();
                set.stand(tin, 0.6..=1.15, top, 0.02);
            }
            _ => {
                set.random_block(0.65, 1.2, top, 0.25);
            }
        }
    }
    set.enclose(1.8..=3.5, 0.04);
}

/// Adds a mug or cup with a bent bar as handle and a dark inside: there is no depth below its rim.
fn cup_with_handle(set: &mut Set, top: f64) {
    let cup = if set.draws.chance(0.6) { set.mug() } else { set.cup() };
    let Thing::Round { base_radius, top_radius, length, .. } = cup else { return };
    let Some(foot) = set.place(&(0.6..=1.15), top, cup.reach() + 0.03, 0.01) else { return };
    set.put(cup, foot);
    if set.draws.chance(0.7) {
        let level = set.draws.within(0.3..=0.9) * length;
        let radius = base_radius + (top_radius - base_radius) * level / length - 0.001;
        let base = foot + Vector3::z() * level;
        let dark =
            Frustum { base, axis: Vector3::z(), length: 1e-3, base_radius: radius, top_radius: radius, open: false };
        set.add_as(Role::Glass, "dark inside", Shape::Frustum(dark));
    }
    let heading = set.draws.heading();
    let reach = set.draws.within(0.022..=0.035);
    let at = |out: f64, share: f64| {
        let radius = base_radius + (top_radius - base_radius) * share;
        foot + heading * (radius + out) + Vector3::z() * (share * length)
    };
    let bends =
        [at(0.0, 0.85), at(0.8 * reach, 0.85), at(reach, 0.65), at(reach, 0.4), at(0.6 * reach, 0.2), at(0.0, 0.15)];
    for ends in bends.windows(2) {
        bar(set, "handle", [ends[0], ends[1]], [0.006; 2]);
    }
}

/// Adds a bottle of glass, of which only label and cap are visible.
fn bottle(set: &mut Set, top: f64) {
    let (radius, height) = (set.draws.within(0.03..=0.045), set.draws.within(0.22..=0.32));
    let Some(foot) = set.place(&(0.65..=1.15), top, radius, 0.02) else { return };
    let up = |share: f64| foot + Vector3::z() * (share * height);
    let round = |from: f64, to: f64, radii: [f64; 2]| Frustum {
        base: up(from),
        axis: Vector3::z(),
        length: (to - from) * height,
        base_radius: radii[0],
        top_radius: radii[1],
        open: false,
    };
    set.add_as(Role::Glass, "glass", Shape::Frustum(round(0.0, 0.62, [radius; 2])));
    set.add_as(Role::Glass, "glass neck", Shape::Frustum(round(0.62, 0.8, [radius, 0.4 * radius])));
    set.add_as(Role::Glass, "glass neck", Shape::Frustum(round(0.8, 0.92, [0.4 * radius; 2])));
    let label = [set.draws.within(0.1..=0.2), set.draws.within(0.4..=0.58)];
    set.add("label", Shape::Frustum(round(label[0], label[1], [radius + 5e-4; 2])));
    set.add_as(Role::Part, "cap", Shape::Frustum(round(0.92, 1.0, [0.45 * radius; 2])));
}

/// Adds a bowl, upright or upturned.
fn bowl(set: &mut Set, top: f64) {
    let radius = set.draws.within(0.06..=0.12);
    let Some(foot) = set.place(&(0.65..=1.1), top, radius, 0.02) else { return };
    set.bowl(foot, radius);
}
