"""Stand-ins for the SDKs of Orbbec, OAK-D and Azure Kinect: the parts of their classes that the adapters call, with the names and
units of the SDKs' documentation. They test how the adapters use an SDK, not how the SDK behaves."""

import datetime
import sys
import types
from enum import Enum, IntEnum

import numpy as np

HEIGHT, WIDTH = 6, 8


def pixels(value):
    return np.full((HEIGHT, WIDTH), value, np.uint16)


def module(name, **members):
    made = types.ModuleType(name)
    vars(made).update(members)
    return made


class Orbbec:
    """pyorbbecsdk2: a camera with one profile, whose pipeline follows a script."""

    def __init__(self, script, name="Orbbec Gemini 335", baseline_mm=95.0, distortion=(0.0,) * 8, model="BROWN_CONRADY_K6"):
        self.script, self.name, self.baseline_mm, self.stopped = list(script), name, baseline_mm, False
        sdk = self

        class OBFormat(Enum):
            Y16, Z16, RLE = range(3)

        class OBCameraDistortionModel(Enum):
            NONE, BROWN_CONRADY, BROWN_CONRADY_K6, INVERSE_BROWN_CONRADY = range(4)

        class OBSensorType(Enum):
            DEPTH_SENSOR = 1

        class OBPlaybackStatus(Enum):
            PLAYING, STOPPED = range(2)

        class Profile:
            def __init__(self, form, width, height, fps, fx=10.0):
                self.fx, self.get_format, self.get_width = fx, lambda: form, lambda: width
                self.get_height, self.get_fps = lambda: height, lambda: fps

            def as_video_stream_profile(self):
                return self

            def get_intrinsic(self):
                return types.SimpleNamespace(fx=self.fx, fy=11.0, cx=3.5, cy=2.5, width=0, height=0)

            def get_distortion(self):
                keys = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
                return types.SimpleNamespace(model=OBCameraDistortionModel[model], **dict(zip(keys, distortion)))

        profiles = [Profile(OBFormat.RLE, 64, 48, 30), Profile(OBFormat.Y16, WIDTH, HEIGHT, 30)]
        profiles += [Profile(OBFormat.Y16, WIDTH, HEIGHT, 5), Profile(OBFormat.Z16, 16, 12, 5)]

        class Profiles:
            get_count = staticmethod(lambda: len(profiles))
            get_default_video_stream_profile = staticmethod(lambda: profiles[0])
            get_stream_profile_by_index = staticmethod(lambda index: profiles[index])

        class Depth:
            def __init__(self, value):
                self.value = value

            get_width, get_height = staticmethod(lambda: sdk.size[0]), staticmethod(lambda: sdk.size[1])
            get_stream_profile = staticmethod(lambda: Profile(OBFormat.Y16, *sdk.size, 30, fx=10.0 * sdk.size[0] / WIDTH))
            get_depth_scale = staticmethod(lambda: 0.1)  # millimetres per unit

            def get_data(self):
                return np.frombuffer(pixels(self.value).tobytes(), np.uint8)

            def get_index(self):
                return self.value

            def get_global_timestamp_us(self):
                return self.value * 1000 if sdk.has_global_clock else 0

            def get_system_timestamp_us(self):
                return 5_000_000

        class Pipeline:
            def __init__(self, device):
                if sdk.busy:
                    raise RuntimeError("LIBUSB_ERROR_BUSY")

            def get_stream_profile_list(self, sensor):
                return Profiles

            def start(self, config):
                sdk.started = config.profile

            def stop(self):
                sdk.stopped = True

            def wait_for_frames(self, patience_ms):
                value = sdk.script.pop(0) if sdk.script else None
                if isinstance(value, Exception):
                    raise value
                return value and types.SimpleNamespace(get_depth_frame=lambda: Depth(value))

        class Config:
            def enable_stream(self, profile):
                self.profile = profile

        class Device:
            def get_baseline(self):
                if sdk.baseline_mm is None:
                    raise RuntimeError("not supported")
                return types.SimpleNamespace(baseline=sdk.baseline_mm, zpd=0.0)

            get_device_info = staticmethod(lambda: types.SimpleNamespace(get_name=lambda: sdk.name))
            is_global_timestamp_supported = staticmethod(lambda: sdk.has_global_clock)
            enable_global_timestamp = staticmethod(lambda is_on: None)
            get_playback_status = staticmethod(
                lambda: OBPlaybackStatus.PLAYING if sdk.script else OBPlaybackStatus.STOPPED
            )

        class Devices:
            get_count = staticmethod(lambda: 1)
            get_device_name_by_index = staticmethod(lambda index: sdk.name)
            get_device_serial_number_by_index = staticmethod(lambda index: "CP1")
            get_device_by_index = staticmethod(lambda index: Device())

        def playback(path):
            if path.endswith("torn.bag"):
                raise RuntimeError("Error opening file")
            return Device()

        class Context:
            set_logger_to_file = staticmethod(lambda level, folder: None)
            query_devices = staticmethod(lambda: Devices)

        self.has_global_clock, self.size, self.busy = True, (WIDTH, HEIGHT), False
        self.module = module(
            "pyorbbecsdk",
            OBFormat=OBFormat,
            OBCameraDistortionModel=OBCameraDistortionModel,
            OBSensorType=OBSensorType,
            OBPlaybackStatus=OBPlaybackStatus,
            Pipeline=Pipeline,
            Config=Config,
            PlaybackDevice=playback,
            Context=Context,
            OBLogLevel=types.SimpleNamespace(NONE=5),
        )


