//! Pipelines of nodes that are made up: what is read of a file, and what is wrong with one.

use super::*;
use crate::network::{Carrier, Network};
use crate::node::{Node, Variant};
use crate::ports::{Delivery, TopicReader};
use crate::side_inputs::SideInput;
use conicflow_messages::{AnyByte, Hinted, Item, LINE_KEYS, Nothing, Object, Track};
use serde_json::{Value as Json, json};

const fn variant(input: &'static str, output: &'static str) -> Variant {
    Variant { input, output, run: |_, _| Ok(()) }
}

pub(super) const fn node(name: &'static str, variants: &'static [Variant]) -> Node {
    let (check, settle) = (|_, _: &Path| Ok(vec![]), Ok);
    let schema = || json!({ "properties": {} });
    Node {
        name,
        summary: "",
        variants,
        side_inputs: || &[],
        schema,
        check,
        message_length: |_, _| None,
        settle,
        host: None,
    }
}

pub(super) const NODES: &[Node] = &[
    Node { schema: of_camera, ..node("camera", &[variant(Nothing::NAME, u16::NAME)]) },
    Node {
        side_inputs: || {
            const {
                &[
                    SideInput::latest::<u16>("mask"),
                    SideInput::latest::<Track>("known"),
                    SideInput::same_frame::<Track>("same"),
                ]
            }
        },
        ..node("detector", &[variant(u16::NAME, Object::NAME)])
    },
    node("tracker", &[variant(Object::NAME, Track::NAME)]),
    node("printer", &[variant(Object::NAME, Nothing::NAME), variant(Track::NAME, Nothing::NAME)]),
    node("replay", &[variant(Nothing::NAME, AnyByte::NAME)]),
    node("recorder", &[variant(AnyByte::NAME, Nothing::NAME)]),
];

fn of_camera() -> Json {
    json!({
        "properties": {
            "rate_hz": {
                "type": "number", "exclusiveMinimum": 0, "maximum": 100, "default": 10,
                "description": "Images\nper second.",
            },
            "speed": { "type": "number", "exclusiveMinimum": 0 },
            "count": { "type": ["integer", "null"], "minimum": 1 },
            "most": { "type": "number", "maximum": 9 },
            "any": { "type": "number", "description": "Any." },
            "mode": { "oneOf": [{ "const": "fast" }, { "enum": ["slow", "still"] }] },
            "size": { "anyOf": [{ "type": "integer" }, { "$ref": "#/$defs/word" }] },
            "ball": { "$ref": "#/$defs/ball" },
            "weights": { "type": "array", "items": { "type": "number" } },
            "shares": { "type": "object", "additionalProperties": { "type": "number", "maximum": 1 } },
            "is_on": { "type": "boolean", "default": null },
            "text": { "type": "string" },
        },
        "$defs": {
            "word": { "type": "string", "enum": ["small", "large"] },
            "ball": { "type": "object", "properties": { "radius": { "type": "number" } }, "required": ["radius"] },
        },
    })
}

fn network() -> Network {
    let check = |machine: &Machine| machine.listen.iter().try_for_each(|endpoint| check_endpoint(endpoint));
    let carrier = Carrier::Program(|| Err(Hinted::new("it is not there", "install it")));
    Network { check, listen_endpoints: |_| Ok(Vec::new()), carrier }
}

/// The folder of this package stands for that of the file.
fn read_on(machine: Option<&str>, text: &str, overrides: &[&str]) -> Result<(Pipeline, Report), Report> {
    let source = SourceText { name: "test.toml".to_owned(), text: text.to_owned() };
    let overrides: Vec<_> = overrides.iter().map(|text| (*text).to_owned()).collect();
    let registry = Registry { nodes: NODES, network: Some(network()) };
    Pipeline::read_on(machine, source, Path::new(env!("CARGO_MANIFEST_DIR")), &overrides, &registry)
}

fn report_of(text: &str, overrides: &[&str]) -> Report {
    match read_on(None, text, overrides) {
        Ok((_, report)) | Err(report) => report,
    }
}

