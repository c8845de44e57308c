"""Tests of `realsense_source` with the real SDK: its software device and its recordings, in pipelines."""

import json
import os
import shutil
import signal
import sys
import time
from pathlib import Path

import pytest
import scenes
from conftest import sdk_of_realsense
from pipelines import OBJECTS

import conicflow
from conicflow.cameras.frame import EndOfRecording, Refused, Settings, stereo_noise

rs = sdk_of_realsense()

from software_realsense import BASELINE_MM, SERIAL, SoftwareRealSense, record

from conicflow.cameras.realsense import RealSense, connect

SETTINGS = Settings(None, None, None, None, None, None, stall_s=3.0)
NOISE = stereo_noise(scenes.CAMERA[0], BASELINE_MM * 1e-3)
HERE = Path(__file__).parent


def pipeline(playground, keys):
    text = OBJECTS.format(rate_hz=0)
    begin, end = text.index("[stage.camera]"), text.index("[stage.extractor]")
    camera = f'[stage.camera]\nnode = "realsense_source"\noutput = "depth"\npython = "{sys.executable}"\n{keys}\n\n'
    playground.write("pipeline.toml", text[:begin] + camera + text[end:])


def lines(playground):
    path = playground.folder / "objects.jsonl"
    text = path.read_text() if path.exists() else ""
    return [json.loads(line) for line in text.splitlines() if line.endswith("}")]


def test_a_recording_of_the_sdk_is_played_back_to_the_last_frame(playground):
    record(playground.folder / "run.db3", 12)
    pipeline(playground, 'path = "run.db3"')
    _, told = playground.run("run")
    played = lines(playground)
    assert [line["sequence"] for line in played] == list(range(12))
    assert [line["stamp_ns"] for line in played] == [round((1000 + n * 1000 / 30) * 1e6) for n in range(12)]
    detector = conicflow.Detector(scenes.CAMERA, scale=0.001, noise=NOISE)
    for number, line in enumerate(played):
        found = detector.detect(scenes.millimetres(number))
        assert line["objects"] == [each.to_dict() for each in found] and len(found) > 0
    assert "images of 320x240" in told and "has a median depth of " in told, told
    # The output of the SDK does not mix with the results.
    out, _ = playground.run("run", "--frames", 5, "--quiet")
    assert out == "" and [line["sequence"] for line in lines(playground)] == list(range(5))


class Plugged:
    """A pipeline whose camera can be plugged in and out."""

    def __init__(self, playground, monkeypatch, keys=""):
        self.playground = playground
        (playground.folder / "site").mkdir()
        shutil.copy(HERE / "plugged_realsense.py", playground.folder / "site/sitecustomize.py")
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(playground.folder / "site"), str(HERE)]))
        pipeline(playground, keys)

    def plug(self, word):
        self.playground.write("plugged.new", word)
        (self.playground.folder / "plugged.new").rename(self.playground.folder / "plugged")

    def unplug(self):
        (self.playground.folder / "plugged").unlink()

    def wait_for_looks(self, what, number):
        looks = self.playground.folder / "looks"
        enough = lambda: looks.exists() and looks.read_text().count(what) >= number  # noqa: E731
        self.playground.wait_until(f"{what} was seen {number} times", enough)

    def wait_for(self, more):
        number = len(lines(self.playground))
        self.playground.wait_until(f"{more} images more came", lambda: len(lines(self.playground)) >= number + more)


