use super::*;

const MINIMAL: &str = "name = 'test'\n[camera]\nposition = [0, 0, 1]\nlook_at = [0, 2, 1]\n";

fn error(text: &str) -> String {
    format!("{:#}", Scene::parse(text, "test.toml").unwrap_err())
}

#[test]
fn all_built_in_scenes_are_sound() {
    for (name, text) in BUILT_IN {
        let scene = Scene::built_in(name).unwrap().unwrap();
        assert_eq!(scene.name, name);
        assert!(text.starts_with('#'), "{name} says what it shows");
    }
    assert!(Scene::built_in("no such scene").is_none());
}

#[test]
fn the_cameras_frame_is_optical() {
    let text = format!("{MINIMAL}[[sphere]]\nname = 'a'\ncenter = [0.3, 2, 0.8]\nradius = 0.1\n");
    let scene = Scene::parse(&text, "test.toml").unwrap();
    let Some(Shape::Sphere(sphere)) = scene.shapes_in_camera(0.0).next() else { panic!("a sphere") };
    assert!((sphere.center - Vector3::new(0.3, 0.2, 2.0)).norm() < 1e-12);
}

#[test]
fn a_camera_that_moves_keeps_its_point_or_its_direction() {
    let motion = "motion.linear = { velocity = [0.5, 0, 0] }\n";
    let at = Scene::parse(&format!("{MINIMAL}{motion}"), "test.toml").unwrap().world_from_camera(2.0);
    assert_eq!(at.translation, Vector3::new(1.0, 0.0, 1.0));
    assert!((at.inverse().point(&Vector3::new(0.0, 2.0, 1.0)).xy()).norm() < 1e-12, "the point stays in the middle");
    let text = MINIMAL.replace("look_at = [0, 2, 1]", "direction = [0, 2, 0]");
    let along = Scene::parse(&format!("{text}{motion}"), "test.toml").unwrap().world_from_camera(2.0);
    assert!((along.rotation.column(2) - Vector3::y()).norm() < 1e-12);
}

#[test]
fn the_same_view_can_be_given_as_a_quaternion() {
    let s = std::f64::consts::FRAC_1_SQRT_2;
    let text = MINIMAL.replace("look_at = [0, 2, 1]", &format!("orientation = [{}, 0, 0, {s}]", -s));
    let by_quaternion = Scene::parse(&text, "test.toml").unwrap().world_from_camera(0.0);
    let by_point = Scene::parse(MINIMAL, "test.toml").unwrap().world_from_camera(0.0);
    assert!((by_quaternion.rotation - by_point.rotation).norm() < 1e-12);
}

#[test]
fn faults_are_reported_with_line_and_column() {
    let text = format!("{MINIMAL}[[sphere]]\nname = 'a'\ncenter = [0, 2, 1]\nradius = -0.1\n");
    let told = error(&text);
    let says = "test.toml:8:10: expected a number above zero, got -0.1\n  8 | radius = -0.1\n  hint: a scene";
    assert!(told.starts_with(says), "{told}");
    let told = error(&format!("{MINIMAL}[[sphere]]\nname = 'a'\ncentre = [0, 2, 1]\nradius = 0.1\n"));
    assert!(told.starts_with("test.toml:7:1: ") && told.contains("unknown field `centre`, expected one of"), "{told}");
    assert!(told.contains("\n  hint: "), "{told}");
    let told = error(&format!("{MINIMAL}motion.linear = {{ velocity = [0, nan, 0] }}\n"));
    assert!(told.starts_with("test.toml:5:") && told.contains("three finite numbers"), "{told}");
    let told = error(&format!("{MINIMAL}[[cylinder]]\nname = 'a'\nbase = [0, 2, 1]\nradius = 0.1\n"));
    assert!(told.starts_with("test.toml:5:") && told.contains("missing field `length`"), "{told}");
}

