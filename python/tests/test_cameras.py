"""Tests of the common loop of all cameras (frames, stalls, losses, returns, sizes, invalid frames), of clocks and rectification.

They need no camera and no pipeline.
"""

import time
from dataclasses import replace

import numpy as np
import pytest

from conicflow.cameras import stream as streams
from conicflow.cameras.frame import (
    DeviceClock,
    EndOfRecording,
    Frame,
    Lens,
    NotThere,
    Rectifier,
    Refused,
    Settings,
    noise_of,
    stereo_noise,
)
from conicflow.cameras.stream import Stream

LENS = Lens(8, 6, 10.0, 10.0, 3.5, 2.5)
SETTINGS = Settings(None, None, None, None, None, None, stall_s=0.05)


def frame(value=1000, lens=LENS, number=None, depth=None):
    depth = np.full((lens.height, lens.width), value, np.uint16) if depth is None else depth
    return Frame(depth, lens, 0.001, "ideal", 7, number)


class FakeCamera:
    """A camera that follows a script of frames, None for a time without a frame, and exceptions to raise."""

    def __init__(self, *script):
        self.name, self.script, self.closed = "fake", list(script), False

    def read(self, patience_s):
        came = self.script.pop(0) if self.script else None
        if came is None:
            time.sleep(patience_s)
        if isinstance(came, Exception):
            raise came
        return came

    def close(self):
        self.closed = True
        raise OSError("it is gone, so this fails as well")


class FakeSource:
    """A stand-in for the source of a run."""

    def __init__(self, resume_at=0):
        self.resume_at, self.counted, self.sent, self.looks, self.most_looks = resume_at, {}, [], 0, 100

    @property
    def stopping(self):
        self.looks += 1
        return self.looks > self.most_looks

    def count(self, name, times=1):
        if times > 0:
            self.counted[name] = self.counted.get(name, 0) + times

    def send(self, items, **header):
        if header["camera"][0] < 1.0:
            raise ValueError("no focal length")
        self.sent.append((items, header))


@pytest.fixture(autouse=True)
def quick(monkeypatch):
    monkeypatch.setattr(streams, "LOOK_S", 0.002)
    monkeypatch.setattr(streams, "TRY_AGAIN_S", 0.004)


def play(cameras, settings=SETTINGS, source=None, most_looks=100):
    """Runs a stream with these cameras. Returns its frames, its log, and its source, which has the counters."""
    source = source or FakeSource()
    source.most_looks = most_looks
    cameras, told = list(cameras), []

    def connect():
        camera = cameras.pop(0) if cameras else NotThere("no fake is connected", "plug it in")
        if isinstance(camera, Exception):
            raise camera
        return camera

    stream = Stream(source, connect, settings, lambda level, text: told.append((level, text)))
    frames = []
    while (came := stream.next()) is not None:
        frames.append(came)
        stream.send(came)
    stream.close()
    return frames, told, source


def test_frames_come_and_a_recording_ends():
    camera = FakeCamera(frame(1), None, frame(2), EndOfRecording())
    frames, told, source = play([camera])
    assert [each.depth[0, 0] for each in frames] == [1, 2] and not source.counted
    assert told == [("info", "fake: images of 8x6")]
    items, header = source.sent[1]
    assert items[0, 0] == 2
    assert header == {"camera": (10.0, 10.0, 3.5, 2.5), "scale": 0.001, "noise": "ideal", "stamp_ns": 7}
    assert camera.closed, "and that it could not be closed is no news"


def test_a_camera_that_is_not_there_is_told_once_and_waited_for():
    missing = NotThere("no fake is connected", "plug it in")
    frames, told, source = play([missing] * 5 + [FakeCamera(frame(1), EndOfRecording())])
    assert len(frames) == 1 and source.counted == {}
    assert told == [
        ("warn", "no fake is connected\n  hint: plug it in\n  the stage waits for the camera"),
        ("info", "fake: images of 8x6"),
    ]


def test_a_camera_that_never_comes_does_not_keep_the_run_from_its_end():
    frames, told, _ = play([], most_looks=30)
    assert frames == [] and len(told) == 1


@pytest.mark.parametrize(
    ("first", "told"),
    [
        (FakeCamera(frame(1), OSError("no such device")), "fake is lost: no such device"),
        (FakeCamera(frame(1)), "fake is lost: no image for 0."),
    ],
)
def test_a_camera_that_is_unplugged_or_stalls_is_opened_anew(first, told):
    second = FakeCamera(frame(2), EndOfRecording())
    missing = NotThere("no fake is connected", "plug it in")
    frames, texts, source = play([first, missing, missing, second], most_looks=1000)
    assert [each.depth[0, 0] for each in frames] == [1, 2] and first.closed
    assert source.counted == {"camera opened anew": 1}
    levels = [level for level, _ in texts]
    assert levels == ["info", "warn", "warn", "info"] and texts[1][1].startswith(told)


def test_a_camera_that_stalls_again_and_again_is_told_once():
    cameras = [FakeCamera() for _ in range(4)] + [FakeCamera(frame(1), EndOfRecording())]
    frames, told, source = play(cameras, most_looks=2000)
    assert len(frames) == 1 and source.counted == {"camera opened anew": 4}
    assert [level for level, _ in told] == ["warn", "info"], told


