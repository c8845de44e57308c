"""Tests of stages and sources in Python, which behave like those in Rust."""

import json
import signal

import pytest
import scenes
from pipelines import OBJECTS, sink

import conicflow

PASS = """
import conicflow

with conicflow.stage() as stage:
    for message in stage:
        stage.send(message)
"""


def lines(playground, name):
    return [json.loads(line) for line in (playground.folder / f"{name}.jsonl").read_text().splitlines()]


def numbers(playground, name):
    return [line["sequence"] for line in lines(playground, name)]


def wait_for_lines(playground):
    path = playground.folder / "passed.jsonl"
    playground.wait_until("something passed", lambda: path.exists() and path.read_text().count("\n") > 2)


def stage(program, topic="objects", delivery="lossless", output="passed", keys=""):
    output = f'output  = {{ topic = "{output}", kind = "objects" }}' if output else ""
    return f"""
[stage.python]
program = {program}
input   = {{ topic = "{topic}", delivery = "{delivery}" }}
{output}
{keys}
"""


def pipeline(playground, text, rate_hz=0):
    playground.write("pipeline.toml", OBJECTS.format(rate_hz=rate_hz) + text)


def test_a_stage_passes_on_all_to_the_bit(playground):
    program = playground.script("pass.py", PASS)
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"))
    _, told = playground.run("run", "--frames", 50)
    expected, passed = lines(playground, "objects"), lines(playground, "passed")
    assert [line["sequence"] for line in passed] == list(range(50))
    assert [line["objects"] for line in passed] == [line["objects"] for line in expected]
    assert any(len(line["objects"]) > 0 for line in passed)
    assert "python" in told


def test_records_and_arrays_may_be_sent_and_what_is_not_answered_gives_an_empty_list(playground):
    program = playground.script(
        "choose.py",
        """
import conicflow
import numpy as np

with conicflow.stage() as stage:
    assert stage.name == "python" and stage.parameters == {"max_objects": 1, "words": ["a", "b"]} and stage.resume_at == 0
    assert stage.dtype == conicflow.dtype("objects") and stage.base
    for message in stage:
        nearest = sorted(message.items, key=lambda each: each.center[2])[: stage.parameters["max_objects"]]
        stage.count("farther objects", len(message.items) - len(nearest))
        if message.sequence % 3 == 0:
            stage.send(nearest)
        elif message.sequence % 3 == 1:
            stage.send(message.array[:1], source="renamed")
""",
    )
    text = stage(program, keys='max_objects = 1\nwords = ["a", "b"]') + sink("passed", "passed", "objects")
    pipeline(playground, text)
    _, told = playground.run("run", "--frames", 12)
    for before, after in zip(lines(playground, "objects"), lines(playground, "passed")):
        number, objects = before["sequence"], before["objects"]
        assert after["sequence"] == number and after["stamp_ns"] == before["stamp_ns"]
        if number % 3 == 0:
            assert after["objects"] == sorted(objects, key=lambda each: each["center"][2])[:1]
        elif number % 3 == 1:
            assert after["objects"] == objects[:1] and after["source"] == "renamed"
        else:
            assert after["objects"] == []
    assert "python found in 12 frames" in told


def test_further_inputs_are_of_the_same_frame(playground):
    program = playground.script(
        "pair.py",
        """
import conicflow

with conicflow.stage(same_frame=["depth"]) as stage, open("pairs.txt", "w") as pairs:
    detector = None
    for message in stage:
        depth = message.inputs["depth"]
        detector = detector or conicflow.Detector(depth.camera, scale=depth.scale, noise=depth.noise)
        found = detector.detect(depth.image)
        latest = message.inputs.get("ellipses")
        is_list = latest is None or latest.kind == "ellipses"
        print(message.sequence, depth.sequence, found == message.items, is_list, file=pairs)
""",
    )
    further = 'inputs = { depth = { topic = "depth", delivery = "lossless" }, ellipses = "ellipses" }'
    pipeline(playground, stage(program, output=None, keys=further))
    playground.run("run", "--frames", 20)
    rows = (playground.folder / "pairs.txt").read_text().splitlines()
    assert rows == [f"{number} {number} True True" for number in range(20)], "and they are the pipeline's, to the bit"


