"""Tests of the detector and the tracker on arrays: their results equal those of the program bit for bit, arrays may have any
stride, and errors are clear."""

import copy
import datetime
import json
import pickle
import subprocess
import sys
import threading
import warnings
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scenes

import conicflow

CAMERA = scenes.CAMERA


def shown(objects):
    return [each.to_dict() for each in objects]


def test_the_objects_are_those_of_the_program_to_the_bit(playground, tmp_path):
    (tmp_path / "frames").mkdir()
    frames = [scenes.millimetres(seed) for seed in range(4)]
    for number, frame in enumerate(frames):
        scenes.write_png(tmp_path / f"frames/{number}.png", frame)
    lines, _ = playground.run("detect", "frames", "--camera", ",".join(map(str, CAMERA)))
    expected = [json.loads(line)["objects"] for line in lines.splitlines()]
    assert len(expected) == 4 and {each["kind"] for each in expected[0]} == {"sphere", "cylinder", "cone"}
    detector = conicflow.Detector(CAMERA, noise="kinect_v1")
    assert [shown(detector.detect(frame)) for frame in frames] == expected
    assert shown(conicflow.detect(frames[0], camera=CAMERA)) == expected[0]


def test_an_image_alone_has_no_history():
    frames = [scenes.millimetres(seed) for seed in (0, 1, 0)]
    first, _, again = (shown(conicflow.detect(frame, camera=CAMERA)) for frame in frames)
    detector = conicflow.Detector(CAMERA)
    _, _, learned = (shown(detector.detect(frame)) for frame in frames)
    assert first == again != learned
    forgetful = conicflow.Detector(CAMERA, assembler={"pooled": {"contour_memory": 0}})
    assert [shown(forgetful.detect(frame)) for frame in frames][2] == first


def test_metres_are_as_good_as_units():
    found = conicflow.detect(scenes.metres().astype(np.float32), camera=CAMERA)
    assert sorted(each.kind for each in found) == ["cone", "cylinder", "sphere"]
    ball = next(each for each in found if each.kind == "sphere")
    assert abs(ball.radius - 0.15) < 0.005 and abs(ball.center[2] - 1.2) < 0.01
    holes = scenes.metres().astype(np.float32)
    holes[:, :160] = np.nan
    assert {each.kind for each in conicflow.detect(holes, camera=CAMERA)} <= {"cone", "sphere"}


def strided(frame):
    """Yields the same pixels with other memory layouts."""
    yield np.asfortranarray(frame)
    yield np.repeat(frame, 2, axis=1)[:, ::2]
    yield np.ascontiguousarray(frame[::-1, ::-1])[::-1, ::-1]
    yield np.stack([frame, frame], axis=-1)[:, :, 1]
    padded = np.zeros((frame.shape[0], frame.shape[1] + 7), frame.dtype)
    padded[:, :-7] = frame
    yield padded[:, :-7]
    bytes_ = np.zeros(frame.nbytes + 1, np.uint8)
    odd = bytes_[1:].view(frame.dtype).reshape(frame.shape)
    odd[:] = frame
    yield odd
    read_only = frame.copy()
    read_only.flags.writeable = False
    yield read_only


@pytest.mark.parametrize("dtype", [np.uint16, np.float32])
def test_any_stride_will_do(dtype):
    frame = scenes.millimetres() if dtype == np.uint16 else scenes.metres().astype(dtype)
    before = frame.copy()
    expected = shown(conicflow.detect(frame, camera=CAMERA))
    for other in strided(frame):
        assert np.array_equal(other, frame)
        assert shown(conicflow.detect(other, camera=CAMERA)) == expected
    assert np.array_equal(frame, before) and len(expected) == 3


