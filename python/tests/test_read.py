"""Tests of live topics: messages equal the output of the pipeline's sinks; images are lent, read-only, and limited in number."""

import gc
import itertools
import json
import pickle
import subprocess
import sys

import numpy as np
import pytest
from pipelines import OBJECTS

import conicflow


@pytest.fixture
def running(playground):
    """Starts a pipeline that runs at 50 Hz until it is stopped."""
    playground.write("pipeline.toml", OBJECTS.format(rate_hz=50))
    process = playground.start("run", "--quiet")
    playground.wait_until("there are objects", lambda: (playground.folder / "objects.jsonl").exists())
    return process


def take(reader, number):
    return list(itertools.islice(reader, number))


def test_objects_are_those_of_the_sink(playground, running):
    with conicflow.read("objects") as reader:
        messages = take(reader, 8)
    running.send_signal(subprocess.signal.SIGINT)
    playground.end(running)
    lines = [json.loads(line) for line in (playground.folder / "objects.jsonl").read_text().splitlines()]
    by_number = {line["sequence"]: line for line in lines}
    assert len({message.sequence for message in messages}) == 8
    for message in messages:
        line = by_number[message.sequence]
        assert (message.topic, message.kind, message.source) == ("objects", "objects", line["source"])
        assert message.stamp_ns == line["stamp_ns"] and 0 < message.latency_ms < 60_000
        assert [item.to_dict() for item in message.items] == line["objects"]
        assert {**message.to_dict(), "latency_ms": line["latency_ms"]} == line
        assert all(isinstance(item, conicflow.Object) for item in message.items)


def test_arrays_hold_what_the_records_show(running):
    for message in take(conicflow.read("objects"), 3):
        assert message.array.dtype == conicflow.dtype("objects") and len(message.array) == len(message) > 0
        for row, item in zip(message.array, message.items):
            assert row["center"].tolist() == item.center and row["points"] == item.points and row["arc"] == item.arc
            assert np.sqrt(row["sigma"]["center"].diagonal()).tolist() == item.sigma.center
            assert np.isclose(row["confidence"], item.confidence) and row["sigma"]["radius"] == item.sigma.radius
        with pytest.raises(ValueError):
            message.array["points"] = 1
    for message in take(conicflow.read("ellipses"), 2):
        for row, item in zip(message.array, message.items):
            assert (row["line"], row["first"], row["last"]) == (item.line, item.first, item.last)
            assert row["semi_axes"].tolist() == item.semi_axes and row["moments"][0] == item.points


def test_an_image_cannot_be_written(running):
    (message,) = take(conicflow.read("depth"), 1)
    image = message.image
    assert image.shape == (120, 160) and image.dtype == np.uint16 and message.size == (160, 120)
    assert message.camera == (110.0, 110.0, 79.5, 59.5) and message.scale > 0 and message.noise["floor_m"] > 0
    for view in (image, image[10:, ::2], image.reshape(-1), image.view("u1"), message.array, np.asarray(image)):
        assert np.shares_memory(view, image) and not view.flags.writeable
        with pytest.raises(ValueError):
            view[...] = 1
        with pytest.raises(ValueError):
            view.flags.writeable = True
    objects = conicflow.detect(image, camera=message.camera, scale=message.scale, noise=message.noise)
    assert objects and np.median(image[image > 0]) * message.scale > 0.1
    assert message.items == [] and len(message) == 160 * 120
    with pytest.raises(TypeError, match="carries objects, no images"):
        take(conicflow.read("objects"), 1)[0].image


def test_an_image_outlives_everything_but_itself(playground, running):
    """The array alone keeps the memory: message and reader are gone, the run is over, and its files are removed."""
    reader = conicflow.read("depth")
    image = take(reader, 1)[0].image[20:100, 30:]
    before = image.copy()
    reader.close()
    del reader
    gc.collect()
    for _ in itertools.islice(conicflow.read("depth"), 30):
        pass
    assert np.array_equal(image, before), "no writer uses the memory again"
    running.send_signal(subprocess.signal.SIGINT)
    playground.end(running)
    assert np.array_equal(image, before)