def test_a_slow_stage_takes_the_newest_and_the_rest_is_counted(playground):
    program = playground.script(
        "slow.py",
        """
import conicflow, time

with conicflow.stage() as stage, open("seen.txt", "w") as seen:
    for message in stage:
        print(message.sequence, file=seen)
        stage.count("slow frames")
        time.sleep(0.05)
""",
    )
    pipeline(playground, stage(program, delivery="latest", output=None))
    _, told = playground.run("run", "--frames", 120)
    seen = [int(line) for line in (playground.folder / "seen.txt").read_text().split()]
    assert seen == sorted(set(seen)) and 1 < len(seen) < 120
    assert f"python: slow frames: {len(seen)}\n" in told
    (row,) = (line.split() for line in told.splitlines() if line.split()[:2] == ["objects", "python"])
    assert row[2] == str(len(seen)) and 0 < int(row[3]) <= 120 - len(seen), told


def test_a_run_that_is_told_to_end_ends_in_order(playground):
    program = playground.script("pass.py", PASS + '\nopen("finished.txt", "w").write("well")\n')
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"), rate_hz=100)
    process = playground.start("run")
    wait_for_lines(playground)
    process.send_signal(signal.SIGINT)
    _, told = playground.end(process)
    assert numbers(playground, "passed") == numbers(playground, "objects")
    assert (playground.folder / "finished.txt").read_text() == "well" and "Traceback" not in told


def test_a_stage_that_fails_is_started_anew_and_loses_one_frame(playground):
    program = playground.script(
        "fail.py",
        """
import conicflow

with conicflow.stage() as stage:
    for message in stage:
        if message.sequence == 7:
            raise ValueError("not this one")
        stage.send(message, source=f"after {stage.resume_at}")
""",
    )
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"), rate_hz=50)
    _, told = playground.run("run", "--frames", 40, code=1)
    passed = numbers(playground, "passed")
    assert passed[:7] == list(range(7)) and 7 not in passed and passed[-1] == 39 and len(passed) > 20
    assert "not complete: `python` lost" in told and "of 40 messages of the lossless topic `objects`" in told
    assert "at frame 7" in told and "ValueError: not this one" in told
    assert {line["source"] for line in lines(playground, "passed")} == {"after 0", "after 7"}


def test_what_cannot_be_made_ready_ends_the_run(playground):
    program = playground.script(
        "refuse.py",
        """
import conicflow

with conicflow.stage() as stage:
    stage.parameters["path"]
    for message in stage:
        stage.send(message)
""",
    )
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"))
    _, told = playground.run("run", "--frames", 40, code=1)
    assert "KeyError: 'path'" in told and "stage `python` could not start" in told


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("conicflow.stage(same_frame=['colour'])", "has no `colour` among its `inputs`"),
        ("conicflow.source()", "this stage has an `input` in the pipeline file"),
    ],
)
def test_a_place_that_is_not_there_ends_the_run(playground, text, told):
    program = playground.script("wrong.py", f"import conicflow\n{text}\n")
    pipeline(playground, stage(program, output=None))
    _, error = playground.run("run", "--frames", 40, code=1)
    assert told in error and "could not start" in error


def test_a_stage_is_replaced_without_the_loss_of_a_frame(playground):
    program = playground.script(
        "version.py",
        PASS.replace("stage.send(message)", 'stage.send(message, source=stage.parameters["version"])'),
    )
    text = stage(program, keys='version = "old"') + sink("passed", "passed", "objects")
    pipeline(playground, text, rate_hz=50)
    process = playground.start("run")
    wait_for_lines(playground)
    playground.run("swap", "python", "--set", "version=new")
    number = len(lines(playground, "passed"))
    playground.wait_until("more came", lambda: len(lines(playground, "passed")) > number + 5)
    process.send_signal(signal.SIGINT)
    playground.end(process)
    passed = lines(playground, "passed")
    assert [line["sequence"] for line in passed] == list(range(len(passed)))
    versions = [line["source"] for line in passed]
    assert versions == sorted(versions, reverse=True) and set(versions) == {"old", "new"}


