"""The program `conicflow`, which the tests compare with and run: named in CONICFLOW, or found on the path."""

import os
import shutil
import subprocess
import warnings

import pytest


@pytest.fixture(scope="session")
def conicflow_program():
    program = os.environ.get("CONICFLOW") or shutil.which("conicflow")
    if not program:
        warnings.warn("SKIPPED: no program conicflow; name it in CONICFLOW", stacklevel=1)
        pytest.skip("no program conicflow; name it in CONICFLOW")
    return program


@pytest.fixture
def run(conicflow_program, tmp_path, monkeypatch):
    """Runs the program to its end, in a folder and with shared memory of its own; what it wrote."""
    monkeypatch.setenv("CONICFLOW_RUNTIME_DIR", str(tmp_path / "r"))

    def run(*arguments, code=0):
        ended = subprocess.run(
            [conicflow_program, *map(str, arguments)], cwd=tmp_path, capture_output=True, text=True, timeout=300
        )
        assert ended.returncode == code, ended.stderr
        return ended

    return run
