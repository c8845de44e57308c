"""Tests of the adapters for Orbbec, OAK-D and Azure Kinect with stand-ins for their SDKs, and of the errors without an SDK."""

import json
import subprocess
import sys
import time

import pytest
from stand_ins import HEIGHT, WIDTH, AzureKinect, OakD, Orbbec, take_place

from conicflow.cameras.__main__ import ADAPTERS, SDKS, how_to_install, settings
from conicflow.cameras.frame import EndOfRecording, NotThere, Refused, Settings, stereo_noise

SETTINGS = Settings(None, None, None, None, None, None, stall_s=3.0)


def read_all(camera):
    """Returns the frames until the recording ends, or until no frame arrives in time."""
    frames = []
    try:
        while (frame := camera.read(0.1)) is not None:
            frames.append(frame)
    except EndOfRecording:
        pass
    return frames


def test_orbbec_tells_lens_scale_noise_and_stamp(monkeypatch):
    sdk = Orbbec([1000, 1001])
    camera = take_place(monkeypatch, sdk, "orbbec").connect(SETTINGS)
    assert camera.name == "Orbbec Gemini 335 (serial number CP1)"
    first, second = read_all(camera)
    assert first.lens == (WIDTH, HEIGHT, 10.0, 11.0, 3.5, 2.5, ()) and first.depth.shape == (HEIGHT, WIDTH)
    assert first.scale == pytest.approx(0.0001) and first.noise == stereo_noise(10.0, 0.095)
    assert (first.stamp_ns, first.number, second.number) == (1_000_000_000, 1000, 1001)
    assert (second.depth == 1001).all()
    camera.close()
    assert sdk.stopped


def test_orbbec_takes_the_format_that_is_asked_for(monkeypatch):
    sdk = Orbbec([1])
    adapter = take_place(monkeypatch, sdk, "orbbec")
    adapter.connect(SETTINGS)
    assert (sdk.started.get_width(), sdk.started.get_fps()) == (WIDTH, 30), "the default is packed, and passed over"
    adapter.connect(SETTINGS._replace(fps=5))
    assert (sdk.started.get_width(), sdk.started.get_fps()) == (WIDTH, 5)
    adapter.connect(SETTINGS._replace(width=16, height=12))
    assert sdk.started.get_width() == 16
    with pytest.raises(Refused, match="no depth images of 64x48\n  hint: it has 16x12 at 5 Hz, 8x6 at 30 Hz, 8x6 at 5 Hz"):
        adapter.connect(SETTINGS._replace(width=64, height=48))
    with pytest.raises(NotThere, match="with serial number X is connected\n.*connected: Orbbec Gemini 335 .serial number CP1"):
        adapter.connect(SETTINGS._replace(serial="X"))


def test_the_noise_of_orbbec_is_that_of_the_lens(monkeypatch):
    sdk = Orbbec([1, 2])
    camera = take_place(monkeypatch, sdk, "orbbec").connect(SETTINGS)
    assert camera.read(0.1).noise == stereo_noise(10.0, 0.095)
    sdk.size = (2 * WIDTH, HEIGHT)
    frame = camera.read(0.1)
    assert (frame.lens.width, frame.lens.fx, frame.noise) == (2 * WIDTH, 20.0, stereo_noise(20.0, 0.095))


def test_an_orbbec_camera_that_is_busy_is_named(monkeypatch):
    sdk = Orbbec([1])
    sdk.busy = True
    told = "Orbbec Gemini 335 .serial number CP1. cannot be opened: LIBUSB_ERROR_BUSY\n  hint: does another program use it"
    with pytest.raises(NotThere, match=told):
        take_place(monkeypatch, sdk, "orbbec").connect(SETTINGS)


