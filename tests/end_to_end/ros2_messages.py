#!/usr/bin/env python3
"""Reads messages with `rosbags`, which nobody here wrote: `ros2_messages.py ros/ FOLDER`.

The number of each type in `ros/src/definition.rs` has to be that of its text, and of every distribution that has the type. Each
file of the folder, `*.PACKAGE.TYPE`, has to be decoded and encoded to the same bytes.
"""

import pathlib
import re
import sys

from rosbags.typesys import Stores, get_types_from_msg, get_typestore

ros, folder = map(pathlib.Path, sys.argv[1:])
table = re.findall(r'name: "(\S+)",\s*text: include_str!\("../(\S+)"\),\s*rihs01: "(\w+)"', (ros / "src/definition.rs").read_text())
distributions = [get_typestore(store) for store in Stores if store.name.removeprefix("ROS2_") in ("HUMBLE", "IRON", "JAZZY", "KILTED", "LYRICAL")]
assert len(distributions) == 5, "the distributions that rosbags knows"

stores = {}
for name, text, number in table:
    store = stores[name] = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg((ros / text).read_text(), name))
    known = [distribution.hash_rihs01(name) for distribution in distributions if name in distribution.fielddefs]
    for told in [store.hash_rihs01(name), *known]:
        assert told == f"RIHS01_{number}", f"{name} is {told}, not {number}"
    print(name, "is the same in", len(known), "distributions")

messages = [path for path in sorted(folder.iterdir()) if path.suffixes and f"{path.name.split('.')[-2]}/msg/{path.name.split('.')[-1]}" in stores]
for path in messages:
    package, kind = path.name.split(".")[-2:]
    name, bytes_ = f"{package}/msg/{kind}", path.read_bytes()
    message = stores[name].deserialize_cdr(bytes_, name)
    again = bytes(stores[name].serialize_cdr(message, name))
    assert again == bytes_, f"{path.name}: {len(bytes_)} bytes, {len(again)} again"
    if kind == "Detection3DArray":
        for detection in message.detections:
            assert detection.results[0].hypothesis.class_id in ("sphere", "cylinder", "cone")
            assert detection.results[0].pose.covariance.shape == (36,) and int(detection.id) >= 0
            assert (detection.bbox.center.position.z > 0) and detection.header.frame_id == message.header.frame_id
    if kind == "MarkerArray":
        assert all(marker.lifetime.nanosec == 500_000_000 and marker.type in (2, 3, 9, 11) for marker in message.markers)
print(len(table), "types,", len(messages), "messages")
