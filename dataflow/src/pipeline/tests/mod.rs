//! Pipelines of made-up nodes: how files are read, and which faults are reported.

mod machines;
mod stages;
mod values;

use super::*;
use crate::network::{Carrier, Network};
use crate::node::{Node, Variant};
use crate::ports::{Delivery, TopicReader};
use crate::side_inputs::SideInput;
use conicflow_messages::{AnyByte, Hinted, Item, LINE_KEYS, Nothing, Object, Track};
use serde_json::{Value as Json, json};

pub(crate) const fn variant(input: &'static str, output: &'static str) -> Variant {
    Variant { input, output, run: |_, _| Ok(()) }
}

pub(crate) const fn node(name: &'static str, variants: &'static [Variant]) -> Node {
    let (check, settle) = (|_, _: &Path| Ok(vec![]), Ok);
    let schema = || json!({ "properties": {} });
    Node {
        name,
        summary: "",
        variants,
        side_inputs: || &[],
        schema,
        check,
        reads: |_, _| vec![],
        writes: |_, _| vec![],
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
    let warnings = |machine: &Machine| match machine.outage_s {
        Some(0.0) => vec![Hinted::new("its certificate has expired", "make another")],
        _ => Vec::new(),
    };
    Network { check, warnings, listen_endpoints: |_| Ok(Vec::new()), carrier }
}

/// The folder of this package serves as that of the file.
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

/// The first lines of a report's faults, without positions.
fn first_lines(report: &Report) -> Vec<String> {
    let text = report.to_string();
    let lines = text.lines().filter(|line| line.starts_with("error: ") || line.starts_with("warning: "));
    let without_place = |line: &str| {
        let parts: Vec<_> = line.splitn(5, ':').collect();
        format!("{}:{}", parts[0], parts[4])
    };
    lines.map(without_place).collect()
}

/// Faults of a pipeline with these stages.
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

/// A stage that runs a program.
fn program(name: &str, keys: &str) -> String {
    format!("[stage.{name}]\nprogram = ['sh']\n{keys}\n")
}

/// The valid pipeline with further lines for its camera.
fn with_camera(lines: &str) -> String {
    [CAMERA, lines, "\n", DETECTOR, PRINTER].concat()
}

const MACHINES: &str = "[machine.robot]\n[machine.base]\n";

fn on(machine: &str, stage: &str) -> String {
    format!("{stage}machine = '{machine}'\n")
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
