"""The load that `python -m trials bags` puts on the logger, in its real processes."""

import sys

import pytest

from straightcomp_ros.bags.reader import read_messages
from straightcomp_ros.cell.launcher import LaunchError
from trials.traffic import TRAFFIC, record_traffic

pytestmark = [pytest.mark.keeps_time, pytest.mark.nightly]

SECONDS = 2.0


@pytest.mark.live
def test_the_logger_records_eight_topics_at_2_khz_without_a_loss(tmp_path):
    missing, busy = record_traffic(tmp_path, SECONDS)
    assert missing == 0
    assert 0 < busy < 1
    for stream in TRAFFIC:
        assert len(read_messages(tmp_path / "traffic", f"/{stream.topic}").data) == SECONDS * 2000


@pytest.mark.live
def test_a_node_that_cannot_publish_says_why(tmp_path):
    with pytest.raises(LaunchError, match=r"node 'traffic' ended: .*'seconds'.*allowed: > 0"):
        record_traffic(tmp_path, 0.0)


def test_traffic_without_a_reader_ends_with_their_names(single):
    command = [sys.executable, "-m", "trials.traffic"]
    traffic = single.start("traffic", {"start_timeout": 0.5}, command=command)
    assert traffic.wait(120) == 1
    assert "no subscriber of encoder, reference" in single.log("traffic").read_text()
