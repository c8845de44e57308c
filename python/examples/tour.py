# %% [markdown]
# # conicflow in Python
# A simulated Kinect looks at a trash can, a parking cone and a ball. We take a depth image from the running pipeline, find the
# objects in it ourselves, follow the ball, and draw both. Run it as it is, with `matplotlib` installed and the program
# `conicflow` on the path, or open it as a notebook (`# %%` begins a cell).

# %%
import os
import subprocess
import sys
import time
from pathlib import Path

import matplotlib

if "ipykernel" not in sys.modules:
    matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import conicflow

pictures = Path(sys.argv[1] if len(sys.argv) == 2 else ".")
program = os.environ.get("CONICFLOW", "conicflow")
pipeline = subprocess.Popen([program, "run", "--quiet", "--for", "20s"], stdout=subprocess.DEVNULL)


def topic(name):
    """Yields the messages of a topic while the pipeline runs; waits for it to start."""
    while pipeline.poll() is None:
        try:
            yield from conicflow.read(name)
        except RuntimeError:
            time.sleep(0.1)


# %% [markdown]
# ## One frame
# `message.image` is in shared memory, where the camera wrote it. `detect` gives the same results as the pipeline.

# %%
message = next(topic("depth"))
objects = conicflow.detect(message.image, camera=message.camera, scale=message.scale, noise=message.noise)
for each in objects:
    print(each.kind, np.round(each.center, 3), "+-", np.round(each.sigma.center, 4), "m, arc", round(each.arc, 2), "rad")


# %% [markdown]
# ## Draw the objects
# A shape is drawn as the circles at its ends, or around its middle, projected into the image.


# %%
def circle(center, axis, radius, camera):
    """Pixels of a circle around an axis, in metres before the camera."""
    center, axis = np.asarray(center), np.asarray(axis) / np.linalg.norm(axis)
    across = np.cross(axis, [1.0, 0.0, 0.0] if abs(axis[0]) < 0.9 else [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    turn = np.linspace(0, 2 * np.pi, 60)[:, None]
    x, y, z = (center + radius * (np.cos(turn) * across + np.sin(turn) * np.cross(axis, across))).T
    fx, fy, cx, cy = camera
    return np.column_stack([fx * x / z + cx, fy * y / z + cy])


def circles(each, camera):
    """Returns the circles that represent a shape."""
    if each.kind == "sphere":
        return [circle(each.center, each.center, each.radius, camera)]
    center, half = np.asarray(each.center), np.asarray(each.axis) * each.length / 2
    narrow, wide = (each.radius, each.radius) if each.kind == "cylinder" else (each.top_radius, each.base_radius)
    return [circle(center - half, each.axis, narrow, camera), circle(center + half, each.axis, wide, camera)]


COLOURS = {"sphere": "tab:orange", "cylinder": "tab:cyan", "cone": "tab:pink"}
figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
depth = np.where(message.image > 0, message.image * message.scale, np.nan)
shown = axes.imshow(depth, cmap="gray_r")
figure.colorbar(shown, label="depth in metres", shrink=0.8)
for each in objects:
    ends = circles(each, message.camera)
    for end in ends:
        axes.plot(*end.T, color=COLOURS[each.kind], linewidth=2)
    if len(ends) == 2:
        for side in (np.argmin, np.argmax):
            line = np.array([end[side(end[:, 0])] for end in ends])
            axes.plot(*line.T, color=COLOURS[each.kind], linewidth=2)
    size = each.radius or each.base_radius
    corner = np.concatenate(ends).min(axis=0) - (0, 6)
    axes.annotate(f"{each.kind}, {100 * size:.1f} cm", corner, color=COLOURS[each.kind], weight="bold")
axes.set(xlabel="u in pixels", ylabel="v in pixels", title=f"Frame {message.sequence}, found by conicflow.detect")
figure.savefig(pictures / "python-objects.png", dpi=90)
del message, depth

# %% [markdown]
# ## Follow them
# Tracks have an identity and a velocity. Structured arrays need no loop over tracks.

# %%
paths = {}
for message in topic("tracks"):
    for track, row in zip(message.items, message.array):
        if track.state == "confirmed":
            paths.setdefault((track.id, track.kind), []).append((message.stamp_ns * 1e-9, *row["object"]["center"]))
    if message.stamp_ns > 8e9:
        break
pipeline.terminate()
pipeline.wait()

figure, axes = plt.subplots(figsize=(8, 4), layout="constrained")
for (number, kind), path in paths.items():
    seconds, x, _, z = np.array(path).T
    axes.plot(x, z, ".-", markersize=3, color=COLOURS[kind], label=f"{number}: {kind}, {seconds[-1] - seconds[0]:.1f} s")
axes.set(xlabel="x in metres", ylabel="z in metres", title="Tracks in the frame of the camera, from above", aspect="equal")
axes.legend(loc="center left", bbox_to_anchor=(1, 0.5))
figure.savefig(pictures / "python-tracks.png", dpi=90)
