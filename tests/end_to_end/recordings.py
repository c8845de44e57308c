#!/usr/bin/env python3
"""Recordings between this program and others, by the `rosbags` and `mcap` packages, which nobody here wrote.

`recordings.py read RUN.mcap TRACKS.jsonl` reads a recording of `mcap_sink` with both, and compares all that is in it with the lines
that the same run wrote. `recordings.py write FOLDER` writes the same few frames as arrays (`frames/`) and as recordings in every
encoding and compression: `same_*` with the same pixels, `near_*` with depths that are rounded otherwise, `old_*` to be converted.
"""

import json
import pathlib
import struct
import sys
import zlib

import mcap.reader
import mcap.writer
import mcap_ros2.decoder
import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

HUMBLE, NOETIC = get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.ROS1_NOETIC)
WIDTH, HEIGHT, FOCAL, BEGIN_S, FRAMES = 160, 120, 150.0, 1_700_000_000, 4
IMAGES, INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"


def read(run, lines):
    lines = [json.loads(line) for line in lines.read_text().splitlines()]
    with run.open("rb") as file:
        reader = mcap.reader.make_reader(file, validate_crcs=True)
        channels = {channel.topic: channel for channel in reader.get_summary().channels.values()}
        assert all(channel.message_encoding in ("cdr", "conicflow") for channel in channels.values()), channels
    with run.open("rb") as file:
        reader = mcap.reader.make_reader(file, decoder_factories=[mcap_ros2.decoder.DecoderFactory()])
        told = [decoded for *_, decoded in reader.iter_decoded_messages(topics=["/source/tracks/list"])]
    check_lists(told, lines)
    images, told, checked = {}, [], 0
    with AnyReader([run]) as reader:
        kinds = [*HUMBLE.fielddefs, "conicflow_msgs/msg/Tracks"]
        for connection, time_ns, data in reader.messages([c for c in reader.connections if c.msgtype in kinds]):
            message, part = reader.deserialize(data, connection.msgtype), connection.topic.split("/")[-1]
            header = message.transforms[0].header if part == "tf" else message.markers[0].header if part == "markers" else message.header
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == time_ns
            if part == "image_rect_raw":
                assert (message.encoding, message.step, header.frame_id) == ("16UC1", 2 * message.width, "source")
                images[time_ns] = np.frombuffer(message.data, "<u2").reshape(message.height, message.width) / 1000.0
            elif part == "camera_info":
                fx, cx = message.k[0], message.k[2]
                assert list(message.p[[0, 2, 5, 6]]) == list(message.k[[0, 2, 4, 5]]) and not any(message.d)
            elif part == "tf":
                assert (header.frame_id, message.transforms[0].child_frame_id) == ("world", "source")
            elif connection.topic == "/source/tracks/list":
                told.append(message)
            elif connection.topic == "/source/tracks/markers":
                checked += check_markers(message.markers, tracks_at(lines, time_ns))
            elif connection.topic == "/source/tracks/points":
                check_points(message, tracks_at(lines, time_ns))
    check_lists(told, lines)
    assert len(images) == len(lines)
    near = [image[image > 0].min() for image in images.values()]
    assert all(0.5 < depth < 3.0 for depth in near) and fx > 100 and cx > 50, (near, fx, cx)
    print(len(lines), "frames,", checked, "markers")


def check_lists(lists, lines):
    """All that the lines of json_sink tell is there by the same name, and nothing else but numbers that are none."""
    assert [(told.sequence, told.source) for told in lists] == [(line["sequence"], line["source"]) for line in lines]
    kinds = set()
    for told, line in zip(lists, lines, strict=True):
        assert told.latency_ms > 0.0
        for item, track in zip(told.items, line["tracks"], strict=True):
            check_item(item, track)
            assert item.sigma.radius == track["sigma"]["radius"] > 0.0
            kinds.add(item.kind)
    assert kinds == {"sphere", "cylinder", "cone"}, kinds


def check_item(item, keys):
    names = [name for name in getattr(item, "__dataclass_fields__", None) or item.__slots__ if name != "__msgtype__"]
    assert set(keys) <= set(names), (keys, names)
    for name in names:
        value = getattr(item, name)
        if isinstance(keys.get(name), dict):
            check_item(value, keys[name])
        elif name in keys:
            assert np.array_equal(value, keys[name]) or name == "confidence" and np.float32(keys[name]) == value, (name, value, keys)
        else:
            assert np.isnan(value).all(), (name, value, keys)


def tracks_at(lines, time_ns):
    [tracks] = [line["tracks"] for line in lines if line["stamp_ns"] == time_ns]
    return tracks