def test_orbbec_of_time_of_flight_is_distorted(monkeypatch):
    sdk = Orbbec([1], "Orbbec Femto Bolt", None, (0.5, 0.1, 0.0, 0.0, 0.01, 0.8, 0.2, 0.02))
    sdk.has_global_clock = False
    (frame,) = read_all(take_place(monkeypatch, sdk, "orbbec").connect(SETTINGS))
    assert frame.noise == "time_of_flight" and frame.lens.distortion == (0.5, 0.1, 0.0, 0.0, 0.01, 0.8, 0.2, 0.02)
    assert frame.stamp_ns == 5_000_000_000, "when it came, where the SDK converts no clock"
    inverse = Orbbec([1], distortion=(0.5,) * 8, model="INVERSE_BROWN_CONRADY")
    with pytest.raises(Refused, match="distorted by a model that is not undone here"):
        take_place(monkeypatch, inverse, "orbbec").connect(SETTINGS)
    with pytest.raises(Refused, match="does not tell the noise of Orbbec Astra"):
        take_place(monkeypatch, Orbbec([1], "Orbbec Astra", None), "orbbec").connect(SETTINGS)
    astra = take_place(monkeypatch, Orbbec([1], "Orbbec Astra", None), "orbbec")
    assert read_all(astra.connect(SETTINGS._replace(noise="kinect_v1")))[0].noise == "kinect_v1"


def test_a_recording_of_orbbec_ends(monkeypatch):
    adapter = take_place(monkeypatch, Orbbec([1, 2, 3]), "orbbec")
    camera = adapter.connect(SETTINGS._replace(path="run.bag"))
    assert [frame.number for frame in read_all(camera)] == [1, 2, 3]
    with pytest.raises(EndOfRecording):
        camera.read(0.1)
    with pytest.raises(Refused, match="`torn.bag` is no recording of an Orbbec camera: Error opening file"):
        adapter.connect(SETTINGS._replace(path="torn.bag"))


def test_oak_d_tells_lens_noise_and_stamp(monkeypatch):
    sdk = OakD([1000, 1001])
    camera = take_place(monkeypatch, sdk, "oakd").connect(SETTINGS._replace(fps=20))
    before = time.time_ns()
    first, second = read_all(camera)
    assert first.lens == (WIDTH, HEIGHT, 10.0, 11.0, 3.5, 2.5, ()) and first.scale == 0.001
    assert first.noise == stereo_noise(10.0, 0.075) and second.number == 1001
    # The frame was half a second old when it arrived.
    assert before - 500_000_000 <= first.stamp_ns <= time.time_ns() - 500_000_000
    assert sdk.built["size"] == (640, 400) and sdk.built["fps"] == 20
    sdk.is_running = False
    with pytest.raises(ConnectionError, match="unplugged"):
        camera.read(0.1)
    camera.close()
    assert sdk.closed


def test_oak_d_that_cannot_be_opened_is_let_go(monkeypatch):
    sdk = OakD([1], devices=())
    adapter = take_place(monkeypatch, sdk, "oakd")
    with pytest.raises(NotThere, match="no OAK-D is connected\n  hint: is it plugged in"):
        adapter.connect(SETTINGS)
    with pytest.raises(NotThere, match="connected: 1844"):
        take_place(monkeypatch, OakD([1]), "oakd").connect(SETTINGS._replace(serial="7"))
    sdk = OakD([1], baseline_cm=0.0)
    camera = take_place(monkeypatch, sdk, "oakd").connect(SETTINGS)
    with pytest.raises(Refused, match="does not tell the noise of OAK-D"):
        camera.read(0.1)
    sdk = OakD([1])
    adapter = take_place(monkeypatch, sdk, "oakd")
    sdk.module.Pipeline.start = lambda self: (_ for _ in ()).throw(RuntimeError("no firmware"))
    with pytest.raises(NotThere, match="OAK-D .serial number 1844. cannot be opened: no firmware\n  hint: does another"):
        adapter.connect(SETTINGS)
    assert sdk.closed


@pytest.mark.parametrize("lacking", [None, "adaptiveMedianFilter"])
def test_oak_d_neither_smooths_nor_shrinks(monkeypatch, lacking):
    sdk = OakD([1])
    sdk.filters = [name for name in sdk.filters if name != lacking]
    take_place(monkeypatch, sdk, "oakd").connect(SETTINGS)
    after = vars(sdk.config.postProcessing)
    assert sdk.config.median == "MEDIAN_OFF" and after.pop("decimationFilter").decimationFactor == 1
    assert len(after) == len(sdk.filters) and not any(each.enable for each in after.values())


