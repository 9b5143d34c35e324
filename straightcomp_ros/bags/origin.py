"""Which program made a bag: version of the package, and the revision of its sources where git knows one."""

import importlib.metadata
import subprocess
from pathlib import Path

from straightcomp_ros.contract import PACKAGE

ORIGIN_METADATA = "origin"
"""Metadata record of a bag with what :func:`origin` gives."""


def origin() -> dict[str, str]:
    """Package, version, and ``revision`` (with ``-dirty`` after changes) or ``unknown``."""
    try:
        version = importlib.metadata.version(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        version = "unknown"
    return {"package": PACKAGE, "version": version, "revision": _revision()}


def _revision() -> str:
    git = ["git", "-C", str(Path(__file__).resolve().parent)]
    describe = ["describe", "--always", "--dirty", "--abbrev=12", "--exclude=*"]
    try:
        # Where the package is installed inside another repository, git would give that one's revision.
        subprocess.run([*git, "ls-files", "--error-unmatch", __file__], capture_output=True, timeout=5, check=True)
        return subprocess.run([*git, *describe], capture_output=True, text=True, timeout=5, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return "unknown"
