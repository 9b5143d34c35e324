"""metadata.yaml: what rosbag2 knows of a bag without opening its files. Version 9, as ROS 2 Jazzy writes it.

Source: rosbag2_storage/yaml.hpp, ``convert<BagMetadata>`` and ``convert<TopicMetadata>``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import yaml

from straightcomp_ros.bags.definitions import ROS_DISTRO
from straightcomp_ros.bags.qos import TopicQos

VERSION = 9
_NO_TIME = 2**63 - 1
"""Start of a bag without messages, in ns: rosbag2 writes the end of time."""


@dataclass(frozen=True)
class Topic:
    """A recorded topic: full name, ROS type, quality of service, type hash."""

    name: str
    type_name: str
    qos: TopicQos
    type_hash: str


@dataclass(frozen=True)
class BagFile:
    """One file of a bag.

    Attributes:
        name: relative to the bag's folder.
        time_range: first and last log time in ns, None without messages.
        message_counts: by topic.
    """

    name: str
    time_range: tuple[int, int] | None
    message_counts: Mapping[str, int]

    @property
    def message_count(self) -> int:
        """Messages of all topics."""
        return sum(self.message_counts.values())


def bag_information(
    files: Sequence[BagFile], topics: Sequence[Topic], custom_data: Mapping[str, str]
) -> dict[str, object]:
    """The content of metadata.yaml below its one root key.

    Args:
        files: oldest first.
        topics: all of them, with messages or without.
        custom_data: free texts.
    """
    ranges = [file.time_range for file in files if file.time_range]
    whole = (min(first for first, _ in ranges), max(last for _, last in ranges)) if ranges else None
    return {
        "version": VERSION,
        "storage_identifier": "mcap",
        **_times(whole),
        "message_count": sum(file.message_count for file in files),
        "topics_with_message_count": [
            {
                "topic_metadata": {
                    "name": topic.name,
                    "type": topic.type_name,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": topic.qos.as_profiles(),
                    "type_description_hash": topic.type_hash,
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
                **_times(file.time_range, "starting_time", "duration"),
                "message_count": file.message_count,
            }
            for file in files
        ],
        "custom_data": dict(custom_data) or None,
        "ros_distro": ROS_DISTRO,
    }


def _times(time_range: tuple[int, int] | None, *order: str) -> dict[str, dict[str, int]]:
    """Both times, in the order of the root or in another."""
    first, last = time_range or (_NO_TIME, _NO_TIME)
    times = {"duration": {"nanoseconds": last - first}, "starting_time": {"nanoseconds_since_epoch": first}}
    return {name: times[name] for name in order or times}


def as_yaml(information: Mapping[str, object]) -> str:
    """YAML without anchors, in the order of rosbag2."""
    return str(yaml.dump(dict(information), Dumper=_WithoutAnchors, sort_keys=False, allow_unicode=True))


class _WithoutAnchors(yaml.SafeDumper):
    """Writes an object that occurs twice two times, as yaml-cpp does."""

    def ignore_aliases(self, data: object) -> bool:
        return True
