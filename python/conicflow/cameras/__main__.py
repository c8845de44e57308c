"""`python3 -m conicflow.cameras ADAPTER`: the program that the camera nodes run. With `--check` it prints
as JSON what is missing for that."""

import importlib
import json
import os
import sys
import sysconfig
from contextlib import ExitStack
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple, Optional

import conicflow
from conicflow._conicflow import log

from .frame import Camera, Fault, Refused, Settings
from .stream import Stream

ADAPTERS = ("realsense", "orbbec", "oakd", "azure_kinect")
REFUSED = 2
"""Exit code of a stage that could not be initialised: a restart would not help."""


def load(adapter: str) -> ModuleType:
    """Imports the adapter and its SDK."""
    sdk = SDKS[adapter]
    try:
        refuse_other_versions(sdk, importlib.import_module(sdk.module))
        return importlib.import_module(f"conicflow.cameras.{adapter}")
    except (ImportError, OSError) as error:
        raise Refused(f"{sys.executable} has no {sdk.package} ({error})", how_to_install(sdk.package, sdk.beside)) from error


def refuse_other_versions(sdk: "Sdk", module: ModuleType) -> None:
    """Checks that an SDK has the functions that the adapter calls, instead of waiting for a camera that it could not open."""
    for name in sdk.needs:
        part: Any = module
        for word in name.split("."):
            part = getattr(part, word, None)
        if part is None:
            what = f"{sdk.package} {_version(sdk.package)} of {sys.executable} has no `{name}`"
            raise Refused(what, f"`{sys.executable} -m pip install --upgrade {sdk.package}`")


def _version(package: str) -> str:
    # Imported here because it loads half of the standard library, which is only needed on failure.
    import importlib.metadata

    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "(of a version that is not known)"


def how_to_install(package: str, beside: str) -> str:
    """The command that installs an SDK: for this Python or, if a distribution manages it, in an environment that extends it."""
    if sys.prefix == sys.base_prefix and Path(sysconfig.get_path("stdlib"), "EXTERNALLY-MANAGED").exists():
        venv = f"sudo {sys.executable} -m venv --system-site-packages /opt/conicflow"
        install = f"`sudo apt install python3-venv && {venv} && sudo /opt/conicflow/bin/pip install {package}`{beside}"
        return f'{install}; and in the table of the stage `python = "/opt/conicflow/bin/python"`'
    install = f"`{sys.executable} -m pip install {package}`{beside}"
    return f'{install}; or name a Python that has it: `python = "venv/bin/python"`'


class Sdk(NamedTuple):
    """The packages that an adapter needs."""

    package: str
    """The package that pip installs."""
    beside: str
    """Further requirements of the package, in words."""
    module: str
    """The module that Python imports."""
    needs: tuple[str, ...]
    """Attributes that other versions, or other packages of that name, lack."""


SDKS = {
    "realsense": Sdk(
        "pyrealsense2",
        ", which on Linux needs libusb (Debian: libusb-1.0-0)",
        "pyrealsense2",
        ("context", "camera_info", "option", "stream", "format", "playback_status", "timestamp_domain", "distortion"),
    ),
    "orbbec": Sdk(
        "pyorbbecsdk2",
        "",
        "pyorbbecsdk",
        ("OBCameraDistortionModel.BROWN_CONRADY_K6", "OBPlaybackStatus", "PlaybackDevice", "Context.set_logger_to_file"),
    ),
    "oakd": Sdk(
        "depthai",
        "",
        "depthai",
        ("DeviceInfo.getDeviceId", "node.StereoDepth.build", "StereoDepthConfig.MedianFilter", "Clock.now"),
    ),
    "azure_kinect": Sdk(
        "pyk4a",
        ", which needs Microsoft's libk4a1.4-dev and a C++ compiler",
        "pyk4a",
        ("PyK4A", "PyK4APlayback", "K4ATimeoutException", "connected_device_count", "CalibrationType"),
    ),
}
"""The SDK of each adapter."""


def settings(parameters: dict[str, Any], base: str) -> Settings:
    """The parameters of the node; a relative path starts at the folder of the pipeline file."""
    known: dict[str, Any] = {name: parameters.get(name) for name in Settings._fields}
    if known["path"]:
        known["path"] = str(Path(base) / known["path"])
    return Settings(**known)


def run(adapter: ModuleType) -> int:
    """Runs as the source of the run that this process was started in; returns the exit code."""
    with ExitStack() as place:
        source = place.enter_context(conicflow.source())
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
            # The stream has not ended: leave the place without ending the stream.
            place.pop_all()
            return REFUSED
        finally:
            stream.close()
    return 0


def main(arguments: Optional[list[str]] = None) -> int:
    """Runs an adapter, or reports what it lacks."""
    arguments = sys.argv[1:] if arguments is None else arguments
    adapter, options = arguments[:1], arguments[1:]
    if adapter not in [[name] for name in ADAPTERS] or options not in ([], ["--check"]):
        print(f"usage: python3 -m conicflow.cameras {'|'.join(ADAPTERS)} [--check]", file=sys.stderr)
        return REFUSED
    # Output of an SDK itself is not a result of the run.
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
    return 0 if options else run(module)


if __name__ == "__main__":
    sys.exit(main())