#[test]
fn faults_of_the_whole_are_reported_by_name() {
    let ball = "[[sphere]]\nname = 'ball'\ncenter = [0, 2, 1]\nradius = 0.1\n";
    assert!(error(&format!("{MINIMAL}{ball}{ball}")).contains("two things are named `ball`"));
    let thrown = "motion.ballistic = { velocity = [0, 0, 0], floor_m = 2 }\n";
    assert!(
        error(&format!("{MINIMAL}{ball}{thrown}")).contains("`ball` cannot move like this: it starts 1.100 m below")
    );
    let both = MINIMAL.replace("look_at", "direction = [0, 1, 0]\nlook_at");
    assert!(error(&both).contains("exactly one of `look_at`, `direction` and `orientation`"));
    let straight_up = MINIMAL.replace("[0, 2, 1]", "[0, 0, 2]");
    assert!(error(&straight_up).contains("looks straight along `up`"));
    let plane = "[[plane]]\nname = 'p'\npoint = [0, 2, 1]\nnormal = [0, 0, 1]\nsize = [1, 1]\nalong = [0, 0, 2]\n";
    assert!(error(&format!("{MINIMAL}{plane}")).contains("`along` and `normal` of `p` are parallel"));
}

#[test]
fn a_missing_file_is_told_with_the_built_in_names() {
    let told = format!("{:#}", read(Path::new("/nowhere/scene.toml")).unwrap_err());
    assert!(told.contains("`/nowhere/scene.toml`") && told.contains("hint: ") && told.contains("`tabletop`"), "{told}");
}

#[test]
fn bowls_and_cups_are_understood() {
    let text = format!(
        "{MINIMAL}[[bowl]]\nname = 'bowl'\ncenter = [0, 2, 1]\nradius = 0.1\n\
         [[cylinder]]\nname = 'mug'\nbase = [0.3, 2, 1]\nradius = 0.04\nlength = 0.1\nopen = true\n"
    );
    let bodies = Scene::parse(&text, "test.toml").unwrap().bodies;
    let find = |name: &str| bodies.iter().find(|body| body.name == name).unwrap().shape;
    let Shape::Bowl(bowl) = find("bowl") else { panic!("a bowl") };
    assert_eq!((bowl.depth, bowl.axis), (0.1, Vector3::z()), "half a sphere that opens upwards");
    assert!(find("mug").hides_itself());
    assert!(error(&text.replace("radius = 0.1\n", "radius = 0.1\ndepth = -1\n")).contains("above zero"));
}

#[test]
fn what_is_not_round_is_a_lump() {
    let text = format!(
        "{MINIMAL}[[lump]]\nname = 'egg'\ncenter = [0, 2, 1]\nsize = [0.04, 0.04, 0.06]\n\
         [[lump]]\nname = 'bag'\ncenter = [1, 2, 1]\nsize = [0.4, 0.2, 0.3]\nsquareness = [2, 3]\n\
         creases = [{{ wave = [9, 0, 4], height = 0.1 }}]\n"
    );
    let scene = Scene::parse(&text, "test.toml").unwrap();
    let find = |name: &str| scene.bodies.iter().find(|body| body.name == name).unwrap().shape;
    let (Shape::Lump(egg), Shape::Lump(bag)) = (find("egg"), find("bag")) else { panic!("two lumps") };
    assert_eq!((egg.half, egg.squareness, egg.creases[0].height), (Vector3::new(0.02, 0.02, 0.03), [1, 1], 0.0));
    assert_eq!((bag.squareness, bag.creases[0].height, bag.creases[1].height), ([2, 3], 0.1, 0.0));
    assert!(error(&text.replace("[2, 3]", "[0, 3]")).contains("from 1 (round)"));
    assert!(error(&text.replace("height = 0.1", "height = 1.0")).contains("lower than its half-size"));
    assert!(error(&text.replace("height = 0.1", "height = -0.1")).contains("zero or a number above"));
    let five = "{ wave = [9, 0, 4], height = 0.1 }, ".repeat(5);
    assert!(error(&text.replace("{ wave = [9, 0, 4], height = 0.1 }", &five)).contains("5 `creases`"));
}
