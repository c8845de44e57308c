//! Stages, the topics between them, and the kinds of their messages.

use super::*;

#[test]
fn a_sound_pipeline_is_read_as_it_stands() {
    let text = sound() + "machine = 5";
    assert_told(&text, ["error: `machine` wants a string, this is an integer"]);
    assert_told(&sound(), []);
    let read =
        pipeline(&with_camera("rate_hz = 5\nrestart = 'always'\nenv = { RUST_LOG = 'debug', CONICFLOW_LOG = 'info' }"));
    let camera = read.stage("camera").unwrap();
    assert!(camera.is_source() && !read.stage("printer").unwrap().is_source() && read.stage("other").is_none());
    assert_eq!((camera.parameters.clone(), camera.restart), (json!({ "rate_hz": 5 }), Restart::Always));
    let env = [("RUST_LOG", "debug"), ("CONICFLOW_LOG", "info")].map(|(key, value)| (key.to_owned(), value.to_owned()));
    assert_eq!(camera.env, env);
    assert_eq!(read.topics(), ["depth", "objects"]);
    assert_eq!(["depth", "objects", "other"].map(|topic| read.kind_of(topic)), [Some("depth"), Some("objects"), None]);
    assert_eq!(read.topic("objects").writers, ["detector"]);
    let reader = TopicReader { stage: "printer".into(), delivery: Delivery::Latest, queue: 2 };
    assert_eq!(read.topic("objects").readers, [reader]);
    assert_eq!(read.topic("objects").kind(), Some("objects"));
    assert!(read.item("tracks").is_some() && read.item("other").is_none() && read.crossings().is_empty());
}

#[test]
fn a_stage_has_the_ends_that_its_node_needs_and_no_other() {
    assert_told(
        &with_camera("input = 'depth'"),
        ["error: stage `camera` has an `input`, but `camera` is a source", "error: stage `camera` waits for itself"],
    );
    assert_told(&sound().replace("input = 'depth'", ""), ["error: stage `detector` has no `input`"]);
    assert_told(
        &sound().replace("output = 'objects'", ""),
        ["error: stage `detector` has no `output`", "error: nobody writes the topic `objects`"],
    );
    assert_told(
        &(sound() + "output = 'printed'\n" + &program("reader", "input = 'printed'")),
        ["error: stage `printer` has an `output`, but `printer` is a sink"],
    );
    let hint = |stages: &str| report_of(&format!("name = 'test'\n{stages}"), &[]).to_string();
    let printer = hint("[stage.printer]\nnode = 'printer'");
    assert!(printer.ends_with("add `input = \"..\"`, a topic that carries objects or tracks"), "{printer}");
    assert!(hint("[stage.replay]\nnode = 'replay'").ends_with("add `output = \"depth\"`, the topic that it writes"));
}

#[test]
fn an_input_reads_what_is_written_once_and_of_a_kind_that_its_node_takes() {
    assert_told(
        &sound().replace("input = 'objects'", "input = 'objekts'"),
        ["error: nobody writes the topic `objekts`"],
    );
    let said =
        |kind: &str| sound().replace("input = 'objects'", &format!("input = {{ topic = 'objects', kind = '{kind}' }}"));
    assert_told(&said("objects"), []);
    assert_told(&said("tracks"), ["error: the topic `objects` carries objects, not tracks"]);
    assert_told(
        &sound().replace("input = 'objects'", "input = 'depth'"),
        ["error: the topic `depth` carries depth, `printer` takes objects or tracks here"],
    );
    let twice = sound() + &program("reader", "input = 'depth'\ninputs = { other = 'objects', again = 'depth' }");
    assert_told(&twice, ["error: stage `reader` reads the topic `depth` twice"]);
    let side = sound().replace("input = 'depth'", "input = 'depth'\ninputs = { known = 'depth2' }");
    assert_told(
        &(side + "[stage.other]\nnode = 'camera'\noutput = 'depth2'\n"),
        ["error: the topic `depth2` carries depth, `detector` takes tracks here"],
    );
    let recorder = |topic: &str| sound() + &format!("[stage.recorder]\nnode = 'recorder'\ninput = '{topic}'\n");
    assert_told(&recorder("objects"), []);
    let any = AnyByte::NAME;
    assert_told(&recorder("depth"), [&*format!("error: the topic `depth` carries depth, `recorder` takes {any} here")]);
}

