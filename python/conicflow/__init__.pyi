from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, Optional, Union, final

import numpy as np
import numpy.typing as npt

__version__: str
__all__: list[str]

_Depth = Union[npt.NDArray[np.uint16], npt.NDArray[np.float32]]
"""Rows and columns: `uint16` in units of the scale, 0 and 65535: no measurement; or `float32` in metres, NaN: no measurement."""

_Camera = Union[
    tuple[float, float, float, float], Sequence[float], Sequence[Sequence[float]], npt.NDArray[Union[np.floating[Any], np.integer[Any]]]
]
"""`(fx, fy, cx, cy)` in pixels, or a matrix K, 3x3 or its nine numbers row by row; pixel centres lie at whole numbers."""

_NoiseName = Literal["kinect_v1", "realsense_d435", "time_of_flight", "ideal"]
_Noise = Union[_NoiseName, Mapping[str, float]]
"""The depth noise of a sensor: a word, or some of `floor_m`, `growth_per_m`, `knee_m`, `step_per_m`."""

_Vector = list[float]
"""Three numbers."""

_Matrix = npt.NDArray[np.float64]
"""A covariance, 3x3."""

class _Sigma:
    """Standard deviations; `None` for parameters that the shape lacks."""

    center: _Vector
    """Of the centre along x, y and z, in metres."""
    axis: Optional[float]
    """Of the angle between the estimated and the true axis, in radians; `None` for a sphere."""
    half_angle: Optional[float]
    """In radians; of a cone."""
    radius: float
    """In metres; for a cone that of its radius at `center`."""
    length: Optional[float]
    """In metres; `None` for a sphere."""

class _TrackSigma(_Sigma):
    velocity: _Vector
    """In metres per second."""

class Record:
    """One item of a message. Its attributes are the keys that `json_sink` writes."""

    def to_dict(self) -> dict[str, Any]:
        """The item as `json_sink` writes it, to the last digit."""
    def __getattr__(self, name: str) -> Any: ...
    def __eq__(self, other: object) -> bool: ...
    def __hash__(self) -> int: ...
    def __dir__(self) -> list[str]: ...

class _Shape(Record):
    kind: Literal["sphere", "cylinder", "cone"]
    """In arrays 0, 1 or 2."""
    center: _Vector
    """In metres; for a cylinder or cone the middle of the visible part, on the axis."""
    apex: Optional[_Vector]
    """In metres; of a cone."""
    axis: Optional[_Vector]
    """Unit vector; for a cone from the apex to the base; `None` for a sphere."""
    half_angle: Optional[float]
    """In radians; of a cone."""
    radius: Optional[float]
    """In metres; `None` for a cone."""
    base_radius: Optional[float]
    """In metres; of a cone."""
    top_radius: Optional[float]
    """In metres; of a cone."""
    length: Optional[float]
    """Of the visible part along the axis, in metres; `None` for a sphere."""
    sigma: _Sigma
    @property
    def covariance(self) -> _Matrix:
        """Of the centre, in square metres."""
    rms: float
    """Root mean square distance of the points from the surface in excess of the noise, in metres."""
    points: int
    """Measurements that support it."""
    rows: int
    """Scan lines that support it."""
    arc: float
    """Visible circumference, in radians."""
    confidence: Optional[float]
    """Probability that it is an object of this shape; `None` if the method does not estimate it."""

@final
class Object(_Shape):
    """A sphere, cylinder or cone in the camera frame; attributes that only other shapes have are `None`."""

@final
class Track(_Shape):
    """A tracked object in the camera frame."""

    id: int
    sigma: _TrackSigma
    velocity: _Vector
    """In metres per second."""
    @property
    def velocity_covariance(self) -> _Matrix:
        """In square metres per square second."""
    age: int
    """Frames since it was first seen."""
    misses: int
    """Frames since it was last seen."""
    state: Literal["tentative", "confirmed", "coasting"]
    """In arrays 0, 1 or 2."""

@final
class Ellipse(Record):
    """An arc of a scan line."""

    scan: Literal["row", "column"]
    """In arrays 0 or 1."""
    line: int
    first: int
    last: int
    points: int
    center: _Vector
    """In metres."""
    semi_axes: list[float]
    """The longer first, in metres."""
    angle: float
    """In radians."""
    rms: float
    """In metres."""
    arc: float
    """In radians."""

@final
class Velocity(Record):
    """A velocity command."""

    linear: _Vector
    """In metres per second."""
    angular: _Vector
    """In radians per second."""
    frame: Literal["camera", "world"]
    """In arrays 0 or 1."""

def detect(depth: _Depth, camera: _Camera, scale: float = 0.001, noise: Optional[_Noise] = None) -> list[Object]:
    """Finds spheres, cylinders and cones in one depth image, in the camera frame."""

@final
class Detector:
    """Finds objects in the images of one camera; all have one size."""

    def __init__(
        self,
        camera: _Camera,
        scale: float = 0.001,
        noise: Optional[_Noise] = None,
        *,
        extractor: Optional[Mapping[str, Any]] = None,
        assembler: Optional[Mapping[str, Any]] = None,
    ) -> None: ...
    def detect(self, depth: _Depth) -> list[Object]: ...
    @property
    def noise_ratios(self) -> tuple[float, float]: ...
    @property
    def rejections(self) -> dict[str, int]: ...

