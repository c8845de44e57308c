"""Runs the Python examples of the documents word for word: the blocks of `docs/python.md`, and `examples/camera.toml`."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import scenes
from conftest import sdk_of_realsense
from pipelines import OBJECTS

ROOT = Path(__file__).parents[2]
README, PYTHON = (path.read_text() for path in (ROOT / "README.md", ROOT / "docs/python.md"))


def blocks(language, section):
    """Returns the code blocks of a section that are in this language."""
    text = PYTHON.split(f"\n## {section}\n")[1].split("\n## ")[0]
    return re.findall(rf"```{language}\n(.*?)```", text, re.DOTALL)


def test_objects_are_found_as_the_document_says(capsys):
    (block,) = blocks("python", "Find objects")
    fx, fy, cx, cy = scenes.CAMERA
    exec(block, {"depth": scenes.millimetres(0), "fx": fx, "fy": fy, "cx": cx, "cy": cy})
    assert capsys.readouterr().out.count("'kind': ") >= 1


def test_the_stage_of_the_document_passes_on_the_nearest_objects(playground, monkeypatch):
    (script,), (stage,) = blocks("python", "A stage"), blocks("toml", "A stage")
    # `python3` has to be the one with the package.
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    playground.write("nearest.py", script)
    sink = '[stage.written]\nnode = "json_sink"\ninput = { topic = "nearest", delivery = "lossless", kind = "objects" }\n'
    playground.write("pipeline.toml", f'{OBJECTS.format(rate_hz=0)}\n{stage}\n{sink}path = "nearest.jsonl"\n')
    playground.run("run", "--frames", 20)
    all_lines, nearest = (
        [json.loads(line)["objects"] for line in (playground.folder / f"{name}.jsonl").read_text().splitlines()]
        for name in ("objects", "nearest")
    )
    assert len(nearest) == 20 and any(len(objects) > 1 for objects in all_lines)
    assert nearest == [sorted(objects, key=lambda each: each["center"][2])[:1] for objects in all_lines]


def test_topics_are_read_as_the_document_says(playground):
    (block,) = blocks("python", "Look at a running pipeline")
    playground.write("pipeline.toml", OBJECTS.format(rate_hz=50))
    process = playground.start("run", "--quiet")
    playground.wait_until("there are objects", lambda: (playground.folder / "objects.jsonl").exists())
    program = textwrap.dedent(f"import conicflow\n{block}")
    with open(playground.folder / "printed", "w+") as printed:
        reader = subprocess.Popen([sys.executable, "-u", "-c", program], stdout=printed, stderr=subprocess.PIPE, text=True)
        playground.running.append(reader)

        def objects():
            return (playground.folder / "printed").read_text().count("radius")

        playground.wait_until("there are objects", lambda: reader.poll() is not None or objects() > 10)
        process.send_signal(signal.SIGINT)
        playground.end(process)
        playground.end(reader)
        assert objects() > 10


def test_who_has_a_camera_runs_the_example(playground, monkeypatch):
    """The command of the README, with the SDK's software device in place of a camera."""
    sdk_of_realsense()
    (command,) = re.findall(r"^\| a camera \| `(.*?)` \|", README, re.MULTILINE)
    program, *arguments = command.split()
    assert program == "conicflow"
    site = playground.folder / "site"
    site.mkdir()
    here = Path(__file__).parent
    shutil.copy(here / "plugged_realsense.py", site / "sitecustomize.py")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(site), str(here)]))
    monkeypatch.setenv("PATH", f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}")
    shutil.copytree(ROOT / "examples", playground.folder / "examples")
    # A stage runs in the folder of the pipeline file, where the software device looks for the file `plugged`.
    playground.write("examples/plugged", "large")
    out, told = playground.run(*arguments, "--frames", 20)
    assert "Software RealSense" in told and len(out.splitlines()) > 5, told
