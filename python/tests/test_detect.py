"""The detector and the tracker on arrays: the same to the bit as the program, whatever the stride, and clear errors."""

import copy
import json
import pickle
import threading
import warnings

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
    """The same pixels, lying in memory in other ways."""
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
        (lambda d: d[0], ValueError, "the shape [320]"),
        (lambda d: np.stack([d] * 3, axis=-1), ValueError, "the shape [240, 320, 3]"),
        (lambda d: d[:0], ValueError, "320x0"),
    ],
)
def test_what_is_no_depth_image_is_told(spoil, kind, told):
    with pytest.raises(kind) as error:
        conicflow.detect(spoil(scenes.millimetres()), camera=CAMERA)
    assert told in str(error.value) and "\n  hint: " in str(error.value)


@pytest.mark.parametrize(
    ("settings", "kind", "told"),
    [
        ({"camera": (525, 525, 319.5)}, ValueError, "has 3 numbers"),
        ({"camera": np.eye(3)}, TypeError, "expected four numbers"),
        ({"camera": (0, 525, 1, 1)}, ValueError, "focal lengths"),
        ({"camera": (np.nan, 525, 1, 1)}, ValueError, "focal lengths"),
        ({"camera": CAMERA, "scale": 0}, ValueError, "`scale` is 0"),
        ({"camera": CAMERA, "scale": -0.001}, ValueError, "`scale` is -0.001"),
        ({"camera": CAMERA, "noise": "kinect"}, ValueError, "`noise` cannot be `kinect`"),
        ({"camera": CAMERA, "noise": {"flor_m": 1}}, ValueError, "unknown key `flor_m` in `noise`"),
        ({"camera": CAMERA, "noise": {"floor_m": -1}}, ValueError, "`floor_m` is -1, allowed is from 0 to 1000"),
        ({"camera": CAMERA, "noise": [0.5]}, ValueError, "`noise` wants a string or a table"),
        ({"camera": CAMERA, "noise": object()}, TypeError, "`noise`"),
    ],
)
def test_settings_that_no_camera_has_are_told(settings, kind, told):
    with pytest.raises(kind) as error:
        conicflow.detect(scenes.millimetres(), **settings)
    assert told in str(error.value) and "\n  hint: " in str(error.value)


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


def test_other_threads_go_on_while_it_works():
    """Without giving the lock free, `count` would not come to anything before the detection is over."""
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