def test_a_camera_that_comes_late_is_unplugged_and_returns(playground, monkeypatch):
    plugged = Plugged(playground, monkeypatch)
    process = playground.start("run")
    # The camera is not connected yet, and the run goes on.
    plugged.wait_for_looks("nothing", 2)
    assert process.poll() is None
    plugged.plug("large")
    plugged.wait_for(5)
    plugged.unplug()
    plugged.plug("small")
    plugged.wait_for(5)
    process.send_signal(signal.SIGINT)
    _, told = playground.end(process)
    seen = lines(playground)
    assert [line["sequence"] for line in seen] == list(range(len(seen))), "others see a gap in time, not in numbers"
    # The camera's clock started at zero, but the stamps are times of this computer's clock.
    assert all(abs(line["stamp_ns"] - time.time_ns()) < 600e9 for line in seen)
    assert "no RealSense is connected" in told and "waits for the camera" in told
    assert f"Software RealSense (serial number {SERIAL}) is lost: it was unplugged" in told
    assert "images of 320x240" in told and "images of 160x120" in told
    assert "camera opened anew: 1" in told, told


def test_a_camera_that_is_silent_is_opened_anew(playground, monkeypatch):
    plugged = Plugged(playground, monkeypatch, "stall_s = 0.5")
    plugged.plug("silent")
    process = playground.start("run")
    plugged.wait_for_looks("found", 2)
    plugged.plug("small")
    plugged.wait_for(5)
    process.send_signal(signal.SIGINT)
    _, told = playground.end(process)
    assert "is lost: no image for " in told, told
    assert "camera opened anew" in told


def test_a_camera_process_that_is_killed_is_started_anew_and_the_others_live(playground, monkeypatch):
    plugged = Plugged(playground, monkeypatch)
    plugged.plug("small")
    process = playground.start("run")
    plugged.wait_for(5)
    shown, _ = playground.run("top", "--once")
    stages = {row["stage"]: row for row in json.loads(shown)["pipelines"][0]["stages"]}
    os.kill(stages["camera"]["process"], signal.SIGKILL)
    plugged.wait_for(5)
    shown, _ = playground.run("top", "--once")
    after = {row["stage"]: row for row in json.loads(shown)["pipelines"][0]["stages"]}
    assert after["camera"]["process"] != stages["camera"]["process"]
    assert after["extractor"]["process"] == stages["extractor"]["process"]
    process.send_signal(signal.SIGINT)
    playground.end(process)


def test_what_cannot_be_is_refused_with_what_there_is(playground, monkeypatch):
    plugged = Plugged(playground, monkeypatch, "width = 640\nheight = 480")
    plugged.plug("large")
    _, told = playground.run("run", code=1)
    assert "has no depth images of 640x480" in told and "hint: it has 320x240 at 30 Hz" in told
    assert "stage `camera` could not start" in told and "SystemExit" not in told
    (playground.folder / "run.bag").write_text("junk")
    pipeline(playground, 'path = "run.bag"')
    _, told = playground.run("run", code=1)
    assert "run.bag` is no recording of a RealSense" in told and "hint: name a .bag or .db3" in told


def test_without_the_sdk_validate_says_what_to_install(playground, monkeypatch):
    pipeline(playground, "")
    out, _ = playground.run("validate")
    assert "is valid" in out
    (playground.folder / "site").mkdir()
    (playground.folder / "site/pyrealsense2.py").write_text("raise ImportError('nothing here')")
    monkeypatch.setenv("PYTHONPATH", str(playground.folder / "site"))
    _, told = playground.run("validate", code=2)
    assert f"{sys.executable} has no pyrealsense2 (nothing here)" in told
    assert f"hint: `{sys.executable} -m pip install pyrealsense2`" in told
    pipeline(playground, "")
    text = (playground.folder / "pipeline.toml").read_text().replace(sys.executable, "/bin/false")
    playground.write("pipeline.toml", text)
    _, told = playground.run("validate", code=2)
    assert "`/bin/false` cannot import conicflow.cameras" in told and '-m pip install "./python[realsense]"' in told


def test_of_two_cameras_that_with_the_serial_number_is_taken(monkeypatch):
    class Context:
        def query_devices(self):
            return [SoftwareRealSense().device]

    monkeypatch.setattr(rs, "context", Context)
    camera = connect(SETTINGS._replace(serial=SERIAL))
    camera.close()
    with pytest.raises(Exception, match=f"with serial number 7 is connected\n.*connected: .*number {SERIAL}"):
        connect(SETTINGS._replace(serial="7"))


