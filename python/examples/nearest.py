"""A stage of a pipeline: passes on the objects that are nearest to the camera.

    [stage.nearest]
    program     = ["python3", "nearest.py"]
    input       = "objects"
    output      = { topic = "nearest", kind = "objects" }
    max_objects = 1
"""

import conicflow

with conicflow.stage() as stage:
    most = stage.parameters.get("max_objects", 1)
    for message in stage:
        by_depth = sorted(message.items, key=lambda each: each.center[2])
        stage.send(by_depth[:most])
        stage.count("farther objects", len(by_depth[most:]))