def check_markers(markers, tracks):
    """The first marker takes the others away; then each track has a shape and a label."""
    assert markers[0].action == 3 and len(markers) == 1 + 2 * len(tracks)
    for track, shape, label in zip(tracks, markers[1::2], markers[2::2], strict=True):
        assert shape.ns == track["kind"] and label.text.startswith(f"{track['id']} {track['kind']} "), label.text
        if track["kind"] == "cone":
            corners = np.array([[point.x, point.y, point.z] for point in shape.points])
            top = np.array(track["center"]) - 0.5 * track["length"] * np.array(track["axis"])
            end = np.array(track["apex"]) if track["top_radius"] <= 0 else top
            assert np.abs(corners - end).max(axis=1).min() < 1e-9, "a cone ends at its apex, or where it is seen to end"
            continue
        place = shape.pose.position
        assert np.allclose([place.x, place.y, place.z], track["center"])
        width = 2 * track["radius"]
        length = width if track["kind"] == "sphere" else track["length"]
        assert np.allclose([shape.scale.x, shape.scale.y, shape.scale.z], [width, width, length])
    return len(markers)


def check_points(cloud, tracks):
    """The points of each track lie on its surface, but for the last ones, which show where it goes."""
    assert [field.name for field in cloud.fields] == ["x", "y", "z", "rgb"] and cloud.point_step == 16
    points = np.frombuffer(cloud.data, "<f4").reshape(-1, 4)[:, :3].astype(float)
    assert len(points) == cloud.width and (not tracks or len(points) % len(tracks) == 0)
    for track, own in zip(tracks, np.split(points, max(len(tracks), 1)), strict=False):
        center, velocity = np.array(track["center"]), np.array(track["velocity"])
        assert np.allclose(own[-1], center + 0.5 * velocity, atol=1e-4)
        if track["kind"] == "sphere":
            assert np.allclose(np.linalg.norm(own[:288] - center, axis=1), track["radius"], atol=1e-5)


def frames():
    """A ball that moves before a wall, in millimetres, as noisy as a Kinect's."""
    noise = np.random.default_rng(1)
    y, x = np.mgrid[:HEIGHT, :WIDTH]
    rays = np.stack([(x - (WIDTH - 1) / 2) / FOCAL, (y - (HEIGHT - 1) / 2) / FOCAL, np.ones_like(x, float)], axis=-1)
    for number in range(FRAMES):
        center = np.array([0.05 * number, 0.02, 1.0])
        along, square = rays @ center, (rays**2).sum(axis=-1)
        root = along**2 - square * (center @ center - 0.15**2)
        depth_m = np.where(root > 0, (along - np.sqrt(np.maximum(root, 0))) / square, 2.0)
        depth_m += noise.normal(scale=0.0012 + 0.0019 * (depth_m - 0.4) ** 2)
        yield np.round(1000 * depth_m).astype(np.uint16)


def stamp(store, number):
    return store.types["builtin_interfaces/msg/Time"](BEGIN_S, 100_000_000 * number)


def header(store, number):
    fields = (stamp(store, number), "optical")
    return store.types["std_msgs/msg/Header"](*((number, *fields) if store is NOETIC else fields))


def image(store, number, pixels, encoding, order="<", padding=0):
    rows = pixels.astype(np.dtype(pixels.dtype).newbyteorder(order)).view(np.uint8).reshape(HEIGHT, -1)
    rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=7)
    data = np.ascontiguousarray(rows).reshape(-1)
    return store.types["sensor_msgs/msg/Image"](header(store, number), HEIGHT, WIDTH, encoding, int(order == ">"), rows.shape[1], data)


def info(store, number):
    cx, cy = (WIDTH - 1) / 2, (HEIGHT - 1) / 2
    k = np.array([FOCAL, 0, cx, 0, FOCAL, cy, 0, 0, 1.0])
    p = np.array([FOCAL, 0, cx, 0, 0, FOCAL, cy, 0, 0, 0, 1.0, 0])
    region = store.types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False)
    return store.types["sensor_msgs/msg/CameraInfo"](header(store, number), HEIGHT, WIDTH, "plumb_bob", np.zeros(5), k, np.eye(3).reshape(-1), p, 0, 0, region)


def compressed(number, pixels, words, code, quantisation=(0.0, 0.0)):
    data = struct.pack("<iff", 0, *quantisation) + code(pixels)
    return HUMBLE.types["sensor_msgs/msg/CompressedImage"](header(HUMBLE, number), f"{words}; compressedDepth{' rvl' if code is rvl else ' png'}", np.frombuffer(data, np.uint8))


