"""Luxonis OAK-D, by depthai 3: depth of the stereo pair, which the camera rectifies and matches.

Tested with stand-ins for the SDK's classes, not with a camera. The SDK plays recordings back only through a camera.
"""

import datetime
import time
from typing import Any, Optional

import depthai as dai

from .frame import Camera, Frame, Lens, Refused, Settings, noise_of, not_there, opening, stereo_noise, text_of

SCALE = 0.001
"""Depths come in millimetres."""
DEFAULT_SIZE = (640, 400)
KEPT = 2
"""Maximum number of frames that wait."""


def connect(settings: Settings) -> Camera:
    """Opens the camera that the settings name."""
    devices = dai.Device.getAllAvailableDevices()
    for info in devices:
        if settings.serial in (None, info.getDeviceId()):
            with opening(_name(info)):
                return OakD(info, settings)
    hint = "is it plugged in, and may this user open it (udev rules of depthai)?"
    raise not_there("OAK-D", settings.serial, [info.getDeviceId() for info in devices], hint)


def _name(info: Any) -> str:
    return f"OAK-D (serial number {info.getDeviceId()})"


class OakD:
    """The stereo depth of a device."""

    def __init__(self, info: Any, settings: Settings) -> None:
        self.name = _name(info)
        self._device = dai.Device(info)
        try:
            self._pipeline, self._settings = dai.Pipeline(self._device), settings
            self._pair = self._stereo_pair()
            self._baseline_m = self._baseline()
            self._start()
        except Exception:
            self._device.close()
            raise

    def _start(self) -> None:
        settings = self._settings
        size = (settings.width or DEFAULT_SIZE[0], settings.height or DEFAULT_SIZE[1])
        preset = dai.node.StereoDepth.PresetMode.DEFAULT
        stereo = self._pipeline.create(dai.node.StereoDepth)
        try:
            stereo.build(True, presetMode=preset, size=size, fps=settings.fps)
            stereo.setRectification(True)
            # With steps of a whole pixel, quantisation would exceed the noise.
            stereo.setSubpixel(True)
            _leave_unsmoothed(stereo.initialConfig)
            self._queue = stereo.depth.createOutputQueue(maxSize=KEPT, blocking=False)
            self._pipeline.start()
        except RuntimeError as error:
            is_asked_for = settings.width is not None or settings.fps is not None
            if is_asked_for and not _is_of_the_link(error):
                what = f"{self.name} has no depth images of {settings.profile()}: {text_of(error)}"
                raise Refused(what, f"it has {self._modes()}") from error
            raise

    def read(self, patience_s: float) -> Optional[Frame]:
        if not self._pipeline.isRunning():
            raise ConnectionError("it ended its work, or was unplugged")
        image: Any = self._queue.get(datetime.timedelta(seconds=patience_s))
        if image is None:
            return None
        depth = image.getFrame()
        matrix = image.getTransformation().getIntrinsicMatrix()
        (fx, _, cx), (_, fy, cy) = matrix[0], matrix[1]
        lens = Lens(image.getWidth(), image.getHeight(), fx, fy, cx, cy)
        # Its stamps are on this computer's clock, counted from its start.
        clock: Any = dai.Clock
        age = clock.now() - image.getTimestamp()
        stamp_ns = time.time_ns() - round(age.total_seconds() * 1e9)
        noise = noise_of(self._settings, self.name, stereo_noise(fx, self._baseline_m))
        return Frame(depth, lens, SCALE, noise, stamp_ns, image.getSequenceNum())

    def close(self) -> None:
        try:
            self._pipeline.stop()
        finally:
            self._device.close()

    def _stereo_pair(self) -> tuple[Any, Any]:
        """The sockets of the right and the left camera, from the calibration."""
        calibration = self._device.readCalibration()
        pair = (calibration.getStereoRightCameraId(), calibration.getStereoLeftCameraId())
        cameras = self._device.getConnectedCameraFeatures()
        if not {each.socket for each in cameras}.issuperset(pair):
            there = ", ".join(f"{each.sensorName} on {_socket(each)}" for each in cameras)
            hint = f"it has {there or 'no cameras'}; name one that has, by `serial`"
            raise Refused(f"{self.name} has no calibrated pair of cameras for stereo", hint)
        return pair

    def _baseline(self) -> float:
        """The base line in metres, from the calibration."""
        return float(self._device.readCalibration().getBaselineDistance(*self._pair, False)) * 1e-2

    def _modes(self) -> str:
        """The formats of the left camera, in words."""
        (left,) = (each for each in self._device.getConnectedCameraFeatures() if each.socket == self._pair[1])
        modes = sorted({(each.width, each.height, each.maxFps) for each in left.configs})
        told = ", ".join(f"{width}x{height} up to {fps:g} Hz" for width, height, fps in modes)
        return f"{told or f'{left.width}x{left.height}'} ({left.sensorName})"


def _socket(camera: Any) -> str:
    return str(getattr(camera.socket, "name", camera.socket))


def _is_of_the_link(error: Exception) -> bool:
    """Whether an error means a lost cable or device, and not a wrong request."""
    return "X_LINK" in str(error) or "XLink" in str(error)


def _leave_unsmoothed(config: Any) -> None:
    """Switches off the preset's smoothing, filling and shrinking: the noise model is that of unfiltered depths."""
    config.setMedianFilter(dai.StereoDepthConfig.MedianFilter.MEDIAN_OFF)
    after: Any = config.postProcessing
    after.decimationFilter.decimationFactor = 1
    # Some versions of the SDK lack some of them.
    for name in ("temporalFilter", "spatialFilter", "speckleFilter", "holeFilling", "adaptiveMedianFilter"):
        if hasattr(after, name):
            getattr(after, name).enable = False