def test_a_slow_pipeline_is_no_stall():
    stream = Stream(FakeSource(), lambda: FakeCamera(frame(1), None, frame(2)), SETTINGS, lambda *_: None)
    assert stream.next().depth[0, 0] == 1
    stream._heard -= 3600.0  # as if the pipeline had taken no frame for an hour
    assert stream.next().depth[0, 0] == 2


@pytest.mark.parametrize(
    "rubbish",
    [
        frame(depth=np.zeros((6, 8), np.uint8)),
        frame(depth=np.zeros((5, 8), np.uint16)),
        frame(depth=np.zeros(48, np.uint16)),
        frame(depth=b"\0" * 96),
        frame(lens=Lens(0, 0, 10.0, 10.0, 0.0, 0.0)),
    ],
)
def test_rubbish_is_counted_told_once_and_passed_over(rubbish):
    frames, told, source = play([FakeCamera(frame(1), rubbish, rubbish, frame(2), EndOfRecording())])
    assert [each.depth[0, 0] for each in frames] == [1, 2]
    assert source.counted == {"frames unreadable": 2}
    assert [level for level, _ in told] == ["info", "warn"] and "no depth image" in told[1][1]


def test_what_no_reader_would_take_is_counted_as_well():
    odd = frame(2, LENS._replace(fx=0.0))
    _, told, source = play([FakeCamera(frame(1), odd, frame(3), EndOfRecording())])
    assert [items[0, 0] for items, _ in source.sent] == [1, 3] and source.counted == {"frames unreadable": 1}
    assert ("warn", "no focal length") in told


def test_another_size_is_told_and_goes_on():
    larger = Lens(16, 12, 20.0, 20.0, 7.5, 5.5)
    frames, told, source = play([FakeCamera(frame(1), frame(2, larger), frame(3, larger), EndOfRecording())])
    assert [each.depth.shape for each in frames] == [(6, 8), (12, 16), (12, 16)] and not source.counted
    assert told[1:] == [("warn", "fake sends images of 16x12 from now on; those before were 8x6")]


def test_frames_that_the_camera_left_out_are_counted():
    numbers = [3, 4, 7, 8, 1, 2]  # the camera has started its numbers again
    script = [frame(number=number) for number in numbers]
    _, _, source = play([FakeCamera(*script, EndOfRecording())])
    assert source.counted == {"frames lost": 2} and len(source.sent) == 6


def test_a_parameter_that_no_camera_can_take_ends_the_run_but_only_at_the_start():
    refused = Refused("no such format", "it has others")
    with pytest.raises(Refused):
        play([refused])
    frames, told, _ = play([FakeCamera(frame(1), OSError("unplugged")), refused, FakeCamera(frame(2), EndOfRecording())])
    assert len(frames) == 2, "another camera than before is waited away"
    assert any("no such format" in text for _, text in told)


def test_a_recording_goes_on_where_it_was_and_is_not_begun_anew():
    recording = SETTINGS._replace(path="a.bag")
    camera = FakeCamera(*[frame(value) for value in range(5)], EndOfRecording())
    frames, _, _ = play([camera], recording, FakeSource(resume_at=3))
    assert [each.depth[0, 0] for each in frames] == [3, 4]
    with pytest.raises(Refused, match="cannot be read on: torn"):
        play([FakeCamera(frame(1), OSError("torn"))], recording)


def test_a_distorted_image_is_rectified():
    # A wide lens like that of an Azure Kinect; the image contains the positions of its pixels.
    lens = Lens(64, 64, 31.0, 31.0, 31.2, 32.1, (0.4, 0.2, 1e-3, -2e-3, 0.02, 0.7, 0.25, 0.05))
    u, v = np.meshgrid(np.arange(64), np.arange(64))
    for axis, places in (("column", u), ("row", v)):
        seen = Rectifier(lens)((places + 1).astype(np.uint16)).astype(float) - 1
        k1, k2, p1, p2, k3, k4, k5, k6 = lens.distortion
        x, y = (u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy
        r2 = x**2 + y**2
        growth = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        if axis == "column":
            expected = lens.fx * (x * growth + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)) + lens.cx
        else:
            expected = lens.fy * (y * growth + 2 * p2 * x * y + p1 * (r2 + 2 * y**2)) + lens.cy
        is_seen = seen >= 0
        assert is_seen.mean() > 0.9 and abs(seen - expected)[is_seen].max() < 0.51
        assert abs(expected - places).max() > 2.0, "it is distorted indeed"
    frames, told, _ = play([FakeCamera(frame(lens=lens), frame(lens=lens), EndOfRecording())])
    assert [each.lens for each in frames] == [lens._replace(distortion=())] * 2
    assert told == [("info", "fake: images of 64x64, rectified here")]