/// The first lines of what is told, without their places.
fn first_lines(report: &Report) -> Vec<String> {
    let text = report.to_string();
    let lines = text.lines().filter(|line| line.starts_with("error: ") || line.starts_with("warning: "));
    let without_place = |line: &str| {
        let parts: Vec<_> = line.splitn(5, ':').collect();
        format!("{}:{}", parts[0], parts[4])
    };
    lines.map(without_place).collect()
}

/// What is told of a pipeline with these stages.
fn told(stages: &str) -> Vec<String> {
    first_lines(&report_of(&format!("name = 'test'\n{stages}"), &[]))
}

fn assert_told<const N: usize>(stages: &str, expected: [&str; N]) {
    assert_eq!(told(stages), expected, "{stages}");
}

fn pipeline(text: &str) -> Pipeline {
    read_on(None, &format!("name = 'test'\n{text}"), &[]).unwrap_or_else(|report| panic!("{report}")).0
}

const CAMERA: &str = "[stage.camera]\nnode = 'camera'\noutput = 'depth'\n";
const DETECTOR: &str = "[stage.detector]\nnode = 'detector'\ninput = 'depth'\noutput = 'objects'\n";
const PRINTER: &str = "[stage.printer]\nnode = 'printer'\ninput = 'objects'\n";

fn sound() -> String {
    [CAMERA, DETECTOR, PRINTER].concat()
}

/// A program of one's own.
fn program(name: &str, keys: &str) -> String {
    format!("[stage.{name}]\nprogram = ['sh']\n{keys}\n")
}

/// The sound pipeline with further lines for its camera.
fn with_camera(lines: &str) -> String {
    [CAMERA, lines, "\n", DETECTOR, PRINTER].concat()
}

#[test]
fn without_a_network_part_a_pipeline_has_no_machines() {
    let text = "name = \"two\"\n[machine.robot]\n[machine.base]\n[stage.a]\nprogram = [\"sh\"]\noutput = \"depth\"\n";
    let source = SourceText { name: "two.toml".to_owned(), text: text.to_owned() };
    let registry = Registry { nodes: &[], network: None };
    let Err(report) = Pipeline::read(source, Path::new("/"), &[], &registry) else { panic!("it was accepted") };
    let told = report.to_string();
    assert_eq!(told.matches("this program was built without its network part").count(), 1, "{told}");
    assert!(told.contains("two.toml:2:") && told.contains("without [machine.*]"), "{told}");
}

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

const MACHINES: &str = "[machine.robot]\n[machine.base]\n";

fn on(machine: &str, stage: &str) -> String {
    format!("{stage}machine = '{machine}'\n")
}

#[test]
fn where_there_are_machines_each_stage_is_on_one_of_them() {
    let of = |stage: &str| report_of(&format!("name = 'test'\n{stage}"), &[]);
    let unknown = "error: stage `printer` is on machine `robt`, which is not in the file";
    let [alone, among] = ["", MACHINES]
        .map(|machines| of(&[machines, &on("robot", CAMERA), &on("robot", DETECTOR), &on("robt", PRINTER)].concat()));
    assert_eq!(first_lines(&among), [unknown]);
    assert!(among.to_string().ends_with("hint: did you mean `robot`?"), "{among}");
    assert_eq!(first_lines(&alone).len(), 3);
    assert!(alone.to_string().ends_with("hint: add a table [machine.robt], or remove the line"), "{alone}");
    let silent = of(&[MACHINES, &on("robot", CAMERA), &on("robot", DETECTOR), PRINTER].concat());
    assert_eq!(first_lines(&silent), ["error: stage `printer` does not say on which machine it runs"]);
    assert!(silent.to_string().ends_with("machines: `base`, `robot`"), "{silent}");
}

