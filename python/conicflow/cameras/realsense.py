"""Intel RealSense, by pyrealsense2: a camera, or a recording of the SDK (.bag, .db3)."""

import queue
import threading
from typing import Any, Optional, Union

import numpy as np
import pyrealsense2 as rs

from .frame import (
    Camera,
    DeviceClock,
    EndOfRecording,
    Frame,
    Lens,
    Noise,
    Refused,
    Settings,
    noise_of,
    not_there,
    opening,
    stereo_noise,
)

KEPT = 2
"""Maximum number of frames that wait; for a camera the oldest is dropped, and counted as lost."""


def connect(settings: Settings) -> Camera:
    """Opens the recording or the camera that the settings name."""
    context = rs.context()
    if settings.path:
        try:
            playback = context.load_device(settings.path).as_playback()
        except RuntimeError as error:
            raise Refused(f"`{settings.path}` is no recording of a RealSense: {error}", "name a .bag or .db3") from error
        playback.set_real_time(False)
        return RealSense(playback, settings, playback)
    devices = list(context.query_devices())
    if settings.serial is not None:
        fitting = [device for device in devices if _info(device, rs.camera_info.serial_number) == settings.serial]
    else:
        fitting = devices
    if not fitting:
        hint = "is it plugged in, and may this user open it (udev rules of librealsense)?"
        raise not_there("RealSense", settings.serial, [_name(device) for device in devices], hint)
    # The first device may have no depth sensor, such as a tracking camera.
    device = next((device for device in fitting if _has_depths(device)), fitting[0])
    with opening(_name(device)):
        return RealSense(device, settings, None)


class RealSense:
    """The depth sensor of a device."""

    def __init__(self, device: Any, settings: Settings, playback: Optional[Any]) -> None:
        self.name = _name(device) if playback is None else f"`{settings.path}`"
        self._device, self._playback, self._settings = device, playback, settings
        self._frames: queue.Queue[Union[Frame, Exception]] = queue.Queue(KEPT)
        self._closing = threading.Event()
        self._clock = DeviceClock()
        self._sensor: Any = _depth_sensor(device)
        if self._sensor is None:
            hint = "name one that has, by `serial`; of a recording, record the depth stream"
            raise Refused(f"{self.name} has no depth sensor", hint)
        profile = _profile(self._sensor, settings, self.name)
        # A recording's sensor has its options, but does not identify itself as a depth sensor.
        # The scale is in single precision; converting it through text gives the intended decimal, such as exactly 0.001.
        self._scale = float(str(np.float32(self._sensor.get_option(rs.option.depth_units))))
        self._see_through(profile.as_video_stream_profile().get_intrinsics())
        self._sensor.open(profile)
        self._sensor.start(self._came)

    def read(self, patience_s: float) -> Optional[Frame]:
        try:
            frame = self._frames.get(timeout=patience_s)
        except queue.Empty:
            if self._playback is not None and self._playback.current_status() == rs.playback_status.stopped:
                raise EndOfRecording from None
            if self._playback is None and not self._is_connected():
                raise ConnectionError("it was unplugged") from None
            return None
        if isinstance(frame, Exception):
            raise frame
        return frame

    def close(self) -> None:
        self._closing.set()
        try:
            self._sensor.stop()
        finally:
            self._sensor.close()

    def _came(self, frame: Any) -> None:
        """Receives a frame, in a thread of the SDK."""
        if not frame.is_depth_frame():
            return
        try:
            self._keep(self._frame(frame))
        except Exception as error:
            self._keep(error)

    def _frame(self, frame: Any) -> Frame:
        # The SDK reuses its memory.
        depth = np.array(frame.get_data(), copy=True)
        stamp_ns = round(frame.get_timestamp() * 1e6)
        if self._playback is None and frame.get_frame_timestamp_domain() == rs.timestamp_domain.hardware_clock:
            stamp_ns = self._clock.stamp_ns(stamp_ns)
        intrinsics = frame.get_profile().as_video_stream_profile().get_intrinsics()
        if not _is_same(intrinsics, self._lens):
            self._see_through(intrinsics)
        return Frame(depth, self._lens, self._scale, self._noise, stamp_ns, frame.get_frame_number())

    def _see_through(self, intrinsics: Any) -> None:
        """Sets the lens, and the noise that depends on it."""
        self._lens = _lens(intrinsics, self.name)
        self._noise = noise_of(self._settings, self.name, self._known_noise())

    def _is_connected(self) -> bool:
        if hasattr(self._device, "is_connected"):
            return bool(self._device.is_connected())
        # Older SDKs, including the last ones that support the L515, only list the devices.
        return self.name in [_name(device) for device in rs.context().query_devices()]

    def _keep(self, came: Union[Frame, Exception]) -> None:
        """Queues a frame for `read`; a recording waits for room, a camera does not."""
        while not self._closing.is_set():
            try:
                self._frames.put(came, timeout=0.05 if self._playback is not None else 0)
                return
            except queue.Full:
                if self._playback is None:
                    self._drop_oldest()

    def _drop_oldest(self) -> None:
        try:
            self._frames.get_nowait()
        except queue.Empty:
            pass

    def _known_noise(self) -> Optional[Noise]:
        if self._sensor.supports(rs.option.stereo_baseline):
            # In millimetres; the sign depends on the firmware.
            return stereo_noise(self._lens.fx, float(self._sensor.get_option(rs.option.stereo_baseline)) * 1e-3)
        return "time_of_flight" if "L5" in self.name else None


