"""Tests of processes that are forked from a reader or a stage: a child does not own the reader or the stage, and does not affect
it."""

import subprocess
import sys

import pytest
from pipelines import OBJECTS, sink
from test_stage import lines, numbers, pipeline, stage

READER = """
import conicflow, gc, itertools, os, sys

with conicflow.read("depth") as reader:
    message = next(reader)
    image, before = message.image, message.image.copy()
    child = os.fork()
    if child == 0:
        for use in (lambda: next(reader), lambda: message.image, lambda: message.array, lambda: message.to_dict()):
            try:
                use()
            except (RuntimeError, BufferError) as error:
                assert "another process, from which this one was forked" in str(error) and "hint: " in str(error), error
            else:
                raise AssertionError("it was used")
        assert len(message) == 160 * 120 and message.camera and repr(message)
        with conicflow.read("objects") as own:
            assert len(list(itertools.islice(own, 3))) == 3
        del image, message, use
        gc.collect()
        sys.exit(7)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
    assert len(list(itertools.islice((each.sequence for each in reader), 40))) == 40, "it goes on"
    assert (image == before).all(), "no writer uses the memory again"
"""


def test_a_child_of_a_reader_gives_nothing_back(playground):
    playground.write("pipeline.toml", OBJECTS.format(rate_hz=50))
    playground.start("run", "--quiet")
    playground.wait_until("there are objects", lambda: (playground.folder / "objects.jsonl").exists())
    ended = subprocess.run([sys.executable, "-c", READER], capture_output=True, text=True, timeout=60)
    assert ended.returncode == 0, ended.stderr


FORK = """
        if {number} == 3:
            child = os.fork()
            if child == 0:
                for use in (lambda: {place}.send({sent}), lambda: {place}.count("uses"), lambda: {place}.stopping, lambda: next({place})):
                    try:
                        use()
                    except RuntimeError as error:
                        assert "this stage was made in another process" in str(error) and "hint: " in str(error), error
                    else:
                        os._exit(9)
                {end}
            status = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
            assert status == {status}, status
"""


@pytest.mark.parametrize(("end", "status"), [("sys.exit(7)", 7), ("raise ValueError('in the child')", 1)])
def test_a_child_of_a_stage_does_not_end_it(playground, end, status):
    fork = FORK.format(number="message.sequence", place="stage", sent="message", end=end, status=status)
    program = playground.script(
        "fork.py",
        f"""
import conicflow, os, sys

with conicflow.stage() as stage:
    for message in stage:
        {fork.strip()}
        stage.send(message)
""",
    )
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"))
    playground.run("run", "--frames", 20)
    assert numbers(playground, "passed") == list(range(20))
    assert [line["objects"] for line in lines(playground, "passed")] == [
        line["objects"] for line in lines(playground, "objects")
    ]


def test_a_child_of_a_source_does_not_end_it(playground):
    sent = "np.zeros((12, 16), np.uint16), camera=(10, 10, 8, 6)"
    fork = FORK.format(number="number", place="source", sent=sent, end="sys.exit(7)", status=7)
    program = playground.script(
        "fork.py",
        f"""
import conicflow, os, sys
import numpy as np

with conicflow.source(total=10) as source:
    for number in source:
        if number == 10:
            break
        {fork.strip()}
        source.send({sent})
""",
    )
    taker = playground.script(
        "take.py",
        """
import conicflow

with conicflow.stage() as stage, open("taken.txt", "w") as taken:
    for message in stage:
        print(message.sequence, file=taken)
""",
    )
    text = f"""
name = "tested"

[stage.source]
program = {program}
output  = {{ topic = "depth", kind = "depth" }}

[stage.taker]
program = {taker}
input   = {{ topic = "depth", delivery = "lossless" }}
"""
    playground.write("pipeline.toml", text)
    playground.run("run")
    assert (playground.folder / "taken.txt").read_text().split() == [str(number) for number in range(10)]
