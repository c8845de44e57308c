//! Tests of the JSON schema of pipeline files, and of `docs/pipeline.schema.json`, which holds it for editors that open the files
//! of this repository. `UPDATE_EXPECT=1` writes it anew.

use crate::NODES;
use conicflow_dataflow::pipeline::file_schema;
use jsonschema::Validator;
use serde_json::{Value as Json, json};
use std::path::{Path, PathBuf};

fn validator() -> Validator {
    let schema = file_schema(NODES);
    assert!(jsonschema::draft7::meta::is_valid(&schema), "the schema itself is one");
    jsonschema::draft7::new(&schema).unwrap()
}

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

/// The pipeline files of the repository.
fn files() -> Vec<PathBuf> {
    let of_folder = |folder: &str| std::fs::read_dir(root().join(folder)).unwrap().map(|entry| entry.unwrap().path());
    let in_root = ["pipeline.toml", "pipeline.two-machines.toml"].map(|name| root().join(name));
    let files = ["examples", "experiments"].into_iter().flat_map(of_folder).chain(in_root);
    files.filter(|path| path.extension().is_some_and(|extension| extension == "toml")).collect()
}

fn read(text: &str) -> Json {
    serde_json::to_value(toml::from_str::<toml::Value>(text).unwrap()).unwrap()
}

#[test]
fn every_pipeline_file_of_the_repository_fits_the_schema() {
    let (validator, files) = (validator(), files());
    assert!(files.len() > 20, "{} files", files.len());
    for file in files {
        let pipeline = read(&std::fs::read_to_string(&file).unwrap());
        let faults: Vec<_> = validator.iter_errors(&pipeline).map(|fault| fault.to_string()).collect();
        assert!(faults.is_empty(), "{}: {faults:#?}", file.display());
    }
}

#[test]
fn the_schema_in_docs_is_the_one_that_the_command_prints() {
    let (path, schema) = (root().join("docs/pipeline.schema.json"), format!("{:#}\n", file_schema(NODES)));
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        std::fs::write(path, schema).unwrap();
    } else {
        let is_current = std::fs::read_to_string(path).unwrap_or_default() == schema;
        assert!(is_current, "docs/pipeline.schema.json is old: UPDATE_EXPECT=1 writes it anew");
    }
}

#[test]
fn every_pipeline_file_of_the_repository_names_the_schema_for_editors() {
    let schema = root().join("docs/pipeline.schema.json").canonicalize().unwrap();
    for file in files() {
        let text = std::fs::read_to_string(&file).unwrap();
        let named = text.lines().next().and_then(|line| line.strip_prefix("#:schema "));
        let path = named.map(|path| file.parent().unwrap().join(path));
        assert_eq!(path.and_then(|path| path.canonicalize().ok()), Some(schema.clone()), "{}", file.display());
    }
}

/// Returns the validator's faults for the default pipeline with another value at this place.
fn faults(pointer: &str, key: &str, value: Json) -> Vec<String> {
    let mut pipeline = read(include_str!("../../pipeline.toml"));
    pipeline.pointer_mut(pointer).unwrap()[key] = value;
    validator().iter_errors(&pipeline).map(|fault| format!("{}: {fault}", fault.instance_path())).collect()
}

#[test]
fn faults_do_not_fit_the_schema() {
    for (pointer, key, value) in [
        ("", "stages", json!({})),
        ("", "name", json!("two words")),
        ("", "machine", json!({ "robot": { "listens": [] } })),
        ("", "metrics", json!({ "token": "0123456789ab" })),
        ("/stage/source", "rate_hz", json!("15")),
        ("/stage/source", "width", json!(-1)),
        ("/stage/source", "input", json!("depth")),
        ("/stage/source", "node", json!("no_such_node")),
        ("/stage/extractor", "input", json!({ "topic": "depth", "delivery": "some" })),
        ("/stage/extractor", "input", json!({ "topic": "depth", "queue": 65 })),
        ("/stage/extractor", "inputs", json!({ "depth": "depth" })),
        ("/stage/tracker", "env", json!({ "LEVEL": 3 })),
    ] {
        assert!(!faults(pointer, key, value.clone()).is_empty(), "{pointer}/{key} = {value}");
    }
}

