"""Depth images of a ball, an upright cylinder and a cone before a wall, made by casting a ray through each pixel, with the
noise of a Kinect; and how to write them as PNG files."""

import struct
import zlib

import numpy as np

CAMERA = (262.5, 262.5, 159.5, 119.5)
"""fx, fy, cx, cy of images of 320x240."""
WIDTH, HEIGHT = 320, 240
WALL_M = 2.5


def _rays():
    fx, fy, cx, cy = CAMERA
    u, v = np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT))
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u, dtype=float)], axis=-1)


def _nearest(a, b, c):
    """Returns the smaller root of a z^2 + b z + c = 0; NaN where there is no real root."""
    square = b * b - 4 * a * c
    root = np.sqrt(np.where(square < 0, np.nan, square))
    return np.fmin((-b - root) / (2 * a), (-b + root) / (2 * a))


def _ball(rays, center, radius):
    center = np.asarray(center)
    return _nearest((rays**2).sum(-1), -2 * rays @ center, center @ center - radius**2)


def _cylinder(rays, center, radius, length):
    x, y, z = center
    flat = rays[..., [0, 2]]
    depth = _nearest((flat**2).sum(-1), -2 * flat @ np.array([x, z]), x * x + z * z - radius**2)
    return np.where(abs(depth * rays[..., 1] - y) < length / 2, depth, np.nan)


def _cone(rays, apex, half_angle, length):
    slope = np.tan(half_angle) ** 2
    weight = np.array([1.0, -slope, 1.0])
    apex = np.asarray(apex)
    depth = _nearest((rays**2 @ weight), -2 * rays @ (weight * apex), (apex**2) @ weight)
    below = depth * rays[..., 1] - apex[1]
    return np.where((below > 0) & (below < length), depth, np.nan)


def metres(seed=0, shift_m=0.0):
    """Returns a depth image in metres, as float64; the ball is shifted along x."""
    rays = _rays()
    depth = np.full((HEIGHT, WIDTH), WALL_M)
    for shape in (
        _ball(rays, (0.1 + shift_m, 0.0, 1.2), 0.15),
        _cylinder(rays, (-0.35, 0.0, 1.5), 0.12, 0.6),
        _cone(rays, (0.55, -0.25, 1.6), 0.3, 0.5),
    ):
        depth = np.fmin(depth, shape)
    sigma = 0.0012 + 0.0019 * (depth - 0.4) ** 2
    return depth + sigma * np.random.default_rng(seed).standard_normal(depth.shape)


def millimetres(seed=0, shift_m=0.0):
    """Returns a depth image in integer millimetres, with a hole of pixels without a measurement."""
    depth = np.round(metres(seed, shift_m) * 1000).astype(np.uint16)
    depth[200:210, 10:30] = 0
    return depth


def write_png(path, pixels):
    """Writes 16-bit grey pixels."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    height, width = pixels.shape
    rows = b"".join(b"\0" + row.astype(">u2").tobytes() for row in pixels)
    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    data = b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")
    path.write_bytes(data)
