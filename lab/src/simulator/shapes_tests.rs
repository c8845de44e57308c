use super::super::pose::from_quaternion;
use super::*;
use nalgebra::Matrix3;

const ORIGIN: Vector3<f64> = Vector3::new(0.0, 0.0, 0.0);

fn close(hit: f64, expected: f64) -> bool {
    (hit - expected).abs() < 1e-12
}

fn upright_can() -> Frustum {
    let base = Vector3::new(0.0, 0.5, 2.0);
    Frustum { base, axis: -Vector3::y(), length: 1.0, base_radius: 0.2, top_radius: 0.2, open: false }
}

#[test]
fn a_sphere_is_met_in_front_off_axis_and_from_inside() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 2.0), radius: 0.5 };
    assert!(close(sphere.hit(&ORIGIN, &Vector3::z()), 1.5));
    let slanted = Vector3::new(0.2, 0.0, 1.0);
    // (1 + 0.04) t^2 - 4 t + 3.75 = 0
    assert!(close(sphere.hit(&ORIGIN, &slanted), (4.0 - (16.0_f64 - 15.0 * 1.04).sqrt()) / 2.08));
    assert!(sphere.hit(&ORIGIN, &Vector3::new(0.3, 0.0, 1.0)).is_infinite());
    assert!(close(sphere.hit(&sphere.center, &Vector3::x()), 0.5));
    assert!(sphere.hit(&Vector3::new(0.0, 0.0, 4.0), &Vector3::z()).is_infinite(), "it lies behind");
}

#[test]
fn a_cylinder_is_met_on_its_side_and_on_its_cap() {
    let can = upright_can();
    assert!(close(can.hit(&ORIGIN, &Vector3::z()), 1.8));
    let x = 0.05;
    let z = (4.0 - (16.0_f64 - 4.0 * (1.0 + x * x) * 3.96).sqrt()) / (2.0 * (1.0 + x * x));
    assert!(close(can.hit(&ORIGIN, &Vector3::new(x, 0.1, 1.0)), z));
    let above = Vector3::new(0.0, -1.5, 0.0);
    // down by one metre while z goes to 2: the cap at y = -0.5
    assert!(close(can.hit(&above, &Vector3::new(0.0, 0.5, 1.0)), 2.0));
    assert!(can.hit(&ORIGIN, &Vector3::new(0.0, 0.4, 1.0)).is_infinite(), "it passes below");
    assert!(close(can.hit(&Vector3::new(0.1, -2.0, 2.0), &Vector3::y()), 1.5), "along the axis");
    assert!(can.hit(&Vector3::new(0.3, -2.0, 2.0), &Vector3::y()).is_infinite());
}

#[test]
fn a_cone_is_met_where_its_radius_says() {
    let cone = Frustum { base_radius: 0.4, top_radius: 0.0, ..upright_can() };
    assert!(close(cone.hit(&ORIGIN, &Vector3::z()), 1.8), "half way up the radius is 0.2");
    assert!(close(cone.hit(&Vector3::new(0.0, 0.25, 0.0), &Vector3::z()), 1.7));
    assert!(
        cone.hit(&Vector3::new(0.0, -0.51, 0.0), &Vector3::z()).is_infinite(),
        "not its mirror image above the tip"
    );
    assert!(close(cone.hit(&Vector3::new(0.0, -2.0, 2.0), &Vector3::y()), 1.5), "straight on the tip");
    assert!(close(cone.hit(&Vector3::new(0.1, 2.0, 2.0), &-Vector3::y()), 1.5), "on its base from below");
    let blunt = Frustum { top_radius: 0.1, ..cone };
    assert!(close(blunt.hit(&Vector3::new(0.05, -2.0, 2.0), &Vector3::y()), 1.5), "on its blunt end");
    assert!(close(blunt.hit(&ORIGIN, &Vector3::z()), 1.75));
    let along_its_side = Vector3::new(0.0, 1.0, -0.4);
    assert!(
        close(cone.hit(&Vector3::new(0.0, 0.0, 2.1), &along_its_side), 0.5),
        "parallel to the far side, on the base"
    );
}

