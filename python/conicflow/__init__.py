"""Spheres, cylinders and cones in depth images, found and tracked.

    import conicflow

    objects = conicflow.detect(depth, camera=(fx, fy, cx, cy), scale=0.001, noise="kinect_v1")
    for each in objects:
        print(each.kind, each.center, each.radius, each.sigma.radius, each.to_dict())

    for message in conicflow.read("objects"):  # a pipeline that runs on this machine
        print(message.sequence, message.stamp_ns, message.items)

Stages and sources of a pipeline are written with `conicflow.stage()` and `conicflow.source()`.

Units are metres, radians and seconds; the camera frame is the optical frame: x right, y down, z forward.
"""

from ._conicflow import (
    Detector,
    Ellipse,
    Message,
    Object,
    Reader,
    Record,
    Source,
    Stage,
    Track,
    Tracker,
    Velocity,
    __version__,
    array,
    detect,
    dtype,
    read,
    source,
    stage,
)

__all__ = [
    "Detector",
    "Ellipse",
    "Message",
    "Object",
    "Reader",
    "Record",
    "Source",
    "Stage",
    "Track",
    "Tracker",
    "Velocity",
    "__version__",
    "array",
    "detect",
    "dtype",
    "read",
    "source",
    "stage",
]