@pytest.mark.parametrize(
    ("spoil", "kind", "told"),
    [
        (lambda d: d.astype(np.float64), TypeError, "the type float64"),
        (lambda d: d.astype(np.int32), TypeError, "the type int32"),
        (lambda d: d.astype(">u2"), TypeError, "the type >u2"),
        (lambda d: d.tolist(), TypeError, "of type list"),
        (lambda d: None, TypeError, "of type NoneType"),
        (lambda d: np.ma.masked_equal(d, 0), TypeError, "a masked array"),
        (lambda d: d[:0], ValueError, "`depth` is 320x0 pixels, expected 1 to 16384 along a side and 67108864 in all"),
        (lambda d: np.zeros((1, 16385), d.dtype), ValueError, "`depth` is 16385x1 pixels"),
        (lambda d: np.zeros((8193, 8193), d.dtype), ValueError, "`depth` is 8193x8193 pixels"),
    ],
)
def test_what_is_no_depth_image_is_told(spoil, kind, told):
    with pytest.raises(kind) as error:
        conicflow.detect(spoil(scenes.millimetres()), camera=CAMERA)
    assert told in str(error.value) and "\n  hint: " in str(error.value)


@pytest.mark.parametrize(
    ("spoil", "told", "hint"),
    [
        (lambda d: None, "of type NoneType", "was the file read?"),
        (lambda d: "frames/0.png", "of type str", "read the file first"),
        (lambda d: Path("frames/0.png"), "Path", "read the file first"),
        (lambda d: d.tobytes(), "of type bytes", "numpy.frombuffer("),
        (lambda d: d.ravel(), "the shape [76800]", "depth.reshape(height, width)"),
        (lambda d: np.stack([d] * 3, axis=-1), "the shape [240, 320, 3]", "depth[:, :, 0]"),
        (lambda d: np.stack([d] * 8), "the shape [8, 240, 320]", "one image after another"),
    ],
)
def test_the_hint_fits_what_came(spoil, told, hint):
    with pytest.raises((TypeError, ValueError)) as error:
        conicflow.detect(spoil(scenes.millimetres()), camera=CAMERA)
    what, told_hint = str(error.value).split("\n  hint: ")
    assert told in what and hint in told_hint


@pytest.mark.parametrize(
    ("settings", "kind", "told"),
    [
        ({"camera": (525, 525, 319.5)}, ValueError, "has 3 numbers"),
        ({"camera": np.ones((3, 3))}, ValueError, "`camera` is no matrix K"),
        ({"camera": np.ones((2, 3))}, TypeError, "`camera` is a ndarray of shape (2, 3), expected four numbers or a matrix K"),
        ({"camera": b"1234"}, TypeError, "expected four numbers or a matrix K"),
        ({"camera": None}, TypeError, "`camera` is None"),
        ({"camera": (0, 525, 1, 1)}, ValueError, "focal lengths"),
        ({"camera": (np.nan, 525, 1, 1)}, ValueError, "focal lengths"),
        ({"camera": CAMERA, "scale": 0}, ValueError, "`scale` is 0"),
        ({"camera": CAMERA, "scale": -0.001}, ValueError, "`scale` is -0.001"),
        ({"camera": CAMERA, "scale": 1000}, ValueError, "`scale` is 1000, allowed is from 1e-9 to 1 metres per unit"),
        ({"camera": CAMERA, "scale": np.nan}, ValueError, "`scale` is NaN"),
        ({"camera": CAMERA, "scale": "0.001"}, TypeError, "`scale` is '0.001' (str), expected a number"),
        ({"camera": CAMERA, "noise": "kinect"}, ValueError, "`noise` cannot be `kinect`"),
        ({"camera": CAMERA, "noise": {"flor_m": 1}}, ValueError, "unknown key `flor_m` in `noise`"),
        ({"camera": CAMERA, "noise": {"floor_m": -1}}, ValueError, "`floor_m` is -1, allowed is from 0 to 1000"),
        ({"camera": CAMERA, "noise": [0.5]}, ValueError, "`noise` wants a string or a table"),
        ({"camera": CAMERA, "noise": object()}, TypeError, "`noise` has a value of type object, which is no number"),
        ({"camera": CAMERA, "noise": {"floor_m": np.nan}}, ValueError, "`noise` is {'floor_m': nan} (dict), expected finite"),
    ],
)
def test_settings_that_no_camera_has_are_told(settings, kind, told):
    with pytest.raises(kind) as error:
        conicflow.detect(scenes.millimetres(), **settings)
    assert told in str(error.value) and "\n  hint: " in str(error.value)