#[test]
fn a_turned_box_is_met_on_its_edge() {
    let axes = from_quaternion([0.0, 0.382_683_432_365_089_8, 0.0, 0.923_879_532_511_286_7]);
    let block = Block { center: Vector3::new(0.0, 0.0, 2.0), axes, half: Vector3::new(0.5, 0.25, 0.5) };
    assert!(close(block.hit(&ORIGIN, &Vector3::z()), 2.0 - 0.5_f64.sqrt()));
    assert!(close(block.hit(&Vector3::new(0.1, 0.0, 0.0), &Vector3::z()), 2.1 - 0.5_f64.sqrt()));
    assert!(block.hit(&Vector3::new(0.0, 0.26, 0.0), &Vector3::z()).is_infinite());
    assert!(close(block.hit(&block.center, &Vector3::y()), 0.25), "from inside");
}

#[test]
fn a_rectangle_ends_and_a_plane_does_not() {
    let sides = [Vector3::x(), Vector3::new(0.0, 0.6, 0.8)];
    let normal = Vector3::new(0.0, -0.8, 0.6);
    let plane = Plane { point: Vector3::new(0.0, 0.0, 2.0), normal, sides, half: [f64::INFINITY; 2] };
    let ray = Vector3::new(0.0, 0.3, 1.0);
    assert!(close(plane.hit(&ORIGIN, &ray), 1.2 / (0.6 - 0.24)));
    let rectangle = Plane { half: [0.5, 0.5], ..plane };
    assert!(rectangle.hit(&ORIGIN, &ray).is_infinite());
    assert!(close(rectangle.hit(&ORIGIN, &Vector3::new(0.2, 0.0, 1.0)), 2.0));
    assert!(plane.hit(&ORIGIN, &Vector3::new(0.0, 0.75, 1.0)).is_infinite(), "parallel");
    assert_eq!(plane.bounds(), None);
}

/// All shapes, in positions without symmetry.
fn zoo() -> Vec<Shape> {
    let turn = Pose {
        rotation: from_quaternion([0.1, 0.3, 0.2, 0.927_361_849_549_570_4]),
        translation: Vector3::new(0.1, -0.2, 0.3),
    };
    let sphere = Shape::Sphere(Sphere { center: Vector3::new(0.1, 0.2, 2.0), radius: 0.3 });
    let can = Shape::Frustum(upright_can());
    let cone = Shape::Frustum(Frustum { base_radius: 0.4, top_radius: 0.05, ..upright_can() });
    let half = Vector3::new(0.3, 0.2, 0.4);
    let block = Shape::Block(Block { center: Vector3::new(0.0, 0.0, 2.0), axes: Matrix3::identity(), half });
    let sides = [Vector3::x(), Vector3::y()];
    let point = Vector3::new(0.0, 0.0, 2.0);
    let plane = Shape::Plane(Plane { point, normal: -Vector3::z(), sides, half: [0.4, 0.3] });
    [sphere, can, cone, block, plane].map(|shape| shape.transformed(&turn)).to_vec()
}

/// The normal is the gradient: of two points near the surface, the ray meets the outer one first.
#[test]
fn normals_are_orthogonal_to_the_surface() {
    for shape in zoo() {
        let mut met = 0;
        let [least, most] = shape.bounds().unwrap();
        let middle = (least + most) / (least.z + most.z);
        for (x, y) in (-20..20).flat_map(|x| (-20..20).map(move |y| (f64::from(x) * 0.02, f64::from(y) * 0.02))) {
            let at = |x: f64, y: f64| {
                let ray = Vector3::new(x, y, 1.0);
                Some(shape.hit(&ORIGIN, &ray)).filter(|t| t.is_finite()).map(|t| ray * t)
            };
            let step = 1e-6;
            let (x, y) = (middle.x + x, middle.y + y);
            let (Some(here), Some(right), Some(below)) = (at(x, y), at(x + step, y), at(x, y + step)) else { continue };
            let across = (right - here).cross(&(below - here)).normalize();
            let normal = shape.normal(&here);
            assert!((normal.norm() - 1.0).abs() < 1e-9);
            assert!((across.dot(&normal).abs() - 1.0).abs() < 1e-3, "{shape:?} at {here:?}: {normal:?}");
            met += 1;
        }
        assert!(met > 50, "{shape:?} was met {met} times");
    }
}

