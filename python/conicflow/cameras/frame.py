"""The frames that adapters make from images of their SDKs: depths, lens, scale, noise, time; and their errors."""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple, Optional, Protocol, Union

import numpy as np
import numpy.typing as npt

Noise = Union[str, Mapping[str, float]]
"""A word as in the pipeline file, or coefficients."""

SUBPIXEL_PX = 0.08
"""The usual error of a stereo camera's disparity in pixels, as in the noise model `realsense_d435`."""


class Fault(Exception):
    """An error with a hint."""

    def __init__(self, what: str, hint: str) -> None:
        super().__init__(f"{what}\n  hint: {hint}")
        self.what, self.hint = what, hint


class Refused(Fault):
    """An error that a retry would give again: a parameter that the camera does not support, an unreadable file."""


class NotThere(Fault):
    """The camera is not connected, but may be later."""


class EndOfRecording(Exception):
    """There are no more frames."""


WRONG_SDK = (AttributeError, ImportError, TypeError)
"""The exceptions of calls to an SDK of another version than the adapter knows."""
IN_USE = "does another program use it?"
"""The hint for a connected camera that cannot be opened."""


def text_of(error: Exception) -> str:
    """The text of an exception, or its type if it has no text."""
    return str(error) or type(error).__name__


@contextmanager
def opening(name: str) -> Iterator[None]:
    """Adds the name of the camera to errors of opening it."""
    try:
        yield
    except (Fault, *WRONG_SDK):
        raise
    except Exception as error:
        raise NotThere(f"{name} cannot be opened: {text_of(error)}", IN_USE) from error


class Lens(NamedTuple):
    """A pinhole camera in pixels, with pixel centres at integers; and its distortion in the order of OpenCV: k1, k2, p1, p2,
    k3, k4, k5, k6. Without coefficients its images are rectified."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    @property
    def is_distorted(self) -> bool:
        return any(self.distortion)


@dataclass(frozen=True)
class Frame:
    """A depth image."""

    depth: npt.NDArray[Any]
    """Rows and columns: `uint16` in units of the scale."""
    lens: Lens
    scale: float
    """Metres per unit."""
    noise: Noise
    stamp_ns: int
    """Time of capture in nanoseconds since the Unix epoch; for a recording as recorded."""
    number: Optional[int] = None
    """Number from the camera: a gap means that frames were lost."""


class Settings(NamedTuple):
    """The parameters of the node, with all defaults filled in."""

    serial: Optional[str]
    path: Optional[str]
    width: Optional[int]
    height: Optional[int]
    fps: Optional[int]
    noise: Optional[Noise]
    stall_s: float

    def profile(self) -> str:
        """The requested format, in words."""
        size = f"{self.width}x{self.height}" if self.width else "any size"
        return f"{size} at {self.fps} Hz" if self.fps else size

    def fits(self, width: int, height: int, fps: int) -> bool:
        """Whether a format of the camera matches the request."""
        return self.width in (None, width) and self.height in (None, height) and self.fps in (None, fps)


class Camera(Protocol):
    """An open camera or recording."""

    @property
    def name(self) -> str:
        """Its name, for messages to the user."""

    def read(self, patience_s: float) -> Optional[Frame]:
        """Returns the next frame, or None if none came in time. Raises EndOfRecording, or any exception if the camera is lost."""

    def close(self) -> None: ...


def not_there(kind: str, serial: Optional[str], there: list[str], otherwise: str) -> NotThere:
    """Returns the error that no such camera is connected, and which are."""
    which = f"{kind} with serial number {serial}" if serial else kind
    return NotThere(f"no {which} is connected", f"connected: {', '.join(there)}" if there else otherwise)


def stereo_noise(fx: float, baseline_m: float) -> Optional[Noise]:
    """Returns the noise of a stereo camera: sigma(z) = z^2 subpixel / (f b); None if no camera has that base line."""
    if not 0.005 < abs(baseline_m) < 1.0:
        return None
    growth_per_m = SUBPIXEL_PX / (fx * abs(baseline_m))
    return {"floor_m": 0.0, "growth_per_m": growth_per_m, "knee_m": 0.0, "step_per_m": 0.0}


def noise_of(settings: "Settings", name: str, known: Optional[Noise]) -> Noise:
    """Returns the noise from the pipeline file, else from the SDK; never a guess."""
    noise = known if settings.noise is None else settings.noise
    if noise is None:
        hint = 'write `noise = "realsense_d435"` for stereo, "kinect_v1" for structured light, "time_of_flight", or a table'
        raise Refused(f"the SDK does not tell the noise of {name}", hint)
    return noise


class DeviceClock:
    """Converts times of a camera's own clock to nanoseconds since the Unix epoch.

    The image with the smallest delay gives the offset between the clocks. They may drift by 1 in 10,000, and jump when one is
    set: a new offset on which all images of some seconds agree is adopted.
    """

    LATE_NS = 2e7
    """Images with a longer delay mean that a clock was set, if none comes earlier for `AGREED_NS`."""
    AGREED_NS = 3_000_000_000
    AGREED = 20
    """Minimum number of such images."""

    def __init__(self) -> None:
        self._apart: Optional[float] = None
        self._last_ns = 0
        self._late: list[tuple[int, float]] = []
        """For the images since the last one in time: the camera's time, and the apparent offset between the clocks."""

    def stamp_ns(self, device_ns: int, now_ns: Optional[int] = None) -> int:
        """Returns the time of capture of an image that has just come."""
        now_apart = float((time.time_ns() if now_ns is None else now_ns) - device_ns)
        if self._apart is None or abs(now_apart - self._apart) > 1e9:
            self._apart = now_apart
        else:
            self._apart = min(now_apart, self._apart + 1e-4 * max(device_ns - self._last_ns, 0))
        self._last_ns = device_ns
        if now_apart - self._apart < self.LATE_NS:
            self._late = []
        else:
            self._late.append((device_ns, now_apart))
            if len(self._late) >= self.AGREED and device_ns - self._late[0][0] >= self.AGREED_NS:
                self._apart = min(apart for _, apart in self._late)
                self._late = []
        return device_ns + round(self._apart)


