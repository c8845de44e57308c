#!/usr/bin/env python3
"""Prints the objects that one machine of a pipeline sends to another. It needs no conicflow: it decodes the messages itself.

    pip install eclipse-zenoh
    read_objects.py tcp/127.0.0.1:7447 PIPELINE MACHINE TOPIC

The key is conicflow/PIPELINE/MACHINE/TOPIC, where MACHINE writes TOPIC. The bytes (bridge/src/wire/mod.rs): `CFLO`, the
version as u16, session as u64, a code of 32 bytes, stream, number and oldest number as u64, all little-endian; then bincode 2,
standard configuration: the names of the layouts, the header, the list. This script trusts its input: it ignores the
code, which authenticates the message to those with the machines' key.
"""

import json
import struct
import sys
import threading
import time

import zenoh

LAYOUT = "conicflow.Header.v2 conicflow.Object.v2"
KINDS = {0: "sphere", 1: "cylinder", 2: "cone"}
END_OF_STREAM = 1
PLACE = "<4sHQ32sQQQ"


class Bytes:
    """Decodes bincode: integers of variable length, floats of eight bytes, text and lists preceded by their length."""

    def __init__(self, content):
        self.content, self.at = content, 0

    def take(self, form):
        values = struct.unpack_from("<" + form, self.content, self.at)
        self.at += struct.calcsize("<" + form)
        return values

    def whole(self):
        (first,) = self.take("B")
        return first if first < 251 else self.take({251: "H", 252: "I", 253: "Q"}[first])[0]

    def reals(self, count):
        return list(self.take(f"{count}d"))

    def text(self):
        (raw,) = self.take(f"{self.whole()}s")
        return raw.decode()


def read_header(data):
    epoch, sequence, number, stamp_ns = (data.whole() for _ in range(4))
    data.whole(), data.whole()  # width and height in pixels
    data.reals(4 + 1 + 4 + 12)  # fx fy cx cy, depth scale, noise model, pose
    source, flags, _ = data.text(), data.whole(), data.whole()
    for _ in range(8):  # hops: stage, received_ns, sent_ns
        data.text(), data.whole(), data.whole()
    return {"sequence": sequence, "stamp_ns": stamp_ns, "source": source, "flags": flags}


def read_object(data):
    kind, points, rows = (data.whole() for _ in range(3))
    (confidence,) = data.take("f")
    center, axis = data.reals(3), data.reals(3)
    radius, length, half_angle, base_radius, top_radius = data.reals(5)
    apex = data.reals(3)
    data.reals(9 + 4)  # covariance of the centre; sigma of axis, radius, length, half angle
    rms, arc = data.reals(2)
    item = {"kind": KINDS[kind], "center": center, "points": points, "rows": rows, "rms": rms, "arc": arc}
    item["confidence"] = confidence
    if item["kind"] != "sphere":
        item |= {"axis": axis, "length": length}
    if item["kind"] == "cone":
        return item | {"apex": apex, "half_angle": half_angle, "base_radius": base_radius, "top_radius": top_radius}
    return item | {"radius": radius}


def read_message(content):
    magic, version, _session, _code, stream, number, _oldest = struct.unpack_from(PLACE, content)
    if (magic, version) != (b"CFLO", 5):
        raise ValueError(f"this script reads version 5 of the wire, got {magic!r} version {version}")
    data = Bytes(content[struct.calcsize(PLACE) :])
    layout = data.text()
    if layout != LAYOUT:
        raise ValueError(f"this script reads `{LAYOUT}`, got `{layout}`")
    header = read_header(data)
    ended = header.pop("flags") & END_OF_STREAM
    objects = [] if ended else [read_object(data) for _ in range(data.whole())]
    return stream, number, header | {"objects": objects}, bool(ended)


def main(endpoint, pipeline, machine, topic):
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    config.insert_json5("connect/endpoints", json.dumps([endpoint]))
    done = threading.Event()
    newest, failure = (None, 0), None

    def receive(sample):
        nonlocal failure
        try:
            look_at(sample)
        except Exception as error:  # standard output is closed, or the message is of another version
            failure = error
            done.set()

    def look_at(sample):
        nonlocal newest
        stream, number, message, ended = read_message(sample.payload.to_bytes())
        if stream == newest[0] and number <= newest[1]:
            return  # a retransmission: the receiver of a lossless edge had not acknowledged it
        newest = (stream, number)
        if not ended:
            print(json.dumps(message), flush=True)
        else:
            done.set()

    with zenoh.open(config) as session:
        while not session.info.peers_zid() and not session.info.routers_zid():
            time.sleep(0.1)  # it connects as soon as there is a peer
        subscriber = session.declare_subscriber(f"conicflow/{pipeline}/{machine}/{topic}", receive)
        print("listening", file=sys.stderr, flush=True)
        done.wait()
        subscriber.undeclare()
    if failure is not None:
        sys.exit(f"error: {failure}")


if __name__ == "__main__":
    if len(sys.argv) != 5:
        sys.exit(__doc__)
    main(*sys.argv[1:])