def test_the_matrix_of_a_camera_will_do():
    fx, fy, cx, cy = CAMERA
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    frame = scenes.millimetres()
    expected = conicflow.detect(frame, camera=CAMERA)
    for camera in (matrix, matrix.ravel(), matrix.tolist(), matrix.ravel().tolist(), np.float32(matrix), np.asfortranarray(matrix)):
        assert conicflow.detect(frame, camera=camera) == expected != []
    with pytest.raises(ValueError, match="no matrix K.*\n  hint: give K row by row"):
        conicflow.detect(frame, camera=matrix.T.ravel())
    for other, hint in (
        (SimpleNamespace(k=matrix.ravel()), "camera=info.k"),
        (SimpleNamespace(fx=fx, fy=fy, ppx=cx, ppy=cy), "i.fx, i.fy, i.ppx, i.ppy"),
    ):
        with pytest.raises(TypeError, match=f"hint: .*{hint}"):
            conicflow.detect(frame, camera=other)


def test_numbers_of_numpy_are_parameters():
    frame = scenes.millimetres()
    plain = conicflow.Detector(CAMERA, noise={"floor_m": 0.5}, extractor={"line_step": 2}).detect(frame)
    noise, step = {"floor_m": np.float32(0.5)}, {"line_step": np.int64(2)}
    assert conicflow.Detector(CAMERA, noise=noise, extractor=step).detect(frame) == plain
    assert conicflow.Tracker({"max_coast_s": np.array(2.0)})


def test_scale_and_noise_have_an_effect():
    frame = scenes.millimetres()
    half = conicflow.detect(frame // 2, camera=np.array(CAMERA), scale=0.002)
    ball = next(each for each in half if each.kind == "sphere")
    assert abs(ball.radius - 0.15) < 0.01
    words = conicflow.detect(frame, camera=CAMERA, noise="kinect_v1")
    table = conicflow.detect(frame, camera=CAMERA, noise={"floor_m": 0.0012})
    other = conicflow.detect(frame, camera=CAMERA, noise="time_of_flight")
    assert words == table == conicflow.detect(frame, camera=CAMERA) and words != other


def test_a_detector_keeps_to_the_size_of_its_first_image():
    detector = conicflow.Detector(CAMERA, extractor={"line_step": 2}, assembler={})
    assert detector.rejections == {}
    detector.detect(scenes.millimetres())
    assert sum(detector.rejections.values()) > 0 and 0.2 < detector.noise_ratios[0] < 5
    with pytest.raises(ValueError, match="is 160x120, the first one was 320x240\n  hint: make a Detector for each size"):
        detector.detect(scenes.millimetres()[::2, ::2])
    with pytest.raises(ValueError, match="unknown key `line_stop` in `extractor`\n  hint: did you mean `line_step`"):
        conicflow.Detector(CAMERA, extractor={"line_stop": 1})
    with pytest.raises(ValueError, match="`extractor`, `min_radius_m`: "):
        conicflow.Detector(CAMERA, extractor={"max_radius_m": 0.001})


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda: conicflow.Detector(CAMERA, extractor={"line_step": 0}), "`line_step` is 0, allowed is from 1 to 64"),
        (lambda: conicflow.Detector(CAMERA, extractor={"max_hole_px": 2**32 - 1}), "`max_hole_px` is 4294967295"),
        (lambda: conicflow.Detector(CAMERA, assembler={"pooled": {"max_gap_lines": 10**9}}), "`max_gap_lines` is 1000000000"),
        (lambda: conicflow.Detector(CAMERA, assembler={"pooled": 3}), "`pooled` wants a table, this is an integer"),
        (lambda: conicflow.Tracker({"gate": -1}), "`gate` is -1, allowed is "),
    ],
)
def test_parameters_are_checked_as_those_of_the_pipeline_file(make, told):
    with pytest.raises(ValueError) as error:
        make()
    assert told in str(error.value) and "\n  hint: " in str(error.value)


