//! Values: their types and ranges, overrides, and the reports of their faults.

use super::*;

#[test]
fn an_item_type_of_ones_own_has_a_name_a_type_and_fields() {
    let used = program("a", "output = { topic = 'x', kind = 'grasps' }") + &program("b", "input = 'x'");
    let item = |lines: &str| format!("[item.grasps]\n{lines}\n{used}");
    let described = "type = 'acme.Grasp.v1'\nfields = { position = 'f64[2]' }";
    let read = pipeline(&item(&format!("{described}\nusual_length = 16_777_216")));
    let grasps = read.item("grasps").unwrap();
    assert_eq!((grasps.type_name(), grasps.size(), grasps.usual_length()), ("acme.Grasp.v1", 16, 1 << 24));
    assert_eq!(pipeline(&item(described)).item("grasps").unwrap().usual_length(), Nothing::USUAL_LENGTH);
    let needs_it = "error: `kind` cannot be `grasps`";
    for (lines, fault) in [
        ("type = 'acme.Grasp.v1'", "item `grasps` has no `fields`"),
        ("fields = { id = 'u64' }", "item `grasps` has no `type`"),
        (
            "type = 'conicflow.A'\nfields = { id = 'u64' }",
            "`conicflow.A`: names that begin with `conicflow.` are those of built-in types",
        ),
        ("type = 'a b'\nfields = { id = 'u64' }\nusual_length = 0", "`a b` cannot be the name of a type"),
        ("type = 'a'\nfields = { id = 'u64' }\nusual_length = 0", "`usual_length` wants an integer from 1 to 16777216"),
        (
            "type = 'a'\nfields = { id = 'f64[3]' }\nusual_length = 16_777_216",
            "a message of item `grasps` has 16777216 items of 24 bytes each",
        ),
        ("type = 'a'\nfields = { id = 'u64' }\nfield = 1", "unknown key `field` in item `grasps`"),
        ("type = 'a'\nfields = { id = 5 }", "`id` wants a string, this is an integer"),
    ] {
        let told = told(&item(lines));
        assert_eq!(told[0], format!("error: {fault}"));
        assert!(told[1..].iter().all(|told| told == needs_it || told.ends_with("16777216")), "{told:?}");
    }
    assert!(told(&item("type = 'a'\nfields = { id = 'u65' }")).len() > 1, "no such type of field");
    let twice = format!("{}[item.other]\n{described}\n", item(described));
    assert_told(&twice, ["error: `grasps` and `other` have the same `type`"]);
    for (name, fault) in [
        ("depth", "`depth` is a built-in item type"),
        (LINE_KEYS[0], &*format!("`{}` has another meaning", LINE_KEYS[0])),
        (Nothing::NAME, &*format!("`{}` has another meaning", Nothing::NAME)),
    ] {
        let text = format!("[item.{name}]\n{described}\n{}", sound());
        assert_told(&text, [&*format!("error: {fault}")]);
    }
}

#[test]
fn names_are_short_and_made_of_letters_and_digits() {
    let faults = |name: &str| first_lines(&report_of(&format!("name = '{name}'\n{}", sound()), &[]));
    let (longest, longer) = ("a".repeat(31), "a".repeat(32));
    assert_eq!([&*longest, "a-b_C9"].map(faults), [vec![""; 0], vec![]]);
    for name in [&*longer, "", "a b", "a/b"] {
        assert_eq!(faults(name), [format!("error: `{name}` cannot be the name of a pipeline")]);
    }
}

#[test]
fn what_is_missing_is_told_unless_a_key_is_misspelt() {
    for (text, expected) in [
        (sound(), vec!["error: the pipeline has no name"]),
        ("nme = 'a'\n".to_owned() + &sound(), vec!["error: unknown key `nme` in the pipeline"]),
        ("name = 'a'\n".to_owned(), vec!["error: the pipeline has no stages"]),
        ("name = 'a'\n[stge.a]\n".to_owned(), vec!["error: unknown key `stge` in the pipeline"]),
        (
            "name = 'a'\n[stage.a]\nnod = 'camera'\n".to_owned(),
            vec!["error: stage `a` has neither `node` nor `program`"],
        ),
        ("name = 'a'\n[stage.a]\nnode = 'camra'\n".to_owned(), vec!["error: there is no node `camra`"]),
        (
            "name = 'a'\n[stage.a]\nnode = 'camera'\nprogram = []\n".to_owned(),
            vec!["error: stage `a` has both `node` and `program`"],
        ),
    ] {
        assert_eq!(first_lines(&report_of(&text, &[])), expected, "{text}");
    }
}

