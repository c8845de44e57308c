#!/usr/bin/env python3
"""The JSON schema of pipeline files, as the `jsonschema` package of Python applies it, which nobody here wrote.

`schema.py SCHEMA FILE..` makes sure that all files fit, and that of what is changed in the first of them one fault is told, by name.
"""

import copy
import json
import pathlib
import sys
import tomllib

import jsonschema

schema, *files = map(pathlib.Path, sys.argv[1:])
validator = jsonschema.Draft7Validator(json.loads(schema.read_text()))
validator.check_schema(validator.schema)
pipelines = [tomllib.loads(file.read_text()) for file in files]
for file, pipeline in zip(files, pipelines, strict=True):
    assert not list(validator.iter_errors(pipeline)), (file, jsonschema.exceptions.best_match(validator.iter_errors(pipeline)))

for path, value, expected in [
    ("stage.source.rate", 15, "Additional properties are not allowed ('rate' was unexpected)"),
    ("stage.source.width", "wide", "'wide' is not of type 'integer'"),
    ("stage.source.intrinsics", {"fx": 1, "fy": 1, "cx": 0, "cy": 0, "cz": 0}, "Additional properties are not allowed ('cz' was unexpected)"),
    ("stage.extractor.inputs", {}, "Additional properties are not allowed ('inputs' was unexpected)"),
    ("stage.extractor.input", {"topic": "depth", "quee": 4}, "Additional properties are not allowed ('quee' was unexpected)"),
    ("stage.source.noise", "kinect", "'kinect' is not one of ["),
    ("stage.source.noise", {"floor": 0.001}, "Additional properties are not allowed ('floor' was unexpected)"),
    ("stage.source.noise", {"edge_jitter_px": 9}, "9 is greater than the maximum of 8"),
    ("stage.source.sensor", {"stero": {}}, "Additional properties are not allowed ('stero' was unexpected)"),
    ("stage.source.sensor", {"stereo": {"baseline_m": "wide"}}, "'wide' is not of type 'number'"),
    ("stage.source.restart", {"hang": 5}, "Additional properties are not allowed ('hang' was unexpected)"),
    ("stage.source.restart", {"join_s": 0}, "0 is less than the minimum of 1"),
    ("stage.source.restart", True, "True is not of type 'string', 'object'"),
    ("stage.tracker.node", "kalman", "'kalman' is not one of ["),
    ("stage.other", {"output": "depth"}, "'node' is a required property"),
    ("stage.other", {"program": "./own"}, "'./own' is not of type 'array'"),
]:
    pipeline = copy.deepcopy(pipelines[0])
    *parents, key = path.split(".")
    table = pipeline
    for parent in parents:
        table = table[parent]
    table[key] = value
    [fault] = validator.iter_errors(pipeline)
    assert fault.message.startswith(expected), (path, fault.message)
print(len(files), "files")
