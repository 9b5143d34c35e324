"""What a power cut leaves of a recording."""

import pytest

from trials.power_cuts import ALLOWED_S, Event, cut_off, left_on_disk

pytestmark = pytest.mark.nightly


class Never:
    """Chance that loses whatever was not synced."""

    def random(self):
        return 1.0

    def randint(self, low, high):
        return low


def test_what_was_not_synced_is_lost_and_what_was_is_not():
    file = "/bag/a.mcap"
    written = [Event(0.0, "name", file), Event(1.0, "write", file, 0, b"abc"), Event(3.0, "write", file, 3, b"de")]
    synced = [*written, Event(4.0, "sync", file, begun=2.0), Event(4.5, "sync", "/bag", begun=4.2)]
    assert left_on_disk(synced, 5.0, Never()) == {file: b"abc"}
    assert left_on_disk(synced, 4.4, Never()) == {}


def test_a_power_cut_takes_no_more_than_a_second_and_the_rest_is_recovered(tmp_path):
    found = cut_off(tmp_path, 4.0, 40, 1)
    assert found["unreadable"] == found["without_the_beginning"] == 0
    assert found["lost_p50_s"] < ALLOWED_S and found["syncs"] > 3, found