def test_oak_d_refuses_what_it_cannot_do(monkeypatch):
    sdk = OakD([1])
    sdk.cannot = "requested size is not supported"
    adapter = take_place(monkeypatch, sdk, "oakd")
    wanted = SETTINGS._replace(width=1920, height=1080, fps=500)
    told = "no depth images of 1920x1080 at 500 Hz: requested size is.*\n  hint: it has 1280x800 up to 120 Hz .OV9282."
    with pytest.raises(Refused, match=told):
        adapter.connect(wanted)
    assert sdk.closed
    sdk.cannot = "Couldn't write data to stream (X_LINK_ERROR)"
    with pytest.raises(NotThere, match="cannot be opened"):
        adapter.connect(wanted)
    sdk.sockets = [0]
    with pytest.raises(Refused, match="no calibrated pair of cameras for stereo\n  hint: it has OV9282 on 0"):
        adapter.connect(SETTINGS)


def test_azure_kinect_tells_lens_and_stamp(monkeypatch):
    sdk = AzureKinect([1000, 1033, -1])
    camera = take_place(monkeypatch, sdk, "azure_kinect").connect(SETTINGS)
    first, second = read_all(camera)
    assert first.lens[:6] == (WIDTH, HEIGHT, 10.0, 11.0, 3.5, 2.5)
    assert first.lens.distortion == (0.5, 0.1, 0.0, 0.0, 0.01, 0.8, 0.2, 0.02)
    assert (first.scale, first.noise) == (0.001, "time_of_flight")
    # The frames are 33 ms apart on the camera's clock, and arrive at the same time. Their stamps are near the present time.
    assert abs(first.stamp_ns - time.time_ns()) < 60e9 and abs(second.stamp_ns - first.stamp_ns) <= 34e6
    assert camera.read(0.1) is None, "nothing came in time"
    assert sdk.config.depth_mode.name == "NFOV_UNBINNED" and sdk.config.camera_fps.name == "FPS_30"
    camera.close()
    assert sdk.opened == []


@pytest.mark.parametrize(
    ("size", "fps", "mode"),
    [
        ((320, 288), 5, "NFOV_2X2BINNED at FPS_5"),
        ((512, 512), None, "WFOV_2X2BINNED at FPS_30"),
        ((1024, 1024), None, "WFOV_UNBINNED at FPS_15"),
        ((1024, 1024), 30, None),
        ((640, 480), None, None),
        ((640, 576), 60, None),
    ],
)
def test_azure_kinect_has_a_mode_for_each_size(monkeypatch, size, fps, mode):
    sdk = AzureKinect([1])
    adapter = take_place(monkeypatch, sdk, "azure_kinect")
    wanted = SETTINGS._replace(width=size[0], height=size[1], fps=fps)
    if mode is None:
        with pytest.raises(Refused, match="hint: it has 640x576, 320x288, 512x512, 1024x1024, at 5, 15 or 30 Hz"):
            adapter.connect(wanted)
    else:
        adapter.connect(wanted)
        assert f"{sdk.config.depth_mode.name} at {sdk.config.camera_fps.name}" == mode


def test_of_several_azure_kinects_that_with_the_serial_number_is_taken(monkeypatch):
    sdk = AzureKinect([1], serials=("0001", "0002"))
    adapter = take_place(monkeypatch, sdk, "azure_kinect")
    assert adapter.connect(SETTINGS._replace(serial="0002")).name == "Azure Kinect (serial number 0002)"
    assert sdk.opened == ["0002"], "the other was let go"
    with pytest.raises(NotThere, match="connected: 0001, 0002"):
        adapter.connect(SETTINGS._replace(serial="3"))


