"""Which bags a folder has, while somebody else changes it."""

import os
from contextlib import contextmanager

from straightcomp_ros.fleet.history.bag_places import bags_in


def test_a_file_that_vanishes_while_its_folder_is_listed_hides_no_other(tmp_path, monkeypatch):
    for name in ("gone", "there"):
        (tmp_path / f"{name}.mcap").write_bytes(b"")
    scandir = os.scandir

    @contextmanager
    def listed(folder):
        with scandir(folder) as found:
            entries = list(found)
        (tmp_path / "gone.mcap").unlink()
        yield entries

    monkeypatch.setattr(os, "scandir", listed)
    assert [place.location for place in bags_in(str(tmp_path))] == [str(tmp_path / "there.mcap")]
