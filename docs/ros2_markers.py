#!/usr/bin/env python3
"""Draws docs/pictures/ros2_markers.png anew: docs/ros2_markers.py [PATH/TO/conicflow]

Markers of `ros2_sink` come through a Zenoh router to this program, are decoded by rosbags, and are drawn as the definition of
`visualization_msgs/Marker` says, which is what RViz does. It needs eclipse-zenoh, rosbags and matplotlib.
"""

import pathlib
import subprocess
import sys
import tempfile
import time

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import zenoh
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from rosbags.typesys import Stores, get_typestore

HERE = pathlib.Path(__file__).parent
ROUTER = "tcp/127.0.0.1:7461"
SPHERE, CYLINDER, TEXT, TRIANGLES = 2, 3, 9, 11


def rotation(q):
    x, y, z, w = q.x, q.y, q.z, q.w
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def surface(marker):
    """The corners of polygons of a marker, before its pose."""
    scale = np.array([marker.scale.x, marker.scale.y, marker.scale.z])
    around = np.linspace(0, 2 * np.pi, 33)
    if marker.type == TRIANGLES:
        return np.array([[point.x, point.y, point.z] for point in marker.points]).reshape(-1, 3, 3) * scale
    if marker.type == CYLINDER:
        rings = np.array([[np.cos(around) / 2, np.sin(around) / 2, np.full(33, end)] for end in (-0.5, 0.5)])
    else:
        down = np.linspace(0, np.pi, 17)
        rings = np.array([[np.cos(around) * np.sin(a) / 2, np.sin(around) * np.sin(a) / 2, np.full(33, np.cos(a) / 2)] for a in down])
    rings = rings.transpose(0, 2, 1) * scale
    quads = [[one[i], one[i + 1], other[i + 1], other[i]] for one, other in zip(rings, rings[1:]) for i in range(32)]
    return np.array(quads)


def newest(program):
    """The last markers of eight seconds of the default scene."""
    config = zenoh.Config.from_json5(f'{{mode: "router", listen: {{endpoints: ["{ROUTER}"]}}, scouting: {{multicast: {{enabled: false}}}}}}')
    heard = []
    with zenoh.open(config) as session, tempfile.TemporaryDirectory() as folder:
        session.declare_subscriber("0/conicflow/tracks/markers/**", lambda sample: heard.append(sample.payload.to_bytes()))
        sink = f'\n[stage.ros]\nnode = "ros2_sink"\ninput = {{ topic = "tracks", delivery = "lossless" }}\nconnect = ["{ROUTER}"]\n'
        pipeline = pathlib.Path(folder, "pipeline.toml")
        pipeline.write_text((HERE.parent / "pipeline.toml").read_text() + sink)
        subprocess.run([program, "run", pipeline, "--quiet", "--frames", "60"], check=True, stdout=subprocess.DEVNULL)
        time.sleep(1)
    store = get_typestore(Stores.ROS2_JAZZY)
    return store.deserialize_cdr(heard[-1], "visualization_msgs/msg/MarkerArray").markers


def draw(markers):
    figure = plt.figure(figsize=(8, 6), dpi=110)
    axes = figure.add_subplot(projection="3d")
    # The optical frame has y down and z forward; axes of a room have z up.
    room = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    corners = []
    for marker in markers:
        place = np.array([marker.pose.position.x, marker.pose.position.y, marker.pose.position.z])
        color = (marker.color.r, marker.color.g, marker.color.b, marker.color.a)
        if marker.type == TEXT:
            axes.text(*(room @ place), marker.text, color="black", size=8, ha="center", zorder=1000)
            continue
        polygons = (surface(marker) @ rotation(marker.pose.orientation).T + place) @ room.T
        axes.add_collection3d(Poly3DCollection(polygons, facecolors=color, edgecolors=(0, 0, 0, 0.08), linewidths=0.3))
        corners.append(polygons.reshape(-1, 3))
        print(marker.ns, marker.id, marker.type, place.round(3), marker.scale)
    low, high = np.min(np.concatenate(corners), axis=0), np.max(np.concatenate(corners), axis=0)
    middle, half = (low + high) / 2, (high - low).max() / 2
    axes.set(**{f"{axis}lim": (m - half, m + half) for axis, m in zip("xyz", middle)})
    axes.set(xlabel="x [m]", ylabel="z, forward [m]", zlabel="-y, up [m]")
    axes.set_box_aspect((1, 1, 1), zoom=1.15)
    axes.view_init(elev=18, azim=-70)
    figure.tight_layout()
    figure.savefig(HERE / "pictures/ros2_markers.png")


draw(newest(pathlib.Path(sys.argv[1] if len(sys.argv) == 2 else "target/release/conicflow").resolve()))
