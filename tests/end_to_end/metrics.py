"""Reads what a run tells of itself, from standard input, with the parser of Prometheus' own Python client, which refuses what is not
in the form: a sample for each line, as JSON. The end-to-end tests of metrics run it."""

import json
import sys

from prometheus_client.openmetrics.parser import text_string_to_metric_families

for family in text_string_to_metric_families(sys.stdin.read()):
    assert family.documentation, f"{family.name} has no help"
    for sample in family.samples:
        print(json.dumps({"type": family.type, "name": sample.name, "labels": sample.labels, "value": sample.value}))