def test_a_parameter_that_is_none_has_its_default():
    frame = scenes.millimetres()
    plain, told = conicflow.Detector(CAMERA), conicflow.Detector(CAMERA, assembler={"pooled": {"budget_ms": None}})
    assert plain.detect(frame) == told.detect(frame)


def test_millimetres_as_real_numbers_are_warned_of():
    frame = scenes.millimetres().astype(np.float32)
    with pytest.warns(UserWarning, match="most of `depth` is beyond 16.38 m, and float32 is in metres\n  hint: "):
        assert conicflow.detect(frame, camera=CAMERA, scale=0.001) == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(conicflow.detect(scenes.metres().astype(np.float32), camera=CAMERA)) == 3


def test_records_are_copied_pickled_and_not_changed_by_their_lists():
    for each in conicflow.detect(scenes.millimetres(), camera=CAMERA):
        before = each.to_dict()
        each.center[2] += 0.5
        each.sigma.center[2] += 0.5
        assert each.center == before["center"] and each.sigma.center == before["sigma"]["center"]
        for other in (copy.copy(each), copy.deepcopy(each), pickle.loads(pickle.dumps(each))):
            assert type(other) is conicflow.Object and other == each and other.to_dict() == before
        make, (layout, content) = each.__reduce__()
        for wrong in ((layout + "x", content), (layout, content[:-8]), (layout, b"\xff" * len(content))):
            with pytest.raises(ValueError):
                make(*wrong)


def test_what_lies_in_memory_of_a_process_is_not_pickled():
    for each in (conicflow.Detector(CAMERA), conicflow.Tracker()):
        with pytest.raises(TypeError, match="cannot be copied or pickled\n  hint: make one where it is used"):
            pickle.dumps(each)


def test_records_become_arrays_and_tell_their_covariance():
    objects = conicflow.detect(scenes.millimetres(), camera=CAMERA)
    array = conicflow.array("objects", objects)
    assert array.dtype == conicflow.dtype("objects") and array.flags.writeable
    assert array["center"].tolist() == [each.center for each in objects]
    for row, each in zip(array, objects):
        assert each.covariance.shape == (3, 3) and np.array_equal(row["sigma"]["center"], each.covariance)
        assert np.allclose(np.sqrt(each.covariance.diagonal()), each.sigma.center)
    assert len(conicflow.array("tracks", [])) == 0
    track = conicflow.Tracker().update(objects, 0)[0]
    assert track.covariance.shape == track.velocity_covariance.shape == (3, 3)
    assert np.allclose(np.sqrt(track.velocity_covariance.diagonal()), track.sigma.velocity)
    for wrong, told in ((objects, "a Object is no item of tracks"), (7, "the items are 7")):
        with pytest.raises(TypeError, match=told):
            conicflow.array("tracks", wrong)
    with pytest.raises(ValueError, match="no items are called `object`"):
        conicflow.array("object", [])


def test_numbers_in_arrays_are_those_that_are_documented():
    objects = conicflow.detect(scenes.millimetres(), camera=CAMERA)
    codes = {each.kind: int(row["kind"]) for each, row in zip(objects, conicflow.array("objects", objects))}
    assert codes == {"sphere": 0, "cylinder": 1, "cone": 2}
    tracker, states = conicflow.Tracker(), {}
    for number, seen in enumerate([objects] * 8 + [[]]):
        tracks = tracker.update(seen, number * 33_333_333)
        states.update({each.state: int(row["state"]) for each, row in zip(tracks, conicflow.array("tracks", tracks))})
    assert states == {"tentative": 0, "confirmed": 1, "coasting": 2}


