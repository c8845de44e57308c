"""Orbbec cameras, by pyorbbecsdk2: stereo (Gemini, Astra 2) and time of flight (Femto); or a recording of the SDK (.bag).

Tested with stand-ins for the SDK's classes, not with a camera.
"""

from typing import Any, Optional

import numpy as np
import pyorbbecsdk as ob

from .frame import Camera, EndOfRecording, Frame, Lens, Noise, Refused, Settings, noise_of, not_there, opening, stereo_noise

FORMATS = (ob.OBFormat.Y16, ob.OBFormat.Z16)
"""Depths as 16-bit integers."""
KNOWN_MODELS = (
    ob.OBCameraDistortionModel.BROWN_CONRADY,
    ob.OBCameraDistortionModel.BROWN_CONRADY_K6,
)
"""Distortion models that are rectified here."""


def connect(settings: Settings) -> Camera:
    """Opens the recording or the camera that the settings name."""
    # Otherwise the SDK writes log files beside the pipeline file.
    ob.Context.set_logger_to_file(ob.OBLogLevel.NONE, "")
    if settings.path:
        try:
            device = ob.PlaybackDevice(settings.path)
        except Exception as error:
            what = f"`{settings.path}` is no recording of an Orbbec camera: {error}"
            raise Refused(what, "name a .bag of OrbbecSDK 2") from error
        return Orbbec(device, settings, f"`{settings.path}`")
    devices = ob.Context().query_devices()
    for index in range(devices.get_count()):
        if settings.serial in (None, devices.get_device_serial_number_by_index(index)):
            with opening(_name(devices, index)):
                return Orbbec(devices.get_device_by_index(index), settings, _name(devices, index))
    there = [_name(devices, index) for index in range(devices.get_count())]
    hint = "is it plugged in, and may this user open it (udev rules of OrbbecSDK)?"
    raise not_there("Orbbec camera", settings.serial, there, hint)


def _name(devices: Any, index: int) -> str:
    name, serial = devices.get_device_name_by_index(index), devices.get_device_serial_number_by_index(index)
    return f"{name} (serial number {serial})"


class Orbbec:
    """The depth stream of a device."""

    def __init__(self, device: Any, settings: Settings, name: str) -> None:
        self.name = name
        self._device, self._settings, self._is_recording = device, settings, bool(settings.path)
        self._pipeline = ob.Pipeline(device)
        profile = self._profile(settings)
        self._see_through(profile)
        if not self._is_recording and device.is_global_timestamp_supported():
            device.enable_global_timestamp(True)
        config = ob.Config()
        config.enable_stream(profile)
        self._pipeline.start(config)

    def read(self, patience_s: float) -> Optional[Frame]:
        frames = self._pipeline.wait_for_frames(round(patience_s * 1000))
        depth = frames.get_depth_frame() if frames is not None else None
        if depth is None:
            if self._is_recording and self._device.get_playback_status() == ob.OBPlaybackStatus.STOPPED:
                raise EndOfRecording
            return None
        width, height = depth.get_width(), depth.get_height()
        if (width, height) != self._lens[:2]:
            self._see_through(depth.get_stream_profile().as_video_stream_profile())
        pixels = np.frombuffer(np.asarray(depth.get_data()).tobytes(), np.uint16)
        if pixels.size == width * height:
            pixels = pixels.reshape(height, width)
        # The camera's time on the computer's clock, as converted by the SDK; else the time when the frame came.
        stamp_ns = (depth.get_global_timestamp_us() or depth.get_system_timestamp_us()) * 1000
        scale = depth.get_depth_scale() * 1e-3
        return Frame(pixels, self._lens, scale, self._noise, stamp_ns, depth.get_index())

    def close(self) -> None:
        self._pipeline.stop()

    def _see_through(self, profile: Any) -> None:
        """Sets the lens, and the noise that depends on it."""
        self._lens = _lens(profile, self.name)
        self._noise = noise_of(self._settings, self.name, self._known_noise())

    def _profile(self, settings: Settings) -> Any:
        """Returns the requested depth stream; of several the camera's default, else the first."""
        profiles = self._pipeline.get_stream_profile_list(ob.OBSensorType.DEPTH_SENSOR)
        default = profiles.get_default_video_stream_profile()
        listed = [profiles.get_stream_profile_by_index(index) for index in range(profiles.get_count())]
        depth = [each.as_video_stream_profile() for each in listed]
        depth = [each for each in [default, *depth] if each.get_format() in FORMATS]
        for each in depth:
            if settings.fits(each.get_width(), each.get_height(), each.get_fps()):
                return each
        there = sorted({f"{each.get_width()}x{each.get_height()} at {each.get_fps()} Hz" for each in depth})
        raise Refused(f"{self.name} has no depth images of {settings.profile()}", f"it has {', '.join(there) or 'none'}")

    def _known_noise(self) -> Optional[Noise]:
        if "Femto" in self._device.get_device_info().get_name():
            return "time_of_flight"
        try:
            baseline_m = float(self._device.get_baseline().baseline) * 1e-3
        except Exception:
            # It is no stereo camera.
            return None
        return stereo_noise(self._lens.fx, baseline_m)


def _lens(profile: Any, name: str) -> Lens:
    """Returns the lens of the depth images; images of time-of-flight cameras are distorted."""
    intrinsic, distortion = profile.get_intrinsic(), profile.get_distortion()
    k1, k2, k3 = distortion.k1, distortion.k2, distortion.k3
    coefficients = (k1, k2, distortion.p1, distortion.p2, k3, distortion.k4, distortion.k5, distortion.k6)
    if any(coefficients) and distortion.model not in KNOWN_MODELS:
        raise Refused(
            f"the depth images of {name} are distorted by a model that is not undone here ({distortion.model})",
            "let the SDK rectify them, and write a source of your own: docs/python.md",
        )
    size = (profile.get_width(), profile.get_height())
    return Lens(*size, intrinsic.fx, intrinsic.fy, intrinsic.cx, intrinsic.cy, coefficients if any(coefficients) else ())