def test_top_shows_a_stage_in_python(playground):
    program = playground.script("pass.py", PASS)
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"), rate_hz=50)
    process = playground.start("run", "--quiet")
    wait_for_lines(playground)
    shown, _ = playground.run("top", "--once")
    row = next(row for row in json.loads(shown)["pipelines"][0]["stages"] if row["stage"] == "python")
    assert row["rate_hz"] > 1 and row["compute_p50_ms"] > 0 and row["messages"] > 2, row
    assert process.poll() is None


def test_a_source_in_python_is_as_good_as_a_folder_of_images(playground):
    (playground.folder / "frames").mkdir()
    for number in range(5):
        scenes.write_png(playground.folder / f"frames/{number}.png", scenes.millimetres(number))
    camera = ",".join(map(str, scenes.CAMERA))
    expected, _ = playground.run("detect", "frames", "--camera", camera)
    playground.write("scenes.py", open(scenes.__file__).read())
    program = playground.script(
        "camera.py",
        """
import conicflow, scenes

with conicflow.source(total=5) as source:
    for number in source:
        if number == 5:
            break
        for wrong in ({}, {"camera": scenes.CAMERA, "sequence": number - 1} if number else {}):
            try:
                source.send(scenes.millimetres(number), **wrong)
            except ValueError as error:
                assert ("needs its camera" if not wrong else "numbers of frames rise") in str(error), error
            else:
                raise AssertionError(wrong)
        source.send(scenes.millimetres(number), camera=scenes.CAMERA, stamp_ns=number * 10**9, source=f"frame {number}")
""",
    )
    text = OBJECTS.format(rate_hz=0)
    begin, end = text.index("[stage.camera]"), text.index("[stage.extractor]")
    own = f'[stage.camera]\nprogram = {program}\noutput = {{ topic = "depth", kind = "depth" }}\nrate_hz = 20\n\n'
    playground.write("pipeline.toml", text[:begin] + own + text[end:])
    playground.run("run")
    made = lines(playground, "objects")
    assert [line["objects"] for line in made] == [json.loads(line)["objects"] for line in expected.splitlines()]
    assert [(line["sequence"], line["stamp_ns"], line["source"]) for line in made] == [
        (number, number * 10**9, f"frame {number}") for number in range(5)
    ]
    playground.run("run", "--frames", 3)
    assert numbers(playground, "objects") == [0, 1, 2]


def test_items_of_ones_own_travel_between_programs(playground):
    planner = playground.script(
        "plan.py",
        """
import conicflow
import numpy as np

with conicflow.stage() as stage:
    for message in stage:
        grasps = np.zeros(len(message.items), dtype=stage.dtype)
        for grasp, each in zip(grasps, message.items):
            grasp["position"], grasp["width"], grasp["shape"] = each.center, 0.25, each.kind.encode()
        stage.send(grasps)
""",
    )
    gripper = playground.script(
        "take.py",
        """
import conicflow, json

with conicflow.stage() as stage, open("taken.jsonl", "w") as taken:
    for message in stage:
        assert message.array["width"].tolist() == [each.width for each in message.items]
        print(json.dumps({"sequence": message.sequence, "grasps": [each.to_dict() for each in message.items]}), file=taken)
""",
    )
    text = f"""
[item.grasps]
type   = "acme.Grasp.v1"
fields = {{ position = "f64[3]", width = "f64", id = "u32", shape = "text[12]" }}

[stage.planner]
program = {planner}
input   = {{ topic = "objects", delivery = "lossless" }}
output  = {{ topic = "grasps", kind = "grasps" }}

[stage.gripper]
program = {gripper}
input   = {{ topic = "grasps", delivery = "lossless" }}
"""
    pipeline(playground, text + sink("grasps", "grasps", "grasps"))
    playground.run("run", "--frames", 10)
    written = [{"sequence": line["sequence"], "grasps": line["grasps"]} for line in lines(playground, "grasps")]
    assert lines(playground, "taken") == written and len(written) == 10
    for line, of in zip(written, lines(playground, "objects")):
        assert [(grasp["position"], grasp["shape"]) for grasp in line["grasps"]] == [
            (each["center"], each["kind"]) for each in of["objects"]
        ]