def test_classes_tell_what_their_records_have():
    objects = conicflow.detect(scenes.millimetres(), camera=CAMERA)
    for each in (*objects, *conicflow.Tracker().update(objects, 0)):
        names = {name for name in dir(each) if not name.startswith("_")}
        assert {"apex", "axis", "length", "radius", "covariance", "to_dict"} <= names
        told = type(each).__doc__
        assert [name for name in names - {"to_dict"} if name not in told] == []
        assert all(hasattr(each, name) for name in names)


def test_records_have_the_keys_of_their_line_as_attributes():
    for each in conicflow.detect(scenes.millimetres(), camera=CAMERA):
        line = each.to_dict()
        assert all(getattr(each, key) == value for key, value in line.items() if key != "sigma")
        assert all(getattr(each.sigma, key) == value for key, value in line["sigma"].items())
        assert set(line) <= set(dir(each)) and repr(each).startswith(f"Object(kind='{line['kind']}'")
        line["kind"] = "changed"
        assert each.kind != "changed"
        with pytest.raises(AttributeError, match="has no `diameter`"):
            each.diameter
    kinds = {each.kind: each for each in conicflow.detect(scenes.millimetres(), camera=CAMERA)}
    assert kinds["cone"].radius is None and kinds["sphere"].axis is None and kinds["sphere"].sigma.length is None
    assert "radius" not in kinds["cone"].to_dict() and "length" not in kinds["sphere"].to_dict()["sigma"]


def test_records_are_compared_by_what_they_are():
    first, again = (conicflow.detect(scenes.millimetres(), camera=CAMERA) for _ in range(2))
    assert first == again and len({*first, *again}) == len(first) and first[0] != first[1] and first[0] != 1
    assert copy.copy(first) == first


def test_a_tracker_follows_a_ball():
    tracker = conicflow.Tracker()
    for number in range(10):
        objects = conicflow.detect(scenes.millimetres(number, shift_m=0.01 * number), camera=CAMERA)
        tracks = tracker.update(objects, stamp_ns=number * 33_333_333)
    ball = next(each for each in tracks if each.kind == "sphere")
    assert isinstance(ball, conicflow.Track) and ball.state == "confirmed" and ball.age == 9
    assert abs(ball.velocity[0] - 0.3) < 0.1 and len(ball.sigma.velocity) == 3
    assert {each.id for each in tracks} >= {1, 2, 3}


@pytest.mark.parametrize(
    ("stamp", "kind", "hint"),
    [
        (1.5, TypeError, "round(seconds * 1e9)"),
        (None, TypeError, "stamp.sec * 10**9 + stamp.nanosec"),
        ("7", TypeError, "round(seconds * 1e9)"),
        (-1, ValueError, "round(seconds * 1e9)"),
        (2**64, ValueError, "round(seconds * 1e9)"),
        (datetime.datetime.fromtimestamp(0), TypeError, "stamp.timestamp()"),
        (np.datetime64(0, "s"), TypeError, "stamp.astype("),
        (SimpleNamespace(sec=1, nanosec=2), TypeError, "stamp.sec * 10**9 + stamp.nanosec"),
    ],
)
def test_a_stamp_is_a_number_of_nanoseconds(stamp, kind, hint):
    with pytest.raises(kind) as error:
        conicflow.Tracker().update([], stamp)
    what, told = str(error.value).split("\n  hint: ")
    assert "`stamp_ns` is " in what and "expected a whole number from 0 to 18446744073709551615" in what and hint in told
    for good in (0, np.int64(5), np.uint64(5), 2**64 - 1):
        conicflow.Tracker().update([], good)