def test_what_lies_beyond_the_model_is_not_measured():
    # The distorted position x (1 - x^2) decreases beyond x = 1 / sqrt(3): farther out the image would show its middle again.
    lens = Lens(41, 1, 20.0, 20.0, 20.0, 0.0, (-1.0,))
    seen = Rectifier(lens)(np.full((1, 41), 5, np.uint16))[0]
    distances = abs(np.arange(41) - 20) / 20
    assert (seen[distances < 0.57] == 5).all() and (seen[distances > 0.58] == 0).all()


def test_stamps_of_a_clock_of_its_own():
    clock, second = DeviceClock(), 10**9
    assert clock.stamp_ns(5 * second, now_ns=100 * second) == 100 * second
    # The next image arrives late; the image after it has a smaller delay than the first.
    assert clock.stamp_ns(6 * second, now_ns=101 * second + 30_000_000) == pytest.approx(101 * second, abs=200_000)
    assert clock.stamp_ns(7 * second, now_ns=102 * second - 5_000_000) == 102 * second - 5_000_000
    # The clock restarts.
    assert clock.stamp_ns(0, now_ns=103 * second) == 103 * second
    # The clock is slow by 50 ppm, for an hour.
    for step in range(1, 3601):
        now = 103 * second + step * second
        stamp = clock.stamp_ns(round(step * second * (1 - 5e-5)), now_ns=now)
    assert abs(stamp - now) < 1_000_000


@pytest.mark.parametrize("step", [0.5, 0.9, -0.5])
def test_stamps_are_right_soon_after_a_clock_was_set(step):
    clock, random = DeviceClock(), np.random.default_rng(1)
    for number in range(30 * 60):
        taken_s = number / 30
        is_set = taken_s >= 30
        comes_s = taken_s + 100 + step * is_set + random.exponential(0.002)
        wrong_s = clock.stamp_ns(round(taken_s * 1e9), round(comes_s * 1e9)) * 1e-9 - (taken_s + 100 + step * is_set)
        if not is_set or taken_s > 34:
            assert -1e-6 < wrong_s < 0.006, (taken_s, wrong_s)


def test_images_that_come_late_for_a_while_set_no_clock():
    clock = DeviceClock()
    for number in range(300):
        # On a busy computer most images, but not all, are late during five seconds.
        late_s = 0.2 if 100 <= number < 250 and number % 10 else 0.0
        taken_ns = round(number / 30 * 1e9)
        assert clock.stamp_ns(taken_ns, taken_ns + round(late_s * 1e9)) - taken_ns < 1_000_000


def test_stamps_of_a_camera_do_not_go_back_a_little():
    script = [replace(frame(), stamp_ns=10**12 + stamp_ms * 10**6) for stamp_ms in (0, 33, 26, 60, -5000)]
    frames, _, _ = play([FakeCamera(*script)])
    assert [each.stamp_ns - 10**12 for each in frames] == [0, 33_000_000, 33_000_001, 60_000_000, -5_000_000_000]
    recording = SETTINGS._replace(path="a.bag")
    frames, _, _ = play([FakeCamera(*script, EndOfRecording())], recording)
    assert [each.stamp_ns for each in frames] == [each.stamp_ns for each in script], "a recording's are kept"


@pytest.mark.parametrize("error", [AttributeError("no getDeviceId"), TypeError("no argument fps"), ImportError("no core")])
def test_an_sdk_of_another_version_is_not_waited_for(error):
    with pytest.raises(Refused, match=f"SDK is not one that this node can use: {type(error).__name__}: no "):
        play([error])
    with pytest.raises(Refused):
        play([FakeCamera(error)])
    frames, told, _ = play([FakeCamera(frame(1), error), FakeCamera(frame(2))])
    assert len(frames) == 2, "it has worked"


def test_a_camera_that_cannot_be_opened_is_named():
    _, told, _ = play([OSError("busy")], SETTINGS._replace(serial="0007"))
    what = "the camera with serial number 0007 cannot be opened: busy\n  hint: does another program use it?"
    assert told[0] == ("warn", f"{what}\n  the stage waits for the camera")


def test_another_lens_is_told_by_its_numbers():
    zoomed = LENS._replace(fx=12.0)
    _, told, _ = play([FakeCamera(frame(1), frame(2, zoomed), EndOfRecording())])
    was, is_now = "fx 10.0 fy 10.0 cx 3.5 cy 2.5", "fx 12.0 fy 10.0 cx 3.5 cy 2.5"
    assert told[1:] == [("warn", f"fake sees through another lens from now on: {is_now}; before: {was}")]


def test_noise_is_never_guessed():
    growth = stereo_noise(424.0, 0.05)["growth_per_m"]
    assert growth == pytest.approx(0.08 / (424 * 0.05))
    assert stereo_noise(424.0, -0.05)["growth_per_m"] == growth, "seen from the other eye"
    assert stereo_noise(424.0, 50.0) is None and stereo_noise(424.0, 0.0) is None, "of another unit, or none"
    assert noise_of(SETTINGS._replace(noise="ideal"), "it", None) == "ideal"
    assert noise_of(SETTINGS, "it", "time_of_flight") == "time_of_flight"
    with pytest.raises(Refused, match="does not tell the noise of it\n  hint: write `noise = "):
        noise_of(SETTINGS, "it", None)