#[test]
fn topics_cross_machines_where_writer_and_reader_are_on_different_ones() {
    let split = [MACHINES, &on("robot", CAMERA), &on("base", DETECTOR), &on("base", PRINTER)].concat();
    let read = pipeline(&split);
    assert_eq!(read.crossings(), [("depth", "robot", "base")]);
    assert!(read.is_on("camera", "robot") && !read.is_on("camera", "base") && !read.is_on("other", "robot"));
    let readers = |machine: Option<&str>| {
        let topic = read.topic_on("depth", machine);
        topic.readers.into_iter().map(|reader| (reader.stage, reader.queue)).collect::<Vec<_>>()
    };
    let [detector, bridge] = ["detector", BRIDGE].map(|stage| vec![(stage.to_owned(), 2)]);
    assert_eq!([Some("robot"), Some("base"), None].map(readers), [bridge, detector.clone(), detector]);
    let lossless = split.replace("input = 'depth'", "input = { topic = 'depth', delivery = 'lossless' }");
    assert_eq!(pipeline(&lossless).topic_on("depth", Some("robot")).delivery_to(BRIDGE), Delivery::Lossless);
    let called = |name: &str, text: &str| text.replace("stage.printer", &format!("stage.{name}"));
    assert_told(&called(BRIDGE, &split), ["error: a stage cannot be called `bridge` where edges cross machines"]);
    assert_told(&called(BRIDGE, &sound()), []);
    for (topic, is_refused) in [("/depth", true), ("depth/", true), ("a//b", true), ("a/b", false)] {
        let named = |text: &str| text.replace("'depth'", &format!("'{topic}'"));
        let fault = format!("error: the topic `{topic}` cannot cross machines: it has an empty part between slashes");
        assert_eq!(told(&named(&split)), if is_refused { vec![fault] } else { vec![] });
        assert_told(&named(&sound()), []);
        let stays = split.replace("'objects'", &format!("'{topic}'"));
        assert_told(&stays, []);
    }
}

#[test]
fn what_crosses_machines_is_of_a_kind_that_is_told_and_compressed_where_that_is_worth_it() {
    let compressed = |topic: &str| {
        sound().replace(&format!("input = '{topic}'"), &format!("input = {{ topic = '{topic}', compression = 'lz4' }}"))
    };
    assert_told(&compressed("depth"), []);
    assert_told(
        &compressed("objects"),
        ["error: `compression` is for images and ellipses, the topic `objects` carries objects"],
    );
    let (a, b) = (program("a", "output = 'things'"), program("b", "input = 'things'"));
    let fault = "error: nobody says what the topic `things` carries, and it crosses machines";
    assert_told(&[MACHINES, &on("robot", &a), &on("base", &b)].concat(), [fault]);
    let split = [MACHINES, &on("robot", CAMERA), &on("base", DETECTOR), &on("base", PRINTER)].concat();
    assert_told(&(split + &on("base", &a) + &on("base", &b)), []);
}

#[test]
fn what_another_machine_needs_of_files_need_not_be_here() {
    let (a, b) = (program("a", "output = 'things'"), program("b", "input = 'things'"));
    let missing = |stage: &str| stage.replace("['sh']", "['./missing']");
    let text = format!(
        "name = 'test'\n[machine.robot]\nkey = 'Cargo.toml'\n[machine.base]\nkey = 'missing.key'\n{}{}",
        on("robot", &a.replace("'things'", "{ topic = 'things', kind = 'objects' }")),
        on("base", &missing(&b))
    );
    let on = |machine: Option<&str>| match read_on(machine, &text, &[]) {
        Ok((_, report)) | Err(report) => first_lines(&report),
    };
    assert_eq!(on(Some("robot")), [""; 0]);
    let program = "error: there is no program `./missing`";
    for machine in [Some("base"), None] {
        let told = on(machine);
        assert!(told.len() == 2 && told[0].starts_with("error: there is no file `") && told[1] == program, "{told:?}");
    }
}

