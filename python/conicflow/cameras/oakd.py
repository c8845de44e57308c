"""Luxonis OAK-D, by depthai 3: depth of the stereo pair, which the camera rectifies and matches.

Tried with stand-ins for the SDK's classes, not with a camera. The SDK plays recordings back only through a camera.
"""

import datetime
import time
from typing import Any, Optional

import depthai as dai

from .frame import Camera, Frame, Lens, Settings, noise_of, not_there, stereo_noise

SCALE = 0.001
"""Depths come in millimetres."""
DEFAULT_SIZE = (640, 400)
KEPT = 2
"""Frames that wait at most."""


def connect(settings: Settings) -> Camera:
    """Opens the camera that the settings name."""
    devices = dai.Device.getAllAvailableDevices()
    for info in devices:
        if settings.serial in (None, info.getDeviceId()):
            return OakD(info, settings)
    hint = "is it plugged in, and may this user open it (udev rules of depthai)?"
    raise not_there("OAK-D", settings.serial, [info.getDeviceId() for info in devices], hint)


class OakD:
    """The stereo depth of a device."""

    def __init__(self, info: Any, settings: Settings) -> None:
        self.name = f"OAK-D (serial number {info.getDeviceId()})"
        self._device = dai.Device(info)
        try:
            self._pipeline = dai.Pipeline(self._device)
            size = (settings.width or DEFAULT_SIZE[0], settings.height or DEFAULT_SIZE[1])
            preset = dai.node.StereoDepth.PresetMode.DEFAULT
            stereo = self._pipeline.create(dai.node.StereoDepth)
            stereo.build(True, presetMode=preset, size=size, fps=settings.fps)
            stereo.setRectification(True)
            # Steps of a whole pixel would drown the noise.
            stereo.setSubpixel(True)
            self._queue = stereo.depth.createOutputQueue(maxSize=KEPT, blocking=False)
            self._settings, self._baseline_m = settings, self._baseline()
            self._pipeline.start()
        except Exception:
            self._device.close()
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
        # Its clock is that of this computer since it started.
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

    def _baseline(self) -> float:
        """Metres between both eyes, as they were calibrated."""
        calibration = self._device.readCalibration()
        right, left = calibration.getStereoRightCameraId(), calibration.getStereoLeftCameraId()
        return float(calibration.getBaselineDistance(right, left, False)) * 1e-2
