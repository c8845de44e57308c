"""Azure Kinect, by pyk4a: a camera, or a recording of the SDK (.mkv). Its images are distorted, and rectified here.

Tested with stand-ins for the SDK's classes, not with a camera.
"""

from contextlib import suppress
from typing import Any, Optional

import pyk4a

from .frame import (
    IN_USE,
    WRONG_SDK,
    Camera,
    DeviceClock,
    EndOfRecording,
    Frame,
    Lens,
    NotThere,
    Refused,
    Settings,
    noise_of,
    not_there,
    text_of,
)

SCALE = 0.001
"""Depths come in millimetres."""
MODES = {
    (640, 576): pyk4a.DepthMode.NFOV_UNBINNED,
    (320, 288): pyk4a.DepthMode.NFOV_2X2BINNED,
    (512, 512): pyk4a.DepthMode.WFOV_2X2BINNED,
    (1024, 1024): pyk4a.DepthMode.WFOV_UNBINNED,
}
"""The depth mode for each image size: a narrow or a wide field of view, with or without binning."""
RATES = {5: pyk4a.FPS.FPS_5, 15: pyk4a.FPS.FPS_15, 30: pyk4a.FPS.FPS_30}
WIDEST_RATE = 15
"""The highest rate for images of 1024x1024."""


def connect(settings: Settings) -> Camera:
    """Opens the recording or the camera that the settings name."""
    if settings.path:
        playback = pyk4a.PyK4APlayback(settings.path)
        try:
            playback.open()
        except Exception as error:
            what = f"`{settings.path}` is no recording of an Azure Kinect: {error}"
            raise Refused(what, "name an .mkv of k4arecorder") from error
        return AzureKinect(playback, settings, f"`{settings.path}`")
    config, there = _config(settings), []
    for index in range(pyk4a.connected_device_count()):
        device = pyk4a.PyK4A(config, device_id=index)
        name = f"Azure Kinect number {index + 1}"
        try:
            device.open()
            name = f"Azure Kinect (serial number {device.serial})"
            if settings.serial in (None, device.serial):
                device.start()
                return AzureKinect(device, settings, name)
            there.append(device.serial)
        except WRONG_SDK:
            raise
        except Exception as error:
            there.append(f"{name}, which cannot be opened: {text_of(error)}; {IN_USE}")
        # If it could not be opened, there is nothing to close.
        with suppress(Exception):
            device.close()
    if there and settings.serial is None:
        raise NotThere("no Azure Kinect can be opened", f"connected: {', '.join(there)}")
    hint = "is it plugged in with its own power supply, and may this user open it (udev rules of k4a)?"
    raise not_there("Azure Kinect", settings.serial, there, hint)


def _config(settings: Settings) -> Any:
    size = (settings.width or 640, settings.height or 576)
    fps = settings.fps or (WIDEST_RATE if size == (1024, 1024) else 30)
    if size not in MODES or fps not in RATES or (size == (1024, 1024) and fps > WIDEST_RATE):
        sizes = ", ".join(f"{width}x{height}" for width, height in MODES)
        hint = f"it has {sizes}, at 5, 15 or 30 Hz; 1024x1024 up to {WIDEST_RATE} Hz"
        raise Refused(f"an Azure Kinect has no depth images of {settings.profile()}", hint)
    return pyk4a.Config(
        color_resolution=pyk4a.ColorResolution.OFF,
        depth_mode=MODES[size],
        camera_fps=RATES[fps],
        synchronized_images_only=False,
    )


class AzureKinect:
    """The depth images of a device."""

    def __init__(self, device: Any, settings: Settings, name: str) -> None:
        self.name = name
        self._device, self._is_recording = device, bool(settings.path)
        self._noise = noise_of(settings, name, "time_of_flight")
        self._clock = DeviceClock()
        kind = pyk4a.CalibrationType.DEPTH
        matrix = device.calibration.get_camera_matrix(kind)
        self._distortion = tuple(float(each) for each in device.calibration.get_distortion_coefficients(kind))
        self._pinhole = (float(matrix[0][0]), float(matrix[1][1]), float(matrix[0][2]), float(matrix[1][2]))

    def read(self, patience_s: float) -> Optional[Frame]:
        try:
            if self._is_recording:
                capture = self._device.get_next_capture()
            else:
                capture = self._device.get_capture(timeout=round(patience_s * 1000))
        except EOFError:
            raise EndOfRecording from None
        except pyk4a.K4ATimeoutException:
            return None
        depth = capture.depth
        if depth is None:
            return None
        height, width = depth.shape
        stamp_ns = capture.depth_timestamp_usec * 1000
        if not self._is_recording:
            stamp_ns = self._clock.stamp_ns(stamp_ns)
        return Frame(depth, Lens(width, height, *self._pinhole, self._distortion), SCALE, self._noise, stamp_ns)

    def close(self) -> None:
        if self._is_recording:
            self._device.close()
        else:
            self._device.stop()
