"""Installed as `sitecustomize` in the process of a camera node: the SDK finds a software device while the file `plugged` exists.

A word in the file selects the device: `large` or `small` images, or `silent`, without images. Each search for devices, and each
device found, adds a line to the file `looks`.
"""

import pathlib

import pyrealsense2 as rs
from software_realsense import SoftwareRealSense

PLUGGED = pathlib.Path("plugged")


class Device:
    """A software device that is lost when the file `plugged` is removed."""

    def __init__(self):
        self._word = PLUGGED.read_text()
        shrink = 2 if self._word == "small" else 1
        self._camera = SoftwareRealSense(shrink, rs.timestamp_domain.hardware_clock)
        self._camera.film(lambda: self.is_connected() and self._word != "silent")

    def is_connected(self):
        return PLUGGED.exists() and PLUGGED.read_text() == self._word

    def __getattr__(self, name):
        return getattr(self._camera.device, name)


class Context(rs.context):
    def query_devices(self):
        found = [Device()] if PLUGGED.exists() else []
        with open("looks", "a") as looks:
            print("found" if found else "nothing", file=looks)
        return found


rs.context = Context
