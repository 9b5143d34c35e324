"""What a power cut leaves of a recording."""

import pytest

from trials.power_cuts import Disk, cut_off

pytestmark = pytest.mark.nightly


class Never:
    """Chance that loses whatever was not synced."""

    def random(self):
        return 1.0

    def randint(self, low, high):
        return low


def test_what_was_not_synced_is_lost_and_what_was_is_not():
    file, disk = "/bag/a.mcap", Disk()
    disk.created[file] = 0.0
    disk.writes[file] = [(1.0, b"abc"), (3.0, b"de")]
    disk.syncs[file] = [(2.0, 4.0)]
    disk.syncs["/bag"] = [(4.2, 4.5)]
    assert disk.left(5.0, Never()) == {file: b"abc"}
    assert disk.left(4.4, Never()) == {}


def test_a_power_cut_takes_no_more_than_a_second_and_the_rest_is_recovered(tmp_path):
    found = cut_off(tmp_path, 4.0, 40)
    assert found["unreadable"] == found["without_the_beginning"] == 0
    assert found["more_than_allowed"] == 0 and found["syncs"] > 3, found
