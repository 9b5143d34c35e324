"""Diagnostics in a bag: node by node, as they were published."""

import pytest
from rosbags.typesys import Stores, get_typestore

from straightcomp_ros.bags import BagError
from straightcomp_ros.bags.recorded_nodes import read_reports
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import DIAGNOSTICS, ENCODER

TYPES = get_typestore(Stores.ROS2_JAZZY)
KIND = "diagnostic_msgs/msg/DiagnosticArray"


def message(node, time_ns, values):
    types = TYPES.types
    status = types["diagnostic_msgs/msg/DiagnosticStatus"](
        level=0,
        name=node,
        message="running",
        hardware_id="",
        values=[types["diagnostic_msgs/msg/KeyValue"](key=key, value=value) for key, value in values.items()],
    )
    stamp = types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    header = types["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    return bytes(TYPES.serialize_cdr(types[KIND](header=header, status=[status]), KIND))


def bag_of(folder, *messages, topic=DIAGNOSTICS, encoder=None):
    with BagWriter(folder) as bag:
        if encoder:
            bag.add_topic(encoder, ENCODER.layout.type_name)
            bag.write(encoder, ENCODER.layout.pack(1, *[0.0] * len(ENCODER.layout.columns)), 1, 1)
        bag.add_topic(topic, KIND)
        for data in messages:
            bag.write(topic, data, 1, 1)
    return folder


@pytest.mark.parametrize("topic", [DIAGNOSTICS, f"/line_3{DIAGNOSTICS}"], ids=["now", "in 0.1"])
def test_each_node_has_its_reports_in_order_and_without_its_namespace(tmp_path, topic):
    data = [message(f"line_3/{node}", t * 10**9 + 5, {"t": str(t)}) for t in range(3) for node in ("driver", "logger")]
    reports = read_reports(bag_of(tmp_path / "bag", *data, topic=topic))
    assert set(reports) == {"driver", "logger"}
    for node in reports.values():
        assert [(report.time_ns, report.values["t"]) for report in node] == [
            (5, "0"),
            (10**9 + 5, "1"),
            (2 * 10**9 + 5, "2"),
        ]


def test_reports_are_of_the_namespace_whose_encoder_was_recorded(tmp_path):
    data = [message(name, 5, {"of": name}) for name in ("line_3/driver", "line_4/driver", "driver", "laser: power")]
    (report,) = read_reports(bag_of(tmp_path / "bag", *data, encoder="/line_4/encoder"))["driver"]
    assert report.values == {"of": "line_4/driver"}
    assert set(read_reports(bag_of(tmp_path / "root", *data, encoder="/encoder"))) == {"driver", "laser: power"}
    with pytest.raises(
        BagError, match=r"several namespaces report: driver, laser: power, line_3/driver, line_4/driver"
    ):
        read_reports(bag_of(tmp_path / "none", *data))


def test_a_bag_without_diagnostics_has_no_reports(tmp_path):
    assert read_reports(bag_of(tmp_path / "bag", topic="/other")) == {}


def test_bytes_that_are_no_diagnostics_are_left_out_with_a_warning(tmp_path):
    bag = bag_of(tmp_path / "bag", b"\x00\x01\x00\x00\xff\xff\xff\xff" * 3, message("driver", 5, {"t": "0"}))
    with pytest.warns(UserWarning, match=r"diagnostics.*does not decode"):
        assert set(read_reports(bag)) == {"driver"}
