"""A small bag of all streams."""

from collections.abc import Callable
from pathlib import Path

import pytest
from recording import Recording, add_streams, messages, write

from straightcomp_ros.bags.writer import BagWriter


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Recording]:
    """Records ``count`` cycles of all streams into a new bag."""

    def recorded(count: int = 50, name: str = "run", **options: object) -> Recording:
        written = messages(count)
        with BagWriter(tmp_path / name, **options) as bag:  # type: ignore[arg-type]
            add_streams(bag)
            bag.attach("parameters.yaml", "application/yaml", b"rate: 2000\n")
            bag.add_metadata("survey", {"guide": "synthetic", "points": "177"})
            write(bag, written)
        return Recording(tmp_path / name, written)

    return recorded
