"""Finds the files that the package installs: config/, launch/."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

from straightcomp_ros.contract import PACKAGE


def _candidates() -> Iterator[Path]:
    yield Path(__file__).resolve().parents[2]  # source checkout, editable install
    for prefix in os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep):
        if prefix:
            yield Path(prefix) / "share" / PACKAGE
    yield Path(sys.prefix) / "share" / PACKAGE
    for parent in Path(__file__).resolve().parents:  # pip install --prefix, colcon's install space
        yield parent / "share" / PACKAGE


def share_path(name: str) -> Path:
    """Full path of an installed file, e.g. ``config/survey_synthetic.csv``.

    Raises:
        FileNotFoundError: no installation path has the file.
    """
    tried = []
    for base in _candidates():
        if os.path.exists(base / name):  # False for a name that is too long, too
            return base / name
        tried.append(str(base))
    raise FileNotFoundError(f"'{name}' of {PACKAGE} is in none of: {', '.join(tried)}; is the package installed?")
