use super::*;

const GRAVITY: f64 = 9.81;

fn setting(height: f64) -> Setting {
    Setting { up: Vector3::z(), gravity: GRAVITY, anchor: Vector3::new(0.0, 0.0, height), reach_below: 0.1 }
}

fn motion(text: &str) -> Motion {
    toml::from_str::<Motion>(text).unwrap()
}

#[test]
fn a_ball_falls_as_galilei_says() {
    let fall = motion("ballistic = { velocity = [0.5, 0, 0], restitution = 0.5 }");
    let at = fall.displacement(0.3, &setting(1.1));
    assert!((at - Vector3::new(0.15, 0.0, -0.5 * GRAVITY * 0.09)).norm() < 1e-12);
}

#[test]
fn each_bounce_keeps_the_square_of_the_restitution() {
    let fall = motion("ballistic = { velocity = [0, 0, 0], restitution = 0.5 }");
    let first = (2.0 / GRAVITY).sqrt();
    let height = |t: f64| 1.0 + fall.displacement(t, &setting(1.1)).z;
    assert!(height(first).abs() < 1e-9);
    assert!((height(2.0 * first - 0.5 * first) - 0.25).abs() < 1e-9, "top of the first bounce");
    assert!(height(2.0 * first).abs() < 1e-9, "down again");
    assert!((height(2.25 * first) - 0.0625).abs() < 1e-9, "top of the second bounce");
    assert!((0..2000).all(|i| height(f64::from(i) * 0.01) >= -1e-12));
    assert_eq!(height(1e6), 0.0, "it rests in the end");
}

#[test]
fn without_loss_it_bounces_for_ever() {
    let fall = motion("ballistic = { velocity = [0, 0, 0], restitution = 1.0 }");
    let period = 2.0 * (2.0 / GRAVITY).sqrt();
    for bounces in [1.0, 17.0, 10_000.0] {
        assert!(fall.displacement(bounces * period, &setting(1.1)).norm() < 1e-6);
    }
}

#[test]
fn between_two_points_it_turns_back() {
    let text = "ballistic = { velocity = [1, 0, 0], restitution = 1.0, between = [[-0.5, 0, 0], [1.5, 0, 3]] }";
    let fall = motion(text);
    for (time, x) in [(1.0, 1.0), (1.5, 1.5), (2.0, 1.0), (3.5, -0.5), (4.0, 0.0), (5.0, 1.0)] {
        assert!((fall.displacement(time, &setting(1.1)).x - x).abs() < 1e-12, "{time}");
    }
}

#[test]
fn a_start_below_the_floor_or_outside_is_refused() {
    let below = motion("ballistic = { velocity = [0, 0, 0], floor_m = 1.2 }");
    assert_eq!(below.fault(&setting(1.0)).unwrap(), "it starts 0.300 m below its floor (`floor_m`)");
    let outside = motion("ballistic = { velocity = [0, 0, 0], between = [[1, 0, 0], [2, 0, 0]] }");
    assert!(outside.fault(&setting(1.0)).unwrap().contains("does not start `between`"));
    assert_eq!(motion("linear = { velocity = [1, 0, 0] }").fault(&setting(0.0)), None);
}

const CORNER: &str = "points = [{ t_s = 1, offset = [0, 0, 0] }, { t_s = 2, offset = [1, 0, 0] }, \
                      { t_s = 4, offset = [1, 2, 0] }]";

#[test]
fn a_path_goes_straight_between_its_points() {
    let path = motion(&format!("path = {{ {CORNER} }}"));
    let at = |t: f64| path.displacement(t, &setting(0.0));
    for (time, x, y) in [(0.0, 0.0, 0.0), (1.25, 0.25, 0.0), (2.0, 1.0, 0.0), (3.0, 1.0, 1.0), (9.0, 1.0, 2.0)] {
        assert!((at(time) - Vector3::new(x, y, 0.0)).norm() < 1e-12, "{time}");
    }
}

#[test]
fn a_smooth_path_meets_its_points_without_a_kink() {
    let path = motion(&format!("path = {{ {CORNER}, smooth = true }}"));
    let at = |t: f64| path.displacement(t, &setting(0.0));
    let speed = |t: f64| (at(t + 1e-6) - at(t - 1e-6)) / 2e-6;
    assert!((at(2.0) - Vector3::new(1.0, 0.0, 0.0)).norm() < 1e-9);
    assert!((speed(2.0 - 1e-5) - speed(2.0 + 1e-5)).norm() < 1e-3);
    assert!(speed(1.0).norm() < 1e-3 && speed(4.0).norm() < 1e-3);
}

#[test]
fn a_path_repeats_or_returns() {
    let repeat = motion(&format!("path = {{ {CORNER}, then = 'repeat' }}"));
    let back = motion(&format!("path = {{ {CORNER}, then = 'return' }}"));
    let setting = setting(0.0);
    assert!((repeat.displacement(4.25, &setting) - Vector3::new(0.25, 0.0, 0.0)).norm() < 1e-12);
    assert!((back.displacement(5.0, &setting) - Vector3::new(1.0, 1.0, 0.0)).norm() < 1e-12);
    assert!((back.displacement(7.25, &setting) - Vector3::new(0.25, 0.0, 0.0)).norm() < 1e-12);
}

#[test]
fn the_velocity_along_a_path_is_that_of_its_pieces() {
    let path = |rest: &str| {
        let Motion::Path(path) = motion(&format!("path = {{ {CORNER}{rest} }}")) else { panic!() };
        path
    };
    let (right, up) = (Vector3::x(), Vector3::y());
    let (stay, repeat, back) = (path(""), path(", then = 'repeat'"), path(", then = 'return'"));
    for (path, time, expected) in [
        (&stay, 0.9, Vector3::zeros()),
        (&stay, 1.0, right),
        (&stay, 2.0, up),
        (&stay, 4.0, Vector3::zeros()),
        (&repeat, 4.0, right),
        (&repeat, 5.5, up),
        (&back, 5.0, -up),
        (&back, 6.5, -right),
        (&back, 7.5, right),
    ] {
        assert!((path.velocity(time) - expected).norm() < 1e-12, "{time}: {}", path.velocity(time));
    }
    let smooth = path(", smooth = true, then = 'return'");
    for time in [1.0, 1.3, 2.0, 3.7, 4.9, 6.2, 8.1] {
        let difference = (smooth.offset(time + 1e-6) - smooth.offset(time - 1e-6)) / 2e-6;
        assert!((smooth.velocity(time) - difference).norm() < 1e-4, "{time}");
    }
}

#[test]
fn way_points_out_of_order_are_refused_with_their_place() {
    let error = toml::from_str::<Motion>(
        "path = { points = [{ t_s = 1, offset = [0, 0, 0] }, { t_s = 1, offset = [0, 0, 1] }] }",
    );
    let text = error.unwrap_err().to_string();
    assert!(text.contains("line 1") && text.contains("got `t_s = 1` after `t_s = 1`"), "{text}");
}