def test_an_azure_kinect_that_another_program_has_is_passed_over(monkeypatch):
    sdk = AzureKinect([1], serials=("0001", "0002"))
    sdk.busy = ("0001",)
    adapter = take_place(monkeypatch, sdk, "azure_kinect")
    assert adapter.connect(SETTINGS).name == "Azure Kinect (serial number 0002)"
    assert adapter.connect(SETTINGS._replace(serial="0002")).name == "Azure Kinect (serial number 0002)"
    with pytest.raises(NotThere, match="connected: Azure Kinect number 1, which cannot be opened: OSError; does another.*, 0002"):
        adapter.connect(SETTINGS._replace(serial="0001"))
    sdk.busy = ("0001", "0002")
    with pytest.raises(NotThere, match="no Azure Kinect can be opened\n  hint: connected: Azure Kinect number 1, which"):
        adapter.connect(SETTINGS)


def test_a_recording_of_azure_kinect_keeps_its_stamps_and_ends(monkeypatch):
    adapter = take_place(monkeypatch, AzureKinect([10, 43]), "azure_kinect")
    frames = read_all(adapter.connect(SETTINGS._replace(path="run.mkv")))
    assert [frame.stamp_ns for frame in frames] == [10_000_000, 43_000_000]
    with pytest.raises(Refused, match="`torn.mkv` is no recording of an Azure Kinect: no EBML head"):
        adapter.connect(SETTINGS._replace(path="torn.mkv"))


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_an_sdk_that_is_not_there_is_named_with_what_to_install(adapter, tmp_path, monkeypatch):
    for name in ("pyrealsense2", "pyorbbecsdk", "depthai", "pyk4a"):
        (tmp_path / f"{name}.py").write_text("print('noise of an SDK')\nraise ImportError('not here')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    asked = subprocess.run(
        [sys.executable, "-m", "conicflow.cameras", adapter, "--check"], capture_output=True, text=True, cwd=tmp_path
    )
    told = json.loads(asked.stdout)
    package = SDKS[adapter][0]
    assert asked.returncode == 2 and told["what"] == f"{sys.executable} has no {package} (not here)"
    assert told["hint"].startswith(f"`{sys.executable} -m pip install {package}`")


@pytest.mark.parametrize("adapter", ADAPTERS)
def test_an_sdk_of_another_version_is_refused(adapter, tmp_path, monkeypatch):
    sdk = SDKS[adapter]
    (tmp_path / f"{sdk.module}.py").touch()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    asked = subprocess.run(
        [sys.executable, "-m", "conicflow.cameras", adapter, "--check"], capture_output=True, text=True, cwd=tmp_path
    )
    told = json.loads(asked.stdout)
    assert asked.returncode == 2 and told["what"].startswith(f"{sdk.package} ")
    assert told["what"].endswith(f" of {sys.executable} has no `{sdk.needs[0]}`")
    assert told["hint"] == f"`{sys.executable} -m pip install --upgrade {sdk.package}`"


def test_a_python_that_a_distribution_keeps_for_itself_gets_an_environment(tmp_path, monkeypatch):
    monkeypatch.setattr("sys.base_prefix", sys.prefix)
    monkeypatch.setattr("sysconfig.get_path", lambda _: str(tmp_path))
    assert "venv" not in how_to_install("depthai", "").partition("; or name a Python")[0].replace(sys.executable, "")
    (tmp_path / "EXTERNALLY-MANAGED").touch()
    environment = f"sudo {sys.executable} -m venv --system-site-packages /opt/conicflow"
    assert f"{environment} && sudo /opt/conicflow/bin/pip install depthai`, too; and" in how_to_install("depthai", ", too")


def test_a_wrong_adapter_is_refused():
    asked = subprocess.run([sys.executable, "-m", "conicflow.cameras", "kinect"], capture_output=True, text=True)
    assert asked.returncode == 2 and "realsense|orbbec|oakd|azure_kinect" in asked.stderr


def test_paths_start_at_the_pipeline_file():
    assert settings({"stall_s": 3.0, "path": "a.bag", "python": "python3"}, "/robot").path == "/robot/a.bag"
    assert settings({"stall_s": 3.0, "path": "/data/a.bag"}, "/robot").path == "/data/a.bag"
    made = settings({"stall_s": 3.0, "noise": {"floor_m": 0.001}, "width": 640, "height": 480}, "/robot")
    assert made == (None, None, 640, 480, None, {"floor_m": 0.001}, 3.0) and made.profile() == "640x480"