#[test]
fn bounds_hold_every_point_and_are_tight() {
    for shape in zoo() {
        let [least, most] = shape.bounds().unwrap();
        let mut seen = [Vector3::repeat(f64::INFINITY), Vector3::repeat(f64::NEG_INFINITY)];
        // from all six sides
        for (axis, sign) in (0..3).flat_map(|axis| [(axis, 1.0), (axis, -1.0)]) {
            let mut direction = Vector3::zeros();
            direction[axis] = sign;
            for (i, j) in (0..200).flat_map(|i| (0..200).map(move |j| (f64::from(i) / 199.0, f64::from(j) / 199.0))) {
                let mut from = least - direction * 5.0;
                let (p, q) = ((axis + 1) % 3, (axis + 2) % 3);
                from[axis] = -5.0 * sign;
                from[p] = (1.2 * i - 0.1) * (most[p] - least[p]) + least[p];
                from[q] = (1.2 * j - 0.1) * (most[q] - least[q]) + least[q];
                let t = shape.hit(&from, &direction);
                if t.is_infinite() {
                    continue;
                }
                let point = from + direction * t;
                seen = [seen[0].inf(&point), seen[1].sup(&point)];
            }
        }
        assert!((seen[0] - least).min() > -1e-9 && (most - seen[1]).min() > -1e-9, "{shape:?}");
        assert!((seen[0] - least).amax() < 0.02 && (most - seen[1]).amax() < 0.02, "{shape:?}");
    }
}

#[test]
fn the_lowest_point_is_the_one_of_the_bounds() {
    for shape in zoo() {
        let below = shape.anchor().y - shape.bounds().unwrap()[0].y;
        assert!((shape.reach_below(&Vector3::y()) - below).abs() < 1e-9, "{shape:?}");
    }
}

#[test]
fn a_cup_shows_its_inside_through_its_open_end_only() {
    let cup = Frustum { open: true, ..upright_can() };
    let top = cup.base + cup.axis * cup.length;
    let down = -cup.axis;
    let above = top + cup.axis * 0.5 + Vector3::x() * 0.05;
    assert!((upright_can().hit(&above, &down) - 0.5).abs() < 1e-12, "a can has a lid");
    assert!((cup.hit(&above, &down) - 1.5).abs() < 1e-12, "a cup shows its bottom");
    let below = cup.base - cup.axis * 0.5;
    assert!((cup.hit(&below, &cup.axis) - 0.5).abs() < 1e-12, "and is closed from below");
    let slanted = (Vector3::x() - cup.axis).normalize();
    let wall = top + slanted * cup.hit(&top, &slanted);
    let radius = (wall - cup.base - cup.axis * cup.along(&wall)).norm();
    assert!((radius - 0.2).abs() < 1e-12 && cup.along(&wall) > 0.0);
    assert!(cup.normal(&wall).dot(&slanted) > 0.0, "the normal points outwards, also on the inside");
}

#[test]
fn a_bowl_is_a_sphere_without_what_is_above_its_rim() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 2.0), radius: 0.1 };
    let bowl = Bowl { sphere, axis: -Vector3::y(), depth: 0.06 };
    let ray = |y: f64| bowl.hit(&Vector3::new(0.0, y, 0.0), &Vector3::z());
    let rim = 0.1 - 0.06; // below the centre; y points down
    let height = |y: f64| (0.01 - y * y).sqrt();
    assert!((ray(rim + 0.001) - (2.0 - height(rim + 0.001))).abs() < 1e-12, "the outside");
    assert_eq!(ray(rim - 0.001), f64::INFINITY, "above the rim there is nothing");
    let from_above = bowl.hit(&Vector3::new(0.0, -1.0, 2.0), &Vector3::y());
    assert!((from_above - 1.1).abs() < 1e-12, "the inside of its bottom");
}
