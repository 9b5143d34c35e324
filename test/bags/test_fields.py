"""One number of every message of a topic, by name, whatever its type and whichever file it lies in."""

import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from threading import Barrier

import numpy as np
import pytest
from bag_of_rows import REPORT, STORE, bag_of, bag_of_rows, header, report

from straightcomp_ros.bags import BagError, fields, noting_warnings
from straightcomp_ros.bags.fields import Field, FieldValues, read_field
from straightcomp_ros.bags.reader import set_back
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.bags.topics import Topic
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import COMMAND, DIAGNOSTICS, DISPLACEMENT, ENCODER

T = STORE.types
START_NS = 1_700_000_123_000_000_456
COUNT = 5


def written(path, type_name, make):
    """A bag with COUNT messages on /probe, made half a second before they were sent, a millisecond apart."""
    messages = []
    for number, ns in enumerate(stamps()):
        data = bytes(STORE.serialize_cdr(make(number, header(ns)), type_name))
        messages.append(("/probe", type_name, data, ns + 600_000_000, ns + 500_000_000))
    return bag_of(path, messages)


def stamps(late_ns=0):
    return [START_NS + 1_000_000 * number + late_ns for number in range(COUNT)]


def point(number, head):
    return T["geometry_msgs/msg/PointStamped"](head, T["geometry_msgs/msg/Point"](1.0, 2.0 * number, 3.0))


def plain(number, head):
    return T["std_msgs/msg/Float64"](2.0 * number)


def joints(number, head):
    names = ["a", "stage_x", "b"]
    return T["sensor_msgs/msg/JointState"](head, names, np.arange(3.0) + number, np.empty(0), np.array([7.0]))


@pytest.mark.parametrize(
    ("type_name", "make", "field", "late_ns"),
    [
        ("geometry_msgs/msg/PointStamped", point, Field("probe", "point.y"), 0),
        ("std_msgs/msg/Float64", plain, Field("/probe", "data"), 5e8),
    ],
)
def test_a_message_has_the_stamp_of_its_header_or_else_the_time_of_sending(tmp_path, type_name, make, field, late_ns):
    found = read_field(written(tmp_path / "bag", type_name, make), field)
    assert found.stamped is (late_ns == 0) and found.stamp.tolist() == stamps(int(late_ns))
    assert found.values.tolist() == [0.0, 2.0, 4.0, 6.0, 8.0]


def test_between_values_that_are_not_far_apart_they_lie_on_a_line_and_elsewhere_they_are_not_known():
    ms = np.array([0, 1, 5, 200, 201])
    found = FieldValues(START_NS + ms * 1_000_000, 3.0 * ms, True)
    asked = np.array([-1.0, 0.0, 0.25, 1.0, 4.0, 5.0, 100.0, 200.0, 200.5, 201.0, 202.0])
    values, known = found.at(START_NS + (asked * 1e6).astype(np.int64))
    assert known.tolist() == [one not in (-1.0, 100.0, 202.0) for one in asked]
    assert values[known] == pytest.approx(3.0 * asked[known], rel=1e-9)


@pytest.mark.parametrize(("back_ms", "warned"), [(0, False), (20, False), (21, True)])
def test_values_come_in_the_order_of_their_stamps_of_one_stamp_the_first_and_far_back_with_a_warning(
    tmp_path, back_ms, warned
):
    kind, ms = "geometry_msgs/msg/PointStamped", [0, 50, 100, 100 - back_ms, 120, 110]
    stamps = [START_NS + 1_000_000 * one for one in ms]
    data = [bytes(STORE.serialize_cdr(point(number, header(ns)), kind)) for number, ns in enumerate(stamps)]
    bag = bag_of(tmp_path / "bag", (("/probe", kind, one, START_NS, START_NS) for one in data))
    with noting_warnings() as texts:
        found = read_field(bag, Field("probe", "point.y"))
    assert found.stamp.tolist() == sorted(set(stamps))
    assert found.values.tolist() == [2.0 * stamps.index(stamp) for stamp in sorted(set(stamps))]
    assert [f"go back by {back_ms * 1e-3:.3g} s" in text for text in texts] == [True] * warned
    assert set_back(np.array(stamps)) == pytest.approx(back_ms * 1e-3 * warned, abs=1e-12)


def test_warnings_for_the_user_are_kept_once_each_and_those_about_code_are_passed_on():
    with pytest.warns(DeprecationWarning, match="old"), noting_warnings() as texts:
        for text in ("a", "b", "a"):
            warnings.warn(text, stacklevel=1)
        warnings.warn("old", DeprecationWarning, stacklevel=1)
    assert texts == ["a", "b"]


def test_each_of_several_threads_keeps_its_own_warnings_and_those_after_them_are_shown():
    begun = Barrier(2, timeout=60.0)

    def noted(text):
        begun.wait()
        with noting_warnings() as texts:
            for _ in range(20):
                warnings.warn(text, stacklevel=1)
                time.sleep(1e-3)
        return texts

    with pytest.warns(UserWarning, match="after"):
        with ThreadPoolExecutor(2) as threads:
            assert list(threads.map(noted, "ab")) == [["a"], ["b"]]
        warnings.warn("after", stacklevel=1)


def test_a_topic_that_is_absent_or_without_messages_is_refused_by_its_name(tmp_path):
    with BagWriter(tmp_path / "bag") as bag:
        bag.add(Topic("/silent", ENCODER.layout.type_name))
    for topic, words in (("other", "has no topic 'other'; it has /silent"), ("silent", "'/silent' has no messages")):
        with pytest.raises(BagError, match=words):
            read_field(tmp_path / "bag", Field(topic, "y"))