def test_what_no_reader_would_take_is_an_error_where_it_is_sent(playground):
    program = playground.script(
        "nonsense.py",
        """
import conicflow
import numpy as np

with conicflow.stage() as stage, open("told.txt", "w") as told:
    early = None
    try:
        stage.send([])
    except ValueError as error:
        early = str(error)
    for message in stage:
        assert early.startswith("a stage sends in answer to a message, and it has none\\n  hint: "), early
        broken = np.zeros(1, dtype=stage.dtype)
        broken["radius"] = np.nan
        named = [("stamp_ns", 4.5), ("sequence", 4.5), ("scale", "x"), ("source", 4)]
        wrong = [lambda items=items: stage.send(items) for items in (broken, np.zeros(3), ["ball"], 7)]
        wrong += [lambda name=name, value=value: stage.send([], **{name: value}) for name, value in named]
        wrong += [lambda: stage.count("a", -1)]
        for call in wrong:
            try:
                call()
            except (TypeError, ValueError) as error:
                what, hint = str(error).split("\\n  hint: ")
                print(type(error).__name__, what, file=told)
        stage.send([])
        try:
            stage.send([])
        except ValueError as error:
            print(str(error).splitlines()[0], file=told)
        break
""",
    )
    pipeline(playground, stage(program) + sink("passed", "passed", "objects"))
    playground.start("run", "--frames", 1)
    path = playground.folder / "told.txt"
    playground.wait_until("all was told", lambda: path.exists() and "one message" in path.read_text())
    told = path.read_text().splitlines()
    assert told[0].startswith("ValueError malformed objects: ") and "dimensions of float64" in told[1]
    assert "TypeError a str is no item of objects" == told[2] and told[3].startswith("TypeError")
    assert told[4] == "TypeError `stamp_ns` is 4.5 (float), expected a whole number from 0 to 18446744073709551615"
    assert told[5].startswith("TypeError `sequence` is 4.5 (float), expected a whole number")
    assert told[6] == "TypeError `scale` is 'x' (str), expected a number"
    assert told[7] == "TypeError `source` is 4 (int), expected a str"
    assert told[8].startswith("ValueError `times` is -1 (int), expected a whole number")
    assert told[9] == "a stage sends one message for each that it takes"


def test_outside_of_a_run_there_is_a_hint_and_the_program_can_be_interrupted_as_before():
    before = signal.getsignal(signal.SIGINT)
    for call in (conicflow.stage, conicflow.source):
        with pytest.raises(RuntimeError, match="is not set\n  hint: this program is a stage"):
            call()
    assert signal.getsignal(signal.SIGINT) is before


SLEEPER = "import time\ntime.sleep(600)\n"


@pytest.mark.parametrize("delivery", ["lossless", "latest"])
def test_a_program_that_does_not_join_is_named_while_the_run_goes_on(playground, delivery):
    program = playground.script("deaf.py", SLEEPER)
    pipeline(playground, stage(program, delivery=delivery, output=None), rate_hz=20)
    process = playground.start("run")
    for line in process.stderr:
        if "has not joined the run" in line:
            break
    assert "stage `python`" in line and "deaf.py" in line, line
    assert ("topic `objects` waits for it" in line) == (delivery == "lossless")
    assert "hint: a program joins by `run_stage`" in next(process.stderr)


def test_a_program_that_ends_without_having_joined_a_lossless_topic_ends_the_run(playground):
    program = playground.script("gone.py", "print('nothing to do')\n")
    pipeline(playground, stage(program, output=None), rate_hz=20)
    _, told = playground.run("run", "--frames", 160, code=1)
    assert "stage `python` has ended without having joined the run: nobody took part in topic `objects`" in told
    pipeline(playground, stage(program, delivery="latest", output=None), rate_hz=20)
    playground.run("run", "--frames", 10)