@final
class Tracker:
    """Gives the objects of successive frames an identity, a velocity and a filtered shape."""

    def __init__(self, parameters: Optional[Mapping[str, Any]] = None) -> None: ...
    def update(
        self,
        objects: Iterable[Object],
        stamp_ns: int,
        world_from_camera: Optional[npt.ArrayLike] = None,
        camera: int = 0,
    ) -> list[Track]:
        """Updates the tracks with the objects of a frame; returns the tracks that are alive. `stamp_ns` is in nanoseconds."""

def dtype(kind: Literal["depth", "ellipses", "objects", "tracks", "velocities"]) -> np.dtype[Any]:
    """The layout of items, for `numpy.zeros(n, dtype=..)`."""

def array(kind: Literal["ellipses", "objects", "tracks", "velocities"], records: Iterable[Record]) -> npt.NDArray[Any]:
    """Converts records to a writable NumPy array of `dtype(kind)`."""

@final
class Message:
    """One message of a topic: the time and the camera of its frame, and its items."""

    @property
    def topic(self) -> str: ...
    @property
    def kind(self) -> str:
        """The item type: "depth", "objects", .."""
    @property
    def sequence(self) -> int:
        """Number of the frame."""
    @property
    def stamp_ns(self) -> int:
        """Time of capture in nanoseconds."""
    @property
    def source(self) -> str:
        """Name of the frame's file, or of its source."""
    @property
    def latency_ms(self) -> Optional[float]:
        """Time from when the source had the frame until the message came, in milliseconds; `None` if unknown."""
    @property
    def camera(self) -> tuple[float, float, float, float]:
        """`(fx, fy, cx, cy)` in pixels."""
    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the camera's images, in pixels."""
    @property
    def scale(self) -> float:
        """Metres per unit of a depth pixel."""
    @property
    def noise(self) -> dict[str, float]: ...
    @property
    def world_from_camera(self) -> Optional[list[list[float]]]:
        """The camera's pose, three rows of `[R | t]`, in metres."""
    @property
    def inputs(self) -> dict[str, "Message"]:
        """For a message that drives a stage: the matching messages of the further inputs, by input name; each may be missing."""
    @property
    def items(self) -> list[Any]:
        """Records: `Object`, `Track`, `Ellipse`, `Velocity`, or `Record` for a type of the pipeline file."""
    @property
    def array(self) -> npt.NDArray[Any]:
        """The items as a read-only array with their layout."""
    @property
    def image(self) -> npt.NDArray[np.uint16]:
        """A depth image in units of `scale`, lent by shared memory: it is not copied, and read-only.

        It is lent to this process only: give a forked child, such as one of `multiprocessing`, `message.image.copy()`.
        """
    def to_dict(self) -> dict[str, Any]:
        """The line that `json_sink` writes."""
    def __len__(self) -> int: ...
    def __bool__(self) -> Literal[True]:
        """A message is true even without items."""

@final
class Reader:
    """An iterator over the messages of topics of a running pipeline, until the run is over."""

    def __iter__(self) -> Iterator[Message]: ...
    def __next__(self) -> Message: ...
    def __enter__(self) -> "Reader": ...
    def __exit__(self, *exception: object) -> None: ...
    def close(self) -> None:
        """Stops reading; received messages stay valid."""

def read(*topics: str, pipeline: Optional[str] = None) -> Reader:
    """Reads the messages of topics of a pipeline that runs on this machine, as an onlooker for whom no writer waits."""

_Items = Union[Iterable[Record], npt.NDArray[Any], Message]

class _Joined:
    @property
    def name(self) -> str:
        """Name of the stage in the pipeline file."""
    @property
    def parameters(self) -> dict[str, Any]:
        """All keys of its table in the pipeline file that are not reserved."""
    @property
    def base(self) -> str:
        """Folder of the pipeline file."""
    @property
    def resume_at(self) -> int:
        """Number of messages that it had taken (a source: sent) before it was restarted in the same run; 0 at first."""
    @property
    def stopping(self) -> bool:
        """Whether the run is to end; asking also shows that the stage is alive."""
    @property
    def dtype(self) -> Optional[np.dtype[Any]]:
        """The layout of the items that it sends."""
    def count(self, name: str, times: int = 1) -> None:
        """Adds to a counter that the summary of the run shows."""
    def send(
        self,
        items: _Items,
        *,
        camera: Optional[_Camera] = None,
        scale: Optional[float] = None,
        noise: Optional[_Noise] = None,
        stamp_ns: Optional[int] = None,
        source: Optional[str] = None,
        sequence: Optional[int] = None,
        world_from_camera: Optional[npt.ArrayLike] = None,
    ) -> None:
        """Sends a message; waits while a lossless reader has no room."""

@final
class Stage(_Joined):
    """A stage of a pipeline: `with conicflow.stage() as stage: for message in stage: stage.send(..)`."""

    def __iter__(self) -> Iterator[Message]: ...
    def __next__(self) -> Message: ...
    def __enter__(self) -> "Stage": ...
    def __exit__(self, *exception: object) -> None: ...

@final
class Source(_Joined):
    """A source of a pipeline: `with conicflow.source() as source: for number in source: source.send(..)`."""

    @property
    def counted(self) -> dict[str, int]:
        """The counters before it was restarted."""
    @property
    def inputs(self) -> dict[str, Message]:
        """The latest messages of the further inputs."""
    def __iter__(self) -> Iterator[int]: ...
    def __next__(self) -> int: ...
    def __enter__(self) -> "Source": ...
    def __exit__(self, *exception: object) -> None: ...

def stage(*, same_frame: Sequence[str] = ()) -> Stage:
    """Joins the run as the stage whose `program` was started as this process."""

def source(*, total: Optional[int] = None) -> Source:
    """Joins the run as the source whose `program` was started as this process."""
