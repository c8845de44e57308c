from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Literal, Optional, Union

import numpy as np
import numpy.typing as npt

__version__: str
__all__: list[str]

Depth = Union[npt.NDArray[np.uint16], npt.NDArray[np.float32]]
"""Rows and columns: `uint16` in units of the scale, 0 and 65535 not measured; or `float32` in metres, NaN not measured."""

Camera = Union[tuple[float, float, float, float], Sequence[float], npt.NDArray[np.floating[Any]]]
"""`(fx, fy, cx, cy)` in pixels; pixel centres lie at whole numbers."""

NoiseName = Literal["kinect_v1", "realsense_d435", "time_of_flight", "ideal"]
Noise = Union[NoiseName, Mapping[str, float]]
"""The depth noise of a sensor: a word, or some of `floor_m`, `growth_per_m`, `knee_m`, `step_per_m`."""

Vector = list[float]
"""Three numbers."""

class Sigma:
    """Standard deviations; `None` where the shape has no such parameter."""

    center: Vector
    """Of the centre along x, y and z, in metres."""
    axis: Optional[float]
    """Of the angle between the axis and the true one, in radians; `None` for a sphere."""
    half_angle: Optional[float]
    """In radians; of a cone."""
    radius: float
    """In metres; of a cone that of its radius at `center`."""
    length: Optional[float]
    """In metres; `None` for a sphere."""
    velocity: Optional[Vector]
    """In metres per second; of a track."""

class Record:
    """One item of a message. Its attributes are the keys that `json_sink` writes."""

    def to_dict(self) -> dict[str, Any]:
        """What `json_sink` writes for this item, to the last digit."""
    def __getattr__(self, name: str) -> Any: ...
    def __eq__(self, other: object) -> bool: ...
    def __hash__(self) -> int: ...
    def __dir__(self) -> list[str]: ...

class _Shape(Record):
    kind: Literal["sphere", "cylinder", "cone"]
    center: Vector
    """In metres; of a cylinder or cone the middle of its visible part, on the axis."""
    apex: Optional[Vector]
    """In metres; of a cone."""
    axis: Optional[Vector]
    """Unit vector, of a cone from the apex to the base; `None` for a sphere."""
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
    sigma: Sigma
    rms: float
    """Root mean square distance of the points from the surface, in metres."""
    points: int
    """Measurements that support it."""
    rows: int
    """Scan lines that support it."""
    arc: float
    """Visible circumference, in radians."""
    confidence: Optional[float]
    """Probability that it is an object of this shape; `None` where the method does not tell."""

class Object(_Shape):
    """A sphere, cylinder or cone in the camera frame; `None` is what another shape has."""

class Track(_Shape):
    """A tracked object in the camera frame."""

    id: int
    velocity: Vector
    """In metres per second."""
    age: int
    """Frames since its first sight."""
    misses: int
    """Frames since it was last seen."""
    state: Literal["tentative", "confirmed", "coasting"]

class Ellipse(Record):
    """An arc of a scan line."""

    scan: Literal["row", "column"]
    line: int
    first: int
    last: int
    points: int
    center: Vector
    """In metres."""
    semi_axes: list[float]
    """The longer first, in metres."""
    angle: float
    """In radians."""
    rms: float
    """In metres."""
    arc: float
    """In radians."""

class Velocity(Record):
    """A velocity that is to be taken."""

    linear: Vector
    """In metres per second."""
    angular: Vector
    """In radians per second."""
    frame: Literal["camera", "world"]

def detect(depth: Depth, camera: Camera, scale: float = 0.001, noise: Optional[Noise] = None) -> list[Object]:
    """Spheres, cylinders and cones in one depth image, in the camera frame."""

class Detector:
    """Finds objects in the images of one camera; all have one size."""

    def __init__(
        self,
        camera: Camera,
        scale: float = 0.001,
        noise: Optional[Noise] = None,
        *,
        extractor: Optional[Mapping[str, Any]] = None,
        assembler: Optional[Mapping[str, Any]] = None,
    ) -> None: ...
    def detect(self, depth: Depth) -> list[Object]: ...
    @property
    def noise_ratios(self) -> tuple[float, float]: ...
    @property
    def rejections(self) -> dict[str, int]: ...

class Tracker:
    """Gives the objects of successive frames an identity, a velocity and a filtered shape."""

    def __init__(self, parameters: Optional[Mapping[str, Any]] = None) -> None: ...
    def update(
        self, objects: Iterable[Object], stamp_ns: int, world_from_camera: Optional[npt.ArrayLike] = None
    ) -> list[Track]: ...