#[test]
fn who_takes_several_kinds_has_to_be_told_what_a_program_writes() {
    let things = program("program", "output = 'things'");
    let reader = |node: &str| format!("{things}[stage.reader]\nnode = '{node}'\ninput = 'things'\n");
    for (node, kinds) in [("printer", "objects or tracks"), ("recorder", AnyByte::NAME)] {
        let text = format!("name = 'test'\n{}", reader(node));
        let report = report_of(&text, &[]);
        let expected = format!("error: nobody says what the topic `things` carries, `{node}` takes {kinds}");
        assert_eq!(first_lines(&report), [expected]);
        assert!(report.to_string().ends_with("input = { topic = \"things\", kind = \"objects\" }"), "{report}");
        assert_told(&reader(node).replace("'things'", "{ topic = 'things', kind = 'tracks' }"), []);
    }
    let tracker = reader("tracker") + "output = 'tracks'\n" + &program("end", "input = 'tracks'");
    assert_told(&tracker, []);
    assert_eq!(pipeline(&tracker).kind_of("things"), Some("objects"), "it takes nothing else");
    let side = [CAMERA, &things, DETECTOR, PRINTER]
        .concat()
        .replace("input = 'depth'", "input = 'depth'\ninputs = { known = 'things' }");
    assert_eq!(pipeline(&side).kind_of("things"), Some("tracks"), "the side input takes nothing else");
    let replay = |output: &str| {
        format!("[stage.replay]\nnode = 'replay'\noutput = {output}\n{}", program("end", "input = 'things'"))
    };
    assert_eq!(pipeline(&replay("'things'")).kind_of("things"), Some("depth"), "nothing tells what is replayed");
    assert_eq!(pipeline(&replay("{ topic = 'things', kind = 'objects' }")).kind_of("things"), Some("objects"));
    let other =
        program("other", "output = 'other'") + &program("reader", "input = { topic = 'other', kind = 'tracks' }");
    let untold = pipeline(&(things + &program("end", "input = 'things'") + &other));
    assert_eq!(["things", "other"].map(|topic| untold.kind_of(topic)), [None, Some("tracks")]);
}

#[test]
fn a_topic_carries_one_kind_and_has_readers_and_each_frame_once() {
    let said = sound().replace("output = 'objects'", "output = { topic = 'objects', kind = 'tracks' }");
    assert_told(&said, ["error: `detector` writes objects, not tracks"]);
    let other = sound() + "[stage.tracker]\nnode = 'tracker'\ninput = 'objects'\noutput = 'depth'\n";
    assert_told(
        &other,
        [
            "error: the stages `tracker` -> `detector` wait for each other in a circle",
            "error: the topic `depth` carries depth, stage `tracker` would write tracks into it",
        ],
    );
    assert_told(&[CAMERA, DETECTOR].concat(), ["warning: nobody reads the topic `objects`"]);
    let second = DETECTOR.replace("stage.detector", "stage.second");
    let rivals = "warning: `detector` and `second` write the same frames of `camera` into the topic `objects`";
    assert_told(&(sound() + &second), [rivals]);
    assert_told(
        &(sound()
            + &second.replace("'objects'", "'other'")
            + &PRINTER.replace("printer]", "p]").replace("objects", "other")),
        [],
    );
    let another = second.replace("'depth'", "'depth2'")
        + &CAMERA.replace("stage.camera", "stage.camera2").replace("'depth'", "'depth2'");
    assert_told(&(sound() + &another), []);
    let filter = program("filter", "input = 'depth'\noutput = { topic = 'depth2', kind = 'depth' }");
    assert_told(&(sound() + &filter + &second.replace("'depth'", "'depth2'")), [rivals]);
}

#[test]
fn no_stages_wait_for_each_other_in_a_circle() {
    let a = |keys: &str| program("a", &format!("output = {{ topic = 'x', kind = 'objects' }}\n{keys}"));
    let b = program("b", "input = 'x'\noutput = { topic = 'y', kind = 'objects' }");
    let circle = "error: the stages `b` -> `a` wait for each other in a circle";
    assert_told(&(a("input = 'y'") + &b), [circle]);
    assert_told(&a("input = 'x'"), ["error: stage `a` waits for itself"]);
    assert_told(&(a("inputs = { back = 'y' }") + &b), []);
    assert_told(&(a("inputs = { back = { topic = 'y', delivery = 'lossless' } }") + &b), [circle]);
    let tracker = "[stage.tracker]\nnode = 'tracker'\ninput = 'objects'\noutput = 'tracks'\n";
    let tracked = |side: &str| {
        sound().replace("input = 'depth'", &format!("input = 'depth'\ninputs = {{ {side} = 'tracks' }}")) + tracker
    };
    assert_told(&tracked("known"), []);
    assert_told(&tracked("same"), ["error: the stages `tracker` -> `detector` wait for each other in a circle"]);
}

#[test]
fn a_graph_has_a_box_for_each_stage_and_an_arrow_for_each_input() {
    let detector = DETECTOR.replace(
        "input = 'depth'",
        "input = { topic = 'depth', delivery = 'lossless' }\ninputs = { known = 'tracks' }",
    );
    let tracks = program("tracks", "output = 'tracks'");
    let alone = pipeline(&[CAMERA, &detector, PRINTER, &tracks].concat()).mermaid();
    let boxes = "flowchart LR\n  camera[\"camera<br/>camera\"]\n  detector[\"detector<br/>detector\"]\n  \
                 printer[\"printer<br/>printer\"]\n";
    let arrows = "  camera -->|\"depth, lossless\"| detector\n  tracks -.->|\"tracks\"| detector\n  \
                  detector -->|\"objects\"| printer\n";
    assert!(alone.starts_with(boxes) && alone.ends_with(arrows) && alone.contains("  tracks[\"tracks<br/>"), "{alone}");
    let split =
        pipeline(&[MACHINES, &on("robot", CAMERA), &on("base", DETECTOR), &on("base", PRINTER)].concat()).mermaid();
    let machines = "  subgraph base\n    detector[\"detector<br/>detector\"]\n    printer[\"printer<br/>printer\"]\n  end\n  \
                    subgraph robot\n    camera[\"camera<br/>camera\"]\n  end\n";
    assert!(split.contains(machines), "{split}");
}