class OakD:
    """depthai 3: a camera whose stereo node follows a script; `devices` are the serial numbers of the connected devices."""

    def __init__(self, script, devices=("1844",), baseline_cm=7.5):
        self.script, self.is_running, self.closed, self.built = list(script), True, False, {}
        sdk = self

        class Image:
            def __init__(self, value):
                self.value = value

            def getFrame(self):
                return pixels(self.value)

            getWidth, getHeight = staticmethod(lambda: WIDTH), staticmethod(lambda: HEIGHT)
            getTransformation = staticmethod(
                lambda: types.SimpleNamespace(
                    getIntrinsicMatrix=lambda: [[10.0, 0.0, 3.5], [0.0, 11.0, 2.5], [0.0, 0.0, 1.0]]
                )
            )
            getTimestamp = staticmethod(lambda: datetime.timedelta(seconds=99.5))

            def getSequenceNum(self):
                return self.value

        class Queue:
            def get(self, patience):
                value = sdk.script.pop(0) if sdk.script else None
                if isinstance(value, Exception):
                    raise value
                return Image(value) if value else None

        class StereoDepth:
            class PresetMode(Enum):
                DEFAULT = 2

            depth = types.SimpleNamespace(createOutputQueue=lambda maxSize, blocking: Queue())

            def __init__(self):
                self.initialConfig = sdk.config = types.SimpleNamespace(
                    median="KERNEL_7x7",
                    setMedianFilter=lambda median: setattr(sdk.config, "median", median),
                    postProcessing=types.SimpleNamespace(
                        decimationFilter=types.SimpleNamespace(decimationFactor=2),
                        **{name: types.SimpleNamespace(enable=True) for name in sdk.filters},
                    ),
                )

            def build(self, create_cameras, **arguments):
                sdk.built = arguments
                if sdk.cannot:
                    raise RuntimeError(sdk.cannot)

            def setRectification(self, is_on):
                assert is_on

            def setSubpixel(self, is_on):
                assert is_on

        class Pipeline:
            def __init__(self, device):
                pass

            def create(self, kind):
                return kind()

            start = staticmethod(lambda: None)
            stop = staticmethod(lambda: None)
            isRunning = staticmethod(lambda: sdk.is_running)

        class DeviceInfo:
            def __init__(self, serial):
                self.serial = serial

            def getDeviceId(self):
                return self.serial

        class Device:
            def __init__(self, info):
                if sdk.busy:
                    raise RuntimeError("X_LINK_DEVICE_ALREADY_IN_USE")

            def getConnectedCameraFeatures(self):
                config = types.SimpleNamespace(width=1280, height=800, maxFps=120.0)
                kind = {"sensorName": "OV9282", "width": 1280, "height": 800, "configs": [config]}
                return [types.SimpleNamespace(socket=socket, **kind) for socket in sdk.sockets]

            def readCalibration(self):
                return types.SimpleNamespace(
                    getStereoRightCameraId=lambda: 2,
                    getStereoLeftCameraId=lambda: 1,
                    getBaselineDistance=lambda right, left, of_specification: baseline_cm,
                )

            def close(self):
                sdk.closed = True

            @staticmethod
            def getAllAvailableDevices():
                return [DeviceInfo(serial) for serial in devices]

        self.busy, self.cannot, self.sockets = False, None, [1, 2]
        self.filters = ["temporalFilter", "spatialFilter", "speckleFilter", "holeFilling", "adaptiveMedianFilter"]
        self.module = module(
            "depthai",
            Device=Device,
            DeviceInfo=DeviceInfo,
            StereoDepthConfig=types.SimpleNamespace(MedianFilter=types.SimpleNamespace(MEDIAN_OFF="MEDIAN_OFF")),
            Pipeline=Pipeline,
            node=types.SimpleNamespace(StereoDepth=StereoDepth),
            Clock=types.SimpleNamespace(now=lambda: datetime.timedelta(seconds=100)),
        )


