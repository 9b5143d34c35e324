"""What a bag says of itself: metadata.yaml, which rosbag2 reads before the files, and which program made the bag.

Version 9, as ROS 2 Jazzy writes it. Source: rosbag2_storage/yaml.hpp, ``convert<BagMetadata>`` and
``convert<TopicMetadata>``.
"""

import importlib.metadata
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml

from straightcomp_ros.bags.topics import ROS_DISTRO, Topic
from straightcomp_ros.parameters.share import PACKAGE

VERSION = 9
ROOT_KEY = "rosbag2_bagfile_information"
"""The only key at the top of metadata.yaml."""
_NO_TIME = 2**63 - 1
"""Start of a bag without messages, in ns: rosbag2 writes the end of time."""


class BagFile(NamedTuple):
    """One file of a bag: name relative to the bag's folder, first and last log time in ns (None without messages),
    messages by topic."""

    name: str
    time_range: tuple[int, int] | None
    message_counts: Mapping[str, int]


def bag_information(
    files: Sequence[BagFile], topics: Iterable[Topic], custom_data: Mapping[str, str]
) -> dict[str, object]:
    """The content of metadata.yaml below :data:`ROOT_KEY`: of the files, oldest first, of all topics, with messages or
    without, and of free texts."""
    ranges = [file.time_range for file in files if file.time_range]
    whole = (min(first for first, _ in ranges), max(last for _, last in ranges)) if ranges else None
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        "duration": _duration(whole),
        "starting_time": _start(whole),
        "message_count": sum(sum(file.message_counts.values()) for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": topic.encoding,
                    "offered_qos_profiles": topic.qos.as_profiles(),
                    "type_description_hash": topic.definition.type_hash,
                },
                "message_count": sum(file.message_counts.get(topic.name, 0) for file in files),
            }
            for topic in topics
        ],
        # Of rosbag2's own compression of messages and files; MCAP compresses its chunks by itself.
        "compression_format": "",
        "compression_mode": "",
        "relative_file_paths": [file.name for file in files],
        "files": [
            {
                "path": file.name,
                "starting_time": _start(file.time_range),
                "duration": _duration(file.time_range),
                "message_count": sum(file.message_counts.values()),
            }
            for file in files
        ],
        "custom_data": dict(custom_data) or None,
        "ros_distro": ROS_DISTRO,
    }


def _start(time_range: tuple[int, int] | None) -> dict[str, int]:
    return {"nanoseconds_since_epoch": time_range[0] if time_range else _NO_TIME}


def _duration(time_range: tuple[int, int] | None) -> dict[str, int]:
    return {"nanoseconds": time_range[1] - time_range[0] if time_range else 0}


def as_yaml(information: Mapping[str, object]) -> str:
    """YAML in the order of rosbag2; without anchors, since no object occurs twice in it."""
    return str(yaml.safe_dump(dict(information), sort_keys=False, allow_unicode=True))


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
