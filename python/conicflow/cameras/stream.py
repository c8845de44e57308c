"""The frames of a camera during a run: it is opened, watched, and reopened when it stalls or is lost.

Nothing here depends on an SDK. A problem is logged once, until it changes.
"""

import time
from dataclasses import replace
from typing import Any, Callable, Optional, Protocol

import numpy as np

from .frame import IN_USE, WRONG_SDK, Camera, EndOfRecording, Fault, Frame, Rectifier, Refused, Settings, text_of

LOOK_S = 0.1
"""Maximum wait for a frame between checks whether the run is to end, which also show that the stage is alive."""
TRY_AGAIN_S = 1.0
"""Pause between attempts to open a camera."""

UNREADABLE = "frames unreadable"
GOES_BACK_NS = 1_000_000_000
"""Stamps that go back by less are kept rising: the SDK has begun to convert the camera's clock, or the computer's was set."""
LOST = "frames lost"
OPENED = "camera opened anew"


class Source(Protocol):
    """The part of `conicflow.Source` that a stream uses."""


    @property
    def stopping(self) -> bool: ...
    @property
    def resume_at(self) -> int: ...
    @property
    def send(self) -> Callable[..., None]: ...
    def count(self, name: str, times: int = 1) -> None: ...


class Stream:
    """The frames of a camera or of a recording; `connect` opens it, `tell(level, text)` logs."""

    def __init__(
        self, source: Source, connect: Callable[[], Camera], settings: Settings, tell: Callable[[str, str], None]
    ) -> None:
        self._source, self._connect, self._settings, self._tell = source, connect, settings, tell
        self._camera: Optional[Camera] = None
        self._rectifier: Optional[Rectifier] = None
        self._last: Optional[Frame] = None
        self._told: Optional[str] = None
        self._has_opened = self._has_seen = False
        self._stamp_ns = 0
        self._heard = time.monotonic()
        # After a restart of the process, a recording continues where it was.
        self._left_out = source.resume_at if settings.path else 0

    def next(self) -> Optional[Frame]:
        """Returns the next frame, or None when the run or the recording is over."""
        self._heard = time.monotonic()
        while not self._source.stopping:
            if self._camera is None and not self._open():
                continue
            try:
                frame = self._read()
            except EndOfRecording:
                return None
            except Refused:
                raise
            except Exception as error:
                self._refuse_wrong_sdk(error)
                self._is_gone(error)
                continue
            if frame is not None:
                return frame
        return None

    def send(self, frame: Frame) -> None:
        """Sends a frame; one that no reader would accept is counted."""
        lens = frame.lens
        camera = (lens.fx, lens.fy, lens.cx, lens.cy)
        try:
            self._source.send(frame.depth, camera=camera, scale=frame.scale, noise=frame.noise, stamp_ns=frame.stamp_ns)
        except ValueError as error:
            self._source.count(UNREADABLE)
            self._say("warn", str(error))

    def close(self) -> None:
        """Closes the camera; errors are ignored, because a lost camera may fail to close."""
        camera, self._camera = self._camera, None
        self._last = None
        if camera is not None:
            try:
                camera.close()
            except Exception:
                pass

    def _open(self) -> bool:
        """Tries to open the camera, or else waits; returns whether it is open."""
        try:
            self._camera = self._connect()
        except Exception as error:
            if isinstance(error, Refused) and not self._has_opened:
                raise
            self._refuse_wrong_sdk(error)
            self._say("warn", f"{self._why_not(error)}\n  the stage waits for the camera")
            self._wait()
            return False
        if self._has_opened:
            self._source.count(OPENED)
        self._has_opened = True
        self._heard = time.monotonic()
        return True

    def _refuse_wrong_sdk(self, error: Exception) -> None:
        """Raises Refused for errors of a wrong SDK. Once a frame has come, the SDK is right, and the camera was lost."""
        if isinstance(error, WRONG_SDK) and not self._has_seen:
            what = f"the camera's SDK is not one that this node can use: {type(error).__name__}: {error}"
            raise Refused(what, "install the version that docs/cameras.md names") from error

    def _why_not(self, error: Exception) -> str:
        if isinstance(error, Fault):
            return str(error)
        which = f"the camera with serial number {self._settings.serial}" if self._settings.serial else "the camera"
        return f"{which} cannot be opened: {text_of(error)}\n  hint: {IN_USE}"

    def _wait(self) -> None:
        until = time.monotonic() + TRY_AGAIN_S
        while not self._source.stopping and time.monotonic() < until:
            time.sleep(LOOK_S / 2)

    def _read(self) -> Optional[Frame]:
        camera = self._camera
        assert camera is not None
        frame = camera.read(LOOK_S)
        if frame is None:
            silence_s = time.monotonic() - self._heard
            if silence_s > self._settings.stall_s:
                raise TimeoutError(f"no image for {silence_s:.1f} s")
            return None
        self._heard = time.monotonic()
        if self._left_out > 0:
            self._left_out -= 1
            return None
        fault = _fault(frame)
        if fault:
            self._source.count(UNREADABLE)
            self._say("warn", f"{camera.name} sends what is no depth image: {fault}")
            return None
        self._compare(camera, frame)
        self._last, self._has_seen = frame, True
        if not self._settings.path:
            frame = replace(frame, stamp_ns=self._rising(frame.stamp_ns))
        if self._rectifier is None:
            return frame
        lens = frame.lens._replace(distortion=())
        return Frame(self._rectifier(frame.depth), lens, frame.scale, frame.noise, frame.stamp_ns)

    def _rising(self, stamp_ns: int) -> int:
        """Returns the stamp, or one after the last stamp if a clock went back a little."""
        if 0 < self._stamp_ns - stamp_ns < GOES_BACK_NS:
            stamp_ns = self._stamp_ns + 1
        self._stamp_ns = stamp_ns
        return stamp_ns

    def _compare(self, camera: Camera, frame: Frame) -> None:
        """Compares a frame with the last one: logs a new lens, and counts missing numbers."""
        last, lens = self._last, frame.lens
        if last is None or last.lens != lens:
            self._rectifier = Rectifier(lens) if lens.is_distorted else None
            size = f"{lens.width}x{lens.height}"
            if last is None:
                rectified = ", rectified here" if lens.is_distorted else ""
                self._told = None
                self._say("info", f"{camera.name}: images of {size}{rectified}")
            elif last.lens[:2] == lens[:2]:
                is_now, was = (f"fx {each.fx:.1f} fy {each.fy:.1f} cx {each.cx:.1f} cy {each.cy:.1f}" for each in (lens, last.lens))
                self._say("warn", f"{camera.name} sees through another lens from now on: {is_now}; before: {was}")
            else:
                was = f"{last.lens.width}x{last.lens.height}"
                self._say("warn", f"{camera.name} sends images of {size} from now on; those before were {was}")
        elif frame.number is not None and last.number is not None:
            self._source.count(LOST, max(frame.number - last.number - 1, 0))

    def _is_gone(self, error: Exception) -> None:
        camera = self._camera
        assert camera is not None
        name = camera.name
        self.close()
        if self._settings.path:
            raise Refused(f"{name} cannot be read on: {text_of(error)}", "is the file whole?") from error
        self._say("warn", f"{name} is lost: {text_of(error)}\n  it is opened anew as soon as it is there")

    def _say(self, level: str, text: str) -> None:
        # The same problem may come with other numbers.
        key = "".join(letter for letter in text if not letter.isdigit())
        if self._told != key:
            self._told = key
            self._tell(level, text)


def _fault(frame: Frame) -> Optional[str]:
    """Returns why a frame is no depth image of its lens, or None if it is one."""
    depth, lens = frame.depth, frame.lens
    if not isinstance(depth, np.ndarray) or depth.dtype != np.uint16:
        return f"{getattr(depth, 'dtype', type(depth).__name__)} in place of uint16"
    if depth.shape != (lens.height, lens.width):
        return f"an array of {depth.shape}, of a lens of {lens.width}x{lens.height}"
    if depth.size == 0:
        return "it is empty"
    return None
