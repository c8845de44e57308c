"""A simulated RealSense (the SDK's software device) with the images of `scenes`; and recordings of it."""

import threading
import time

import pyrealsense2 as rs
import scenes

BASELINE_MM = 50.0
SERIAL = "000042"


class SoftwareRealSense:
    """A device with a depth sensor that sees a scene."""

    def __init__(self, shrink=1, domain=rs.timestamp_domain.system_time, coefficients=(0.0,) * 5, model=None):
        self.shrink, self.domain = shrink, domain
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.name, "Software RealSense")
        self.device.register_info(rs.camera_info.serial_number, SERIAL)
        self.sensor = self.device.add_sensor("Stereo Module")
        intrinsics = rs.intrinsics()
        intrinsics.width, intrinsics.height = scenes.WIDTH // shrink, scenes.HEIGHT // shrink
        intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy = (each / shrink for each in scenes.CAMERA)
        intrinsics.model = model or rs.distortion.brown_conrady
        intrinsics.coeffs = list(coefficients)
        stream = rs.video_stream()
        stream.type, stream.index, stream.uid, stream.fmt = rs.stream.depth, 0, 1, rs.format.z16
        stream.width, stream.height, stream.bpp, stream.fps = intrinsics.width, intrinsics.height, 2, 30
        stream.intrinsics = intrinsics
        self.profile = self.sensor.add_video_stream(stream)
        self.sensor.add_read_only_option(rs.option.depth_units, 0.001)
        self.sensor.add_read_only_option(rs.option.stereo_baseline, BASELINE_MM)

    def show(self, number, stamp_ms):
        """Makes the sensor send an image."""
        frame = rs.software_video_frame()
        pixels = scenes.millimetres(number)[:: self.shrink, :: self.shrink].copy()
        frame.pixels, frame.stride, frame.bpp = pixels, pixels.shape[1] * 2, 2
        frame.timestamp, frame.domain, frame.frame_number = stamp_ms, self.domain, number
        frame.profile, frame.depth_units = self.profile.as_video_stream_profile(), 0.001
        self.sensor.on_video_frame(frame)

    def film(self, is_on):
        """Sends 30 numbered images per second while `is_on` returns True."""

        def work():
            number = 0
            while True:
                if is_on():
                    self.show(number, number * 1000 / 30)
                    number += 1
                time.sleep(1 / 30)

        threading.Thread(target=work, daemon=True).start()


def record(path, frames):
    """Makes the SDK write a recording with this number of images, at 30 Hz."""
    camera = SoftwareRealSense()
    recorder = rs.recorder(str(path), camera.device)
    sensor = recorder.query_sensors()[0]
    came = threading.Semaphore(0)
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(lambda _: came.release())
    for number in range(frames):
        camera.show(number, 1000 + number * 1000 / 30)
        assert came.acquire(timeout=30), "the SDK keeps the image"
    sensor.stop()
    sensor.close()