#[test]
fn a_machine_says_how_it_is_reached_and_all_have_a_key_or_none() {
    let machine = |lines: &str| format!("[machine.robot]\n{lines}\n{}", on("robot", &program("a", "")));
    let lines = "listen = ['tcp/0.0.0.0:7447']\nconnect = ['udp/base:1']\n\
                 zenoh = 'Cargo.toml'\nkey = 'Cargo.toml'\ninsecure = true\n\
                 outage_s = 2.5\nmetrics = '127.0.0.1:9464'";
    let read = pipeline(&("metrics = '127.0.0.1:1'\n".to_owned() + &machine(lines)));
    let file = Some(Path::new(env!("CARGO_MANIFEST_DIR")).join("Cargo.toml"));
    let listening = |text: &str| Metrics { listen: text.parse().unwrap(), token: None };
    assert_eq!(
        read.machines["robot"],
        Machine {
            listen: vec!["tcp/0.0.0.0:7447".into()],
            connect: vec!["udp/base:1".into()],
            zenoh: file.clone(),
            key: file,
            insecure: true,
            outage_s: Some(2.5),
            metrics: Some(listening("127.0.0.1:9464")),
        }
    );
    assert_eq!(read.metrics_on(Some("robot")), Some(&listening("127.0.0.1:9464")));
    assert_eq!(read.metrics_on(None), Some(&listening("127.0.0.1:1")));
    for (lines, fault) in [
        ("listen = ['tcp/robot']", "machine `robot`: `tcp/robot` is no endpoint"),
        ("insecure = 1", "`insecure` wants true or false, this is an integer"),
        ("connect = 'tcp/a:1'", "`connect` wants an array of strings, this is a string"),
        ("connect = ['tcp/a:1', 2]", "`connect` wants an array of strings, this is an integer"),
        ("outage_s = -1", "`outage_s` wants seconds, from 0 to 86400"),
        ("outage_s = 'long'", "`outage_s` wants seconds, from 0 to 86400"),
        ("lisen = []", "unknown key `lisen` in machine `robot`"),
    ] {
        assert_told(&machine(lines), [&*format!("error: {fault}")]);
    }
    let keyless = "[machine.base]\n".to_owned() + &machine("key = 'Cargo.toml'");
    assert_told(&keyless, ["error: machine `base` has no `key`, but machine `robot` has one"]);
}

#[test]
fn an_endpoint_has_a_protocol_a_host_and_a_port() {
    for endpoint in ["tcp/192.168.0.2:7447", "udp/[::1]:7447", "tls/host:1#iface=eth0", "quic/host:65535?x"] {
        assert!(check_endpoint(endpoint).is_ok(), "{endpoint}");
    }
    for endpoint in ["tcp/:7447", "ftp/host:1", "tcp/host:65536", "tcp/host", "host:1", "tcp/host:1:x"] {
        assert_eq!(check_endpoint(endpoint).unwrap_err().what, format!("`{endpoint}` is no endpoint"));
    }
}

#[test]
fn who_offers_metrics_to_everyone_is_warned() {
    let metrics = |said: &str| format!("metrics = {said}\n{}", sound());
    let read = pipeline(&metrics("{ listen = '0.0.0.0:9464', token = 'secret' }")).metrics.unwrap();
    assert_eq!((read.listen.port(), read.token.as_deref()), (9464, Some("secret")));
    let open = "warning: everyone who reaches 0.0.0.0:9464 may read the metrics";
    for (said, expected) in [
        ("'0.0.0.0:9464'", vec![open]),
        ("{ listen = '0.0.0.0:9464' }", vec![open]),
        ("{ listen = '0.0.0.0:9464', token = 'secret' }", vec![]),
        ("'127.0.0.1:9464'", vec![]),
        ("{ token = 'secret' }", vec!["error: `metrics` has no `listen`"]),
        ("'here'", vec!["error: `metrics` cannot be `here`, expected ADDRESS:PORT in numbers"]),
        ("{ listen = '[::1]:1', tokn = 'a' }", vec!["error: unknown key `tokn` in `metrics`"]),
    ] {
        assert_eq!(told(&metrics(said)), expected, "{said}");
    }
    let text = format!(
        "name = 'test'\n[machine.robot]\n[machine.base]\nmetrics = '0.0.0.0:9464'\n{}",
        on("robot", &program("a", ""))
    );
    let warnings = |machine| read_on(Some(machine), &text, &[]).map(|(_, report)| first_lines(&report)).unwrap();
    assert_eq!([warnings("robot"), warnings("base")], [vec![], vec![open.to_owned()]], "it is that machine's concern");
}

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
        ("rate_hz = 0", "`rate_hz` is 0, allowed is from 0 to 100"),
        ("rate_hz = 100.5", "`rate_hz` is 100.5, allowed is from 0 to 100"),
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
            "error: --set:1:16: `rate_hz` is -1, allowed is from 0 to 100",
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
        diagnostic::Place { source, span: start..start + piece.len() }
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
