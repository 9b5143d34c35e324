"""A small bag of all streams."""

from collections.abc import Callable
from pathlib import Path

import pytest
from recording import Recording, recorded


@pytest.fixture
def record(tmp_path: Path) -> Callable[..., Recording]:
    """Records ``count`` cycles of all streams into a new bag."""
    return lambda count=50, name="run", **options: recorded(tmp_path / name, count, **options)