def _info(device: Any, what: Any) -> str:
    return str(device.get_info(what)) if device.supports(what) else "unknown"


def _name(device: Any) -> str:
    name, serial = _info(device, rs.camera_info.name), _info(device, rs.camera_info.serial_number)
    return f"{name} (serial number {serial})"


def _has_depths(device: Any) -> bool:
    try:
        return _depth_sensor(device) is not None
    except RuntimeError:
        # It is busy, or was just disconnected.
        return False


def _depth_sensor(device: Any) -> Optional[Any]:
    for sensor in device.query_sensors():
        if any(profile.stream_type() == rs.stream.depth for profile in sensor.get_stream_profiles()):
            return sensor
    return None


def _profile(sensor: Any, settings: Settings, name: str) -> Any:
    """Returns the requested depth stream; of several the camera's default, else the first."""
    depth = [
        profile.as_video_stream_profile()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16
    ]
    fitting = [each for each in depth if settings.fits(each.width(), each.height(), each.fps())]
    if not fitting:
        there = sorted({f"{each.width()}x{each.height()} at {each.fps()} Hz" for each in depth})
        raise Refused(f"{name} has no depth images of {settings.profile()}", f"it has {', '.join(there) or 'none'}")
    return next((profile for profile in fitting if profile.is_default()), fitting[0])


def _is_same(intrinsics: Any, lens: Lens) -> bool:
    return (intrinsics.width, intrinsics.height, intrinsics.fx, intrinsics.ppx) == (
        lens.width,
        lens.height,
        lens.fx,
        lens.cx,
    )


def _lens(intrinsics: Any, name: str) -> Lens:
    """Returns the lens of the depth images, which most cameras rectify."""
    distortion: tuple[float, ...] = tuple(intrinsics.coeffs)  # k1, k2, p1, p2, k3
    model = intrinsics.model
    if not any(distortion) or model == rs.distortion.none:
        distortion = ()
    elif model != rs.distortion.brown_conrady:
        raise Refused(
            f"the depth images of {name} are distorted by a model that is not undone here ({model})",
            "let the SDK rectify them, and write a source of your own: docs/python.md",
        )
    size = (intrinsics.width, intrinsics.height)
    return Lens(*size, intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy, distortion)