def png(pixels):
    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    begin = struct.pack(">IIBBBBB", WIDTH, HEIGHT, 16, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", begin) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def rvl(pixels):
    """Runs of zeros and of others, these as differences, in pieces of three bits and one that tells whether more follow."""
    pieces, values, at, before = [], pixels.reshape(-1).astype(int).tolist(), 0, 0

    def add(number):
        while True:
            pieces.append(number & 7 | (8 if number > 7 else 0))
            number >>= 3
            if not number:
                return

    while at < len(values):
        for is_run in (lambda value: value == 0, lambda value: value != 0):
            start = at
            while at < len(values) and is_run(values[at]):
                at += 1
            add(at - start)
        for value in values[start:at]:
            difference, before = value - before, value
            add(difference << 1 ^ difference >> 31)
    pieces += [0] * (-len(pieces) % 8)
    words = (int("".join(f"{piece:x}" for piece in pieces[place : place + 8]), 16) for place in range(0, len(pieces), 8))
    return struct.pack("<II", WIDTH, HEIGHT) + b"".join(struct.pack("<I", word) for word in words)


def inverse(pixels):
    """Inverse depths in equal steps, as image_transport has them by default for up to 10 m."""
    a = 100.0 * 101.0
    b = 1.0 - a / 10.0
    return np.round(a / (pixels / 1000.0) + b).astype(np.uint16), (a, b)


def write_mcap(path, compression, name, messages):
    """By the writer of the makers of the format, with chunks so small that there are several."""
    with path.open("wb") as file:
        writer = mcap.writer.Writer(file, chunk_size=20_000, compression=compression)
        writer.start(profile="ros2")
        channels = {}
        for topic, kind, messages in [(INFO, "sensor_msgs/msg/CameraInfo", [info(HUMBLE, n) for n in range(FRAMES)]), (*name, messages)]:
            schema = writer.register_schema(kind, "ros2msg", HUMBLE.generate_msgdef(kind)[0].encode())
            channels[topic] = (writer.register_channel(topic, "cdr", schema), kind, messages)
        for number in range(FRAMES):
            for channel, kind, messages in channels.values():
                time_ns = BEGIN_S * 10**9 + 100_000_000 * number
                writer.add_message(channel, time_ns, bytes(HUMBLE.serialize_cdr(messages[number], kind)), time_ns, number)
        writer.finish()


def write_bag(writer, store, serialize, images):
    with writer:
        for topic, messages in ((INFO, [info(store, number) for number in range(FRAMES)]), (IMAGES, images)):
            kind = messages[0].__msgtype__
            connection = writer.add_connection(topic, kind, typestore=store)
            for number, message in enumerate(messages):
                writer.write(connection, BEGIN_S * 10**9 + 100_000_000 * number, serialize(message, kind))


def write(folder):
    (folder / "frames").mkdir(parents=True)
    all_frames = list(frames())
    for number, pixels in enumerate(all_frames):
        np.save(folder / f"frames/{number}.npy", pixels)
    camera = {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": (WIDTH - 1) / 2, "cy": (HEIGHT - 1) / 2, "depth_scale": 0.001}
    (folder / "frames/camera.json").write_text(json.dumps(camera))

    compressions, raw = mcap.writer.CompressionType, (IMAGES, "sensor_msgs/msg/Image")
    packed = (f"{IMAGES}/compressedDepth", "sensor_msgs/msg/CompressedImage")
    numbered = list(enumerate(all_frames))
    metres = [(number, (pixels / 1000.0).astype(np.float32)) for number, pixels in numbered]
    for path, compression, name, messages in [
        ("same_16uc1_lz4", compressions.LZ4, raw, [image(HUMBLE, n, p, "16UC1") for n, p in numbered]),
        ("same_16uc1_padded_big_endian", compressions.NONE, raw, [image(HUMBLE, n, p, "16UC1", ">", 6) for n, p in numbered]),
        ("same_mono16_zstd", compressions.ZSTD, raw, [image(HUMBLE, n, p, "mono16") for n, p in numbered]),
        ("same_compressed_png", compressions.ZSTD, packed, [compressed(n, p, "16UC1", png) for n, p in numbered]),
        ("same_compressed_rvl", compressions.LZ4, packed, [compressed(n, p, "16UC1", rvl) for n, p in numbered]),
        ("near_32fc1", compressions.LZ4, raw, [image(HUMBLE, n, p, "32FC1") for n, p in metres]),
        ("near_32fc1_padded_big_endian", compressions.NONE, raw, [image(HUMBLE, n, p, "32FC1", ">", 4) for n, p in metres]),
        ("near_inverse_png", compressions.NONE, packed, [compressed(n, inverse(p)[0], "32FC1", png, inverse(p)[1]) for n, p in numbered]),
        ("near_inverse_rvl", compressions.NONE, packed, [compressed(n, inverse(p)[0], "32FC1", rvl, inverse(p)[1]) for n, p in numbered]),
    ]:
        write_mcap(folder / f"{path}.mcap", compression, name, messages)

    images = [image(HUMBLE, n, p, "16UC1") for n, p in numbered]
    for name, storage in [("same_rosbags", rosbag2.StoragePlugin.MCAP), ("same_rosbags_zstd", rosbag2.StoragePlugin.MCAP), ("old_sqlite", rosbag2.StoragePlugin.SQLITE3)]:
        writer = rosbag2.Writer(folder / name, version=9, storage_plugin=storage)
        if name.endswith("zstd"):
            writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        write_bag(writer, HUMBLE, HUMBLE.serialize_cdr, images)
    write_bag(rosbag1.Writer(folder / "old_ros1.bag"), NOETIC, NOETIC.serialize_ros1, [image(NOETIC, n, p, "16UC1") for n, p in numbered])


{"read": read, "write": write}[sys.argv[1]](*map(pathlib.Path, sys.argv[2:]))
