"""Spheres, cylinders and cones in depth images, found and tracked.

    import conicflow

    objects = conicflow.detect(depth, camera=(fx, fy, cx, cy), scale=0.001, noise="kinect_v1")
    for each in objects:
        print(each.kind, each.center, each.radius, each.sigma.radius, each.to_dict())

Units are metres, radians and seconds; the camera frame is the optical frame: x right, y down, z forward.
"""

from ._conicflow import (
    Detector,
    Ellipse,
    Object,
    Record,
    Track,
    Tracker,
    Velocity,
    __version__,
    detect,
)

__all__ = [
    "Detector",
    "Ellipse",
    "Object",
    "Record",
    "Track",
    "Tracker",
    "Velocity",
    "__version__",
    "detect",
]