class Rectifier:
    """Rectifies a distorted image: moves its pixels to where a pinhole camera would see them.

    Each pixel takes the nearest measurement, because a mean over an edge would be a depth without a surface. Depths are along the
    optical axis and do not change.
    """

    def __init__(self, lens: Lens) -> None:
        self._lens = lens
        u: Any = np.arange(lens.width, dtype=np.float64)[None, :]
        v: Any = np.arange(lens.height, dtype=np.float64)[:, None]
        x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
        p1, p2 = (*lens.distortion, *[0.0] * 8)[2:4]
        square = x * x + y * y
        growth = self._growth(square)
        column = np.rint((x * growth + 2 * p1 * x * y + p2 * (square + 2 * x * x)) * lens.fx + lens.cx)
        row = np.rint((y * growth + p1 * (square + 2 * y * y) + 2 * p2 * x * y) * lens.fy + lens.cy)
        seen = (0 <= column) & (column < lens.width) & (0 <= row) & (row < lens.height) & (square < self._limit())
        # Pixels that the camera does not see are read from the zero that `__call__` appends.
        beyond = lens.width * lens.height
        self._places = np.where(seen, row * lens.width + column, beyond).astype(np.intp)

    def __call__(self, depth: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.append(depth.ravel(), depth.dtype.type(0))[self._places]

    def _growth(self, square: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        k1, k2, _, _, k3, k4, k5, k6 = (*self._lens.distortion, *[0.0] * 8)[:8]
        above = 1 + square * (k1 + square * (k2 + square * k3))
        return above / (1 + square * (k4 + square * (k5 + square * k6)))

    def _limit(self) -> float:
        """The squared distance from the axis beyond which the model folds back, which no lens does."""
        radius: npt.NDArray[np.float64] = np.linspace(0.0, 10.0, 10_001)
        with np.errstate(all="ignore"):
            distorted: npt.NDArray[np.float64] = radius * self._growth(radius**2)
            rises = np.diff(distorted) > 0
        return float(radius[np.argmin(rises)] ** 2) if not rises.all() else np.inf
