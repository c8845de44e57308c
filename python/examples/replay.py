"""A source of a pipeline: plays depth images from a NumPy file, an array of (frames, rows, columns) of uint16 or float32.

    [stage.camera]
    program = ["python3", "replay.py"]
    output  = { topic = "depth", kind = "depth" }
    path    = "frames.npy"
    camera  = [525.0, 525.0, 319.5, 239.5]
    rate_hz = 30

A camera works in the same way: open it before the loop, and send its images.
"""

from pathlib import Path

import numpy as np

import conicflow

with conicflow.source() as source:
    frames = np.load(Path(source.base) / source.parameters["path"], mmap_mode="r")
    for number in source:
        if number >= len(frames):
            break
        source.send(frames[number], camera=source.parameters["camera"], stamp_ns=round(number * 1e9 / 30))