def test_stamps_in_other_units_are_warned_of_once():
    objects = conicflow.detect(scenes.millimetres(), camera=CAMERA)
    for unit in (33, 33_333):
        tracker = conicflow.Tracker()
        with pytest.warns(UserWarning, match="less than 0.1 ms apart.*nanoseconds\n  hint: of milli") as told:
            for number in range(20):
                tracker.update(objects, number * unit)
        assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        still, several, slow = (conicflow.Tracker() for _ in range(3))
        for number in range(20):
            still.update(objects, 7)
            slow.update(objects, number * 33_333_333)
            for camera in range(4):
                several.update(objects, number * 33_333_333 + camera, np.eye(4), camera)


def test_the_tracker_tells_what_it_cannot_use():
    tracker = conicflow.Tracker({"max_coast_s": 2.0})
    with pytest.raises(TypeError, match="`objects` has a str at 0, expected conicflow.Object"):
        tracker.update(["ball"], 0)
    objects = conicflow.detect(scenes.millimetres(), camera=CAMERA)
    assert len(tracker.update(objects, 0, world_from_camera=np.eye(4))) == 3
    for pose in (np.zeros((3, 4)), np.eye(3), "here", 2 * np.eye(4)):
        with pytest.raises((TypeError, ValueError), match="`world_from_camera`"):
            tracker.update(objects, 1, world_from_camera=pose)
    with pytest.raises(ValueError, match="has no pose"):
        tracker.update(objects, 1, camera=1)
    for stamp_ns in range(2, 90_000_000, 30_000_000):
        tracks = tracker.update(objects, stamp_ns, world_from_camera=np.eye(4))
        assert [track.misses for track in tracks] == [0, 0, 0]
        others = tracker.update([], stamp_ns, world_from_camera=np.eye(4), camera=1)
        assert [track.misses for track in others] == [0, 0, 0], "another camera misses nothing"
    with pytest.raises(ValueError, match="unknown key `max_coast` in `parameters`\n  hint: did you mean `max_coast_s`"):
        conicflow.Tracker({"max_coast": 1})
    for wrong, told in (
        (lambda: tracker.update(None, 0), "`objects` is None"),
        (lambda: tracker.update(objects[0], 0), "expected a list of conicflow.Object"),
        (lambda: tracker.update(objects, 0, np.eye(4), -1), "`camera` is -1 (int), expected a whole number from 0 to 4294967295"),
        (lambda: tracker.update(objects, 0, np.eye(4), 2**32), "`camera` is 4294967296"),
        (lambda: tracker.update(objects, 0, np.eye(4), 0.5), "`camera` is 0.5"),
    ):
        with pytest.raises((TypeError, ValueError)) as error:
            wrong()
        assert told in str(error.value) and "\n  hint: " in str(error.value)


def test_other_threads_go_on_while_it_works():
    """If the detection held the global lock of Python, `count` would make no progress before the detection has ended."""
    frame = np.tile(scenes.millimetres(), (4, 4))
    counted, done = [0], threading.Event()
    started = threading.Event()

    def count():
        started.set()
        while not done.is_set():
            counted[0] += 1

    counter = threading.Thread(target=count)
    counter.start()
    started.wait()
    before = counted[0]
    conicflow.detect(frame, camera=(1050, 1050, 639.5, 479.5))
    during = counted[0] - before
    done.set()
    counter.join()
    assert during > 10


def test_threads_get_the_same_from_one_detector():
    detector = conicflow.Detector(CAMERA, assembler={"pooled": {"contour_memory": 0}})
    frames = [scenes.millimetres(seed) for seed in range(4)]
    expected, found = [detector.detect(frame) for frame in frames], [None] * 4

    def look(index):
        found[index] = detector.detect(frames[index])

    threads = [threading.Thread(target=look, args=(index,)) for index in range(4)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    assert found == expected


def test_without_numpy_there_is_a_hint():
    """NumPy is replaced by a module that does not exist."""
    program = "import sys\nsys.modules['numpy'] = None\nimport conicflow"
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert ended.returncode == 1
    assert "ImportError: conicflow needs NumPy, which is not installed\n  hint: `pip install numpy`" in ended.stderr
