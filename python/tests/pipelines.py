"""Pipeline files for the tests: stages of conicflow up to a topic, followed by programs in Python."""

OBJECTS = """
name = "tested"

[stage.camera]
node       = "synthetic_source"
output     = "depth"
width      = 160
height     = 120
rate_hz    = {rate_hz}
intrinsics = {{ fx = 110, fy = 110, cx = 79.5, cy = 59.5 }}

[stage.extractor]
node   = "row_ellipse_extractor"
input  = {{ topic = "depth", delivery = "lossless" }}
output = "ellipses"

[stage.assembler]
node   = "object_assembler"
input  = {{ topic = "ellipses", delivery = "lossless" }}
output = "objects"

[stage.objects]
node  = "json_sink"
input = {{ topic = "objects", delivery = "lossless" }}
path  = "objects.jsonl"
"""
"""A pipeline that finds objects and writes them into `objects.jsonl`."""


def sink(name, topic, kind):
    """A sink that writes all messages of a topic into `NAME.jsonl`."""
    return f"""
[stage.{name}]
node  = "json_sink"
input = {{ topic = "{topic}", delivery = "lossless", kind = "{kind}" }}
path  = "{name}.jsonl"
"""
