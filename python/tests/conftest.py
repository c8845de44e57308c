"""Fixtures of the tests. The environment variable CONICFLOW names the program `conicflow`; otherwise the search path contains
it."""

import importlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import pytest

DEADLINE_S = 120
"""Maximum duration of a wait in seconds, much longer than any wait should take."""


@pytest.fixture(scope="session")
def conicflow_program():
    program = os.environ.get("CONICFLOW") or shutil.which("conicflow")
    if not program:
        warnings.warn("SKIPPED: no program conicflow; name it in CONICFLOW", stacklevel=1)
        pytest.skip("no program conicflow; name it in CONICFLOW")
    return str(Path(program).resolve())


def sdk_of_realsense():
    """Imports the SDK of RealSense. If the SDK or one of its libraries is missing, the test is skipped with a reason."""
    try:
        return importlib.import_module("pyrealsense2")
    except ImportError as error:
        warnings.warn(f"SKIPPED: {error}; `realsense_source` is not shown to work", stacklevel=2)
        pytest.skip(str(error), allow_module_level=True)


class Playground:
    """A folder for a pipeline, with shared memory of its own."""

    def __init__(self, program, folder):
        self.program, self.folder, self.running = program, folder, []

    def write(self, name, text):
        (self.folder / name).write_text(text)

    def script(self, name, text):
        """Writes a program in Python; returns its command for a pipeline file."""
        self.write(name, text)
        return f'["{sys.executable}", "{name}"]'

    def start(self, *arguments):
        process = subprocess.Popen(
            [self.program, *map(str, arguments)],
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.running.append(process)
        return process

    def end(self, process, code=0):
        out, err = process.communicate(timeout=DEADLINE_S)
        self.running.remove(process)
        assert process.returncode == code, err
        return out, err

    def run(self, *arguments, code=0):
        return self.end(self.start(*arguments), code)

    def wait_until(self, what, condition):
        deadline = time.monotonic() + DEADLINE_S
        while not condition():
            assert time.monotonic() < deadline, f"waited in vain until {what}"
            time.sleep(0.02)


@pytest.fixture
def playground(conicflow_program, tmp_path, monkeypatch):
    # The path of the runtime folder has to be short, because the folder contains sockets.
    with tempfile.TemporaryDirectory(prefix="cf") as memory:
        monkeypatch.setenv("CONICFLOW_RUNTIME_DIR", memory)
        playground = Playground(conicflow_program, tmp_path)
        yield playground
        for process in playground.running:
            process.kill()
            process.communicate()