class AzureKinect:
    """pyk4a: a camera or a recording that follows a script."""

    def __init__(self, script, serials=("0001",)):
        self.script, self.opened, self.config, self.busy = list(script), [], None, ()
        sdk = self

        class DepthMode(IntEnum):
            NFOV_2X2BINNED, NFOV_UNBINNED, WFOV_2X2BINNED, WFOV_UNBINNED = range(1, 5)

        class FPS(IntEnum):
            FPS_5, FPS_15, FPS_30 = range(3)

        class K4ATimeoutException(Exception):
            pass

        class Calibration:
            def get_camera_matrix(self, kind):
                return np.array([[10.0, 0.0, 3.5], [0.0, 11.0, 2.5], [0.0, 0.0, 1.0]])

            def get_distortion_coefficients(self, kind):
                return np.array([0.5, 0.1, 0.0, 0.0, 0.01, 0.8, 0.2, 0.02])

        class Device:
            calibration = Calibration()

            def __init__(self, config=None, device_id=0):
                sdk.config, self.serial = config, serials[device_id]

            def open(self):
                if self.serial in sdk.busy:
                    raise OSError
                sdk.opened.append(self.serial)

            def close(self):
                sdk.opened.remove(self.serial)

            start = staticmethod(lambda: None)
            stop = close

            def get_capture(self, timeout):
                value = sdk.script.pop(0) if sdk.script else None
                if isinstance(value, Exception):
                    raise value
                if value is None:
                    raise K4ATimeoutException
                depth = pixels(value) if value > 0 else None
                return types.SimpleNamespace(depth=depth, depth_timestamp_usec=value * 1000)

        class Playback(Device):
            def __init__(self, path):
                self.path, self.serial = path, path

            def open(self):
                if self.path.endswith("torn.mkv"):
                    raise RuntimeError("no EBML head")
                sdk.opened.append(self.path)

            def get_next_capture(self):
                if not sdk.script:
                    raise EOFError
                return self.get_capture(0)

        self.module = module(
            "pyk4a",
            DepthMode=DepthMode,
            FPS=FPS,
            K4ATimeoutException=K4ATimeoutException,
            ColorResolution=types.SimpleNamespace(OFF=0),
            CalibrationType=types.SimpleNamespace(DEPTH=0),
            Config=lambda **arguments: types.SimpleNamespace(**arguments),
            PyK4A=Device,
            PyK4APlayback=Playback,
            connected_device_count=lambda: len(serials),
        )


def take_place(monkeypatch, sdk, adapter):
    """Replaces the SDK of an adapter by a stand-in; returns the adapter."""
    monkeypatch.setitem(sys.modules, sdk.module.__name__, sdk.module)
    monkeypatch.delitem(sys.modules, f"conicflow.cameras.{adapter}", raising=False)
    from conicflow.cameras.__main__ import load

    return load(adapter)
