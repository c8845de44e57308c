"""`python3 -m conicflow.cameras ADAPTER`: the program that the nodes of cameras run. With `--check` it says, as JSON, what is missing
for that."""

import importlib
import json
import os
import sys
import sysconfig
from pathlib import Path
from types import ModuleType
from typing import Any, Optional

import conicflow
from conicflow._conicflow import log

from .frame import Camera, Fault, Refused, Settings
from .stream import Stream

ADAPTERS = ("realsense", "orbbec", "oakd", "azure_kinect")
REFUSED = 2
"""Exit code of a stage that could not be made ready: to start it anew would not help."""


def load(adapter: str) -> ModuleType:
    """The adapter, with its SDK."""
    try:
        return importlib.import_module(f"conicflow.cameras.{adapter}")
    except (ImportError, OSError) as error:
        package, beside = SDKS[adapter]
        raise Refused(f"{sys.executable} has no {package} ({error})", how_to_install(package, beside)) from error


def how_to_install(package: str, beside: str) -> str:
    """What gives this Python an SDK, or, where a distribution keeps it for itself, one that has its packages, too."""
    if sys.prefix == sys.base_prefix and Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED").exists():
        venv = f"sudo {sys.executable} -m venv --system-site-packages /opt/conicflow"
        install = f"`sudo apt install python3-venv && {venv} && sudo /opt/conicflow/bin/pip install {package}`{beside}"
        return f'{install}; and in the table of the stage `python = "/opt/conicflow/bin/python"`'
    install = f"`{sys.executable} -m pip install {package}`{beside}"
    return f'{install}; or name a Python that has it: `python = "venv/bin/python"`'


SDKS = {
    "realsense": ("pyrealsense2", ", which on Linux needs libusb (Debian: libusb-1.0-0)"),
    "orbbec": ("pyorbbecsdk2", ""),
    "oakd": ("depthai", ""),
    "azure_kinect": ("pyk4a", ", which needs Microsoft's libk4a1.4-dev and a C++ compiler"),
}
"""The package with the SDK of each adapter, and what else it needs."""


def settings(parameters: dict[str, Any], base: str) -> Settings:
    """The parameters of the node; a relative path starts at the folder of the pipeline file."""
    known: dict[str, Any] = {name: parameters.get(name) for name in Settings._fields}
    if known["path"]:
        known["path"] = str(Path(base) / known["path"])
    return Settings(**known)


def run(adapter: ModuleType) -> None:
    """Is the source of the run that this process was started in."""
    with conicflow.source() as source:
        wanted = settings(source.parameters, source.base)

        def connect() -> Camera:
            camera: Camera = adapter.connect(wanted)
            return camera

        stream = Stream(source, connect, wanted, log)
        try:
            for _ in source:
                frame = stream.next()
                if frame is None:
                    break
                stream.send(frame)
        except Refused as fault:
            log("error", str(fault))
            sys.exit(REFUSED)
        finally:
            stream.close()


def main(arguments: Optional[list[str]] = None) -> int:
    """Runs an adapter, or tells what it lacks."""
    arguments = sys.argv[1:] if arguments is None else arguments
    adapter, options = arguments[:1], arguments[1:]
    if adapter not in [[name] for name in ADAPTERS] or options not in ([], ["--check"]):
        print(f"usage: python3 -m conicflow.cameras {'|'.join(ADAPTERS)} [--check]", file=sys.stderr)
        return REFUSED
    # What an SDK says by itself is no result of the run.
    answers = os.dup(sys.stdout.fileno())
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    try:
        module = load(adapter[0])
    except Fault as fault:
        if options:
            os.write(answers, json.dumps({"what": fault.what, "hint": fault.hint}).encode())
        else:
            print(f"error: {fault}", file=sys.stderr)
        return REFUSED
    if not options:
        run(module)
    return 0


if __name__ == "__main__":
    sys.exit(main())