@pytest.mark.parametrize("time_ns", [1 << 63, (1 << 64) - 1])
def test_a_time_of_sending_beyond_the_epochs_is_refused_where_no_header_has_another(tmp_path, time_ns):
    for type_name, make in (("geometry_msgs/msg/PointStamped", point), ("std_msgs/msg/Float64", plain)):
        data = bytes(STORE.serialize_cdr(make(1, header(START_NS)), type_name))
        bag_of(tmp_path / make.__name__, [("/probe", type_name, data, START_NS, time_ns)])
    assert read_field(tmp_path / "point", Field("probe", "point.y")).stamp.tolist() == [START_NS]
    with pytest.raises(BagError, match=f"'/probe', message 0.*{time_ns}"):
        read_field(tmp_path / "plain", Field("probe", "data"))


@pytest.mark.parametrize(("path", "first"), [("position[stage_x]", 1.0), ("position[2]", 2.0), ("effort[0]", 7.0)])
def test_an_element_is_taken_by_its_number_or_by_the_name_of_its_joint(tmp_path, path, first):
    bag = written(tmp_path / "bag", "sensor_msgs/msg/JointState", joints)
    assert read_field(bag, Field("probe", path)).values[0] == first


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("position[c]", r"no element 'c' for 'position\[c\]'; its names are a, stage_x, b"),
        ("position[3]", "no element '3'"),
        ("effort[1]", "no element '1'"),
        ("effort[stage_x]", "no element 'stage_x'"),
        ("header[0]", "no element '0'"),
        ("speed", "no field 'speed' in 'speed'; it has header, name, position, velocity, effort"),
        ("header.stamp.minutes", "no field 'minutes' in 'header.stamp.minutes'; it has sec, nanosec"),
        ("position.x", "no field 'x' in 'position.x'; it has no fields"),
        ("header.stamp.sec.x", "no field 'x'"),
        ("header.frame_id", "'header.frame_id' is no number but str"),
        ("position", "'position' is no number but ndarray"),
    ],
)
def test_a_field_that_is_not_there_is_named_with_what_there_is(tmp_path, path, words):
    bag = written(tmp_path / "bag", "sensor_msgs/msg/JointState", joints)
    with pytest.raises(BagError, match=f"topic '/probe', message 0.*{words}"):
        read_field(bag, Field("probe", path))


@pytest.mark.parametrize(
    ("stream", "path"),
    [
        (ENCODER, "position[stage_x]"),
        (DISPLACEMENT, "position[displacement]"),
        (COMMAND, "effort[platform_y]"),  # the encoder has an element of this name, too
    ],
)
def test_our_own_streams_are_read_as_columns(tmp_path, stream, path, monkeypatch):
    monkeypatch.setattr(fields, "decoded", None)  # not message by message
    layout = stream.layout
    place = [f"{array}[{joint}]" for array, joint in layout.places].index(path)
    values = [[float(10 * column + number) for column in range(len(layout.columns))] for number in range(COUNT)]
    bag_of_rows(tmp_path / "bag", ((stream, stamp, row) for stamp, row in zip(stamps(), values, strict=True)))
    found = read_field(tmp_path / "bag", Field(stream.topic, path))
    assert found.stamped and found.stamp.tolist() == stamps()
    assert found.values.tolist() == [10.0 * place + number for number in range(COUNT)]


@pytest.mark.parametrize("text", ["", ":point.y", "probe:point y", "probe:position[", "probe:1x", "probe:a..b"])
def test_what_is_no_field_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match=r"allowed: TOPIC or TOPIC:FIELD, FIELD such as point\.y"):
        Field.parsed(text, "data")
    assert Field.parsed("/probe", "data") == Field("/probe", "data")
    assert str(Field.parsed("probe:point.y", "data")) == "probe:point.y"


def reports_of(folder, *messages, topic=DIAGNOSTICS, encoder=None):
    one = () if encoder is None else [(encoder, ENCODER.layout.type_name, ENCODER.layout.pack(1, 0, 0, 0, 0), 1, 1)]
    return read_reports(bag_of(folder, [*one, *((topic, REPORT, data, 1, 1) for data in messages)]))


@pytest.mark.parametrize("topic", [DIAGNOSTICS, f"/line_3{DIAGNOSTICS}"], ids=["now", "in 0.1"])
def test_each_node_has_its_reports_in_order_and_without_its_namespace(tmp_path, topic):
    data = [report(f"line_3/{node}", 10**9 * n + 5, t=str(n)) for n in range(3) for node in ("driver", "logger")]
    reports = reports_of(tmp_path / "bag", *data, topic=topic)
    assert set(reports) == {"driver", "logger"}
    for node in reports.values():
        assert [(one.time_ns, one.values["t"]) for one in node] == [(10**9 * n + 5, str(n)) for n in range(3)]


def test_reports_are_of_the_namespace_whose_encoder_was_recorded(tmp_path):
    data = [report(name, 5, of=name) for name in ("line_3/driver", "line_4/driver", "driver", "laser: power")]
    (found,) = reports_of(tmp_path / "bag", *data, encoder="/line_4/encoder")["driver"]
    assert found.values == {"of": "line_4/driver"}
    assert set(reports_of(tmp_path / "root", *data, encoder="/encoder")) == {"driver", "laser: power"}
    with pytest.raises(BagError, match=r"several namespaces report: driver, laser: power, line_3/driver"):
        reports_of(tmp_path / "none", *data)


def test_what_is_no_diagnostics_is_left_out(tmp_path):
    assert reports_of(tmp_path / "other", report("driver", 5), topic="/other") == {}
    with pytest.warns(UserWarning, match=r"diagnostics.*does not decode"):
        found = reports_of(tmp_path / "bag", b"\x00\x01\x00\x00\xff\xff\xff\xff" * 3, report("driver", 5, t="0"))
    assert set(found) == {"driver"}