#[test]
fn a_value_of_another_type_is_told_by_the_word_for_its_type() {
    for (value, word) in [
        ("5", "an integer"),
        ("1.5", "a number"),
        ("inf", "a number out of range"),
        ("99999999999999999999", "a number out of range"),
        ("true", "a boolean"),
        ("1979-05-27", "a date"),
        ("[]", "an array"),
        ("{}", "a table"),
    ] {
        let report = report_of(&format!("name = {value}\n{}", sound()), &[]);
        assert_eq!(first_lines(&report), [format!("error: `name` wants a string, this is {word}")]);
    }
}

#[test]
fn a_program_is_a_file_that_may_be_run() {
    let run = |command: &str| program("a", "").replace("['sh']", command);
    assert_told(&run("['sh', '-c']"), []);
    for (command, fault) in [
        ("['./Cargo.toml']", "`./Cargo.toml` may not be run"),
        ("['./src']", "`./src` may not be run"),
        ("['./missing']", "there is no program `./missing`"),
        ("['no-such-program']", "there is no program `no-such-program`"),
        ("[]", "`program` is empty"),
        (r#"["a\u0000"]"#, "`program` has a zero byte in it"),
    ] {
        assert_told(&run(command), [&*format!("error: {fault}")]);
    }
}

#[test]
fn a_stage_says_when_it_is_started_anew_and_when_it_counts_as_dead() {
    let of = |restart: &str| {
        let read = pipeline(&with_camera(&format!("restart = {restart}")));
        let camera = read.stage("camera").unwrap();
        (camera.restart, camera.hang_s, camera.join_s)
    };
    assert_eq!(of("'never'"), (Restart::Never, None, None));
    assert_eq!(of("{ when = 'always', hang_s = 5, join_s = 2.5 }"), (Restart::Always, Some(5.0), Some(2.5)));
    assert_eq!(of("{ hang_s = 1.5 }"), (Restart::OnFailure, Some(1.5), None));
    for (restart, fault) in [
        ("'somtimes'", "`restart` cannot be `somtimes`"),
        ("{ hang_s = 0.5 }", "`hang_s` wants seconds, from 1 to 86400"),
        ("{ join = 5 }", "unknown key `join` in `restart`"),
    ] {
        assert_told(&with_camera(&format!("restart = {restart}")), [&*format!("error: {fault}")]);
    }
}

#[test]
fn the_environment_of_a_stage_cannot_take_its_place_in_the_run_from_it() {
    for (entry, fault) in [
        ("CONICFLOW_STAGE = 'a'", "`CONICFLOW_STAGE` is set by the run itself"),
        ("'' = 'a'", "`` cannot be the name of a variable"),
        ("'a=b' = 'a'", "`a=b` cannot be the name of a variable"),
        (r#"a = "\u0000""#, "the value of `a` has a zero byte in it"),
        ("a = 5", "`a` wants a string, this is an integer"),
    ] {
        assert_told(&with_camera(&format!("env = {{ {entry} }}")), [&*format!("error: {fault}")]);
    }
}

#[test]
fn inputs_say_how_they_are_read() {
    let of = |input: &str| {
        let detector = DETECTOR.replace("input = 'depth'", &format!("input = 'depth'\ninputs = {input}"));
        let tracks = program("tracks", "output = 'tracks'");
        let read = pipeline(&[CAMERA, &detector, PRINTER, &tracks].concat());
        let (_, input) = &read.stage("detector").unwrap().inputs[0];
        (input.delivery, input.queue)
    };
    assert_eq!(of("{ known = 'tracks' }"), (Delivery::Latest, 2));
    assert_eq!(of("{ same = 'tracks' }"), (Delivery::Latest, 8));
    assert_eq!(of("{ same = { topic = 'tracks', queue = 64 } }"), (Delivery::Latest, 64));
    assert_eq!(of("{ known = { topic = 'tracks', queue = 1, delivery = 'lossless' } }"), (Delivery::Lossless, 2));
    for (input, fault) in [
        ("{ topic = 'objects', queue = 0 }", "`queue` is 0, allowed is from 1 to 64"),
        ("{ topic = 'objects', queue = 65 }", "`queue` is 65, allowed is from 1 to 64"),
        ("{ topic = 'objects', queue = 'a' }", "`queue` wants an integer, this is a string"),
        ("{ topic = 'objects', delivery = 'all' }", "`delivery` cannot be `all`"),
        ("{ topic = 'objects', kind = 'apples' }", "`kind` cannot be `apples`"),
        ("{ topic = 'objects', que = 1 }", "unknown key `que` in the input"),
        ("{ queue = 1 }", "the input has no topic"),
        ("5", "an input is a topic or a table, this is an integer"),
    ] {
        let told = told(&sound().replace("input = 'objects'", &format!("input = {input}")));
        assert_eq!(told[0], format!("error: {fault}"));
    }
    let lossless =
        "input = { topic = 'depth', delivery = 'lossless' }\ninputs = { same = 'tracks', known = 'tracks2' }";
    let outputs = program("one", "output = 'tracks'") + &program("two", "output = 'tracks2'");
    let read = pipeline(&(sound().replace("input = 'depth'", lossless) + &outputs));
    let deliveries: Vec<_> = read.stage("detector").unwrap().all_inputs().map(|input| input.delivery).collect();
    assert_eq!(
        deliveries,
        [Delivery::Lossless, Delivery::Lossless, Delivery::Latest],
        "the same frame is as sure as what drives it"
    );
    assert_told(
        &(sound().replace("input = 'depth'", "input = 'depth'\ninputs = { knwn = 'objects3' }")),
        ["error: node `detector` has no side input `knwn`", "error: nobody writes the topic `objects3`"],
    );
}

#[test]
fn parameters_are_of_the_type_and_in_the_range_that_their_node_says() {
    for lines in [
        "rate_hz = 0.1\ncount = 1\nmost = 9\nany = -1e9\nmode = 'still'\nsize = 3\nball = { radius = 1 }\nweights = [1, 2.5]",
        "size = 'large'\nshares = { a = 1, b = 0.5 }\nis_on = true\ntext = 'any'\nmode = 'fast'\nspeed = 1e9\nrate_hz = 100",
    ] {
        assert_told(&with_camera(lines), []);
    }
    for (line, fault) in [
        ("rate_hz = 0", "`rate_hz` is 0, allowed is more than 0, up to 100"),
        ("rate_hz = 100.5", "`rate_hz` is 100.5, allowed is more than 0, up to 100"),
        ("rate_hz = 1e308", "`rate_hz` is 1e308, allowed is more than 0, up to 100"),
        ("speed = -1", "`speed` is -1, allowed is more than 0"),
        ("count = 0", "`count` is 0, allowed is 1 or more"),
        ("count = 1.5", "`count` wants an integer, this is a number"),
        ("most = 10", "`most` is 10, allowed is up to 9"),
        ("any = inf", "`any` is inf, allowed is a finite number"),
        ("any = 1979-05-27", "`any` wants a number, this is a date"),
        ("mode = 'fst'", "`mode` cannot be `fst`"),
        ("size = 'medium'", "`size` cannot be `medium`"),
        ("size = true", "`size` wants an integer or a string, this is a boolean"),
        ("ball = {}", "`ball` lacks `radius`"),
        ("ball = { radius = 1, x = 1 }", "unknown key `x` in `ball`"),
        ("ball = 1", "`ball` wants a table, this is an integer"),
        ("weights = [1, 'a']", "`weights` wants a number, this is a string"),
        ("weights = 1", "`weights` wants an array, this is an integer"),
        ("shares = { a = 2 }", "`a` is 2, allowed is up to 1"),
        ("is_on = 'yes'", "`is_on` wants true or false, this is a string"),
        ("rate_hs = 5", "unknown key `rate_hs` in stage `camera`"),
    ] {
        assert_told(&with_camera(line), [&*format!("error: {fault}")]);
    }
    let hint = |line: &str| report_of(&format!("name = 'test'\n{}", with_camera(line)), &[]).to_string();
    for (line, expected) in [
        ("rate_hz = 0", "hint: Images per second (default 10)"),
        ("any = inf", "hint: Any."),
        ("rate_hs = 5", "hint: did you mean `rate_hz`?"),
        ("outptu = 5", "hint: did you mean `output`?"),
        ("mode = 'xxxxxxxx'", "hint: allowed: `fast`, `slow`, `still`"),
    ] {
        let told = hint(line);
        assert!(told.ends_with(expected), "{told}");
    }
    assert!(!hint("is_on = 5").contains("hint: "), "nothing is known of it");
}

#[test]
fn values_are_set_beside_the_file() {
    let set = |overrides: &[&str]| read_on(None, &format!("name = 'test'\n{}", with_camera("rate_hz = 5")), overrides);
    let camera = |overrides: &[&str]| {
        let (read, _) = set(overrides).unwrap_or_else(|report| panic!("{report}"));
        let camera = read.stage("camera").unwrap();
        (camera.parameters.clone(), camera.env.clone(), camera.output.clone())
    };
    let depth = Some("depth".to_owned());
    assert_eq!(camera(&[" camera.rate_hz = 7"]), (json!({ "rate_hz": 7 }), vec![], depth.clone()));
    let variable = vec![("A".to_owned(), "b c".to_owned())];
    assert_eq!(camera(&["camera.env.A=b c"]), (json!({ "rate_hz": 5 }), variable, depth.clone()));
    assert_eq!(
        camera(&["camera.ball.radius=2", "camera.ball.radius=3"]).0,
        json!({ "rate_hz": 5, "ball": { "radius": 3 } })
    );
    assert_eq!(camera(&["camera.node=camera"]).0, json!({ "rate_hz": 5 }));
    assert_eq!(
        camera(&["camera.node=replay"]),
        (json!({}), vec![], depth),
        "what it was told means nothing to another node"
    );
    let (read, _) = set(&["detector.input.delivery=lossless"]).unwrap();
    let input = read.stage("detector").unwrap().input.clone().unwrap();
    assert_eq!((&*input.topic, input.delivery), ("depth", Delivery::Lossless));
    for (text, first_line, hint) in [
        ("camera=5", "error: --set:1:1: `--set` wants STAGE.KEY=VALUE", "--set source.rate_hz=10"),
        ("camera.rate_hz", "error: --set:1:1: `--set` wants STAGE.KEY=VALUE", "--set source.rate_hz=10"),
        ("camra.rate_hz=5", "error: --set:1:1: there is no stage `camra`", "did you mean `camera`?"),
        ("other.rate_hz=5", "error: --set:1:1: there is no stage `other`", "stages: `camera`, `detector`, `printer`"),
        (
            "camera.rate_hz=-1",
            "error: --set:1:16: `rate_hz` is -1, allowed is more than 0, up to 100",
            "Images per second (default 10)",
        ),
    ] {
        let told = set(&[text]).err().unwrap().to_string();
        assert!(told.lines().next() == Some(first_line) && told.ends_with(hint), "{told}");
    }
}

#[test]
fn of_each_table_one_fault_of_form_is_told() {
    let report = report_of("[a]\nx = \ny = \n[b]\nz = \n  [c]\nz = \n", &[]);
    assert_eq!(report.0.len(), 3, "{report}");
    for (text, hint) in [
        ("a = 1\na = 2\n", "each key stands once in its table, and each stage has a name of its own"),
        ("a = [1\n", "an array ends with `]`, and commas stand between what is in it"),
        ("a = hello\n", "the file is not valid TOML here; strings stand in quotes, tables in [brackets]"),
    ] {
        let told = report_of(text, &[]).to_string();
        assert!(told.contains(&format!("hint: {hint}")), "{told}");
    }
}

#[test]
fn a_fault_is_shown_in_its_line() {
    let place = |text: &str, piece: &str| {
        let source = Arc::new(SourceText { name: "a.toml".into(), text: text.to_owned() });
        let start = text.find(piece).unwrap();
        diagnostic::SourceSpan { source, span: start..start + piece.len() }
    };
    let at = place("a = 1\nbé\t= 22\nc = 3\n", "22");
    let shown = Diagnostic::warning(&at, "it is odd", "write 2").to_string();
    assert_eq!(shown, "warning: a.toml:2:6: it is odd\n    2 | bé\t= 22\n      |   \t  ^^\n  hint: write 2");
    assert!(Diagnostic::error(&at, "it is odd", "").to_string().ends_with("^^"));
    let long = format!("{}fault{}", "x".repeat(1000), "y".repeat(1000));
    let shown = Diagnostic::error(&place(&long, "fault"), "it is long", "").to_string();
    let lines: Vec<_> = shown.lines().collect();
    assert_eq!(lines[0], "error: a.toml:1:1001: it is long");
    assert_eq!(lines[1], format!("    1 | {}fault{}", "x".repeat(150), "y".repeat(145)));
    assert_eq!(lines[2], format!("      | {}^^^^^", " ".repeat(150)));
}

#[test]
fn a_misspelt_word_means_the_nearest_one_if_any_is_near() {
    let nearest = |word: &str| diagnostic::closest(word, ["camera", "abxy"]);
    assert_eq!(["camra", "abc", "abcdz", "xyz"].map(nearest), [Some("camera"), Some("abxy"), None, None]);
    assert_eq!(suggestion("xyz", ["a", "b"], "nodes"), "nodes: `a`, `b`");
    assert_eq!(suggestion("xyz", [], "nodes"), "there are no nodes");
    assert_eq!(suggestion("nod", ["node"], "nodes"), "did you mean `node`?");
}
