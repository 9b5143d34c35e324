"""The logger's own services and refusals, with played samples instead of a driver."""

import re

import numpy as np
import pytest
import rclpy
from std_srvs.srv import Trigger

from straightcomp_ros.bags.reader import read_attachments, read_metadata, read_streams
from straightcomp_ros.bags.writer import BagWriter
from straightcomp_ros.contract import ENCODER

COUNT = 20_000


@pytest.fixture(scope="module")
def samples(tmp_path_factory):
    """Ten seconds of samples."""
    path = tmp_path_factory.mktemp("bags") / "samples"
    with BagWriter(path) as bag:
        bag.add_topic("/encoder", ENCODER.layout.type_name)
        for number in range(COUNT):
            stamp = 1_700_000_000_000_000_000 + 500_000 * number
            bag.write("/encoder", ENCODER.layout.pack(stamp, number * 1e-4, 0.0, 0.0, 0.0), stamp, stamp)
    return path


def call(name: str) -> Trigger.Response:
    rclpy.init()
    try:
        node = rclpy.create_node("caller")
        client = node.create_client(Trigger, name)
        assert client.wait_for_service(60)
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(node, future, timeout_sec=60)
        return future.result()
    finally:
        rclpy.try_shutdown()


def test_a_snapshot_saves_the_last_second_and_the_bag_says_what_it_is(graph, samples, tmp_path):
    bag = tmp_path / "bag"
    graph.start("logger", {"output": str(bag), "snapshot": 1.0, "topics": "encoder|command", "nodes": "player"})
    player = graph.start("player", {"bag": str(samples), "subscribers": 1})
    assert player.wait(120) == 0
    response = call("logger/snapshot")
    assert response.success and int(re.match(r"\d+", response.message)[0]) > 0
    assert graph.stop(["logger"])["logger"] == 0
    stream = read_streams(bag, {"encoder": ENCODER.layout})["encoder"]
    assert 0 < np.ptp(stream.log_time) <= 1.0e9
    metadata = read_metadata(bag)
    assert metadata["origin"]["package"] == "straightcomp_ros"
    assert set(metadata["losses"]) == {"/encoder"}
    assert "player" in read_attachments(bag)["parameters.yaml"].decode()


def test_a_disk_that_is_nearly_full_ends_the_recording_with_a_whole_bag(graph, tmp_path):
    bag = tmp_path / "bag"
    logger = graph.start("logger", {"output": str(bag), "min_free_bytes": 10**18})
    assert logger.wait(120) == 1
    assert "min_free_bytes" in graph.log("logger").read_text()
    assert (bag / "metadata.yaml").exists()


def test_a_pattern_that_is_none_is_refused(graph, tmp_path):
    logger = graph.start("logger", {"output": str(tmp_path / "bag"), "topics": "("})
    assert logger.wait(120) == 2
    assert "parameter 'topics'" in graph.last_words("logger")
