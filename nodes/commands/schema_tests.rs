//! Tests of the JSON schema of pipeline files, and of `docs/pipeline.schema.json`, which holds it for the editors of those that
//! open the files here. `UPDATE_EXPECT=1` writes it anew.

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
fn every_pipeline_file_here_fits_the_schema() {
    let (validator, files) = (validator(), files());
    assert!(files.len() > 20, "{} files", files.len());
    for file in files {
        let pipeline = read(&std::fs::read_to_string(&file).unwrap());
        let faults: Vec<_> = validator.iter_errors(&pipeline).map(|fault| fault.to_string()).collect();
        assert!(faults.is_empty(), "{}: {faults:#?}", file.display());
    }
}

#[test]
fn the_schema_in_the_documents_is_that_of_the_command() {
    let (path, schema) = (root().join("docs/pipeline.schema.json"), format!("{:#}\n", file_schema(NODES)));
    if std::env::var_os("UPDATE_EXPECT").is_some() {
        std::fs::write(path, schema).unwrap();
    } else {
        let is_current = std::fs::read_to_string(path).unwrap_or_default() == schema;
        assert!(is_current, "docs/pipeline.schema.json is old: UPDATE_EXPECT=1 writes it anew");
    }
}

#[test]
fn every_pipeline_file_here_leads_editors_to_the_schema() {
    let schema = root().join("docs/pipeline.schema.json").canonicalize().unwrap();
    for file in files() {
        let text = std::fs::read_to_string(&file).unwrap();
        let named = text.lines().next().and_then(|line| line.strip_prefix("#:schema "));
        let path = named.map(|path| file.parent().unwrap().join(path));
        assert_eq!(path.and_then(|path| path.canonicalize().ok()), Some(schema.clone()), "{}", file.display());
    }
}

#[test]
fn faults_do_not_fit_the_schema() {
    let validator = validator();
    let with = |pointer: &str, key: &str, value: Json| -> Vec<String> {
        let mut pipeline = read(include_str!("../../pipeline.toml"));
        pipeline.pointer_mut(pointer).unwrap()[key] = value;
        validator.iter_errors(&pipeline).map(|fault| format!("{}: {fault}", fault.instance_path())).collect()
    };
    let fits = |pointer, key, value| with(pointer, key, value).is_empty();
    assert!(fits("/stage/source", "rate_hz", json!(15.0)) && fits("/stage/source", "restart", json!({ "hang_s": 5 })));
    for (pointer, key, value) in [
        ("", "stages", json!({})),
        ("", "name", json!("two words")),
        ("", "machine", json!({ "robot": { "listens": [] } })),
        ("", "metrics", json!({ "token": "0123456789ab" })),
        ("/stage/source", "rate", json!(15.0)),
        ("/stage/source", "rate_hz", json!("15")),
        ("/stage/source", "width", json!(-1)),
        ("/stage/source", "input", json!("depth")),
        ("/stage/source", "node", json!("no_such_node")),
        ("/stage/source", "restart", json!("sometimes")),
        ("/stage/extractor", "input", json!({ "topic": "depth", "delivery": "some" })),
        ("/stage/extractor", "input", json!({ "topic": "depth", "queue": 65 })),
        ("/stage/extractor", "inputs", json!({ "depth": "depth" })),
        ("/stage/assembler", "min_confidence", json!(1.5)),
        ("/stage/tracker", "env", json!({ "LEVEL": 3 })),
    ] {
        assert!(!fits(pointer, key, value.clone()), "{pointer}/{key} = {value}");
    }
    // Editors show the fault where it is, and name it.
    for (pointer, key, value, told) in [
        (
            "/stage/source",
            "rate",
            json!(15.0),
            "/stage/source: Additional properties are not allowed ('rate' was unexpected)",
        ),
        ("/stage/source", "width", json!("wide"), "/stage/source/width: \"wide\" is not of type \"integer\""),
        (
            "/stage/assembler",
            "min_confidence",
            json!(1.5),
            "/stage/assembler/min_confidence: 1.5 is greater than the maximum of 1",
        ),
        (
            "/stage/extractor",
            "input",
            json!({ "topic": "depth", "quee": 4 }),
            "/stage/extractor/input: Additional properties are not allowed ('quee' was unexpected)",
        ),
        (
            "/stage/source",
            "intrinsics",
            json!({ "fx": 1.0, "fy": 1.0, "cx": 0.0, "cy": 0.0, "cz": 0.0 }),
            "/stage/source/intrinsics: Additional properties are not allowed ('cz' was unexpected)",
        ),
        ("/stage", "other", json!({ "output": "depth" }), "/stage/other: \"node\" is a required property"),
    ] {
        let told_all = with(pointer, key, value);
        assert!(told_all.len() == 1 && told_all[0].starts_with(told), "{told_all:#?}");
    }
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