/// Editors show the fault at its place, with its name.
#[test]
fn faults_are_reported_with_their_key() {
    let unexpected = |key: &str| format!("Additional properties are not allowed ('{key}' was unexpected)");
    for (place, value, within, expected) in [
        ("source/rate", json!(15.0), "source", unexpected("rate")),
        ("source/width", json!("wide"), "source/width", "\"wide\" is not of type \"integer\"".into()),
        (
            "assembler/min_confidence",
            json!(1.5),
            "assembler/min_confidence",
            "1.5 is greater than the maximum of 1".into(),
        ),
        ("extractor/input", json!({ "topic": "depth", "quee": 4 }), "extractor/input", unexpected("quee")),
        (
            "source/intrinsics",
            json!({ "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "cz": 0.0 }),
            "source/intrinsics",
            unexpected("cz"),
        ),
        ("other/output", json!("depth"), "other", "\"node\" is a required property".into()),
    ] {
        expect_fault(place, value, within, &expected);
    }
}

/// The file has a choice between a word and a table here.
#[test]
fn faults_within_a_choice_are_reported_with_their_key() {
    for (key, value) in [
        ("noise", json!("ideal")),
        ("noise", json!({ "floor_m": 0.001 })),
        ("sensor", json!("stereo")),
        ("sensor", json!({ "stereo": { "baseline_m": 0.05 } })),
        ("restart", json!({ "when": "never", "hang_s": 5, "join_s": 5 })),
    ] {
        let reported = faults("/stage/source", key, value.clone());
        assert!(reported.is_empty(), "{key} = {value}: {reported:#?}");
    }
    for (key, value, within, expected) in [
        ("noise", json!("kinect"), "noise", "\"kinect\" is not one of \"kinect_v1\", "),
        ("noise", json!(3), "noise", "3 is not of types \"string\", \"object\""),
        ("noise", json!({ "floor": 0.001 }), "noise", "Additional properties are not allowed ('floor' was unexpected)"),
        ("noise", json!({ "floor_m": "much" }), "noise/floor_m", "\"much\" is not of type \"number\""),
        ("noise", json!({ "edge_jitter_px": 9.0 }), "noise/edge_jitter_px", "9.0 is greater than the maximum of 8"),
        ("sensor", json!("stero"), "sensor", "\"stero\" is not one of \"stereo\", "),
        ("sensor", json!({ "stero": {} }), "sensor", "Additional properties are not allowed ('stero' was unexpected)"),
        ("sensor", json!({}), "sensor", "{} has less than 1 property"),
        (
            "sensor",
            json!({ "stereo": { "baseline": 0.05 } }),
            "sensor/stereo",
            "Additional properties are not allowed ('baseline' was unexpected)",
        ),
        (
            "sensor",
            json!({ "stereo": { "baseline_m": "wide" } }),
            "sensor/stereo/baseline_m",
            "\"wide\" is not of type \"number\"",
        ),
        ("restart", json!("sometimes"), "restart", "\"sometimes\" is not one of \"never\", "),
        ("restart", json!({ "hang": 5 }), "restart", "Additional properties are not allowed ('hang' was unexpected)"),
        ("restart", json!({ "hang_s": 0 }), "restart/hang_s", "0 is less than the minimum of 1"),
    ] {
        expect_fault(&format!("source/{key}"), value, &format!("source/{within}"), expected);
    }
}

/// Expects one fault, at its place, for a stage whose key has this value.
fn expect_fault(place: &str, value: Json, within: &str, expected: &str) {
    let (stage, key) = place.split_once('/').unwrap();
    let reported = match stage {
        "other" => faults("/stage", stage, json!({ key: value })),
        _ => faults(&format!("/stage/{stage}"), key, value),
    };
    assert!(reported.len() == 1 && reported[0].starts_with(&format!("/stage/{within}: {expected}")), "{reported:#?}");
}

#[test]
fn all_keys_of_the_file_fit_the_schema() {
    let mut pipeline = read(include_str!("../../pipeline.toml"));
    pipeline["machine"]["robot"] = json!({
        "listen": ["tcp/127.0.0.1:7447"], "connect": [], "zenoh": "z.json5", "key": "robot.key", "insecure": true,
        "outage_s": 3, "metrics": "127.0.0.1:9464",
    });
    pipeline["metrics"] = json!({ "listen": "0.0.0.0:9464", "token": "0123456789ab" });
    pipeline["item"]["grasps"] = json!({ "type": "acme.Grasp.v1", "fields": { "width": "f64" }, "usual_length": 4 });
    let input =
        json!({ "topic": "objects", "kind": "objects", "delivery": "latest", "queue": 2, "compression": "lz4" });
    pipeline["stage"]["own"] = json!({
        "program": ["./own", "--fast"], "input": input, "inputs": { "depth": "depth" }, "machine": "robot",
        "output": { "topic": "grasps", "kind": "grasps" }, "restart": "never", "env": { "LEVEL": "3" }, "speed": 3,
    });
    assert!(validator().is_valid(&pipeline));
    pipeline["stage"]["own"]["node"] = json!("console_sink");
    assert!(!validator().is_valid(&pipeline), "either a node or a program");
}