class Tracking:
    """A device without a depth sensor."""

    def supports(self, what):
        return False

    def query_sensors(self):
        return []


def plug_in(monkeypatch, devices):
    class Context:
        def query_devices(self):
            return devices

    monkeypatch.setattr(rs, "context", Context)


def test_of_two_cameras_the_first_with_depths_is_taken(monkeypatch):
    plug_in(monkeypatch, [Tracking(), SoftwareRealSense().device])
    camera = connect(SETTINGS)
    camera.close()
    assert SERIAL in camera.name
    plug_in(monkeypatch, [Tracking()])
    with pytest.raises(Refused, match="has no depth sensor\n  hint: name one that has"):
        connect(SETTINGS)


def test_an_older_sdk_tells_only_which_devices_there_are(monkeypatch):
    class Older:
        def __init__(self):
            self._made = SoftwareRealSense()

        def __getattr__(self, name):
            if name == "is_connected":
                raise AttributeError(name)
            return getattr(self._made.device, name)

    there = [Older()]
    plug_in(monkeypatch, there)
    camera = connect(SETTINGS)
    assert camera.read(0.01) is None
    there.clear()
    with pytest.raises(ConnectionError, match="unplugged"):
        camera.read(0.01)
    camera.close()


def test_the_noise_is_that_of_the_lens():
    device = SoftwareRealSense()
    camera = RealSense(device.device, SETTINGS, None)
    wider = camera._lens._replace(fx=camera._lens.fx / 2)
    camera._lens = wider
    camera._noise = stereo_noise(wider.fx, BASELINE_MM * 1e-3)
    device.show(3, 5000.0)
    assert camera.read(30.0).noise == NOISE
    camera.close()


def opened(device, settings=SETTINGS):
    camera = RealSense(device.device, settings, None)
    device.show(3, 5000.0)
    frame = camera.read(30.0)
    camera.close()
    return frame


def test_intrinsics_scale_and_noise_are_those_of_the_sdk():
    frame = opened(SoftwareRealSense())
    assert frame.lens == (320, 240, *scenes.CAMERA, ()) and not frame.lens.is_distorted
    assert (frame.scale, frame.noise, frame.stamp_ns, frame.number) == (0.001, NOISE, 5_000_000_000, 3)
    assert (frame.depth == scenes.millimetres(3)).all()
    assert opened(SoftwareRealSense(), SETTINGS._replace(noise="ideal")).noise == "ideal"


def test_distorted_depth_is_rectified_or_refused():
    frame = opened(SoftwareRealSense(coefficients=(0.1, 0.0, 0.0, 0.0, -0.02)))
    assert frame.lens.distortion == pytest.approx((0.1, 0.0, 0.0, 0.0, -0.02))
    inverse = SoftwareRealSense(coefficients=(0.1, 0, 0, 0, 0), model=rs.distortion.inverse_brown_conrady)
    with pytest.raises(Refused, match="distorted by a model that is not undone here"):
        opened(inverse)


def test_a_recording_waits_for_who_reads_it_and_a_camera_does_not(tmp_path):
    record(tmp_path / "run.db3", 10)
    camera = connect(SETTINGS._replace(path=str(tmp_path / "run.db3")))
    numbers = []
    with pytest.raises(EndOfRecording):
        while True:
            time.sleep(0.02)
            frame = camera.read(0.1)
            numbers += [frame.number] if frame else []
    camera.close()
    assert numbers == list(range(10))
    device = SoftwareRealSense()
    camera = RealSense(device.device, SETTINGS, None)
    for number in range(10):
        device.show(number, 5000.0 + number)
    deadline = time.monotonic() + 30
    while (frame := camera.read(0.1)) is None or frame.number < 9:
        assert time.monotonic() < deadline
    camera.close()