def test_who_holds_too_many_images_is_told_and_may_go_on(running):
    reader = conicflow.read("depth")
    held = take(reader, 4)
    with pytest.raises(BufferError, match="4 images of topic `depth` are still held.*\n  hint: keep copies"):
        next(reader)
    images = [message.image for message in held]
    del held
    gc.collect()
    with pytest.raises(BufferError):
        next(reader)
    copies = [image.copy() for image in images]
    before, images = copies[0].copy(), []
    gc.collect()
    assert next(reader).image.shape == (120, 160) and np.array_equal(copies[0], before)


def test_lists_may_be_kept_without_bound(running):
    messages = take(conicflow.read("objects"), 40)
    assert len({message.sequence for message in messages}) == 40


def test_a_message_is_not_pickled(running):
    for message in take(conicflow.read("depth", "objects"), 2):
        with pytest.raises(TypeError, match="cannot be copied or pickled\n  hint: pickle message.items, message.image.copy"):
            pickle.dumps(message)


def test_an_arc_of_the_widest_image_is_unpickled(running):
    message = next(message for message in conicflow.read("ellipses") if message.items)
    arc, array = message.items[0], message.array[:1].copy()
    make, (layout, _) = arc.__reduce__()
    for scan in (0, 1):
        array["scan"], array["line"], array["first"], array["last"] = scan, 4000, 16_000, 16_383
        wide = make(layout, array.tobytes())
        assert wide.last == 16_383 and pickle.loads(pickle.dumps(wide)) == wide
        array["last"] = 16_384
        with pytest.raises(ValueError, match="16385"):
            make(layout, array.tobytes())


def test_several_topics_come_by_their_names(running):
    reader = conicflow.read("depth", "objects", pipeline="tested")
    seen = set()
    while seen != {"depth", "objects"}:
        seen.add(next(reader).topic)


def test_an_onlooker_costs_no_message(playground):
    playground.write("pipeline.toml", OBJECTS.format(rate_hz=0))
    process = playground.start("run", "--frames", 60)
    playground.wait_until("there are objects", lambda: (playground.folder / "objects.jsonl").exists())
    slow = [conicflow.read("depth", "objects") for _ in range(2)]
    firsts = [next(reader) for reader in slow]
    playground.end(process)
    lines = (playground.folder / "objects.jsonl").read_text().splitlines()
    assert [json.loads(line)["sequence"] for line in lines] == list(range(60)) and len(firsts) == 2
    assert all(message.sequence < 60 for reader in slow for message in reader), "the end of the run ends the loop"


@pytest.mark.parametrize(
    ("call", "told"),
    [
        (lambda: conicflow.read("object"), "has no topic `object`\n  hint: did you mean `objects`"),
        (lambda: conicflow.read("objects", pipeline="tasted"), "no pipeline `tasted` runs"),
    ],
)
def test_what_is_not_there_is_told(running, call, told):
    with pytest.raises(RuntimeError) as error:
        call()
    assert told in str(error.value)


def test_without_a_pipeline_there_is_a_hint(playground):
    with pytest.raises(RuntimeError, match="no pipeline runs.*\n  hint: start one with `conicflow run`"):
        conicflow.read("objects")
    with pytest.raises(TypeError, match="got no topic"):
        conicflow.read()
    with pytest.raises(TypeError, match="`topic` is \\['objects'\\] \\(list\\), expected a str\n  hint: give each topic by its name"):
        conicflow.read(["objects"])


def test_ctrl_c_ends_a_reader_that_waits(playground):
    """While no messages come, Python raises KeyboardInterrupt."""
    playground.write("pipeline.toml", OBJECTS.format(rate_hz="1e-3"))
    process = playground.start("run", "--quiet")
    playground.wait_until("there are objects", lambda: (playground.folder / "objects.jsonl").exists())
    program = (
        "import conicflow, os, signal, threading\n"
        # A shell starts background processes with SIGINT ignored, and Python keeps that: the reader would wait for ever.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "reader = conicflow.read('objects')\n"
        "try:\n"
        "    threading.Timer(0.3, lambda: os.kill(os.getpid(), signal.SIGINT)).start()\n"
        "    for _ in reader: pass\n"
        "except KeyboardInterrupt:\n"
        "    print('interrupted')\n"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert ended.stdout == "interrupted\n", ended.stderr
    assert process.poll() is None
